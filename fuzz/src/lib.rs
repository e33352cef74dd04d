//! The table of decoders that `tests/hostile` replays, for libFuzzer.

#[path = "../../tests/hostile/targets/mod.rs"]
#[allow(dead_code, reason = "the replay makes seeds and judges memory with what is left over here")]
mod targets;

/// Runs a target. What it answers does not matter, that it does is asked.
pub fn run(target: &str, bytes: &[u8]) {
    let _ = (targets::named(target).decode)(bytes);
}
