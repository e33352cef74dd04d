//! Contents that held jobs name: which are here, which are on their way and from where, who waits for them. Bytes are the
//! driver's.
//!
//! Small contents come from the application at once. Of large ones the coordinator is asked where they should come from: a
//! node that has them, or the application.

use std::{
    collections::{BTreeMap, BTreeSet, btree_map::Entry},
    time::Duration,
};

use super::{Effect, Provider, WorkerMachine, job::HeldState};
use crate::{
    id::{ContentHash, JobAttempt, LinkId},
    message::{Contact, JobFailure, NodeToCoordinator},
    program::Content,
    time::Instant,
};

/// Most fetches of one content that may fail in a row before the jobs that wait for it fail.
const MAX_FETCH_TRIES: u32 = 3;

/// Pause before a failed fetch is tried again, in milliseconds: long enough to learn that the link closed, which is the
/// usual reason and no reason to give up.
const REFETCH_MS: u64 = 100;

/// Contents told of in one message.
const MAX_TOLD: usize = 1_024;

/// Contents from this size on are asked for at the coordinator, in bytes: what its answer takes is lost in their transfer.
const LARGE_BYTES: u64 = 1 << 20;

/// Longest wait for the coordinator's answer, in milliseconds; then the application is asked.
const LOCATED_MS: u64 = 60_000;

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
    /// Asked for on this application's link.
    Fetching(LinkId),
    /// Asked for at another node.
    FetchingFromPeer,
    /// The coordinator was asked where to fetch it; until then an answer is awaited.
    Locating {
        /// Then the application is asked.
        until: Instant,
    },
    /// To be asked for: no link yet, or the last try failed.
    Wanted,
}

/// A job names a content by another size than other jobs do: one of them is wrong, and must not spoil it for the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Misnamed {
    /// It is here: this job is wrong.
    Certainly(Content),
    /// It is not here yet.
    Perhaps,
}

/// Those of which the coordinator is told.
pub(super) fn large(contents: &[Content]) -> BTreeMap<ContentHash, u64> {
    let large = contents.iter().filter(|content| content.size_bytes >= LARGE_BYTES);
    large.map(|content| (content.hash, content.size_bytes)).collect()
}

impl WorkerMachine {
    /// The first of a new job's contents that others know by another size.
    pub(super) fn misnamed(&self, contents: &[Content]) -> Option<Misnamed> {
        contents.iter().find_map(|content| {
            let holding = self.contents.get(&content.hash).filter(|holding| holding.content != *content)?;
            let here = holding.state == ContentState::Ready;
            Some(if here { Misnamed::Certainly(*content) } else { Misnamed::Perhaps })
        })
    }

    /// Whether a job that is here names this content.
    #[must_use]
    pub fn needs(&self, content: &ContentHash) -> bool {
        self.contents.contains_key(content)
    }

    /// Counts a new job's contents. Returns how many are not here.
    pub(super) fn hold_contents(
        &mut self,
        now: Instant,
        link: LinkId,
        job: JobAttempt,
        contents: &[Content],
    ) -> usize {
        let mut missing = 0;
        for &content in contents {
            if let Entry::Vacant(place) = self.contents.entry(content.hash) {
                let state = ContentState::Wanted;
                place.insert(Holding {
                    content,
                    state,
                    references: 0,
                    waiting: BTreeSet::new(),
                    failed_tries: 0,
                });
                if self.may_be_located(&content) {
                    self.ask_where(now, content);
                }
            }
            let Some(holding) = self.contents.get_mut(&content.hash) else { continue };
            holding.references += 1;
            // Nobody with a link waited for it; this job's application has one.
            if holding.state == ContentState::Wanted {
                holding.state = ContentState::Fetching(link);
                self.effects.push_back(Effect::Fetch { content, from: Provider::Application(link) });
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
                let state = holding.state;
                self.contents.remove(&content.hash);
                self.push(Effect::Release(content.hash));
                // The coordinator need not wait for it to arrive here.
                if state != ContentState::Ready && content.size_bytes >= LARGE_BYTES {
                    self.tell_cache_changed(Vec::new(), vec![content.hash]);
                }
            }
        }
    }

    pub(super) fn content_ready(&mut self, hash: ContentHash) {
        let Some(holding) = self.contents.get_mut(&hash) else { return };
        holding.state = ContentState::Ready;
        holding.failed_tries = 0;
        let content = holding.content;
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
        if content.size_bytes >= LARGE_BYTES && self.cached.insert(hash, content.size_bytes).is_none() {
            self.tell_cache_changed(vec![content], Vec::new());
        }
    }

    pub(super) fn contents_evicted(&mut self, mut gone: Vec<ContentHash>) {
        gone.retain(|hash| self.cached.remove(hash).is_some());
        for gone in gone.chunks(MAX_TOLD) {
            self.tell_cache_changed(Vec::new(), gone.to_vec());
        }
    }

    /// The coordinator's word on where to fetch a content.
    pub(super) fn located(&mut self, hash: ContentHash, peer: Option<Contact>) {
        let Some(holding) = self.contents.get_mut(&hash) else { return };
        match holding.state {
            ContentState::Locating { .. } => {}
            // It is here, or was not waited for.
            ContentState::Ready
            | ContentState::Fetching(_)
            | ContentState::FetchingFromPeer
            | ContentState::Wanted => return,
        }
        match peer {
            Some(contact) => {
                holding.state = ContentState::FetchingFromPeer;
                let content = holding.content;
                self.push(Effect::Fetch { content, from: Provider::Node(contact) });
            }
            None => {
                holding.state = ContentState::Wanted;
                self.fetch_wanted();
                if self.contents.get(&hash).is_some_and(|holding| holding.state == ContentState::Wanted) {
                    self.not_on_its_way(hash);
                }
            }
        }
    }

    /// Without a coordinator nobody says where contents are but their applications.
    pub(super) fn locate_nothing(&mut self) {
        self.located_by = None;
        for holding in self.contents.values_mut() {
            if let ContentState::Locating { .. } = holding.state {
                holding.state = ContentState::Wanted;
            }
        }
        self.fetch_wanted();
    }

    /// Registered (again): the coordinator need not know what is here.
    pub(super) fn tell_cache(&mut self) {
        let held: Vec<Content> =
            self.cached.iter().map(|(&hash, &size_bytes)| Content { hash, size_bytes }).collect();
        for held in held.chunks(MAX_TOLD) {
            self.tell_cache_changed(held.to_vec(), Vec::new());
        }
    }

    fn may_be_located(&self, content: &Content) -> bool {
        content.size_bytes >= LARGE_BYTES
            && self.session.is_registered()
            && !self.cached.contains_key(&content.hash)
    }

    fn ask_where(&mut self, now: Instant, content: Content) {
        let until = now.after(Duration::from_millis(LOCATED_MS));
        let Some(holding) = self.contents.get_mut(&content.hash) else { return };
        holding.state = ContentState::Locating { until };
        self.located_by.get_or_insert(until);
        self.tell_coordinator(NodeToCoordinator::Locate(content));
    }

    /// A large content does not come from the application for now: nobody else should wait for it to arrive here. Later tries
    /// ask nobody.
    fn not_on_its_way(&mut self, hash: ContentHash) {
        let large = self.contents.get(&hash).is_some_and(|holding| holding.content.size_bytes >= LARGE_BYTES);
        if large {
            self.tell_cache_changed(Vec::new(), vec![hash]);
        }
    }

    fn tell_cache_changed(&mut self, held: Vec<Content>, gone: Vec<ContentHash>) {
        if self.session.is_registered() {
            self.tell_coordinator(NodeToCoordinator::CacheChanged { held, gone });
        }
    }

    pub(super) fn content_failed(&mut self, now: Instant, hash: ContentHash, reason: &str) {
        let Some(holding) = self.contents.get_mut(&hash) else { return };
        let content = holding.content;
        match holding.state {
            ContentState::Fetching(_) => {}
            ContentState::FetchingFromPeer => {
                tracing::info!(content = %hash, reason, "a peer could not be fetched from");
                holding.state = ContentState::Wanted;
                if self.may_be_located(&content) {
                    self.ask_where(now, content);
                } else {
                    self.fetch_wanted();
                }
                return;
            }
            // It came in another way, or the link's end was told first.
            ContentState::Ready | ContentState::Wanted | ContentState::Locating { .. } => return,
        }
        tracing::warn!(content = %hash, reason, "fetch failed");
        holding.state = ContentState::Wanted;
        holding.failed_tries += 1;
        let goes_on = holding.failed_tries < MAX_FETCH_TRIES;
        self.not_on_its_way(hash);
        if goes_on {
            self.refetch_soon(now);
            return;
        }
        let Some(holding) = self.contents.get_mut(&hash) else { return };
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
        let mut lost = Vec::new();
        for (&hash, holding) in
            self.contents.iter_mut().filter(|(_, holding)| holding.state == ContentState::Fetching(link))
        {
            holding.state = ContentState::Wanted;
            lost.push(hash);
        }
        // Another application with a link may have the same content.
        if !lost.is_empty() {
            self.refetch_soon(now);
        }
        lost.into_iter().for_each(|hash| self.not_on_its_way(hash));
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
                let from = Provider::Application(link);
                self.effects.push_back(Effect::Fetch { content: holding.content, from });
            }
        }
    }

    pub(super) fn content_timeout(&mut self, now: Instant) {
        let mut late = self.refetch_at.take_if(|at| *at <= now).is_some();
        if self.located_by.take_if(|at| *at <= now).is_some() {
            late = true;
            for holding in self.contents.values_mut() {
                let ContentState::Locating { until } = holding.state else { continue };
                if until <= now {
                    holding.state = ContentState::Wanted;
                } else {
                    self.located_by = Some(self.located_by.map_or(until, |by| by.min(until)));
                }
            }
        }
        if late {
            self.fetch_wanted();
        }
    }

    fn refetch_soon(&mut self, now: Instant) {
        let at = now.after(Duration::from_millis(REFETCH_MS));
        self.refetch_at = Some(self.refetch_at.map_or(at, |earlier| earlier.min(at)));
    }
}
