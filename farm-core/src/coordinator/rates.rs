//! What devices are worth: a rate for each (module, device), learnt from completed jobs, and for pairs without a
//! completed job an estimate from the device's score (10-scheduling.md section 1).
//!
//! A rate is `score * speed * scale`: the device's score, how much faster than its score says it is at the module, and what
//! a point of score is worth at the module just now, which all devices tell together. Where nobody knows what jobs cost, dear
//! jobs in a row lower the scale, which all devices share, and no device's speed.
//!
//! Loads are in the unit of their module's applications (nanoseconds at speed 1.0 where they give costs), so rates of two
//! modules are never compared: only the times that follow from them are.

use std::collections::BTreeMap;

use crate::id::ContentHash;

/// Least weight of a new throughput sample in a mean; the first samples weigh alike. Where applications do not know what
/// their jobs cost, samples scatter like the jobs (by a fifth in a render): at 0.05 a mean scatters by 3 %, and a change of speed
/// is followed within forty jobs.
const LEAST_RATE_GAIN: f64 = 0.05;

/// A sample counts as at most this many times faster or slower than the rate so far: one warm-up launch or one job of
/// wrong cost must not starve or flood a device.
const MAX_RATE_STEP: f64 = 16.0;

/// After so many samples in a row that are off by more than this factor, all to the same side, a mean starts anew: the same
/// module has jobs of another size now, or a device another speed.
const FAR_OFF: f64 = 2.0;
const CHANGED_AFTER: i8 = 4;

/// So many samples make a mean that is worth keeping.
const SETTLED_SAMPLES: u32 = 4;

/// What a point of score is taken to be worth before any job was completed: a device of score 1,000 has speed 1.0, as
/// simulated devices have. Only what is weighed against other times, such as a transfer's, depends on it.
const UNKNOWN_SCALE: f64 = 1e-3;

/// Most modules with a scale of their own; beyond it the one that was asked for longest ago is forgotten.
const MAX_MODULES: usize = 1_024;

/// Most modules that one device keeps a rate for; beyond it one without queued jobs is forgotten.
const MAX_DEVICE_MODULES: usize = 64;

/// A module that jobs launch, or none, by a number of this coordinator's own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Module(u32);

/// What a job adds to a device's queue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Load {
    pub(super) module: Module,
    /// In the unit of the module's jobs.
    pub(super) amount: u64,
}

/// The modules known, and for each what a point of score is worth: what makes the scores of devices without a completed
/// job comparable with the measured rates of the others.
#[derive(Debug, Default)]
pub(super) struct Modules {
    known: BTreeMap<Option<ContentHash>, Module>,
    entries: BTreeMap<Module, Entry>,
    /// Over all modules: the guess for a new one.
    overall: Mean,
    next: u32,
    uses: u64,
}

#[derive(Debug)]
struct Entry {
    name: Option<ContentHash>,
    scale: Mean,
    last_use: u64,
}

impl Modules {
    pub(super) fn named(&mut self, name: Option<ContentHash>) -> Module {
        self.uses += 1;
        if let Some(&module) = self.known.get(&name) {
            if let Some(entry) = self.entries.get_mut(&module) {
                entry.last_use = self.uses;
            }
            return module;
        }
        if self.entries.len() >= MAX_MODULES
            && let Some((&oldest, _)) = self.entries.iter().min_by_key(|(_, entry)| entry.last_use)
            && let Some(entry) = self.entries.remove(&oldest)
        {
            self.known.remove(&entry.name);
        }
        let module = Module(self.next);
        self.next = self.next.wrapping_add(1);
        self.known.insert(name, module);
        self.entries.insert(module, Entry { name, scale: Mean::default(), last_use: self.uses });
        module
    }

    /// Whether a job of it was completed.
    pub(super) fn is_known(&self, module: Module) -> bool {
        self.entries.get(&module).is_some_and(|entry| entry.scale.value.is_some())
    }

    /// The load, in the module's unit of now, of a job that cost so many points of score times nanoseconds.
    pub(super) fn load(&self, module: Module, point_ns: f64) -> f64 {
        point_ns * self.scale(module)
    }

    /// Load per time that a point of score stands for.
    fn scale(&self, module: Module) -> f64 {
        let own = self.entries.get(&module).and_then(|entry| entry.scale.value);
        own.or(self.overall.value).unwrap_or(UNKNOWN_SCALE)
    }

    fn observe(&mut self, module: Module, sample: f64) {
        self.overall.observe(sample);
        if let Some(entry) = self.entries.get_mut(&module) {
            entry.scale.observe(sample);
        }
    }
}

/// What a device has queued and what it is worth, by module.
#[derive(Debug)]
pub(super) struct Throughput {
    score: f64,
    /// How much faster than its score says, compared with the others: over all modules, the guess for a new one.
    speed: Mean,
    /// Few: searched from the front.
    modules: Vec<ModuleThroughput>,
}

#[derive(Debug)]
struct ModuleThroughput {
    module: Module,
    /// How much faster than its score says the device is at this module.
    speed: Mean,
    queued: u128,
    jobs: u64,
}

impl Throughput {
    pub(super) const fn new(score: f64) -> Self {
        Self { score, speed: Mean::NONE, modules: Vec::new() }
    }

    /// How much faster than its score says, over all modules; `None` before a job was completed.
    pub(super) const fn speed(&self) -> Option<f64> {
        self.speed.value
    }

    /// The same, once enough jobs say so.
    pub(super) fn settled_speed(&self) -> Option<f64> {
        self.speed.value.filter(|_| self.speed.samples >= SETTLED_SAMPLES)
    }

    /// How much faster than its score says it was once; counts as one sample.
    pub(super) const fn presume(&mut self, speed: f64) {
        self.speed.presume(Mean { value: Some(speed), samples: 1, off_in_a_row: 0 });
    }

    /// Load of a module per nanosecond.
    pub(super) fn rate(&self, modules: &Modules, module: Module) -> f64 {
        self.points(module) * modules.scale(module)
    }

    /// What the device's score should be for jobs of a module.
    fn points(&self, module: Module) -> f64 {
        let own = self.find(module).and_then(|found| found.speed.value);
        self.score * own.or(self.speed.value).unwrap_or(1.0)
    }

    /// What the device is worth at a module was found out otherwise.
    pub(super) fn set_rate(&mut self, modules: &Modules, module: Module, rate: f64) {
        let speed = rate / (self.score * modules.scale(module));
        if let Some(found) = self.modules.iter_mut().find(|found| found.module == module) {
            found.speed.value = Some(speed);
            found.speed.off_in_a_row = 0;
        }
    }

    /// How long what is queued takes, in nanoseconds.
    pub(super) fn queued_ns(&self, modules: &Modules) -> f64 {
        let queued = self.modules.iter().filter(|found| found.jobs > 0);
        queued.map(|found| found.queued as f64 / self.rate(modules, found.module)).sum()
    }

    /// What is queued of each module.
    pub(super) fn queued(&self) -> impl Iterator<Item = (Module, u128)> {
        self.modules.iter().filter(|found| found.jobs > 0).map(|found| (found.module, found.queued))
    }

    pub(super) fn add(&mut self, load: Load) {
        let index = match self.modules.iter().position(|found| found.module == load.module) {
            Some(index) => index,
            None => {
                self.forget_idle();
                self.modules.push(ModuleThroughput {
                    module: load.module,
                    speed: Mean::NONE,
                    queued: 0,
                    jobs: 0,
                });
                self.modules.len() - 1
            }
        };
        self.modules[index].queued += u128::from(load.amount);
        self.modules[index].jobs += 1;
    }

    pub(super) fn remove(&mut self, load: Load) {
        let found = self.modules.iter_mut().find(|found| found.module == load.module);
        let found = found.expect("what was added is kept until it is removed");
        found.queued -= u128::from(load.amount);
        found.jobs -= 1;
    }

    /// What is queued is another amount than was thought.
    pub(super) fn rebook(&mut self, before: Load, amount: u64) {
        self.remove(before);
        self.add(Load { amount, ..before });
    }

    /// Learns from one completed job. Gives what it cost, in points of score times nanoseconds, which no change of the
    /// scale changes; see [`Modules::load`].
    pub(super) fn completed(&mut self, modules: &mut Modules, load: Load, device_time_ns: u64) -> f64 {
        let Load { module, amount } = load;
        if amount > 0 && device_time_ns > 0 {
            let sample = amount as f64 / device_time_ns as f64;
            modules.observe(module, sample / self.points(module));
            let speed = sample / (self.score * modules.scale(module));
            self.speed.observe(speed);
            let presumed = self.speed;
            if let Some(found) = self.modules.iter_mut().find(|found| found.module == module) {
                found.speed.presume(presumed);
                found.speed.observe(speed);
            }
        }
        self.points(module) * device_time_ns as f64
    }

    fn find(&self, module: Module) -> Option<&ModuleThroughput> {
        self.modules.iter().find(|found| found.module == module)
    }

    fn forget_idle(&mut self) {
        if self.modules.len() >= MAX_DEVICE_MODULES
            && let Some(idle) = self.modules.iter().position(|found| found.jobs == 0)
        {
            self.modules.remove(idle);
        }
    }
}

/// A mean of positive samples that forgets the older ones; `None` before the first. It starts anew when several samples in
/// a row say that what is measured has changed.
#[derive(Clone, Copy, Debug, Default)]
struct Mean {
    value: Option<f64>,
    samples: u32,
    /// Samples in a row that were far off, negative where they were smaller.
    off_in_a_row: i8,
}

impl Mean {
    const NONE: Self = Self { value: None, samples: 0, off_in_a_row: 0 };

    /// Something to begin with, which counts as one sample.
    const fn presume(&mut self, other: Self) {
        if self.value.is_none() {
            *self = Self { samples: 1, ..other };
        }
    }

    fn observe(&mut self, sample: f64) {
        let so_far = self.value.unwrap_or(sample);
        self.off_in_a_row = match sample / so_far {
            part if part > FAR_OFF => self.off_in_a_row.max(0) + 1,
            part if part < 1.0 / FAR_OFF => self.off_in_a_row.min(0) - 1,
            _ => 0,
        };
        if self.off_in_a_row.abs() == CHANGED_AFTER {
            *self = Self { value: Some(sample), samples: 1, off_in_a_row: 0 };
            return;
        }
        self.samples = self.samples.saturating_add(1);
        let sample = sample.clamp(so_far / MAX_RATE_STEP, so_far * MAX_RATE_STEP);
        let gain = (1.0 / f64::from(self.samples)).max(LEAST_RATE_GAIN);
        self.value = Some(so_far + gain * (sample - so_far));
    }
}
