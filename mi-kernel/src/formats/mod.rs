//! Bytes to [`Alignment`]: which format it is, told by content, and the readers. Owns the line reader and what a
//! residue and a gap look like; never guesses past what it documents, and never keeps a byte it does not know.

mod fasta;
mod interleaved;
mod plain;

use std::{collections::HashSet, fmt};

use crate::alignment::{Alignment, AlignmentError, GAP, MAX_ROWS, Row};

/// Longest line read. One sequence of 65,536 columns with 255 insertions for each still fits.
pub const MAX_LINE_BYTES: usize = 16 << 20;

/// How an alignment is written down.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Format {
    /// `>name` and residues; case is folded.
    Fasta,
    /// FASTA with insert columns in lower case and `.`; those columns are dropped.
    A2m,
    /// FASTA with insertions in lower case and no column for them elsewhere; insertions are dropped.
    A3m,
    /// `# STOCKHOLM 1.0`, sequential or interleaved; markup is ignored.
    Stockholm,
    /// `CLUSTAL ...` and interleaved blocks; conservation lines are ignored.
    Clustal,
    /// One sequence per line, no names.
    Plain,
}

impl Format {
    /// The name people know it by.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Fasta => "FASTA",
            Self::A2m => "A2M",
            Self::A3m => "A3M",
            Self::Stockholm => "Stockholm",
            Self::Clustal => "Clustal",
            Self::Plain => "plain",
        }
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// What a reader did to the input that its user should know.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ParsingNotes {
    /// As what it was read.
    pub format: Format,
    /// Sequences whose name had been seen before. They are kept.
    pub duplicate_names: usize,
    /// Inserted residues dropped (A2M, A3M).
    pub dropped_insertions: usize,
}

/// An alignment and what happened on the way.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Parsed {
    /// The alignment.
    pub alignment: Alignment,
    /// What happened.
    pub notes: ParsingNotes,
}

/// Reads an alignment in the format that its content shows.
///
/// The first line that is not blank decides: `# STOCKHOLM`, `CLUSTAL` (and the headers of MUSCLE, PROBCONS, MSAPROBS and
/// T-COFFEE), `>`; anything else is plain. Among the formats with `>`, A2M is told by insert columns, A3M by lower
/// case that explains unequal lengths.
///
/// # Errors
/// The place and cause; see [`AlignmentError`].
pub fn parse(bytes: &[u8]) -> Result<Parsed, AlignmentError> {
    let bytes = without_mark(bytes);
    refuse_archives(bytes)?;
    match detect(bytes)? {
        Detected::Family => fasta::parse(bytes, None),
        Detected::One(format) => parse_as(format, bytes),
    }
}

/// Reads an alignment in a format that the user named.
///
/// # Errors
/// As [`parse`].
pub fn parse_as(format: Format, bytes: &[u8]) -> Result<Parsed, AlignmentError> {
    let bytes = without_mark(bytes);
    refuse_archives(bytes)?;
    match format {
        Format::Fasta | Format::A2m | Format::A3m => fasta::parse(bytes, Some(format)),
        Format::Stockholm => interleaved::parse_stockholm(bytes),
        Format::Clustal => interleaved::parse_clustal(bytes),
        Format::Plain => plain::parse(bytes),
    }
}

/// What the first line tells.
enum Detected {
    /// FASTA, A2M or A3M: the sequences decide.
    Family,
    /// One format.
    One(Format),
}

const CLUSTAL_HEADERS: [&[u8]; 5] = [b"CLUSTAL", b"MUSCLE", b"PROBCONS", b"MSAPROBS", b"T-COFFEE"];

fn detect(bytes: &[u8]) -> Result<Detected, AlignmentError> {
    for line in Lines::new(bytes) {
        let line = line?;
        let text = line.text.trim_ascii();
        if text.is_empty() {
            continue;
        }
        if text.starts_with(b"# STOCKHOLM") {
            return Ok(Detected::One(Format::Stockholm));
        }
        // HH-suite and ColabFold put a line of their own before the first name.
        if text.starts_with(b"#") {
            continue;
        }
        if text.starts_with(b">") {
            return Ok(Detected::Family);
        }
        // A header has a second word; a plain row that happens to spell CLUSTAL has none.
        let header = CLUSTAL_HEADERS.iter().any(|word| text.starts_with(word));
        let plain = text.iter().all(|byte| is_symbol(*byte));
        return Ok(Detected::One(if header && (!plain || text == b"CLUSTAL") {
            Format::Clustal
        } else {
            Format::Plain
        }));
    }
    Err(AlignmentError::Empty)
}

fn refuse_archives(bytes: &[u8]) -> Result<(), AlignmentError> {
    const MAGIC: [(&[u8], &str); 4] = [
        (&[0x1f, 0x8b], "gzip"),
        (&[0x28, 0xb5, 0x2f, 0xfd], "zstd"),
        (b"BZh", "bzip2"),
        (b"\xfd7zXZ", "xz"),
    ];
    match MAGIC.iter().find(|(magic, _)| bytes.starts_with(magic)) {
        // BZh alone could be three residues; the archive goes on with a digit.
        Some((b"BZh", _)) if !bytes.get(3).is_some_and(u8::is_ascii_digit) => Ok(()),
        Some((_, with)) => Err(AlignmentError::Compressed { with }),
        None => Ok(()),
    }
}

fn without_mark(bytes: &[u8]) -> &[u8] {
    bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes)
}

/// One line without its end.
#[derive(Clone, Copy)]
struct Line<'a> {
    /// From 1.
    number: usize,
    text: &'a [u8],
}

/// Lines ended by LF or CR LF, each at most [`MAX_LINE_BYTES`].
struct Lines<'a> {
    rest: &'a [u8],
    number: usize,
}

impl<'a> Lines<'a> {
    fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes, number: 0 }
    }
}

impl<'a> Iterator for Lines<'a> {
    type Item = Result<Line<'a>, AlignmentError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.rest.is_empty() {
            return None;
        }
        self.number += 1;
        let end = self.rest.iter().position(|byte| *byte == b'\n').unwrap_or(self.rest.len());
        let text = &self.rest[..end];
        self.rest = self.rest.get(end + 1..).unwrap_or_default();
        if text.len() > MAX_LINE_BYTES {
            self.rest = &[];
            return Some(Err(AlignmentError::LineTooLong { line: self.number, limit_bytes: MAX_LINE_BYTES }));
        }
        Some(Ok(Line { number: self.number, text: text.strip_suffix(b"\r").unwrap_or(text) }))
    }
}

/// A residue or a gap.
fn is_symbol(byte: u8) -> bool {
    byte.is_ascii_alphabetic() || is_gap(byte)
}

/// The ways of writing a gap: also the padding of local alignments and what is not known.
fn is_gap(byte: u8) -> bool {
    matches!(byte, b'-' | b'.' | b'~' | b'*' | b'?')
}

/// A symbol with case folded and every gap as [`GAP`].
fn folded(byte: u8) -> u8 {
    if is_gap(byte) { GAP } else { byte.to_ascii_uppercase() }
}

/// Appends the symbols of a piece of a line that starts at byte `offset` (from 0) of the line.
fn append_symbols(
    target: &mut Vec<u8>,
    line: Line<'_>,
    offset: usize,
    piece: &[u8],
    format: &'static str,
) -> Result<(), AlignmentError> {
    if let Some(at) = piece.iter().position(|byte| !is_symbol(*byte)) {
        return Err(AlignmentError::InvalidSymbol {
            line: line.number,
            position: offset + at + 1,
            byte: piece[at],
            format,
        });
    }
    target.extend_from_slice(piece);
    Ok(())
}

/// A name from a piece of a line at byte `offset` (from 0); bytes that are not UTF-8 become U+FFFD.
fn name_from(line: Line<'_>, offset: usize, piece: &[u8]) -> Result<String, AlignmentError> {
    if let Some(at) = piece.iter().position(u8::is_ascii_control) {
        return Err(AlignmentError::InvalidName {
            line: line.number,
            position: offset + at + 1,
            byte: piece[at],
        });
    }
    Ok(String::from_utf8_lossy(piece).into_owned())
}

fn check_row_count(rows: usize, line: Line<'_>) -> Result<(), AlignmentError> {
    if rows >= MAX_ROWS {
        return Err(AlignmentError::TooManyRows { line: line.number, limit: MAX_ROWS });
    }
    Ok(())
}

/// Folds rows that keep every column, and closes the reading.
fn finish(mut rows: Vec<Row>, format: Format) -> Result<Parsed, AlignmentError> {
    for symbol in rows.iter_mut().flat_map(|row| &mut row.symbols) {
        *symbol = folded(*symbol);
    }
    finish_folded(rows, format, 0)
}

fn finish_folded(
    rows: Vec<Row>,
    format: Format,
    dropped_insertions: usize,
) -> Result<Parsed, AlignmentError> {
    let mut seen = HashSet::with_capacity(rows.len());
    let duplicate_names = rows.iter().filter(|row| !seen.insert(row.name.as_str())).count();
    drop(seen);
    let alignment = Alignment::from_rows(rows, format.name())?;
    Ok(Parsed { alignment, notes: ParsingNotes { format, duplicate_names, dropped_insertions } })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(bytes: &[u8]) -> AlignmentError {
        parse(bytes).expect_err("this input is broken")
    }

    #[test]
    fn each_format_is_told_by_its_content() {
        let cases: [(&[u8], Format); 8] = [
            (b">a\nAC\n>b\nAG\n", Format::Fasta),
            (b"#2\t1\n>a\nAC\n>b\nAttG\n", Format::A3m),
            (b">a\nA.C\n>b\nAtG\n", Format::A2m),
            (b"\n# STOCKHOLM 1.0\na AC\nb AG\n//\n", Format::Stockholm),
            (b"CLUSTAL W (1.82) multiple alignment\n\na AC\nb AG\n  * \n", Format::Clustal),
            (b"MUSCLE (3.8) multiple sequence alignment\n\na AC\nb AG\n", Format::Clustal),
            (b"AC\nAG\n", Format::Plain),
            (b"CLUSTALACDE\nMUSCLEFFGHI\n", Format::Plain),
        ];
        for (bytes, format) in cases {
            assert_eq!(
                parse(bytes).map(|parsed| parsed.notes.format),
                Ok(format),
                "{}",
                bytes.escape_ascii()
            );
        }
    }

    #[test]
    fn archives_are_named() {
        assert_eq!(error(b"\x1f\x8b\x08\0\0"), AlignmentError::Compressed { with: "gzip" });
        assert_eq!(error(b"\x28\xb5\x2f\xfd\0"), AlignmentError::Compressed { with: "zstd" });
        assert_eq!(error(b"BZh91AY"), AlignmentError::Compressed { with: "bzip2" });
        assert!(parse(b"BZhA\nBZhC\n").is_ok(), "B, Z and H are residues");
    }

    #[test]
    fn nothing_and_one_are_refused() {
        assert_eq!(error(b""), AlignmentError::Empty);
        assert_eq!(error(b"\n \r\n\n"), AlignmentError::Empty);
        assert_eq!(error(b"\xef\xbb\xbf"), AlignmentError::Empty);
        assert_eq!(error(b"# only a remark\n"), AlignmentError::Empty);
        assert_eq!(error(b">a\nACGT\n"), AlignmentError::OneSequence { line: 1, name: "a".into() });
        assert_eq!(error(b"ACGT"), AlignmentError::OneSequence { line: 1, name: "1".into() });
    }

    #[test]
    fn binary_junk_is_placed() {
        let invalid =
            |line, position, byte, format| AlignmentError::InvalidSymbol { line, position, byte, format };
        assert_eq!(error(b"\x7fELF\x02\x01"), invalid(1, 1, 0x7f, "plain"));
        assert_eq!(error(b"ACGT\nAC\0T\n"), invalid(2, 3, 0, "plain"));
        assert_eq!(error(b">a\nACGT\n>b\nAC5T\n"), invalid(4, 3, b'5', "FASTA"));
        assert_eq!(error(b">a\x01\nACGT\n"), AlignmentError::InvalidName { line: 1, position: 3, byte: 1 });
    }

    #[test]
    fn a_huge_line_is_bounded() {
        let mut bytes = b">a\n".to_vec();
        bytes.resize(bytes.len() + MAX_LINE_BYTES + 1, b'A');
        assert_eq!(error(&bytes), AlignmentError::LineTooLong { line: 2, limit_bytes: MAX_LINE_BYTES });
    }

    #[test]
    fn the_end_of_a_line_and_the_byte_order_mark_do_not_matter() {
        let unix = parse(b">a\nAC\n>b\nAG\n").unwrap();
        assert_eq!(parse(b"\xef\xbb\xbf>a\r\nAC\r\n>b\r\nAG").unwrap(), unix);
    }
}
