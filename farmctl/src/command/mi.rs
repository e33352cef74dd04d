//! `farmctl mi`: an alignment in, mutual information with its null model out, through a farm.

use std::{
    fs,
    io::{self, BufWriter, Read as _, Write as _},
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use anyhow::{Context as _, anyhow};
use client_sdk::{FarmError, FarmOptions, Progress, RunSummary, SimulatedDevices};
use mi_kernel::{
    Accumulators, Alignment, Filters, GapMode, NullModel, Reference, Seed, ShuffleKind, histogram,
    job::{JobLengths, MiHandle, MiOptions, Mode, mi_graph},
    output, parse, saved,
};
use serde_json::json;
use tempfile::NamedTempFile;

use crate::{
    cli::{Gaps, MiArgs, MiMode, ProgressStyle},
    embedded::EmbeddedFarm,
    failure::Failure,
    journal,
    output::{moved, print_text, taken_over},
    progress::{Early, Units},
    running::{Stops, run_graph},
    target::Target,
};

/// Raw sums in the folder: what `--extend` goes on from.
const SUMS: &str = "sums.bin";

/// Most bytes of an alignment file once decompressed: past what any device holds, short of what a small file can blow
/// up to.
const MAX_INPUT_BYTES: u64 = 4 << 30;

/// The alignment as read, and what is known of its file.
#[derive(Debug)]
struct Input {
    /// After the filters.
    alignment: Arc<Alignment>,
    /// Sequences and columns before them.
    read: [usize; 2],
    format: String,
    blake3: String,
    earlier: Option<Accumulators>,
}

/// Computes; the exit code is 0 only when every iteration is in the results.
pub(crate) async fn run(arguments: &MiArgs, target: &Target<'_>) -> Result<(), Failure> {
    let mut stops = Stops::listen()?;
    let reading = arguments.clone();
    // Reading ends by itself, or with the process.
    let input = tokio::select! {
        input = tokio::task::spawn_blocking(move || read(&reading)) => input.context("reading panicked")??,
        () = stops.recv() => return Err(anyhow!("interrupted before the first job: nothing was written").into()),
    };
    let options = MiOptions {
        iterations: arguments.iterations,
        seed: Seed(arguments.seed),
        mode: match arguments.mode {
            MiMode::Reduce => Mode::Reduce,
            MiMode::Matrix => Mode::Matrix,
        },
        lengths: if arguments.resume { JobLengths::Fixed } else { JobLengths::Measured },
        earlier: input.earlier.clone(),
        simulated: SimulatedDevices::Refused,
    };
    let before = input.earlier.as_ref().map_or(0, Accumulators::iterations) as u64;
    let asked = arguments.iterations.saturating_sub(before);
    let (graph, handle) = mi_graph(Arc::clone(&input.alignment), options).with_context(|| {
        let sums = arguments.folder.join(SUMS);
        shown(if input.earlier.is_some() { &sums } else { &arguments.alignment })
    })?;
    let path = journal_path(arguments);
    let journal = if arguments.resume {
        let MiArgs { iterations, seed, mode, gaps, .. } = arguments;
        let label = format!("mi, {iterations} iterations, seed {seed}, {mode:?}, {gaps:?}").to_lowercase();
        Some(journal::open(&path, &label)?)
    } else {
        journal::mention(&path);
        None
    };
    let (reach, own_farm) = tokio::select! {
        farm = EmbeddedFarm::unless_named(target, &arguments.devices) => farm?,
        () = stops.recv() => return Err(anyhow!("interrupted before the first job: nothing was written").into()),
    };
    #[expect(clippy::cast_precision_loss, reason = "a rate for people")]
    let units = Units {
        share: done_of(handle.clone(), before, asked),
        total: asked as f64,
        name: "iterations",
        early: Some(early_z(handle.clone())),
    };
    let name = arguments.alignment.file_name().unwrap_or(arguments.alignment.as_os_str());
    let farm = FarmOptions {
        policy: arguments.policy.clone(),
        ..reach.options(format!("mi {}", name.to_string_lossy()))
    };
    let result = run_graph(farm, graph, journal, arguments.progress, units, &mut stops).await;
    let of_journal = matches!(result, Err(FarmError::Journal(_)));
    let ended = finish(result, &input, &handle, arguments, before).await;
    match &ended {
        Ok(()) if arguments.resume => journal::remove(&path),
        Err(_) if arguments.resume && !of_journal => journal::tell_kept(&path),
        Ok(()) | Err(_) => {}
    }
    if let Some(farm) = own_farm {
        tokio::select! {
            () = farm.stop() => {}
            () = stops.recv() => {}
        }
    }
    ended
}

/// The share of the iterations asked for that are in the sums; scoring the alignment itself does not count.
#[expect(clippy::cast_precision_loss, reason = "a share for people")]
fn done_of(handle: MiHandle, before: u64, asked: u64) -> Arc<dyn Fn(&Progress) -> f64 + Send + Sync> {
    Arc::new(move |_| (handle.iterations_done() - before) as f64 / asked.max(1) as f64)
}

/// Where results of jobs are kept while it computes.
fn journal_path(arguments: &MiArgs) -> PathBuf {
    arguments.folder.join(journal::EXTENSION)
}

/// The pair that leads while the run goes on.
fn early_z(handle: MiHandle) -> Arc<dyn Fn() -> Option<Early> + Send + Sync> {
    Arc::new(move || {
        let (iterations, [i, j], z) = handle.leading()?;
        Some(Early {
            words: format!("Z {z:.1} ({i}, {j})"),
            field: ("leading", json!({ "i": i, "j": j, "z": z, "iterations": iterations })),
        })
    })
}

fn shown(path: &Path) -> String {
    path.display().to_string()
}

/// Reads the alignment and, where asked, the sums to go on from; the folder is there afterwards.
fn read(arguments: &MiArgs) -> Result<Input, Failure> {
    let bytes = fs::read(&arguments.alignment).with_context(|| shown(&arguments.alignment))?;
    let text = decompressed(&bytes, MAX_INPUT_BYTES).with_context(|| shown(&arguments.alignment))?;
    let parsed = parse(text.as_deref().unwrap_or(&bytes)).with_context(|| shown(&arguments.alignment))?;
    tell!("farmctl: {}: {}, {}", shown(&arguments.alignment), parsed.notes.format, parsed.alignment);
    if parsed.notes.duplicate_names > 0 {
        tell!(
            "farmctl: warning: sequences that have the name of an earlier one: {}",
            parsed.notes.duplicate_names
        );
    }
    let filters = Filters {
        min_coverage: arguments.min_coverage,
        max_identity: arguments.max_identity,
        max_gap_share: arguments.max_gap_share,
    };
    let read = [parsed.alignment.n(), parsed.alignment.l()];
    let alignment = match filters == Filters::default() {
        true => parsed.alignment,
        false => filters.apply(&parsed.alignment).with_context(|| shown(&arguments.alignment))?,
    };
    if [alignment.n(), alignment.l()] != read {
        tell!("farmctl: the filters leave {alignment}");
    }
    let alignment = alignment.with_gaps(match arguments.gaps {
        Gaps::Ormi => GapMode::Ormi,
        Gaps::Sumi => GapMode::Sumi,
        Gaps::Demi => GapMode::Demi,
        Gaps::Esmi => GapMode::Esmi,
    });
    fs::create_dir_all(&arguments.folder).with_context(|| shown(&arguments.folder))?;
    // Better now than after hours: a folder that cannot be written to.
    drop(NamedTempFile::new_in(&arguments.folder).with_context(|| shown(&arguments.folder))?);
    let path = arguments.folder.join(SUMS);
    let load =
        |sums: &[u8]| saved::load(&alignment, Seed(arguments.seed), sums).with_context(|| shown(&path));
    let earlier = match (fs::read(&path), arguments.extend) {
        // Written by the run that the journal is of, which ended before it could remove it: the same sums will follow.
        (Ok(sums), false) if arguments.resume && journal_path(arguments).exists() => {
            let there = load(&sums).map_err(Failure::Usage)?.iterations();
            if there as u64 > arguments.iterations {
                let reason = anyhow!(
                    "{} has {there} iterations: another run's, which is not written over",
                    shown(&path)
                );
                return Err(Failure::Usage(reason));
            }
            None
        }
        (Ok(_), false) => {
            let reason = anyhow!(
                "{} is there already: --extend goes on from it, another folder begins anew",
                shown(&path)
            );
            return Err(Failure::Usage(reason));
        }
        (Ok(sums), true) => Some(load(&sums)?),
        (Err(error), false) if error.kind() == io::ErrorKind::NotFound => None,
        (Err(error), _) => return Err(anyhow::Error::new(error).context(shown(&path)).into()),
    };
    Ok(Input {
        alignment: Arc::new(alignment),
        read,
        format: parsed.notes.format.to_string(),
        blake3: blake3::hash(&bytes).to_hex().to_string(),
        earlier,
    })
}

/// What a gzip file holds, also one of several members (bgzip); nothing for a file that is none.
fn decompressed(bytes: &[u8], most_bytes: u64) -> io::Result<Option<Vec<u8>>> {
    if !bytes.starts_with(&[0x1f, 0x8b]) {
        return Ok(None);
    }
    let mut text = Vec::new();
    let read = flate2::read::MultiGzDecoder::new(bytes).take(most_bytes + 1).read_to_end(&mut text)?;
    if read as u64 > most_bytes {
        let reason = format!("decompressed it is longer than {most_bytes} bytes");
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, reason));
    }
    Ok(Some(text))
}

/// Writes the results of a complete run, or what there is of an incomplete one.
async fn finish(
    result: Result<RunSummary, FarmError>,
    input: &Input,
    handle: &MiHandle,
    arguments: &MiArgs,
    before: u64,
) -> Result<(), Failure> {
    let (summary, failure) = match result {
        Ok(summary) => (summary, None),
        // With a journal half the sums would only be in the way of the whole ones.
        Err(error) if arguments.resume => return Err(Failure::of_run(error)),
        Err(error) => (RunSummary::default(), Some(Failure::of_run(error))),
    };
    let sums = handle.sums();
    let done = sums.iterations() as u64;
    let Some(observed) = handle.observed().filter(|_| failure.is_none() || done > before) else {
        tell!("farmctl: no iteration was added: nothing was written");
        return Err(failure.unwrap_or_else(|| anyhow!("the run gave no scores").into()));
    };
    let results = Results {
        alignment: Arc::clone(&input.alignment),
        seed: Seed(arguments.seed),
        observed,
        sums,
        folder: arguments.folder.clone(),
        top: arguments.top.unwrap_or_else(|| input.alignment.l() * 5),
    };
    let record = json!({
        "input": shown(&arguments.alignment),
        "input_blake3": input.blake3,
        "format": input.format,
        "sequences_read": input.read[0],
        "columns_read": input.read[1],
        "filters": {
            "min_coverage": arguments.min_coverage,
            "max_identity": arguments.max_identity,
            "max_gap_share": arguments.max_gap_share,
        },
        "sequences": input.alignment.n(),
        "columns": input.alignment.l(),
        "column_numbers": column_numbers(input),
        "alphabet": String::from_utf8_lossy(input.alignment.alphabet()),
        "gap_share": input.alignment.gap_share(),
        "gaps": gap_words(arguments.gaps),
        "units": "bits",
        "seed": arguments.seed,
        "iterations": done,
        "iterations_asked": arguments.iterations,
        "complete": failure.is_none(),
        "null_model": "columns shuffled by keyed Feistel permutations, 8 rounds",
        "mode": match arguments.mode { MiMode::Reduce => "reduce", MiMode::Matrix => "matrix" },
        "version": env!("CARGO_PKG_VERSION"),
        "nodes": handle.nodes().iter().map(ToString::to_string).collect::<Vec<_>>(),
        "jobs": summary.jobs,
        "jobs_journalled": summary.journalled,
        "replanned": summary.replanned,
        "wall_seconds": summary.wall_time.as_secs_f64(),
        "device_seconds": summary.device_time.as_secs_f64(),
    });
    let best =
        tokio::task::spawn_blocking(move || results.write(&record)).await.context("writing panicked")??;
    if let Some(failure) = failure {
        tell!(
            "farmctl: saved a partial result in {}: {done} of {} iterations; --extend goes on from it",
            shown(&arguments.folder),
            arguments.iterations
        );
        return Err(failure);
    }
    tell(&summary, arguments, done - before, &best)
}

fn gap_words(gaps: Gaps) -> &'static str {
    match gaps {
        Gaps::Ormi => "an ordinary symbol (ORMI)",
        Gaps::Sumi => "rows with a gap in either column left out of a pair (SUMI)",
        Gaps::Demi => "own entropies over residues, joint entropies over rows with both (DEMI)",
        Gaps::Esmi => "own distributions over residues, joint distributions over rows with both (ESMI)",
    }
}

/// Which columns of the input the matrices are of, from 1; nothing where it is all of them.
fn column_numbers(input: &Input) -> Option<Vec<usize>> {
    let l = input.alignment.l();
    (l != input.read[1]).then(|| (0..l).map(|column| input.alignment.number(column)).collect())
}

fn tell(summary: &RunSummary, arguments: &MiArgs, added: u64, best: &str) -> Result<(), Failure> {
    let prepare: Duration = summary.tasks.iter().map(|task| task.prepare_time).sum();
    let seconds = summary.wall_time.saturating_sub(prepare).as_secs_f64();
    if arguments.progress == ProgressStyle::Ndjson {
        let line = json!({
            "event": "done",
            "iterations": arguments.iterations,
            "iterations_added": added,
            "jobs": summary.jobs,
            "jobs_journalled": summary.journalled,
            "replanned": summary.replanned,
            "seconds": seconds,
            "device_seconds": summary.device_time.as_secs_f64(),
        });
        print_text(&format!("{line}\n"))?;
    }
    tell!(
        "farmctl: {} written: {} in {} jobs{}, {seconds:.1} s{}; {best}",
        shown(&arguments.folder),
        match arguments.iterations {
            all if all == added => format!("{all} iterations"),
            all => format!("{all} iterations, {added} of them new,"),
        },
        summary.jobs,
        taken_over(summary.journalled),
        moved(summary.replanned),
    );
    Ok(())
}

/// Everything that the files are made of.
struct Results {
    alignment: Arc<Alignment>,
    seed: Seed,
    observed: Vec<i32>,
    sums: Accumulators,
    folder: PathBuf,
    top: usize,
}

impl Results {
    /// Writes all files, the sums first: they alone cannot be made again. Gives the top pair in words.
    fn write(self, record: &serde_json::Value) -> anyhow::Result<String> {
        let sums = saved::save(&self.alignment, self.seed, &self.sums);
        place(&self.folder, SUMS, |out| out.write_all(&sums))?;
        let kept = format!("the sums are in {}; --extend writes the rest", shown(&self.folder.join(SUMS)));
        self.write_rest(record).context(kept)
    }

    fn write_rest(self, record: &serde_json::Value) -> anyhow::Result<String> {
        let reference = Reference::with_observed(&self.alignment, self.observed)?;
        let null = NullModel::new(&reference, self.seed, ShuffleKind::Feistel);
        let pairs = self.sums.statistics(&null);
        let l = self.alignment.l();
        for (name, matrix) in output::matrices(&reference, &pairs) {
            place(&self.folder, &format!("{name}.npy"), |out| output::write_npy(out, l, &matrix))?;
            if let "mi_bits" | "z" = name {
                let picture = output::heat_map(l, &matrix)?;
                place(&self.folder, &format!("{name}.png"), |out| out.write_all(&picture))?;
            }
        }
        let z: Vec<f64> = pairs.iter().map(|pair| pair.z).collect();
        let picture = histogram::z_histogram(&z)?;
        place(&self.folder, "z_histogram.png", |out| out.write_all(&picture))?;
        place(&self.folder, "pairs.csv", |out| {
            output::write_top_pairs(out, &self.alignment, &pairs, self.top)
        })?;
        let text = serde_json::to_string_pretty(record)? + "\n";
        place(&self.folder, "run.json", |out| out.write_all(text.as_bytes()))?;
        let best = pairs
            .iter()
            .filter(|pair| !pair.z_undefined)
            .max_by(|a, b| a.z.total_cmp(&b.z).then(a.mi_bits.total_cmp(&b.mi_bits)));
        let none = || "no pair has a Z: nothing varies".to_owned();
        Ok(best.map_or_else(none, |best| {
            let number = |column| self.alignment.number(column);
            format!("highest Z {:.1}: columns {} and {}", best.z, number(best.i), number(best.j))
        }))
    }
}

/// Writes a file of the folder, whole or not at all.
fn place(
    folder: &Path,
    name: &str,
    write: impl FnOnce(&mut BufWriter<fs::File>) -> io::Result<()>,
) -> anyhow::Result<()> {
    let path = folder.join(name);
    let unfinished = folder.join(format!(".{name}.{}", std::process::id()));
    let written = fs::File::create(&unfinished).and_then(|file| {
        let mut out = BufWriter::new(file);
        write(&mut out)?;
        out.into_inner().map_err(io::IntoInnerError::into_error)?.sync_all()?;
        fs::rename(&unfinished, &path)
    });
    if written.is_err() {
        // What is left of it is of no use; that it cannot be removed either changes nothing.
        let _ = fs::remove_file(&unfinished);
    }
    written.with_context(|| shown(&path))
}

#[cfg(test)]
mod tests {
    use flate2::{Compression, write::GzEncoder};

    use super::*;

    #[test]
    fn gzip_is_read_within_its_bound() {
        let gzip = |text: &[u8]| {
            let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
            encoder.write_all(text).unwrap();
            encoder.finish().unwrap()
        };
        let members = [gzip(b">a\nAC\n"), gzip(b">b\nGT\n")].concat();
        assert_eq!(decompressed(&members, 12).unwrap().as_deref(), Some(&b">a\nAC\n>b\nGT\n"[..]));
        assert!(decompressed(&members, 11).unwrap_err().to_string().contains("longer than 11 bytes"));
        assert!(decompressed(&members[..members.len() - 1], 12).is_err(), "cut short");
        assert_eq!(decompressed(b">a\nAC\n", 12).unwrap(), None);
    }
}
