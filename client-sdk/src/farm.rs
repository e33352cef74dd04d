//! An application's connection to a farm.

use tokio::sync::watch;

use crate::{
    error::FarmError,
    graph::TaskGraph,
    options::FarmOptions,
    progress::{Progress, RunSummary},
};

/// An application's connection to a farm. Dropping it closes it; [`Self::close`] also waits until goodbye is said.
#[derive(Debug)]
pub struct Farm {
    progress: watch::Receiver<Progress>,
    stop: watch::Sender<bool>,
}

/// Ends the runs of a farm early and in order; can be cloned and used from any thread.
#[derive(Clone, Debug)]
pub struct StopHandle {
    stop: watch::Sender<bool>,
}

impl StopHandle {
    /// Lets every current and later run of the farm end with [`FarmError::Stopped`]: results that have
    /// arrived are retrieved, everything else is cancelled.
    pub fn stop(&self) {
        self.stop.send_replace(true);
    }
}

impl Farm {
    /// Connects to a coordinator and registers the application.
    ///
    /// # Errors
    /// An option is out of range, the coordinator cannot be reached in time, or it refuses.
    pub async fn connect(options: FarmOptions) -> Result<Self, FarmError> {
        options.check()?;
        Err(FarmError::Unreachable { address: options.coordinator, reason: "not connected yet".to_owned() })
    }

    /// Runs a graph of tasks to its end. Several runs may go side by side.
    ///
    /// # Errors
    /// See [`FarmError`]; the first cause ends the run, and its outstanding jobs are cancelled.
    pub async fn run(&self, graph: TaskGraph) -> Result<RunSummary, FarmError> {
        graph.check()?;
        Err(FarmError::Closed)
    }

    /// The newest progress, and a way to wait for the next.
    #[must_use]
    pub fn progress(&self) -> watch::Receiver<Progress> {
        self.progress.clone()
    }

    /// A handle that ends runs early.
    #[must_use]
    pub fn stop_handle(&self) -> StopHandle {
        StopHandle { stop: self.stop.clone() }
    }

    /// Says goodbye and waits until it is sent.
    pub async fn close(self) {}
}
