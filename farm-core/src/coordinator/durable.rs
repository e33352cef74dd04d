//! What a coordinator keeps over its own death beside its epoch (20-delivery.md, "Durable in the control store"): which
//! applications are stopped, and what devices turned out to be worth.
//!
//! The machine says what is to be kept ([`super::Effect::Keep`]) and is given it back at its start ([`Restored`]). It never reads
//! a disk or a calendar: how much of a stop is left when a coordinator comes back is its driver's to say.

use std::{collections::BTreeMap, time::Duration};

use serde::{Deserialize, Serialize};

use super::{
    CoordinatorMachine, Effect,
    breaker::{Breaker, STOPPED_MS},
    model::Node,
};
use crate::{
    id::{AppId, DeviceIndex, NodeId},
    time::Instant,
};

/// Most applications kept as stopped; beyond it the one whose stop ends first is forgotten.
pub const MAX_STOPPED: usize = 1_024;

/// Most nodes whose devices' speeds are kept; beyond it the one whose were kept longest ago is forgotten.
pub const MAX_KNOWN_NODES: usize = 4_096;

/// A device's speed is kept anew when it is off by this factor from what is kept: a mean that scatters by a few percent writes
/// nothing.
const WORTH_KEEPING: f64 = 1.25;

/// What is kept of a device counts only if its name and, within this factor, its score are what they were: another card in the
/// same slot begins anew.
const SAME_SCORE: f64 = 4.0;

/// What an earlier coordinator kept.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Restored {
    /// Applications that are stopped still; at most [`MAX_STOPPED`] count.
    pub stopped: Vec<Stopped>,
    /// What nodes' devices are worth, those that were kept last at the end; at most [`MAX_KNOWN_NODES`] count.
    pub speeds: Vec<NodeSpeeds>,
}

/// An application that gets no devices for a while.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Stopped {
    /// Which.
    pub app: AppId,
    /// For how long from now, in milliseconds; more than a minute counts as one.
    pub left_ms: u64,
    /// Why, for people.
    pub reason: String,
}

/// What the devices of a node turned out to be worth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NodeSpeeds {
    /// The node's name.
    pub node: String,
    /// Its devices, by index.
    pub devices: Vec<DeviceSpeed>,
}

/// What a device turned out to be worth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DeviceSpeed {
    /// The device's name.
    pub name: String,
    /// What it announced, GFLOP/s.
    pub score: f64,
    /// How much faster than its score says it was, compared with the farm's others, over all modules; `None`: not measured.
    pub speed: Option<f64>,
}

/// Something to be kept over the coordinator's death.
#[derive(Clone, Debug, PartialEq)]
pub enum Keep {
    /// An application was stopped.
    Stopped(Stopped),
    /// The devices of a node changed their speeds; takes the place of what was kept under its name.
    Speeds(NodeSpeeds),
}

/// What is known from an earlier life, or would be in a later one.
#[derive(Debug, Default)]
pub(super) struct Durable {
    stopped: BTreeMap<AppId, (Instant, String)>,
    speeds: BTreeMap<String, Known>,
    /// Counts what was kept.
    kept: u64,
}

#[derive(Debug)]
struct Known {
    devices: Vec<DeviceSpeed>,
    kept: u64,
}

impl Durable {
    fn stop(&mut self, now: Instant, app: AppId, until: Instant, reason: String) {
        self.stopped.retain(|_, (until, _)| *until > now);
        self.stopped.insert(app, (until, reason));
        if self.stopped.len() > MAX_STOPPED
            && let Some((&first, _)) = self.stopped.iter().min_by_key(|(_, (until, _))| *until)
        {
            self.stopped.remove(&first);
        }
    }

    fn know(&mut self, speeds: NodeSpeeds) {
        self.kept += 1;
        self.speeds.insert(speeds.node, Known { devices: speeds.devices, kept: self.kept });
        if self.speeds.len() > MAX_KNOWN_NODES
            && let Some((oldest, _)) = self.speeds.iter().min_by_key(|(_, known)| known.kept)
        {
            let oldest = oldest.clone();
            self.speeds.remove(&oldest);
        }
    }
}

impl CoordinatorMachine {
    /// The first event starts the time that is left of stops.
    pub(super) fn restore(&mut self, now: Instant) {
        let Restored { stopped, speeds } = std::mem::take(&mut self.config.restored);
        for Stopped { app, left_ms, reason } in stopped {
            let until = now.after(Duration::from_millis(left_ms.min(STOPPED_MS)));
            self.durable.stop(now, app, until, reason);
        }
        for speeds in speeds {
            self.durable.know(speeds);
        }
    }

    /// Keeps that an application is stopped, in this life (it may leave and come back) and the next.
    pub(super) fn keep_stopped(&mut self, now: Instant, app: AppId, until: Instant, reason: &str) {
        self.durable.stop(now, app, until, reason.to_owned());
        let left_ms = u64::try_from(until.since(now).as_millis()).unwrap_or(u64::MAX);
        let stopped = Stopped { app, left_ms, reason: reason.to_owned() };
        self.effects.push_back(Effect::Keep(Keep::Stopped(stopped)));
    }

    /// The breaker of an application that registers: open if it is stopped still.
    pub(super) fn breaker_of(&self, now: Instant, app: AppId) -> Breaker {
        match self.durable.stopped.get(&app) {
            Some((until, reason)) if *until > now => Breaker::Open { until: *until, reason: reason.clone() },
            Some(_) | None => Breaker::new(),
        }
    }

    /// A node registered anew: its devices are taken for what they were worth the last time.
    pub(super) fn recall_speeds(&mut self, id: NodeId) {
        let Some(node) = self.nodes.get_mut(&id) else { return };
        let Some(known) = self.durable.speeds.get(&node.name) else { return };
        for (device, known) in node.devices.iter_mut().zip(&known.devices) {
            let ratio = device.info.score / known.score;
            let same = device.info.name == known.name && (1.0 / SAME_SCORE..=SAME_SCORE).contains(&ratio);
            if let Some(speed) = known.speed.filter(|speed| same && speed.is_finite() && *speed > 0.0) {
                // The score is measured anew at each start, the device is the same.
                device.throughput.presume(speed / ratio);
            }
        }
    }

    /// Keeps what the devices of a node are worth, if this one's speed is worth it.
    pub(super) fn keep_speeds(&mut self, id: NodeId, index: DeviceIndex) {
        let Some(node) = self.nodes.get(&id) else { return };
        let at = usize::from(index.0);
        let Some(speed) = node.devices.get(at).and_then(|device| device.throughput.settled_speed()) else {
            return;
        };
        let known = self.durable.speeds.get(&node.name).and_then(|known| known.devices.get(at)?.speed);
        let as_known =
            known.is_some_and(|known| (1.0 / WORTH_KEEPING..=WORTH_KEEPING).contains(&(speed / known)));
        if as_known {
            return;
        }
        let speeds = speeds_of(node);
        self.durable.know(speeds.clone());
        self.effects.push_back(Effect::Keep(Keep::Speeds(speeds)));
    }
}

fn speeds_of(node: &Node) -> NodeSpeeds {
    let devices = node.devices.iter().map(|device| DeviceSpeed {
        name: device.info.name.clone(),
        score: device.info.score,
        speed: device.throughput.speed(),
    });
    NodeSpeeds { node: node.name.clone(), devices: devices.collect() }
}
