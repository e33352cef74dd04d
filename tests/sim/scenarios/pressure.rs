//! An application that takes no results: scenario 27.

use tests::sim::{
    diary::Run,
    faults::Fault,
    world::{Setup, World},
};

use super::{
    farm::{HALF_SPEED, SEEDS, app_id, farm, seconds, setup},
    figures::{Bar, count, figure},
};
use crate::all_delivered;

/// What an application may leave on a node here: about fifteen results.
const QUOTA_BYTES: u64 = 20_000;

/// On each of a node's two devices one runs and one is staged when the quota is reached; a result is 2,672 bytes at most.
const ON_DEVICES_BYTES: u64 = 4 * 2_672;

/// How long it reads nothing.
const DEAF_S: f64 = 25.0;

/// 27: an application reads no results for 25 s. What each node keeps of it stays at its quota and what was on the devices when
/// that was reached; it gets no device there from then on, and the others at least what they get without it being deaf; when it
/// reads again everything is delivered.
#[test]
fn s27_an_application_stops_reading_results() {
    let (mut most, mut late, mut again) = (0, 0, 0);
    let mut least = f64::INFINITY;
    for seed in SEEDS {
        let quota = || Setup { spool_quota_bytes: QUOTA_BYTES, ..setup(seed, HALF_SPEED) };
        let (mut world, mut calm) = (farm(quota()), farm(quota()));
        world.run_for(seconds(3.0));
        let deaf = world.now;
        world.fault(Fault::Deafen { app: 1, duration: seconds(DEAF_S) });
        let app = app_id(&world, 1);
        let kept = |world: &World| world.workers.iter().map(|worker| worker.spooled_bytes(app)).max();
        for _ in 0..250 {
            world.run_for(seconds(DEAF_S / 250.0));
            most = most.max(kept(&world).unwrap_or(0));
        }
        // By then every node has reached the quota.
        let settled = deaf.after(seconds(12.0));
        late += world.diary.runs.iter().filter(|run| run.job.job.app == app && run.began > settled).count();
        calm.run_for(seconds(3.0 + DEAF_S));
        let others = |run: &Run| run.job.job.app != app;
        let time = |world: &World| world.diary.busy(deaf, world.now, others).as_secs_f64();
        least = least.min(time(&world) / time(&calm));
        world.finish();
        assert!(all_delivered(&world), "all of them, once it reads again: {}", world.describe());
        again += world.diary.executed_again();
    }
    let bar = Bar::AtMost((QUOTA_BYTES + ON_DEVICES_BYTES) as f64);
    figure("s27", "kept on one node, most", most as f64, "B", bar);
    count("s27", "its jobs begun once every node had reached the quota", late, Bar::Exactly(0.0));
    figure("s27", "device time of the others, of that without it", least * 100.0, "%", Bar::AtLeast(100.0));
    count("s27", "executed again", again, Bar::Exactly(0.0));
}
