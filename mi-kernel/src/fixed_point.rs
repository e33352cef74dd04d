//! `T(c) = c * log2(c)` as fixed-point integers, and the scale that keeps every sum in 31 bits.
//!
//! The logarithm is computed with integers only, so the table, and with it every result, is the same on every machine and
//! with every mathematics library.

/// Largest scale: 14 fractional bits leave an error of 1.4e-6 bits of mutual information at N = 200.
pub const MAX_SCALE_BITS: u32 = 14;

/// Fractional bits of [`log2_q57`].
pub(crate) const LOG_BITS: u32 = 57;

/// The table of `T(c) * 2^s` for c = 0..=N, modulo 2^32.
///
/// Entries wrap: sums are taken modulo 2^32 and only the final score must fit an `i32`, which the scale makes sure of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FixedPoint {
    scale_bits: u32,
    table: Vec<u32>,
}

impl FixedPoint {
    /// The table for `n` sequences over `q` symbols; `None` where no scale fits 31 bits.
    #[must_use]
    pub fn new(n: u32, q: u32) -> Option<Self> {
        let scale_bits = scale_bits(n, q)?;
        Some(Self { scale_bits, table: (0..=n).map(|count| entry(count, scale_bits)).collect() })
    }

    /// s: how many fractional bits a score has.
    #[must_use]
    pub fn scale_bits(&self) -> u32 {
        self.scale_bits
    }

    /// `round(c * log2(c) * 2^s)` modulo 2^32, for c = 0..=N; what a kernel binds.
    #[must_use]
    pub fn table(&self) -> &[u32] {
        &self.table
    }

    /// Sum of T over counts, modulo 2^32. Counts are at most N.
    #[must_use]
    pub fn sum(&self, counts: &[u32]) -> u32 {
        counts.iter().fold(0u32, |sum, count| sum.wrapping_add(self.table[*count as usize]))
    }
}

/// The largest s up to [`MAX_SCALE_BITS`] with `N * log2(q) * 2^s` below 2^31.
///
/// The design gives `min(14, 31 - ceil(log2(N * log2 q)))`. That is the same, but where `N * log2 q` is a power of two
/// (N = 32,768 and q = 16) it lets X reach 2^31 itself; the rounding of the `(q + 1)^2` terms is kept free here too.
pub(crate) fn scale_bits(n: u32, q: u32) -> Option<u32> {
    let rounding = u128::from(q + 1) * u128::from(q + 1) / 2 + 1;
    let most = u128::from(n) * u128::from(log2_q57(u64::from(q.max(1))));
    (0..=MAX_SCALE_BITS).rev().find(|s| ((most << s) >> LOG_BITS) + rounding < 1 << 31)
}

fn entry(count: u32, scale_bits: u32) -> u32 {
    let exact = (u128::from(count) * u128::from(log2_q57(u64::from(count.max(1))))) << scale_bits;
    let rounded = (exact + (1 << (LOG_BITS - 1))) >> LOG_BITS;
    u32::try_from(rounded & u128::from(u32::MAX)).expect("32 bits are left")
}

/// `log2(value)` in units of 2^-57, by repeated squaring; exact for powers of two, else at most 2 units low.
///
/// `value` is at least 1; log2 of 0 is taken as 0.
#[must_use]
pub fn log2_q57(value: u64) -> u64 {
    let whole = value.max(1).ilog2();
    // The mantissa in [1, 2) with 63 fractional bits. Each squaring doubles the logarithm; a carry past 2 is its next bit.
    // An error of 2^-63 made at step k counts 2^-k: all 57 steps together stay below 2^-62.
    let mut mantissa = u128::from(value.max(1)) << (63 - whole);
    let mut logarithm = u64::from(whole);
    for _ in 0..LOG_BITS {
        mantissa = (mantissa * mantissa) >> 63;
        let carry = mantissa >> 64;
        mantissa >>= carry;
        logarithm = (logarithm << 1) | u64::from(carry != 0);
    }
    logarithm
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_integer_logarithm_agrees_with_the_library() {
        assert_eq!(log2_q57(1), 0);
        assert_eq!(log2_q57(1 << 40), 40 << LOG_BITS);
        for value in (1..5_000u64).chain([65_535, 1 << 20, (1 << 31) - 1]) {
            let ours = log2_q57(value) as f64 / (1u64 << LOG_BITS) as f64;
            let theirs = (value as f64).log2();
            assert!((ours - theirs).abs() <= 1e-14 * theirs.max(1.0), "log2({value}): {ours} and {theirs}");
        }
    }

    #[test]
    fn the_table_is_the_rounded_product() {
        let table = FixedPoint::new(3_000, 21).unwrap();
        assert_eq!(table.scale_bits(), 14);
        for (count, entry) in table.table().iter().enumerate() {
            let c = count.max(1) as f64;
            let exact = c * c.log2() * 16_384.0;
            let wrapped = exact.rem_euclid(4_294_967_296.0);
            assert!((wrapped - f64::from(*entry)).abs() < 0.5001, "T({count}): {exact} and {entry}");
        }
    }

    #[test]
    fn the_scale_is_the_designs_away_from_powers_of_two() {
        for (n, q, s) in
            [(200u32, 21u32, 14u32), (2_767, 21, 14), (20_000, 21, 14), (45_000, 21, 13), (65_535, 27, 12)]
        {
            let needed = (f64::from(n) * f64::from(q).log2()).log2().ceil();
            assert_eq!(
                f64::from(s),
                (31.0 - needed).min(14.0),
                "the formula of the design, N = {n}, q = {q}"
            );
            assert_eq!(scale_bits(n, q), Some(s), "N = {n}, q = {q}");
        }
    }

    #[test]
    fn a_score_of_two_to_the_31_cannot_come_up() {
        // Identical columns of 16 equally frequent symbols: MI = 4 bits, N * MI = 2^17. With s = 14 X would wrap to -2^31.
        assert_eq!(scale_bits(1 << 15, 16), Some(13));
        assert_eq!(scale_bits(1 << 17, 2), Some(13));
    }

    #[test]
    fn one_symbol_and_too_many_rows() {
        assert_eq!(scale_bits(10, 1), Some(14));
        assert_eq!(scale_bits(1 << 20, 27), Some(8));
        assert_eq!(scale_bits(u32::MAX, 27), None);
    }
}
