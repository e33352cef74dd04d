//! The null model as an application of the farm: a task of one job that scores the alignment as it is, and one of jobs
//! over ranges of iterations after it.
//!
//! Owns how iterations become jobs and how results are summed. What a job computes is `gpu`'s. Never knows where a job
//! runs; integer sums make that invisible in the result.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    iter,
    ops::Range,
    sync::{
        Arc, Mutex, MutexGuard, OnceLock, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use client_sdk::{
    Content, DispatchError, Job, JobProgram, JobResult, NodeId, Requirements, RetrieveError,
    SimulatedDevices, Task, TaskData, TaskError, TaskGraph, TaskProgress,
};
use thiserror::Error;

use crate::{
    Accumulators, Alignment, NullModelError, PairSums, Reference, ReferenceError, Seed,
    gpu::{AlignmentContents, MiJob, PAIR_BYTES, PackedAlignment, Pass, Shape, ShapeError, module_source},
    pair_count,
};

/// Name of the task that scores the alignment as it is.
pub const OBSERVED_TASK: &str = "observed";
/// Name of the task of the null model.
pub const NULL_TASK: &str = "null";

/// Most iterations of one run.
pub const MAX_ITERATIONS: u64 = 10_000_000;

/// Most bytes of results of jobs in flight and of sums that wait for those of the other pairs, apart from the jobs that always are.
/// Results wait in the nodes' spools: what the application holds of them is bounded by its `Window`.
const FLIGHT_BYTES: u64 = 8 << 30;
/// The same until the first results say how long an iteration takes.
const FIRST_FLIGHT_BYTES: u64 = 2 << 30;
/// Most jobs in flight.
const FLIGHT_JOBS: u64 = 256;
/// Counts (pairs times sequences times iterations) of a job, where the run is long enough: two seconds of an H200.
const JOB_COUNTS: u64 = 2_000_000_000_000;
/// Jobs that a run has at least, where it has as many iterations.
const LEAST_JOBS: u64 = 64;
/// Most iterations of a job.
const JOB_ITERATIONS: u64 = 256;
/// Most commands that a job's iterations make; `gpu::MiJob` checks the same.
const JOB_COMMANDS: u64 = 3_500;
/// Most bytes of a job's matrices.
const JOB_MATRIX_BYTES: u64 = 256 << 20;
/// Bytes of sums that a device makes in a second at most, where a job may be that long: some five devices together fill
/// what an application takes (about 500 MB/s).
const SUMS_BYTES_PER_S: f64 = 80e6;
/// A job has at most this share of the iterations left, and a run's last ones this share of the others' length: devices that
/// end at different times wait for a short job. Where results are large, twice what devices make else is the most.
const LEFT_SHARE: u64 = 8;
const SHORT_SHARE: u64 = 8;
const SHORT_LARGE_SHARE: u64 = 2;

/// What jobs bring back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Sums over a job's iterations.
    Reduce,
    /// Every iteration's matrix, as the thesis has it; the sums are the host's. The same final bytes.
    Matrix,
}

/// How long jobs are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JobLengths {
    /// By what an iteration was measured to take so far.
    Measured,
    /// The same jobs in each run of the same options: what a journal needs to know them again.
    Fixed,
}

/// What to compute of an alignment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MiOptions {
    /// Iterations of the null model in the end, 0..=10,000,000: those with numbers 0..iterations.
    pub iterations: u64,
    /// The same seed gives the same result.
    pub seed: Seed,
    /// What jobs bring back.
    pub mode: Mode,
    /// How iterations become jobs.
    pub lengths: JobLengths,
    /// Sums of an earlier run; the iterations in them are not computed again.
    pub earlier: Option<Accumulators>,
    /// Accepted only where the result does not matter, as in a bench of the farm: it is zeros then.
    pub simulated: SimulatedDevices,
}

/// A run that cannot start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum MiError {
    /// Too many iterations.
    #[error("{iterations} iterations: at most {MAX_ITERATIONS}")]
    Iterations {
        /// What was asked for.
        iterations: u64,
    },
    /// The earlier sums hold iterations that were not asked for.
    #[error("the earlier sums hold iteration {held} (counted from 0), past the {iterations} asked for")]
    Earlier {
        /// The last iteration held, from 0.
        held: u64,
        /// What was asked for.
        iterations: u64,
    },
    /// The earlier sums are of another number of columns.
    #[error("the earlier sums are of another alignment")]
    OtherSums,
    /// An alignment that devices cannot hold.
    #[error(transparent)]
    Shape(#[from] ShapeError),
    /// An alignment that the fixed point cannot hold.
    #[error(transparent)]
    Reference(#[from] ReferenceError),
}

/// A view of a run from outside.
#[derive(Clone, Debug)]
pub struct MiHandle {
    shared: Arc<Shared>,
}

impl MiHandle {
    /// Iterations in the sums so far, those of an earlier run included. Never waits.
    #[must_use]
    pub fn iterations_done(&self) -> u64 {
        self.shared.iterations_done.load(Ordering::Relaxed)
    }

    /// Nodes that results came from.
    #[must_use]
    pub fn nodes(&self) -> BTreeSet<NodeId> {
        self.shared.nodes.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Observed scores, once they are there.
    #[must_use]
    pub fn observed(&self) -> Option<Vec<i32>> {
        self.shared.observed.get().cloned()
    }

    /// Iterations in the sums so far, and the pair with the highest Z in them (columns' numbers in the input); a pass over all
    /// pairs, in which no result is taken.
    #[must_use]
    pub fn leading(&self) -> Option<(usize, [usize; 2], f64)> {
        let observed = self.shared.observed.get()?;
        let sums = self.shared.sums();
        let (pair, z) = sums.leading(observed)?;
        let number = |column| self.shared.alignment.number(column);
        Some((sums.iterations(), [number(pair.i), number(pair.j)], z))
    }

    /// The sums of what has come so far: complete after the run, valid at any time.
    #[must_use]
    pub fn sums(&self) -> Accumulators {
        self.shared.sums().clone()
    }
}

/// The tasks of a run, and a handle on its sums.
///
/// # Errors
/// The alignment or the options are out of range.
pub fn mi_graph(alignment: Arc<Alignment>, options: MiOptions) -> Result<(TaskGraph, MiHandle), MiError> {
    let shape = Shape::new(&alignment)?;
    Reference::unscored(&alignment)?;
    let MiOptions { iterations, seed, mode, lengths, earlier, simulated } = options;
    if iterations > MAX_ITERATIONS {
        return Err(MiError::Iterations { iterations });
    }
    let sums = earlier.unwrap_or_else(|| Accumulators::new(alignment.l()));
    if sums.sum().len() != pair_count(alignment.l()) {
        return Err(MiError::OtherSums);
    }
    if let Some((held, _)) = sums.maxima().last_key_value().filter(|(held, _)| **held >= iterations) {
        return Err(MiError::Earlier { held: *held, iterations });
    }
    let lengths = Lengths::new(&shape, mode, lengths, iterations);
    let remaining = Remaining::new(&sums, iterations);
    let earlier = sums.iterations() as u64;
    let shared = Arc::new(Shared {
        alignment,
        shape,
        contents: OnceLock::new(),
        observed: OnceLock::new(),
        observed_contents: OnceLock::new(),
        parts: Mutex::new(BTreeMap::new()),
        sums: Mutex::new(sums),
        iterations_done: AtomicU64::new(earlier),
        pair_iterations_done: AtomicU64::new(0),
        nodes: Mutex::new(BTreeSet::new()),
    });
    let needs = Requirements { simulated, ..Requirements::ANY };
    let observed = ObservedTask { needs, shared: Arc::clone(&shared) };
    let null = NullTask { needs, remaining, lengths, seed, mode, shared: Arc::clone(&shared) };
    let graph =
        TaskGraph::new().task(OBSERVED_TASK, observed).task(NULL_TASK, null).after(NULL_TASK, OBSERVED_TASK);
    Ok((graph, MiHandle { shared }))
}

/// How many iterations a job gets, and how many jobs are in flight.
#[derive(Clone, Copy, Debug)]
struct Lengths {
    mode: Mode,
    by: JobLengths,
    /// Of all jobs over the same iterations.
    pairs: u64,
    /// Jobs over the same iterations, each of a part of the pairs.
    parts: u64,
    /// Of the largest part.
    part_pairs: u64,
    /// While nothing is known of the devices: long enough for a fast one, short enough that many share the run.
    first: u64,
    most: u64,
}

impl Lengths {
    fn new(shape: &Shape, mode: Mode, by: JobLengths, iterations: u64) -> Self {
        let pairs = shape.pairs() as u64;
        let parts = parts_of(shape, mode);
        let chunks = parts.iter().map(Range::len).max().unwrap_or(1) as u64;
        let part_pairs = parts.iter().map(|part| shape.pairs_of(part.clone())).max().unwrap_or(1) as u64;
        let parts = parts.len() as u64;
        let long = JOB_COUNTS / (part_pairs * u64::from(shape.rows())).max(1);
        let commands = JOB_COMMANDS / (4 + 3 * chunks);
        let held = match mode {
            Mode::Reduce => JOB_ITERATIONS,
            Mode::Matrix => JOB_MATRIX_BYTES / (pairs * 4),
        };
        let most = JOB_ITERATIONS.min(commands).min(held).max(1);
        let first = long.min((iterations * parts).div_ceil(LEAST_JOBS)).clamp(1, most);
        Self { mode, by, pairs, parts, part_pairs, first, most }
    }

    /// Iterations of the next job, `left` being without one. `iteration_s` is what one took so far: where sums are large
    /// and devices fast, jobs are so long that the application keeps up with their results.
    #[expect(
        clippy::cast_precision_loss,
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a length that is bounded right after; `as` saturates"
    )]
    fn next(&self, left: u64, iteration_s: Option<f64>) -> u64 {
        let by_result = match (self.mode, self.by, iteration_s) {
            (Mode::Reduce, JobLengths::Measured, Some(iteration_s)) => {
                (self.pairs as f64 * PAIR_BYTES as f64 / (SUMS_BYTES_PER_S * iteration_s)) as u64
            }
            _ => 0,
        };
        let full = self.first.max(by_result).min(self.most);
        let short = self.first.div_ceil(SHORT_SHARE).max(by_result.min(self.most) / SHORT_LARGE_SHARE);
        full.min((left * self.parts).div_ceil(LEFT_SHARE)).max(short)
    }

    /// Bytes of one job's result.
    fn result_bytes(&self, iterations: u64) -> u64 {
        match self.mode {
            Mode::Reduce => self.part_pairs * PAIR_BYTES,
            Mode::Matrix => self.pairs * 4 * iterations,
        }
    }

    /// How many jobs of so many iterations may be in flight.
    fn in_flight(&self, iterations: u64, measured: bool) -> u64 {
        let bytes = if measured { FLIGHT_BYTES } else { FIRST_FLIGHT_BYTES };
        (bytes / self.result_bytes(iterations).max(1)).clamp(2.max(self.parts), FLIGHT_JOBS)
    }
}

/// The chunks of each job over the same iterations. Matrices are not split: their bytes are the same however they are.
fn parts_of(shape: &Shape, mode: Mode) -> Vec<Range<usize>> {
    match mode {
        Mode::Reduce => shape.parts(),
        Mode::Matrix => iter::once(0..shape.chunks().len()).collect(),
    }
}

/// The iterations that no job has yet, in order.
#[derive(Debug)]
struct Remaining {
    ranges: VecDeque<Range<u64>>,
}

impl Remaining {
    /// Those of `0..iterations` that are not in the sums.
    fn new(sums: &Accumulators, iterations: u64) -> Self {
        let held = sums.maxima().keys().copied();
        let starts = iter::once(0).chain(held.clone().map(|held| held + 1));
        let ranges = starts.zip(held.chain([iterations])).map(|(start, end)| start..end);
        Self { ranges: ranges.filter(|range| !range.is_empty()).collect() }
    }

    fn left(&self) -> u64 {
        self.ranges.iter().map(|range| range.end - range.start).sum()
    }

    /// At most so many iterations, one after the other.
    fn take(&mut self, most: u64) -> Option<Range<u64>> {
        let range = self.ranges.front_mut()?;
        let taken = range.start..range.end.min(range.start + most);
        range.start = taken.end;
        if range.is_empty() {
            self.ranges.pop_front();
        }
        Some(taken)
    }
}

/// What the jobs, the tasks and the handle share.
#[derive(Debug)]
struct Shared {
    alignment: Arc<Alignment>,
    shape: Shape,
    contents: OnceLock<AlignmentContents>,
    observed: OnceLock<Vec<i32>>,
    observed_contents: OnceLock<Vec<Content>>,
    /// Sums of some of the pairs, by the first iteration that they are of, until those of the others are there: what a run is
    /// stopped with has to be of the same iterations for all pairs. Jobs of the same iterations are dispatched together, and new
    /// ones only while those that wait and those in flight come to a bounded number of bytes. Held for one insertion.
    parts: Mutex<BTreeMap<u64, Vec<PairSums>>>,
    /// A lock, not an owner with messages: jobs are retrieved on the run's own threads and must know that their sums
    /// were taken before they say so; the handle reads between two of them. Held for one merge or one copy.
    sums: Mutex<Accumulators>,
    /// Of the sums, for who must not wait for them.
    iterations_done: AtomicU64,
    /// Iterations times pairs that jobs of this run brought, in the sums or not yet.
    pair_iterations_done: AtomicU64,
    /// As `sums`; held for one insertion.
    nodes: Mutex<BTreeSet<NodeId>>,
}

impl Shared {
    fn sums(&self) -> MutexGuard<'_, Accumulators> {
        self.sums.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a job's sums.
    fn take(&self, range: Range<u64>, sums: PairSums) -> Result<(), NullModelError> {
        let iterations = range.end - range.start;
        self.pair_iterations_done.fetch_add(iterations * sums.pairs() as u64, Ordering::Relaxed);
        let all = {
            let mut parts = self.parts.lock().unwrap_or_else(PoisonError::into_inner);
            let there = parts.entry(range.start).or_default();
            there.push(sums);
            let complete = there.iter().map(PairSums::pairs).sum::<usize>() >= self.shape.pairs();
            if complete { parts.remove(&range.start) } else { None }
        };
        if let Some(all) = all {
            self.sums().merge_parts(all)?;
            self.iterations_done.fetch_add(iterations, Ordering::Relaxed);
        }
        Ok(())
    }

    /// Results whose sums wait for those of the other pairs.
    fn waiting_parts(&self) -> u64 {
        let parts = self.parts.lock().unwrap_or_else(PoisonError::into_inner);
        parts.values().map(|there| there.len() as u64).sum()
    }

    fn contents(&self) -> Result<&AlignmentContents, DispatchError> {
        self.contents.get().ok_or_else(|| out_of_order(OBSERVED_TASK))
    }

    fn note(&self, node: NodeId) {
        self.nodes.lock().unwrap_or_else(PoisonError::into_inner).insert(node);
    }
}

fn out_of_order(task: &str) -> DispatchError {
    DispatchError::Application(format!("task `{task}` has not run"))
}

/// Packs the alignment and scores it as it is.
#[derive(Debug)]
struct ObservedTask {
    needs: Requirements,
    shared: Arc<Shared>,
}

impl Task for ObservedTask {
    fn requirements(&self) -> Requirements {
        self.needs
    }

    fn prepare(&mut self, data: &mut TaskData) -> Result<(), TaskError> {
        let reference = Reference::unscored(&self.shared.alignment).map_err(TaskError::application)?;
        let packed = PackedAlignment::new(&reference, &self.shared.shape);
        let contents = AlignmentContents {
            codes: data.allocation(packed.codes),
            orders: packed.orders.into_iter().map(|order| data.allocation(order)).collect(),
            bounds: data.allocation(packed.bounds),
            table: data.allocation(packed.table),
            column_terms: data.allocation(packed.column_terms),
            module: data.module(module_source(&self.shared.shape)),
        };
        self.shared
            .contents
            .set(contents)
            .map_err(|_| TaskError::application("the alignment was packed before"))
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        vec![Box::new(ObservedJob { shared: Arc::clone(&self.shared) })]
    }
}

#[derive(Debug)]
struct ObservedJob {
    shared: Arc<Shared>,
}

/// Nothing is drawn: the seed does not matter.
const OBSERVED: MiJob = MiJob { seed: Seed(0), pass: Pass::Observed };

impl Job for ObservedJob {
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        OBSERVED.program(&self.shared.shape, self.shared.contents()?, &[], cmd)
    }

    fn retrieve(&mut self, result: JobResult) -> Result<(), RetrieveError> {
        let scores =
            OBSERVED.scores(&self.shared.shape, &result.sections).map_err(RetrieveError::application)?;
        self.shared.note(result.node);
        let scores = scores.into_iter().next().unwrap_or_default();
        self.shared.observed.set(scores).map_err(|_| RetrieveError::application("scored twice"))
    }
}

/// The iterations.
#[derive(Debug)]
struct NullTask {
    needs: Requirements,
    remaining: Remaining,
    lengths: Lengths,
    seed: Seed,
    mode: Mode,
    shared: Arc<Shared>,
}

impl NullTask {
    fn next_jobs(&mut self, progress: &TaskProgress) -> Vec<Box<dyn Job>> {
        let iteration_s = self.iteration_s(progress);
        let parts = parts_of(&self.shared.shape, self.mode);
        let mut in_flight = progress.jobs_known - progress.jobs_done + self.shared.waiting_parts();
        let mut jobs: Vec<Box<dyn Job>> = Vec::new();
        let mut left = self.remaining.left();
        while left > 0 {
            let length = self.lengths.next(left, iteration_s);
            if in_flight + parts.len() as u64 > self.lengths.in_flight(length, iteration_s.is_some()) {
                break;
            }
            let Some(range) = self.remaining.take(length) else { break };
            left -= range.end - range.start;
            in_flight += parts.len() as u64;
            jobs.extend(parts.iter().map(|chunks| -> Box<dyn Job> {
                let (iterations, chunks) = (range.clone(), chunks.clone());
                let pass = match self.mode {
                    Mode::Reduce => Pass::Reduce { iterations, chunks },
                    Mode::Matrix => Pass::Matrix(iterations),
                };
                let job = MiJob { seed: self.seed, pass };
                Box::new(NullJob { job, shared: Arc::clone(&self.shared) })
            }));
        }
        jobs
    }

    /// Measured device time of one iteration, over all devices.
    #[expect(clippy::cast_precision_loss, reason = "a mean")]
    fn iteration_s(&self, progress: &TaskProgress) -> Option<f64> {
        let done =
            self.shared.pair_iterations_done.load(Ordering::Relaxed) as f64 / self.lengths.pairs as f64;
        let mean_s = progress.device_time.as_secs_f64() / done;
        (done > 0.0 && mean_s > 0.0).then_some(mean_s)
    }
}

impl Task for NullTask {
    fn requirements(&self) -> Requirements {
        self.needs
    }

    fn prepare(&mut self, data: &mut TaskData) -> Result<(), TaskError> {
        let observed =
            self.shared.observed.get().ok_or_else(|| TaskError::application("nothing was scored"))?;
        let contents = self
            .shared
            .shape
            .observed_bytes(observed)
            .into_iter()
            .map(|bytes| data.allocation(bytes))
            .collect();
        self.shared
            .observed_contents
            .set(contents)
            .map_err(|_| TaskError::application("the scores were named before"))
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        self.next_jobs(&TaskProgress::default())
    }

    fn more_jobs(&mut self, progress: &TaskProgress) -> Vec<Box<dyn Job>> {
        self.next_jobs(progress)
    }
}

#[derive(Debug)]
struct NullJob {
    job: MiJob,
    shared: Arc<Shared>,
}

impl Job for NullJob {
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        let observed = self.shared.observed_contents.get().ok_or_else(|| out_of_order(OBSERVED_TASK))?;
        self.job.program(&self.shared.shape, self.shared.contents()?, observed, cmd)
    }

    fn retrieve(&mut self, result: JobResult) -> Result<(), RetrieveError> {
        let observed =
            self.shared.observed.get().ok_or_else(|| RetrieveError::application("nothing was scored"))?;
        let sums = self
            .job
            .sums(&self.shared.shape, observed, &result.sections)
            .map_err(RetrieveError::application)?;
        self.shared.note(result.node);
        self.shared.take(self.job.iterations(), sums).map_err(RetrieveError::application)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{NullModel, ShuffleKind, parse};

    fn options(iterations: u64, earlier: Option<Accumulators>) -> MiOptions {
        MiOptions {
            iterations,
            seed: Seed(1),
            mode: Mode::Reduce,
            lengths: JobLengths::Measured,
            earlier,
            simulated: SimulatedDevices::Refused,
        }
    }

    #[test]
    fn what_is_missing_is_computed_once() {
        let alignment = Arc::new(parse(b"ACA\nACC\nGTA\nGTC\n").unwrap().alignment);
        let reference = Reference::new(&alignment).unwrap();
        let null = NullModel::new(&reference, Seed(1), ShuffleKind::Feistel);
        let mut sums = null.run(0..3).unwrap();
        sums.merge(null.run(7..8).unwrap()).unwrap();
        let ranges = |iterations| Remaining::new(&sums, iterations).ranges;
        assert_eq!(ranges(12), [3..7, 8..12]);
        assert_eq!(ranges(8).into_iter().flatten().collect::<Vec<_>>(), [3, 4, 5, 6]);
        let mut remaining = Remaining::new(&sums, 12);
        assert_eq!(remaining.left(), 8);
        let taken: Vec<_> = iter::from_fn(|| remaining.take(3)).collect();
        assert_eq!(taken, [3..6, 6..7, 8..11, 11..12]);
        let error = mi_graph(Arc::clone(&alignment), options(7, Some(sums.clone()))).unwrap_err();
        assert_eq!(error, MiError::Earlier { held: 7, iterations: 7 });
        let error = mi_graph(Arc::clone(&alignment), options(7, Some(Accumulators::new(9)))).unwrap_err();
        assert_eq!(error, MiError::OtherSums);
        let (_, handle) = mi_graph(alignment, options(12, Some(sums))).unwrap();
        assert_eq!(handle.iterations_done(), 4);
    }

    #[test]
    fn iterations_count_once_the_sums_of_all_their_pairs_are_there() {
        let alignment = Arc::new(parse(b"ACA\nACC\nGTA\nGTC\n").unwrap().alignment);
        let reference = Reference::new(&alignment).unwrap();
        let null = NullModel::new(&reference, Seed(1), ShuffleKind::Feistel);
        let (_, handle) = mi_graph(Arc::clone(&alignment), options(5, None)).unwrap();
        let part = |iterations: Range<u64>, places: Range<usize>| {
            let all = null.run(iterations.clone()).unwrap();
            let (sum, squares) =
                (all.sum()[places.clone()].to_vec(), all.sum_of_squares()[places.clone()].to_vec());
            let reached = all.at_least_observed()[places.clone()].to_vec();
            // As a job would know them: over its own pairs.
            let maxima = iterations.clone().map(|iteration| {
                (iteration, null.scores(iteration)[places.clone()].iter().copied().max().unwrap())
            });
            let part =
                PairSums::new(alignment.l(), places.start, sum, squares, reached, maxima.collect()).unwrap();
            handle.shared.take(iterations, part)
        };
        part(2..5, 1..3).unwrap();
        part(0..2, 0..1).unwrap();
        assert_eq!((handle.iterations_done(), handle.sums().iterations()), (0, 0), "none is complete");
        part(2..5, 0..1).unwrap();
        assert_eq!((handle.iterations_done(), handle.sums() == null.run(2..5).unwrap()), (3, true));
        part(0..2, 1..3).unwrap();
        assert_eq!((handle.iterations_done(), handle.sums() == null.run(0..5).unwrap()), (5, true));
        part(0..2, 0..1).unwrap();
        assert_eq!(part(0..2, 1..3).unwrap_err(), NullModelError::Doubled { iteration: 0 });
    }

    #[test]
    fn sums_that_wait_for_other_pairs_count_as_in_flight() {
        let columns = "AC".repeat(1_350);
        let alignment = Arc::new(parse(format!("{columns}\n{columns}\n").as_bytes()).unwrap().alignment);
        let (_, handle) = mi_graph(alignment, options(100_000, None)).unwrap();
        let shared = Arc::clone(&handle.shared);
        assert_eq!(shared.shape.parts().len(), 2);
        let mut task = NullTask {
            needs: Requirements::ANY,
            remaining: Remaining::new(&handle.sums(), 100_000),
            lengths: Lengths::new(&shared.shape, Mode::Reduce, JobLengths::Fixed, 100_000),
            seed: Seed(1),
            mode: Mode::Reduce,
            shared: Arc::clone(&shared),
        };
        let jobs = task.next_jobs(&TaskProgress::default()).len() as u64;
        let progress = TaskProgress { jobs_known: jobs, jobs_done: jobs / 2, ..TaskProgress::default() };
        let part = PairSums::new(2_700, 0, Vec::new(), Vec::new(), Vec::new(), BTreeMap::new()).unwrap();
        let wait = |parts| shared.parts.lock().unwrap().insert(0, vec![part.clone(); parts]);
        wait(usize::try_from(jobs / 2).unwrap());
        assert!(task.next_jobs(&progress).is_empty(), "half of them are in flight, and half wait here");
        wait(0);
        assert!(!task.next_jobs(&progress).is_empty());
    }

    #[test]
    fn first_jobs_fit_the_run_and_the_program() {
        let alignment = parse(b"ACA\nACC\nGTA\nGTC\n").unwrap().alignment;
        let shape = Shape::new(&alignment).unwrap();
        for (iterations, expected) in [(0, 1), (1, 1), (64, 1), (1_000, 16), (1 << 20, 256)] {
            assert_eq!(
                Lengths::new(&shape, Mode::Reduce, JobLengths::Fixed, iterations).first,
                expected,
                "{iterations}"
            );
        }
        assert!(mi_graph(Arc::new(alignment), options(MAX_ITERATIONS + 1, None)).is_err());
    }

    #[test]
    fn jobs_are_as_long_as_their_results_are_large_and_short_at_the_end() {
        // The thesis' second set on an H200: 252 MB of sums, 44 ms an iteration.
        let by = JobLengths::Measured;
        let lengths = Lengths {
            mode: Mode::Reduce,
            by,
            pairs: 12_628_338,
            parts: 1,
            part_pairs: 12_628_338,
            first: 3,
            most: 256,
        };
        assert_eq!(lengths.next(10_000, None), 3);
        assert_eq!(lengths.next(10_000, Some(0.044)), 71);
        assert_eq!(lengths.next(400, Some(0.044)), 50);
        assert_eq!(lengths.next(1, Some(0.044)), 35);
        assert_eq!(lengths.next(10_000, Some(1e-6)), 256);
        assert_eq!(lengths.next(10_000, Some(130.0)), 3, "slow devices: results are no burden");
        let fixed = Lengths { by: JobLengths::Fixed, ..lengths };
        assert_eq!(fixed.next(10_000, Some(0.044)), 3, "the same in each run");
        let matrices = Lengths { mode: Mode::Matrix, ..lengths };
        assert_eq!(matrices.next(10_000, Some(0.044)), 3, "twice the iterations are twice the bytes");
        assert_eq!((lengths.in_flight(71, false), lengths.in_flight(71, true)), (8, 34));
        // In four parts: the same bytes, but a job has a quarter of them, and of the time.
        let parts = Lengths { parts: 4, part_pairs: 12_628_338 / 4, ..lengths };
        assert_eq!((parts.next(10_000, Some(0.044)), parts.next(400, Some(0.044))), (71, 71));
        assert_eq!((parts.in_flight(71, false), parts.in_flight(71, true)), (34, 136));
    }
}
