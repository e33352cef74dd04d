//! The executor process itself: one device, orders in from the socket that is its standard input, news out on it.

use std::{
    io::{self, Read as _, Write as _},
    os::{
        fd::AsFd as _,
        unix::{net::UnixStream, process::parent_id},
    },
    path::PathBuf,
    process::ExitCode,
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use bytes::Bytes;
use farm_core::{
    id::{ContentHash, JobAttempt},
    message::JobFailure,
};
use gpu_exec::{Busy, DeviceSpec, Executor, ExecutorConfig, ExecutorEvent, Host, HungDevice, Order};

use super::{
    decode,
    mouth::Mouth,
    wire::{self, FromExecutor, Header as _, LENGTH_BYTES, ToExecutor},
};

/// How long a content may take from the worker's memory to here; longer means that the worker has stopped.
const CONTENT_WAIT: Duration = Duration::from_secs(60);
/// How long the end of the process may take, drivers' clean-up included.
const ENDING_LIMIT: Duration = Duration::from_secs(3);
/// Pause between two looks for the parent.
const PARENT_LOOKS: Duration = Duration::from_secs(1);
/// Exit code where there is no worker at the other end.
const EXIT_USAGE: u8 = 2;

/// Opens the device `spec`, with what its driver compiled before from the folder `compiled`, and runs jobs on it until the worker at the other end of standard input is gone.
pub(super) fn serve(spec: &str, compiled: Option<PathBuf>) -> ExitCode {
    let Ok(socket) = io::stdin().as_fd().try_clone_to_owned().map(UnixStream::from) else {
        return ExitCode::from(EXIT_USAGE);
    };
    let done = Line::new(socket).and_then(|line| run(spec, compiled, &Arc::new(line)));
    end_soon();
    match done {
        Ok(()) => ExitCode::SUCCESS,
        // The worker was gone before the device was open, or before it heard something.
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => ExitCode::SUCCESS,
        Err(error) => {
            // Whoever started this by hand reads it.
            let _ = writeln!(io::stderr(), "an executor is started by a worker: {error}");
            ExitCode::from(EXIT_USAGE)
        }
    }
}

fn run(spec: &str, compiled: Option<PathBuf>, line: &Arc<Line>) -> io::Result<()> {
    let config = ExecutorConfig { hung_device: HungDevice::Lost, compiled, ..ExecutorConfig::default() };
    let open = end_with_parent();
    let opened = spec.parse::<DeviceSpec>().map_err(|error| error.to_string()).and_then(|spec| {
        let host = Speaker(Arc::clone(line));
        Executor::start(&spec, config, host).map_err(|error| error.to_string())
    });
    open.store(true, Ordering::Relaxed);
    let executor = match opened {
        Ok(executor) => executor,
        Err(reason) => return line.mouth.say(&FromExecutor::Refused(reason)),
    };
    line.mouth.say(&FromExecutor::Opened(executor.info().clone()))?;
    loop {
        match line.hear() {
            Ok((header, payload)) => take(&executor, line, header, payload)?,
            // The worker is gone, and with it whoever wants a result.
            Err(_) => return Ok(()),
        }
    }
}

fn take(executor: &Executor, line: &Line, header: ToExecutor, payload: Bytes) -> io::Result<()> {
    match header {
        ToExecutor::Execute { job, class, limit, scope, .. } => {
            let failure = match decode(&payload, scope) {
                Ok(program) => {
                    let order = Order { job, class, program: Arc::new(program), contents: Vec::new(), limit };
                    match executor.submit(order) {
                        // A lost device is the end of this process; what had not begun is tried in the next one.
                        Ok(()) | Err(Busy::Lost { .. }) => None,
                        Err(full @ Busy::Full { .. }) => Some(JobFailure::DeviceLost(full.to_string())),
                    }
                }
                Err(error) => Some(JobFailure::InvalidProgram(error.to_string())),
            };
            match failure {
                Some(failure) => line.mouth.finished(job, 0, Err(failure)),
                None => Ok(()),
            }
        }
        ToExecutor::Abort(job) => {
            executor.abort(job);
            Ok(())
        }
        ToExecutor::Content { hash, size_bytes } => {
            // One that comes too late is wished for no more.
            if let Some(wish) = line.wish().as_mut().filter(|wish| wish.hash == hash) {
                wish.answer = Some(size_bytes.map(|_| payload));
                line.news.notify_all();
            }
            Ok(())
        }
    }
}

/// Until the device is open nobody reads the socket: a worker that ends meanwhile is noticed by its being the parent no more.
/// Ends when told that the device is open.
fn end_with_parent() -> Arc<AtomicBool> {
    let (open, parent) = (Arc::new(AtomicBool::new(false)), parent_id());
    let told = Arc::clone(&open);
    // Without a thread a driver that hangs keeps the process: no more than that.
    let _ = thread::Builder::new().spawn(move || {
        while !told.load(Ordering::Relaxed) {
            thread::sleep(PARENT_LOOKS);
            if parent_id() != parent {
                std::process::abort();
            }
        }
    });
    open
}

/// A driver that does not come to its end does not keep the process.
fn end_soon() {
    // Without a thread the end may take as long as the driver likes.
    let _ = thread::Builder::new().spawn(|| {
        thread::sleep(ENDING_LIMIT);
        std::process::abort();
    });
}

/// The socket to the worker.
struct Line {
    socket: UnixStream,
    mouth: Arc<Mouth>,
    /// The content that the device's thread waits for, in the middle of a job's preparation: hence a lock and a signal.
    wish: Mutex<Option<Wish>>,
    news: Condvar,
}

/// A content that was asked for.
struct Wish {
    hash: ContentHash,
    /// What came: the bytes, or that the worker has none.
    answer: Option<Option<Bytes>>,
}

/// What the device tells, and asks of, the worker.
struct Speaker(Arc<Line>);

impl Host for Speaker {
    fn event(&self, event: ExecutorEvent) {
        let mouth = &self.0.mouth;
        let told = match event {
            ExecutorEvent::Started { job } => mouth.say(&FromExecutor::Started(job)),
            ExecutorEvent::Yielded { job } => mouth.say(&FromExecutor::Yielded(job)),
            ExecutorEvent::Resumed { job } => mouth.say(&FromExecutor::Resumed(job)),
            ExecutorEvent::Finished { job, device_time_ns, outcome } => {
                mouth.finished(job, device_time_ns, outcome)
            }
            ExecutorEvent::Lost { reason } => mouth.say_last(&FromExecutor::Lost(reason)),
        };
        // A worker that is gone is noticed by the thread that reads.
        let _ = told;
    }

    fn preparing(&self, job: JobAttempt) {
        let _ = self.0.mouth.say(&FromExecutor::Preparing(job));
    }

    fn prepared(&self, job: JobAttempt) {
        let _ = self.0.mouth.say(&FromExecutor::Prepared(job));
    }

    fn content(&self, hash: &ContentHash) -> Option<Bytes> {
        *self.0.wish() = Some(Wish { hash: *hash, answer: None });
        self.0.mouth.say(&FromExecutor::Wants(*hash)).ok()?;
        let open = |wish: &mut Option<Wish>| wish.as_ref().is_some_and(|wish| wish.answer.is_none());
        let waited = self.0.news.wait_timeout_while(self.0.wish(), CONTENT_WAIT, open);
        let (mut wish, _) = waited.unwrap_or_else(PoisonError::into_inner);
        wish.take()?.answer.flatten()
    }
}

impl Line {
    fn new(socket: UnixStream) -> io::Result<Self> {
        let mouth = Mouth::open(socket.try_clone()?)?;
        Ok(Self { socket, mouth, wish: Mutex::default(), news: Condvar::new() })
    }

    fn hear(&self) -> io::Result<(ToExecutor, Bytes)> {
        let mut socket = &self.socket;
        let mut length = [0; LENGTH_BYTES];
        socket.read_exact(&mut length)?;
        let mut header = vec![0; wire::header_bytes(length).map_err(io::Error::other)?];
        socket.read_exact(&mut header)?;
        let header: ToExecutor = wire::decode(&header).map_err(io::Error::other)?;
        let payload_bytes = header.payload_bytes().map_err(io::Error::other)?;
        let mut payload = Vec::with_capacity(payload_bytes);
        socket.take(payload_bytes as u64).read_to_end(&mut payload)?;
        if payload.len() < payload_bytes {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        Ok((header, Bytes::from(payload)))
    }

    fn wish(&self) -> MutexGuard<'_, Option<Wish>> {
        self.wish.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
