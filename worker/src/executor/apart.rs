//! A device's executor in a process of its own: a driver that crashes, or a kernel that never ends, costs the attempts that
//! were on the device, not the daemon and not the other devices.
//!
//! A task owns the process and a [`Book`] of what it holds; it starts the process anew when it ends, and ends it when it
//! hangs. The process itself is [`super::serve`]. A new one measures its device again before it takes jobs.

use std::{
    path::PathBuf,
    time::{Duration, Instant},
};

use bytes::Bytes;
use farm_core::{
    device::DeviceInfo,
    id::{DeviceIndex, JobAttempt},
    message::JobFailure,
};
use gpu_exec::DeviceSpec;
use proto::link::ContentBytes;
use tokio::{sync::mpsc, time::timeout};

use super::{
    Order,
    book::{Aborted, Book, Victim},
    process::{NotOpen, Process},
    restarts::Restarts,
    wire::{FromExecutor, ToExecutor},
};
use crate::{
    contents::Shelf,
    device::{DeviceEvent, DeviceNews, Payload},
};

/// How long a process that seems hung is listened to once more.
const LAST_LOOK: Duration = Duration::from_millis(500);

/// How an executor process is started.
#[derive(Clone, Debug)]
pub(super) struct Launch {
    /// A binary that serves when its first argument is [`super::ROLE`].
    pub(super) program: PathBuf,
    pub(super) spec: DeviceSpec,
    /// Where what drivers compile is kept.
    pub(super) compiled: Option<PathBuf>,
}

/// The way to a device's executor process. Dropping it ends the process.
#[derive(Debug)]
pub(crate) struct ExecutorProcess {
    /// Unbounded for the owner task, which must not wait: at most the jobs of one device and their aborts.
    commands: mpsc::UnboundedSender<Command>,
}

#[derive(Debug)]
enum Command {
    Execute(Order),
    Abort(JobAttempt),
}

impl ExecutorProcess {
    /// Opens the device in a process of its own.
    ///
    /// # Errors
    /// The process does not start, or the device does not open; the text is for people.
    pub(super) async fn start(
        launch: Launch,
        index: DeviceIndex,
        contents: Shelf,
        events: mpsc::UnboundedSender<DeviceEvent>,
    ) -> Result<(Self, DeviceInfo), String> {
        let (process, info) = first(&launch).await?;
        let (commands, received) = mpsc::unbounded_channel();
        let supervisor = Supervisor {
            launch,
            index,
            info: info.clone(),
            contents,
            events,
            book: Book::new(Instant::now()),
            restarts: Restarts::default(),
            fault_told: false,
        };
        // Ends when the handle is dropped.
        tokio::spawn(supervisor.run(process, received));
        Ok((Self { commands }, info))
    }

    /// Takes an order; what becomes of it comes as an event.
    pub(super) fn submit(&self, order: Order) {
        let _ = self.commands.send(Command::Execute(order));
    }

    /// Takes a job back.
    pub(super) fn abort(&self, job: JobAttempt) {
        let _ = self.commands.send(Command::Abort(job));
    }
}

/// The task behind an [`ExecutorProcess`].
struct Supervisor {
    launch: Launch,
    index: DeviceIndex,
    /// As it was opened first: what the farm knows of it.
    info: DeviceInfo,
    contents: Shelf,
    events: mpsc::UnboundedSender<DeviceEvent>,
    book: Book,
    restarts: Restarts,
    /// The last that the process said was that a job failed: if its device is lost now, that was why.
    fault_told: bool,
}

/// Why a process is of no more use.
enum End {
    /// Nobody wants it any more.
    Closed,
    /// It ended by itself, or broke the protocol.
    Broken(String),
    /// It said that its device is gone; whose fault that is it has said before.
    DeviceLost(String),
    /// It was silent for too long.
    Hung,
}

impl Supervisor {
    async fn run(mut self, first: Process, mut commands: mpsc::UnboundedReceiver<Command>) {
        let mut process = first;
        loop {
            let end = self.attend(&mut process, &mut commands).await;
            let blamed = self.fault_told && matches!(end, End::DeviceLost(_));
            let reason = match end {
                End::Closed => return,
                End::Broken(words) => format!("the device's executor {}; {words}", process.ended().await),
                End::DeviceLost(words) => words,
                End::Hung => "the device's executor did not answer and was ended".to_owned(),
            };
            // Killed, whatever state it is in: what the driver holds is freed before the device is opened anew.
            process.kill().await;
            let explained = self.bury(&reason) || blamed;
            tracing::warn!(device = %self.launch.spec, reason, "starting the executor anew");
            match self.reopen(explained, &mut commands).await {
                Ok(Some(next)) => process = next,
                Ok(None) => return,
                Err(error) => return self.lose(format!("{reason}; {error}"), commands).await,
            }
        }
    }

    /// Serves until the process, or the need of it, ends.
    async fn attend(
        &mut self,
        process: &mut Process,
        commands: &mut mpsc::UnboundedReceiver<Command>,
    ) -> End {
        loop {
            while let Some(order) = self.book.next(Instant::now()) {
                process.execute(order);
            }
            let deadline = self.book.deadline();
            let silence = async move {
                match deadline {
                    Some(at) => tokio::time::sleep_until(at.into()).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                biased;
                said = process.said() => match said {
                    Ok((header, payload)) => {
                        if let Some(end) = self.heard(process, header, payload) {
                            return end;
                        }
                    }
                    Err(error) => return End::Broken(error),
                },
                command = commands.recv() => match command {
                    Some(Command::Execute(order)) => self.book.take(order),
                    Some(Command::Abort(job)) => {
                        if self.abort(job) {
                            process.send(&ToExecutor::Abort(job), None);
                        }
                    }
                    None => return End::Closed,
                },
                // Whoever was stopped itself, as by a debugger, finds the words of a process that was not.
                () = silence => match timeout(LAST_LOOK, process.said()).await {
                    Ok(Ok((header, payload))) => {
                        if let Some(end) = self.heard(process, header, payload) {
                            return end;
                        }
                    }
                    Ok(Err(error)) => return End::Broken(error),
                    Err(_) => return End::Hung,
                },
            }
        }
    }

    fn heard(&mut self, process: &Process, header: FromExecutor, payload: Bytes) -> Option<End> {
        let now = Instant::now();
        let fault_told = matches!(&header, FromExecutor::Finished { outcome: Err(_), .. });
        let fault_told = std::mem::replace(&mut self.fault_told, fault_told);
        match header {
            FromExecutor::Preparing(job) => self.book.preparing(now, job),
            FromExecutor::Prepared(job) => self.book.prepared(now, job),
            FromExecutor::Started(job) => {
                self.book.runs(now, job);
                self.tell(DeviceNews::Started(job));
            }
            FromExecutor::Resumed(job) => {
                self.book.runs(now, job);
                self.tell(DeviceNews::Resumed(job));
            }
            FromExecutor::Yielded(job) => {
                self.book.yielded(now, job);
                self.tell(DeviceNews::Yielded(job));
            }
            FromExecutor::Ended(job) => self.book.ended(now, job),
            FromExecutor::Finished { job, device_time_ns, outcome } => {
                if self.book.finished(now, job) {
                    self.restarts.works();
                    let outcome = outcome.map(|output| {
                        let digest = output.digest;
                        Payload { sections: output.cut(payload), digest }
                    });
                    self.tell(DeviceNews::Finished { job, device_time_ns, outcome });
                }
            }
            FromExecutor::Wants(hash) => {
                let bytes = self.contents.get(&hash).map(ContentBytes::into_bytes);
                let size_bytes = bytes.as_ref().map(|bytes| bytes.len() as u64);
                process.send(&ToExecutor::Content { hash, size_bytes }, bytes);
            }
            FromExecutor::Lost(reason) => {
                self.fault_told = fault_told;
                return Some(End::DeviceLost(reason));
            }
            FromExecutor::Opened(_) | FromExecutor::Refused(_) => {
                return Some(End::Broken("it greeted twice".to_owned()));
            }
            // The reader puts them together.
            FromExecutor::Part { .. } => {}
        }
        None
    }

    /// Whether the process has to be told.
    fn abort(&mut self, job: JobAttempt) -> bool {
        match self.book.abort(job) {
            Aborted::There => true,
            Aborted::Here => {
                self.tell_failed(job, 0, JobFailure::Cancelled);
                false
            }
            Aborted::Over => false,
        }
    }

    /// Reports the jobs that ended with the process; whether one of them was to blame.
    fn bury(&mut self, reason: &str) -> bool {
        let victims = self.book.lost(Instant::now(), reason);
        // One that was taken back may be the cause if it was on the device.
        let is_cause = |victim: &Victim| victim.failure != JobFailure::Cancelled || victim.device_time_ns > 0;
        let explained = victims.iter().any(is_cause);
        for victim in victims {
            self.tell_failed(victim.job, victim.device_time_ns, victim.failure);
        }
        explained
    }

    /// A new process with the device open; `None` if nobody wants it any more. Orders are taken meanwhile.
    async fn reopen(
        &mut self,
        explained: bool,
        commands: &mut mpsc::UnboundedReceiver<Command>,
    ) -> Result<Option<Process>, String> {
        let mut rest = self.restarts.ended(Instant::now(), explained)?;
        loop {
            let launch = self.launch.clone();
            let opening = async move {
                tokio::time::sleep(rest).await;
                Process::start(&launch).await
            };
            tokio::pin!(opening);
            let opened = loop {
                tokio::select! {
                    opened = &mut opening => break opened,
                    command = commands.recv() => match command {
                        Some(Command::Execute(order)) => self.book.take(order),
                        Some(Command::Abort(job)) => {
                            // Nothing is with a process.
                            let _ = self.abort(job);
                        }
                        None => return Ok(None),
                    },
                }
            };
            match opened {
                Ok((process, info)) if is_same(&self.info, &info) => return Ok(Some(process)),
                // `gpu:N` counts the devices that are there: one fewer, and a sibling answers.
                Ok((_, other)) => {
                    let reason = format!("{} answers in its place", other.name);
                    rest = self.restarts.refused(reason)?;
                }
                Err(error) => rest = self.restarts.refused(error.reason())?,
            }
        }
    }

    /// The device is gone for good: every job on it and every one that still comes ends so.
    async fn lose(mut self, reason: String, mut commands: mpsc::UnboundedReceiver<Command>) {
        // First, so that it gets no further jobs meanwhile.
        self.tell(DeviceNews::Lost(reason.clone()));
        for job in self.book.clear() {
            self.tell_failed(job, 0, JobFailure::DeviceLost(reason.clone()));
        }
        while let Some(command) = commands.recv().await {
            if let Command::Execute(order) = command {
                self.tell_failed(order.job, 0, JobFailure::DeviceLost(reason.clone()));
            }
        }
    }

    fn tell_failed(&self, job: JobAttempt, device_time_ns: u64, failure: JobFailure) {
        self.tell(DeviceNews::Finished { job, device_time_ns, outcome: Err(failure) });
    }

    fn tell(&self, what: DeviceNews) {
        // The driver is gone only when the worker ends: nobody is left to hear.
        let _ = self.events.send(DeviceEvent { device: self.index, what });
    }
}

/// The first process of a device. One that ends before it can say how the device is, as by a signal, is tried again.
async fn first(launch: &Launch) -> Result<(Process, DeviceInfo), String> {
    let mut restarts = Restarts::default();
    loop {
        match Process::start(launch).await {
            Ok(opened) => return Ok(opened),
            Err(NotOpen::Refused(reason)) => return Err(reason),
            Err(NotOpen::Ended(reason)) => {
                tracing::warn!(device = %launch.spec, reason, "an executor did not come up");
                let rest = restarts.refused(reason)?;
                tokio::time::sleep(rest).await;
            }
        }
    }
}

/// Whether a device that was opened again is what the farm knows. Its score varies, and is that of the first time.
fn is_same(known: &DeviceInfo, opened: &DeviceInfo) -> bool {
    DeviceInfo { score: known.score, ..opened.clone() } == *known
}
