//! Mutual information through real processes: the same bytes whatever the farm does, exact continuation, hostile input.

use std::{
    fmt::Write as _,
    fs,
    path::{Path, PathBuf},
};

use tempfile::TempDir;
use tests::{Farm, Process, Signal, farmctl};

/// What must not depend on the farm, the mode or the split; `run.json` tells of the run and may.
const RESULTS: [&str; 10] = [
    "mi_bits.npy",
    "null_mean_bits.npy",
    "null_sd_bits.npy",
    "z.npy",
    "p.npy",
    "mi_bits.png",
    "z.png",
    "z_histogram.png",
    "pairs.csv",
    "sums.bin",
];

/// Random residues in `n` sequences of `l` columns; column 11 follows column 3.
fn alignment(folder: &TempDir, n: usize, l: usize) -> String {
    let mut state = 7_u64;
    let mut below = |bound: u64| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        usize::try_from((state >> 33) % bound).expect("a small number")
    };
    let mut text = String::new();
    for row in 0..n {
        let mut residues: Vec<char> =
            (0..l).map(|_| char::from(b"-ACDEFGHIKLMNPQRSTVWY"[below(21)])).collect();
        residues[11] = residues[3];
        let residues: String = residues.into_iter().collect();
        writeln!(text, ">s{row}\n{residues}").expect("a string takes any text");
    }
    let path = folder.path().join("alignment.fasta");
    fs::write(&path, text).expect("the folder is writable");
    path.display().to_string()
}

fn start(farm: &Farm, alignment: &str, out: &Path, more: &[&str]) -> Process {
    let out = out.display().to_string();
    let fixed = ["--coordinator", &farm.grpc, "mi", alignment, "-o", &out, "--progress", "ndjson"];
    Process::start("farmctl", fixed.iter().chain(more))
}

fn finish(run: Process) {
    let (status, stderr) = run.finish();
    assert!(status.success(), "{status}; stderr:\n{stderr}");
}

fn files(folder: &Path) -> Vec<(&'static str, Vec<u8>)> {
    RESULTS
        .into_iter()
        .map(|name| (name, fs::read(folder.join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))))
        .collect()
}

fn assert_same(left: &Path, right: &Path, what: &str) {
    for ((name, left), (_, right)) in files(left).into_iter().zip(files(right)) {
        assert!(left == right, "{what}: {name} differs");
    }
}

fn done(line: &serde_json::Value, jobs: u64) -> bool {
    line["event"] == "progress" && line["jobs_done"].as_u64().is_some_and(|done| done >= jobs)
}

#[test]
fn the_farm_does_not_show_in_the_bytes() {
    let folder = TempDir::new().expect("a temporary folder");
    let input = alignment(&folder, 160, 40);
    let out = |name: &str| -> PathBuf { folder.path().join(name) };

    let quiet = Farm::with_cpu_workers(1);
    finish(start(&quiet, &input, &out("quiet"), &["--iterations", "200"]));
    // In two runs, and as matrices.
    finish(start(&quiet, &input, &out("extended"), &["--iterations", "70"]));
    finish(start(&quiet, &input, &out("extended"), &["--iterations", "200", "--extend"]));
    finish(start(&quiet, &input, &out("matrix"), &["--iterations", "200", "--mode", "matrix"]));
    // Negative control of the comparison.
    finish(start(&quiet, &input, &out("seed"), &["--iterations", "200", "--seed", "2"]));
    drop(quiet);

    let mut farm = Farm::with_cpu_workers(3);
    let mut disturbed = start(&farm, &input, &out("disturbed"), &["--iterations", "200"]);
    disturbed.wait_for(|line| done(line, 3));
    farm.workers[1].signal(Signal::Kill);
    farm.begin_worker("cpu");
    finish(disturbed);

    assert_same(&out("quiet"), &out("disturbed"), "three workers, one killed, one joining");
    assert_same(&out("quiet"), &out("extended"), "extended");
    assert_same(&out("quiet"), &out("matrix"), "matrix mode");
    let differs = files(&out("quiet")).into_iter().zip(files(&out("seed"))).filter(|(a, b)| a != b).count();
    assert_eq!(differs, 8, "another seed changes all but the observed matrix and its picture");
    let pairs = fs::read_to_string(out("quiet").join("pairs.csv")).expect("the table is there");
    let top = pairs.lines().nth(1).unwrap_or_default();
    assert!(top.starts_with("4,") && top.contains(",12,"), "the planted pair is not on top: {top}");
}

#[test]
fn a_run_with_a_journal_goes_on_from_it_with_the_same_bytes() {
    let folder = TempDir::new().expect("a temporary folder");
    let input = alignment(&folder, 160, 40);
    let farm = Farm::with_cpu_workers(1);
    let out = |name: &str| -> PathBuf { folder.path().join(name) };
    let iterations = ["--iterations", "200"];
    finish(start(&farm, &input, &out("quiet"), &iterations));

    let resume = [&iterations[..], &["--resume"]].concat();
    let mut run = start(&farm, &input, &out("resumed"), &resume);
    run.wait_for(|line| done(line, 2));
    run.signal(Signal::Term);
    let (status, stderr) = run.finish();
    assert_eq!(status.code(), Some(1), "an incomplete result is not a success; stderr:\n{stderr}");
    assert!(stderr.contains("the same command goes on"), "what to do is said:\n{stderr}");
    assert_eq!(fs::read_dir(out("resumed")).expect("the folder").count(), 1, "the journal is all there is");
    let (status, stderr) =
        start(&farm, &input, &out("resumed"), &[&resume[..], &["--seed", "2"]].concat()).finish();
    assert_eq!(status.code(), Some(2), "another seed is another run; stderr:\n{stderr}");
    let sums = out("resumed").join("sums.bin");
    for others in [["--iterations", "20", "--seed", "2"], ["--iterations", "201", "--seed", "1"]] {
        let folder = out(others[1]);
        finish(start(&farm, &input, &folder, &others));
        fs::copy(folder.join("sums.bin"), &sums).expect("the sums are there");
        let (status, stderr) = start(&farm, &input, &out("resumed"), &resume).finish();
        assert!(!status.success() && stderr.contains("sums.bin"), "{others:?}; stderr:\n{stderr}");
        fs::remove_file(&sums).expect("it is left as it was");
    }

    let mut run = start(&farm, &input, &out("resumed"), &resume);
    let summary = run.wait_for(|line| line["event"] == "done");
    assert!(summary["jobs_journalled"].as_u64().is_some_and(|jobs| jobs >= 2), "{summary}");
    finish(run);
    assert_same(&out("quiet"), &out("resumed"), "stopped and resumed");
    assert!(
        !out("resumed").join("gleaner-journal").exists(),
        "a journal is removed when the results are written"
    );
}

#[test]
fn an_interrupted_run_leaves_what_can_be_continued() {
    let folder = TempDir::new().expect("a temporary folder");
    let input = alignment(&folder, 160, 40);
    let farm = Farm::with_cpu_workers(1);
    let out = folder.path().join("partial");
    let mut run = start(&farm, &input, &out, &["--iterations", "100000"]);
    run.wait_for(|line| done(line, 2));
    run.signal(Signal::Int);
    let (status, stderr) = run.finish();
    assert_eq!(status.code(), Some(1), "an incomplete result is not a success; stderr:\n{stderr}");
    assert!(stderr.contains("partial"), "stderr does not say that the result is partial:\n{stderr}");
    assert!(!files(&out).is_empty(), "all files are there");
    // As it would overwrite what took long, beginning anew is refused; so is another seed.
    let (status, stderr) = start(&farm, &input, &out, &["--iterations", "100000"]).finish();
    assert_eq!(status.code(), Some(2), "{stderr}");
    assert!(stderr.contains("--extend"), "{stderr}");
    let other = ["--iterations", "100000", "--extend", "--seed", "2"];
    let (status, stderr) = start(&farm, &input, &out, &other).finish();
    assert_eq!(status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("another seed"), "{stderr}");
}

#[test]
fn filters_leave_out_what_they_say() {
    let folder = TempDir::new().expect("a temporary folder");
    // b is short, c is a where both have residues, column 2 holds gaps.
    let text = b">a\nA-CG\n>b\n---G\n>c\nAACG\n>d\nT-GC\n>e\nT-CC\n".to_vec();
    let path = folder.path().join("alignment.fasta").display().to_string();
    fs::write(&path, text).expect("the folder is writable");
    let out = folder.path().join("out");
    let shown = out.display().to_string();
    let run = |more: &[&str]| {
        let fixed =
            ["mi", &path, "-o", &shown, "--iterations", "20", "--device", "cpu", "--min-coverage", "0.5"];
        farmctl(fixed.iter().chain(more))
    };
    let ended = run(&["--max-gap-share", "0.5", "--max-identity", "0.9"]);
    let stderr = String::from_utf8_lossy(&ended.stderr);
    assert!(ended.status.success() && stderr.contains("3 sequences, 3 columns"), "{stderr}");
    let record = fs::read(out.join("run.json")).expect("the record is there");
    let record: serde_json::Value = serde_json::from_slice(&record).expect("it is JSON");
    assert_eq!((&record["sequences_read"], &record["sequences"]), (&5.into(), &3.into()), "{record}");
    assert_eq!(record["column_numbers"], serde_json::json!([1, 3, 4]), "{record}");
    assert_eq!(record["filters"]["max_gap_share"], 0.5, "{record}");
    let pairs = fs::read_to_string(out.join("pairs.csv")).expect("the pairs are there");
    assert!(pairs.lines().any(|line| line.starts_with("1,A,4,G,3,")), "{pairs}");

    let ended = run(&["--extend", "--max-identity", "0.1"]);
    let stderr = String::from_utf8_lossy(&ended.stderr);
    assert_eq!(ended.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("the sums are of another alignment"), "{stderr}");
    let ended = run(&["--max-identity", "2"]);
    assert_eq!(ended.status.code(), Some(2), "{}", String::from_utf8_lossy(&ended.stderr));
}

#[test]
fn hostile_input_is_named_by_its_place() {
    let folder = TempDir::new().expect("a temporary folder");
    let cases: [(&str, Vec<u8>, &str); 6] = [
        ("empty", Vec::new(), "no sequence"),
        ("one", b">a\nACGT\n".to_vec(), "line 1: only one sequence"),
        ("unequal", b">a\nACGT\n>b\nACG\n".to_vec(), "line 3: sequence b has 3 columns"),
        ("binary", (0..=255).cycle().take(5_000).collect(), "line 1"),
        (
            "wide",
            [b">a\n".to_vec(), vec![b'A'; 1_000_000], b"\n>b\n".to_vec(), vec![b'C'; 1_000_000]].concat(),
            "columns",
        ),
        ("single", b">a\nA\n>b\nC\n".to_vec(), "at least two"),
    ];
    for (name, bytes, expected) in cases {
        let path = folder.path().join(name);
        fs::write(&path, bytes).expect("the folder is writable");
        let out = folder.path().join("out").display().to_string();
        let ended = farmctl(["mi", &path.display().to_string(), "-o", &out]);
        let stderr = String::from_utf8_lossy(&ended.stderr);
        assert_eq!(ended.status.code(), Some(1), "{name}: {stderr}");
        assert!(stderr.contains(expected), "{name}: {stderr}");
        assert!(stderr.contains(&path.display().to_string()), "{name}: {stderr}");
    }
    let ended = farmctl(["mi", "/nowhere", "-o", "/tmp"]);
    assert_eq!(ended.status.code(), Some(1));
}
