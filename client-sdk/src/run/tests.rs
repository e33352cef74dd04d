//! The run against a driver that answers as a test tells it: no farm, no network.

use std::{
    sync::{Mutex, mpsc},
    thread::JoinHandle,
};

use farm_core::{
    id::{AppId, ContentHash},
    program::{DispatchError, JobProgram},
};
use proto::codec::content_hash;
use tokio::sync::mpsc as tokio_mpsc;

use super::*;
use crate::{driver::Input, graph::TaskGraph, job::RetrieveError, journal::JournalError, task::TaskError};

type Log = Arc<Mutex<Vec<String>>>;

/// A job of one small buffer that writes down what happens to it.
struct Noted {
    log: Log,
    name: String,
    /// Names this content in its program.
    content: Option<Content>,
    refuse_result: bool,
}

impl Job for Noted {
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        if let Some(content) = self.content {
            cmd.task_allocation(content);
        }
        let buffer = cmd.malloc(4)?;
        cmd.memcpy_dtoh(buffer, 0, 4)
    }

    fn retrieve(&mut self, result: JobResult) -> Result<(), RetrieveError> {
        let value = result.section(0, 4)?[0];
        if self.refuse_result {
            return Err(RetrieveError::application("not what I wanted"));
        }
        self.log.lock().unwrap().push(format!("{} got {value}", self.name));
        Ok(())
    }

    fn failed(&mut self, failure: &JobFailure) {
        self.log.lock().unwrap().push(format!("{} failed: {failure:?}", self.name));
    }
}

/// A task that writes down what happens to it.
#[derive(Default)]
struct NotedTask {
    log: Log,
    name: &'static str,
    jobs: usize,
    /// Further jobs, one after the other has come back.
    chain: usize,
    /// Puts this into the data and the content's name into `content`.
    data: Option<&'static [u8]>,
    content: Arc<Mutex<Option<Content>>>,
    fail_in: Option<&'static str>,
}

impl NotedTask {
    fn note(&self, what: &str) -> Result<(), TaskError> {
        self.log.lock().unwrap().push(format!("{} {what}", self.name));
        if self.fail_in == Some(what) { Err(TaskError::application("as told")) } else { Ok(()) }
    }

    fn job(&self, number: usize) -> Box<dyn Job> {
        if self.fail_in == Some("panic") {
            panic!("as told");
        }
        let refuse_result = self.fail_in == Some("retrieve");
        let content = *self.content.lock().unwrap();
        Box::new(Noted {
            log: Arc::clone(&self.log),
            name: format!("{} {number}", self.name),
            content,
            refuse_result,
        })
    }
}

impl Task for NotedTask {
    fn prepare(&mut self, data: &mut TaskData) -> Result<(), TaskError> {
        if let Some(bytes) = self.data {
            *self.content.lock().unwrap() = Some(data.allocation(bytes));
        }
        self.note("prepare")
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        (0..self.jobs).map(|number| self.job(number)).collect()
    }

    fn more_jobs(&mut self, progress: &TaskProgress) -> Vec<Box<dyn Job>> {
        if self.chain == 0 || !progress.is_idle() {
            return Vec::new();
        }
        self.chain -= 1;
        vec![self.job(usize::try_from(progress.jobs_known).unwrap())]
    }

    fn finish(&mut self) -> Result<(), TaskError> {
        self.note("finish")
    }
}

fn payload(bytes: &[u8]) -> Payload {
    let bytes = Bytes::copy_from_slice(bytes);
    Payload { digest: content_hash(&bytes), bytes, permit: None }
}

struct FakeDriver {
    inputs: tokio_mpsc::Receiver<Input>,
    events: mpsc::Sender<RunEvent>,
    run: JoinHandle<Result<RunSummary, FarmError>>,
    progress: watch::Receiver<Progress>,
    store: ContentStore,
    /// Jobs that the run says are in its journal.
    kept: usize,
    /// Applications that it says it goes on for.
    superseded: Vec<AppId>,
}

fn start(graph: TaskGraph, window: Window) -> FakeDriver {
    start_with(graph, window, None)
}

fn start_with(graph: TaskGraph, window: Window, journal: Option<Journal>) -> FakeDriver {
    start_as(AppId(1), graph, window, journal)
}

fn start_as(app: AppId, graph: TaskGraph, window: Window, journal: Option<Journal>) -> FakeDriver {
    let nodes = graph.check().unwrap();
    let (driver, inputs) = DriverHandle::new();
    let (events_sender, events) = mpsc::channel();
    let (progress, progress_receiver) = watch::channel(Progress::default());
    let store = ContentStore::default();
    // Ids that do not start at zero show a confusion of id and index.
    let tasks = 5..5 + u32::try_from(nodes.len()).unwrap();
    let run = Run {
        tasks,
        nodes,
        window,
        app,
        journal,
        store: store.clone(),
        driver,
        progress,
        events,
        events_sender: events_sender.clone(),
    };
    let run = thread::spawn(move || run.run());
    let (progress, superseded) = (progress_receiver, Vec::new());
    FakeDriver { inputs, events: events_sender, run, progress, store, kept: 0, superseded }
}

impl FakeDriver {
    /// The next batch; `None` when the run is over.
    fn batch(&mut self) -> Option<Submission> {
        loop {
            match self.inputs.blocking_recv()? {
                Input::Submitted(submission) => {
                    assert_eq!(submission.jobs.len(), submission.programs.len());
                    return Some(submission);
                }
                Input::Kept(jobs) => self.kept += jobs.len(),
                Input::Supersedes(app) => self.superseded.push(app),
                Input::RunOver { .. } => return None,
                _ => panic!("a run submits and ends, nothing else"),
            }
        }
    }

    fn answer(&self, task: TaskId, jobs: &[SubmittedJob]) {
        let arrival = |job: &SubmittedJob| Arrival::Delivered {
            job: JobId { app: AppId(1), task, index: job.index },
            payload: payload(&job.index.0.to_le_bytes()),
            sections: vec![4],
            device_time: Duration::from_millis(2),
            node: NodeId(1),
        };
        self.events.send(RunEvent::Arrivals(jobs.iter().map(arrival).collect())).unwrap();
    }

    /// Answers every batch until the run is over.
    fn serve(mut self) -> Result<RunSummary, FarmError> {
        while let Some(batch) = self.batch() {
            self.answer(batch.task, &batch.jobs);
        }
        self.end()
    }

    fn end(self) -> Result<RunSummary, FarmError> {
        let outcome = self.run.join().unwrap();
        assert!(self.progress.borrow().active_tasks.is_empty(), "a run that is over has no active task");
        outcome
    }
}

fn noted(log: &Log, name: &'static str, jobs: usize) -> NotedTask {
    NotedTask { log: Arc::clone(log), name, jobs, ..NotedTask::default() }
}

#[test]
fn every_job_is_retrieved_once_and_summed() {
    let log = Log::default();
    let graph = TaskGraph::new().task("a", noted(&log, "a", 40)).task("none", noted(&log, "none", 0));
    let driver = start(graph, Window::default());
    let progress = driver.progress.clone();
    let summary = driver.serve().unwrap();
    assert_eq!(summary.jobs, 40);
    assert_eq!(summary.device_time, Duration::from_millis(80));
    assert_eq!((summary.tasks[0].jobs, summary.tasks[1].jobs), (40, 0));
    assert_eq!((progress.borrow().jobs_done, progress.borrow().jobs_known), (40, 40));
    let log = log.lock().unwrap();
    let got: Vec<&String> = log.iter().filter(|line| line.contains("got")).collect();
    assert_eq!(got.len(), 40);
    assert_eq!((got[0].as_str(), got[39].as_str()), ("a 0 got 0", "a 39 got 39"));
    assert_eq!(log.iter().filter(|line| line.contains("finish")).count(), 2);
}

#[test]
fn the_window_bounds_what_is_outstanding() {
    let window = Window { jobs: 20, ..Window::default() };
    let mut driver = start(TaskGraph::new().task("a", noted(&Log::default(), "a", 100)), window);
    let (mut outstanding, mut most, mut done) = (VecDeque::new(), 0, 0);
    while done < 100 {
        while outstanding.len() < 20.min(100 - done) {
            let batch = driver.batch().expect("the run goes on until all is done");
            outstanding.extend(batch.jobs);
            most = most.max(outstanding.len());
        }
        // A part comes back: enough for the run to find a further batch worth it.
        let back: Vec<SubmittedJob> = outstanding.drain(..outstanding.len().min(5)).collect();
        done += back.len();
        driver.answer(TaskId(5), &back);
    }
    assert_eq!(most, 20, "the window is filled and not overfilled");
    assert_eq!(driver.serve().unwrap().jobs, 100);
}

#[test]
fn dependent_tasks_wait_and_find_the_data() {
    let log = Log::default();
    let mut bvh = noted(&log, "bvh", 0);
    bvh.data = Some(b"treetree");
    let mut render = noted(&log, "render", 2);
    render.content = Arc::clone(&bvh.content);
    let graph = TaskGraph::new().task("render", render).task("bvh", bvh).after("render", "bvh");
    let mut driver = start(graph, Window::default());
    let batch = driver.batch().expect("the render task has jobs");
    assert_eq!(batch.task, TaskId(5));
    driver.answer(batch.task, &batch.jobs);
    let store = driver.store.clone();
    driver.serve().unwrap();
    let order =
        ["bvh prepare", "bvh finish", "render prepare", "render 0 got 0", "render 1 got 1", "render finish"];
    assert_eq!(*log.lock().unwrap(), order);
    for content in batch.jobs.iter().flat_map(|job| &job.contents) {
        assert_eq!(store.get(&content.hash), None, "data is given back when the run is over");
    }
}

#[test]
fn a_chain_of_jobs_follows_the_results() {
    let log = Log::default();
    let mut task = noted(&log, "a", 1);
    task.chain = 3;
    let mut driver = start(TaskGraph::new().task("a", task), Window::default());
    for index in 0..4 {
        let batch = driver.batch().expect("a further job follows");
        assert_eq!(batch.jobs.iter().map(|job| job.index.0).collect::<Vec<_>>(), [index]);
        driver.answer(batch.task, &batch.jobs);
    }
    assert_eq!(driver.serve().unwrap().jobs, 4);
}

#[test]
fn a_failed_job_is_told_and_ends_the_run() {
    let log = Log::default();
    let mut driver = start(TaskGraph::new().task("a", noted(&log, "a", 3)), Window::default());
    let batch = driver.batch().expect("the task has jobs");
    driver.answer(batch.task, &batch.jobs[..1]);
    let job = JobId { app: AppId(1), task: batch.task, index: JobIndex(2) };
    let failure = JobFailure::InvalidProgram("command 7: no".to_owned());
    driver.events.send(RunEvent::Arrivals(vec![Arrival::Failed { job, failure }])).unwrap();
    assert!(driver.batch().is_none());
    let error = driver.end().unwrap_err();
    assert_eq!(error.to_string(), "task `a`, job-2 failed: the program is not valid: command 7: no");
    assert!(!error.can_be_retried());
    assert!(log.lock().unwrap().last().unwrap().starts_with("a 2 failed"));
}

#[test]
fn errors_of_the_application_name_task_and_stage() {
    let outcome = |fail_in| {
        let mut task = noted(&Log::default(), "a", 1);
        task.fail_in = Some(fail_in);
        start(TaskGraph::new().task("a", task), Window::default()).serve().unwrap_err().to_string()
    };
    assert_eq!(outcome("prepare"), "task `a`, prepare: as told");
    assert_eq!(outcome("finish"), "task `a`, finish: as told");
    assert_eq!(outcome("retrieve"), "task `a`, job-0, retrieve: not what I wanted");
    assert_eq!(outcome("panic"), "task `a` panicked in prepare: as told");
}

#[test]
fn a_content_that_no_task_added_is_refused() {
    let task = noted(&Log::default(), "a", 1);
    let content = Content { hash: ContentHash([9; 32]), size_bytes: 8 };
    *task.content.lock().unwrap() = Some(content);
    let error = start(TaskGraph::new().task("a", task), Window::default()).serve().unwrap_err();
    assert!(matches!(error, FarmError::UnknownContent { content: named, .. } if named == content), "{error}");
}

#[test]
fn stopping_retrieves_what_has_arrived() {
    let log = Log::default();
    let mut driver = start(TaskGraph::new().task("a", noted(&log, "a", 3)), Window::default());
    let batch = driver.batch().expect("the task has jobs");
    driver.answer(batch.task, &batch.jobs[..2]);
    driver.events.send(RunEvent::Ended(RunEnd::Stopped)).unwrap();
    assert!(driver.batch().is_none());
    let error = driver.end().unwrap_err();
    assert!(matches!(error, FarmError::Stopped { jobs_done: 2, jobs_known: 3 }), "{error}");
    assert!(!log.lock().unwrap().contains(&"a finish".to_owned()));
}

#[test]
fn stopping_does_not_wait_for_a_preparation() {
    struct Slow(mpsc::Receiver<()>);
    impl Task for Slow {
        fn prepare(&mut self, _: &mut TaskData) -> Result<(), TaskError> {
            self.0.recv().map_err(TaskError::application)
        }
        fn jobs(&mut self) -> Vec<Box<dyn Job>> {
            Vec::new()
        }
    }
    let (let_go, wait) = mpsc::channel();
    let driver = start(TaskGraph::new().task("slow", Slow(wait)), Window::default());
    driver.events.send(RunEvent::Ended(RunEnd::Stopped)).unwrap();
    assert!(matches!(driver.end(), Err(FarmError::Stopped { .. })));
    drop(let_go);
}

/// A journal in a folder of its own.
struct JournalFile(tempfile::TempDir);

impl JournalFile {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn open(&self) -> Journal {
        Journal::open(self.0.path().join("journal"), "test").unwrap()
    }
}

/// Two tasks, the first with a chain of jobs that follow from results.
fn journalled_graph(log: &Log) -> TaskGraph {
    let chain = NotedTask { chain: 3, ..noted(log, "a", 5) };
    TaskGraph::new().task("a", chain).task("b", noted(log, "b", 10)).after("b", "a")
}

#[test]
fn a_run_goes_on_from_its_journal_wherever_it_was_stopped() {
    for stop_after in 0..=18 {
        let file = JournalFile::new();
        let log = Log::default();
        let mut first = start_with(journalled_graph(&log), Window::default(), Some(file.open()));
        let mut given = 0;
        while given < stop_after {
            let batch = first.batch().expect("jobs are left");
            let some = batch.jobs.len().min(stop_after - given);
            first.answer(batch.task, &batch.jobs[..some]);
            given += some;
        }
        first.events.send(RunEvent::Ended(RunEnd::Stopped)).unwrap();
        while first.batch().is_some() {}
        let kept = first.kept;
        let _ = first.end();
        let got = |log: &Log| log.lock().unwrap().iter().filter(|line| line.contains("got")).count();
        assert_eq!((got(&log), kept), (stop_after, stop_after), "all that was retrieved is kept");
        assert_eq!(file.open().results(), stop_after as u64);

        let log = Log::default();
        let mut second = start_with(journalled_graph(&log), Window::default(), Some(file.open()));
        let mut computed = 0;
        while let Some(batch) = second.batch() {
            computed += batch.jobs.len();
            second.answer(batch.task, &batch.jobs);
        }
        let progress = second.progress.clone();
        let summary = second.end().unwrap();
        assert_eq!(computed, 18 - stop_after, "stopped after {stop_after}");
        assert_eq!((summary.jobs, summary.journalled), (18, stop_after as u64));
        assert_eq!(summary.device_time, Duration::from_millis(36), "what it took then counts");
        assert_eq!(progress.borrow().jobs_journalled, stop_after as u64);
        let mut lines: Vec<String> = log.lock().unwrap().clone();
        assert_eq!(got(&log), 18, "each job is retrieved once in each process");
        lines.sort();
        lines.dedup();
        assert_eq!(lines.len(), 18 + 4, "and each task prepared and finished: {lines:?}");
    }
}

#[test]
fn a_complete_journal_needs_no_farm() {
    let file = JournalFile::new();
    start_with(journalled_graph(&Log::default()), Window::default(), Some(file.open())).serve().unwrap();
    let log = Log::default();
    // A window of one: results of the journal take a job's place in it.
    let window = Window { jobs: 1, ..Window::default() };
    let mut again = start_with(journalled_graph(&log), window, Some(file.open()));
    assert!(again.batch().is_none(), "nothing is to be planned");
    assert_eq!(again.end().unwrap().journalled, 18);
}

#[test]
fn a_journal_without_room_ends_the_run() {
    let file = JournalFile::new();
    let journal = file.open().with_max_bytes(584);
    let mut driver = start_with(journalled_graph(&Log::default()), Window::default(), Some(journal));
    let batch = driver.batch().expect("the task has jobs");
    // One is left out: the run cannot be complete before it hears.
    driver.answer(batch.task, &batch.jobs[..4]);
    assert!(driver.batch().is_none());
    let error = driver.end().unwrap_err();
    assert!(matches!(error, FarmError::Journal(JournalError::Full { .. })), "{error}");
    assert_eq!(file.open().results(), 3, "what found room is kept");
}

#[test]
fn a_journal_of_another_graph_or_of_other_inputs_ends_the_run_before_it_begins() {
    let file = JournalFile::new();
    start_with(journalled_graph(&Log::default()), Window::default(), Some(file.open())).serve().unwrap();
    let log = Log::default();
    let run = |graph| start_with(graph, Window::default(), Some(file.open())).serve().unwrap_err();
    let error = run(TaskGraph::new().task("a", noted(&log, "a", 5)));
    assert!(
        matches!(&error, FarmError::Journal(JournalError::OtherTasks { task, .. }) if task == "b"),
        "{error}"
    );
    let changed = NotedTask { data: Some(b"new data"), ..noted(&log, "a", 5) };
    let error = run(TaskGraph::new().task("a", changed).task("b", noted(&log, "b", 10)).after("b", "a"));
    assert!(matches!(error, FarmError::Journal(JournalError::OtherInputs { .. })), "{error}");
    assert_eq!(*log.lock().unwrap(), ["a prepare"], "no result of the other run was taken");
}

#[test]
fn a_run_says_whom_it_goes_on_for_before_it_asks_for_anything() {
    let file = JournalFile::new();
    for (app, predecessor) in [(7, None), (8, Some(7)), (8, None), (9, Some(8))] {
        let graph = journalled_graph(&Log::default());
        let mut run = start_as(AppId(app), graph, Window::default(), Some(file.open()));
        run.batch().expect("jobs are left");
        assert_eq!(run.superseded, Vec::from_iter(predecessor.map(AppId)), "{app}");
        run.events.send(RunEvent::Ended(RunEnd::Stopped)).unwrap();
        while run.batch().is_some() {}
        let _ = run.end();
    }
}
