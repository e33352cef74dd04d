//! One run of a task graph: a thread of its own that calls the application's methods, keeps the window full and ends
//! with the first cause. It never touches a socket: batches go to the driver, results come back as events.

mod dispatch;
mod journalled;
#[cfg(test)]
mod tests;
mod window;

use std::{
    collections::{HashMap, HashSet, VecDeque},
    ops::Range,
    sync::{Arc, mpsc},
    thread,
    time::{Duration, Instant},
};

use bytes::Bytes;
use farm_core::{
    device::Requirements,
    id::{AppId, ContentHash, JobId, JobIndex, NodeId, TaskId},
    ledger::SubmittedJob,
    message::{JobFailure, WaitReason},
    program::Content,
};
use tokio::sync::{OwnedSemaphorePermit, watch};

use self::{
    dispatch::{Dispatched, catch_panic, dispatch_chunk, needs_with, retrieve},
    journalled::{Replay, RunJournal},
    window::WindowUse,
};
use crate::{
    content::{ContentStore, TaskData},
    driver::{DriverHandle, Submission},
    error::FarmError,
    graph::GraphNode,
    job::{Job, JobResult, split_sections},
    journal::{About, Journal, Keep},
    options::Window,
    progress::{Progress, RunSummary, TaskSummary},
    task::{Task, TaskError, TaskProgress},
};

/// Most jobs that are dispatched without a look at what came in.
const CHUNK_JOBS: usize = 512;
/// Most jobs of one plan request; the ledger may cut it further.
const BATCH_JOBS: usize = 4_096;
/// Programs of one batch are sent once they come to this many bytes.
const BATCH_BYTES: usize = 16 << 20;
/// Most events handled before the window is looked at again.
const EVENTS_PER_TURN: usize = 256;

const PREPARE: &str = "prepare";
const FINISH: &str = "finish";

/// What a run hears. Sent over an unbounded channel whose content is bounded by the window: at most one
/// [`Arrival`] for each outstanding job, one `Returned` for each task, and one `Ended`.
pub(crate) enum RunEvent {
    /// Jobs ended.
    Arrivals(Vec<Arrival>),
    /// A task's `prepare` or `finish` is through.
    Returned(Box<Returned>),
    /// The run is over, whatever is outstanding.
    Ended(RunEnd),
}

/// A job that ended.
#[derive(Debug)]
pub(crate) enum Arrival {
    /// With a result.
    Delivered {
        job: JobId,
        payload: Payload,
        /// Lengths in the payload.
        sections: Vec<u64>,
        device_time: Duration,
        node: NodeId,
    },
    /// Without one.
    Failed { job: JobId, failure: JobFailure },
}

/// A received result with its share of the connection's bound on unretrieved bytes.
#[derive(Debug)]
pub(crate) struct Payload {
    pub(crate) bytes: Bytes,
    /// Of the bytes.
    pub(crate) digest: ContentHash,
    pub(crate) permit: Option<OwnedSemaphorePermit>,
}

/// Why a run ends before its tasks do.
#[derive(Debug)]
pub(crate) enum RunEnd {
    /// The stop handle, or nobody waits for the run any more.
    Stopped,
    /// Jobs of a task have waited too long for a device.
    NoFittingDevice { task: TaskId, reason: WaitReason, waited: Duration },
    /// The connection to the farm cannot go on.
    Farm(FarmError),
}

/// A task back from a thread of its own.
pub(crate) struct Returned {
    at: usize,
    task: Box<dyn Task>,
    outcome: Result<Stage, FarmError>,
}

/// A run that is about to start.
pub(crate) struct Run {
    /// Ids of the graph's tasks, in order.
    pub(crate) tasks: Range<u32>,
    pub(crate) nodes: Vec<GraphNode>,
    pub(crate) window: Window,
    /// As which application it runs.
    pub(crate) app: AppId,
    /// Where results come from that an earlier process has taken, and where those go that this one takes.
    pub(crate) journal: Option<Journal>,
    pub(crate) store: ContentStore,
    pub(crate) driver: DriverHandle,
    pub(crate) progress: watch::Sender<Progress>,
    pub(crate) events: mpsc::Receiver<RunEvent>,
    /// For the threads of `prepare` and `finish`.
    pub(crate) events_sender: mpsc::Sender<RunEvent>,
}

/// Where a task stands.
enum Stage {
    /// Other tasks come first.
    Waiting,
    /// Ready; waits for a free thread to prepare on.
    Ready,
    /// On a thread of its own, in `prepare` or `finish`.
    Away,
    /// Back from `prepare`, with its data and first jobs.
    Prepared { data: TaskData, needs: Requirements, jobs: Vec<Box<dyn Job>>, took: Duration },
    /// Has jobs, or may make more.
    Active(Active),
    /// Back from `finish`.
    Done,
}

struct Active {
    needs: Requirements,
    pending: VecDeque<Box<dyn Job>>,
    next_index: u32,
    outstanding: HashMap<JobIndex, Outstanding>,
    /// Whether `more_jobs` may answer otherwise than the last time it was asked.
    ask: bool,
}

struct Outstanding {
    job: Box<dyn Job>,
    program_bytes: usize,
    /// Digest of its program, where results are kept by it.
    program: Option<ContentHash>,
}

struct TaskState {
    name: Arc<str>,
    /// `None` while it is away.
    task: Option<Box<dyn Task>>,
    stage: Stage,
    dependents: Vec<usize>,
    waits_for: usize,
    progress: TaskProgress,
    prepare_time: Duration,
}

/// The running state; lives on the run's thread.
struct Runner {
    tasks: Range<u32>,
    states: Vec<TaskState>,
    window: WindowUse,
    app: AppId,
    journal: Option<RunJournal>,
    /// Outstanding jobs whose results are in it.
    replays: VecDeque<Replay>,
    /// What the run's tasks have added, kept until the run ends.
    data: Vec<TaskData>,
    known: HashSet<Content>,
    store: ContentStore,
    driver: DriverHandle,
    progress: watch::Sender<Progress>,
    events: mpsc::Receiver<RunEvent>,
    events_sender: mpsc::Sender<RunEvent>,
    /// Wall time of one dispatch in the last chunk.
    dispatch_time: Duration,
    /// Tasks on threads of their own.
    away: usize,
    /// Jobs whose results were in the journal.
    journalled: u64,
}

impl Run {
    /// Runs the graph to its end on the calling thread, which must not belong to an async runtime.
    pub(crate) fn run(self) -> Result<RunSummary, FarmError> {
        let started = Instant::now();
        let replanned_before = self.progress.borrow().replanned;
        let state = |node: GraphNode| TaskState {
            name: node.name.into(),
            task: Some(node.task),
            stage: if node.waits_for == 0 { Stage::Ready } else { Stage::Waiting },
            dependents: node.dependents,
            waits_for: node.waits_for,
            progress: TaskProgress::default(),
            prepare_time: Duration::ZERO,
        };
        let mut runner = Runner {
            tasks: self.tasks,
            states: self.nodes.into_iter().map(state).collect(),
            window: WindowUse::new(self.window),
            app: self.app,
            journal: None,
            replays: VecDeque::new(),
            data: Vec::new(),
            known: HashSet::new(),
            store: self.store,
            driver: self.driver,
            progress: self.progress,
            events: self.events,
            events_sender: self.events_sender,
            dispatch_time: Duration::ZERO,
            away: 0,
            journalled: 0,
        };
        let uploaded_before = runner.store.served_bytes();
        let outcome = runner.open_journal(self.journal).and_then(|()| runner.run());
        // A complete run has all that it wanted, whether the last results are in the journal or not.
        let kept = runner.close_journal();
        outcome.map_err(|cause| kept.err().unwrap_or(cause))?;
        let tasks: Vec<TaskSummary> = runner.states.iter().map(TaskState::summary).collect();
        Ok(RunSummary {
            jobs: tasks.iter().map(|task| task.jobs).sum(),
            journalled: runner.journalled,
            replanned: runner.progress.borrow().replanned.saturating_sub(replanned_before),
            device_time: tasks.iter().map(|task| task.device_time).sum(),
            uploaded_bytes: runner.store.served_bytes() - uploaded_before,
            wall_time: started.elapsed(),
            tasks,
        })
    }
}

impl Runner {
    fn run(&mut self) -> Result<(), FarmError> {
        loop {
            self.start_ready_tasks()?;
            let dispatched = self.dispatch_batch()?;
            let replayed = self.replay()?;
            self.finish_idle_tasks()?;
            if self.states.iter().all(|state| matches!(state.stage, Stage::Done)) {
                return Ok(());
            }
            // A task that could still be started or has just been dispatched does not wait for an event.
            self.handle_events(if dispatched || replayed { Wait::No } else { Wait::ForOne })?;
        }
    }

    /// Sends ready tasks to threads of their own, as many as there are cores.
    fn start_ready_tasks(&mut self) -> Result<(), FarmError> {
        let most = thread::available_parallelism().map_or(1, usize::from);
        for at in 0..self.states.len() {
            if self.away >= most {
                return Ok(());
            }
            if matches!(self.states[at].stage, Stage::Ready) {
                let data = TaskData::new(self.store.clone());
                self.send_away(at, PREPARE, move |task, name| prepare(task, name, data))?;
            }
        }
        Ok(())
    }

    fn send_away(
        &mut self,
        at: usize,
        stage: &'static str,
        work: impl FnOnce(&mut dyn Task, &str) -> Result<Stage, FarmError> + Send + 'static,
    ) -> Result<(), FarmError> {
        let state = &mut self.states[at];
        let name = Arc::clone(&state.name);
        let mut task = state.task.take().expect("a task that is not away is here");
        let events = self.events_sender.clone();
        let code = move || {
            let outcome = work(task.as_mut(), &name);
            // A run that has ended meanwhile does not listen; the task is dropped here then.
            let _ = events.send(RunEvent::Returned(Box::new(Returned { at, task, outcome })));
        };
        thread::Builder::new().name(format!("gleaner-{stage}")).spawn(code).map_err(|error| {
            FarmError::Task { task: state.name.to_string(), stage, error: TaskError::application(error) }
        })?;
        if stage == PREPARE {
            let name = Arc::clone(&state.name);
            self.progress.send_modify(|progress| progress.active_tasks.push(name));
        }
        state.stage = Stage::Away;
        self.away += 1;
        Ok(())
    }

    fn returned(&mut self, returned: Returned) -> Result<(), FarmError> {
        self.away -= 1;
        let Returned { at, task, outcome } = returned;
        self.states[at].task = Some(task);
        match outcome? {
            Stage::Prepared { data, needs, jobs, took } => {
                self.known.extend(data.added());
                self.data.push(data);
                let state = &mut self.states[at];
                state.prepare_time = took;
                state.stage = Stage::Active(Active {
                    needs,
                    pending: VecDeque::new(),
                    next_index: 0,
                    outstanding: HashMap::new(),
                    ask: true,
                });
                self.add_jobs(at, jobs);
            }
            stage => {
                self.states[at].stage = stage;
                self.no_longer_active(at..at + 1);
                for dependent in self.states[at].dependents.clone() {
                    let state = &mut self.states[dependent];
                    state.waits_for -= 1;
                    if state.waits_for == 0 {
                        state.stage = Stage::Ready;
                    }
                }
            }
        }
        Ok(())
    }

    fn add_jobs(&mut self, at: usize, jobs: Vec<Box<dyn Job>>) {
        let count = jobs.len() as u64;
        let state = &mut self.states[at];
        let Stage::Active(active) = &mut state.stage else { unreachable!("only active tasks make jobs") };
        if active.pending.is_empty() {
            active.pending = jobs.into();
        } else {
            active.pending.extend(jobs);
        }
        state.progress.jobs_known += count;
        self.progress.send_modify(|progress| progress.jobs_known += count);
    }

    /// Dispatches one batch of the first task that has jobs and for which the window has room.
    fn dispatch_batch(&mut self) -> Result<bool, FarmError> {
        for at in 0..self.states.len() {
            self.ask_for_jobs(at)?;
            if self.dispatch_batch_of(at)? {
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn ask_for_jobs(&mut self, at: usize) -> Result<(), FarmError> {
        let has_room = self.window.admits(1) > 0;
        let state = &mut self.states[at];
        let Stage::Active(active) = &mut state.stage else { return Ok(()) };
        if !(active.ask && active.pending.is_empty() && has_room) {
            return Ok(());
        }
        let task = state.task.as_mut().expect("an active task is here");
        let progress = state.progress;
        let jobs = catch_panic(|| task.more_jobs(&progress)).map_err(|message| FarmError::Panicked {
            task: state.name.to_string(),
            stage: "more_jobs",
            message,
        })?;
        if jobs.is_empty() {
            active.ask = false;
        } else {
            self.add_jobs(at, jobs);
        }
        Ok(())
    }

    fn dispatch_batch_of(&mut self, at: usize) -> Result<bool, FarmError> {
        let task = TaskId(self.tasks.start + u32::try_from(at).expect("task ids were given for every task"));
        let state = &mut self.states[at];
        let Stage::Active(active) = &mut state.stage else { return Ok(false) };
        let mut batch = Batch::default();
        let mut dispatched_any = false;
        while batch.jobs.len() < BATCH_JOBS && batch.program_bytes < BATCH_BYTES {
            let count =
                self.window.admits(active.pending.len()).min(CHUNK_JOBS).min(BATCH_JOBS - batch.jobs.len());
            if count == 0 {
                break;
            }
            dispatched_any = true;
            let mut jobs: Vec<Box<dyn Job>> = active.pending.drain(..count).collect();
            let first = active.next_index;
            let index = |offset: usize| {
                let offset = u32::try_from(offset).expect("a chunk has few jobs");
                JobIndex(first.checked_add(offset).expect("a task has less than 2^32 jobs"))
            };
            let chunk = dispatch_chunk(&mut jobs, &self.known, self.dispatch_time)
                .map_err(|(offset, fault)| fault.into_error(&state.name, index(offset)))?;
            self.dispatch_time = chunk.time_each;
            active.next_index = index(count).0;
            self.window.dispatched(count, chunk.jobs.iter().map(|job| job.program.len()).sum());
            for (offset, (job, dispatched)) in jobs.into_iter().zip(chunk.jobs).enumerate() {
                let (index, program_bytes) = (index(offset), dispatched.program.len());
                let journal = self.journal.as_mut();
                let (program, place) =
                    Self::find_in_journal(journal, &state.name, index, &dispatched.program)?;
                active.outstanding.insert(index, Outstanding { job, program_bytes, program });
                match place {
                    Some(place) => self.replays.push_back(Replay { at, index, place }),
                    None => batch.add(index, dispatched, active.needs),
                }
            }
        }
        if !batch.jobs.is_empty() {
            let Batch { jobs, programs, needs, .. } = batch;
            let needs = needs.expect("a batch of jobs has needs");
            self.driver.submit(Submission { task, jobs, programs, needs })?;
        }
        Ok(dispatched_any)
    }

    /// Lets tasks end that have no job left and make no more.
    fn finish_idle_tasks(&mut self) -> Result<(), FarmError> {
        for at in 0..self.states.len() {
            let idle = match &self.states[at].stage {
                Stage::Active(active) => {
                    active.pending.is_empty() && active.outstanding.is_empty() && !active.ask
                }
                Stage::Waiting | Stage::Ready | Stage::Away | Stage::Prepared { .. } | Stage::Done => false,
            };
            if idle {
                self.send_away(at, FINISH, finish)?;
            }
        }
        Ok(())
    }

    fn handle_events(&mut self, wait: Wait) -> Result<(), FarmError> {
        let mut next = match wait {
            // The driver holds the other end until the run is over; without it there is no farm.
            Wait::ForOne => Some(self.events.recv().map_err(|_| FarmError::Closed)?),
            Wait::No => None,
        };
        for _ in 0..EVENTS_PER_TURN {
            let Some(event) = next.take().or_else(|| self.events.try_recv().ok()) else { break };
            match event {
                RunEvent::Arrivals(arrivals) => self.handle_arrivals(arrivals)?,
                RunEvent::Returned(returned) => self.returned(*returned)?,
                RunEvent::Ended(end) => return Err(self.ended(end)),
            }
        }
        Ok(())
    }

    fn handle_arrivals(&mut self, arrivals: Vec<Arrival>) -> Result<(), FarmError> {
        let (mut done, mut device_time) = (0, Duration::ZERO);
        let mut outcome = Ok(());
        for arrival in arrivals {
            match self.handle_arrival(arrival) {
                Ok(job_time) => {
                    done += 1;
                    device_time += job_time;
                }
                Err(error) => {
                    outcome = Err(error);
                    break;
                }
            }
        }
        self.progress.send_modify(|progress| {
            progress.jobs_done += done;
            progress.device_time += device_time;
        });
        outcome
    }

    /// Hands one ended job to the application; gives its device time.
    fn handle_arrival(&mut self, arrival: Arrival) -> Result<Duration, FarmError> {
        let id = arrival.job();
        let at = (id.task.0.checked_sub(self.tasks.start)).map_or(usize::MAX, |at| at as usize);
        let mut ended = self.take_out(at, id.index);
        let state = &mut self.states[at];
        match arrival {
            Arrival::Delivered { job: _, payload, sections, device_time, node } => {
                let bytes = payload.bytes.clone();
                let result = JobResult { sections: split_sections(bytes, &sections), device_time, node };
                retrieve(ended.job.as_mut(), result, &state.name, id.index)?;
                if let (Some(journal), Some(program)) = (&self.journal, ended.program) {
                    let about = About { task: id.task, name: &state.name, index: id.index, program };
                    journal.writer.keep(Keep::new(about, sections, device_time, node, payload));
                }
                state.progress.jobs_done += 1;
                state.progress.device_time += device_time;
                Ok(device_time)
            }
            Arrival::Failed { job: _, failure } => {
                let task = state.name.to_string();
                catch_panic(|| ended.job.failed(&failure)).map_err(|message| FarmError::Panicked {
                    task: task.clone(),
                    stage: "failed",
                    message,
                })?;
                Err(FarmError::JobFailed { task, job: id.index, failure })
            }
        }
    }

    /// A job has ended: the window has room, and its task may know of more.
    fn take_out(&mut self, at: usize, index: JobIndex) -> Outstanding {
        let state = self.states.get_mut(at).expect("the driver sends a run the jobs of its tasks");
        let Stage::Active(active) = &mut state.stage else {
            panic!("{index} of `{}` ended, but the task has no job outstanding", state.name)
        };
        let ended = active.outstanding.remove(&index).expect("a job ends once, after it was dispatched");
        self.window.retrieved(ended.program_bytes);
        active.ask = true;
        ended
    }

    fn ended(&self, end: RunEnd) -> FarmError {
        match end {
            RunEnd::Stopped => FarmError::Stopped {
                jobs_done: self.states.iter().map(|state| state.progress.jobs_done).sum(),
                jobs_known: self.states.iter().map(|state| state.progress.jobs_known).sum(),
            },
            RunEnd::NoFittingDevice { task, reason, waited } => {
                let at = task.0.wrapping_sub(self.tasks.start) as usize;
                let name =
                    self.states.get(at).map_or_else(|| task.to_string(), |state| state.name.to_string());
                FarmError::NoFittingDevice { task: name, reason, waited }
            }
            RunEnd::Farm(error) => error,
        }
    }

    /// Takes names out of the progress; other runs may have tasks of the same names, but not the same allocations.
    fn no_longer_active(&self, tasks: Range<usize>) {
        let states = &self.states[tasks];
        self.progress.send_modify(|progress| {
            progress.active_tasks.retain(|name| !states.iter().any(|state| Arc::ptr_eq(&state.name, name)));
        });
    }
}

impl Drop for Runner {
    fn drop(&mut self) {
        // Whoever sees that no task is active may open the journal. Why it failed, if it did, nobody asks any more.
        let _ = self.close_journal();
        self.no_longer_active(0..self.states.len());
        self.driver.run_over(self.tasks.clone());
    }
}

impl Arrival {
    const fn job(&self) -> JobId {
        match self {
            Self::Delivered { job, .. } | Self::Failed { job, .. } => *job,
        }
    }
}

impl TaskState {
    fn summary(&self) -> TaskSummary {
        TaskSummary {
            name: self.name.to_string(),
            jobs: self.progress.jobs_done,
            device_time: self.progress.device_time,
            prepare_time: self.prepare_time,
        }
    }
}

/// Whether a turn may begin without an event.
enum Wait {
    No,
    ForOne,
}

#[derive(Default)]
struct Batch {
    jobs: Vec<SubmittedJob>,
    programs: Vec<Bytes>,
    program_bytes: usize,
    needs: Option<Requirements>,
}

impl Batch {
    fn add(&mut self, index: JobIndex, job: Dispatched, task_needs: Requirements) {
        self.needs = Some(needs_with(self.needs.unwrap_or(task_needs), &job));
        self.program_bytes += job.program.len();
        let Dispatched { program, contents, module, cost, class, priority, .. } = job;
        self.jobs.push(SubmittedJob { index, cost, class, priority, contents, module });
        self.programs.push(program);
    }
}

/// On a thread of its own: the task's preparation and first jobs.
fn prepare(task: &mut dyn Task, name: &str, mut data: TaskData) -> Result<Stage, FarmError> {
    let started = Instant::now();
    let outcome = catch_panic(|| {
        task.prepare(&mut data)?;
        Ok((task.requirements(), task.jobs()))
    });
    let (needs, jobs) = application_outcome(outcome, name, PREPARE)?;
    Ok(Stage::Prepared { data, needs, jobs, took: started.elapsed() })
}

/// On a thread of its own: the task's end.
fn finish(task: &mut dyn Task, name: &str) -> Result<Stage, FarmError> {
    application_outcome(catch_panic(|| task.finish()), name, FINISH)?;
    Ok(Stage::Done)
}

fn application_outcome<T>(
    outcome: Result<Result<T, TaskError>, String>,
    name: &str,
    stage: &'static str,
) -> Result<T, FarmError> {
    outcome
        .map_err(|message| FarmError::Panicked { task: name.to_owned(), stage, message })?
        .map_err(|error| FarmError::Task { task: name.to_owned(), stage, error })
}
