//! Runs the simulator by hand: `simulate --seed 7 --scenario weather`, `simulate list`.

use std::{
    fs::File,
    num::NonZero,
    path::PathBuf,
    process::ExitCode,
    sync::{
        Mutex,
        atomic::{AtomicU64, Ordering},
    },
    thread,
    time::Instant,
};

use anyhow::{Context as _, bail};
use clap::{Parser, Subcommand};
use tests::sim::{
    million::{self, Figures, MEMORY_BAR_BYTES, PLANNING_BAR_US},
    scenario::{Outcome, SCENARIOS, Scenario},
};

/// Name of the scenario that measures instead of judging.
const MILLION: &str = "million";

/// The real machines of a farm in one process, over a seeded network with virtual time, in trouble.
#[derive(Debug, Parser)]
#[command(name = "simulate")]
struct Arguments {
    #[command(subcommand)]
    command: Option<Command>,
    /// The first seed.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// How many seeds, one after the other.
    #[arg(long, default_value_t = 1)]
    seeds: u64,
    /// Which kind of farm; `simulate list` names them.
    #[arg(long, default_value = "weather")]
    scenario: String,
    /// Seeds at once; as many as there are cores if not given.
    #[arg(long)]
    threads: Option<NonZero<usize>>,
    /// Writes everything that any machine wants into this file; for one seed.
    #[arg(long)]
    log: Option<PathBuf>,
    /// Devices of each node of the scenario `million`.
    #[arg(long, default_value_t = 1)]
    devices: u16,
    /// Prints only what fails, and the sum.
    #[arg(long)]
    quiet: bool,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Names the scenarios.
    List,
}

fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    match arguments.command {
        Some(Command::List) => {
            for scenario in SCENARIOS {
                println!("{:<10} {}", scenario.name, scenario.about);
            }
            println!(
                "{MILLION:<10} what planning and keeping a job costs the coordinator, for 1,000,000 jobs"
            );
            Ok(ExitCode::SUCCESS)
        }
        None if arguments.scenario == MILLION => {
            let figures = million::measure(arguments.devices);
            print_figures(&figures);
            Ok(if figures.pass() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
        }
        None => run(&arguments),
    }
}

fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let Some(scenario) = Scenario::named(&arguments.scenario) else {
        bail!("no scenario is called {}; `simulate list` names them", arguments.scenario);
    };
    if arguments.log.is_some() && arguments.seeds != 1 {
        bail!("--log holds one seed, {} are to run", arguments.seeds);
    }
    let log = arguments
        .log
        .as_ref()
        .map(|path| File::create(path).with_context(|| format!("{} cannot be written", path.display())));
    let log = Mutex::new(log.transpose()?);
    let threads = arguments
        .threads
        .map_or_else(|| thread::available_parallelism().map_or(1, NonZero::get), NonZero::get);
    // Broken invariants are printed with their seed.
    std::panic::set_hook(Box::new(|_| {}));
    let begin = Instant::now();
    let next = AtomicU64::new(0);
    let failed = AtomicU64::new(0);
    let events = AtomicU64::new(0);
    thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                loop {
                    let nth = next.fetch_add(1, Ordering::Relaxed);
                    if nth >= arguments.seeds {
                        break;
                    }
                    let log = log.lock().ok().and_then(|mut log| log.take());
                    let outcome = scenario.run(arguments.seed + nth, log);
                    events.fetch_add(outcome.events, Ordering::Relaxed);
                    if outcome.verdict.is_err() {
                        failed.fetch_add(1, Ordering::Relaxed);
                    }
                    if !arguments.quiet || outcome.verdict.is_err() {
                        print_outcome(scenario, &outcome);
                    }
                }
            });
        }
    });
    let seconds = begin.elapsed().as_secs_f64();
    let failed = failed.into_inner();
    println!(
        "{} seeds of {}: {failed} failed; {} events, {seconds:.1} s, {:.0} seeds/s on {threads} threads",
        arguments.seeds,
        scenario.name,
        events.into_inner(),
        arguments.seeds as f64 / seconds
    );
    Ok(if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn print_outcome(scenario: Scenario, outcome: &Outcome) {
    let Outcome { seed, events, log_hash, virtual_time, verdict, .. } = outcome;
    let seconds = virtual_time.as_secs_f64();
    let verdict = match verdict {
        Ok(()) => "ok".to_owned(),
        Err(broken) => {
            format!("FAILED\n{broken}\nrepeat with: simulate --scenario {} --seed {seed}", scenario.name)
        }
    };
    println!("seed {seed:>7}  events {events:>7}  log {log_hash:016x}  virtual {seconds:>8.3} s  {verdict}");
}

fn print_figures(figures: &Figures) {
    let Figures { jobs, devices, planning_us, memory_bytes } = figures;
    println!("{jobs} queued jobs on {devices} devices of 1000 nodes");
    let mark = |pass: bool| if pass { "ok" } else { "MISSED" };
    let fast = mark(*planning_us <= PLANNING_BAR_US);
    println!("planning     {planning_us:>8.2} us per job     bar {PLANNING_BAR_US} us     {fast}");
    let small = mark(*memory_bytes < MEMORY_BAR_BYTES);
    println!("coordinator  {memory_bytes:>8.0} bytes per job  bar {MEMORY_BAR_BYTES} bytes  {small}");
}
