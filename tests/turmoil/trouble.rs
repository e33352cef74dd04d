//! What happens to farms: each kind of trouble is drawn from a seed, on a network of the seed's own.

use std::time::Duration;

use rand::{Rng as _, SeedableRng as _, rngs::SmallRng, seq::IndexedRandom as _};

use crate::farm::{APP, Act, COORDINATOR, Farm, NODES, Scene};

/// Who talks to whom.
const LINKS: [(&str, &str); 5] =
    [(APP, COORDINATOR), (NODES[0], COORDINATOR), (NODES[1], COORDINATOR), (APP, NODES[0]), (APP, NODES[1])];

/// A network without loss, on which work takes some ten seconds.
fn scene(seed: u64, rng: &mut SmallRng) -> Scene {
    Scene {
        seed,
        jobs: 200,
        latency: Duration::from_millis(rng.random_range(10..120)),
        fail_rate: 0.0,
        repair_rate: 1.0,
        secured: rng.random_bool(0.2),
    }
}

/// Sessions and links are made where much is lost: everybody begins at once, nobody waits for another.
pub(crate) fn handshake(seed: u64) -> Result<Duration, String> {
    let rng = &mut rng(seed);
    let scene = Scene {
        jobs: 12,
        fail_rate: rng.random_range(0.0..0.04),
        repair_rate: rng.random_range(0.2..1.0),
        secured: seed % 2 == 1,
        ..scene(seed, rng)
    };
    // All that came of it goes on to work when no more is lost.
    Farm::new(&scene).play(vec![(seconds(rng, 0.0, 10.0), Act::Clear)])
}

/// Links are silent for shorter and longer than every time-out, one to three times: what was said meanwhile is lost, or comes at once.
pub(crate) fn reconnect(seed: u64) -> Result<Duration, String> {
    let rng = &mut rng(seed);
    let scene = scene(seed, rng);
    let mut acts = Vec::new();
    let mut at = seconds(rng, 0.0, 2.0);
    for _ in 0..rng.random_range(1..=3) {
        let count = rng.random_range(1..=LINKS.len());
        let cut: Vec<_> = LINKS.choose_multiple(rng, count).copied().collect();
        let held = rng.random_bool(0.5);
        let back = at + seconds(rng, 2.0, 25.0);
        for &(one, other) in &cut {
            acts.push((at, if held { Act::Hold(one, other) } else { Act::Part(one, other) }));
        }
        for &(one, other) in &cut {
            acts.push((back, if held { Act::Release(one, other) } else { Act::Repair(one, other) }));
        }
        at = back + seconds(rng, 0.0, 6.0);
    }
    Farm::new(&scene).play(acts)
}

/// One node is parted from the application, or from the coordinator, or the application from the coordinator; both ways or one way.
pub(crate) fn partition(seed: u64) -> Result<Duration, String> {
    let rng = &mut rng(seed);
    let scene = scene(seed, rng);
    let (one, other) = match seed % 5 {
        0 | 1 => (APP, NODES[0]),
        2 | 3 => (NODES[0], COORDINATOR),
        _ => (APP, COORDINATOR),
    };
    let act = match seed / 5 % 3 {
        0 => Act::Part(one, other),
        1 => Act::Silence(one, other),
        _ => Act::Silence(other, one),
    };
    let at = seconds(rng, 0.0, 2.0);
    Farm::new(&scene).play(vec![(at, act), (at + seconds(rng, 8.0, 40.0), Act::Repair(one, other))])
}

/// A node, the coordinator or both die in mid-run and come back, at once or after a while.
pub(crate) fn bounce(seed: u64) -> Result<Duration, String> {
    let rng = &mut rng(seed);
    let scene = Scene { jobs: 300, ..scene(seed, rng) };
    let victims: &[&str] = match seed % 4 {
        0 => &[COORDINATOR],
        1 => &[NODES[0]],
        2 => &[NODES[1], COORDINATOR],
        _ => &[COORDINATOR, NODES[0], NODES[1]],
    };
    let mut acts = Vec::new();
    let mut at = seconds(rng, 0.0, 3.0);
    for &victim in victims {
        acts.push((at, Act::Crash(victim)));
        let back = at + if rng.random_bool(0.4) { Duration::ZERO } else { seconds(rng, 0.0, 15.0) };
        acts.push((back, Act::Bounce(victim)));
        // The next one may die while this one is away.
        at += seconds(rng, 0.0, 12.0);
    }
    acts.sort_by_key(|(at, _)| *at);
    Farm::new(&scene).play(acts)
}

fn rng(seed: u64) -> SmallRng {
    SmallRng::seed_from_u64(seed)
}

fn seconds(rng: &mut SmallRng, from: f64, to: f64) -> Duration {
    Duration::from_secs_f64(rng.random_range(from..to))
}
