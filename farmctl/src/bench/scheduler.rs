//! What the farm costs when jobs cost nothing: round trip, jobs a second, CPU time a job. A coordinator and two workers
//! as processes, this one the application, real gRPC and QUIC over loopback.

use std::time::{Duration, Instant};

use client_sdk::TaskGraph;
use tokio::sync::mpsc;

use super::{
    Better, Figure, connect,
    jobs::{Chain, Flood},
    settled, start_farm,
    statistics::{median, percentile},
};
use crate::process_farm::{CpuTime, Shape, Stealing};

/// Round trips measured, one after the other.
const ROUND_TRIPS: usize = 2_000;
/// Round trips before measuring: connections, caches, allocator.
const WARM_UP: usize = 200;
/// Jobs of a throughput run.
const JOBS: usize = 20_000;

/// Measures on two workers of one simulated device each.
pub(super) async fn measure(runs: usize) -> anyhow::Result<Vec<Figure>> {
    let farm = start_farm(&Shape::uniform(2, 1))?;
    let app = connect(&farm, "bench scheduler", 1.0, Stealing::Off).await?;

    let (results, mut trips) = mpsc::unbounded_channel();
    app.run(TaskGraph::new().task("chain", Chain { left: WARM_UP + ROUND_TRIPS, results })).await?;
    let mut trips_ms = Vec::with_capacity(WARM_UP + ROUND_TRIPS);
    while let Some(trip) = trips.recv().await {
        trips_ms.push(milliseconds(trip.round_trip));
    }
    let trips_ms = trips_ms.split_off(WARM_UP);

    app.run(TaskGraph::new().task("warm up", Flood { jobs: JOBS })).await?;
    settled(&farm).await?;
    let before = farm.cpu_time()?;
    let mut rates = Vec::with_capacity(runs);
    for _ in 0..runs {
        let began = Instant::now();
        app.run(TaskGraph::new().task("flood", Flood { jobs: JOBS })).await?;
        rates.push(JOBS as f64 / began.elapsed().as_secs_f64());
        settled(&farm).await?;
    }
    let cpu = farm.cpu_time()?.since(before);
    app.close().await;

    let jobs = (JOBS * runs) as f64;
    let microseconds = |time: Duration| time.as_secs_f64() * 1e6 / jobs;
    tell(&cpu, microseconds);
    Ok(vec![
        Figure::new("round_trip_p50", percentile(&trips_ms, 0.50), "ms", Better::Lower, 1.0),
        Figure::new("round_trip_p95", percentile(&trips_ms, 0.95), "ms", Better::Lower, 3.0),
        Figure::new("noop_jobs_per_second", median(&rates), "1/s", Better::Higher, 50_000.0),
        Figure::new("cpu_per_job", microseconds(cpu.total()), "us", Better::Lower, 20.0),
        Figure::new("coordinator_cpu_per_job", microseconds(cpu.coordinator), "us", Better::Lower, 5.0),
    ])
}

fn tell(cpu: &CpuTime, microseconds: impl Fn(Duration) -> f64) {
    tell!(
        "CPU a job: application {:.1} us, coordinator {:.1} us, both workers {:.1} us",
        microseconds(cpu.application),
        microseconds(cpu.coordinator),
        microseconds(cpu.workers)
    );
}

fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}
