//! Who leads a farm whose coordinators share a state directory, and when a standby takes over (ADR 20).
//!
//! Terms are files, `leader-N`, and each has a control store of its own. Who makes the next one leads. A leader writes a new
//! beat into its own every heartbeat. A standby takes over when the beat stands still for as long as a node may be silent, or at
//! once where the leader was a process of this system that has let go of its lock. A leader that has not written its beat for three
//! quarters of that time commits nothing any more, and one that sees a later term ends.

mod standbys;

use std::{
    fs::{self, File, OpenOptions},
    io::{self, Read as _},
    os::unix::fs::{FileExt as _, OpenOptionsExt as _},
    path::{Path, PathBuf},
    process,
    sync::{
        Arc, LazyLock, Mutex, OnceLock, PoisonError, Weak,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use farm_core::message::Liveness;
use tokio::sync::watch;

use self::standbys::Presence;
pub(crate) use self::standbys::Standbys;
use crate::{StartError, numbered::Numbered, store};

/// The terms' files.
const TERMS: Numbered = Numbered { before: "leader-", after: "" };
/// Longest content of such a file that is read, in bytes.
const MAX_CONTENT_BYTES: u64 = 512;
/// How often a standby looks at the leader's beat.
const LOOK: Duration = Duration::from_millis(200);
/// This boot of this system, containers included: file locks reach as far.
static BOOT: LazyLock<String> = LazyLock::new(|| line_of("/proc/sys/kernel/random/boot_id"));
/// This process, for people. One text for as long as it lives.
static HOLDER: LazyLock<String> =
    LazyLock::new(|| format!("process {} of {}", process::id(), line_of("/proc/sys/kernel/hostname")));

/// What a standby found: the last term, and nobody who leads by it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Vacancy {
    /// The last term; 0: there was none.
    pub term: u64,
    /// Its leader is silent, and may have the control store open still.
    pub silent: bool,
}

/// One term of leading a farm. Over when this is dropped; one that never served is taken back then.
#[derive(Debug)]
pub(crate) struct Lead {
    directory: PathBuf,
    term: u64,
    /// Locked for as long as the process lives.
    file: File,
    liveness: Liveness,
    /// Before the newest beat was written.
    renewed: Mutex<Instant>,
    /// Whether there is a later term.
    over: watch::Sender<bool>,
    serves: AtomicBool,
    standbys: Arc<Standbys>,
    /// Its control store, if that is a copy of the one of a leader that may go on.
    copy: OnceLock<PathBuf>,
}

impl Lead {
    /// Takes the lead: the term after `predecessor`, or, if none is given, after whichever is there.
    ///
    /// # Errors
    /// [`StartError::Outrun`]: another one took that term. The directory cannot be used.
    pub(crate) fn take(
        directory: &Path,
        predecessor: Option<u64>,
        liveness: Liveness,
    ) -> Result<Arc<Self>, StartError> {
        let fault = |error: io::Error| store::fault(directory, &error);
        let term = match predecessor {
            Some(term) => term,
            None => TERMS.latest(directory).map_err(fault)?,
        } + 1;
        let path = TERMS.path(directory, term);
        let made = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&path);
        let file = made.map_err(|error| match error.kind() {
            io::ErrorKind::AlreadyExists => StartError::Outrun,
            _ => store::fault(&path, &error),
        })?;
        let (over, _) = watch::channel(false);
        // From here on what fails takes the term back.
        let lead = Arc::new(Self {
            directory: directory.to_owned(),
            term,
            file,
            liveness,
            renewed: Mutex::new(Instant::now()),
            over,
            serves: AtomicBool::new(false),
            standbys: Arc::default(),
            copy: OnceLock::new(),
        });
        lead.file.lock().map_err(|error| store::fault(&path, &error))?;
        lead.write_beat(0).map_err(|error| store::fault(&path, &error))?;
        // A later leader has removed the file of this term, which was another's.
        if lead.is_over().map_err(fault)? {
            return Err(StartError::Outrun);
        }
        let beating = Arc::downgrade(&lead);
        thread::Builder::new().name("lead".to_owned()).spawn(move || beat(&beating)).map_err(fault)?;
        let looking = Arc::downgrade(&lead);
        thread::Builder::new()
            .name("standbys".to_owned())
            .spawn(move || look_for_standbys(&looking))
            .map_err(fault)?;
        Ok(lead)
    }

    pub(crate) const fn term(&self) -> u64 {
        self.term
    }

    /// Who would take over.
    pub(crate) fn standbys(&self) -> Arc<Standbys> {
        Arc::clone(&self.standbys)
    }

    /// The control store of this term is a copy, or will be.
    pub(crate) fn copies_to(&self, path: &Path) {
        // There is one.
        let _ = self.copy.set(path.to_owned());
    }

    /// The coordinator serves: what is left of earlier terms goes.
    pub(crate) fn serves(&self) {
        self.serves.store(true, Ordering::Relaxed);
        TERMS.remove_before(&self.directory, self.term);
        store::forget_before(&self.directory, self.term);
    }

    /// Whether what is committed now is what a successor finds.
    ///
    /// # Errors
    /// Why it may not be.
    pub(crate) fn holds(&self) -> Result<(), String> {
        let silent = self.renewed.lock().unwrap_or_else(PoisonError::into_inner).elapsed();
        if silent > Duration::from_millis(self.liveness.dead_ms) * 3 / 4 {
            return Err(format!(
                "this coordinator could not write to {} for {silent:.1?}: another one may lead",
                self.directory.display()
            ));
        }
        match self.is_over() {
            Ok(false) => Ok(()),
            Ok(true) => Err("another coordinator has taken the farm over".to_owned()),
            Err(error) => Err(format!("{} cannot be read: {error}", self.directory.display())),
        }
    }

    /// Waits until another coordinator leads. Cancel-safe.
    pub(crate) async fn over(&self) {
        // The sender is of this very value.
        let _ = self.over.subscribe().wait_for(|&over| over).await;
    }

    fn is_over(&self) -> io::Result<bool> {
        Ok(TERMS.latest(&self.directory)? > self.term)
    }

    fn write_beat(&self, beat: u64) -> io::Result<()> {
        let before = Instant::now();
        let content = Content::new(beat, self.liveness);
        self.file.write_all_at(content.to_text().as_bytes(), 0)?;
        // Other systems see it through a network's disk.
        self.file.sync_data()?;
        *self.renewed.lock().unwrap_or_else(PoisonError::into_inner) = before;
        Ok(())
    }
}

impl Drop for Lead {
    fn drop(&mut self) {
        if !*self.serves.get_mut() {
            // A leader that was only silent goes on with what it has, if it has not seen this.
            if let Some(copy) = self.copy.get() {
                let _ = fs::remove_file(copy);
            }
            let _ = fs::remove_file(TERMS.path(&self.directory, self.term));
        }
    }
}

/// Writes beats until the term is over or nobody leads by it any more.
fn beat(lead: &Weak<Lead>) {
    let mut failing = false;
    for beat in 1.. {
        let Some(heartbeat) = lead.upgrade().map(|lead| lead.liveness.heartbeat_ms) else { return };
        thread::sleep(Duration::from_millis(heartbeat));
        let Some(lead) = lead.upgrade() else { return };
        // Before the beat: who was stopped for a while must not say that it leads.
        let renewed = lead
            .is_over()
            .and_then(|over| if over { Ok(true) } else { lead.write_beat(beat).map(|()| false) });
        match renewed {
            Ok(true) => {
                tracing::error!(
                    term = lead.term,
                    "another coordinator has taken the farm over: this one ends"
                );
                lead.over.send_replace(true);
                return;
            }
            Ok(false) => failing = false,
            Err(error) if !failing => {
                failing = true;
                tracing::error!(%error, "the coordinator's beat cannot be written: a standby would take over");
            }
            Err(_) => {}
        }
    }
}

/// A file that does not answer, on a disk of the network, holds no beat up.
fn look_for_standbys(lead: &Weak<Lead>) {
    loop {
        let Some((standbys, directory, liveness)) =
            lead.upgrade().map(|lead| (lead.standbys(), lead.directory.clone(), lead.liveness))
        else {
            return;
        };
        standbys.look(&directory, Duration::from_millis(liveness.dead_ms));
        thread::sleep(Duration::from_millis(liveness.heartbeat_ms));
    }
}

/// Waits until nobody leads. Says in the log who is waited for.
///
/// # Errors
/// The directory cannot be used, or is not there: on a disk that is not mounted, another farm would begin.
pub async fn stand_by(directory: &Path, liveness: Liveness) -> Result<Vacancy, StartError> {
    let mut watch = Watch {
        directory: directory.to_owned(),
        own_dead_ms: liveness.dead_ms,
        seen: None,
        presence: Presence::new(directory, liveness),
    };
    loop {
        let looked = tokio::task::spawn_blocking(move || (watch.look(), watch)).await;
        let look;
        (look, watch) = looked.map_err(|error| store::fault(directory, &error))?;
        match look.map_err(|error| store::fault(directory, &error))? {
            Look::Free(vacancy) => return Ok(vacancy),
            Look::Led => tokio::time::sleep(LOOK).await,
        }
    }
}

enum Look {
    Led,
    Free(Vacancy),
}

/// What a standby has seen of the leader.
struct Watch {
    directory: PathBuf,
    own_dead_ms: u64,
    seen: Option<Seen>,
    presence: Presence,
}

struct Seen {
    term: u64,
    text: String,
    since: Instant,
}

impl Watch {
    fn look(&mut self) -> io::Result<Look> {
        let term = TERMS.latest(&self.directory)?;
        if term == 0 {
            return Ok(Look::Free(Vacancy { term, silent: false }));
        }
        self.presence.show();
        let file = match File::open(TERMS.path(&self.directory, term)) {
            Ok(file) => file,
            // A successor has tidied up.
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Look::Led),
            Err(error) => return Err(error),
        };
        let text = text_of(&file)?;
        let content = Content::parse(&text);
        let seen = match self.seen.take() {
            Some(seen) if seen.term == term && seen.text == text => seen,
            seen => {
                if seen.is_none_or(|seen| seen.term != term) {
                    let leader = content.as_ref().map_or("another process", |content| &content.holder);
                    tracing::info!(term, leader, "standing by");
                }
                Seen { term, text, since: Instant::now() }
            }
        };
        let silent = seen.since.elapsed();
        self.seen = Some(seen);
        let dead_ms = content.as_ref().map_or(0, |content| content.dead_ms).max(self.own_dead_ms);
        // Of another system a lock says nothing that can be relied on.
        let here = content.is_some_and(|content| !content.boot.is_empty() && content.boot == *BOOT);
        if here && file.try_lock_shared().is_ok() {
            return Ok(Look::Free(Vacancy { term, silent: false }));
        }
        if silent >= Duration::from_millis(dead_ms) {
            tracing::warn!(term, ?silent, "the leader is silent");
            return Ok(Look::Free(Vacancy { term, silent: true }));
        }
        Ok(Look::Led)
    }
}

fn text_of(file: &File) -> io::Result<String> {
    let mut text = Vec::new();
    file.take(MAX_CONTENT_BYTES).read_to_end(&mut text)?;
    Ok(String::from_utf8_lossy(&text).into_owned())
}

/// What is in the file of a leader or a standby: of one length for as long as it lives.
struct Content {
    beat: u64,
    /// After how long a silence it counts as gone, in milliseconds.
    dead_ms: u64,
    boot: String,
    /// For people.
    holder: String,
}

impl Content {
    /// This process's.
    fn new(beat: u64, liveness: Liveness) -> Self {
        Self { beat, dead_ms: liveness.dead_ms, boot: BOOT.clone(), holder: HOLDER.clone() }
    }

    fn to_text(&self) -> String {
        let Self { beat, dead_ms, boot, holder } = self;
        format!("{beat:020} {dead_ms:020} {boot} {holder}\n")
    }

    fn parse(text: &str) -> Option<Self> {
        let mut words = text.strip_suffix('\n')?.splitn(4, ' ');
        let beat = words.next()?.parse().ok()?;
        let dead_ms = words.next()?.parse().ok()?;
        Some(Self { beat, dead_ms, boot: words.next()?.to_owned(), holder: words.next()?.to_owned() })
    }
}

fn line_of(file: &str) -> String {
    fs::read_to_string(file).unwrap_or_default().trim().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn soon() -> Liveness {
        Liveness { heartbeat_ms: 20, suspect_ms: 60, dead_ms: 200, ..Liveness::default() }
    }

    #[tokio::test]
    async fn a_standby_waits_for_the_leader_and_only_one_follows_it() {
        let directory = tempfile::tempdir().unwrap();
        assert_eq!(stand_by(directory.path(), soon()).await.unwrap(), Vacancy { term: 0, silent: false });
        let first = Lead::take(directory.path(), Some(0), soon()).unwrap();
        assert!(matches!(Lead::take(directory.path(), Some(0), soon()), Err(StartError::Outrun)));
        let waiting = stand_by(directory.path(), soon());
        tokio::pin!(waiting);
        let early = tokio::time::timeout(Duration::from_millis(600), &mut waiting).await;
        assert!(early.is_err(), "three times the silence that counts: it beats");
        first.serves();
        drop(first);
        let vacancy = waiting.await.unwrap();
        assert_eq!(vacancy, Vacancy { term: 1, silent: false });
        let second = Lead::take(directory.path(), Some(1), soon()).unwrap();
        assert!(
            matches!(Lead::take(directory.path(), Some(1), soon()), Err(StartError::Outrun)),
            "one follows"
        );
        second.serves();
        assert_eq!(TERMS.all(directory.path()).unwrap(), [2]);
        second.holds().unwrap();
    }

    #[test]
    fn a_term_that_never_served_is_taken_back_and_a_late_one_is_none() {
        let directory = tempfile::tempdir().unwrap();
        let first = Lead::take(directory.path(), None, soon()).unwrap();
        drop(Lead::take(directory.path(), Some(1), soon()).unwrap());
        assert_eq!(TERMS.all(directory.path()).unwrap(), [1]);
        first.holds().unwrap();
        let second = Lead::take(directory.path(), Some(1), soon()).unwrap();
        let third = Lead::take(directory.path(), Some(2), soon()).unwrap();
        third.serves();
        // Somebody who saw the first one end, and was stopped until now.
        assert!(matches!(Lead::take(directory.path(), Some(1), soon()), Err(StartError::Outrun)));
        assert_eq!(TERMS.all(directory.path()).unwrap(), [3]);
        third.holds().unwrap();
        drop(second);
        assert_eq!(TERMS.all(directory.path()).unwrap(), [3], "it takes nothing of others back");
    }

    #[tokio::test]
    async fn who_is_taken_over_commits_nothing_and_ends() {
        let directory = tempfile::tempdir().unwrap();
        let first = Lead::take(directory.path(), None, soon()).unwrap();
        let second = Lead::take(directory.path(), None, soon()).unwrap();
        assert!(first.holds().unwrap_err().contains("another coordinator"));
        second.holds().unwrap();
        first.over().await;
    }

    #[test]
    fn who_could_not_beat_commits_nothing() {
        let directory = tempfile::tempdir().unwrap();
        let hours = Liveness { heartbeat_ms: 3_600_000, ..soon() };
        let lead = Lead::take(directory.path(), None, hours).unwrap();
        lead.holds().unwrap();
        *lead.renewed.lock().unwrap() = Instant::now() - Duration::from_millis(151);
        assert!(lead.holds().unwrap_err().contains("could not write"));
    }

    #[tokio::test]
    async fn a_silent_leader_of_another_system_is_followed_after_its_own_patience() {
        let directory = tempfile::tempdir().unwrap();
        let content = Content {
            beat: 7,
            dead_ms: 400,
            boot: "another".to_owned(),
            holder: "process 1 of far".to_owned(),
        };
        let file = TERMS.path(directory.path(), 3);
        fs::write(&file, content.to_text()).unwrap();
        let silent = Vacancy { term: 3, silent: true };
        let began = Instant::now();
        assert_eq!(stand_by(directory.path(), soon()).await.unwrap(), silent);
        assert!(began.elapsed() >= Duration::from_millis(400), "nobody holds its lock, which says nothing");
        // A garbled one counts as silent, too.
        fs::write(&file, "\0\u{1}").unwrap();
        assert_eq!(stand_by(directory.path(), soon()).await.unwrap(), silent);
    }
}
