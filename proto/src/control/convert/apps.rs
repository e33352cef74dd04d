//! Applications and the coordinator.

use farm_core::{
    id::{AppId, AppIncarnation, BatchId, ContentHash, Epoch, JobAttempt, NodeId, NodeSession, TaskId},
    message::{
        AppHello, AppToCoordinator, CoordinatorToApp, CostNs, DevicePlan, NodePlan, Plan, PlanJob,
        PlanRequest, WaitReason,
    },
};

use super::{
    MAX_CONTENTS, MAX_ENTRIES, MAX_JOBS, WireError,
    attempts::{IndexColumn, held, held_runs},
    cut, device, enumeration, invalid, list, name, required, text, weight, within,
};
use crate::{control::v1, trust::MAX_CAPABILITY_BYTES};

impl From<AppToCoordinator> for v1::AppToCoordinator {
    fn from(message: AppToCoordinator) -> Self {
        use v1::app_to_coordinator::Message;
        let message = match message {
            AppToCoordinator::Hello(hello) => Message::Hello(hello.into()),
            AppToCoordinator::Plan(request) => Message::Plan(request.into()),
            AppToCoordinator::AlreadyDelivered(jobs) => Message::AlreadyDelivered(jobs.as_slice().into()),
            AppToCoordinator::Unreachable { node, session } => {
                Message::Unreachable(v1::Unreachable { node: node.0, session: session.0 })
            }
            AppToCoordinator::Cancel(task) => Message::Cancel(v1::CancelTask { task: task.0 }),
            AppToCoordinator::Supersede(app) => Message::Supersede(v1::Supersede { app: app.0 }),
            AppToCoordinator::Heartbeat { sequence, unanswered } => {
                Message::Heartbeat(v1::AppHeartbeat { sequence, unanswered })
            }
            AppToCoordinator::Goodbye => Message::Goodbye(v1::Nothing {}),
        };
        Self { message: Some(message) }
    }
}

impl TryFrom<v1::AppToCoordinator> for AppToCoordinator {
    type Error = WireError;

    fn try_from(wire: v1::AppToCoordinator) -> Result<Self, WireError> {
        use v1::app_to_coordinator::Message;
        Ok(match required("AppToCoordinator.message", wire.message)? {
            Message::Hello(hello) => Self::Hello(hello.try_into()?),
            Message::Plan(request) => Self::Plan(request.try_into()?),
            Message::AlreadyDelivered(jobs) => Self::AlreadyDelivered(jobs.try_into()?),
            Message::Unreachable(v1::Unreachable { node, session }) => {
                Self::Unreachable { node: NodeId(node), session: NodeSession(session) }
            }
            Message::Cancel(v1::CancelTask { task }) => Self::Cancel(TaskId(task)),
            Message::Supersede(v1::Supersede { app }) => Self::Supersede(AppId(app)),
            Message::Heartbeat(v1::AppHeartbeat { sequence, unanswered }) => {
                Self::Heartbeat { sequence, unanswered }
            }
            Message::Goodbye(v1::Nothing {}) => Self::Goodbye,
        })
    }
}

impl From<AppHello> for v1::AppHello {
    fn from(hello: AppHello) -> Self {
        let resume = hello.resume.map(|(app, life)| v1::AppIdentity { app: app.0, incarnation: life.0 });
        Self {
            protocol: hello.protocol,
            name: hello.name,
            weight: hello.weight,
            resume,
            global_stealing: hello.global_stealing,
            policy: hello.policy,
        }
    }
}

impl TryFrom<v1::AppHello> for AppHello {
    type Error = WireError;

    fn try_from(wire: v1::AppHello) -> Result<Self, WireError> {
        Ok(Self {
            protocol: wire.protocol,
            name: name("AppHello.name", wire.name)?,
            weight: weight("AppHello.weight", wire.weight)?,
            global_stealing: wire.global_stealing,
            policy: name("AppHello.policy", wire.policy)?,
            resume: wire.resume.map(|was| (AppId(was.app), AppIncarnation(was.incarnation))),
        })
    }
}

impl From<PlanRequest> for v1::PlanRequest {
    fn from(request: PlanRequest) -> Self {
        let mut index = IndexColumn::default();
        Self {
            batch: request.batch.0,
            task: request.task.0,
            index_deltas: request.jobs.iter().map(|job| index.delta(job.index)).collect(),
            cost_ns: cost_column(&request.jobs),
            needs: Some(request.needs.into()),
            contents: request.contents.into_iter().map(Into::into).collect(),
            module: request.module.map_or_else(Vec::new, |module| module.0.to_vec()),
            held: held_runs(&request.held),
        }
    }
}

/// None if all are unknown, one if all are equal, else all.
fn cost_column(jobs: &[PlanJob]) -> Vec<u64> {
    match jobs.split_first() {
        Some((first, rest)) if rest.iter().all(|job| job.cost == first.cost) => {
            Vec::from_iter((first.cost.0 != 0).then_some(first.cost.0))
        }
        _ => jobs.iter().map(|job| job.cost.0).collect(),
    }
}

impl TryFrom<v1::PlanRequest> for PlanRequest {
    type Error = WireError;

    fn try_from(wire: v1::PlanRequest) -> Result<Self, WireError> {
        let count = wire.index_deltas.len();
        within("PlanRequest.index_deltas", count, MAX_JOBS)?;
        let costs = wire.cost_ns;
        if !(costs.len() <= 1 || costs.len() == count) {
            return Err(invalid("PlanRequest.cost_ns", format!("{} costs for {count} jobs", costs.len())));
        }
        let cost_of =
            |position: usize| CostNs(costs.get(position).or_else(|| costs.first()).copied().unwrap_or(0));
        let mut column = IndexColumn::default();
        let jobs = wire.index_deltas.into_iter().enumerate().map(|(position, delta)| {
            Ok(PlanJob { index: column.next("PlanRequest.index_deltas", delta)?, cost: cost_of(position) })
        });
        Ok(Self {
            batch: BatchId(wire.batch),
            task: TaskId(wire.task),
            jobs: jobs.collect::<Result<_, WireError>>()?,
            needs: required("PlanRequest.needs", wire.needs)?.try_into()?,
            contents: list("PlanRequest.contents", MAX_CONTENTS, wire.contents)?,
            module: module(&wire.module)?,
            held: held(wire.held)?,
        })
    }
}

fn module(wire: &[u8]) -> Result<Option<ContentHash>, WireError> {
    if wire.is_empty() {
        return Ok(None);
    }
    let hash = wire.try_into().map_err(|_| invalid("PlanRequest.module", format!("{} bytes", wire.len())))?;
    Ok(Some(ContentHash(hash)))
}

impl From<CoordinatorToApp> for v1::CoordinatorToApp {
    fn from(message: CoordinatorToApp) -> Self {
        use v1::coordinator_to_app::Message;
        let message = match message {
            CoordinatorToApp::Welcome { app, incarnation, epoch, liveness } => {
                Message::Welcome(v1::AppWelcome {
                    app: app.0,
                    incarnation: incarnation.0,
                    epoch: epoch.0,
                    liveness: Some(liveness.into()),
                })
            }
            CoordinatorToApp::Refused { reason } => Message::Refused(v1::Refused { reason: cut(reason) }),
            CoordinatorToApp::Plan(plan) => Message::Plan(plan.into()),
            CoordinatorToApp::Waiting { batch, reason } => {
                Message::Waiting(v1::Waiting { batch: batch.0, reason: v1::WaitReason::from(reason).into() })
            }
            CoordinatorToApp::JobFailed { job, failure } => {
                Message::JobFailed(v1::JobFailed { job: Some(job.into()), failure: Some(failure.into()) })
            }
            CoordinatorToApp::Stopped { reason } => Message::Stopped(v1::Stopped { reason: cut(reason) }),
            CoordinatorToApp::HeartbeatAck { sequence } => {
                Message::HeartbeatAck(v1::HeartbeatAck { sequence })
            }
            CoordinatorToApp::Capability(bytes) => Message::Capability(bytes),
        };
        Self { message: Some(message) }
    }
}

impl TryFrom<v1::CoordinatorToApp> for CoordinatorToApp {
    type Error = WireError;

    fn try_from(wire: v1::CoordinatorToApp) -> Result<Self, WireError> {
        use v1::coordinator_to_app::Message;
        Ok(match required("CoordinatorToApp.message", wire.message)? {
            Message::Welcome(welcome) => Self::Welcome {
                app: AppId(welcome.app),
                incarnation: AppIncarnation(welcome.incarnation),
                epoch: Epoch(welcome.epoch),
                liveness: required("AppWelcome.liveness", welcome.liveness)?.into(),
            },
            Message::Refused(refused) => Self::Refused { reason: text("Refused.reason", refused.reason)? },
            Message::Plan(plan) => Self::Plan(plan.try_into()?),
            Message::Waiting(waiting) => {
                Self::Waiting { batch: BatchId(waiting.batch), reason: wait_reason(waiting.reason)? }
            }
            Message::JobFailed(failed) => Self::JobFailed {
                job: required("JobFailed.job", failed.job)?.into(),
                failure: required("JobFailed.failure", failed.failure)?.try_into()?,
            },
            Message::Stopped(stopped) => Self::Stopped { reason: text("Stopped.reason", stopped.reason)? },
            Message::HeartbeatAck(v1::HeartbeatAck { sequence }) => Self::HeartbeatAck { sequence },
            Message::Capability(bytes) => {
                within("CoordinatorToApp.capability", bytes.len(), MAX_CAPABILITY_BYTES)?;
                Self::Capability(bytes)
            }
        })
    }
}

impl From<WaitReason> for v1::WaitReason {
    fn from(reason: WaitReason) -> Self {
        match reason {
            WaitReason::NoNode => Self::NoNode,
            WaitReason::NoFittingDevice => Self::NoFittingDevice,
            WaitReason::OverQuota => Self::OverQuota,
        }
    }
}

fn wait_reason(reason: i32) -> Result<WaitReason, WireError> {
    const FIELD: &str = "Waiting.reason";
    match enumeration(FIELD, reason)? {
        v1::WaitReason::Unspecified => Err(WireError::Missing { field: FIELD }),
        v1::WaitReason::NoNode => Ok(WaitReason::NoNode),
        v1::WaitReason::NoFittingDevice => Ok(WaitReason::NoFittingDevice),
        v1::WaitReason::OverQuota => Ok(WaitReason::OverQuota),
    }
}

impl From<Plan> for v1::Plan {
    fn from(plan: Plan) -> Self {
        let nodes = plan.nodes.into_iter().map(|node| v1::NodePlan {
            node: node.node.0,
            session: node.session.0,
            contact: Some(node.contact.into()),
            devices: node.devices.into_iter().map(Into::into).collect(),
        });
        let batch = plan.batch.map(|batch| batch.0);
        Self { batch, nodes: nodes.collect(), speculative: plan.speculative }
    }
}

impl TryFrom<v1::Plan> for Plan {
    type Error = WireError;

    fn try_from(wire: v1::Plan) -> Result<Self, WireError> {
        let nodes = list("Plan.nodes", MAX_ENTRIES, wire.nodes)?;
        Ok(Self { batch: wire.batch.map(BatchId), speculative: wire.speculative, nodes })
    }
}

impl TryFrom<v1::NodePlan> for NodePlan {
    type Error = WireError;

    fn try_from(wire: v1::NodePlan) -> Result<Self, WireError> {
        Ok(Self {
            node: NodeId(wire.node),
            session: NodeSession(wire.session),
            contact: required("NodePlan.contact", wire.contact)?.try_into()?,
            devices: list("NodePlan.devices", MAX_ENTRIES, wire.devices)?,
        })
    }
}

impl From<DevicePlan> for v1::DevicePlan {
    fn from(plan: DevicePlan) -> Self {
        Self { device: plan.device.0.into(), jobs: Some(plan.jobs.as_slice().into()) }
    }
}

impl TryFrom<v1::DevicePlan> for DevicePlan {
    type Error = WireError;

    fn try_from(wire: v1::DevicePlan) -> Result<Self, WireError> {
        let jobs: Vec<JobAttempt> = required("DevicePlan.jobs", wire.jobs)?.try_into()?;
        Ok(Self { device: device("DevicePlan.device", wire.device)?, jobs })
    }
}
