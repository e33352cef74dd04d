//! Simulated devices: launches take as long as their cost says, sleep instead of computing, and change no buffer.
//!
//! A farm of them is real but for the kernels: 32 in one process cost one timer thread together. Jobs of no cost
//! complete inside [`SimDevice::submit`], without any thread in between. Host bytes make the round trip: what `MemcpyHtoD`
//! wrote is what `MemcpyDtoH` reads, everything else reads as zeros.

mod timer;

use std::{
    collections::VecDeque,
    fmt,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use bytes::Bytes;
use farm_core::{
    device::{DeviceInfo, DeviceKind, Features, Limits},
    id::JobAttempt,
    message::{CostNs, JobFailure, LatencyClass},
    program::{Buffer, Command, JobProgram, ProgramQuota, validate},
};

pub use self::timer::{SimClock, SimulatedTime, simulate_time};
use crate::{
    error::{Busy, OpenError},
    executor::{DEPTH, ExecutorEvent, Host, Order},
    spec::{DeviceSpec, SimSpec},
};

/// A simulated device.
pub(crate) struct SimDevice {
    shared: Arc<Shared>,
}

/// What the submitter and the timer thread share. A mutex and not a message: a job of no cost has to complete in the
/// submitter's own call, and the state is touched for well under a microsecond at a time.
struct Shared {
    spec: SimSpec,
    host: Box<dyn Host>,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    running: Option<Running>,
    /// Interrupted at a launch boundary.
    yielded: Option<Running>,
    /// At most [`DEPTH`] with the two above.
    staged: VecDeque<Order>,
    /// Tells the running job's alarm from those of jobs that were aborted before.
    generation: u64,
    /// Events not yet handed out; bounded by two events a held job, and two an interruption.
    outbox: VecDeque<ExecutorEvent>,
    /// Some thread is handing events out: it takes the new ones too, so that their order holds.
    emitting: bool,
}

struct Running {
    job: JobAttempt,
    class: LatencyClass,
    program: Arc<JobProgram>,
    sections: Vec<u64>,
    /// When it began to run, for the first time or again.
    since: Instant,
    /// Device time before that.
    done: Duration,
    /// Device time at which it next ends or yields.
    until: Duration,
    /// Device time of the whole job.
    duration: Duration,
    /// The duration is the order's limit, not the program's cost.
    cut_short: bool,
}

impl SimDevice {
    pub(crate) fn start(spec: SimSpec, host: Box<dyn Host>) -> Result<(Self, DeviceInfo), OpenError> {
        timer::ensure().map_err(|source| OpenError::Thread { spec: DeviceSpec::Sim(spec), source })?;
        let info = DeviceInfo {
            name: format!("simulated (speed {})", spec.speed),
            kind: DeviceKind::Simulated,
            score: spec.score,
            features: Features::INT64
                .union(Features::FLOAT16)
                .union(Features::SUBGROUP)
                .union(Features::TIMESTAMP),
            limits: Limits::UNBOUNDED,
        };
        let shared = Arc::new(Shared { spec, host, state: Mutex::default() });
        Ok((Self { shared }, info))
    }

    pub(crate) fn submit(&self, order: Order) -> Result<(), Busy> {
        let mut state = self.shared.lock();
        let on_it = usize::from(state.running.is_some()) + usize::from(state.yielded.is_some());
        if on_it + state.staged.len() >= DEPTH {
            return Err(Busy::Full { job: order.job });
        }
        state.staged.push_back(order);
        self.shared.promote(&mut state);
        self.shared.yield_soon(&mut state);
        self.shared.emit(state);
        Ok(())
    }

    pub(crate) fn abort(&self, job: JobAttempt) {
        let mut state = self.shared.lock();
        if let Some(position) = state.staged.iter().position(|order| order.job == job) {
            state.staged.remove(position);
            state.finish(job, 0, Err(JobFailure::Cancelled));
        } else if let Some(yielded) = state.yielded.take_if(|yielded| yielded.job == job) {
            state.finish(job, nanoseconds(yielded.done), Err(JobFailure::Cancelled));
        } else if let Some(running) = state.running.take_if(|running| running.job == job) {
            state.finish(job, nanoseconds(running.device_time()), Err(JobFailure::Cancelled));
            self.shared.promote(&mut state);
        }
        self.shared.emit(state);
    }
}

impl fmt::Debug for SimDevice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SimDevice").field("spec", &self.shared.spec).finish_non_exhaustive()
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        // No callback runs under the lock, so a panic cannot leave the state half changed.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The timer's call: the job of `generation` has had its time, if it still runs.
    fn alarm(self: &Arc<Self>, generation: u64) {
        let mut state = self.lock();
        if state.generation != generation {
            return;
        }
        if let Some(running) = state.running.take() {
            if running.until == running.duration {
                state.complete(running);
            } else if state.is_outranked(running.class) {
                state.outbox.push_back(ExecutorEvent::Yielded { job: running.job });
                state.yielded = Some(Running { done: running.until, ..running });
            } else {
                // The job that it was to make way for has been taken back.
                let until = running.duration;
                self.run(&mut state, Running { done: running.until, until, ..running });
            }
            self.promote(&mut state);
        }
        self.emit(state);
    }

    /// Gives a free device to the next job: the highest class first, one that yielded before staged ones of its class.
    fn promote(self: &Arc<Self>, state: &mut State) {
        while state.running.is_none() {
            let class = state.yielded.as_ref().map(|yielded| yielded.class);
            if class.is_some_and(|class| !state.is_outranked(class))
                && let Some(yielded) = state.yielded.take()
            {
                state.outbox.push_back(ExecutorEvent::Resumed { job: yielded.job });
                let until = yielded.duration;
                self.run(state, Running { until, ..yielded });
            } else if let Some(order) = state.take_staged() {
                self.begin(state, order);
            } else {
                return;
            }
        }
    }

    fn begin(self: &Arc<Self>, state: &mut State, order: Order) {
        let Order { job, class, program, limit, .. } = order;
        state.outbox.push_back(ExecutorEvent::Started { job });
        let summary = match validate(&program, &ProgramQuota::default()) {
            Ok(summary) => summary,
            Err(error) => {
                state.finish(job, 0, Err(JobFailure::InvalidProgram(error.to_string())));
                return;
            }
        };
        let cost = duration_of(summary.cost, self.spec.speed);
        let duration = cost.min(limit);
        let running = Running {
            job,
            class,
            program,
            sections: summary.sections,
            since: timer::now(),
            done: Duration::ZERO,
            until: duration,
            duration,
            cut_short: cost > limit,
        };
        if duration.is_zero() {
            state.complete(running);
        } else {
            self.run(state, running);
        }
    }

    /// Lets a job run from now on.
    fn run(self: &Arc<Self>, state: &mut State, running: Running) {
        let running = Running { since: timer::now(), ..running };
        self.wake_for(state, &running);
        state.running = Some(running);
        self.yield_soon(state);
    }

    /// A running job that has to make way does so at its next launch boundary.
    fn yield_soon(self: &Arc<Self>, state: &mut State) {
        let Some(running) = &state.running else { return };
        if state.yielded.is_some() || running.until < running.duration || !state.is_outranked(running.class) {
            return;
        }
        let until = boundary(&running.program, self.spec.speed, running.device_time()).min(running.duration);
        let Some(running) = state.running.take() else { return };
        let running = Running { until, ..running };
        self.wake_for(state, &running);
        state.running = Some(running);
    }

    fn wake_for(self: &Arc<Self>, state: &mut State, running: &Running) {
        state.generation += 1;
        let at = running.since + running.until.saturating_sub(running.done);
        timer::wake_at(at, Arc::downgrade(self), state.generation);
    }

    /// Hands the outbox out, without the lock while a callback runs: it may submit the next job from inside.
    fn emit<'a>(&'a self, mut state: MutexGuard<'a, State>) {
        if state.emitting {
            return;
        }
        state.emitting = true;
        while let Some(event) = state.outbox.pop_front() {
            drop(state);
            self.host.event(event);
            state = self.lock();
        }
        state.emitting = false;
    }
}

impl Running {
    fn device_time(&self) -> Duration {
        (self.done + timer::now().saturating_duration_since(self.since)).min(self.until)
    }
}

impl State {
    /// Whether an order of a higher class is staged.
    fn is_outranked(&self, class: LatencyClass) -> bool {
        self.staged.iter().any(|order| order.class > class)
    }

    /// The first of the highest class.
    fn take_staged(&mut self) -> Option<Order> {
        let class = self.staged.iter().map(|order| order.class).max()?;
        let first = self.staged.iter().position(|order| order.class == class)?;
        self.staged.remove(first)
    }

    fn complete(&mut self, running: Running) {
        let outcome = if running.cut_short {
            Err(JobFailure::Timeout)
        } else {
            Ok(sections(&running.program, &running.sections))
        };
        self.finish(running.job, nanoseconds(running.duration), outcome);
    }

    fn finish(&mut self, job: JobAttempt, device_time_ns: u64, outcome: Result<Vec<Bytes>, JobFailure>) {
        self.outbox.push_back(ExecutorEvent::Finished { job, device_time_ns, outcome });
    }
}

/// The end of the launch that runs after so much device time of a program: the next point at which it can be interrupted.
fn boundary(program: &JobProgram, speed: f64, device_time: Duration) -> Duration {
    let mut cost = CostNs(0);
    for command in program.commands() {
        if let Command::Launch { cost: of_launch, .. } = command {
            cost.0 = cost.0.saturating_add(of_launch.0);
            let end = duration_of(cost, speed);
            if end >= device_time {
                return end;
            }
        }
    }
    Duration::MAX
}

/// How long a launch of `cost` takes at `speed`.
fn duration_of(cost: CostNs, speed: f64) -> Duration {
    // A cost is far below 2^53 ns (104 days) where its rounding would be seen.
    Duration::try_from_secs_f64(cost.0 as f64 / speed / 1e9).unwrap_or(Duration::MAX)
}

fn nanoseconds(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}

/// What a device without kernels reads back from a valid program: `MemcpyHtoD` bytes over zeros.
fn sections(program: &JobProgram, lengths: &[u64]) -> Vec<Bytes> {
    if lengths.is_empty() {
        return Vec::new();
    }
    let bytes_of = |length: u64| usize::try_from(length).expect("a valid program's result fits the quota");
    let mut payload = vec![0_u8; lengths.iter().copied().map(bytes_of).sum()];
    let mut start = 0;
    for (index, command) in program.commands().iter().enumerate() {
        if let Command::MemcpyDtoH { buffer, offset_bytes, size_bytes } = *command {
            let end = start + bytes_of(size_bytes);
            let earlier = &program.commands()[..index];
            overlay(&mut payload[start..end], earlier, buffer, offset_bytes);
            start = end;
        }
    }
    let payload = Bytes::from(payload);
    let mut start = 0;
    let mut cut = |&length: &u64| {
        let end = start + bytes_of(length);
        let section = payload.slice(start..end);
        start = end;
        section
    };
    lengths.iter().map(&mut cut).collect()
}

/// Writes what `commands` copied into `wanted` onto the part of it that begins at `part_offset`.
fn overlay(part: &mut [u8], commands: &[Command], wanted: Buffer, part_offset: u64) {
    for command in commands {
        let Command::MemcpyHtoD { buffer, offset_bytes, bytes } = command else { continue };
        if *buffer != wanted {
            continue;
        }
        let (skip_source, skip_part) =
            (part_offset.saturating_sub(*offset_bytes), offset_bytes.saturating_sub(part_offset));
        let (Ok(skip_source), Ok(skip_part)) = (usize::try_from(skip_source), usize::try_from(skip_part))
        else {
            continue;
        };
        if let (Some(source), Some(target)) = (bytes.get(skip_source..), part.get_mut(skip_part..)) {
            let count = source.len().min(target.len());
            target[..count].copy_from_slice(&source[..count]);
        }
    }
}
