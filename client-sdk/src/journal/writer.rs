//! The thread that appends results to a journal: in groups, as many as came while the disk was busy with the ones before. Once a
//! group is on disk its results are acknowledged. It never reads.

use std::{
    fs::File,
    io::{self, BufWriter, Seek as _, SeekFrom, Write as _},
    sync::mpsc,
    thread::{self, JoinHandle},
    time::Duration,
};

use farm_core::id::{ContentHash, JobIndex, NodeId, TaskId};

use super::{
    Appendix, JournalError,
    format::{HEAD_BYTES, Head, Kind, Meta},
};
use crate::run::Payload;

/// Results that wait for the thread, at most; then the run waits. Their bytes count as not yet retrieved.
const QUEUED_RESULTS: usize = 256;
/// Results of one group, at most: the first waits for the last to be acknowledged.
const GROUP_RESULTS: usize = 256;
/// A group that has come to this many bytes is not added to.
const GROUP_BYTES: u64 = 64 << 20;
/// Results of this size and more are written as they are, smaller ones put together first, in bytes.
const BUFFER_BYTES: usize = 256 << 10;

/// Which job a result is of.
#[derive(Clone, Copy, Debug)]
pub(crate) struct About<'a> {
    /// Its task in this connection.
    pub(crate) task: TaskId,
    /// Its task in the graph.
    pub(crate) name: &'a str,
    pub(crate) index: JobIndex,
    /// Digest of its encoded program.
    pub(crate) program: ContentHash,
}

/// A result that the application has taken.
#[derive(Debug)]
pub(crate) struct Keep {
    task: TaskId,
    meta: Meta,
    payload: Payload,
}

impl Keep {
    pub(crate) fn new(
        about: About<'_>,
        sections: Vec<u64>,
        device_time: Duration,
        node: NodeId,
        payload: Payload,
    ) -> Self {
        let About { task, name, index, program } = about;
        let digest = payload.digest;
        let meta =
            Meta { task: name.to_owned(), index, program, payload: digest, sections, device_time, node };
        Self { task, meta, payload }
    }

    #[cfg(test)]
    pub(super) const fn meta(&self) -> &Meta {
        &self.meta
    }
}

/// What the thread tells.
pub(crate) trait Reports: Send + 'static {
    /// These are on disk.
    fn kept(&mut self, jobs: Vec<(TaskId, JobIndex)>);
    /// Nothing more will be.
    fn failed(&mut self, error: JournalError);
}

/// Hands results to the thread.
#[derive(Debug)]
pub(crate) struct JournalWriter {
    results: mpsc::SyncSender<Keep>,
    thread: JoinHandle<()>,
}

impl JournalWriter {
    /// # Errors
    /// There is no thread, or the file does not let itself be appended to.
    pub(crate) fn start(mut appendix: Appendix, reports: impl Reports) -> Result<Self, JournalError> {
        let (results, queue) = mpsc::sync_channel(QUEUED_RESULTS);
        let at = SeekFrom::Start(appendix.length);
        let path = appendix.path.clone();
        appendix.file.seek(at).map_err(|error| JournalError::io(&path, "appending to it", error))?;
        let thread = thread::Builder::new()
            .name("gleaner-journal".to_owned())
            .spawn(move || append(appendix, &queue, reports))
            .map_err(|error| JournalError::io(&path, "starting its thread", error))?;
        Ok(Self { results, thread })
    }

    /// Has a result kept; waits where too many do.
    pub(crate) fn keep(&self, result: Keep) {
        // A thread that is gone has told why.
        let _ = self.results.send(result);
    }

    /// Waits until what was handed over is on disk, and reported.
    pub(crate) fn close(self) {
        drop(self.results);
        self.thread.join().expect("the journal's thread does not panic");
    }
}

fn append(appendix: Appendix, queue: &mpsc::Receiver<Keep>, mut reports: impl Reports) {
    let Appendix { path, file, length, max_bytes, signed: _, writer: _ } = appendix;
    let mut tail =
        Tail { durable: length, length, max_bytes, out: BufWriter::with_capacity(BUFFER_BYTES, &file) };
    while let Ok(first) = queue.recv() {
        let mut kept = Vec::new();
        match tail.write_group(first, queue, &mut kept).and_then(|()| tail.sync(&file)) {
            Ok(()) => reports.kept(kept),
            Err(fault) => {
                // Results that were written whole are not lost; what is half written is cut off when the journal is opened.
                let _ = tail.sync(&file);
                return reports.failed(match fault {
                    Fault::Io(error) => JournalError::Io { path, action: "writing it", error },
                    Fault::Full => JournalError::Full { path, max_bytes },
                    Fault::OverBound => JournalError::OverBound {
                        path,
                        what: "the name of a task, or the number of a result's sections, is over its bound"
                            .to_owned(),
                    },
                });
            }
        }
    }
}

/// The end of the file.
struct Tail<'a> {
    /// Bytes that are on disk.
    durable: u64,
    /// Bytes written.
    length: u64,
    max_bytes: u64,
    out: BufWriter<&'a File>,
}

enum Fault {
    Io(io::Error),
    Full,
    OverBound,
}

impl From<io::Error> for Fault {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl Tail<'_> {
    /// Writes a result and those that wait behind it.
    fn write_group(
        &mut self,
        first: Keep,
        queue: &mpsc::Receiver<Keep>,
        kept: &mut Vec<(TaskId, JobIndex)>,
    ) -> Result<(), Fault> {
        let mut next = Some(first);
        while let Some(result) = next.take() {
            self.write(&result)?;
            kept.push((result.task, result.meta.index));
            // It takes no memory from here on.
            drop(result.payload.permit);
            if kept.len() < GROUP_RESULTS && self.length - self.durable < GROUP_BYTES {
                next = queue.try_recv().ok();
            }
        }
        Ok(())
    }

    fn write(&mut self, result: &Keep) -> Result<(), Fault> {
        let payload = &result.payload.bytes;
        let meta = result.meta.encode().ok_or(Fault::OverBound)?;
        let head = Head {
            at: self.length,
            durable: self.durable,
            payload_bytes: payload.len() as u64,
            meta_bytes: u32::try_from(meta.len()).expect("an encoded meta is bounded"),
            kind: Kind::Result,
        };
        let end = head.end().filter(|end| *end <= self.max_bytes).ok_or(Fault::Full)?;
        let head: [u8; HEAD_BYTES] = head.encode();
        self.out.write_all(&head)?;
        self.out.write_all(&meta)?;
        self.out.write_all(payload)?;
        self.length = end;
        Ok(())
    }

    fn sync(&mut self, file: &File) -> Result<(), Fault> {
        self.out.flush()?;
        file.sync_data()?;
        self.durable = self.length;
        Ok(())
    }
}
