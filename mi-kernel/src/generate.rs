//! Random alignments, of the sizes of the thesis' sets or of any other: what benches and people who try the farm need. The same
//! values always give the same bytes.

use std::{
    io::{self, Write},
    str::FromStr,
};

use thiserror::Error;

use crate::{MAX_COLUMNS, MAX_ROWS, Seed, philox::split, philox4x32_10};

/// In the order in which symbols are taken: the gap, the residues, what is ambiguous.
const SYMBOLS: &[u8] = b"-ACDEFGHIKLMNPQRSTVWYBZXUOJ";

/// Most symbols of an alignment.
pub const MAX_SYMBOLS: usize = SYMBOLS.len();

/// A random alignment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RandomAlignment {
    /// N, 2 to [`MAX_ROWS`].
    pub sequences: usize,
    /// L, 1 to [`MAX_COLUMNS`].
    pub columns: usize,
    /// q, 1 to [`MAX_SYMBOLS`].
    pub symbols: usize,
    /// Nine of ten places of a column hold one symbol.
    pub conserved: bool,
    /// What is drawn.
    pub seed: Seed,
}

/// An alignment that cannot be. Not to be retried.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum GenerateError {
    /// No set has this name.
    #[error("{name:?} is none of {}", RandomAlignment::NAMES.join(", "))]
    Name {
        /// What was asked for.
        name: String,
    },
    /// A size out of its range.
    #[error("{what} must be {least} to {most}, not {got}")]
    Size {
        /// Which.
        what: &'static str,
        /// The smallest.
        least: usize,
        /// The largest.
        most: usize,
        /// What was asked for.
        got: usize,
    },
}

impl RandomAlignment {
    /// What [`Self::from_str`] knows: the sets of the thesis (5.5.1) by size, and a small one.
    pub const NAMES: [&str; 4] = ["thesis-a", "thesis-b", "thesis-c", "small"];

    /// The sets of the thesis.
    pub const THESIS: [Self; 3] =
        [Self::proteins(45_000, 1_400), Self::proteins(4_176, 5_025), Self::proteins(20_000, 2_189)];

    /// Of 21 symbols, all alike.
    #[must_use]
    pub const fn proteins(sequences: usize, columns: usize) -> Self {
        Self { sequences, columns, symbols: 21, conserved: false, seed: Seed(1) }
    }

    /// Writes it as FASTA, sequences named `s1`, `s2`, ...
    ///
    /// # Errors
    /// A size out of its range, or `out` refuses.
    pub fn write_fasta(&self, out: &mut impl Write) -> io::Result<()> {
        self.check().map_err(|error| io::Error::new(io::ErrorKind::InvalidInput, error))?;
        let mut line = Vec::with_capacity(self.columns + 1);
        for row in 0..self.sequences {
            line.clear();
            line.extend((0..self.columns).map(|column| self.symbol(row, column)));
            line.push(b'\n');
            writeln!(out, ">s{}", row + 1)?;
            out.write_all(&line)?;
        }
        Ok(())
    }

    /// # Errors
    /// A size out of its range.
    pub fn check(&self) -> Result<(), GenerateError> {
        let sizes = [
            ("sequences", 2, MAX_ROWS, self.sequences),
            ("columns", 1, MAX_COLUMNS, self.columns),
            ("symbols", 1, MAX_SYMBOLS, self.symbols),
        ];
        match sizes.into_iter().find(|(_, least, most, got)| !(least..=most).contains(&got)) {
            Some((what, least, most, got)) => Err(GenerateError::Size { what, least, most, got }),
            None => Ok(()),
        }
    }

    fn symbol(&self, row: usize, column: usize) -> u8 {
        let (high, low) = split(self.seed.0);
        let narrow = |place| u32::try_from(place).expect("sizes are checked");
        let [choice, rest, ..] = philox4x32_10([narrow(row), narrow(column), 0, 0], [low, high]);
        let code = if self.conserved && choice % 10 != 0 { column } else { rest as usize };
        SYMBOLS[code % self.symbols]
    }
}

impl FromStr for RandomAlignment {
    type Err = GenerateError;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        let [a, b, c] = Self::THESIS;
        match name {
            "thesis-a" => Ok(a),
            "thesis-b" => Ok(b),
            "thesis-c" => Ok(c),
            "small" => Ok(Self::proteins(200, 100)),
            _ => Err(GenerateError::Name { name: name.to_owned() }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parse;

    #[test]
    fn what_is_written_is_read_again() {
        for name in RandomAlignment::NAMES {
            let sizes: RandomAlignment = name.parse().unwrap();
            assert_eq!(sizes.check(), Ok(()), "{name}");
        }
        let mut text = Vec::new();
        let small: RandomAlignment = "small".parse().unwrap();
        small.write_fasta(&mut text).unwrap();
        let alignment = parse(&text).unwrap().alignment;
        assert_eq!((alignment.n(), alignment.l(), alignment.q()), (200, 100, 21));
        let share = alignment.gap_share() * 21.0;
        assert!((0.9..1.1).contains(&share), "one symbol in 21 is a gap: {share}");
    }

    #[test]
    fn conserved_columns_hold_one_symbol_nine_times_in_ten() {
        let conserved = RandomAlignment { conserved: true, ..RandomAlignment::proteins(2_000, 3) };
        let mut text = Vec::new();
        conserved.write_fasta(&mut text).unwrap();
        let alignment = parse(&text).unwrap().alignment;
        let most = |column: usize| {
            let mut counts = vec![0_u32; alignment.q()];
            alignment.column(column).iter().for_each(|code| counts[usize::from(*code)] += 1);
            counts.into_iter().max().unwrap()
        };
        assert!((0..3).all(|column| (1_750..1_880).contains(&most(column))), "{} {}", most(0), most(1));
    }

    #[test]
    fn what_cannot_be_is_said() {
        let error = RandomAlignment::proteins(1, 10).write_fasta(&mut Vec::new()).unwrap_err();
        assert_eq!(error.to_string(), "sequences must be 2 to 1048576, not 1");
        let error = "thesis-d".parse::<RandomAlignment>().unwrap_err();
        assert_eq!(error.to_string(), "\"thesis-d\" is none of thesis-a, thesis-b, thesis-c, small");
    }
}
