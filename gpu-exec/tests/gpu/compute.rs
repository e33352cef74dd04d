//! Programs that work: every command does what its documentation says.

use std::{fs, time::Duration};

use farm_core::{
    device::DeviceKind,
    message::CostNs,
    program::{Access, JobProgram, Slicing},
};
use gpu_exec::ExecutorConfig;

use crate::device::{TestDevice, as_f32, as_u32, content};

const ADD: &str = "
@group(0) @binding(0) var<storage, read> a: array<f32>;
@group(0) @binding(1) var<storage, read> b: array<f32>;
@group(0) @binding(2) var<storage, read_write> sum: array<f32>;
@compute @workgroup_size(64) fn add(@builtin(global_invocation_id) id: vec3u) {
    if id.x < arrayLength(&sum) { sum[id.x] = a[id.x] + b[id.x]; }
}";

#[test]
fn adds_two_vectors_of_task_allocations() {
    let device = TestDevice::open();
    let (a, b): (Vec<f32>, Vec<f32>) = (0_u16..1_000).map(|i| (f32::from(i), 0.5 * f32::from(i))).unzip();
    let (module, module_bytes) = content(ADD.as_bytes());
    let (a_content, a_bytes) = content(bytemuck::cast_slice(&a));
    let (b_content, b_bytes) = content(bytemuck::cast_slice(&b));
    let mut program = JobProgram::default();
    let add = program.function(module, "add");
    let (a_buffer, b_buffer) = (program.task_allocation(a_content), program.task_allocation(b_content));
    let sum = program.malloc(4_000).unwrap();
    program.param_in(add, 0, a_buffer).unwrap();
    program.param_in(add, 1, b_buffer).unwrap();
    program.param_in_out(add, 2, sum).unwrap();
    program.launch(add, [16, 1, 1]).unwrap();
    program.memcpy_dtoh(sum, 0, 4_000).unwrap();

    let order = device.order(program, &[module_bytes, a_bytes, b_bytes]);
    let job = order.job;
    device.executor.submit(order).unwrap();
    let (device_time_ns, outcome) = device.finished(job);
    let sections = outcome.unwrap();
    let expected: Vec<f32> = a.iter().zip(&b).map(|(a, b)| a + b).collect();
    assert_eq!(as_f32(&sections[0]), expected);
    assert!(device_time_ns > 0, "a launch takes device time");
}

#[test]
fn announces_what_it_is() {
    let device = TestDevice::open();
    let info = device.executor.info();
    assert_ne!(info.kind, DeviceKind::Simulated);
    assert!(info.score > 0.0, "{info:?}");
    assert!(info.limits.binding_bytes >= 128 << 20, "{info:?}");
    assert!(info.limits.storage_buffers >= 8, "{info:?}");
}

const GLOBALS: &str = "
struct Pair { first: u32, second: u32 }
@group(0) @binding(0) var<storage, read_write> out: array<u32>;
@group(0) @binding(5) var<storage, read_write> unused: array<u32>;
@group(1) @binding(0) var<uniform> pair: Pair;
@group(2) @binding(3) var<uniform> index: u32;
@group(2) @binding(4) var<uniform> elsewhere: vec4f;
@compute @workgroup_size(1) fn store() { out[index] = pair.first * 100u + pair.second; }
@compute @workgroup_size(1) fn other() { out[u32(elsewhere.x)] = 1u; }";

#[test]
fn a_global_holds_its_last_value_before_each_launch() {
    let device = TestDevice::open();
    let (module, module_bytes) = content(GLOBALS.as_bytes());
    let mut program = JobProgram::default();
    let out = program.malloc(16).unwrap();
    let kernels = [program.function(module, "store"), program.function(module, "store")];
    for kernel in kernels {
        program.param_in_out(kernel, 0, out).unwrap();
    }
    let pair = |a: u32, b: u32| bytemuck::bytes_of(&[a, b]).to_vec();
    let set = |program: &mut JobProgram, kernel, pair: Option<Vec<u8>>, index: u32| {
        if let Some(pair) = pair {
            program.memcpy_htod(kernel, "pair", &pair).unwrap();
        }
        program.memcpy_htod(kernel, "index", &index.to_le_bytes()).unwrap();
    };
    set(&mut program, kernels[0], Some(pair(9, 9)), 0);
    set(&mut program, kernels[0], Some(pair(1, 2)), 0);
    set(&mut program, kernels[1], Some(pair(3, 4)), 1);
    program.launch(kernels[0], [1, 1, 1]).unwrap();
    program.launch(kernels[1], [1, 1, 1]).unwrap();
    set(&mut program, kernels[0], None, 2);
    program.launch(kernels[0], [1, 1, 1]).unwrap();
    set(&mut program, kernels[0], Some(pair(5, 6)), 3);
    program.launch(kernels[0], [1, 1, 1]).unwrap();
    program.memcpy_dtoh(out, 0, 16).unwrap();
    let sections = device.run_program(program, &[module_bytes]).unwrap();
    assert_eq!(as_u32(&sections[0]), [102, 304, 102, 506]);
}

const INCREMENT: &str = "
@group(0) @binding(0) var<storage, read_write> values: array<u32>;
@compute @workgroup_size(4) fn increment(@builtin(global_invocation_id) id: vec3u) { values[id.x] += 1u; }";

#[test]
fn copies_and_launches_keep_the_order_of_the_program() {
    let device = TestDevice::open();
    let (module, module_bytes) = content(INCREMENT.as_bytes());
    let mut program = JobProgram::default();
    let values = program.malloc(16).unwrap();
    let increment = program.function(module, "increment");
    program.param_in_out(increment, 0, values).unwrap();
    let numbers = |numbers: [u32; 2]| bytemuck::bytes_of(&numbers).to_vec();
    program.memcpy_htod_buffer(values, 0, &numbers([10, 20])).unwrap();
    program.memcpy_dtoh(values, 0, 8).unwrap();
    program.memcpy_htod_buffer(values, 4, &numbers([30, 40])).unwrap();
    program.launch(increment, [1, 1, 1]).unwrap();
    program.memcpy_dtoh(values, 0, 16).unwrap();
    program.memcpy_htod_buffer(values, 8, &numbers([70, 80])).unwrap();
    program.launch(increment, [1, 1, 1]).unwrap();
    program.memcpy_dtoh(values, 4, 12).unwrap();
    let sections = device.run_program(program, &[module_bytes]).unwrap();
    let sections: Vec<_> = sections.iter().map(as_u32).collect();
    assert_eq!(sections, [vec![10, 20], vec![11, 31, 41, 1], vec![32, 71, 81]]);
}

#[test]
fn a_parameter_can_be_a_part_of_a_buffer() {
    let device = TestDevice::open();
    let (module, module_bytes) = content(INCREMENT.as_bytes());
    let mut program = JobProgram::default();
    let values = program.malloc(512).unwrap();
    let increment = program.function(module, "increment");
    program.param(increment, 0, values, 256, 12, Access::InOut).unwrap();
    program.launch(increment, [1, 1, 1]).unwrap();
    program.memcpy_dtoh(values, 0, 512).unwrap();
    let sections = device.run_program(program, &[module_bytes]).unwrap();
    let mut expected = vec![0; 128];
    expected[64..67].fill(1); // the fourth invocation is out of bounds: its write is nobody's
    // WebGPU lets a bounded write land anywhere inside the binding: only outside must stay untouched.
    let values = as_u32(&sections[0]);
    assert_eq!(values[..64], expected[..64]);
    assert_eq!(values[67..], expected[67..]);
    assert!(values[64..66].iter().all(|&value| value == 1), "{:?}", &values[64..67]);
}

#[test]
fn override_constants_make_pipelines_of_their_own() {
    let device = TestDevice::open();
    let source = "
override factor = 1u;
@id(3) override offset: f32 = 0.0;
@group(0) @binding(0) var<storage, read_write> out: array<u32>;
@compute @workgroup_size(1) fn store() { out[0] = 10u * factor + u32(offset); }";
    let (module, module_bytes) = content(source.as_bytes());
    let run = |constants: &[(&str, f64)]| {
        let mut program = JobProgram::default();
        let store = program.function_with_constants(module, "store", constants);
        let out = program.malloc(4).unwrap();
        program.param_in_out(store, 0, out).unwrap();
        program.launch(store, [1, 1, 1]).unwrap();
        program.memcpy_dtoh(out, 0, 4).unwrap();
        as_u32(&device.run_program(program, std::slice::from_ref(&module_bytes)).unwrap()[0])
    };
    assert_eq!(run(&[]), [10]);
    assert_eq!(run(&[("factor", 7.0)]), [70]);
    assert_eq!(run(&[("factor", 7.0), ("offset", 4.0)]), [74]);
    assert_eq!(run(&[]), [10], "the first pipeline is still itself");
}

const LAYERS: &str = "
@group(0) @binding(0) var<storage, read_write> out: array<u32>;
@group(1) @binding(0) var<uniform> first_z: u32;
@group(1) @binding(1) var<uniform> seed: u32;
@compute @workgroup_size(4) fn fill(
    @builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32
) {
    let z = first_z + group.z;
    let index = (z * groups.y + group.y) * 4u + local;
    out[index] += (index + 1u) * 2654435761u + seed;
}";

#[test]
fn slices_of_any_size_cover_each_layer_exactly_once() {
    const LAYER_COUNT: u32 = 300;
    let bytes = u64::from(LAYER_COUNT) * 2 * 4 * 4;
    let (module, module_bytes) = content(LAYERS.as_bytes());
    let run = |device: &TestDevice, most: Option<u32>| {
        let mut program = JobProgram::default();
        let fill = program.function(module, "fill");
        let out = program.malloc(bytes).unwrap();
        program.param_in_out(fill, 0, out).unwrap();
        program.memcpy_htod(fill, "seed", &5_u32.to_le_bytes()).unwrap();
        let groups = [1, 2, LAYER_COUNT];
        match most {
            Some(most) => {
                let slicing = Slicing { global: "first_z".to_owned(), max_groups_z: most };
                program.launch_sliced(fill, groups, slicing, CostNs(0)).unwrap();
            }
            None => {
                program.memcpy_htod(fill, "first_z", &0_u32.to_le_bytes()).unwrap();
                program.launch(fill, groups).unwrap();
            }
        }
        program.memcpy_dtoh(out, 0, bytes).unwrap();
        as_u32(&device.run_program(program, std::slice::from_ref(&module_bytes)).unwrap()[0])
    };
    let device = TestDevice::open();
    let expected: Vec<u32> =
        (1..=LAYER_COUNT * 8).map(|index| index.wrapping_mul(2_654_435_761).wrapping_add(5)).collect();
    assert_eq!(run(&device, None), expected);
    for most in [1, 7, 64, u32::MAX] {
        assert_eq!(run(&device, Some(most)), expected, "at most {most} layers a run");
    }
    // A target of nothing cuts into single layers, whatever was measured.
    let config = ExecutorConfig { submit_target: Duration::from_nanos(1), ..ExecutorConfig::default() };
    let slow = TestDevice::with(config);
    for _ in 0..2 {
        assert_eq!(run(&slow, Some(u32::MAX)), expected, "single layers");
    }
}

/// Runs one small kernel on zeros and looks at what it made of them.
fn increments(device: &TestDevice) {
    let (module, module_bytes) = content(INCREMENT.as_bytes());
    let mut program = JobProgram::default();
    let values = program.malloc(16).unwrap();
    let increment = program.function(module, "increment");
    program.param_in_out(increment, 0, values).unwrap();
    program.launch(increment, [1, 1, 1]).unwrap();
    program.memcpy_dtoh(values, 0, 16).unwrap();
    assert_eq!(as_u32(&device.run_program(program, &[module_bytes]).unwrap()[0]), [1; 4]);
}

#[test]
fn what_a_driver_compiled_is_kept_for_later_processes_and_spoilt_files_do_no_harm() {
    let folder = tempfile::tempdir().unwrap();
    let compiled = folder.path().join("pipelines");
    let run = || {
        let compiled = Some(compiled.clone());
        let device = TestDevice::with(ExecutorConfig { compiled, ..ExecutorConfig::default() });
        increments(&device);
    };
    let files =
        || -> Vec<_> { fs::read_dir(&compiled).unwrap().map(|entry| entry.unwrap().path()).collect() };
    run();
    let [file] = &files()[..] else { panic!("one device, one file: {:?}", files()) };
    let first = fs::read(file).unwrap();
    run();
    assert_eq!(files(), std::slice::from_ref(file));
    for spoilt in [&first[..10], &[7; 1_000]] {
        fs::write(file, spoilt).unwrap();
        run();
        assert_eq!(files(), std::slice::from_ref(file), "it is written anew");
        assert_ne!(fs::read(file).unwrap(), spoilt);
    }
}

#[test]
fn kernels_run_without_runtime_checks_where_the_operator_allows_it() {
    let device = TestDevice::with(ExecutorConfig { unchecked: true, ..ExecutorConfig::default() });
    increments(&device);
}

#[test]
fn a_program_without_launches_or_results_completes() {
    let device = TestDevice::open();
    assert_eq!(device.run_program(JobProgram::default(), &[]), Ok(Vec::new()));
    let mut program = JobProgram::default();
    let values = program.malloc(8).unwrap();
    program.memcpy_htod_buffer(values, 0, &[1, 2, 3, 4]).unwrap();
    program.memcpy_dtoh(values, 0, 8).unwrap();
    let sections = device.run_program(program, &[]).unwrap();
    assert_eq!(sections[0][..], [1, 2, 3, 4, 0, 0, 0, 0]);
}
