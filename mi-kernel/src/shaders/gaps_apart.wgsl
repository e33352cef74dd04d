// Gaps stand apart (SUMI, DEMI, ESMI): a pair's score is MI * 2^SCORE_BITS over the rows in which neither column has a
// gap. The gap is symbol 0. The host puts `const GAPS` in front of this text. Twin: src/gaps.rs (score).

const SUMI: u32 = 1u;
const DEMI: u32 = 2u;
const ESMI: u32 = 3u;

const SCORE_BITS: u32 = 20u;
const LOW_BITS: u32 = 15u;
const LEAST_ROWS: u32 = 2u;

// What the counts of column i with four columns come to.
struct Tally {
    // Rows with residues in both columns.
    rows: vec4<u32>,
    // sum_ab T(c_ab) over residues, with what the marginal counts r add: SUMI -T(r), ESMI r times the symbol's surprisal.
    terms: vec4<u32>,
    // ESMI: r times the low part of the surprisal.
    low: vec4<u32>,
}

// The gaps of column i are needed also where there are none: what they leave of column j is its marginal counts.
fn skips_if_empty(symbol: u32) -> bool {
    return symbol != 0u;
}

fn table_of(counts: vec4<u32>) -> vec4<u32> {
    return vec4<u32>(table[counts.x], table[counts.y], table[counts.z], table[counts.w]);
}

fn bounds_at(columns: vec4<u32>, symbol: u32) -> vec4<u32> {
    let at = columns * (SYMBOLS + 1u) + symbol;
    return vec4<u32>(bounds[at.x], bounds[at.y], bounds[at.z], bounds[at.w]);
}

fn column_terms_at(at: vec4<u32>) -> vec4<u32> {
    return vec4<u32>(column_terms[at.x], column_terms[at.y], column_terms[at.z], column_terms[at.w]);
}

// What four columns' marginal counts of a symbol add.
fn with_margin(tally: Tally, counts: vec4<u32>, columns: vec4<u32>, symbol: u32) -> Tally {
    var added = tally;
    if GAPS == SUMI {
        added.terms -= table_of(counts);
    } else if GAPS == ESMI {
        let at = (columns * SYMBOLS + symbol) * 2u;
        added.terms += counts * column_terms_at(at);
        added.low += counts * column_terms_at(at + 1u);
    }
    return added;
}

// Takes the counts of column i's symbol with all symbols of four columns and empties the histogram.
fn flush(before: Tally, symbol: u32, i: u32, word: u32, lane: u32) -> Tally {
    var tally = before;
    // Columns past the last one are counted, not used.
    let columns = min(vec4<u32>(0u, 1u, 2u, 3u) + word * 4u, vec4<u32>(sizes.l - 1u));
    for (var other = 0u; other < SYMBOLS; other += 1u) {
        let at = other * 128u + lane;
        let low = histogram[at];
        let high = histogram[at + 64u];
        histogram[at] = 0u;
        histogram[at + 64u] = 0u;
        let counts = vec4<u32>(low & 0xffffu, low >> 16u, high & 0xffffu, high >> 16u);
        if symbol == 0u {
            if other > 0u {
                // What column i's gaps leave of the other column's symbol.
                let left = bounds_at(columns, other + 1u) - bounds_at(columns, other) - counts;
                tally = with_margin(tally, left, columns, other);
            }
        } else if other == 0u {
            let at_symbol = i * (SYMBOLS + 1u) + symbol;
            let left = vec4<u32>(bounds[at_symbol + 1u] - bounds[at_symbol]) - counts;
            tally.rows += left;
            tally = with_margin(tally, left, vec4<u32>(i), symbol);
        } else {
            tally.terms += table_of(counts);
        }
    }
    return tally;
}

// terms * 2^bits / rows of a signed number, rounded, halves away from zero. Long division: the product may leave a word.
fn quotient(terms: u32, rows: u32, bits: u32) -> i32 {
    let negative = bitcast<i32>(terms) < 0;
    let magnitude = select(terms, 0u - terms, negative);
    let whole = magnitude / rows;
    let rest = magnitude % rows;
    let value = bitcast<i32>((whole << bits) + ((rest << bits) + rows / 2u) / rows);
    return select(value, -value, negative);
}

// MI * 2^SCORE_BITS of column i with column j.
fn score(tally: Tally, column: u32, i: u32, j: u32) -> i32 {
    let rows = tally.rows[column];
    if rows < LEAST_ROWS {
        return 0;
    }
    let terms = tally.terms[column];
    let bits = SCORE_BITS - sizes.scale_bits;
    if GAPS == SUMI {
        return quotient(terms + table[rows], rows, bits);
    }
    if GAPS == DEMI {
        return quotient(terms - table[rows], rows, bits) + bitcast<i32>(column_terms[i] + column_terms[j]);
    }
    let carried = (tally.low[column] + (1u << (LOW_BITS - 1u))) >> LOW_BITS;
    return quotient(terms - table[rows] + carried, rows, bits);
}
