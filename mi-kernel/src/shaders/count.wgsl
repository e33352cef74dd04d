// Scores of pairs: a workgroup is one column i times 256 columns j, a lane owns four of them and a histogram of its own.
// The rows come grouped by the symbol of column i, so the histogram is that of one symbol: no atomics, no barriers, and
// no difference between conserved and random columns. What is made of the counts is gaps_counted.wgsl's or
// gaps_apart.wgsl's. Twin: src/reference.rs (score_pairs).

// Two columns a word: n is below 65,536.
var<workgroup> histogram: array<u32, SYMBOLS * 128u>;
var<workgroup> group_maximum: atomic<u32>;

// The first and the third column have words of their own, so have the others: two sums are under way at a time.
fn count_row(symbols: u32, lane: u32) {
    let a = (symbols & 0xffu) * 128u + lane;
    let c = ((symbols >> 16u) & 0xffu) * 128u + 64u + lane;
    let count_a = histogram[a];
    let count_c = histogram[c];
    histogram[a] = count_a + 1u;
    histogram[c] = count_c + 1u;
    let b = ((symbols >> 8u) & 0xffu) * 128u + lane;
    let d = (symbols >> 24u) * 128u + 64u + lane;
    let count_b = histogram[b];
    let count_d = histogram[d];
    histogram[b] = count_b + 0x10000u;
    histogram[d] = count_d + 0x10000u;
}

fn count_rows(symbols: vec4<u32>, lane: u32) {
    count_row(symbols.x, lane);
    count_row(symbols.y, lane);
    count_row(symbols.z, lane);
    count_row(symbols.w, lane);
}

fn grouped_row(base: u32, place: u32) -> u32 {
    return (grouped[base + (place >> 1u)] >> ((place & 1u) * 16u)) & 0xffffu;
}

// The four columns of a word in the four rows that two words name.
fn symbols_of(rows: vec2<u32>, word: u32) -> vec4<u32> {
    return vec4<u32>(
        shuffled[(rows.x & 0xffffu) * sizes.row_words + word],
        shuffled[(rows.x >> 16u) * sizes.row_words + word],
        shuffled[(rows.y & 0xffffu) * sizes.row_words + word],
        shuffled[(rows.y >> 16u) * sizes.row_words + word],
    );
}

fn rows_at(at: u32) -> vec4<u32> {
    return vec4<u32>(grouped[at], grouped[at + 1u], grouped[at + 2u], grouped[at + 3u]);
}

// What the counts of column i with the four columns of a word come to.
fn tally_of(local_i: u32, word: u32, lane: u32) -> Tally {
    let base = local_i * sizes.order_words;
    let i = chunk.first_i + local_i;
    var tally = Tally();
    for (var symbol = 0u; symbol < SYMBOLS; symbol += 1u) {
        var place = bounds[i * (SYMBOLS + 1u) + symbol];
        let end = bounds[i * (SYMBOLS + 1u) + symbol + 1u];
        if place == end && skips_if_empty(symbol) {
            continue;
        }
        if (place & 1u) == 1u {
            count_row(shuffled[grouped_row(base, place) * sizes.row_words + word], lane);
            place += 1u;
        }
        // Eight rows a round: while they are counted the symbols of the next eight are on their way, and the numbers of the
        // eight after those, which may be the next symbol's. (And the rounds stay below lavapipe's 65,535.)
        if place + 8u <= end {
            let last_at = base + sizes.order_words - 4u;
            var rows = rows_at(base + (place >> 1u));
            var first = symbols_of(rows.xy, word);
            var second = symbols_of(rows.zw, word);
            place += 8u;
            rows = rows_at(min(base + (place >> 1u), last_at));
            while place + 8u <= end {
                let next_first = symbols_of(rows.xy, word);
                let next_second = symbols_of(rows.zw, word);
                rows = rows_at(min(base + (place >> 1u) + 4u, last_at));
                count_rows(first, lane);
                count_rows(second, lane);
                first = next_first;
                second = next_second;
                place += 8u;
            }
            count_rows(first, lane);
            count_rows(second, lane);
        }
        while place < end {
            count_row(shuffled[grouped_row(base, place) * sizes.row_words + word], lane);
            place += 1u;
        }
        tally = flush(tally, symbol, i, word, lane);
    }
    return tally;
}

// Which pairs a workgroup computes. z runs over column groups within a block of j, so that neighbours share a block.
struct Work {
    local_i: u32,
    block: u32,
    any: bool,
}

fn work_of(group: vec3<u32>) -> Work {
    let z = group.z + first_z;
    let local_i = (z % chunk.column_groups) * chunk.columns_x + group.x;
    let block = chunk.first_block + z / chunk.column_groups;
    // Blocks left of the diagonal hold no pair.
    let last_j = block * BLOCK_COLUMNS + BLOCK_COLUMNS - 1u;
    return Work(local_i, block, local_i < chunk.columns && last_j > chunk.first_i + local_i);
}

// Place of the pair in the chunk.
fn place_of(i: u32, j: u32) -> u32 {
    return i * (2u * sizes.l - i - 1u) / 2u + j - i - 1u - chunk.first_place;
}

fn accumulate(at: u32, x: i32) {
    let word = bitcast<u32>(x);
    let sum = sums[at];
    let sum_low = sum.x + word;
    sums[at] = vec2<u32>(sum_low, sum.y + select(0u, 0xffffffffu, x < 0) + select(0u, 1u, sum_low < word));
    let magnitude = select(word, 0u - word, x < 0);
    let squared = product(magnitude, magnitude);
    let square = squares[at];
    let square_low = square.x + squared.low;
    squares[at] = vec2<u32>(square_low, square.y + squared.high + select(0u, 1u, square_low < squared.low));
    reached[at] += select(0u, 1u, x >= observed[at]);
}

@compute @workgroup_size(64, 1, 1)
fn count_reduce(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let work = work_of(group);
    if !work.any {
        return;
    }
    let i = chunk.first_i + work.local_i;
    let word = work.block * LANES + lane;
    let tally = tally_of(work.local_i, min(word, sizes.row_words - 1u), lane);
    var largest = 0u;
    for (var column = 0u; column < 4u; column += 1u) {
        let j = word * 4u + column;
        if j > i && j < sizes.l {
            let x = score(tally, column, i, j);
            accumulate(place_of(i, j), x);
            largest = max(largest, bitcast<u32>(x) ^ 0x80000000u);
        }
    }
    atomicMax(&group_maximum, largest);
    workgroupBarrier();
    if lane == 0u {
        atomicMax(&maxima[round_keys[0]], atomicLoad(&group_maximum));
    }
}

@compute @workgroup_size(64, 1, 1)
fn count_matrix(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let work = work_of(group);
    if !work.any {
        return;
    }
    let i = chunk.first_i + work.local_i;
    let word = work.block * LANES + lane;
    let tally = tally_of(work.local_i, min(word, sizes.row_words - 1u), lane);
    for (var column = 0u; column < 4u; column += 1u) {
        let j = word * 4u + column;
        if j > i && j < sizes.l {
            scores[place_of(i, j)] = score(tally, column, i, j);
        }
    }
}
