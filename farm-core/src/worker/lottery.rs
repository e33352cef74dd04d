//! Which application's job is staged next: a lottery with fair-share feedback (thesis 5.4.3; 10-scheduling.md section 2).
//!
//! Shares are charged by cost (device seconds x device score), not by wins. The lottery knows no jobs and no devices.

use std::{collections::BTreeMap, fmt};

use rand::{Rng, rngs::SmallRng};

use crate::id::AppId;

/// No application's tickets fall below this part of its share: whoever had too much still moves.
const LEAST_TICKETS: f64 = 0.05;

/// Weight of a new charge in the mean charge, which is the lottery's unit of lag.
const MEAN_GAIN: f64 = 0.05;

/// A rule that shares devices between applications.
pub(super) trait FairShare: fmt::Debug + Send {
    /// An application is there, or its weight changed. It starts without lag, at rest.
    fn join(&mut self, app: AppId, weight: f64);
    /// It is gone.
    fn leave(&mut self, app: AppId);
    /// It has something to run (again).
    fn wake(&mut self, app: AppId);
    /// It has nothing to run: what others get meanwhile is not held against them.
    fn rest(&mut self, app: AppId);
    /// Chooses among applications that have a job to stage.
    fn draw(&mut self, candidates: &mut dyn Iterator<Item = AppId>, rng: &mut SmallRng) -> Option<AppId>;
    /// One of its jobs took this much, in device seconds x score.
    fn charge(&mut self, app: AppId, cost: f64);
}

/// Lottery with feedback: `tickets_i = max(p_i + c * lag_i, 0.05 * p_i)`.
///
/// `p_i` is the weight share among the applications awake. The lag in this formula is measured in mean charges, so that
/// `c` means the same on a fast and on a slow farm.
#[derive(Debug)]
pub(super) struct Lottery {
    gain: f64,
    entrants: BTreeMap<AppId, Entrant>,
    /// Sum of the weights of those awake.
    awake_weight: f64,
    largest_charge: f64,
    mean_charge: f64,
    /// Scratch of one draw.
    tickets: Vec<(AppId, f64)>,
}

#[derive(Debug)]
struct Entrant {
    weight: f64,
    /// What it is owed (if positive), in device seconds x score.
    lag: f64,
    awake: bool,
}

impl Lottery {
    pub(super) const fn new(gain: f64) -> Self {
        Self {
            gain,
            entrants: BTreeMap::new(),
            awake_weight: 0.0,
            largest_charge: 0.0,
            mean_charge: 0.0,
            tickets: Vec::new(),
        }
    }

    /// Spreads a lag that its owner gives up over the others, by weight: the sum of all lags stays zero.
    fn spread(&mut self, lag: f64, except: AppId) {
        let awake = |(id, entrant): &(&AppId, &mut Entrant)| entrant.awake && **id != except;
        let anyone_awake = self.entrants.iter().any(|(id, entrant)| entrant.awake && *id != except);
        let heirs =
            |entry: &(&AppId, &mut Entrant)| if anyone_awake { awake(entry) } else { *entry.0 != except };
        let weight: f64 =
            self.entrants.iter_mut().filter(|entry| heirs(entry)).map(|(_, entrant)| entrant.weight).sum();
        for (_, entrant) in self.entrants.iter_mut().filter(|entry| heirs(entry)) {
            entrant.lag += lag * entrant.weight / weight;
        }
    }

    fn count_awake(&mut self) {
        self.awake_weight =
            self.entrants.values().filter(|entrant| entrant.awake).map(|entrant| entrant.weight).sum();
    }
}

impl FairShare for Lottery {
    fn join(&mut self, app: AppId, weight: f64) {
        let weight = if weight.is_finite() && weight > 0.0 { weight } else { 1.0 };
        self.entrants.entry(app).or_insert(Entrant { weight, lag: 0.0, awake: false }).weight = weight;
        self.count_awake();
    }

    fn leave(&mut self, app: AppId) {
        let Some(entrant) = self.entrants.remove(&app) else { return };
        self.spread(entrant.lag, app);
        self.count_awake();
    }

    fn wake(&mut self, app: AppId) {
        let bound = self.largest_charge;
        let Some(entrant) = self.entrants.get_mut(&app) else { return };
        entrant.awake = true;
        let clamped = entrant.lag.clamp(-bound, bound);
        let rest = entrant.lag - clamped;
        entrant.lag = clamped;
        if rest != 0.0 {
            self.spread(rest, app);
        }
        self.count_awake();
    }

    fn rest(&mut self, app: AppId) {
        if let Some(entrant) = self.entrants.get_mut(&app) {
            entrant.awake = false;
        }
        self.count_awake();
    }

    fn draw(&mut self, candidates: &mut dyn Iterator<Item = AppId>, rng: &mut SmallRng) -> Option<AppId> {
        let unit = if self.mean_charge > 0.0 { self.mean_charge } else { f64::INFINITY };
        self.tickets.clear();
        let mut total = 0.0;
        for app in candidates {
            let tickets = self.entrants.get(&app).map_or(0.0, |entrant| {
                let share = entrant.weight / self.awake_weight;
                (share + self.gain * entrant.lag / unit).max(LEAST_TICKETS * share)
            });
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

    fn charge(&mut self, app: AppId, cost: f64) {
        if !(cost.is_finite() && cost > 0.0) {
            return;
        }
        self.largest_charge = self.largest_charge.max(cost);
        self.mean_charge = if self.mean_charge > 0.0 {
            self.mean_charge + MEAN_GAIN * (cost - self.mean_charge)
        } else {
            cost
        };
        for (&id, entrant) in self.entrants.iter_mut().filter(|(_, entrant)| entrant.awake) {
            entrant.lag += entrant.weight / self.awake_weight * cost;
            if id == app {
                entrant.lag -= cost;
            }
        }
    }
}
