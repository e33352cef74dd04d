//! FASTA, A2M and A3M: the same records, told apart by what lower case and `.` must mean.

use super::{
    Format, Line, Lines, Parsed, append_symbols, check_row_count, finish, finish_folded, folded, name_from,
};
use crate::alignment::{AlignmentError, Row};

const FAMILY: &str = "FASTA";

/// Reads records and settles the format, unless the user named it.
pub(super) fn parse(bytes: &[u8], named: Option<Format>) -> Result<Parsed, AlignmentError> {
    let rows = records(bytes)?;
    match named.unwrap_or_else(|| told_by_rows(&rows)) {
        format @ (Format::A2m | Format::A3m) => {
            let (rows, dropped) = without_insertions(rows);
            finish_folded(rows, format, dropped)
        }
        format => finish(rows, format),
    }
}

fn records(bytes: &[u8]) -> Result<Vec<Row>, AlignmentError> {
    let mut rows: Vec<Row> = Vec::new();
    for line in Lines::new(bytes) {
        let line = line?;
        if let Some(header) = line.text.strip_prefix(b">") {
            check_row_count(rows.len(), line)?;
            let name = record_name(line, header, rows.len())?;
            rows.push(Row { name, line: line.number, symbols: Vec::new() });
            continue;
        }
        let Some(row) = rows.last_mut() else {
            if line.text.trim_ascii().is_empty() || line.text.starts_with(b"#") {
                continue;
            }
            return Err(AlignmentError::Unexpected {
                line: line.number,
                expected: "a line with >name",
                format: FAMILY,
            });
        };
        // Blanks inside a sequence line are layout (blocks of ten).
        let mut offset = 0;
        for piece in line.text.split(|byte| matches!(byte, b' ' | b'\t')) {
            append_symbols(&mut row.symbols, line, offset, piece, FAMILY)?;
            offset += piece.len() + 1;
        }
    }
    Ok(rows)
}

/// The first word after `>`; a record without one is named by its place.
fn record_name(line: Line<'_>, header: &[u8], index: usize) -> Result<String, AlignmentError> {
    let blanks = header.iter().take_while(|byte| byte.is_ascii_whitespace()).count();
    let word = header[blanks..].split(u8::is_ascii_whitespace).next().unwrap_or_default();
    if word.is_empty() {
        return Ok(format!("sequence-{}", index + 1));
    }
    name_from(line, 1 + blanks, word)
}

fn told_by_rows(rows: &[Row]) -> Format {
    let Some(first) = rows.first() else { return Format::Fasta };
    let unlike_first = |length: fn(&Row) -> usize| {
        let wanted = length(first);
        rows.iter().filter(|row| length(row) != wanted).count()
    };
    let unequal = unlike_first(|row| row.symbols.len());
    if unequal == 0 {
        return if has_insert_columns(rows) { Format::A2m } else { Format::Fasta };
    }
    // The reading with fewer rows out of step: one broken row of an A3M is then reported as A3M, with its aligned length.
    if unlike_first(aligned_length) < unequal { Format::A3m } else { Format::Fasta }
}

/// Lower case and `.` only ever share a column with each other, `.` does occur, and aligned columns exist. Without `.`,
/// or in a column with upper case, lower case is someone's masking and is folded.
fn has_insert_columns(rows: &[Row]) -> bool {
    const INSERT: u8 = 1;
    const ALIGNED: u8 = 2;
    const BOTH: u8 = INSERT | ALIGNED;
    let columns = rows.first().map_or(0, |row| row.symbols.len());
    let mut kinds = vec![0u8; columns];
    let mut dot = false;
    for row in rows {
        for (kind, symbol) in kinds.iter_mut().zip(&row.symbols) {
            *kind |= if is_insertion(*symbol) { INSERT } else { ALIGNED };
            dot |= *symbol == b'.';
        }
    }
    dot && kinds.contains(&ALIGNED) && !kinds.contains(&BOTH)
}

fn is_insertion(symbol: u8) -> bool {
    symbol.is_ascii_lowercase() || symbol == b'.'
}

fn aligned_length(row: &Row) -> usize {
    row.symbols.iter().filter(|symbol| !is_insertion(**symbol)).count()
}

fn without_insertions(mut rows: Vec<Row>) -> (Vec<Row>, usize) {
    let mut dropped = 0;
    for row in &mut rows {
        dropped += row.symbols.iter().filter(|symbol| symbol.is_ascii_lowercase()).count();
        row.symbols.retain(|symbol| !is_insertion(*symbol));
        for symbol in &mut row.symbols {
            *symbol = folded(*symbol);
        }
    }
    (rows, dropped)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        alignment::Alignment,
        formats::{parse, parse_as},
    };

    fn rows_of(alignment: &Alignment) -> Vec<String> {
        let row = |row| (0..alignment.l()).map(|column| char::from(alignment.symbol(row, column))).collect();
        (0..alignment.n()).map(row).collect()
    }

    #[test]
    fn names_blanks_and_case() {
        let parsed = parse(b">one two three\nacgt ACGT\n\n\tAC\n> b\nACGTACGT--\n>\n....~~*?AC\n").unwrap();
        assert_eq!(parsed.notes.format, Format::Fasta);
        assert_eq!(parsed.alignment.names(), ["one", "b", "sequence-3"]);
        assert_eq!(rows_of(&parsed.alignment), ["ACGTACGTAC", "ACGTACGT--", "--------AC"]);
    }

    #[test]
    fn duplicate_names_are_kept_and_counted() {
        let parsed = parse(b">a\nAC\n>a\nAG\n>b\nAT\n>a x\nAA\n").unwrap();
        assert_eq!(parsed.notes.duplicate_names, 2);
        assert_eq!(parsed.alignment.n(), 4);
    }

    #[test]
    fn insertions_of_a3m_are_dropped() {
        let parsed = parse(b">a\nACGT\n>b\nAkkC-T\n>c\n-CGTw\n").unwrap();
        assert_eq!(parsed.notes.format, Format::A3m);
        assert_eq!(parsed.notes.dropped_insertions, 3);
        assert_eq!(rows_of(&parsed.alignment), ["ACGT", "AC-T", "-CGT"]);
    }

    #[test]
    fn insert_columns_of_a2m_are_dropped() {
        let parsed = parse(b">a\nAC.GT\n>b\nACkG-\n").unwrap();
        assert_eq!((parsed.notes.format, parsed.notes.dropped_insertions), (Format::A2m, 1));
        assert_eq!(rows_of(&parsed.alignment), ["ACGT", "ACG-"]);
    }

    #[test]
    fn masking_and_dotted_gaps_stay_fasta() {
        for text in ["acgt\n>b\nacga", "ACgT\n>b\nACaT", "AC.T\n>b\nACGT", "ac.t\n>b\nacgt"] {
            let parsed = parse(format!(">a\n{text}\n").as_bytes()).unwrap();
            assert_eq!((parsed.notes.format, parsed.alignment.l()), (Format::Fasta, 4), "{text}");
        }
    }

    #[test]
    fn a_named_format_overrides_the_guess() {
        let bytes = b">a\nACgT\n>b\nACaT\n";
        assert_eq!(parse(bytes).unwrap().alignment.l(), 4);
        assert_eq!(parse_as(Format::A3m, bytes).unwrap().alignment.l(), 3);
    }

    #[test]
    fn unequal_lengths_name_line_and_both_lengths() {
        let text = parse(b">a\nACGT\n>b\nACG\n").unwrap_err().to_string();
        assert_eq!(
            text,
            "line 3: sequence b has 3 columns as FASTA, but the first sequence (a, line 1) has 4"
        );
        let text = parse(b">a\nACGT\n>b\nAkCGT\n>c\nACkkGT\n>d\nAkCG\n").unwrap_err().to_string();
        assert_eq!(text, "line 7: sequence d has 3 columns as A3M, but the first sequence (a, line 1) has 4");
    }

    #[test]
    fn a_name_without_residues_is_placed() {
        let error = parse(b">a\nACGT\n>b\n>c\nACGT\n").unwrap_err();
        assert_eq!(error, AlignmentError::EmptySequence { line: 3, name: "b".into() });
        assert!(matches!(
            parse_as(Format::Fasta, b"ACGT\n"),
            Err(AlignmentError::Unexpected { line: 1, .. })
        ));
    }
}
