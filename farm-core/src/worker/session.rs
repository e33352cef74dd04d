//! The worker's talk with the coordinator: registration, heartbeats, orders. Losing it stops nothing: running, queueing
//! and delivering go on.

use super::{Effect, WorkerMachine, drain::Drain};
use crate::{
    message::{CoordinatorToNode, NodeHello, NodeToCoordinator, PROTOCOL_VERSION},
    pulse::{Answers, Pulse},
    time::Instant,
};

/// How the worker stands with the coordinator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Session {
    /// No connection.
    Offline,
    /// Hello said, no welcome yet.
    Greeting,
    /// Welcome.
    Registered(Pulse),
}

impl Session {
    /// The timer of this state.
    pub(super) fn next_heartbeat(self) -> Option<Instant> {
        match self {
            Self::Registered(pulse) => Some(pulse.due()),
            Self::Offline | Self::Greeting => None,
        }
    }

    pub(super) const fn is_registered(self) -> bool {
        matches!(self, Self::Registered(_))
    }
}

impl WorkerMachine {
    pub(super) fn coordinator_connected(&mut self) {
        self.session = Session::Greeting;
        let inventory = self.inventory();
        self.tell_coordinator(NodeToCoordinator::Hello(NodeHello {
            protocol: PROTOCOL_VERSION,
            name: self.config.name.clone(),
            node: self.node,
            session: self.config.session,
            devices: self.config.devices.clone(),
            contact: self.config.contact.clone(),
            inventory,
        }));
    }

    pub(super) fn coordinator_lost(&mut self) {
        self.session = Session::Offline;
        self.reports.unsend();
        // Only a registered worker can be told of applications.
        for app in self.apps.values_mut() {
            app.drop_at = None;
        }
        self.locate_nothing();
    }

    pub(super) fn coordinator_said(&mut self, now: Instant, message: CoordinatorToNode) {
        match message {
            CoordinatorToNode::Welcome { node, epoch: _, liveness } => {
                if self.session != Session::Greeting {
                    return;
                }
                self.node = Some(node);
                self.session = Session::Registered(Pulse::new(now, liveness));
                self.compare_at = now.after(liveness.compare_every());
                self.reports.unsend();
                self.await_announcements(now);
                self.tell_lost_devices();
                self.tell_cache();
            }
            CoordinatorToNode::Refused { reason } => self.refused(&reason),
            CoordinatorToNode::AppsJoined(apps) => {
                apps.into_iter().for_each(|(app, terms)| self.app_joined(app, terms));
            }
            CoordinatorToNode::AppLeft { app } => self.app_left(app),
            CoordinatorToNode::Cancel { jobs } => jobs.into_iter().for_each(|job| self.cancel(job)),
            CoordinatorToNode::Retract { steal, jobs } => self.retract(steal, &jobs),
            CoordinatorToNode::Located { content, peer } => self.located(content, peer),
            CoordinatorToNode::Evict { contents } => self.push(Effect::Evict(contents)),
            CoordinatorToNode::SayInventory => {
                let held = self.inventory();
                self.tell_coordinator(NodeToCoordinator::Inventory(held));
            }
            CoordinatorToNode::Drain => self.start_drain(now),
            CoordinatorToNode::HeartbeatAck { sequence } => {
                self.reports.confirm(sequence);
                if let Session::Registered(pulse) = &mut self.session {
                    pulse.answered(now);
                }
            }
        }
    }

    pub(super) fn session_timeout(&mut self, now: Instant) {
        let Session::Registered(pulse) = &mut self.session else { return };
        let Some(answers) = pulse.beat(now) else { return };
        self.heartbeat_sequence += 1;
        let devices = self.loads(now);
        self.tell_coordinator(NodeToCoordinator::Heartbeat {
            sequence: self.heartbeat_sequence,
            unanswered: answers == Answers::Missing,
            devices,
            spool_bytes: self.spool_bytes,
            cache: Some(self.cache),
        });
        self.reports.heartbeat_said(self.heartbeat_sequence);
        self.tell_holding(now);
    }

    /// The coordinator may have missed it, or be another one.
    fn tell_lost_devices(&mut self) {
        let lost: Vec<_> = self.lost_devices().collect();
        for device in lost {
            let reason = "lost earlier in this session".to_owned();
            self.tell_coordinator(NodeToCoordinator::DeviceLost { device, reason });
        }
    }

    /// A newer process of the same name, or another protocol: nothing that this process does counts any more.
    fn refused(&mut self, reason: &str) {
        tracing::error!(reason, "coordinator refused this node");
        self.drop_everything();
        self.drain = Drain::Gone;
        self.push(Effect::Exit);
    }
}
