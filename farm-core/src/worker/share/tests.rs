//! Both rules against the bars of 10-scheduling.md section 2, with a lottery without feedback as the negative control.

use std::collections::VecDeque;

use proptest::prelude::*;
use rand::{Rng as _, SeedableRng as _};

use super::*;

impl Lags {
    /// What each application that has something to run is owed.
    fn awake(&self) -> impl Iterator<Item = (AppId, f64)> {
        self.entrants.iter().filter(|(_, entrant)| entrant.awake).map(|(&app, entrant)| (app, entrant.lag))
    }
}

const WEIGHTS: [f64; 3] = [3.0, 2.0, 1.0];
const RULES: [Share; 2] = [Share::DEFAULT, Share::Stride];
const NO_FEEDBACK: Share = Share::Lottery { gain: 0.0 };

/// Jobs of continuously backlogged applications on devices.
#[derive(Clone, Copy)]
struct Load {
    jobs: usize,
    /// Jobs drawn before the first of them is charged: one a device that runs, one more that is staged.
    in_flight: usize,
    seed: u64,
    cost: fn(usize, f64) -> f64,
}

/// What it led to.
#[derive(Debug)]
struct Outcome {
    /// Largest |lag| at any time, in largest charges as the lags remember them.
    worst_lag: f64,
    /// Largest difference between a share received and a share due.
    share_error: f64,
    /// Jain's index of what each received for its weight: 1 when all are equal.
    jain: f64,
}

fn awake(weights: &[f64]) -> Lags {
    let mut lags = Lags::default();
    for (app, &weight) in (0..).zip(weights) {
        lags.join(AppId(app), weight);
        lags.wake(AppId(app));
    }
    lags
}

fn index(app: AppId) -> usize {
    usize::try_from(app.0).unwrap()
}

fn run(share: Share, load: Load) -> Outcome {
    let mut rule = share.rule();
    let mut lags = awake(&WEIGHTS);
    let mut rng = SmallRng::seed_from_u64(load.seed);
    let mut on_devices = VecDeque::new();
    let mut received = [0.0; 3];
    let mut worst_lag = 0.0_f64;
    for _ in 0..load.jobs {
        let app = rule.draw(&lags, &mut (0..3).map(AppId), &mut rng).unwrap();
        lags.stage(app);
        on_devices.push_back((app, (load.cost)(index(app), rng.random())));
        if on_devices.len() > load.in_flight
            && let Some((app, cost)) = on_devices.pop_front()
        {
            lags.unstage(app);
            lags.charge(app, cost);
            received[index(app)] += cost;
            let lag = lags.awake().map(|(_, lag)| lag.abs()).fold(0.0, f64::max);
            worst_lag = worst_lag.max(lag / lags.largest_charge());
        }
    }
    let total: f64 = received.iter().sum();
    let error = |(received, weight): (&f64, f64)| (received / total - weight / 6.0).abs();
    let share_error = received.iter().zip(WEIGHTS).map(error).fold(0.0, f64::max);
    let normal: Vec<f64> = received.iter().zip(WEIGHTS).map(|(received, weight)| received / weight).collect();
    let squares: f64 = normal.iter().map(|part| part * part).sum();
    let jain = normal.iter().sum::<f64>().powi(2) / (3.0 * squares);
    Outcome { worst_lag, share_error, jain }
}

fn equal(_: usize, _: f64) -> f64 {
    1.0
}

/// Costs that differ between applications by up to 10, and inside one by up to 3.
fn unequal(app: usize, random: f64) -> f64 {
    [0.3, 1.0, 3.0][app] * (0.5 + random)
}

/// Nothing on devices while one is drawn; one device with a staged job; four such.
const IN_FLIGHT: [usize; 3] = [0, 1, 7];

#[test]
fn lag_stays_below_five_largest_charges() {
    for share in RULES {
        for seed in 0..20 {
            for (in_flight, cost) in
                IN_FLIGHT.into_iter().flat_map(|n| [(n, equal as fn(_, _) -> _), (n, unequal)])
            {
                let outcome = run(share, Load { jobs: 10_000, in_flight, seed, cost });
                assert!(
                    outcome.worst_lag <= 5.0,
                    "{share:?}, seed {seed}, {in_flight} in flight: {outcome:?}"
                );
            }
        }
    }
}

#[test]
fn chance_ends_before_the_bar() {
    let draws_of_the_first = |charges: usize| {
        let mut lags = awake(&[1.0, 1.0]);
        (0..charges).for_each(|_| lags.charge(AppId(0), 1.0));
        let mut rule = Share::DEFAULT.rule();
        let mut rng = SmallRng::seed_from_u64(1);
        let draws = (0..1_000).map(|_| rule.draw(&lags, &mut (0..2).map(AppId), &mut rng).unwrap());
        draws.filter(|app| *app == AppId(0)).count()
    };
    assert!(draws_of_the_first(6) > 0, "at three largest jobs too much it still moves");
    assert_eq!(draws_of_the_first(10), 0, "at five the other one is next");
}

#[test]
fn without_feedback_the_bound_does_not_hold() {
    let load = |seed| Load { jobs: 10_000, in_flight: 0, seed, cost: equal };
    let worst = (0..20).map(|seed| run(NO_FEEDBACK, load(seed)).worst_lag).fold(0.0, f64::max);
    assert!(worst > 20.0, "a pure lottery drifts with the square root of its draws, here to {worst}");
}

#[test]
fn shares_are_within_two_percent_after_a_thousand_jobs() {
    for share in RULES {
        for (seed, in_flight) in (0..20).flat_map(|seed| IN_FLIGHT.map(|in_flight| (seed, in_flight))) {
            let outcome = run(share, Load { jobs: 1_000, in_flight, seed, cost: unequal });
            assert!(
                outcome.share_error <= 0.02 && outcome.jain >= 0.99,
                "{share:?}, seed {seed}, {in_flight} in flight: {outcome:?}"
            );
        }
    }
    let load = |seed| Load { jobs: 1_000, in_flight: 1, seed, cost: unequal };
    let worst = (0..20).map(|seed| run(NO_FEEDBACK, load(seed)).share_error).fold(0.0, f64::max);
    assert!(
        worst > 0.02,
        "without feedback and charged by wins, shares follow the jobs' sizes, here by {worst}"
    );
}

#[test]
fn stride_is_never_off_by_more_than_one_job() {
    let outcome = run(Share::Stride, Load { jobs: 10_000, in_flight: 0, seed: 1, cost: equal });
    assert!(outcome.worst_lag <= 1.0, "{outcome:?}");
    let lottery = run(Share::DEFAULT, Load { jobs: 10_000, in_flight: 0, seed: 1, cost: equal });
    assert!(lottery.worst_lag > 1.0, "a lottery is: {lottery:?}");
}

#[test]
fn jobs_on_devices_count_before_they_are_charged() {
    let mut lags = awake(&[1.0, 1.0]);
    let mut rng = SmallRng::seed_from_u64(1);
    let mut staged = [0, 0];
    for _ in 0..8 {
        let app = Stride.draw(&lags, &mut (0..2).map(AppId), &mut rng).unwrap();
        lags.stage(app);
        staged[index(app)] += 1;
    }
    assert_eq!(staged, [4, 4], "eight devices that were free at once");
}

#[test]
fn who_rests_is_not_owed_what_others_get() {
    let mut lags = awake(&[1.0, 1.0]);
    lags.charge(AppId(0), 1.0);
    lags.rest(AppId(1));
    let frozen = lags.entrants[&AppId(1)].lag;
    (0..100).for_each(|_| lags.charge(AppId(0), 1.0));
    assert_eq!(lags.entrants[&AppId(1)].lag, frozen, "frozen at rest");
    lags.entrants.get_mut(&AppId(1)).unwrap().lag = 50.0;
    lags.entrants.get_mut(&AppId(0)).unwrap().lag = -50.0;
    lags.wake(AppId(1));
    assert_eq!(lags.entrants[&AppId(1)].lag, 1.0, "clamped to the largest charge");
    assert_eq!(lags.entrants[&AppId(0)].lag, -1.0, "and the sum stays zero");
}

#[test]
fn a_large_job_is_forgotten_after_its_debt_is_paid() {
    let mut lags = awake(&WEIGHTS);
    let mut rng = SmallRng::seed_from_u64(1);
    lags.charge(AppId(2), 1_000.0);
    let mut paid_back = false;
    let mut jobs = 0;
    while lags.largest_charge() > 10.0 {
        let app = Stride.draw(&lags, &mut (0..3).map(AppId), &mut rng).unwrap();
        lags.charge(app, 1.0);
        paid_back |= lags.entrants[&AppId(2)].lag > -1.0;
        assert!(lags.awake().all(|(_, lag)| lag.abs() <= lags.largest_charge()), "{lags:?}");
        jobs += 1;
        assert!(jobs < 100_000, "it is never forgotten");
    }
    assert!(paid_back, "forgotten before the debt was paid");
}

#[test]
fn jobs_that_cost_nothing_are_shared_by_weight() {
    let mut lottery = Share::DEFAULT.rule();
    let mut lags = awake(&WEIGHTS);
    let mut rng = SmallRng::seed_from_u64(1);
    let mut wins = [0_u32; 3];
    for _ in 0..6_000 {
        let app = lottery.draw(&lags, &mut (0..3).map(AppId), &mut rng).unwrap();
        lags.charge(app, 0.0);
        wins[index(app)] += 1;
    }
    // Six standard deviations of a fair draw.
    assert!(wins[0].abs_diff(3_000) < 240 && wins[2].abs_diff(1_000) < 180, "{wins:?}");
}

proptest! {
    #[test]
    fn lags_always_sum_to_zero(
        stride in any::<bool>(),
        steps in prop::collection::vec((0_u8..7, 0_u64..4, 0.0_f64..100.0), 1..200),
    ) {
        let mut rule = RULES[usize::from(stride)].rule();
        let mut lags = Lags::default();
        let mut rng = SmallRng::seed_from_u64(7);
        for (step, app, amount) in steps {
            let app = AppId(app);
            match step {
                0 => lags.join(app, amount + 0.1),
                1 if lags.entrants.len() > 2 => lags.leave(app),
                2 => lags.wake(app),
                3 => lags.rest(app),
                4 => lags.stage(app),
                5 => lags.unstage(app),
                _ => lags.charge(app, amount),
            }
            let awake: Vec<AppId> = lags.awake().map(|(app, _)| app).collect();
            let drawn = rule.draw(&lags, &mut awake.iter().copied(), &mut rng);
            prop_assert_eq!(drawn.is_none(), awake.is_empty());
            if lags.entrants.len() > 1 {
                let sum: f64 = lags.entrants.values().map(|entrant| entrant.lag).sum();
                prop_assert!(sum.abs() < 1e-6, "{sum}");
            }
        }
    }

    #[test]
    fn any_weights_and_costs_keep_the_bound(
        stride in any::<bool>(),
        weights in prop::collection::vec(0.2_f64..5.0, 2..6),
        costs in prop::collection::vec(0.05_f64..1.0, 6),
        devices in 1_usize..5,
        seed in any::<u64>(),
    ) {
        let mut rule = RULES[usize::from(stride)].rule();
        let mut lags = awake(&weights);
        let mut rng = SmallRng::seed_from_u64(seed);
        let mut on_devices = VecDeque::new();
        for _ in 0..1_000 {
            let app = rule.draw(&lags, &mut (0..).map(AppId).take(weights.len()), &mut rng).unwrap();
            lags.stage(app);
            on_devices.push_back(app);
            if on_devices.len() == 2 * devices && let Some(app) = on_devices.pop_front() {
                lags.unstage(app);
                lags.charge(app, costs[index(app)] * rng.random_range(0.5..1.5));
                let worst = lags.awake().map(|(_, lag)| lag.abs()).fold(0.0, f64::max);
                prop_assert!(worst <= 5.0 * lags.largest_charge(), "{worst} of {}", lags.largest_charge());
            }
        }
    }
}
