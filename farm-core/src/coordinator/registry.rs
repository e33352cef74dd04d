//! Who is there: hellos, goodbyes, closed connections, draining. Ids are issued here, once each.

use std::{collections::BTreeMap, time::Duration};

use super::{
    CoordinatorMachine, Effect, NodeState,
    model::{App, Node, Peer},
    policy::{BUILT_IN, Policy},
    replan::Blame,
};
use crate::{
    device::DeviceInfo,
    id::{AppId, AppIncarnation, DeviceIndex, LinkId, NodeId},
    message::{AppHello, CoordinatorToApp, CoordinatorToNode, NodeHello, check_protocol},
    time::Instant,
};

/// Most registered applications; a further one is refused.
const MAX_APPS: usize = 16_384;

/// Most node names ever seen in one life of the coordinator; a further one is refused.
const MAX_NODE_NAMES: usize = 65_536;

/// Most devices of one node.
const MAX_DEVICES: usize = 1_024;

/// Smallest score of a device, in GFLOP/s.
const MIN_SCORE: f64 = 1e-6;

/// Largest score of a device, in GFLOP/s.
const MAX_SCORE: f64 = 1e12;

/// Longest name, in bytes.
const MAX_NAME_BYTES: usize = 256;

/// Ids of one epoch start above those of all earlier ones, so that none is ever issued twice.
const EPOCH_SHIFT: u32 = 32;

impl CoordinatorMachine {
    pub(super) fn app_hello(&mut self, now: Instant, link: LinkId, hello: AppHello) {
        let project = self.projects.introduced(link);
        match self.admit_app(&hello, &project) {
            Err(reason) => {
                self.effects.push_back(Effect::ToApp { link, message: CoordinatorToApp::Refused { reason } });
                self.effects.push_back(Effect::Close { link });
            }
            Ok(Admission::Back(app)) => self.app_comes_back(now, link, app),
            Ok(Admission::New(app, incarnation)) => {
                self.app_joins(now, link, (app, incarnation), hello, &project);
            }
        }
    }

    pub(super) fn node_hello(&mut self, now: Instant, link: LinkId, hello: NodeHello) {
        if let Err(reason) = self.admit_node(&hello) {
            self.effects.push_back(Effect::ToNode { link, message: CoordinatorToNode::Refused { reason } });
            self.effects.push_back(Effect::Close { link });
            return;
        }
        let id = self.node_id(&hello.name, hello.node);
        self.timeline.node_known(id, &hello);
        let same_session = self.nodes.get(&id).map(|node| node.session == hello.session);
        match same_session {
            Some(true) => {
                if let Some(old) = self.nodes.get_mut(&id).and_then(|node| node.link.take()) {
                    self.close(old);
                }
            }
            Some(false) => self.fence(now, id, &hello),
            None => {
                self.nodes.insert(id, Node::new(&hello, now));
                self.recall_speeds(id);
            }
        }
        let Some(node) = self.nodes.get_mut(&id) else { return };
        node.link = Some(link);
        node.deaf = false;
        node.last_heard = now;
        node.full_until = None;
        node.contact = hello.contact.clone();
        let draining = node.state == NodeState::Draining;
        if !draining {
            node.state = NodeState::Alive;
        }
        self.links.insert(link, Peer::Node(id));
        self.arm(now.after(Duration::from_millis(self.config.liveness.suspect_ms)));
        self.tell_node(
            id,
            CoordinatorToNode::Welcome { node: id, epoch: self.config.epoch, liveness: self.config.liveness },
        );
        let apps: Vec<_> = self.apps.keys().map(|&app| (app, self.terms_of(app))).collect();
        if !apps.is_empty() {
            self.tell_node(id, CoordinatorToNode::AppsJoined(apps));
        }
        if draining {
            self.tell_node(id, CoordinatorToNode::Drain);
        }
        self.forget_cache_of(now, id);
        self.node_brings(now, id, &hello);
        self.reconcile(now, id, &hello.inventory);
        self.retry_stuck();
        tracing::info!(node = %id, name = hello.name, session = %hello.session, "node registered");
    }

    pub(super) fn link_closed(&mut self, now: Instant, link: LinkId) {
        match self.links.remove(&link) {
            None => {}
            Some(Peer::App(app)) => self.app_away(now, app),
            Some(Peer::Node(node)) => self.node_away(now, node),
        }
    }

    /// A peer that does not keep to the protocol loses its connection, as if it had closed it.
    pub(super) fn protocol_error(&mut self, now: Instant, link: LinkId) {
        tracing::warn!(%link, "message out of turn, closing");
        self.link_closed(now, link);
        self.effects.push_back(Effect::Close { link });
    }

    /// An application that asks for more than it may have is out, with everything it has.
    pub(super) fn expel_app(&mut self, app: AppId, reason: String) {
        tracing::warn!(%app, reason, "application expelled");
        self.tell_app(app, CoordinatorToApp::Refused { reason });
        if let Some(link) = self.apps.get(&app).and_then(|app| app.link) {
            self.close(link);
        }
        self.app_leaves(app);
    }

    /// The application is gone: everything of it is freed, here and on the nodes.
    pub(super) fn app_leaves(&mut self, id: AppId) {
        self.drop_backups_of(id);
        let Some(app) = self.apps.remove(&id) else { return };
        self.timeline.app_leaves(id, &app);
        for (key, job) in app.jobs {
            self.release(id, key, job.state);
        }
        app.batches.values().for_each(|batch| self.projects.batch_over(id, batch));
        self.app_leaves_project(id);
        self.forget_pending(|pending| pending.app == id);
        let nodes: Vec<NodeId> = self.nodes.keys().copied().collect();
        for node in nodes {
            self.tell_node(node, CoordinatorToNode::AppLeft { app: id });
        }
        tracing::info!(app = %id, "application left");
    }

    /// A drained node says goodbye: it should hold nothing; what it still holds here was never its fault.
    pub(super) fn node_leaves(&mut self, now: Instant, id: NodeId) {
        self.remove_node(now, id, Blame::Nobody);
        tracing::info!(node = %id, "node left");
    }

    pub(super) fn drain(&mut self, id: NodeId) {
        let Some(node) = self.nodes.get_mut(&id) else { return };
        node.state = NodeState::Draining;
        self.tell_node(id, CoordinatorToNode::Drain);
    }

    fn admit_app(&self, hello: &AppHello, project: &str) -> Result<Admission, String> {
        check_protocol(hello.protocol)?;
        check_name(&hello.name)?;
        let policy = Policy::named(&hello.policy);
        if let Policy::Plugin(name) = &policy
            && !self.config.plugins.contains(name)
        {
            let known: Vec<&str> =
                BUILT_IN.into_iter().chain(self.config.plugins.iter().map(String::as_str)).collect();
            return Err(format!(
                "placement policy `{name}` is not known here; there are {}",
                known.join(", ")
            ));
        }
        if !(hello.weight.is_finite() && hello.weight > 0.0) {
            return Err(format!("weight {} must be positive and finite", hello.weight));
        }
        if let Some((app, incarnation)) = hello.resume {
            if self.apps.contains_key(&app) && self.projects.name_of(app) != project {
                let own = self.projects.name_of(app);
                return Err(format!("{app} is of the project {own}, and you are of the project {project}"));
            }
            return match self.apps.get(&app) {
                Some(known) if known.incarnation == incarnation => Ok(Admission::Back(app)),
                // The welcome that told it of its new incarnation got lost.
                Some(known) if !known.heard && known.incarnation.0 == incarnation.0.saturating_add(1) => {
                    Ok(Admission::Back(app))
                }
                Some(known) => Err(format!("{app} {incarnation} is over, {} is there", known.incarnation)),
                // An earlier coordinator knew it: it goes on as who it is, and its jobs where they are.
                None if app.0 != 0 && app.0 <= self.issued_before() => Ok(Admission::New(app, incarnation)),
                // Its lease ran out: it keeps its name, its jobs are asked for anew.
                None if self.issued(app) => {
                    Ok(Admission::New(app, AppIncarnation(incarnation.0.saturating_add(1))))
                }
                None => Err(format!("{app} was never registered")),
            };
        }
        if self.apps.len() >= MAX_APPS {
            return Err(format!("{MAX_APPS} applications are registered already"));
        }
        Ok(Admission::New(AppId(self.epoch_base() + u64::from(self.next_app)), AppIncarnation(1)))
    }

    fn admit_node(&self, hello: &NodeHello) -> Result<(), String> {
        check_protocol(hello.protocol)?;
        check_name(&hello.name)?;
        if hello.devices.is_empty() || hello.devices.len() > MAX_DEVICES {
            return Err(format!("{} devices: 1..={MAX_DEVICES} are allowed", hello.devices.len()));
        }
        for (index, device) in hello.devices.iter().enumerate() {
            check_device(index, device)?;
        }
        let known = self.names.get(&hello.name).and_then(|id| self.nodes.get(id));
        if known
            .is_some_and(|node| node.session == hello.session && node.devices.len() != hello.devices.len())
        {
            return Err(format!("{} came back with other devices", hello.session));
        }
        if !self.names.contains_key(&hello.name) && self.names.len() >= MAX_NODE_NAMES {
            return Err(format!("{MAX_NODE_NAMES} node names are known already"));
        }
        Ok(())
    }

    fn app_joins(
        &mut self,
        now: Instant,
        link: LinkId,
        (id, incarnation): (AppId, AppIncarnation),
        hello: AppHello,
        project: &str,
    ) {
        if hello.resume.is_none() {
            self.next_app += 1;
        }
        let app = App {
            name: hello.name,
            global_stealing: hello.global_stealing,
            policy: Policy::named(&hello.policy),
            incarnation,
            link: Some(link),
            heard: false,
            deaf: false,
            last_heard: now,
            lease_until: now,
            superseded_until: None,
            batches: BTreeMap::new(),
            jobs: BTreeMap::new(),
            failed: BTreeMap::new(),
            unreachable: BTreeMap::new(),
            breaker: self.breaker_of(now, id),
            waiting_jobs: 0,
            delivered_jobs: 0,
            device_time_ns: 0,
        };
        tracing::info!(app = %id, name = app.name, "application registered");
        self.timeline.app_known(id, &app.name);
        self.apps.insert(id, app);
        self.links.insert(link, Peer::App(id));
        self.welcome_app(now, id);
        self.app_enters_project(id, project, hello.weight);
    }

    /// The connection was broken and stands again: repeats everything that may have been lost with the old one.
    fn app_comes_back(&mut self, now: Instant, link: LinkId, id: AppId) {
        let Some(app) = self.apps.get_mut(&id) else { return };
        app.deaf = false;
        app.last_heard = now;
        // Whoever comes back is alive.
        app.superseded_until = None;
        if let Some(old) = app.link.replace(link) {
            self.close(old);
        }
        self.links.insert(link, Peer::App(id));
        self.welcome_app(now, id);
        self.repeat_failures(id);
        self.repeat_placements(id);
        self.repeat_backups(id);
        self.retry_stuck();
    }

    fn welcome_app(&mut self, now: Instant, id: AppId) {
        let Some(app) = self.apps.get(&id) else { return };
        let welcome = CoordinatorToApp::Welcome {
            app: id,
            incarnation: app.incarnation,
            epoch: self.config.epoch,
            liveness: self.config.liveness,
        };
        self.tell_app(id, welcome);
        self.arm(now.after(Duration::from_millis(self.config.liveness.dead_ms)));
    }

    /// A second life of a node's name: the first is over at once. Jobs that the new one brought along stay with it.
    fn fence(&mut self, now: Instant, id: NodeId, hello: &NodeHello) {
        if let Some(link) = self.nodes.get(&id).and_then(|node| node.link) {
            let reason = format!(
                "another worker of the name {} took this one's place ({}); two on one machine need names of their own",
                hello.name, hello.session
            );
            self.effects.push_back(Effect::ToNode { link, message: CoordinatorToNode::Refused { reason } });
            self.close(link);
        }
        self.end_steals_from(id);
        let kept = self.inherited(id, hello);
        self.remove_node(now, id, Blame::OldestOnEachDevice);
        self.nodes.insert(id, Node::new(hello, now));
        self.recall_speeds(id);
        self.inherit(now, id, &kept);
    }

    /// A node's id goes with its name; one that an earlier coordinator gave is kept, so that applications know it still.
    fn node_id(&mut self, name: &str, earlier: Option<NodeId>) -> NodeId {
        if let Some(&id) = self.names.get(name) {
            return id;
        }
        let (issued_before, names) = (self.issued_before(), &self.names);
        let is_free = |id: &NodeId| id.0 <= issued_before && names.values().all(|taken| taken != id);
        let id = earlier.filter(is_free).unwrap_or_else(|| {
            let id = NodeId(issued_before + u64::from(self.next_node));
            self.next_node += 1;
            id
        });
        self.names.insert(name.to_owned(), id);
        id
    }

    /// The largest id that earlier epochs can have issued.
    pub(super) fn issued_before(&self) -> u64 {
        self.epoch_base()
    }

    fn epoch_base(&self) -> u64 {
        u64::from(self.config.epoch.0.saturating_sub(1)) << EPOCH_SHIFT
    }

    /// Whether an application id was issued by this or an earlier coordinator.
    fn issued(&self, app: AppId) -> bool {
        app.0 != 0 && app.0 < self.epoch_base() + u64::from(self.next_app)
    }
}

/// How an application's hello is taken.
enum Admission {
    /// Registered and known.
    Back(AppId),
    /// Nothing is known of it here.
    New(AppId, AppIncarnation),
}

fn check_name(name: &str) -> Result<(), String> {
    if name.len() <= MAX_NAME_BYTES {
        return Ok(());
    }
    Err(format!("a name of {} bytes is longer than {MAX_NAME_BYTES}", name.len()))
}

fn check_device(index: usize, device: &DeviceInfo) -> Result<(), String> {
    let index = u16::try_from(index).map(DeviceIndex).map_err(|error| error.to_string())?;
    // A range, not just "positive": rates derived from it stay far from the ends of f64.
    if (MIN_SCORE..=MAX_SCORE).contains(&device.score) {
        return Ok(());
    }
    Err(format!(
        "{index} ({}): score {} is not in {MIN_SCORE}..={MAX_SCORE} GFLOP/s",
        device.name, device.score
    ))
}
