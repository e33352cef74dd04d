//! The binary `farm-worker`.

mod settings;

use std::{
    io::{IsTerminal as _, Write as _},
    process::ExitCode,
};

use anyhow::Context as _;
use clap::Parser as _;
use proto::control::SessionError;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tracing_subscriber::EnvFilter;
use worker::{End, StartError, WorkerHandle, WorkerInfo, WorkerOptions};

use self::settings::Arguments;

/// Something failed.
const EXIT_FAILED: u8 = 1;
/// The command line or the settings are wrong.
const EXIT_USAGE: u8 = 2;
/// The coordinator could not be reached at the start.
const EXIT_UNREACHABLE: u8 = 3;
/// The farm does not let this node in.
const EXIT_DENIED: u8 = 4;

fn main() -> ExitCode {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info,wgpu_hal=error"));
    // A log that cannot be written must not end the daemon.
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none())
        .log_internal_errors(false)
        .init();
    if let Some(code) = worker::serve_if_executor(std::env::args_os()) {
        return code;
    }
    proto::memory::give_large_blocks_back();
    // clap exits with 2 by itself.
    let arguments = Arguments::parse();
    let options = match settings::options(arguments) {
        Ok(options) => options,
        Err(error) => return failed(EXIT_USAGE, &error),
    };
    match run(options) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failed(exit_code(&error), &error),
    }
}

fn failed(code: u8, error: &anyhow::Error) -> ExitCode {
    // Nobody may be left to read it.
    let _ = writeln!(std::io::stderr(), "farm-worker: {error:#}");
    ExitCode::from(code)
}

fn exit_code(error: &anyhow::Error) -> u8 {
    match error.downcast_ref() {
        Some(StartError::Unreachable(SessionError::Address { .. }, _) | StartError::NoDevice) => EXIT_USAGE,
        Some(StartError::Unreachable(..)) => EXIT_UNREACHABLE,
        Some(StartError::Denied { .. }) => EXIT_DENIED,
        Some(
            StartError::Device(_)
            | StartError::Executor { .. }
            | StartError::Listen(_)
            | StartError::Cache { .. }
            | StartError::Refused { .. }
            | StartError::System(_),
        )
        | None => EXIT_FAILED,
    }
}

#[tokio::main]
async fn run(options: WorkerOptions) -> anyhow::Result<()> {
    // Before anything is started: a signal during the start is not lost.
    let mut interrupt = signal(SignalKind::interrupt()).context("cannot listen for SIGINT")?;
    let mut terminate = signal(SignalKind::terminate()).context("cannot listen for SIGTERM")?;
    if options.identity.is_none() && !options.listen.ip().is_loopback() {
        tracing::warn!(
            address = %options.listen,
            "listening beyond this machine WITHOUT authentication: whoever reaches this address can run kernels on this \
             machine's devices; do so only on a network you trust, or secure the farm with `farmctl init`"
        );
    }
    let mut handle = tokio::select! {
        started = worker::start(options) => started?,
        () = asked_to_end(&mut interrupt, &mut terminate) => return Ok(()),
    };
    let ready = ready_line(handle.info());
    writeln!(std::io::stdout(), "{ready}").context("cannot write the ready line to stdout")?;

    tokio::select! {
        end = handle.ended() => return outcome(end),
        () = asked_to_end(&mut interrupt, &mut terminate) => {}
    }
    tracing::info!("draining; a second signal ends at once");
    tokio::select! {
        end = drained(&mut handle) => outcome(end),
        () = asked_to_end(&mut interrupt, &mut terminate) => anyhow::bail!("ended before it was drained"),
    }
}

async fn drained(handle: &mut WorkerHandle) -> End {
    handle.begin_drain().await;
    handle.ended().await
}

fn outcome(end: End) -> anyhow::Result<()> {
    match end {
        End::Drained => Ok(()),
        End::Denied { reason } => anyhow::bail!("denied: {reason}"),
        End::Refused { reason } => anyhow::bail!("the coordinator refused this node: {reason}"),
        End::Failed { reason } => anyhow::bail!("{reason}"),
    }
}

async fn asked_to_end(interrupt: &mut Signal, terminate: &mut Signal) {
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
    }
}

fn ready_line(info: &WorkerInfo) -> serde_json::Value {
    let devices: Vec<_> = info
        .devices
        .iter()
        .map(|device| {
            serde_json::json!({
                "name": device.name,
                "kind": device.kind.to_string(),
                "score": device.score,
            })
        })
        .collect();
    serde_json::json!({
        "event": "ready",
        "node": info.node.to_string(),
        "name": info.name,
        "data": info.data.to_string(),
        "devices": devices,
    })
}
