//! The child side of plug-ins: a process that loads one shared object and answers questions about it, one line of JSON
//! in, one out. `farm-coordinator policy-host PATH` runs it; `crate::plugins` talks to it.
//!
//! It ends when its stdin does, whatever the plug-in is doing: it never outlives the coordinator.

mod abi;
mod object;

use std::{
    fs::File,
    io::{self, BufRead, BufReader, Read as _, Write as _},
    path::Path,
    process::ExitCode,
    sync::mpsc,
    thread,
};

use farm_core::coordinator::policy::{Choice, Question};
use rustix::process::{Resource, Rlimit, setrlimit};
use serde::{Deserialize, Serialize};

use self::object::{PlaceError, PolicyObject};

/// Longest line of a question or an answer, in bytes: 4,096 jobs and 100,000 devices fit. A longer one ends the host.
pub(crate) const MAX_LINE_BYTES: u64 = 16 << 20;
/// Most memory that the process may map, in bytes.
const MAX_MAPPED_BYTES: u64 = 4 << 30;

/// Says that a plug-in is loaded: the first line of a host, or why it is not.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Loaded {
    /// What it says about itself.
    pub(crate) about: String,
}

/// The first line.
pub(crate) type Greeting = Result<Loaded, String>;
/// Every further line, each for one [`Question`].
pub(crate) type Answer = Result<Vec<Choice>, String>;

/// Serves the plug-in at `path` on stdin and stdout until stdin ends.
pub fn serve(path: &Path) -> ExitCode {
    match Pipes::take().and_then(|pipes| answer_all(path, pipes)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            complain(&error);
            ExitCode::FAILURE
        }
    }
}

/// Says what went wrong, to whoever still reads.
fn complain(error: &impl std::fmt::Display) {
    let _ = writeln!(io::stderr(), "policy host: {error}");
}

/// The coordinator's ends. The plug-in sees others: nothing on stdin, and a stdout that is stderr.
struct Pipes {
    questions: File,
    answers: File,
}

impl Pipes {
    fn take() -> io::Result<Self> {
        let questions = rustix::io::fcntl_dupfd_cloexec(io::stdin(), 3)?;
        let answers = rustix::io::fcntl_dupfd_cloexec(io::stdout(), 3)?;
        rustix::stdio::dup2_stdin(File::open("/dev/null")?)?;
        rustix::stdio::dup2_stdout(io::stderr())?;
        Ok(Self { questions: questions.into(), answers: answers.into() })
    }
}

fn answer_all(path: &Path, pipes: Pipes) -> io::Result<()> {
    let Pipes { questions, mut answers } = pipes;
    limit_resources()?;
    // One question is being answered, one is being read.
    let (lines, questions_read) = mpsc::sync_channel(0);
    thread::spawn(move || read_all(questions, &lines));
    let mut object = match PolicyObject::load(path) {
        Ok(object) => object,
        Err(reason) => return write_line(&mut answers, &Greeting::Err(reason)),
    };
    write_line(&mut answers, &Greeting::Ok(Loaded { about: object.about().to_owned() }))?;
    for line in questions_read {
        let question: Question = serde_json::from_slice(&line)?;
        let answer = object.place(&question);
        let broken = matches!(answer, Err(PlaceError::Overrun(_)));
        write_line(&mut answers, &answer.map_err(|error| error.to_string()))?;
        if broken {
            return Err(io::Error::other("the plug-in has overwritten this process's memory"));
        }
    }
    Ok(())
}

/// Reads questions, and ends the process when there will be no more: a plug-in that does not return cannot hold it up.
fn read_all(questions: File, lines: &mpsc::SyncSender<Vec<u8>>) {
    let mut questions = BufReader::new(questions);
    loop {
        match read_line(&mut questions) {
            Ok(Some(line)) => {
                if lines.send(line).is_err() {
                    // The other thread ends the process.
                    return;
                }
            }
            Ok(None) => break,
            Err(error) => {
                complain(&error);
                break;
            }
        }
    }
    // Not by exit: what a plug-in has registered to run then may not return either.
    let killed = rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::KILL);
    killed.expect("a process may kill itself");
}

/// The next line without its end; `None` when there is none.
fn read_line(from: &mut impl BufRead) -> io::Result<Option<Vec<u8>>> {
    let mut line = Vec::new();
    from.by_ref().take(MAX_LINE_BYTES).read_until(b'\n', &mut line)?;
    match line.pop() {
        None => Ok(None),
        Some(b'\n') => Ok(Some(line)),
        Some(_) => Err(io::Error::new(
            io::ErrorKind::InvalidData,
            format!("a question breaks off, or is longer than {MAX_LINE_BYTES} B"),
        )),
    }
}

fn write_line(answers: &mut File, line: &impl Serialize) -> io::Result<()> {
    let mut bytes = serde_json::to_vec(line)?;
    bytes.push(b'\n');
    answers.write_all(&bytes)
}

/// No core file for each crash, and no more memory than a policy can need.
fn limit_resources() -> io::Result<()> {
    let limit = |most| Rlimit { current: Some(most), maximum: Some(most) };
    setrlimit(Resource::Core, limit(0))?;
    setrlimit(Resource::As, limit(MAX_MAPPED_BYTES))?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_whole_and_bounded() {
        let mut text = &b"one\n\ntwo\nbroken"[..];
        assert_eq!(read_line(&mut text).unwrap().unwrap(), b"one");
        assert_eq!(read_line(&mut text).unwrap().unwrap(), b"");
        assert_eq!(read_line(&mut text).unwrap().unwrap(), b"two");
        assert!(read_line(&mut text).is_err(), "it has no end");
        assert_eq!(read_line(&mut text).unwrap(), None);
        let mut endless = BufReader::new(io::repeat(b'x'));
        assert!(read_line(&mut endless).is_err(), "a line without end ends at the bound");
    }
}
