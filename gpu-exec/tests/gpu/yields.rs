//! A batch job that makes way for an interactive one: no launch of it is lost or doubled.

use bytes::Bytes;
use farm_core::{
    id::ContentHash,
    message::{JobFailure, LatencyClass},
    program::JobProgram,
};
use gpu_exec::{ExecutorEvent, Order};

use crate::device::{TestDevice, as_u32, content};

/// Launches of the batch job. Each takes some milliseconds on lavapipe, so an order that comes after the first one's
/// start finds most of them still to be done.
const LAUNCHES: u32 = 300;

/// Every launch hashes every value once more: the result depends on how often, and on nothing between.
const HASH: &str = "
@group(0) @binding(0) var<storage, read_write> values: array<u32>;
@compute @workgroup_size(64) fn hash(@builtin(global_invocation_id) id: vec3u) {
    var x = values[id.x] + id.x;
    for (var i = 0u; i < 20000u; i++) { x = (x ^ (x >> 13u)) * 1664525u + i; }
    values[id.x] = x;
}";

fn hashing(launches: u32) -> (JobProgram, Vec<(ContentHash, Bytes)>) {
    let (module, module_bytes) = content(HASH.as_bytes());
    let mut program = JobProgram::default();
    let values = program.malloc(16_384).unwrap();
    let kernel = program.function(module, "hash");
    program.param_in_out(kernel, 0, values).unwrap();
    for _ in 0..launches {
        program.launch(kernel, [64, 1, 1]).unwrap();
    }
    program.memcpy_dtoh(values, 0, 16_384).unwrap();
    (program, vec![module_bytes])
}

fn order(device: &TestDevice, class: LatencyClass, launches: u32) -> Order {
    let (program, contents) = hashing(launches);
    Order { class, ..device.order(program, &contents) }
}

#[test]
fn an_interrupted_job_ends_with_the_bytes_of_an_undisturbed_one() {
    let device = TestDevice::open();
    let undisturbed = device.run(order(&device, LatencyClass::Batch, LAUNCHES)).unwrap();
    let one_less = device.run(order(&device, LatencyClass::Batch, LAUNCHES - 1)).unwrap();
    assert_ne!(as_u32(&undisturbed[0]), as_u32(&one_less[0]), "a lost launch would be seen");

    let batch = order(&device, LatencyClass::Batch, LAUNCHES);
    let staged = order(&device, LatencyClass::Batch, 1);
    let urgent = order(&device, LatencyClass::Interactive, 1);
    let jobs = [batch.job, staged.job, urgent.job];
    device.executor.submit(batch).unwrap();
    device.executor.submit(staged).unwrap();
    assert_eq!(device.next_event(), ExecutorEvent::Started { job: jobs[0] });
    device.executor.submit(urgent).unwrap();
    assert_eq!(device.next_event(), ExecutorEvent::Yielded { job: jobs[0] });
    assert!(device.finished(jobs[2]).1.is_ok(), "before the batch job ends");
    assert_eq!(device.next_event(), ExecutorEvent::Resumed { job: jobs[0] });
    assert_eq!(device.finished(jobs[0]).1.as_ref(), Ok(&undisturbed));
    assert!(device.finished(jobs[1]).1.is_ok(), "the staged one comes last");
}

#[test]
fn an_interrupted_job_can_be_taken_back() {
    let device = TestDevice::open();
    let batch = order(&device, LatencyClass::Batch, LAUNCHES);
    let urgent = order(&device, LatencyClass::Interactive, LAUNCHES);
    let jobs = [batch.job, urgent.job];
    device.executor.submit(batch).unwrap();
    assert_eq!(device.next_event(), ExecutorEvent::Started { job: jobs[0] });
    device.executor.submit(urgent).unwrap();
    assert_eq!(device.next_event(), ExecutorEvent::Yielded { job: jobs[0] });
    assert_eq!(device.next_event(), ExecutorEvent::Started { job: jobs[1] });
    device.executor.abort(jobs[0]);
    assert_eq!(device.finished(jobs[0]).1, Err(JobFailure::Cancelled));
    assert!(device.finished(jobs[1]).1.is_ok());
}
