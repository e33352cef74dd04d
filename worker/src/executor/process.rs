//! One executor process as its supervisor sees it: its start, what it says, its end.

use std::{
    os::{fd::OwnedFd, unix::net::UnixStream as StdStream, unix::process::ExitStatusExt as _},
    process::Stdio,
    time::Duration,
};

use bytes::{Bytes, BytesMut};
use farm_core::device::DeviceInfo;
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::{
        UnixStream,
        unix::{OwnedReadHalf, OwnedWriteHalf},
    },
    process::{Child, Command},
    sync::mpsc,
    time::timeout,
};

use super::{
    Launch, Order, ROLE,
    wire::{self, FromExecutor, Header, LENGTH_BYTES, ToExecutor},
};

/// How long a process may take to open and measure its device.
const OPENING_LIMIT: Duration = Duration::from_secs(60);
/// How long the end of a process that was killed, or closed its socket, may take.
const ENDING_LIMIT: Duration = Duration::from_secs(5);
/// Messages of the process that wait for the supervisor; the process waits when there are more.
const QUEUED_MESSAGES: usize = 16;

/// Why a device is not open; the texts are for people.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum NotOpen {
    /// It is not there, or the driver does not give it.
    Refused(String),
    /// The process ended before it could say.
    Ended(String),
}

impl NotOpen {
    pub(super) fn reason(self) -> String {
        match self {
            Self::Refused(reason) | Self::Ended(reason) => reason,
        }
    }
}

/// What the reader brings: a message with its payload, or why there is none any more.
type Said = Result<(FromExecutor, Bytes), String>;

/// A running process. Dropping it kills it.
#[derive(Debug)]
pub(super) struct Process {
    child: Child,
    said: mpsc::Receiver<Said>,
    /// Unbounded for the supervisor, which must not wait for a process that does not read: at most the jobs of one device,
    /// their aborts, and one content, since the device asks for one at a time.
    outbox: mpsc::UnboundedSender<(Vec<u8>, Option<Bytes>)>,
}

impl Process {
    /// Starts a process and waits until its device is open.
    ///
    /// # Errors
    /// It does not start, or the device does not open in time.
    pub(super) async fn start(launch: &Launch) -> Result<(Self, DeviceInfo), NotOpen> {
        let failed = |error: std::io::Error| {
            NotOpen::Ended(format!("no executor process for `--device {}`: {error}", launch.spec))
        };
        let (ours, theirs) = StdStream::pair().map_err(failed)?;
        ours.set_nonblocking(true).map_err(failed)?;
        let child = Command::new(&launch.program)
            .arg0("farm-worker")
            .arg(ROLE)
            .arg(launch.spec.to_string())
            .args(&launch.compiled)
            .stdin(Stdio::from(OwnedFd::from(theirs)))
            .stdout(Stdio::null())
            // A Ctrl-C at the terminal is for the daemon, which drains.
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
            .map_err(failed)?;
        let (reads, writes) = UnixStream::from_std(ours).map_err(failed)?.into_split();
        let (saying, said) = mpsc::channel(QUEUED_MESSAGES);
        let (outbox, outgoing) = mpsc::unbounded_channel();
        // Both end with the process.
        tokio::spawn(read(reads, saying));
        tokio::spawn(write(writes, outgoing));
        let mut process = Self { child, said, outbox };
        let greeting = timeout(OPENING_LIMIT, process.said()).await;
        let refusal = match greeting {
            Ok(Ok((FromExecutor::Opened(info), _))) => return Ok((process, info)),
            Ok(Ok((FromExecutor::Refused(reason), _))) => NotOpen::Refused(reason),
            Ok(Ok((other, _))) => NotOpen::Ended(format!("the executor began with {other:?}")),
            Ok(Err(error)) => {
                let ended = process.ended().await;
                NotOpen::Ended(format!("the executor of `--device {}` {ended}; {error}", launch.spec))
            }
            Err(_) => {
                NotOpen::Ended(format!("`--device {}` was not open within {OPENING_LIMIT:?}", launch.spec))
            }
        };
        process.kill().await;
        Err(refusal)
    }

    /// The next thing it says. Cancel-safe. After an error the process is of no more use.
    pub(super) async fn said(&mut self) -> Said {
        self.said.recv().await.unwrap_or_else(|| Err("its socket is closed".to_owned()))
    }

    pub(super) fn execute(&self, order: &Order) {
        let Order { job, class, program, limit } = order;
        let (scope, program_bytes) = (program.scope, program.bytes.len() as u64);
        let header = ToExecutor::Execute { job: *job, class: *class, limit: *limit, scope, program_bytes };
        self.send(&header, Some(program.bytes.clone()));
    }

    /// Puts a message on its way. A process that is gone says so by itself.
    pub(super) fn send(&self, header: &ToExecutor, payload: Option<Bytes>) {
        let _ = self.outbox.send((wire::encode(header), payload));
    }

    /// Waits until a process that broke off has ended, and says how.
    pub(super) async fn ended(&mut self) -> String {
        match timeout(ENDING_LIMIT, self.child.wait()).await {
            Ok(Ok(status)) => match (status.signal(), status.code()) {
                (Some(signal), _) => format!("was ended by signal {signal}"),
                (None, code) => format!("ended with exit code {}", code.unwrap_or_default()),
            },
            Ok(Err(error)) => format!("has ended, nobody can say how: {error}"),
            Err(_) => "broke off".to_owned(),
        }
    }

    /// Ends it. One that the system cannot end in time is left to the system.
    pub(super) async fn kill(&mut self) {
        if self.child.start_kill().is_ok() && timeout(ENDING_LIMIT, self.child.wait()).await.is_err() {
            tracing::error!(
                pid = self.child.id(),
                "an executor process cannot be killed: its driver holds it"
            );
        }
    }
}

async fn read(mut stream: OwnedReadHalf, said: mpsc::Sender<Said>) {
    let mut parts = BytesMut::new();
    loop {
        let message = read_message(&mut stream, &mut parts).await;
        let over = message.is_err();
        if said.send(message).await.is_err() || over {
            return;
        }
    }
}

/// The next message, with its payload. Of a result in parts what has come is in `parts`.
async fn read_message(stream: &mut OwnedReadHalf, parts: &mut BytesMut) -> Said {
    loop {
        let header = read_header(stream).await?;
        let payload_bytes = header.payload_bytes()?;
        match &header {
            FromExecutor::Part { of, .. } => {
                let all = usize::try_from(*of).map_err(|error| error.to_string())?;
                if parts.len() + payload_bytes > all {
                    return Err(format!("more parts came than {all} B"));
                }
                parts.reserve(all - parts.len());
                read_payload(stream, parts, payload_bytes).await?;
            }
            FromExecutor::Finished { outcome: Ok(output), .. } if output.in_parts => {
                let payload = std::mem::take(parts).freeze();
                if payload.len() != output.bytes()? {
                    return Err(format!("{} B came in parts of {:?} B", payload.len(), output.sections));
                }
                return Ok((header, payload));
            }
            _ => {
                let mut payload = BytesMut::with_capacity(payload_bytes);
                read_payload(stream, &mut payload, payload_bytes).await?;
                return Ok((header, payload.freeze()));
            }
        }
    }
}

async fn read_header(stream: &mut OwnedReadHalf) -> Result<FromExecutor, String> {
    let broken = |error: std::io::Error| error.to_string();
    let mut length = [0; LENGTH_BYTES];
    stream.read_exact(&mut length).await.map_err(broken)?;
    let mut header = vec![0; wire::header_bytes(length)?];
    stream.read_exact(&mut header).await.map_err(broken)?;
    wire::decode(&header)
}

async fn read_payload(stream: &mut OwnedReadHalf, into: &mut BytesMut, bytes: usize) -> Result<(), String> {
    let end = into.len() + bytes;
    let mut rest = stream.take(bytes as u64);
    while into.len() < end {
        if rest.read_buf(into).await.map_err(|error| error.to_string())? == 0 {
            return Err("it broke off inside a result".to_owned());
        }
    }
    Ok(())
}

async fn write(mut stream: OwnedWriteHalf, mut outgoing: mpsc::UnboundedReceiver<(Vec<u8>, Option<Bytes>)>) {
    while let Some((header, payload)) = outgoing.recv().await {
        let written = async {
            stream.write_all(&header).await?;
            stream.write_all(payload.as_deref().unwrap_or_default()).await
        };
        // The reader hears of a broken socket, too.
        if written.await.is_err() {
            return;
        }
    }
}
