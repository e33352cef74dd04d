//! How much of a launch goes into one submit: learnt from what the pipeline's earlier runs took.
//!
//! Pure but for its atomics; it measures nothing itself.

use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

/// A run may be this many times larger than any run measured before. A small run under-fills a fast device and so
/// over-estimates the time a workgroup takes; a few steps of this factor find the real rate, and one step cannot
/// overshoot the target by more than it.
const GROWTH: u64 = 8;

/// One pipeline's rate. Touched by the device's thread only; atomics make a pipeline `Send` for its disposal.
#[derive(Debug, Default)]
pub(crate) struct Pace {
    /// Picoseconds a workgroup took in the last measured run; 0 while nothing is measured.
    group_ps: AtomicU64,
    /// The largest run measured, in workgroups.
    largest_groups: AtomicU64,
}

impl Pace {
    /// Takes in what a run of `groups` workgroups took.
    pub(crate) fn observe(&self, groups: u64, elapsed: Duration) {
        let elapsed_ps = u64::try_from(elapsed.as_nanos()).unwrap_or(u64::MAX).saturating_mul(1_000);
        self.group_ps.store((elapsed_ps / groups.max(1)).max(1), Ordering::Relaxed);
        self.largest_groups.fetch_max(groups, Ordering::Relaxed);
    }

    /// What `groups` workgroups should take; `None` while nothing is measured.
    pub(crate) fn estimate(&self, groups: u64) -> Option<Duration> {
        let group_ps = self.group_ps.load(Ordering::Relaxed);
        (group_ps > 0).then(|| Duration::from_nanos(group_ps.saturating_mul(groups) / 1_000))
    }

    /// How many of the `remaining` layers of `layer_groups` workgroups each one run should do, to take `target`: at
    /// least one, at most `most`; one while nothing is measured.
    pub(crate) fn layers(&self, layer_groups: u64, remaining: u32, most: u32, target: Duration) -> u32 {
        let group_ps = self.group_ps.load(Ordering::Relaxed);
        if group_ps == 0 {
            return 1;
        }
        let target_ps = u64::try_from(target.as_nanos()).unwrap_or(u64::MAX).saturating_mul(1_000);
        let by_time = target_ps / group_ps.saturating_mul(layer_groups).max(1);
        let by_growth =
            self.largest_groups.load(Ordering::Relaxed).saturating_mul(GROWTH) / layer_groups.max(1);
        let layers = by_time.min(by_growth).min(u64::from(remaining)).min(u64::from(most)).max(1);
        u32::try_from(layers).expect("bounded by a u32 above")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TARGET: Duration = Duration::from_millis(25);

    #[test]
    fn an_unknown_pipeline_starts_with_one_layer() {
        let pace = Pace::default();
        assert_eq!(pace.layers(64, 1_000, 1_000, TARGET), 1);
        assert_eq!(pace.estimate(64), None);
    }

    #[test]
    fn runs_grow_by_measured_rate_and_never_by_more_than_the_factor() {
        let pace = Pace::default();
        pace.observe(64, Duration::from_millis(1));
        assert_eq!(pace.layers(64, 1_000, 1_000, TARGET), 8, "the factor bounds it");
        pace.observe(8 * 64, Duration::from_millis(8));
        assert_eq!(pace.layers(64, 1_000, 1_000, TARGET), 25, "the target bounds it");
        assert_eq!(pace.layers(64, 7, 1_000, TARGET), 7, "what remains bounds it");
        assert_eq!(pace.layers(64, 1_000, 5, TARGET), 5, "the kernel's scratch bounds it");
        assert_eq!(pace.estimate(64), Some(Duration::from_millis(1)));
    }

    #[test]
    fn a_layer_over_the_target_runs_alone() {
        let pace = Pace::default();
        pace.observe(64, Duration::from_secs(1));
        assert_eq!(pace.layers(64, 1_000, 1_000, TARGET), 1);
    }
}
