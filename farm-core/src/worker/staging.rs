//! Who is next on which device: staging from its own queue, stealing from siblings, the urgent place
//! (10-scheduling.md sections 2 and 3).

use super::{
    Effect, WorkerMachine,
    app::App,
    device::{Device, load_ns},
    job::{Handed, HeldState, Phase, Rank},
};
use crate::{
    id::{AppId, DeviceIndex, JobAttempt, JobId},
    message::{CostNs, LatencyClass},
    time::Instant,
};

/// One running, one staged: more would move the draw further away from the moment it counts.
const MAX_HANDED_OVER: usize = 2;

/// The part of a job's finish at its owner that a steal has to gain: below it the estimates' errors decide.
const LEAST_GAIN: f64 = 0.1;

impl WorkerMachine {
    /// Hands jobs to executors: first every device that is idle gets one, of its own or a sibling's, then the places
    /// behind are filled, at last those of interactive jobs that nobody idle took.
    pub(super) fn fill_devices(&mut self, now: Instant) {
        for places in 1..=MAX_HANDED_OVER {
            if self.devices.iter().all(|device| device.queued_jobs == 0) {
                break;
            }
            for index in self.device_indices() {
                while self.has_room(index, places) && self.hand_over_next(now, index) {}
            }
            if self.config.local_stealing {
                for index in self.device_indices() {
                    if self.has_room(index, places) {
                        self.steal(now, index);
                    }
                }
            }
        }
        if self.config.local_stealing && self.devices.iter().any(|device| device.handed_over.len() > 1) {
            for index in self.device_indices() {
                if self.has_room(index, 1) {
                    self.steal_staged(now, index);
                }
            }
        }
        for index in self.device_indices() {
            if self.has_urgent_room(index)
                && let Some((rank, LatencyClass::Interactive)) = self.draw(index, |_| true)
            {
                self.hand_over(now, rank, index, index);
            }
        }
    }

    /// How fast a device does its costs: measured, or by its score as measured siblings are by theirs.
    pub(super) fn speed(&self, device: &Device) -> f64 {
        if let Some(measured) = device.rate.measured() {
            return measured;
        }
        let mut siblings = (0_u32, 0.0);
        for sibling in &self.devices {
            if let Some(measured) = sibling.rate.measured() {
                siblings = (siblings.0 + 1, siblings.1 + measured / sibling.info.score);
            }
        }
        let point = if siblings.0 == 0 { 1.0 } else { siblings.1 / f64::from(siblings.0) };
        device.info.score * point
    }

    fn has_room(&self, index: DeviceIndex, places: usize) -> bool {
        let device = &self.devices[usize::from(index.0)];
        !device.lost && device.handed_over.len() < places
    }

    /// A third place, for the one interactive job that need not wait for the two before it.
    fn has_urgent_room(&self, index: DeviceIndex) -> bool {
        let device = &self.devices[usize::from(index.0)];
        let waits = |held: &super::HeldJob| {
            held.class == LatencyClass::Interactive
                && matches!(held.state, HeldState::HandedOver(handed) if handed.phase == Phase::Staged)
        };
        !device.lost
            && device.handed_over.len() == MAX_HANDED_OVER
            && !device.handed_over.iter().filter_map(|id| self.jobs.get(id)).any(waits)
    }

    /// Stages the next job of a device's own queue.
    fn hand_over_next(&mut self, now: Instant, index: DeviceIndex) -> bool {
        let Some((rank, _)) = self.draw(index, |_| true) else { return false };
        self.hand_over(now, rank, index, index);
        true
    }

    /// The next job of a device's queue, and the class that it counts as. The draw is among the applications of the
    /// highest class; one that had too much counts as batch: its class says when it is served, never how much.
    fn draw(&mut self, index: DeviceIndex, may: impl Fn(&App) -> bool) -> Option<(Rank, LatencyClass)> {
        let queues = self.devices[usize::from(index.0)].queues();
        let lags = &self.lags;
        let counts_as = |app: AppId, first: &Rank| {
            if lags.had_too_much(app) { LatencyClass::Batch } else { first.class.0 }
        };
        let (apps, projects, quota_bytes) = (&self.apps, &self.projects, self.spool_quota_bytes());
        let takes_part = |app: &AppId| {
            apps.get(app).is_some_and(|app| app.takes_results(quota_bytes, projects) && may(app))
        };
        let firsts = || {
            let queues = queues.iter().filter(|(app, _)| takes_part(app));
            queues.filter_map(|(&app, queue)| Some((app, queue.first()?)))
        };
        let class = firsts().map(|(app, first)| counts_as(app, first)).max()?;
        let mut candidates =
            firsts().filter(|(app, first)| counts_as(*app, first) == class).map(|(app, _)| app);
        let app = self.share.draw(lags, &mut candidates, &mut self.rng)?;
        let first = queues.get(&app)?.first()?;
        Some((*first, class))
    }

    fn hand_over(&mut self, now: Instant, rank: Rank, from: DeviceIndex, to: DeviceIndex) {
        let Some(held) = self.jobs.get_mut(&rank.job) else { return };
        held.state = HeldState::HandedOver(Handed::over(now, (from != to).then_some(from)));
        held.device = to;
        let (attempt, class, cost) = (held.attempt, held.class, held.cost);
        self.device_mut(from).dequeue(rank, cost);
        self.device_mut(to).handed_over.push_back(rank.job);
        self.lags.stage(rank.job.app);
        self.push(Effect::Execute { job: JobAttempt { job: rank.job, attempt }, device: to, class });
    }

    /// Takes a job from the sibling whose queue ends last, if there is a gain: it starts here before it would there,
    /// and ends here before that queue does.
    ///
    /// The application is drawn as for the sibling itself, or a device that only steals would be shared by nobody's
    /// rule. Of its jobs it is the first, where that ends earlier here; else the last, which would wait longest.
    fn steal(&mut self, now: Instant, thief: DeviceIndex) {
        let own = &self.devices[usize::from(thief.0)];
        if own.queued_jobs > 0 {
            return;
        }
        let ends =
            |victim: &Device| self.remaining_ns(now, victim) + victim.queued_ns() as f64 / self.speed(victim);
        let moves = |app: &App| !app.stays;
        let has_loot = |victim: &Device| {
            victim.queues().keys().filter_map(|app| self.apps.get(app)).any(moves)
                && own.stands_in_for(victim)
        };
        let victims = (0_u16..)
            .map(DeviceIndex)
            .zip(&self.devices)
            .filter(|(index, victim)| *index != thief && victim.queued_jobs > 0 && has_loot(victim));
        let last = victims
            .map(|(index, victim)| (index, ends(victim)))
            .max_by(|(_, one), (_, other)| one.total_cmp(other));
        let Some((victim, end)) = last else { return };
        let Some((first, _)) = self.draw(victim, moves) else { return };
        let [own, owner] = [thief, victim].map(|index| &self.devices[usize::from(index.0)]);
        let (here, there) = (self.remaining_ns(now, own), self.remaining_ns(now, owner));
        let takes = |device, rank: &Rank| {
            self.takes_ns(device, self.jobs.get(&rank.job).map_or(CostNs(0), |held| held.cost))
        };
        let ends_later_here = here + takes(own, &first) > there + takes(owner, &first);
        let queue = owner.queues().get(&first.job.app);
        let last = queue.and_then(|queue| queue.last()).copied().unwrap_or(first);
        let (rank, starts_there) =
            if ends_later_here { (last, end - takes(owner, &last)) } else { (first, there) };
        if here <= starts_there && end - (here + takes(own, &rank)) > LEAST_GAIN * end {
            self.hand_over(now, rank, victim, thief);
        }
    }

    /// An idle device takes what is only staged on a sibling, if that ends sooner here: at the end of a run nothing else is
    /// left. What the sibling has prepared for it is lost.
    fn steal_staged(&mut self, now: Instant, thief: DeviceIndex) {
        let own = &self.devices[usize::from(thief.0)];
        let mut best: Option<(f64, DeviceIndex, JobId)> = None;
        for (index, victim) in (0_u16..).map(DeviceIndex).zip(&self.devices) {
            let Some(&id) = victim.handed_over.back().filter(|_| victim.handed_over.len() > 1) else {
                continue;
            };
            let Some(held) = self.jobs.get(&id) else { continue };
            let staged = matches!(held.state, HeldState::HandedOver(handed) if handed.phase == Phase::Staged);
            let stays = self.apps.get(&id.app).is_some_and(|app| app.stays);
            if !staged || stays || !own.stands_in_for(victim) {
                continue;
            }
            let there = self.remaining_ns(now, victim);
            let gain = there - self.takes_ns(own, held.cost);
            if gain > LEAST_GAIN * there && best.is_none_or(|(most, ..)| gain > most) {
                best = Some((gain, index, id));
            }
        }
        let Some((_, victim, id)) = best else { return };
        let Some(held) = self.jobs.get_mut(&id) else { return };
        held.state = HeldState::HandedOver(Handed::over(now, Some(victim)));
        held.device = thief;
        let (job, class) = (JobAttempt { job: id, attempt: held.attempt }, held.class);
        self.device_mut(victim).handed_over.retain(|other| *other != id);
        self.device_mut(thief).handed_over.push_back(id);
        self.push(Effect::Abort { job, device: victim });
        self.push(Effect::Execute { job, device: thief, class });
    }

    /// How long a device still takes for what its executor holds, in nanoseconds.
    fn remaining_ns(&self, now: Instant, device: &Device) -> f64 {
        let held = device.handed_over.iter().filter_map(|id| self.jobs.get(id));
        held.map(|held| {
            let HeldState::HandedOver(handed) = held.state else { return 0.0 };
            (self.takes_ns(device, held.cost) - handed.ran(now).as_nanos() as f64).max(0.0)
        })
        .sum()
    }

    fn takes_ns(&self, device: &Device, cost: CostNs) -> f64 {
        load_ns(cost) as f64 / self.speed(device)
    }
}
