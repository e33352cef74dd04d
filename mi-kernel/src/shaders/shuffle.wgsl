// One iteration's alignment: round keys, the shuffled rows, and each column's rows by symbol. Twin: src/shuffle.rs.

@compute @workgroup_size(64, 1, 1)
fn keys(@builtin(global_invocation_id) id: vec3<u32>) {
    let column = id.x;
    if column == 0u {
        round_keys[0] = iteration.slot;
        round_keys[1] = iteration.shuffled;
    }
    if column >= sizes.l {
        return;
    }
    let key = vec2<u32>(iteration.seed_lo, iteration.seed_hi);
    let base = KEYS_HEADER + column * 8u;
    for (var block = 0u; block < 2u; block += 1u) {
        let words = philox4x32_10(vec4<u32>(iteration.number_lo, iteration.number_hi, column, block), key);
        round_keys[base + block * 4u] = words.x;
        round_keys[base + block * 4u + 1u] = words.y;
        round_keys[base + block * 4u + 2u] = words.z;
        round_keys[base + block * 4u + 3u] = words.w;
    }
}

fn shuffled_symbol(feistel: Feistel, column: u32, row: u32) -> u32 {
    if column >= sizes.l {
        return 0u;
    }
    var source = row;
    if round_keys[1] != 0u {
        source = forward(feistel, row);
    }
    return (codes[column * sizes.column_words + (source >> 2u)] >> ((source & 3u) * 8u)) & 0xffu;
}

// A lane writes one word (four columns) of some rows.
@compute @workgroup_size(64, 1, 1)
fn shuffle(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let word = group.x * LANES + lane;
    if word >= sizes.row_words {
        return;
    }
    let column = word * 4u;
    let last = sizes.l - 1u;
    let feistel_0 = feistel_of(min(column, last));
    let feistel_1 = feistel_of(min(column + 1u, last));
    let feistel_2 = feistel_of(min(column + 2u, last));
    let feistel_3 = feistel_of(min(column + 3u, last));
    let first_row = (group.z + first_z) * ROWS_A_LANE;
    let end_row = min(first_row + ROWS_A_LANE, sizes.n);
    for (var row = first_row; row < end_row; row += 1u) {
        shuffled[row * sizes.row_words + word] = shuffled_symbol(feistel_0, column, row)
            | (shuffled_symbol(feistel_1, column + 1u, row) << 8u)
            | (shuffled_symbol(feistel_2, column + 2u, row) << 16u)
            | (shuffled_symbol(feistel_3, column + 3u, row) << 24u);
    }
}

fn shuffled_row(feistel: Feistel, row: u32) -> u32 {
    // The last word of an odd column holds one row; the other half is never read.
    if round_keys[1] == 0u || row >= sizes.n {
        return row;
    }
    return backward(feistel, row);
}

// z is a column of the chunk: where its rows, ordered by symbol, are after the shuffle.
@compute @workgroup_size(64, 1, 1)
fn group(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let column = group.z + first_z;
    let feistel = feistel_of(chunk.first_i + column);
    for (var turn = 0u; turn < WORDS_A_LANE; turn += 1u) {
        let word = (group.x * WORDS_A_LANE + turn) * LANES + lane;
        if word >= sizes.order_words {
            return;
        }
        let at = column * sizes.order_words + word;
        let rows = symbol_order[at];
        grouped[at] = shuffled_row(feistel, rows & 0xffffu) | (shuffled_row(feistel, rows >> 16u) << 16u);
    }
}
