//! Simulated time for what does not get it from tokio: devices, and the one thread of the application that a run has.

use std::{
    fs::File,
    os::unix::fs::FileExt as _,
    sync::{Arc, Mutex},
    thread,
    time::Instant,
};

use gpu_exec::SimClock;

/// The paused time of the host that turmoil runs at the moment.
pub(crate) struct HostTime;

impl SimClock for HostTime {
    fn now(&self) -> Instant {
        tokio::time::Instant::now().into_std()
    }

    fn wake_at(&self, at: Instant, wake: Box<dyn FnOnce() + Send>) {
        // On the host's runtime: what bounces takes its devices' alarms along.
        tokio::spawn(async move {
            tokio::time::sleep_until(at.into()).await;
            wake();
        });
    }
}

/// The application's thread, for which simulated time waits: without it a second of a busy machine were minutes of the farm.
#[derive(Clone, Default)]
pub(crate) struct AppThread(Arc<Mutex<State>>);

#[derive(Default)]
enum State {
    /// No run has begun.
    #[default]
    None,
    /// A run has begun, its thread has not come by yet.
    Expected,
    /// The thread's line in `/proc`.
    Runs(File),
}

impl AppThread {
    /// From now on time waits for the thread to come by.
    pub(crate) fn expect(&self) {
        *self.0.lock().unwrap() = State::Expected;
    }

    /// This thread is it.
    pub(crate) fn is_this(&self) {
        *self.0.lock().unwrap() = State::Runs(File::open("/proc/thread-self/stat").unwrap());
    }

    /// Waits until the thread waits, too.
    pub(crate) fn until_idle(&self) {
        loop {
            match &*self.0.lock().unwrap() {
                State::None => return,
                State::Expected => {}
                State::Runs(stat) if is_busy(stat) => {}
                State::Runs(_) => return,
            }
            thread::yield_now();
        }
    }
}

/// Whether a thread computes: one that waits for a message sleeps, and is woken by whoever sends it one.
fn is_busy(stat: &File) -> bool {
    let mut line = [0; 64];
    // A thread that is gone has no line any more.
    let Ok(length) = stat.read_at(&mut line, 0) else { return false };
    let end_of_name = line[..length].iter().rposition(|&byte| byte == b')');
    end_of_name.is_some_and(|at| matches!(line.get(at + 2), Some(b'R' | b'D')))
}
