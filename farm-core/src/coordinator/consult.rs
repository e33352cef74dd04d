//! Batches whose application chose a plug-in: it is asked, and waited for no longer than its budget. Whatever goes wrong,
//! the batch is placed first come, first served.
//!
//! A question is about the farm as it was; an answer is checked against the farm as it is.

use std::{collections::BTreeSet, time::Duration};

use super::{
    CoordinatorMachine, Effect,
    model::{Node, Pending},
    neighbours::Place,
    policy::{Choice, Question, QuestionId},
};
use crate::{id::TaskId, time::Instant};

/// How long a plug-in may take for a batch, in milliseconds.
const BUDGET_MS: u64 = 100;

/// A plug-in that failed this often in a row is not asked for a while.
const MAX_FAULTS: u32 = 3;

/// For how long, in milliseconds.
const DISTRUST_MS: u64 = 60_000;

/// A question without an answer.
#[derive(Debug)]
pub(super) struct Asked {
    plugin: String,
    pub(super) pending: Pending,
    pub(super) task: TaskId,
    question: Question,
    pub(super) answer_by: Instant,
}

/// How a plug-in did lately.
#[derive(Debug, Default)]
pub(super) struct PluginFaults {
    in_a_row: u32,
    /// Not asked before.
    trusted_at: Option<Instant>,
}

impl CoordinatorMachine {
    pub(super) fn is_trusted(&self, now: Instant, plugin: &str) -> bool {
        let trusted_at = self.plugin_faults.get(plugin).and_then(|faults| faults.trusted_at);
        trusted_at.is_none_or(|at| at <= now)
    }

    pub(super) fn ask(&mut self, now: Instant, plugin: String, pending: Pending, question: Question) {
        let id = QuestionId(self.next_question);
        self.next_question += 1;
        let answer_by = now.after(Duration::from_millis(BUDGET_MS));
        self.arm(answer_by);
        let effect = Effect::AskPolicy { id, plugin: plugin.clone(), question: question.clone() };
        self.effects.push_back(effect);
        let task = question.task;
        self.questions.insert(id, Asked { plugin, pending, task, question, answer_by });
    }

    pub(super) fn policy_answered(
        &mut self,
        now: Instant,
        id: QuestionId,
        answer: Result<Vec<Choice>, String>,
    ) {
        let Some(asked) = self.questions.remove(&id) else { return };
        let checked = answer.and_then(|choices| check(&asked.question, &choices).map(|()| choices));
        match checked {
            Ok(choices) => {
                self.plugin_faults.remove(&asked.plugin);
                self.place_as_answered(now, asked, &choices);
            }
            Err(reason) => self.fall_back(now, asked, &reason),
        }
    }

    pub(super) fn expire_questions(&mut self, now: Instant) {
        let due: Vec<QuestionId> =
            self.questions.iter().filter(|(_, asked)| asked.answer_by <= now).map(|(&id, _)| id).collect();
        for id in due {
            if let Some(asked) = self.questions.remove(&id) {
                self.fall_back(now, asked, &format!("no answer within {BUDGET_MS} ms"));
            }
        }
    }

    /// Jobs that went meanwhile are left out; a device that went sends the whole batch back into line.
    fn place_as_answered(&mut self, now: Instant, asked: Asked, choices: &[Choice]) {
        let Asked { pending, question, .. } = asked;
        let places: BTreeSet<Place> = choices
            .iter()
            .map(|choice| {
                let device = &question.devices[choice.device as usize];
                (device.node, device.device)
            })
            .collect();
        let stands = places.iter().all(|&place| self.still_takes(now, &pending, place));
        let within = self.is_within_quota(&pending, choices.len(), &places);
        let Some(app) = self.apps.get(&pending.app) else { return };
        if !stands || !within || app.link.is_none() {
            self.fresh.push_back(pending);
            return;
        }
        let waits = |choice: &&Choice| {
            let index = question.jobs[choice.job as usize].index;
            app.waiting_job(crate::id::JobKey { task: question.task, index }, pending.batch).is_some()
        };
        let choices: Vec<Choice> = choices.iter().filter(waits).copied().collect();
        if !choices.is_empty() {
            self.enter(now, &pending, &question, &choices);
        }
    }

    fn still_takes(&self, now: Instant, pending: &Pending, (node, index): Place) -> bool {
        let Some(app) = self.apps.get(&pending.app) else { return false };
        let takes_work = self.nodes.get(&node).is_some_and(Node::takes_work);
        let needs = app.batches.get(&pending.batch).map(|batch| batch.needs);
        takes_work
            && app.can_reach(now, node)
            && self
                .device((node, index))
                .zip(needs)
                .is_some_and(|(device, needs)| !device.lost && needs.fulfilled_by(&device.info))
    }

    /// The batch goes back into line, and the plug-in is passed over for it.
    fn fall_back(&mut self, now: Instant, asked: Asked, reason: &str) {
        let faults = self.plugin_faults.entry(asked.plugin.clone()).or_default();
        faults.in_a_row = faults.in_a_row.saturating_add(1);
        let distrusted = faults.in_a_row >= MAX_FAULTS;
        faults.trusted_at = distrusted.then(|| now.after(Duration::from_millis(DISTRUST_MS)));
        tracing::warn!(
            plugin = asked.plugin,
            app = %asked.pending.app,
            batch = %asked.pending.batch,
            reason,
            distrusted,
            "placement plug-in failed, placing first come, first served"
        );
        self.policy_fallbacks += 1;
        self.place_first_come(now, asked.pending);
    }
}

/// A choice for every job, each job once, devices that were named.
fn check(question: &Question, choices: &[Choice]) -> Result<(), String> {
    let (jobs, devices) = (question.jobs.len(), question.devices.len());
    if choices.len() != jobs {
        return Err(format!("{} choices for {jobs} jobs", choices.len()));
    }
    let mut chosen = vec![false; jobs];
    for choice in choices {
        match chosen.get_mut(choice.job as usize) {
            Some(chosen) if !*chosen => *chosen = true,
            Some(_) => return Err(format!("job {} is chosen twice", choice.job)),
            None => return Err(format!("there is no job {} of {jobs}", choice.job)),
        }
        if choice.device as usize >= devices {
            return Err(format!("there is no device {} of {devices}", choice.device));
        }
    }
    Ok(())
}
