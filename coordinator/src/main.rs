//! The binary `farm-coordinator`.

mod settings;

use std::{
    io::{IsTerminal as _, Write as _},
    process::ExitCode,
    time::Duration,
};

use anyhow::Context as _;
use clap::Parser as _;
use coordinator::{CoordinatorHandle, CoordinatorOptions, StartError};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tracing_subscriber::EnvFilter;

use self::settings::{Arguments, Role, Settings};

/// Something failed.
const EXIT_FAILED: u8 = 1;
/// Pause of a standby that was not the first.
const NEXT_LOOK: Duration = Duration::from_millis(500);
/// The command line or the settings are wrong.
const EXIT_USAGE: u8 = 2;

fn main() -> ExitCode {
    // clap exits with 2 by itself.
    let arguments = Arguments::parse();
    if let Some(Role::PolicyHost { object }) = &arguments.role {
        return coordinator::policy_host::serve(object);
    }
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    // A log that cannot be written must not end the daemon.
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none())
        .log_internal_errors(false)
        .init();
    proto::memory::give_large_blocks_back();
    let settings = match settings::settings(arguments) {
        Ok(settings) => settings,
        Err(error) => return failed(EXIT_USAGE, &error),
    };
    match run(settings) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failed(EXIT_FAILED, &error),
    }
}

fn failed(code: u8, error: &anyhow::Error) -> ExitCode {
    // Nobody may be left to read it.
    let _ = writeln!(std::io::stderr(), "farm-coordinator: {error:#}");
    ExitCode::from(code)
}

#[tokio::main]
async fn run(Settings { options, standby }: Settings) -> anyhow::Result<()> {
    // Before anything is started: a signal during the start is not lost.
    let mut interrupt = signal(SignalKind::interrupt()).context("cannot listen for SIGINT")?;
    let mut terminate = signal(SignalKind::terminate()).context("cannot listen for SIGTERM")?;
    let in_plain_text = if options.secured { vec![options.http] } else { vec![options.listen, options.http] };
    for address in in_plain_text {
        if !address.ip().is_loopback() {
            tracing::warn!(
                %address,
                "listening beyond this machine WITHOUT authentication or encryption: whoever reaches this address can use \
                 or watch the farm; do so only on a network you trust, or secure the farm with `farmctl init`"
            );
        }
    }
    let handle = tokio::select! {
        started = start(options, standby) => started?,
        () = asked_to_end(&mut interrupt, &mut terminate) => return Ok(()),
    };
    let ready = serde_json::json!({
        "event": "ready",
        "grpc": handle.grpc_addr().to_string(),
        "http": handle.http_addr().to_string(),
    });
    writeln!(std::io::stdout(), "{ready}").context("cannot write the ready line to stdout")?;

    tokio::select! {
        biased;
        () = asked_to_end(&mut interrupt, &mut terminate) => {}
        () = handle.taken_over() => anyhow::bail!(
            "another coordinator leads the farm: this one ends; started again with --standby it waits beside it"
        ),
        () = handle.stopped() => anyhow::bail!("the coordinator stopped by itself; the log says why"),
    }
    tracing::info!("ending; a second signal ends at once");
    tokio::select! {
        () = handle.shutdown() => Ok(()),
        () = asked_to_end(&mut interrupt, &mut terminate) => anyhow::bail!("ended before every session was closed"),
    }
}

/// Starts the coordinator; a standby once nobody leads.
async fn start(mut options: CoordinatorOptions, standby: bool) -> anyhow::Result<CoordinatorHandle> {
    let directory = options.state.clone().filter(|_| standby);
    if directory.is_some() {
        // Not on the day when it counts: the leader may be on this machine, and have them.
        coordinator::check_addresses(&options).await?;
        writeln!(std::io::stdout(), r#"{{"event":"standby"}}"#).context("cannot write to stdout")?;
    }
    loop {
        if let Some(directory) = &directory {
            options.vacancy = Some(coordinator::stand_by(directory, options.liveness).await?);
            // It may have been secured meanwhile.
            options.secured = !options.insecure && settings::is_secured(directory);
        }
        match coordinator::start(options.clone()).await {
            // Another standby was faster, or a coordinator that knows of no standbys is there.
            Err(StartError::Outrun | StartError::InUse { .. }) if standby => {
                tokio::time::sleep(NEXT_LOOK).await
            }
            started => return Ok(started?),
        }
    }
}

async fn asked_to_end(interrupt: &mut Signal, terminate: &mut Signal) {
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
    }
}
