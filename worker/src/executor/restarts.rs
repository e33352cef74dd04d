//! Whether a device whose executor ended is opened once more, and when.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

/// Rests before the device is opened anew; as many tries as there are rests.
const RESTS: [Duration; 3] = [Duration::ZERO, Duration::from_secs(1), Duration::from_secs(5)];
/// Ends without a job to blame that a device may have within [`WINDOW`]; with one more it is lost. The window holds as many
/// processes that are silent for as long as they may be. A device on which one job
/// after the other crashes is another matter: those may be poison, and each new process measures the device.
const MAX_UNEXPLAINED: usize = 3;
/// How long an end without a job to blame counts.
const WINDOW: Duration = Duration::from_secs(900);

/// The ends of one device's executors.
#[derive(Debug, Default)]
pub(super) struct Restarts {
    unexplained: VecDeque<Instant>,
    /// Openings that failed since the last job that ended.
    refused: usize,
}

impl Restarts {
    /// A job ended as jobs do.
    pub(super) fn works(&mut self) {
        self.refused = 0;
    }

    /// An executor ended; `explained` by a job that was on the device. How long to rest before the next one.
    ///
    /// # Errors
    /// There should be no next one.
    pub(super) fn ended(&mut self, now: Instant, explained: bool) -> Result<Duration, String> {
        while self.unexplained.front().is_some_and(|at| now.saturating_duration_since(*at) > WINDOW) {
            self.unexplained.pop_front();
        }
        if !explained {
            self.unexplained.push_back(now);
        }
        if self.unexplained.len() > MAX_UNEXPLAINED {
            return Err(format!(
                "it ended {} times within {} s without a job to blame",
                self.unexplained.len(),
                WINDOW.as_secs()
            ));
        }
        Ok(RESTS[0])
    }

    /// The device did not open. How long to rest before the next try.
    ///
    /// # Errors
    /// There should be no next try.
    pub(super) fn refused(&mut self, reason: String) -> Result<Duration, String> {
        self.refused += 1;
        RESTS.get(self.refused).copied().ok_or_else(|| format!("it does not open again: {reason}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_that_does_not_open_three_times_is_lost() {
        let mut restarts = Restarts::default();
        let now = Instant::now();
        assert_eq!(restarts.ended(now, true), Ok(Duration::ZERO));
        assert_eq!(restarts.refused("no".to_owned()), Ok(Duration::from_secs(1)));
        assert_eq!(restarts.refused("no".to_owned()), Ok(Duration::from_secs(5)));
        restarts.refused("gone".to_owned()).expect_err("three tries are enough");
        restarts.works();
        assert_eq!(restarts.refused("no".to_owned()), Ok(Duration::from_secs(1)), "it worked in between");
    }

    #[test]
    fn ends_count_only_without_a_job_to_blame_and_for_a_while() {
        let mut restarts = Restarts::default();
        let now = Instant::now();
        for _ in 0..100 {
            restarts.ended(now, true).expect("jobs were to blame");
        }
        for _ in 0..MAX_UNEXPLAINED {
            restarts.ended(now, false).expect("it may happen");
        }
        let mut later = Restarts { unexplained: restarts.unexplained.clone(), refused: 0 };
        restarts.ended(now, false).expect_err("it happens too often");
        later.ended(now + WINDOW + Duration::from_secs(1), false).expect("the others are long over");
    }
}
