//! What one end of a connection holds of the other's jobs, in 16 bytes: two ends compare these now and then ([`Liveness::compare_ms`](crate::message::Liveness::compare_ms)), and say all of it only
//! where they differ (20-delivery.md, "Who owns the truth").

use serde::{Deserialize, Serialize};

use crate::id::JobAttempt;

/// A set of attempts, whatever their order. Two sets that differ by chance have the same one once in 2^64 times; against
/// somebody who wants that it is no protection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Holding {
    /// How many.
    pub attempts: u64,
    /// The wrapping sum of their hashes.
    pub sum: u64,
}

impl FromIterator<JobAttempt> for Holding {
    fn from_iter<I: IntoIterator<Item = JobAttempt>>(attempts: I) -> Self {
        attempts.into_iter().fold(Self::default(), |holding, attempt| Self {
            attempts: holding.attempts + 1,
            sum: holding.sum.wrapping_add(hash(attempt)),
        })
    }
}

fn hash(JobAttempt { job, attempt }: JobAttempt) -> u64 {
    let task_and_index = (u64::from(job.task.0) << 32) | u64::from(job.index.0);
    [job.app.0, task_and_index, attempt.epoch.0.into(), attempt.sequence]
        .into_iter()
        .fold(0, |hash, word| mixed(hash ^ word))
}

/// SplitMix64's step (Steele, Lea and Flood 2014): every bit of the argument changes half of the bits of the result.
const fn mixed(word: u64) -> u64 {
    let word = word.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let word = (word ^ (word >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let word = (word ^ (word >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    word ^ (word >> 31)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::id::{AppId, Attempt, Epoch, JobId, JobIndex, TaskId};

    fn attempt(app: u64, task: u32, index: u32, epoch: u32, sequence: u64) -> JobAttempt {
        let job = JobId { app: AppId(app), task: TaskId(task), index: JobIndex(index) };
        JobAttempt { job, attempt: Attempt { epoch: Epoch(epoch), sequence } }
    }

    #[test]
    fn sets_are_told_apart_and_orders_are_not() {
        let (one, two, three) = (attempt(1, 0, 0, 1, 1), attempt(1, 0, 1, 1, 2), attempt(1, 1, 0, 1, 3));
        let holding = |attempts: &[JobAttempt]| attempts.iter().copied().collect::<Holding>();
        assert_eq!(holding(&[one, two, three]), holding(&[three, one, two]));
        assert_ne!(holding(&[one, two]), holding(&[one, three]));
        assert_ne!(holding(&[one, two]), holding(&[one]));
        assert_eq!(holding(&[]), Holding::default());
    }

    #[test]
    fn every_part_of_an_attempt_counts() {
        let mut hashes = BTreeSet::new();
        for part in 0..5 {
            for value in 1..100_u32 {
                let mut parts = [0_u32; 5];
                parts[part] = value;
                let [app, task, index, epoch, sequence] = parts;
                hashes.insert(hash(attempt(app.into(), task, index, epoch, sequence.into())));
            }
        }
        assert_eq!(hashes.len(), 5 * 99);
    }
}
