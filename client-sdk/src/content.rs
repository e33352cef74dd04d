//! Task allocations and modules by content address: what the data server answers fetches from. Never sends anything
//! itself, never holds a job allocation.

use std::{
    collections::{BTreeSet, HashMap},
    sync::{
        Arc, PoisonError, RwLock,
        atomic::{AtomicU64, Ordering},
    },
};

use bytes::Bytes;
use farm_core::{id::ContentHash, program::Content};
use proto::link::{ContentBytes, ContentSource};

/// The bytes of every live run's contents, shared between the runs that add to it and the data server that reads.
///
/// A lock, not an owner task: adding happens on preparing threads and must be visible before the first job that names
/// the content is sent; reading happens on any number of fetch streams. It is held for a map operation only, bytes
/// are reference-counted.
#[derive(Clone, Debug, Default)]
pub(crate) struct ContentStore {
    contents: Arc<RwLock<HashMap<ContentHash, Stored>>>,
    served_bytes: Arc<AtomicU64>,
}

#[derive(Debug)]
struct Stored {
    bytes: ContentBytes,
    runs: usize,
}

impl ContentStore {
    /// The bytes of a content that some live run owns.
    pub(crate) fn get(&self, hash: &ContentHash) -> Option<ContentBytes> {
        self.contents
            .read()
            .unwrap_or_else(PoisonError::into_inner)
            .get(hash)
            .map(|stored| stored.bytes.clone())
    }

    /// What nodes fetch from here.
    pub(crate) fn source(&self) -> ContentSource {
        let store = self.clone();
        ContentSource::new(move |hash| store.get(&hash)).counted_in(Arc::clone(&self.served_bytes))
    }

    /// Bytes that nodes fetched so far, those of fetches that broke off too.
    pub(crate) fn served_bytes(&self) -> u64 {
        self.served_bytes.load(Ordering::Relaxed)
    }

    fn retain(&self, bytes: ContentBytes) {
        let mut contents = self.contents.write().unwrap_or_else(PoisonError::into_inner);
        contents.entry(bytes.content().hash).or_insert(Stored { bytes, runs: 0 }).runs += 1;
    }

    fn release(&self, hash: &ContentHash) {
        let mut contents = self.contents.write().unwrap_or_else(PoisonError::into_inner);
        let last = contents.get_mut(hash).is_some_and(|stored| {
            stored.runs -= 1;
            stored.runs == 0
        });
        if last {
            contents.remove(hash);
        }
    }
}

/// Where a task puts the data that all its jobs share. What one task adds, the tasks that depend on it may name too: it
/// lives until the run ends.
#[derive(Debug)]
pub struct TaskData {
    store: ContentStore,
    added: BTreeSet<Content>,
}

impl TaskData {
    pub(crate) fn new(store: ContentStore) -> Self {
        Self { store, added: BTreeSet::new() }
    }

    /// A task allocation: read-only for kernels, fetched once by each node that runs a job naming it. Its size must be
    /// a positive multiple of 4, as for every buffer; `validate` says so when a program names it.
    pub fn allocation(&mut self, bytes: impl Into<Bytes>) -> Content {
        self.add(ContentBytes::new(bytes))
    }

    /// A module: WGSL text.
    pub fn module(&mut self, wgsl: impl Into<Bytes>) -> Content {
        self.add(ContentBytes::new(wgsl))
    }

    /// What was added here.
    pub(crate) fn added(&self) -> impl Iterator<Item = Content> {
        self.added.iter().copied()
    }

    fn add(&mut self, bytes: ContentBytes) -> Content {
        let content = bytes.content();
        if self.added.insert(content) {
            self.store.retain(bytes);
        }
        content
    }
}

impl Drop for TaskData {
    fn drop(&mut self) {
        for content in &self.added {
            self.store.release(&content.hash);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn content_lives_until_its_last_run_ends() {
        let store = ContentStore::default();
        let mut first = TaskData::new(store.clone());
        let mut second = TaskData::new(store.clone());
        let a = first.allocation(vec![1_u8; 8]);
        assert_eq!(first.allocation(vec![1_u8; 8]), a, "the same bytes have the same name");
        assert_eq!(second.module("abcdefgh").size_bytes, 8);
        assert_eq!(second.allocation(vec![1_u8; 8]), a);
        drop(first);
        assert_eq!(store.get(&a.hash).as_deref(), Some(&[1_u8; 8][..]));
        drop(second);
        assert!(store.get(&a.hash).is_none());
        assert!(store.contents.read().unwrap().is_empty(), "nothing may stay behind");
    }
}
