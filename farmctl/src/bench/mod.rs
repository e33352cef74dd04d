//! Figures of merit beside their bars (10-scheduling.md section 5).

mod scheduler;

use serde::Serialize;

use crate::{
    cli::{BenchName, Format},
    failure::Failure,
    output,
};

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
    pub figure: &'static str,
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
        figure: &'static str,
        value: f64,
        unit: &'static str,
        better: Better,
        bar: f64,
    ) -> Self {
        let ok = match better {
            Better::Higher => value >= bar,
            Better::Lower => value <= bar,
        };
        Self { figure, value, unit, bar, better, ok }
    }
}

/// Measures, prints, and fails when a figure misses its bar.
pub(crate) async fn run(name: BenchName, format: Format) -> Result<(), Failure> {
    let figures = match name {
        BenchName::Scheduler => scheduler::measure().await?,
    };
    output::print(&figures, format, figures_table)?;
    let missed = figures.iter().filter(|figure| !figure.ok).count();
    if missed > 0 {
        return Err(Failure::Work(anyhow::anyhow!("{missed} of {} figures miss their bar", figures.len())));
    }
    Ok(())
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
}
