//! What moves between nodes: global stealing by the retract protocol (10-scheduling.md section 3), and the same towards
//! a node that joined.
//!
//! A steal names attempts to the victim, which alone says what it gives up; only then a new attempt goes to the thief.
//! Whatever happens to the order or its answer, each job stays on the books of exactly one node.
//!
//! Decisions are between pools: the devices of one kind on one node, which share work by local stealing.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use super::{
    CoordinatorMachine, NodeState,
    model::{App, Device, Job, JobState, Node, Placement},
    placement::FETCH_NS_PER_BYTE,
    rates::{Module, Modules},
};
use crate::{
    device::DeviceKind,
    id::{AppId, Attempt, DeviceIndex, JobAttempt, JobId, JobKey, NodeId, StealId},
    message::CoordinatorToNode,
    time::Instant,
};

/// What a steal takes besides messages, in nanoseconds (6 ms): 5 ms that the victim's reports may be old, 1 ms for
/// staging.
const STEAL_OVERHEAD_NS: f64 = 6e6;

/// What an answer is taken to need before the first one came, in nanoseconds (2 ms): two messages on a LAN.
const FIRST_ANSWER_NS: f64 = 2e6;

/// Weight of a new answer in the mean time of answers.
const ANSWER_GAIN: f64 = 0.2;

/// What a steal takes from the decision until its first job may start on the thief. Four messages of like ways (retract,
/// answer, plan, ticket), of which the first two are measured, and the rest.
#[derive(Debug)]
pub(super) struct StealLatency {
    answer_ns: f64,
}

impl Default for StealLatency {
    fn default() -> Self {
        Self { answer_ns: FIRST_ANSWER_NS }
    }
}

impl StealLatency {
    pub(super) fn ns(&self) -> f64 {
        2.0 * self.answer_ns + STEAL_OVERHEAD_NS
    }

    fn answered(&mut self, after: Duration) {
        self.answer_ns += ANSWER_GAIN * (after.as_nanos() as f64 - self.answer_ns);
    }
}

/// The least gain worth a steal, as a part of the job's finish on the victim: below it the estimates' errors decide.
const LEAST_GAIN: f64 = 0.2;

/// What is stolen at once should last this many steal latencies on each device.
const ROUND_LATENCIES: f64 = 4.0;

/// Most steals of one job.
pub(super) const MAX_STEALS: usize = 3;

/// How long a stolen job stays where it is, in milliseconds (ten steal latencies). The node does not report starts;
/// by then it has the job in its queue and its books are true.
const REST_MS: u64 = 100;

/// Most jobs of one steal. More would keep a victim of many small jobs at it for long.
const MAX_STOLEN_JOBS: usize = 4_096;

/// Most victims that are looked into for one thief at a time.
const MAX_VICTIMS: usize = 4;

/// How long an answer may take before the thief may try elsewhere, in milliseconds. A later answer still counts.
const ANSWER_MS: u64 = 1_000;

/// Pause after a look at the farm that found nothing to steal. A look costs some 100 ns for each node (and device), so the
/// pause grows by 1 us with the square of the nodes: with every node looking it is a tenth of a core at most.
const LOOKING_PAUSE: Duration = Duration::from_millis(2);

/// Pause after the first refusal of a victim, in milliseconds; it doubles with each further one.
const PAUSE_MS: u64 = 10;

/// The pause doubles at most this often: 640 ms.
const MAX_DOUBLINGS: u32 = 6;

/// A retract order without an answer.
#[derive(Debug)]
pub(super) struct Steal {
    pub(super) thief: NodeId,
    /// Which of the thief's devices asked.
    kind: DeviceKind,
    pub(super) victim: NodeId,
    /// As they were when the order left; some may have ended since.
    pub(super) jobs: BTreeMap<JobId, Attempt>,
    /// Time that they take the victim, in nanoseconds.
    leaving_ns: f64,
    ordered_at: Instant,
    pub(super) answer_by: Instant,
}

/// The devices of one kind on one node.
#[derive(Debug)]
struct Pool<'farm> {
    node: NodeId,
    kind: DeviceKind,
    devices: Vec<&'farm Device>,
    modules: &'farm Modules,
    jobs: u64,
    /// How long its work takes, in nanoseconds.
    remaining_ns: f64,
}

impl<'farm> Pool<'farm> {
    fn of(
        now: Instant,
        id: NodeId,
        node: &'farm Node,
        kind: DeviceKind,
        modules: &'farm Modules,
    ) -> Option<Self> {
        let of_kind = |device: &&Device| !device.lost && device.info.kind == kind;
        let devices: Vec<&Device> = node.devices.iter().filter(of_kind).collect();
        let jobs = devices.iter().map(|device| device.planned_jobs).sum();
        let mut pool = Self { node: id, kind, devices, modules, jobs, remaining_ns: 0.0 };
        // What each device has left, in the time that all of them together take for it.
        let mut queued: BTreeMap<Module, f64> = BTreeMap::new();
        for device in &pool.devices {
            let queued_ns = device.throughput.queued_ns(modules);
            let left = if queued_ns > 0.0 { device.free_at_ns(now, modules) / queued_ns } else { 0.0 };
            for (module, amount) in device.throughput.queued() {
                *queued.entry(module).or_default() += amount as f64 * left;
            }
        }
        pool.remaining_ns = queued.into_iter().map(|(module, amount)| amount / pool.rate(module)).sum();
        (!pool.devices.is_empty()).then_some(pool)
    }

    /// Load per nanosecond of all its devices.
    fn rate(&self, module: Module) -> f64 {
        self.devices.iter().map(|device| device.throughput.rate(self.modules, module)).sum()
    }

    /// When each of its devices is done with what it has.
    fn free_at_ns(&self, now: Instant) -> Vec<f64> {
        self.devices.iter().map(|device| device.free_at_ns(now, self.modules)).collect()
    }

    /// The last job ends later than [`Self::remaining_ns`], since devices do not end together: by half a job of one device
    /// on average, less what that job adds itself. In the time that all of them together take for a job.
    fn unevenness(&self) -> f64 {
        (self.devices.len() as f64 - 1.0) / 2.0
    }

    /// Whether some of its jobs must be off the devices still.
    fn has_waiting(&self) -> bool {
        self.jobs > self.devices.len() as u64
    }

    /// Whether what is not on a device yet lasts no longer than a steal.
    fn is_low(&self, latency_ns: f64) -> bool {
        let waiting = 1.0 - self.devices.len() as f64 / self.jobs.max(1) as f64;
        self.remaining_ns * waiting <= latency_ns
    }
}

impl CoordinatorMachine {
    /// A node was heard: if it will soon be out of work, it gets some of another's.
    pub(super) fn consider_stealing(&mut self, now: Instant, id: NodeId) {
        let Some(node) = self.nodes.get(&id).filter(|node| node.takes_work() && node.steal_at <= now) else {
            return;
        };
        let wanted = node.joining || self.apps.values().any(|app| app.global_stealing);
        if !wanted || self.steals.values().any(|steal| steal.thief == id) {
            return;
        }
        let kinds: BTreeSet<DeviceKind> = node.devices.iter().map(|device| device.info.kind).collect();
        let mut low = false;
        for kind in kinds {
            let pool = Pool::of(now, id, node, kind, &self.modules);
            let Some(thief) = pool.filter(|pool| pool.is_low(self.steal_latency.ns())) else { continue };
            low = true;
            if let Some((victim, jobs)) = self.find_loot(now, &thief) {
                self.order(now, (id, kind), victim, jobs);
                return;
            }
        }
        if low {
            self.pause_looking(now, id);
        }
    }

    /// The victim's answer. What it gave up is free, whether or not the steal is still known.
    pub(super) fn retracted(&mut self, now: Instant, victim: NodeId, id: StealId, given_up: &[JobAttempt]) {
        let steal = match self.steals.get(&id) {
            Some(steal) if steal.victim == victim => {
                self.steal_latency.answered(now.since(steal.ordered_at));
                self.end_steal(id)
            }
            Some(_) | None => None,
        };
        let mut moved: BTreeMap<AppId, Vec<JobKey>> = BTreeMap::new();
        for job in given_up {
            let state = self.job(job.job).map(|job| job.state);
            let Some(JobState::Placed(place)) = state else { continue };
            if (place.node, place.attempt) != (victim, job.attempt) {
                continue;
            }
            if steal.as_ref().is_some_and(|steal| self.move_job(now, job.job, place, steal)) {
                moved.entry(job.job.app).or_default().push(JobKey::of(job.job));
            } else {
                self.requeue(job.job, None);
            }
        }
        if let Some(steal) = steal {
            if moved.is_empty() {
                self.stole_in_vain(now, steal.thief);
            } else if let Some(thief) = self.nodes.get_mut(&steal.thief) {
                thief.joining = false;
                thief.vain_steals = 0;
            }
        }
        for (app, keys) in moved {
            self.stolen_jobs += keys.len() as u64;
            self.repeat_plan(app, &keys);
        }
    }

    /// Orders to a node that is gone, or in a new life, will have no answer. Its jobs stay on its books.
    pub(super) fn end_steals_from(&mut self, victim: NodeId) {
        for id in self.steals_from(victim) {
            self.end_steal(id);
        }
    }

    /// A victim is back on a new connection: order or answer went with the old one. What it does not hold it gave up,
    /// or it ended, or its ticket is still on the way: a new attempt is right in each case.
    pub(super) fn settle_interrupted_steals(&mut self, victim: NodeId, held: &BTreeMap<JobId, Attempt>) {
        for id in self.steals_from(victim) {
            let Some(steal) = self.end_steal(id) else { continue };
            let gone = |(job, attempt): &(JobId, Attempt)| {
                held.get(job) != Some(attempt) && self.is_placed(*job, victim, *attempt)
            };
            let gone: Vec<JobId> = steal.jobs.into_iter().filter(gone).map(|(job, _)| job).collect();
            self.move_off(victim, gone);
        }
    }

    pub(super) fn expire_steals(&mut self, now: Instant) {
        let due: Vec<(StealId, NodeId)> = self
            .steals
            .iter()
            .filter(|(_, steal)| steal.answer_by <= now)
            .map(|(&id, steal)| (id, steal.thief))
            .collect();
        for (id, thief) in due {
            self.end_steal(id);
            self.stole_in_vain(now, thief);
        }
    }

    /// The jobs that the thief should have, by the victim with the most work left that has any for it.
    fn find_loot(&self, now: Instant, thief: &Pool<'_>) -> Option<(NodeId, Vec<(JobId, Placement)>)> {
        let mut victims: Vec<Pool<'_>> = Vec::new();
        for (&id, node) in self.nodes.iter().filter(|(id, node)| **id != thief.node && can_answer(node)) {
            let kinds: BTreeSet<DeviceKind> = node.devices.iter().map(|device| device.info.kind).collect();
            for kind in kinds {
                let Some(mut pool) = Pool::of(now, id, node, kind, &self.modules) else { continue };
                pool.remaining_ns = (pool.remaining_ns - self.leaving_ns(id)).max(0.0);
                if pool.has_waiting() {
                    victims.push(pool);
                }
            }
        }
        victims.sort_by(|one, other| other.remaining_ns.total_cmp(&one.remaining_ns));
        victims.iter().take(MAX_VICTIMS).find_map(|victim| {
            let jobs = self.loot(now, thief, victim);
            (!jobs.is_empty()).then_some((victim.node, jobs))
        })
    }

    /// From the tail of the victim's queue, each job that ends sooner on the thief. Where both finish together it ends:
    /// `x = s_t (R - L s_v) / (s_v + s_t)` of 10-scheduling.md for small jobs, and whole jobs on whole devices for large ones.
    fn loot(&self, now: Instant, thief: &Pool<'_>, victim: &Pool<'_>) -> Vec<(JobId, Placement)> {
        let latency_ns = self.steal_latency.ns();
        let joining = self.nodes.get(&thief.node).is_some_and(|node| node.joining);
        let mut free_at_ns = thief.free_at_ns(now);
        // Time that what was taken so far takes off the victim.
        let mut spared_ns = 0.0;
        let mut jobs = Vec::new();
        for (job, place, fetch_ns) in self.stealable(now, thief, victim) {
            let amount = place.load.amount as f64;
            let on_victim = amount / victim.rate(place.load.module);
            let there = victim.remaining_ns - spared_ns + victim.unevenness() * on_victim;
            let finish = |(device, free_at): (usize, &f64)| {
                let job_ns = amount / thief.devices[device].throughput.rate(thief.modules, place.load.module);
                (device, free_at.max(latency_ns).max(fetch_ns) + job_ns)
            };
            let soonest =
                free_at_ns.iter().enumerate().map(finish).min_by(|(_, one), (_, other)| one.total_cmp(other));
            let Some((device, here)) = soonest else { break };
            // Long jobs are taken one for each device: the next steal comes sooner than these end, and knows more. A node that
            // joins has one steal of any application's jobs.
            let rounds = (ROUND_LATENCIES * latency_ns / (here - free_at_ns[device]).max(1.0)).max(1.0);
            if !joining && jobs.len() as f64 >= rounds * thief.devices.len() as f64 {
                break;
            }
            let least = if jobs.is_empty() { (2.0 * latency_ns).max(LEAST_GAIN * there) } else { 0.0 };
            if there - here <= least || jobs.len() == MAX_STOLEN_JOBS {
                break;
            }
            free_at_ns[device] = here;
            spared_ns += on_victim;
            jobs.push((job, place));
        }
        jobs
    }

    /// The jobs of the victim that the thief may have, without those that must be on a device, with the time that bringing
    /// their data takes: those whose data the thief holds first, among them the last planned first.
    fn stealable(&self, now: Instant, thief: &Pool<'_>, victim: &Pool<'_>) -> Vec<(JobId, Placement, f64)> {
        let (Some(from), Some(to)) = (self.nodes.get(&victim.node), self.nodes.get(&thief.node)) else {
            return Vec::new();
        };
        let mut placed: Vec<(Attempt, JobId, Placement)> = Vec::new();
        for &id in &from.jobs {
            let Some(JobState::Placed(place)) = self.job(id).map(|job| job.state) else { continue };
            let kind = from.devices.get(usize::from(place.device.0)).map(|device| device.info.kind);
            if place.node == victim.node && kind == Some(victim.kind) {
                placed.push((place.attempt, id, place));
            }
        }
        placed.sort_unstable_by_key(|(attempt, _, _)| *attempt);
        let mut stealable: Vec<(JobId, Placement, f64)> = placed
            .into_iter()
            .skip(victim.devices.len())
            .rev()
            .filter(|(_, id, place)| self.may_move(now, *id, *place, thief, to))
            .map(|(_, id, place)| (id, place, self.fetch_ns(id, to)))
            .collect();
        stealable.sort_by(|(.., one), (.., other)| one.total_cmp(other));
        stealable
    }

    /// What bringing a job's contents to a node takes.
    fn fetch_ns(&self, id: JobId, to: &Node) -> f64 {
        let batch = self.apps.get(&id.app).and_then(|app| {
            let job = app.jobs.get(&JobKey::of(id))?;
            app.batches.get(&job.batch)
        });
        batch.map_or(0.0, |batch| to.missing_bytes(&batch.contents) as f64 * FETCH_NS_PER_BYTE)
    }

    fn may_move(&self, now: Instant, id: JobId, place: Placement, thief: &Pool<'_>, to: &Node) -> bool {
        let Some(app) = self.apps.get(&id.app) else { return false };
        let Some(job) = app.jobs.get(&JobKey::of(id)) else { return false };
        let rested =
            job.stolen_from.is_empty() || now.since(place.planned_at) >= Duration::from_millis(REST_MS);
        (app.global_stealing || to.joining)
            && reaches(app, now, thief.node)
            && place.retracting.is_none()
            && rested
            && job.stolen_from.len() < MAX_STEALS
            && !job.stolen_from.contains(&thief.node)
            && self.fitting(id.app, (app, job), (thief.node, to), thief.kind).next().is_some()
    }

    /// The devices of a kind that fulfil a job's needs, and that its project may be on.
    fn fitting<'farm>(
        &'farm self,
        id: AppId,
        (app, job): (&App, &Job),
        (node, to): (NodeId, &'farm Node),
        kind: DeviceKind,
    ) -> impl Iterator<Item = (DeviceIndex, &'farm Device)> + use<'farm> {
        let needs = app.batches.get(&job.batch).map(|batch| batch.needs);
        (0_u16..).map(DeviceIndex).zip(&to.devices).filter(move |(index, device)| {
            !device.lost
                && device.info.kind == kind
                && needs.is_some_and(|needs| needs.fulfilled_by(&device.info))
                && self.projects.may_use(id, (node, *index))
        })
    }

    fn order(
        &mut self,
        now: Instant,
        (thief, kind): (NodeId, DeviceKind),
        victim: NodeId,
        jobs: Vec<(JobId, Placement)>,
    ) {
        let id = StealId(self.next_steal);
        self.next_steal += 1;
        let answer_by = now.after(Duration::from_millis(ANSWER_MS));
        let pool = self.nodes.get(&victim).and_then(|node| Pool::of(now, victim, node, kind, &self.modules));
        let time_on = |pool: Pool<'_>| {
            jobs.iter().map(|(_, place)| place.load.amount as f64 / pool.rate(place.load.module)).sum()
        };
        let leaving_ns = pool.map_or(0.0, time_on);
        let attempts: Vec<JobAttempt> =
            jobs.iter().map(|&(job, place)| JobAttempt { job, attempt: place.attempt }).collect();
        for &job in &attempts {
            if let Some(JobState::Placed(place)) = self.job_mut(job.job).map(|job| &mut job.state) {
                place.retracting = Some(id);
            }
        }
        let jobs = attempts.iter().map(|job| (job.job, job.attempt)).collect();
        tracing::debug!(steal = %id, %thief, %victim, jobs = attempts.len(), "stealing");
        self.steals.insert(id, Steal { thief, kind, victim, jobs, leaving_ns, ordered_at: now, answer_by });
        self.arm(answer_by);
        self.tell_node(victim, CoordinatorToNode::Retract { steal: id, jobs: attempts });
    }

    /// Gives a job that its victim gave up to the thief. False if the thief cannot take it (any more).
    fn move_job(&mut self, now: Instant, id: JobId, from: Placement, steal: &Steal) -> bool {
        let Some(app) = self.apps.get(&id.app).filter(|app| reaches(app, now, steal.thief)) else {
            return false;
        };
        let Some(job) = app.jobs.get(&JobKey::of(id)) else { return false };
        let Some(thief) = self.nodes.get(&steal.thief).filter(|node| node.takes_work()) else { return false };
        let free_at = |device: &Device| {
            let job_ns = from.load.amount as f64 / device.throughput.rate(&self.modules, from.load.module);
            device.free_at_ns(now, &self.modules) + job_ns
        };
        let earliest = self
            .fitting(id.app, (app, job), (steal.thief, thief), steal.kind)
            .min_by(|(_, one), (_, other)| free_at(one).total_cmp(&free_at(other)));
        let Some((device, _)) = earliest else { return false };
        self.projects.occupies(id.app, (steal.thief, device));
        self.release(id.app, JobKey::of(id), JobState::Placed(from));
        let attempt = Attempt { epoch: self.config.epoch, sequence: self.next_attempt };
        self.next_attempt += 1;
        let Some(job) = self.job_mut(id) else { return false };
        job.stolen_from.push(from.node);
        let place = Placement {
            node: steal.thief,
            device,
            attempt,
            planned_at: now,
            stolen_from: Some((from.node, from.device)),
            retracting: None,
            ..from
        };
        job.state = JobState::Placed(place);
        let batch = self.apps.get(&id.app).and_then(|app| app.batches.get(&self.job(id)?.batch));
        let contents = batch.map_or_else(Vec::new, |batch| batch.contents.clone());
        let Some(thief) = self.nodes.get_mut(&steal.thief) else { return false };
        thief.will_hold(&contents);
        thief.jobs.insert(id);
        if let Some(device) = thief.device_mut(device) {
            device.add_load(now, from.load);
        }
        true
    }

    /// Forgets an order: its jobs may be stolen again.
    fn end_steal(&mut self, id: StealId) -> Option<Steal> {
        let steal = self.steals.remove(&id)?;
        for &job in steal.jobs.keys() {
            if let Some(JobState::Placed(place)) = self.job_mut(job).map(|job| &mut job.state)
                && place.retracting == Some(id)
            {
                place.retracting = None;
            }
        }
        Some(steal)
    }

    /// Nothing worth stealing was found.
    fn pause_looking(&mut self, now: Instant, id: NodeId) {
        let nodes = self.nodes.len() as u64;
        let pause = LOOKING_PAUSE + Duration::from_micros(nodes.saturating_mul(nodes));
        if let Some(node) = self.nodes.get_mut(&id) {
            node.steal_at = now.after(pause);
        }
    }

    fn stole_in_vain(&mut self, now: Instant, id: NodeId) {
        let Some(node) = self.nodes.get_mut(&id) else { return };
        let pause_ms = PAUSE_MS << node.vain_steals.min(MAX_DOUBLINGS);
        node.vain_steals = node.vain_steals.saturating_add(1);
        node.steal_at = now.after(Duration::from_millis(pause_ms));
    }

    fn steals_from(&self, victim: NodeId) -> Vec<StealId> {
        self.steals.iter().filter(|(_, steal)| steal.victim == victim).map(|(&id, _)| id).collect()
    }

    /// What a node was asked to give up.
    fn leaving_ns(&self, victim: NodeId) -> f64 {
        self.steals.values().filter(|steal| steal.victim == victim).map(|steal| steal.leaving_ns).sum()
    }

    fn is_placed(&self, job: JobId, node: NodeId, attempt: Attempt) -> bool {
        match self.job(job).map(|job| job.state) {
            Some(JobState::Placed(place)) => (place.node, place.attempt) == (node, attempt),
            Some(JobState::Waiting | JobState::Executed { .. }) | None => false,
        }
    }
}

/// Whether a node can be asked to give jobs up now. A draining one gives them back by itself.
fn can_answer(node: &Node) -> bool {
    match node.state {
        NodeState::Alive => node.link.is_some(),
        NodeState::Suspect | NodeState::Draining => false,
    }
}

/// Whether the application can send jobs to a node now.
fn reaches(app: &App, now: Instant, node: NodeId) -> bool {
    app.link.is_some() && app.can_reach(now, node)
}
