//! A coordinator killed in the midst of much work (20-delivery.md, failure table): how soon its successor has work done again, and
//! how much of what ran meanwhile is done twice.

use std::time::{Duration, Instant};

use anyhow::Context as _;
use client_sdk::{CostNs, Farm, FarmOptions, TaskGraph, Window};
use tokio::{sync::mpsc, task::block_in_place};

use super::{
    Better, Figure, connect,
    jobs::{Chain, List, UNKNOWN},
    start_farm,
};
use crate::{
    admin::Admin,
    process_farm::{ProcessFarm, Shape, Stealing},
    target::Reach,
};

/// Jobs that are planned and not delivered when the coordinator dies.
const OUTSTANDING: usize = 100_000;
/// Further ones, planned as those come back: the successor has to plan them.
const FURTHER: usize = 20_000;
/// 32 devices need half a minute for all.
const JOB: CostNs = CostNs(8_000_000);
/// Longest wait until all are planned.
const PLANNING_PATIENCE: Duration = Duration::from_secs(60);
/// How often it is asked meanwhile.
const POLL: Duration = Duration::from_millis(20);

/// Measures `runs` deaths; the worst counts.
pub(super) async fn measure(runs: usize) -> anyhow::Result<Vec<Figure>> {
    let mut worst: Option<(f64, f64)> = None;
    for _ in 0..runs {
        let (seconds, again) = death().await?;
        tell!("first result {seconds:.2} s after the start, {again} jobs planned again");
        let so_far = worst.unwrap_or((seconds, again));
        worst = Some((so_far.0.max(seconds), so_far.1.max(again)));
    }
    let (seconds, again) = worst.context("no run was asked for")?;
    Ok(vec![
        Figure::new("first_result_after_restart", seconds, "s", Better::Lower, 2.0),
        Figure::new("jobs_planned_again", again, "jobs", Better::Lower, 0.0),
    ])
}

/// Seconds from a successor's start to the first result of a new application, and jobs of the old one that got a new attempt.
async fn death() -> anyhow::Result<(f64, f64)> {
    let mut farm = start_farm(&Shape::uniform(8, 4))?;
    let window = Window { jobs: OUTSTANDING, ..Window::default() };
    let app = Farm::connect(FarmOptions { window, ..FarmOptions::new(farm.grpc(), "much work") }).await?;
    let work = TaskGraph::new().task("work", List::new(vec![JOB; OUTSTANDING + FURTHER], UNKNOWN));
    let run = app.run(work);
    let successor = async {
        outstanding(&farm).await?;
        let began = Instant::now();
        block_in_place(|| farm.replace_coordinator())?;
        let (results, mut retrieved) = mpsc::unbounded_channel();
        let newcomer = connect(&farm, "newcomer", 1.0, Stealing::Off).await?;
        newcomer.run(TaskGraph::new().task("one", Chain { left: 1, results })).await?;
        let first = retrieved.recv().await.context("the newcomer's job is not back")?;
        newcomer.close().await;
        Ok::<f64, anyhow::Error>(first.at.duration_since(began).as_secs_f64())
    };
    let (summary, seconds) = tokio::join!(run, successor);
    let (summary, seconds) = (summary?, seconds?);
    app.close().await;
    Ok((seconds, summary.replanned as f64))
}

/// Waits until the coordinator has all that the application may have outstanding on its books.
async fn outstanding(farm: &ProcessFarm) -> anyhow::Result<()> {
    let admin = Admin::new(Reach::open(farm.grpc()));
    let planned = async {
        loop {
            let status = admin.status().await.map_err(|failure| anyhow::anyhow!(failure.describe()))?;
            let jobs: u64 = status.apps.iter().map(|app| app.outstanding_jobs).sum();
            // Some are on their way at any time.
            if jobs >= OUTSTANDING as u64 / 100 * 99 {
                return anyhow::Ok(());
            }
            tokio::time::sleep(POLL).await;
        }
    };
    tokio::time::timeout(PLANNING_PATIENCE, planned).await.context("not all jobs were planned in time")?
}
