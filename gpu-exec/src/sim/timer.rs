//! The one timer thread of all simulated devices of the process.
//!
//! It only wakes devices; it knows nothing of jobs. It lives as long as the process, asleep while nothing is due.

use std::{
    cmp::{Ordering, Reverse},
    collections::BinaryHeap,
    io,
    sync::{Condvar, LazyLock, Mutex, PoisonError, Weak},
    thread,
    time::Instant,
};

use super::Shared;

/// Pending alarms. Bounded by the jobs that simulated devices run, plus those aborted since they began.
#[derive(Default)]
struct Timer {
    alarms: Mutex<BinaryHeap<Reverse<Alarm>>>,
    changed: Condvar,
}

struct Alarm {
    at: Instant,
    device: Weak<Shared>,
    generation: u64,
}

static TIMER: LazyLock<Timer> = LazyLock::new(Timer::default);
static THREAD: LazyLock<Result<(), io::ErrorKind>> = LazyLock::new(|| {
    let thread = thread::Builder::new().name("sim-timer".to_owned());
    thread.spawn(|| TIMER.run()).map(drop).map_err(|error| error.kind())
});

/// Starts the thread if it does not run yet.
pub(super) fn ensure() -> Result<(), io::Error> {
    (*THREAD).map_err(io::Error::from)
}

/// Calls `device` with `generation` at a point of time.
pub(super) fn wake_at(at: Instant, device: Weak<Shared>, generation: u64) {
    let mut alarms = TIMER.alarms.lock().unwrap_or_else(PoisonError::into_inner);
    let first = alarms.peek().is_none_or(|Reverse(alarm)| at < alarm.at);
    alarms.push(Reverse(Alarm { at, device, generation }));
    if first {
        TIMER.changed.notify_one();
    }
}

impl Timer {
    fn run(&self) {
        let mut alarms = self.alarms.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            let Some(Reverse(next)) = alarms.peek() else {
                alarms = self.changed.wait(alarms).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            let wait = next.at.saturating_duration_since(Instant::now());
            if !wait.is_zero() {
                let waited = self.changed.wait_timeout(alarms, wait);
                alarms = waited.unwrap_or_else(PoisonError::into_inner).0;
                continue;
            }
            let due = alarms.pop();
            drop(alarms);
            if let Some(Reverse(Alarm { device, generation, .. })) = due
                && let Some(device) = device.upgrade()
            {
                device.alarm(generation);
            }
            alarms = self.alarms.lock().unwrap_or_else(PoisonError::into_inner);
        }
    }
}

impl Ord for Alarm {
    fn cmp(&self, other: &Self) -> Ordering {
        self.at.cmp(&other.at).then(self.generation.cmp(&other.generation))
    }
}

impl PartialOrd for Alarm {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Alarm {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Alarm {}
