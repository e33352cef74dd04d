//! `farmctl up`: coordinator, one worker over every device, and the status page in one process.

use std::net::{SocketAddr, ToSocketAddrs as _};

use coordinator::CoordinatorOptions;
use serde_json::json;

use crate::{cli::UpArgs, embedded::EmbeddedFarm, failure::Failure, output, running::Stops};

/// Runs a farm until SIGINT or SIGTERM, then drains it; a second signal ends the process at once.
pub(crate) async fn run(arguments: &UpArgs) -> Result<(), Failure> {
    let mut stops = Stops::listen()?;
    let options = CoordinatorOptions {
        listen: resolve("--listen", &arguments.listen)?,
        http: resolve("--http", &arguments.http)?,
        ..CoordinatorOptions::embedded()
    };
    let mut farm = EmbeddedFarm::start_with(options, &arguments.devices).await?;

    let devices = &farm.worker().info().devices;
    let ready = json!({
        "event": "ready",
        "grpc": farm.grpc(),
        "http": farm.coordinator().http_addr().to_string(),
        "devices": devices.iter().map(|device| json!({
            "name": device.name, "kind": device.kind.to_string(), "score": device.score,
        })).collect::<Vec<_>>(),
    });
    output::print_text(&format!("{ready}\n"))?;
    tell!("farmctl: the farm is up; status page http://{}; Ctrl-C ends it", farm.coordinator().http_addr());

    tokio::select! {
        () = stops.recv() => {}
        why = farm.worker_left() => {
            tell!("farmctl: the worker of this process has left ({why}); others may join the farm; Ctrl-C ends it");
            stops.recv().await;
        }
    }
    tell!("farmctl: draining; again to end at once");
    tokio::select! {
        () = farm.stop() => Ok(()),
        () = stops.recv() => Err(Failure::Work(anyhow::anyhow!("ended before the farm was drained"))),
    }
}

fn resolve(flag: &str, address: &str) -> Result<SocketAddr, Failure> {
    let found = address.to_socket_addrs().map(|mut addresses| addresses.next());
    match found {
        Ok(Some(address)) => Ok(address),
        Ok(None) => Err(Failure::Usage(anyhow::anyhow!("{flag} {address}: the name has no address"))),
        Err(error) => Err(Failure::Usage(anyhow::anyhow!("{flag} {address}: {error}"))),
    }
}
