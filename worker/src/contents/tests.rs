//! Scenario 29: what the caches are worth beside a textbook LRU of the same size, over the same references. Contents come over a
//! real link and lie in real files; one blocking thread and one reference at a time make a seed the same run.

use std::{
    collections::{BTreeMap, VecDeque},
    fs,
    net::SocketAddr,
};

use farm_core::message::{AppToNode, NodeToApp};
use proto::link::{DataServer, Link, LinkSender};
use rand::{Rng as _, SeedableRng as _, rngs::SmallRng};
use tempfile::TempDir;

use super::*;

const APPS: usize = 3;
/// Modules and task allocations of one application, 1 to 8 KiB each.
const CONTENTS: usize = 80;
/// Jobs of all applications.
const JOBS: usize = 2_000;
/// Jobs that hold their contents at a time: two devices, one job running and one staged on each.
const HOLDING: usize = 4;
/// After so many jobs an application is at its next frame: other allocations are the popular ones.
const JOBS_PER_PHASE: usize = 250;
const SEEDS: u64 = 3;

/// What the applications' jobs name, in order of the jobs: each the module of its application and two or three allocations, as
/// likely as 1 / rank (Zipf's law).
#[expect(clippy::cast_possible_truncation, reason = "a rank is at most CONTENTS")]
fn jobs(rng: &mut SmallRng, apps: &[Vec<Content>]) -> Vec<Vec<Content>> {
    let mut job = |number: usize| {
        let app = &apps[rng.random_range(0..APPS)];
        let (module, allocations) = app.split_first().expect("it has contents");
        let phase = number / JOBS_PER_PHASE * CONTENTS / 4;
        let mut named = vec![*module];
        while named.len() < 3 + number % 2 {
            let rank = (CONTENTS as f64).powf(rng.random()) as usize - 1;
            let content = allocations[(rank + phase) % allocations.len()];
            if !named.contains(&content) {
                named.push(content);
            }
        }
        named
    };
    (0..JOBS).map(&mut job).collect()
}

/// The textbook: room is made by what was used longest ago. It knows no jobs.
struct Oracle {
    cap_bytes: u64,
    /// Oldest first.
    used: VecDeque<Content>,
}

impl Oracle {
    /// Uses a content; true if it was here.
    fn hit(&mut self, content: Content) -> bool {
        let place = self.used.iter().position(|used| *used == content);
        place.map(|place| self.used.remove(place));
        self.used.push_back(content);
        while self.used.iter().map(|content| content.size_bytes).sum::<u64>() > self.cap_bytes {
            self.used.pop_front();
        }
        place.is_some()
    }
}

/// The node's contents with an application that has everything, and the jobs that hold some.
struct Node {
    contents: Contents,
    application: LinkSender<NodeToApp>,
    inputs: (mpsc::Sender<Input>, mpsc::Receiver<Input>),
    /// How many jobs need a content: the machine's count.
    held: BTreeMap<ContentHash, u32>,
    caps: (u64, u64),
    folder: TempDir,
}

impl Node {
    async fn open(application: LinkSender<NodeToApp>, caps: (u64, u64)) -> Self {
        let folder = TempDir::new().unwrap();
        let disk = (caps.1 > 0).then_some((folder.path(), caps.1));
        let contents = Contents::open(caps.0, disk, true).unwrap();
        Self { contents, application, inputs: mpsc::channel(8), held: BTreeMap::new(), caps, folder }
    }

    /// A job begins to need a content; true if it was here.
    async fn hold(&mut self, content: Content) -> bool {
        let jobs = self.held.entry(content.hash).or_default();
        *jobs += 1;
        if *jobs > 1 || self.contents.pin(content) {
            return true;
        }
        let from = Source::Application(Some(self.application.clone()));
        self.contents.fetch(content, from, self.inputs.0.clone());
        let mut from_disk = false;
        while !self.contents.fetching.is_empty() || self.is_writing() {
            match self.inputs.1.recv().await.expect("the test has a sender") {
                Input::Fetched { content, fetched } => {
                    from_disk = fetched.from_disk;
                    let events = self.contents.fetched(content, fetched, &self.inputs.0);
                    let failed = events.iter().find(|event| matches!(event, Event::ContentFailed { .. }));
                    assert_eq!(failed, None, "there is room, and the application has all");
                }
                Input::Stored { content, result } => {
                    self.check_files().await;
                    self.contents.stored(content, result);
                }
                other => panic!("{other:?}"),
            }
        }
        self.check();
        from_disk
    }

    fn release(&mut self, content: Content) {
        let jobs = self.held.get_mut(&content.hash).expect("it is held");
        *jobs -= 1;
        if *jobs == 0 {
            self.held.remove(&content.hash);
            self.contents.release(content.hash);
        }
    }

    fn is_writing(&self) -> bool {
        self.contents.disk.as_ref().is_some_and(|disk| disk.writing_bytes() > 0)
    }

    /// The caps hold, and what jobs need is there.
    fn check(&self) {
        let ((_, memory), disk) = (self.contents.memory.figures(), self.contents.disk.as_ref());
        assert!(memory <= self.caps.0, "{memory} B in memory");
        let disk = disk.map_or(0, |disk| disk.figures().1);
        assert!(disk <= self.caps.1, "{disk} B on disk");
        for hash in self.held.keys() {
            assert!(self.contents.shelf().get(hash).is_some(), "{hash} is needed and was evicted");
        }
    }

    /// The files themselves keep to the cap, also with the one that has just been written.
    async fn check_files(&self) {
        let folder = self.folder.path().join("contents");
        // There is one blocking thread: what was to be removed before is.
        let files = tokio::task::spawn_blocking(move || {
            let files = fs::read_dir(folder).into_iter().flatten();
            files.map(|file| file.unwrap().metadata().unwrap().len()).sum::<u64>()
        });
        let bytes = files.await.unwrap();
        assert!(bytes <= self.caps.1, "{bytes} B in files, cap {} B", self.caps.1);
    }
}

/// A link to an application that has these contents.
async fn application(contents: BTreeMap<ContentHash, ContentBytes>) -> (impl Sized, LinkSender<NodeToApp>) {
    let server = DataServer::bind(SocketAddr::from(([127, 0, 0, 1], 0)), None).unwrap();
    let address = [server.local_addr().to_string()];
    let source = ContentSource::new(move |hash| contents.get(&hash).cloned());
    let dialled =
        proto::link::connect::<AppToNode, NodeToApp>(&address, server.certificate_der(), None, source);
    let accepted = async { server.accept().await.unwrap().establish(|_| ContentSource::empty()).await };
    let (dialled, accepted) = tokio::join!(dialled, accepted);
    let (Link { sender, receiver }, _): (Link<NodeToApp, AppToNode>, _) = accepted.unwrap();
    ((server, dialled.unwrap(), receiver), sender)
}

/// Hit rates of the node and of the oracle, whose caps are a half of all that the jobs name.
async fn hit_rates(seed: u64, caps: impl Fn(u64) -> (u64, u64)) -> (f64, f64) {
    let mut rng = SmallRng::seed_from_u64(seed);
    let mut bytes = BTreeMap::new();
    let mut make = || {
        let mut content = vec![0; rng.random_range(1 << 10..=8 << 10)];
        rng.fill(&mut content[..]);
        let content = ContentBytes::new(content);
        let named = content.content();
        bytes.insert(named.hash, content);
        named
    };
    let apps: Vec<Vec<Content>> = (0..APPS).map(|_| (0..CONTENTS).map(|_| make()).collect()).collect();
    let cap_bytes = apps.iter().flatten().map(|content| content.size_bytes).sum::<u64>() / 2;
    let jobs = jobs(&mut rng, &apps);

    let (_open, link) = application(bytes).await;
    let mut node = Node::open(link, caps(cap_bytes)).await;
    let mut oracle = Oracle { cap_bytes, used: VecDeque::new() };
    let (mut hits, mut oracle_hits) = (0_u32, 0_u32);
    let mut holding: Vec<&[Content]> = Vec::new();
    for job in &jobs {
        if holding.len() == HOLDING {
            let ended = holding.swap_remove(rng.random_range(0..HOLDING));
            ended.iter().for_each(|content| node.release(*content));
        }
        for content in job {
            hits += u32::from(node.hold(*content).await);
            oracle_hits += u32::from(oracle.hit(*content));
        }
        holding.push(job);
    }
    let all: usize = jobs.iter().map(Vec::len).sum();
    (f64::from(hits) / all as f64, f64::from(oracle_hits) / all as f64)
}

fn show_and_judge(what: &str, caps: impl Fn(u64) -> (u64, u64)) {
    let mut runtime = tokio::runtime::Builder::new_current_thread();
    let runtime = runtime.enable_all().max_blocking_threads(1).build().unwrap();
    for seed in 1..=SEEDS {
        let (rate, oracle) = runtime.block_on(hit_rates(seed, &caps));
        println!("s29  {what}, seed {seed}: hit rate {:.2} %, LRU {:.2} %", 100.0 * rate, 100.0 * oracle);
        assert!(rate >= oracle - 0.01, "s29: {what}, seed {seed}: {rate:.4}, LRU {oracle:.4}");
    }
}

#[test]
fn s29_memory_hits_as_often_as_an_lru() {
    show_and_judge("memory", |cap_bytes| (cap_bytes, 0));
}

/// Memory is a quarter of the disk: what is in either need not be fetched.
#[test]
fn s29_memory_and_disk_hit_as_often_as_an_lru_of_the_disks_size() {
    show_and_judge("memory and disk", |cap_bytes| (cap_bytes / 4, cap_bytes));
}
