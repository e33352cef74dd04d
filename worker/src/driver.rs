//! The task that owns the worker's machine: it turns what the coordinator, applications and devices say into events, and
//! carries the machine's effects out. It never waits for a peer.

use std::{
    collections::HashMap,
    io,
    sync::Arc,
    time::{Duration, SystemTime},
};

use farm_core::{
    id::{DeviceIndex, JobAttempt, LinkId, NodeId},
    message::{
        AppToNode, CoordinatorToNode, JobFailure, JobTicket, LatencyClass, NodeToApp, NodeToCoordinator,
    },
    program::Content,
    time,
    worker::{Effect, Event, Provider, WorkerConfig, WorkerMachine},
};
use proto::{
    codec,
    control::{SessionError, SessionSender},
    link::{DataServer, Frame, LinkSender},
    trust::{Capability, Principal, Scope},
};
use tokio::{
    sync::{mpsc, oneshot},
    task::JoinSet,
    time::Instant,
};

use crate::{
    End, WorkerOptions,
    contents::{Contents, Fetched},
    device::{Device, DeviceEvent, DeviceNews},
    executor::{Executor, Order},
    link::{self, Outbox, Source},
    programs::{Program, Programs},
    session::{self, NodeLink},
    spool::Spool,
};

/// Inputs that wait for the owner task, at most; further senders wait.
pub(crate) const QUEUED_INPUTS: usize = 1_024;
/// Inputs taken in before effects are carried out.
const INPUTS_PER_TURN: usize = 128;
/// How long a leaving node waits for the coordinator to hear its goodbye.
const GOODBYE_WAIT: Duration = Duration::from_secs(1);
/// Device events taken in while effects are carried out.
const ANSWERS_PER_TURN: usize = 256;

/// What the owner task hears.
#[derive(Debug)]
pub(crate) enum Input {
    /// The coordinator is connected again.
    Connected(NodeLink),
    /// The coordinator said something in session `serial`.
    CoordinatorSaid { serial: u64, message: CoordinatorToNode },
    /// Session `serial` is over.
    CoordinatorEnded { serial: u64, error: SessionError },
    /// An application dialled.
    LinkOpened { link: LinkId, sender: LinkSender<NodeToApp>, peer: Option<Principal> },
    /// An application said this, in order.
    AppSaid { link: LinkId, frames: Vec<Frame<AppToNode>> },
    /// An application's link is over.
    LinkEnded { link: LinkId },
    /// A fetch is through.
    Fetched { content: Content, fetched: Fetched },
    /// A content has been written to disk, or not.
    Stored { content: Content, result: io::Result<()> },
    /// The disk took results, or did not.
    SpoolChanged,
    /// A result cannot be read back from disk.
    ResultLost { job: JobAttempt },
    /// The process was asked to end in order.
    Drain,
}

/// What a driver is made of.
pub(crate) struct Setup {
    pub(crate) options: WorkerOptions,
    pub(crate) config: WorkerConfig,
    pub(crate) devices: Vec<Executor>,
    pub(crate) contents: Contents,
    pub(crate) spool: Spool,
    /// Unbounded for its senders, who must not wait; a device has at most six jobs, two events of each, and two an interruption.
    pub(crate) events: mpsc::UnboundedReceiver<DeviceEvent>,
    pub(crate) server: Arc<DataServer>,
    pub(crate) session: NodeLink,
    pub(crate) inputs: mpsc::Sender<Input>,
    pub(crate) received: mpsc::Receiver<Input>,
    pub(crate) registered: oneshot::Sender<NodeId>,
}

/// The owner of the machine.
struct Driver {
    machine: WorkerMachine,
    /// Origin of the machine's time.
    origin: Instant,
    options: WorkerOptions,
    inputs: mpsc::Sender<Input>,
    coordinator: Option<SessionSender<NodeToCoordinator>>,
    /// Counts sessions: news of an older one are of no interest.
    serial: u64,
    links: HashMap<LinkId, Outbox>,
    devices: Vec<Device>,
    contents: Contents,
    programs: Programs,
    spool: Spool,
    /// Failures that the driver itself found, to be told to the machine in the next turn.
    found: Vec<Event>,
    registered: Option<oneshot::Sender<NodeId>>,
    end: Option<End>,
    /// Accepting and reconnecting; aborted with the driver.
    tasks: JoinSet<()>,
}

/// Runs until drained, refused or dropped.
pub(crate) async fn drive(setup: Setup) -> End {
    let Setup {
        options,
        config,
        devices,
        contents,
        spool,
        mut events,
        server,
        session,
        inputs,
        mut received,
        registered,
    } = setup;
    let mut driver = Driver {
        machine: WorkerMachine::new(config),
        origin: Instant::now(),
        contents,
        options,
        inputs: inputs.clone(),
        coordinator: None,
        serial: 0,
        links: HashMap::new(),
        devices: devices.into_iter().map(Device::new).collect(),
        programs: Programs::default(),
        spool,
        found: Vec::new(),
        registered: Some(registered),
        end: None,
        tasks: JoinSet::new(),
    };
    driver.tasks.spawn(link::accept(Arc::clone(&server), driver.contents.source(), inputs));
    if let Some(identity) = &driver.options.identity {
        driver.tasks.spawn(session::stay_valid(driver.options.coordinator.clone(), identity.clone()));
    }
    driver.connected(session);
    let mut taken = Vec::with_capacity(INPUTS_PER_TURN);
    let mut heard = Vec::with_capacity(INPUTS_PER_TURN);
    let end = loop {
        driver.carry_out(&mut events);
        if let Some(end) = driver.end.take() {
            break end;
        }
        let wake = driver.next_wake();
        tokio::select! {
            _ = received.recv_many(&mut taken, INPUTS_PER_TURN) => {}
            _ = events.recv_many(&mut heard, INPUTS_PER_TURN) => {}
            () = tokio::time::sleep_until(wake.unwrap_or_else(Instant::now)), if wake.is_some() => {}
        }
        for input in taken.drain(..) {
            driver.take(input);
        }
        for event in heard.drain(..) {
            driver.heard(event);
        }
        if let Some(figures) = driver.contents.news() {
            driver.tell(Event::CacheCounted(figures));
        }
        if let Some(full) = driver.spool.news() {
            driver.tell(Event::SpoolFull(full));
        }
        driver.act_on_timers();
    };
    let connected = driver.coordinator.take().is_some();
    if connected && matches!(end, End::Drained) {
        goodbye_heard(driver.serial, &mut received).await;
    }
    for (_, outbox) in driver.links.drain() {
        outbox.close("the node leaves");
    }
    server.shutdown("the node leaves").await;
    end
}

/// Waits until the coordinator has heard the goodbye: it closes the session then. A process that ended before would
/// take the goodbye along.
async fn goodbye_heard(serial: u64, received: &mut mpsc::Receiver<Input>) {
    let ended = async {
        while let Some(input) = received.recv().await {
            if matches!(input, Input::CoordinatorEnded { serial: ended, .. } if ended == serial) {
                break;
            }
        }
    };
    if tokio::time::timeout(GOODBYE_WAIT, ended).await.is_err() {
        tracing::warn!("the coordinator did not answer the goodbye");
    }
}

impl Driver {
    fn now(&self) -> time::Instant {
        time::Instant::ZERO.after(self.origin.elapsed())
    }

    fn tell(&mut self, event: Event) {
        self.machine.handle(self.now(), event);
    }

    fn next_wake(&self) -> Option<Instant> {
        self.machine.poll_timeout().map(|at| self.origin + at.since(time::Instant::ZERO))
    }

    fn act_on_timers(&mut self) {
        let now = self.now();
        if self.machine.poll_timeout().is_some_and(|at| at <= now) {
            self.machine.handle_timeout(now);
        }
    }

    fn take(&mut self, input: Input) {
        match input {
            Input::Connected(session) => self.connected(session),
            Input::CoordinatorSaid { serial, message } if serial == self.serial => {
                self.coordinator_said(message)
            }
            Input::CoordinatorEnded { serial, error } if serial == self.serial => {
                self.coordinator_lost(&error)
            }
            Input::CoordinatorSaid { .. } | Input::CoordinatorEnded { .. } => {}
            Input::LinkOpened { link, sender, peer } => {
                self.links.insert(link, Outbox::new(sender, peer, self.spool.clone(), self.inputs.clone()));
            }
            Input::AppSaid { link, frames } => {
                for frame in frames {
                    self.app_said(link, frame);
                }
            }
            Input::LinkEnded { link } => {
                self.links.remove(&link);
                self.tell(Event::AppLinkClosed { link });
            }
            Input::Fetched { content, fetched } => {
                let events = self.contents.fetched(content, fetched, &self.inputs);
                events.into_iter().for_each(|event| self.tell(event));
            }
            Input::Stored { content, result } => self.contents.stored(content, result),
            // What it means is asked for after each turn.
            Input::SpoolChanged => {}
            Input::ResultLost { job } => self.tell(Event::ResultLost(job)),
            Input::Drain => self.tell(Event::DrainRequested),
        }
    }

    fn connected(&mut self, session: NodeLink) {
        self.serial += 1;
        self.coordinator = Some(session.sender);
        self.tasks.spawn(session::listen(self.serial, session.receiver, self.inputs.clone()));
        self.tell(Event::CoordinatorConnected);
    }

    fn coordinator_said(&mut self, message: CoordinatorToNode) {
        match &message {
            CoordinatorToNode::Refused { reason } => {
                tracing::error!(reason, "refused by the coordinator");
                self.end = Some(End::Refused { reason: reason.clone() });
            }
            CoordinatorToNode::Welcome { node, epoch, .. } => {
                tracing::info!(%node, %epoch, "registered");
                if let Some(registered) = self.registered.take() {
                    // Whoever started us may have given up; we are dropped then.
                    let _ = registered.send(*node);
                }
            }
            CoordinatorToNode::AppsJoined(_)
            | CoordinatorToNode::AppLeft { .. }
            | CoordinatorToNode::Cancel { .. }
            | CoordinatorToNode::Retract { .. }
            | CoordinatorToNode::Located { .. }
            | CoordinatorToNode::Evict { .. }
            | CoordinatorToNode::Drain
            | CoordinatorToNode::SayInventory
            | CoordinatorToNode::HeartbeatAck { .. } => {}
        }
        self.tell(Event::FromCoordinator(message));
    }

    fn coordinator_lost(&mut self, error: &SessionError) {
        if let (SessionError::Denied { reason }, true) = (error, self.registered.is_some()) {
            self.end = Some(End::Denied { reason: reason.clone() });
            return;
        }
        tracing::warn!(%error, "the coordinator is lost; work goes on, trying again");
        self.coordinator = None;
        self.serial += 1;
        self.tell(Event::CoordinatorLost);
        self.tasks.spawn(session::again(
            self.options.coordinator.clone(),
            self.options.identity.clone(),
            self.inputs.clone(),
        ));
        // Ended tasks of earlier sessions.
        while self.tasks.try_join_next().is_some() {}
    }

    /// Whether an application may say this hello here: in a secured farm the coordinator has to have said so.
    ///
    /// # Errors
    /// It may not.
    fn check_hello(&mut self, link: LinkId, frame: &Frame<AppToNode>) -> Result<(), String> {
        let AppToNode::Hello { app, incarnation, .. } = &frame.header else { return Ok(()) };
        let nobody = "nobody has shown who this is";
        let outbox = self.links.get_mut(&link).ok_or(nobody)?;
        let scope = match &self.options.identity {
            None => Scope::OPEN,
            Some(own) => {
                let peer = outbox.peer().ok_or(nobody)?;
                let shown = Capability::check(&frame.payload, own, peer, SystemTime::now())
                    .map_err(|error| error.to_string())?;
                if (shown.app, shown.incarnation) != (*app, *incarnation) {
                    return Err(format!("the capability is for {}, {}", shown.app, shown.incarnation));
                }
                Scope::of(&shown.project)
            }
        };
        outbox.introduce(*app, scope);
        Ok(())
    }

    /// Names the contents of an application's jobs as those of its project.
    fn name_contents(&mut self, scope: Scope, tickets: &mut [JobTicket]) {
        if scope == Scope::OPEN {
            return;
        }
        for content in tickets.iter_mut().flat_map(|ticket| &mut ticket.contents) {
            let digest = content.hash;
            content.hash = scope.name(digest);
            let machine = &self.machine;
            self.contents.is_called(digest, content.hash, |name| machine.needs(name));
        }
    }

    fn app_said(&mut self, link: LinkId, frame: Frame<AppToNode>) {
        // What came after what it was refused for is nobody's word.
        if !self.links.contains_key(&link) {
            return;
        }
        match self.check_hello(link, &frame).and_then(|()| self.unpack(link, frame)) {
            Ok(message) => self.tell(Event::FromApp { link, message }),
            Err(reason) => {
                tracing::warn!(%link, reason, "an application was refused, or broke the protocol");
                if let Some(outbox) = self.links.remove(&link) {
                    outbox.send(NodeToApp::Refused { reason });
                    outbox.close("refused");
                }
                self.tell(Event::AppLinkClosed { link });
            }
        }
    }

    /// The message of a frame; the programs of jobs are kept.
    ///
    /// # Errors
    /// They are not those of the application that the link is of.
    fn unpack(&mut self, link: LinkId, frame: Frame<AppToNode>) -> Result<AppToNode, String> {
        let AppToNode::Jobs(mut tickets) = frame.header else { return Ok(frame.header) };
        let app = self.links.get(&link).and_then(Outbox::app);
        let (app, scope) = app.ok_or("jobs came before a hello")?;
        if tickets.iter().any(|ticket| ticket.job.job.app != app) {
            return Err(format!("a job is not of {app}"));
        }
        let programs =
            codec::unpack_programs(frame.payload, tickets.len()).map_err(|error| error.to_string())?;
        self.name_contents(scope, &mut tickets);
        for (ticket, bytes) in tickets.iter().zip(programs) {
            self.programs.keep(ticket.job, Program { bytes, scope });
        }
        Ok(AppToNode::Jobs(tickets))
    }

    fn heard(&mut self, DeviceEvent { device, what }: DeviceEvent) {
        match what {
            DeviceNews::Started(job) => self.tell(Event::Started { job, device }),
            DeviceNews::Yielded(job) => self.tell(Event::Yielded { job, device }),
            DeviceNews::Resumed(job) => self.tell(Event::Resumed { job, device }),
            DeviceNews::Finished { job, device_time_ns, outcome } => {
                if let Some(device) = self.devices.get_mut(usize::from(device.0)) {
                    device.finished();
                }
                let (outcome, payload) = match outcome {
                    Ok(payload) => {
                        let lengths = payload.sections.iter().map(|section| section.len() as u64).collect();
                        (Ok((lengths, payload.digest)), Some(payload))
                    }
                    Err(failure) => (Err(failure), None),
                };
                self.tell(Event::Executed { job, device, device_time_ns, outcome });
                // Not if it was taken back meanwhile, and runs on another device or not at all: the bytes belong to the header.
                if let Some(payload) = payload.filter(|_| self.machine.executed_on(job) == Some(device)) {
                    self.programs.discard(job);
                    self.spool.keep(job, payload);
                }
            }
            DeviceNews::Lost(reason) => {
                tracing::error!(%device, reason, "a device is lost");
                self.tell(Event::DeviceLost { device, reason });
            }
        }
    }

    /// Carries effects out until there is none, with some of what simulated devices answer at once: a jobless device
    /// need not wait for a turn of the task, and a flood of no-op jobs must not keep inputs waiting.
    fn carry_out(&mut self, events: &mut mpsc::UnboundedReceiver<DeviceEvent>) {
        let mut answers = 0;
        loop {
            while let Some(effect) = self.machine.poll_effect() {
                self.act(effect);
            }
            if !self.found.is_empty() {
                for event in std::mem::take(&mut self.found) {
                    self.tell(event);
                }
                continue;
            }
            if answers == ANSWERS_PER_TURN {
                return;
            }
            let Ok(event) = events.try_recv() else { return };
            answers += 1;
            self.heard(event);
        }
    }

    fn act(&mut self, effect: Effect) {
        match effect {
            Effect::ToCoordinator(message) => self.send_to_coordinator(message),
            Effect::ToApp { link, message } => {
                if let Some(outbox) = self.links.get(&link) {
                    outbox.send(message);
                }
            }
            Effect::CloseApp { link } => {
                if let Some(outbox) = self.links.remove(&link) {
                    outbox.close("closed by the node");
                }
            }
            Effect::Fetch { content, from } => self.fetch(content, from),
            Effect::Execute { job, device, class } => self.execute(job, device, class),
            Effect::Abort { job, device } => {
                if let Some(device) = self.devices.get_mut(usize::from(device.0)) {
                    device.abort(job);
                }
            }
            Effect::Discard(job) => {
                self.programs.discard(job);
                self.spool.discard(job);
            }
            Effect::Release(hash) => self.contents.release(hash),
            Effect::Evict(contents) => self.found.extend(self.contents.evict(&contents)),
            // After a refusal the machine exits too; the refusal is the reason.
            Effect::Exit => {
                self.end.get_or_insert(End::Drained);
            }
        }
    }

    fn send_to_coordinator(&mut self, mut message: NodeToCoordinator) {
        let Some(coordinator) = &self.coordinator else { return };
        if let NodeToCoordinator::Report { executed, .. } = &mut message {
            for executed in executed {
                // Its application knows it by the digest.
                if let Some(JobFailure::ContentUnavailable(content)) = &mut executed.failure {
                    *content = self.contents.digest_of(*content);
                }
            }
        }
        if let Err(error) = coordinator.try_send(message) {
            // A coordinator that does not read for QUEUED_MESSAGES messages is as good as lost; the next hello's
            // inventory says what it missed.
            self.coordinator_lost(&error);
        }
    }

    fn fetch(&mut self, content: Content, from: Provider) {
        if self.contents.pin(content) {
            self.found.push(Event::ContentReady(content.hash));
            return;
        }
        let from = match from {
            Provider::Application(link) => {
                Source::Application(self.links.get(&link).map(|outbox| outbox.sender().clone()))
            }
            Provider::Node(contact) => Source::Node(contact, self.options.identity.clone()),
        };
        self.contents.fetch(content, from, self.inputs.clone());
    }

    fn execute(&mut self, job: JobAttempt, index: DeviceIndex, class: LatencyClass) {
        let order = self.programs.get(job).map(|program| {
            let limit = self.options.job_limit;
            Order { job, class, program, limit }
        });
        let reason = match (order, self.devices.get_mut(usize::from(index.0))) {
            (Some(order), Some(device)) => return device.execute(order),
            (None, Some(_)) => "the node has no program of this job".to_owned(),
            (_, None) => format!("{index} does not exist"),
        };
        let outcome = Err(JobFailure::InvalidProgram(reason));
        self.found.push(Event::Executed { job, device: index, device_time_ns: 0, outcome });
    }
}
