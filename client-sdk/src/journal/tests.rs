//! Journals as files: what a crash may leave of them, and what others may have done to them.

use std::{fs, sync::mpsc, time::Duration};

use farm_core::id::{NodeId, TaskId};
use tempfile::TempDir;

use super::{format::Kind, *};
use crate::run::Payload;

const LABEL: &str = "test, seed 7";

struct Channel(mpsc::Sender<Result<Vec<(TaskId, JobIndex)>, JournalError>>);

impl Reports for Channel {
    fn kept(&mut self, jobs: Vec<(TaskId, JobIndex)>) {
        self.0.send(Ok(jobs)).unwrap();
    }

    fn failed(&mut self, error: JournalError) {
        self.0.send(Err(error)).unwrap();
    }
}

fn program(index: u32) -> ContentHash {
    content_hash(&index.to_le_bytes())
}

/// The sections of a job: an empty one, and one that is long for every third job.
fn sections(index: u32) -> [Vec<u8>; 2] {
    let length = if index.is_multiple_of(3) { 300 } else { 5 };
    [Vec::new(), vec![u8::try_from(index).unwrap(); length]]
}

fn keep(name: &str, index: u32, program: ContentHash) -> Keep {
    let sections = sections(index);
    let bytes = Bytes::from(sections.concat());
    let payload = Payload { digest: content_hash(&bytes), bytes, permit: None };
    let about = About { task: TaskId(4), name, index: JobIndex(index), program };
    let lengths = sections.iter().map(|section| section.len() as u64).collect();
    Keep::new(about, lengths, Duration::from_nanos(index.into()), NodeId(9), payload)
}

/// Appends results of the task `a`; each group is on disk before the next is begun.
fn append(path: &Path, groups: &[&[u32]]) {
    let (_, appendix) = Journal::open(path, LABEL).unwrap().split(&["a"]).unwrap();
    let (reports, heard) = mpsc::channel();
    let writer = JournalWriter::start(appendix, Channel(reports)).unwrap();
    for group in groups {
        group.iter().for_each(|&index| writer.keep(keep("a", index, program(index))));
        let mut kept = 0;
        while kept < group.len() {
            kept += heard.recv().unwrap().unwrap().len();
        }
    }
    writer.close();
}

/// The journal's results of jobs 0 to 9, each as it was written; an error of a result that is not.
fn read(path: &Path) -> Result<Vec<u32>, JournalError> {
    let journal = Journal::open(path, LABEL)?;
    let count = journal.results();
    let (mut reader, _) = journal.split(&["a"])?;
    let mut found = Vec::new();
    for index in 0..10 {
        let Some(place) = reader.find("a", JobIndex(index), program(index))? else { continue };
        let result = reader.read(place)?;
        assert_eq!(result.sections, sections(index).map(Bytes::from), "job {index}");
        assert_eq!((result.device_time, result.node), (Duration::from_nanos(index.into()), NodeId(9)));
        found.push(index);
    }
    assert_eq!(found.len() as u64, count);
    Ok(found)
}

/// A journal of 0 on disk for certain, 1 and 2 in one group after it; with the offsets of the records and the end.
fn three(folder: &TempDir) -> (PathBuf, Vec<u8>, [usize; 4]) {
    let path = folder.path().join("three");
    append(&path, &[&[0]]);
    let first = fs::metadata(&path).unwrap().len();
    // In one group, whatever the threads' turns: written by hand.
    let mut bytes = fs::read(&path).unwrap();
    let mut starts = vec![format::encode_header(LABEL).len(), bytes.len()];
    for index in [1, 2] {
        add_result(&mut bytes, index, first);
        starts.push(bytes.len());
    }
    (path, bytes, starts.try_into().unwrap())
}

/// Adds a result of the task `a` to a journal of which so many bytes are on disk.
fn add_result(bytes: &mut Vec<u8>, index: u32, durable: u64) {
    let result = keep("a", index, program(index));
    let (meta, payload) = (result.meta().encode().unwrap(), sections(index).concat());
    let head = Head {
        at: bytes.len() as u64,
        durable,
        payload_bytes: payload.len() as u64,
        meta_bytes: u32::try_from(meta.len()).unwrap(),
        kind: Kind::Result,
    };
    bytes.extend_from_slice(&head.encode());
    bytes.extend_from_slice(&meta);
    bytes.extend_from_slice(&payload);
}

/// A journal whose first writer added 0, and whose second one 1 and 2 in one group. With the ends of the header and of each record,
/// and what is there so far: results, and who wrote last.
type Ends = Vec<(usize, u64, Option<AppId>)>;

fn two_writers(folder: &TempDir) -> (PathBuf, Vec<u8>, Ends) {
    let path = folder.path().join("writers");
    let mut ends = vec![(format::encode_header(LABEL).len(), 0, None)];
    let length = || usize::try_from(fs::metadata(&path).unwrap().len()).unwrap();
    sign(&path, FIRST);
    ends.push((length(), 0, Some(FIRST)));
    append(&path, &[&[0]]);
    ends.push((length(), 1, Some(FIRST)));
    sign(&path, SECOND);
    ends.push((length(), 1, Some(SECOND)));
    let mut bytes = fs::read(&path).unwrap();
    for index in [1, 2] {
        add_result(&mut bytes, index, ends[3].0 as u64);
        ends.push((bytes.len(), 1 + u64::from(index), Some(SECOND)));
    }
    (path, bytes, ends)
}

const FIRST: AppId = AppId(3 << 32 | 7);
const SECOND: AppId = AppId(3 << 32 | 8);

fn sign(path: &Path, app: AppId) {
    Journal::open(path, LABEL).unwrap().split(&["a"]).unwrap().1.sign(app).unwrap();
}

fn writer(path: &Path) -> Result<Option<AppId>, JournalError> {
    Ok(Journal::open(path, LABEL)?.split(&["a"])?.1.writer())
}

#[test]
fn the_last_writer_is_known_wherever_the_end_was_torn() {
    let folder = TempDir::new().unwrap();
    let (path, bytes, ends) = two_writers(&folder);
    for cut in ends[0].0..=bytes.len() {
        fs::write(&path, &bytes[..cut]).unwrap();
        let &(_, results, last) = ends.iter().rfind(|(end, ..)| *end <= cut).unwrap();
        assert_eq!(writer(&path).unwrap(), last, "cut at {cut}");
        assert_eq!(Journal::open(&path, LABEL).unwrap().results(), results, "cut at {cut}");
    }
    // Of the last group, which nothing says was on disk, a record is torn: the writer was on disk before it.
    for torn in [ends[3].0, ends[4].0 - 1] {
        let mut holed = bytes.clone();
        holed[torn] ^= 1;
        fs::write(&path, holed).unwrap();
        assert_eq!((writer(&path).unwrap(), read(&path).unwrap()), (Some(SECOND), vec![0]), "byte {torn}");
    }
    for at in ends[2].0..ends[3].0 {
        let mut flipped = bytes.clone();
        flipped[at] ^= 1 << (at % 8);
        fs::write(&path, flipped).unwrap();
        let damaged = writer(&path).unwrap_err();
        let begins = ends[2].0 as u64;
        assert!(matches!(damaged, JournalError::Damaged { at_byte, .. } if at_byte == begins), "{damaged}");
    }
}

#[test]
fn a_writer_signs_once_and_takes_no_room_that_is_not_there() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("journal");
    sign(&path, FIRST);
    let length = fs::metadata(&path).unwrap().len();
    sign(&path, FIRST);
    assert_eq!(fs::metadata(&path).unwrap().len(), length);
    let journal = Journal::open(&path, LABEL).unwrap().with_max_bytes(length + 10);
    journal.split(&["a"]).unwrap().1.sign(SECOND).unwrap();
    assert_eq!((writer(&path).unwrap(), fs::metadata(&path).unwrap().len()), (Some(FIRST), length));
}

/// It has no writers, and a program that knows no others has to be able to go on with it, too.
#[test]
fn a_journal_of_the_first_format_goes_on_as_it_is() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("journal");
    let old = fs::read(corpus().join("valid-three")).unwrap();
    fs::write(&path, &old).unwrap();
    sign(&path, FIRST);
    assert_eq!((writer(&path).unwrap(), &fs::read(&path).unwrap()), (None, &old));
    append(&path, &[&[7]]);
    assert_eq!(read(&path).unwrap(), [0, 1, 2, 7]);
    assert!(fs::read(&path).unwrap().starts_with(&old));
}

fn corpus() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus/run_journal")
}

/// A golden file: another format must have another version. It is also what `tests/hostile` makes hostile journals of.
#[test]
fn the_format_is_that_of_the_corpus() {
    let golden = corpus().join("valid-writers");
    let (_, bytes, _) = two_writers(&TempDir::new().unwrap());
    if std::env::var_os("FARM_BLESS").is_some() && !golden.exists() {
        fs::create_dir_all(golden.parent().unwrap()).unwrap();
        fs::write(&golden, &bytes).unwrap();
    }
    assert!(fs::read(&golden).unwrap() == bytes, "format {VERSION} has changed");
}

#[test]
fn results_come_back_in_another_life_and_more_are_added() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("journal");
    append(&path, &[&[0, 1], &[5]]);
    assert_eq!(read(&path).unwrap(), [0, 1, 5]);
    append(&path, &[&[2, 3]]);
    assert_eq!(read(&path).unwrap(), [0, 1, 2, 3, 5]);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "one file is all there is");
}

#[test]
fn a_journal_cut_at_any_byte_has_the_results_before_the_cut() {
    let folder = TempDir::new().unwrap();
    let (path, bytes, [first, second, third, end]) = three(&folder);
    for cut in 0..=bytes.len() {
        fs::write(&path, &bytes[..cut]).unwrap();
        let (whole, results) = match cut {
            cut if cut < second => (first, 0),
            cut if cut < third => (second, 1),
            cut if cut < end => (third, 2),
            _ => (end, 3),
        };
        let journal = Journal::open(&path, LABEL).unwrap_or_else(|error| panic!("cut at {cut}: {error}"));
        assert_eq!(journal.results(), results, "cut at {cut}");
        assert_eq!(journal.cut_bytes(), cut.saturating_sub(whole) as u64, "cut at {cut}");
        drop(journal);
        assert_eq!(fs::metadata(&path).unwrap().len(), whole as u64, "cut at {cut}");
        if cut % 40 == 0 {
            append(&path, &[&[7]]);
            let expected: Vec<u32> = (0..u32::try_from(results).unwrap()).chain([7]).collect();
            assert_eq!(read(&path).unwrap(), expected, "cut at {cut}, and gone on");
        }
    }
}

#[test]
fn a_flipped_bit_is_never_taken_for_a_result_and_damage_is_told_from_a_torn_end() {
    let folder = TempDir::new().unwrap();
    let (path, bytes, [first, second, third, _]) = three(&folder);
    for at in 0..bytes.len() {
        let mut flipped = bytes.clone();
        flipped[at] ^= 1 << (at % 8);
        fs::write(&path, &flipped).unwrap();
        // `read` compares each result that it is given.
        match read(&path) {
            Err(JournalError::Damaged { at_byte, .. }) => {
                let begins = if at < first { 0 } else { first };
                assert!(at < second, "byte {at} was not known to be on disk");
                assert_eq!(at_byte, begins as u64, "byte {at}");
            }
            Err(JournalError::NotAJournal { .. }) => assert!(at < 16, "byte {at}"),
            Err(JournalError::Version { .. }) => assert!((16..20).contains(&at), "byte {at}"),
            Err(error) => panic!("byte {at}: {error}"),
            Ok(results) if at >= third => assert_eq!(results, [0, 1], "byte {at}"),
            Ok(results) => {
                assert!(at >= second, "byte {at} was on disk: its damage must be an error");
                assert_eq!(results, [0], "byte {at}");
            }
        }
    }
}

/// Pages of a file reach the disk in any order: a hole before good records is a torn end as long as nothing said that it was there.
#[test]
fn a_hole_in_what_was_not_synced_is_a_torn_end() {
    let folder = TempDir::new().unwrap();
    let (path, bytes, [first, second, third, _]) = three(&folder);
    let with_hole = |from: usize, to: usize| {
        let mut holed = bytes.clone();
        holed[from..to].fill(0);
        fs::write(&path, holed).unwrap();
        read(&path)
    };
    assert_eq!(with_hole(second, third).unwrap(), [0]);
    assert_eq!(with_hole(third - 3, third).unwrap(), [0], "a payload alone");
    // The record that says so of the first one is torn itself: what it said still counts.
    let mut both = bytes.clone();
    both[second - 1] ^= 1;
    both.truncate(third + 10);
    both[third - 1] ^= 1;
    fs::write(&path, both).unwrap();
    assert!(matches!(read(&path), Err(JournalError::Damaged { at_byte, .. }) if at_byte == first as u64));
    let damaged = with_hole(first, second).unwrap_err();
    assert!(matches!(damaged, JournalError::Damaged { at_byte, .. } if at_byte == first as u64), "{damaged}");
    assert!(damaged.to_string().contains("three"), "the file is named: {damaged}");
}

/// A crash may leave a file's length without its bytes.
#[test]
fn a_header_that_a_crash_left_out_is_written_again() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("journal");
    let header = format::encode_header(LABEL);
    for zeros in [0..header.len(), 10..header.len(), 0..16] {
        let mut torn = header.clone();
        torn[zeros].fill(0);
        fs::write(&path, &torn).unwrap();
        append(&path, &[&[7]]);
        assert_eq!(read(&path).unwrap(), [7]);
    }
    let zeros = vec![0; header.len() + 1];
    fs::write(&path, &zeros).unwrap();
    assert!(matches!(Journal::open(&path, LABEL), Err(JournalError::NotAJournal { .. })));
    assert_eq!(fs::read(&path).unwrap(), zeros, "longer than a header: somebody else's");
}

#[test]
fn journals_of_others_are_refused_and_left_alone() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("journal");
    append(&path, &[&[0]]);
    let before = fs::read(&path).unwrap();
    let other = Journal::open(&path, "test, seed 8").unwrap_err();
    assert!(matches!(other, JournalError::OtherRun { .. }), "{other}");
    assert!(other.to_string().contains("seed 7") && other.to_string().contains("seed 8"), "{other}");
    let journal = Journal::open(&path, LABEL).unwrap();
    assert!(matches!(Journal::open(&path, LABEL), Err(JournalError::InUse { .. })));
    let tasks = journal.split(&["b"]).unwrap_err();
    assert!(matches!(&tasks, JournalError::OtherTasks { task, .. } if task == "a"), "{tasks}");
    assert_eq!(fs::read(&path).unwrap(), before);

    let picture = folder.path().join("picture.png");
    fs::write(&picture, b"\x89PNG, and what follows").unwrap();
    assert!(matches!(Journal::open(&picture, LABEL), Err(JournalError::NotAJournal { .. })));
    assert_eq!(fs::read(&picture).unwrap(), b"\x89PNG, and what follows");
    assert!(matches!(Journal::open(&path, &"x".repeat(5_000)), Err(JournalError::OverBound { .. })));
    assert!(matches!(Journal::open(folder.path(), LABEL), Err(JournalError::Io { .. })));
}

#[test]
fn a_disk_without_room_is_an_error_that_names_the_journal() {
    let error = Journal::open("/dev/full", LABEL).unwrap_err().to_string();
    assert!(error.contains("journal /dev/full") && error.contains("No space left"), "{error}");
}

#[test]
fn the_bound_on_its_size_ends_the_run_and_keeps_what_is_there() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("journal");
    append(&path, &[&[0]]);
    let length = fs::metadata(&path).unwrap().len();
    let journal = Journal::open(&path, LABEL).unwrap().with_max_bytes(length + 10);
    let (_, appendix) = journal.split(&["a"]).unwrap();
    let (reports, heard) = mpsc::channel();
    let writer = JournalWriter::start(appendix, Channel(reports)).unwrap();
    writer.keep(keep("a", 1, program(1)));
    let error = heard.recv().unwrap().unwrap_err();
    assert!(matches!(error, JournalError::Full { max_bytes, .. } if max_bytes == length + 10), "{error}");
    writer.keep(keep("a", 2, program(2)));
    writer.close();
    assert_eq!(read(&path).unwrap(), [0]);
}

#[test]
fn equal_programs_have_a_result_each() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("journal");
    let (_, appendix) = Journal::open(&path, LABEL).unwrap().split(&["a"]).unwrap();
    let (reports, _heard) = mpsc::channel();
    let writer = JournalWriter::start(appendix, Channel(reports)).unwrap();
    [3, 4, 5].into_iter().for_each(|index| writer.keep(keep("a", index, program(0))));
    writer.close();
    let (mut reader, _) = Journal::open(&path, LABEL).unwrap().split(&["a", "b"]).unwrap();
    let mut of = |task, index| {
        let place = reader.find(task, JobIndex(index), program(0)).unwrap();
        place.map(|place| u64::try_from(reader.read(place).unwrap().device_time.as_nanos()).unwrap())
    };
    assert_eq!(of("b", 4), None, "another task");
    assert_eq!(of("a", 4), Some(4), "its own first");
    assert_eq!([of("a", 0), of("a", 1), of("a", 3)], [Some(3), Some(5), None], "none twice");
}

#[test]
fn other_inputs_are_found_by_the_job_that_came_first() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("journal");
    append(&path, &[&[2], &[1]]);
    let reader = || Journal::open(&path, LABEL).unwrap().split(&["a"]).unwrap().0;
    // Job 1 may have followed from the result of job 2, and may be another job in this run.
    let mut changed = reader();
    assert_eq!(changed.find("a", JobIndex(1), program(100)).unwrap(), None);
    let error = changed.find("a", JobIndex(2), program(200)).unwrap_err();
    assert!(matches!(error, JournalError::OtherInputs { job: JobIndex(2), .. }), "{error}");
    drop(changed);
    let mut same = reader();
    assert!(same.find("a", JobIndex(2), program(2)).unwrap().is_some());
    assert!(same.find("a", JobIndex(7), program(1)).unwrap().is_some(), "at another index now");
}
