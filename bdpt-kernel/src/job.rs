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
        self, FrameError, FrameParams, Integrator, LightJob, NormalisedScene, PackedScene, SceneContents, TileJob,
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
        self.prepared
            .get()
            .ok_or_else(|| DispatchError::Application(format!("task `{RENDER_TASK}` must run after `{BVH_TASK}`")))
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
        let scene = self.scene.take().ok_or_else(|| TaskError::application("the scene was prepared before"))?;
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
            // One of those in flight has its turn; the film holds at most the rest.
            let tile_room = self.cursor.tiles_out() - tiles_merged < MAX_HELD_TILES as u64;
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
