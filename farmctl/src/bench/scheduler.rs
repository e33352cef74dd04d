//! What the farm costs when jobs cost nothing: round trip, jobs a second, CPU time a job. An embedded farm, real
//! gRPC and QUIC over loopback, all tiers in this one process.

use std::{
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use client_sdk::{Farm, FarmOptions, Job, JobResult, RetrieveError, Task, TaskGraph, TaskProgress};
use farm_core::{
    device::Requirements,
    program::{DispatchError, JobProgram},
};

use super::{Better, Figure};
use crate::{embedded::EmbeddedFarm, failure::Failure};

/// Round trips measured, one after the other.
const ROUND_TRIPS: usize = 2_000;
/// Round trips before measuring: connections, caches, allocator.
const WARM_UP: usize = 200;
/// Jobs of the throughput run.
const JOBS: usize = 20_000;

/// Measures on a farm of two simulated devices.
pub(crate) async fn measure() -> Result<Vec<Figure>, Failure> {
    let devices = ["sim:score=1000,speed=1.0".to_owned(), "sim:score=1000,speed=1.0".to_owned()];
    let farm = EmbeddedFarm::start(&devices).await?;
    let app = Farm::connect(FarmOptions::new(farm.grpc(), "bench scheduler")).await?;

    let trips = Arc::new(Mutex::new(Vec::with_capacity(WARM_UP + ROUND_TRIPS)));
    let chain = Chain { left: WARM_UP + ROUND_TRIPS, trips: Arc::clone(&trips) };
    app.run(TaskGraph::new().task("chain", chain)).await?;
    let mut trips = trips.lock().unwrap_or_else(PoisonError::into_inner).split_off(WARM_UP);
    trips.sort_unstable();

    let (cpu_before, began) = (process_cpu_time()?, Instant::now());
    let summary = app.run(TaskGraph::new().task("flood", Flood)).await?;
    let (wall, cpu) = (began.elapsed(), process_cpu_time()? - cpu_before);
    app.close().await;
    farm.stop().await;

    let jobs = f64::from(u32::try_from(summary.jobs).unwrap_or(u32::MAX));
    Ok(vec![
        Figure::new("round_trip_p50", percentile_ms(&trips, 0.50), "ms", Better::Lower, 1.0),
        Figure::new("round_trip_p95", percentile_ms(&trips, 0.95), "ms", Better::Lower, 3.0),
        Figure::new("noop_jobs_per_second", jobs / wall.as_secs_f64(), "1/s", Better::Higher, 20_000.0),
        // All tiers together (10-scheduling.md section 5).
        Figure::new("cpu_per_job", cpu.as_secs_f64() * 1e6 / jobs, "us", Better::Lower, 20.0),
    ])
}

/// The value below which the share `quantile` of the sorted durations lies.
fn percentile_ms(sorted: &[Duration], quantile: f64) -> f64 {
    let last = sorted.len().saturating_sub(1);
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        clippy::cast_precision_loss,
        reason = "an index of a few thousand entries, scaled by a number in 0..=1"
    )]
    let index = (last as f64 * quantile).round() as usize;
    sorted.get(index).map_or(f64::NAN, |duration| duration.as_secs_f64() * 1e3)
}

/// User and system time of this process.
fn process_cpu_time() -> Result<Duration, Failure> {
    // proc(5): after the name in parentheses, utime and stime are the 12th and 13th fields, in ticks of 10 ms.
    let stat = std::fs::read_to_string("/proc/self/stat")?;
    let fields = stat.rsplit_once(')').map_or("", |(_, fields)| fields);
    let ticks: u64 =
        fields.split_whitespace().skip(11).take(2).filter_map(|field| field.parse::<u64>().ok()).sum();
    Ok(Duration::from_millis(ticks * 10))
}

/// A job that does nothing; says when it was dispatched and when its result came.
struct NoOp {
    dispatched: Instant,
    trips: Option<Arc<Mutex<Vec<Duration>>>>,
}

impl Job for NoOp {
    fn dispatch(&mut self, _cmd: &mut JobProgram) -> Result<(), DispatchError> {
        Ok(())
    }

    fn retrieve(&mut self, _result: JobResult) -> Result<(), RetrieveError> {
        if let Some(trips) = &self.trips {
            trips.lock().unwrap_or_else(PoisonError::into_inner).push(self.dispatched.elapsed());
        }
        Ok(())
    }
}

/// One job at a time, each made when the one before is back.
struct Chain {
    left: usize,
    trips: Arc<Mutex<Vec<Duration>>>,
}

impl Chain {
    fn next(&mut self) -> Vec<Box<dyn Job>> {
        if self.left == 0 {
            return Vec::new();
        }
        self.left -= 1;
        vec![Box::new(NoOp { dispatched: Instant::now(), trips: Some(Arc::clone(&self.trips)) })]
    }
}

impl Task for Chain {
    fn requirements(&self) -> Requirements {
        Requirements::ANY
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        self.next()
    }

    fn more_jobs(&mut self, progress: &TaskProgress) -> Vec<Box<dyn Job>> {
        if progress.is_idle() { self.next() } else { Vec::new() }
    }
}

/// All the jobs at once.
struct Flood;

impl Task for Flood {
    fn requirements(&self) -> Requirements {
        Requirements::ANY
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        let now = Instant::now();
        (0..JOBS).map(|_| Box::new(NoOp { dispatched: now, trips: None }) as Box<dyn Job>).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_of_the_sorted_list() {
        let sorted: Vec<Duration> = (1..=101).map(Duration::from_millis).collect();
        assert!((percentile_ms(&sorted, 0.5) - 51.0).abs() < 1e-9, "the median of 1..=101 is 51");
        assert!((percentile_ms(&sorted, 0.95) - 96.0).abs() < 1e-9, "95 % of 1..=101 lie at or below 96");
        assert!(percentile_ms(&[], 0.5).is_nan(), "no median of nothing");
    }
}
