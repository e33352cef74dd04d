//! Running a prepared job: the second half of the program interpreter.
//!
//! Work goes out in submits of bounded time, a few on the way at once; each end of a submit is a yield point where an
//! abort or the job's limit takes hold. It never waits longer than it is told to.

use std::{
    collections::VecDeque,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use bytes::Bytes;
use farm_core::{
    device::DeviceKind,
    id::JobAttempt,
    message::{JobFailure, LatencyClass},
};

use super::{
    adapter::Gpu,
    clock::{MAX_LAUNCHES_PER_SUBMIT, TimestampPool, Timestamps, WallClock},
    pipeline::Pipeline,
    prepare::{Caches, Held, Launch, Prepared, Step},
};

/// Submits on the way at once on a GPU: one runs, one is next without a gap, one is being recorded.
const MAX_IN_FLIGHT: usize = 3;
/// On a software adapter: lavapipe (Mesa 22.3) blocks in a submit until the one before it has run, and with it the thread
/// that has to keep the limits.
const MAX_IN_FLIGHT_CPU: usize = 1;
/// Before a result is copied one more goes out for each of these bytes of it: the copy takes about as long as that runs, and no
/// submit follows meanwhile.
const COPY_BYTES_A_SUBMIT: u64 = 16 << 20;
/// At most so many: an interruption waits for them.
const MAX_FOR_COPY: usize = 16;
/// How long submits on the way may still take after the job is to end; a device that needs longer counts as hung.
const GRACE: Duration = Duration::from_secs(2);

/// The device has stopped answering.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Hung(pub(crate) String);

/// A job on the device.
#[derive(Debug)]
pub(crate) struct Run {
    pub(crate) job: JobAttempt,
    pub(crate) class: LatencyClass,
    /// When it began, moved on by its interruptions.
    started: Instant,
    paused: Option<Instant>,
    limit: Duration,
    steps: VecDeque<Step>,
    /// Layers of the first step's launch that earlier runs did.
    done_z: u32,
    sections: Vec<u64>,
    held: Held,
    in_flight: VecDeque<InFlight>,
    clock: WallClock,
    device_time: Duration,
    mapped: Arc<AtomicBool>,
    /// The job is to end with this; nothing more is submitted.
    ending: Option<(JobFailure, Instant)>,
}

#[derive(Debug)]
struct InFlight {
    index: wgpu::SubmissionIndex,
    submitted: Instant,
    launches: Vec<Recorded>,
    timestamps: Option<Timestamps>,
}

#[derive(Debug)]
struct Recorded {
    pipeline: Arc<Pipeline>,
    groups: u64,
    estimate: Duration,
}

impl Run {
    pub(crate) fn new(prepared: Prepared, now: Instant) -> Self {
        let Prepared { job, class, limit, steps, sections, held } = prepared;
        Self {
            job,
            class,
            started: now,
            paused: None,
            limit,
            steps: steps.into(),
            done_z: 0,
            sections,
            held,
            in_flight: VecDeque::with_capacity(MAX_IN_FLIGHT),
            clock: WallClock::new(now),
            device_time: Duration::ZERO,
            mapped: Arc::default(),
            ending: None,
        }
    }

    /// Ends the job with `failure` as soon as what is on the way is done.
    pub(crate) fn end_with(&mut self, failure: JobFailure, now: Instant) {
        self.ending.get_or_insert((failure, now));
    }

    /// Bytes that [`Self::finish`] will copy.
    pub(crate) fn result_bytes(&self) -> u64 {
        if self.ending.is_some() { 0 } else { self.sections.iter().sum() }
    }

    /// Nothing is left to submit or to wait for.
    pub(crate) fn is_over(&self) -> bool {
        self.in_flight.is_empty() && (self.steps.is_empty() || self.ending.is_some())
    }

    /// Something is left to submit, and nothing on the way stands against making way.
    pub(crate) fn can_yield(&self) -> bool {
        !self.steps.is_empty() && self.ending.is_none()
    }

    /// Nothing of it is on the device's queue.
    pub(crate) fn is_drained(&self) -> bool {
        self.in_flight.is_empty()
    }

    /// Interrupted: its limit does not run on.
    pub(crate) fn paused(self, now: Instant) -> Self {
        Self { paused: Some(now), ..self }
    }

    /// Goes on.
    pub(crate) fn resumed(self, now: Instant) -> Self {
        let pause = self.paused.map_or(Duration::ZERO, |since| now.saturating_duration_since(since));
        Self { started: self.started + pause, paused: None, ..self }
    }

    /// Whether submits for other jobs would not block: see [`MAX_IN_FLIGHT_CPU`].
    pub(crate) fn leaves_the_queue_free(&self, gpu: &Gpu) -> bool {
        gpu.kind == DeviceKind::Gpu || self.in_flight.is_empty()
    }

    /// Submits as much as may be on the way at once.
    pub(crate) fn fill(&mut self, gpu: &Gpu, timestamps: &mut TimestampPool, target: Duration) {
        self.fill_for_copy(gpu, timestamps, target, 0);
    }

    /// The same before a result of another job of so many bytes is copied.
    pub(crate) fn fill_for_copy(
        &mut self,
        gpu: &Gpu,
        timestamps: &mut TimestampPool,
        target: Duration,
        copied_bytes: u64,
    ) {
        let more = usize::try_from(copied_bytes / COPY_BYTES_A_SUBMIT).unwrap_or(usize::MAX);
        let most = match gpu.kind {
            DeviceKind::Gpu => MAX_IN_FLIGHT + more.min(MAX_FOR_COPY),
            DeviceKind::Cpu | DeviceKind::Simulated => MAX_IN_FLIGHT_CPU,
        };
        while self.ending.is_none() && !self.steps.is_empty() && self.in_flight.len() < most {
            let command = self.next_command();
            match gpu.scoped(|| self.submit(gpu, timestamps, target)) {
                Ok(submitted) => self.in_flight.push_back(submitted),
                Err(refusal) => {
                    self.end_with(refusal.into_failure(&format!("command {command}")), Instant::now());
                }
            }
        }
    }

    /// Waits for the oldest submit, at most `patience`.
    pub(crate) fn wait(
        &mut self,
        gpu: &Gpu,
        timestamps: &mut TimestampPool,
        patience: Duration,
    ) -> Result<(), Hung> {
        let mut patience = patience;
        while let Some(oldest) = self.in_flight.front() {
            let poll = wgpu::PollType::Wait {
                submission_index: Some(oldest.index.clone()),
                timeout: Some(patience),
            };
            match gpu.device.poll(poll) {
                Ok(_) => {}
                Err(wgpu::PollError::Timeout) => break,
                Err(error) => return Err(Hung(error.to_string())),
            }
            let now = Instant::now();
            if let Some(done) = self.in_flight.pop_front() {
                self.account(gpu, done, timestamps, now);
            }
            // The others may have ended meanwhile: see, but do not wait.
            patience = Duration::ZERO;
        }
        self.check(gpu)
    }

    fn check(&mut self, gpu: &Gpu) -> Result<(), Hung> {
        let now = Instant::now();
        if gpu.is_lost() {
            return Err(Hung("the driver gave the device up".to_owned()));
        }
        match &self.ending {
            None if !self.overdue(now).is_zero() && !self.is_over() => {
                self.ending = Some((JobFailure::Timeout, now));
            }
            Some((_, since)) if !self.in_flight.is_empty() => {
                // A cancelled job's launch may take what the job's limit allows; it is no sign of a hung device.
                let overdue = now.saturating_duration_since(*since).min(self.overdue(now));
                if overdue > GRACE {
                    return Err(Hung(format!("a submit did not end within {GRACE:?} after its job's limit")));
                }
            }
            None | Some(_) => {}
        }
        Ok(())
    }

    fn overdue(&self, now: Instant) -> Duration {
        now.saturating_duration_since(self.started).saturating_sub(self.limit)
    }

    /// The job's outcome, once it is over: takes the result out of the mapped memory and gives everything back.
    pub(crate) fn finish(mut self, caches: &mut Caches) -> (u64, Result<Vec<Bytes>, JobFailure>) {
        let outcome = match self.ending.take() {
            Some((failure, _)) => Err(failure),
            None => self.take_result(),
        };
        if outcome.is_err() {
            // It may still be mapped or about to be; a fresh one costs little.
            self.held.readback = None;
        }
        self.held.release(caches);
        (u64::try_from(self.device_time.as_nanos()).unwrap_or(u64::MAX), outcome)
    }

    /// How it ends when the device is gone.
    pub(crate) fn abandon(self, reason: &Hung) -> (u64, JobFailure) {
        let failure = match self.ending {
            Some((failure, _)) => failure,
            None => JobFailure::DeviceLost(reason.0.clone()),
        };
        (u64::try_from(self.device_time.as_nanos()).unwrap_or(u64::MAX), failure)
    }

    fn take_result(&self) -> Result<Vec<Bytes>, JobFailure> {
        let Some(readback) = &self.held.readback else { return Ok(Vec::new()) };
        let length: u64 = self.sections.iter().sum();
        let lost = |reason: &str| JobFailure::DeviceLost(format!("readback: {reason}"));
        if !self.mapped.load(Ordering::Acquire) {
            return Err(lost("the result's memory was not mapped"));
        }
        let view = readback.buffer.get_mapped_range(..length).map_err(|error| lost(&error.to_string()))?;
        // The one move of the result's bytes on the host.
        let payload = Bytes::copy_from_slice(&view);
        drop(view);
        readback.buffer.unmap();
        let mut start = 0;
        let cut = self.sections.iter().map(|&length| {
            let end = start + usize::try_from(length).expect("a mapped length fits the address space");
            let section = payload.slice(start..end);
            start = end;
            section
        });
        Ok(cut.collect())
    }

    fn next_command(&self) -> usize {
        let launch = self.steps.iter().find_map(|step| match step {
            Step::Launch(launch) => Some(launch.command),
            Step::Copy { .. } => None,
        });
        launch.unwrap_or_default()
    }

    /// Records and submits the next steps: as many as should take `target` together, one where that is unknown.
    fn submit(&mut self, gpu: &Gpu, pool: &mut TimestampPool, target: Duration) -> InFlight {
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let mut timestamps = pool.take(gpu);
        let mut launches = Vec::new();
        let mut budget = target;
        while let Some(step) = self.steps.front() {
            let whole = match step {
                Step::Copy { source, source_offset, target, target_offset, size_bytes } => {
                    encoder.copy_buffer_to_buffer(
                        source,
                        *source_offset,
                        target,
                        *target_offset,
                        *size_bytes,
                    );
                    true
                }
                Step::Launch(launch) => {
                    let layers = layers(launch, self.done_z, budget);
                    let groups = groups_of(launch.groups, layers);
                    let estimate = launch.pipeline.pace.estimate(groups);
                    let fits = estimate.is_some_and(|estimate| estimate <= budget);
                    if !launches.is_empty() && (!fits || launches.len() == MAX_LAUNCHES_PER_SUBMIT as usize) {
                        break;
                    }
                    record(gpu, &mut encoder, launch, self.done_z, layers, timestamps.as_mut());
                    budget = estimate.map_or(Duration::ZERO, |estimate| budget.saturating_sub(estimate));
                    launches.push(Recorded {
                        pipeline: Arc::clone(&launch.pipeline),
                        groups,
                        estimate: estimate.unwrap_or_default(),
                    });
                    self.done_z += layers;
                    self.done_z == launch.groups[2]
                }
            };
            if whole {
                self.steps.pop_front();
                self.done_z = 0;
            }
            if budget.is_zero() && !matches!(self.steps.front(), Some(Step::Copy { .. })) {
                break;
            }
        }
        if let Some(timestamps) = &timestamps {
            timestamps.resolve(&mut encoder);
        }
        let index = gpu.queue.submit([encoder.finish()]);
        if let Some(timestamps) = &timestamps {
            timestamps.request();
        }
        if self.steps.is_empty() {
            self.request_result();
        }
        InFlight { index, submitted: Instant::now(), launches, timestamps }
    }

    fn request_result(&self) {
        if let Some(readback) = &self.held.readback {
            let mapped = Arc::clone(&self.mapped);
            let length: u64 = self.sections.iter().sum();
            readback.buffer.map_async(wgpu::MapMode::Read, ..length, move |outcome| {
                mapped.store(outcome.is_ok(), Ordering::Release);
            });
        }
    }

    /// Charges the job for a submit, and tells its pipelines what their runs took.
    fn account(&mut self, gpu: &Gpu, done: InFlight, pool: &mut TimestampPool, now: Instant) {
        let wall = self.clock.charge(done.submitted, now);
        let measured = done.timestamps.and_then(|mut timestamps| {
            let durations = timestamps.read(gpu.timestamp_period_ns?);
            pool.give(timestamps);
            durations
        });
        if let Some(durations) = measured {
            for (launch, duration) in done.launches.iter().zip(durations) {
                launch.pipeline.pace.observe(launch.groups, duration);
                self.device_time += duration;
            }
            return;
        }
        self.device_time += wall;
        // Wall time is of the whole submit: its launches share it as they were estimated.
        let estimated: Duration = done.launches.iter().map(|launch| launch.estimate).sum();
        for launch in &done.launches {
            let share = if estimated.is_zero() {
                1.0 / done.launches.len() as f64
            } else {
                launch.estimate.as_secs_f64() / estimated.as_secs_f64()
            };
            launch.pipeline.pace.observe(launch.groups, wall.mul_f64(share));
        }
    }
}

/// How many layers of a launch to record next: all of them if it cannot be cut.
fn layers(launch: &Launch, done_z: u32, budget: Duration) -> u32 {
    let remaining = launch.groups[2] - done_z;
    match &launch.slices {
        None => remaining,
        Some(slices) => {
            let layer = groups_of(launch.groups, 1);
            launch.pipeline.pace.layers(layer, remaining, slices.max_groups_z, budget)
        }
    }
}

fn groups_of([x, y, _]: [u32; 3], layers: u32) -> u64 {
    u64::from(x).saturating_mul(u64::from(y)).saturating_mul(u64::from(layers))
}

fn record(
    gpu: &Gpu,
    encoder: &mut wgpu::CommandEncoder,
    launch: &Launch,
    first_z: u32,
    layers: u32,
    timestamps: Option<&mut Timestamps>,
) {
    let timestamp_writes = timestamps.map(Timestamps::next_launch);
    let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: None, timestamp_writes });
    pass.set_pipeline(&launch.pipeline.raw);
    for (group, bind_group) in (0_u32..).zip(&launch.bind_groups) {
        if let Some(bind_group) = bind_group {
            pass.set_bind_group(group, bind_group, &[]);
        }
    }
    if let Some(slices) = &launch.slices {
        let (group, bind_group) = slices.bind(gpu, &launch.pipeline, first_z);
        pass.set_bind_group(group, &bind_group, &[]);
    }
    let [x, y, _] = launch.groups;
    pass.dispatch_workgroups(x, y, layers);
}
