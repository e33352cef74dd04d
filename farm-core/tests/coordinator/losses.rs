//! What a node loses while it stands: a device, or the way to the contents of its jobs.

use std::time::Duration;

use farm_core::{
    coordinator::{Event, Whereabouts},
    id::{ContentHash, DeviceIndex, JobAttempt, LinkId},
    message::{JobFailure, NodeToCoordinator},
};

use crate::farm::Farm;

#[test]
fn the_jobs_of_a_lost_device_are_booked_on_its_sibling() {
    let mut farm = Farm::new("", &[]);
    farm.node_of_devices_joins(1, &[1_000.0, 1_000.0]);
    farm.plan(&[10; 8], 1, &[]);
    let lost = NodeToCoordinator::DeviceLost { device: DeviceIndex(0), reason: "test".to_owned() };
    farm.handle(Event::FromNode { link: LinkId(1), message: lost });
    let node = &farm.machine.status().nodes[0];
    let devices: Vec<(bool, u64)> =
        node.devices.iter().map(|device| (device.lost, device.planned_jobs)).collect();
    assert_eq!(devices, [(true, 0), (false, 8)], "thieves see all that the one device has to do");
}

/// Fails the job for want of its contents wherever it goes, for so long; gives where it is then.
fn starve(farm: &mut Farm, mut job: JobAttempt, tries: u64, pause: Duration) -> Whereabouts {
    for _ in 0..tries {
        let planned = farm.failed(1, job, JobFailure::ContentUnavailable(ContentHash([7; 32])));
        let Some(&again) = planned.get(&1).and_then(|jobs| jobs.first()) else { break };
        job = again;
        farm.now = farm.now.after(pause);
    }
    farm.machine.whereabouts(job.job)
}

#[test]
fn contents_that_cannot_be_had_for_some_seconds_cost_no_job() {
    let mut farm = Farm::new("", &[1_000.0]);
    let job = farm.plan(&[10], 1, &[])[&1][0];
    let after_20_s = starve(&mut farm, job, 100, Duration::from_millis(200));
    assert!(matches!(after_20_s, Whereabouts::At { .. }), "{after_20_s:?}");
}

#[test]
fn contents_that_never_come_fail_their_job() {
    let mut farm = Farm::new("", &[1_000.0]);
    let job = farm.plan(&[10], 1, &[])[&1][0];
    let after_a_minute = starve(&mut farm, job, 20, Duration::from_secs(3));
    assert!(matches!(after_a_minute, Whereabouts::Unknown), "{after_a_minute:?}");
    assert_eq!(farm.open_jobs(), 0);
}
