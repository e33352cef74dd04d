// Everything that crosses between host and device: structs and bindings. Twin: src/gpu/layout.rs. The host puts
// `const SYMBOLS` (q) in front of this text.

const LANES: u32 = 64u;
// Columns j of one workgroup: four a lane.
const BLOCK_COLUMNS: u32 = 256u;
// Rows that one lane of `shuffle` writes, and words that one lane of `group` writes.
const ROWS_A_LANE: u32 = 16u;
const WORDS_A_LANE: u32 = 8u;
// Words before the first column's keys in `round_keys`: the iteration's slot, whether it is shuffled.
const KEYS_HEADER: u32 = 8u;

struct Sizes {
    n: u32,
    l: u32,
    row_words: u32,
    column_words: u32,
    order_words: u32,
    left_bits: u32,
    right_bits: u32,
    plane_words: u32,
    // s: fractional bits of the table.
    scale_bits: u32,
    padding_0: u32,
    padding_1: u32,
    padding_2: u32,
}

// Columns i of one launch, and where their pairs begin.
struct Chunk {
    first_i: u32,
    columns: u32,
    first_place: u32,
    first_block: u32,
    columns_x: u32,
    column_groups: u32,
    padding_0: u32,
    padding_1: u32,
}

struct Iteration {
    number_lo: u32,
    number_hi: u32,
    seed_lo: u32,
    seed_hi: u32,
    slot: u32,
    shuffled: u32,
    padding_0: u32,
    padding_1: u32,
}

// Symbol codes, a byte each, column after column.
@group(0) @binding(0) var<storage, read> codes: array<u32>;
// Rows of each column of the chunk in the order of their symbols, 16 bits each.
@group(0) @binding(1) var<storage, read> symbol_order: array<u32>;
// Where each symbol's rows begin in that order: SYMBOLS + 1 a column.
@group(0) @binding(2) var<storage, read> bounds: array<u32>;
// T(c) for c = 0..=n.
@group(0) @binding(3) var<storage, read> table: array<u32>;
// What each column adds to its pairs' scores (src/gaps.rs).
@group(0) @binding(4) var<storage, read> column_terms: array<u32>;
@group(0) @binding(5) var<storage, read_write> round_keys: array<u32>;
// Row after row, a byte a column.
@group(0) @binding(6) var<storage, read_write> shuffled: array<u32>;
// As symbol_order, of the shuffled columns.
@group(0) @binding(7) var<storage, read_write> grouped: array<u32>;
@group(0) @binding(8) var<storage, read> observed: array<i32>;
// 64 bits, low word first.
@group(0) @binding(9) var<storage, read_write> sums: array<vec2<u32>>;
@group(0) @binding(10) var<storage, read_write> squares: array<vec2<u32>>;
@group(0) @binding(11) var<storage, read_write> reached: array<u32>;
// Largest score of each iteration, its sign bit turned over so that unsigned order is the order.
@group(0) @binding(12) var<storage, read_write> maxima: array<atomic<u32>>;
@group(0) @binding(13) var<storage, read_write> scores: array<i32>;
// A bit a row: word by word, in it symbol by symbol but the first, in it column by column.
@group(0) @binding(14) var<storage, read_write> planes: array<u32>;

@group(1) @binding(0) var<uniform> sizes: Sizes;
@group(1) @binding(1) var<uniform> chunk: Chunk;
@group(1) @binding(2) var<uniform> iteration: Iteration;
@group(1) @binding(3) var<uniform> first_z: u32;
