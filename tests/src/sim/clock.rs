//! A process's clock: it starts with the process, and runs a little too fast or too slow.

use farm_core::time::Instant;

/// Parts of one in which rates are given.
const MILLION: u128 = 1_000_000;

/// How a process sees the world's time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Clock {
    /// The world's time at the clock's zero.
    origin: Instant,
    /// Ticks per million nanoseconds of the world.
    rate_ppm: u32,
}

impl Clock {
    /// The world's own time.
    pub const TRUE: Self = Self { origin: Instant::ZERO, rate_ppm: 1_000_000 };

    /// A clock that starts now.
    ///
    /// # Panics
    /// The rate is zero: such a clock never gets anywhere.
    #[must_use]
    pub fn started(now: Instant, rate_ppm: u32) -> Self {
        assert!(rate_ppm > 0, "a clock runs");
        Self { origin: now, rate_ppm }
    }

    /// What the clock shows at a time of the world.
    #[must_use]
    pub fn shows(self, world: Instant) -> Instant {
        let ticks = u128::from(world.0.saturating_sub(self.origin.0)) * u128::from(self.rate_ppm) / MILLION;
        Instant(u64::try_from(ticks).unwrap_or(u64::MAX))
    }

    /// The first time of the world at which the clock shows `local` or more.
    #[must_use]
    pub fn reaches(self, local: Instant) -> Instant {
        let elapsed = (u128::from(local.0) * MILLION).div_ceil(u128::from(self.rate_ppm));
        Instant(u64::try_from(elapsed).unwrap_or(u64::MAX).saturating_add(self.origin.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_timer_fires_at_the_first_moment_that_shows_it() {
        for rate_ppm in [900_000, 999_999, 1_000_000, 1_100_000] {
            let clock = Clock::started(Instant(12_345), rate_ppm);
            for local in [0, 1, 7, 1_000_003, 5_000_000_000] {
                let due = clock.reaches(Instant(local));
                assert!(clock.shows(due) >= Instant(local), "{rate_ppm}: due at {due}");
                let before = Instant(due.0 - 1);
                assert!(local == 0 || clock.shows(before) < Instant(local), "{rate_ppm}: due before {due}");
            }
        }
    }
}
