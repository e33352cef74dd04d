//! Task allocations and modules in memory: least recently used out, pinned ones stay. Fetches nothing itself; other nodes
//! fetch from its [`Shelf`].

use std::{
    collections::{BTreeMap, HashMap},
    sync::{Arc, PoisonError, RwLock},
};

use farm_core::{id::ContentHash, program::Content};
use proto::link::ContentBytes;

/// The bytes of the contents in memory, for whoever answers fetches.
///
/// A lock, not messages to the cache's owner: fetches are answered on any number of streams, and must not wait for the
/// machine's turn. It is held for a map operation only, bytes are reference-counted.
#[derive(Clone, Debug, Default)]
pub(crate) struct Shelf {
    bytes: Arc<RwLock<HashMap<ContentHash, ContentBytes>>>,
}

impl Shelf {
    /// The bytes of a content that is in memory.
    pub(crate) fn get(&self, hash: &ContentHash) -> Option<ContentBytes> {
        self.bytes.read().unwrap_or_else(PoisonError::into_inner).get(hash).cloned()
    }

    fn put(&self, name: ContentHash, bytes: ContentBytes) {
        self.bytes.write().unwrap_or_else(PoisonError::into_inner).insert(name, bytes);
    }

    fn take(&self, hash: &ContentHash) {
        self.bytes.write().unwrap_or_else(PoisonError::into_inner).remove(hash);
    }
}

/// The node's contents in memory.
#[derive(Debug)]
pub(super) struct MemoryCache {
    entries: HashMap<ContentHash, Entry>,
    shelf: Shelf,
    /// Unpinned entries by last use.
    idle: BTreeMap<u64, ContentHash>,
    bytes: u64,
    cap_bytes: u64,
    uses: u64,
}

#[derive(Debug)]
struct Entry {
    size_bytes: u64,
    /// When it was used last; meaningless while pinned.
    last_use: u64,
    pinned: bool,
}

/// A content does not fit beside the pinned ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct CacheFull {
    pub(super) pinned_bytes: u64,
    pub(super) cap_bytes: u64,
}

impl MemoryCache {
    pub(super) fn new(cap_bytes: u64) -> Self {
        Self {
            entries: HashMap::new(),
            shelf: Shelf::default(),
            idle: BTreeMap::new(),
            bytes: 0,
            cap_bytes,
            uses: 0,
        }
    }

    /// Keeps a content until it is released; false if it is not here, or has another size.
    pub(super) fn pin(&mut self, Content { hash, size_bytes }: Content) -> bool {
        let entry = self.entries.get_mut(&hash).filter(|entry| entry.size_bytes == size_bytes);
        let Some(entry) = entry else { return false };
        if !std::mem::replace(&mut entry.pinned, true) {
            self.idle.remove(&entry.last_use);
        }
        true
    }

    /// Lets a content be evicted when room is needed.
    pub(super) fn release(&mut self, hash: ContentHash) {
        let Some(entry) = self.entries.get_mut(&hash) else { return };
        if std::mem::replace(&mut entry.pinned, false) {
            self.uses += 1;
            entry.last_use = self.uses;
            self.idle.insert(self.uses, hash);
        }
    }

    /// Drops those that are named and not pinned; `evicted` is told of each.
    pub(super) fn evict(
        &mut self,
        is_named: impl Fn(&ContentHash) -> bool,
        mut evicted: impl FnMut(ContentHash),
    ) {
        let idle: Vec<u64> = self.idle.iter().filter(|(_, hash)| is_named(hash)).map(|(&at, _)| at).collect();
        for at in idle {
            if let Some(hash) = self.idle.remove(&at) {
                self.drop_idle(hash);
                evicted(hash);
            }
        }
    }

    /// How many are here, and their bytes.
    pub(super) fn figures(&self) -> (u64, u64) {
        (self.entries.len() as u64, self.bytes)
    }

    pub(super) fn has(&self, hash: &ContentHash) -> bool {
        self.entries.contains_key(hash)
    }

    fn drop_idle(&mut self, hash: ContentHash) {
        if let Some(entry) = self.entries.remove(&hash) {
            self.bytes -= entry.size_bytes;
            self.shelf.take(&hash);
        }
    }

    /// Where others read.
    pub(super) const fn shelf(&self) -> &Shelf {
        &self.shelf
    }

    /// Takes a content in, pinned; evicts idle ones for it, which `evicted` is told of.
    pub(super) fn insert(
        &mut self,
        hash: ContentHash,
        bytes: ContentBytes,
        mut evicted: impl FnMut(ContentHash),
    ) -> Result<(), CacheFull> {
        let size_bytes = bytes.content().size_bytes;
        if self.pin(Content { hash, size_bytes }) {
            return Ok(());
        }
        while self.bytes + size_bytes > self.cap_bytes {
            let Some((_, oldest)) = self.idle.pop_first() else {
                return Err(CacheFull { pinned_bytes: self.bytes, cap_bytes: self.cap_bytes });
            };
            self.drop_idle(oldest);
            evicted(oldest);
        }
        self.bytes += size_bytes;
        self.shelf.put(hash, bytes);
        self.entries.insert(hash, Entry { size_bytes, last_use: 0, pinned: true });
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn content(tag: u8, size_bytes: usize) -> (ContentHash, ContentBytes) {
        let bytes = ContentBytes::new(vec![tag; size_bytes]);
        (bytes.content().hash, bytes)
    }

    #[test]
    fn the_least_recently_used_idle_content_goes_first() {
        let mut cache = MemoryCache::new(100);
        let [(a, a_bytes), (b, b_bytes), (c, c_bytes)] = [content(1, 40), content(2, 40), content(3, 40)];
        let mut evicted = Vec::new();
        cache.insert(a, a_bytes, |hash| evicted.push(hash)).unwrap();
        cache.insert(b, b_bytes, |hash| evicted.push(hash)).unwrap();
        cache.release(a);
        cache.release(b);
        assert!(!cache.pin(Content { hash: a, size_bytes: 39 }), "not of this size");
        assert!(cache.pin(Content { hash: a, size_bytes: 40 }), "a is here");
        cache.release(a);
        cache.insert(c, c_bytes, |hash| evicted.push(hash)).unwrap();
        assert_eq!(evicted, [b], "whoever announces contents is told");
        assert!(cache.shelf().get(&b).is_none(), "b was used before a");
        assert!(cache.shelf().get(&a).is_some() && cache.shelf().get(&c).is_some(), "only one had to go");
    }

    #[test]
    fn pinned_contents_stay_and_the_cap_holds() {
        let mut cache = MemoryCache::new(100);
        let [(a, a_bytes), (b, b_bytes)] = [content(1, 60), content(2, 60)];
        cache.insert(a, a_bytes.clone(), drop).unwrap();
        cache.insert(a, a_bytes, drop).unwrap();
        assert_eq!(cache.bytes, 60, "the same content is held once");
        assert_eq!(
            cache.insert(b, b_bytes.clone(), drop),
            Err(CacheFull { pinned_bytes: 60, cap_bytes: 100 })
        );
        cache.release(a);
        cache.insert(b, b_bytes, drop).unwrap();
        assert!(cache.shelf().get(&a).is_none(), "the cap holds");
    }
}
