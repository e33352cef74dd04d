//! An application whose results can be wrong: each job brings back bytes that are its own, and who hears of one twice is told.

use std::{
    ops::Range,
    sync::{Arc, Mutex},
};

use client_sdk::{
    Content, CostNs, DispatchError, Job, JobProgram, JobResult, Requirements, RetrieveError, Task, TaskData,
    TaskError, TaskProgress,
};

use crate::clock::AppThread;

/// Every so many jobs one has a result that gets a stream of its own.
const LARGE_EVERY: u32 = 16;
/// Bytes of such a one, and of the others.
const LARGE_BYTES: usize = 80 << 10;
const SMALL_BYTES: usize = 256;
/// Bytes of the module that every job names: nodes fetch it.
const MODULE_BYTES: usize = 50_000;
/// Device time of a job: a hundred of them are ten seconds of four devices.
const SHORTEST_MS: u64 = 100;
const LONGEST_MS: u64 = 700;

/// How often each job was retrieved that was ever asked for, by its number.
#[derive(Clone, Default)]
pub(crate) struct Brought(Arc<Mutex<Vec<u32>>>);

impl Brought {
    /// Jobs that came.
    pub(crate) fn count(&self) -> usize {
        self.0.lock().unwrap().iter().filter(|times| **times > 0).count()
    }

    /// What is wrong; empty: each job came once.
    pub(crate) fn wrong(&self) -> String {
        let times = self.0.lock().unwrap();
        let wrong = times.iter().enumerate().filter(|(_, times)| **times != 1);
        wrong.map(|(number, times)| format!("job {number} came {times} times; ")).collect()
    }

    /// The numbers of further jobs.
    fn ask(&self, jobs: u32) -> Range<u32> {
        let mut times = self.0.lock().unwrap();
        let first = u32::try_from(times.len()).unwrap();
        times.extend((0..jobs).map(|_| 0));
        first..first + jobs
    }

    fn came(&self, number: u32) {
        self.0.lock().unwrap()[number as usize] += 1;
    }
}

/// Some jobs.
pub(crate) struct Numbers {
    numbers: Range<u32>,
    module: Option<Content>,
    brought: Brought,
    thread: AppThread,
}

impl Numbers {
    pub(crate) fn new(jobs: u32, brought: Brought, thread: AppThread) -> Self {
        Self { numbers: brought.ask(jobs), module: None, brought, thread }
    }
}

impl Task for Numbers {
    fn prepare(&mut self, data: &mut TaskData) -> Result<(), TaskError> {
        self.module = Some(data.module(bytes(self.numbers.start, MODULE_BYTES)));
        Ok(())
    }

    fn requirements(&self) -> Requirements {
        Requirements::ANY
    }

    fn jobs(&mut self) -> Vec<Box<dyn Job>> {
        Vec::new()
    }

    /// On the run's own thread.
    fn more_jobs(&mut self, _: &TaskProgress) -> Vec<Box<dyn Job>> {
        self.thread.is_this();
        let module = self.module.expect("prepare comes first");
        let job = |number| Box::new(Number { number, module, brought: self.brought.clone() });
        std::mem::take(&mut self.numbers).map(|number| job(number) as Box<dyn Job>).collect()
    }
}

struct Number {
    number: u32,
    module: Content,
    brought: Brought,
}

impl Number {
    /// What it brings back.
    fn bytes(&self) -> Vec<u8> {
        let large = self.number % LARGE_EVERY == LARGE_EVERY - 1;
        bytes(self.number, if large { LARGE_BYTES } else { SMALL_BYTES })
    }

    fn cost(&self) -> CostNs {
        let milliseconds = SHORTEST_MS + mixed(self.number) % (LONGEST_MS - SHORTEST_MS);
        CostNs(milliseconds * 1_000_000)
    }
}

impl Job for Number {
    fn dispatch(&mut self, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        let bytes = self.bytes();
        let size = bytes.len() as u64;
        let buffer = cmd.malloc(size)?;
        cmd.memcpy_htod_buffer(buffer, 0, &bytes)?;
        let kernel = cmd.function(self.module, "main");
        cmd.launch_with_cost(kernel, [1, 1, 1], self.cost())?;
        cmd.memcpy_dtoh(buffer, 0, size)
    }

    fn retrieve(&mut self, result: JobResult) -> Result<(), RetrieveError> {
        let expected = self.bytes();
        let section = result.section(0, expected.len())?;
        assert!(section[..] == expected[..], "job {} brought back another's bytes", self.number);
        self.brought.came(self.number);
        Ok(())
    }
}

/// Bytes that are a number's own.
fn bytes(number: u32, length: usize) -> Vec<u8> {
    let words = (0..).flat_map(|at: u32| mixed(number.wrapping_mul(65_537) ^ at).to_le_bytes());
    words.take(length).collect()
}

/// splitmix64's mixing.
fn mixed(number: u32) -> u64 {
    let mut mixed = u64::from(number).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    mixed ^ (mixed >> 31)
}
