//! Times iterations of the null model on one device, without a farm: a random alignment of given sizes.
//!
//! `cargo run --release -p mi-kernel --example iterations -- [N L Q [ITERATIONS]] [--conserved] [--unchecked]`
//!
//! Without sizes the three sets of the thesis with 21 symbols (45,000 x 1,400; 4,176 x 5,025; 20,000 x 2,189). Prints
//! one line of JSON a set. The time is the device's, of jobs after a warm-up. `--conserved` gives each column one symbol
//! in nine of ten places.

use std::{
    env,
    error::Error,
    sync::{Arc, mpsc},
    time::{Duration, Instant},
};

use bytes::Bytes;
use farm_core::{
    id::{AppId, Attempt, ContentHash, Epoch, JobAttempt, JobId, JobIndex, TaskId},
    program::{Content, JobProgram},
};
use gpu_exec::{DeviceSpec, Executor, ExecutorConfig, ExecutorEvent, Order, expand};
use mi_kernel::{
    Alignment, Reference, Seed,
    generate::RandomAlignment,
    gpu::{AlignmentContents, MiJob, PackedAlignment, Pass, Shape, module_source},
    parse,
};

const LIMIT: Duration = Duration::from_secs(600);

struct Arguments {
    sets: Vec<RandomAlignment>,
    iterations: u64,
    unchecked: bool,
}

fn arguments() -> Result<Arguments, Box<dyn Error>> {
    let (mut numbers, mut conserved, mut unchecked) = (Vec::new(), false, false);
    for argument in env::args().skip(1) {
        match argument.as_str() {
            "--conserved" => conserved = true,
            "--unchecked" => unchecked = true,
            number => numbers.push(number.parse::<usize>().map_err(|error| format!("{number}: {error}"))?),
        }
    }
    let (sets, iterations) = match numbers[..] {
        [] => (RandomAlignment::THESIS.to_vec(), 10),
        [n, l, q] => (vec![sizes(n, l, q)], 10),
        [n, l, q, iterations] => (vec![sizes(n, l, q)], iterations as u64),
        _ => return Err("expected N L Q [ITERATIONS]".into()),
    };
    let sets = sets.into_iter().map(|sizes| RandomAlignment { conserved, ..sizes }).collect();
    Ok(Arguments { sets, iterations, unchecked })
}

const fn sizes(n: usize, l: usize, q: usize) -> RandomAlignment {
    RandomAlignment { symbols: q, ..RandomAlignment::proteins(n, l) }
}

/// Random residues; the same sizes always give the same.
fn generate(sizes: &RandomAlignment) -> Result<Alignment, Box<dyn Error>> {
    let mut text = Vec::with_capacity(sizes.sequences * (sizes.columns + 10));
    sizes.write_fasta(&mut text)?;
    Ok(parse(&text)?.alignment)
}

struct Bench {
    executor: Executor,
    inbox: mpsc::Receiver<ExecutorEvent>,
    sequence: u64,
}

impl Bench {
    /// Device time and sections of a job.
    fn run(
        &mut self,
        program: JobProgram,
        contents: &[(ContentHash, Bytes)],
    ) -> Result<(Duration, Vec<Bytes>), Box<dyn Error>> {
        self.sequence += 1;
        let job = JobAttempt {
            job: JobId { app: AppId(1), task: TaskId(0), index: JobIndex(0) },
            attempt: Attempt { epoch: Epoch(1), sequence: self.sequence },
        };
        let order = Order {
            job,
            class: farm_core::message::LatencyClass::Batch,
            program: Arc::new(program),
            contents: contents.to_vec(),
            limit: LIMIT,
        };
        self.executor.submit(order)?;
        loop {
            match self.inbox.recv_timeout(LIMIT)? {
                ExecutorEvent::Started { .. }
                | ExecutorEvent::Yielded { .. }
                | ExecutorEvent::Resumed { .. } => {}
                ExecutorEvent::Finished { outcome, device_time_ns, .. } => {
                    let sections = outcome.map_err(|failure| format!("{failure:?}"))?;
                    return Ok((Duration::from_nanos(device_time_ns), sections));
                }
                ExecutorEvent::Lost { reason } => return Err(reason.into()),
            }
        }
    }
}

fn measure(bench: &mut Bench, arguments: &Arguments, set: &RandomAlignment) -> Result<(), Box<dyn Error>> {
    let alignment = generate(set)?;
    let shape = Shape::new(&alignment)?;
    let reference = Reference::unscored(&alignment)?;
    let packed = PackedAlignment::new(&reference, &shape);
    let mut contents = Vec::new();
    let mut name = |bytes: Vec<u8>| {
        let hash = ContentHash(*blake3::hash(&bytes).as_bytes());
        let content = Content { hash, size_bytes: bytes.len() as u64 };
        contents.push((hash, Bytes::from(bytes)));
        content
    };
    let named = AlignmentContents {
        codes: name(packed.codes),
        orders: packed.orders.into_iter().map(&mut name).collect(),
        bounds: name(packed.bounds),
        table: name(packed.table),
        column_terms: name(packed.column_terms),
        module: name(module_source(&shape).into_bytes()),
    };
    let started = Instant::now();
    let pass = MiJob { seed: Seed(1), pass: Pass::Observed };
    let mut program = JobProgram::default();
    pass.program(&shape, &named, &[], &mut program)?;
    let (observed_time, sections) = bench.run(program, &contents)?;
    let observed = pass.scores(&shape, &sections)?.remove(0);
    let mut digest = blake3::Hasher::new();
    let mut extra = Vec::new();
    let observed_names: Vec<Content> = shape
        .observed_bytes(&observed)
        .into_iter()
        .map(|bytes| {
            let hash = ContentHash(*blake3::hash(&bytes).as_bytes());
            let content = Content { hash, size_bytes: bytes.len() as u64 };
            extra.push((hash, Bytes::from(bytes)));
            content
        })
        .collect();
    contents.extend(extra);
    let mut job = |range: std::ops::Range<u64>| -> Result<(Duration, Vec<Bytes>), Box<dyn Error>> {
        let pass = Pass::Reduce { iterations: range, chunks: 0..shape.chunks().len() };
        let pass = MiJob { seed: Seed(1), pass };
        let mut program = JobProgram::default();
        pass.program(&shape, &named, &observed_names, &mut program)?;
        bench.run(program, &contents)
    };
    // Compiles, and finds the device's pace.
    let _ = job(0..1)?;
    let _ = job(0..1)?;
    let warm_up = started.elapsed();
    let began = Instant::now();
    let (device_time, sections) = job(0..arguments.iterations)?;
    let wall = began.elapsed();
    for section in &sections {
        digest.update(section);
    }
    let per_iteration_ms = device_time.as_secs_f64() * 1e3 / arguments.iterations as f64;
    let counts = shape.pairs() as f64 * alignment.n() as f64;
    println!(
        "{{\"device\":\"{}\",\"n\":{},\"l\":{},\"q\":{},\"conserved\":{},\"iterations\":{},\"ms_per_iteration\":{:.3},\
         \"wall_ms_per_iteration\":{:.3},\"counts_per_ns\":{:.2},\"observed_ms\":{:.1},\"warm_up_s\":{:.2},\
         \"blake3\":\"{}\"}}",
        bench.executor.info().name,
        alignment.n(),
        alignment.l(),
        alignment.q(),
        set.conserved,
        arguments.iterations,
        per_iteration_ms,
        wall.as_secs_f64() * 1e3 / arguments.iterations as f64,
        counts / (per_iteration_ms * 1e6),
        observed_time.as_secs_f64() * 1e3,
        warm_up.as_secs_f64(),
        digest.finalize().to_hex(),
    );
    Ok(())
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments = arguments()?;
    let (events, inbox) = mpsc::channel();
    let config = ExecutorConfig { unchecked: arguments.unchecked, ..ExecutorConfig::default() };
    let device = expand(&[DeviceSpec::All])?;
    let executor = Executor::start(&device[0], config, move |event| drop(events.send(event)))?;
    let mut bench = Bench { executor, inbox, sequence: 0 };
    arguments.sets.iter().try_for_each(|set| measure(&mut bench, &arguments, set))
}
