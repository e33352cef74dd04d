//! Looks over the whole farm from time to time, into every machine at once: is every job somewhere (I1), does every
//! device work that could (I6)?

use std::time::Duration;

use farm_core::{
    coordinator::Whereabouts,
    id::{AppId, JobAttempt, JobId, NodeId},
    message::{AppToCoordinator, NodeToCoordinator},
    time::Instant,
};

use super::{
    network::Message,
    work::{MAX_COST_NS, cost_ns},
    world::World,
};

/// Virtual time between two looks.
const PERIOD: Duration = Duration::from_millis(50);

/// Four messages of at most 5 ms each, 5 ms that a report waits.
const STEAL_LATENCY: Duration = Duration::from_millis(25);

/// Longest pause of a thief that tried in vain (`coordinator/steal.rs`).
const MAX_STEAL_PAUSE: Duration = Duration::from_millis(640);

/// How long an application's word that it cannot reach a node keeps jobs away from the node.
const UNREACHABLE: Duration = Duration::from_secs(60);

/// How long a full node gets nothing new.
const FULL: Duration = Duration::from_secs(1);

/// What the fastest clock makes of a second of the slowest: 1.1 / 0.9.
const SKEW: f64 = 1.25;

/// What the lookout remembers.
#[derive(Debug, Default)]
pub(super) struct Lookout {
    next: Instant,
    /// Until when stealing and placement have a reason to leave somebody out.
    excused_until: Instant,
    /// Since when each worker has had work for others.
    rich_since: Vec<Option<Instant>>,
    /// Since when some application has waited for a place.
    waiting_since: Option<Instant>,
}

impl Lookout {
    fn excuse(&mut self, now: Instant, duration: Duration) {
        self.excused_until = self.excused_until.max(now.after(duration.mul_f64(SKEW)));
    }
}

impl World {
    /// Time goes on to `to`: looks, if it is time.
    pub(super) fn look_around(&mut self, to: Instant) {
        if to < self.lookout.next {
            return;
        }
        self.lookout.next = to.after(PERIOD);
        if !self.setup.projects {
            self.look_for_idleness();
        }
        self.look_for_jobs();
    }

    /// A message tells of something that keeps jobs away from a node for a while.
    pub(super) fn excuse(&mut self, message: &Message) {
        match message {
            Message::AppToCoordinator(AppToCoordinator::Unreachable { .. }) => {
                self.lookout.excuse(self.now, UNREACHABLE);
            }
            Message::NodeToCoordinator(NodeToCoordinator::Report { executed, .. })
                if executed.iter().any(|ended| ended.failure.is_some()) =>
            {
                self.lookout.excuse(self.now, FULL);
            }
            // It was away until now: what waited for it is not planned yet.
            Message::AppToCoordinator(AppToCoordinator::Hello(_))
            | Message::NodeToCoordinator(NodeToCoordinator::Hello(_)) => self.lookout.excuse(self.now, FULL),
            _ => {}
        }
    }

    /// Nothing went wrong for long enough that every silence was noticed and every doubt settled.
    fn is_undisturbed(&self) -> bool {
        let timings = self.setup.liveness;
        let settled = Duration::from_millis(timings.dead_ms + timings.reconnect_ms).mul_f64(SKEW);
        let last = self.audit.last_disturbance();
        last.is_none_or(|last| self.now.since(last) > settled)
            && self.coordinator_up
            && self.blocked.is_empty()
            && self.cuts.is_empty()
            && self.all_connected()
    }

    fn all_connected(&self) -> bool {
        let open = |link| matches!(link, Some(link) if self.is_open(link));
        self.apps.iter().filter(|host| host.is_active()).all(|host| open(host.control))
            && self.workers.iter().filter(|host| host.is_up()).all(|host| open(host.control))
            && self.links.values().all(|link| !link.is_silent())
    }

    // ------------------------------------------------------------------ I1

    /// I1: while nothing is on its way, all three tiers agree on where each open job is.
    fn look_for_jobs(&mut self) {
        if !self.is_quiet() || !self.is_undisturbed() {
            return;
        }
        let mut looked_for = 0;
        for host in self.apps.iter().filter(|host| host.is_active()) {
            let Some(app) = host.ledger.app() else { continue };
            for (task, index, planned) in host.ledger.open_jobs() {
                let job = JobId { app, task, index };
                looked_for += 1;
                match self.coordinator.whereabouts(job) {
                    Whereabouts::Unknown => panic!("I1: nobody knows {job} any more: {}", self.describe()),
                    Whereabouts::Waiting => {}
                    Whereabouts::At { node, attempt } => {
                        assert_eq!(
                            planned,
                            Some((node, attempt)),
                            "I1: its application seeks {job} elsewhere"
                        );
                        let job = JobAttempt { job, attempt };
                        // Without a link the ledger's own timer gets it one, or gives the node up.
                        let linked = host.nodes.keys().any(|(linked, _)| *linked == node);
                        assert!(!linked || self.is_held(node, job), "I1: {node} has lost {job}");
                    }
                }
            }
        }
        self.audit.checks.whereabouts += looked_for;
    }

    fn is_held(&self, node: NodeId, job: JobAttempt) -> bool {
        self.workers
            .iter()
            .filter_map(|host| host.machine())
            .any(|machine| machine.node() == Some(node) && machine.holds(job))
    }

    // ------------------------------------------------------------------ I6

    /// I6: no healthy device has nothing to do for long while a compatible job is queued within reach.
    fn look_for_idleness(&mut self) {
        let now = self.now;
        let bound =
            2 * (Duration::from_millis(self.setup.liveness.heartbeat_ms) + STEAL_LATENCY) + MAX_STEAL_PAUSE;
        let bound = bound.mul_f64(SKEW);
        let long_ago = |since: Option<Instant>| since.is_some_and(|since| now.since(since) > bound);
        self.note_riches();
        let excused = now < self.lookout.excused_until;
        let waits = long_ago(self.lookout.waiting_since);
        let rich = (0..).zip(&self.lookout.rich_since).find(|(_, since)| long_ago(**since));
        let rich: Option<usize> = rich.map(|(worker, _)| worker);
        if excused || !(waits || rich.is_some()) || !self.is_undisturbed() {
            return;
        }
        let mut idle = 0;
        for (worker, host) in self.workers.iter().enumerate() {
            if host.machine().is_none_or(|machine| machine.node().is_none()) || host.leaves() {
                continue;
            }
            for (device, _, idle_since) in host.well_devices() {
                idle += 1;
                assert!(
                    !long_ago(idle_since),
                    "I6: device {device} of worker {worker} is idle since {idle_since:?}, {} : {}",
                    rich.map_or_else(
                        || "and jobs wait for a place".to_owned(),
                        |victim| format!("and worker {victim} has more than it can do")
                    ),
                    self.describe()
                );
            }
        }
        self.audit.checks.idle_devices += idle;
    }

    /// Whether an application can be told where its jobs go.
    fn is_present(&self, app: AppId) -> bool {
        self.apps.iter().any(|host| host.is_active() && host.ledger.app() == Some(app))
    }

    /// Notes who has more queued work than a steal from it by the slowest device could need, whatever the estimates.
    fn note_riches(&mut self) {
        let now = self.now;
        let speeds = || self.workers.iter().flat_map(|host| host.well_devices()).map(|(_, speed, _)| speed);
        let slowest = speeds().fold(f64::INFINITY, f64::min);
        // A job is stolen if it ends a fifth earlier by it; estimates may be wrong by half.
        let least_s = 4.0 * (MAX_COST_NS as f64 / 1e9 / slowest + 2.0 * STEAL_LATENCY.as_secs_f64());
        let stealing = self.apps.iter().all(|host| host.allows_stealing());
        let rich: Vec<bool> = self
            .workers
            .iter()
            .map(|host| {
                let speed: f64 = host.well_devices().map(|(_, speed, _)| speed).sum();
                let movable =
                    host.queued().filter(|job| self.audit.may_move(*job) && self.is_present(job.job.app));
                let work_ns: u64 = movable.map(|job| cost_ns(job.job.index)).sum();
                stealing && !host.leaves() && host.is_well() && work_ns as f64 / 1e9 > least_s * speed
            })
            .collect();
        let waits = self.apps.iter().any(|host| host.is_active() && host.ledger.counts().waiting_jobs > 0);
        let since = &mut self.lookout.rich_since;
        since.resize(rich.len(), None);
        for (since, rich) in since.iter_mut().zip(rich) {
            *since = if rich { since.or(Some(now)) } else { None };
        }
        let waiting = &mut self.lookout.waiting_since;
        *waiting = if waits { waiting.or(Some(now)) } else { None };
    }
}
