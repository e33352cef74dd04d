//! Stockholm and Clustal: lines of `name residues`, where a name that comes again goes on with its sequence.

use std::collections::HashMap;

use super::{Format, Line, Lines, Parsed, append_symbols, check_row_count, finish, name_from};
use crate::alignment::{AlignmentError, Row};

/// Reads one Stockholm alignment up to `//`. All markup (`#=GF`, `#=GC`, `#=GS`, `#=GR`) is ignored, case is folded.
pub(super) fn parse_stockholm(bytes: &[u8]) -> Result<Parsed, AlignmentError> {
    let mut blocks = Blocks::new(Format::Stockholm);
    let mut header = false;
    let mut ended = false;
    for line in Lines::new(bytes) {
        let line = line?;
        let text = line.text.trim_ascii();
        if text.is_empty() {
            continue;
        }
        if ended {
            return Err(AlignmentError::SecondAlignment { line: line.number });
        }
        if !header {
            if !text.starts_with(b"# STOCKHOLM") {
                return Err(blocks.unexpected(line, "the header \"# STOCKHOLM 1.0\""));
            }
            header = true;
        } else if text == b"//" {
            ended = true;
        } else if !text.starts_with(b"#") {
            blocks.add(line)?;
        }
    }
    if header && !ended {
        return Err(AlignmentError::Truncated);
    }
    finish(blocks.rows, Format::Stockholm)
}

/// Reads one Clustal alignment. Lines that start with a blank show conservation and are ignored, as are the counts
/// at the ends of lines.
pub(super) fn parse_clustal(bytes: &[u8]) -> Result<Parsed, AlignmentError> {
    let mut blocks = Blocks::new(Format::Clustal);
    let mut header = false;
    for line in Lines::new(bytes) {
        let line = line?;
        if line.text.trim_ascii().is_empty() {
            continue;
        }
        if !header {
            header = true;
        } else if !line.text.starts_with(b" ") && !line.text.starts_with(b"\t") {
            blocks.add(line)?;
        }
    }
    finish(blocks.rows, Format::Clustal)
}

/// Sequences that grow block by block.
struct Blocks {
    format: Format,
    rows: Vec<Row>,
    index_of: HashMap<Vec<u8>, usize>,
}

impl Blocks {
    fn new(format: Format) -> Self {
        Self { format, rows: Vec::new(), index_of: HashMap::new() }
    }

    fn add(&mut self, line: Line<'_>) -> Result<(), AlignmentError> {
        let mut words = Words { text: line.text, offset: 0 };
        let name = words.next();
        let piece = words.next();
        let count = words.next();
        let (Some((name_offset, name)), Some((piece_offset, piece))) = (name, piece) else {
            return Err(self.unexpected(line, "a name and residues"));
        };
        let count_allowed = self.format == Format::Clustal;
        if count.is_some_and(|(_, count)| !count_allowed || !count.iter().all(u8::is_ascii_digit))
            || words.next().is_some()
        {
            return Err(self.unexpected(line, "a name and residues, nothing more"));
        }
        let index = match self.index_of.get(name) {
            Some(index) => *index,
            None => {
                check_row_count(self.rows.len(), line)?;
                let shown = name_from(line, name_offset, name)?;
                self.rows.push(Row { name: shown, line: line.number, symbols: Vec::new() });
                self.index_of.insert(name.to_vec(), self.rows.len() - 1);
                self.rows.len() - 1
            }
        };
        let row = &mut self.rows[index];
        // The latest line of a sequence is where a wrong length shows.
        row.line = line.number;
        append_symbols(&mut row.symbols, line, piece_offset, piece, self.format.name())
    }

    fn unexpected(&self, line: Line<'_>, expected: &'static str) -> AlignmentError {
        AlignmentError::Unexpected { line: line.number, expected, format: self.format.name() }
    }
}

/// Words of a line with their offsets from 0.
struct Words<'a> {
    text: &'a [u8],
    offset: usize,
}

impl<'a> Iterator for Words<'a> {
    type Item = (usize, &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let rest = self.text.get(self.offset..)?;
        let start = self.offset + rest.iter().position(|byte| !byte.is_ascii_whitespace())?;
        let word = self.text[start..].split(u8::is_ascii_whitespace).next()?;
        self.offset = start + word.len();
        Some((start, word))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::{parse, parse_as};

    #[test]
    fn stockholm_blocks_join_and_markup_is_ignored() {
        let text = b"# STOCKHOLM 1.0\n#=GF ID test\n\na/1-4  AC\nb/1-4  a.\n#=GC RF xx\n\na/1-4  GT\nb/1-4  GA\n//\n\n";
        let parsed = parse(text).unwrap();
        assert_eq!(parsed.notes.format, Format::Stockholm);
        assert_eq!(parsed.alignment.names(), ["a/1-4", "b/1-4"]);
        assert_eq!(parsed.alignment.l(), 4);
        assert_eq!(parsed.alignment.symbol(1, 1), b'-');
    }

    #[test]
    fn stockholm_must_end_and_end_once() {
        assert_eq!(parse(b"# STOCKHOLM 1.0\na AC\nb AC\n").unwrap_err(), AlignmentError::Truncated);
        let two = b"# STOCKHOLM 1.0\na AC\nb AC\n//\n# STOCKHOLM 1.0\n";
        assert_eq!(parse(two).unwrap_err(), AlignmentError::SecondAlignment { line: 5 });
        let error = parse_as(Format::Stockholm, b"a AC\n").unwrap_err();
        assert!(matches!(error, AlignmentError::Unexpected { line: 1, .. }), "{error}");
        assert_eq!(parse(b"# STOCKHOLM 1.0\n//\n").unwrap_err(), AlignmentError::Empty);
    }

    #[test]
    fn clustal_with_counts_and_conservation() {
        let text = b"CLUSTAL O(1.2.4) multiple sequence alignment\n\n\na      AC-T 3\nbb     ACGT 4\n       ** *\n\na      AA 5\nbb     AA 6\n       **\n";
        let parsed = parse(text).unwrap();
        assert_eq!((parsed.alignment.n(), parsed.alignment.l()), (2, 6));
    }

    #[test]
    fn a_sequence_missing_from_a_block_is_found() {
        let text = parse(b"CLUSTAL\n\na AC\nb AC\n\na GT\n").unwrap_err().to_string();
        assert_eq!(
            text,
            "line 4: sequence b has 2 columns as Clustal, but the first sequence (a, line 6) has 4"
        );
    }

    #[test]
    fn a_line_with_too_few_or_too_many_words_is_placed() {
        for (text, line) in [("a\n", 3), ("a AC GT\n", 3), ("a AC 2 2\n", 3), ("a AC\nb A1\n", 4)] {
            let error = parse(format!("CLUSTAL\n\n{text}").as_bytes()).unwrap_err();
            assert!(error.to_string().starts_with(&format!("line {line}")), "{error}");
        }
    }
}
