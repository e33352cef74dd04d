//! `farmctl bench` as scripts meet it: the JSON contract and the exit code (70-users.md), not the figures, which are
//! of no worth on a machine that runs tests.

use std::{fs, process::Command};

use serde_json::Value;
use tempfile::TempDir;
use tests::{binary, farmctl};

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Whether an entry is as the contract says, its judgement included.
fn keeps_contract(entry: &Value) -> bool {
    const KEYS: [&str; 6] = ["figure", "value", "unit", "bar", "better", "ok"];
    let Some(object) = entry.as_object() else { return false };
    let (value, bar) = (entry["value"].as_f64(), entry["bar"].as_f64());
    let (Some(value), Some(bar), Some(ok)) = (value, bar, entry["ok"].as_bool()) else { return false };
    let reached = match entry["better"].as_str() {
        Some("higher") => value >= bar,
        Some("lower") => value <= bar,
        _ => return false,
    };
    object.len() == KEYS.len()
        && KEYS.iter().all(|key| object.contains_key(*key))
        && entry["figure"].is_string()
        && entry["unit"].is_string()
        && reached == ok
}

#[test]
fn a_bench_prints_figures_with_bars_and_exits_by_them() {
    let output = farmctl(["bench", "scheduler", "--runs", "1", "--seed", "7", "-o", "json"]);
    let stderr = text(&output.stderr);
    let figures: Value =
        serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {stderr}"));
    let figures = figures.as_array().expect("a list of figures");
    let named = |name: &str| figures.iter().any(|entry| entry["figure"] == name);
    assert!(named("noop_jobs_per_second") && named("coordinator_cpu_per_job"), "{figures:?}");
    for entry in figures {
        assert!(keeps_contract(entry), "{entry}");
    }
    let all_ok = figures.iter().all(|entry| entry["ok"] == true);
    assert_eq!(output.status.code(), Some(if all_ok { 0 } else { 1 }), "{figures:?}; stderr:\n{stderr}");
    assert!(stderr.contains("seed 7"), "the seed is told: {stderr}");
}

#[test]
fn a_broken_contract_is_seen() {
    // Negative control of the check above.
    let entry = |text: &str| serde_json::from_str::<Value>(text).expect("JSON");
    let good = r#"{"figure":"a","value":1.0,"unit":"ms","bar":2,"better":"lower","ok":true}"#;
    assert!(keeps_contract(&entry(good)));
    for (from, to) in [
        ("true", "false"),
        ("lower", "higher"),
        ("lower", "less"),
        ("1.0", "null"),
        ("\"unit\":\"ms\",", ""),
        ("\"a\"", "7"),
        ("\"ok\"", "\"fine\":1,\"ok\""),
    ] {
        assert!(!keeps_contract(&entry(&good.replace(from, to))), "{from} -> {to}");
    }
}

#[test]
fn a_missing_daemon_is_named_by_its_path() {
    // The binary's own folder: a hard link needs the same file system.
    let own = binary("farmctl");
    let folder = TempDir::new_in(own.parent().expect("a folder")).expect("a temporary folder");
    let alone = folder.path().join("farmctl");
    fs::hard_link(&own, &alone).expect("a link to farmctl");
    let output = Command::new(&alone).args(["bench", "steal"]).output().expect("farmctl starts");
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stderr));
    let missing = folder.path().join("farm-coordinator").display().to_string();
    assert!(text(&output.stderr).contains(&missing), "{}", text(&output.stderr));
    assert!(output.stdout.is_empty(), "no figures without a farm: {}", text(&output.stdout));
}
