//! Farms by name and seed, and what became of them.

use std::{
    fs::File,
    panic::{self, AssertUnwindSafe},
    time::Duration,
};

use farm_core::{message::JobFailure, time::Instant};

use super::{
    auditor::Checks,
    hosts::Ending,
    storm,
    weather::{Kind, Weather},
    world::{Setup, World},
};

/// One run in this many has the machines check their books after every event, whatever the number of its jobs.
const THOROUGH_ONE_IN: u64 = 16;

/// A kind of farm, of which each seed is one.
#[derive(Clone, Copy, Debug)]
pub struct Scenario {
    /// What it is called.
    pub name: &'static str,
    /// What it is for.
    pub about: &'static str,
    story: Story,
}

#[derive(Clone, Copy, Debug)]
enum Story {
    /// The first generator of trouble.
    Storm,
    /// Any of these kinds of trouble.
    Weather(&'static [Kind]),
    /// Applications that always have work, and no trouble.
    Fair,
}

/// All of them.
pub const SCENARIOS: &[Scenario] = &[
    Scenario {
        name: "weather",
        about: "any farm, any work, any of all kinds of trouble",
        story: Story::Weather(&Kind::ALL),
    },
    Scenario {
        name: "storm",
        about: "the first generator: one farm, eleven kinds of trouble",
        story: Story::Storm,
    },
    Scenario {
        name: "network",
        about: "connections break, stall, fall silent, in one direction too, over long distances, with wrong clocks",
        story: Story::Weather(&[
            Kind::Breaks,
            Kind::Silence,
            Kind::Stalls,
            Kind::OneWay,
            Kind::Cuts,
            Kind::Distance,
            Kind::Doubles,
            Kind::Skew,
            Kind::Stealing,
            Kind::Scores,
        ]),
    },
    Scenario {
        name: "lives",
        about: "processes of all three tiers die and come back",
        story: Story::Weather(&[
            Kind::Restarts,
            Kind::Deaths,
            Kind::Collapse,
            Kind::Coordinator,
            Kind::Orphans,
            Kind::Resumes,
            Kind::Stealing,
            Kind::Cancels,
        ]),
    },
    Scenario {
        name: "devices",
        about: "slow and lost devices, poison jobs, failures by chance",
        story: Story::Weather(&[
            Kind::Grey,
            Kind::DeviceLoss,
            Kind::Poison,
            Kind::Crashes,
            Kind::Fetches,
            Kind::Scores,
            Kind::Stealing,
        ]),
    },
    Scenario {
        name: "elastic",
        about: "workers join and are drained while jobs are stolen between them; no job runs twice",
        story: Story::Weather(&[
            Kind::Joins,
            Kind::Drains,
            Kind::Stealing,
            Kind::Scores,
            Kind::Skew,
            Kind::Distance,
            Kind::Doubles,
        ]),
    },
    Scenario {
        name: "steals",
        about: "thieves race for victims that start, die and hear everything twice or late, while tasks are cancelled",
        story: Story::Weather(&[
            Kind::Stealing,
            Kind::Scores,
            Kind::Grey,
            Kind::Joins,
            Kind::Restarts,
            Kind::Deaths,
            Kind::Cancels,
            Kind::Doubles,
            Kind::Stalls,
            Kind::Distance,
        ]),
    },
    Scenario {
        name: "classes",
        about: "interactive jobs interrupt batch jobs on devices that are slow, get lost and are drained",
        story: Story::Weather(&[
            Kind::Classes,
            Kind::Breaks,
            Kind::Restarts,
            Kind::Resumes,
            Kind::Grey,
            Kind::DeviceLoss,
            Kind::Crashes,
            Kind::Drains,
            Kind::Joins,
            Kind::Cancels,
            Kind::Stealing,
        ]),
    },
    Scenario {
        name: "plugins",
        about: "a placement plug-in answers well, wrongly, late or never while nodes and devices come and go",
        story: Story::Weather(&[
            Kind::Plugins,
            Kind::Breaks,
            Kind::Restarts,
            Kind::Deaths,
            Kind::Coordinator,
            Kind::Resumes,
            Kind::DeviceLoss,
            Kind::Drains,
            Kind::Joins,
            Kind::Cancels,
            Kind::Stealing,
        ]),
    },
    Scenario {
        name: "parts",
        about: "jobs go out in parts and are measured by their neighbours while nodes, devices and processes come and go",
        story: Story::Weather(&[
            Kind::Parts,
            Kind::Breaks,
            Kind::Restarts,
            Kind::Deaths,
            Kind::Coordinator,
            Kind::Orphans,
            Kind::Resumes,
            Kind::Grey,
            Kind::DeviceLoss,
            Kind::Poison,
            Kind::Crashes,
            Kind::Drains,
            Kind::Joins,
            Kind::Cancels,
            Kind::Scores,
            Kind::Stealing,
        ]),
    },
    Scenario {
        name: "projects",
        about: "projects with quotas that change, while nodes, devices, applications and the coordinator come and go",
        story: Story::Weather(&[
            Kind::Projects,
            Kind::Breaks,
            Kind::Restarts,
            Kind::Deaths,
            Kind::Coordinator,
            Kind::Orphans,
            Kind::Resumes,
            Kind::Grey,
            Kind::DeviceLoss,
            Kind::Poison,
            Kind::Crashes,
            Kind::Drains,
            Kind::Joins,
            Kind::Cancels,
            Kind::Stealing,
        ]),
    },
    Scenario {
        name: "losses",
        about: "tickets, acknowledgements, orders and reports are lost on connections that stand; only comparisons tell",
        story: Story::Weather(&[
            Kind::Losses,
            Kind::Distance,
            Kind::Skew,
            Kind::Breaks,
            Kind::Restarts,
            Kind::Cancels,
            Kind::Stealing,
        ]),
    },
    Scenario {
        name: "fair",
        about: "three applications of unequal weights that always have work share one node",
        story: Story::Fair,
    },
];

/// What became of a run.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// Which run.
    pub seed: u64,
    /// Effects of all machines.
    pub events: u64,
    /// One number for all of them.
    pub log_hash: u64,
    /// How long it took on the world's clock.
    pub virtual_time: Duration,
    /// What was there to be judged.
    pub checks: Checks,
    /// The broken invariant, if any.
    pub verdict: Result<(), String>,
}

impl Scenario {
    /// The scenario of this name.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        SCENARIOS.iter().find(|scenario| scenario.name == name).copied()
    }

    /// Lets a seed run to its end, good or bad, with its log in a file if one is given.
    #[must_use]
    pub fn run(self, seed: u64, log: Option<File>) -> Outcome {
        let (mut world, weather) = match self.story {
            Story::Storm => (World::new(storm::setup(seed)), None),
            Story::Weather(kinds) => {
                let weather = Weather::forecast(seed, kinds);
                (World::new(weather.setup.clone()), Some(weather))
            }
            Story::Fair => (World::new(fair_setup(seed)), None),
        };
        if let Some(file) = log {
            world.log.write_to(file);
        }
        if seed.is_multiple_of(THOROUGH_ONE_IN) {
            world.audit.be_thorough();
        }
        let run = panic::catch_unwind(AssertUnwindSafe(|| {
            match (self.story, weather) {
                (Story::Storm, _) => storm::storm(&mut world),
                (Story::Weather(_), Some(weather)) => weather.come_over(&mut world),
                (Story::Weather(_), None) => {}
                (Story::Fair, _) => fair(&mut world),
            }
            world.finish();
            assert_endings(&world);
        }));
        Outcome {
            seed,
            events: world.log.entries(),
            log_hash: world.log.hash(),
            virtual_time: world.now.since(Instant::ZERO),
            checks: world.audit.checks,
            verdict: run.map_err(|panic| message(&*panic)),
        }
    }
}

/// I2: each job ended once, with its result or for a reason.
fn assert_endings(world: &World) {
    for host in &world.apps {
        for ((task, index), ending) in &host.endings {
            let poison = world.work.poison.contains(task);
            let fits = match ending {
                Ending::Delivered(_) => !poison,
                Ending::Failed(JobFailure::Cancelled) => host.cancelled.contains(task),
                // Whether it was one, the auditor asked.
                Ending::Failed(JobFailure::Poison(_) | JobFailure::PoisonApplication(_)) => true,
                Ending::Failed(_) => false,
            };
            assert!(fits, "I2: {task} {index} ended with {ending:?}");
        }
    }
}

/// One node of two devices, or two.
fn fair_setup(seed: u64) -> Setup {
    let node = vec![1.0, 0.5];
    Setup::calm(seed, vec![node; 1 + usize::from(seed.is_multiple_of(2))], 3)
}

fn fair(world: &mut World) {
    for app in 0..3 {
        world.submit(0, app, 0, 400);
    }
    let deadline = world.now.after(Duration::from_secs(60));
    world.run_until(deadline, |world| world.apps.iter().any(|host| host.is_done()));
}

fn message(panic: &(dyn std::any::Any + Send)) -> String {
    panic
        .downcast_ref::<String>()
        .cloned()
        .or_else(|| panic.downcast_ref::<&str>().map(|&text| text.to_owned()))
        .unwrap_or_else(|| "a panic without words".to_owned())
}
