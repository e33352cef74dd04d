//! Samples and rays per second of the kernels on this machine's first device, without a farm around them:
//! `throughput SCENE [--size WxH] [--samples N] [--seconds S] [--integrator bdpt|pt] [--lanes N] [--threshold X]
//! [--unchecked] [--module FILE]`. One line of JSON per run; `--module` measures another text of the kernels.

use std::{
    error::Error,
    path::PathBuf,
    sync::{Arc, mpsc},
    time::{Duration, Instant},
};

use bdpt_kernel::{
    bvh::{BuildQuality, Bvh},
    gpu::{
        Counters, FrameParams, Integrator, LightJob, NormalisedScene, PackedScene, RenderOptions,
        SceneContents, TileJob, module_source,
    },
    scene::{self, model::FilmSize},
};
use bytes::Bytes;
use farm_core::{
    id::{AppId, Attempt, ContentHash, Epoch, JobAttempt, JobId, JobIndex, TaskId},
    program::{Content, JobProgram},
};
use gpu_exec::{DeviceSpec, Executor, ExecutorConfig, ExecutorEvent, Order, expand};

const TILE_EDGE_PX: u32 = 64;
const LIMIT: Duration = Duration::from_secs(300);

struct Arguments {
    scene: PathBuf,
    width_px: u32,
    height_px: u32,
    samples: u32,
    seconds: f64,
    options: RenderOptions,
    unchecked: bool,
    module: Option<PathBuf>,
}

fn arguments() -> Result<Arguments, Box<dyn Error>> {
    let mut words = std::env::args().skip(1);
    let mut arguments = Arguments {
        scene: words.next().ok_or("which scene?")?.into(),
        width_px: 1920,
        height_px: 1152,
        samples: 64,
        seconds: 5.0,
        options: RenderOptions::default(),
        unchecked: false,
        module: None,
    };
    while let Some(flag) = words.next() {
        let mut value = || words.next().ok_or_else(|| format!("{flag} needs a value"));
        match flag.as_str() {
            "--size" => {
                let size = value()?;
                let (width, height) = size.split_once('x').ok_or("--size WxH")?;
                (arguments.width_px, arguments.height_px) = (width.parse()?, height.parse()?);
            }
            "--samples" => arguments.samples = value()?.parse()?,
            "--seconds" => arguments.seconds = value()?.parse()?,
            "--lanes" => arguments.options.lanes_per_run = value()?.parse()?,
            "--threshold" => arguments.options.connection_threshold = value()?.parse()?,
            "--integrator" => {
                arguments.options.integrator = match value()?.as_str() {
                    "bdpt" => Integrator::Bidirectional,
                    "pt" => Integrator::PathTracing,
                    other => return Err(format!("--integrator {other}: bdpt or pt").into()),
                };
            }
            "--unchecked" => arguments.unchecked = true,
            "--module" => arguments.module = Some(value()?.into()),
            other => return Err(format!("unknown {other}").into()),
        }
    }
    Ok(arguments)
}

struct Bench {
    executor: Executor,
    inbox: mpsc::Receiver<ExecutorEvent>,
    contents: Vec<(ContentHash, Bytes)>,
    sequence: u64,
}

impl Bench {
    fn submit(&mut self, program: JobProgram) -> Result<(), Box<dyn Error>> {
        self.sequence += 1;
        let job = JobAttempt {
            job: JobId { app: AppId(1), task: TaskId(0), index: JobIndex(0) },
            attempt: Attempt { epoch: Epoch(1), sequence: self.sequence },
        };
        let order = Order {
            job,
            class: farm_core::message::LatencyClass::Batch,
            program: Arc::new(program),
            contents: self.contents.clone(),
            limit: LIMIT,
        };
        Ok(self.executor.submit(order)?)
    }

    /// Device time and sections of the job that ends next.
    fn finish(&self) -> Result<(Duration, Vec<Bytes>), Box<dyn Error>> {
        loop {
            match self.inbox.recv_timeout(LIMIT)? {
                ExecutorEvent::Started { .. }
                | ExecutorEvent::Yielded { .. }
                | ExecutorEvent::Resumed { .. } => {}
                ExecutorEvent::Finished { outcome, device_time_ns, .. } => {
                    let sections = outcome.map_err(|failure| format!("{failure:?}"))?;
                    return Ok((Duration::from_nanos(device_time_ns), sections));
                }
                ExecutorEvent::Lost { reason } => return Err(reason.into()),
            }
        }
    }
}

fn register(packed: &PackedScene, module: &str) -> (SceneContents, Vec<(ContentHash, Bytes)>) {
    let mut contents = Vec::new();
    let mut name = |bytes: &[u8]| {
        let hash = ContentHash(*blake3::hash(bytes).as_bytes());
        contents.push((hash, Bytes::copy_from_slice(bytes)));
        Content { hash, size_bytes: bytes.len() as u64 }
    };
    let scene = SceneContents {
        nodes: name(&packed.nodes),
        triangles: name(&packed.triangles),
        shading: name(&packed.shading),
        materials: name(&packed.materials),
        lights: name(&packed.lights),
        module: name(module.as_bytes()),
    };
    (scene, contents)
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments = arguments()?;
    let loaded = scene::load(&arguments.scene)?;
    let normalised = NormalisedScene::new(&loaded.scene);
    let triangles = &normalised.scene().triangles;
    let bvh = Bvh::build(triangles, BuildQuality::for_triangles(triangles.len()));
    let packed = PackedScene::new(&normalised, &bvh)?;
    let film = FilmSize { width_px: arguments.width_px, height_px: arguments.height_px };
    let frame = FrameParams::new(&packed, film, arguments.options)?;
    let module = match &arguments.module {
        Some(file) => std::fs::read_to_string(file)?,
        None => module_source().to_owned(),
    };
    let (scene, contents) = register(&packed, &module);
    let config = ExecutorConfig { unchecked: arguments.unchecked, ..ExecutorConfig::default() };
    let (events, inbox) = mpsc::channel();
    let device = expand(&[DeviceSpec::All])?;
    let executor = Executor::start(&device[0], config, move |event| drop(events.send(event)))?;
    let name = executor.info().name.clone();
    let mut bench = Bench { executor, inbox, contents, sequence: 0 };

    // Tiles that step through the whole image, so that any part of it weighs as much.
    let columns = film.width_px.div_ceil(TILE_EDGE_PX);
    let rows = film.height_px.div_ceil(TILE_EDGE_PX);
    let tile = |number: u32| {
        let place = number.wrapping_mul(7) % (columns * rows);
        let (x_px, y_px) = (place % columns * TILE_EDGE_PX, place / columns * TILE_EDGE_PX);
        TileJob {
            x_px,
            y_px,
            width_px: TILE_EDGE_PX.min(film.width_px - x_px),
            height_px: TILE_EDGE_PX.min(film.height_px - y_px),
            first_sample: number / (columns * rows) * arguments.samples,
            samples: arguments.samples,
            seed: 1,
        }
    };
    let submit = |bench: &mut Bench, number: u32| -> Result<(), Box<dyn Error>> {
        let mut program = JobProgram::default();
        tile(number).program(&scene, &frame, &mut program)?;
        bench.submit(program)
    };
    // The first jobs compile and find the device's pace.
    let warm_up = Instant::now();
    for number in 0..4 {
        submit(&mut bench, number)?;
        let _ = bench.finish()?;
    }
    let warm_up = warm_up.elapsed();
    let (mut samples, mut rays, mut device_time) = (0_u64, 0_u64, Duration::ZERO);
    let mut counters = Counters::default();
    let start = Instant::now();
    submit(&mut bench, 4)?;
    let mut number = 5;
    while start.elapsed().as_secs_f64() < arguments.seconds {
        submit(&mut bench, number)?;
        let (time, sections) = bench.finish()?;
        let layer = tile(number - 1).decode(&sections)?;
        samples += tile(number - 1).total_samples();
        rays += layer.pixels.iter().map(|p| u64::from(p.rays)).sum::<u64>();
        counters.add(&layer.counters);
        device_time += time;
        number += 1;
    }
    let wall = start.elapsed().as_secs_f64();
    let _ = bench.finish()?;
    let light = LightJob {
        first_path: 0,
        paths: u32::try_from(samples).map_or(2_000_000, |n| n.min(2_000_000)),
        seed: 1,
    };
    let mut light_s = 0.0;
    let mut light_rays = 0;
    for _ in 0..3 {
        let mut program = JobProgram::default();
        light.program(&scene, &frame, &mut program)?;
        bench.submit(program)?;
        let (time, sections) = bench.finish()?;
        let layer = light.decode(&frame, &sections)?;
        light_s = time.as_secs_f64();
        light_rays = layer.counters.rays;
        counters.add(&layer.counters);
    }
    let on_device = device_time.as_secs_f64();
    println!(
        "{{\"device\":\"{name}\",\"triangles\":{},\"samples_per_s\":{:.3e},\"samples_per_device_s\":{:.3e},\
         \"rays_per_device_s\":{:.3e},\"rays_per_sample\":{:.1},\"job_device_ms\":{:.2},\"job_wall_ms\":{:.2},\
         \"light_paths_per_device_s\":{:.3e},\"light_rays_per_device_s\":{:.3e},\"warm_up_s\":{:.2},\"faults\":\"{:?}\"}}",
        triangles.len(),
        samples as f64 / wall,
        samples as f64 / on_device,
        rays as f64 / on_device,
        rays as f64 / samples as f64,
        on_device * 1e3 / f64::from(number - 5),
        wall * 1e3 / f64::from(number - 5),
        f64::from(light.paths) / light_s,
        f64::from(light_rays) / light_s,
        warm_up.as_secs_f64(),
        counters.faults(),
    );
    Ok(())
}
