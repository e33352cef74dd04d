//! What an executor process holds, how far each job is, and whose fault it is when the process dies. No process and no
//! clock in here: the same events at the same times give the same answers.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use farm_core::{id::JobAttempt, message::JobFailure};

use super::Order;

/// How long a job may take beyond its limit. The executor itself ends the job at its limit and gives a submit that is
/// on the way two seconds; this is for one that cannot do even that.
const GRACE: Duration = Duration::from_millis(2_500);
/// How long compiling and uploading may keep the device's thread from ending the job that runs. A path tracer's kernels take
/// some ten seconds on the slowest driver known.
const COMPILING: Duration = Duration::from_secs(20);
/// How long compiling and uploading may take at all.
const PREPARATION_LIMIT: Duration = Duration::from_secs(120);

/// The jobs of one executor process.
#[derive(Debug)]
pub(super) struct Book {
    /// In order of arrival; at most what an executor takes.
    held: VecDeque<Held>,
    /// A job that may have taken the last process down while it was prepared: it is tried with nothing beside it.
    suspect: Option<JobAttempt>,
    /// When the process said something last.
    heard: Instant,
}

#[derive(Debug)]
struct Held {
    order: Order,
    stage: Stage,
    /// The process was told to give it up.
    aborted: bool,
}

#[derive(Clone, Copy, Debug)]
enum Stage {
    /// Not with the process yet.
    Waiting,
    /// With the process, staged or about to be prepared.
    Sent,
    /// Being compiled and uploaded.
    Preparing { since: Instant },
    /// On the device; `ran` before.
    Running { since: Instant, ran: Duration },
    /// Made way for another one.
    Interrupted { ran: Duration },
    /// Off the device; its result is on its way.
    Ended { ran: Duration },
}

/// A job that ends with its process.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Victim {
    pub(super) job: JobAttempt,
    pub(super) device_time_ns: u64,
    pub(super) failure: JobFailure,
}

/// Where a job that is to be taken back is.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Aborted {
    /// With the process: tell it.
    There,
    /// It had not got there, and is gone.
    Here,
    /// It has ended.
    Over,
}

impl Book {
    pub(super) fn new(now: Instant) -> Self {
        Self { held: VecDeque::new(), suspect: None, heard: now }
    }

    /// A new order.
    pub(super) fn take(&mut self, order: Order) {
        self.held.push_back(Held { order, stage: Stage::Waiting, aborted: false });
    }

    /// The next order for the process; it counts as sent.
    pub(super) fn next(&mut self, now: Instant) -> Option<&Order> {
        let suspect = self.suspect;
        let next = self.held.iter_mut().find(|held| {
            matches!(held.stage, Stage::Waiting) && suspect.is_none_or(|suspect| held.order.job == suspect)
        })?;
        next.stage = Stage::Sent;
        // It has not been silent since: it had nothing to say.
        self.heard = now;
        Some(&next.order)
    }

    pub(super) fn abort(&mut self, job: JobAttempt) -> Aborted {
        let Some(held) = self.find_mut(job) else { return Aborted::Over };
        match held.stage {
            Stage::Waiting => {
                self.remove(job);
                Aborted::Here
            }
            Stage::Sent
            | Stage::Preparing { .. }
            | Stage::Running { .. }
            | Stage::Interrupted { .. }
            | Stage::Ended { .. } => {
                held.aborted = true;
                Aborted::There
            }
        }
    }

    pub(super) fn preparing(&mut self, now: Instant, job: JobAttempt) {
        self.heard = now;
        self.set(job, Stage::Preparing { since: now });
    }

    pub(super) fn prepared(&mut self, now: Instant, job: JobAttempt) {
        self.heard = now;
        self.cleared(job);
        self.set(job, Stage::Sent);
    }

    /// It runs, for the first time or again.
    pub(super) fn runs(&mut self, now: Instant, job: JobAttempt) {
        self.heard = now;
        self.cleared(job);
        let ran = self.find(job).map_or(Duration::ZERO, |held| held.ran(now));
        self.set(job, Stage::Running { since: now, ran });
    }

    pub(super) fn yielded(&mut self, now: Instant, job: JobAttempt) {
        self.heard = now;
        let ran = self.find(job).map_or(Duration::ZERO, |held| held.ran(now));
        self.set(job, Stage::Interrupted { ran });
    }

    /// It has left the device, and its result comes. If the process dies before that it starts over, and is not to blame.
    pub(super) fn ended(&mut self, now: Instant, job: JobAttempt) {
        self.heard = now;
        let ran = self.find(job).map_or(Duration::ZERO, |held| held.ran(now));
        self.set(job, Stage::Ended { ran });
    }

    /// It is over; false if it was not here.
    pub(super) fn finished(&mut self, now: Instant, job: JobAttempt) -> bool {
        self.heard = now;
        self.remove(job)
    }

    /// When the process counts as hung, if nothing is heard before.
    pub(super) fn deadline(&self) -> Option<Instant> {
        self.held.iter().filter_map(|held| self.deadline_of(held)).min()
    }

    /// The process is gone, whether by itself or because it was hung: who ends with it. All others start over.
    pub(super) fn lost(&mut self, now: Instant, reason: &str) -> Vec<Victim> {
        let overdue: Vec<JobAttempt> = self.those(|held| self.deadline_of(held).is_some_and(|at| at <= now));
        let on_device = |held: &Held| matches!(held.stage, Stage::Running { .. } | Stage::Interrupted { .. });
        let mut victims = self.those(on_device);
        let idle = victims.is_empty();
        self.suspect = None;
        // At most one is prepared. With nothing on the device it was this one; else it is one of two.
        for job in self.those(|held| matches!(held.stage, Stage::Preparing { .. })) {
            if idle || overdue.contains(&job) {
                victims.push(job);
            } else {
                self.suspect = Some(job);
            }
        }
        // It was never taken up, the first of them at least.
        let stuck = self.those(|held| matches!(held.stage, Stage::Sent)).into_iter();
        victims.extend(stuck.filter(|job| overdue.contains(job)).take(usize::from(victims.is_empty())));
        // Nobody wants them any more: they do not start over.
        let given_up = self.those(|held| held.aborted);
        self.suspect.take_if(|suspect| given_up.contains(suspect));
        victims.extend(given_up.iter().copied().filter(|job| !victims.contains(job)).collect::<Vec<_>>());
        let victims: Vec<Victim> = victims
            .into_iter()
            .filter_map(|job| {
                let held = self.find(job)?;
                let failure = if held.aborted {
                    JobFailure::Cancelled
                } else if overdue.contains(&job) {
                    JobFailure::Timeout
                } else {
                    JobFailure::DeviceLost(reason.to_owned())
                };
                let device_time_ns = u64::try_from(held.ran(now).as_nanos()).unwrap_or(u64::MAX);
                Some(Victim { job, device_time_ns, failure })
            })
            .collect();
        for Victim { job, .. } in &victims {
            self.remove(*job);
        }
        for held in &mut self.held {
            held.stage = Stage::Waiting;
        }
        self.heard = now;
        victims
    }

    /// Everything that is held, which is over: there will be no further process.
    pub(super) fn clear(&mut self) -> Vec<JobAttempt> {
        self.suspect = None;
        self.held.drain(..).map(|held| held.order.job).collect()
    }

    fn deadline_of(&self, held: &Held) -> Option<Instant> {
        match held.stage {
            Stage::Preparing { since } => Some(since + PREPARATION_LIMIT),
            Stage::Running { since, ran } => {
                let due = since + held.order.limit.saturating_sub(ran);
                let compiled = self.preparing_since().map_or(due, |since| since + COMPILING);
                Some(due.max(self.heard).max(compiled) + GRACE)
            }
            // Behind another one it may wait as long as that takes.
            Stage::Sent | Stage::Interrupted { .. } | Stage::Ended { .. } if !self.is_at_work() => {
                Some(self.heard + PREPARATION_LIMIT)
            }
            Stage::Sent | Stage::Waiting | Stage::Interrupted { .. } | Stage::Ended { .. } => None,
        }
    }

    fn is_at_work(&self) -> bool {
        self.held.iter().any(|held| matches!(held.stage, Stage::Running { .. } | Stage::Preparing { .. }))
    }

    fn preparing_since(&self) -> Option<Instant> {
        self.held.iter().find_map(|held| match held.stage {
            Stage::Preparing { since } => Some(since),
            Stage::Waiting
            | Stage::Sent
            | Stage::Running { .. }
            | Stage::Interrupted { .. }
            | Stage::Ended { .. } => None,
        })
    }

    /// The job has come further than where a suspect falls.
    fn cleared(&mut self, job: JobAttempt) {
        self.suspect.take_if(|suspect| *suspect == job);
    }

    fn those(&self, wanted: impl Fn(&Held) -> bool) -> Vec<JobAttempt> {
        self.held.iter().filter(|held| wanted(held)).map(|held| held.order.job).collect()
    }

    fn find(&self, job: JobAttempt) -> Option<&Held> {
        self.held.iter().find(|held| held.order.job == job)
    }

    fn find_mut(&mut self, job: JobAttempt) -> Option<&mut Held> {
        self.held.iter_mut().find(|held| held.order.job == job)
    }

    fn set(&mut self, job: JobAttempt, stage: Stage) {
        if let Some(held) = self.find_mut(job) {
            held.stage = stage;
        }
    }

    fn remove(&mut self, job: JobAttempt) -> bool {
        self.cleared(job);
        let position = self.held.iter().position(|held| held.order.job == job);
        position.is_some_and(|position| self.held.remove(position).is_some())
    }
}

impl Held {
    /// How long it has been on the device.
    fn ran(&self, now: Instant) -> Duration {
        match self.stage {
            Stage::Waiting | Stage::Sent | Stage::Preparing { .. } => Duration::ZERO,
            Stage::Running { since, ran } => ran + now.saturating_duration_since(since),
            Stage::Interrupted { ran } | Stage::Ended { ran } => ran,
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use farm_core::{
        id::{AppId, Attempt, Epoch, JobId, JobIndex, TaskId},
        message::LatencyClass,
    };
    use proto::trust::Scope;

    use super::*;
    use crate::programs::Program;

    const LIMIT: Duration = Duration::from_secs(10);

    fn job(index: u32) -> JobAttempt {
        let job = JobId { app: AppId(1), task: TaskId(1), index: JobIndex(index) };
        JobAttempt { job, attempt: Attempt { epoch: Epoch(1), sequence: 1 } }
    }

    /// A book in which jobs 0, 1, ... were taken and sent.
    fn sent(now: Instant, jobs: u32) -> Book {
        let mut book = Book::new(now);
        for index in 0..jobs {
            let class = LatencyClass::Batch;
            let program = Program { bytes: Bytes::new(), scope: Scope::OPEN };
            book.take(Order { job: job(index), class, program, limit: LIMIT });
        }
        for index in 0..jobs {
            assert_eq!(next(&mut book, now), Some(job(index)), "in the order of arrival");
        }
        assert_eq!(next(&mut book, now), None, "each once");
        book
    }

    fn next(book: &mut Book, now: Instant) -> Option<JobAttempt> {
        book.next(now).map(|order| order.job)
    }

    fn crashed(job: JobAttempt, device_time_ns: u64) -> Victim {
        Victim { job, device_time_ns, failure: JobFailure::DeviceLost("crash".to_owned()) }
    }

    #[test]
    fn a_crash_costs_what_was_on_the_device_and_the_rest_starts_over() {
        let start = Instant::now();
        let mut book = sent(start, 3);
        book.preparing(start, job(0));
        book.runs(start, job(0));
        book.yielded(start + Duration::from_secs(1), job(0));
        book.runs(start + Duration::from_secs(1), job(1));
        let victims = book.lost(start + Duration::from_secs(3), "crash");
        assert_eq!(victims, [crashed(job(0), 1_000_000_000), crashed(job(1), 2_000_000_000)]);
        assert_eq!(next(&mut book, start), Some(job(2)));
        assert_eq!(next(&mut book, start), None);
    }

    /// Found by reading: a result that was still being written cost its finished job an attempt.
    #[test]
    fn who_has_left_the_device_starts_over_without_blame() {
        let start = Instant::now();
        let mut book = sent(start, 3);
        book.runs(start, job(0));
        book.ended(start + Duration::from_secs(1), job(0));
        book.runs(start + Duration::from_secs(1), job(1));
        assert_eq!(book.lost(start + Duration::from_secs(2), "crash"), [crashed(job(1), 1_000_000_000)]);
        assert_eq!(next(&mut book, start), Some(job(0)));
        assert_eq!(next(&mut book, start), Some(job(2)));
    }

    #[test]
    fn who_crashes_it_with_nothing_on_the_device_was_being_prepared() {
        let start = Instant::now();
        let mut book = sent(start, 2);
        book.preparing(start, job(0));
        assert_eq!(book.lost(start, "crash"), [crashed(job(0), 0)]);
        assert_eq!(next(&mut book, start), Some(job(1)));
    }

    #[test]
    fn one_that_was_prepared_beside_a_running_one_is_tried_alone() {
        let start = Instant::now();
        let mut book = sent(start, 3);
        book.runs(start, job(0));
        book.preparing(start, job(2));
        assert_eq!(book.lost(start, "crash"), [crashed(job(0), 0)]);
        assert_eq!(next(&mut book, start), Some(job(2)), "alone");
        assert_eq!(next(&mut book, start), None, "nothing goes with it");
        book.preparing(start, job(2));
        let mut innocent = book.lost(start, "crash");
        assert_eq!(innocent.pop(), Some(crashed(job(2), 0)), "it was this one");
        assert_eq!((innocent.len(), next(&mut book, start)), (0, Some(job(1))));
    }

    #[test]
    fn a_suspect_is_cleared_when_it_starts_ends_or_is_taken_back() {
        let clear: [fn(&mut Book, Instant); 3] = [
            |book, now| {
                next(book, now);
                book.runs(now, job(1));
            },
            |book, now| {
                next(book, now);
                assert!(book.finished(now, job(1)), "it was here");
            },
            |book, _| assert_eq!(book.abort(job(1)), Aborted::Here, "it had not been sent again"),
        ];
        for clear in clear {
            let start = Instant::now();
            let mut book = sent(start, 3);
            book.runs(start, job(0));
            book.preparing(start, job(1));
            book.lost(start, "crash");
            clear(&mut book, start);
            assert_eq!(next(&mut book, start), Some(job(2)), "the others go on");
        }
    }

    #[test]
    fn a_job_beyond_its_limit_times_out_and_interruptions_do_not_count() {
        let start = Instant::now();
        let at = |seconds| start + Duration::from_secs(seconds);
        let mut book = sent(start, 2);
        book.runs(start, job(0));
        assert_eq!(book.deadline(), Some(at(10) + GRACE));
        book.yielded(at(4), job(0));
        book.runs(at(4), job(1));
        assert!(book.finished(at(100), job(1)), "it was here");
        book.runs(at(100), job(0));
        assert_eq!(book.deadline(), Some(at(106) + GRACE), "four of its ten seconds are used");
        let victims = book.lost(at(106) + GRACE, "hung");
        assert_eq!(victims[0].failure, JobFailure::Timeout);
    }

    fn timed_out(job: JobAttempt) -> Victim {
        Victim { job, device_time_ns: 0, failure: JobFailure::Timeout }
    }

    #[test]
    fn a_job_that_is_never_taken_up_or_never_prepared_times_out_too() {
        let start = Instant::now();
        let later = start + PREPARATION_LIMIT;
        let mut book = sent(start, 2);
        assert_eq!(book.deadline(), Some(later), "nothing is heard of the first");
        assert_eq!(book.lost(later, "hung"), [timed_out(job(0))], "the second may be innocent");
        let mut book = sent(start, 2);
        book.preparing(start, job(1));
        assert_eq!(book.deadline(), Some(later));
        assert_eq!(book.lost(later, "hung"), [timed_out(job(1))]);
    }

    /// Found by reading: the first order after two idle minutes was taken for two minutes of silence.
    #[test]
    fn a_process_without_a_job_is_not_silent() {
        let start = Instant::now();
        let later = start + Duration::from_secs(600);
        let mut book = sent(later, 1);
        book.heard = start;
        assert!(book.finished(start, job(0)), "it was here");
        book.take(sent(start, 1).held.remove(0).expect("one").order);
        assert_eq!(next(&mut book, later), Some(job(0)));
        assert_eq!(book.deadline(), Some(later + PREPARATION_LIMIT));
    }

    /// Found by reading: a job that was staged for long counted as being prepared for long, and as a suspect.
    #[test]
    fn a_staged_job_is_neither_late_nor_a_suspect() {
        let start = Instant::now();
        let at = |seconds| start + Duration::from_secs(seconds);
        let mut book = sent(start, 2);
        book.runs(start, job(0));
        book.preparing(start, job(1));
        assert_eq!(book.deadline(), Some(start + COMPILING + GRACE), "the thread compiles: the limit waits");
        book.prepared(at(60), job(1));
        assert_eq!(book.deadline(), Some(at(60) + GRACE), "the running one is over its limit");
        assert!(book.finished(at(60), job(0)), "the process ends it itself, and then is lost");
        assert_eq!(book.lost(at(60), "hung"), [], "the staged one is nobody's victim");
        assert_eq!(next(&mut book, at(60)), Some(job(1)));
    }

    /// Found by reading: a job that was taken back before its process died ran to its end in the next one.
    #[test]
    fn what_was_taken_back_does_not_start_over() {
        let start = Instant::now();
        let mut book = sent(start, 3);
        book.runs(start, job(0));
        book.preparing(start, job(1));
        for index in 0..3 {
            assert_eq!(book.abort(job(index)), Aborted::There);
        }
        let victims: Vec<JobFailure> =
            book.lost(start, "crash").into_iter().map(|victim| victim.failure).collect();
        assert_eq!(victims, vec![JobFailure::Cancelled; 3]);
        assert_eq!((next(&mut book, start), book.abort(job(1))), (None, Aborted::Over));
    }
}
