//! The bytes under gRPC: a TCP connection, in a secured farm under TLS, and who is at its other end.

use std::{
    io,
    net::SocketAddr,
    pin::Pin,
    task::{Context, Poll},
    time::Duration,
};

use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    sync::OwnedSemaphorePermit,
    time::{self, Instant, Sleep},
};
use tokio_rustls::server::TlsStream;
use tonic::transport::server::Connected;

use crate::{net::TcpStream, tls, trust::Member};

/// Who is at the other end of a connection; in every request's extensions.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Caller {
    /// Where from.
    pub address: SocketAddr,
    /// Whether the connection is under TLS.
    pub encrypted: bool,
    /// The member whose certificate was shown, and checked; `None` for a stranger, and wherever nobody is asked.
    pub member: Option<Member>,
}

/// An accepted connection. It ends with an error where its peer is silent for too long.
#[derive(Debug)]
pub struct ControlStream {
    caller: Caller,
    transport: Transport,
    silence: Silence,
    /// Of the connections that its listener may have.
    _place: OwnedSemaphorePermit,
}

/// How long a peer may be silent from now on.
#[derive(Debug)]
pub(super) enum Silence {
    /// Until it has said as much as makes a connection.
    Opening { ends: Pin<Box<Sleep>>, missing_bytes: usize },
    /// Between two bytes in either direction.
    Idle { ends: Pin<Box<Sleep>>, most: Duration },
    /// For ever: the protocol's pings find out.
    Allowed,
}

impl Silence {
    pub(super) fn opening(patience: Duration, missing_bytes: usize) -> Self {
        Self::Opening { ends: Box::pin(time::sleep(patience)), missing_bytes }
    }

    pub(super) fn idle(most: Duration) -> Self {
        Self::Idle { ends: Box::pin(time::sleep(most)), most }
    }

    /// Bytes came, or went.
    pub(super) fn broken(&mut self, came: usize, went: usize) {
        match self {
            Self::Opening { missing_bytes, .. } if came >= *missing_bytes => *self = Self::Allowed,
            Self::Opening { missing_bytes, .. } => *missing_bytes -= came,
            Self::Idle { ends, most } if came + went > 0 => ends.as_mut().reset(Instant::now() + *most),
            Self::Idle { .. } | Self::Allowed => {}
        }
    }

    /// An error once it has lasted too long; wakes then.
    pub(super) fn poll_end(&mut self, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let (Self::Opening { ends, .. } | Self::Idle { ends, .. }) = self else { return Poll::Pending };
        ends.as_mut()
            .poll(context)
            .map(|()| Err(io::Error::new(io::ErrorKind::TimedOut, "the peer is silent")))
    }
}

#[derive(Debug)]
enum Transport {
    Plain(TcpStream),
    Tls(Box<TlsStream<TcpStream>>),
}

impl ControlStream {
    pub(super) fn plain(
        stream: TcpStream,
        address: SocketAddr,
        silence: Silence,
        place: OwnedSemaphorePermit,
    ) -> Self {
        let caller = Caller { address, encrypted: false, member: None };
        Self { caller, transport: Transport::Plain(stream), silence, _place: place }
    }

    pub(super) fn tls(
        stream: TlsStream<TcpStream>,
        address: SocketAddr,
        silence: Silence,
        place: OwnedSemaphorePermit,
    ) -> Self {
        let member = tls::member(stream.get_ref().1.peer_certificates());
        let caller = Caller { address, encrypted: true, member };
        Self { caller, transport: Transport::Tls(Box::new(stream)), silence, _place: place }
    }
}

impl ControlStream {
    fn wrote(&mut self, written: Poll<io::Result<usize>>) -> Poll<io::Result<usize>> {
        if let Poll::Ready(Ok(bytes)) = &written {
            self.silence.broken(0, *bytes);
        }
        written
    }
}

impl Connected for ControlStream {
    type ConnectInfo = Caller;

    fn connect_info(&self) -> Caller {
        self.caller.clone()
    }
}

impl AsyncRead for ControlStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        let read = match &mut self.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_read(context, buffer),
            Transport::Tls(stream) => Pin::new(stream).poll_read(context, buffer),
        };
        if read.is_pending() {
            return self.silence.poll_end(context);
        }
        self.silence.broken(buffer.filled().len() - before, 0);
        read
    }
}

impl AsyncWrite for ControlStream {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = match &mut self.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_write(context, bytes),
            Transport::Tls(stream) => Pin::new(stream).poll_write(context, bytes),
        };
        self.wrote(written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = match &mut self.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_write_vectored(context, slices),
            Transport::Tls(stream) => Pin::new(stream).poll_write_vectored(context, slices),
        };
        self.wrote(written)
    }

    fn is_write_vectored(&self) -> bool {
        match &self.transport {
            Transport::Plain(stream) => stream.is_write_vectored(),
            Transport::Tls(stream) => stream.is_write_vectored(),
        }
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_flush(context),
            Transport::Tls(stream) => Pin::new(stream).poll_flush(context),
        }
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_shutdown(context),
            Transport::Tls(stream) => Pin::new(stream).poll_shutdown(context),
        }
    }
}
