//! Wrong programs: each ends its own job with a message that names the command, and the device goes on.

use bytes::Bytes;
use farm_core::{
    id::ContentHash,
    message::{CostNs, JobFailure},
    program::{Access, Content, JobProgram, Kernel, Slicing},
};

use crate::device::{TestDevice, as_u32, content};

const STORE: &str = "
struct Camera { eye: vec3f, scale: f32 }
@group(0) @binding(0) var<storage, read_write> out: array<u32, 4>;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(1) @binding(0) var<uniform> camera: Camera;
@group(1) @binding(1) var<uniform> index: u32;
@compute @workgroup_size(1) fn store() { out[index] = 1u + input[0]; }
@compute @workgroup_size(1) fn plain() { out[0] = 1u; }
@compute @workgroup_size(1) fn sized() { out[0] = u32(camera.scale); }
override count = 1u;
@compute @workgroup_size(count) fn wide() { out[0] = 1u; }";

/// Asserts that the device still computes.
fn assert_alive(device: &TestDevice) {
    let (module, module_bytes) = content(STORE.as_bytes());
    let mut program = JobProgram::default();
    let out = program.malloc(16).unwrap();
    let plain = program.function(module, "plain");
    program.param_in_out(plain, 0, out).unwrap();
    program.launch(plain, [1, 1, 1]).unwrap();
    program.memcpy_dtoh(out, 0, 16).unwrap();
    assert_eq!(as_u32(&device.run_program(program, &[module_bytes]).unwrap()[0]), [1, 0, 0, 0]);
}

/// A program around one kernel of [`STORE`].
fn one_kernel(
    entry: &str,
    build: impl FnOnce(&mut JobProgram, Kernel),
) -> (JobProgram, Vec<(ContentHash, Bytes)>) {
    let (module, module_bytes) = content(STORE.as_bytes());
    let mut program = JobProgram::default();
    let kernel = program.function(module, entry);
    build(&mut program, kernel);
    (program, vec![module_bytes])
}

#[track_caller]
fn assert_names(text: &str, parts: &[&str]) {
    for part in parts {
        assert!(text.contains(part), "`{part}` is missing in: {text}");
    }
}

#[test]
fn modules_that_do_not_compile_say_where() {
    let device = TestDevice::open();
    let fail = |source: &[u8]| {
        let (module, module_bytes) = content(source);
        let mut program = JobProgram::default();
        let kernel = program.function(module, "main");
        program.launch(kernel, [1, 1, 1]).unwrap();
        device.invalid(program, &[module_bytes])
    };
    assert_names(
        &fail(b"\n@compute @workgroup_size(1) fn main() { let x = nonsense; }"),
        &["command 0", "wgsl:2:49", "nonsense"],
    );
    assert_names(
        &fail(b"@compute @workgroup_size(1) fn main() { let x: u32 = 1.5; }"),
        &["command 0", "wgsl:1"],
    );
    assert_names(&fail(&[0xff, 0xfe, 0]), &["command 0", "UTF-8"]);
    assert_names(&fail(&vec![b' '; (1 << 20) + 1]), &["command 0", "over 1048576 B"]);
    assert_names(&fail(b"const x = 1;"), &["command 0", "no @compute entry point `main`"]);
    assert_names(&fail(b""), &["command 0", "a module of 0 B"]);
    let nested = format!("const x = {}1{};", "(".repeat(100_000), ")".repeat(100_000));
    assert_names(&fail(nested.as_bytes()), &["command 0"]);
    assert_alive(&device);
}

#[test]
fn entry_points_and_constants_have_to_exist() {
    let device = TestDevice::open();
    let launch = |program: &mut JobProgram, kernel| program.launch(kernel, [1, 1, 1]).unwrap();
    let (program, contents) = one_kernel("shade", launch);
    assert_names(&device.invalid(program, &contents), &["command 0", "`shade`", "plain, sized, store"]);

    let (module, module_bytes) = content(STORE.as_bytes());
    let mut program = JobProgram::default();
    let kernel = program.function_with_constants(module, "plain", &[("size", 1.0)]);
    launch(&mut program, kernel);
    assert_names(&device.invalid(program, std::slice::from_ref(&module_bytes)), &["command 0", "`size`"]);

    for count in [1e6, -1.0, 0.5, 0.0] {
        let mut program = JobProgram::default();
        let kernel = program.function_with_constants(module, "wide", &[("count", count)]);
        launch(&mut program, kernel);
        assert_names(&device.invalid(program, std::slice::from_ref(&module_bytes)), &["command 0", "`wide`"]);
    }
    assert_alive(&device);
}

#[test]
fn globals_have_to_exist_to_fit_and_to_be_set() {
    let device = TestDevice::open();
    let (program, contents) = one_kernel("sized", |program, kernel| {
        program.memcpy_htod(kernel, "kamera", &[0; 16]).unwrap();
    });
    assert_names(&device.invalid(program, &contents), &["command 1", "kamera", "camera, index"]);
    let (program, contents) = one_kernel("sized", |program, kernel| {
        program.memcpy_htod(kernel, "camera", &[0; 12]).unwrap();
    });
    assert_names(&device.invalid(program, &contents), &["command 1", "`camera` takes 16 B, not 12 B"]);
    let (program, contents) = one_kernel("sized", |program, kernel| {
        let out = program.malloc(16).unwrap();
        program.param_in_out(kernel, 0, out).unwrap();
        program.launch(kernel, [1, 1, 1]).unwrap();
    });
    assert_names(&device.invalid(program, &contents), &["command 3", "`camera` was never set"]);
    for (global, entry) in [("index", "plain"), ("camera", "sized"), ("out", "store")] {
        let (program, contents) = one_kernel(entry, |program, kernel| {
            let (out, input) = (program.malloc(16).unwrap(), program.malloc(16).unwrap());
            program.param_in_out(kernel, 0, out).unwrap();
            program.param_in(kernel, 1, input).unwrap();
            let slicing = Slicing { global: global.to_owned(), max_groups_z: 1 };
            program.launch_sliced(kernel, [1, 1, 4], slicing, CostNs(0)).unwrap();
        });
        assert_names(&device.invalid(program, &contents), &["command 5", "slicing global", global]);
    }
    assert_alive(&device);
}

#[test]
fn parameters_have_to_exist_to_fit_and_to_be_bound_as_declared() {
    let device = TestDevice::open();
    let (program, contents) = one_kernel("plain", |program, kernel| {
        let out = program.malloc(16).unwrap();
        program.param_in_out(kernel, 9, out).unwrap();
    });
    assert_names(&device.invalid(program, &contents), &["command 2", "@binding(9)"]);
    let (program, contents) = one_kernel("plain", |program, kernel| {
        let out = program.malloc(12).unwrap();
        program.param_in_out(kernel, 0, out).unwrap();
    });
    assert_names(&device.invalid(program, &contents), &["command 2", "at least 16 B, not 12 B"]);
    let (program, contents) = one_kernel("plain", |program, kernel| {
        program.launch(kernel, [1, 1, 1]).unwrap();
    });
    assert_names(&device.invalid(program, &contents), &["command 1", "parameter 0 was never bound"]);

    // A task allocation is never written: neither by its own access nor by a declaration that says otherwise.
    let (allocation, allocation_bytes) = content(&[7; 16]);
    let (program, mut contents) = one_kernel("plain", |program, kernel| {
        let buffer = program.task_allocation(allocation);
        program.param(kernel, 0, buffer, 0, 16, Access::In).unwrap();
        program.launch(kernel, [1, 1, 1]).unwrap();
    });
    contents.push(allocation_bytes);
    assert_names(&device.invalid(program, &contents), &["command 2", "`read_write` in the module"]);

    // One buffer for reading and for writing in one launch is a hazard that the device refuses.
    let (program, contents) = one_kernel("store", |program, kernel| {
        let out = program.malloc(16).unwrap();
        program.param_in_out(kernel, 0, out).unwrap();
        program.param_in(kernel, 1, out).unwrap();
        program.memcpy_htod(kernel, "index", &[0; 4]).unwrap();
        program.launch(kernel, [1, 1, 1]).unwrap();
    });
    assert_names(&device.invalid(program, &contents), &["command 5"]);
    assert_alive(&device);
}

#[test]
fn writes_out_of_bounds_touch_nobody_else() {
    let device = TestDevice::open();
    let source = "
@group(0) @binding(0) var<storage, read_write> mine: array<u32>;
@compute @workgroup_size(64) fn flood(@builtin(global_invocation_id) id: vec3u) { mine[id.x * 97u] = 1u; }";
    let (module, module_bytes) = content(source.as_bytes());
    let mut program = JobProgram::default();
    let flood = program.function(module, "flood");
    let [before, mine, after] = [(); 3].map(|()| program.malloc(4_096).unwrap());
    program.param_in_out(flood, 0, mine).unwrap();
    program.launch(flood, [1_000, 1, 1]).unwrap();
    program.memcpy_dtoh(before, 0, 4_096).unwrap();
    program.memcpy_dtoh(mine, 0, 4_096).unwrap();
    program.memcpy_dtoh(after, 0, 4_096).unwrap();
    let sections = device.run_program(program, &[module_bytes]).unwrap();
    assert!(sections[0].iter().all(|&byte| byte == 0), "the buffer before was written");
    assert_eq!(as_u32(&sections[1])[97], 1, "the kernel ran");
    assert!(sections[2].iter().all(|&byte| byte == 0), "the buffer after was written");
}

#[test]
fn too_many_workgroups_are_refused_by_name() {
    let device = TestDevice::open();
    let (program, contents) = one_kernel("plain", |program, kernel| {
        let out = program.malloc(16).unwrap();
        program.param_in_out(kernel, 0, out).unwrap();
        program.launch(kernel, [65_536, 1, 1]).unwrap();
    });
    assert_names(&device.invalid(program, &contents), &["command 3"]);
    assert_alive(&device);
}

#[test]
fn a_missing_content_is_named() {
    let device = TestDevice::open();
    let (module, module_bytes) = content(STORE.as_bytes());
    let mut program = JobProgram::default();
    let _ = program.function(module, "plain");
    assert_eq!(
        device.run_program(program, &[]),
        Err(JobFailure::ContentUnavailable(module.hash)),
        "a module"
    );
    let absent = Content { hash: ContentHash([9; 32]), size_bytes: 16 };
    let mut program = JobProgram::default();
    let _ = program.task_allocation(absent);
    let outcome = device.run_program(program, &[module_bytes]);
    assert_eq!(outcome, Err(JobFailure::ContentUnavailable(absent.hash)), "an allocation");
    assert_alive(&device);
}
