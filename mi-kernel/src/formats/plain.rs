//! One sequence per line, as the tools around contact prediction write it (`.aln`). Rows are named by their number.

use super::{Format, Lines, Parsed, append_symbols, check_row_count, finish};
use crate::alignment::{AlignmentError, Row};

/// Reads rows; blank lines are skipped.
pub(super) fn parse(bytes: &[u8]) -> Result<Parsed, AlignmentError> {
    let mut rows = Vec::new();
    for line in Lines::new(bytes) {
        let line = line?;
        let indent = line.text.len() - line.text.trim_ascii_start().len();
        let text = line.text.trim_ascii();
        if text.is_empty() {
            continue;
        }
        check_row_count(rows.len(), line)?;
        let mut symbols = Vec::with_capacity(text.len());
        append_symbols(&mut symbols, line, indent, text, Format::Plain.name())?;
        rows.push(Row { name: (rows.len() + 1).to_string(), line: line.number, symbols });
    }
    finish(rows, Format::Plain)
}

#[cfg(test)]
mod tests {
    use crate::formats::parse;

    #[test]
    fn rows_are_lines() {
        let parsed = parse(b"-AAD\r\n\r\n  --ad  \n").unwrap();
        assert_eq!(parsed.alignment.names(), ["1", "2"]);
        assert_eq!(parsed.alignment.alphabet(), b"-AD");
    }

    #[test]
    fn a_second_word_is_refused_at_its_place() {
        let text = parse(b"ACGT\n  AC GT\n").unwrap_err().to_string();
        assert_eq!(text, "line 2, byte 5: 0x20 is no residue or gap of plain");
    }
}
