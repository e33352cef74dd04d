//! Readers of alignments: what one writes in any format comes back the same, and no input makes them panic.

#![allow(clippy::unwrap_used, reason = "a panic in a test is its failure, also in its helpers")]

use std::fmt::Write as _;

use mi_kernel::{Alignment, AlignmentError, Format, parse, parse_as};
use proptest::prelude::*;

const FORMATS: [Format; 6] =
    [Format::Fasta, Format::A2m, Format::A3m, Format::Stockholm, Format::Clustal, Format::Plain];

/// Rows over upper case and '-', all of one length.
fn rows() -> impl Strategy<Value = Vec<String>> {
    (2usize..8, 1usize..70).prop_flat_map(|(n, l)| {
        let symbol = prop::sample::select(b"ACDEFGHIKLMNPQRSTVWY-".to_vec()).prop_map(char::from);
        prop::collection::vec(prop::collection::vec(symbol, l).prop_map(String::from_iter), n)
    })
}

fn written(format: Format, rows: &[String], end: &str) -> String {
    let mut text = String::new();
    let mut line = |line: &str| write!(text, "{line}{end}").unwrap();
    let blocks = |line: &mut dyn FnMut(&str)| {
        for start in (0..rows[0].len()).step_by(25) {
            for (r, row) in rows.iter().enumerate() {
                line(&format!("row_{r}/1-9    {}", &row[start..row.len().min(start + 25)]));
            }
            line("");
        }
    };
    match format {
        Format::Fasta | Format::A3m | Format::A2m => {
            for (r, row) in rows.iter().enumerate() {
                line(&format!(">row_{r} of a test"));
                for piece in row.as_bytes().chunks(60) {
                    line(std::str::from_utf8(piece).unwrap());
                }
            }
        }
        Format::Stockholm => {
            line("# STOCKHOLM 1.0");
            line("#=GF ID test");
            blocks(&mut line);
            line("//");
        }
        Format::Clustal => {
            line("CLUSTAL O(1.2.4) multiple sequence alignment");
            line("");
            blocks(&mut line);
        }
        Format::Plain => rows.iter().for_each(|row| line(row)),
    }
    text
}

/// Adds residues that A2M and A3M drop again: one insertion after each of `places`, dots elsewhere for A2M.
fn with_insertions(format: Format, rows: &[String], place: usize) -> Vec<String> {
    let insert = |(r, row): (usize, &String)| {
        let at = place.min(row.len());
        let piece = match (format, r % 2) {
            (Format::A2m, 0) => "k.",
            (Format::A2m, _) => "..",
            (_, 0) => "kw",
            _ => "",
        };
        format!("{}{piece}{}", &row[..at], &row[at..])
    };
    rows.iter().enumerate().map(insert).collect()
}

fn symbols(alignment: &Alignment) -> Vec<String> {
    let row = |row| (0..alignment.l()).map(|column| char::from(alignment.symbol(row, column))).collect();
    (0..alignment.n()).map(row).collect()
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn what_is_written_comes_back(rows in rows(), place in 0usize..70, crlf: bool) {
        let end = if crlf { "\r\n" } else { "\n" };
        for format in FORMATS {
            let text = match format {
                Format::A2m | Format::A3m => written(format, &with_insertions(format, &rows, place), end),
                _ => written(format, &rows, end),
            };
            let parsed = parse(text.as_bytes()).map_err(|error| TestCaseError::fail(format!("{error}\n{text}")))?;
            prop_assert_eq!(parsed.notes.format, format);
            prop_assert_eq!(&symbols(&parsed.alignment), &rows);
            prop_assert_eq!(&parse_as(format, text.as_bytes()), &Ok(parsed));
        }
    }

    #[test]
    fn no_bytes_make_a_reader_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = parse(&bytes);
        for format in FORMATS {
            let _ = parse_as(format, &bytes);
        }
    }

    #[test]
    fn no_damage_makes_a_reader_panic(
        rows in rows(),
        format in prop::sample::select(FORMATS.to_vec()),
        damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
        cut in any::<prop::sample::Index>(),
    ) {
        let mut bytes = written(format, &rows, "\n").into_bytes();
        for (place, byte) in damage {
            let place = place.index(bytes.len());
            bytes[place] = byte;
        }
        bytes.truncate(cut.index(bytes.len() + 1));
        let lines = bytes.iter().filter(|byte| **byte == b'\n').count() + 1;
        for result in [parse(&bytes), parse_as(format, &bytes)] {
            match result {
                Ok(parsed) => prop_assert!(parsed.alignment.n() >= 2 && parsed.alignment.q() <= 27),
                Err(AlignmentError::InvalidSymbol { line, byte, .. }) => {
                    prop_assert!((1..=lines).contains(&line));
                    prop_assert!(bytes.contains(&byte));
                }
                Err(_) => {}
            }
        }
    }
}
