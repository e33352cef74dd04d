//! The one command line of Gleaner. Raw arguments become checked ones in `cli`, verbs are in `command`, output is a
//! function of data in `output`.

/// Says something on stderr; a stderr that is full or closed changes nothing of what is done.
macro_rules! tell {
    ($($words:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stderr(), $($words)*);
    }};
}

mod admin;
mod bench;
mod cli;
mod command;
mod embedded;
mod failure;
mod journal;
mod output;
mod process_farm;
mod progress;
mod running;
mod target;
mod timeline;

use std::{io::IsTerminal as _, process::ExitCode};

use clap::Parser;
use tracing_subscriber::EnvFilter;

use crate::{
    cli::{Cli, Verb},
    failure::Failure,
};

fn main() -> ExitCode {
    // Logs are for the one who asks (RUST_LOG): a command's own words are its output and its error.
    tracing_subscriber::fmt()
        .with_env_filter(EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("error")))
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none())
        .log_internal_errors(false)
        .init();
    if let Some(code) = worker::serve_if_executor(std::env::args_os()) {
        return code;
    }
    let cli = Cli::parse();
    match run(&cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            tell!("farmctl: {}", failure.describe());
            failure.exit_code()
        }
    }
}

fn run(cli: &Cli) -> Result<(), Failure> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let result = runtime.block_on(async {
        let target = &cli.target()?;
        match &cli.verb {
            Verb::Up(arguments) => command::up::run(arguments).await,
            Verb::Render(arguments) => Box::pin(command::render::run(arguments, target)).await,
            Verb::Mi(arguments) => Box::pin(command::mi::run(arguments, target)).await,
            Verb::Scene(arguments) => command::scene::run(arguments),
            Verb::Alignment(arguments) => command::alignment::run(arguments),
            Verb::Status(arguments) => command::status::run(arguments, target, cli.output).await,
            Verb::Timeline(arguments) => command::timeline::run(arguments, target, cli.output).await,
            Verb::Node(verb) => command::node::run(verb, target).await,
            Verb::Cache(verb) => command::cache::run(verb, target, cli.output).await,
            Verb::Init(arguments) => command::membership::init(arguments, target),
            Verb::Join(arguments) => command::membership::join(arguments, target).await,
            Verb::Token(verb) => command::membership::token(verb, target, cli.output).await,
            Verb::Member(verb) => command::membership::member(verb, target, cli.output).await,
            Verb::Project(verb) => command::project::run(verb, target, cli.output).await,
            Verb::Bench(arguments) => {
                Box::pin(bench::run(arguments, arguments.output.unwrap_or(cli.output))).await
            }
            Verb::Version(arguments) => command::version::run(arguments.output.unwrap_or(cli.output)),
        }
    });
    // A device thread or a name look-up may still hang: nothing of it is worth waiting for.
    runtime.shutdown_background();
    result
}
