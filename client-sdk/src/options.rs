//! Settings of one connection to a farm, checked once. Reads no environment and no file.

use std::time::Duration;

use farm_core::coordinator::policy::FCFS;
use proto::{control::coordinator_addresses, trust::Identity};

use crate::error::FarmError;

/// Time for a coordinator's machine to start anew: what waits for it is worth more than the wait.
const RECONNECT_TIMEOUT: Duration = Duration::from_secs(600);

/// How an application connects, and the bounds it keeps.
#[derive(Clone, Debug, PartialEq)]
pub struct FarmOptions {
    /// `host:port` of the coordinator; where it has standbys theirs, too, with commas between.
    pub coordinator: String,
    /// The application's name, for people.
    pub name: String,
    /// Fair-share weight, > 0 and finite.
    pub weight: f64,
    /// Whether queued jobs may be moved between nodes to balance them. Costs a little traffic, and is worth it
    /// whenever devices or jobs are unequal.
    pub global_stealing: bool,
    /// The coordinator's placement policy for this application's jobs: `fcfs`, `neighbours` (costs by those of the jobs of
    /// indices beside theirs), `history` (costs of the same jobs of the
    /// application's last task, longest first), or the name of a
    /// plug-in in the coordinator's folder.
    pub policy: String,
    /// Who the application is in a secured farm; without it, the farm has to be open.
    pub identity: Option<Identity>,
    /// How long connecting and registering may take.
    pub connect_timeout: Duration,
    /// How long a lost coordinator is tried again before the run ends. What nodes have goes on meanwhile, and its results come.
    pub reconnect_timeout: Duration,
    /// How long jobs may wait for a fitting device before the run ends.
    pub patience: Duration,
    /// Bounds of what is dispatched and not yet retrieved.
    pub window: Window,
}

/// How much of a run is in memory at a time. Jobs beyond it stay undispatched.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// Most jobs dispatched and not yet retrieved, of one run.
    pub jobs: usize,
    /// Most bytes of their encoded programs, of one run; one job is dispatched whatever its size.
    pub program_bytes: usize,
    /// Most bytes of results received and not yet retrieved, of the whole connection; when it is full, results wait in
    /// the nodes' spools. One result is received whatever its size.
    pub result_bytes: usize,
}

impl Default for Window {
    fn default() -> Self {
        Self { jobs: 8_192, program_bytes: 256 << 20, result_bytes: 256 << 20 }
    }
}

impl FarmOptions {
    /// Default settings: weight 1, no stealing between nodes, 5 s to connect, 10 minutes to reconnect, 60 s of patience.
    pub fn new(coordinator: impl Into<String>, name: impl Into<String>) -> Self {
        Self {
            coordinator: coordinator.into(),
            name: name.into(),
            weight: 1.0,
            global_stealing: false,
            policy: FCFS.to_owned(),
            identity: None,
            connect_timeout: Duration::from_secs(5),
            reconnect_timeout: RECONNECT_TIMEOUT,
            patience: Duration::from_secs(60),
            window: Window::default(),
        }
    }

    /// Refuses what cannot work, before anything is connected.
    pub(crate) fn check(&self) -> Result<(), FarmError> {
        let wrong = |option, reason: String| Err(FarmError::Options { option, reason });
        if let Err(error) = coordinator_addresses(&self.coordinator) {
            return wrong("coordinator", error.to_string());
        }
        if !(self.weight.is_finite() && self.weight > 0.0) {
            return wrong("weight", format!("{} is not a positive number", self.weight));
        }
        if self.window.jobs == 0 || self.window.program_bytes == 0 || self.window.result_bytes == 0 {
            return wrong("window", format!("{:?} has no room", self.window));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unusable_options_are_named() {
        let good = FarmOptions::new("127.0.0.1:7700", "test");
        good.check().unwrap();
        FarmOptions::new("[::1]:7700", "test").check().unwrap();
        FarmOptions::new("one:7700,two:7700", "test").check().unwrap();
        let option = |options: FarmOptions| match options.check() {
            Err(FarmError::Options { option, .. }) => option,
            other => panic!("expected a refused option, got {other:?}"),
        };
        for address in
            ["", "localhost", ":7700", "host:", "host:0", "host:65536", "host:port", "host:1,", "host:1,host"]
        {
            assert_eq!(option(FarmOptions::new(address, "test")), "coordinator", "{address}");
        }
        for weight in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert_eq!(option(FarmOptions { weight, ..good.clone() }), "weight");
        }
        let window = Window { jobs: 0, ..Window::default() };
        assert_eq!(option(FarmOptions { window, ..good }), "window");
    }
}
