//! Results until their applications acknowledge them: in memory, and beyond its room on disk, the oldest first.
//!
//! Files have no names: whatever ends the process, nothing is left of them. One file holds many small results, and its room
//! is free again when the last of them is acknowledged.

use std::{
    collections::{BTreeMap, HashMap},
    fs::File,
    io::{self, Write as _},
    os::unix::fs::FileExt as _,
    path::PathBuf,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use bytes::Bytes;
use farm_core::id::{ContentHash, JobAttempt};
use proto::codec::content_hash;
use tokio::sync::mpsc;

use crate::{
    device::{Payload, size_of},
    driver::Input,
};

/// Results are written to one file until it holds this many bytes.
const FILE_BYTES: u64 = 64 << 20;
/// And this share of the memory's room at a time.
const SPILLED_SHARE: u64 = 4;
/// How long a disk that did not take a result is left alone.
const DISK_REST: Duration = Duration::from_secs(10);
/// While the disk takes results, memory may hold this many times its room.
const MEMORY_EXCESS: u64 = 2;

/// Bounds of a spool.
#[derive(Clone, Debug)]
pub(crate) struct SpoolRoom {
    /// Bytes of results in memory.
    pub(crate) memory_bytes: u64,
    /// Where further ones go, and bytes of files there.
    pub(crate) disk: Option<(PathBuf, u64)>,
}

/// The results.
///
/// A lock, not messages to an owner: links take results when their turn comes, the disk when it has written some, each on
/// threads of their own, and the machine's driver puts them in without waiting. Held for a few map operations.
#[derive(Clone, Debug)]
pub(crate) struct Spool {
    room: Arc<SpoolRoom>,
    state: Arc<Mutex<State>>,
    /// Hears when the disk took results, or did not.
    inputs: mpsc::Sender<Input>,
}

#[derive(Debug, Default)]
struct State {
    results: HashMap<JobAttempt, Held>,
    /// Results in memory, by age.
    in_memory: BTreeMap<u64, JobAttempt>,
    memory_bytes: u64,
    /// Of all files.
    disk_bytes: Arc<AtomicU64>,
    next_serial: u64,
    spilling: bool,
    /// When the disk failed last.
    disk_failed: Option<Instant>,
    /// What the driver was told last.
    told_full: bool,
}

#[derive(Debug)]
enum Held {
    Memory { serial: u64, payload: Payload },
    Disk { file: Arc<SpoolFile>, offset: u64, lengths: Vec<usize>, digest: ContentHash },
}

/// A file without a name.
#[derive(Debug)]
struct SpoolFile {
    file: File,
    bytes: u64,
    disk_bytes: Arc<AtomicU64>,
}

impl Drop for SpoolFile {
    fn drop(&mut self) {
        self.disk_bytes.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

impl Spool {
    pub(crate) fn new(room: SpoolRoom, inputs: mpsc::Sender<Input>) -> Self {
        Self { room: Arc::new(room), state: Arc::default(), inputs }
    }

    /// Keeps a result.
    pub(crate) fn keep(&self, job: JobAttempt, payload: Payload) {
        let mut state = self.state();
        state.forget(job);
        let serial = state.next_serial;
        state.next_serial += 1;
        state.memory_bytes += size_of(&payload.sections);
        state.in_memory.insert(serial, job);
        state.results.insert(job, Held::Memory { serial, payload });
        self.spill_if_needed(&mut state);
    }

    /// A result, if it is in memory.
    pub(crate) fn at_hand(&self, job: JobAttempt) -> Option<Vec<Bytes>> {
        match self.state().results.get(&job) {
            Some(Held::Memory { payload, .. }) => Some(payload.sections.clone()),
            Some(Held::Disk { .. }) | None => None,
        }
    }

    /// A result, wherever it is; `None` once it is discarded.
    ///
    /// # Errors
    /// The disk does not give it back.
    pub(crate) async fn read(&self, job: JobAttempt) -> io::Result<Option<Vec<Bytes>>> {
        let (file, offset, lengths, digest) = match self.state().results.get(&job) {
            None => return Ok(None),
            Some(Held::Memory { payload, .. }) => return Ok(Some(payload.sections.clone())),
            Some(Held::Disk { file, offset, lengths, digest }) => {
                (Arc::clone(file), *offset, lengths.clone(), *digest)
            }
        };
        let reading = tokio::task::spawn_blocking(move || {
            let mut bytes = vec![0; lengths.iter().sum()];
            file.file.read_exact_at(&mut bytes, offset)?;
            if content_hash(&bytes) != digest {
                return Err(io::Error::new(io::ErrorKind::InvalidData, "the disk gave other bytes back"));
            }
            let mut rest = Bytes::from(bytes);
            Ok(Some(lengths.iter().map(|length| rest.split_to(*length)).collect()))
        });
        reading.await.unwrap_or_else(|error| Err(io::Error::other(error)))
    }

    /// It was acknowledged, or is not wanted any more.
    pub(crate) fn discard(&self, job: JobAttempt) {
        self.state().forget(job);
    }

    /// Whether no more results should be made, if that changed. Looks whether the disk takes results again, too.
    pub(crate) fn news(&self) -> Option<bool> {
        let mut state = self.state();
        self.spill_if_needed(&mut state);
        let room = self.room.memory_bytes;
        let most = if self.disk_takes(&state) { room.saturating_mul(MEMORY_EXCESS) } else { room };
        let full = state.memory_bytes > most;
        (std::mem::replace(&mut state.told_full, full) != full).then_some(full)
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn disk_takes(&self, state: &State) -> bool {
        self.disk_room_bytes(state) > 0 && state.disk_failed.is_none_or(|failed| failed.elapsed() > DISK_REST)
    }

    fn disk_room_bytes(&self, state: &State) -> u64 {
        let cap_bytes = self.room.disk.as_ref().map_or(0, |(_, cap_bytes)| *cap_bytes);
        cap_bytes.saturating_sub(state.disk_bytes.load(Ordering::Relaxed))
    }

    fn spill_if_needed(&self, state: &mut State) {
        if state.memory_bytes > self.room.memory_bytes && !state.spilling && self.disk_takes(state) {
            state.spilling = true;
            let spool = self.clone();
            tokio::task::spawn_blocking(move || spool.spill());
        }
    }

    /// Writes the oldest results to disk until the others fit into memory. Blocks.
    fn spill(&self) {
        while let Some(oldest) = self.next_to_spill() {
            let written = self.write(&oldest);
            let mut state = self.state();
            match written {
                Ok(file) => state.spilled(oldest, &Arc::new(file)),
                Err(error) => {
                    tracing::warn!(%error, "results cannot be kept on disk; they stay in memory, and no more are made than it holds");
                    state.disk_failed = Some(Instant::now());
                }
            }
            drop(state);
            // Without a driver the worker has ended.
            let _ = self.inputs.blocking_send(Input::SpoolChanged);
        }
    }

    /// A file full of the oldest results in memory; none if there is room, or the disk takes none.
    fn next_to_spill(&self) -> Option<Vec<(JobAttempt, Payload)>> {
        let mut state = self.state();
        if !self.disk_takes(&state) {
            state.spilling = false;
            return None;
        }
        // With some more than the excess: a file each for the next small results would be many files.
        let mut excess = match state.memory_bytes.saturating_sub(self.room.memory_bytes) {
            0 => 0,
            excess => excess + self.room.memory_bytes / SPILLED_SHARE,
        };
        let most = FILE_BYTES.min(self.disk_room_bytes(&state));
        let mut file_bytes = 0;
        let mut oldest = Vec::new();
        for job in state.in_memory.values() {
            let Some(Held::Memory { payload, .. }) = state.results.get(job) else { continue };
            let size_bytes = size_of(&payload.sections);
            // One goes whatever its size.
            if excess == 0 || (file_bytes > 0 && file_bytes + size_bytes > most) {
                break;
            }
            excess = excess.saturating_sub(size_bytes);
            file_bytes += size_bytes;
            oldest.push((*job, payload.clone()));
        }
        state.spilling = !oldest.is_empty();
        state.spilling.then_some(oldest)
    }

    /// The results in one file.
    fn write(&self, results: &[(JobAttempt, Payload)]) -> io::Result<SpoolFile> {
        let (folder, _) = self.room.disk.as_ref().ok_or_else(|| io::Error::other("there is no folder"))?;
        let mut file = tempfile::tempfile_in(folder)?;
        let mut bytes = 0;
        for (_, Payload { sections, .. }) in results {
            sections.iter().try_for_each(|section| file.write_all(section))?;
            bytes += size_of(sections);
        }
        let disk_bytes = Arc::clone(&self.state().disk_bytes);
        disk_bytes.fetch_add(bytes, Ordering::Relaxed);
        Ok(SpoolFile { file, bytes, disk_bytes })
    }
}

impl State {
    fn forget(&mut self, job: JobAttempt) {
        if let Some(Held::Memory { serial, payload }) = self.results.remove(&job) {
            self.in_memory.remove(&serial);
            self.memory_bytes -= size_of(&payload.sections);
        }
    }

    /// These are on disk now; those that were acknowledged meanwhile need no place.
    fn spilled(&mut self, results: Vec<(JobAttempt, Payload)>, file: &Arc<SpoolFile>) {
        let mut offset = 0;
        for (job, Payload { sections, digest }) in results {
            let size_bytes = size_of(&sections);
            if self.results.contains_key(&job) {
                self.forget(job);
                let lengths = sections.iter().map(Bytes::len).collect();
                self.results.insert(job, Held::Disk { file: Arc::clone(file), offset, lengths, digest });
            }
            offset += size_bytes;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use farm_core::id::{AppId, Attempt, Epoch, JobId, JobIndex, TaskId};

    use super::*;

    fn job(index: u32) -> JobAttempt {
        let job = JobId { app: AppId(1), task: TaskId(0), index: JobIndex(index) };
        JobAttempt { job, attempt: Attempt { epoch: Epoch(1), sequence: 1 } }
    }

    fn result(index: u32) -> Vec<Bytes> {
        let tag = u8::try_from(index).unwrap();
        vec![Bytes::from(vec![tag; 30]), Bytes::new(), Bytes::from(vec![tag + 100; 10])]
    }

    fn spool(memory_bytes: u64, disk: Option<(&Path, u64)>) -> (Spool, mpsc::Receiver<Input>) {
        let (inputs, received) = mpsc::channel(64);
        let disk = disk.map(|(folder, cap_bytes)| (folder.to_owned(), cap_bytes));
        (Spool::new(SpoolRoom { memory_bytes, disk }, inputs), received)
    }

    async fn spilled(received: &mut mpsc::Receiver<Input>) {
        assert!(matches!(received.recv().await, Some(Input::SpoolChanged)), "only that is sent here");
    }

    #[tokio::test]
    async fn what_memory_does_not_hold_goes_to_disk_and_comes_back() {
        let folder = tempfile::tempdir().unwrap();
        let (spool, mut received) = spool(100, Some((folder.path(), 1_000)));
        for index in 0..3 {
            spool.keep(job(index), Payload::of(result(index)));
        }
        spilled(&mut received).await;
        assert_eq!(spool.at_hand(job(0)), None, "the oldest is on disk");
        assert_eq!(spool.at_hand(job(2)), Some(result(2)));
        for index in 0..3 {
            assert_eq!(spool.read(job(index)).await.unwrap(), Some(result(index)), "{index}");
        }
        assert_eq!(spool.news(), None, "there is room");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "files have no names");
        for index in 0..3 {
            spool.discard(job(index));
            assert_eq!(spool.read(job(index)).await.unwrap(), None, "{index} is gone");
        }
        let state = spool.state();
        assert_eq!((state.memory_bytes, state.disk_bytes.load(Ordering::Relaxed)), (0, 0));
        assert!(state.results.is_empty() && state.in_memory.is_empty(), "nothing stays behind");
    }

    #[tokio::test]
    async fn other_bytes_from_the_disk_are_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let (spool, mut received) = spool(0, Some((folder.path(), 1_000)));
        spool.keep(job(0), Payload::of(result(0)));
        spilled(&mut received).await;
        match spool.state().results.get(&job(0)) {
            Some(Held::Disk { file, .. }) => file.file.write_all_at(b"x", 5).unwrap(),
            held => panic!("it is on disk: {held:?}"),
        }
        assert_eq!(spool.read(job(0)).await.unwrap_err().kind(), io::ErrorKind::InvalidData);
    }

    #[tokio::test]
    async fn small_results_share_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let (spool, mut received) = spool(400, Some((folder.path(), 10_000)));
        (0..11).for_each(|index| spool.keep(job(index), Payload::of(result(index))));
        spilled(&mut received).await;
        let state = spool.state();
        let on_disk = state.results.values().filter(|held| matches!(held, Held::Disk { .. })).count();
        assert!(on_disk >= 3, "a quarter of the room besides the excess of one: {on_disk}");
    }

    #[tokio::test]
    async fn without_a_disk_memory_is_the_bound() {
        let (spool, _received) = spool(100, None);
        spool.keep(job(0), Payload::of(result(0)));
        spool.keep(job(1), Payload::of(result(1)));
        assert_eq!(spool.news(), None, "80 B are no more than 100 B");
        spool.keep(job(2), Payload::of(result(2)));
        assert_eq!((spool.news(), spool.news()), (Some(true), None), "said once");
        spool.keep(job(2), Payload::of(result(2)));
        assert_eq!(spool.state().memory_bytes, 120, "a repetition is the same result");
        spool.discard(job(1));
        assert_eq!(spool.news(), Some(false));
    }

    #[tokio::test]
    async fn a_disk_that_takes_nothing_loses_nothing() {
        let gone = tempfile::tempdir().unwrap().path().join("gone");
        let (spool, mut received) = spool(50, Some((&gone, 1_000)));
        spool.keep(job(0), Payload::of(result(0)));
        spool.keep(job(1), Payload::of(result(1)));
        spilled(&mut received).await;
        assert_eq!(spool.news(), Some(true), "memory alone is full");
        for index in 0..2 {
            assert_eq!(spool.read(job(index)).await.unwrap(), Some(result(index)), "{index}");
        }
    }

    #[tokio::test]
    async fn the_disk_has_a_bound_too() {
        let folder = tempfile::tempdir().unwrap();
        let (spool, mut received) = spool(0, Some((folder.path(), 40)));
        spool.keep(job(0), Payload::of(result(0)));
        spilled(&mut received).await;
        spool.keep(job(1), Payload::of(result(1)));
        assert_eq!(spool.news(), Some(true), "the disk is full");
        spool.discard(job(0));
        assert_eq!(spool.news(), None, "twice the memory's room is exceeded as well");
        assert_eq!(spool.read(job(1)).await.unwrap(), Some(result(1)));
    }
}
