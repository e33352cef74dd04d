//! Device memory: zero-filled, cached, bounded.

use std::{
    collections::HashMap,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
        mpsc,
    },
};

use bytes::Bytes;
use farm_core::{
    id::ContentHash,
    message::JobFailure,
    program::{Content, JobProgram},
};
use gpu_exec::{ExecutorConfig, ExecutorEvent, Host};
use rand::{Rng as _, SeedableRng as _, rngs::SmallRng};

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

/// Gives the allocations that are not on the device, and counts them.
struct Shelf {
    events: mpsc::Sender<ExecutorEvent>,
    allocations: HashMap<ContentHash, Bytes>,
    given: Arc<AtomicUsize>,
    closed: Arc<AtomicBool>,
}

impl Host for Shelf {
    fn event(&self, event: ExecutorEvent) {
        // The test may be over.
        let _ = self.events.send(event);
    }

    fn content(&self, hash: &ContentHash) -> Option<Bytes> {
        if self.closed.load(Ordering::Relaxed) {
            return None;
        }
        self.given.fetch_add(1, Ordering::Relaxed);
        self.allocations.get(hash).cloned()
    }
}

/// Scenario 29 on the device: three applications' allocations are twice what the cache may hold, jobs name one each, the popular
/// ones more often; one job runs while the next is staged. Hits are those of a textbook LRU of the same size.
#[test]
#[expect(clippy::cast_possible_truncation, reason = "numbers and ranks of 72 allocations")]
fn s29_the_device_hits_as_often_as_an_lru() {
    const APPS: usize = 3;
    const ALLOCATIONS: usize = 24;
    const JOBS: usize = 600;
    let mut rng = SmallRng::seed_from_u64(1);
    let contents: Vec<(Content, (ContentHash, Bytes))> = (0..APPS * ALLOCATIONS)
        .map(|number| content(bytemuck::cast_slice(&vec![number as u32; rng.random_range(1_024..8_192)])))
        .collect();
    let cap_bytes = contents.iter().map(|(content, _)| content.size_bytes).sum::<u64>() / 2;
    let (_, module) = content(SUM.as_bytes());

    let memory_bytes = TestDevice::open().executor.info().limits.memory_bytes;
    // A byte more, lest the product be rounded below it.
    let allocation_cache_fraction = (cap_bytes + 1) as f64 / memory_bytes as f64;
    let config = ExecutorConfig { allocation_cache_fraction, ..ExecutorConfig::default() };
    let (given, closed) = (Arc::<AtomicUsize>::default(), Arc::<AtomicBool>::default());
    let device = TestDevice::hosted(config, |events| Shelf {
        events,
        allocations: contents.iter().map(|(_, named)| named.clone()).collect(),
        given: Arc::clone(&given),
        closed: Arc::clone(&closed),
    });

    let mut oldest_first: Vec<Content> = Vec::new();
    let mut oracle_hits = 0;
    let mut before = None;
    for _ in 0..JOBS {
        // As likely as 1 / rank: Zipf's law.
        let rank = (ALLOCATIONS as f64 + 1.0).powf(rng.random()) as usize - 1;
        let number = rng.random_range(0..APPS) * ALLOCATIONS + rank;
        let allocation = contents[number].0;
        let order = device.order(first_of(allocation), std::slice::from_ref(&module));
        let staged = (order.job, number);
        device.executor.submit(order).unwrap();
        if let Some((job, number)) = before.replace(staged) {
            assert_eq!(as_u32(&device.finished(job).1.unwrap()[0]), [number as u32]);
        }
        let place = oldest_first.iter().position(|used| *used == allocation);
        oracle_hits += usize::from(place.map(|place| oldest_first.remove(place)).is_some());
        oldest_first.push(allocation);
        while oldest_first.iter().map(|used| used.size_bytes).sum::<u64>() > cap_bytes {
            oldest_first.remove(0);
        }
    }
    device.finished(before.unwrap().0).1.unwrap();

    let hits = JOBS - given.load(Ordering::Relaxed);
    let [rate, oracle] = [hits, oracle_hits].map(|hits| hits as f64 / JOBS as f64);
    println!("s29  device: hit rate {:.2} %, LRU {:.2} %", 100.0 * rate, 100.0 * oracle);
    assert!(rate >= oracle - 0.01, "s29: {rate:.4}, LRU {oracle:.4}");
    // What is served without the host is what is there.
    closed.store(true, Ordering::Relaxed);
    let here = |content: &Content| device.run_program(first_of(*content), &[]).is_ok();
    let bytes: u64 = contents
        .iter()
        .map(|(content, _)| content)
        .filter(|content| here(content))
        .map(|content| content.size_bytes)
        .sum();
    println!("s29  device: {bytes} B on the device, cap {cap_bytes} B");
    assert!(bytes <= cap_bytes && bytes > cap_bytes / 2, "{bytes} B, cap {cap_bytes} B");
}
