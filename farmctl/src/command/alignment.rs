//! `farmctl alignment`: writes a random alignment, of the sizes of the thesis' sets or of any other.

use std::{
    fs::{self, File},
    io::{BufWriter, Write as _},
};

use anyhow::{Context as _, anyhow};
use mi_kernel::{Seed, generate::RandomAlignment};

use crate::{cli::AlignmentArgs, failure::Failure, output::print_text};

/// Writes an alignment, or lists the names of the sizes.
pub(crate) fn run(arguments: &AlignmentArgs) -> Result<(), Failure> {
    if arguments.name == "list" {
        return print_text(&(RandomAlignment::NAMES.join("\n") + "\n"));
    }
    let sizes: RandomAlignment =
        arguments.name.parse().map_err(|error| Failure::Usage(anyhow::Error::new(error)))?;
    let alignment = RandomAlignment {
        sequences: arguments.sequences.unwrap_or(sizes.sequences),
        columns: arguments.columns.unwrap_or(sizes.columns),
        symbols: arguments.symbols.unwrap_or(sizes.symbols),
        conserved: arguments.conserved,
        seed: Seed(arguments.seed),
    };
    alignment.check().map_err(|error| Failure::Usage(error.into()))?;
    let Some(path) = &arguments.file else {
        return Err(Failure::Usage(anyhow!("name the file: farmctl alignment {} FILE", arguments.name)));
    };
    let shown = || path.display().to_string();
    let mut out = BufWriter::new(File::create(path).with_context(shown)?);
    let written = alignment.write_fasta(&mut out).and_then(|()| out.flush());
    if written.is_err() && path.is_file() {
        // Half an alignment may pass for a whole one. That it cannot be removed either changes nothing.
        let _ = fs::remove_file(path);
    }
    written.with_context(shown)?;
    print_text(&format!("{}\n", path.display()))
}
