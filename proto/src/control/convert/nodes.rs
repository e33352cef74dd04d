//! Worker nodes and the coordinator.

use farm_core::{
    holding::Holding,
    id::{AppId, ContentHash, Epoch, JobAttempt, NodeId, NodeSession, StealId},
    message::{
        CoordinatorToNode, DeviceLoad, Executed, JobFailure, JobTrace, NodeHello, NodeToCoordinator,
        RunningJob,
    },
    program::Content,
    project::AppTerms,
    time::Instant,
};

use super::{
    MAX_CONTENTS, MAX_ENTRIES, WireError, cut, device, invalid, list, model::content_hash, name, required,
    text, weight, within,
};
use crate::control::v1;

impl From<NodeToCoordinator> for v1::NodeToCoordinator {
    fn from(message: NodeToCoordinator) -> Self {
        use v1::node_to_coordinator::Message;
        let message = match message {
            NodeToCoordinator::Hello(hello) => Message::Hello(hello.into()),
            NodeToCoordinator::Heartbeat { sequence, unanswered, devices, spool_bytes, cache } => {
                let devices = devices.into_iter().map(Into::into).collect();
                let cache = cache.map(Into::into);
                Message::Heartbeat(v1::NodeHeartbeat { sequence, unanswered, devices, spool_bytes, cache })
            }
            NodeToCoordinator::Report { sent_at, executed, delivered } => {
                Message::Report(report(sent_at, executed, &delivered))
            }
            NodeToCoordinator::DeviceLost { device, reason } => {
                Message::DeviceLost(v1::DeviceLost { device: device.0.into(), reason: cut(reason) })
            }
            NodeToCoordinator::Retracted { steal, retracted, running, unknown } => {
                Message::Retracted(v1::Retracted {
                    steal: steal.0,
                    retracted: Some(retracted.as_slice().into()),
                    running: Some(running.as_slice().into()),
                    unknown: Some(unknown.as_slice().into()),
                })
            }
            NodeToCoordinator::Locate(content) => Message::Locate(content.into()),
            NodeToCoordinator::CacheChanged { held, gone } => Message::CacheChanged(v1::CacheChanged {
                held_size_bytes: held.iter().map(|content| content.size_bytes).collect(),
                held: held.into_iter().map(|content| content.hash.0.into()).collect(),
                gone: gone.into_iter().map(|hash| hash.0.into()).collect(),
            }),
            NodeToCoordinator::Goodbye => Message::Goodbye(v1::Nothing {}),
            NodeToCoordinator::Holding(Holding { attempts, sum }) => {
                Message::Holding(v1::Holding { attempts, sum })
            }
            NodeToCoordinator::Inventory(held) => Message::Inventory(held.as_slice().into()),
        };
        Self { message: Some(message) }
    }
}

impl TryFrom<v1::NodeToCoordinator> for NodeToCoordinator {
    type Error = WireError;

    fn try_from(wire: v1::NodeToCoordinator) -> Result<Self, WireError> {
        use v1::node_to_coordinator::Message;
        Ok(match required("NodeToCoordinator.message", wire.message)? {
            Message::Hello(hello) => Self::Hello(hello.try_into()?),
            Message::Heartbeat(heartbeat) => {
                within("NodeHeartbeat.devices", heartbeat.devices.len(), MAX_ENTRIES)?;
                Self::Heartbeat {
                    sequence: heartbeat.sequence,
                    unanswered: heartbeat.unanswered,
                    devices: heartbeat
                        .devices
                        .into_iter()
                        .map(TryInto::try_into)
                        .collect::<Result<_, WireError>>()?,
                    spool_bytes: heartbeat.spool_bytes,
                    cache: heartbeat.cache.map(Into::into),
                }
            }
            Message::Report(report) => {
                let delivered = required("Report.delivered", report.delivered.clone())?.try_into()?;
                let sent_at = Instant(report.sent_at_ns);
                Self::Report { sent_at, executed: executed(report)?, delivered }
            }
            Message::DeviceLost(lost) => Self::DeviceLost {
                device: device("DeviceLost.device", lost.device)?,
                reason: text("DeviceLost.reason", lost.reason)?,
            },
            Message::Retracted(answer) => Self::Retracted {
                steal: StealId(answer.steal),
                retracted: required("Retracted.retracted", answer.retracted)?.try_into()?,
                running: required("Retracted.running", answer.running)?.try_into()?,
                unknown: required("Retracted.unknown", answer.unknown)?.try_into()?,
            },
            Message::Locate(content) => Self::Locate(content.try_into()?),
            Message::CacheChanged(change) => {
                Self::CacheChanged { held: held(&change)?, gone: hashes("CacheChanged.gone", &change.gone)? }
            }
            Message::Goodbye(v1::Nothing {}) => Self::Goodbye,
            Message::Holding(v1::Holding { attempts, sum }) => Self::Holding(Holding { attempts, sum }),
            Message::Inventory(held) => Self::Inventory(held.try_into()?),
        })
    }
}

impl From<NodeHello> for v1::NodeHello {
    fn from(hello: NodeHello) -> Self {
        Self {
            protocol: hello.protocol,
            name: hello.name,
            session: hello.session.0,
            devices: hello.devices.into_iter().map(Into::into).collect(),
            contact: Some(hello.contact.into()),
            inventory: Some(hello.inventory.as_slice().into()),
            node: hello.node.map(|node| node.0),
        }
    }
}

impl TryFrom<v1::NodeHello> for NodeHello {
    type Error = WireError;

    fn try_from(wire: v1::NodeHello) -> Result<Self, WireError> {
        Ok(Self {
            protocol: wire.protocol,
            name: name("NodeHello.name", wire.name)?,
            node: wire.node.map(NodeId),
            session: NodeSession(wire.session),
            devices: list("NodeHello.devices", MAX_ENTRIES, wire.devices)?,
            contact: required("NodeHello.contact", wire.contact)?.try_into()?,
            inventory: required("NodeHello.inventory", wire.inventory)?.try_into()?,
        })
    }
}

impl From<DeviceLoad> for v1::DeviceLoad {
    fn from(load: DeviceLoad) -> Self {
        let running = load.running.map(|running| v1::RunningJob {
            job: Some([running.job].as_slice().into()),
            for_ns: running.for_ns,
        });
        Self { queued_jobs: load.queued_jobs, running }
    }
}

impl TryFrom<v1::DeviceLoad> for DeviceLoad {
    type Error = WireError;

    fn try_from(wire: v1::DeviceLoad) -> Result<Self, WireError> {
        let running = wire.running.map(|running| {
            let jobs: Vec<JobAttempt> = required("RunningJob.job", running.job)?.try_into()?;
            match jobs[..] {
                [job] => Ok(RunningJob { job, for_ns: running.for_ns }),
                _ => Err(invalid("RunningJob.job", format!("{} attempts", jobs.len()))),
            }
        });
        Ok(Self { queued_jobs: wire.queued_jobs, running: running.transpose()? })
    }
}

fn report(sent_at: Instant, executed: Vec<Executed>, delivered: &[JobAttempt]) -> v1::Report {
    let jobs: Vec<JobAttempt> = executed.iter().map(|done| done.job).collect();
    let ago = |at: fn(&JobTrace) -> Instant| {
        executed.iter().map(|done| sent_at.0.saturating_sub(at(&done.trace).0)).collect()
    };
    let stolen_from = |done: &Executed| done.trace.stolen_from.map_or(0, |device| u32::from(device.0) + 1);
    let executed_stolen_from = match executed.iter().any(|done| done.trace.stolen_from.is_some()) {
        true => executed.iter().map(stolen_from).collect(),
        false => Vec::new(),
    };
    v1::Report {
        executed: Some(jobs.as_slice().into()),
        executed_devices: executed.iter().map(|done| done.device.0.into()).collect(),
        executed_device_time_ns: executed.iter().map(|done| done.device_time_ns).collect(),
        sent_at_ns: sent_at.0,
        executed_staged_ago_ns: ago(|trace| trace.staged_at),
        executed_started_ago_ns: ago(|trace| trace.started_at),
        executed_ended_ago_ns: ago(|trace| trace.ended_at),
        executed_stolen_from,
        // A report of 2^32 executions would be over the message cap long before.
        failures: (0_u32..)
            .zip(executed)
            .filter_map(|(position, done)| {
                Some(v1::ExecutedFailure { position, failure: Some(done.failure?.into()) })
            })
            .collect(),
        delivered: Some(delivered.into()),
    }
}

/// The executions of a report. The columns are of one length; each failure names a position, increasing.
fn executed(wire: v1::Report) -> Result<Vec<Executed>, WireError> {
    let jobs: Vec<JobAttempt> = required("Report.executed", wire.executed)?.try_into()?;
    for (field, length) in [
        ("Report.executed_devices", wire.executed_devices.len()),
        ("Report.executed_device_time_ns", wire.executed_device_time_ns.len()),
        ("Report.executed_staged_ago_ns", wire.executed_staged_ago_ns.len()),
        ("Report.executed_started_ago_ns", wire.executed_started_ago_ns.len()),
        ("Report.executed_ended_ago_ns", wire.executed_ended_ago_ns.len()),
    ] {
        if length != jobs.len() {
            return Err(invalid(field, format!("{length} entries for {} executions", jobs.len())));
        }
    }
    if !(wire.executed_stolen_from.is_empty() || wire.executed_stolen_from.len() == jobs.len()) {
        let found = format!("{} entries for {} executions", wire.executed_stolen_from.len(), jobs.len());
        return Err(invalid("Report.executed_stolen_from", found));
    }
    let at = |ago: &[u64], position: usize| Instant(wire.sent_at_ns.saturating_sub(ago[position]));
    let mut failures = wire.failures.into_iter().peekable();
    let mut executed = Vec::with_capacity(jobs.len());
    for (position, job) in jobs.into_iter().enumerate() {
        let stolen_from = match wire.executed_stolen_from.get(position) {
            None | Some(0) => None,
            Some(beyond) => Some(device("Report.executed_stolen_from", beyond - 1)?),
        };
        let failed_here =
            |failure: &v1::ExecutedFailure| usize::try_from(failure.position).is_ok_and(|at| at == position);
        executed.push(Executed {
            job,
            device: device("Report.executed_devices", wire.executed_devices[position])?,
            device_time_ns: wire.executed_device_time_ns[position],
            trace: JobTrace {
                staged_at: at(&wire.executed_staged_ago_ns, position),
                started_at: at(&wire.executed_started_ago_ns, position),
                ended_at: at(&wire.executed_ended_ago_ns, position),
                stolen_from,
            },
            failure: failures.next_if(failed_here).map(failure_of).transpose()?,
        });
    }
    match failures.next() {
        None => Ok(executed),
        Some(stray) => Err(invalid("ExecutedFailure.position", stray.position)),
    }
}

/// What a cache holds now. A node of before the sizes does not say them.
fn held(change: &v1::CacheChanged) -> Result<Vec<Content>, WireError> {
    let hashes = hashes("CacheChanged.held", &change.held)?;
    let sizes = &change.held_size_bytes;
    if !(sizes.is_empty() || sizes.len() == hashes.len()) {
        let found = format!("{} entries for {} contents", sizes.len(), hashes.len());
        return Err(invalid("CacheChanged.held_size_bytes", found));
    }
    let sizes = sizes.iter().copied().chain(std::iter::repeat(0));
    Ok(hashes.into_iter().zip(sizes).map(|(hash, size_bytes)| Content { hash, size_bytes }).collect())
}

pub(super) fn hashes(field: &'static str, wire: &[Vec<u8>]) -> Result<Vec<ContentHash>, WireError> {
    within(field, wire.len(), MAX_CONTENTS)?;
    wire.iter().map(|bytes| content_hash(field, bytes)).collect()
}

fn failure_of(wire: v1::ExecutedFailure) -> Result<JobFailure, WireError> {
    required("ExecutedFailure.failure", wire.failure)?.try_into()
}

impl From<(AppId, AppTerms)> for v1::AppJoined {
    fn from((app, terms): (AppId, AppTerms)) -> Self {
        let AppTerms { weight, project, result_bytes, stays } = terms;
        Self { app: app.0, weight, project, result_bytes, stays }
    }
}

impl TryFrom<v1::AppJoined> for (AppId, AppTerms) {
    type Error = WireError;

    fn try_from(wire: v1::AppJoined) -> Result<Self, WireError> {
        let terms = AppTerms {
            weight: weight("AppJoined.weight", wire.weight)?,
            project: name("AppJoined.project", wire.project)?,
            result_bytes: wire.result_bytes,
            stays: wire.stays,
        };
        Ok((AppId(wire.app), terms))
    }
}

impl From<CoordinatorToNode> for v1::CoordinatorToNode {
    fn from(message: CoordinatorToNode) -> Self {
        use v1::coordinator_to_node::Message;
        let message = match message {
            CoordinatorToNode::Welcome { node, epoch, liveness } => Message::Welcome(v1::NodeWelcome {
                node: node.0,
                epoch: epoch.0,
                liveness: Some(liveness.into()),
            }),
            CoordinatorToNode::Refused { reason } => Message::Refused(v1::Refused { reason: cut(reason) }),
            CoordinatorToNode::AppsJoined(apps) => {
                Message::AppsJoined(v1::AppsJoined { apps: apps.into_iter().map(Into::into).collect() })
            }
            CoordinatorToNode::AppLeft { app } => Message::AppLeft(v1::AppLeft { app: app.0 }),
            CoordinatorToNode::Cancel { jobs } => Message::Cancel(jobs.as_slice().into()),
            CoordinatorToNode::Retract { steal, jobs } => {
                Message::Retract(v1::Retract { steal: steal.0, jobs: Some(jobs.as_slice().into()) })
            }
            CoordinatorToNode::Located { content, peer } => {
                Message::Located(v1::Located { content: content.0.into(), peer: peer.map(Into::into) })
            }
            CoordinatorToNode::Evict { contents } => Message::Evict(v1::Evict {
                contents: contents.into_iter().map(|hash| hash.0.into()).collect(),
            }),
            CoordinatorToNode::Drain => Message::Drain(v1::Nothing {}),
            CoordinatorToNode::SayInventory => Message::SayInventory(v1::Nothing {}),
            CoordinatorToNode::HeartbeatAck { sequence } => {
                Message::HeartbeatAck(v1::HeartbeatAck { sequence })
            }
        };
        Self { message: Some(message) }
    }
}

impl TryFrom<v1::CoordinatorToNode> for CoordinatorToNode {
    type Error = WireError;

    fn try_from(wire: v1::CoordinatorToNode) -> Result<Self, WireError> {
        use v1::coordinator_to_node::Message;
        Ok(match required("CoordinatorToNode.message", wire.message)? {
            Message::Welcome(welcome) => Self::Welcome {
                node: NodeId(welcome.node),
                epoch: Epoch(welcome.epoch),
                liveness: required("NodeWelcome.liveness", welcome.liveness)?.into(),
            },
            Message::Refused(refused) => Self::Refused { reason: text("Refused.reason", refused.reason)? },
            Message::AppsJoined(joined) => {
                Self::AppsJoined(list("AppsJoined.apps", MAX_ENTRIES, joined.apps)?)
            }
            Message::AppLeft(v1::AppLeft { app }) => Self::AppLeft { app: AppId(app) },
            Message::Cancel(jobs) => Self::Cancel { jobs: jobs.try_into()? },
            Message::Retract(order) => Self::Retract {
                steal: StealId(order.steal),
                jobs: required("Retract.jobs", order.jobs)?.try_into()?,
            },
            Message::Located(located) => Self::Located {
                content: content_hash("Located.content", &located.content)?,
                peer: located.peer.map(TryInto::try_into).transpose()?,
            },
            Message::Evict(evict) => Self::Evict { contents: hashes("Evict.contents", &evict.contents)? },
            Message::Drain(v1::Nothing {}) => Self::Drain,
            Message::SayInventory(v1::Nothing {}) => Self::SayInventory,
            Message::HeartbeatAck(v1::HeartbeatAck { sequence }) => Self::HeartbeatAck { sequence },
        })
    }
}
