//! The renderer as an application of the farm: a task that builds the hierarchy, and one of tile and light jobs after it.
//!
//! Owns how jobs become a film; how an image is cut is `plan`'s, how layers add up is `film`'s, what a job computes is
//! `gpu`'s. Never knows where a job runs.

use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use client_sdk::{
    DispatchError, Job, JobProgram, JobResult, RetrieveError, Task, TaskData, TaskError, TaskGraph,
    TaskProgress,
};
use thiserror::Error;

use crate::{
    bvh::{BuildQuality, Bvh},
    film::{Film, FilmProgress, Image, MAX_HELD_TILES},
    gpu::{
        self, FrameError, FrameParams, Integrator, LightJob, NormalisedScene, PackedScene, SceneContents,
        TileJob,
    },
    plan::{Cursor, LightImage, PlannedJob, RenderPlan, TileTurn},
    scene::model::{FilmSize, Scene},
};

/// Name of the task that builds the hierarchy and packs the scene.
pub const BVH_TASK: &str = "bvh";
/// Name of the task that renders.
pub const RENDER_TASK: &str = "render";

/// Most samples per pixel of one render.
pub const MAX_SAMPLES_PER_PIXEL: u32 = 1 << 24;

/// What to render of a scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderOptions {
    /// Image size.
    pub size: FilmSize,
    /// Samples per pixel, 1..=16,777,216.
    pub spp: u32,
    /// The same seed on the same kind of device gives the same image.
    pub seed: u64,
    /// How paths are made.
    pub integrator: gpu::RenderOptions,
}

impl RenderOptions {
    /// All strategies, paths of up to 16 edges.
    #[must_use]
    pub fn new(size: FilmSize, spp: u32, seed: u64) -> Self {
        Self { size, spp, seed, integrator: gpu::RenderOptions::default() }
    }
}

/// A render that cannot start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum RenderError {
    /// No sample, or too many.
    #[error("{spp} samples per pixel: must be in 1..={MAX_SAMPLES_PER_PIXEL}")]
    Samples {
        /// What was asked for.
        spp: u32,
    },
    /// An image that the kernels cannot hold.
    #[error(transparent)]
    Frame(#[from] FrameError),
}

/// A view of a render from outside: its film as it grows.
#[derive(Clone, Debug)]
pub struct RenderHandle {
    shared: Arc<Shared>,
}

impl RenderHandle {
    /// How far the film is.
    #[must_use]
    pub fn progress(&self) -> FilmProgress {
        self.shared.film().progress()
    }

    /// The image of what has been merged so far; complete after the run.
    #[must_use]
    pub fn image(&self) -> Image {
        self.shared.film().image()
    }

    /// The image of all that has come, after a run that was stopped: layers that waited for their turn are merged.
    #[must_use]
    pub fn partial_image(&self) -> Image {
        let mut film = self.shared.film();
        film.merge_held();
        film.image()
    }

    /// How the image is cut into jobs.
    #[must_use]
    pub fn plan(&self) -> RenderPlan {
        self.shared.plan
    }

    /// Facts of the hierarchy, once it is built.
    #[must_use]
    pub fn bvh(&self) -> Option<BvhFacts> {
        self.shared.prepared.get().map(|prepared| prepared.bvh)
    }
}

/// What building the hierarchy came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BvhFacts {
    /// Triangles of the scene.
    pub triangles: usize,
    /// Nodes of 80 B.
    pub nodes: usize,
    /// Levels.
    pub depth: u32,
    /// Time of the build alone.
    pub build_time: std::time::Duration,
    /// Bytes that every node fetches.
    pub scene_bytes: usize,
}

/// The tasks of a render, and a handle on its film.
///
/// # Errors
/// The number of samples or the image size is out of range.
pub fn render_graph(scene: Scene, options: RenderOptions) -> Result<(TaskGraph, RenderHandle), RenderError> {
    if !(1..=MAX_SAMPLES_PER_PIXEL).contains(&options.spp) {
        return Err(RenderError::Samples { spp: options.spp });
    }
    let FilmSize { width_px, height_px } = options.size;
    if !(1..=FrameParams::MAX_PIXELS).contains(&options.size.pixels()) {
        return Err(FrameError::Size { width_px, height_px }.into());
    }
    let light_image = match options.integrator.integrator {
        Integrator::Bidirectional => LightImage::Traced,
        Integrator::NoLightImage | Integrator::PathTracing => LightImage::Left,
    };
    let plan = RenderPlan::new(options.size, options.spp, options.seed, light_image);
    let shared = Arc::new(Shared { plan, film: Mutex::new(Film::new(plan)), prepared: OnceLock::new() });
    let bvh = BvhTask { scene: Some(scene), options, shared: Arc::clone(&shared) };
    let render = RenderTask { cursor: Cursor::new(plan), shared: Arc::clone(&shared) };
    let graph = TaskGraph::new().task(BVH_TASK, bvh).task(RENDER_TASK, render).after(RENDER_TASK, BVH_TASK);
    Ok((graph, RenderHandle { shared }))
}

/// What the jobs, the tasks and the handle share.
#[derive(Debug)]
struct Shared {
    plan: RenderPlan,
    /// A lock, not an owner with messages: jobs are retrieved on the run's own threads, which may block, and must know
    /// that a layer was taken before they say so; the handle reads between two of them. Held for one merge or one
    /// copy.
    film: Mutex<Film>,
    prepared: OnceLock<Prepared>,
}

impl Shared {
    fn film(&self) -> MutexGuard<'_, Film> {
        // A panic in a merge is a broken invariant that ends the run; the sums stay readable for the partial image.
        self.film.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn prepared(&self) -> Result<&Prepared, DispatchError> {
        self.prepared.get().ok_or_else(|| {
            DispatchError::Application(format!("task `{RENDER_TASK}` must run after `{BVH_TASK}`"))
        })
    }
}

/// What the jobs need of the scene.
#[derive(Debug)]
struct Prepared {
    contents: SceneContents,
    frame: FrameParams,
    bvh: BvhFacts,
}

/// Builds the hierarchy on the CPU and puts the scene where the farm fetches it from.
#[derive(Debug)]
struct BvhTask {
    scene: Option<Scene>,
    options: RenderOptions,
    shared: Arc<Shared>,
}

impl Task for BvhTask {
    fn prepare(&mut self, data: &mut TaskData) -> Result<(), TaskError> {
        let scene =
            self.scene.take().ok_or_else(|| TaskError::application("the scene was prepared before"))?;
        let normalised = NormalisedScene::new(&scene);
        drop(scene);
        let triangles = &normalised.scene().triangles;
        let bvh = Bvh::build(triangles, BuildQuality::for_triangles(triangles.len()));
        let packed = PackedScene::new(&normalised, &bvh).map_err(TaskError::application)?;
        let frame = FrameParams::new(&packed, self.options.size, self.options.integrator)
            .map_err(TaskError::application)?;
        let facts = BvhFacts {
            triangles: triangles.len(),
            nodes: bvh.cwbvh.nodes.len(),
            depth: bvh.depth,
            build_time: bvh.build_time,
            scene_bytes: packed.arrays().into_iter().map(|(_, bytes)| bytes.len()).sum(),
        };
        let contents = SceneContents {
            nodes: data.allocation(packed.nodes),
            triangles: data.allocation(packed.triangles),
            shading: data.allocation(packed.shading),
            materials: data.allocation(packed.materials),
            lights: data.allocation(packed.lights),
            module: data.module(gpu::module_source()),
        };
        self.shared
            .prepared
            .set(Prepared { contents, frame, bvh: facts })
            .map_err(|_| TaskError::application("the scene was prepared before"))
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        Vec::new()
    }
}

/// Makes jobs while few enough are in flight for the film to hold whatever comes early.
#[derive(Debug)]
struct RenderTask {
    cursor: Cursor,
    shared: Arc<Shared>,
}

impl RenderTask {
    fn next_jobs(&mut self) -> Vec<Box<dyn Job>> {
        let (tiles_merged, lights_merged) = {
            let film = self.shared.film();
            (film.merged_tiles(), film.merged_lights())
        };
        let most_lights = Film::max_held_splats(self.shared.plan.size()) as u64;
        let mut jobs: Vec<Box<dyn Job>> = Vec::new();
        loop {
            // A tile's first layer never waits in the film. Of later ones in flight one has its turn; the film holds at most
            // the rest.
            let tiles_out = self.cursor.tiles_out();
            let tile_room = tiles_out < u64::from(self.shared.plan.tiles())
                || tiles_out - tiles_merged < MAX_HELD_TILES as u64;
            let light_room = u64::from(self.cursor.lights_out() - lights_merged) < most_lights;
            let Some(planned) = self.cursor.next(tile_room, light_room) else { return jobs };
            let shared = Arc::clone(&self.shared);
            jobs.push(match planned {
                PlannedJob::Tile(turn, job) => Box::new(RenderTile { turn, job, shared }),
                PlannedJob::Light(turn, job) => Box::new(RenderLight { turn, job, shared }),
            });
        }
    }
}

impl Task for RenderTask {
    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        self.next_jobs()
    }

    fn more_jobs(&mut self, _progress: &TaskProgress) -> Vec<Box<dyn Job>> {
        self.next_jobs()
    }

    fn finish(&mut self) -> Result<(), TaskError> {
        let progress = self.shared.film().progress();
        if progress.is_complete() {
            return Ok(());
        }
        Err(TaskError::application(format!(
            "the image is not complete: {} of {} samples, {} of {} light paths",
            progress.samples, progress.total_samples, progress.light_paths, progress.total_light_paths
        )))
    }
}

/// Eye samples of a tile.
#[derive(Debug)]
struct RenderTile {
    turn: TileTurn,
    job: TileJob,
    shared: Arc<Shared>,
}

impl Job for RenderTile {
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        let prepared = self.shared.prepared()?;
        self.job.program(&prepared.contents, &prepared.frame, cmd)
    }

    fn retrieve(&mut self, result: JobResult) -> Result<(), RetrieveError> {
        let layer = self.job.decode(&result.sections).map_err(RetrieveError::application)?;
        self.shared.film().add_tile(self.turn, layer).map_err(RetrieveError::application)
    }
}

/// A range of light paths.
#[derive(Debug)]
struct RenderLight {
    turn: u32,
    job: LightJob,
    shared: Arc<Shared>,
}

impl Job for RenderLight {
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        let prepared = self.shared.prepared()?;
        self.job.program(&prepared.contents, &prepared.frame, cmd)
    }

    fn retrieve(&mut self, result: JobResult) -> Result<(), RetrieveError> {
        let prepared = self.shared.prepared().map_err(RetrieveError::application)?;
        let layer = self.job.decode(&prepared.frame, &result.sections).map_err(RetrieveError::application)?;
        self.shared.film().add_splats(self.turn, layer).map_err(RetrieveError::application)
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::{
        gpu::{Counters, FirstHit, PixelSum, SplatLayer, TileLayer},
        scene::model::Camera,
    };

    fn scene() -> Scene {
        let camera = Camera { eye: Vec3::Z, target: Vec3::ZERO, up: Vec3::Y, hfov_deg: 40.0 };
        let film = FilmSize::new(64, 48).unwrap();
        Scene { film, camera, triangles: Vec::new(), materials: Vec::new(), environment: Some(Vec3::ONE) }
    }

    fn render_task(width: u32, height: u32, spp: u32) -> RenderTask {
        let plan = RenderPlan::new(FilmSize::new(width, height).unwrap(), spp, 1, LightImage::Traced);
        let shared = Arc::new(Shared { plan, film: Mutex::new(Film::new(plan)), prepared: OnceLock::new() });
        RenderTask { cursor: Cursor::new(plan), shared }
    }

    fn tile_layer(job: &TileJob) -> TileLayer {
        let pixels = (job.width_px * job.height_px) as usize;
        TileLayer {
            x_px: job.x_px,
            y_px: job.y_px,
            width_px: job.width_px,
            height_px: job.height_px,
            pixels: vec![PixelSum { count: job.samples, ..PixelSum::default() }; pixels],
            first_hits: vec![FirstHit::default(); pixels],
            counters: Counters::default(),
        }
    }

    #[test]
    fn requests_out_of_range_are_refused() {
        let size = FilmSize { width_px: 64, height_px: 64 };
        for spp in [0, MAX_SAMPLES_PER_PIXEL + 1] {
            let error = render_graph(scene(), RenderOptions::new(size, spp, 1)).unwrap_err();
            assert_eq!(error, RenderError::Samples { spp });
        }
        for size in
            [FilmSize { width_px: 0, height_px: 64 }, FilmSize { width_px: 16_000, height_px: 16_000 }]
        {
            let error = render_graph(scene(), RenderOptions::new(size, 1, 1)).unwrap_err();
            assert!(matches!(error, RenderError::Frame(FrameError::Size { .. })), "{error}");
        }
    }

    #[test]
    fn a_render_is_two_tasks_and_an_empty_film() {
        let size = FilmSize::new(200, 100).unwrap();
        let (graph, handle) = render_graph(scene(), RenderOptions::new(size, 8, 1)).unwrap();
        assert!(format!("{graph:?}").contains("(\"render\", \"bvh\")"), "{graph:?}");
        let progress = handle.progress();
        assert_eq!(
            (progress.samples, progress.total_samples, progress.total_light_paths),
            (0, 160_000, 160_000)
        );
        assert_eq!(handle.bvh(), None);
        assert!(handle.image().beauty.iter().all(|pixel| *pixel == [0.0; 3]), "nothing is black, not NaN");
        let options =
            gpu::RenderOptions { integrator: Integrator::PathTracing, ..gpu::RenderOptions::default() };
        let options = RenderOptions { integrator: options, ..RenderOptions::new(size, 8, 1) };
        let (_, handle) = render_graph(scene(), options).unwrap();
        assert_eq!(handle.plan().light_jobs(), 0);
    }

    #[test]
    fn jobs_come_in_a_window_that_the_film_can_hold_in_any_order() {
        // One tile of 1,600 slices: the worst case for a film, as every job waits for the one before.
        let mut task = render_task(8, 8, 256 * 1_600);
        let plan = task.shared.plan;
        assert_eq!((plan.tiles(), plan.slices()), (1, 1_600));
        let (mut tile, mut light) = (0, 0);
        let mut rounds = 0;
        loop {
            let jobs = task.next_jobs().len();
            if jobs == 0 {
                break;
            }
            rounds += 1;
            assert!(jobs <= MAX_HELD_TILES + 16, "{jobs} jobs at once");
            // The newest results come first.
            for number in (tile..task.cursor.tiles_out()).rev() {
                let (turn, job) = plan.tile_job(number);
                task.shared
                    .film()
                    .add_tile(turn, tile_layer(&job))
                    .expect("the window is what the film holds");
            }
            for number in (light..task.cursor.lights_out()).rev() {
                let paths = plan.light_job(number).paths;
                let (rgb, counters) = (vec![[0.0; 3]; 64], Counters::default());
                let layer = SplatLayer { width_px: 8, height_px: 8, rgb, paths, counters };
                task.shared.film().add_splats(number, layer).expect("the window is what the film holds");
            }
            (tile, light) = (task.cursor.tiles_out(), task.cursor.lights_out());
        }
        assert!(rounds > 3, "1,600 jobs do not fit into {rounds} windows");
        task.finish().expect("every job was made and merged");
    }

    #[test]
    fn first_layers_go_out_at_once_and_later_ones_wait_for_room() {
        // 540 tiles of one layer: the coordinator sees the whole image in one batch.
        assert_eq!(render_task(1_920, 1_152, 64).next_jobs().len(), 540 + 16);
        let mut task = render_task(1_920, 1_152, 512);
        let plan = task.shared.plan;
        assert_eq!((plan.tiles(), plan.slices()), (540, 2));
        task.next_jobs();
        assert_eq!(task.cursor.tiles_out(), 540);
        let (turn, job) = plan.tile_job(539);
        task.shared.film().add_tile(turn, tile_layer(&job)).unwrap();
        assert!(task.next_jobs().is_empty(), "539 that are not there yet leave no room");
        for number in 0..40 {
            let (turn, job) = plan.tile_job(number);
            task.shared.film().add_tile(turn, tile_layer(&job)).unwrap();
        }
        task.next_jobs();
        assert_eq!(task.cursor.tiles_out() - 41, MAX_HELD_TILES as u64);
    }

    #[test]
    fn an_image_that_is_not_complete_is_no_success() {
        let mut task = render_task(64, 64, 4);
        let error = task.finish().unwrap_err().to_string();
        assert!(error.contains("0 of 16384 samples"), "{error}");
    }

    #[test]
    fn a_job_before_its_scene_is_an_error() {
        let mut task = render_task(64, 64, 4);
        for mut job in task.next_jobs() {
            let error = job.dispatch(&mut JobProgram::default()).unwrap_err();
            assert!(error.to_string().contains("must run after"), "{error}");
        }
    }
}
