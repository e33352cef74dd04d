//! Speed-up on equal jobs, like those of mutual information (thesis 5.6.1): by devices of one node, by nodes of four
//! devices, and against the exact optimum on unequal devices.
//!
//! Every device count gets the same number of jobs per device, so that each run takes equally long; the speed-up is of jobs
//! per time.

use client_sdk::{CostNs, TaskGraph};

use super::{
    Better, Figure, connect,
    jobs::{Hint, List},
    settled, start_farm,
    statistics::{equal_jobs_optimum, median},
    tiles::cost_ms,
};
use crate::{
    output,
    process_farm::{Shape, Stealing},
};

/// One iteration of the thesis' first set of sequences, its seconds as milliseconds.
const JOB_MS: f64 = 19.72;
/// Jobs per device: two seconds.
const JOBS_PER_DEVICE: usize = 100;
/// Devices of one node.
const DEVICE_COUNTS: [usize; 6] = [1, 2, 4, 8, 16, 32];
/// Nodes of four devices.
const NODE_COUNTS: [usize; 4] = [1, 2, 4, 8];
const DEVICES_PER_NODE: usize = 4;
/// The thesis reaches 31.5 on 32 GPUs.
pub(super) const LEAST_EFFICIENCY: f64 = 0.985;
/// Speeds of the nodes of the unequal farm, from slowest to fastest as thesis 5.6.5.
const UNEQUAL_SPEEDS: [f64; 4] = [1.0, 1.25, 1.5, 1.76];

/// Measures all farms.
pub(super) async fn measure(runs: usize) -> anyhow::Result<Vec<Figure>> {
    let mut table = output::table(["NODES", "DEVICES", "SPEED-UP", "OVER IDEAL"]);
    let farms = DEVICE_COUNTS.map(|devices| (1, devices)).into_iter();
    let farms = farms.chain(NODE_COUNTS.map(|nodes| (nodes, DEVICES_PER_NODE)));
    let ideal_ms = JOB_MS * JOBS_PER_DEVICE as f64;
    let mut alone_ms = f64::NAN;
    let mut speed_ups = Vec::new();
    for (nodes, devices) in farms {
        let count = nodes * devices;
        let makespan_ms = makespan_ms(&Shape::uniform(nodes, devices), count * JOBS_PER_DEVICE, runs).await?;
        if count == 1 {
            alone_ms = makespan_ms;
        }
        let speed_up = count as f64 * alone_ms / makespan_ms;
        speed_ups.push(speed_up);
        let over_ideal = makespan_ms / ideal_ms;
        table.add_row([
            nodes.to_string(),
            count.to_string(),
            format!("{speed_up:.2}"),
            format!("{over_ideal:.4}"),
        ]);
    }
    tell!("{table}");
    let by_devices = speed_ups[DEVICE_COUNTS.len() - 1];
    let by_nodes = speed_ups[speed_ups.len() - 1];

    let worker = |speed: f64| vec![format!("sim:score={},speed={speed}", 1_000.0 * speed); DEVICES_PER_NODE];
    let unequal = Shape { workers: UNEQUAL_SPEEDS.map(worker).into(), local_stealing: Stealing::On };
    let times_ms: Vec<f64> =
        UNEQUAL_SPEEDS.iter().flat_map(|speed| [JOB_MS / speed; DEVICES_PER_NODE]).collect();
    let jobs = times_ms.len() * JOBS_PER_DEVICE;
    let ratio = makespan_ms(&unequal, jobs, runs).await? / equal_jobs_optimum(jobs, &times_ms);

    let least = LEAST_EFFICIENCY * 32.0;
    Ok(vec![
        Figure::new("speed_up_32_devices", by_devices, "x", Better::Higher, least),
        Figure::new("speed_up_8_nodes_32_devices", by_nodes, "x", Better::Higher, least),
        Figure::new("equal_jobs_makespan_ratio", ratio, "ratio", Better::Lower, 1.05),
    ])
}

/// The median time of `runs` runs of equal jobs on one farm.
async fn makespan_ms(shape: &Shape, jobs: usize, runs: usize) -> anyhow::Result<f64> {
    let farm = start_farm(shape)?;
    let app = connect(&farm, "bench scaling", 1.0, Stealing::On).await?;
    let list = |count, duration: CostNs| List::new(vec![duration; count], Hint::Exact);
    app.run(TaskGraph::new().task("warm up", list(jobs, CostNs(0)))).await?;
    let mut makespans_ms = Vec::with_capacity(runs);
    for _ in 0..runs {
        settled(&farm).await?;
        let summary = app.run(TaskGraph::new().task("jobs", list(jobs, cost_ms(JOB_MS)))).await?;
        makespans_ms.push(summary.wall_time.as_secs_f64() * 1e3);
    }
    app.close().await;
    Ok(median(&makespans_ms))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::tiles::in_ms;

    #[test]
    fn jobs_divide_evenly() {
        let ideal_ms = JOB_MS * JOBS_PER_DEVICE as f64;
        for devices in DEVICE_COUNTS {
            let optimum_ms = equal_jobs_optimum(devices * JOBS_PER_DEVICE, &vec![JOB_MS; devices]);
            assert!((optimum_ms - ideal_ms).abs() < 1e-6, "{devices} devices: {optimum_ms} ms");
            let uneven_ms = equal_jobs_optimum(devices * JOBS_PER_DEVICE + 1, &vec![JOB_MS; devices]);
            assert!(uneven_ms > ideal_ms + JOB_MS / 2.0, "one job more is one round more");
        }
        assert!((in_ms(cost_ms(JOB_MS)) - JOB_MS).abs() < 1e-6);
    }
}
