//! A farm of four of turmoil's hosts: a coordinator, two nodes of two simulated devices each, and an application that runs some
//! hundred jobs. All of it is what the daemons and the SDK run, sockets and clocks apart.

use std::{
    collections::{HashMap, VecDeque},
    net::{Ipv4Addr, SocketAddr},
    path::PathBuf,
    rc::Rc,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use client_sdk::{FarmError, FarmOptions, TaskGraph, Window};
use coordinator::{CoordinatorOptions, initialise};
use farm_core::coordinator::{NodeState, NodeStatus};
use gpu_exec::{SimulatedTime, simulate_time};
use proto::{
    control::{self, Invitation},
    net::{Simulation, simulate},
    trust::{Identity, Role},
};
use rand::{Rng as _, SeedableRng as _, rngs::SmallRng};
use tempfile::TempDir;
use tokio::time::{sleep, timeout};
use turmoil::Sim;
use worker::WorkerOptions;

use crate::{
    application::{Brought, Numbers},
    clock::{AppThread, HostTime},
    network::Turmoil,
};

pub(crate) const COORDINATOR: &str = "coordinator";
pub(crate) const NODES: [&str; 2] = ["node-1", "node-2"];
pub(crate) const APP: &str = "app";

const COORDINATOR_ADDRESS: &str = "coordinator:7700";
const CONTROL_PORT: u16 = 7700;
const HTTP_PORT: u16 = 7701;
const DATA_PORT: u16 = 7800;
/// Simulated time that passes between two looks at the network: a fifth of what a message takes at most times.
const TICK: Duration = Duration::from_millis(4);
/// No farm needs as long, whatever the trouble: that takes a minute at most.
const LONGEST: Duration = Duration::from_secs(400);
/// How long the farm may take, after the last trouble, until everyone works with everyone again: a minute for which the coordinator
/// plans none of an application's jobs on a node that it could not reach, before it the longest time-out (10 s for a silent link or
/// session) and the longest pause between tries (3 s), some handshakes on a slow network, a few jobs.
const RECOVERY: Duration = Duration::from_secs(90);
/// Results that have come when the trouble begins.
const BEFORE_TROUBLE: usize = 8;
/// Jobs that are run at a time when the trouble is over, two for each device.
const AFTERWARDS: u32 = 8;

/// What is simulated, trouble apart.
pub(crate) struct Scene {
    pub(crate) seed: u64,
    pub(crate) jobs: u32,
    /// How long a message takes at most.
    pub(crate) latency: Duration,
    /// How often a link between two hosts fails, for each message sent on it.
    pub(crate) fail_rate: f64,
    /// How often a failed one is repaired, for each message that was to go over it.
    pub(crate) repair_rate: f64,
    /// Whether the farm is for members alone.
    pub(crate) secured: bool,
}

/// What happens to a farm.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Act {
    /// Messages wait on the way between two.
    Hold(&'static str, &'static str),
    /// They arrive, all at once.
    Release(&'static str, &'static str),
    /// Messages between two are lost.
    Part(&'static str, &'static str),
    /// Messages from the first to the second are lost.
    Silence(&'static str, &'static str),
    /// No longer.
    Repair(&'static str, &'static str),
    /// The process is gone at once.
    Crash(&'static str),
    /// The process is there, anew.
    Bounce(&'static str),
    /// No link fails any more.
    Clear,
}

/// The hosts' own state, which survives what happens to them.
#[derive(Clone)]
struct World {
    state: PathBuf,
    operator: Option<Identity>,
    identities: Arc<Mutex<HashMap<&'static str, Identity>>>,
    brought: Brought,
    thread: AppThread,
    /// The trouble is over.
    calm: Arc<AtomicBool>,
    jobs: u32,
    window: usize,
}

pub(crate) struct Farm {
    sim: Sim<'static>,
    world: World,
    _state: TempDir,
    _network: Simulation,
    _time: SimulatedTime,
}

impl Farm {
    pub(crate) fn new(scene: &Scene) -> Self {
        let state = tempfile::tempdir().unwrap();
        let operator = scene.secured.then(|| initialise(state.path(), "farm", "boss").unwrap());
        let mut rng = SmallRng::seed_from_u64(scene.seed);
        let world = World {
            state: state.path().to_owned(),
            operator,
            identities: Arc::default(),
            brought: Brought::default(),
            thread: AppThread::default(),
            calm: Arc::default(),
            jobs: scene.jobs,
            window: [16, 64, 8_192][rng.random_range(0..3)],
        };
        let (network, time) = (simulate(Rc::new(Turmoil)), simulate_time(Rc::new(HostTime)));
        let mut sim = turmoil::Builder::new()
            .rng_seed(scene.seed)
            .tick_duration(TICK)
            .simulation_duration(LONGEST)
            .min_message_latency(Duration::from_millis(1))
            .max_message_latency(scene.latency)
            .fail_rate(scene.fail_rate)
            .repair_rate(scene.repair_rate)
            .enable_random_order()
            // Queues of the system's: far more than is ever on the way.
            .tcp_capacity(1 << 12)
            .udp_capacity(1 << 12)
            .build();
        let coordinator = world.clone();
        sim.host(COORDINATOR, move || coordinate(coordinator.clone()));
        for name in NODES {
            let node = world.clone();
            sim.host(name, move || work(node.clone(), name));
        }
        sim.client(APP, apply(world.clone()));
        Self { sim, world, _state: state, _network: network, _time: time }
    }

    /// Runs the farm until the application is through; each act comes so long after the first results. Gives how long it took.
    ///
    /// # Errors
    /// A host ended, the application's end was not reached, or a job's result came not exactly once.
    pub(crate) fn play(mut self, acts: Vec<(Duration, Act)>) -> Result<Duration, String> {
        let mut acts = VecDeque::from(acts);
        let mut begun = None;
        loop {
            let over = self.sim.step().map_err(|error| self.told(&acts, &error.to_string()))?;
            self.world.thread.until_idle();
            if over {
                break;
            }
            if begun.is_none() && self.world.brought.count() >= BEFORE_TROUBLE {
                begun = Some(self.sim.elapsed());
            }
            while let (Some(begun), Some(&(after, act))) = (begun, acts.front())
                && begun + after <= self.sim.elapsed()
            {
                self.act(act);
                acts.pop_front();
            }
            if acts.is_empty() {
                self.world.calm.store(true, Ordering::Relaxed);
            }
        }
        let wrong = self.world.brought.wrong();
        if wrong.is_empty() { Ok(self.sim.elapsed()) } else { Err(self.told(&acts, &wrong)) }
    }

    fn act(&mut self, act: Act) {
        tracing::info!(?act, at = ?self.sim.elapsed());
        match act {
            Act::Hold(one, other) => self.sim.hold(one, other),
            Act::Release(one, other) => self.sim.release(one, other),
            Act::Part(one, other) => self.sim.partition(one, other),
            Act::Silence(from, to) => self.sim.partition_oneway(from, to),
            Act::Repair(one, other) => self.sim.repair(one, other),
            Act::Crash(host) => self.sim.crash(host),
            Act::Bounce(host) => self.sim.bounce(host),
            Act::Clear => self.sim.set_fail_rate(0.0),
        }
    }

    fn told(&self, acts: &VecDeque<(Duration, Act)>, error: &str) -> String {
        let (at, came) = (self.sim.elapsed(), self.world.brought.count());
        format!("after {at:?} with {came} results and {acts:?} still to come: {error}")
    }
}

async fn coordinate(world: World) -> turmoil::Result {
    let any = |port| SocketAddr::from((Ipv4Addr::UNSPECIFIED, port));
    let coordinator = coordinator::start(CoordinatorOptions {
        listen: any(CONTROL_PORT),
        http: any(HTTP_PORT),
        state: Some(world.state),
        secured: world.operator.is_some(),
        ..CoordinatorOptions::default()
    });
    coordinator.await?.stopped().await;
    Err("the coordinator stopped by itself".into())
}

async fn work(world: World, name: &'static str) -> turmoil::Result {
    let identity = world.identity(Role::Node, name).await;
    let options = WorkerOptions {
        listen: SocketAddr::from((Ipv4Addr::UNSPECIFIED, DATA_PORT)),
        advertise: vec![SocketAddr::from((turmoil::lookup(name), DATA_PORT)).to_string()],
        name: identity.as_ref().map_or(name, |identity| &identity.principal().name).to_owned(),
        identity,
        connect_timeout: LONGEST,
        ..WorkerOptions::embedded(COORDINATOR_ADDRESS.to_owned(), vec!["sim".parse()?, "sim".parse()?])
    };
    let end = worker::start(options).await?.ended().await;
    Err(format!("{name} ended by itself: {end:?}").into())
}

async fn apply(world: World) -> turmoil::Result {
    let identity = world.identity(Role::App, APP).await;
    let options = FarmOptions {
        identity: identity.clone(),
        global_stealing: true,
        reconnect_timeout: LONGEST,
        patience: LONGEST,
        window: Window { jobs: world.window, ..Window::default() },
        ..FarmOptions::new(COORDINATOR_ADDRESS, APP)
    };
    let farm = loop {
        match client_sdk::Farm::connect(options.clone()).await {
            Ok(farm) => break farm,
            Err(error) if error.can_be_retried() => sleep(Duration::from_millis(500)).await,
            Err(error) => return Err(error.into()),
        }
    };
    let run = async |jobs: u32| {
        let task = Numbers::new(jobs, world.brought.clone(), world.thread.clone());
        world.thread.expect();
        farm.run(TaskGraph::new().task("numbers", task)).await
    };
    run(world.jobs).await?;
    while !world.calm.load(Ordering::Relaxed) {
        sleep(Duration::from_secs(1)).await;
    }
    let working = async {
        let before = executed(&identity).await;
        loop {
            run(AFTERWARDS).await?;
            let after = executed(&identity).await;
            let grew = |name: &str| {
                let new = after
                    .iter()
                    .filter(|(node, jobs)| node.starts_with(name) && before.get(*node) < Some(jobs));
                new.count() > 0
            };
            if NODES.into_iter().all(grew) {
                return Ok::<_, FarmError>(());
            }
            sleep(Duration::from_secs(5)).await;
        }
    };
    let together = timeout(RECOVERY, working).await;
    together.map_err(|_| format!("after {RECOVERY:?} of calm a node still gets no jobs"))??;
    farm.close().await;
    Ok(())
}

/// Jobs that each living node has executed in this life of the coordinator.
async fn executed(identity: &Option<Identity>) -> HashMap<String, u64> {
    loop {
        if let Ok(status) = control::status(COORDINATOR_ADDRESS, identity.as_ref()).await {
            let living = status.nodes.into_iter().filter(|node| node.state == NodeState::Alive);
            let jobs = |node: &NodeStatus| node.devices.iter().map(|device| device.executed_jobs).sum();
            return living.map(|node| (node.name.clone(), jobs(&node))).collect();
        }
    }
}

impl World {
    /// Who a host is in a secured farm: it joins when it is there for the first time.
    async fn identity(&self, role: Role, host: &'static str) -> Option<Identity> {
        let operator = self.operator.as_ref()?;
        if let Some(identity) = self.identities.lock().unwrap().get(host) {
            return Some(identity.clone());
        }
        let lifetime = Duration::from_secs(3_600);
        let mut tries = 0..;
        loop {
            // An answer that was lost leaves a member behind: the next try is for another name.
            let name = Some(format!("{host}-{}", tries.next().unwrap_or(0)));
            let invitation = Invitation { role, name, lifetime, uses: 1, project: None };
            let joined = async {
                let (_, token) =
                    control::create_token(COORDINATOR_ADDRESS, Some(operator), &invitation).await?;
                control::join(COORDINATOR_ADDRESS, &token, None).await
            };
            match joined.await {
                Ok(identity) => {
                    self.identities.lock().unwrap().insert(host, identity.clone());
                    return Some(identity);
                }
                Err(error) => tracing::debug!(host, %error, "trying again"),
            }
            sleep(Duration::from_millis(300)).await;
        }
    }
}
