//! Who gets the devices when all want them: shares, lag and Jain's index of three applications of unequal weights and
//! jobs, how soon a fourth one gets its first result, and two unlike applications side by side (thesis figure 5.13).
//!
//! All of it as applications see it: a result tells the device time it is charged with, and arrives when it is ready.

use std::time::{Duration, Instant};

use anyhow::{Context as _, ensure};
use client_sdk::{CostNs, Farm, FarmError, FarmOptions, RunSummary, StopHandle, TaskGraph, Window};
use rand::{Rng as _, SeedableRng as _, rngs::SmallRng};
use tokio::{
    sync::mpsc::{self, UnboundedReceiver},
    task::JoinHandle,
    time::timeout,
};

use super::{
    Better, Figure, connect,
    jobs::{Hint, List, Results, Retrieved, Stream, UNKNOWN},
    settled, start_farm,
    statistics::jain,
    tiles::{MUSTANG, cost_ms},
};
use crate::{
    output,
    process_farm::{ProcessFarm, Shape, Stealing},
};

/// Devices of the one node.
const DEVICES: usize = 4;
/// Weights of the applications.
const WEIGHTS: [f64; 3] = [3.0, 2.0, 1.0];
/// Mean of their jobs' durations: who is owed least has the longest.
const MEAN_MS: [f64; 3] = [2.0, 4.0, 8.0];
/// Durations differ by up to this part of the mean, either way.
const SPREAD: f64 = 0.5;
/// How long shares are counted; 10-scheduling.md section 5 names a window of 30 s.
const COUNTED: Duration = Duration::from_secs(31);
/// Work of each application, over what it gets in the counted time: nobody runs dry.
const SURPLUS: f64 = 1.3;
/// The windows in which received is held against entitled.
const WINDOWS: [Duration; 2] = [Duration::from_secs(2), Duration::from_secs(30)];
/// Jobs of all applications together after which shares must be right.
const SETTLED_JOBS: usize = 1_000;
/// Tiles of the stream beside the no-op stream: two seconds on four devices.
const TILES: usize = 160;
/// No-op jobs outstanding at a time.
const NO_OPS: usize = 64;
/// Longest wait for any one result.
const PATIENCE: Duration = Duration::from_secs(30);

/// What three applications' results say.
#[derive(Clone, Debug)]
struct Shares {
    /// Largest |lag| at the end of any job, in largest jobs.
    worst_lag: f64,
    /// Largest difference between a share received and a share due after [`SETTLED_JOBS`] jobs or more, in percent of all.
    share_error: f64,
    /// Device time of each in the whole counted time.
    received_s: [f64; 3],
    /// In each of the [`WINDOWS`]: the largest |received - entitled| / entitled, in percent.
    window_error: [f64; 2],
    jobs: usize,
}

/// Measures `runs` times; of each figure the worst counts.
pub(super) async fn measure(seed: u64, runs: usize) -> anyhow::Result<Vec<Figure>> {
    let mut worst: Option<Vec<Figure>> = None;
    for run in 0..runs as u64 {
        let figures = measure_once(seed.wrapping_add(run)).await?;
        worst = Some(match worst {
            None => figures,
            Some(worst) => worst.into_iter().zip(figures).map(|(one, other)| one.worse(other)).collect(),
        });
    }
    worst.context("no run")
}

async fn measure_once(seed: u64) -> anyhow::Result<Vec<Figure>> {
    let farm = start_farm(&Shape::uniform(1, DEVICES))?;
    let (shares, first_result) = three_and_a_fourth(&farm, seed).await?;
    settled(&farm).await?;
    let pauses = tiles_beside_no_ops(&farm, seed).await?;
    tell(&shares);
    let entitled = WEIGHTS.map(|weight| weight / WEIGHTS.iter().sum::<f64>());
    let [two_seconds, thirty_seconds] = shares.window_error;
    let ms = |duration: Duration| duration.as_secs_f64() * 1e3;
    let jain = jain(&shares.received_s, &entitled);
    Ok(vec![
        Figure::new("max_lag", shares.worst_lag, "largest jobs", Better::Lower, 5.0),
        Figure::new("share_error_after_1000_jobs", shares.share_error, "%", Better::Lower, 2.0),
        Figure::new("jain_index", jain, "1", Better::Higher, 0.99),
        Figure::new("window_error_2s", two_seconds, "%", Better::Lower, 5.0),
        Figure::new("window_error_30s", thirty_seconds, "%", Better::Lower, 1.0),
        Figure::new("fourth_application_first_result", ms(first_result), "ms", Better::Lower, 1_000.0),
        Figure::new("longest_pause_of_tiles", ms(pauses[0]), "ms", Better::Lower, 1_000.0),
        Figure::new("longest_pause_of_no_ops", ms(pauses[1]), "ms", Better::Lower, 1_000.0),
    ])
}

/// An application whose run goes on until it is stopped.
struct Running {
    stop: StopHandle,
    run: JoinHandle<Result<RunSummary, FarmError>>,
}

impl Running {
    fn start(app: Farm, graph: TaskGraph) -> Self {
        let stop = app.stop_handle();
        let run = tokio::spawn(async move {
            let outcome = app.run(graph).await;
            app.close().await;
            outcome
        });
        Self { stop, run }
    }

    /// # Errors
    /// It failed, or had ended before it was stopped, which means that it did not always have jobs.
    async fn stop(self) -> anyhow::Result<()> {
        self.stop.stop();
        match self.run.await? {
            Err(FarmError::Stopped { .. }) => Ok(()),
            Ok(summary) => anyhow::bail!("an application ran out of work after {} jobs", summary.jobs),
            Err(error) => Err(error.into()),
        }
    }
}

async fn three_and_a_fourth(farm: &ProcessFarm, seed: u64) -> anyhow::Result<(Shares, Duration)> {
    let mut random = SmallRng::seed_from_u64(seed);
    let (results, mut heard) = mpsc::unbounded_channel();
    let total_weight: f64 = WEIGHTS.iter().sum();
    let mut running = Vec::new();
    let mut largest = CostNs(0);
    for (app, (weight, mean_ms)) in WEIGHTS.into_iter().zip(MEAN_MS).enumerate() {
        let share_ms = COUNTED.as_secs_f64() * 1e3 * DEVICES as f64 * weight / total_weight;
        let mut durations = Vec::new();
        let mut work_ms = 0.0;
        while work_ms < SURPLUS * share_ms {
            let ms = mean_ms * (1.0 + SPREAD * random.random_range(-1.0..1.0));
            work_ms += ms;
            durations.push(cost_ms(ms));
        }
        largest = largest.max(durations.iter().copied().max().unwrap_or_default());
        let list = List::new(durations, Hint::Exact).telling(app, results.clone());
        let name = format!("bench fairness {weight}");
        let farm = connect(farm, &name, weight, Stealing::Off).await?;
        running.push(Running::start(farm, TaskGraph::new().task("jobs", list)));
    }
    let counted = count(&mut heard).await?;

    let fourth = connect(farm, "bench fairness late", 1.0, Stealing::Off).await?;
    let (late_results, mut late_heard) = mpsc::unbounded_channel();
    let submitted = Instant::now();
    let list =
        List::new(vec![cost_ms(MEAN_MS[0]); DEVICES], Hint::Exact).telling(WEIGHTS.len(), late_results);
    let late = fourth.run(TaskGraph::new().task("late", list)).await?;
    ensure!(late.jobs == DEVICES as u64, "the fourth application lost jobs");
    let first = next(&mut late_heard).await?;
    fourth.close().await;
    for app in running {
        app.stop().await?;
    }
    Ok((shares(&counted, largest), first.at - submitted))
}

/// Hears results from the moment when each application had one, for the counted time.
async fn count(heard: &mut UnboundedReceiver<Retrieved>) -> anyhow::Result<Vec<Retrieved>> {
    let mut seen = [false; WEIGHTS.len()];
    let began = loop {
        let result = next(heard).await?;
        seen[result.app] = true;
        if seen == [true; WEIGHTS.len()] {
            break result.at;
        }
    };
    let mut counted = Vec::new();
    loop {
        let result = next(heard).await?;
        if result.at - began > COUNTED {
            return Ok(counted);
        }
        counted.push(result);
    }
}

async fn next(heard: &mut UnboundedReceiver<Retrieved>) -> anyhow::Result<Retrieved> {
    let result = timeout(PATIENCE, heard.recv()).await.context("no result came")?;
    result.context("an application ended early")
}

/// Holds results, in the order of their arrival, against what their applications were entitled to.
fn shares(results: &[Retrieved], largest: CostNs) -> Shares {
    let total_weight: f64 = WEIGHTS.iter().sum();
    let entitled = WEIGHTS.map(|weight| weight / total_weight);
    let largest_s = largest.0 as f64 / 1e9;
    let mut received_s = [0.0; WEIGHTS.len()];
    let (mut worst_lag, mut share_error) = (0.0_f64, 0.0_f64);
    for (jobs, result) in (1..).zip(results) {
        received_s[result.app] += result.device_time.as_secs_f64();
        let all_s: f64 = received_s.iter().sum();
        for (entitled, received_s) in entitled.iter().zip(received_s) {
            let lag_s = entitled * all_s - received_s;
            worst_lag = worst_lag.max(lag_s.abs() / largest_s);
            if jobs >= SETTLED_JOBS {
                share_error = share_error.max(100.0 * lag_s.abs() / all_s);
            }
        }
    }
    let window_error = WINDOWS.map(|window| window_error(results, window, &entitled));
    Shares { worst_lag, share_error, received_s, window_error, jobs: results.len() }
}

/// The largest |received - entitled| / entitled in windows one after the other, in percent; NaN if not one is full.
fn window_error(results: &[Retrieved], window: Duration, entitled: &[f64]) -> f64 {
    let (Some(first), Some(last)) = (results.first(), results.last()) else { return f64::NAN };
    let mut worst = f64::NAN;
    let mut from = 0;
    let mut end = first.at + window;
    while end <= last.at {
        let to = from + results[from..].partition_point(|result| result.at < end);
        let mut received_s = vec![0.0; entitled.len()];
        for result in &results[from..to] {
            received_s[result.app] += result.device_time.as_secs_f64();
        }
        let all_s: f64 = received_s.iter().sum();
        for (entitled, received_s) in entitled.iter().zip(received_s) {
            worst = worst.max(100.0 * (received_s / (entitled * all_s) - 1.0).abs());
        }
        (from, end) = (to, end + window);
    }
    worst
}

/// Tiles and no-op jobs of equal weight; the longest time that each went without a result.
async fn tiles_beside_no_ops(farm: &ProcessFarm, seed: u64) -> anyhow::Result<[Duration; 2]> {
    let window = Window { jobs: NO_OPS, ..Window::default() };
    let options = FarmOptions { window, ..FarmOptions::new(farm.grpc(), "bench no-ops") };
    let (no_op_results, no_ops_heard) = mpsc::unbounded_channel();
    let no_ops = Running::start(Farm::connect(options).await?, stream(no_op_results));
    let tiles_app = connect(farm, "bench tiles", 1.0, Stealing::Off).await?;
    let (tile_results, tiles_heard) = mpsc::unbounded_channel();
    let tiles = MUSTANG.tiles(seed).into_iter().take(TILES).collect();
    let list = List::new(tiles, UNKNOWN).telling(0, tile_results);
    let began = Instant::now();
    tiles_app.run(TaskGraph::new().task("tiles", list)).await?;
    let ended = Instant::now();
    tiles_app.close().await;
    no_ops.stop().await?;
    Ok([longest_pause(tiles_heard, began, ended), longest_pause(no_ops_heard, began, ended)])
}

fn stream(results: Results) -> TaskGraph {
    TaskGraph::new().task("no-ops", Stream { batch: NO_OPS, app: 1, results })
}

/// The longest time between two results, or between one and an end of the time looked at.
fn longest_pause(mut heard: UnboundedReceiver<Retrieved>, began: Instant, ended: Instant) -> Duration {
    let mut longest = Duration::ZERO;
    let mut last = began;
    while let Ok(result) = heard.try_recv() {
        let at = result.at.clamp(began, ended);
        longest = longest.max(at.saturating_duration_since(last));
        last = at;
    }
    longest.max(ended - last)
}

fn tell(shares: &Shares) {
    let mut table = output::table(["WEIGHT", "ENTITLED %", "RECEIVED %"]);
    let (total_weight, total_s) = (WEIGHTS.iter().sum::<f64>(), shares.received_s.iter().sum::<f64>());
    for (weight, received_s) in WEIGHTS.into_iter().zip(shares.received_s) {
        let percent = |part: f64| format!("{:.2}", 100.0 * part);
        table.add_row([weight.to_string(), percent(weight / total_weight), percent(received_s / total_s)]);
    }
    tell!("{table}\n{} jobs in {COUNTED:?}", shares.jobs);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Results of 1 ms, one a millisecond, of applications in this order again and again.
    fn results(order: &[usize], count: usize) -> Vec<Retrieved> {
        let began = Instant::now();
        let ms = |count: usize| Duration::from_millis(u64::try_from(count).unwrap());
        let result = |(at, &app): (usize, &usize)| Retrieved {
            app,
            at: began + ms(at),
            round_trip: Duration::ZERO,
            device_time: ms(1),
        };
        order.iter().cycle().take(count).enumerate().map(result).collect()
    }

    #[test]
    fn fair_results_have_small_lags_and_errors() {
        let fair = shares(&results(&[0, 1, 0, 2, 1, 0], 6_001), cost_ms(1.0));
        assert!(fair.worst_lag <= 1.0, "{fair:?}");
        assert!(fair.share_error < 0.1 && fair.window_error[0] < 0.5, "{fair:?}");
        assert!(fair.window_error[1].is_nan(), "six seconds hold no window of thirty");
    }

    #[test]
    fn unfair_results_are_seen_by_every_figure() {
        let unfair = shares(&results(&[0, 1, 2], 6_001), cost_ms(1.0));
        assert!(unfair.worst_lag > 900.0, "{unfair:?}");
        assert!(
            (unfair.share_error - 100.0 / 6.0).abs() < 0.1,
            "a half of all is due, a third came: {unfair:?}"
        );
        assert!((unfair.window_error[0] - 100.0).abs() < 1.0, "the third one got twice its due: {unfair:?}");
    }

    #[test]
    fn unfair_windows_do_not_cancel_out() {
        let mut turns = results(&[0, 1, 2], 6_001);
        for (at, result) in turns.iter_mut().enumerate() {
            result.app = at / 2_000 % 3;
        }
        assert!(shares(&turns, cost_ms(1.0)).window_error[0] >= 100.0, "each window was one application's");
    }

    #[test]
    fn a_pause_counts_at_the_ends_too() {
        let began = Instant::now();
        let at = |ms| began + Duration::from_millis(ms);
        let heard = |times: &[u64]| {
            let (sender, receiver) = mpsc::unbounded_channel();
            for &ms in times {
                let (round_trip, device_time) = (Duration::ZERO, Duration::ZERO);
                sender.send(Retrieved { app: 0, at: at(ms), round_trip, device_time }).unwrap();
            }
            receiver
        };
        let pause = |times: &[u64]| longest_pause(heard(times), began, at(100)).as_millis();
        assert_eq!(pause(&[10, 20, 90]), 70);
        assert_eq!(pause(&[60, 90]), 60);
        assert_eq!(pause(&[10, 20]), 80);
        assert_eq!(pause(&[]), 100);
    }
}
