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
    /// What it is owed (if positive), in largest charges so far. Zero if it is not here.
    fn lag(&self, app: AppId) -> f64;
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

    fn lag(&self, app: AppId) -> f64 {
        let unit = if self.largest_charge > 0.0 { self.largest_charge } else { f64::INFINITY };
        self.entrants.get(&app).map_or(0.0, |entrant| entrant.lag / unit)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;

    use proptest::prelude::*;
    use rand::{Rng as _, SeedableRng as _};

    use super::*;

    const WEIGHTS: [f64; 3] = [3.0, 2.0, 1.0];

    /// What a run of continuously backlogged applications led to.
    struct Outcome {
        /// Largest |lag| at any time, in largest charges.
        worst_lag: f64,
        /// Largest difference between a share received and a share due.
        share_error: f64,
    }

    /// Draws `draws` jobs; each is charged when `in_flight` later ones have been drawn, as on devices with running and
    /// staged jobs.
    fn run(
        gain: f64,
        draws: usize,
        in_flight: usize,
        seed: u64,
        cost: impl Fn(usize, f64) -> f64,
    ) -> Outcome {
        let mut lottery = Lottery::new(gain);
        let mut rng = SmallRng::seed_from_u64(seed);
        for (app, weight) in (0..).zip(WEIGHTS) {
            lottery.join(AppId(app), weight);
            lottery.wake(AppId(app));
        }
        let mut outstanding = VecDeque::new();
        let mut received = [0.0; 3];
        let mut worst = 0.0_f64;
        for _ in 0..draws {
            let app = lottery.draw(&mut (0..3).map(AppId), &mut rng).unwrap();
            let index = usize::try_from(app.0).unwrap();
            outstanding.push_back((app, index, cost(index, rng.random())));
            if outstanding.len() > in_flight
                && let Some((app, index, cost)) = outstanding.pop_front()
            {
                lottery.charge(app, cost);
                received[index] += cost;
                let lag = lottery.entrants.values().map(|entrant| entrant.lag.abs()).fold(0.0, f64::max);
                worst = worst.max(lag / lottery.largest_charge);
            }
        }
        let total: f64 = received.iter().sum();
        let share_error = received
            .iter()
            .zip(WEIGHTS)
            .map(|(received, weight)| (received / total - weight / 6.0).abs())
            .fold(0.0, f64::max);
        Outcome { worst_lag: worst, share_error }
    }

    /// Costs that differ between applications by up to 10, and inside one by up to 3.
    fn unequal(app: usize, random: f64) -> f64 {
        [0.3, 1.0, 3.0][app] * (0.5 + random)
    }

    #[test]
    fn lag_stays_below_five_largest_charges() {
        for seed in 0..20 {
            for in_flight in [0, 1] {
                let equal = run(0.15, 10_000, in_flight, seed, |_, _| 1.0);
                assert!(equal.worst_lag <= 5.0, "seed {seed}: {} with equal costs", equal.worst_lag);
                let unequal = run(0.15, 10_000, in_flight, seed, unequal);
                assert!(unequal.worst_lag <= 5.0, "seed {seed}: {} with unequal costs", unequal.worst_lag);
            }
        }
    }

    #[test]
    fn without_feedback_the_bound_does_not_hold() {
        let worst = (0..20).map(|seed| run(0.0, 10_000, 0, seed, |_, _| 1.0).worst_lag).fold(0.0, f64::max);
        assert!(worst > 20.0, "a pure lottery drifts with the square root of its draws, here to {worst}");
    }

    #[test]
    fn shares_are_within_two_percent_after_a_thousand_jobs() {
        for seed in 0..20 {
            let outcome = run(0.15, 1_000, 1, seed, unequal);
            assert!(outcome.share_error <= 0.02, "seed {seed}: {}", outcome.share_error);
        }
    }

    #[test]
    fn who_rests_is_not_owed_what_others_get() {
        let mut lottery = Lottery::new(0.15);
        for app in 0..2 {
            lottery.join(AppId(app), 1.0);
            lottery.wake(AppId(app));
        }
        lottery.charge(AppId(0), 1.0);
        lottery.rest(AppId(1));
        let frozen = lottery.entrants[&AppId(1)].lag;
        (0..100).for_each(|_| lottery.charge(AppId(0), 1.0));
        assert_eq!(lottery.entrants[&AppId(1)].lag, frozen, "frozen at rest");
        lottery.entrants.get_mut(&AppId(1)).unwrap().lag = 50.0;
        lottery.entrants.get_mut(&AppId(0)).unwrap().lag = -50.0;
        lottery.wake(AppId(1));
        assert_eq!(lottery.entrants[&AppId(1)].lag, 1.0, "clamped to the largest charge");
        assert_eq!(lottery.entrants[&AppId(0)].lag, -1.0, "and the sum stays zero");
    }

    #[test]
    fn jobs_that_cost_nothing_are_shared_by_weight() {
        let mut lottery = Lottery::new(0.15);
        let mut rng = SmallRng::seed_from_u64(1);
        for (app, weight) in (0..).zip(WEIGHTS) {
            lottery.join(AppId(app), weight);
            lottery.wake(AppId(app));
        }
        let mut wins = [0_u32; 3];
        for _ in 0..6_000 {
            let app = lottery.draw(&mut (0..3).map(AppId), &mut rng).unwrap();
            lottery.charge(app, 0.0);
            wins[usize::try_from(app.0).unwrap()] += 1;
        }
        // Six standard deviations of a fair draw.
        assert!(wins[0].abs_diff(3_000) < 240 && wins[2].abs_diff(1_000) < 180, "{wins:?}");
    }

    proptest! {
        #[test]
        fn lags_always_sum_to_zero(steps in prop::collection::vec((0_u8..5, 0_u64..4, 0.0_f64..100.0), 1..200)) {
            let mut lottery = Lottery::new(0.15);
            let mut rng = SmallRng::seed_from_u64(7);
            for (step, app, amount) in steps {
                let app = AppId(app);
                let awake = lottery.entrants.get(&app).is_some_and(|entrant| entrant.awake);
                match step {
                    0 => lottery.join(app, amount + 0.1),
                    1 if lottery.entrants.len() > 2 => lottery.leave(app),
                    2 => lottery.wake(app),
                    3 => lottery.rest(app),
                    _ if awake => lottery.charge(app, amount),
                    _ => {}
                }
                let awake: Vec<AppId> =
                    lottery.entrants.iter().filter(|(_, entrant)| entrant.awake).map(|(&id, _)| id).collect();
                let drawn = lottery.draw(&mut awake.iter().copied(), &mut rng);
                prop_assert_eq!(drawn.is_none(), awake.is_empty());
                if lottery.entrants.len() > 1 {
                    let sum: f64 = lottery.entrants.values().map(|entrant| entrant.lag).sum();
                    prop_assert!(sum.abs() < 1e-6, "{sum}");
                }
            }
        }
    }
}
