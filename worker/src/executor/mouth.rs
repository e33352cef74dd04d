//! The writing side of an executor's socket. Small messages are written by whoever says them; a large result is digested
//! and written by a thread of its own, in parts, and the device goes on meanwhile. What is said in that time is written between
//! two parts: the worker knows at any time which job the device is at.

use std::{
    collections::VecDeque,
    io::{self, Write as _},
    os::unix::net::UnixStream,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread,
};

use bytes::Bytes;
use farm_core::{
    id::{ContentHash, JobAttempt},
    message::JobFailure,
};

use super::wire::{self, FromExecutor, Output};
use crate::device::{Payload, size_of};

/// A result of this many bytes is large: writing it takes about as long as waking a thread does a hundred times.
const LARGE_BYTES: u64 = 1 << 20;
/// Bytes of large results that wait, at most, apart from one; whoever brings more waits.
const MAX_WAITING_BYTES: u64 = 512 << 20;

/// Bytes of a part: written in about a millisecond.
const PART_BYTES: usize = 4 << 20;

/// Says things: large results in the order in which they come, everything else at once.
pub(super) struct Mouth {
    socket: UnixStream,
    /// A lock and a signal: the device's thread, the reading one and the writing one meet here, none of them async.
    outgoing: Mutex<Outgoing>,
    changed: Condvar,
}

#[derive(Default)]
struct Outgoing {
    /// The thread writes: nobody else may.
    writing: bool,
    /// For the next gap between two parts.
    messages: VecDeque<Vec<u8>>,
    results: VecDeque<Large>,
    waiting_bytes: u64,
    /// The last word, for when all results are written.
    last: Option<Vec<u8>>,
}

/// A large result.
struct Large {
    job: JobAttempt,
    device_time_ns: u64,
    sections: Vec<Bytes>,
}

impl Mouth {
    /// A mouth, and its thread.
    ///
    /// # Errors
    /// There is no thread to be had.
    pub(super) fn open(socket: UnixStream) -> io::Result<Arc<Self>> {
        let mouth = Arc::new(Self { socket, outgoing: Mutex::default(), changed: Condvar::new() });
        let writer = Arc::clone(&mouth);
        thread::Builder::new().name("results".to_owned()).spawn(move || writer.write_results())?;
        Ok(mouth)
    }

    /// Says how a job ended.
    ///
    /// # Errors
    /// The worker is gone.
    pub(super) fn finished(
        &self,
        job: JobAttempt,
        device_time_ns: u64,
        outcome: Result<Vec<Bytes>, JobFailure>,
    ) -> io::Result<()> {
        match outcome {
            Ok(sections) if size_of(&sections) >= LARGE_BYTES => {
                self.say(&FromExecutor::Ended(job))?;
                let mut outgoing = self.outgoing();
                while outgoing.waiting_bytes > MAX_WAITING_BYTES {
                    outgoing = self.changed.wait(outgoing).unwrap_or_else(PoisonError::into_inner);
                }
                outgoing.waiting_bytes += size_of(&sections);
                outgoing.results.push_back(Large { job, device_time_ns, sections });
                outgoing.writing = true;
                self.changed.notify_all();
                Ok(())
            }
            Ok(sections) => {
                let Payload { sections, digest } = Payload::of(sections);
                self.say_all(finished(job, device_time_ns, &sections, digest, false), &sections)
            }
            Err(failure) => self.say(&FromExecutor::Finished { job, device_time_ns, outcome: Err(failure) }),
        }
    }

    /// Says something without a payload.
    ///
    /// # Errors
    /// The worker is gone.
    pub(super) fn say(&self, message: &FromExecutor) -> io::Result<()> {
        self.say_all(wire::encode(message), &[])
    }

    /// Says something after which nobody listens any more.
    ///
    /// # Errors
    /// The worker is gone.
    pub(super) fn say_last(&self, message: &FromExecutor) -> io::Result<()> {
        let message = wire::encode(message);
        let mut outgoing = self.outgoing();
        if outgoing.writing {
            outgoing.last = Some(message);
            return Ok(());
        }
        self.write(&message, &[])
    }

    fn say_all(&self, header: Vec<u8>, payload: &[Bytes]) -> io::Result<()> {
        let mut outgoing = self.outgoing();
        if outgoing.writing {
            let mut message = header;
            payload.iter().for_each(|part| message.extend_from_slice(part));
            outgoing.messages.push_back(message);
            return Ok(());
        }
        self.write(&header, payload)
    }

    /// Writes results as they come, until the worker is gone: then so is whoever could hear of them.
    fn write_results(&self) {
        while let Some(result) = self.next_result() {
            let size_bytes = size_of(&result.sections);
            if self.write_in_parts(result).is_err() {
                return;
            }
            self.outgoing().waiting_bytes -= size_bytes;
            self.changed.notify_all();
        }
    }

    /// Waits for a result, with everything else written before; `None` if the worker is gone.
    fn next_result(&self) -> Option<Large> {
        let mut outgoing = self.outgoing();
        loop {
            while let Some(message) = outgoing.messages.pop_front() {
                self.write(&message, &[]).ok()?;
            }
            match outgoing.results.pop_front() {
                Some(result) => return Some(result),
                None => outgoing.writing = false,
            }
            if let Some(last) = outgoing.last.take() {
                self.write(&last, &[]).ok()?;
            }
            outgoing = self.changed.wait(outgoing).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn write_in_parts(&self, Large { job, device_time_ns, sections }: Large) -> io::Result<()> {
        let of = size_of(&sections);
        let mut digest = blake3::Hasher::new();
        for part in sections.iter().flat_map(|section| section.chunks(PART_BYTES)) {
            self.write_messages()?;
            let mut socket = &self.socket;
            socket.write_all(&wire::encode(&FromExecutor::Part { bytes: part.len() as u64, of }))?;
            socket.write_all(part)?;
            digest.update(part);
        }
        let digest = ContentHash(*digest.finalize().as_bytes());
        self.write(&finished(job, device_time_ns, &sections, digest, true), &[])
    }

    fn write_messages(&self) -> io::Result<()> {
        let messages = std::mem::take(&mut self.outgoing().messages);
        messages.iter().try_for_each(|message| self.write(message, &[]))
    }

    fn write(&self, header: &[u8], payload: &[Bytes]) -> io::Result<()> {
        let mut socket = &self.socket;
        socket.write_all(header)?;
        payload.iter().try_for_each(|part| socket.write_all(part))
    }

    fn outgoing(&self) -> MutexGuard<'_, Outgoing> {
        self.outgoing.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A completed job's header.
fn finished(
    job: JobAttempt,
    device_time_ns: u64,
    sections: &[Bytes],
    digest: ContentHash,
    in_parts: bool,
) -> Vec<u8> {
    let sections = sections.iter().map(|section| section.len() as u64).collect();
    let outcome = Ok(Output { sections, in_parts, digest });
    wire::encode(&FromExecutor::Finished { job, device_time_ns, outcome })
}
