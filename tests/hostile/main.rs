//! Hostile input on stable: every file of `fuzz/corpus`, thousands of inputs made of each, and large ones made for one
//! weakness go through the decoders of `targets`. A decoder passes if it answers, without a panic, with memory in proportion
//! to its input, on a stack of usual size, in bounded time. What it answers is not asked, but for files named `valid-`.
//!
//! An input that fails is written to `target/hostile/`. One that ends the process (a stack that overflows, an allocation that
//! fails) is `target/hostile/TARGET.last`, which is there only while a target runs. Copied to `fuzz/corpus/TARGET/` under a
//! name that says what it is, it is a regression test.

#![allow(clippy::unwrap_used, reason = "a panic in a test is its failure, also in its helpers")]

mod meter;
mod mutation;
mod seeds;
mod storm;
mod targets;

use std::{
    collections::BTreeSet,
    fs::{self, File},
    os::unix::fs::FileExt as _,
    panic::{self, AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

use self::{
    meter::peak_of,
    mutation::{Draw, mutated},
    storm::STORMS,
    targets::{TARGETS, Target, Verdict, named},
};

/// Stack of a decoder: that of threads of Rust and of tokio.
const STACK_BYTES: usize = 2 << 20;
/// Memory that a decoder may hold whatever its input: tables made once, and serde's cautious first mebibyte of a list.
const FREE_BYTES: usize = 3 << 20;
/// An input that takes longer hangs: the largest takes a fraction of a second on the slowest builder.
const PATIENCE: Duration = Duration::from_secs(20);
/// Most bytes of the whole corpus.
const MAX_CORPUS_BYTES: u64 = 500_000;
/// Names a file that a target runs instead of everything else.
const ONLY: &str = "HOSTILE_INPUT";
/// Failures of one target that are shown.
const SHOWN: usize = 5;

/// One test for each target, so that they run side by side and one that kills its process is known by name.
macro_rules! replays {
    ($($name:ident)*) => {
        $(#[test]
        fn $name() {
            replay(named(stringify!($name)));
        })*

        const REPLAYED: &[&str] = &[$(stringify!($name)),*];
    };
}

replays! {
    frames_to_node frames_to_app job_program packed_programs
    app_to_coordinator coordinator_to_app node_to_coordinator coordinator_to_node farm_status timeline_head timeline_segments
    plugin_question plugin_answer
    join_token principal certificate membership signing_request capability identity_file authority_file
    control_store epoch_file run_journal
    scene_toml scene_obj scene_mtl
    alignment alignment_fasta alignment_a2m alignment_a3m alignment_stockholm alignment_clustal alignment_plain saved_sums
    mi_result render_result
    device_spec wgsl_module
}

#[test]
fn every_target_is_replayed_and_has_a_fuzz_target_and_a_valid_seed() {
    let names: BTreeSet<&str> = TARGETS.iter().map(|target| target.name).collect();
    assert_eq!(names.len(), TARGETS.len(), "a name is there twice");
    assert_eq!(REPLAYED.iter().copied().collect::<BTreeSet<_>>(), names, "tests and targets differ");
    for name in &names {
        let file = root().join("fuzz/fuzz_targets").join(format!("{name}.rs"));
        let text = fs::read_to_string(&file).unwrap_or_default();
        assert!(text.contains(&format!("\"{name}\"")), "{} does not run {name}", file.display());
        assert!(
            corpus(name).iter().any(|(file, _)| file.starts_with("valid-")),
            "{name} has no valid seed: its decoder is never seen to the end"
        );
    }
    for storm in STORMS {
        assert!(names.contains(storm.target), "no target is called {}", storm.target);
    }
    let folders = fs::read_dir(root().join("fuzz/corpus")).unwrap();
    for folder in folders.map(|folder| folder.unwrap().file_name().into_string().unwrap()) {
        assert!(names.contains(&*folder), "fuzz/corpus/{folder} is of no target");
    }
    let bytes: usize = names.iter().flat_map(|name| corpus(name)).map(|(_, bytes)| bytes.len()).sum();
    assert!(bytes as u64 <= MAX_CORPUS_BYTES, "the corpus has {bytes} B");
}

#[test]
fn seeds_that_are_missing_are_written_when_blessed() {
    if std::env::var_os("FARM_BLESS").is_none() {
        return;
    }
    for (target, name, make) in seeds::SEEDS {
        let path = root().join("fuzz/corpus").join(target).join(name);
        if fs::metadata(&path).map_or(0, |file| file.len()) == 0 {
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, make()).unwrap();
        }
    }
}

/// What has no names for its fields is understood by those alone who have the same ones.
#[test]
fn what_is_said_and_kept_without_names_is_as_it_was() {
    const NAMELESS: [&str; 5] =
        ["frames_to_node", "frames_to_app", "job_program", "packed_programs", "saved_sums"];
    for (target, name, make) in seeds::SEEDS.iter().filter(|(target, ..)| NAMELESS.contains(target)) {
        let path = root().join("fuzz/corpus").join(target).join(name);
        assert!(
            fs::read(&path).unwrap_or_default() == make(),
            "{} is encoded otherwise now: raise PROTOCOL_VERSION, or the file format's version, remove it and run this with FARM_BLESS=1",
            path.display()
        );
    }
}

mod negative_control {
    //! Decoders that are wrong in each of the ways that are looked for. Each must be found.

    use super::*;

    fn found(decode: fn(&[u8]) -> Verdict, bytes: &[u8]) -> String {
        let target = Target { name: "control", decode, bytes_per_byte: 64, mutations: 0 };
        judge(&target, "valid-control", bytes).unwrap_err()
    }

    #[test]
    fn a_panic_is_found() {
        assert!(found(|bytes| panic!("at {}", bytes[2]), &[1, 2, 3]).contains("panics: at 3"));
        assert!(found(|bytes| Err(bytes[7].to_string()), &[1]).contains("index out of bounds"));
        // What a length of u64::MAX does to those who believe it.
        let believing = |bytes: &[u8]| {
            let length = usize::from_le_bytes(*bytes.first_chunk().unwrap());
            drop(Vec::<u64>::with_capacity(length));
            Ok(())
        };
        assert!(found(believing, &[0xff; 8]).contains("capacity overflow"));
    }

    #[test]
    fn an_allocation_on_the_word_of_the_input_is_found() {
        fn believing(bytes: &[u8]) -> Verdict {
            let length = u32::from_le_bytes(*bytes.first_chunk().unwrap());
            drop(std::hint::black_box(vec![0_u8; length as usize]));
            Ok(())
        }
        assert!(found(believing, &(64_u32 << 20).to_le_bytes()).contains("holds 67"));
        let honest = Target { name: "control", decode: believing, bytes_per_byte: 64, mutations: 0 };
        assert_eq!(judge(&honest, "", &100_u32.to_le_bytes()), Ok(()));
        // Little by little is no better.
        let growing = |bytes: &[u8]| {
            let mut all = Vec::new();
            for _ in 0..1_000_000 {
                all.push(bytes.to_vec());
            }
            drop(std::hint::black_box(all));
            Ok(())
        };
        assert!(found(growing, &[1; 8]).contains("for 8 B of input"));
    }

    #[test]
    fn a_valid_file_that_is_refused_is_found() {
        assert!(found(|_| Err("no".to_owned()), &[]).contains("refused: no"));
        let target =
            Target { name: "control", decode: |_| Err("no".to_owned()), bytes_per_byte: 1, mutations: 0 };
        assert_eq!(judge(&target, "crash-1", &[]), Ok(()), "others may be");
    }

    #[test]
    fn an_error_as_long_as_the_input_is_found() {
        let echo = |bytes: &[u8]| Err(String::from_utf8_lossy(bytes).into_owned());
        let target = Target { name: "control", decode: echo, bytes_per_byte: 64, mutations: 0 };
        let long = vec![b'a'; 2 * MAX_ERROR_BYTES];
        assert!(judge(&target, "", &long).unwrap_err().contains("error of"));
    }

    #[test]
    fn mutations_are_many_different_and_the_same_each_time() {
        let seeds = [b"some bytes".to_vec(), vec![0; 40]];
        let made = || -> Vec<Vec<u8>> {
            let mut draw = Draw::of("x");
            (0..500).map(|_| mutated(&mut draw, &seeds[0], &seeds)).collect()
        };
        assert_eq!(made(), made());
        let different: BTreeSet<Vec<u8>> = made().into_iter().collect();
        assert!(different.len() > 400, "{} of 500 are different", different.len());
        assert!(
            different.iter().any(Vec::is_empty) || different.iter().any(|bytes| bytes.len() < 3),
            "none is short"
        );
    }
}

/// Longest text of a refusal, in bytes: whoever reads it has a terminal, and whoever is sent it a message cap.
const MAX_ERROR_BYTES: usize = 8 << 10;

/// Runs a target over its corpus, what is made of it, and its storms.
fn replay(target: Target) {
    let started = Instant::now();
    // A panic that the decoder itself catches is none; but its backtrace would count as memory, debug symbols and all.
    panic::set_hook(Box::new(|panic| eprintln!("{panic}")));
    let thread = thread::Builder::new().name(target.name.to_owned()).stack_size(STACK_BYTES);
    let (runs, failures) = thread.spawn(move || failures_of(&target)).unwrap().join().unwrap();
    println!("{}: {runs} inputs, {:.1} s", target.name, started.elapsed().as_secs_f64());
    assert!(
        failures.is_empty(),
        "{} of {runs} inputs fail:\n{}",
        failures.len(),
        failures.iter().take(SHOWN).cloned().collect::<Vec<_>>().join("\n")
    );
}

fn failures_of(target: &Target) -> (usize, Vec<String>) {
    let folder = root().join("target/hostile");
    fs::create_dir_all(&folder).unwrap();
    let last_path = folder.join(format!("{}.last", target.name));
    let last = File::create(&last_path).unwrap();
    let (mut runs, mut failures) = (0, Vec::new());
    let mut run = |name: &str, bytes: &[u8]| {
        runs += 1;
        last.set_len(0).and_then(|()| last.write_all_at(bytes, 0)).unwrap();
        if let Err(reason) = judge(target, name, bytes) {
            let kept = folder.join(format!("{}-{:04}", target.name, failures.len()));
            if failures.len() < SHOWN {
                fs::write(&kept, bytes).unwrap();
            }
            failures.push(format!("{name} ({}): {reason}", kept.display()));
        }
    };
    if let Some(input) = std::env::var_os(ONLY) {
        run("the one input", &fs::read(input).unwrap());
        return (runs, failures);
    }
    let files = corpus(target.name);
    assert!(!files.is_empty(), "fuzz/corpus/{} is empty", target.name);
    let seeds: Vec<Vec<u8>> = files.iter().map(|(_, bytes)| bytes.clone()).collect();
    for (name, bytes) in &files {
        run(name, bytes);
        let mut draw = Draw::of(name);
        for number in 0..target.mutations {
            run(&format!("mutation {number} of {name}"), &mutated(&mut draw, bytes, &seeds));
        }
    }
    for storm in STORMS.iter().filter(|storm| storm.target == target.name) {
        run(storm.what, &(storm.make)());
    }
    fs::remove_file(last_path).unwrap();
    (runs, failures)
}

/// Whether a decoder does with some bytes what it may.
fn judge(target: &Target, name: &str, bytes: &[u8]) -> Result<(), String> {
    let started = Instant::now();
    let (outcome, peak_bytes) = peak_of(|| catch_unwind(AssertUnwindSafe(|| (target.decode)(bytes))));
    let taken = started.elapsed();
    let verdict = outcome.map_err(|panic| {
        let text = panic.downcast_ref::<String>().map(String::as_str);
        format!("panics: {}", text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no message"))
    })?;
    let allowed_bytes = FREE_BYTES + target.bytes_per_byte * bytes.len();
    if peak_bytes > allowed_bytes {
        return Err(format!("holds {peak_bytes} B, over {allowed_bytes} B, for {} B of input", bytes.len()));
    }
    if taken > PATIENCE {
        return Err(format!("takes {taken:?} for {} B of input", bytes.len()));
    }
    match verdict {
        Err(reason) if reason.len() > MAX_ERROR_BYTES => Err(format!("gives an error of {} B", reason.len())),
        Err(reason) if name.starts_with("valid-") => Err(format!("is refused: {reason}")),
        Ok(()) | Err(_) => Ok(()),
    }
}

/// A target's files by name.
fn corpus(target: &str) -> Vec<(String, Vec<u8>)> {
    let Ok(folder) = fs::read_dir(root().join("fuzz/corpus").join(target)) else { return Vec::new() };
    let mut files: Vec<(String, Vec<u8>)> = folder
        .map(|file| {
            let path: PathBuf = file.unwrap().path();
            (path.file_name().unwrap().to_str().unwrap().to_owned(), fs::read(path).unwrap())
        })
        .collect();
    files.sort();
    files
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("tests/ lies in the workspace")
}
