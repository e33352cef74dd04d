//! A graph of tasks run for a person: progress is told, signals stop it in order. Never knows what the tasks compute.

use client_sdk::{Farm, FarmError, FarmOptions, Journal, RunSummary, TaskGraph};
use tokio::signal::unix::{Signal, SignalKind, signal};

use crate::{
    cli::ProgressStyle,
    failure::Failure,
    progress::{self, Units},
};

/// Runs the graph on a farm, with a journal if there is one, and with stealing between its nodes; the first signal stops it in order, the second one ends the process.
pub(crate) async fn run_graph(
    options: FarmOptions,
    graph: TaskGraph,
    journal: Option<Journal>,
    style: ProgressStyle,
    units: Units,
    stops: &mut Stops,
) -> Result<RunSummary, FarmError> {
    let farm = Farm::connect(FarmOptions { global_stealing: true, ..options }).await?;
    let teller = tokio::spawn(progress::tell(farm.progress(), style, units));
    let stop = farm.stop_handle();
    let result = {
        let running = async {
            match journal {
                Some(journal) => farm.run_journalled(graph, journal).await,
                None => farm.run(graph).await,
            }
        };
        tokio::pin!(running);
        tokio::select! {
            result = &mut running => result,
            () = stops.recv() => {
                tell!("farmctl: stopping; again to end at once");
                stop.stop();
                tokio::select! {
                    result = &mut running => result,
                    () = stops.recv() => std::process::exit(1),
                }
            }
        }
    };
    farm.close().await;
    // The progress channel closed with the farm: the teller ends by itself.
    let _ = teller.await;
    result
}

/// SIGINT and SIGTERM.
pub(crate) struct Stops {
    interrupt: Signal,
    terminate: Signal,
}

impl Stops {
    /// Listens from now on.
    pub(crate) fn listen() -> Result<Self, Failure> {
        Ok(Self { interrupt: signal(SignalKind::interrupt())?, terminate: signal(SignalKind::terminate())? })
    }

    /// Waits for the next one.
    pub(crate) async fn recv(&mut self) {
        tokio::select! {
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
        }
    }
}
