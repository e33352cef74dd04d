//! An application's connection to a farm: what the application holds. The work is the driver's and the runs'.

use std::{
    sync::{
        atomic::{AtomicU32, Ordering},
        mpsc as std_mpsc,
    },
    thread,
};

use farm_core::id::AppId;
use proto::control::{SessionError, connect_app};
use tokio::{
    sync::{oneshot, watch},
    task::JoinHandle,
};

use crate::{
    content::ContentStore,
    driver::{Acknowledge, DriverHandle, DriverSetup, drive},
    error::FarmError,
    graph::TaskGraph,
    journal::Journal,
    options::FarmOptions,
    progress::{Progress, RunSummary},
    run::{Run, RunEnd, RunEvent},
};

/// An application's connection to a farm. Dropping it ends its runs and its registration; [`Self::close`] also waits
/// until goodbye is said, without which the farm keeps the application's place for a while (its lease).
#[derive(Debug)]
pub struct Farm {
    options: FarmOptions,
    /// As which application it was registered.
    app: AppId,
    driver: DriverHandle,
    driver_task: JoinHandle<()>,
    store: ContentStore,
    /// Task ids are given once in a connection's life: two runs never share one.
    next_task: AtomicU32,
    progress: watch::Sender<Progress>,
    stop: watch::Sender<bool>,
    /// Dropped or used, it lets the driver end.
    closing: oneshot::Sender<()>,
}

/// Ends the runs of a farm early and in order; can be cloned and used from any thread.
#[derive(Clone, Debug)]
pub struct StopHandle {
    stop: watch::Sender<bool>,
}

impl StopHandle {
    /// Lets every current and later run of the farm end with [`FarmError::Stopped`]: results that have arrived are
    /// retrieved, everything else is cancelled. A `prepare` or `finish` that is on its way is not waited for.
    pub fn stop(&self) {
        self.stop.send_replace(true);
    }
}

impl Farm {
    /// Connects to a coordinator and registers the application. Must be called on a tokio runtime, which carries the
    /// connection from then on.
    ///
    /// # Errors
    /// An option is out of range, the coordinator cannot be reached within [`FarmOptions::connect_timeout`] (a refused
    /// connection is an error at once), or it refuses the application.
    pub async fn connect(options: FarmOptions) -> Result<Self, FarmError> {
        options.check()?;
        let (address, timeout) = (options.coordinator.clone(), options.connect_timeout);
        match tokio::time::timeout(timeout, Self::register(options)).await {
            Ok(outcome) => outcome,
            Err(_) => {
                Err(FarmError::Unreachable { address, reason: format!("no answer within {timeout:?}") })
            }
        }
    }

    async fn register(options: FarmOptions) -> Result<Self, FarmError> {
        let session = connect_app(&options.coordinator, options.identity.as_ref(), &[])
            .await
            .map_err(|error| connect_error(&options, error))?;
        let (driver, inputs) = DriverHandle::new();
        let (progress, _) = watch::channel(Progress::default());
        let (stop, stop_receiver) = watch::channel(false);
        let (closing, closing_receiver) = oneshot::channel();
        let (registered, registration) = oneshot::channel();
        let store = ContentStore::default();
        let driver_task = tokio::spawn(drive(DriverSetup {
            options: options.clone(),
            handle: driver.clone(),
            inputs,
            session,
            registered,
            contents: store.source(),
            progress: progress.clone(),
            stop: stop_receiver,
            closing: closing_receiver,
        }));
        // From here on an early return drops `closing`, and the driver ends.
        let app = registration.await.unwrap_or(Err(FarmError::Closed))?;
        Ok(Self {
            options,
            app,
            driver,
            driver_task,
            store,
            next_task: AtomicU32::new(0),
            progress,
            stop,
            closing,
        })
    }

    /// Runs a graph of tasks to its end. Several runs may go side by side; dropping the future ends the run.
    ///
    /// # Errors
    /// See [`FarmError`]; the first cause ends the run, and its outstanding jobs are cancelled.
    pub async fn run(&self, graph: TaskGraph) -> Result<RunSummary, FarmError> {
        self.run_with(graph, None).await
    }

    /// The same with a journal: each result goes there once its job has taken it, and only then may its node forget it. Another
    /// process that runs the same graph with the same journal goes on from there: `dispatch` is called as ever, and `retrieve` of
    /// the jobs whose programs the journal has results of, with the bytes that it has, once each. So an application that was killed
    /// comes to the same state by the same calls, and what it had retrieved is not computed again.
    ///
    /// The application that ran with the journal before, if its process was killed and the coordinator keeps its place still, is over
    /// at once: what it left at the nodes would be computed beside this run, and again by it.
    ///
    /// The file stays when the run has ended, in whatever way; remove it when what became of the results is safe.
    ///
    /// # Errors
    /// Those of [`Self::run`], and [`FarmError::Journal`]: it is of another run, damaged, or cannot be added to. What was retrieved
    /// before a full disk stays in it.
    pub async fn run_journalled(&self, graph: TaskGraph, journal: Journal) -> Result<RunSummary, FarmError> {
        self.run_with(graph, Some(journal)).await
    }

    async fn run_with(&self, graph: TaskGraph, journal: Option<Journal>) -> Result<RunSummary, FarmError> {
        let nodes = graph.check()?;
        if nodes.is_empty() {
            return Ok(RunSummary::default());
        }
        let count = u32::try_from(nodes.len()).expect("a graph in memory has less than 2^32 tasks");
        let first = self
            .next_task
            .try_update(Ordering::Relaxed, Ordering::Relaxed, |next| next.checked_add(count))
            .map_err(|_| FarmError::Closed)?;
        let tasks = first..first + count;
        let (events_sender, events) = std_mpsc::channel();
        let acknowledge = if journal.is_some() { Acknowledge::WhenKept } else { Acknowledge::AtOnce };
        self.driver.start_run(tasks.clone(), events_sender.clone(), acknowledge).await?;
        let abandoned = EndWhenDropped(events_sender.clone());
        let run = Run {
            tasks: tasks.clone(),
            nodes,
            window: self.options.window,
            app: self.app,
            journal,
            store: self.store.clone(),
            driver: self.driver.clone(),
            progress: self.progress.clone(),
            events,
            events_sender,
        };
        let (done, outcome) = oneshot::channel();
        let code = move || {
            // Nobody may be waiting any more.
            let _ = done.send(run.run());
        };
        if let Err(error) = thread::Builder::new().name(format!("gleaner-run-{first}")).spawn(code) {
            self.driver.abandon_run(tasks).await;
            return Err(FarmError::Thread(error));
        }
        let outcome = outcome.await.unwrap_or(Err(FarmError::Closed));
        drop(abandoned);
        outcome
    }

    /// The newest progress, and a way to wait for the next.
    #[must_use]
    pub fn progress(&self) -> watch::Receiver<Progress> {
        self.progress.subscribe()
    }

    /// A handle that ends runs early.
    #[must_use]
    pub fn stop_handle(&self) -> StopHandle {
        StopHandle { stop: self.stop.clone() }
    }

    /// Ends what still runs, says goodbye and waits (a few seconds at most) until it is sent.
    pub async fn close(self) {
        // The driver may have ended by itself; both ways it is over after this.
        let _ = self.closing.send(());
        let _ = self.driver_task.await;
    }
}

/// Ends a run that nobody waits for.
struct EndWhenDropped(std_mpsc::Sender<RunEvent>);

impl Drop for EndWhenDropped {
    fn drop(&mut self) {
        // A run that is over does not listen.
        let _ = self.0.send(RunEvent::Ended(RunEnd::Stopped));
    }
}

fn connect_error(options: &FarmOptions, error: SessionError) -> FarmError {
    let address = options.coordinator.clone();
    match error {
        SessionError::Address { reason, .. } => FarmError::Options { option: "coordinator", reason },
        SessionError::Refused { reason } => FarmError::Refused { address, reason },
        SessionError::Denied { reason } => FarmError::Denied { address, reason },
        SessionError::Unreachable { reason, .. } => FarmError::Unreachable { address, reason },
        error @ (SessionError::Ended { .. }
        | SessionError::Malformed { .. }
        | SessionError::Failed { .. }
        | SessionError::UnknownRequest
        | SessionError::Full) => FarmError::Unreachable { address, reason: error.to_string() },
    }
}
