//! A device's thread: takes orders, keeps one running, one interrupted and one of each class staged, replaces a device that hangs or is lost.
//!
//! A fault costs the running attempt only: the staged order is prepared again on the new device.

use std::{
    any::Any,
    cmp::Reverse,
    mem,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
        mpsc::{Receiver, RecvError, TryRecvError},
    },
    thread,
    time::{Duration, Instant},
};

use bytes::Bytes;
use farm_core::{
    id::JobAttempt,
    message::{JobFailure, LatencyClass},
};

use super::{
    Shared,
    adapter::Gpu,
    clock::TimestampPool,
    prepare::{Caches, Prepared, prepare},
    run::{Hung, Run},
};
use crate::{
    executor::{ExecutorConfig, ExecutorEvent, Host, HungDevice, Order},
    spec::DeviceSpec,
};

/// One wait for the device; new orders and aborts are seen after it.
const WAIT_SLICE: Duration = Duration::from_millis(1);
/// Hung devices that may be left behind at once, each with its memory; one more and the device counts as lost.
const MAX_ABANDONED: usize = 3;

/// What the handle sends.
#[derive(Debug)]
pub(super) enum Message {
    Order(Order),
    Abort(JobAttempt),
    /// The handle is being dropped.
    Close,
}

/// The thread's state.
pub(super) struct DeviceThread {
    spec: DeviceSpec,
    config: ExecutorConfig,
    inbox: Receiver<Message>,
    shared: Arc<Shared>,
    host: Box<dyn Host>,
    state: State,
    /// Hung devices whose work has not ended yet.
    abandoned: Arc<AtomicUsize>,
}

/// Everything that lives on one wgpu device, and the jobs on it.
struct State {
    gpu: Gpu,
    caches: Caches,
    timestamps: TimestampPool,
    running: Option<Run>,
    /// Interrupted between two submits; its buffers stay as they are.
    yielded: Option<Run>,
    /// At most one of each class. The order stays at hand: its preparation dies with the device.
    staged: Vec<(Order, Prepared)>,
    /// Orders not yet prepared; at most as many as the device holds.
    waiting: Vec<Order>,
}

impl State {
    /// Whether a prepared order waits for the running job to make way. One that has nothing left to submit ends by itself.
    fn makes_way(&self, running: &Run) -> bool {
        self.yielded.is_none() && running.can_yield() && self.outranks(running.class)
    }

    fn outranks(&self, class: LatencyClass) -> bool {
        self.staged.iter().any(|(order, _)| order.class > class)
    }

    /// Takes the prepared order of the highest class.
    fn take_staged(&mut self) -> Option<Prepared> {
        let (position, _) = self.staged.iter().enumerate().max_by_key(|(_, (order, _))| order.class)?;
        Some(self.staged.remove(position).1)
    }

    /// The order to prepare next: the first of the highest class of which none is prepared.
    fn next_to_prepare(&self) -> Option<usize> {
        let prepared = |class| self.staged.iter().any(|(order, _)| order.class == class);
        let open = self.waiting.iter().enumerate().filter(|(_, order)| !prepared(order.class));
        open.max_by_key(|(position, order)| (order.class, Reverse(*position))).map(|(position, _)| position)
    }

    fn new(gpu: Gpu, config: &ExecutorConfig) -> Self {
        let caches = Caches::new(&gpu, config);
        let timestamps = TimestampPool::default();
        Self {
            gpu,
            caches,
            timestamps,
            running: None,
            yielded: None,
            staged: Vec::new(),
            waiting: Vec::new(),
        }
    }
}

/// Why a round of work ended early.
enum Fault {
    /// The device does not answer.
    Hung(Hung),
    /// The executor's handle is gone.
    Closed,
}

impl DeviceThread {
    pub(super) fn new(
        spec: DeviceSpec,
        gpu: Gpu,
        config: ExecutorConfig,
        inbox: Receiver<Message>,
        shared: Arc<Shared>,
        host: Box<dyn Host>,
    ) -> Self {
        let state = State::new(gpu, &config);
        Self { spec, config, inbox, shared, host, state, abandoned: Arc::default() }
    }

    /// Works until the handle is dropped.
    pub(super) fn run(mut self) {
        loop {
            // wgpu panics where a driver breaks its contract, and naga's depths are its own: neither may take the
            // thread, or the jobs on it would never end.
            let fault = catch_unwind(AssertUnwindSafe(|| self.work()))
                .unwrap_or_else(|panic| Fault::Hung(Hung(panic_text(panic.as_ref()))));
            let reason = match fault {
                Fault::Closed => return,
                Fault::Hung(reason) => reason,
            };
            if let Err(lost) = self.replace_device(&reason) {
                return self.lose(lost);
            }
        }
    }

    /// Rounds of: take messages, prepare, submit, wait.
    fn work(&mut self) -> Fault {
        loop {
            if let Err(RecvError) = self.take_messages() {
                return Fault::Closed;
            }
            self.prepare_next();
            self.submit();
            if let Some(running) = &mut self.state.running
                && let Err(hung) = running.wait(&self.state.gpu, &mut self.state.timestamps, WAIT_SLICE)
            {
                return Fault::Hung(hung);
            }
            self.hand_over();
        }
    }

    /// Takes what has come; sleeps while there is nothing else to do. An error means that the handle is gone.
    fn take_messages(&mut self) -> Result<(), RecvError> {
        let state = &self.state;
        if state.running.is_none() && state.staged.is_empty() && state.waiting.is_empty() {
            let message = self.inbox.recv()?;
            self.take(message)?;
        }
        loop {
            match self.inbox.try_recv() {
                Ok(message) => self.take(message)?,
                Err(TryRecvError::Empty) => return Ok(()),
                Err(TryRecvError::Disconnected) => return Err(RecvError),
            }
        }
    }

    fn take(&mut self, message: Message) -> Result<(), RecvError> {
        match message {
            Message::Order(order) => self.state.waiting.push(order),
            Message::Abort(job) => self.abort(job),
            Message::Close => return Err(RecvError),
        }
        Ok(())
    }

    fn abort(&mut self, job: JobAttempt) {
        let state = &mut self.state;
        if let Some(position) = state.waiting.iter().position(|order| order.job == job) {
            state.waiting.remove(position);
            self.finished(job, 0, Err(JobFailure::Cancelled));
        } else if let Some(position) = state.staged.iter().position(|(order, _)| order.job == job) {
            let (_, prepared) = state.staged.remove(position);
            prepared.held.release(&mut state.caches);
            self.finished(job, 0, Err(JobFailure::Cancelled));
        } else if let Some(mut yielded) = state.yielded.take_if(|yielded| yielded.job == job) {
            yielded.end_with(JobFailure::Cancelled, Instant::now());
            let (device_time_ns, outcome) = yielded.finish(&mut state.caches);
            self.finished(job, device_time_ns, outcome);
        } else if let Some(running) = state.running.as_mut().filter(|running| running.job == job) {
            running.end_with(JobFailure::Cancelled, Instant::now());
        }
    }

    fn submit(&mut self) {
        if self.state.running.as_ref().is_some_and(|running| self.state.makes_way(running)) {
            return;
        }
        let State { gpu, timestamps, running, .. } = &mut self.state;
        if let Some(running) = running {
            running.fill(gpu, timestamps, self.config.submit_target);
        }
    }

    /// Prepares a waiting order, if there is room: the device is free, or one only runs.
    fn prepare_next(&mut self) {
        let queue_free = |state: &State| {
            state.running.as_ref().is_none_or(|running| running.leaves_the_queue_free(&state.gpu))
        };
        while queue_free(&self.state)
            && let Some(position) = self.state.next_to_prepare()
        {
            let order = self.state.waiting.remove(position);
            let job = order.job;
            self.host.preparing(job);
            // A panic in here is the order's: it must not come back.
            let State { gpu, caches, .. } = &mut self.state;
            let prepared =
                catch_unwind(AssertUnwindSafe(|| prepare(gpu, caches, &order, self.host.as_ref())))
                    .unwrap_or_else(|panic| Err(JobFailure::InvalidProgram(panic_text(panic.as_ref()))));
            match prepared {
                Ok(prepared) => {
                    self.state.staged.push((order, prepared));
                    self.host.prepared(job);
                }
                Err(failure) => self.finished(job, 0, Err(failure)),
            }
            self.hand_over();
        }
    }

    /// Ends a job that is over, or interrupts one that has to make way, and starts the next one: its first submits go out
    /// before the old result is copied.
    fn hand_over(&mut self) {
        let over = self.state.running.take_if(|running| running.is_over());
        if let Some(running) = self.state.running.take() {
            if !(running.is_drained() && self.state.makes_way(&running)) {
                self.state.running = Some(running);
                return;
            }
            self.host.event(ExecutorEvent::Yielded { job: running.job });
            self.state.yielded = Some(running.paused(Instant::now()));
        }
        let next = self.next_run(over.as_ref().map_or(0, Run::result_bytes));
        if let Some(over) = over {
            let job = over.job;
            let (device_time_ns, outcome) = over.finish(&mut self.state.caches);
            self.finished(job, device_time_ns, outcome);
        }
        if let Some((next, event)) = next {
            self.host.event(event);
            self.state.running = Some(next);
        }
    }

    /// Starts what is prepared, or lets the interrupted job go on: that goes first, unless it is outranked. The device has enough
    /// to do then until so many bytes are copied.
    fn next_run(&mut self, copied_bytes: u64) -> Option<(Run, ExecutorEvent)> {
        let class = self.state.yielded.as_ref().map(|yielded| yielded.class);
        let yielded = match class {
            Some(class) if !self.state.outranks(class) => self.state.yielded.take(),
            Some(_) | None => None,
        };
        let (mut run, event) = match yielded {
            Some(yielded) => {
                let run = yielded.resumed(Instant::now());
                let event = ExecutorEvent::Resumed { job: run.job };
                (run, event)
            }
            None => {
                let run = Run::new(self.state.take_staged()?, Instant::now());
                let event = ExecutorEvent::Started { job: run.job };
                (run, event)
            }
        };
        let State { gpu, timestamps, .. } = &mut self.state;
        run.fill_for_copy(gpu, timestamps, self.config.submit_target, copied_bytes);
        Some((run, event))
    }

    fn finished(&self, job: JobAttempt, device_time_ns: u64, outcome: Result<Vec<Bytes>, JobFailure>) {
        // First, so that the callback may submit the next one.
        self.shared.held.fetch_sub(1, Ordering::AcqRel);
        self.host.event(ExecutorEvent::Finished { job, device_time_ns, outcome });
    }

    /// Ends the running attempt and the interrupted one, whose state is lost too, leaves the device behind and opens a new one.
    fn replace_device(&mut self, reason: &Hung) -> Result<(), String> {
        tracing::warn!(spec = %self.spec, reason = reason.0, "replacing the device");
        self.fail_running(reason);
        if self.config.hung_device == HungDevice::Lost {
            return Err(reason.0.clone());
        }
        let opened = Gpu::reopen(self.spec);
        let gpu = opened.map_err(|error| format!("{}; it does not open again: {error}", reason.0))?;
        let mut old = mem::replace(&mut self.state, State::new(gpu, &self.config));
        let staged = mem::take(&mut old.staged).into_iter().map(|(order, _)| order);
        self.state.waiting = staged.chain(mem::take(&mut old.waiting)).collect();
        self.leave_behind(old).map_err(|error| format!("{}; {error}", reason.0))
    }

    fn fail_running(&mut self, reason: &Hung) {
        for running in [self.state.running.take(), self.state.yielded.take()].into_iter().flatten() {
            let job = running.job;
            let (device_time_ns, failure) = running.abandon(reason);
            self.finished(job, device_time_ns, Err(failure));
        }
    }

    /// Drops a hung device on a thread of its own: the drop waits until its work ends.
    fn leave_behind(&self, old: State) -> Result<(), String> {
        if self.abandoned.fetch_add(1, Ordering::AcqRel) >= MAX_ABANDONED {
            // Dropping would hang; its memory is the price of a clear error.
            mem::forget(old);
            return Err(format!("{MAX_ABANDONED} hung devices have not ended yet"));
        }
        let abandoned = Arc::clone(&self.abandoned);
        let dispose = move || {
            let _ = catch_unwind(AssertUnwindSafe(|| drop(old)));
            abandoned.fetch_sub(1, Ordering::AcqRel);
        };
        thread::Builder::new()
            .name("device disposal".to_owned())
            .spawn(dispose)
            .map(drop)
            .map_err(|error| format!("no thread to dispose of it: {error}"))
    }

    /// The device is gone for good: every job on it and every one that still comes ends so.
    fn lose(mut self, reason: String) {
        self.shared.lost.store(true, Ordering::Release);
        let failure = || Err(JobFailure::DeviceLost(reason.clone()));
        let staged = mem::take(&mut self.state.staged).into_iter().map(|(order, _)| order);
        let left: Vec<Order> = staged.chain(mem::take(&mut self.state.waiting)).collect();
        match self.config.hung_device {
            HungDevice::Reopened => left.iter().for_each(|order| self.finished(order.job, 0, failure())),
            HungDevice::Lost => {}
        }
        self.host.event(ExecutorEvent::Lost { reason: reason.clone() });
        // An order may have been sent while the flag was being set.
        while let Ok(message) = self.inbox.recv() {
            match message {
                Message::Order(order) => self.finished(order.job, 0, failure()),
                Message::Abort(_) => {}
                Message::Close => return,
            }
        }
    }
}

fn panic_text(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no message");
    format!("panic in the device's thread: {text}")
}
