//! Twin of `shaders/shared/rng.wgsl`: bit for bit the same numbers.

use glam::Vec4;

/// Stream of eye samples.
pub const STREAM_EYE: u32 = 0x9e37_79b9;
/// Stream of light paths.
pub const STREAM_LIGHT: u32 = 0x85eb_ca6b;

/// A counter-based generator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rng {
    key: [u32; 4],
    dimension: u32,
}

/// The hash (Jarzynski and Olano 2020).
#[must_use]
pub fn pcg4d(input: [u32; 4]) -> [u32; 4] {
    let mut v = input.map(|x| x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
    let round = |v: &mut [u32; 4]| {
        v[0] = v[0].wrapping_add(v[1].wrapping_mul(v[3]));
        v[1] = v[1].wrapping_add(v[2].wrapping_mul(v[0]));
        v[2] = v[2].wrapping_add(v[0].wrapping_mul(v[1]));
        v[3] = v[3].wrapping_add(v[1].wrapping_mul(v[2]));
    };
    round(&mut v);
    v = v.map(|x| x ^ (x >> 16));
    round(&mut v);
    v
}

/// `index` is (pixel, sample) of an eye sample, or the two halves of a light path's index.
#[must_use]
pub fn rng_new(index: [u32; 2], stream: u32, seed: u64) -> Rng {
    let halves = [(seed & 0xffff_ffff) as u32, (seed >> 32) as u32];
    let mut key = pcg4d([index[0], index[1], halves[0], halves[1]]);
    key[3] ^= stream;
    Rng { key, dimension: 0 }
}

/// The next four dimensions as integers.
#[must_use]
pub fn rng_bits(rng: &mut Rng) -> [u32; 4] {
    let [x, y, z, w] = rng.key;
    let bits = pcg4d([x.wrapping_add(rng.dimension), y, z, w]);
    rng.dimension += 1;
    bits
}

/// The next four dimensions, each in `0 <= u < 1`.
#[must_use]
pub fn rng_next(rng: &mut Rng) -> Vec4 {
    #[allow(clippy::cast_precision_loss, reason = "24 bits fit f32")]
    let unit = rng_bits(rng).map(|x| (x >> 8) as f32 * (1.0 / 16_777_216.0));
    Vec4::from_array(unit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dimensions_are_uniform_and_uncorrelated() {
        const COUNT: u32 = 40_000;
        // Neighbouring indices, first dimensions: where a weak hash shows.
        let mut mean = [0.0_f64; 8];
        let mut square = [0.0_f64; 8];
        let mut lag = [0.0_f64; 8];
        let mut before = [0.5_f64; 8];
        for index in 0..COUNT {
            let mut rng = rng_new([index % 200, index / 200], STREAM_EYE, 7);
            let (a, b) = (rng_next(&mut rng), rng_next(&mut rng));
            let u = [a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w].map(f64::from);
            for d in 0..8 {
                mean[d] += u[d];
                square[d] += u[d] * u[d];
                lag[d] += (u[d] - 0.5) * (before[d] - 0.5);
            }
            before = u;
        }
        let n = f64::from(COUNT);
        for d in 0..8 {
            // Standard errors: mean sqrt(1/12/n), square sqrt(4/45/n), lagged product 1/12/sqrt(n). Five of each.
            assert!((mean[d] / n - 0.5).abs() < 5.0 * (1.0 / 12.0 / n).sqrt(), "mean of dimension {d}");
            assert!(
                (square[d] / n - 1.0 / 3.0).abs() < 5.0 * (4.0 / 45.0 / n).sqrt(),
                "square of dimension {d}"
            );
            assert!((lag[d] / n).abs() < 5.0 / 12.0 / n.sqrt(), "lag of dimension {d}");
        }
    }

    #[test]
    fn keys_tell_streams_seeds_and_indices_apart() {
        let draw = |index, stream, seed| rng_bits(&mut rng_new(index, stream, seed));
        let base = draw([1, 2], STREAM_EYE, 3);
        assert_eq!(base, draw([1, 2], STREAM_EYE, 3), "same key, same numbers");
        let others = [
            draw([1, 2], STREAM_LIGHT, 3),
            draw([2, 1], STREAM_EYE, 3),
            draw([1, 2], STREAM_EYE, 4),
            draw([1, 2], STREAM_EYE, 3 | (1 << 32)),
        ];
        assert!(others.iter().all(|other| *other != base), "each part of the key matters");
    }
}
