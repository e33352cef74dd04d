//! A run's journal: the results that an application has taken, in one file, so that another process of it goes on from there; and
//! as which application the last one did so.
//!
//! Owns the file: who may use it, what of it counts after a crash, how it grows. Never decides which result counts, and never
//! talks to the farm; `format` knows the bytes, `writer` the thread that appends.

mod format;
#[cfg(test)]
mod tests;
mod writer;

use std::{
    collections::{BTreeMap, HashMap},
    fmt,
    fs::{File, OpenOptions, TryLockError},
    io,
    os::unix::fs::{FileExt as _, OpenOptionsExt as _},
    path::{Path, PathBuf},
};

use bytes::Bytes;
use farm_core::id::{AppId, ContentHash, JobIndex};
use proto::codec::content_hash;
use thiserror::Error;

use self::format::{
    FIXED_HEADER_BYTES, HEAD_BYTES, Head, Header, HeaderFault, MAX_LABEL_BYTES, Meta, Record, VERSION,
};
pub(crate) use self::writer::{About, JournalWriter, Keep, Reports};
use crate::job::{JobResult, split_sections};

/// Size that a journal keeps to unless told otherwise, in bytes.
const DEFAULT_MAX_BYTES: u64 = 256 << 30;
/// Characters of a label or a name that an error shows.
const SHOWN_CHARS: usize = 200;
/// Bytes that are looked through at a time for what follows damage.
const SEARCH_BYTES: usize = 1 << 20;

/// The results that an application has taken, in a file, for [`Farm::run_journalled`](crate::Farm::run_journalled).
///
/// A process that opens the journal of an earlier one gets what is there: jobs with the same program (by its digest) are not
/// computed again, their `retrieve` is called with the bytes in the journal. The rest is computed and added.
///
/// Nobody removes the file but the application: only it knows when what it has made of the results is safe.
#[derive(Debug)]
pub struct Journal {
    path: PathBuf,
    /// Locked, so that two processes never write to it.
    file: File,
    /// Bytes of whole records; what comes next goes there. All of it is on disk.
    length: u64,
    max_bytes: u64,
    /// Whether its format has writers.
    signed: bool,
    records: Records,
    cut_bytes: u64,
}

/// Why a journal cannot be used. Each names the file.
#[derive(Debug, Error)]
pub enum JournalError {
    /// The system refused: no permission, no space left.
    #[error("journal {}, {action}: {error}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// The system's reason.
        #[source]
        error: io::Error,
    },
    /// Another process uses it.
    #[error("journal {} is in use by another process", path.display())]
    InUse {
        /// The file.
        path: PathBuf,
    },
    /// The file is something else; it was not touched.
    #[error("{} is no journal", path.display())]
    NotAJournal {
        /// The file.
        path: PathBuf,
    },
    /// Written by a later version, that writes them otherwise.
    #[error("journal {} is of format {found}, this program reads formats up to {VERSION}", path.display())]
    Version {
        /// The file.
        path: PathBuf,
        /// Its format.
        found: u32,
    },
    /// Of a run with another label.
    #[error("journal {} is of another run: {found:?}, not {wanted:?}", path.display())]
    OtherRun {
        /// The file.
        path: PathBuf,
        /// Its label.
        found: String,
        /// The label it was opened with.
        wanted: String,
    },
    /// The run has no task of a name that the journal has results of.
    #[error("journal {} is of another run: it has results of a task {task:?}, which this run does not have", path.display())]
    OtherTasks {
        /// The file.
        path: PathBuf,
        /// The task.
        task: String,
    },
    /// The job whose result came first has another program now: the inputs are not those of the journal.
    #[error("journal {} is of other inputs: task `{task}`, {job} had another program then", path.display())]
    OtherInputs {
        /// The file.
        path: PathBuf,
        /// The job's task.
        task: String,
        /// The job.
        job: JobIndex,
    },
    /// Bytes that were on disk have changed.
    #[error("journal {} is damaged at byte {at_byte}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Where the damaged part begins.
        at_byte: u64,
    },
    /// It would grow over its bound.
    #[error("journal {} would grow over its bound of {max_bytes} B", path.display())]
    Full {
        /// The file.
        path: PathBuf,
        /// The bound.
        max_bytes: u64,
    },
    /// A label, a task's name or a result that a journal does not hold.
    #[error("journal {}: {what}", path.display())]
    OverBound {
        /// The file.
        path: PathBuf,
        /// What is over which bound.
        what: String,
    },
}

impl Journal {
    /// Opens the journal of a run, or begins one where no file is. Reads as much as the file has records, and waits for the disk:
    /// a blocking call.
    ///
    /// `label` says which run it is (4 KiB at most): its inputs and options, as far as they are known before the run. A journal with
    /// another label is refused. What the label does not say is found by the programs' digests.
    ///
    /// A tail that a crash tore is cut off; everything else that is wrong is an error, and the file stays as it is.
    ///
    /// # Errors
    /// [`JournalError::InUse`], [`NotAJournal`](JournalError::NotAJournal), [`Version`](JournalError::Version),
    /// [`OtherRun`](JournalError::OtherRun), [`Damaged`](JournalError::Damaged), or the system's reason.
    pub fn open(path: impl Into<PathBuf>, label: &str) -> Result<Self, JournalError> {
        let path = path.into();
        if label.len() > MAX_LABEL_BYTES {
            let what = format!("a label of {} B is over {MAX_LABEL_BYTES} B", label.len());
            return Err(JournalError::OverBound { path, what });
        }
        let opened =
            OpenOptions::new().read(true).write(true).create(true).truncate(false).mode(0o600).open(&path);
        let file = opened.map_err(|error| JournalError::io(&path, "opening it", error))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(JournalError::InUse { path }),
            Err(TryLockError::Error(error)) => return Err(JournalError::io(&path, "locking it", error)),
        }
        let opened = begin_or_read(&file, label).map_err(|fault| fault.of(&path, label))?;
        let (signed, records, end, length) = match opened {
            Contents::Begun { length } => {
                // The name of a new file is safe when its folder is.
                sync_folder(&path).map_err(|error| JournalError::io(&path, "writing its folder", error))?;
                (true, Records::default(), length, length)
            }
            Contents::Read { signed, records, end, length } => (signed, records, end, length),
        };
        if end < length {
            file.set_len(end).map_err(|error| JournalError::io(&path, "cutting off its torn end", error))?;
        }
        // What an earlier process wrote may still be in memory only.
        file.sync_all().map_err(|error| JournalError::io(&path, "writing it", error))?;
        let (max_bytes, cut_bytes) = (DEFAULT_MAX_BYTES, length - end);
        Ok(Self { path, file, length: end, max_bytes, signed, records, cut_bytes })
    }

    /// The same with another bound on its size than 256 GiB. A run whose results do not fit ends with [`JournalError::Full`]; what
    /// is there stays.
    #[must_use]
    pub const fn with_max_bytes(mut self, max_bytes: u64) -> Self {
        self.max_bytes = max_bytes;
        self
    }

    /// Where it is.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Results in it.
    #[must_use]
    pub fn results(&self) -> u64 {
        self.records.places.len() as u64
    }

    /// Its size in bytes.
    #[must_use]
    pub const fn bytes(&self) -> u64 {
        self.length
    }

    /// Bytes at its end that a crash had torn, and that were cut off.
    #[must_use]
    pub const fn cut_bytes(&self) -> u64 {
        self.cut_bytes
    }

    /// Splits it into what reads and what writes. `names` are those of the run's tasks.
    pub(crate) fn split(self, names: &[&str]) -> Result<(JournalReader, Appendix), JournalError> {
        let Self { path, file, length, max_bytes, signed, records, cut_bytes: _ } = self;
        if let Some(task) = records.tasks.keys().find(|task| !names.contains(&task.as_str())) {
            return Err(JournalError::OtherTasks { task: shown(task), path });
        }
        let append = file.try_clone().map_err(|error| JournalError::io(&path, "opening it again", error))?;
        let writer = records.writer;
        let appendix = Appendix { path: path.clone(), file: append, length, max_bytes, signed, writer };
        Ok((JournalReader { path, file, records }, appendix))
    }
}

impl JournalError {
    fn io(path: &Path, action: &'static str, error: io::Error) -> Self {
        Self::Io { path: path.to_owned(), action, error }
    }
}

/// The part of a journal that a run reads from.
#[derive(Debug)]
pub(crate) struct JournalReader {
    path: PathBuf,
    file: File,
    records: Records,
}

/// The part that a run appends to.
#[derive(Debug)]
pub(crate) struct Appendix {
    path: PathBuf,
    file: File,
    length: u64,
    max_bytes: u64,
    signed: bool,
    writer: Option<AppId>,
}

impl Appendix {
    /// As which application the last process wrote that may have added results.
    pub(crate) const fn writer(&self) -> Option<AppId> {
        self.writer
    }

    /// Has the journal say, on disk, that what follows is this application's.
    ///
    /// # Errors
    /// The system refuses.
    pub(crate) fn sign(&mut self, app: AppId) -> Result<(), JournalError> {
        if !self.signed || self.writer == Some(app) {
            return Ok(());
        }
        let record = format::encode_writer(self.length, app);
        let end = self.length + record.len() as u64;
        // Where this has no room no result has: the run ends with the first, or needs none.
        if end > self.max_bytes {
            return Ok(());
        }
        let written = self.file.write_all_at(&record, self.length).and_then(|()| self.file.sync_data());
        written.map_err(|error| JournalError::io(&self.path, "writing it", error))?;
        (self.length, self.writer) = (end, Some(app));
        Ok(())
    }
}

impl JournalReader {
    /// Takes a job's result out, if there is one of its program: first that of the same index, for jobs of equal programs.
    ///
    /// # Errors
    /// The journal is of other inputs.
    pub(crate) fn find(
        &mut self,
        task: &str,
        index: JobIndex,
        program: ContentHash,
    ) -> Result<Option<Place>, JournalError> {
        let Some(&number) = self.records.tasks.get(task) else { return Ok(None) };
        let key = |index| RecordKey { task: number, program, index };
        let places = &mut self.records.places;
        let found = places.remove(&key(index)).or_else(|| {
            let (&other, _) = places.range(key(JobIndex(0))..=key(JobIndex(u32::MAX))).next()?;
            places.remove(&other)
        });
        // A job whose result came first depends on no other result: it has this index in every run of the same inputs.
        let first = self.records.first.take_if(|first| (first.task, first.index) == (number, index));
        match found {
            None if first.is_some_and(|first| first.program != program) => {
                Err(JournalError::OtherInputs { path: self.path.clone(), task: task.to_owned(), job: index })
            }
            found => Ok(found.map(|at| Place { at, program })),
        }
    }

    /// Reads a result: its bytes once, into one allocation.
    ///
    /// # Errors
    /// The record has changed since it was written, or cannot be read.
    pub(crate) fn read(&self, place: Place) -> Result<JobResult, JournalError> {
        let Place { at, program } = place;
        let read = || -> io::Result<Option<JobResult>> {
            let Some((head, Record::Result(meta))) = read_record(&self.file, at, u64::MAX)? else {
                return Ok(None);
            };
            let payload = read_payload(&self.file, &head)?;
            if meta.program != program || content_hash(&payload) != meta.payload {
                return Ok(None);
            }
            let sections = split_sections(Bytes::from(payload), &meta.sections);
            Ok(Some(JobResult { sections, device_time: meta.device_time, node: meta.node }))
        };
        let damaged = || JournalError::Damaged { path: self.path.clone(), at_byte: at };
        match read() {
            Ok(result) => result.ok_or_else(damaged),
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Err(damaged()),
            Err(error) => Err(JournalError::io(&self.path, "reading it", error)),
        }
    }
}

/// Where a result is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Place {
    at: u64,
    program: ContentHash,
}

/// Which results there are, and where.
#[derive(Default)]
struct Records {
    /// Numbers of the tasks, by name.
    tasks: HashMap<String, u32>,
    /// Offsets of the records.
    places: BTreeMap<RecordKey, u64>,
    /// What was written first of all.
    first: Option<RecordKey>,
    /// Whose process wrote last.
    writer: Option<AppId>,
}

/// What a result is found by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct RecordKey {
    task: u32,
    program: ContentHash,
    index: JobIndex,
}

impl Records {
    fn add(&mut self, at: u64, record: Record) {
        match record {
            Record::Result(meta) => self.add_result(at, meta),
            Record::Writer(app) => self.writer = Some(app),
        }
    }

    fn add_result(&mut self, at: u64, meta: Meta) {
        let count = u32::try_from(self.tasks.len()).expect("a name takes a record, and 2^32 of them no file");
        let task = *self.tasks.entry(meta.task).or_insert(count);
        let key = RecordKey { task, program: meta.program, index: meta.index };
        self.first.get_or_insert(key);
        self.places.insert(key, at);
    }
}

impl fmt::Debug for Records {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Records").field("results", &self.places.len()).finish_non_exhaustive()
    }
}

/// What a file held.
enum Contents {
    /// Nothing, or the beginning of this header: it has the whole header now.
    Begun { length: u64 },
    /// Records up to `end`, of a file of `length` bytes.
    Read { signed: bool, records: Records, end: u64, length: u64 },
}

/// The records of a file that count.
struct Scan {
    records: Records,
    /// Where they end.
    end: u64,
    /// What is known to have been on disk.
    durable: u64,
}

/// Why a file's contents cannot be used.
enum Fault {
    Io(io::Error),
    Header(HeaderFault),
    Label(String),
    Damaged { at: u64 },
}

impl From<io::Error> for Fault {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<HeaderFault> for Fault {
    fn from(fault: HeaderFault) -> Self {
        Self::Header(fault)
    }
}

impl Fault {
    fn of(self, path: &Path, wanted: &str) -> JournalError {
        let path = path.to_owned();
        match self {
            Self::Io(error) => JournalError::Io { path, action: "reading it", error },
            Self::Header(HeaderFault::NotAJournal) => JournalError::NotAJournal { path },
            Self::Header(HeaderFault::Version(found)) => JournalError::Version { path, found },
            Self::Header(HeaderFault::Damaged) => JournalError::Damaged { path, at_byte: 0 },
            Self::Label(found) => {
                JournalError::OtherRun { path, found: shown(&found), wanted: shown(wanted) }
            }
            Self::Damaged { at } => JournalError::Damaged { path, at_byte: at },
        }
    }
}

fn begin_or_read(file: &File, label: &str) -> Result<Contents, Fault> {
    let header = format::encode_header(label);
    let length = file.metadata()?.len();
    let beginning = read_at(file, 0, length.min(header.len() as u64))?;
    if length <= header.len() as u64 && beginning != header && format::is_torn(&beginning, &header) {
        file.write_all_at(&header, 0)?;
        return Ok(Contents::Begun { length: header.len() as u64 });
    }
    let fixed = &beginning[..beginning.len().min(FIXED_HEADER_BYTES)];
    let Header { bytes, signed } = format::decode_fixed_header(fixed)?;
    let whole = bytes as u64;
    if whole > length {
        return Err(HeaderFault::Damaged.into());
    }
    let found = read_at(file, 0, whole)?;
    let found = format::decode_header(&found)?;
    if found != label {
        return Err(Fault::Label(found.to_owned()));
    }
    let mut scan = read_records(file, whole, length, whole)?;
    if scan.end < length {
        // What is cut off may be what says of the rest that it was on disk.
        scan = read_records(file, whole, scan.end, scan.durable)?;
    }
    let Scan { records, end, durable: _ } = scan;
    Ok(Contents::Read { signed, records, end, length })
}

/// All records that count, of a file of which the first `known` bytes are known to have been on disk.
fn read_records(file: &File, from: u64, length: u64, known: u64) -> Result<Scan, Fault> {
    let (mut records, mut at, mut durable) = (Records::default(), from, from);
    // Written since the last time that the disk was waited for: each may be torn.
    let mut young: Vec<(Head, Record)> = Vec::new();
    while at < length {
        let Some((head, record)) = read_record(file, at, length)? else {
            if is_followed(file, at, length)? {
                return Err(Fault::Damaged { at });
            }
            break;
        };
        if head.durable > durable {
            durable = head.durable;
            for (head, record) in young.extract_if(.., |(head, _)| head.at < durable) {
                records.add(head.at, record);
            }
        }
        at = head.end().expect("a decoded head has an end");
        young.push((head, record));
    }
    for (head, record) in young {
        let torn = match &record {
            Record::Result(meta) => content_hash(&read_payload(file, &head)?) != meta.payload,
            Record::Writer(_) => false,
        };
        if torn {
            at = head.at;
            if at < known {
                return Err(Fault::Damaged { at });
            }
            break;
        }
        records.add(head.at, record);
    }
    Ok(Scan { records, end: at, durable: durable.max(known) })
}

/// The record at `at` but for its payload; `None` if there is none that is whole.
fn read_record(file: &File, at: u64, length: u64) -> io::Result<Option<(Head, Record)>> {
    if length.saturating_sub(at) < HEAD_BYTES as u64 {
        return Ok(None);
    }
    let mut head = [0; HEAD_BYTES];
    file.read_exact_at(&mut head, at)?;
    let Some(head) = Head::decode(&head, at) else { return Ok(None) };
    if head.end().is_none_or(|end| end > length) {
        return Ok(None);
    }
    let meta = read_at(file, head.meta_at(), head.meta_bytes.into())?;
    Ok(Record::decode(&meta, &head).map(|record| (head, record)))
}

fn read_payload(file: &File, head: &Head) -> io::Result<Vec<u8>> {
    read_at(file, head.payload_at(), head.payload_bytes)
}

/// Whether a record somewhere after `at` says that what is at `at` was on disk.
fn is_followed(file: &File, at: u64, length: u64) -> io::Result<bool> {
    let mut from = at + 1;
    while from < length {
        let bytes = read_at(file, from, (length - from).min(SEARCH_BYTES as u64))?;
        let mut offset = 0;
        while let Some(mark) = format::find_mark(&bytes[offset..]) {
            offset += mark;
            let place = from + offset as u64;
            if length - place >= HEAD_BYTES as u64 {
                let mut head = [0; HEAD_BYTES];
                file.read_exact_at(&mut head, place)?;
                if Head::decode(&head, place).is_some_and(|head| head.durable > at) {
                    return Ok(true);
                }
            }
            offset += 1;
        }
        // A mark may lie across two parts.
        let overlap = if bytes.len() == SEARCH_BYTES { HEAD_BYTES as u64 } else { 0 };
        from += bytes.len() as u64 - overlap;
    }
    Ok(false)
}

/// Text of a file for an error: not more than people read.
fn shown(text: &str) -> String {
    text.chars().take(SHOWN_CHARS).collect()
}

/// Bytes of a file; `length` is known not to be over the file's.
fn read_at(file: &File, at: u64, length: u64) -> io::Result<Vec<u8>> {
    let length = usize::try_from(length).map_err(|_| io::ErrorKind::FileTooLarge)?;
    let mut bytes = vec![0; length];
    file.read_exact_at(&mut bytes, at)?;
    Ok(bytes)
}

fn sync_folder(path: &Path) -> io::Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    File::open(folder.unwrap_or_else(|| Path::new(".")))?.sync_all()
}
