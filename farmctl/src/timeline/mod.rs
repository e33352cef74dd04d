//! What ran when and where, as pictures and tables. Every output is a function of a [`Timeline`].

pub(crate) mod perfetto;
pub(crate) mod summary;
pub(crate) mod svg;

use std::collections::BTreeMap;

use farm_core::{
    coordinator::timeline::{Segment, Timeline, TimelineNode},
    id::{AppId, DeviceIndex, NodeId},
    time::Instant,
};

/// The rows of a picture, the span it shows, and names.
pub(crate) struct Chart<'a> {
    /// What is drawn.
    pub timeline: &'a Timeline,
    /// A row for each device, grouped by node.
    pub rows: BTreeMap<(NodeId, DeviceIndex), usize>,
    /// The first thing that happened.
    pub begin: Instant,
    /// The last thing that happened.
    pub end: Instant,
}

impl<'a> Chart<'a> {
    /// Lays a timeline out.
    pub(crate) fn new(timeline: &'a Timeline) -> Self {
        let announced =
            timeline.head.nodes.iter().flat_map(|node| {
                (0_u16..).zip(&node.devices).map(|(index, _)| (node.node, DeviceIndex(index)))
            });
        let used = timeline.segments.iter().map(|segment| (segment.node, segment.device));
        let mut rows: BTreeMap<_, usize> = announced.chain(used).map(|device| (device, 0)).collect();
        for (index, row) in rows.values_mut().enumerate() {
            *row = index;
        }
        let first = |segment: &Segment| segment.scheduled_at.min(segment.started_at);
        let begin = timeline.segments.iter().map(first).min().unwrap_or_default();
        let end = timeline.segments.iter().map(|segment| segment.ended_at).max().unwrap_or_default();
        Self { timeline, rows, begin, end: end.max(begin) }
    }

    /// From the first to the last event, in seconds.
    pub(crate) fn span_s(&self) -> f64 {
        self.end.since(self.begin).as_secs_f64()
    }

    /// Seconds since the first event.
    pub(crate) fn at_s(&self, at: Instant) -> f64 {
        at.since(self.begin).as_secs_f64()
    }

    /// Part of the devices' time in which a job was on them.
    pub(crate) fn utilisation(&self) -> f64 {
        let busy: f64 = self.timeline.segments.iter().map(busy_s).sum();
        let offered = self.span_s() * self.rows.len() as f64;
        if offered > 0.0 { busy / offered } else { 0.0 }
    }

    /// What a node is called.
    pub(crate) fn node_name(&self, id: NodeId) -> String {
        match self.node(id) {
            Some(node) if !node.name.is_empty() => node.name.clone(),
            Some(_) | None => id.to_string(),
        }
    }

    /// What an application is called.
    pub(crate) fn app_name(&self, id: AppId) -> String {
        let named = self.timeline.head.apps.iter().find(|app| app.app == id && !app.name.is_empty());
        named.map_or_else(|| id.to_string(), |app| format!("{id} ({})", app.name))
    }

    /// The applications drawn, by id.
    pub(crate) fn apps(&self) -> Vec<AppId> {
        let mut apps: Vec<AppId> = self.timeline.segments.iter().map(|segment| segment.job.job.app).collect();
        apps.sort_unstable();
        apps.dedup();
        apps
    }

    fn node(&self, id: NodeId) -> Option<&TimelineNode> {
        self.timeline.head.nodes.iter().find(|node| node.node == id)
    }
}

/// How long a segment was on its device, in seconds.
pub(crate) fn busy_s(segment: &Segment) -> f64 {
    segment.ended_at.since(segment.started_at).as_secs_f64()
}

/// Segments for the tests of every output.
#[cfg(test)]
pub(crate) mod samples {
    use farm_core::{
        coordinator::timeline::{Migration, Outcome, TimelineApp, TimelineHead},
        id::{Attempt, Epoch, JobAttempt, JobId, JobIndex, TaskId},
    };

    use super::*;

    /// A job of 50 ms as the `index`th on its device.
    pub(crate) fn segment(node: u64, device: u16, index: u32, migration: Option<Migration>) -> Segment {
        let job = JobId { app: AppId(1), task: TaskId(0), index: JobIndex(index) };
        let ms = |ms: u64| Instant(ms * 1_000_000);
        let start = 1_000 + 50 * u64::from(index);
        Segment {
            job: JobAttempt { job, attempt: Attempt { epoch: Epoch(1), sequence: index.into() } },
            node: NodeId(node),
            device: DeviceIndex(device),
            scheduled_at: ms(1_000),
            staged_at: ms(start),
            started_at: ms(start),
            ended_at: ms(start + 49),
            device_time_ns: 49_000_000,
            outcome: Outcome::Completed,
            migration,
        }
    }

    /// A farm of two nodes with two devices each, called `name`, and these segments.
    pub(crate) fn timeline(name: &str, segments: Vec<Segment>) -> Timeline {
        let node = |id| TimelineNode {
            node: NodeId(id),
            name: format!("{name}{id}"),
            devices: vec![name.to_owned(), name.to_owned()],
        };
        let count = segments.len() as u64;
        let app = TimelineApp { app: AppId(1), name: name.to_owned(), tasks: vec![(TaskId(0), count)] };
        let head = TimelineHead { nodes: vec![node(1), node(2)], apps: vec![app], ..TimelineHead::default() };
        Timeline { head, segments }
    }
}
