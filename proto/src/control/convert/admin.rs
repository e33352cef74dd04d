//! Operators and the coordinator.

use farm_core::{
    coordinator::{
        AppStatus, ContentStatus, ContentsStatus, DeviceStatus, FarmStatus, NodeState, NodeStatus,
        ProjectStatus,
    },
    id::{AppId, ContentHash, Epoch, NodeId},
};

use super::{
    MAX_CONTENTS, MAX_ENTRIES, WireError, device, enumeration, list,
    model::{addresses, device_kind},
    name,
    nodes::hashes,
    required, score, weight, within,
};
use crate::control::v1;

impl From<FarmStatus> for v1::FarmStatus {
    fn from(status: FarmStatus) -> Self {
        Self {
            epoch: status.epoch.0,
            nodes: status.nodes.into_iter().map(Into::into).collect(),
            apps: status.apps.into_iter().map(Into::into).collect(),
            delivered_jobs: status.delivered_jobs,
            replanned_jobs: status.replanned_jobs,
            stolen_jobs: status.stolen_jobs,
            speculations: status.speculations,
            policy_fallbacks: status.policy_fallbacks,
            projects: status.projects.into_iter().map(Into::into).collect(),
            standbys: status.standbys,
        }
    }
}

impl TryFrom<v1::FarmStatus> for FarmStatus {
    type Error = WireError;

    fn try_from(wire: v1::FarmStatus) -> Result<Self, WireError> {
        Ok(Self {
            epoch: Epoch(wire.epoch),
            nodes: list("FarmStatus.nodes", MAX_ENTRIES, wire.nodes)?,
            apps: list("FarmStatus.apps", MAX_ENTRIES, wire.apps)?,
            delivered_jobs: wire.delivered_jobs,
            replanned_jobs: wire.replanned_jobs,
            stolen_jobs: wire.stolen_jobs,
            speculations: wire.speculations,
            policy_fallbacks: wire.policy_fallbacks,
            projects: list("FarmStatus.projects", MAX_ENTRIES, wire.projects)?,
            standbys: addresses("FarmStatus.standbys", wire.standbys)?,
        })
    }
}

impl From<NodeStatus> for v1::NodeStatus {
    fn from(node: NodeStatus) -> Self {
        let state = match node.state {
            NodeState::Alive => v1::NodeState::Alive,
            NodeState::Suspect => v1::NodeState::Suspect,
            NodeState::Draining => v1::NodeState::Draining,
        };
        Self {
            node: node.node.0,
            name: node.name,
            state: state.into(),
            addresses: node.addresses,
            devices: node.devices.into_iter().map(Into::into).collect(),
            cache: Some(node.cache.into()),
        }
    }
}

impl TryFrom<v1::NodeStatus> for NodeStatus {
    type Error = WireError;

    fn try_from(wire: v1::NodeStatus) -> Result<Self, WireError> {
        const STATE: &str = "NodeStatus.state";
        Ok(Self {
            node: NodeId(wire.node),
            name: name("NodeStatus.name", wire.name)?,
            state: match enumeration(STATE, wire.state)? {
                v1::NodeState::Unspecified => return Err(WireError::Missing { field: STATE }),
                v1::NodeState::Alive => NodeState::Alive,
                v1::NodeState::Suspect => NodeState::Suspect,
                v1::NodeState::Draining => NodeState::Draining,
            },
            addresses: addresses("NodeStatus.addresses", wire.addresses)?,
            devices: list("NodeStatus.devices", MAX_ENTRIES, wire.devices)?,
            cache: wire.cache.map(Into::into).unwrap_or_default(),
        })
    }
}

impl From<DeviceStatus> for v1::DeviceStatus {
    fn from(device: DeviceStatus) -> Self {
        Self {
            device: device.device.0.into(),
            name: device.name,
            kind: v1::DeviceKind::from(device.kind).into(),
            score: device.score,
            planned_jobs: device.planned_jobs,
            running_jobs: device.running_jobs,
            executed_jobs: device.executed_jobs,
            device_time_ns: device.device_time_ns,
            lost: device.lost,
        }
    }
}

impl TryFrom<v1::DeviceStatus> for DeviceStatus {
    type Error = WireError;

    fn try_from(wire: v1::DeviceStatus) -> Result<Self, WireError> {
        Ok(Self {
            device: device("DeviceStatus.device", wire.device)?,
            name: name("DeviceStatus.name", wire.name)?,
            kind: device_kind("DeviceStatus.kind", wire.kind)?,
            score: score("DeviceStatus.score", wire.score)?,
            planned_jobs: wire.planned_jobs,
            running_jobs: wire.running_jobs,
            executed_jobs: wire.executed_jobs,
            device_time_ns: wire.device_time_ns,
            lost: wire.lost,
        })
    }
}

impl From<AppStatus> for v1::AppStatus {
    fn from(app: AppStatus) -> Self {
        Self {
            app: app.app.0,
            name: app.name,
            weight: app.weight,
            connected: app.connected,
            waiting_jobs: app.waiting_jobs,
            outstanding_jobs: app.outstanding_jobs,
            delivered_jobs: app.delivered_jobs,
            device_time_ns: app.device_time_ns,
            project: app.project,
        }
    }
}

impl TryFrom<v1::AppStatus> for AppStatus {
    type Error = WireError;

    fn try_from(wire: v1::AppStatus) -> Result<Self, WireError> {
        Ok(Self {
            app: AppId(wire.app),
            name: name("AppStatus.name", wire.name)?,
            weight: weight("AppStatus.weight", wire.weight)?,
            connected: wire.connected,
            waiting_jobs: wire.waiting_jobs,
            outstanding_jobs: wire.outstanding_jobs,
            delivered_jobs: wire.delivered_jobs,
            device_time_ns: wire.device_time_ns,
            project: name("AppStatus.project", wire.project)?,
        })
    }
}

impl From<ProjectStatus> for v1::ProjectStatus {
    fn from(project: ProjectStatus) -> Self {
        Self {
            project: project.project,
            quota: Some(project.quota.into()),
            apps: project.apps,
            devices: project.devices,
            queued_jobs: project.queued_jobs,
            waiting_jobs: project.waiting_jobs,
            bytes: project.bytes,
            weight: project.weight,
        }
    }
}

impl TryFrom<v1::ProjectStatus> for ProjectStatus {
    type Error = WireError;

    fn try_from(wire: v1::ProjectStatus) -> Result<Self, WireError> {
        Ok(Self {
            project: name("ProjectStatus.project", wire.project)?,
            quota: required("ProjectStatus.quota", wire.quota)?.try_into()?,
            apps: wire.apps,
            devices: wire.devices,
            queued_jobs: wire.queued_jobs,
            waiting_jobs: wire.waiting_jobs,
            bytes: wire.bytes,
            weight: score("ProjectStatus.weight", wire.weight)?,
        })
    }
}

impl From<ContentsStatus> for v1::ContentsStatus {
    fn from(status: ContentsStatus) -> Self {
        let contents = status.contents.into_iter().map(|held| v1::ContentStatus {
            content: Some(held.content.into()),
            nodes: held.nodes.into_iter().map(|node| node.0).collect(),
        });
        Self { contents: contents.collect(), omitted: status.omitted }
    }
}

impl TryFrom<v1::ContentsStatus> for ContentsStatus {
    type Error = WireError;

    fn try_from(wire: v1::ContentsStatus) -> Result<Self, WireError> {
        let contents = list("ContentsStatus.contents", MAX_CONTENTS, wire.contents)?;
        Ok(Self { contents, omitted: wire.omitted })
    }
}

impl TryFrom<v1::ContentStatus> for ContentStatus {
    type Error = WireError;

    fn try_from(wire: v1::ContentStatus) -> Result<Self, WireError> {
        within("ContentStatus.nodes", wire.nodes.len(), MAX_ENTRIES)?;
        Ok(Self {
            content: required("ContentStatus.content", wire.content)?.try_into()?,
            nodes: wire.nodes.into_iter().map(NodeId).collect(),
        })
    }
}

/// What an eviction asks for: of one node or all, these contents or all.
///
/// # Errors
/// It names too many contents, or something that is no digest.
pub fn eviction(wire: v1::EvictRequest) -> Result<(Option<NodeId>, Vec<ContentHash>), WireError> {
    Ok((wire.node.map(NodeId), hashes("EvictRequest.contents", &wire.contents)?))
}
