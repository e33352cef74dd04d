//! Adds two vectors on a farm: 64 jobs of 4,096 floats each.
//!
//! ```text
//! cargo run -p client-sdk --example vector_add -- --coordinator 127.0.0.1:7700
//! ```
//! Without `--coordinator` it takes the address in `GLEANER_COORDINATOR`, else 127.0.0.1:7700. It needs a worker with a
//! device that computes (a GPU, or lavapipe): a simulated one would not add anything, and does not get the jobs.

use std::{
    process::ExitCode,
    sync::{Arc, Mutex},
};

use client_sdk::{
    Access, Content, DispatchError, Farm, FarmError, FarmOptions, Job, JobProgram, JobResult, RetrieveError,
    Task, TaskData, TaskError, TaskGraph,
};

/// The kernel. Parameter `i` of the program is `@group(0) @binding(i)`; a uniform (in any other group) is set by name.
const ADD: &str = "\
@group(0) @binding(0) var<storage, read> a: array<f32>;
@group(0) @binding(1) var<storage, read> b: array<f32>;
@group(0) @binding(2) var<storage, read_write> sum: array<f32>;
@group(1) @binding(0) var<uniform> count: u32;
@compute @workgroup_size(64)
fn add(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x < count {
        sum[id.x] = a[id.x] + b[id.x];
    }
}
";

/// Jobs of the task.
const JOBS: usize = 64;
/// Floats that one job adds.
const JOB_FLOATS: usize = 4_096;
/// The same as the kernel's `count`.
const JOB_COUNT: u32 = 4_096;
/// Bytes of these.
const JOB_BYTES: u64 = JOB_FLOATS as u64 * 4;

/// The task: adds the vectors `a` and `b`.
struct AddVectors {
    a: Vec<f32>,
    b: Vec<f32>,
    /// What every job of the task names; known once `prepare` has run.
    shared: Option<Shared>,
    /// Where jobs put their part of the sum.
    sum: Arc<Mutex<Vec<f32>>>,
}

/// Names of the data that the workers fetch once and keep.
#[derive(Clone, Copy)]
struct Shared {
    module: Content,
    a: Content,
}

impl Task for AddVectors {
    // Before the first job: name the data that all jobs share. Nothing is sent yet; each worker that gets a job asks for
    // what it lacks, once, and keeps it.
    fn prepare(&mut self, data: &mut TaskData) -> Result<(), TaskError> {
        self.shared = Some(Shared {
            module: data.module(ADD),              // a module: WGSL text
            a: data.allocation(to_bytes(&self.a)), // a task allocation: the whole first vector
        });
        Ok(())
    }

    // The jobs, independent of each other. Only a window of them is in flight at a time.
    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        let shared = self.shared.expect("prepare comes first");
        let job = |(number, b): (usize, &[f32])| {
            Box::new(AddPart { number, b: b.to_vec(), shared, sum: Arc::clone(&self.sum) }) as Box<dyn Job>
        };
        self.b.chunks_exact(JOB_FLOATS).enumerate().map(job).collect()
    }
}

/// One job: adds one part of the vectors.
struct AddPart {
    number: usize,
    b: Vec<f32>,
    shared: Shared,
    sum: Arc<Mutex<Vec<f32>>>,
}

impl Job for AddPart {
    // Writes down what the device shall do. Nothing runs here: the program is sent to a worker and replayed there.
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        // The kernel: entry point `add` of the module.
        let add = cmd.function(self.shared.module, "add");

        // The task allocation, bound by the part that this job adds. Offsets of parts are multiples of 256.
        let a = cmd.task_allocation(self.shared.a);
        cmd.param(add, 0, a, self.number as u64 * JOB_BYTES, JOB_BYTES, Access::In)?;

        // A job allocation with this job's own data: it travels with the program and is freed with the job.
        let b = cmd.malloc(JOB_BYTES)?;
        cmd.memcpy_htod_buffer(b, 0, &to_bytes(&self.b))?;
        cmd.param_in(add, 1, b)?;

        // A job allocation for the result, zero at first.
        let sum = cmd.malloc(JOB_BYTES)?;
        cmd.param_in_out(add, 2, sum)?;

        // The uniform `count`, by its name in the module.
        cmd.memcpy_htod(add, "count", &JOB_COUNT.to_le_bytes())?;

        // 64 groups of 64 invocations: one for each float.
        cmd.launch(add, [64, 1, 1])?;

        // The result: one section for each copy.
        cmd.memcpy_dtoh(sum, 0, JOB_BYTES)
    }

    // Takes the result, exactly once, whatever happened to workers on the way.
    fn retrieve(&mut self, result: JobResult) -> Result<(), RetrieveError> {
        // Section 0 is what the first (and only) `memcpy_dtoh` copied; the length is checked.
        let part = result.section(0, JOB_FLOATS * 4)?;
        let mut sum = self.sum.lock().map_err(|_| RetrieveError::application("another job panicked"))?;
        for (to, from) in sum[self.number * JOB_FLOATS..].iter_mut().zip(part.chunks_exact(4)) {
            *to = f32::from_le_bytes([from[0], from[1], from[2], from[3]]);
        }
        Ok(())
    }
}

/// Adds on the farm of the coordinator, and says what came out.
async fn add_on_farm(coordinator: &str) -> Result<Outcome, FarmError> {
    // Whole numbers below 2^24 add exactly in f32, so the sums can be compared for equality.
    let a: Vec<f32> = (0_u16..8).cycle().take(JOBS * JOB_FLOATS).map(f32::from).collect();
    let b: Vec<f32> = (0_u16..1_000).cycle().take(JOBS * JOB_FLOATS).map(f32::from).collect();
    let expected: Vec<f32> = a.iter().zip(&b).map(|(a, b)| a + b).collect();
    let sum = Arc::new(Mutex::new(vec![f32::NAN; JOBS * JOB_FLOATS]));

    // Register at the coordinator under a name that people see in the farm's status.
    let farm = Farm::connect(FarmOptions::new(coordinator, "vector_add")).await?;
    let task = AddVectors { a, b, shared: None, sum: Arc::clone(&sum) };
    let summary = farm.run(TaskGraph::new().task("add", task)).await?;
    // Say goodbye, so that the farm frees what it holds for us at once.
    farm.close().await;

    let sum = sum.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let wrong = sum.iter().zip(&expected).filter(|(found, expected)| found != expected).count();
    let line =
        format!("{} jobs, {} sums, {wrong} wrong, in {:?}", summary.jobs, sum.len(), summary.wall_time);
    Ok(Outcome { line, wrong })
}

/// What came out.
struct Outcome {
    /// For people.
    line: String,
    /// Sums that are not what they should be.
    wrong: usize,
}

fn to_bytes(floats: &[f32]) -> Vec<u8> {
    floats.iter().flat_map(|float| float.to_le_bytes()).collect()
}

#[tokio::main]
async fn main() -> ExitCode {
    let Some(coordinator) = coordinator_from_arguments() else {
        eprintln!("usage: vector_add [--coordinator HOST:PORT]");
        return ExitCode::from(2);
    };
    match add_on_farm(&coordinator).await {
        Ok(Outcome { line, wrong }) => {
            println!("{line}");
            if wrong == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
        }
        Err(error) => {
            eprintln!("vector_add: {error}");
            ExitCode::FAILURE
        }
    }
}

/// The argument, else the environment, else the default; `None` for arguments that mean nothing.
fn coordinator_from_arguments() -> Option<String> {
    let mut arguments = std::env::args().skip(1);
    match (arguments.next().as_deref(), arguments.next(), arguments.next()) {
        (None, ..) => {
            Some(std::env::var("GLEANER_COORDINATOR").unwrap_or_else(|_| "127.0.0.1:7700".to_owned()))
        }
        (Some("--coordinator"), Some(address), None) => Some(address),
        _ => None,
    }
}

/// A job is tested without a farm: its methods are plain methods.
#[cfg(test)]
mod tests {
    use client_sdk::{Bytes, ContentHash, NodeId};
    use farm_core::program::{ProgramQuota, validate};

    use super::*;

    #[test]
    fn programs_are_valid_and_results_land_in_their_place() {
        let content = |number, size_bytes| Content { hash: ContentHash([number; 32]), size_bytes };
        let shared = Shared { module: content(1, ADD.len() as u64), a: content(2, JOBS as u64 * JOB_BYTES) };
        let sum = Arc::new(Mutex::new(vec![f32::NAN; JOBS * JOB_FLOATS]));
        for number in 0..JOBS {
            let mut job = AddPart { number, b: vec![1.0; JOB_FLOATS], shared, sum: Arc::clone(&sum) };
            let mut program = JobProgram::default();
            job.dispatch(&mut program).unwrap();
            let summary = validate(&program, &ProgramQuota::default()).unwrap();
            assert_eq!(summary.sections, [JOB_BYTES]);

            let found: Vec<f32> = (0_u16..4_096).map(|at| f32::from(at) + 0.5).collect();
            let sections = vec![Bytes::from(to_bytes(&found))];
            let result = JobResult { sections, device_time: std::time::Duration::ZERO, node: NodeId(1) };
            job.retrieve(result).unwrap();
            assert_eq!(sum.lock().unwrap()[number * JOB_FLOATS..][..JOB_FLOATS], found);
        }
        assert!(!sum.lock().unwrap().iter().any(|sum| sum.is_nan()), "every place is filled");
    }
}
