//! The farm of the scenarios, and how it is looked at: unless said otherwise 3 applications, 4 nodes of 2 devices, 2,000 jobs,
//! with the design's own timings (heartbeat 1 s, lease 10 s, application lease 30 s).

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use farm_core::{
    coordinator::{NodeState, NodeStatus},
    id::{AppId, JobAttempt, JobId, NodeId},
    time::Instant,
};
use tests::sim::{
    faults::{Fault, keepalive},
    network::Proc,
    world::{Happening, Setup, World},
};

/// Each scenario is run with these; its figure is the worst of them.
pub(super) const SEEDS: std::ops::Range<u64> = 0..2;

/// Devices, of the farm.
pub(super) const DEVICES: u32 = 8;

/// The lease of a node.
pub(super) const LEASE_S: f64 = 10.0;

/// A job takes 101 ms on average, 200 ms at most: 2,000 of them are 25 s of the whole farm.
pub(super) const SPEED: f64 = 0.1;

/// And here 201 ms and 400 ms: 50 s, for faults that last as long.
pub(super) const HALF_SPEED: f64 = 0.05;

/// Longest a job takes at [`HALF_SPEED`].
pub(super) const LONGEST_S: f64 = 0.4;

/// The farm of section 5.
pub(super) fn setup(seed: u64, speed: f64) -> Setup {
    Setup::designed(seed, vec![vec![speed; 2]; 4], 3)
}

/// A farm and its work, submitted when everybody is there.
pub(super) fn farm(setup: Setup) -> World {
    let mut world = World::new(setup);
    submit(&mut world, 0);
    world
}

/// Each application's part of 2,000 jobs, as this task, 100 ms from now.
pub(super) fn submit(world: &mut World, task: u32) {
    let at_ms = u64::try_from(world.now.since(Instant::ZERO).as_millis()).expect("minutes") + 100;
    for (app, jobs) in [667, 667, 666].into_iter().enumerate() {
        world.submit(at_ms, app, task, jobs);
    }
}

pub(super) fn seconds(duration_s: f64) -> Duration {
    Duration::from_secs_f64(duration_s)
}

/// Lets a fault happen a while from now.
pub(super) fn after(world: &mut World, wait: Duration, fault: Fault) {
    world.after(wait, Happening::Fault(fault));
}

/// Nothing gets through either way for a while; the keepalives notice, if it lasts.
pub(super) fn part(world: &mut World, one: Proc, other: Proc, duration: Duration) {
    world.fault(Fault::Partition { from: one, to: other, duration });
    world.fault(Fault::Partition { from: other, to: one, duration });
    let patience = keepalive(one, other);
    if duration > patience {
        after(world, patience, Fault::TimeOut { one, other });
    }
}

pub(super) fn app_id(world: &World, app: usize) -> AppId {
    world.apps[app].ledger.app().expect("it is registered")
}

/// What the coordinator knows of a worker.
pub(super) fn node(world: &World, worker: usize) -> Option<NodeStatus> {
    let name = format!("worker-{worker}");
    world.coordinator.status().nodes.into_iter().find(|node| node.name == name)
}

pub(super) fn is_alive(world: &World, worker: usize) -> bool {
    node(world, worker).is_some_and(|node| node.state == NodeState::Alive)
}

/// Jobs that applications have on a worker, and no result of.
pub(super) fn undelivered_on(world: &World, worker: usize) -> BTreeSet<JobId> {
    let node: Option<NodeId> = node(world, worker).map(|node| node.node);
    let mut undelivered = BTreeSet::new();
    for host in &world.apps {
        let Some(app) = host.ledger.app() else { continue };
        let here = host.ledger.open_jobs().filter(|(_, _, place)| place.map(|(node, _)| node) == node);
        undelivered.extend(here.map(|(task, index, _)| JobId { app, task, index }));
    }
    undelivered
}

/// When each of these jobs was planned anew since a moment.
pub(super) fn planned_since(
    world: &World,
    since: Instant,
    jobs: &BTreeSet<JobId>,
) -> BTreeMap<JobId, Instant> {
    let mut planned = BTreeMap::new();
    for plan in world.diary.plans.iter().filter(|plan| plan.at > since && jobs.contains(&plan.job.job)) {
        planned.entry(plan.job.job).or_insert(plan.at);
    }
    planned
}

/// The word that a job is over takes so long at most to a node that was about to run it again: one message.
const WORD: Duration = Duration::from_millis(5);

/// Executions that began after their job's result had been delivered, and word of it could be there.
pub(super) fn reruns_of_delivered(world: &World) -> usize {
    let over: BTreeMap<JobId, Instant> =
        world.diary.endings.iter().map(|ended| (ended.job, ended.at)).collect();
    let runs = world.diary.runs.iter();
    runs.filter(|run| over.get(&run.job.job).is_some_and(|over| run.began > over.after(WORD))).count()
}

/// The attempt that ended last on a worker.
pub(super) fn ended_last_on(world: &World, worker: usize) -> Option<JobAttempt> {
    let ended = world.diary.runs.iter().filter(|run| run.worker == worker);
    ended.filter_map(|run| Some((run.ended?, run.job))).max_by_key(|(ended, _)| *ended).map(|(_, job)| job)
}

pub(super) fn runs_of(world: &World, job: JobId) -> usize {
    world.diary.runs.iter().filter(|run| run.job.job == job).count()
}

/// The part of the farm's device time that was used between two moments.
pub(super) fn used(world: &World, from: Instant, to: Instant) -> f64 {
    let busy = world.diary.busy(from, to, |_| true).as_secs_f64();
    busy / (to.since(from).as_secs_f64() * f64::from(DEVICES))
}

/// The largest of the figures of all seeds.
pub(super) fn worst(figure: impl FnMut(u64) -> f64) -> f64 {
    SEEDS.map(figure).fold(0.0, f64::max)
}
