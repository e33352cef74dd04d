//! What a run does with a journal: results that an earlier process has taken are retrieved from it, those that this one takes go
//! into it. The files' part is `journal`'s.

use std::{sync::mpsc, time::Duration};

use bytes::Bytes;
use farm_core::id::{ContentHash, JobIndex, TaskId};
use proto::codec::content_hash;

use super::{RunEnd, RunEvent, Runner, dispatch::retrieve};
use crate::{
    driver::DriverHandle,
    error::FarmError,
    journal::{Journal, JournalError, JournalReader, JournalWriter, Place, Reports},
};

/// Bytes of results that are retrieved from the journal before events are looked at; one is, whatever its size.
const BYTES_PER_TURN: usize = 16 << 20;
/// Most results of one turn.
const RESULTS_PER_TURN: usize = 256;

/// A run's journal.
#[derive(Debug)]
pub(super) struct RunJournal {
    pub(super) reader: JournalReader,
    pub(super) writer: JournalWriter,
}

/// A dispatched job whose result is in the journal.
#[derive(Debug)]
pub(super) struct Replay {
    /// Its task.
    pub(super) at: usize,
    pub(super) index: JobIndex,
    pub(super) place: Place,
}

impl Runner {
    pub(super) fn open_journal(&mut self, journal: Option<Journal>) -> Result<(), FarmError> {
        let Some(journal) = journal else { return Ok(()) };
        let names: Vec<&str> = self.states.iter().map(|state| &*state.name).collect();
        let (reader, mut appendix) = journal.split(&names)?;
        // Its process is dead, or the journal would be locked: what it has at the nodes is in this run's way.
        if let Some(predecessor) = appendix.writer().filter(|writer| *writer != self.app) {
            self.driver.supersedes(predecessor)?;
        }
        appendix.sign(self.app)?;
        let reporter = Reporter { driver: self.driver.clone(), events: self.events_sender.clone() };
        let writer = JournalWriter::start(appendix, reporter)?;
        self.journal = Some(RunJournal { reader, writer });
        Ok(())
    }

    /// Waits until what was retrieved is in the journal.
    ///
    /// # Errors
    /// Some of it is not.
    pub(super) fn close_journal(&mut self) -> Result<(), FarmError> {
        let Some(journal) = self.journal.take() else { return Ok(()) };
        journal.writer.close();
        let failed = |event| match event {
            RunEvent::Ended(RunEnd::Farm(error @ FarmError::Journal(_))) => Some(error),
            RunEvent::Arrivals(_) | RunEvent::Returned(_) | RunEvent::Ended(_) => None,
        };
        self.events.try_iter().find_map(failed).map_or(Ok(()), Err)
    }

    /// Where the result of a job with this program is, if the journal has it; and the digest by which it will be found.
    pub(super) fn find_in_journal(
        journal: Option<&mut RunJournal>,
        task: &str,
        index: JobIndex,
        program: &[u8],
    ) -> Result<(Option<ContentHash>, Option<Place>), FarmError> {
        let Some(journal) = journal else { return Ok((None, None)) };
        let program = content_hash(program);
        Ok((Some(program), journal.reader.find(task, index, program)?))
    }

    /// Retrieves some of the results that are in the journal; gives whether there were any.
    pub(super) fn replay(&mut self) -> Result<bool, FarmError> {
        let (mut bytes, mut done, mut device_time) = (0, 0, Duration::ZERO);
        while bytes < BYTES_PER_TURN && done < RESULTS_PER_TURN {
            let Some(Replay { at, index, place }) = self.replays.pop_front() else { break };
            let journal = self.journal.as_ref().expect("what is replayed is in a journal");
            let result = journal.reader.read(place)?;
            bytes += result.sections.iter().map(Bytes::len).sum::<usize>();
            let job_time = result.device_time;
            let mut ended = self.take_out(at, index);
            let state = &mut self.states[at];
            retrieve(ended.job.as_mut(), result, &state.name, index)?;
            state.progress.jobs_done += 1;
            state.progress.device_time += job_time;
            device_time += job_time;
            done += 1;
        }
        let count = done as u64;
        if count > 0 {
            self.journalled += count;
            self.progress.send_modify(|progress| {
                progress.jobs_done += count;
                progress.jobs_journalled += count;
                progress.device_time += device_time;
            });
        }
        Ok(count > 0)
    }
}

/// Tells the driver and the run what became of results.
struct Reporter {
    driver: DriverHandle,
    events: mpsc::Sender<RunEvent>,
}

impl Reports for Reporter {
    fn kept(&mut self, jobs: Vec<(TaskId, JobIndex)>) {
        self.driver.kept(jobs);
    }

    fn failed(&mut self, error: JournalError) {
        // A run that is over does not listen.
        let _ = self.events.send(RunEvent::Ended(RunEnd::Farm(error.into())));
    }
}
