// Gaps are a symbol like all others (ORMI): a pair's score is N * MI * 2^s. Twin: src/gaps.rs (score).

// sum_ab T(c_ab) of column i with four columns.
alias Tally = vec4<u32>;

fn skips_if_empty(symbol: u32) -> bool {
    return true;
}

// Adds T over the histogram and empties it.
fn flush(tally: Tally, symbol: u32, i: u32, word: u32, lane: u32) -> Tally {
    var total = tally;
    for (var other = 0u; other < SYMBOLS; other += 1u) {
        let at = other * 128u + lane;
        let low = histogram[at];
        let high = histogram[at + 64u];
        histogram[at] = 0u;
        histogram[at + 64u] = 0u;
        total += vec4<u32>(table[low & 0xffffu], table[low >> 16u], table[high & 0xffffu], table[high >> 16u]);
    }
    return total;
}

// X of column i with column j.
fn joint_score(joint: u32, i: u32, j: u32) -> i32 {
    return bitcast<i32>(joint - column_terms[i] - column_terms[j] + table[sizes.n]);
}

fn score(tally: Tally, column: u32, i: u32, j: u32) -> i32 {
    return joint_score(tally[column], i, j);
}
