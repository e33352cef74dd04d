//! What ran when and where, as the thesis draws it (figures 5.11 to 5.17): a bounded record of ended attempts. Nothing
//! is decided by it.
//!
//! Nodes tell times by their own clocks. They are kept as told, and put on the coordinator's clock when they are read:
//! by the least delay between a report's leaving and its coming that was seen in those minutes. All times of one node
//! shift together that way, so its order of events stays as it was, and no event seems to be before its cause.

use std::collections::{BTreeMap, VecDeque};

use serde::{Deserialize, Serialize};

use super::{
    CoordinatorMachine,
    model::{App, JobState, Placement},
};
use crate::{
    id::{AppId, DeviceIndex, JobAttempt, JobId, NodeId, NodeSession, TaskId},
    message::{Executed, JobFailure, JobTrace, NodeHello},
    time::Instant,
};

/// Ended attempts kept: 128 Ki of about 130 bytes each, 16 MiB in all. The oldest go first, and are counted.
pub const MAX_SEGMENTS: usize = 131_072;

/// Lives of nodes whose names and clocks are kept. The oldest go first; what ran there goes with them, from the pictures.
const MAX_LIVES: usize = 16_384;

/// Names of applications kept; the oldest go first.
const MAX_NAMED_APPS: usize = 16_384;

/// Places kept of jobs whose application left before the node's report came: as many as one plan request may name.
const MAX_DEPARTED: usize = 16_384;

/// Time over which a node's least delay is taken, in nanoseconds (one minute): clocks that run apart by 100 ppm are
/// 6 ms apart after it.
const WINDOW_NS: u64 = 60_000_000_000;

/// Windows kept for one life of a node (two hours); older times are mapped by the oldest of them.
const MAX_WINDOWS: usize = 120;

/// How an attempt in the timeline ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// With a result.
    Completed,
    /// Without one.
    Failed,
}

/// How an attempt came to a device that it was not planned for at first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Migration {
    /// From the queue of a sibling device of the same node.
    Local {
        /// The sibling.
        device: DeviceIndex,
    },
    /// From another node. A local steal after it is not told apart.
    Global {
        /// The victim.
        node: NodeId,
        /// Where it was planned there.
        device: DeviceIndex,
    },
}

/// One attempt on one device. Times are the coordinator's.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Segment {
    /// Which attempt.
    pub job: JobAttempt,
    /// Where it ran.
    pub node: NodeId,
    /// On which of its devices.
    pub device: DeviceIndex,
    /// Planned for the node.
    pub scheduled_at: Instant,
    /// Handed to the device's executor.
    pub staged_at: Instant,
    /// Began to run.
    pub started_at: Instant,
    /// Ended.
    pub ended_at: Instant,
    /// Measured device time, nanoseconds.
    pub device_time_ns: u64,
    /// How it ended.
    pub outcome: Outcome,
    /// How it got there, if it was stolen.
    pub migration: Option<Migration>,
}

/// A node in a [`Timeline`]; it may have left.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TimelineNode {
    /// The node.
    pub node: NodeId,
    /// For people.
    pub name: String,
    /// Its devices' names, by index.
    pub devices: Vec<String>,
}

/// An application with segments in the record; it may have left.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TimelineApp {
    /// The application.
    pub app: AppId,
    /// For people.
    pub name: String,
    /// Its tasks with segments, and how many.
    pub tasks: Vec<(TaskId, u64)>,
}

/// What [`Timeline`] says besides its segments.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TimelineHead {
    /// By id: the nodes of the segments, and those that are there.
    pub nodes: Vec<TimelineNode>,
    /// Every application in the record, by id, whatever was asked for.
    pub apps: Vec<TimelineApp>,
    /// Older segments that the record had no room for, of all applications.
    pub dropped_segments: u64,
    /// Older segments that were asked for and are more than the answer may hold.
    pub omitted_segments: u64,
}

/// What ran when and where.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Timeline {
    /// Names and counts.
    #[serde(flatten)]
    pub head: TimelineHead,
    /// In the order in which they were reported.
    pub segments: Vec<Segment>,
}

/// Which part of the record is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimelineQuery {
    /// Of one application, or of all.
    pub app: Option<AppId>,
    /// Of one task of it, or of all.
    pub task: Option<TaskId>,
    /// The newest so many.
    pub max_segments: usize,
}

/// The record.
#[derive(Debug, Default)]
pub(super) struct Record {
    segments: VecDeque<Told>,
    dropped: u64,
    lives: BTreeMap<LifeId, Life>,
    /// The newest life of each node in `lives`.
    newest: BTreeMap<NodeId, LifeId>,
    next_life: u32,
    apps: BTreeMap<AppId, String>,
    /// Where jobs were when their application left: their reports may still be on the way.
    departed: BTreeMap<JobId, Placement>,
}

/// A life of a node, in the order of registration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct LifeId(u32);

#[derive(Debug)]
struct Life {
    session: NodeSession,
    node: TimelineNode,
    windows: VecDeque<Window>,
}

/// The least delay of reports that left in a window of the node's time. It includes what the clocks are apart.
#[derive(Clone, Copy, Debug)]
struct Window {
    since: Instant,
    least_delay_ns: i64,
}

/// A segment as its node told it.
#[derive(Clone, Copy, Debug)]
struct Told {
    job: JobAttempt,
    life: LifeId,
    device: DeviceIndex,
    scheduled_at: Instant,
    trace: JobTrace,
    device_time_ns: u64,
    outcome: Outcome,
    stolen_from: Option<(NodeId, DeviceIndex)>,
}

impl CoordinatorMachine {
    /// The newest ended attempts that fit the query, whether or not their application and nodes are still there.
    #[must_use]
    pub fn timeline(&self, query: TimelineQuery) -> Timeline {
        let present = |id: NodeId| self.nodes.contains_key(&id);
        self.timeline.read(query, present)
    }

    /// Keeps what a report says of an attempt that counts: one that was replaced or is known already does not.
    pub(super) fn trace(&mut self, node: NodeId, ended: &Executed) {
        let outcome = match ended.failure {
            None => Outcome::Completed,
            // It never ran.
            Some(JobFailure::Returned) => return,
            Some(_) => Outcome::Failed,
        };
        let id = ended.job.job;
        let this = |place: &Placement| (place.node, place.attempt) == (node, ended.job.attempt);
        let place = match self.job(id).map(|job| job.state) {
            Some(JobState::Placed(place)) if this(&place) => Some(place),
            Some(_) => self.backups.get(&id).copied().filter(this),
            None => self.timeline.departed.get(&id).copied().filter(this),
        };
        if let Some(place) = place {
            self.timeline.push(&place, ended, outcome);
        }
    }
}

impl Record {
    /// A node said hello.
    pub(super) fn node_known(&mut self, node: NodeId, hello: &NodeHello) {
        let known = self.newest.get(&node).and_then(|life| self.lives.get(life));
        if known.is_some_and(|life| life.session == hello.session) {
            return;
        }
        if self.lives.len() == MAX_LIVES
            && let Some((life, gone)) = self.lives.pop_first()
            && self.newest.get(&gone.node.node) == Some(&life)
        {
            self.newest.remove(&gone.node.node);
        }
        let id = LifeId(self.next_life);
        self.next_life = self.next_life.wrapping_add(1);
        let devices = hello.devices.iter().map(|device| device.name.clone()).collect();
        let node_names = TimelineNode { node, name: hello.name.clone(), devices };
        let life = Life { session: hello.session, node: node_names, windows: VecDeque::new() };
        self.lives.insert(id, life);
        self.newest.insert(node, id);
    }

    /// An application was registered.
    pub(super) fn app_known(&mut self, app: AppId, name: &str) {
        if self.apps.len() == MAX_NAMED_APPS {
            self.apps.pop_first();
        }
        self.apps.insert(app, name.to_owned());
    }

    /// An application leaves: what its nodes still report of it ran all the same.
    pub(super) fn app_leaves(&mut self, id: AppId, app: &App) {
        for (key, job) in &app.jobs {
            if let JobState::Placed(place) = job.state {
                if self.departed.len() == MAX_DEPARTED {
                    self.departed.pop_first();
                }
                self.departed.insert(key.in_app(id), place);
            }
        }
    }

    /// A report came in.
    pub(super) fn report_came(&mut self, now: Instant, node: NodeId, sent_at: Instant) {
        let life = self.newest.get(&node).and_then(|life| self.lives.get_mut(life));
        let Some(life) = life else { return };
        let delay_ns = now.0.wrapping_sub(sent_at.0).cast_signed();
        match life.windows.back_mut() {
            Some(window) if sent_at.0.saturating_sub(window.since.0) < WINDOW_NS => {
                window.least_delay_ns = window.least_delay_ns.min(delay_ns);
            }
            Some(_) | None => {
                if life.windows.len() == MAX_WINDOWS {
                    life.windows.pop_front();
                }
                life.windows.push_back(Window { since: sent_at, least_delay_ns: delay_ns });
            }
        }
    }

    fn push(&mut self, place: &Placement, ended: &Executed, outcome: Outcome) {
        let Some(&life) = self.newest.get(&place.node) else { return };
        if self.segments.len() == MAX_SEGMENTS {
            self.segments.pop_front();
            self.dropped += 1;
        }
        self.segments.push_back(Told {
            job: ended.job,
            life,
            device: ended.device,
            scheduled_at: place.planned_at,
            trace: ended.trace,
            device_time_ns: ended.device_time_ns,
            outcome,
            stolen_from: place.stolen_from,
        });
        if !self.departed.is_empty() {
            self.departed.remove(&ended.job.job);
        }
    }

    fn read(&self, query: TimelineQuery, present: impl Fn(NodeId) -> bool) -> Timeline {
        let mut tasks: BTreeMap<AppId, BTreeMap<TaskId, u64>> = BTreeMap::new();
        let mut found: VecDeque<Segment> = VecDeque::new();
        let mut omitted = 0_u64;
        for told in self.segments.iter().rev() {
            let JobId { app, task, .. } = told.job.job;
            *tasks.entry(app).or_default().entry(task).or_default() += 1;
            let wanted = query.app.is_none_or(|wanted| wanted == app)
                && query.task.is_none_or(|wanted| wanted == task);
            if !wanted {
                continue;
            }
            match self.lives.get(&told.life) {
                Some(life) if found.len() < query.max_segments => found.push_front(told.on(life)),
                Some(_) | None => omitted += 1,
            }
        }
        let named = |app: AppId| self.apps.get(&app).cloned().unwrap_or_default();
        let apps = tasks
            .into_iter()
            .map(|(app, tasks)| TimelineApp { app, name: named(app), tasks: tasks.into_iter().collect() })
            .collect();
        let mut nodes: BTreeMap<NodeId, &TimelineNode> = BTreeMap::new();
        let mut used: Vec<NodeId> = Vec::new();
        for segment in &found {
            let victim = match segment.migration {
                Some(Migration::Global { node, .. }) => Some(node),
                Some(Migration::Local { .. }) | None => None,
            };
            used.extend(victim.into_iter().chain([segment.node]));
        }
        used.extend(self.newest.keys().copied().filter(|&id| present(id)));
        for id in used {
            if let Some(life) = self.newest.get(&id).and_then(|life| self.lives.get(life)) {
                nodes.insert(id, &life.node);
            }
        }
        let head = TimelineHead {
            nodes: nodes.into_values().cloned().collect(),
            apps,
            dropped_segments: self.dropped,
            omitted_segments: omitted,
        };
        Timeline { head, segments: found.into() }
    }
}

impl Told {
    /// With its times on the coordinator's clock.
    fn on(&self, life: &Life) -> Segment {
        let JobTrace { staged_at, started_at, ended_at, stolen_from } = self.trace;
        let delay_ns = life.delay_ns(ended_at);
        let here = |at: Instant| Instant(at.0.saturating_add_signed(delay_ns));
        let local = stolen_from.map(|device| Migration::Local { device });
        let global = self.stolen_from.map(|(node, device)| Migration::Global { node, device });
        Segment {
            job: self.job,
            node: life.node.node,
            device: self.device,
            scheduled_at: self.scheduled_at,
            staged_at: here(staged_at),
            started_at: here(started_at),
            ended_at: here(ended_at),
            device_time_ns: self.device_time_ns,
            outcome: self.outcome,
            migration: global.or(local),
        }
    }
}

impl Life {
    /// The least delay around `at`: of its window and the two beside it, so that a window with few reports does not jump.
    fn delay_ns(&self, at: Instant) -> i64 {
        let index = self.windows.partition_point(|window| window.since <= at).saturating_sub(1);
        let near = self.windows.iter().skip(index.saturating_sub(1)).take(3);
        near.map(|window| window.least_delay_ns).min().unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn life(reports: &[(u64, u64)]) -> Life {
        let node = TimelineNode { node: NodeId(1), name: String::new(), devices: Vec::new() };
        let mut record = Record { newest: BTreeMap::from([(NodeId(1), LifeId(0))]), ..Record::default() };
        record.lives.insert(LifeId(0), Life { session: NodeSession(1), node, windows: VecDeque::new() });
        for &(sent_at, received) in reports {
            record.report_came(Instant(received), NodeId(1), Instant(sent_at));
        }
        record.lives.remove(&LifeId(0)).expect("put there")
    }

    #[test]
    fn the_least_delay_of_a_window_places_its_times() {
        // The node's clock is 1,000 behind; its reports are 50, 3 and 20 on the way.
        let life = life(&[(100, 1_150), (200, 1_203), (300, 1_320)]);
        assert_eq!(life.delay_ns(Instant(250)), 1_003);
        assert_eq!(life.delay_ns(Instant(50)), 1_003, "before the first report too");
    }

    #[test]
    fn a_node_may_be_ahead_of_the_coordinator() {
        assert_eq!(life(&[(1_000_000, 10)]).delay_ns(Instant(1_000_000)), -999_990);
    }

    #[test]
    fn clocks_that_run_apart_are_followed() {
        // Two minutes of each minute's reports 6 ms later than before: 100 ppm.
        let reports: Vec<(u64, u64)> =
            (0..10).map(|minute| (minute * WINDOW_NS, minute * (WINDOW_NS + 6_000_000))).collect();
        let life = life(&reports);
        assert_eq!(life.windows.len(), 10);
        let error = life.delay_ns(Instant(9 * WINDOW_NS)) - 9 * 6_000_000;
        assert!((-6_000_000..=0).contains(&error), "{error} ns: within one window's drift");
    }

    #[test]
    fn windows_are_bounded() {
        let reports: Vec<(u64, u64)> =
            (0..2 * MAX_WINDOWS as u64).map(|minute| (minute * WINDOW_NS, minute * WINDOW_NS)).collect();
        assert_eq!(life(&reports).windows.len(), MAX_WINDOWS);
    }
}
