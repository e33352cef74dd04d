//! Mutual information as thesis 5.6.1 measures it: runtime over iterations and speed-up on devices of this machine
//! (figures 5.6 and 5.7), and what network and application add, by workers of one and of four simulated devices
//! (figure 5.8).

use std::{sync::Arc, time::Duration};

use client_sdk::{RunSummary, SimulatedDevices};
use mi_kernel::{
    Alignment, Seed,
    generate::RandomAlignment,
    job::{JobLengths, MiOptions, Mode, mi_graph},
    parse,
};

use super::{Better, Figure, connect, scaling::LEAST_EFFICIENCY, settled, start_farm, statistics::median};
use crate::{
    output,
    process_farm::{ProcessFarm, Shape, Stealing},
};

/// Iterations before the clock starts, for each device: jobs of one each, so many that each device gets some.
const WARM_UP_ITERATIONS: u64 = 8;
/// Parts of the iterations asked for that figure 5.6 is drawn over.
const PARTS: [u64; 4] = [8, 4, 2, 1];
/// Nodes and devices a node of figure 5.8.
const NODE_COUNTS: [usize; 4] = [1, 2, 4, 8];
const DEVICES_PER_NODE: [usize; 2] = [1, 4];
/// Iterations of figure 5.8.
const NETWORK_ITERATIONS: u64 = 64;
/// How fast the simulated devices are: one iteration of the thesis' first set takes 0.44 s.
const NETWORK_SPEED: f64 = 0.1;
/// The largest overhead of figure 5.8 in seconds.
const THESIS_OVERHEAD_S: f64 = 20.8;

/// What is measured.
pub(super) struct Setup<'a> {
    /// The alignment.
    pub(super) set: RandomAlignment,
    /// Devices of this machine; without any only the network is measured.
    pub(super) devices: &'a [String],
    /// Most iterations on them.
    pub(super) iterations: u64,
    /// Points of the curve over iterations: the last ones of [`PARTS`].
    pub(super) points: usize,
    /// Of the null model.
    pub(super) seed: u64,
    /// Of each measurement, of which the median counts.
    pub(super) runs: usize,
}

/// Measures all farms.
pub(super) async fn measure(setup: &Setup<'_>) -> anyhow::Result<Vec<Figure>> {
    let set = setup.set;
    let alignment = tokio::task::spawn_blocking(move || generated(&set)).await??;
    tell!("{alignment}");
    let mut figures = Vec::new();
    if !setup.devices.is_empty() {
        figures.extend(on_devices(setup, &alignment).await?);
    }
    figures.push(over_the_network(setup, &alignment).await?);
    Ok(figures)
}

fn generated(set: &RandomAlignment) -> anyhow::Result<Arc<Alignment>> {
    let mut text = Vec::new();
    set.write_fasta(&mut text)?;
    Ok(Arc::new(parse(&text)?.alignment))
}

/// 1, 2, 4, ... and all.
fn counts(devices: usize) -> Vec<usize> {
    let mut counts: Vec<usize> = std::iter::successors(Some(1), |count| Some(count * 2))
        .take_while(|count| *count < devices)
        .collect();
    counts.push(devices);
    counts
}

async fn on_devices(setup: &Setup<'_>, alignment: &Arc<Alignment>) -> anyhow::Result<Option<Figure>> {
    let mut table = output::table(["DEVICES", "ITERATIONS", "SECONDS", "MS/ITERATION", "SPEED-UP"]);
    let parts = &PARTS[PARTS.len() - setup.points..];
    let mut alone_s = [f64::NAN; PARTS.len()];
    let mut best = None;
    for count in counts(setup.devices.len()) {
        let shape = Shape { workers: vec![setup.devices[..count].to_vec()], local_stealing: Stealing::On };
        let farm = start_farm(&shape)?;
        // Every device has the contents and the compiled kernels.
        run(&farm, setup, alignment, WARM_UP_ITERATIONS * count as u64).await?;
        for (part, alone_s) in parts.iter().zip(&mut alone_s) {
            let iterations = (setup.iterations / part).max(1);
            let (seconds, _) = median_run(&farm, setup, alignment, iterations).await?;
            if count == 1 {
                *alone_s = seconds;
            }
            let speed_up = *alone_s / seconds;
            table.add_row([
                count.to_string(),
                iterations.to_string(),
                format!("{seconds:.3}"),
                format!("{:.2}", seconds * 1e3 / iterations as f64),
                format!("{speed_up:.3}"),
            ]);
            best = (count > 1).then_some((count, speed_up));
        }
    }
    tell!("{table}");
    Ok(best.map(|(count, speed_up)| {
        Figure::new("mi_speed_up", speed_up, "x", Better::Higher, LEAST_EFFICIENCY * count as f64)
    }))
}

async fn over_the_network(setup: &Setup<'_>, alignment: &Arc<Alignment>) -> anyhow::Result<Figure> {
    let mut table = output::table(["NODES", "DEVICES", "SECONDS", "ON DEVICES", "OVERHEAD"]);
    let mut worst_s = 0.0_f64;
    for devices in DEVICES_PER_NODE {
        for nodes in NODE_COUNTS {
            let worker =
                vec![format!("sim:score={},speed={NETWORK_SPEED}", 1_000.0 * NETWORK_SPEED); devices];
            let farm = start_farm(&Shape { workers: vec![worker; nodes], local_stealing: Stealing::On })?;
            let (seconds, device_s) = median_run(&farm, setup, alignment, NETWORK_ITERATIONS).await?;
            let busy_s = device_s / (nodes * devices) as f64;
            worst_s = worst_s.max(seconds - busy_s);
            table.add_row([
                nodes.to_string(),
                (nodes * devices).to_string(),
                format!("{seconds:.3}"),
                format!("{busy_s:.3}"),
                format!("{:.3}", seconds - busy_s),
            ]);
        }
    }
    tell!("{table}");
    Ok(Figure::new("mi_network_overhead_worst", worst_s, "s", Better::Lower, THESIS_OVERHEAD_S))
}

/// Medians of wall time and of device time, in seconds.
async fn median_run(
    farm: &ProcessFarm,
    setup: &Setup<'_>,
    alignment: &Arc<Alignment>,
    iterations: u64,
) -> anyhow::Result<(f64, f64)> {
    let (mut wall_s, mut device_s) = (Vec::new(), Vec::new());
    for _ in 0..setup.runs {
        let summary = run(farm, setup, alignment, iterations).await?;
        let seconds = |duration: Duration| duration.as_secs_f64();
        wall_s.push(seconds(summary.wall_time));
        device_s.push(seconds(summary.device_time));
    }
    Ok((median(&wall_s), median(&device_s)))
}

async fn run(
    farm: &ProcessFarm,
    setup: &Setup<'_>,
    alignment: &Arc<Alignment>,
    iterations: u64,
) -> anyhow::Result<RunSummary> {
    settled(farm).await?;
    let options = MiOptions {
        iterations,
        seed: Seed(setup.seed),
        mode: Mode::Reduce,
        lengths: JobLengths::Measured,
        earlier: None,
        simulated: SimulatedDevices::Accepted,
    };
    let (graph, _) = mi_graph(Arc::clone(alignment), options)?;
    let app = connect(farm, "bench mi", 1.0, Stealing::On).await?;
    let summary = app.run(graph).await?;
    app.close().await;
    Ok(summary)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_double_up_to_all() {
        assert_eq!(counts(1), [1]);
        assert_eq!(counts(2), [1, 2]);
        assert_eq!(counts(6), [1, 2, 4, 6]);
    }
}
