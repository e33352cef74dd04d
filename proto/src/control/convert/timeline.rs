//! What ran when and where: a head, and segments as columns.

use farm_core::{
    coordinator::timeline::{
        Migration, Outcome, Segment, TimelineApp, TimelineHead, TimelineNode, TimelineQuery,
    },
    id::{AppId, JobAttempt, NodeId, TaskId},
    time::Instant,
};

use super::{MAX_ENTRIES, WireError, device, invalid, list, name, required, within};
use crate::control::v1;

/// Most devices of one node, and tasks of one application, in a timeline.
const MAX_NAMES: usize = 65_536;

impl From<TimelineQuery> for v1::TimelineRequest {
    fn from(query: TimelineQuery) -> Self {
        Self {
            app: query.app.map(|app| app.0),
            task: query.task.map(|task| task.0),
            max_segments: u32::try_from(query.max_segments).unwrap_or(u32::MAX),
        }
    }
}

impl From<v1::TimelineRequest> for TimelineQuery {
    fn from(wire: v1::TimelineRequest) -> Self {
        Self {
            app: wire.app.map(AppId),
            task: wire.task.map(TaskId),
            max_segments: usize::try_from(wire.max_segments).unwrap_or(usize::MAX),
        }
    }
}

impl From<TimelineHead> for v1::TimelineHead {
    fn from(head: TimelineHead) -> Self {
        Self {
            nodes: head.nodes.into_iter().map(Into::into).collect(),
            apps: head.apps.into_iter().map(Into::into).collect(),
            dropped_segments: head.dropped_segments,
            omitted_segments: head.omitted_segments,
        }
    }
}

impl TryFrom<v1::TimelineHead> for TimelineHead {
    type Error = WireError;

    fn try_from(wire: v1::TimelineHead) -> Result<Self, WireError> {
        Ok(Self {
            nodes: list("TimelineHead.nodes", MAX_ENTRIES, wire.nodes)?,
            apps: list("TimelineHead.apps", MAX_ENTRIES, wire.apps)?,
            dropped_segments: wire.dropped_segments,
            omitted_segments: wire.omitted_segments,
        })
    }
}

impl From<TimelineNode> for v1::TimelineNode {
    fn from(node: TimelineNode) -> Self {
        Self { node: node.node.0, name: node.name, devices: node.devices }
    }
}

impl TryFrom<v1::TimelineNode> for TimelineNode {
    type Error = WireError;

    fn try_from(wire: v1::TimelineNode) -> Result<Self, WireError> {
        const DEVICES: &str = "TimelineNode.devices";
        within(DEVICES, wire.devices.len(), MAX_NAMES)?;
        Ok(Self {
            node: NodeId(wire.node),
            name: name("TimelineNode.name", wire.name)?,
            devices: wire
                .devices
                .into_iter()
                .map(|device| name(DEVICES, device))
                .collect::<Result<_, WireError>>()?,
        })
    }
}

impl From<TimelineApp> for v1::TimelineApp {
    fn from(app: TimelineApp) -> Self {
        Self {
            app: app.app.0,
            name: app.name,
            tasks: app.tasks.iter().map(|(task, _)| task.0).collect(),
            task_segments: app.tasks.iter().map(|(_, segments)| *segments).collect(),
        }
    }
}

impl TryFrom<v1::TimelineApp> for TimelineApp {
    type Error = WireError;

    fn try_from(wire: v1::TimelineApp) -> Result<Self, WireError> {
        same_length("TimelineApp.task_segments", wire.task_segments.len(), wire.tasks.len())?;
        Ok(Self {
            app: AppId(wire.app),
            name: name("TimelineApp.name", wire.name)?,
            tasks: wire.tasks.into_iter().map(TaskId).zip(wire.task_segments).collect(),
        })
    }
}

impl From<&[Segment]> for v1::TimelineSegments {
    fn from(segments: &[Segment]) -> Self {
        let jobs: Vec<JobAttempt> = segments.iter().map(|segment| segment.job).collect();
        let difference = |from: Instant, to: Instant| to.0.wrapping_sub(from.0).cast_signed();
        let mut wire = Self { jobs: Some(jobs.as_slice().into()), ..Self::default() };
        let mut before = Instant::ZERO;
        // A message holds far fewer than 2^32.
        for (position, segment) in (0_u32..).zip(segments) {
            wire.nodes.push(segment.node.0);
            wire.devices.push(segment.device.0.into());
            wire.scheduled_deltas_ns.push(difference(before, segment.scheduled_at));
            before = segment.scheduled_at;
            wire.staged_after_ns.push(difference(segment.scheduled_at, segment.staged_at));
            wire.started_after_ns.push(difference(segment.staged_at, segment.started_at));
            wire.ended_after_ns.push(difference(segment.started_at, segment.ended_at));
            wire.device_time_ns.push(segment.device_time_ns);
            match segment.outcome {
                Outcome::Completed => {}
                Outcome::Failed => wire.failed.push(position),
            }
            wire.migrations.extend(segment.migration.map(|migration| {
                let (from_node, from_device) = match migration {
                    Migration::Local { device } => (None, device),
                    Migration::Global { node, device } => (Some(node.0), device),
                };
                v1::TimelineMigration { position, from_node, from_device: from_device.0.into() }
            }));
        }
        wire
    }
}

impl TryFrom<v1::TimelineSegments> for Vec<Segment> {
    type Error = WireError;

    fn try_from(wire: v1::TimelineSegments) -> Result<Self, WireError> {
        let jobs: Vec<JobAttempt> = required("TimelineSegments.jobs", wire.jobs)?.try_into()?;
        for (field, length) in [
            ("TimelineSegments.nodes", wire.nodes.len()),
            ("TimelineSegments.devices", wire.devices.len()),
            ("TimelineSegments.scheduled_deltas_ns", wire.scheduled_deltas_ns.len()),
            ("TimelineSegments.staged_after_ns", wire.staged_after_ns.len()),
            ("TimelineSegments.started_after_ns", wire.started_after_ns.len()),
            ("TimelineSegments.ended_after_ns", wire.ended_after_ns.len()),
            ("TimelineSegments.device_time_ns", wire.device_time_ns.len()),
        ] {
            same_length(field, length, jobs.len())?;
        }
        let later = |at: Instant, difference: i64| Instant(at.0.wrapping_add_signed(difference));
        let mut failed = wire.failed.into_iter().peekable();
        let mut migrations = wire.migrations.into_iter().peekable();
        let mut segments = Self::with_capacity(jobs.len());
        let mut before = Instant::ZERO;
        for (position, job) in jobs.into_iter().enumerate() {
            let here = |named: u32| usize::try_from(named).is_ok_and(|named| named == position);
            let scheduled_at = later(before, wire.scheduled_deltas_ns[position]);
            before = scheduled_at;
            let staged_at = later(scheduled_at, wire.staged_after_ns[position]);
            let started_at = later(staged_at, wire.started_after_ns[position]);
            segments.push(Segment {
                job,
                node: NodeId(wire.nodes[position]),
                device: device("TimelineSegments.devices", wire.devices[position])?,
                scheduled_at,
                staged_at,
                started_at,
                ended_at: later(started_at, wire.ended_after_ns[position]),
                device_time_ns: wire.device_time_ns[position],
                outcome: match failed.next_if(|&named| here(named)) {
                    None => Outcome::Completed,
                    Some(_) => Outcome::Failed,
                },
                migration: migrations
                    .next_if(|migration| here(migration.position))
                    .map(migration_of)
                    .transpose()?,
            });
        }
        if let Some(stray) = failed.next() {
            return Err(invalid("TimelineSegments.failed", stray));
        }
        match migrations.next() {
            None => Ok(segments),
            Some(stray) => Err(invalid("TimelineMigration.position", stray.position)),
        }
    }
}

fn migration_of(wire: v1::TimelineMigration) -> Result<Migration, WireError> {
    let device = device("TimelineMigration.from_device", wire.from_device)?;
    Ok(match wire.from_node {
        None => Migration::Local { device },
        Some(node) => Migration::Global { node: NodeId(node), device },
    })
}

fn same_length(field: &'static str, length: usize, expected: usize) -> Result<(), WireError> {
    if length == expected {
        return Ok(());
    }
    Err(invalid(field, format!("{length} entries for {expected}")))
}
