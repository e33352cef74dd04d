//! Attacks that go on until they are called off, at the lowest priority: what they cost a farm on the same cores is what its
//! daemons do about them, not what it takes to make them.

use std::{
    fs,
    net::SocketAddr,
    process::Command,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc,
    },
    time::Duration,
};

use tokio::runtime::{Builder, Runtime};

use crate::{control, data};

/// How long an attacker waits for an answer.
pub(crate) const PATIENCE: Duration = Duration::from_secs(1);
/// How long who has sent all that is taken goes on saying nothing.
pub(crate) const STALL: Duration = Duration::from_secs(1);
/// How long the first round of each attack may take.
const FIRST_ROUND: Duration = Duration::from_secs(60);

/// What is attacked.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Target {
    /// The coordinator's gRPC port.
    pub(crate) grpc: SocketAddr,
    /// Its status page.
    pub(crate) http: SocketAddr,
    /// A worker's QUIC port.
    pub(crate) data: SocketAddr,
}

/// Counts what one attack has tried.
#[derive(Clone, Debug)]
pub(crate) struct Tally {
    tried: Arc<AtomicU64>,
    begun: mpsc::Sender<()>,
}

impl Tally {
    pub(crate) fn add(&self, tries: u64) {
        if self.tried.fetch_add(tries, Ordering::Relaxed) == 0 {
            // The siege may be over already.
            let _ = self.begun.send(());
        }
    }
}

/// All attacks at once.
#[derive(Debug)]
pub(crate) struct Siege {
    runtime: Runtime,
    tallies: Vec<(&'static str, Tally)>,
}

impl Siege {
    /// Begins, and waits until each attack has tried something.
    pub(crate) fn lay(target: Target) -> Self {
        let runtime = Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .on_thread_start(step_back)
            .build()
            .unwrap();
        let (begun, first_rounds) = mpsc::channel();
        let mut tallies = Vec::new();
        macro_rules! attack_with {
            ($($attack:path),* $(,)?) => {$(
                let tally = Tally { tried: Arc::default(), begun: begun.clone() };
                runtime.spawn($attack(target, tally.clone()));
                tallies.push((stringify!($attack), tally));
            )*};
        }
        attack_with!(
            control::garbage,
            control::slow,
            control::slow_pages,
            control::pages,
            control::requests,
            control::fillers,
            data::datagrams,
            data::half_handshakes,
            data::tiny_streams,
            data::broken_frames,
            data::announcements,
            data::stalled,
        );
        for _ in &tallies {
            first_rounds.recv_timeout(FIRST_ROUND).expect("every attack begins");
        }
        Self { runtime, tallies }
    }

    /// Ends; gives what was tried.
    pub(crate) fn lift(self) -> String {
        let tried = self
            .tallies
            .iter()
            .map(|(name, tally)| format!("{name} {}", tally.tried.load(Ordering::Relaxed)));
        let tried = tried.collect::<Vec<_>>().join(", ");
        self.runtime.shutdown_background();
        tried
    }
}

/// Gives the calling thread the lowest priority.
fn step_back() {
    let thread = fs::read_link("/proc/thread-self").expect("Linux names its threads");
    let thread = thread.file_name().expect("by number");
    let set =
        Command::new("renice").args(["-n", "19", "-p"]).arg(thread).output().expect("util-linux is there");
    assert!(set.status.success(), "{set:?}");
}
