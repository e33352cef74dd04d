//! The jobs of the benches: nothing at all, or so much time on a simulated device. Each tells its bench when it came back.

use std::time::{Duration, Instant};

use client_sdk::{
    Content, CostNs, DispatchError, Job, JobProgram, JobResult, Requirements, RetrieveError, Task, TaskData,
    TaskError, TaskProgress,
};
use tokio::sync::mpsc::UnboundedSender;

/// A launch needs a kernel; simulated devices do not look into it.
const MODULE: &str = "@compute @workgroup_size(1) fn sleep() {}\n";

/// What jobs of unknown duration say they cost: the same of each.
pub(super) const UNKNOWN: Hint = Hint::Constant(CostNs(50_000_000));

/// A result, as the application saw it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Retrieved {
    /// Which of the bench's applications.
    pub app: usize,
    /// When.
    pub at: Instant,
    /// Since the job was dispatched.
    pub round_trip: Duration,
    /// Charged to the application.
    pub device_time: Duration,
}

/// Where a bench hears of results. Bounded by the jobs it makes.
pub(super) type Results = UnboundedSender<Retrieved>;

/// What jobs say of their cost before they run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Hint {
    /// The truth.
    Exact,
    /// The same of every job: the scheduler has no prior knowledge (thesis 5.6.3).
    Constant(CostNs),
}

/// A fixed list of jobs, all there from the start.
pub(super) struct List {
    app: usize,
    /// How long each runs on a device of speed 1.
    durations: Vec<CostNs>,
    hint: Hint,
    results: Option<Results>,
    module: Option<Content>,
}

impl List {
    /// Jobs that take time.
    pub(super) const fn new(durations: Vec<CostNs>, hint: Hint) -> Self {
        Self { app: 0, durations, hint, results: None, module: None }
    }

    /// The same, telling of each result as application `app`.
    pub(super) fn telling(self, app: usize, results: Results) -> Self {
        Self { app, results: Some(results), ..self }
    }
}

impl Task for List {
    fn prepare(&mut self, data: &mut TaskData) -> Result<(), TaskError> {
        self.module = Some(data.module(MODULE));
        Ok(())
    }

    fn requirements(&self) -> Requirements {
        Requirements::ANY
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        let job = |duration: CostNs| {
            let work = self.module.map(|module| Work { module, duration, hint: self.hint });
            let job = BenchJob { app: self.app, work, dispatched: None, results: self.results.clone() };
            Box::new(job) as Box<dyn Job>
        };
        std::mem::take(&mut self.durations).into_iter().map(job).collect()
    }
}

/// Jobs that do nothing, all there from the start.
pub(super) struct Flood {
    /// How many.
    pub jobs: usize,
}

impl Task for Flood {
    fn requirements(&self) -> Requirements {
        Requirements::ANY
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        (0..self.jobs).map(|_| no_op(0, None)).collect()
    }
}

/// Jobs that do nothing, one at a time, each made when the one before is back.
pub(super) struct Chain {
    /// How many are still to come.
    pub left: usize,
    /// Hears of each.
    pub results: Results,
}

impl Chain {
    fn next(&mut self) -> Vec<Box<dyn Job>> {
        if self.left == 0 {
            return Vec::new();
        }
        self.left -= 1;
        vec![no_op(0, Some(self.results.clone()))]
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

/// Jobs that do nothing without end: as many as the window holds, until the run is stopped.
pub(super) struct Stream {
    /// Jobs made at a time.
    pub batch: usize,
    /// Which of the bench's applications.
    pub app: usize,
    /// Hears of each.
    pub results: Results,
}

impl Task for Stream {
    fn requirements(&self) -> Requirements {
        Requirements::ANY
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        (0..self.batch).map(|_| no_op(self.app, Some(self.results.clone()))).collect()
    }

    fn more_jobs(&mut self, _progress: &TaskProgress) -> Vec<Box<dyn Job>> {
        self.jobs()
    }
}

fn no_op(app: usize, results: Option<Results>) -> Box<dyn Job> {
    Box::new(BenchJob { app, work: None, dispatched: None, results })
}

/// One job of any of them.
struct BenchJob {
    app: usize,
    /// A job without work has an empty program.
    work: Option<Work>,
    dispatched: Option<Instant>,
    results: Option<Results>,
}

#[derive(Clone, Copy)]
struct Work {
    module: Content,
    duration: CostNs,
    hint: Hint,
}

impl Job for BenchJob {
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        self.dispatched = Some(Instant::now());
        if let Some(work) = self.work {
            let sleep = cmd.function(work.module, "sleep");
            cmd.launch_with_cost(sleep, [1, 1, 1], work.duration)?;
        }
        Ok(())
    }

    fn retrieve(&mut self, result: JobResult) -> Result<(), RetrieveError> {
        if let Some(results) = &self.results {
            let at = Instant::now();
            let round_trip = self.dispatched.map_or(Duration::ZERO, |dispatched| at - dispatched);
            // A bench that has seen enough does not listen any more.
            let _ =
                results.send(Retrieved { app: self.app, at, round_trip, device_time: result.device_time });
        }
        Ok(())
    }

    fn cost(&self) -> CostNs {
        match self.work {
            Some(Work { hint: Hint::Constant(cost), .. }) => cost,
            Some(Work { hint: Hint::Exact, .. }) | None => CostNs(0),
        }
    }
}
