//! Lottery with feedback: `tickets_i = max(p_i + c * lag_i, 0.05 * p_i)`.
//!
//! The lag in this formula is measured in mean charges, so that `c` means the same on a fast and on a slow farm.

use rand::{Rng, rngs::SmallRng};

use super::share::{FairShare, Lags};
use crate::id::AppId;

/// No application's tickets fall below this part of its share: whoever had too much still moves.
const LEAST_TICKETS: f64 = 0.05;

/// Chance ends here, in largest charges: who is owed more is next, and who had more than this too much has no ticket. The farm's
/// bar is 5 at any time, and without a limit one run in some thousands passes it.
const MOST_OWED: f64 = 4.0;

/// A lottery whose tickets follow what each application is owed.
#[derive(Debug)]
pub(super) struct Lottery {
    gain: f64,
    /// Scratch of one draw.
    tickets: Vec<(AppId, f64)>,
}

impl Lottery {
    pub(super) const fn new(gain: f64) -> Self {
        Self { gain, tickets: Vec::new() }
    }
}

impl FairShare for Lottery {
    fn draw(
        &mut self,
        lags: &Lags,
        candidates: &mut dyn Iterator<Item = AppId>,
        rng: &mut SmallRng,
    ) -> Option<AppId> {
        self.tickets.clear();
        let mut total = 0.0;
        // Where nothing follows what is owed, or nothing was charged yet, there is none.
        let limit = MOST_OWED * lags.largest_charge();
        let limit = if self.gain > 0.0 && limit > 0.0 { limit } else { f64::INFINITY };
        for app in candidates {
            let share = lags.share(app);
            let due = lags.due(app);
            if due > limit {
                return Some(app);
            }
            let lag = due / lags.mean_charge();
            let least = if due < -limit { 0.0 } else { LEAST_TICKETS * share };
            let tickets = (share + self.gain * lag).max(least);
            total += tickets;
            self.tickets.push((app, tickets));
        }
        if let [(only, _)] = self.tickets[..] {
            return Some(only);
        }
        let mut ticket = rng.random::<f64>() * total;
        for &(app, tickets) in &self.tickets {
            if ticket < tickets {
                return Some(app);
            }
            ticket -= tickets;
        }
        // Rounding can leave the last ticket over.
        self.tickets.last().map(|&(app, _)| app)
    }
}
