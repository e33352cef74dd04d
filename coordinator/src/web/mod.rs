//! The HTTP side: health, metrics, the status page, and the status as JSON. It reads; it changes nothing.

mod metrics;
mod page;

use std::{io, net::SocketAddr};

use axum::{
    Json, Router,
    extract::State,
    http::{StatusCode, header},
    response::{Html, IntoResponse, Response},
    routing::get,
};
use farm_core::coordinator::FarmStatus;
use proto::{
    control::{ControlStream, Incoming},
    net::TcpListener,
};

use crate::owner::OwnerHandle;

/// The HTTP listener: connections whose peers speak.
#[derive(Debug)]
pub(crate) struct Listener {
    incoming: Incoming,
    address: io::Result<SocketAddr>,
}

impl Listener {
    pub(crate) fn of(listener: TcpListener) -> Self {
        Self { address: listener.local_addr(), incoming: Incoming::http(listener) }
    }
}

impl axum::serve::Listener for Listener {
    type Io = ControlStream;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (ControlStream, SocketAddr) {
        match self.incoming.accept().await {
            Some(accepted) => accepted,
            // The accepting task lives as long as this: only a runtime that ends takes it away.
            None => std::future::pending().await,
        }
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.address.as_ref().copied().map_err(|error| error.kind().into())
    }
}

/// The routes.
pub(crate) fn router(owner: OwnerHandle) -> Router {
    Router::new()
        .route("/", get(index))
        .route("/healthz", get(health))
        .route("/metrics", get(prometheus))
        .route("/status.json", get(json))
        .with_state(owner)
}

/// The coordinator's task has stopped.
struct Stopped;

impl IntoResponse for Stopped {
    fn into_response(self) -> Response {
        (StatusCode::SERVICE_UNAVAILABLE, "the coordinator has stopped\n").into_response()
    }
}

async fn status(owner: &OwnerHandle) -> Result<FarmStatus, Stopped> {
    owner.status().await.ok_or(Stopped)
}

async fn index(State(owner): State<OwnerHandle>) -> Result<Html<String>, Stopped> {
    Ok(Html(page::render(&status(&owner).await?)))
}

async fn health(State(owner): State<OwnerHandle>) -> Result<&'static str, Stopped> {
    status(&owner).await?;
    Ok("ok\n")
}

async fn prometheus(State(owner): State<OwnerHandle>) -> Result<impl IntoResponse, Stopped> {
    let text = metrics::render(&status(&owner).await?);
    Ok(([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text))
}

async fn json(State(owner): State<OwnerHandle>) -> Result<Json<FarmStatus>, Stopped> {
    Ok(Json(status(&owner).await?))
}

#[cfg(test)]
pub(crate) mod samples {
    //! A farm to render.

    use farm_core::{
        coordinator::{AppStatus, DeviceStatus, FarmStatus, NodeState, NodeStatus, ProjectStatus},
        device::DeviceKind,
        id::{AppId, DeviceIndex, Epoch, NodeId},
        message::CacheFigures,
        project::Quota,
    };

    pub(crate) fn farm() -> FarmStatus {
        let device = DeviceStatus {
            device: DeviceIndex(0),
            name: "a <b>\"GPU\"</b> & \\co".to_owned(),
            kind: DeviceKind::Gpu,
            score: 1_234.5,
            planned_jobs: 7,
            running_jobs: 1,
            executed_jobs: 41,
            device_time_ns: 2_500_000_000,
            lost: false,
        };
        let lost = DeviceStatus { device: DeviceIndex(1), lost: true, running_jobs: 0, ..device.clone() };
        let node = NodeStatus {
            node: NodeId(3),
            name: "n<script>".to_owned(),
            state: NodeState::Alive,
            addresses: vec!["127.0.0.1:1".to_owned()],
            devices: vec![device, lost],
            cache: CacheFigures { disk_bytes: 77, memory_hits: 5, ..CacheFigures::default() },
        };
        let app = AppStatus {
            app: AppId(9),
            name: "render".to_owned(),
            project: "films".to_owned(),
            weight: 2.0,
            connected: true,
            waiting_jobs: 1,
            outstanding_jobs: 2,
            delivered_jobs: 3,
            device_time_ns: 4_000_000,
        };
        let project = ProjectStatus {
            project: "films".to_owned(),
            quota: Quota { devices: Some(4), ..Quota::default() },
            apps: 1,
            devices: 3,
            queued_jobs: 2,
            waiting_jobs: 1,
            bytes: 5_000,
            weight: 2.0,
        };
        FarmStatus {
            epoch: Epoch(5),
            nodes: vec![node],
            apps: vec![app],
            projects: vec![project],
            delivered_jobs: 40,
            replanned_jobs: 6,
            stolen_jobs: 7,
            speculations: 8,
            policy_fallbacks: 9,
            standbys: vec!["process 7 of <two>".to_owned()],
        }
    }
}
