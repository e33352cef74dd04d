//! Lists of jobs and attempts as columns of differences: a job of a plan costs about two bytes.

use std::collections::BTreeMap;

use farm_core::{
    id::{AppId, Attempt, DeviceIndex, Epoch, JobAttempt, JobId, JobIndex, NodeSession, TaskId},
    message::HeldJob,
};

use super::{MAX_JOBS, WireError, invalid, within};
use crate::control::v1;

impl From<&[JobAttempt]> for v1::Attempts {
    fn from(jobs: &[JobAttempt]) -> Self {
        let key = |job: &JobAttempt| (job.job.app, job.job.task, job.attempt.epoch);
        let runs = jobs.chunk_by(|before, after| key(before) == key(after)).map(|run| {
            let (app, task, epoch) = key(&run[0]);
            let mut index = IndexColumn::default();
            let mut sequence = SequenceColumn::default();
            v1::AttemptRun {
                app: app.0,
                task: task.0,
                epoch: epoch.0,
                index_deltas: run.iter().map(|job| index.delta(job.job.index)).collect(),
                sequence_deltas: run.iter().map(|job| sequence.delta(job.attempt.sequence)).collect(),
            }
        });
        Self { runs: runs.collect() }
    }
}

impl TryFrom<v1::Attempts> for Vec<JobAttempt> {
    type Error = WireError;

    fn try_from(wire: v1::Attempts) -> Result<Self, WireError> {
        let count = wire.runs.iter().map(|run| run.index_deltas.len()).sum();
        within("Attempts.runs", count, MAX_JOBS)?;
        let mut jobs = Self::with_capacity(count);
        for run in wire.runs {
            if run.index_deltas.len() != run.sequence_deltas.len() {
                return Err(invalid(
                    "AttemptRun.sequence_deltas",
                    format!("{} of them", run.sequence_deltas.len()),
                ));
            }
            let (app, task, epoch) = (AppId(run.app), TaskId(run.task), Epoch(run.epoch));
            let mut index = IndexColumn::default();
            let mut sequence = SequenceColumn::default();
            for (index_delta, sequence_delta) in run.index_deltas.into_iter().zip(run.sequence_deltas) {
                let index = index.next("AttemptRun.index_deltas", index_delta)?;
                let attempt = Attempt { epoch, sequence: sequence.next(sequence_delta) };
                jobs.push(JobAttempt { job: JobId { app, task, index }, attempt });
            }
        }
        Ok(jobs)
    }
}

impl From<&[JobId]> for v1::JobIds {
    fn from(jobs: &[JobId]) -> Self {
        let runs =
            jobs.chunk_by(|before, after| (before.app, before.task) == (after.app, after.task)).map(|run| {
                let mut index = IndexColumn::default();
                v1::JobRun {
                    app: run[0].app.0,
                    task: run[0].task.0,
                    index_deltas: run.iter().map(|job| index.delta(job.index)).collect(),
                }
            });
        Self { runs: runs.collect() }
    }
}

impl TryFrom<v1::JobIds> for Vec<JobId> {
    type Error = WireError;

    fn try_from(wire: v1::JobIds) -> Result<Self, WireError> {
        let count = wire.runs.iter().map(|run| run.index_deltas.len()).sum();
        within("JobIds.runs", count, MAX_JOBS)?;
        let mut jobs = Self::with_capacity(count);
        for run in wire.runs {
            let mut index = IndexColumn::default();
            for delta in run.index_deltas {
                let index = index.next("JobRun.index_deltas", delta)?;
                jobs.push(JobId { app: AppId(run.app), task: TaskId(run.task), index });
            }
        }
        Ok(jobs)
    }
}

/// A column of job indices as differences.
#[derive(Default)]
pub(super) struct IndexColumn(u32);

impl IndexColumn {
    /// What to write for the next index.
    pub(super) fn delta(&mut self, index: JobIndex) -> i64 {
        let delta = i64::from(index.0) - i64::from(self.0);
        self.0 = index.0;
        delta
    }

    /// The next index for what was read.
    pub(super) fn next(&mut self, field: &'static str, delta: i64) -> Result<JobIndex, WireError> {
        let index = i64::from(self.0).checked_add(delta).and_then(|index| u32::try_from(index).ok());
        self.0 = index.ok_or_else(|| invalid(field, delta))?;
        Ok(JobIndex(self.0))
    }
}

/// A column of attempt sequences as differences modulo 2^64.
#[derive(Default)]
struct SequenceColumn(u64);

impl SequenceColumn {
    fn delta(&mut self, sequence: u64) -> i64 {
        let delta = sequence.wrapping_sub(self.0).cast_signed();
        self.0 = sequence;
        delta
    }

    fn next(&mut self, delta: i64) -> u64 {
        self.0 = self.0.wrapping_add_signed(delta);
        self.0
    }
}

/// Grouped by device: the jobs of a request go round over all devices.
pub(super) fn held_runs(held: &[HeldJob]) -> Vec<v1::HeldRun> {
    let mut groups: BTreeMap<(NodeSession, DeviceIndex, Epoch), Vec<&HeldJob>> = BTreeMap::new();
    for job in held {
        groups.entry((job.session, job.device, job.attempt.epoch)).or_default().push(job);
    }
    let runs = groups.into_iter().map(|((session, device, epoch), jobs)| {
        let mut index = IndexColumn::default();
        let mut sequence = SequenceColumn::default();
        v1::HeldRun {
            session: session.0,
            device: u32::from(device.0),
            epoch: epoch.0,
            index_deltas: jobs.iter().map(|job| index.delta(job.index)).collect(),
            sequence_deltas: jobs.iter().map(|job| sequence.delta(job.attempt.sequence)).collect(),
        }
    });
    runs.collect()
}

pub(super) fn held(runs: Vec<v1::HeldRun>) -> Result<Vec<HeldJob>, WireError> {
    let count = runs.iter().map(|run| run.index_deltas.len()).sum();
    within("PlanRequest.held", count, MAX_JOBS)?;
    let mut held = Vec::with_capacity(count);
    for run in runs {
        if run.index_deltas.len() != run.sequence_deltas.len() {
            return Err(invalid("HeldRun.sequence_deltas", format!("{} of them", run.sequence_deltas.len())));
        }
        let device = u16::try_from(run.device).map_err(|_| invalid("HeldRun.device", run.device))?;
        let (session, device, epoch) = (NodeSession(run.session), DeviceIndex(device), Epoch(run.epoch));
        let mut index = IndexColumn::default();
        let mut sequence = SequenceColumn::default();
        for (index_delta, sequence_delta) in run.index_deltas.into_iter().zip(run.sequence_deltas) {
            let index = index.next("HeldRun.index_deltas", index_delta)?;
            let attempt = Attempt { epoch, sequence: sequence.next(sequence_delta) };
            held.push(HeldJob { index, session, device, attempt });
        }
    }
    Ok(held)
}
