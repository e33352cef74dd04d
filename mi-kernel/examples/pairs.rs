//! Reads an alignment and prints its report and the ten pairs of columns with the highest Z, on the host alone.
//!
//! `cargo run --release -p mi-kernel --example pairs -- FILE [ITERATIONS]`

use std::{env, error::Error, fs, process::ExitCode};

use mi_kernel::{NullModel, Reference, Seed, ShuffleKind, parse};

const TOP: usize = 10;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("pairs: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run() -> Result<(), Box<dyn Error>> {
    let mut arguments = env::args().skip(1);
    let path = arguments.next().ok_or("usage: pairs FILE [ITERATIONS]")?;
    let iterations = arguments.next().map_or(Ok(20), |count| count.parse())?;
    let parsed = parse(&fs::read(&path)?).map_err(|error| format!("{path}: {error}"))?;
    println!("{}: {}", parsed.notes.format, parsed.alignment);
    if parsed.notes.duplicate_names > 0 {
        println!("{} names occur more than once", parsed.notes.duplicate_names);
    }
    let reference = Reference::new(&parsed.alignment)?;
    let null = NullModel::new(&reference, Seed(1), ShuffleKind::Feistel);
    let mut pairs = null.run(0..iterations)?.statistics(&null);
    pairs.sort_by(|a, b| b.z.total_cmp(&a.z));
    println!("   i    j   mi/bit  null mean   null sd       z       p");
    for pair in pairs.iter().take(TOP) {
        println!(
            "{:4} {:4} {:8.5} {:10.5} {:9.6} {:7.1} {:7.4}",
            pair.i + 1,
            pair.j + 1,
            pair.mi_bits,
            pair.null_mean_bits,
            pair.null_sd_bits,
            pair.z,
            pair.p
        );
    }
    Ok(())
}
