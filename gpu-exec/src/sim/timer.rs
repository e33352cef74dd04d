//! The time of simulated devices: the one timer thread of all those of the process, or the clock that a test has put in its place.
//!
//! It only wakes devices; it knows nothing of jobs. The thread lives as long as the process, asleep while nothing is due.

use std::{
    cell::RefCell,
    cmp::{Ordering, Reverse},
    collections::BinaryHeap,
    io,
    marker::PhantomData,
    rc::Rc,
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

/// A clock by which simulated devices take their time.
pub trait SimClock {
    /// What time it is.
    fn now(&self) -> Instant;
    /// Calls `wake` at a point of time, on a thread that has this clock; never, if the devices are gone by then.
    fn wake_at(&self, at: Instant, wake: Box<dyn FnOnce() + Send>);
}

thread_local! {
    static CLOCK: RefCell<Option<Rc<dyn SimClock>>> = const { RefCell::new(None) };
}

/// Lets simulated devices go by `clock` on this thread, until what this gives is dropped: in a simulation whose time is not the
/// system's, all that is done with them is done on one thread.
///
/// # Panics
/// The thread has such a clock already.
#[must_use = "the system's time is back when this is dropped"]
pub fn simulate_time(clock: Rc<dyn SimClock>) -> SimulatedTime {
    let earlier = CLOCK.replace(Some(clock));
    assert!(earlier.is_none(), "one clock a thread");
    SimulatedTime { thread: PhantomData }
}

/// As long as it lives, its thread has a clock for simulated devices.
#[derive(Debug)]
pub struct SimulatedTime {
    thread: PhantomData<Rc<()>>,
}

impl Drop for SimulatedTime {
    fn drop(&mut self) {
        CLOCK.set(None);
    }
}

fn clock() -> Option<Rc<dyn SimClock>> {
    CLOCK.with_borrow(Option::clone)
}

/// The time of devices on this thread.
pub(super) fn now() -> Instant {
    clock().map_or_else(Instant::now, |clock| clock.now())
}

/// Calls `device` with `generation` at a point of time.
pub(super) fn wake_at(at: Instant, device: Weak<Shared>, generation: u64) {
    if let Some(clock) = clock() {
        let wake = move || device.upgrade().into_iter().for_each(|device| device.alarm(generation));
        return clock.wake_at(at, Box::new(wake));
    }
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
