//! When an application whose jobs crash is stopped, and when it is not.

use std::time::Duration;

use farm_core::{
    coordinator::Event,
    id::{DeviceIndex, JobAttempt, LinkId},
    message::{JobFailure, NodeToCoordinator},
};

use crate::farm::Farm;

/// Two nodes of eight devices, and a job for each of some devices: node 1's by index, then node 2's.
fn farm(jobs: usize) -> (Farm, Vec<(u64, JobAttempt)>) {
    let mut farm = Farm::new("", &[]);
    farm.node_of_devices_joins(1, &[1_000.0; 8]);
    farm.node_of_devices_joins(2, &[1_000.0; 8]);
    let planned = farm.plan(&vec![10; jobs], 1, &[]);
    let jobs = planned.into_iter().flat_map(|(node, jobs)| jobs.into_iter().map(move |job| (node, job)));
    let jobs = jobs.collect();
    (farm, jobs)
}

fn crash(farm: &mut Farm, jobs: &[(u64, JobAttempt)], device: impl Fn(u16) -> u16) {
    for (nth, &(node, job)) in (0..).zip(jobs) {
        farm.failed_on(node, DeviceIndex(device(nth)), job, JobFailure::Timeout);
    }
}

#[test]
fn eight_crashes_in_a_row_stop_an_application_for_a_minute() {
    let (mut farm, jobs) = farm(32);
    crash(&mut farm, &jobs[..4], |_| 0);
    crash(&mut farm, &jobs[16..19], |_| 0);
    assert!(farm.stopped.is_empty(), "seven are not enough");
    crash(&mut farm, &jobs[19..20], |_| 0);
    assert_eq!(farm.open_jobs(), 0, "everything of it is off the farm");
    let reason = farm.stopped.concat();
    let named =
        format!("8 attempts in a row ended with their devices, on 2 nodes, the last one, {}", jobs[19].1);
    assert!(reason.starts_with(&named) && reason.ends_with("Timeout"), "{reason}");
    let cancelled: Vec<JobAttempt> = farm.cancelled.iter().map(|(_, job)| *job).collect();
    let mut innocent = jobs[4..16].iter().chain(&jobs[20..]).map(|(_, job)| job);
    assert!(innocent.all(|job| cancelled.contains(job)), "nodes drop what they hold of it");

    assert!(farm.plan(&[10], 1, &[]).is_empty(), "it gets nothing");
    assert_eq!(farm.stopped.len(), 2, "and hears why");
    farm.now = farm.now.after(Duration::from_secs(60));
    assert_eq!(farm.plan(&[10], 1, &[]).len(), 1, "it may try again");
}

#[test]
fn a_driver_that_fails_with_all_devices_of_its_node_stops_nobody() {
    let (mut farm, jobs) = farm(16);
    crash(&mut farm, &jobs[..8], |nth| nth);
    assert!(farm.stopped.is_empty(), "each device crashed once");
    crash(&mut farm, &jobs[8..9], |_| 0);
    assert_eq!(farm.stopped.len(), 1, "another node is another matter");
}

#[test]
fn devices_and_nodes_that_are_lost_stop_nobody() {
    let (mut farm, jobs) = farm(48);
    for device in (0..4).map(DeviceIndex) {
        let lost = NodeToCoordinator::DeviceLost { device, reason: "test".to_owned() };
        farm.handle(Event::FromNode { link: LinkId(1), message: lost });
    }
    crash(&mut farm, &jobs[..16], |nth| nth % 4);
    farm.stop_taking(2);
    farm.now = farm.now.after(Duration::from_secs(5));
    farm.machine.handle_timeout(farm.now);
    farm.settle();
    assert_eq!(farm.machine.status().nodes.len(), 1, "the other node is given up");
    assert!(farm.stopped.is_empty());
}

#[test]
fn completed_jobs_speak_for_their_application() {
    let (mut farm, jobs) = farm(80);
    crash(&mut farm, &jobs[33..40], |_| 0);
    let (node, job) = jobs[0];
    farm.ended(node, job, 10);
    crash(&mut farm, &jobs[1..32], |_| 0);
    assert!(farm.stopped.is_empty(), "31 in a row");
    crash(&mut farm, &jobs[40..41], |_| 0);
    assert_eq!(farm.stopped.len(), 1, "32");
}
