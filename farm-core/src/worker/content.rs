//! Contents that held jobs name: which are here, which are on their way, who waits for them. Bytes are the driver's.

use std::{collections::BTreeSet, time::Duration};

use super::{Effect, WorkerMachine, job::HeldState};
use crate::{
    id::{ContentHash, JobAttempt, LinkId},
    message::JobFailure,
    program::Content,
    time::Instant,
};

/// Most fetches of one content that may fail in a row before the jobs that wait for it fail.
const MAX_FETCH_TRIES: u32 = 3;

/// Pause before a failed fetch is tried again, in milliseconds: long enough to learn that the link closed, which is the
/// usual reason and no reason to give up.
const REFETCH_MS: u64 = 100;

/// A content that some held, unexecuted job names.
#[derive(Debug)]
pub(super) struct Holding {
    content: Content,
    pub(super) state: ContentState,
    /// Jobs that name it.
    pub(super) references: usize,
    /// Jobs that wait for it.
    waiting: BTreeSet<JobAttempt>,
    failed_tries: u32,
}

/// Where a content is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ContentState {
    /// In the node's cache.
    Ready,
    /// Asked for on this link.
    Fetching(LinkId),
    /// To be asked for: no link yet, or the last try failed.
    Wanted,
}

impl WorkerMachine {
    /// Counts a new job's contents. Returns how many are not here.
    pub(super) fn hold_contents(&mut self, link: LinkId, job: JobAttempt, contents: &[Content]) -> usize {
        let mut missing = 0;
        for &content in contents {
            let holding = self.contents.entry(content.hash).or_insert_with(|| {
                self.effects.push_back(Effect::Fetch { content, link });
                let state = ContentState::Fetching(link);
                Holding { content, state, references: 0, waiting: BTreeSet::new(), failed_tries: 0 }
            });
            holding.references += 1;
            // Nobody with a link waited for it; this job's application has one.
            if holding.state == ContentState::Wanted {
                holding.state = ContentState::Fetching(link);
                self.effects.push_back(Effect::Fetch { content, link });
            }
            if holding.state != ContentState::Ready {
                holding.waiting.insert(job);
                missing += 1;
            }
        }
        missing
    }

    pub(super) fn release_contents(&mut self, job: JobAttempt, contents: &[Content]) {
        for content in contents {
            let Some(holding) = self.contents.get_mut(&content.hash) else { continue };
            holding.references -= 1;
            holding.waiting.remove(&job);
            if holding.references == 0 {
                self.contents.remove(&content.hash);
                self.push(Effect::Release(content.hash));
            }
        }
    }

    pub(super) fn content_ready(&mut self, hash: ContentHash) {
        let Some(holding) = self.contents.get_mut(&hash) else { return };
        holding.state = ContentState::Ready;
        holding.failed_tries = 0;
        for job in std::mem::take(&mut holding.waiting) {
            let Some(held) = self.jobs.get_mut(&job.job).filter(|held| held.attempt == job.attempt) else {
                continue;
            };
            let HeldState::Fetching { missing } = &mut held.state else { continue };
            *missing -= 1;
            if *missing == 0 {
                self.enqueue(job.job);
            }
        }
    }

    pub(super) fn content_failed(&mut self, now: Instant, hash: ContentHash, reason: &str) {
        let Some(holding) = self.contents.get_mut(&hash) else { return };
        match holding.state {
            ContentState::Fetching(_) => {}
            // It came in another way, or the link's end was told first.
            ContentState::Ready | ContentState::Wanted => return,
        }
        tracing::warn!(content = %hash, reason, "fetch failed");
        holding.state = ContentState::Wanted;
        holding.failed_tries += 1;
        if holding.failed_tries < MAX_FETCH_TRIES {
            self.refetch_soon(now);
            return;
        }
        holding.failed_tries = 0;
        for job in std::mem::take(&mut holding.waiting) {
            let Some(device) =
                self.jobs.get(&job.job).filter(|held| held.attempt == job.attempt).map(|held| held.device)
            else {
                continue;
            };
            self.drop_job(job);
            self.report_failure(now, job, device, JobFailure::ContentUnavailable(hash));
        }
    }

    /// What was on its way on a closed link is not.
    pub(super) fn link_fetches_nothing(&mut self, now: Instant, link: LinkId) {
        let mut any = false;
        for holding in
            self.contents.values_mut().filter(|holding| holding.state == ContentState::Fetching(link))
        {
            holding.state = ContentState::Wanted;
            any = true;
        }
        // Another application with a link may have the same content.
        if any {
            self.refetch_soon(now);
        }
    }

    /// Asks for what is wanted on the links that are there.
    pub(super) fn fetch_wanted(&mut self) {
        for holding in self.contents.values_mut().filter(|holding| holding.state == ContentState::Wanted) {
            let link = holding
                .waiting
                .iter()
                .filter(|job| self.jobs.contains_key(&job.job))
                .find_map(|job| self.apps.get(&job.job.app).and_then(|app| app.link));
            if let Some(link) = link {
                holding.state = ContentState::Fetching(link);
                self.effects.push_back(Effect::Fetch { content: holding.content, link });
            }
        }
    }

    pub(super) fn content_timeout(&mut self, now: Instant) {
        if self.refetch_at.take_if(|at| *at <= now).is_some() {
            self.fetch_wanted();
        }
    }

    fn refetch_soon(&mut self, now: Instant) {
        let at = now.after(Duration::from_millis(REFETCH_MS));
        self.refetch_at = Some(self.refetch_at.map_or(at, |earlier| earlier.min(at)));
    }
}
