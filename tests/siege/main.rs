//! Scenario 31 of `tests/README.md`: daemons that are besieged. Strangers say to every port what no peer would, as fast as two
//! cores allow, while an application has its jobs done: all of them come, memory stays in its bounds, and afterwards the farm
//! serves as before. How much of the throughput is left is printed beside its bar and not asserted: it is the machine's, too.

#![allow(clippy::unwrap_used, reason = "a step that fails fails its test")]

mod attack;
mod control;
mod data;
mod farm;

use client_sdk::{FarmError, FarmOptions, JobFailure};
use proto::{
    control::{CONNECTION_WINDOW_BYTES, MAX_MESSAGE_BYTES},
    link::{LINK_WINDOW_BYTES, MAX_LINKS},
};
use tokio::runtime::Runtime;

use self::{
    attack::{Siege, Target},
    control::Peer,
    farm::{Besieged, run, work},
};

/// Of the undisturbed throughput, what should be left.
const BAR: f64 = 0.9;
/// Ten seconds of the devices; a siege lasts twice as long.
const JOBS: u32 = 4_000;
/// What a connection costs its daemon whose peer sends next to nothing: the buffers of hyper and h2, or of quinn, rustls and a
/// link's reader, 64 KiB at the most, and its tasks.
const CONNECTION_BYTES: u64 = 128 << 10;

#[test]
fn s31_an_open_farm_works_on_under_siege() {
    // Messages of a session and frames of a link are taken in as they come, to their caps.
    let message = MAX_MESSAGE_BYTES as u64 + u64::from(CONNECTION_WINDOW_BYTES);
    let caps = [message * control::FILLERS, u64::from(LINK_WINDOW_BYTES) * data::STALLED_LINKS];
    let grown = endures(Besieged::open(), caps);
    assert!(grown[0] > caps[0] / 2 && grown[1] > caps[1] / 2, "what may be kept was brought: {grown:?} B");
}

#[test]
fn s31_a_secured_farm_works_on_under_siege() {
    // No stranger's session or link is read.
    endures(Besieged::secured(), [u64::from(CONNECTION_WINDOW_BYTES) * control::FILLERS, 0]);
}

/// `caps` are what attackers may have coordinator and worker keep beside their connections, in bytes. Gives by how much they have
/// grown.
fn endures(farm: Besieged, caps: [u64; 2]) -> [u64; 2] {
    let runtime = Runtime::new().unwrap();
    let app = runtime.block_on(farm.application());
    let undisturbed = runtime.block_on(work(&app, JOBS));
    let baselines = farm.peaks();

    let siege = Siege::lay(farm.target);
    let besieged = runtime.block_on(work(&app, 2 * JOBS));
    let tried = siege.lift();
    let peaks = farm.peaks();

    let connections = [
        control::SLOW_CONNECTIONS + control::SLOW_BROWSERS + control::FILLERS,
        // Half of a handshake is a connection until the node's patience with it is over.
        MAX_LINKS as u64,
    ];
    println!("s31: tried: {tried}");
    println!(
        "s31: {:.0} % of the throughput is left ({besieged:.0} of {undisturbed:.0} jobs/s; bar: {:.0} %)",
        100.0 * besieged / undisturbed,
        100.0 * BAR
    );
    let daemons = ["coordinator", "worker"].into_iter().zip(baselines).zip(peaks);
    let bounds = connections.map(|connections| connections * CONNECTION_BYTES);
    for (((name, baseline), peak), (bound, cap)) in daemons.zip(bounds.into_iter().zip(caps)) {
        let bound = 2 * baseline + bound + cap;
        println!(
            "s31: {name}: {} MiB at most, {} MiB before, bound {} MiB",
            peak >> 20,
            baseline >> 20,
            bound >> 20
        );
        assert!(peak < bound, "{name}: {peak} B resident, bound {bound} B");
    }
    assert!(besieged > 0.0, "something gets done");

    let status = farm.status();
    assert_eq!(status["nodes"].as_array().map(Vec::len), Some(1), "{status}");
    let other = runtime.block_on(farm.application());
    runtime.block_on(work(&other, 10));
    runtime.block_on(async { tokio::join!(app.close(), other.close()) });
    [peaks[0] - baselines[0], peaks[1] - baselines[1]]
}

/// What the attackers say is refused for what it is.
#[test]
fn s31_hostile_bytes_are_refused_by_name() {
    let farm = Besieged::open();
    let Target { grpc, data, .. } = farm.target;
    Runtime::new().unwrap().block_on(async {
        for request in control::hostile_requests() {
            let peer = Peer::connect(grpc).await.unwrap();
            let status = peer.ask(&request).await;
            assert_eq!(status.as_deref().ok(), Some(request.status), "{}: {status:?}", request.what);
        }
        let stranger = data::stranger();
        for (reason, bytes) in data::broken_streams() {
            let closed = data::said_alone(&stranger, data, &bytes).await.unwrap_or_default();
            assert!(closed.contains(reason), "{reason:?} is not in {closed:?}");
        }
    });
}

#[test]
fn s31_nodes_take_no_early_data() {
    let farm = Besieged::open();
    Runtime::new().unwrap().block_on(async {
        assert!(!data::takes_early_data(farm.target.data).await, "it could be sent again by anybody");
        let generous = data::generous();
        assert!(data::takes_early_data(generous.local_addr().unwrap()).await, "the attempt is a real one");
    });
}

#[test]
fn s31_a_module_that_nests_without_end_fails_its_job_and_nothing_else() {
    const DEPTH: usize = 100_000;
    let nested = |before: &str, open: &str, close: &str, after: &str| {
        [before, &open.repeat(DEPTH), "1", &close.repeat(DEPTH), after].concat()
    };
    let farm = tests::Farm::with_cpu_workers(1);
    Runtime::new().unwrap().block_on(async {
        let app = client_sdk::Farm::connect(FarmOptions::new(&farm.grpc, "nested")).await.unwrap();
        for text in [
            nested("@compute @workgroup_size(1) fn main() { let x = ", "(", ")", "; }"),
            nested("@compute @workgroup_size(1) fn main() { ", "{", "}", " }"),
            nested("var<private> x: ", "array<", ",1>", ";"),
            nested("@compute @workgroup_size(1) fn main() { let x = ", "-", "", "; }"),
        ] {
            let failed = run(&app, 1, &text).await;
            let invalid =
                matches!(&failed, Err(FarmError::JobFailed { failure: JobFailure::InvalidProgram(_), .. }));
            assert!(invalid, "{}...: {failed:?}", &text[..80]);
        }
        work(&app, 10).await;
        app.close().await;
    });
}
