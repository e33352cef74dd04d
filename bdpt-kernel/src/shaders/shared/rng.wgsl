// Counter-based random numbers keyed (seed, index, stream, dimension): a retry or another tiling draws the same.
// pcg4d of Jarzynski and Olano 2020, applied twice. Twin: src/twin/rng.rs.

const STREAM_EYE: u32 = 0x9e3779b9u;
const STREAM_LIGHT: u32 = 0x85ebca6bu;

struct Rng {
    key: vec4<u32>,
    dimension: u32,
}

fn pcg4d(input: vec4<u32>) -> vec4<u32> {
    var v = input * 1664525u + 1013904223u;
    v.x += v.y * v.w;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    v.w += v.y * v.z;
    v = v ^ (v >> vec4<u32>(16u));
    v.x += v.y * v.w;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    v.w += v.y * v.z;
    return v;
}

// `index` is (pixel, sample) of an eye sample, or the two halves of a light path's index.
fn rng_new(index: vec2<u32>, stream: u32, seed: vec2<u32>) -> Rng {
    var key = pcg4d(vec4<u32>(index, seed));
    key.w ^= stream;
    return Rng(key, 0u);
}

// The next four dimensions, each in 0 <= u < 1.
fn rng_next(rng: ptr<function, Rng>) -> vec4<f32> {
    let key = (*rng).key;
    let bits = pcg4d(vec4<u32>(key.x + (*rng).dimension, key.y, key.z, key.w));
    (*rng).dimension += 1u;
    return vec4<f32>(bits >> vec4<u32>(8u)) * (1.0 / 16777216.0);
}
