//! Fair share of devices between applications (thesis 5.4.3; 10-scheduling.md section 2): who is owed how much, and the
//! rules that turn it into who is next.
//!
//! Shares are charged by cost (device seconds x device score), not by wins. Nothing here knows jobs or devices.

use std::{collections::BTreeMap, fmt};

use rand::rngs::SmallRng;

use super::{lottery::Lottery, stride::Stride};
use crate::id::AppId;

/// Weight of a new charge in a mean charge: twenty jobs of another size move it by two thirds of the way.
const MEAN_GAIN: f64 = 0.05;

/// What an application's first jobs are taken for while nothing has been charged; only their ratios count.
const UNKNOWN_CHARGE: f64 = 1.0;

/// How much slower the largest charge is forgotten than the debt that it left is paid back.
const FORGETTING: f64 = 0.125;

/// How devices are shared between applications.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Share {
    /// Lottery with feedback: shares hold in the mean, and no application can time its jobs by the order of turns.
    Lottery {
        /// How strongly tickets follow the lag (10-scheduling.md section 2: c = 0.15).
        gain: f64,
    },
    /// Whoever is owed most is next: deterministic, with the smallest error.
    Stride,
}

impl Share {
    /// What a worker does unless it is told otherwise.
    pub const DEFAULT: Self = Self::Lottery { gain: 0.15 };

    pub(super) fn rule(self) -> Box<dyn FairShare> {
        match self {
            Self::Lottery { gain } => Box::new(Lottery::new(gain)),
            Self::Stride => Box::new(Stride),
        }
    }
}

/// A rule that chooses who is next.
pub(super) trait FairShare: fmt::Debug + Send {
    /// Chooses among applications that have a job to stage.
    fn draw(
        &mut self,
        lags: &Lags,
        candidates: &mut dyn Iterator<Item = AppId>,
        rng: &mut SmallRng,
    ) -> Option<AppId>;
}

/// What each application is owed: `lag_i += p_i * C - charged_i` for each job that ended with cost C, where p_i is
/// the weight share among the applications awake. The sum of all lags is zero.
#[derive(Debug, Default)]
pub(super) struct Lags {
    entrants: BTreeMap<AppId, Entrant>,
    /// Sum of the weights of those awake.
    awake_weight: f64,
    lightest_awake: f64,
    /// What the jobs on devices will cost, if they are like the ones before.
    expected: f64,
    largest_charge: f64,
    mean_charge: Option<f64>,
}

#[derive(Debug)]
struct Entrant {
    weight: f64,
    /// What it is owed (if positive), in device seconds x score.
    lag: f64,
    awake: bool,
    /// Its jobs on devices, not charged yet.
    on_devices: u32,
    /// What they are expected to cost.
    expected: f64,
    mean_charge: Option<f64>,
}

impl Lags {
    /// An application is there, or its weight changed. It starts without lag, at rest.
    pub(super) fn join(&mut self, app: AppId, weight: f64) {
        let weight = if weight.is_finite() && weight > 0.0 { weight } else { 1.0 };
        let entrant = self.entrants.entry(app).or_insert(Entrant {
            weight,
            lag: 0.0,
            awake: false,
            on_devices: 0,
            expected: 0.0,
            mean_charge: None,
        });
        entrant.weight = weight;
        self.count_awake();
    }

    /// It is gone: the others inherit its lag.
    pub(super) fn leave(&mut self, app: AppId) {
        let Some(entrant) = self.entrants.remove(&app) else { return };
        self.spread(entrant.lag, app);
        self.count_awake();
    }

    /// It has something to run (again). What it is owed from before counts up to one largest job: it can neither claim
    /// a long absence, nor is it barred for long.
    pub(super) fn wake(&mut self, app: AppId) {
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

    /// It has nothing to run: what others get meanwhile is not held against them.
    pub(super) fn rest(&mut self, app: AppId) {
        if let Some(entrant) = self.entrants.get_mut(&app) {
            entrant.awake = false;
        }
        self.count_awake();
    }

    /// One of its jobs went to a device. It counts at once with what it will probably cost: else an application that
    /// is owed something would get every device that is free before its first job ends.
    pub(super) fn stage(&mut self, app: AppId) {
        self.expect(app, |jobs| jobs + 1);
    }

    /// One of its jobs left its device, charged or not.
    pub(super) fn unstage(&mut self, app: AppId) {
        self.expect(app, |jobs| jobs.saturating_sub(1));
    }

    /// One of its jobs took this much, in device seconds x score.
    pub(super) fn charge(&mut self, app: AppId, cost: f64) {
        let counts = cost.is_finite() && cost > 0.0;
        if !counts || !self.entrants.contains_key(&app) {
            return;
        }
        self.remember(cost);
        observe(&mut self.mean_charge, cost);
        // Whoever runs alone owes nothing, and a job may end after its application's last one was taken back.
        if self.awake_weight > 0.0 {
            for entrant in self.entrants.values_mut().filter(|entrant| entrant.awake) {
                entrant.lag += entrant.weight / self.awake_weight * cost;
            }
            if let Some(entrant) = self.entrants.get_mut(&app) {
                entrant.lag -= cost;
            }
        }
        if let Some(entrant) = self.entrants.get_mut(&app) {
            observe(&mut entrant.mean_charge, cost);
        }
        self.expect(app, |jobs| jobs);
    }

    /// Its weight share among those awake.
    pub(super) fn share(&self, app: AppId) -> f64 {
        self.entrants.get(&app).map_or(0.0, |entrant| entrant.weight / self.awake_weight)
    }

    /// What it is owed if the jobs on devices cost what is expected of them.
    pub(super) fn due(&self, app: AppId) -> f64 {
        self.entrants.get(&app).map_or(0.0, |entrant| {
            entrant.lag - entrant.expected + entrant.weight / self.awake_weight * self.expected
        })
    }

    /// The largest cost of a job, slowly forgotten; zero before the first.
    pub(super) const fn largest_charge(&self) -> f64 {
        self.largest_charge
    }

    /// Mean cost of a job.
    pub(super) fn mean_charge(&self) -> f64 {
        self.mean_charge.unwrap_or(UNKNOWN_CHARGE)
    }

    /// It had its share, and half a largest job more: several interactive applications may each be ahead by that.
    pub(super) fn had_too_much(&self, app: AppId) -> bool {
        self.due(app) < -self.largest_charge / 2.0
    }

    /// What it is owed (if positive), in largest charges. Zero if it is not here.
    pub(super) fn lag(&self, app: AppId) -> f64 {
        let unit = if self.largest_charge > 0.0 { self.largest_charge } else { f64::INFINITY };
        self.entrants.get(&app).map_or(0.0, |entrant| entrant.lag / unit)
    }

    /// The largest charge shrinks, or one job of an hour would loosen every bound for the rest of the daemon's life. It
    /// shrinks slower than the lightest application is paid back, so that a bound in its unit still holds for the
    /// debt that this job left.
    fn remember(&mut self, cost: f64) {
        let forgotten = if self.awake_weight > 0.0 {
            FORGETTING * cost * self.lightest_awake / self.awake_weight
        } else {
            0.0
        };
        self.largest_charge = cost.max(self.largest_charge - forgotten);
    }

    fn expect(&mut self, app: AppId, on_devices: impl FnOnce(u32) -> u32) {
        let mean_charge = self.mean_charge();
        let Some(entrant) = self.entrants.get_mut(&app) else { return };
        entrant.on_devices = on_devices(entrant.on_devices);
        entrant.expected = f64::from(entrant.on_devices) * entrant.mean_charge.unwrap_or(mean_charge);
        // A sum kept by differences would drift away from zero.
        self.expected = self.entrants.values().map(|entrant| entrant.expected).sum();
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
        let weights = self.entrants.values().filter(|entrant| entrant.awake).map(|entrant| entrant.weight);
        (self.awake_weight, self.lightest_awake) =
            weights.fold((0.0, f64::INFINITY), |(sum, least), weight| (sum + weight, least.min(weight)));
    }
}

fn observe(mean: &mut Option<f64>, cost: f64) {
    *mean = Some(mean.map_or(cost, |mean| mean + MEAN_GAIN * (cost - mean)));
}

#[cfg(test)]
mod tests;
