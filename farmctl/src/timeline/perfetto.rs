//! The timeline in Chrome's trace event format, which <https://ui.perfetto.dev> opens: a process for each node, a
//! thread for each device, a slice for each attempt, an arrow for each steal.

use std::collections::{BTreeMap, BTreeSet};

use farm_core::{
    coordinator::timeline::{Migration, Segment},
    id::{DeviceIndex, NodeId},
    time::Instant,
};
use serde_json::{Value, json};

use super::Chart;

/// The whole document.
pub(crate) fn trace(chart: &Chart<'_>) -> Value {
    let mut events = Vec::new();
    let processes = processes(chart);
    let mut named = None;
    for &(node, device) in chart.rows.keys() {
        if named.replace(node) != Some(node) {
            events.push(json!({
                "ph": "M", "name": "process_name", "pid": processes[&node], "tid": 0,
                "args": {"name": format!("{} ({node})", chart.node_name(node))},
            }));
        }
        events.push(json!({
            "ph": "M", "name": "thread_name", "pid": processes[&node], "tid": thread(device),
            "args": {"name": device_name(chart, node, device)},
        }));
    }
    for (id, segment) in chart.timeline.segments.iter().enumerate() {
        events.push(slice(chart, segment, processes[&segment.node]));
        let Some(migration) = segment.migration else { continue };
        let (kind, node, device) = match migration {
            Migration::Local { device } => ("local steal", segment.node, device),
            Migration::Global { node, device } => ("global steal", node, device),
        };
        // A global steal happened when the new attempt was planned, a local one when it was handed over.
        let at = match migration {
            Migration::Local { .. } => segment.staged_at,
            Migration::Global { .. } => segment.scheduled_at,
        };
        events.push(json!({
            "ph": "s", "id": id, "name": kind, "cat": "steal", "pid": processes[&node],
            "tid": thread(device), "ts": microseconds(chart, at),
        }));
        events.push(json!({
            "ph": "f", "bp": "e", "id": id, "name": kind, "cat": "steal", "pid": processes[&segment.node],
            "tid": thread(segment.device), "ts": microseconds(chart, segment.started_at),
        }));
    }
    json!({"displayTimeUnit": "ms", "traceEvents": events})
}

/// Numbers of the nodes, from 1: ids have 64 bits, and viewers take 32.
fn processes(chart: &Chart<'_>) -> BTreeMap<NodeId, u32> {
    let victims = chart.timeline.segments.iter().filter_map(|segment| match segment.migration {
        Some(Migration::Global { node, .. }) => Some(node),
        Some(Migration::Local { .. }) | None => None,
    });
    let nodes: BTreeSet<NodeId> = chart.rows.keys().map(|&(node, _)| node).chain(victims).collect();
    nodes.into_iter().zip(1..).collect()
}

fn slice(chart: &Chart<'_>, segment: &Segment, process: u32) -> Value {
    json!({
        "ph": "X", "name": segment.job.job.to_string(), "cat": "job", "pid": process,
        "tid": thread(segment.device), "ts": microseconds(chart, segment.started_at),
        "dur": segment.ended_at.since(segment.started_at).as_secs_f64() * 1e6,
        "args": {
            "job": segment.job.job.to_string(),
            "attempt": segment.job.attempt.to_string(),
            "app": chart.app_name(segment.job.job.app),
            "outcome": segment.outcome,
            "migration": segment.migration,
            "scheduled_us": microseconds(chart, segment.scheduled_at),
            "staged_us": microseconds(chart, segment.staged_at),
            "device_time_us": segment.device_time_ns as f64 / 1e3,
        },
    })
}

fn microseconds(chart: &Chart<'_>, at: Instant) -> f64 {
    chart.at_s(at) * 1e6
}

/// Thread 0 stands for the process.
fn thread(device: DeviceIndex) -> u32 {
    u32::from(device.0) + 1
}

fn device_name(chart: &Chart<'_>, node: NodeId, device: DeviceIndex) -> String {
    let name = chart.node(node).and_then(|node| node.devices.get(usize::from(device.0)));
    name.map_or_else(|| device.to_string(), |name| format!("{} {name}", device.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::timeline::samples::{segment, timeline};

    #[test]
    fn a_steal_is_an_arrow_from_the_victim_to_the_slice() {
        let global = Some(Migration::Global { node: NodeId(1), device: DeviceIndex(1) });
        let timeline = timeline("w", vec![segment(1, 0, 0, None), segment(2, 1, 1, global)]);
        let document = trace(&Chart::new(&timeline));
        let events = document["traceEvents"].as_array().unwrap();
        let of = |phase: &str| events.iter().filter(|event| event["ph"] == phase).collect::<Vec<_>>();
        assert_eq!((of("M").len(), of("X").len(), of("s").len(), of("f").len()), (6, 2, 1, 1));
        assert_eq!((&of("s")[0]["pid"], &of("s")[0]["tid"]), (&json!(1), &json!(2)), "from the victim");
        assert_eq!(of("f")[0]["ts"], of("X")[1]["ts"], "to the start of the stolen one");
        assert_eq!(of("X")[1]["args"]["job"], "1/0/1");
    }

    #[test]
    fn nodes_of_any_id_have_numbers_that_viewers_take() {
        let far = 123_572_252_124_905_473;
        let global = Some(Migration::Global { node: NodeId(far + 1), device: DeviceIndex(0) });
        let timeline = timeline("w", vec![segment(far, 0, 0, global)]);
        let document = trace(&Chart::new(&timeline));
        let events = document["traceEvents"].as_array().unwrap();
        let of = |phase: &str| &events.iter().find(|event| event["ph"] == phase).unwrap()["pid"];
        // After those of the farm's own two nodes.
        assert_eq!((of("X"), of("s"), of("f")), (&json!(3), &json!(4), &json!(3)));
    }
}
