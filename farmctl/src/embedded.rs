//! A whole farm inside this process: a coordinator and one worker, over loopback, with ports of the system's choice. What
//! `up`, `render` without a coordinator and the benches run on.

use anyhow::Context as _;
use coordinator::{CoordinatorHandle, CoordinatorOptions};
use gpu_exec::DeviceSpec;
use worker::{End, Isolation, WorkerHandle, WorkerOptions};

use crate::{
    failure::Failure,
    target::{Reach, Target},
};

/// A running embedded farm.
#[derive(Debug)]
pub(crate) struct EmbeddedFarm {
    coordinator: CoordinatorHandle,
    worker: WorkerHandle,
}

impl EmbeddedFarm {
    /// Starts a farm over `devices` (all found when empty) on ports of the system's choice.
    pub(crate) async fn start(devices: &[String]) -> Result<Self, Failure> {
        Self::start_with(CoordinatorOptions::embedded(), devices).await
    }

    /// The farm that was named; where none was, one of our own over `devices`.
    pub(crate) async fn unless_named(
        target: &Target<'_>,
        devices: &[String],
    ) -> Result<(Reach, Option<Self>), Failure> {
        if let Some(reach) = target.named().await? {
            if !devices.is_empty() {
                let reason =
                    format!("--device is for a farm of your own, and {} was named", target.address());
                return Err(Failure::Usage(anyhow::anyhow!(reason)));
            }
            return Ok((reach, None));
        }
        let farm = Self::start(devices).await?;
        Ok((Reach::open(&farm.grpc()), Some(farm)))
    }

    /// Starts a farm whose coordinator has these options.
    pub(crate) async fn start_with(options: CoordinatorOptions, devices: &[String]) -> Result<Self, Failure> {
        let specs = device_specs(devices)?;
        let coordinator =
            coordinator::start(options).await.context("the coordinator of the own farm does not start")?;
        let options = WorkerOptions {
            isolation: Isolation::own_binary(),
            ..WorkerOptions::embedded(coordinator.grpc_addr().to_string(), specs)
        };
        match worker::start(options).await {
            Ok(worker) => Ok(Self { coordinator, worker }),
            Err(error) => {
                coordinator.shutdown().await;
                Err(anyhow::Error::new(error).context("the worker of the own farm does not start").into())
            }
        }
    }

    /// Where applications connect.
    pub(crate) fn grpc(&self) -> String {
        self.coordinator.grpc_addr().to_string()
    }

    /// The coordinator.
    pub(crate) const fn coordinator(&self) -> &CoordinatorHandle {
        &self.coordinator
    }

    /// The worker.
    pub(crate) const fn worker(&self) -> &WorkerHandle {
        &self.worker
    }

    /// Waits until the worker is none any more; gives why. Cancel-safe.
    pub(crate) async fn worker_left(&mut self) -> String {
        match self.worker.ended().await {
            End::Drained => "it was drained".to_owned(),
            End::Denied { reason } | End::Refused { reason } | End::Failed { reason } => reason,
        }
    }

    /// Drains the worker, then stops the coordinator.
    pub(crate) async fn stop(self) {
        self.worker.drain().await;
        self.coordinator.shutdown().await;
    }
}

fn device_specs(devices: &[String]) -> Result<Vec<DeviceSpec>, Failure> {
    if devices.is_empty() {
        return Ok(vec![DeviceSpec::All]);
    }
    devices
        .iter()
        .map(|text| text.parse().map_err(|error| Failure::Usage(anyhow::Error::new(error))))
        .collect()
}
