//! The timeline as a table: a line for each device.

use farm_core::coordinator::timeline::{Migration, Outcome};

use super::{Chart, busy_s};
use crate::output::{self, printable};

/// What one device did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Line {
    jobs: u64,
    failed: u64,
    busy_s: f64,
    local_in: u64,
    local_out: u64,
    global_in: u64,
    global_out: u64,
}

/// Jobs, share of time busy, and steals of each device.
pub(crate) fn table(chart: &Chart<'_>) -> String {
    let mut lines = vec![Line::default(); chart.rows.len()];
    for segment in &chart.timeline.segments {
        let row = chart.rows[&(segment.node, segment.device)];
        lines[row].jobs += 1;
        lines[row].failed += u64::from(segment.outcome == Outcome::Failed);
        lines[row].busy_s += busy_s(segment);
        match segment.migration {
            None => {}
            Some(Migration::Local { device }) => {
                lines[row].local_in += 1;
                if let Some(&from) = chart.rows.get(&(segment.node, device)) {
                    lines[from].local_out += 1;
                }
            }
            Some(Migration::Global { node, device }) => {
                lines[row].global_in += 1;
                if let Some(&from) = chart.rows.get(&(node, device)) {
                    lines[from].global_out += 1;
                }
            }
        }
    }
    let mut table = output::table([
        "NODE",
        "DEVICE",
        "JOBS",
        "FAILED",
        "BUSY",
        "LOCAL IN",
        "LOCAL OUT",
        "GLOBAL IN",
        "GLOBAL OUT",
    ]);
    for (&(node, device), &row) in &chart.rows {
        let line = lines[row];
        table.add_row([
            printable(&chart.node_name(node)),
            device.0.to_string(),
            line.jobs.to_string(),
            line.failed.to_string(),
            format!("{:.1} %", 100.0 * line.busy_s / chart.span_s().max(f64::MIN_POSITIVE)),
            line.local_in.to_string(),
            line.local_out.to_string(),
            line.global_in.to_string(),
            line.global_out.to_string(),
        ]);
    }
    let apps: Vec<String> = chart.apps().into_iter().map(|app| printable(&chart.app_name(app))).collect();
    format!(
        "{}: {} jobs in {:.3} s, devices {:.1} % busy\n\n{table}\n",
        if apps.is_empty() { "nothing ran".to_owned() } else { apps.join(", ") },
        chart.timeline.segments.len(),
        chart.span_s(),
        100.0 * chart.utilisation(),
    )
}

#[cfg(test)]
mod tests {
    use farm_core::id::{DeviceIndex, NodeId};

    use super::*;
    use crate::timeline::samples::{segment, timeline};

    #[test]
    fn steals_count_at_both_ends() {
        let local = Some(Migration::Local { device: DeviceIndex(1) });
        let global = Some(Migration::Global { node: NodeId(1), device: DeviceIndex(1) });
        let timeline = timeline("w", vec![segment(1, 0, 0, local), segment(2, 1, 0, global)]);
        let text = table(&Chart::new(&timeline));
        let cells = |row: usize| -> Vec<String> {
            text.lines().nth(3 + row).unwrap_or_default().split_whitespace().map(str::to_owned).collect()
        };
        assert_eq!(cells(0)[2..], ["1", "0", "100.0", "%", "1", "0", "0", "0"], "{text}");
        assert_eq!(cells(1)[2..], ["0", "0", "0.0", "%", "0", "1", "0", "1"], "{text}");
        assert_eq!(cells(3)[2..], ["1", "0", "100.0", "%", "0", "0", "1", "0"], "{text}");
    }

    #[test]
    fn nothing_is_said_to_be_nothing() {
        assert!(table(&Chart::new(&timeline("w", Vec::new()))).starts_with("nothing ran"));
    }
}
