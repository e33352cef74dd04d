//! What stealing gains on irregular jobs: the thesis' tables 5.1 and 5.2 with real processes, simulated devices, and its
//! seconds as milliseconds.
//!
//! Each run has a farm of its own, so that none profits from what another one taught the coordinator. Links and the
//! module are there before the clock starts: they are milliseconds, and so are, at this scale, the jobs.

use client_sdk::{CostNs, TaskGraph};
use rand::{Rng as _, SeedableRng as _, rngs::SmallRng};

use super::{
    Better, Figure, connect,
    jobs::{List, UNKNOWN},
    settled, start_farm,
    statistics::{lower_bound, median, one_queue},
    tiles::{KITCHEN, MUSTANG, Scene, in_ms},
};
use crate::{
    output,
    process_farm::{Shape, Stealing},
};

/// Workers, as in the thesis' cluster (5.6).
const WORKERS: usize = 8;
/// Devices of each.
const DEVICES: usize = 4;
/// How much faster the fastest device of the unequal farm is than the slowest (thesis 5.6.5: 583 to 1027 GFLOP/s).
const SPEED_RANGE: f64 = 1.76;
/// Announced scores are wrong by up to this factor, either way.
const SCORE_ERROR: f64 = 2.0;
/// Jobs before the clock starts: enough that every node gets one, whatever its score.
const WARM_UP_JOBS: usize = 512;

/// What may steal, in the order of the tables' columns.
const MODES: [(&str, Stealing, Stealing); 4] = [
    ("none", Stealing::Off, Stealing::Off),
    ("global only", Stealing::Off, Stealing::On),
    ("local only", Stealing::On, Stealing::Off),
    ("full", Stealing::On, Stealing::On),
];
const NONE: usize = 0;
const FULL: usize = 3;

/// One line of a table.
struct Setting {
    name: &'static str,
    scene: Scene,
    devices: Vec<SimDevice>,
    /// Seconds in the thesis, by mode.
    thesis_s: [f64; 4],
    gain: (&'static str, f64),
    ratio: &'static str,
}

/// A simulated device and what it announces.
#[derive(Clone, Copy)]
struct SimDevice {
    speed: f64,
    score: f64,
}

/// Measures all settings.
pub(super) async fn measure(seed: u64, runs: usize) -> anyhow::Result<Vec<Figure>> {
    let mut figures = Vec::new();
    let [none, global, local, full] = MODES.map(|(mode, ..)| mode);
    let mut table = output::table(["", none, global, local, full, "full/none", "lower bound", "one queue"]);
    for setting in settings(seed) {
        let tiles = setting.scene.tiles(seed);
        let mut makespans_ms: [Vec<f64>; 4] = Default::default();
        // The modes take turns: what else the machine does meets all of them.
        for _ in 0..runs {
            for (makespans_ms, (_, local, global)) in makespans_ms.iter_mut().zip(MODES) {
                makespans_ms.push(run(&setting.devices, &tiles, local, global).await?);
            }
        }
        let medians_ms = makespans_ms.map(|makespans_ms| median(&makespans_ms));
        let jobs_ms: Vec<f64> = tiles.iter().map(|&tile| in_ms(tile)).collect();
        let speeds: Vec<f64> = setting.devices.iter().map(|device| device.speed).collect();
        let bound_ms = lower_bound(&jobs_ms, &speeds);
        let one_queue_ms = one_queue(&jobs_ms, &speeds);
        let gain = medians_ms[FULL] / medians_ms[NONE];
        let row = |name: String, runtimes: [f64; 4], unit: &str, rest: [String; 2]| {
            let gain = runtimes[FULL] / runtimes[NONE];
            let runtimes = runtimes.map(|runtime| format!("{runtime:.0} {unit}"));
            [vec![name], runtimes.into(), vec![format!("{gain:.3}")], rest.into()].concat()
        };
        let reference = [bound_ms, one_queue_ms].map(|ms| format!("{ms:.0} ms"));
        table.add_row(row(setting.name.to_owned(), medians_ms, "ms", reference));
        table.add_row(row("  thesis".to_owned(), setting.thesis_s, "s", Default::default()));
        figures.push(Figure::new(setting.gain.0, gain, "ratio", Better::Lower, setting.gain.1));
        figures.push(Figure::new(setting.ratio, medians_ms[FULL] / bound_ms, "ratio", Better::Lower, 1.04));
    }
    eprintln!("{table}");
    Ok(figures)
}

fn settings(seed: u64) -> [Setting; 3] {
    let equal = vec![SimDevice { speed: 1.0, score: 1_000.0 }; WORKERS * DEVICES];
    [
        Setting {
            name: "kitchen",
            scene: KITCHEN,
            devices: equal.clone(),
            thesis_s: [227.105, 203.453, 212.26, 201.597],
            gain: ("steal_gain_kitchen", 0.888),
            ratio: "makespan_ratio_kitchen",
        },
        Setting {
            name: "mustang",
            scene: MUSTANG,
            devices: equal,
            thesis_s: [236.324, 193.776, 210.258, 190.51],
            gain: ("steal_gain_mustang", 0.806),
            ratio: "makespan_ratio_mustang",
        },
        Setting {
            name: "mustang, unequal",
            scene: MUSTANG,
            devices: unequal_devices(seed),
            thesis_s: [823.19, 708.16, 715.52, 681.53],
            gain: ("steal_gain_heterogeneous", 0.828),
            ratio: "makespan_ratio_heterogeneous",
        },
    ]
}

/// Devices of nodes from the slowest to the fastest, with scores that are wrong.
fn unequal_devices(seed: u64) -> Vec<SimDevice> {
    let mut random = SmallRng::seed_from_u64(seed);
    let device = |index: usize| {
        let step = (index / DEVICES) as f64 / (WORKERS - 1) as f64;
        let speed = 1.0 + (SPEED_RANGE - 1.0) * step;
        let error = SCORE_ERROR.powf(random.random_range(-1.0..1.0));
        SimDevice { speed, score: 1_000.0 * speed * error }
    };
    (0..WORKERS * DEVICES).map(device).collect()
}

/// Runs the jobs once on a fresh farm; gives the time from the call to the last result, in milliseconds.
async fn run(
    devices: &[SimDevice],
    tiles: &[CostNs],
    local_stealing: Stealing,
    global: Stealing,
) -> anyhow::Result<f64> {
    let spec = |device: &SimDevice| format!("sim:score={},speed={}", device.score, device.speed);
    let workers = devices.chunks(DEVICES).map(|devices| devices.iter().map(spec).collect()).collect();
    let farm = start_farm(&Shape { workers, local_stealing })?;
    let app = connect(&farm, "bench steal", 1.0, global).await?;
    let warm_up = List::new(vec![CostNs(0); WARM_UP_JOBS], UNKNOWN);
    app.run(TaskGraph::new().task("warm up", warm_up)).await?;
    settled(&farm).await?;
    let summary = app.run(TaskGraph::new().task("tiles", List::new(tiles.to_vec(), UNKNOWN))).await?;
    app.close().await;
    Ok(summary.wall_time.as_secs_f64() * 1e3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unequal_devices_are_as_unequal_as_they_should_be() {
        let devices = unequal_devices(1);
        let speeds = || devices.iter().map(|device| device.speed);
        assert_eq!(speeds().fold(f64::INFINITY, f64::min), 1.0);
        assert!((speeds().fold(0.0, f64::max) - SPEED_RANGE).abs() < 1e-9);
        let errors: Vec<f64> = devices.iter().map(|device| device.score / device.speed / 1_000.0).collect();
        assert!(errors.iter().all(|error| (1.0 / SCORE_ERROR..=SCORE_ERROR).contains(error)), "{errors:?}");
        let (least, most) =
            (errors.iter().copied().fold(9.0, f64::min), errors.iter().copied().fold(0.0, f64::max));
        assert!(most / least > 2.0, "scores that hardly err measure nothing: {least}..{most}");
    }
}
