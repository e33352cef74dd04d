//! How a long run tells how far it is: a bar on a terminal, lines of JSON for scripts, or nothing.

use std::{
    io::IsTerminal as _,
    sync::Arc,
    time::{Duration, Instant},
};

use client_sdk::{CoordinatorLink, Progress};
use farm_core::message::WaitReason;
use indicatif::{HumanCount, ProgressBar, ProgressStyle as BarStyle};
use serde_json::json;
use tokio::{sync::watch, task::JoinHandle};

use crate::{cli::ProgressStyle, output};

/// Redraws of the bar, and lines of JSON, are at least this far apart.
const INTERVAL: Duration = Duration::from_millis(100);

/// How often [`Units::early`] is asked at most: it may pass over all that there is.
const EARLY_INTERVAL: Duration = Duration::from_secs(2);

/// How finely the bar is drawn.
const BAR_STEPS: u64 = 10_000;

/// What the bar counts besides jobs.
#[derive(Clone)]
pub(crate) struct Units {
    /// How much of the run is done, 0 to 1.
    pub share: Arc<dyn Fn(&Progress) -> f64 + Send + Sync>,
    /// Units of work of the whole run (samples, iterations).
    pub total: f64,
    /// What they are called.
    pub name: &'static str,
    /// What can be said of the result before the end.
    pub early: Option<Arc<dyn Fn() -> Option<Early> + Send + Sync>>,
}

/// A result before the end.
#[derive(Clone, Debug)]
pub(crate) struct Early {
    /// For the bar.
    pub words: String,
    /// For the line of JSON: its name and its value.
    pub field: (&'static str, serde_json::Value),
}

/// Asks for the early result, not too often and beside the telling.
struct EarlyTeller {
    units: Units,
    asked: Instant,
    asking: Option<JoinHandle<Option<Early>>>,
    known: Option<Early>,
}

impl EarlyTeller {
    fn new(units: Units) -> Self {
        Self { units, asked: Instant::now(), asking: None, known: None }
    }

    /// The latest answer.
    async fn known(&mut self) -> Option<&Early> {
        if self.asking.as_ref().is_some_and(JoinHandle::is_finished)
            && let Some(asking) = self.asking.take()
        {
            self.known = asking.await.ok().flatten().or_else(|| self.known.take());
        }
        if let Some(early) = self.units.early.clone().filter(|_| self.asking.is_none())
            && self.asked.elapsed() >= EARLY_INTERVAL
        {
            self.asked = Instant::now();
            self.asking = Some(tokio::task::spawn_blocking(move || early()));
        }
        self.known.as_ref()
    }
}

/// Tells the progress until the farm's connection closes.
pub(crate) async fn tell(mut progress: watch::Receiver<Progress>, style: ProgressStyle, units: Units) {
    match style {
        ProgressStyle::None => {}
        ProgressStyle::Ndjson => tell_lines(&mut progress, units).await,
        ProgressStyle::Auto if std::io::stderr().is_terminal() => tell_bar(&mut progress, units).await,
        ProgressStyle::Auto => tell_waits(&mut progress).await,
    }
}

async fn tell_lines(progress: &mut watch::Receiver<Progress>, units: Units) {
    let mut early = EarlyTeller::new(units);
    loop {
        let mut line = {
            let now = progress.borrow_and_update();
            json!({
                "event": "progress",
                "jobs_done": now.jobs_done,
                "jobs_known": now.jobs_known,
                "share": (early.units.share)(&now),
                "jobs_journalled": now.jobs_journalled,
                "replanned": now.replanned,
                "nodes": now.nodes,
                "tasks": now.active_tasks.iter().map(|name| &**name).collect::<Vec<&str>>(),
                "waiting": waits(&now),
                "coordinator": match now.coordinator {
                    CoordinatorLink::Up => "up",
                    CoordinatorLink::Reconnecting => "lost",
                },
            })
        };
        if let Some(Early { field: (name, value), .. }) = early.known().await {
            line[name] = value.clone();
        }
        if output::print_text(&format!("{line}\n")).is_err() || progress.changed().await.is_err() {
            return;
        }
        tokio::time::sleep(INTERVAL).await;
    }
}

async fn tell_bar(progress: &mut watch::Receiver<Progress>, units: Units) {
    let bar = ProgressBar::new(BAR_STEPS);
    let style = BarStyle::with_template("{prefix:>8} {wide_bar} {percent:>3}%  {msg}")
        .expect("the template is valid");
    bar.set_style(style);
    let began = Instant::now();
    let mut early = EarlyTeller::new(units.clone());
    loop {
        let words = early.known().await.map(|early| early.words.clone());
        {
            let now = progress.borrow_and_update();
            bar.set_position(whole((units.share)(&now) * BAR_STEPS as f64));
            bar.set_prefix(now.active_tasks.last().map_or("start", |task| &**task).to_owned());
            let said = message(&now, &units, began.elapsed());
            bar.set_message([Some(said), words].into_iter().flatten().collect::<Vec<_>>().join("  "));
        }
        if progress.changed().await.is_err() {
            break;
        }
        tokio::time::sleep(INTERVAL).await;
    }
    bar.finish_and_clear();
}

/// Without a terminal only what needs a person's help is told, once each, and how the coordinator's absence begins and ends.
async fn tell_waits(progress: &mut watch::Receiver<Progress>) {
    let (mut told, mut quota_told) = (None, false);
    let mut link = CoordinatorLink::Up;
    loop {
        let (waiting, link_now) = {
            let now = progress.borrow_and_update();
            (waits(&now), now.coordinator)
        };
        if std::mem::replace(&mut link, link_now) != link_now {
            match link_now {
                CoordinatorLink::Reconnecting => tell!("farmctl: {COORDINATOR_LOST}"),
                CoordinatorLink::Up => tell!("farmctl: the coordinator is there again"),
            }
        }
        let again = waiting == Some(OVER_QUOTA) && quota_told;
        if let Some(reason) = waiting.filter(|_| waiting != told && !again) {
            tell!("farmctl: waiting: {reason}");
        }
        quota_told |= waiting == Some(OVER_QUOTA);
        told = waiting;
        if progress.changed().await.is_err() {
            return;
        }
    }
}

fn message(now: &Progress, units: &Units, elapsed: Duration) -> String {
    let waiting = waits(now);
    let share = (units.share)(now);
    let computed = now.jobs_done - now.jobs_journalled;
    let begun = share > 0.0 && computed > 0;
    // A project at its quota gets on, if more slowly.
    let slow = begun && waiting == Some(OVER_QUOTA);
    if let Some(reason) = waiting.filter(|_| !slow) {
        return format!("waiting: {reason}");
    }
    if now.coordinator == CoordinatorLink::Reconnecting {
        return COORDINATOR_LOST.to_owned();
    }
    if !begun {
        return String::new();
    }
    // What a journal had took no time.
    let computed = share * count(computed) / count(now.jobs_done);
    let rate = units.total * computed / elapsed.as_secs_f64();
    let left = elapsed.mul_f64((1.0 - share).max(0.0) / computed);
    let (rate, left) = (HumanCount(whole(rate)), clock(left));
    let quota = if slow { "  at your project's quota" } else { "" };
    format!("{rate} {}/s  ETA {left}  nodes {}{quota}", units.name, now.nodes)
}

const COORDINATOR_LOST: &str = "coordinator lost, trying again; nodes go on working";
const OVER_QUOTA: &str = "your project has as much of the farm as it may have (`farmctl project ls`)";

/// Why nothing goes on, if it does not.
const fn waits(now: &Progress) -> Option<&'static str> {
    match now.waiting {
        Some(WaitReason::NoNode) => Some("no node is registered at the coordinator"),
        Some(WaitReason::NoFittingDevice) => Some("no device of the farm fits the jobs"),
        Some(WaitReason::OverQuota) => Some(OVER_QUOTA),
        None if now.out_of_reach => Some("no node of the farm can be reached from here, trying again"),
        None => None,
    }
}

fn clock(duration: Duration) -> String {
    let seconds = duration.as_secs();
    match seconds {
        0..60 => format!("{seconds}s"),
        60..3_600 => format!("{}m{:02}s", seconds / 60, seconds % 60),
        _ => format!("{}h{:02}m", seconds / 3_600, seconds % 3_600 / 60),
    }
}

#[expect(clippy::cast_precision_loss, reason = "a count for people")]
fn count(number: u64) -> f64 {
    number as f64
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a rate for people; `as` saturates"
)]
fn whole(number: f64) -> u64 {
    number as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bar_tells_rate_and_remaining_time() {
        let now = Progress { jobs_done: 25, jobs_known: 100, nodes: 3, ..Progress::default() };
        let share = Arc::new(|now: &Progress| now.jobs_done as f64 / 100.0);
        let units = Units { share, total: 1_000_000.0, name: "samples", early: None };
        assert_eq!(message(&now, &units, Duration::from_secs(10)), "25,000 samples/s  ETA 30s  nodes 3");
        let resumed = Progress { jobs_done: 75, jobs_journalled: 50, ..now.clone() };
        assert_eq!(message(&resumed, &units, Duration::from_secs(10)), "25,000 samples/s  ETA 10s  nodes 3");
        let slow = Progress { waiting: Some(WaitReason::OverQuota), ..now.clone() };
        assert_eq!(
            message(&slow, &units, Duration::from_secs(10)),
            "25,000 samples/s  ETA 30s  nodes 3  at your project's quota"
        );
        let stuck = Progress { waiting: Some(WaitReason::NoNode), ..now };
        assert!(message(&stuck, &units, Duration::from_secs(10)).contains("no node"));
    }

    #[test]
    fn durations_read_well() {
        assert_eq!(clock(Duration::from_secs(59)), "59s");
        assert_eq!(clock(Duration::from_secs(61)), "1m01s");
        assert_eq!(clock(Duration::from_secs(7_260)), "2h01m");
    }
}
