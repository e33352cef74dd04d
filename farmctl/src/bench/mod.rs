//! Figures of merit beside their bars (10-scheduling.md section 5), measured on farms of real processes on this machine.

mod fairness;
mod jobs;
mod mi;
mod recovery;
mod scaling;
mod scheduler;
mod statistics;
mod steal;
mod tiles;

use std::time::Duration;

use anyhow::Context as _;
use client_sdk::{Farm, FarmOptions};
use serde::Serialize;
use tokio::task::block_in_place;

use crate::{
    admin::Admin,
    cli::{BenchArgs, BenchName, Format},
    failure::Failure,
    output,
    process_farm::{ProcessFarm, Shape, Stealing},
    running::Stops,
    target::Reach,
};

/// Longest wait until a farm has heard of the end of all its jobs: nodes report within 5 ms.
const SETTLE_PATIENCE: Duration = Duration::from_secs(5);
/// How often it is asked meanwhile.
const SETTLE_POLL: Duration = Duration::from_millis(2);

/// Which way a figure gets better.
#[derive(Clone, Copy, Debug, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Better {
    /// Larger is better.
    Higher,
    /// Smaller is better.
    Lower,
}

/// One measured figure and the bar it has to reach.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Figure {
    /// What was measured.
    pub figure: String,
    /// The measurement.
    pub value: f64,
    /// Its unit.
    pub unit: &'static str,
    /// What it has to reach.
    pub bar: f64,
    /// Which way.
    pub better: Better,
    /// Whether it does.
    pub ok: bool,
}

impl Figure {
    /// Judges a measurement.
    pub(crate) fn new(
        figure: impl Into<String>,
        value: f64,
        unit: &'static str,
        better: Better,
        bar: f64,
    ) -> Self {
        let ok = match better {
            Better::Higher => value >= bar,
            Better::Lower => value <= bar,
        };
        Self { figure: figure.into(), value, unit, bar, better, ok }
    }

    /// The worse of two measurements of one figure; one that is no number is the worst.
    fn worse(self, other: Self) -> Self {
        let other_is_worse = match self.better {
            Better::Higher => other.value < self.value,
            Better::Lower => other.value > self.value,
        };
        if other_is_worse || other.value.is_nan() { other } else { self }
    }
}

/// Measures, prints, and fails when a figure misses its bar.
pub(crate) async fn run(arguments: &BenchArgs, format: Format) -> Result<(), Failure> {
    let mut stops = Stops::listen()?;
    tell!("seed {}", arguments.seed);
    let figures = tokio::select! {
        figures = Box::pin(measure(arguments)) => figures?,
        // The measurement is dropped, and its processes with it.
        () = stops.recv() => return Err(Failure::Work(anyhow::anyhow!("interrupted"))),
    };
    output::print(&figures, format, figures_table)?;
    let missed = figures.iter().filter(|figure| !figure.ok).count();
    if missed > 0 {
        return Err(Failure::Work(anyhow::anyhow!("{missed} of {} figures miss their bar", figures.len())));
    }
    Ok(())
}

async fn measure(arguments: &BenchArgs) -> anyhow::Result<Vec<Figure>> {
    let runs = |default: usize| arguments.runs.map_or(default, usize::from);
    match arguments.name {
        BenchName::Scheduler => scheduler::measure(runs(5)).await,
        BenchName::Steal => steal::measure(arguments.seed, runs(5), arguments.pictures.as_deref()).await,
        BenchName::Fairness => fairness::measure(arguments.seed, runs(1)).await,
        BenchName::Scaling => scaling::measure(runs(3)).await,
        BenchName::Recovery => recovery::measure(runs(1)).await,
        BenchName::Mi => {
            let setup = mi::Setup {
                set: arguments.set,
                devices: &arguments.devices,
                iterations: arguments.iterations,
                points: arguments.points.into(),
                seed: arguments.seed,
                runs: runs(1),
            };
            mi::measure(&setup).await
        }
    }
}

/// A farm of processes; this thread waits for it.
fn start_farm(shape: &Shape) -> anyhow::Result<ProcessFarm> {
    block_in_place(|| ProcessFarm::start(shape))
}

/// An application on a farm of processes.
async fn connect(farm: &ProcessFarm, name: &str, weight: f64, global: Stealing) -> anyhow::Result<Farm> {
    let global_stealing = global == Stealing::On;
    let options = FarmOptions { weight, global_stealing, ..FarmOptions::new(farm.grpc(), name) };
    Ok(Farm::connect(options).await?)
}

/// Waits until the coordinator has no job on its books: what is planned next starts from empty queues.
async fn settled(farm: &ProcessFarm) -> anyhow::Result<()> {
    let quiet = async {
        let admin = Admin::new(Reach::open(farm.grpc()));
        loop {
            let status = admin.status().await.map_err(|failure| anyhow::anyhow!(failure.describe()))?;
            if status.apps.iter().all(|app| app.outstanding_jobs == 0 && app.waiting_jobs == 0) {
                return Ok(());
            }
            tokio::time::sleep(SETTLE_POLL).await;
        }
    };
    let patience = tokio::time::timeout(SETTLE_PATIENCE, quiet).await;
    patience.context("the farm still has jobs on its books after all were retrieved")?
}

fn figures_table(figures: &Vec<Figure>, _wide: bool) -> String {
    let mut table = output::table(["FIGURE", "VALUE", "UNIT", "BAR", "OK"]);
    for figure in figures {
        let sign = match figure.better {
            Better::Higher => ">=",
            Better::Lower => "<=",
        };
        table.add_row([
            figure.figure.to_owned(),
            format!("{:.3}", figure.value),
            figure.unit.to_owned(),
            format!("{sign} {}", figure.bar),
            if figure.ok { "yes" } else { "NO" }.to_owned(),
        ]);
    }
    format!("{table}\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bars_are_judged_both_ways() {
        assert!(Figure::new("a", 1.0, "ms", Better::Lower, 1.0).ok);
        assert!(!Figure::new("a", 1.1, "ms", Better::Lower, 1.0).ok);
        assert!(Figure::new("a", 1.1, "1/s", Better::Higher, 1.0).ok);
        assert!(!Figure::new("a", f64::NAN, "1/s", Better::Higher, 1.0).ok);
    }

    #[test]
    fn the_worse_of_two_counts() {
        let figure = |value, better| Figure::new("a", value, "1", better, 1.0);
        for (one, other) in [(1.0, 2.0), (2.0, 1.0)] {
            assert_eq!(figure(one, Better::Lower).worse(figure(other, Better::Lower)).value, 2.0);
            assert_eq!(figure(one, Better::Higher).worse(figure(other, Better::Higher)).value, 1.0);
        }
        assert!(figure(1.0, Better::Lower).worse(figure(f64::NAN, Better::Lower)).value.is_nan());
        assert!(figure(f64::NAN, Better::Lower).worse(figure(1.0, Better::Lower)).value.is_nan());
    }
}
