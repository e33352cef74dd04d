//! Applications as a node knows them: who they are, their one current link, when they are gone.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use super::{Effect, WorkerMachine};
use crate::{
    id::{AppId, AppIncarnation, JobAttempt, LinkId},
    message::{AppToNode, JobTicket, NodeToApp, check_protocol},
    project::AppTerms,
    time::Instant,
};

/// Weight of an application that the coordinator has not announced yet.
const UNANNOUNCED_WEIGHT: f64 = 1.0;

/// How long an application's jobs are kept while a registered node waits for its announcement, in milliseconds. The
/// same as the coordinator's lease on a vanished application.
const UNANNOUNCED_MS: u64 = 30_000;

/// Most applications on one node; a further one is refused.
const MAX_APPS: usize = 16_384;

/// An application with a link, jobs, or an announcement.
#[derive(Debug, Default)]
pub(super) struct App {
    /// The coordinator vouches for it.
    pub(super) announced: bool,
    /// When it is dropped, unless it is announced before.
    pub(super) drop_at: Option<Instant>,
    incarnation: Option<AppIncarnation>,
    /// Where its results go.
    pub(super) link: Option<LinkId>,
    /// Its jobs in [`WorkerMachine::jobs`].
    pub(super) held_jobs: usize,
    /// Its jobs that could be staged, are staged or run: what makes it backlogged.
    pub(super) active_jobs: usize,
    /// Bytes of its results that wait for acknowledgement.
    pub(super) spool_bytes: u64,
    /// It has a share of the devices now.
    pub(super) awake: bool,
    /// Its project, once the coordinator said which.
    project: Option<String>,
    /// Its jobs are not taken by other devices than those that they were planned for.
    pub(super) stays: bool,
}

impl App {
    /// Whether it gets a further job: it leaves no more results behind than it may, and neither does its project.
    pub(super) fn takes_results(&self, quota_bytes: u64, projects: &BTreeMap<String, Project>) -> bool {
        // With a quota of nothing, too, one result may wait: nothing would ever run else.
        let fits =
            |project: &Project| project.quota_bytes.is_none_or(|most| project.spool_bytes < most.max(1));
        let project = self.project.as_ref().and_then(|name| projects.get(name));
        self.spool_bytes < quota_bytes && project.is_none_or(fits)
    }
}

/// Results of the applications of one project.
#[derive(Debug, Default)]
pub(super) struct Project {
    apps: BTreeSet<AppId>,
    spool_bytes: u64,
    /// What they may come to before the applications get no further job.
    quota_bytes: Option<u64>,
}

impl WorkerMachine {
    pub(super) fn app_said(&mut self, now: Instant, link: LinkId, message: AppToNode) {
        let app = match message {
            AppToNode::Hello { protocol, app, incarnation } => {
                return self.app_hello(now, link, protocol, app, incarnation);
            }
            AppToNode::Jobs(_) | AppToNode::Acks(_) | AppToNode::Cancel(_) | AppToNode::Holding(_) => {
                match self.links.get(&link) {
                    Some(&app) => app,
                    None => {
                        if let AppToNode::Jobs(tickets) = &message {
                            self.discard_unheld(tickets);
                        }
                        return self.refuse_app(link, "say hello first".to_owned());
                    }
                }
            }
        };
        let own = |job: &JobAttempt| job.job.app == app;
        match message {
            AppToNode::Hello { .. } => {}
            AppToNode::Jobs(tickets) => {
                if tickets.iter().all(|ticket| own(&ticket.job)) {
                    tickets.into_iter().for_each(|ticket| self.take_in(now, link, ticket));
                } else {
                    self.discard_unheld(&tickets);
                    self.app_link_closed(now, link);
                    self.refuse_app(link, format!("jobs of another application than {app}"));
                }
            }
            AppToNode::Acks(acks) => {
                for ack in acks.into_iter().filter(|ack| own(&ack.job)) {
                    self.acknowledged(now, ack);
                }
            }
            AppToNode::Cancel(jobs) => {
                jobs.into_iter().filter(own).for_each(|job| self.cancelled_by_app(now, job));
            }
            AppToNode::Holding(theirs) => self.compare(link, app, theirs),
        }
    }

    /// The driver has the programs of jobs that are not taken in: it may forget them.
    fn discard_unheld(&mut self, tickets: &[JobTicket]) {
        let unheld = |job: &JobAttempt| !self.holds(*job);
        let unheld: Vec<JobAttempt> = tickets.iter().map(|ticket| ticket.job).filter(unheld).collect();
        unheld.into_iter().for_each(|job| self.push(Effect::Discard(job)));
    }

    pub(super) fn app_link_closed(&mut self, now: Instant, link: LinkId) {
        let Some(id) = self.links.remove(&link) else { return };
        if let Some(app) = self.apps.get_mut(&id)
            && app.link == Some(link)
        {
            app.link = None;
        }
        self.forget_if_idle(id);
        self.link_fetches_nothing(now, link);
    }

    pub(super) fn app_joined(&mut self, id: AppId, terms: AppTerms) {
        let AppTerms { weight, project, result_bytes, stays } = terms;
        if self.apps.get(&id).is_some_and(|app| app.project.as_ref() != Some(&project)) {
            self.leave_project(id);
        }
        let app = self.apps.entry(id).or_default();
        app.announced = true;
        app.drop_at = None;
        app.stays = stays;
        let entered = self.projects.entry(project.clone()).or_default();
        let mut concerns_all = std::mem::replace(&mut entered.quota_bytes, result_bytes) != result_bytes;
        if app.project.replace(project).is_none() {
            entered.apps.insert(id);
            entered.spool_bytes += app.spool_bytes;
            concerns_all |= app.spool_bytes > 0;
        }
        let concerned = if concerns_all { entered.apps.clone() } else { BTreeSet::from([id]) };
        self.lags.join(id, weight);
        concerned.into_iter().for_each(|app| self.settle_share(app));
    }

    pub(super) fn takes_results(&self, id: AppId) -> bool {
        let app = self.apps.get(&id);
        app.is_some_and(|app| app.takes_results(self.spool_quota_bytes(), &self.projects))
    }

    /// What an application leaves behind it takes along, and those who stay may get on by that.
    fn leave_project(&mut self, id: AppId) {
        let Some(app) = self.apps.get_mut(&id) else { return };
        let Some(name) = app.project.take() else { return };
        let Some(project) = self.projects.get_mut(&name) else { return };
        project.apps.remove(&id);
        project.spool_bytes -= app.spool_bytes;
        let staying = project.quota_bytes.map_or_else(BTreeSet::new, |_| project.apps.clone());
        if project.apps.is_empty() {
            self.projects.remove(&name);
        }
        staying.into_iter().for_each(|app| self.settle_share(app));
    }

    /// I8: a project's results are those of its applications.
    pub(super) fn check_projects(&self) {
        for (name, project) in &self.projects {
            assert!(!project.apps.is_empty(), "I8: project {name} has no application");
            let of_app = |app: &AppId| self.apps.get(app).map(|app| app.spool_bytes);
            let spooled: Option<u64> = project.apps.iter().map(of_app).sum();
            assert_eq!(spooled, Some(project.spool_bytes), "I8: the results of project {name}");
        }
    }

    /// An application's project may have reached its quota, or left it behind.
    fn settle_shares_with(&mut self, id: AppId) {
        let project = self.apps.get(&id).and_then(|app| self.projects.get(app.project.as_ref()?));
        match project.filter(|project| project.quota_bytes.is_some()) {
            Some(project) => project.apps.clone().into_iter().for_each(|app| self.settle_share(app)),
            None => self.settle_share(id),
        }
    }

    /// Everything of the application is dropped, whatever state it is in.
    pub(super) fn app_left(&mut self, id: AppId) {
        self.drop_jobs_of(id);
        self.tombstones.forget_app(id);
        let links: Vec<LinkId> =
            self.links.iter().filter(|(_, app)| **app == id).map(|(&link, _)| link).collect();
        for link in links {
            self.links.remove(&link);
            self.push(Effect::CloseApp { link });
        }
        self.leave_project(id);
        if self.apps.remove(&id).is_some() {
            self.lags.leave(id);
        }
    }

    /// Registered (again): every living application is announced now, or was gone before.
    pub(super) fn await_announcements(&mut self, now: Instant) {
        let drop_at = now.after(Duration::from_millis(UNANNOUNCED_MS));
        for app in self.apps.values_mut() {
            app.announced = false;
            app.drop_at = Some(drop_at);
        }
    }

    pub(super) fn app_timeout(&mut self, now: Instant) {
        let gone: Vec<AppId> = self
            .apps
            .iter()
            .filter(|(_, app)| app.drop_at.is_some_and(|drop_at| drop_at <= now))
            .map(|(&id, _)| id)
            .collect();
        gone.into_iter().for_each(|id| self.app_left(id));
    }

    fn app_hello(
        &mut self,
        now: Instant,
        link: LinkId,
        protocol: u32,
        id: AppId,
        incarnation: AppIncarnation,
    ) {
        if let Err(reason) = self.admit_app(link, protocol, id, incarnation) {
            self.app_link_closed(now, link);
            self.refuse_app(link, reason);
            return;
        }
        let Some(node) = self.node else { return };
        let registered = self.session.is_registered();
        let known = self.apps.contains_key(&id);
        let app = self.apps.entry(id).or_default();
        app.incarnation = Some(incarnation);
        if !known {
            app.drop_at = registered.then(|| now.after(Duration::from_millis(UNANNOUNCED_MS)));
            self.lags.join(id, UNANNOUNCED_WEIGHT);
        }
        // The newest link is the one that stands: an older one is half-open, or about to be.
        if let Some(old) = app.link.replace(link)
            && old != link
        {
            self.links.remove(&old);
            self.push(Effect::CloseApp { link: old });
            self.link_fetches_nothing(now, old);
        }
        self.links.insert(link, id);
        let welcome = NodeToApp::Welcome { node, session: self.config.session };
        self.push(Effect::ToApp { link, message: welcome });
        self.resend_results(id, link);
        self.fetch_wanted();
    }

    fn admit_app(
        &self,
        link: LinkId,
        protocol: u32,
        id: AppId,
        incarnation: AppIncarnation,
    ) -> Result<(), String> {
        check_protocol(protocol)?;
        if self.node.is_none() {
            return Err("this node is not registered yet".to_owned());
        }
        if self.links.get(&link).is_some_and(|app| *app != id) {
            return Err("a link belongs to one application".to_owned());
        }
        match self.apps.get(&id) {
            Some(app) if app.incarnation.is_some_and(|known| known > incarnation) => {
                Err(format!("{id} has a later life than {incarnation}"))
            }
            Some(_) => Ok(()),
            None if self.apps.len() >= MAX_APPS => Err(format!("{MAX_APPS} applications are here already")),
            None => Ok(()),
        }
    }

    /// An application has a share while it has something to run and takes its results.
    pub(super) fn settle_share(&mut self, id: AppId) {
        let takes_results = self.takes_results(id);
        let Some(app) = self.apps.get_mut(&id) else { return };
        let awake = app.active_jobs > 0 && takes_results;
        match (std::mem::replace(&mut app.awake, awake), awake) {
            (false, true) => self.lags.wake(id),
            (true, false) => self.lags.rest(id),
            (false, false) | (true, true) => {}
        }
    }

    /// Its spool grew or shrank.
    pub(super) fn spool_changed(&mut self, id: AppId, change: impl Fn(u64) -> u64) {
        self.spool_bytes = change(self.spool_bytes);
        if let Some(app) = self.apps.get_mut(&id) {
            app.spool_bytes = change(app.spool_bytes);
            if let Some(project) = app.project.as_ref().and_then(|name| self.projects.get_mut(name)) {
                project.spool_bytes = change(project.spool_bytes);
            }
            self.settle_shares_with(id);
        }
    }

    fn refuse_app(&mut self, link: LinkId, reason: String) {
        self.push(Effect::ToApp { link, message: NodeToApp::Refused { reason } });
        self.push(Effect::CloseApp { link });
    }

    /// Without announcement, link and jobs nothing is left of an application.
    pub(super) fn forget_if_idle(&mut self, id: AppId) {
        let idle =
            self.apps.get(&id).is_some_and(|app| !app.announced && app.link.is_none() && app.held_jobs == 0);
        if idle {
            self.leave_project(id);
            self.apps.remove(&id);
            self.lags.leave(id);
        }
    }
}
