//! The node's task allocations and modules: in memory for jobs and for who fetches here, on disk over restarts where there
//! is a cache folder. It owns both and the fetches on their way; where to fetch from is the machine's to say.

mod disk;
mod memory;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeSet, HashMap},
    io,
    path::Path,
};

use bytes::Bytes;
use farm_core::{id::ContentHash, message::CacheFigures, program::Content, worker::Event};
use proto::link::{Arrived, ContentBytes, ContentSource};
use tokio::sync::mpsc;

pub(crate) use self::memory::Shelf;
use self::{
    disk::{DiskCache, Folder},
    memory::MemoryCache,
};
use crate::{driver::Input, link::Source};

/// Most bytes that broken off fetches leave in memory; those of a further one come again from the start.
const MAX_ARRIVED_BYTES: u64 = 4 << 30;

/// Names of contents whose digests are kept beyond those that jobs need.
const MAX_NAMES: usize = 65_536;

/// What is kept, and what is on its way.
#[derive(Debug)]
pub(crate) struct Contents {
    /// What the bytes of those contents have as their digest that jobs need, or needed lately, and that are not called by it.
    digests: HashMap<ContentHash, ContentHash>,
    /// When they are many: [`MAX_NAMES`], or twice those that were needed last.
    most_names: usize,
    /// Whether names are digests.
    open: bool,
    memory: MemoryCache,
    disk: Option<DiskCache>,
    /// Fetches on the way, and whether the machine still waits for them.
    fetching: HashMap<ContentHash, bool>,
    /// What fetches that broke off left of contents that jobs still need: the next one goes on from there.
    arrived: HashMap<ContentHash, Arrived>,
    figures: CacheFigures,
    /// What the machine was told last.
    told: CacheFigures,
}

/// What became of a fetch.
#[derive(Debug)]
pub(crate) struct Fetched {
    /// The bytes, checked; or why there are none, for people.
    result: Result<ContentBytes, String>,
    /// What is right of it, if there is an error.
    arrived: Arrived,
    /// From the disk, not from elsewhere.
    from_disk: bool,
    /// The disk did not have what it should.
    disk_failed: bool,
}

impl Contents {
    /// Opens the cache folder, if there is one; in an open farm contents are called by their digests. Blocks.
    ///
    /// # Errors
    /// The folder cannot be used.
    pub(crate) fn open(memory_cap_bytes: u64, disk: Option<(&Path, u64)>, open: bool) -> io::Result<Self> {
        let disk = disk.map(|(folder, cap_bytes)| DiskCache::open(folder, cap_bytes)).transpose()?;
        Ok(Self {
            digests: HashMap::new(),
            most_names: MAX_NAMES,
            open,
            memory: MemoryCache::new(memory_cap_bytes),
            disk,
            fetching: HashMap::new(),
            arrived: HashMap::new(),
            figures: CacheFigures::default(),
            told: CacheFigures::default(),
        })
    }

    /// Where executors read what jobs on them need: all of it is in memory.
    pub(crate) const fn shelf(&self) -> &Shelf {
        self.memory.shelf()
    }

    /// What other nodes fetch from here.
    pub(crate) fn source(&self) -> ContentSource {
        let shelf = self.shelf().clone();
        let source = ContentSource::new(move |hash| shelf.get(&hash));
        let open = self.open;
        match self.disk.as_ref().map(DiskCache::folder) {
            // Who asks for it knows its digest in any case.
            Some(folder) => source.or_stored(move |name| folder.read(&name, open.then_some(name)).ok()),
            None => source,
        }
    }

    /// Jobs call bytes with this digest by that name. Names that no job needs are forgotten when they become many.
    pub(crate) fn is_called(
        &mut self,
        digest: ContentHash,
        name: ContentHash,
        is_needed: impl Fn(&ContentHash) -> bool,
    ) {
        if self.digests.len() >= self.most_names {
            self.digests.retain(|name, _| is_needed(name));
            self.most_names = MAX_NAMES.max(2 * self.digests.len());
        }
        self.digests.insert(name, digest);
    }

    /// The digest of a content that jobs need, or needed lately.
    pub(crate) fn digest_of(&self, name: ContentHash) -> ContentHash {
        self.digests.get(&name).copied().unwrap_or(name)
    }

    /// What earlier processes left on disk.
    pub(crate) fn on_disk(&self) -> Vec<Content> {
        self.disk.iter().flat_map(DiskCache::contents).collect()
    }

    /// Pins a content that a job needs; false if it is not in memory.
    pub(crate) fn pin(&mut self, content: Content) -> bool {
        let here = self.memory.pin(content);
        self.figures.memory_hits += u64::from(here);
        here
    }

    /// Brings a content here, from the disk if it is there, else from a peer; the outcome comes as an [`Input::Fetched`].
    /// One that is on its way already is not fetched twice.
    pub(crate) fn fetch(&mut self, content: Content, from: Source, inputs: mpsc::Sender<Input>) {
        if self.fetching.insert(content.hash, true).is_some() {
            return;
        }
        let disk = self.disk.as_ref().filter(|disk| disk.has(&content.hash)).map(DiskCache::folder);
        let mut arrived = self.arrived.remove(&content.hash).unwrap_or_default();
        let wanted = Content { hash: self.digest_of(content.hash), ..content };
        tokio::spawn(async move {
            let stored = match &disk {
                Some(folder) => read(folder.clone(), content.hash, wanted).await,
                None => None,
            };
            let (from_disk, disk_failed) = (stored.is_some(), disk.is_some() && stored.is_none());
            let result = match stored {
                Some(bytes) => Ok(bytes),
                None => from.fetch(content.hash, wanted, &mut arrived).await,
            };
            let fetched = Fetched { result, arrived, from_disk, disk_failed };
            // Without a driver the worker has ended.
            let _ = inputs.send(Input::Fetched { content, fetched }).await;
        });
    }

    /// A fetch is through: what the machine has to hear of it.
    pub(crate) fn fetched(
        &mut self,
        content: Content,
        fetched: Fetched,
        inputs: &mpsc::Sender<Input>,
    ) -> Vec<Event> {
        let hash = content.hash;
        let wanted = self.fetching.remove(&hash).unwrap_or(false);
        let mut events = Vec::new();
        if fetched.disk_failed
            && self.disk.as_mut().is_some_and(|disk| disk.forget(&hash))
            && !self.memory.has(&hash)
        {
            events.push(Event::ContentsEvicted(vec![hash]));
        }
        let failure = match fetched.result {
            Ok(bytes) => {
                if fetched.from_disk {
                    self.figures.disk_hits += 1;
                } else {
                    self.figures.fetches += 1;
                    self.figures.fetched_bytes += content.size_bytes;
                }
                let gone = self.keep(content, bytes.bytes(), fetched.from_disk, inputs);
                events.extend(evicted(gone.into_iter().filter(|hash| !self.memory.has(hash)).collect()));
                self.take_in(hash, bytes, &mut events)
            }
            Err(reason) => {
                if wanted && fetched.arrived.size_bytes() + self.arrived_bytes() <= MAX_ARRIVED_BYTES {
                    self.arrived.insert(hash, fetched.arrived);
                }
                Some(reason)
            }
        };
        match (wanted, failure) {
            (true, None) => events.push(Event::ContentReady(hash)),
            (true, Some(reason)) => events.push(Event::ContentFailed { content: hash, reason }),
            (false, _) => self.memory.release(hash),
        }
        events
    }

    /// No job needs a content any more.
    pub(crate) fn release(&mut self, hash: ContentHash) {
        self.memory.release(hash);
        self.arrived.remove(&hash);
        if let Some(wanted) = self.fetching.get_mut(&hash) {
            *wanted = false;
        }
    }

    /// A content has been written to disk, or could not be.
    pub(crate) fn stored(&mut self, content: Content, result: io::Result<()>) {
        let Some(disk) = &mut self.disk else { return };
        disk.written(content, result.is_ok());
        if let Err(error) = result {
            tracing::warn!(content = %content.hash, %error, "a content cannot be kept on disk");
        }
    }

    /// Drops contents that no job needs, all such if none is named: what the machine has to hear of it.
    pub(crate) fn evict(&mut self, named: &[ContentHash]) -> Vec<Event> {
        let named: BTreeSet<ContentHash> = named.iter().copied().collect();
        let is_named = |hash: &ContentHash| named.is_empty() || named.contains(hash);
        let mut gone = Vec::new();
        self.memory.evict(is_named, |hash| gone.push(hash));
        if let Some(disk) = &mut self.disk {
            let unneeded: Vec<ContentHash> = disk
                .contents()
                .map(|content| content.hash)
                .filter(|hash| is_named(hash) && !self.memory.has(hash) && !self.fetching.contains_key(hash))
                .collect();
            for hash in &unneeded {
                disk.forget(hash);
            }
            gone.extend(&unneeded);
            remove(disk.folder(), unneeded);
        }
        gone.sort_unstable();
        gone.dedup();
        evicted(gone)
    }

    /// The figures, if they are others than those given last.
    pub(crate) fn news(&mut self) -> Option<CacheFigures> {
        let (memory_contents, memory_bytes) = self.memory.figures();
        let (disk_contents, disk_bytes) = self.disk.as_ref().map_or((0, 0), DiskCache::figures);
        let now = CacheFigures { memory_contents, memory_bytes, disk_contents, disk_bytes, ..self.figures };
        (std::mem::replace(&mut self.told, now) != now).then_some(now)
    }

    fn arrived_bytes(&self) -> u64 {
        self.arrived.values().map(Arrived::size_bytes).sum()
    }

    /// Puts bytes into memory, pinned; the reason, for people, if there is no room.
    fn take_in(&mut self, name: ContentHash, bytes: ContentBytes, events: &mut Vec<Event>) -> Option<String> {
        let Self { memory, disk, figures, .. } = self;
        let mut gone = Vec::new();
        let taken = memory.insert(name, bytes, |hash| gone.push(hash));
        figures.memory_evictions += gone.len() as u64;
        gone.retain(|hash| disk.as_ref().is_none_or(|disk| !disk.has(hash)));
        events.extend(evicted(gone));
        taken.err().map(|full| {
            format!(
                "the content cache of {} B is full of contents in use ({} B)",
                full.cap_bytes, full.pinned_bytes
            )
        })
    }

    /// Keeps a content on disk, if it is to be; the outcome comes as an [`Input::Stored`]. Gives what went from there for it.
    fn keep(
        &mut self,
        content: Content,
        bytes: &Bytes,
        from_disk: bool,
        inputs: &mpsc::Sender<Input>,
    ) -> Vec<ContentHash> {
        let Some(disk) = &mut self.disk else { return Vec::new() };
        if from_disk {
            disk.touch(&content.hash);
            return Vec::new();
        }
        let Some(gone) = disk.make_way(&content) else { return Vec::new() };
        self.figures.disk_evictions += gone.len() as u64;
        let (folder, bytes, inputs, gone_first) =
            (disk.folder(), bytes.clone(), inputs.clone(), gone.clone());
        tokio::spawn(async move {
            let write = move || {
                gone_first.iter().for_each(|hash| folder.remove(hash));
                folder.write(&content.hash, &bytes)
            };
            let result = tokio::task::spawn_blocking(write).await;
            let result = result.unwrap_or_else(|error| Err(io::Error::other(error)));
            let _ = inputs.send(Input::Stored { content, result }).await;
        });
        gone
    }
}

/// What the machine hears of contents that are gone.
fn evicted(gone: Vec<ContentHash>) -> Vec<Event> {
    if gone.is_empty() { Vec::new() } else { vec![Event::ContentsEvicted(gone)] }
}

/// Reads a content from disk; `None` if it is not what it should be.
async fn read(folder: Folder, name: ContentHash, content: Content) -> Option<ContentBytes> {
    let read = tokio::task::spawn_blocking(move || folder.read(&name, Some(content.hash))).await.ok()?;
    match read {
        Ok(bytes) if bytes.len() as u64 == content.size_bytes => Some(bytes),
        // Its digest is right: the application is mistaken, and is told when it is asked.
        Ok(_) => None,
        Err(error) => {
            tracing::warn!(content = %content.hash, %error, "a cached content is fetched again");
            None
        }
    }
}

/// Removes files on a thread that may block.
fn remove(folder: Folder, gone: Vec<ContentHash>) {
    if !gone.is_empty() {
        tokio::task::spawn_blocking(move || gone.iter().for_each(|hash| folder.remove(hash)));
    }
}
