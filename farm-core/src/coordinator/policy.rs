//! How the jobs of a batch are spread over the devices that may take them: the policies an application may choose from
//! (10-scheduling.md section 1).
//!
//! A policy sees a batch and the devices, and answers a choice for every job. It keeps no books and changes none. Three
//! are built in (one of them sees a batch in parts: `reserve`); a further kind, the plug-in, is a shared object that the
//! coordinator's driver asks in a process of its own, and its answer comes as an event.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::id::{AppId, DeviceIndex, JobIndex, NodeId, TaskId};

/// Name of the policy that takes jobs in their order and each to the device that would finish it first.
pub const FCFS: &str = "fcfs";

/// Name of the policy that knows what the same job took in the application's last task.
pub const HISTORY: &str = "history";

/// Name of the policy that knows what a job takes by what the jobs of indices beside it took.
pub const NEIGHBOURS: &str = "neighbours";

/// Names that no plug-in may have.
pub const BUILT_IN: [&str; 3] = [FCFS, NEIGHBOURS, HISTORY];

/// One question to a plug-in, never reused in one life of the coordinator.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct QuestionId(pub u64);

/// A batch to be placed, as a policy sees it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Question {
    /// Whose jobs.
    pub app: AppId,
    /// Their task.
    pub task: TaskId,
    /// The jobs, in the order they were asked for.
    pub jobs: Vec<QuestionJob>,
    /// The devices that may take them; at least one.
    pub devices: Vec<QuestionDevice>,
}

/// A job of a [`Question`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct QuestionJob {
    /// Its index in the task.
    pub index: JobIndex,
    /// Estimated work: nanoseconds on a device of speed 1.0 if the application said so, else in a unit of the batch's own.
    pub load: f64,
    /// The node that lost it last: another one is preferred.
    pub avoid: Option<NodeId>,
}

/// A device of a [`Question`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct QuestionDevice {
    /// Its node.
    pub node: NodeId,
    /// Which of the node's.
    pub device: DeviceIndex,
    /// When it will be done with what it has, in nanoseconds from now.
    pub free_at_ns: f64,
    /// Nanoseconds that a unit of load takes there.
    pub time_per_load: f64,
    /// When what the batch needs can be there, in nanoseconds from now; zero where it is there.
    pub ready_at_ns: f64,
}

/// A job's place, by positions in the [`Question`]'s lists.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Choice {
    /// Which of the jobs.
    pub job: u32,
    /// Which of the devices.
    pub device: u32,
}

/// What an application chose.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Policy {
    Fcfs,
    History,
    Neighbours,
    /// By its name in the coordinator's folder.
    Plugin(String),
}

impl Policy {
    pub(super) fn named(name: &str) -> Self {
        match name {
            "" | FCFS => Self::Fcfs,
            HISTORY => Self::History,
            NEIGHBOURS => Self::Neighbours,
            name => Self::Plugin(name.to_owned()),
        }
    }

    /// Whether it learns from the jobs of a batch what the others cost, and lets them go out in parts.
    pub(super) const fn learns(&self) -> bool {
        match self {
            Self::Fcfs | Self::History | Self::Plugin(_) => false,
            Self::Neighbours => true,
        }
    }
}

/// A policy that answers at once.
pub(super) trait PlacementPolicy {
    /// A choice for every job, in the order they should run.
    fn place(&self, question: &Question) -> Vec<Choice>;
}

/// First come, first served, by list scheduling: each job in its turn to the device that would finish it first.
///
/// A scan, not a heap: with unequal loads and rates the order of finishes differs from job to job. The scan reads few
/// numbers per device; see `farm-core/tests/placement_cost.rs` for what it costs at 1,000 devices.
#[derive(Debug)]
pub(super) struct Fcfs;

impl PlacementPolicy for Fcfs {
    fn place(&self, question: &Question) -> Vec<Choice> {
        let mut queues = Queues::of(&question.devices);
        (0_u32..)
            .zip(&question.jobs)
            .map(|(job, wanted)| Choice { job, device: queues.take(wanted) })
            .collect()
    }
}

/// Longest first: what a batch of known costs gains most from.
#[derive(Debug)]
pub(super) struct LongestFirst;

impl PlacementPolicy for LongestFirst {
    fn place(&self, question: &Question) -> Vec<Choice> {
        let mut jobs: Vec<(u32, &QuestionJob)> = (0_u32..).zip(&question.jobs).collect();
        // Stable: equal ones stay first come, first served.
        jobs.sort_by(|(_, one), (_, other)| other.load.total_cmp(&one.load));
        let mut queues = Queues::of(&question.devices);
        jobs.into_iter().map(|(job, wanted)| Choice { job, device: queues.take(wanted) }).collect()
    }
}

/// Longest first, then exchanged between devices while the one that ends last ends sooner by it: for the last jobs of a batch,
/// whose costs are known.
///
/// Longest first leaves devices ends that are up to a job apart where the shortest jobs are not much shorter than the others.
#[derive(Debug)]
pub(super) struct Packed;

impl PlacementPolicy for Packed {
    fn place(&self, question: &Question) -> Vec<Choice> {
        let mut choices = LongestFirst.place(question);
        let mut ends = Ends::of(question, &choices);
        let mut looks = 0;
        while looks < MAX_LOOKS {
            looks += choices.len() * choices.len().div_ceil(question.devices.len());
            let Some(exchange) = ends.best_exchange(question, &choices) else { break };
            ends.carry_out(question, &mut choices, exchange);
        }
        choices
    }
}

/// Most pairs of jobs that one batch's exchanges look at: some milliseconds. With 32 devices there is nothing left to exchange
/// after a tenth of it.
const MAX_LOOKS: usize = 1 << 20;

/// What an exchange has to gain, as a part of the time at which the last device ends.
const LEAST_EXCHANGE: f64 = 1e-4;

/// When each device of a question ends with what it was chosen for, in nanoseconds from now.
struct Ends(Vec<f64>);

/// A job that moves off the device that ends last.
struct Exchange {
    /// Positions in the choices: the job, and the one that comes for it, if any.
    out: usize,
    back: Option<usize>,
    to: u32,
}

impl Ends {
    fn of(question: &Question, choices: &[Choice]) -> Self {
        let mut ends = Self(question.devices.iter().map(|device| device.free_at_ns).collect());
        for &Choice { job, device } in choices {
            let end = &mut ends.0[device as usize];
            *end = end.max(question.devices[device as usize].ready_at_ns) + time_ns(question, job, device);
        }
        ends
    }

    /// The exchange after which the later of its two devices ends soonest.
    fn best_exchange(&self, question: &Question, choices: &[Choice]) -> Option<Exchange> {
        let (last, &end) = (0_u32..).zip(&self.0).max_by(|(_, one), (_, other)| one.total_cmp(other))?;
        let mut best = (end * (1.0 - LEAST_EXCHANGE), None);
        let mut consider = |later: f64, exchange: Exchange| {
            if later < best.0 {
                best = (later, Some(exchange));
            }
        };
        for (out, chosen) in choices.iter().enumerate().filter(|(_, chosen)| chosen.device == last) {
            let without = end - time_ns(question, chosen.job, last);
            for (to, &other) in (0_u32..).zip(&self.0).filter(|(to, _)| may_run(question, chosen.job, *to)) {
                let here = other.max(question.devices[to as usize].ready_at_ns);
                let later = without.max(here + time_ns(question, chosen.job, to));
                consider(later, Exchange { out, back: None, to });
            }
            for (back, other) in choices.iter().enumerate().filter(|(_, other)| other.device != last) {
                let to = other.device;
                if !may_run(question, chosen.job, to) || !may_run(question, other.job, last) {
                    continue;
                }
                let there = self.0[to as usize] - time_ns(question, other.job, to);
                let later = (without + time_ns(question, other.job, last))
                    .max(there + time_ns(question, chosen.job, to));
                consider(later, Exchange { out, back: Some(back), to });
            }
        }
        best.1
    }

    fn carry_out(&mut self, question: &Question, choices: &mut [Choice], exchange: Exchange) {
        let Exchange { out, back, to } = exchange;
        let from = choices[out].device;
        choices[out].device = to;
        if let Some(back) = back {
            choices[back].device = from;
        }
        *self = Self::of(question, choices);
    }
}

fn may_run(question: &Question, job: u32, device: u32) -> bool {
    question.jobs[job as usize].avoid != Some(question.devices[device as usize].node)
}

fn time_ns(question: &Question, job: u32, device: u32) -> f64 {
    question.jobs[job as usize].load * question.devices[device as usize].time_per_load
}

/// How busy the devices of a question are, as its jobs are spread over them.
struct Queues(Vec<Queue>);

/// Times are in nanoseconds from now.
struct Queue {
    node: NodeId,
    free_at: f64,
    ready_at: f64,
    time_per_load: f64,
}

impl Queues {
    fn of(devices: &[QuestionDevice]) -> Self {
        let queue = |device: &QuestionDevice| Queue {
            node: device.node,
            free_at: device.free_at_ns,
            ready_at: device.ready_at_ns,
            time_per_load: device.time_per_load,
        };
        Self(devices.iter().map(queue).collect())
    }

    /// Gives a job to the device that would finish it first; to one of another node than the one to avoid wherever there
    /// is one.
    fn take(&mut self, job: &QuestionJob) -> u32 {
        let everywhere = || (0_u32..).zip(&self.0);
        let elsewhere = everywhere().filter(|(_, queue)| job.avoid != Some(queue.node));
        let chosen = earliest(elsewhere, job.load).or_else(|| earliest(everywhere(), job.load));
        let (device, finish) = chosen.expect("a question has at least one device");
        if let Some(queue) = self.0.get_mut(device as usize) {
            queue.free_at = finish;
        }
        device
    }
}

/// The device with the earliest finish, and the finish.
fn earliest<'queue>(queues: impl Iterator<Item = (u32, &'queue Queue)>, load: f64) -> Option<(u32, f64)> {
    let mut best = None;
    for (index, queue) in queues {
        let finish = queue.free_at.max(queue.ready_at) + load * queue.time_per_load;
        if best.is_none_or(|(_, earliest)| finish < earliest) {
            best = Some((index, finish));
        }
    }
    best
}

/// Most applications whose last task is remembered, by name; beyond it the one that computed longest ago is forgotten.
const MAX_HISTORIES: usize = 64;

/// Most jobs of a task that are remembered (256 KiB); those of larger indices are as good as unknown.
const MAX_HISTORY_JOBS: usize = 65_536;

/// What the jobs of applications took the last time, by the application's name and the job's index.
#[derive(Debug, Default)]
pub(super) struct History {
    by_name: BTreeMap<String, Past>,
    notes: u64,
}

#[derive(Debug, Default)]
struct Past {
    /// Of each job, in points of score times nanoseconds: neither the device nor the scale of its module shows.
    point_ns: Vec<f32>,
    last_note: u64,
}

impl History {
    #[expect(clippy::cast_possible_truncation, reason = "seven digits are more than a hint needs")]
    pub(super) fn note(&mut self, app: &str, index: JobIndex, point_ns: f64) {
        let Some(index) = usize::try_from(index.0).ok().filter(|index| *index < MAX_HISTORY_JOBS) else {
            return;
        };
        self.notes += 1;
        if !self.by_name.contains_key(app) {
            if self.by_name.len() >= MAX_HISTORIES
                && let Some(oldest) =
                    self.by_name.iter().min_by_key(|(_, past)| past.last_note).map(|(name, _)| name.clone())
            {
                self.by_name.remove(&oldest);
            }
            self.by_name.insert(app.to_owned(), Past::default());
        }
        let Some(past) = self.by_name.get_mut(app) else { return };
        past.last_note = self.notes;
        if past.point_ns.len() <= index {
            past.point_ns.resize(index + 1, 0.0);
        }
        past.point_ns[index] = point_ns as f32;
    }

    /// What a job took the last time, in points of score times nanoseconds (temporal coherence: thesis 5.6.3, of fly-throughs).
    pub(super) fn recall(&self, app: &str, index: JobIndex) -> Option<f64> {
        let index = usize::try_from(index.0).ok()?;
        let point_ns = self.by_name.get(app)?.point_ns.get(index)?;
        (*point_ns > 0.0).then(|| (*point_ns).into())
    }
}
