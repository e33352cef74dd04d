//! Results whose acknowledgement waits until the application has put them where a crash does not reach. It never decides whether
//! a result counts.

use super::{Ledger, nodes::NodeLife};
use crate::{
    id::{ContentHash, JobAttempt, JobKey, TaskId},
    message::ResultHeader,
};

/// A delivered result that its node still keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Unkept {
    life: NodeLife,
    job: JobAttempt,
    digest: ContentHash,
}

impl Ledger {
    /// From now on results of the task are acknowledged when they are kept.
    pub(super) fn journalled(&mut self, task: TaskId) {
        self.journalled.insert(task);
    }

    /// A delivered result is safe: its node may forget it.
    pub(super) fn kept(&mut self, key: JobKey) {
        if let Some(Unkept { life, job, digest }) = self.unkept.remove(&key) {
            self.acknowledge(life, job, digest);
        }
    }

    /// Acknowledges a result that is delivered now, or has that wait.
    pub(super) fn acknowledge_delivered(&mut self, life: NodeLife, job: JobAttempt, digest: ContentHash) {
        let key = JobKey::of(job.job);
        if self.journalled.contains(&key.task) {
            self.unkept.insert(key, Unkept { life, job, digest });
        } else {
            self.acknowledge(life, job, digest);
        }
    }

    /// Whether this is a repetition (on a new link, say) of a result that was delivered and is not kept yet.
    pub(super) fn waits_to_be_kept(&self, header: &ResultHeader) -> bool {
        self.unkept.get(&JobKey::of(header.job.job)).is_some_and(|unkept| unkept.job == header.job)
    }

    /// The results that a node still keeps.
    pub(super) fn unkept_on(&self, life: NodeLife) -> impl Iterator<Item = JobAttempt> {
        self.unkept.values().filter(move |unkept| unkept.life == life).map(|unkept| unkept.job)
    }

    /// The task is over: nobody will ask for its results again.
    pub(super) fn keep_no_longer(&mut self, task: TaskId) {
        self.journalled.remove(&task);
        let keys: Vec<JobKey> = self.unkept.range(JobKey::range_of(task)).map(|(&key, _)| key).collect();
        keys.into_iter().for_each(|key| self.kept(key));
    }

    pub(super) fn check_unkept(&self) {
        for key in self.unkept.keys() {
            assert!(self.over.contains(key), "I1: {key} was not delivered and waits to be kept");
            assert!(self.journalled.contains(&key.task), "I8: {key} waits to be kept by nobody");
        }
    }
}
