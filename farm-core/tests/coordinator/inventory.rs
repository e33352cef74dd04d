//! What a node says it holds, compared with what is planned there.

use farm_core::{
    coordinator::Event,
    id::{JobAttempt, LinkId},
    message::NodeToCoordinator,
};

use crate::farm::{Farm, MILLISECOND_NS};

const NODE: u64 = 1;
/// How long a job may be missing, in milliseconds.
const MISSING_MS: u64 = 60_000;

fn farm_of_two_jobs() -> (Farm, JobAttempt, JobAttempt) {
    let mut farm = Farm::new("fcfs", &[1_000.0]);
    let planned = farm.plan(&[10, 10], 1, &[]);
    let [first, second] = planned[&NODE][..] else { panic!("two jobs are planned: {planned:?}") };
    (farm, first, second)
}

impl Farm {
    fn holds(&mut self, held: &[JobAttempt]) -> bool {
        self.asked.clear();
        let message = NodeToCoordinator::Holding(held.iter().copied().collect());
        self.handle(Event::FromNode { link: LinkId(NODE), message });
        !self.asked.is_empty()
    }
}

#[test]
fn a_node_that_holds_what_it_should_is_not_asked() {
    let (mut farm, first, second) = farm_of_two_jobs();
    assert!(!farm.holds(&[second, first]));
    assert!(farm.holds(&[first]));
}

#[test]
fn a_job_that_is_missing_at_two_looks_gets_a_new_attempt() {
    let (mut farm, first, second) = farm_of_two_jobs();
    assert_eq!(farm.inventory(NODE, &[first]), []);
    farm.asked.clear();
    farm.advance_to_ms(MISSING_MS - 1);
    assert_eq!(farm.inventory(NODE, &[first]), [], "a look in between is too soon");
    assert_eq!(farm.asked, []);
    farm.advance_to_ms(MISSING_MS);
    assert_eq!(farm.asked, [NODE]);
    let planned = farm.inventory(NODE, &[first]);
    assert!(matches!(planned[..], [again] if again.job == second.job && again.attempt > second.attempt));
    assert_eq!(farm.cancelled, [(NODE, second)], "should it come all the same it is not run");
}

#[test]
fn a_job_that_came_meanwhile_stays() {
    let (mut farm, first, second) = farm_of_two_jobs();
    farm.inventory(NODE, &[first]);
    farm.advance_to_ms(MISSING_MS);
    assert_eq!(farm.inventory(NODE, &[first, second]), []);
    assert_eq!(farm.cancelled, []);
    farm.advance_to_ms(3 * MISSING_MS);
    assert_eq!(farm.asked.len(), 1, "there is nothing left to ask for");
}

#[test]
fn what_nobody_waits_for_is_dropped() {
    let (mut farm, first, second) = farm_of_two_jobs();
    let mut older = first;
    older.attempt.sequence = 0;
    let mut foreign = first;
    foreign.job.index.0 = 99;
    farm.inventory(NODE, &[first, second, foreign]);
    assert_eq!(farm.cancelled, [(NODE, foreign)]);
    farm.inventory(NODE, &[older, second]);
    assert_eq!(farm.cancelled[1..], [(NODE, older)]);
    assert!(farm.now.0 < MILLISECOND_NS);
}
