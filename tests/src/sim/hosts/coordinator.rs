//! The coordinator's process, and what it finds on its disk when it starts.

use std::{collections::BTreeMap, time::Duration};

use farm_core::{
    coordinator::{
        CoordinatorConfig, CoordinatorMachine, Effect, Event,
        durable::{Keep, NodeSpeeds, Restored, Stopped},
        policy::{Choice, Question, QuestionId},
    },
    id::{Epoch, LinkId},
    message::{AppToCoordinator, CoordinatorToNode},
    project::{DEFAULT_PROJECT, Quota},
    time::Instant,
};
use rand::{Rng as _, SeedableRng as _, rngs::SmallRng};

use crate::sim::{
    auditor::Auditor,
    network::{Message, Proc},
    world::{Happening, Setup, World},
};

/// The plug-in that the coordinator knows.
pub(in crate::sim) const PLUGIN: &str = "plugin";

/// The projects of applications, by turns.
pub(in crate::sim) const PROJECTS: [&str; 2] = [DEFAULT_PROJECT, "films"];

/// What survives the coordinator's process: what it committed.
#[derive(Clone, Debug)]
pub(in crate::sim) struct Store {
    pub(in crate::sim) epoch: u32,
    /// Until when, in the world's time, and what the machine said of it.
    stopped: Vec<(Instant, Stopped)>,
    speeds: BTreeMap<String, NodeSpeeds>,
    pub(in crate::sim) quotas: BTreeMap<String, Quota>,
}

impl Store {
    pub(in crate::sim) const fn new() -> Self {
        Self { epoch: 1, stopped: Vec::new(), speeds: BTreeMap::new(), quotas: BTreeMap::new() }
    }

    fn keep(&mut self, now: Instant, keep: Keep) {
        match keep {
            Keep::Stopped(stopped) => {
                let until = now.after(Duration::from_millis(stopped.left_ms));
                self.stopped.push((until, stopped));
            }
            Keep::Speeds(speeds) => drop(self.speeds.insert(speeds.node.clone(), speeds)),
        }
    }

    fn restored(&self, now: Instant) -> Restored {
        let left_ms = |until: Instant| u64::try_from(until.since(now).as_millis()).unwrap_or(u64::MAX);
        let stopped = self.stopped.iter().filter(|(until, _)| *until > now);
        let stopped = stopped.map(|(until, stopped)| Stopped { left_ms: left_ms(*until), ..stopped.clone() });
        Restored { stopped: stopped.collect(), speeds: self.speeds.values().cloned().collect() }
    }

    /// A process that starts on this store.
    pub(in crate::sim) fn coordinator(&self, now: Instant, seed: u64, setup: &Setup) -> CoordinatorMachine {
        let config = CoordinatorConfig::new(Epoch(self.epoch), seed);
        CoordinatorMachine::new(CoordinatorConfig {
            liveness: setup.liveness,
            app_lease_ms: setup.app_lease_ms,
            max_crashes: setup.max_crashes,
            plugins: [PLUGIN.to_owned()].into(),
            restored: self.restored(now),
            quotas: self.quotas.clone(),
            ..config
        })
    }
}

impl World {
    /// The coordinator dies and another process, which knows only what is on the disk, takes its address at once.
    pub fn restart_coordinator(&mut self) {
        self.stop_coordinator();
        self.start_coordinator();
    }

    pub(in crate::sim) fn stop_coordinator(&mut self) {
        for link in self.links_of(Proc::Coordinator) {
            self.drop_link(link);
        }
        self.audit.disturbed(self.now, Proc::Coordinator, Proc::Coordinator);
        self.store.epoch += 1;
        self.coordinator_up = false;
        self.rearm(Proc::Coordinator);
    }

    pub(in crate::sim) fn start_coordinator(&mut self) {
        if self.coordinator_up {
            return;
        }
        self.coordinator_up = true;
        self.audit.coordinator_began(self.store.epoch);
        self.coordinator_clock = self.new_clock();
        self.coordinator = self.store.coordinator(self.now, self.store.epoch.into(), &self.setup);
        self.rearm(Proc::Coordinator);
    }

    pub(in crate::sim) fn coordinator_event(&mut self, event: Event) {
        if !self.coordinator_up {
            return;
        }
        self.introduce(&event);
        let before = self.coordinator.stolen_jobs();
        let answer = Auditor::steal_answer(&event);
        self.coordinator.handle(self.coordinator_clock.shows(self.now), event);
        self.audit.moved(answer, self.coordinator.stolen_jobs() - before);
        self.coordinator_settles();
    }

    /// Whose the connection is on which an application says hello.
    fn introduce(&mut self, event: &Event) {
        let Event::FromApp { link, message: AppToCoordinator::Hello(_) } = event else { return };
        let dialler = self.links.get(link).map(|link| link.dialler);
        if let (true, Some(Proc::App(app))) = (self.setup.projects, dialler) {
            let project = PROJECTS[app % PROJECTS.len()].to_owned();
            let now = self.coordinator_clock.shows(self.now);
            self.coordinator.handle(now, Event::AppIntroduced { link: *link, project });
        }
    }

    /// An operator changes what a project may have.
    pub(in crate::sim) fn set_quota(&mut self, project: &str, quota: Quota) {
        self.store.quotas.insert(project.to_owned(), quota);
        self.audit.quotas_changed(&self.coordinator.status().projects);
        self.coordinator_event(Event::QuotaSet { project: project.to_owned(), quota });
    }

    /// I8: a project has no more than its quota, or than it had when that was lowered.
    fn judge_projects(&mut self) {
        // What goes on over a restart is not counted until its node and its application are both back.
        if self.setup.projects && self.store.epoch == 1 {
            self.audit.projects_have(&self.coordinator.status().projects);
        }
    }

    pub(in crate::sim) fn coordinator_settles(&mut self) {
        if self.audit.is_due() {
            self.coordinator.check_invariants();
            self.judge_projects();
        }
        while let Some(effect) = self.coordinator.poll_effect() {
            self.log.enter(self.now, Proc::Coordinator, &effect);
            match effect {
                Effect::ToApp { link, message } => {
                    self.send(Proc::Coordinator, link, Message::CoordinatorToApp(message));
                }
                Effect::ToNode { link, message } => {
                    self.note_registration(link, &message);
                    self.send(Proc::Coordinator, link, Message::CoordinatorToNode(message));
                }
                Effect::Keep(keep) => self.store.keep(self.now, keep),
                Effect::Close { link } => self.hang_up(Proc::Coordinator, link),
                Effect::AskPolicy { id, question, .. } => self.plugin_thinks(id, &question),
            }
        }
        self.rearm(Proc::Coordinator);
    }

    fn note_registration(&mut self, link: LinkId, message: &CoordinatorToNode) {
        let dialler = self.links.get(&link).map(|link| link.dialler);
        if let (CoordinatorToNode::Welcome { .. }, Some(Proc::Worker(worker))) = (message, dialler) {
            self.diary.registers(self.now, worker);
        }
    }

    /// Half of the answers are good ones; the others come too late or never, are none, or leave a job out.
    fn plugin_thinks(&mut self, question: QuestionId, asked: &Question) {
        // A generator of its own: without plug-ins the world draws as it always did.
        let seed = self.setup.seed ^ (u64::from(self.store.epoch) << 32) ^ question.0;
        let mut rng = SmallRng::seed_from_u64(seed);
        let count = |length: usize| u32::try_from(length).expect("batches and farms are small");
        let (jobs, devices) = (count(asked.jobs.len()), count(asked.devices.len()));
        let mut choices: Vec<Choice> =
            (0..jobs).map(|job| Choice { job, device: rng.random_range(0..devices) }).collect();
        let (after_ms, answer) = match rng.random_range(0..8) {
            0..4 => (rng.random_range(1..90), Ok(choices)),
            4 => (rng.random_range(110..300), Ok(choices)),
            5 => (rng.random_range(1..90), Err("it crashed".to_owned())),
            6 => {
                choices.pop();
                (rng.random_range(1..90), Ok(choices))
            }
            _ => return,
        };
        let happening = Happening::PluginAnswers { epoch: self.store.epoch, question, answer };
        self.after(Duration::from_millis(after_ms), happening);
    }
}
