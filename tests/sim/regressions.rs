//! What the simulator found, each made to happen again: first as a story that does not depend on how seeds are drawn, where
//! one could be made; then as the seed that found it.

use std::time::Duration;

use tests::sim::{
    faults::Fault,
    network::Proc,
    scenario::Scenario,
    world::{Setup, World},
};

use crate::all_delivered;

/// Seeds that found something, by scenario. They mean what they meant as long as a farm draws as it did.
const SEEDS: [(&str, &[u64]); 5] = [
    // A plan request lost after a change of coordinator, a welcome lost after one, a result that crossed a goodbye.
    ("storm", &[82, 194, 365, 1_302]),
    // 4679: what was held back of one application waited for its own jobs, while another one left a device with nothing.
    // 7644: chance alone left an application owed more than five of its largest jobs.
    ("parts", &[4_679, 7_644]),
    // 78: a content that nobody with a link waited for was never asked for again. 165: an application that resumed
    // numbered its batches from zero again, and was expelled for a number it had used. 305: crashes of second attempts
    // did not count. 2376: a node kept the programs of jobs that it refused. 5330: contents that could not be had made a
    // job poison. Of the simulator itself: 10284, 13445, 17727: jobs of applications that were away were held against
    // idle devices. 18944: a process that had ended took programs in. 6521: what a node moved off a lost device was not
    // seen by thieves. 47121, 68965, 71353, 73278: contents out of reach for two seconds failed their jobs. Of the simulator:
    // 35007, 47627: a job that was planned anew after its end was said to be stolen too often. 20267: before any job was
    // completed queues were taken for so short that nothing was worth a steal. 24543: all nodes waited for a content to come to
    // one whose application was gone. 1083, 10071: a coordinator that takes over what its predecessor planned knows nothing of
    // earlier steals, nor of plans that never left the predecessor. 66597: nobody took the queue behind a job that had taken a
    // thousand times what it should. 93593: a second attempt ended first, and its application had lost its link to that node and
    // sought the job at the other one for ever. Of the simulator, storm 194: a connection that broke before it stood was waited for.
    (
        "weather",
        &[
            78, 165, 305, 1_083, 2_376, 5_330, 6_521, 10_071, 10_284, 13_445, 17_727, 18_944, 20_267, 24_543,
            35_007, 47_121, 47_627, 66_597, 68_965, 71_353, 73_278, 93_593,
        ],
    ),
    // 17, 48, 143: an application that resumed without its memory was not told of jobs that had been executed, threw
    // their results away, and waited for them for ever. 218: as 165 of the weather.
    ("lives", &[17, 48, 143, 218]),
    // As 305 of the weather.
    ("devices", &[197]),
];

#[test]
fn seeds_that_found_something_find_nothing_now() {
    for (name, seeds) in SEEDS {
        let scenario = Scenario::named(name).unwrap();
        for &seed in seeds {
            let outcome = scenario.run(seed, None);
            assert_eq!(outcome.verdict, Ok(()), "simulate --scenario {name} --seed {seed}");
        }
    }
}

#[test]
fn a_content_wanted_for_nobody_comes_for_the_next_who_names_it() {
    // The first application's tickets arrive, its contents do not, and then it is gone: in some of these moments.
    for pause_ms in 5..60 {
        let mut world = World::new(Setup::calm(pause_ms, vec![vec![1.0]], 2));
        world.submit(0, 1, 0, 20);
        world.run_for(Duration::from_millis(pause_ms));
        let (from, to) = (Proc::Worker(0), Proc::App(1));
        world.fault(Fault::Partition { from, to, duration: Duration::from_millis(100) });
        world.run_for(Duration::from_millis(60));
        world.vanish_app(1, None);
        world.submit(500, 0, 0, 20);
        world.finish();
        assert!(all_delivered(&world), "{pause_ms} ms: {}", world.describe());
    }
}

#[test]
fn an_application_that_resumes_gets_the_results_that_came_while_it_was_away() {
    for pause_ms in (10..200).step_by(5) {
        let mut world = World::new(Setup::calm(pause_ms, vec![vec![1.0], vec![0.5]], 1));
        world.submit(0, 0, 0, 20);
        world.run_for(Duration::from_millis(pause_ms));
        world.vanish_app(0, Some(Duration::from_millis(200)));
        world.finish();
        assert!(all_delivered(&world), "{pause_ms} ms: {}", world.describe());
    }
}
