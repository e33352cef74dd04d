//! The farm as operators see it. It reads, and changes nothing.

use super::{AppStatus, CoordinatorMachine, DeviceStatus, FarmStatus, NodeStatus, Whereabouts};
use crate::id::{DeviceIndex, JobId};

impl CoordinatorMachine {
    /// The farm as an operator sees it.
    #[must_use]
    pub fn status(&self) -> FarmStatus {
        FarmStatus {
            epoch: self.config.epoch,
            nodes: self.node_statuses(),
            apps: self.app_statuses(),
            projects: self.project_statuses(),
            delivered_jobs: self.delivered_jobs,
            replanned_jobs: self.replanned_jobs,
            stolen_jobs: self.stolen_jobs,
            speculations: self.speculations,
            policy_fallbacks: self.policy_fallbacks,
            standbys: Vec::new(),
        }
    }

    /// Jobs that moved from one node to another by stealing, since this start.
    #[must_use]
    pub const fn stolen_jobs(&self) -> u64 {
        self.stolen_jobs
    }

    /// Where a job is, as far as the coordinator knows.
    #[must_use]
    pub fn whereabouts(&self, job: JobId) -> Whereabouts {
        match self.job(job).map(|job| job.state.holder()) {
            None => Whereabouts::Unknown,
            Some(None) => Whereabouts::Waiting,
            Some(Some((node, attempt))) => Whereabouts::At { node, attempt },
        }
    }

    fn node_statuses(&self) -> Vec<NodeStatus> {
        let devices = |node: &super::model::Node| {
            (0_u16..)
                .zip(&node.devices)
                .map(|(index, device)| DeviceStatus {
                    device: DeviceIndex(index),
                    name: device.info.name.clone(),
                    kind: device.info.kind,
                    score: device.info.score,
                    planned_jobs: device.planned_jobs,
                    running_jobs: device.running.is_some().into(),
                    executed_jobs: device.executed_jobs,
                    device_time_ns: device.device_time_ns,
                    lost: device.lost,
                })
                .collect()
        };
        self.nodes
            .iter()
            .map(|(&id, node)| NodeStatus {
                node: id,
                name: node.name.clone(),
                state: node.state,
                addresses: node.contact.addresses.clone(),
                devices: devices(node),
                cache: node.cache.unwrap_or_default(),
            })
            .collect()
    }

    fn app_statuses(&self) -> Vec<AppStatus> {
        self.apps
            .iter()
            .map(|(&id, app)| AppStatus {
                app: id,
                name: app.name.clone(),
                project: self.projects.name_of(id).to_owned(),
                weight: self.terms_of(id).weight,
                connected: app.link.is_some(),
                waiting_jobs: app.waiting_jobs,
                outstanding_jobs: app.jobs.len() as u64 - app.waiting_jobs,
                delivered_jobs: app.delivered_jobs,
                device_time_ns: app.device_time_ns,
            })
            .collect()
    }
}
