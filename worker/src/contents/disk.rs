//! Contents on disk: a file each, named by its digest, below `contents/` of the cache folder. They outlive the process.
//!
//! Which files are there and which goes first is known here; the files themselves are read and written on threads that may
//! block. A file is complete when it has its name (written beside it, then renamed), and is checked against its digest when
//! it is read: what the machine's sudden end left behind is found then.

use std::{
    collections::{BTreeMap, HashMap},
    fs, io,
    path::{Path, PathBuf},
    sync::atomic::{AtomicU64, Ordering},
    time::{Duration, SystemTime},
};

use farm_core::{id::ContentHash, program::Content};
use proto::link::ContentBytes;

/// Most bytes on their way to disk: memory beyond the cache's cap. What comes faster than the disk writes is not kept there.
const MAX_WRITING_BYTES: u64 = 4 << 30;
/// Most files; the oldest go first beyond it.
const MAX_FILES: usize = 65_536;
/// An unfinished file this old was left behind by a process that is gone.
const ABANDONED_AFTER: Duration = Duration::from_secs(3_600);
/// How unfinished files are named.
const UNFINISHED: &str = ".unfinished-";

/// What is on disk.
#[derive(Debug)]
pub(super) struct DiskCache {
    folder: Folder,
    cap_bytes: u64,
    entries: HashMap<ContentHash, Entry>,
    /// By last use.
    oldest: BTreeMap<u64, ContentHash>,
    bytes: u64,
    /// On their way here: memory beyond the other cache's cap.
    writing_bytes: u64,
    uses: u64,
}

#[derive(Debug)]
struct Entry {
    size_bytes: u64,
    last_use: u64,
}

impl DiskCache {
    /// What earlier processes left in `cache`, which is made if it is not there. Blocks.
    pub(super) fn open(cache: &Path, cap_bytes: u64) -> io::Result<Self> {
        let folder = Folder(cache.join("contents"));
        fs::create_dir_all(&folder.0)?;
        let mut found = Vec::new();
        for file in fs::read_dir(&folder.0)? {
            let file = file?;
            let Ok(metadata) = file.metadata() else { continue };
            let changed = metadata.modified().unwrap_or(SystemTime::UNIX_EPOCH);
            let name = file.file_name();
            match name.to_str().and_then(hash_of) {
                Some(hash) if metadata.is_file() => {
                    found.push((changed, Content { hash, size_bytes: metadata.len() }));
                }
                Some(_) | None => {
                    let abandoned = changed.elapsed().is_ok_and(|age| age > ABANDONED_AFTER);
                    if abandoned && name.to_str().is_some_and(|name| name.starts_with(UNFINISHED)) {
                        // It will be tried again at the next start.
                        let _ = fs::remove_file(file.path());
                    }
                }
            }
        }
        found.sort_unstable_by_key(|(changed, content)| (*changed, content.hash));
        let (entries, oldest) = (HashMap::new(), BTreeMap::new());
        let mut cache = Self { folder, cap_bytes, entries, oldest, bytes: 0, writing_bytes: 0, uses: 0 };
        found.into_iter().for_each(|(_, content)| cache.book(content));
        cache.make_room(0).iter().for_each(|hash| cache.folder.remove(hash));
        Ok(cache)
    }

    /// Where the files are.
    pub(super) fn folder(&self) -> Folder {
        self.folder.clone()
    }

    /// Everything that is here, in no order.
    pub(super) fn contents(&self) -> impl Iterator<Item = Content> {
        self.entries.iter().map(|(&hash, entry)| Content { hash, size_bytes: entry.size_bytes })
    }

    /// How many are here, and their bytes.
    pub(super) fn figures(&self) -> (u64, u64) {
        (self.entries.len() as u64, self.bytes)
    }

    pub(super) fn has(&self, hash: &ContentHash) -> bool {
        self.entries.contains_key(hash)
    }

    /// Makes room for a content that is to be written, so that the cap holds while it is. Gives what has to go; the files are
    /// the caller's to remove, before it writes. `None` if it is not to be kept: it is here, is too large, or more comes than
    /// the disk writes.
    pub(super) fn make_way(&mut self, content: &Content) -> Option<Vec<ContentHash>> {
        let writing_bytes = self.writing_bytes + content.size_bytes;
        if self.has(&content.hash) || writing_bytes > self.cap_bytes.min(MAX_WRITING_BYTES) {
            return None;
        }
        let gone = self.make_room(content.size_bytes);
        self.writing_bytes = writing_bytes;
        Some(gone)
    }

    /// It is used: others go before it.
    pub(super) fn touch(&mut self, hash: &ContentHash) {
        if let Some(entry) = self.entries.get_mut(hash) {
            self.oldest.remove(&entry.last_use);
            self.uses += 1;
            entry.last_use = self.uses;
            self.oldest.insert(self.uses, *hash);
        }
    }

    /// It has been written, or could not be.
    pub(super) fn written(&mut self, content: Content, whole: bool) {
        self.writing_bytes -= content.size_bytes;
        // Two applications may have brought it.
        if whole && !self.has(&content.hash) {
            self.book(content);
        }
    }

    /// Bytes on their way here.
    #[cfg(test)]
    pub(super) fn writing_bytes(&self) -> u64 {
        self.writing_bytes
    }

    /// It is to go, or was found spoilt; true if it was here.
    pub(super) fn forget(&mut self, hash: &ContentHash) -> bool {
        let Some(entry) = self.entries.remove(hash) else { return false };
        self.oldest.remove(&entry.last_use);
        self.bytes -= entry.size_bytes;
        true
    }

    fn book(&mut self, content: Content) {
        self.uses += 1;
        self.bytes += content.size_bytes;
        self.oldest.insert(self.uses, content.hash);
        self.entries.insert(content.hash, Entry { size_bytes: content.size_bytes, last_use: self.uses });
    }

    fn make_room(&mut self, size_bytes: u64) -> Vec<ContentHash> {
        let mut gone = Vec::new();
        while self.bytes + self.writing_bytes + size_bytes > self.cap_bytes || self.entries.len() >= MAX_FILES
        {
            let Some((_, hash)) = self.oldest.first_key_value().map(|(at, hash)| (*at, *hash)) else { break };
            self.forget(&hash);
            gone.push(hash);
        }
        gone
    }
}

/// The files. Every call blocks.
#[derive(Clone, Debug)]
pub(super) struct Folder(PathBuf);

impl Folder {
    /// Reads a content and checks it, where its digest is known. One that has another is removed.
    ///
    /// # Errors
    /// It is not there, or spoilt.
    pub(super) fn read(&self, name: &ContentHash, digest: Option<ContentHash>) -> io::Result<ContentBytes> {
        let path = self.path(name);
        let bytes = ContentBytes::new(fs::read(&path)?);
        if digest.is_some_and(|digest| bytes.content().hash != digest) {
            self.remove(name);
            return Err(io::Error::new(io::ErrorKind::InvalidData, "the file is spoilt and was removed"));
        }
        // The order of use is for the next process, too; a disk that is read-only by now loses it.
        let _ = fs::File::open(&path).and_then(|file| file.set_modified(SystemTime::now()));
        Ok(bytes)
    }

    /// Writes a content under its name, whole or not at all.
    ///
    /// # Errors
    /// The disk is full, or does not take it.
    pub(super) fn write(&self, hash: &ContentHash, bytes: &[u8]) -> io::Result<()> {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        // Process ids alone repeat: in containers each is 1.
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_nanos();
        let unfinished = self.0.join(format!("{UNFINISHED}{}-{now}-{number}", std::process::id()));
        // By the same clock as reading: a file system's own lags behind it by some milliseconds.
        let written = fs::write(&unfinished, bytes)
            .and_then(|()| fs::File::open(&unfinished)?.set_modified(SystemTime::now()))
            .and_then(|()| fs::rename(&unfinished, self.path(hash)));
        if written.is_err() {
            // A full disk must not keep half a file; one that is not there is as good.
            let _ = fs::remove_file(&unfinished);
        }
        written
    }

    /// Removes a content's file, if it is there.
    pub(super) fn remove(&self, hash: &ContentHash) {
        if let Err(error) = fs::remove_file(self.path(hash))
            && error.kind() != io::ErrorKind::NotFound
        {
            tracing::warn!(content = %hash, %error, "a cached content cannot be removed from disk");
        }
    }

    fn path(&self, hash: &ContentHash) -> PathBuf {
        self.0.join(hash.to_string())
    }
}

/// The digest that a file's name is.
fn hash_of(name: &str) -> Option<ContentHash> {
    let mut hash = [0; 32];
    let digits = |byte: u8| byte.is_ascii_digit() || (b'a'..=b'f').contains(&byte);
    if name.len() != 64 || !name.bytes().all(digits) {
        return None;
    }
    for (byte, pair) in hash.iter_mut().zip(name.as_bytes().chunks_exact(2)) {
        *byte = u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok()?;
    }
    Some(ContentHash(hash))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn content(bytes: &[u8]) -> Content {
        Content { hash: ContentHash(*blake3::hash(bytes).as_bytes()), size_bytes: bytes.len() as u64 }
    }

    fn store(cache: &mut DiskCache, bytes: &[u8]) -> Vec<ContentHash> {
        let content = content(bytes);
        let gone = cache.make_way(&content).expect("it is new and fits");
        gone.iter().for_each(|hash| cache.folder().remove(hash));
        cache.folder().write(&content.hash, bytes).unwrap();
        cache.written(content, true);
        gone
    }

    #[test]
    fn contents_outlive_the_process_and_the_order_of_use_does_too() {
        let folder = tempfile::tempdir().unwrap();
        let mut cache = DiskCache::open(folder.path(), 10).unwrap();
        let (first, second) = (content(b"first"), content(b"secnd"));
        store(&mut cache, b"first");
        store(&mut cache, b"secnd");
        // File systems count time in coarse steps; what was read last is what was touched last.
        let earlier = SystemTime::now() - Duration::from_secs(60);
        for hash in [first.hash, second.hash] {
            fs::File::open(cache.folder().path(&hash)).unwrap().set_modified(earlier).unwrap();
        }
        assert_eq!(&cache.folder().read(&first.hash, Some(first.hash)).unwrap()[..], b"first");

        let mut cache = DiskCache::open(folder.path(), 10).unwrap();
        assert_eq!(cache.figures(), (2, 10));
        assert_eq!(store(&mut cache, b"third"), [second.hash], "the one that was not read goes");
        assert!(cache.has(&first.hash) && cache.figures() == (2, 10));
        let smaller = DiskCache::open(folder.path(), 5).unwrap();
        assert_eq!(
            smaller.contents().collect::<Vec<_>>(),
            [content(b"third")],
            "a smaller cap holds at once"
        );
        assert_eq!(fs::read_dir(folder.path().join("contents")).unwrap().count(), 1);
    }

    #[test]
    fn what_is_used_stays_and_what_is_too_large_is_not_wanted() {
        let folder = tempfile::tempdir().unwrap();
        let mut cache = DiskCache::open(folder.path(), 10).unwrap();
        store(&mut cache, b"first");
        store(&mut cache, b"secnd");
        cache.touch(&content(b"first").hash);
        assert_eq!(store(&mut cache, b"third"), [content(b"secnd").hash]);
        assert_eq!(cache.make_way(&content(b"eleven byte")), None, "over the cap");
        assert_eq!(cache.make_way(&content(b"third")), None, "here");
    }

    #[test]
    fn what_is_being_written_counts() {
        let folder = tempfile::tempdir().unwrap();
        let mut cache = DiskCache::open(folder.path(), 10).unwrap();
        store(&mut cache, b"first");
        assert_eq!(cache.make_way(&content(b"secnd")), Some(Vec::new()));
        assert_eq!(cache.make_way(&content(b"third")), Some(vec![content(b"first").hash]), "room for two");
        assert_eq!(cache.make_way(&content(b"fourth")), None, "both are on their way");
        cache.written(content(b"secnd"), false);
        cache.written(content(b"third"), true);
        assert_eq!(cache.figures(), (1, 5), "the disk did not take the other");
    }

    #[test]
    fn a_spoilt_file_is_found_and_removed() {
        let folder = tempfile::tempdir().unwrap();
        let mut cache = DiskCache::open(folder.path(), 100).unwrap();
        store(&mut cache, b"first");
        let hash = content(b"first").hash;
        fs::write(cache.folder().path(&hash), b"fir\0t").unwrap();
        assert_eq!(cache.folder().read(&hash, Some(hash)).unwrap_err().kind(), io::ErrorKind::InvalidData);
        assert_eq!(cache.folder().read(&hash, Some(hash)).unwrap_err().kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn files_of_others_are_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let contents = folder.path().join("contents");
        fs::create_dir_all(contents.join("ab".repeat(32))).unwrap();
        let old = contents.join(format!("{UNFINISHED}1-1"));
        let young = contents.join(format!("{UNFINISHED}1-2"));
        for path in [&old, &young, &contents.join("README"), &contents.join("AB".repeat(32))] {
            fs::write(path, b"x").unwrap();
        }
        let long_ago = SystemTime::now() - 2 * ABANDONED_AFTER;
        fs::File::open(&old).unwrap().set_modified(long_ago).unwrap();
        let cache = DiskCache::open(folder.path(), 100).unwrap();
        assert_eq!(cache.contents().count(), 0, "none of these is a content");
        assert!(!old.exists() && young.exists(), "what another process writes now is not abandoned");
        assert_eq!(fs::read_dir(&contents).unwrap().count(), 4);
    }
}
