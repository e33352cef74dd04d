//! Two real applications at once on one device (thesis, figure 5.13), and what the timeline says of it afterwards.

use std::{fs, path::Path};

use serde_json::Value;
use tempfile::TempDir;
use tests::{Farm, Process, farmctl};

/// Exit code and stdout of `farmctl timeline`.
fn timeline(farm: &Farm, more: &[&str]) -> (Option<i32>, String) {
    let output = farmctl(["--coordinator", &farm.grpc, "timeline"].iter().chain(more));
    (output.status.code(), String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Starts a render and a run of mutual information that each take some seconds of the device.
fn start_both(farm: &Farm, folder: &Path) -> [Process; 2] {
    let path = |name: &str| folder.join(name).display().to_string();
    let scene = path("cornell");
    assert!(farmctl(["scene", "cornell-box", &scene]).status.success(), "the scene is written");
    let residue = |row: usize, column: usize| {
        char::from(b"ACDEFGHIKLMNPQRSTVWY"[(row * 7 + column * (row % 11 + 3)) % 20])
    };
    let sequence =
        |row| format!(">s{row}\n{}\n", (0..60).map(|column| residue(row, column)).collect::<String>());
    fs::write(folder.join("alignment.fasta"), (0..60).map(sequence).collect::<String>()).expect("it is ours");
    let (image, alignment, out) = (path("image.exr"), path("alignment.fasta"), path("mi"));
    let render = ["render", &scene, "-o", &image, "--size", "128x128", "--spp", "24"];
    let information = ["mi", &alignment, "-o", &out, "--iterations", "400"];
    [&render[..], &information[..]]
        .map(|verb| Process::start("farmctl", ["--coordinator", &farm.grpc].iter().chain(verb)))
}

fn number(segment: &Value, field: &str) -> u64 {
    segment[field].as_u64().unwrap_or_else(|| panic!("{field} of {segment}"))
}

#[test]
fn two_applications_share_a_device_and_the_timeline_shows_it() {
    let folder = TempDir::new().expect("a temporary folder");
    let mut farm = Farm::coordinator();
    assert_eq!(farm.add_worker("cpu")["event"], "ready", "the worker serves");
    assert_eq!(timeline(&farm, &[]), (Some(1), String::new()), "nothing ran");
    for process in start_both(&farm, folder.path()) {
        let (status, stderr) = process.finish();
        assert!(status.success(), "{status}; stderr:\n{stderr}");
    }

    // Both have left: what they ran is still told.
    let (code, json) = timeline(&farm, &["@all", "-o", "json"]);
    assert_eq!(code, Some(0), "{json}");
    let all: Value = serde_json::from_str(&json).expect("the timeline is JSON");
    let mut segments: Vec<&Value> = all["segments"].as_array().expect("segments").iter().collect();
    segments.sort_by_key(|segment| number(segment, "started_at"));
    for segment in &segments {
        let at = ["scheduled_at", "staged_at", "started_at", "ended_at"].map(|field| number(segment, field));
        assert!(at.is_sorted(), "{segment}");
    }
    let app = |segment: &Value| segment["job"]["job"]["app"].clone();
    let mut turns = 0;
    for pair in segments.windows(2) {
        assert!(number(pair[0], "ended_at") <= number(pair[1], "started_at"), "one job at a time: {pair:?}");
        turns += u32::from(app(pair[0]) != app(pair[1]));
    }
    assert!(turns >= 4, "{turns} turns: one waited for the other");

    let (code, picture) = timeline(&farm, &["@all", "-o", "svg"]);
    assert_eq!(code, Some(0), "{picture}");
    for name in ["<svg", "render cornell", "mi alignment.fasta", "w0"] {
        assert!(picture.contains(name), "{name} is missing in {picture}");
    }
    assert_eq!(timeline(&farm, &["app-77"]), (Some(1), String::new()), "an application that never was");
}
