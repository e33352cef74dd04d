//! The journal's bytes: a header, then records. Pure: no file is opened here.
//!
//! ```text
//! header   "gleaner-journal\n" | version u32 | label length u32 | label | check
//! record   head (48 B) | meta | payload
//! head     mark | offset of the head u64 | durable u64 | payload length u64 | meta length u32 | kind u32 | check
//! result   kind 0; meta: program [32] | payload digest [32] | node u64 | device time in ns u64 | index u32
//!          | number of sections u32 | their lengths u64.. | task name | check; payload: the sections, one after the other
//! writer   kind 1; meta: application u64 | check; no payload: whose results follow
//! ```
//! Format 1 is the same without writers: it is read, and gone on with as it is.
//!
//! Numbers are little-endian. A check is the first eight bytes of blake3 over what comes before it in its part. `durable` says
//! how many bytes of the file were on disk when the record was written: what is damaged below that is damage, what is
//! damaged above it was torn by a crash.

use std::time::Duration;

use farm_core::id::{AppId, ContentHash, JobIndex, NodeId};
use proto::codec::content_hash;

/// The format that is written, and the newest that is read.
pub(super) const VERSION: u32 = 2;
/// The oldest format that is read.
const OLDEST_VERSION: u32 = 1;
/// The oldest format with writers.
const SIGNED_VERSION: u32 = 2;
/// First bytes of a journal.
pub(super) const MAGIC: [u8; 16] = *b"gleaner-journal\n";
/// First bytes of a record; a byte that is no text first.
const MARK: [u8; 8] = *b"\x89record\n";
/// Bytes before the label.
pub(super) const FIXED_HEADER_BYTES: usize = 24;
/// Longest label, in bytes.
pub(super) const MAX_LABEL_BYTES: usize = 4 << 10;
/// Longest name of a task, in bytes.
pub(super) const MAX_TASK_BYTES: usize = 4 << 10;
/// Most sections of a result: as many as a program may have commands.
pub(super) const MAX_SECTIONS: usize = 4_096;
const CHECK_BYTES: usize = 8;
pub(super) const HEAD_BYTES: usize = 48;
/// Bytes of a meta without sections and name.
const FIXED_META_BYTES: usize = 32 + 32 + 8 + 8 + 4 + 4 + CHECK_BYTES;
/// Longest meta.
pub(super) const MAX_META_BYTES: usize = FIXED_META_BYTES + 8 * MAX_SECTIONS + MAX_TASK_BYTES;

/// Why bytes are no header.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum HeaderFault {
    /// Something else.
    NotAJournal,
    /// Of another format.
    Version(u32),
    /// Spoilt.
    Damaged,
}

/// The header of a journal with this label.
pub(super) fn encode_header(label: &str) -> Vec<u8> {
    let length = u32::try_from(label.len()).expect("labels are checked against MAX_LABEL_BYTES");
    let mut bytes = [&MAGIC[..], &VERSION.to_le_bytes(), &length.to_le_bytes(), label.as_bytes()].concat();
    bytes.extend_from_slice(&check(&bytes));
    bytes
}

/// Whether a crash can have left these bytes where a header was being written: some are missing or zero, none is another's.
pub(super) fn is_torn(bytes: &[u8], header: &[u8]) -> bool {
    bytes.len() <= header.len()
        && bytes.iter().zip(header).all(|(found, meant)| *found == 0 || found == meant)
}

/// What the first [`FIXED_HEADER_BYTES`] of a header say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Header {
    /// Bytes of the whole header.
    pub(super) bytes: usize,
    /// Whether those who write say who they are.
    pub(super) signed: bool,
}

pub(super) fn decode_fixed_header(fixed: &[u8]) -> Result<Header, HeaderFault> {
    let mut fields = Fields(fixed);
    if fields.take::<16>() != Some(MAGIC) {
        return Err(HeaderFault::NotAJournal);
    }
    let version = match fields.u32() {
        Some(version @ OLDEST_VERSION..=VERSION) => version,
        Some(other) => return Err(HeaderFault::Version(other)),
        None => return Err(HeaderFault::Damaged),
    };
    match fields.u32().map(|length| length as usize) {
        Some(length) if length <= MAX_LABEL_BYTES => {
            Ok(Header { bytes: FIXED_HEADER_BYTES + length + CHECK_BYTES, signed: version >= SIGNED_VERSION })
        }
        _ => Err(HeaderFault::Damaged),
    }
}

/// The label, by a whole header.
pub(super) fn decode_header(bytes: &[u8]) -> Result<&str, HeaderFault> {
    let label =
        checked(bytes).and_then(|bytes| bytes.get(FIXED_HEADER_BYTES..)).ok_or(HeaderFault::Damaged)?;
    std::str::from_utf8(label).map_err(|_| HeaderFault::Damaged)
}

/// What a record tells of; its number is in the head.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Result = 0,
    Writer = 1,
}

impl Kind {
    const fn numbered(number: u32) -> Option<Self> {
        match number {
            0 => Some(Self::Result),
            1 => Some(Self::Writer),
            _ => None,
        }
    }
}

/// What a record begins with: where it is, how long, and of which kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Head {
    /// Offset of its first byte.
    pub(super) at: u64,
    /// Bytes of the file that were on disk when it was written.
    pub(super) durable: u64,
    pub(super) payload_bytes: u64,
    pub(super) meta_bytes: u32,
    pub(super) kind: Kind,
}

impl Head {
    pub(super) fn encode(&self) -> [u8; HEAD_BYTES] {
        let Self { at, durable, payload_bytes, meta_bytes, kind } = *self;
        let mut bytes = [0; HEAD_BYTES];
        bytes[..8].copy_from_slice(&MARK);
        bytes[8..16].copy_from_slice(&at.to_le_bytes());
        bytes[16..24].copy_from_slice(&durable.to_le_bytes());
        bytes[24..32].copy_from_slice(&payload_bytes.to_le_bytes());
        bytes[32..36].copy_from_slice(&meta_bytes.to_le_bytes());
        bytes[36..40].copy_from_slice(&(kind as u32).to_le_bytes());
        let sum = check(&bytes[..HEAD_BYTES - CHECK_BYTES]);
        bytes[HEAD_BYTES - CHECK_BYTES..].copy_from_slice(&sum);
        bytes
    }

    /// `None` for bytes that are no head, or not one that belongs at `at`.
    pub(super) fn decode(bytes: &[u8; HEAD_BYTES], at: u64) -> Option<Self> {
        if !bytes.starts_with(&MARK) {
            return None;
        }
        let mut fields = Fields(checked(bytes)?);
        let head = Self {
            at: fields.take::<8>().and_then(|_| fields.u64())?,
            durable: fields.u64()?,
            payload_bytes: fields.u64()?,
            meta_bytes: fields.u32()?,
            kind: fields.u32().and_then(Kind::numbered)?,
        };
        let whole = head.meta_bytes as usize <= MAX_META_BYTES && head.end().is_some();
        (head.at == at && head.durable <= at && whole).then_some(head)
    }

    /// Where the meta begins.
    pub(super) const fn meta_at(&self) -> u64 {
        self.at + HEAD_BYTES as u64
    }

    /// Where the payload begins.
    pub(super) const fn payload_at(&self) -> u64 {
        self.meta_at() + self.meta_bytes as u64
    }

    /// Where the next record begins; `None` if no file is that long.
    pub(super) fn end(&self) -> Option<u64> {
        let before = (HEAD_BYTES as u64).checked_add(u64::from(self.meta_bytes))?;
        self.at.checked_add(before)?.checked_add(self.payload_bytes)
    }
}

/// Offset in `bytes` of the first mark of a record.
pub(super) fn find_mark(bytes: &[u8]) -> Option<usize> {
    bytes.windows(MARK.len()).position(|window| window == MARK)
}

/// What a record says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Record {
    /// A result, its payload apart.
    Result(Meta),
    /// What follows is written by a process of this application.
    Writer(AppId),
}

impl Record {
    /// `None` for bytes that are no meta of such a head.
    pub(super) fn decode(bytes: &[u8], head: &Head) -> Option<Self> {
        match head.kind {
            Kind::Result => Meta::decode(bytes, head.payload_bytes).map(Self::Result),
            Kind::Writer => {
                let mut fields = Fields(checked(bytes)?);
                let app = AppId(fields.u64()?);
                (fields.0.is_empty() && head.payload_bytes == 0).then_some(Self::Writer(app))
            }
        }
    }
}

/// A whole record that says who writes from here on, where all bytes before it are on disk.
pub(super) fn encode_writer(at: u64, app: AppId) -> Vec<u8> {
    let meta = app.0.to_le_bytes();
    let meta_bytes = u32::try_from(meta.len() + CHECK_BYTES).expect("16 bytes");
    let head = Head { at, durable: at, payload_bytes: 0, meta_bytes, kind: Kind::Writer };
    [&head.encode()[..], &meta, &check(&meta)].concat()
}

/// What a record says of its result.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Meta {
    /// Name of the job's task in its graph.
    pub(super) task: String,
    pub(super) index: JobIndex,
    /// Digest of the job's encoded program: what the result is a function of.
    pub(super) program: ContentHash,
    /// Digest of the payload.
    pub(super) payload: ContentHash,
    /// Lengths in the payload.
    pub(super) sections: Vec<u64>,
    pub(super) device_time: Duration,
    pub(super) node: NodeId,
}

impl Meta {
    /// `None` where the name or the number of sections is over its bound.
    pub(super) fn encode(&self) -> Option<Vec<u8>> {
        if self.task.len() > MAX_TASK_BYTES || self.sections.len() > MAX_SECTIONS {
            return None;
        }
        let device_time_ns = u64::try_from(self.device_time.as_nanos()).unwrap_or(u64::MAX);
        let sections = u32::try_from(self.sections.len()).expect("bounded by MAX_SECTIONS");
        let mut bytes = Vec::with_capacity(FIXED_META_BYTES + 8 * self.sections.len() + self.task.len());
        bytes.extend_from_slice(&self.program.0);
        bytes.extend_from_slice(&self.payload.0);
        bytes.extend_from_slice(&self.node.0.to_le_bytes());
        bytes.extend_from_slice(&device_time_ns.to_le_bytes());
        bytes.extend_from_slice(&self.index.0.to_le_bytes());
        bytes.extend_from_slice(&sections.to_le_bytes());
        self.sections.iter().for_each(|length| bytes.extend_from_slice(&length.to_le_bytes()));
        bytes.extend_from_slice(self.task.as_bytes());
        bytes.extend_from_slice(&check(&bytes));
        Some(bytes)
    }

    /// `None` for bytes that are no meta, or not one of a payload of this length.
    pub(super) fn decode(bytes: &[u8], payload_bytes: u64) -> Option<Self> {
        let mut fields = Fields(checked(bytes)?);
        let (program, payload) = (ContentHash(fields.take()?), ContentHash(fields.take()?));
        let (node, device_time) = (NodeId(fields.u64()?), Duration::from_nanos(fields.u64()?));
        let (index, count) = (JobIndex(fields.u32()?), fields.u32()? as usize);
        if count > MAX_SECTIONS || fields.0.len() < 8 * count {
            return None;
        }
        let sections: Vec<u64> = (0..count).map(|_| fields.u64()).collect::<Option<_>>()?;
        let sum = sections.iter().try_fold(0_u64, |sum, length| sum.checked_add(*length))?;
        let task = std::str::from_utf8(fields.0).ok().filter(|task| task.len() <= MAX_TASK_BYTES)?;
        let task = task.to_owned();
        (sum == payload_bytes).then_some(Self { task, index, program, payload, sections, device_time, node })
    }
}

fn check(bytes: &[u8]) -> [u8; CHECK_BYTES] {
    *content_hash(bytes).0.first_chunk().expect("a digest has 32 bytes")
}

/// The bytes before the check at the end, if it is theirs.
fn checked(bytes: &[u8]) -> Option<&[u8]> {
    let (bytes, sum) = bytes.split_last_chunk()?;
    (check(bytes) == *sum).then_some(bytes)
}

/// Fixed fields, taken one after the other.
struct Fields<'a>(&'a [u8]);

impl Fields<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (field, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*field)
    }

    fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.take().map(u64::from_le_bytes)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn metas() -> impl Strategy<Value = Meta> {
        let digests = (any::<[u8; 32]>(), any::<[u8; 32]>());
        let sections = prop::collection::vec(0..1_u64 << 40, 0..20);
        (".{0,40}", any::<u32>(), digests, sections, any::<u64>(), any::<u64>()).prop_map(
            |(task, index, (program, payload), sections, time, node)| Meta {
                task,
                index: JobIndex(index),
                program: ContentHash(program),
                payload: ContentHash(payload),
                sections,
                device_time: Duration::from_nanos(time),
                node: NodeId(node),
            },
        )
    }

    proptest! {
        #[test]
        fn a_meta_comes_back_and_a_changed_one_does_not(
            meta in metas(),
            flip in any::<prop::sample::Index>(),
            bit in 0..8_u32,
        ) {
            let bytes = meta.encode().unwrap();
            let sum = meta.sections.iter().sum();
            prop_assert_eq!(Meta::decode(&bytes, sum), Some(meta));
            prop_assert_eq!(Meta::decode(&bytes, sum + 1), None, "of another payload");
            let mut changed = bytes.clone();
            changed[flip.index(bytes.len())] ^= 1 << bit;
            prop_assert_eq!(Meta::decode(&changed, sum), None);
            prop_assert_eq!(Meta::decode(&bytes[..flip.index(bytes.len())], sum), None, "cut");
        }

        #[test]
        fn a_head_comes_back_where_it_belongs_and_a_changed_one_does_not(
            at in 0..1_u64 << 50,
            durable in 0..1_u64 << 50,
            payload_bytes in 0..1_u64 << 50,
            flip in 0..8 * HEAD_BYTES,
        ) {
            let kind = if at % 2 == 0 { Kind::Result } else { Kind::Writer };
            let head = Head { at, durable: durable.min(at), payload_bytes, meta_bytes: 100, kind };
            let bytes = head.encode();
            prop_assert_eq!(Head::decode(&bytes, at), Some(head));
            prop_assert_eq!(Head::decode(&bytes, at + 1), None, "a copy elsewhere is no record");
            let mut changed = bytes;
            changed[flip / 8] ^= 1 << (flip % 8);
            prop_assert_eq!(Head::decode(&changed, at), None);
        }

        #[test]
        fn any_bytes_give_an_answer(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = (decode_fixed_header(&bytes).is_ok(), decode_header(&bytes).is_ok(), Meta::decode(&bytes, 0));
        }

        #[test]
        fn a_label_comes_back(label in ".{0,100}") {
            let bytes = encode_header(&label);
            prop_assert_eq!(decode_fixed_header(&bytes), Ok(Header { bytes: bytes.len(), signed: true }));
            prop_assert_eq!(decode_header(&bytes), Ok(&*label));
            prop_assert_eq!(decode_header(&bytes[..bytes.len() - 1]), Err(HeaderFault::Damaged));
        }
    }

    #[test]
    fn what_no_file_can_hold_is_no_head() {
        let (payload_bytes, kind) = (u64::MAX - 50, Kind::Result);
        let head = Head { at: 100, durable: 0, payload_bytes, meta_bytes: 100, kind };
        assert_eq!(Head::decode(&head.encode(), 100), None);
        let head = Head { payload_bytes: 0, meta_bytes: u32::MAX, ..head };
        assert_eq!(Head::decode(&head.encode(), 100), None);
        let head = Head { meta_bytes: 100, durable: 101, ..head };
        assert_eq!(Head::decode(&head.encode(), 100), None, "more on disk than there is");
    }

    #[test]
    fn headers_of_others_are_told_apart() {
        let mut other = encode_header("x");
        other[16] = 9;
        assert_eq!(decode_fixed_header(&other), Err(HeaderFault::Version(9)));
        other[16] = 1;
        assert!(decode_fixed_header(&other).is_ok_and(|header| !header.signed));
        assert_eq!(decode_fixed_header(b"v 0.1 an OBJ file, of all things"), Err(HeaderFault::NotAJournal));
    }

    #[test]
    fn a_writer_comes_back_and_a_changed_one_does_not() {
        let bytes = encode_writer(100, AppId(7 << 32 | 1));
        let decode = |bytes: &[u8]| {
            let (head, meta) = bytes.split_first_chunk()?;
            Record::decode(meta, &Head::decode(head, 100)?)
        };
        assert_eq!(decode(&bytes), Some(Record::Writer(AppId(7 << 32 | 1))));
        for at in 0..bytes.len() {
            let mut changed = bytes.clone();
            changed[at] ^= 1;
            assert_eq!(decode(&changed), None, "byte {at}");
        }
    }
}
