//! Who is silent, since when, and what follows: suspect, dead, lease over.

use std::time::Duration;

use super::{CoordinatorMachine, NodeState, model::Node, replan::Blame};
use crate::{
    id::{AppId, NodeId},
    message::Liveness,
    time::Instant,
};

/// When more than this part of all nodes is silent at once, the fault is rather on this side.
const GUARDED_PART: f64 = 0.55;

/// Fewer nodes than this are given up without ado: two of three may well have died.
const LEAST_GUARDED_NODES: usize = 4;

impl CoordinatorMachine {
    pub(super) fn app_heard(&mut self, now: Instant, id: AppId) {
        let Some(app) = self.apps.get_mut(&id) else { return };
        app.heard = true;
        if !app.deaf {
            app.last_heard = now;
        }
    }

    /// An application says whether it is answered. While it is not, it gets no plans that it would not hear of.
    pub(super) fn app_hears(&mut self, id: AppId, hears: bool) {
        let Some(app) = self.apps.get_mut(&id) else { return };
        let was_deaf = std::mem::replace(&mut app.deaf, !hears);
        if was_deaf && hears {
            self.retry_stuck();
        }
    }

    /// A node says whether it is answered.
    pub(super) fn node_hears(&mut self, id: NodeId, hears: bool) {
        let Some(node) = self.nodes.get_mut(&id) else { return };
        node.deaf = !hears;
        if node.deaf {
            suspect(node);
        }
    }

    pub(super) fn node_heard(&mut self, now: Instant, id: NodeId) {
        let Some(node) = self.nodes.get_mut(&id) else { return };
        if node.deaf {
            return;
        }
        node.last_heard = now;
        if node.state == NodeState::Suspect {
            node.state = NodeState::Alive;
            self.retry_stuck();
        }
    }

    /// An application's connection is gone: its jobs go on for the time of its lease, unless another one goes on for it.
    pub(super) fn app_away(&mut self, now: Instant, id: AppId) {
        let lease_until = now.after(Duration::from_millis(self.config.app_lease_ms));
        let Some(app) = self.apps.get_mut(&id) else { return };
        app.link = None;
        if app.superseded_until.is_some_and(|until| now <= until) {
            return self.app_leaves(id);
        }
        app.lease_until = lease_until;
        self.arm(lease_until);
    }

    /// An application says that it goes on for another one of its project, whose process is dead: nobody waits for that one's
    /// results. One whose connection stands keeps all it has, whatever is said of it; if its process is dead indeed the end of
    /// its connection is on its way, or its silence will be noticed.
    pub(super) fn supersede(&mut self, now: Instant, successor: AppId, id: AppId) {
        if successor == id || self.projects.name_of(successor) != self.projects.name_of(id) {
            return;
        }
        // Its last words may be on their way still, and its silence counts from them.
        let noticed_by = now.after(Duration::from_millis(self.config.liveness.dead_ms).saturating_mul(2));
        let Some(app) = self.apps.get_mut(&id) else { return };
        match app.link {
            Some(_) => app.superseded_until = Some(noticed_by),
            None => {
                tracing::info!(app = %id, %successor, "another application goes on for it");
                self.app_leaves(id);
            }
        }
    }

    /// A node's connection is gone: suspect at once, dead if it does not come back soon.
    pub(super) fn node_away(&mut self, now: Instant, id: NodeId) {
        let Some(node) = self.nodes.get_mut(&id) else { return };
        node.link = None;
        node.last_heard = now;
        suspect(node);
        self.arm(now.after(Duration::from_millis(self.config.liveness.reconnect_ms)));
    }

    /// Acts on every deadline that is due.
    pub(super) fn expire(&mut self, now: Instant) {
        self.expire_nodes(now);
        self.ask_for_missing(now);
        self.expire_apps(now);
        self.expire_steals(now);
        self.expire_questions(now);
        self.open_lanes(now);
        self.end_recovery(now);
    }

    /// Finds the next deadline.
    pub(super) fn rearm(&mut self) {
        let liveness = self.config.liveness;
        let nodes = self.nodes.values().flat_map(|node| {
            let silence = silence_deadline(&liveness, node);
            [
                Some(self.guarded_until.map_or(silence, |until| silence.max(until))),
                node.full_until,
                node.ask_at,
            ]
        });
        let apps = self.apps.values().flat_map(|app| {
            let lease = match app.link {
                Some(_) => app.last_heard.after(Duration::from_millis(liveness.dead_ms)),
                None => app.lease_until,
            };
            [Some(lease), app.unreachable.values().min().copied()]
        });
        let steals = self.steals.values().map(|steal| Some(steal.answer_by));
        let questions = self.questions.values().map(|asked| Some(asked.answer_by));
        let others = [self.lanes_due(), self.recovery.deadline()];
        self.wake = nodes.chain(apps).chain(steals).chain(questions).chain(others).flatten().min();
    }

    fn expire_nodes(&mut self, now: Instant) {
        let liveness = self.config.liveness;
        let mut dead = Vec::new();
        let mut relieved = false;
        let mut silent = 0;
        for (&id, node) in &mut self.nodes {
            if node.full_until.is_some_and(|until| until <= now) {
                node.full_until = None;
                relieved = true;
            }
            let silence = now.since(node.last_heard);
            let at_least = |bound_ms| silence >= Duration::from_millis(bound_ms);
            silent += usize::from(node.link.is_none() || at_least(liveness.suspect_ms));
            match node.link {
                // Silent on a standing connection: a partition, as far as one can tell from here.
                Some(_) if at_least(liveness.dead_ms) => dead.push((id, Blame::Nobody)),
                Some(_) if at_least(liveness.suspect_ms) => suspect(node),
                None if at_least(liveness.reconnect_ms) => dead.push((id, Blame::OldestOnEachDevice)),
                Some(_) | None => {}
            }
        }
        self.declare_dead(now, silent, dead);
        if relieved {
            self.retry_stuck();
        }
    }

    /// The one place where nodes are given up for their silence. If most of the farm is silent when the first of them is due
    /// nothing is planned anew for as long as a node may be silent: then they are back, or gone indeed (20-delivery.md, "most
    /// nodes vanish at once"). What counts is who is silent, not who is due: nodes that were cut off at one instant are due one
    /// after the other, each by its own last heartbeat.
    fn declare_dead(&mut self, now: Instant, silent: usize, dead: Vec<(NodeId, Blame)>) {
        let most = silent >= LEAST_GUARDED_NODES && silent as f64 > GUARDED_PART * self.nodes.len() as f64;
        match self.guarded_until {
            Some(until) if now < until => return,
            None if most && !dead.is_empty() => {
                let guard = Duration::from_millis(self.config.liveness.dead_ms);
                tracing::error!(silent, of = self.nodes.len(), ?guard, "most nodes vanished at once");
                self.guarded_until = Some(now.after(guard));
                return;
            }
            Some(_) | None => self.guarded_until = None,
        }
        for (id, blame) in dead {
            self.remove_node(now, id, blame);
        }
    }

    fn expire_apps(&mut self, now: Instant) {
        let dead = Duration::from_millis(self.config.liveness.dead_ms);
        let mut silent = Vec::new();
        let mut left = Vec::new();
        let mut reachable = false;
        for (&id, app) in &mut self.apps {
            let before = app.unreachable.len();
            app.unreachable.retain(|_, until| *until > now);
            reachable |= app.unreachable.len() < before;
            match app.link {
                Some(link) if now.since(app.last_heard) >= dead => silent.push((id, link)),
                None if app.lease_until <= now => left.push(id),
                Some(_) | None => {}
            }
        }
        for (id, link) in silent {
            self.close(link);
            self.app_away(now, id);
        }
        for id in left {
            self.app_leaves(id);
        }
        if reachable {
            self.retry_stuck();
        }
    }
}

fn suspect(node: &mut Node) {
    match node.state {
        NodeState::Alive => node.state = NodeState::Suspect,
        NodeState::Suspect | NodeState::Draining => {}
    }
}

/// When a node's silence will next mean something.
fn silence_deadline(liveness: &Liveness, node: &Node) -> Instant {
    let bound_ms = match (node.link, node.state) {
        (None, _) => liveness.reconnect_ms,
        (Some(_), NodeState::Alive) => liveness.suspect_ms.min(liveness.dead_ms),
        (Some(_), NodeState::Suspect | NodeState::Draining) => liveness.dead_ms,
    };
    node.last_heard.after(Duration::from_millis(bound_ms))
}
