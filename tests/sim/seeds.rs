//! Very many seeds, each a farm in trouble. Cut into tests of equal length, so that all cores have some.

use tests::sim::{auditor::Checks, scenario::Scenario};

/// Runs these seeds; a failing one is printed with the command that repeats it.
fn sweep(name: &str, seeds: std::ops::Range<u64>) -> Checks {
    let scenario = Scenario::named(name).expect("a scenario of this name");
    let mut sum = Checks::default();
    for seed in seeds {
        let outcome = scenario.run(seed, None);
        if let Err(broken) = outcome.verdict {
            panic!("simulate --scenario {name} --seed {seed}\n{broken}");
        }
        sum = sum.plus(outcome.checks);
    }
    sum
}

/// A sweep in which nothing was there to be judged proves nothing.
fn judge(name: &str, seeds: std::ops::Range<u64>) {
    let Checks { books, whereabouts, plans, executions, lags, steals, speculations, peer_fetches, .. } =
        sweep(name, seeds);
    assert!(books > 0 && plans > 0 && executions > 0, "nothing happened");
    assert!(whereabouts > 0, "I1: no quiet moment with open jobs");
    assert!(lags > 0, "I7: no moment with two backlogged applications");
    assert!(steals > 0, "I9: no steal");
    assert!(speculations > 0, "I5: no second attempt");
    assert!(peer_fetches > 0, "no node took a content from another one");
}

macro_rules! sweeps {
    ($($test:ident: $name:literal, $seeds:expr;)*) => {
        $(#[test]
        fn $test() {
            judge($name, $seeds);
        })*
    };
}

sweeps! {
    weather_to_300: "weather", 0..300;
    weather_to_600: "weather", 300..600;
    weather_to_900: "weather", 600..900;
    weather_to_1200: "weather", 900..1_200;
    storms: "storm", 0..250;
}

#[test]
fn networks() {
    sweep("network", 0..250);
}

#[test]
fn lives() {
    sweep("lives", 0..250);
}

#[test]
fn devices() {
    sweep("devices", 0..250);
}

#[test]
fn elastic_farms_execute_nothing_twice() {
    let checks = sweep("elastic", 0..250);
    assert!(checks.steals > 0, "and jobs were stolen");
}

#[test]
fn losses() {
    sweep("losses", 0..250);
}

#[test]
fn fair_shares() {
    let checks = sweep("fair", 0..8);
    assert!(checks.lags > 1_000, "lags were looked at");
}

#[test]
fn plugins() {
    let Checks { plugin_answers, executions, .. } = sweep("plugins", 0..250);
    assert!(plugin_answers > 0 && executions > 0, "no plug-in was asked");
}

#[test]
fn jobs_in_parts() {
    let checks = sweep("parts", 0..250);
    assert!(checks.executions > 0 && checks.steals > 0, "nothing went out in parts");
}

#[test]
fn projects() {
    let checks = sweep("projects", 0..250);
    assert!(checks.full_projects > 0 && checks.steals > 0, "no project had as much as it may have");
}

#[test]
fn classes() {
    let Checks { yields, executions, .. } = sweep("classes", 0..250);
    assert!(yields > 0 && executions > 0, "no job made way");
}
