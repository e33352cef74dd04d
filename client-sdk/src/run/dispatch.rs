//! Turning jobs into encoded programs: `dispatch()`, the one validation, the encoding. Side by side on several threads
//! where a chunk is worth it. Never sends anything.

use std::{
    collections::HashSet,
    panic::{AssertUnwindSafe, catch_unwind},
    thread,
    time::{Duration, Instant},
};

use bytes::Bytes;
use farm_core::{
    device::{Limits, Requirements},
    id::{ContentHash, JobIndex},
    message::{CostNs, LatencyClass, Priority},
    program::{
        Command, Content, DispatchError, JobProgram, ProgramError, ProgramQuota, ProgramSummary, validate,
    },
};
use proto::codec;

use crate::{
    error::FarmError,
    job::{Job, JobResult, RetrieveError},
};

/// Work that a further thread must get to be worth starting.
const THREAD_WORTH: Duration = Duration::from_millis(1);

/// A job's program, ready to be sent.
#[derive(Debug)]
pub(super) struct Dispatched {
    pub(super) program: Bytes,
    pub(super) contents: Vec<Content>,
    /// The one that the program names first.
    pub(super) module: Option<ContentHash>,
    pub(super) cost: CostNs,
    pub(super) class: LatencyClass,
    pub(super) priority: Priority,
    needs: Limits,
}

/// What a chunk of jobs gave.
#[derive(Debug)]
pub(super) struct DispatchedChunk {
    /// In the order of the jobs.
    pub(super) jobs: Vec<Dispatched>,
    /// Wall time of one job's dispatch, for the next chunk's threads.
    pub(super) time_each: Duration,
}

/// Why one job of a chunk could not be dispatched.
#[derive(Debug)]
pub(super) enum DispatchFault {
    Verb(DispatchError),
    Program(ProgramError),
    Encode(codec::CodecError),
    UnknownContent(Content),
    Panicked(String),
}

impl DispatchFault {
    pub(super) fn into_error(self, task: &str, job: JobIndex) -> FarmError {
        let task = task.to_owned();
        match self {
            Self::Verb(error) => FarmError::Dispatch { task, job, error },
            Self::Program(error) => FarmError::Program { task, job, error },
            Self::Encode(error) => FarmError::Encode { task, job, reason: error.to_string() },
            Self::UnknownContent(content) => FarmError::UnknownContent { task, job, content },
            Self::Panicked(message) => FarmError::Panicked { task, stage: "dispatch", message },
        }
    }
}

/// Dispatches a chunk of jobs. `time_each` is what one took in the chunk before; zero if there was none.
///
/// # Errors
/// The offset in `jobs` of the first job (in order) that failed, and why.
pub(super) fn dispatch_chunk(
    jobs: &mut [Box<dyn Job>],
    known: &HashSet<Content>,
    time_each: Duration,
) -> Result<DispatchedChunk, (usize, DispatchFault)> {
    let started = Instant::now();
    let dispatched = match threads_for(jobs.len(), time_each) {
        1 => dispatch_in_order(jobs, known)?,
        threads => dispatch_side_by_side(jobs, known, threads)?,
    };
    let count = u32::try_from(jobs.len()).unwrap_or(u32::MAX).max(1);
    // The time of one job on one thread is at most the wall time times the threads; what counts next time is the wall.
    Ok(DispatchedChunk { jobs: dispatched, time_each: started.elapsed() / count })
}

fn threads_for(jobs: usize, time_each: Duration) -> usize {
    let work = time_each.saturating_mul(u32::try_from(jobs).unwrap_or(u32::MAX));
    let worth = usize::try_from(work.as_nanos() / THREAD_WORTH.as_nanos()).unwrap_or(usize::MAX);
    let cores = thread::available_parallelism().map_or(1, usize::from);
    worth.min(cores).min(jobs).max(1)
}

fn dispatch_side_by_side(
    jobs: &mut [Box<dyn Job>],
    known: &HashSet<Content>,
    threads: usize,
) -> Result<Vec<Dispatched>, (usize, DispatchFault)> {
    let part = jobs.len().div_ceil(threads);
    let parts: Vec<_> = thread::scope(|scope| {
        let running: Vec<_> =
            jobs.chunks_mut(part).map(|jobs| scope.spawn(move || dispatch_in_order(jobs, known))).collect();
        running
            .into_iter()
            .map(|thread| thread.join().expect("dispatch catches the panics of jobs"))
            .collect()
    });
    let mut dispatched = Vec::with_capacity(jobs.len());
    for (at, outcome) in parts.into_iter().enumerate() {
        dispatched.extend(outcome.map_err(|(offset, fault)| (at * part + offset, fault))?);
    }
    Ok(dispatched)
}

fn dispatch_in_order(
    jobs: &mut [Box<dyn Job>],
    known: &HashSet<Content>,
) -> Result<Vec<Dispatched>, (usize, DispatchFault)> {
    let quota = ProgramQuota::default();
    let dispatch = |(at, job): (usize, &mut Box<dyn Job>)| {
        dispatch_one(job.as_mut(), known, &quota).map_err(|fault| (at, fault))
    };
    jobs.iter_mut().enumerate().map(dispatch).collect()
}

fn dispatch_one(
    job: &mut dyn Job,
    known: &HashSet<Content>,
    quota: &ProgramQuota,
) -> Result<Dispatched, DispatchFault> {
    let mut program = JobProgram::default();
    let (cost, class, priority) = catch_panic(|| {
        job.dispatch(&mut program)?;
        Ok((job.cost(), job.latency_class(), job.priority()))
    })
    .map_err(DispatchFault::Panicked)?
    .map_err(DispatchFault::Verb)?;
    let summary = validate(&program, quota).map_err(DispatchFault::Program)?;
    let needs = needs_of(&summary);
    let cost = if cost == CostNs(0) { summary.cost } else { cost };
    let mut contents = summary.allocations;
    contents.extend(summary.modules);
    if let Some(content) = contents.iter().find(|content| !known.contains(content)) {
        return Err(DispatchFault::UnknownContent(*content));
    }
    let module = program.commands().iter().find_map(|command| match command {
        Command::Function { module, .. } => Some(module.hash),
        _ => None,
    });
    let program = codec::encode_program(&program).map_err(DispatchFault::Encode)?;
    Ok(Dispatched { program, contents, module, cost, class, priority, needs })
}

const fn needs_of(summary: &ProgramSummary) -> Limits {
    Limits {
        memory_bytes: summary.memory_bytes,
        buffer_bytes: summary.largest_buffer_bytes,
        binding_bytes: summary.largest_binding_bytes,
        storage_buffers: summary.storage_buffers,
        ..Limits::NONE
    }
}

/// What every job of a batch needs, with one more in it: the task's word, and the largest of what the programs say.
pub(super) fn needs_with(most: Requirements, job: &Dispatched) -> Requirements {
    let limits = Limits {
        memory_bytes: most.limits.memory_bytes.max(job.needs.memory_bytes),
        buffer_bytes: most.limits.buffer_bytes.max(job.needs.buffer_bytes),
        binding_bytes: most.limits.binding_bytes.max(job.needs.binding_bytes),
        storage_buffers: most.limits.storage_buffers.max(job.needs.storage_buffers),
        ..most.limits
    };
    Requirements { limits, ..most }
}

/// `retrieve()`, with a panic as a value.
pub(super) fn retrieve(
    job: &mut dyn Job,
    result: JobResult,
    task: &str,
    index: JobIndex,
) -> Result<(), FarmError> {
    let outcome: Result<(), RetrieveError> = catch_panic(|| job.retrieve(result))
        .map_err(|message| FarmError::Panicked { task: task.to_owned(), stage: "retrieve", message })?;
    outcome.map_err(|error| FarmError::Retrieve { task: task.to_owned(), job: index, error })
}

/// Runs the application's code; a panic becomes its text. What the code has half done is not looked at again: the run
/// ends.
pub(super) fn catch_panic<T>(code: impl FnOnce() -> T) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(code)).map_err(|payload| {
        payload
            .downcast_ref::<&str>()
            .map(|text| (*text).to_owned())
            .or_else(|| payload.downcast_ref::<String>().cloned())
            .unwrap_or_else(|| "no text".to_owned())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fails, panics or names an unknown content at chosen indices.
    struct Picky {
        index: u64,
        fault: Option<&'static str>,
    }

    impl Job for Picky {
        fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
            match self.fault {
                None => {
                    let buffer = cmd.malloc(4 * (self.index + 1))?;
                    cmd.memcpy_dtoh(buffer, 0, 4)
                }
                Some("verb") => cmd.malloc(3).map(|_| ()),
                Some("content") => {
                    cmd.task_allocation(Content { hash: ContentHash([7; 32]), size_bytes: 4 });
                    Ok(())
                }
                Some(text) => panic!("{text}"),
            }
        }

        fn retrieve(&mut self, _: JobResult) -> Result<(), RetrieveError> {
            Ok(())
        }
    }

    fn jobs(count: u64, fault_at: Option<(u64, &'static str)>) -> Vec<Box<dyn Job>> {
        let job = |index| {
            let fault = fault_at.filter(|(at, _)| *at == index).map(|(_, fault)| fault);
            Box::new(Picky { index, fault }) as Box<dyn Job>
        };
        (0..count).map(job).collect()
    }

    #[test]
    fn threads_keep_the_order_of_jobs() {
        let known = HashSet::new();
        let slow = Duration::from_millis(10);
        let chunk = dispatch_chunk(&mut jobs(37, None), &known, slow).unwrap();
        let inline = dispatch_in_order(&mut jobs(37, None), &known).unwrap();
        let programs = |jobs: &[Dispatched]| jobs.iter().map(|job| job.program.clone()).collect::<Vec<_>>();
        assert_eq!(programs(&chunk.jobs), programs(&inline));
        assert_ne!(chunk.jobs[0].program, chunk.jobs[1].program, "the programs differ, so their order shows");
    }

    #[test]
    fn the_first_fault_is_named_by_its_offset() {
        let known = HashSet::new();
        for time_each in [Duration::ZERO, Duration::from_millis(10)] {
            let fault =
                |fault| dispatch_chunk(&mut jobs(20, Some((13, fault))), &known, time_each).unwrap_err();
            assert!(matches!(fault("verb"), (13, DispatchFault::Verb(DispatchError::Size { .. }))));
            assert!(matches!(fault("oh no"), (13, DispatchFault::Panicked(text)) if text == "oh no"));
        }
    }

    #[test]
    fn small_work_stays_on_its_thread() {
        assert_eq!(threads_for(1, Duration::from_secs(1)), 1);
        assert_eq!(threads_for(4_096, Duration::ZERO), 1);
        assert_eq!(threads_for(100, Duration::from_micros(3)), 1);
    }
}
