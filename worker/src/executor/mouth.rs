//! The writing side of an executor's socket. Small messages are written by whoever says them; a large result is digested
//! and written by a thread of its own, and the device goes on meanwhile. What is said in that time waits behind it.

use std::{
    collections::VecDeque,
    io::{self, Write as _},
    os::unix::net::UnixStream,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread,
};

use bytes::Bytes;
use farm_core::{id::JobAttempt, message::JobFailure};

use super::wire::{self, FromExecutor, Output};
use crate::device::{Payload, size_of};

/// A result of this many bytes is large: writing it takes about as long as waking a thread does a hundred times.
const LARGE_BYTES: u64 = 1 << 20;
/// Bytes of large results that wait, at most, apart from one; whoever brings more waits.
const MAX_WAITING_BYTES: u64 = 512 << 20;

/// Says things in the order in which they come.
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
    waiting: VecDeque<Said>,
    waiting_bytes: u64,
}

enum Said {
    Message(Vec<u8>),
    Result { job: JobAttempt, device_time_ns: u64, sections: Vec<Bytes> },
}

impl Mouth {
    /// A mouth, and its thread.
    ///
    /// # Errors
    /// There is no thread to be had.
    pub(super) fn open(socket: UnixStream) -> io::Result<Arc<Self>> {
        let mouth = Arc::new(Self { socket, outgoing: Mutex::default(), changed: Condvar::new() });
        let writer = Arc::clone(&mouth);
        thread::Builder::new().name("results".to_owned()).spawn(move || writer.write_waiting())?;
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
                let mut outgoing = self.outgoing();
                while outgoing.waiting_bytes > MAX_WAITING_BYTES {
                    outgoing = self.changed.wait(outgoing).unwrap_or_else(PoisonError::into_inner);
                }
                outgoing.waiting_bytes += size_of(&sections);
                outgoing.waiting.push_back(Said::Result { job, device_time_ns, sections });
                outgoing.writing = true;
                self.changed.notify_all();
                Ok(())
            }
            Ok(sections) => {
                let (header, sections) = result(job, device_time_ns, sections);
                self.say_all(header, &sections)
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

    fn say_all(&self, header: Vec<u8>, payload: &[Bytes]) -> io::Result<()> {
        let mut outgoing = self.outgoing();
        if outgoing.writing {
            let mut message = header;
            payload.iter().for_each(|part| message.extend_from_slice(part));
            outgoing.waiting.push_back(Said::Message(message));
            return Ok(());
        }
        self.write(&header, payload)
    }

    /// Writes what waits, until the worker is gone: then so is whoever could hear it.
    fn write_waiting(&self) {
        loop {
            let next = {
                let mut outgoing = self.outgoing();
                loop {
                    match outgoing.waiting.pop_front() {
                        Some(next) => break next,
                        None => outgoing.writing = false,
                    }
                    outgoing = self.changed.wait(outgoing).unwrap_or_else(PoisonError::into_inner);
                }
            };
            let (written, result_bytes) = match next {
                Said::Message(message) => (self.write(&message, &[]), 0),
                Said::Result { job, device_time_ns, sections } => {
                    let (header, sections) = result(job, device_time_ns, sections);
                    (self.write(&header, &sections), size_of(&sections))
                }
            };
            if written.is_err() {
                return;
            }
            self.outgoing().waiting_bytes -= result_bytes;
            self.changed.notify_all();
        }
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

/// A completed job's header as it is written, and its payload.
fn result(job: JobAttempt, device_time_ns: u64, sections: Vec<Bytes>) -> (Vec<u8>, Vec<Bytes>) {
    let Payload { sections, digest } = Payload::of(sections);
    let lengths = sections.iter().map(|section| section.len() as u64).collect();
    let outcome = Ok(Output { sections: lengths, digest });
    (wire::encode(&FromExecutor::Finished { job, device_time_ns, outcome }), sections)
}
