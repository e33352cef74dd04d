//! Where sockets come from: the operating system, or a network that a test simulates in its place. Both planes open theirs here
//! and nowhere else.
//!
//! It is a property of the thread, looked at once for each socket that is opened: a farm without a simulation pays nothing for it,
//! and no option, message or signature knows of it.

use std::{
    cell::RefCell,
    fmt, io,
    marker::PhantomData,
    net::SocketAddr,
    pin::Pin,
    rc::Rc,
    sync::Arc,
    task::{Context, Poll},
};

use quinn::{AsyncUdpSocket, Runtime as _, TokioRuntime};
use socket2::{Domain, Protocol, Socket, Type};
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    net,
};

/// What is asked of the system for each socket's buffers; it may give less (`net.core.rmem_max`).
const SOCKET_BUFFER_BYTES: usize = 4 << 20;

/// A network that a test simulates.
pub trait Network {
    /// Listens for connections (port 0: the network chooses).
    ///
    /// # Errors
    /// The address cannot be had.
    fn listen(&self, address: SocketAddr) -> io::Result<Box<dyn Listener>>;
    /// Connects to `HOST:PORT`.
    fn connect(&self, address: &str) -> Promised<'static, Box<dyn Connection>>;
    /// Opens a socket for datagrams (port 0: the network chooses).
    ///
    /// # Errors
    /// The address cannot be had.
    fn datagrams(&self, address: SocketAddr) -> io::Result<Arc<dyn AsyncUdpSocket>>;
}

/// The simulated end that is connected to.
pub trait Listener: Send + Sync {
    /// The next connection and who connects.
    fn accept(&self) -> Promised<'_, (Box<dyn Connection>, SocketAddr)>;
    /// Where it listens.
    ///
    /// # Errors
    /// The network does not know.
    fn local_addr(&self) -> io::Result<SocketAddr>;
}

/// A simulated connection.
pub trait Connection: AsyncRead + AsyncWrite + Send + Sync + Unpin {
    /// Reads and leaves what was read; zero bytes: the peer has ended it.
    fn poll_peek(&mut self, context: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<usize>>;
}

/// What a simulated network will give.
pub type Promised<'a, T> = Pin<Box<dyn Future<Output = io::Result<T>> + Send + 'a>>;

thread_local! {
    static SIMULATED: RefCell<Option<Rc<dyn Network>>> = const { RefCell::new(None) };
}

/// Lets every socket that this thread opens be one of `network`, until what this gives is dropped.
///
/// # Panics
/// The thread has a simulated network already.
#[must_use = "the simulation ends when this is dropped"]
pub fn simulate(network: Rc<dyn Network>) -> Simulation {
    let earlier = SIMULATED.replace(Some(network));
    assert!(earlier.is_none(), "one simulated network a thread");
    Simulation { thread: PhantomData }
}

/// As long as it lives, its thread has a simulated network.
#[derive(Debug)]
pub struct Simulation {
    thread: PhantomData<Rc<()>>,
}

impl Drop for Simulation {
    fn drop(&mut self) {
        SIMULATED.set(None);
    }
}

fn simulated() -> Option<Rc<dyn Network>> {
    SIMULATED.with_borrow(Option::clone)
}

/// Opens a UDP socket (port 0: the system chooses) for QUIC. Needs a tokio runtime.
pub(crate) fn datagrams(address: SocketAddr) -> io::Result<Arc<dyn AsyncUdpSocket>> {
    if let Some(network) = simulated() {
        return network.datagrams(address);
    }
    let socket = Socket::new(Domain::for_address(address), Type::DGRAM, Some(Protocol::UDP))?;
    for outcome in
        [socket.set_recv_buffer_size(SOCKET_BUFFER_BYTES), socket.set_send_buffer_size(SOCKET_BUFFER_BYTES)]
    {
        // Smaller buffers only cost speed.
        if let Err(error) = outcome {
            tracing::debug!(%error, "the system keeps its default socket buffers");
        }
    }
    socket.bind(&address.into())?;
    TokioRuntime.wrap_udp_socket(socket.into())
}

/// The end of TCP that is connected to.
pub struct TcpListener(Listening);

enum Listening {
    System(net::TcpListener),
    Simulated(Box<dyn Listener>),
}

impl TcpListener {
    /// Listens (port 0: the system chooses). Needs a tokio runtime.
    ///
    /// # Errors
    /// The address cannot be had.
    pub async fn bind(address: SocketAddr) -> io::Result<Self> {
        Ok(Self(match simulated() {
            None => Listening::System(net::TcpListener::bind(address).await?),
            Some(network) => Listening::Simulated(network.listen(address)?),
        }))
    }

    /// Where it listens.
    ///
    /// # Errors
    /// The system does not know.
    pub fn local_addr(&self) -> io::Result<SocketAddr> {
        match &self.0 {
            Listening::System(listener) => listener.local_addr(),
            Listening::Simulated(listener) => listener.local_addr(),
        }
    }

    /// The next connection and who connects.
    pub(crate) async fn accept(&self) -> io::Result<(TcpStream, SocketAddr)> {
        match &self.0 {
            Listening::System(listener) => {
                let (stream, peer) = listener.accept().await?;
                Ok((TcpStream(Carrier::System(stream)), peer))
            }
            Listening::Simulated(listener) => {
                let (stream, peer) = listener.accept().await?;
                Ok((TcpStream(Carrier::Simulated(stream)), peer))
            }
        }
    }
}

impl fmt::Debug for TcpListener {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("TcpListener").field(&self.local_addr()).finish()
    }
}

/// A TCP connection.
pub(crate) struct TcpStream(Carrier);

enum Carrier {
    System(net::TcpStream),
    Simulated(Box<dyn Connection>),
}

impl TcpStream {
    /// Connects to `HOST:PORT`, without Nagle's delay from then on.
    pub(crate) async fn connect(address: &str) -> io::Result<Self> {
        // Not across an await: whoever connects may move to another thread.
        let simulated = simulated().map(|network| network.connect(address));
        let stream = Self(match simulated {
            None => Carrier::System(net::TcpStream::connect(address).await?),
            Some(connecting) => Carrier::Simulated(connecting.await?),
        });
        stream.set_nodelay()?;
        Ok(stream)
    }

    pub(crate) fn set_nodelay(&self) -> io::Result<()> {
        match &self.0 {
            Carrier::System(stream) => stream.set_nodelay(true),
            Carrier::Simulated(_) => Ok(()),
        }
    }

    /// Reads and leaves what was read; zero bytes: the peer has ended it.
    pub(crate) async fn peek(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match &mut self.0 {
            Carrier::System(stream) => stream.peek(buffer).await,
            Carrier::Simulated(stream) => {
                let mut buffer = ReadBuf::new(buffer);
                std::future::poll_fn(|context| stream.poll_peek(context, &mut buffer)).await
            }
        }
    }
}

impl fmt::Debug for TcpStream {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("TcpStream")
    }
}

impl AsyncRead for TcpStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        match &mut self.0 {
            Carrier::System(stream) => Pin::new(stream).poll_read(context, buffer),
            Carrier::Simulated(stream) => Pin::new(stream).poll_read(context, buffer),
        }
    }
}

impl AsyncWrite for TcpStream {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        match &mut self.0 {
            Carrier::System(stream) => Pin::new(stream).poll_write(context, bytes),
            Carrier::Simulated(stream) => Pin::new(stream).poll_write(context, bytes),
        }
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        match &mut self.0 {
            Carrier::System(stream) => Pin::new(stream).poll_write_vectored(context, slices),
            Carrier::Simulated(stream) => Pin::new(stream).poll_write_vectored(context, slices),
        }
    }

    fn is_write_vectored(&self) -> bool {
        match &self.0 {
            Carrier::System(stream) => stream.is_write_vectored(),
            Carrier::Simulated(stream) => stream.is_write_vectored(),
        }
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.0 {
            Carrier::System(stream) => Pin::new(stream).poll_flush(context),
            Carrier::Simulated(stream) => Pin::new(stream).poll_flush(context),
        }
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.0 {
            Carrier::System(stream) => Pin::new(stream).poll_shutdown(context),
            Carrier::Simulated(stream) => Pin::new(stream).poll_shutdown(context),
        }
    }
}
