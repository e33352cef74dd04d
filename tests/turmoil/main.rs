//! The farm's own network code, gRPC by tonic and QUIC by quinn, over a simulated network: the real coordinator, workers and SDK,
//! each on a host of turmoil's, with seeded delay, loss, partitions and deaths. Time is simulated, too: a minute of a farm takes
//! half a second.
//!
//! A seed is one farm with its weather and its trouble. A failing one is printed with the command that repeats it; `SEED=7` lets a
//! test run that seed alone. Handshakes' random numbers and the order of hash maps are not the seed's, so a run is the same in
//! what happens to it, not in every datagram.

#![allow(clippy::unwrap_used, reason = "a step that fails fails its test")]

mod application;
mod clock;
mod farm;
mod network;
mod trouble;

use std::{env, ops::Range, time::Duration};

use tracing_subscriber::EnvFilter;

/// Lets a failing seed be looked into: `RUST_LOG=debug` shows what each host says (`turmoil=trace` each message).
fn log() {
    let filter = EnvFilter::from_default_env();
    // Another test of this process may have done so.
    let _ = tracing_subscriber::fmt().with_env_filter(filter).with_test_writer().without_time().try_init();
}

/// Runs seeds of one kind of trouble, or the one that is asked for.
fn sweep(kind: &str, play: fn(u64) -> Result<Duration, String>, seeds: Range<u64>) {
    log();
    let asked = env::var("SEED").ok().map(|seed| seed.parse().expect("SEED is a number"));
    let seeds: Vec<u64> = asked.map_or_else(|| seeds.collect(), |seed| vec![seed]);
    for seed in seeds {
        let outcome = play(seed);
        match outcome {
            Ok(took) => println!("{kind} {seed}: {took:?} of the farm"),
            Err(reason) => panic!(
                "{reason}\nSEED={seed} cargo nextest run --workspace --locked -E 'binary(turmoil) & test({kind})'"
            ),
        }
    }
}

macro_rules! sweeps {
    ($($test:ident: $kind:ident, $seeds:expr;)*) => {
        $(#[test]
        fn $test() {
            sweep(stringify!($kind), trouble::$kind, $seeds);
        })*
    };
}

// Fifty seeds of each kind, cut in two so that both cores of a small builder have some.
sweeps! {
    handshake_to_25: handshake, 0..25;
    handshake_to_50: handshake, 25..50;
    reconnect_to_25: reconnect, 0..25;
    reconnect_to_50: reconnect, 25..50;
    partition_to_25: partition, 0..25;
    partition_to_50: partition, 25..50;
    bounce_to_25: bounce, 0..25;
    bounce_to_50: bounce, 25..50;
}
