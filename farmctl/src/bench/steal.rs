//! What stealing gains on irregular jobs: the thesis' tables 5.1 and 5.2 with real processes, simulated devices, and its
//! seconds as milliseconds.
//!
//! The tables' modes are those of the policy `fcfs`, under which nobody knows what a tile takes: even one queue for all devices
//! ends some 3 % after the bound. What a render gets (`neighbours`) is beside them, and a second frame under `history`: the same
//! tiles again, whose times the farm has seen.
//!
//! Each run has a farm of its own, so that none profits from what another one taught the coordinator. Links and the
//! module are there before the clock starts: they are milliseconds, and so are, at this scale, the jobs.

use std::{collections::BTreeMap, fs, path::Path};

use anyhow::Context as _;
use client_sdk::{CostNs, Farm, FarmOptions, TaskGraph};
use farm_core::{
    coordinator::{
        policy::{FCFS, HISTORY, NEIGHBOURS},
        timeline::{MAX_SEGMENTS, Migration, Segment, Timeline, TimelineQuery},
    },
    id::{DeviceIndex, NodeId},
};
use rand::{Rng as _, SeedableRng as _, rngs::SmallRng};

use super::{
    Better, Figure,
    jobs::{List, UNKNOWN},
    settled, start_farm,
    statistics::{lower_bound, median, one_queue, percentile},
    tiles::{KITCHEN, MUSTANG, Scene, in_ms},
};
use crate::{
    admin::Admin,
    output,
    process_farm::{Shape, Stealing},
    target::Reach,
    timeline::{Chart, svg},
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

/// What may steal and how jobs are placed: the tables' columns in their order, then what a render gets, and its second frame.
const MODES: [(&str, Stealing, Stealing, &str); 6] = [
    ("none", Stealing::Off, Stealing::Off, FCFS),
    ("global only", Stealing::Off, Stealing::On, FCFS),
    ("local only", Stealing::On, Stealing::Off, FCFS),
    ("full", Stealing::On, Stealing::On, FCFS),
    ("render", Stealing::On, Stealing::On, NEIGHBOURS),
    ("second frame", Stealing::On, Stealing::On, HISTORY),
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
    /// What the thesis gains, over runs without stealing; `fcfs` with all of it, and what a render gets, should gain more.
    gain_bar: f64,
    /// What figures call it.
    key: &'static str,
}

/// A simulated device and what it announces.
#[derive(Clone, Copy)]
struct SimDevice {
    speed: f64,
    score: f64,
}

/// Measures all settings.
pub(super) async fn measure(seed: u64, runs: usize, pictures: Option<&Path>) -> anyhow::Result<Vec<Figure>> {
    let mut figures = Vec::new();
    let [none, global, local, full, render, second_frame] = MODES.map(|(mode, ..)| mode);
    let mut table = output::table([
        "",
        none,
        global,
        local,
        full,
        "full/none",
        "lower bound",
        "one queue",
        render,
        second_frame,
    ]);
    let mut gaps = Gaps::default();
    for setting in settings(seed) {
        let tiles = setting.scene.tiles(seed);
        let mut makespans_ms: [Vec<f64>; MODES.len()] = Default::default();
        // The modes take turns: what else the machine does meets all of them.
        for _ in 0..runs {
            for (index, (mode, local, global, policy)) in MODES.into_iter().enumerate() {
                let ran = run(&setting.devices, &tiles, local, global, policy).await?;
                makespans_ms[index].push(ran.makespan_ms);
                if index == FULL {
                    gaps.take(&ran.timeline.segments);
                }
                if let Some(folder) = pictures {
                    draw(folder, &format!("{}, {mode}", setting.name), &ran.timeline)?;
                }
            }
        }
        let medians_ms = makespans_ms.map(|makespans_ms| median(&makespans_ms));
        let jobs_ms: Vec<f64> = tiles.iter().map(|&tile| in_ms(tile)).collect();
        let speeds: Vec<f64> = setting.devices.iter().map(|device| device.speed).collect();
        let bound_ms = lower_bound(&jobs_ms, &speeds);
        let one_queue_ms = one_queue(&jobs_ms, &speeds);
        let [none_ms, global_ms, local_ms, full_ms, render_ms, second_frame_ms] = medians_ms;
        let row = |name: String, runtimes: [f64; 4], unit: &str, rest: [String; 4]| {
            let gain = runtimes[FULL] / runtimes[NONE];
            let runtimes = runtimes.map(|runtime| format!("{runtime:.0} {unit}"));
            [vec![name], runtimes.into(), vec![format!("{gain:.3}")], rest.into()].concat()
        };
        let reference = [bound_ms, one_queue_ms, render_ms, second_frame_ms].map(|ms| format!("{ms:.0} ms"));
        let runtimes_ms = [none_ms, global_ms, local_ms, full_ms];
        table.add_row(row(setting.name.to_owned(), runtimes_ms, "ms", reference));
        table.add_row(row("  thesis".to_owned(), setting.thesis_s, "s", Default::default()));
        let key = setting.key;
        for (name, ms) in [(format!("steal_gain_{key}"), full_ms), (format!("render_gain_{key}"), render_ms)]
        {
            figures.push(Figure::new(name, ms / none_ms, "ratio", Better::Lower, setting.gain_bar));
        }
        for (suffix, ms) in [("", render_ms), ("_second_frame", second_frame_ms), ("_fcfs", full_ms)] {
            let name = format!("makespan_ratio_{key}{suffix}");
            figures.push(Figure::new(name, ms / bound_ms, "ratio", Better::Lower, 1.04));
        }
    }
    tell!("{table}");
    for (name, gaps_ms, bar_ms) in [
        ("steal_latency_p95_local", &gaps.local_ms, 5.0),
        ("steal_latency_p95_global", &gaps.global_ms, 25.0),
    ] {
        figures.push(Figure::new(name, percentile(gaps_ms, 0.95), "ms", Better::Lower, bar_ms));
    }
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
            gain_bar: 0.888,
            key: "kitchen",
        },
        Setting {
            name: "mustang",
            scene: MUSTANG,
            devices: equal,
            thesis_s: [236.324, 193.776, 210.258, 190.51],
            gain_bar: 0.806,
            key: "mustang",
        },
        Setting {
            name: "mustang, unequal",
            scene: MUSTANG,
            devices: unequal_devices(seed),
            thesis_s: [823.19, 708.16, 715.52, 681.53],
            gain_bar: 0.828,
            key: "heterogeneous",
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

/// One run of the tiles.
struct Ran {
    /// From the call to the last result.
    makespan_ms: f64,
    timeline: Timeline,
}

/// How long devices were idle before jobs that they stole, in milliseconds: from the end of the job before.
#[derive(Default)]
struct Gaps {
    local_ms: Vec<f64>,
    global_ms: Vec<f64>,
}

impl Gaps {
    fn take(&mut self, segments: &[Segment]) {
        let mut by_device: BTreeMap<(NodeId, DeviceIndex), Vec<&Segment>> = BTreeMap::new();
        for segment in segments {
            by_device.entry((segment.node, segment.device)).or_default().push(segment);
        }
        for jobs in by_device.values_mut() {
            jobs.sort_by_key(|segment| segment.started_at);
            for pair in jobs.windows(2) {
                let idle_ms = pair[1].started_at.since(pair[0].ended_at).as_secs_f64() * 1e3;
                match pair[1].migration {
                    None => {}
                    Some(Migration::Local { .. }) => self.local_ms.push(idle_ms),
                    Some(Migration::Global { .. }) => self.global_ms.push(idle_ms),
                }
            }
        }
    }
}

/// Writes what a run looked like.
fn draw(folder: &Path, name: &str, timeline: &Timeline) -> anyhow::Result<()> {
    let path = folder.join(format!("{}.svg", name.replace(", ", "-").replace(' ', "-")));
    let written =
        fs::create_dir_all(folder).and_then(|()| fs::write(&path, svg::picture(&Chart::new(timeline))));
    written.with_context(|| format!("{} cannot be written", path.display()))
}

/// Runs the tiles on a fresh farm, after jobs that take no time; under `history` after a first frame of the same tiles.
async fn run(
    devices: &[SimDevice],
    tiles: &[CostNs],
    local_stealing: Stealing,
    global: Stealing,
    policy: &str,
) -> anyhow::Result<Ran> {
    let spec = |device: &SimDevice| format!("sim:score={},speed={}", device.score, device.speed);
    let workers = devices.chunks(DEVICES).map(|devices| devices.iter().map(spec).collect()).collect();
    let farm = start_farm(&Shape { workers, local_stealing })?;
    let options = FarmOptions {
        global_stealing: global == Stealing::On,
        policy: policy.to_owned(),
        ..FarmOptions::new(farm.grpc(), "bench steal")
    };
    let app = Farm::connect(options).await?;
    let frame = || TaskGraph::new().task("tiles", List::new(tiles.to_vec(), UNKNOWN));
    let before = match policy {
        HISTORY => frame(),
        _ => TaskGraph::new().task("warm up", List::new(vec![CostNs(0); WARM_UP_JOBS], UNKNOWN)),
    };
    app.run(before).await?;
    settled(&farm).await?;
    let summary = app.run(frame()).await?;
    settled(&farm).await?;
    let query = TimelineQuery { app: None, task: None, max_segments: MAX_SEGMENTS };
    let timeline = Admin::new(Reach::open(farm.grpc())).timeline(query).await;
    let mut timeline = timeline.map_err(|failure| anyhow::anyhow!(failure.describe()))?;
    app.close().await;
    let last = timeline.segments.iter().map(|segment| segment.job.job.task).max();
    timeline.segments.retain(|segment| Some(segment.job.job.task) == last);
    Ok(Ran { makespan_ms: summary.wall_time.as_secs_f64() * 1e3, timeline })
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
