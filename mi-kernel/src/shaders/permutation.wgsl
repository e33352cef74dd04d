// The keyed Feistel permutation and the Philox blocks its keys come from. Twins: src/shuffle.rs, src/philox.rs.

struct Product {
    high: u32,
    low: u32,
}

fn product(a: u32, b: u32) -> Product {
    let a_low = a & 0xffffu;
    let a_high = a >> 16u;
    let b_low = b & 0xffffu;
    let b_high = b >> 16u;
    let low = a_low * b_low;
    let middle = a_high * b_low + (low >> 16u);
    let cross = a_low * b_high + (middle & 0xffffu);
    return Product(a_high * b_high + (middle >> 16u) + (cross >> 16u), a * b);
}

fn philox4x32_10(counter: vec4<u32>, key: vec2<u32>) -> vec4<u32> {
    var c = counter;
    var k = key;
    for (var round = 0u; round < 10u; round += 1u) {
        let p0 = product(0xd2511f53u, c.x);
        let p1 = product(0xcd9e8d57u, c.z);
        c = vec4<u32>(p1.high ^ c.y ^ k.x, p1.low, p0.high ^ c.w ^ k.y, p0.low);
        k += vec2<u32>(0x9e3779b9u, 0xbb67ae85u);
    }
    return c;
}

struct Feistel {
    first: vec4<u32>,
    second: vec4<u32>,
}

fn feistel_of(column: u32) -> Feistel {
    let base = KEYS_HEADER + column * 8u;
    return Feistel(
        vec4<u32>(round_keys[base], round_keys[base + 1u], round_keys[base + 2u], round_keys[base + 3u]),
        vec4<u32>(round_keys[base + 4u], round_keys[base + 5u], round_keys[base + 6u], round_keys[base + 7u]),
    );
}

fn mix(input: u32) -> u32 {
    var value = input;
    value ^= value >> 16u;
    value *= 0x85ebca6bu;
    value ^= value >> 13u;
    value *= 0xc2b2ae35u;
    return value ^ (value >> 16u);
}

// Two rounds leave the halves where they were: x is the left one, y the right one.
fn two_rounds(halves: vec2<u32>, key_a: u32, key_b: u32, masks: vec2<u32>) -> vec2<u32> {
    let left = halves.x ^ (mix(halves.y ^ key_a) & masks.x);
    return vec2<u32>(left, halves.y ^ (mix(left ^ key_b) & masks.y));
}

fn two_rounds_back(halves: vec2<u32>, key_a: u32, key_b: u32, masks: vec2<u32>) -> vec2<u32> {
    let right = halves.y ^ (mix(halves.x ^ key_b) & masks.y);
    return vec2<u32>(halves.x ^ (mix(right ^ key_a) & masks.x), right);
}

fn half_masks() -> vec2<u32> {
    return vec2<u32>((1u << sizes.left_bits) - 1u, (1u << sizes.right_bits) - 1u);
}

// Where a row comes from. The walk ends: the cycle holds `row` itself, which is below n.
fn forward(feistel: Feistel, row: u32) -> u32 {
    let masks = half_masks();
    var value = row;
    loop {
        var halves = vec2<u32>(value >> sizes.right_bits, value & masks.y);
        halves = two_rounds(halves, feistel.first.x, feistel.first.y, masks);
        halves = two_rounds(halves, feistel.first.z, feistel.first.w, masks);
        halves = two_rounds(halves, feistel.second.x, feistel.second.y, masks);
        halves = two_rounds(halves, feistel.second.z, feistel.second.w, masks);
        value = (halves.x << sizes.right_bits) | halves.y;
        if value < sizes.n {
            break;
        }
    }
    return value;
}

fn backward(feistel: Feistel, row: u32) -> u32 {
    let masks = half_masks();
    var value = row;
    loop {
        var halves = vec2<u32>(value >> sizes.right_bits, value & masks.y);
        halves = two_rounds_back(halves, feistel.second.z, feistel.second.w, masks);
        halves = two_rounds_back(halves, feistel.second.x, feistel.second.y, masks);
        halves = two_rounds_back(halves, feistel.first.z, feistel.first.w, masks);
        halves = two_rounds_back(halves, feistel.first.x, feistel.first.y, masks);
        value = (halves.x << sizes.right_bits) | halves.y;
        if value < sizes.n {
            break;
        }
    }
    return value;
}
