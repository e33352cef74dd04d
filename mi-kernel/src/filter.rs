//! Leaves out what would blur the statistics: sequences that cover little, sequences that are nearly the same, columns of
//! gaps. Owns the rules and their order; all are off unless asked for, and the caller tells what was left out.

use thiserror::Error;

use crate::{Alignment, GAP};

/// What to leave out. Shares are 0 to 1; `None` leaves nothing out. Applied in the order of the fields.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Filters {
    /// Sequences with residues in a smaller share of the columns go.
    pub min_coverage: Option<f64>,
    /// Sequences go that share more of their residues with one that was kept before them, in the order of the input:
    /// identical residues over the columns in which both have one.
    pub max_identity: Option<f64>,
    /// Columns with gaps in a larger share of the sequences kept go.
    pub max_gap_share: Option<f64>,
}

/// The filters leave too little. Not to be retried with the same filters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum FilterError {
    /// Mutual information needs variation over sequences.
    #[error("the filters leave {left} of {of} sequences; at least two are needed")]
    Sequences {
        /// Sequences left.
        left: usize,
        /// Sequences there were.
        of: usize,
    },
    /// Every column has too many gaps.
    #[error("the filters leave none of {of} columns")]
    Columns {
        /// Columns there were.
        of: usize,
    },
}

impl Filters {
    /// The alignment without what the filters leave out; columns keep their numbers ([`Alignment::number`]).
    ///
    /// # Errors
    /// Fewer than two sequences or no column would be left.
    pub fn apply(&self, alignment: &Alignment) -> Result<Alignment, FilterError> {
        let rows = self.rows(alignment);
        if rows.len() < 2 {
            return Err(FilterError::Sequences { left: rows.len(), of: alignment.n() });
        }
        let columns = self.columns(alignment, &rows);
        if columns.is_empty() {
            return Err(FilterError::Columns { of: alignment.l() });
        }
        Ok(alignment.select(&rows, &columns))
    }

    fn rows(&self, alignment: &Alignment) -> Vec<usize> {
        let (n, l) = (alignment.n(), alignment.l());
        if self.min_coverage.is_none() && self.max_identity.is_none() {
            return (0..n).collect();
        }
        // Row after row: pairs of sequences are compared as runs of bytes.
        let mut symbols = vec![0_u8; n * l];
        for column in 0..l {
            for (row, code) in alignment.column(column).iter().enumerate() {
                symbols[row * l + column] = alignment.alphabet()[usize::from(*code)];
            }
        }
        let row = |row: usize| &symbols[row * l..(row + 1) * l];
        let covers = |least: f64| {
            move |at: &usize| {
                let residues = row(*at).iter().filter(|symbol| **symbol != GAP).count();
                residues as f64 / l as f64 >= least
            }
        };
        let mut kept: Vec<usize> = (0..n).collect();
        if let Some(least) = self.min_coverage {
            kept.retain(covers(least));
        }
        let Some(most) = self.max_identity else { return kept };
        let mut unlike: Vec<usize> = Vec::new();
        for at in kept {
            if unlike.iter().all(|other| identity(row(*other), row(at)) <= most) {
                unlike.push(at);
            }
        }
        unlike
    }

    fn columns(&self, alignment: &Alignment, rows: &[usize]) -> Vec<usize> {
        let all = 0..alignment.l();
        let Some(most) = self.max_gap_share else { return all.collect() };
        let few_gaps = |column: &usize| {
            let codes = alignment.column(*column);
            let is_gap = |row: &&usize| alignment.alphabet()[usize::from(codes[**row])] == GAP;
            rows.iter().filter(is_gap).count() as f64 / rows.len() as f64 <= most
        };
        all.filter(few_gaps).collect()
    }
}

/// Share of the columns with two residues in which both are the same; 0 without such a column.
fn identity(one: &[u8], other: &[u8]) -> f64 {
    let (mut both, mut same) = (0_usize, 0_usize);
    for (a, b) in one.iter().zip(other) {
        let residues = (*a != GAP) & (*b != GAP);
        both += usize::from(residues);
        same += usize::from(residues & (a == b));
    }
    if both == 0 { 0.0 } else { same as f64 / both as f64 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parse;

    fn rows(alignment: &Alignment) -> Vec<String> {
        let row =
            |row| (0..alignment.l()).map(move |column| char::from(alignment.symbol(row, column))).collect();
        (0..alignment.n()).map(row).collect()
    }

    fn filtered(text: &str, filters: Filters) -> Result<Alignment, FilterError> {
        filters.apply(&parse(text.as_bytes()).unwrap().alignment)
    }

    #[test]
    fn without_filters_nothing_changes() {
        let alignment = parse(b"AC-G\nAC-G\n").unwrap().alignment;
        assert_eq!(Filters::default().apply(&alignment).unwrap(), alignment);
    }

    #[test]
    fn short_sequences_and_copies_go_and_the_first_of_them_stays() {
        let filters = Filters { min_coverage: Some(0.5), max_identity: Some(0.75), ..Filters::default() };
        // The second has a quarter of the columns; the third shares three of four residues with the first, the fourth all
        // of those that both have.
        let kept = filtered("ACGT\nA---\nACGG\n-CGT\nTGCA\n", filters).unwrap();
        assert_eq!(rows(&kept), ["ACGT", "ACGG", "TGCA"]);
    }

    #[test]
    fn columns_of_gaps_go_and_the_others_keep_their_numbers() {
        let filters = Filters { max_gap_share: Some(0.5), ..Filters::default() };
        let kept = filtered("A-CG\nA-C-\nT-G-\nT-G-\n", filters).unwrap();
        assert_eq!(rows(&kept), ["AC", "AC", "TG", "TG"]);
        assert_eq!((kept.number(0), kept.number(1)), (1, 3));
        assert_eq!(kept.alphabet(), b"ACGT", "no gap is left");
        assert_eq!(kept.names().len(), 4);
    }

    #[test]
    fn gaps_are_counted_over_the_sequences_that_are_left() {
        let filters = Filters { min_coverage: Some(0.6), max_gap_share: Some(0.0), ..Filters::default() };
        assert_eq!(rows(&filtered("ACG\nTCG\n--G\n", filters).unwrap()), ["ACG", "TCG"]);
    }

    #[test]
    fn too_little_is_an_error_that_counts() {
        let filters = Filters { max_identity: Some(0.5), ..Filters::default() };
        let error = filtered("ACGT\nACGT\nACGA\n", filters).unwrap_err();
        assert_eq!(error.to_string(), "the filters leave 1 of 3 sequences; at least two are needed");
        let filters = Filters { max_gap_share: Some(0.0), ..Filters::default() };
        assert_eq!(filtered("A-\n-A\n", filters).unwrap_err(), FilterError::Columns { of: 2 });
    }
}
