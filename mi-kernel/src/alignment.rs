//! The alignment as the kernels read it: dense symbol codes, column after column. Owns the checks that hold for every
//! format (equal lengths, at least two sequences, bounds); never reads a format.

use std::fmt;

use thiserror::Error;

use crate::GapMode;

/// Most sequences of one alignment: keeps `N * log2(q) * 2^s` inside 31 bits with 8 fractional bits left.
pub const MAX_ROWS: usize = 1 << 20;

/// Most columns of one alignment: 2^31 pairs, past every known protein.
pub const MAX_COLUMNS: usize = 1 << 16;

/// The gap symbol; every other way of writing a gap is folded to it.
pub const GAP: u8 = b'-';

/// Why bytes are not an alignment. Not to be retried. Lines and positions count from 1.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum AlignmentError {
    /// Nothing but blank lines.
    #[error("the input holds no sequence")]
    Empty,
    /// Mutual information needs variation over sequences.
    #[error("line {line}: only one sequence ({name}); an alignment needs at least two")]
    OneSequence {
        /// Where it stands.
        line: usize,
        /// Its name.
        name: String,
    },
    /// A name without residues, or with insertions only.
    #[error("line {line}: sequence {name} has no aligned residue")]
    EmptySequence {
        /// Where it stands.
        line: usize,
        /// Its name.
        name: String,
    },
    /// The sequences are not aligned.
    #[error(
        "line {line}: sequence {name} has {length} columns as {format}, but the first sequence ({first_name}, line \
         {first_line}) has {first_length}"
    )]
    UnequalLengths {
        /// Where the sequence stands.
        line: usize,
        /// Its name.
        name: String,
        /// Its columns.
        length: usize,
        /// Where the first sequence stands.
        first_line: usize,
        /// Its name.
        first_name: String,
        /// Its columns.
        first_length: usize,
        /// How the input was read.
        format: &'static str,
    },
    /// A byte that is neither residue nor gap.
    #[error("line {line}, byte {position}: {} is no residue or gap of {format}", Shown(*.byte))]
    InvalidSymbol {
        /// Its line.
        line: usize,
        /// Its place in the line.
        position: usize,
        /// The byte.
        byte: u8,
        /// How the input was read.
        format: &'static str,
    },
    /// A control character in a name.
    #[error("line {line}, byte {position}: {} in a sequence name; is this a text file?", Shown(*.byte))]
    InvalidName {
        /// Its line.
        line: usize,
        /// Its place in the line.
        position: usize,
        /// The byte.
        byte: u8,
    },
    /// The input is an archive.
    #[error("the input is compressed with {with}; decompress it first")]
    Compressed {
        /// `gzip`, `zstd`, ...
        with: &'static str,
    },
    /// A line that the format has no place for.
    #[error("line {line}: expected {expected} ({format})")]
    Unexpected {
        /// The line.
        line: usize,
        /// What could stand there.
        expected: &'static str,
        /// How the input was read.
        format: &'static str,
    },
    /// The end mark is missing: most likely a download that broke off.
    #[error("the input ends without \"//\"; a Stockholm file that was cut short?")]
    Truncated,
    /// More than one alignment in one file.
    #[error("line {line}: a second alignment begins; split the file")]
    SecondAlignment {
        /// Where it begins.
        line: usize,
    },
    /// A line past [`crate::MAX_LINE_BYTES`].
    #[error("line {line}: longer than {limit_bytes} bytes")]
    LineTooLong {
        /// The line.
        line: usize,
        /// The limit.
        limit_bytes: usize,
    },
    /// Too many sequences.
    #[error("line {line}: more than {limit} sequences")]
    TooManyRows {
        /// Where the first one too many stands.
        line: usize,
        /// The limit.
        limit: usize,
    },
    /// Too many columns.
    #[error("line {line}: sequence {name} has {length} columns; the limit is {limit}")]
    TooManyColumns {
        /// Where it stands.
        line: usize,
        /// Its name.
        name: String,
        /// Its columns.
        length: usize,
        /// The limit.
        limit: usize,
    },
}

/// A byte as a reader can find it: the character where it prints, and its value.
struct Shown(u8);

impl fmt::Display for Shown {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.is_ascii_graphic() {
            write!(f, "'{}' (0x{:02x})", char::from(self.0), self.0)
        } else {
            write!(f, "0x{:02x}", self.0)
        }
    }
}

/// N sequences of L columns over the symbols that occur.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Alignment {
    names: Vec<String>,
    /// Symbol codes, column after column: `codes[column * n + row]`.
    codes: Vec<u8>,
    /// The symbol of each code, ascending; the gap, where it occurs, is therefore code 0.
    alphabet: Vec<u8>,
    /// The number of each column in the input, from 1.
    numbers: Vec<usize>,
    gaps: GapMode,
}

/// One sequence as a format reader delivers it: upper-case letters and [`GAP`] only.
#[derive(Clone, Debug)]
pub(crate) struct Row {
    pub(crate) name: String,
    /// Where a reader of an error should look.
    pub(crate) line: usize,
    pub(crate) symbols: Vec<u8>,
}

/// Longest piece of a name that an error repeats, in characters.
const EXCERPT_CHARS: usize = 60;

/// The start of a name.
fn excerpt(name: &str) -> String {
    match name.char_indices().nth(EXCERPT_CHARS) {
        Some((end, _)) => format!("{}...", &name[..end]),
        None => name.to_owned(),
    }
}

impl Alignment {
    /// Checks rows of one format and turns them into columns of codes.
    pub(crate) fn from_rows(rows: Vec<Row>, format: &'static str) -> Result<Self, AlignmentError> {
        let first = rows.first().ok_or(AlignmentError::Empty)?;
        let (n, l) = (rows.len(), first.symbols.len());
        if n == 1 {
            return Err(AlignmentError::OneSequence { line: first.line, name: excerpt(&first.name) });
        }
        if let Some(row) = rows.get(MAX_ROWS) {
            return Err(AlignmentError::TooManyRows { line: row.line, limit: MAX_ROWS });
        }
        for row in &rows {
            if row.symbols.is_empty() {
                return Err(AlignmentError::EmptySequence { line: row.line, name: excerpt(&row.name) });
            }
            if row.symbols.len() != l {
                return Err(AlignmentError::UnequalLengths {
                    line: row.line,
                    name: excerpt(&row.name),
                    length: row.symbols.len(),
                    first_line: first.line,
                    first_name: excerpt(&first.name),
                    first_length: l,
                    format,
                });
            }
        }
        if l > MAX_COLUMNS {
            let (line, name) = (first.line, excerpt(&first.name));
            return Err(AlignmentError::TooManyColumns { line, name, length: l, limit: MAX_COLUMNS });
        }
        let mut symbols = vec![0_u8; n * l];
        for (r, row) in rows.iter().enumerate() {
            for (column, symbol) in row.symbols.iter().enumerate() {
                symbols[column * n + r] = *symbol;
            }
        }
        let (codes, alphabet) = coded(symbols);
        let names = rows.into_iter().map(|row| row.name).collect();
        Ok(Self { names, codes, alphabet, numbers: (1..=l).collect(), gaps: GapMode::default() })
    }

    /// Some of its sequences and columns, at least one of each, both ascending; the alphabet is what occurs in them.
    pub(crate) fn select(&self, rows: &[usize], columns: &[usize]) -> Self {
        let picked = |column: &usize| {
            let codes = self.column(*column);
            rows.iter().map(|row| self.alphabet[usize::from(codes[*row])])
        };
        let (codes, alphabet) = coded(columns.iter().flat_map(picked).collect());
        let names = rows.iter().map(|row| self.names[*row].clone()).collect();
        let numbers = columns.iter().map(|column| self.numbers[*column]).collect();
        Self { names, codes, alphabet, numbers, gaps: self.gaps }
    }

    /// The same alignment, its gaps counted in another way.
    #[must_use]
    pub fn with_gaps(self, gaps: GapMode) -> Self {
        Self { gaps, ..self }
    }

    /// How gaps count. Without any, all ways are one.
    #[must_use]
    pub fn gaps(&self) -> GapMode {
        if self.alphabet.first() == Some(&GAP) { self.gaps } else { GapMode::Ormi }
    }

    /// Number of sequences, N; at least 2.
    #[must_use]
    pub fn n(&self) -> usize {
        self.names.len()
    }

    /// Number of columns, L; at least 1.
    #[must_use]
    pub fn l(&self) -> usize {
        self.numbers.len()
    }

    /// What a column is called: its number in the input, from 1. Filters leave gaps in these.
    ///
    /// # Panics
    /// `column` is not below L.
    #[must_use]
    pub fn number(&self, column: usize) -> usize {
        self.numbers[column]
    }

    /// Number of symbols that occur, q; 1 to 27.
    #[must_use]
    pub fn q(&self) -> usize {
        self.alphabet.len()
    }

    /// Names in the order of the input; they may repeat.
    #[must_use]
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// The symbol of each code, ascending: upper-case letters and [`GAP`].
    #[must_use]
    pub fn alphabet(&self) -> &[u8] {
        &self.alphabet
    }

    /// The codes of one column, N of them, each below q.
    ///
    /// # Panics
    /// `column` is not below L.
    #[must_use]
    pub fn column(&self, column: usize) -> &[u8] {
        let n = self.n();
        &self.codes[column * n..(column + 1) * n]
    }

    /// The symbol of one sequence in one column.
    ///
    /// # Panics
    /// `row` is not below N or `column` not below L.
    #[must_use]
    pub fn symbol(&self, row: usize, column: usize) -> u8 {
        self.alphabet[usize::from(self.column(column)[row])]
    }

    /// Share of gaps among all N * L symbols, 0 to 1.
    #[must_use]
    pub fn gap_share(&self) -> f64 {
        if self.alphabet.first() != Some(&GAP) {
            return 0.0;
        }
        let gaps = self.codes.iter().filter(|code| **code == 0).count();
        gaps as f64 / self.codes.len() as f64
    }
}

/// Dense codes in the place of symbols, and the symbol of each code, ascending.
fn coded(mut symbols: Vec<u8>) -> (Vec<u8>, Vec<u8>) {
    let mut occurs = [false; 256];
    for symbol in &symbols {
        occurs[usize::from(*symbol)] = true;
    }
    let alphabet: Vec<u8> = (0..=u8::MAX).filter(|symbol| occurs[usize::from(*symbol)]).collect();
    let mut code_of = [0_u8; 256];
    for (code, symbol) in (0_u8..).zip(&alphabet) {
        code_of[usize::from(*symbol)] = code;
    }
    for symbol in &mut symbols {
        *symbol = code_of[usize::from(*symbol)];
    }
    (symbols, alphabet)
}

impl fmt::Display for Alignment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let alphabet = String::from_utf8_lossy(&self.alphabet);
        write!(
            f,
            "{} sequences, {} columns, {} symbols ({alphabet}), {:.1} % gaps",
            self.n(),
            self.l(),
            self.q(),
            100.0 * self.gap_share()
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(line: usize, symbols: &str) -> Row {
        Row { name: format!("s{line}"), line, symbols: symbols.as_bytes().to_vec() }
    }

    #[test]
    fn codes_are_dense_and_column_by_column() {
        let alignment = Alignment::from_rows(vec![row(1, "A-C"), row(2, "ZAC")], "plain").unwrap();
        assert_eq!(alignment.alphabet(), b"-ACZ");
        assert_eq!((alignment.n(), alignment.l(), alignment.q()), (2, 3, 4));
        assert_eq!(alignment.column(0), [1, 3]);
        assert_eq!(alignment.column(1), [0, 1]);
        assert_eq!(alignment.symbol(1, 0), b'Z');
        assert_eq!(alignment.to_string(), "2 sequences, 3 columns, 4 symbols (-ACZ), 16.7 % gaps");
    }

    #[test]
    fn an_error_shows_where_to_look() {
        let error = Alignment::from_rows(vec![row(1, "ACC"), row(4, "AC")], "FASTA").unwrap_err();
        let text = "line 4: sequence s4 has 2 columns as FASTA, but the first sequence (s1, line 1) has 3";
        assert_eq!(error.to_string(), text);
        let error = AlignmentError::InvalidSymbol { line: 3, position: 7, byte: b'!', format: "FASTA" };
        assert_eq!(error.to_string(), "line 3, byte 7: '!' (0x21) is no residue or gap of FASTA");
    }

    #[test]
    fn too_wide_is_refused() {
        let wide = "A".repeat(MAX_COLUMNS + 1);
        let error = Alignment::from_rows(vec![row(1, &wide), row(2, &wide)], "plain").unwrap_err();
        assert!(matches!(error, AlignmentError::TooManyColumns { limit: MAX_COLUMNS, .. }), "{error}");
    }
}
