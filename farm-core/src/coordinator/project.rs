//! What the applications of a project have together, and may have: devices, planned jobs, bytes, fair-share weight.
//!
//! What is over a quota waits in its project's line until the project has less, first come, first served; nothing is lost. Only a
//! batch that alone needs more bytes than its project may have fails.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use super::{
    CoordinatorMachine, ProjectStatus,
    model::{Batch, JobState, Pending, Placement},
    neighbours::Place,
    policy::{Question, QuestionDevice, QuestionJob},
};
use crate::{
    id::{AppId, ContentHash, JobId, JobKey, LinkId},
    message::{CoordinatorToNode, JobFailure, WaitReason},
    program::Content,
    project::{AppTerms, DEFAULT_PROJECT, Quota},
    time::Instant,
};

/// A project, for as long as an application of it is registered.
type Slot = u32;

/// The books of projects.
#[derive(Debug)]
pub(super) struct Projects {
    projects: BTreeMap<Slot, Project>,
    by_name: BTreeMap<String, Slot>,
    next: Slot,
    of: BTreeMap<AppId, Slot>,
    /// Have less than they had, since the last look at their lines.
    relieved: BTreeSet<Slot>,
    /// Whose the connection is on which a hello comes next.
    introduced: Option<(LinkId, String)>,
}

#[derive(Debug)]
struct Project {
    name: String,
    quota: Quota,
    /// With the weights that they asked for.
    apps: BTreeMap<AppId, f64>,
    /// Attempts on each device; of backups, too.
    devices: BTreeMap<Place, u32>,
    /// Size in bytes of each content, and the batches that name it.
    contents: BTreeMap<ContentHash, (u64, u32)>,
    /// Their sum; sizes are what applications say, up to the last of 64 bits.
    content_bytes: u128,
    /// Jobs that wait until it has less.
    line: VecDeque<Pending>,
}

impl Project {
    /// What its applications' weights come to by what these ask for; finite, however large each is.
    fn asked_weight(&self) -> f64 {
        // Not `sum`: of nothing that is -0.0.
        self.apps.values().fold(0.0, |sum, weight| sum + weight).min(f64::MAX)
    }

    /// What the weights of its applications are multiplied by.
    fn weight_scale(&self) -> f64 {
        self.quota.weight.map_or(1.0, |most| (most / self.asked_weight()).min(1.0))
    }

    /// Bytes of these contents that do not count yet.
    fn additional_bytes(&self, contents: &[Content]) -> u128 {
        let new = distinct(contents).filter(|(hash, _)| !self.contents.contains_key(hash));
        new.map(|(_, size_bytes)| u128::from(size_bytes)).sum()
    }

    fn may_use(&self, place: Place) -> bool {
        let has_room =
            |most| self.devices.len() + usize::from(!self.devices.contains_key(&place)) <= most as usize;
        self.quota.devices.is_none_or(has_room)
    }
}

impl Projects {
    pub(super) fn new(quotas: BTreeMap<String, Quota>) -> Self {
        let mut projects = Self {
            projects: BTreeMap::new(),
            by_name: BTreeMap::new(),
            next: 0,
            of: BTreeMap::new(),
            relieved: BTreeSet::new(),
            introduced: None,
        };
        projects.named(DEFAULT_PROJECT);
        for (name, quota) in quotas {
            let slot = projects.named(&name);
            projects.set(slot, quota);
        }
        projects
    }

    /// The next hello on a connection is of somebody of this project.
    pub(super) fn introduce(&mut self, link: LinkId, project: String) {
        self.introduced = Some((link, project));
    }

    /// Whose the connection is that says hello.
    pub(super) fn introduced(&mut self, link: LinkId) -> String {
        let introduced = self.introduced.take().filter(|(introduced, _)| *introduced == link);
        introduced.map_or_else(|| DEFAULT_PROJECT.to_owned(), |(_, project)| project)
    }

    pub(super) fn name_of(&self, app: AppId) -> &str {
        self.project_of(app).map_or(DEFAULT_PROJECT, |project| &project.name)
    }

    pub(super) fn quota_of(&self, app: AppId) -> Quota {
        self.project_of(app).map_or_else(Quota::default, |project| project.quota)
    }

    /// An attempt got a place.
    pub(super) fn occupies(&mut self, app: AppId, place: Place) {
        if let Some((_, project)) = self.project_of_mut(app) {
            *project.devices.entry(place).or_default() += 1;
        }
    }

    /// An attempt lost or left its place.
    pub(super) fn vacates(&mut self, app: AppId, place: Place) {
        let Some((slot, project)) = self.project_of_mut(app) else { return };
        let Some(attempts) = project.devices.get_mut(&place) else { return };
        *attempts -= 1;
        if *attempts == 0 {
            project.devices.remove(&place);
            self.relieved.insert(slot);
        }
    }

    /// An application has fewer jobs planned.
    pub(super) fn relieve(&mut self, app: AppId) {
        self.relieved.extend(self.of.get(&app));
    }

    /// Somewhere a device takes work again.
    pub(super) fn relieve_all(&mut self) {
        let waits = self.projects.iter().filter(|(_, project)| !project.line.is_empty());
        self.relieved.extend(waits.map(|(&slot, _)| slot));
    }

    /// Whether a job of the application may be placed there.
    pub(super) fn may_use(&self, app: AppId, place: Place) -> bool {
        self.project_of(app).is_none_or(|project| project.may_use(place))
    }

    /// A batch of the application had its first place.
    pub(super) fn counts(&mut self, app: AppId, contents: &[Content]) {
        let Some((_, project)) = self.project_of_mut(app) else { return };
        for (hash, size_bytes) in distinct(contents) {
            let (counted_bytes, batches) = project.contents.entry(hash).or_insert((size_bytes, 0));
            if *batches == 0 {
                project.content_bytes += u128::from(*counted_bytes);
            }
            *batches += 1;
        }
    }

    /// A batch is over: if it counted, it does no more.
    pub(super) fn batch_over(&mut self, app: AppId, batch: &Batch) {
        if !batch.counted {
            return;
        }
        let Some((slot, project)) = self.project_of_mut(app) else { return };
        for (hash, _) in distinct(&batch.contents) {
            let Some((size_bytes, batches)) = project.contents.get_mut(&hash) else { continue };
            *batches -= 1;
            if *batches == 0 {
                project.content_bytes -= u128::from(*size_bytes);
                project.contents.remove(&hash);
            }
        }
        self.relieved.insert(slot);
    }

    /// Jobs that wait for their project, in the order that each project's will go on.
    pub(super) fn lines(&self) -> impl Iterator<Item = &Pending> {
        self.projects.values().flat_map(|project| &project.line)
    }

    pub(super) fn lines_mut(&mut self) -> impl Iterator<Item = &mut VecDeque<Pending>> {
        self.projects.values_mut().map(|project| &mut project.line)
    }

    /// Puts jobs into line: behind those of the project that wait already, or before them.
    fn line_up(&mut self, pending: Pending, first: bool) {
        let Some((_, project)) = self.project_of_mut(pending.app) else { return };
        if first {
            project.line.push_front(pending);
        } else {
            project.line.push_back(pending);
        }
    }

    fn named(&mut self, name: &str) -> Slot {
        if let Some(&slot) = self.by_name.get(name) {
            return slot;
        }
        let slot = self.next;
        self.next = self.next.wrapping_add(1);
        self.by_name.insert(name.to_owned(), slot);
        let project = Project {
            name: name.to_owned(),
            quota: Quota::default(),
            apps: BTreeMap::new(),
            devices: BTreeMap::new(),
            contents: BTreeMap::new(),
            content_bytes: 0,
            line: VecDeque::new(),
        };
        self.projects.insert(slot, project);
        slot
    }

    fn set(&mut self, slot: Slot, quota: Quota) {
        if let Some(project) = self.projects.get_mut(&slot) {
            project.quota = quota;
            self.relieved.insert(slot);
        }
    }

    fn project_of(&self, app: AppId) -> Option<&Project> {
        self.projects.get(self.of.get(&app)?)
    }

    fn project_of_mut(&mut self, app: AppId) -> Option<(Slot, &mut Project)> {
        let slot = *self.of.get(&app)?;
        Some((slot, self.projects.get_mut(&slot)?))
    }

    /// Nobody can find a removed project whose last application has left.
    fn forget_if_gone(&mut self, slot: Slot) {
        let Some(project) = self.projects.get(&slot) else { return };
        if project.apps.is_empty() && self.by_name.get(&project.name) != Some(&slot) {
            self.projects.remove(&slot);
        }
    }
}

/// Each content once.
fn distinct(contents: &[Content]) -> impl Iterator<Item = (ContentHash, u64)> + use<> {
    let distinct: BTreeMap<ContentHash, u64> =
        contents.iter().map(|content| (content.hash, content.size_bytes)).collect();
    distinct.into_iter()
}

impl CoordinatorMachine {
    /// An application registered: nodes hear what it may have, and those of its project what is left for them.
    pub(super) fn app_enters_project(&mut self, id: AppId, name: &str, weight: f64) {
        let slot = self.projects.named(name);
        self.projects.of.insert(id, slot);
        let Some(project) = self.projects.projects.get_mut(&slot) else { return };
        let before = project.weight_scale();
        project.apps.insert(id, weight);
        if project.weight_scale() == before || project.apps.len() == 1 {
            self.tell_terms([id]);
        } else {
            self.tell_terms_of(slot);
        }
    }

    /// An application left, and its jobs lost their places.
    pub(super) fn app_leaves_project(&mut self, id: AppId) {
        let Some(slot) = self.projects.of.remove(&id) else { return };
        let Some(project) = self.projects.projects.get_mut(&slot) else { return };
        let before = project.weight_scale();
        project.apps.remove(&id);
        let rescaled = project.weight_scale() != before;
        self.projects.relieved.insert(slot);
        if rescaled {
            self.tell_terms_of(slot);
        }
        self.projects.forget_if_gone(slot);
    }

    /// An operator says what a project may have; one that is not there is made.
    pub(super) fn set_quota(&mut self, name: &str, quota: Quota) {
        let slot = self.projects.named(name);
        self.projects.set(slot, quota);
        self.tell_terms_of(slot);
    }

    /// A project is none any more. What is registered of it goes on without quotas until it leaves.
    pub(super) fn remove_project(&mut self, name: &str) {
        if name == DEFAULT_PROJECT {
            return;
        }
        if let Some(slot) = self.projects.by_name.remove(name) {
            self.projects.set(slot, Quota::default());
            self.tell_terms_of(slot);
            self.projects.forget_if_gone(slot);
        }
    }

    fn tell_terms_of(&mut self, slot: Slot) {
        let apps = self.projects.projects.get(&slot).map(|project| project.apps.keys().copied().collect());
        let apps: Vec<AppId> = apps.unwrap_or_default();
        self.tell_terms(apps);
    }

    fn tell_terms(&mut self, apps: impl IntoIterator<Item = AppId>) {
        let apps: Vec<_> = apps.into_iter().map(|app| (app, self.terms_of(app))).collect();
        if apps.is_empty() {
            return;
        }
        for node in self.nodes.keys().copied().collect::<Vec<_>>() {
            self.tell_node(node, CoordinatorToNode::AppsJoined(apps.clone()));
        }
    }

    /// What an application may have of a node.
    pub(super) fn terms_of(&self, app: AppId) -> AppTerms {
        let Some(project) = self.projects.project_of(app) else { return AppTerms::unlimited(1.0) };
        let asked = project.apps.get(&app).copied().unwrap_or(1.0);
        AppTerms {
            // However little is left of it, it is more than nothing.
            weight: (asked * project.weight_scale()).max(f64::MIN_POSITIVE),
            project: project.name.clone(),
            result_bytes: project.quota.bytes,
            stays: project.quota.devices.is_some(),
        }
    }

    /// Places what waits of relieved projects, as far as these may have it.
    pub(super) fn serve_lines(&mut self, now: Instant) {
        while let Some(slot) = self.projects.relieved.pop_first() {
            let line = |machine: &mut Self| {
                let project = machine.projects.projects.get_mut(&slot)?;
                Some((project.line.len(), project.line.pop_front()?))
            };
            while let Some((waited, pending)) = line(self) {
                self.place_batch(now, pending);
                // The first one is there again, or what is left of it: those behind it wait for it.
                if self.projects.projects.get(&slot).is_some_and(|project| project.line.len() >= waited) {
                    break;
                }
            }
        }
    }

    /// Whether new jobs of an application have to wait behind others of its project. Then they do, unless there is nothing to
    /// wait for.
    pub(super) fn waits_in_line(&mut self, pending: &mut Pending) -> bool {
        let Some(project) = self.projects.project_of(pending.app) else { return false };
        let fails = |most| matches!(self.bytes_fit(pending, most), Fits::Never(_));
        let waits = !project.line.is_empty() && !project.quota.bytes.is_some_and(fails);
        if waits {
            self.wait_for_project(pending, false);
        }
        waits
    }

    /// Leaves a batch as many of its waiting jobs as the project may have planned now; the others wait. False: there is no room.
    pub(super) fn has_room(&mut self, pending: &mut Pending) -> bool {
        let Some(most) = self.projects.quota_of(pending.app).queued_jobs else { return true };
        let room = most.saturating_sub(self.planned_of_project(pending.app));
        let Some(app) = self.apps.get(&pending.app) else { return false };
        if room == 0 {
            self.wait_for_project(pending, true);
            return false;
        }
        let mut left = usize::try_from(room).unwrap_or(usize::MAX);
        let fits = pending.keys.iter().take_while(|key| {
            left -= usize::from(app.waiting_job(**key, pending.batch).is_some());
            left > 0
        });
        let taken = fits.count() + 1;
        if taken < pending.keys.len() {
            let keys = pending.keys.split_off(taken);
            self.projects.line_up(Pending { keys, ..*pending }, true);
        }
        true
    }

    /// Reduces what is to be decided to what the application's project may have now; the other jobs wait. `None`: all do, or
    /// they need more than that project may ever have.
    pub(super) fn within_quota(&mut self, pending: &mut Pending, mut question: Question) -> Option<Question> {
        let quota = self.projects.quota_of(pending.app);
        if quota == (Quota { weight: quota.weight, ..Quota::default() }) {
            return Some(question);
        }
        let key = |job: &QuestionJob| JobKey { task: question.task, index: job.index };
        pending.keys = question.jobs.iter().map(key).collect();
        if let Some(most) = quota.bytes {
            match self.bytes_fit(pending, most) {
                Fits::Now => {}
                Fits::Later => return self.wait_first(pending),
                Fits::Never(reason) => {
                    for key in std::mem::take(&mut pending.keys) {
                        self.fail_job(key.in_app(pending.app), JobFailure::OverQuota(reason.clone()));
                    }
                    return None;
                }
            }
        }
        if let Some(most) = quota.devices {
            question.devices = self.permitted(pending.app, most, &question);
            if question.devices.is_empty() {
                return self.wait_first(pending);
            }
        }
        Some(question)
    }

    /// Whether what a policy chose is within the project's quotas still.
    pub(super) fn is_within_quota(&self, pending: &Pending, jobs: usize, devices: &BTreeSet<Place>) -> bool {
        let app = pending.app;
        let Some(project) = self.projects.project_of(app) else { return true };
        let more = devices.iter().filter(|place| !project.devices.contains_key(place)).count();
        // What the project is on it was offered, even where that is more than it may have now.
        let has_devices = |most| more == 0 || project.devices.len() + more <= most as usize;
        let has_room = |most| self.planned_of_project(app) + jobs as u64 <= most;
        let has_bytes = |most| matches!(self.bytes_fit(pending, most), Fits::Now);
        project.quota.devices.is_none_or(has_devices)
            && project.quota.queued_jobs.is_none_or(has_room)
            && project.quota.bytes.is_none_or(has_bytes)
    }

    /// A batch has its first place: its contents count from now on.
    pub(super) fn count_contents(&mut self, pending: &Pending) {
        let batch = self.apps.get_mut(&pending.app).and_then(|app| app.batches.get_mut(&pending.batch));
        if let Some(batch) = batch.filter(|batch| !batch.counted) {
            batch.counted = true;
            self.projects.counts(pending.app, &batch.contents);
        }
    }

    pub(super) fn project_statuses(&self) -> Vec<ProjectStatus> {
        let listed = self.projects.by_name.values().filter_map(|slot| self.projects.projects.get(slot));
        listed
            .map(|project| ProjectStatus {
                project: project.name.clone(),
                quota: project.quota,
                apps: project.apps.len() as u64,
                devices: project.devices.len() as u64,
                queued_jobs: self.planned(project),
                waiting_jobs: self.apps_of(project).map(|app| app.waiting_jobs).sum(),
                bytes: u64::try_from(project.content_bytes).unwrap_or(u64::MAX),
                weight: project.asked_weight() * project.weight_scale(),
            })
            .collect()
    }

    /// What was about to be placed is the next to be.
    fn wait_first(&mut self, pending: &mut Pending) -> Option<Question> {
        self.wait_for_project(pending, true);
        None
    }

    fn wait_for_project(&mut self, pending: &mut Pending, first: bool) {
        self.say_waiting(pending.app, pending.batch, WaitReason::OverQuota);
        let keys = std::mem::take(&mut pending.keys);
        self.projects.line_up(Pending { keys, ..*pending }, first);
    }

    fn bytes_fit(&self, pending: &Pending, most: u64) -> Fits {
        let batch = self.apps.get(&pending.app).and_then(|app| app.batches.get(&pending.batch));
        let (Some(batch), Some(project)) =
            (batch.filter(|batch| !batch.counted), self.projects.project_of(pending.app))
        else {
            return Fits::Now;
        };
        let most_bytes = u128::from(most);
        let alone: u128 = distinct(&batch.contents).map(|(_, size_bytes)| u128::from(size_bytes)).sum();
        if alone > most_bytes {
            return Fits::Never(format!(
                "its task allocations and modules have {alone} B, project {} may have {most} B",
                project.name
            ));
        }
        let together = project.content_bytes + project.additional_bytes(&batch.contents);
        if together > most_bytes { Fits::Later } else { Fits::Now }
    }

    /// The devices that the project is on, and others up to as many as it may have: of each those that would be done first with
    /// their share.
    fn permitted(&self, app: AppId, most: u32, question: &Question) -> Vec<QuestionDevice> {
        let Some(project) = self.projects.project_of(app) else { return question.devices.clone() };
        let load: f64 = question.jobs.iter().map(|job| job.load).sum::<f64>() / f64::from(most.max(1));
        let ends_at =
            |device: &QuestionDevice| device.free_at_ns.max(device.ready_at_ns) + load * device.time_per_load;
        let place = |device: &QuestionDevice| (device.node, device.device);
        let is_used = |device: &QuestionDevice| project.devices.contains_key(&place(device));
        let mut order: Vec<&QuestionDevice> = question.devices.iter().collect();
        order.sort_by(|one, other| {
            is_used(other).cmp(&is_used(one)).then(ends_at(one).total_cmp(&ends_at(other)))
        });
        let used = order.iter().filter(|device| is_used(device)).count();
        let unfit = project.devices.len() - used;
        order.truncate((most as usize).saturating_sub(unfit));
        let permitted: BTreeSet<Place> = order.into_iter().map(place).collect();
        question.devices.iter().filter(|device| permitted.contains(&place(device))).copied().collect()
    }

    fn planned_of_project(&self, app: AppId) -> u64 {
        self.projects.project_of(app).map_or(0, |project| self.planned(project))
    }

    fn planned(&self, project: &Project) -> u64 {
        self.apps_of(project).map(|app| app.jobs.len() as u64 - app.waiting_jobs).sum()
    }

    fn apps_of(&self, project: &Project) -> impl Iterator<Item = &super::model::App> {
        project.apps.keys().filter_map(|app| self.apps.get(app))
    }
}

/// Whether a project has room for a batch's contents.
enum Fits {
    Now,
    Later,
    /// Why, for people.
    Never(String),
}

impl CoordinatorMachine {
    /// The books of projects say what the jobs say.
    pub(super) fn check_projects(&self) {
        let mut devices: BTreeMap<Slot, BTreeMap<Place, u32>> = BTreeMap::new();
        let mut contents: BTreeMap<Slot, BTreeMap<ContentHash, u32>> = BTreeMap::new();
        let slot_of = |app: AppId| *self.projects.of.get(&app).expect("I8: each application has a project");
        for (&id, app) in &self.apps {
            let (devices, contents) =
                (devices.entry(slot_of(id)).or_default(), contents.entry(slot_of(id)).or_default());
            let backups = self.backups.range(JobId::range_of(id)).map(|(_, backup)| *backup);
            let placed = |state| if let JobState::Placed(place) = state { Some(place) } else { None };
            let placed = app.jobs.values().filter_map(|job| placed(job.state));
            for Placement { node, device, .. } in placed.chain(backups) {
                *devices.entry((node, device)).or_default() += 1;
            }
            for batch in app.batches.values().filter(|batch| batch.counted) {
                for (hash, _) in distinct(&batch.contents) {
                    *contents.entry(hash).or_default() += 1;
                }
            }
        }
        for (slot, project) in &self.projects.projects {
            let name = &project.name;
            assert_eq!(
                devices.remove(slot).unwrap_or_default(),
                project.devices,
                "I8: the devices of project {name}"
            );
            let counted: BTreeMap<ContentHash, u32> =
                project.contents.iter().map(|(&hash, (_, batches))| (hash, *batches)).collect();
            assert_eq!(
                contents.remove(slot).unwrap_or_default(),
                counted,
                "I8: the contents of project {name}"
            );
            let bytes: u128 = project.contents.values().map(|(bytes, _)| u128::from(*bytes)).sum();
            assert_eq!(bytes, project.content_bytes, "I8: the bytes of project {name}");
        }
        assert_eq!(self.projects.of.len(), self.apps.len(), "I8: each application has one project");
    }
}
