//! Depth, aborts and the limit of a job.

use std::time::Duration;

use bytes::Bytes;
use farm_core::{
    device::DeviceKind,
    id::ContentHash,
    message::{CostNs, JobFailure},
    program::{JobProgram, Slicing},
};
use gpu_exec::{Busy, ExecutorEvent, Order};

use crate::device::{TestDevice, content};

/// Dependent multiplications in each of 64 invocations a workgroup: bounded, and no compiler can shorten them.
/// lavapipe ends every loop of an invocation after 65,535 rounds in all, so long work takes more workgroups, not rounds.
const SPIN: &str = "
@group(0) @binding(0) var<storage, read_write> out: array<u32>;
@group(1) @binding(1) var<uniform> first_z: u32;
@compute @workgroup_size(64) fn spin(@builtin(global_invocation_id) id: vec3u) {
    var x = id.x + id.y + id.z + first_z;
    for (var i = 0u; i < 60000u; i++) { x = (x ^ (x >> 13u)) * 1664525u + i; }
    if x == 12345u { out[id.x % 64u] = x; }
}";

fn spin([x, y, z]: [u32; 3], sliced: bool) -> (JobProgram, Vec<(ContentHash, Bytes)>) {
    let (module, module_bytes) = content(SPIN.as_bytes());
    let mut program = JobProgram::default();
    let kernel = program.function(module, "spin");
    let out = program.malloc(256).unwrap();
    program.param_in_out(kernel, 0, out).unwrap();
    if sliced {
        let slicing = Slicing { global: "first_z".to_owned(), max_groups_z: 16 };
        program.launch_sliced(kernel, [x, y, z], slicing, CostNs(0)).unwrap();
    } else {
        program.memcpy_htod(kernel, "first_z", &[0; 4]).unwrap();
        program.launch(kernel, [x, y, z]).unwrap();
    }
    program.memcpy_dtoh(out, 0, 256).unwrap();
    (program, vec![module_bytes])
}

/// A job that runs until it is aborted or its limit is reached: 65,535 layers of some milliseconds.
fn endless(device: &TestDevice) -> Order {
    let (program, contents) = spin([64, 1, 65_535], true);
    device.order(program, &contents)
}

fn empty(device: &TestDevice) -> Order {
    device.order(JobProgram::default(), &[])
}

#[test]
fn three_are_held_and_a_fourth_is_refused() {
    let device = TestDevice::open();
    let (running, staged, third) = (endless(&device), empty(&device), empty(&device));
    let jobs = [running.job, staged.job, third.job];
    device.executor.submit(running).unwrap();
    assert_eq!(device.next_event(), ExecutorEvent::Started { job: jobs[0] });
    device.executor.submit(staged).unwrap();
    device.executor.submit(third).unwrap();
    let fourth = empty(&device);
    let job = fourth.job;
    assert_eq!(device.executor.submit(fourth), Err(Busy::Full { job }));

    device.executor.abort(jobs[0]);
    let (device_time_ns, outcome) = device.finished(jobs[0]);
    assert_eq!(outcome, Err(JobFailure::Cancelled));
    assert!(device_time_ns > 0, "what ran before the abort is charged");
    assert_eq!(device.next_event(), ExecutorEvent::Started { job: jobs[1] });
    assert_eq!(device.finished(jobs[1]).1, Ok(Vec::new()));
}

#[test]
fn an_aborted_staged_job_never_starts() {
    let device = TestDevice::open();
    let (running, staged, next) = (endless(&device), empty(&device), empty(&device));
    let jobs = [running.job, staged.job, next.job];
    device.executor.submit(running).unwrap();
    assert_eq!(device.next_event(), ExecutorEvent::Started { job: jobs[0] });
    device.executor.submit(staged).unwrap();
    device.executor.abort(jobs[1]);
    assert_eq!(
        device.next_event(),
        ExecutorEvent::Finished { job: jobs[1], device_time_ns: 0, outcome: Err(JobFailure::Cancelled) }
    );
    device.executor.submit(next).unwrap();
    device.executor.abort(jobs[1]);
    device.executor.abort(jobs[0]);
    assert_eq!(device.finished(jobs[0]).1, Err(JobFailure::Cancelled));
    assert_eq!(device.finished(jobs[2]).1, Ok(Vec::new()));
}

#[test]
fn a_wrong_staged_job_ends_while_the_other_runs() {
    let device = TestDevice::open();
    let running = endless(&device);
    let (module, module_bytes) = content(b"not wgsl");
    let mut program = JobProgram::default();
    let _ = program.function(module, "main");
    let staged = device.order(program, &[module_bytes]);
    let jobs = [running.job, staged.job];
    device.executor.submit(running).unwrap();
    assert_eq!(device.next_event(), ExecutorEvent::Started { job: jobs[0] });
    device.executor.submit(staged).unwrap();
    assert!(matches!(device.finished(jobs[1]).1, Err(JobFailure::InvalidProgram(_))));
    device.executor.abort(jobs[0]);
    assert_eq!(device.finished(jobs[0]).1, Err(JobFailure::Cancelled));
}

#[test]
fn a_job_past_its_limit_ends_and_the_device_goes_on() {
    let device = TestDevice::open();
    let order = Order { limit: Duration::from_millis(100), ..endless(&device) };
    assert_eq!(device.run(order), Err(JobFailure::Timeout));
    let (program, contents) = spin([1, 1, 4], true);
    assert!(device.run_program(program, &contents).is_ok(), "the device serves the next job");
}

#[test]
fn a_launch_that_cannot_be_cut_costs_the_device_and_only_its_own_job() {
    let device = TestDevice::open();
    // Calibrated to some five seconds: longer than the executor's patience after the limit, and still bounded.
    let (program, contents) = spin([256, 1, 1], false);
    let warm_up = device.order(program.clone(), &contents);
    device.run(warm_up).unwrap();
    let measured = device.order(program, &contents);
    let job = measured.job;
    device.executor.submit(measured).unwrap();
    let (device_time_ns, _) = device.finished(job);
    let factor = 5_000_000_000 / device_time_ns.max(1);
    let long = [256, u32::try_from(factor).unwrap().clamp(1, 65_535), 1];

    let (program, contents) = spin(long, false);
    let hung = Order { limit: Duration::from_millis(50), ..device.order(program, &contents) };
    let (program, contents) = spin([1, 1, 1], false);
    let staged = device.order(program, &contents);
    let jobs = [hung.job, staged.job];
    device.executor.submit(hung).unwrap();
    device.executor.submit(staged).unwrap();
    assert_eq!(device.finished(jobs[0]).1, Err(JobFailure::Timeout));
    assert!(device.finished(jobs[1]).1.is_ok(), "the staged job ran on the new device");
    // As long again on the new device: the one left behind has ended before the process does.
    let (program, contents) = spin(long, false);
    assert!(device.run_program(program, &contents).is_ok());
}

#[test]
#[ignore = "prints a figure for people: how much of the wall time of a sliced job the device works"]
fn measure_how_busy_slices_keep_the_device() {
    let device = TestDevice::open();
    let info = device.executor.info();
    println!("{}: score {:.0} GFLOP/s", info.name, info.score);
    // The scratch of a real kernel bounds its slices; 16 layers of 64 workgroups is what a small tile has.
    let gpu = info.kind == DeviceKind::Gpu;
    for (x, layers) in if gpu { [(64, 8_000), (1_024, 4_000)] } else { [(8, 40), (64, 20)] } {
        for _ in 0..2 {
            let (program, contents) = spin([x, 1, layers], true);
            let order = device.order(program, &contents);
            let job = order.job;
            let begin = std::time::Instant::now();
            device.executor.submit(order).unwrap();
            let (device_time_ns, outcome) = device.finished(job);
            let wall = begin.elapsed();
            outcome.unwrap();
            let busy = Duration::from_nanos(device_time_ns);
            println!(
                "{x} x {layers} workgroups: wall {wall:?}, device {busy:?}, {:.3}",
                busy.as_secs_f64() / wall.as_secs_f64()
            );
        }
    }
    // Small jobs one after the other, one staged: what a job costs beside its work.
    let begin = std::time::Instant::now();
    let count = 200;
    let (mut submitted, mut ended) = (0, 0);
    while ended < count {
        while submitted < count {
            let (program, contents) = spin([1, 1, 1], false);
            if device.executor.submit(device.order(program, &contents)).is_err() {
                break;
            }
            submitted += 1;
        }
        if let ExecutorEvent::Finished { outcome, .. } = device.next_event() {
            outcome.unwrap();
            ended += 1;
        }
    }
    println!("{count} small jobs: {:?} each", begin.elapsed() / count);
}
