//! What a device is worth to its siblings: measured work per time, in place of the announced score once a job is done.
//!
//! Announced scores are wrong by up to 2; a thief that trusts them takes jobs that it then finishes last.

use crate::message::CostNs;

/// Weight of a new sample, as in the coordinator's rates: it follows a change of speed within ten jobs.
const GAIN: f64 = 0.2;

/// A sample counts as at most this many times faster or slower than the rate so far.
const MAX_STEP: f64 = 16.0;

/// Work per device time: speed 1.0 does its costs in as many nanoseconds. `None` before the first job of known cost.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Rate(Option<f64>);

impl Rate {
    pub(super) fn observe(&mut self, cost: CostNs, device_time_ns: u64) {
        if cost == CostNs(0) || device_time_ns == 0 {
            return;
        }
        let sample = cost.0 as f64 / device_time_ns as f64;
        self.0 = Some(self.0.map_or(sample, |so_far| {
            so_far + GAIN * (sample.clamp(so_far / MAX_STEP, so_far * MAX_STEP) - so_far)
        }));
    }

    pub(super) const fn measured(self) -> Option<f64> {
        self.0
    }
}
