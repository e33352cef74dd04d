// Scores of pairs over small alphabets: a bit a row for each symbol but the first, AND and a count of ones; what concerns
// the first symbol follows from the columns' own counts. `joint_planes(i, j)` is made for the alphabet's size by
// src/gpu/mod.rs. Twin: src/reference.rs (score_pairs).

// Word z of every column: 32 rows, symbol by symbol, column by column.
@compute @workgroup_size(64, 1, 1)
fn planes_of_rows(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let column = group.x * LANES + lane;
    if column >= sizes.l {
        return;
    }
    let feistel = feistel_of(column);
    let word = group.z + first_z;
    let rows = min(32u, sizes.n - word * 32u);
    var bits: array<u32, SYMBOLS>;
    for (var row = 0u; row < rows; row += 1u) {
        bits[shuffled_symbol(feistel, column, word * 32u + row)] |= 1u << row;
    }
    for (var symbol = 1u; symbol < SYMBOLS; symbol += 1u) {
        planes[(word * (SYMBOLS - 1u) + symbol - 1u) * sizes.l + column] = bits[symbol];
    }
}

// How often a column has a symbol.
fn margin(column: u32, symbol: u32) -> u32 {
    let at = column * (SYMBOLS + 1u) + symbol;
    return bounds[at + 1u] - bounds[at];
}

@compute @workgroup_size(64, 1, 1)
fn planes_reduce(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let work = work_of(group);
    if !work.any {
        return;
    }
    let i = chunk.first_i + work.local_i;
    var largest = 0u;
    for (var turn = 0u; turn < 4u; turn += 1u) {
        let j = work.block * BLOCK_COLUMNS + turn * LANES + lane;
        if j > i && j < sizes.l {
            let x = joint_score(joint_planes(i, j), i, j);
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
fn planes_matrix(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let work = work_of(group);
    if !work.any {
        return;
    }
    let i = chunk.first_i + work.local_i;
    for (var turn = 0u; turn < 4u; turn += 1u) {
        let j = work.block * BLOCK_COLUMNS + turn * LANES + lane;
        if j > i && j < sizes.l {
            scores[place_of(i, j)] = joint_score(joint_planes(i, j), i, j);
        }
    }
}
