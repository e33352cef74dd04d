//! CPU time of one iteration of the null model on one core, by the host reference: the plain loop that a device has to beat.
//!
//! `cargo run --release -p mi-kernel --example one_core -- FILE...`; `tests/peers/mi_speed.py` runs it beside ProDy.

use std::{env, error::Error, fs, process::ExitCode};

use mi_kernel::{NullModel, Reference, Seed, ShuffleKind, pair_count, parse};

fn main() -> ExitCode {
    match env::args().skip(1).try_for_each(|path| measure(&path)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("one_core: {error}");
            ExitCode::FAILURE
        }
    }
}

fn measure(path: &str) -> Result<(), Box<dyn Error>> {
    let alignment = parse(&fs::read(path)?).map_err(|error| format!("{path}: {error}"))?.alignment;
    let reference = Reference::unscored(&alignment)?;
    let null = NullModel::new(&reference, Seed(1), ShuffleKind::Feistel);
    let before = on_cpu_ns()?;
    let scores = null.scores(0);
    let seconds = (on_cpu_ns()? - before) as f64 / 1e9;
    assert_eq!(scores.len(), pair_count(alignment.l()), "one score for each pair");
    println!("{path}: {seconds:.3} s an iteration");
    Ok(())
}

/// How long this thread has had a core (proc(5), `schedstat`): what others do on the machine does not count.
fn on_cpu_ns() -> Result<u64, Box<dyn Error>> {
    let told = fs::read_to_string("/proc/thread-self/schedstat")?;
    Ok(told.split_whitespace().next().ok_or("schedstat is empty")?.parse()?)
}
