//! The parent side of plug-in policies: the plug-ins of one folder, and a process for each that is asked.
//!
//! A plug-in is asked by name and answers, or will not, by a value; it never holds the asker up and cannot take the
//! coordinator along. Names are looked up among what the folder held at the start: none becomes a path.

mod child;
mod folder;
mod stderr;

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
    time::Duration,
};

use farm_core::coordinator::policy::{Choice, Question, QuestionId};
use tokio::{sync::mpsc, task::JoinSet, time::Instant};

use self::child::{Backoff, Child};
use crate::StartError;

/// Questions that wait for one plug-in; a further one is refused at once.
const QUEUED_QUESTIONS: usize = 16;
/// Answers that wait for the asker; plug-ins wait when it is full.
const QUEUED_ANSWERS: usize = 64;

/// Where plug-ins are, and how long they may take.
#[derive(Clone, Debug)]
pub struct PluginOptions {
    /// The folder of shared objects.
    pub folder: PathBuf,
    /// The executable that hosts a plug-in: a `farm-coordinator`.
    pub host: PathBuf,
    /// How long a question may wait, and again how long its answer may take; then the process is killed.
    pub answer_limit: Duration,
    /// How long a plug-in rests after its process ended by itself; doubled each time until it answers, up to a minute.
    pub restart_delay: Duration,
}

impl PluginOptions {
    /// With the usual limits: a second for an answer (a batch of 4,096 jobs at 20 us each takes 82 ms), 100 ms of rest.
    #[must_use]
    pub fn new(folder: impl Into<PathBuf>, host: impl Into<PathBuf>) -> Self {
        Self {
            folder: folder.into(),
            host: host.into(),
            answer_limit: Duration::from_secs(1),
            restart_delay: Duration::from_millis(100),
        }
    }

    /// Hosted by the `farm-coordinator` that lies beside the running executable.
    ///
    /// # Errors
    /// The system does not say where the running executable is.
    pub fn beside_this_executable(folder: impl Into<PathBuf>) -> std::io::Result<Self> {
        Ok(Self::new(folder, std::env::current_exe()?.with_file_name("farm-coordinator")))
    }
}

/// What came of a question.
#[derive(Debug)]
pub struct Answered {
    /// Which.
    pub question: QuestionId,
    /// A choice for every job, or why there is none, for people.
    pub answer: Result<Vec<Choice>, String>,
}

/// The plug-ins of a coordinator. Dropping it kills their processes.
#[derive(Debug)]
pub struct Plugins {
    hosts: BTreeMap<String, mpsc::Sender<Asked>>,
    answers: mpsc::Receiver<Answered>,
    /// Keeps `answers` open when there is no plug-in.
    _answer: mpsc::Sender<Answered>,
    _tasks: JoinSet<()>,
}

impl Plugins {
    /// None at all: every question is refused.
    #[must_use]
    pub fn none() -> Self {
        let (_answer, answers) = mpsc::channel(QUEUED_ANSWERS);
        Self { hosts: BTreeMap::new(), answers, _answer, _tasks: JoinSet::new() }
    }

    /// Scans the folder and loads each of its plug-ins once, so that a broken one is known now. They are loaded again when
    /// they are first asked.
    ///
    /// # Errors
    /// The folder, the host or a plug-in cannot be used; the error names it.
    pub async fn open(options: &PluginOptions) -> Result<Self, StartError> {
        let fault = |path: &Path, reason| StartError::Plugin { path: path.to_owned(), reason };
        if !options.host.is_file() {
            let reason = "is not there; plug-ins need it as their host".to_owned();
            return Err(fault(&options.host, reason));
        }
        let mut plugins = Self::none();
        for (name, path) in folder::scan(&options.folder)? {
            let launch = Launch { name: name.clone(), path, host: options.host.clone() };
            let child = Child::start(&launch).await.map_err(|reason| fault(&launch.path, reason))?;
            tracing::info!(plugin = %name, about = child.about(), "plug-in found");
            let (questions, asked) = mpsc::channel(QUEUED_QUESTIONS);
            let task = Host {
                launch,
                answer_limit: options.answer_limit,
                backoff: Backoff::new(options.restart_delay),
                child: None,
            };
            plugins._tasks.spawn(task.run(asked, plugins._answer.clone()));
            plugins.hosts.insert(name, questions);
        }
        Ok(plugins)
    }

    /// The names that can be asked.
    #[must_use]
    pub fn names(&self) -> BTreeSet<String> {
        self.hosts.keys().cloned().collect()
    }

    /// Asks without waiting; the answer comes from [`Self::answered`].
    ///
    /// # Errors
    /// There will be no answer: no such plug-in, or too many questions wait for it.
    pub fn ask(&self, id: QuestionId, plugin: &str, question: Question) -> Result<(), String> {
        let host = self.hosts.get(plugin).ok_or_else(|| format!("there is no plug-in {plugin:?}"))?;
        let asked = Asked { id, question, at: Instant::now() };
        host.try_send(asked).map_err(|_| format!("{QUEUED_QUESTIONS} questions wait for it already"))
    }

    /// The next answer; waits for ever if nothing was asked. Cancel-safe.
    pub async fn answered(&mut self) -> Answered {
        self.answers.recv().await.expect("its own sender keeps it open")
    }
}

/// A question on its way.
#[derive(Debug)]
struct Asked {
    id: QuestionId,
    question: Question,
    at: Instant,
}

/// What a child is started with.
#[derive(Debug)]
struct Launch {
    name: String,
    /// Resolved: a link that changes later changes nothing.
    path: PathBuf,
    host: PathBuf,
}

/// One plug-in: asks one question after the other.
#[derive(Debug)]
struct Host {
    launch: Launch,
    answer_limit: Duration,
    backoff: Backoff,
    child: Option<Child>,
}

impl Host {
    async fn run(mut self, mut asked: mpsc::Receiver<Asked>, answers: mpsc::Sender<Answered>) {
        while let Some(Asked { id, question, at }) = asked.recv().await {
            let answer = if at.elapsed() > self.answer_limit {
                Err("it was busy with earlier questions".to_owned())
            } else {
                self.answer(&question).await
            };
            if answers.send(Answered { question: id, answer }).await.is_err() {
                return;
            }
        }
    }

    async fn answer(&mut self, question: &Question) -> Result<Vec<Choice>, String> {
        let mut child = match self.child.take() {
            Some(child) => child,
            None => self.restart().await?,
        };
        let answer = match tokio::time::timeout(self.answer_limit, child.ask(question)).await {
            Ok(Ok(answer)) => {
                self.child = Some(child);
                self.backoff.answered();
                return answer;
            }
            Ok(Err(error)) => format!("{error}; {}", child.ending().await),
            // Dropped, it is killed.
            Err(_) => format!("did not answer within {:?} and was killed", self.answer_limit),
        };
        Err(self.failed(answer))
    }

    async fn restart(&mut self) -> Result<Child, String> {
        if let Some(rest) = self.backoff.rest(Instant::now()) {
            return Err(format!("its process ended before, and starts again in {rest:?} at the earliest"));
        }
        let started = Child::start(&self.launch).await;
        started.map_err(|reason| self.failed(reason))
    }

    fn failed(&mut self, reason: String) -> String {
        let rest = self.backoff.failed(Instant::now());
        tracing::warn!(plugin = %self.launch.name, %reason, ?rest, "plug-in failed; it rests before it is started again");
        reason
    }
}
