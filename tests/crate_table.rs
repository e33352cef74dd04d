//! The crate table of the design (`ARCHITECTURE.md`) as a test, for machines without cargo-deny. `deny.toml` says the same
//! with `bans.deny` and `wrappers`; that both name the same crates is a test here too.

#![allow(clippy::unwrap_used, reason = "a panic in a test is its failure, also in its helpers")]

use std::{collections::BTreeSet, path::Path, process::Command};

use serde_json::{Value, json};

/// Which of our crates each of our crates may name. One way: core <- wire, devices, kernels <- daemons, SDK <- command line.
const OURS: [(&str, &[&str]); 10] = [
    ("farm-core", &[]),
    ("proto", &["farm-core"]),
    ("gpu-exec", &["farm-core"]),
    ("coordinator", &["farm-core", "proto"]),
    ("worker", &["farm-core", "proto", "gpu-exec"]),
    ("client-sdk", &["farm-core", "proto"]),
    ("bdpt-kernel", &["farm-core", "client-sdk"]),
    ("mi-kernel", &["farm-core", "client-sdk"]),
    (
        "farmctl",
        &[
            "farm-core",
            "proto",
            "gpu-exec",
            "coordinator",
            "worker",
            "client-sdk",
            "bdpt-kernel",
            "mi-kernel",
        ],
    ),
    (
        "tests",
        &[
            "farm-core",
            "proto",
            "gpu-exec",
            "coordinator",
            "worker",
            "client-sdk",
            "bdpt-kernel",
            "mi-kernel",
            "farmctl",
        ],
    ),
];

/// Our crates that may name what the table keeps in one place; everyone else may not.
const RESTRICTED: [(&str, &[&str]); 13] = [
    ("libloading", &["coordinator"]),
    ("wgpu", &["gpu-exec"]),
    ("naga", &["gpu-exec"]),
    ("bincode", &["proto"]),
    ("quinn", &["proto"]),
    ("rustls", &["proto"]),
    ("rcgen", &["proto"]),
    ("prost", &["proto"]),
    ("tonic-prost", &["proto"]),
    ("tonic", &["proto", "coordinator", "worker", "client-sdk", "farmctl"]),
    ("tokio", &["proto", "coordinator", "worker", "client-sdk", "farmctl"]),
    ("axum", &["coordinator"]),
    ("redb", &["coordinator"]),
];

/// What tests of a crate may name besides: devices to run kernels on, naga to check layouts, a farm to link against, what a
/// simulated network stands in for and attackers speak.
const ALSO_IN_TESTS: [(&str, &[&str]); 5] = [
    ("bdpt-kernel", &["gpu-exec", "naga"]),
    ("mi-kernel", &["gpu-exec", "naga"]),
    ("client-sdk", &["coordinator", "worker", "gpu-exec"]),
    ("worker", &["coordinator", "client-sdk"]),
    ("tests", &["quinn", "tokio"]),
];

/// Everything the pure core may name outside its tests.
const CORE: [&str; 4] = ["rand", "serde", "thiserror", "tracing"];

/// Crates of which the kernels see the SDK only behind their feature `farm`.
const KERNELS: [&str; 2] = ["bdpt-kernel", "mi-kernel"];

#[test]
fn every_crate_names_only_what_the_table_allows() {
    let broken = violations(&metadata());
    assert!(broken.is_empty(), "the crate table is broken:\n{}", broken.join("\n"));
}

#[test]
fn deny_toml_says_the_same() {
    let text = std::fs::read_to_string(root().join("deny.toml")).unwrap();
    for (name, allowed) in RESTRICTED {
        let entry = text
            .lines()
            .find(|line| line.trim_start().starts_with(&format!("{{ crate = \"{name}\"")))
            .unwrap_or_else(|| panic!("deny.toml does not restrict {name}"));
        let wrappers = entry.split_once("wrappers = [").unwrap().1.split_once(']').unwrap().0;
        let wrappers: BTreeSet<&str> = wrappers
            .split(',')
            .map(|wrapper| wrapper.trim().trim_matches('"'))
            .filter(|wrapper| !wrapper.is_empty())
            .collect();
        let tests = ALSO_IN_TESTS
            .iter()
            .filter(|(_, names)| names.contains(&name))
            .map(|(crate_name, _)| *crate_name);
        let expected: BTreeSet<&str> = allowed.iter().copied().chain(tests).collect();
        let ours: BTreeSet<&str> = wrappers
            .iter()
            .copied()
            .filter(|wrapper| OURS.iter().any(|(crate_name, _)| crate_name == wrapper))
            .collect();
        assert_eq!(ours, expected, "deny.toml and this table differ about {name}");
    }
}

#[test]
fn a_broken_table_is_seen() {
    // Negative control: each rule once, against the real metadata with one dependency more.
    let cases = [
        ("client-sdk", json!({"name": "wgpu", "kind": null, "optional": false}), "wgpu"),
        ("worker", json!({"name": "wgpu", "kind": "dev", "optional": false}), "wgpu"),
        ("farm-core", json!({"name": "tokio", "kind": null, "optional": false}), "tokio"),
        ("farm-core", json!({"name": "bytes", "kind": null, "optional": false}), "bytes"),
        ("gpu-exec", json!({"name": "tonic", "kind": "build", "optional": false}), "tonic"),
        ("proto", json!({"name": "worker", "kind": null, "optional": false, "path": "worker"}), "worker"),
        (
            "bdpt-kernel",
            json!({"name": "client-sdk", "kind": null, "optional": false, "path": "client-sdk"}),
            "client-sdk",
        ),
        ("bdpt-kernel", json!({"name": "naga", "kind": null, "optional": false}), "naga"),
        (
            "coordinator",
            json!({"name": "bincode", "kind": null, "optional": false, "rename": "codec"}),
            "bincode",
        ),
    ];
    for (package, dependency, culprit) in cases {
        let mut metadata = metadata();
        let packages = metadata["packages"].as_array_mut().unwrap();
        let package_value = packages.iter_mut().find(|value| value["name"] == package).unwrap();
        package_value["dependencies"].as_array_mut().unwrap().push(dependency);
        let broken = violations(&metadata);
        assert!(
            broken.len() == 1
                && broken[0].starts_with(&format!("{package}: "))
                && broken[0].contains(culprit),
            "{package} naming {culprit} gives {broken:?}"
        );
    }
    let mut unknown = metadata();
    unknown["packages"].as_array_mut().unwrap().push(json!({"name": "common", "dependencies": []}));
    assert_eq!(violations(&unknown), ["common: is not in the table"]);
}

fn violations(metadata: &Value) -> Vec<String> {
    let mut broken = Vec::new();
    for package in metadata["packages"].as_array().unwrap() {
        let name = package["name"].as_str().unwrap();
        let Some((_, ours_allowed)) = OURS.iter().find(|(crate_name, _)| *crate_name == name) else {
            broken.push(format!("{name}: is not in the table"));
            continue;
        };
        for dependency in package["dependencies"].as_array().unwrap() {
            let named = dependency["name"].as_str().unwrap();
            let in_tests = dependency["kind"] == "dev";
            if in_tests && allowed_in_tests(name, named) {
                continue;
            }
            if OURS.iter().any(|(crate_name, _)| *crate_name == named) {
                if !ours_allowed.contains(&named) {
                    broken.push(format!("{name}: may not name our crate {named}"));
                } else if named == "client-sdk"
                    && KERNELS.contains(&name)
                    && dependency["optional"] != true
                    && !in_tests
                {
                    broken.push(format!("{name}: names client-sdk outside its feature `farm`"));
                }
            } else if let Some((_, allowed)) = RESTRICTED.iter().find(|(crate_name, _)| *crate_name == named)
                && !allowed.contains(&name)
            {
                broken.push(format!("{name}: may not name {named}, which belongs to {}", allowed.join(", ")));
            } else if name == "farm-core" && !in_tests && !CORE.contains(&named) {
                broken.push(format!("{name}: the pure core may not name {named}"));
            }
        }
    }
    broken
}

fn allowed_in_tests(name: &str, named: &str) -> bool {
    ALSO_IN_TESTS.iter().any(|(crate_name, also)| *crate_name == name && also.contains(&named))
}

fn metadata() -> Value {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--no-deps", "--format-version", "1", "--offline"])
        .current_dir(root())
        .output()
        .expect("cargo runs");
    assert!(output.status.success(), "cargo metadata: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("cargo metadata prints JSON")
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("tests/ lies in the workspace")
}
