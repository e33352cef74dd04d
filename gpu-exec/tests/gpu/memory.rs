//! Device memory: zero-filled, cached, bounded.

use bytes::Bytes;
use farm_core::{
    id::ContentHash,
    message::JobFailure,
    program::{Content, JobProgram},
};
use gpu_exec::ExecutorConfig;

use crate::device::{TestDevice, as_u32, content};

const FILL: &str = "
@group(0) @binding(0) var<storage, read_write> out: array<u32>;
@compute @workgroup_size(64) fn fill(@builtin(global_invocation_id) id: vec3u) { out[id.x] = 7u; }";

#[test]
fn a_reused_buffer_is_zero_again() {
    let device = TestDevice::open();
    let (module, module_bytes) = content(FILL.as_bytes());
    let words = 64 * 1_024_usize;
    let bytes = words as u64 * 4;
    let read = |filled: bool| {
        let mut program = JobProgram::default();
        let out = program.malloc(bytes).unwrap();
        if filled {
            let fill = program.function(module, "fill");
            program.param_in_out(fill, 0, out).unwrap();
            program.launch(fill, [1_024, 1, 1]).unwrap();
        }
        program.memcpy_dtoh(out, 0, bytes).unwrap();
        as_u32(&device.run_program(program, std::slice::from_ref(&module_bytes)).unwrap()[0])
    };
    for _ in 0..3 {
        assert_eq!(read(true), vec![7; words], "the kernel writes what the next job must not see");
        assert_eq!(read(false), vec![0; words]);
    }
}

const SUM: &str = "
@group(0) @binding(0) var<storage, read> input: array<u32>;
@group(0) @binding(1) var<storage, read_write> out: array<u32>;
@compute @workgroup_size(1) fn first() { out[0] = input[0]; }";

fn first_of(allocation: Content) -> JobProgram {
    let (module, _) = content(SUM.as_bytes());
    let mut program = JobProgram::default();
    let first = program.function(module, "first");
    let input = program.task_allocation(allocation);
    let out = program.malloc(4).unwrap();
    program.param_in(first, 0, input).unwrap();
    program.param_in_out(first, 1, out).unwrap();
    program.launch(first, [1, 1, 1]).unwrap();
    program.memcpy_dtoh(out, 0, 4).unwrap();
    program
}

fn allocation(value: u32) -> (Content, (ContentHash, Bytes)) {
    content(bytemuck::cast_slice(&[value; 4_096]))
}

#[test]
fn task_allocations_stay_on_the_device_until_the_cache_is_full() {
    let (_, module_bytes) = content(SUM.as_bytes());
    let ((a, a_bytes), (b, b_bytes)) = (allocation(11), allocation(22));
    let run = |device: &TestDevice, wanted, contents: &[_]| {
        let sections = device.run_program(first_of(wanted), contents)?;
        Ok(as_u32(&sections[0])[0])
    };
    let both = |fraction: f64| {
        let config = ExecutorConfig { allocation_cache_fraction: fraction, ..ExecutorConfig::default() };
        let device = TestDevice::with(config);
        assert_eq!(run(&device, a, &[module_bytes.clone(), a_bytes.clone()]), Ok(11));
        assert_eq!(run(&device, b, &[module_bytes.clone(), b_bytes.clone()]), Ok(22));
        // Without bytes: served only from the cache.
        (run(&device, a, std::slice::from_ref(&module_bytes)), run(&device, b, &[]))
    };
    assert_eq!(both(0.5), (Ok(11), Ok(22)), "room for both, and for the module");
    // Room for one (16 KiB each) on a device of 2 GiB and on one of 16 GiB alike: for none at all.
    let (a_again, b_again) = both(1e-9);
    assert_eq!(a_again, Err(JobFailure::ContentUnavailable(a.hash)));
    assert_eq!(b_again, Err(JobFailure::ContentUnavailable(b.hash)));
}

#[test]
fn more_memory_than_the_device_has_is_refused() {
    let device = TestDevice::open();
    let limits = device.executor.info().limits;
    let mut program = JobProgram::default();
    let each = limits.buffer_bytes.min(1 << 30) & !3;
    for _ in 0..=limits.memory_bytes / each {
        program.malloc(each).unwrap();
    }
    let text = device.invalid(program, &[]);
    assert!(text.contains("command"), "{text}");
    assert_eq!(device.run_program(JobProgram::default(), &[]), Ok(Vec::new()));
}
