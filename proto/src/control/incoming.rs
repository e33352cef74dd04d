//! Accepted TCP connections of a listener, each once its peer has begun to speak, and, in a secured farm, has shown who it is: a
//! crowd of silent ones costs a descriptor each for some seconds, and running out of descriptors costs no spinning.

use std::{
    io,
    net::SocketAddr,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::Duration,
};

use tokio::{
    sync::{OwnedSemaphorePermit, Semaphore, mpsc},
    time,
};
use tokio_rustls::TlsAcceptor;
use tokio_stream::Stream;

use super::stream::{ControlStream, Silence};
use crate::{
    net::{TcpListener, TcpStream},
    tls::{self, TlsError},
    trust::Identity,
};

/// How long an accepted connection may be silent before its first byte, and how long its TLS handshake may take.
const FIRST_BYTE_TIMEOUT: Duration = Duration::from_secs(10);
/// What every HTTP/2 client says first: its preface and the head of a frame, in bytes. It has as long for that as for the first one.
const HTTP2_OPENING_BYTES: usize = 24 + 9;
/// How long a connection of HTTP/1, which has no pings, may be without a byte in either direction.
const HTTP1_IDLE: Duration = Duration::from_secs(30);
/// Connections of one listener at a time; further ones wait in the system's queue. For nodes and applications, and for browsers:
/// neither takes the other's descriptors.
const MAX_GRPC_CONNECTIONS: usize = 16_384;
const MAX_HTTP_CONNECTIONS: usize = 256;
/// The first byte of every TLS connection: a record of the handshake.
const TLS_HANDSHAKE: u8 = 22;
/// Pause after the system could not give a connection, most likely for want of descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);
/// The log speaks of that at most this often.
const COMPLAINT_INTERVAL: Duration = Duration::from_secs(30);
/// Connections that wait to be served; further ones wait with their first byte unread.
const QUEUED_CONNECTIONS: usize = 64;

/// Connections whose peers have begun to speak, without Nagle's delay. Accepting ends when this is dropped.
#[derive(Debug)]
pub struct Incoming {
    speaking: mpsc::Receiver<(ControlStream, SocketAddr)>,
}

impl Incoming {
    /// Accepts from now on. Needs a tokio runtime.
    #[must_use]
    pub fn of(listener: TcpListener) -> Self {
        Self::patient(listener, Speech::Grpc { acceptor: None }, FIRST_BYTE_TIMEOUT)
    }

    /// The same for HTTP/1: a status page.
    #[must_use]
    pub fn http(listener: TcpListener) -> Self {
        Self::patient(listener, Speech::Http, FIRST_BYTE_TIMEOUT)
    }

    /// Accepts from now on under TLS, as the coordinator of a secured farm. A connection in plain text comes, too, as a
    /// stranger's: it is told why it is refused.
    ///
    /// # Errors
    /// The TLS library refuses the identity.
    pub fn secured(listener: TcpListener, identity: &Identity) -> Result<Self, TlsError> {
        let acceptor = TlsAcceptor::from(Arc::new(tls::control_server_config(identity)?));
        Ok(Self::patient(listener, Speech::Grpc { acceptor: Some(acceptor) }, FIRST_BYTE_TIMEOUT))
    }

    fn patient(listener: TcpListener, speech: Speech, patience: Duration) -> Self {
        let (speaking_sender, speaking) = mpsc::channel(QUEUED_CONNECTIONS);
        tokio::spawn(accept(listener, Ear { speech, patience, speaking: speaking_sender }));
        Self { speaking }
    }

    /// The next one. Cancel-safe.
    pub async fn accept(&mut self) -> Option<(ControlStream, SocketAddr)> {
        self.speaking.recv().await
    }
}

impl Stream for Incoming {
    type Item = io::Result<ControlStream>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.speaking.poll_recv(context).map(|next| next.map(|(stream, _)| Ok(stream)))
    }
}

async fn accept(listener: TcpListener, ear: Ear) {
    let mut complained: Option<time::Instant> = None;
    let places = Arc::new(Semaphore::new(ear.speech.most_connections()));
    loop {
        let next = async {
            // The semaphore is never closed.
            let place = Arc::clone(&places).acquire_owned().await.map_err(io::Error::other)?;
            let (stream, peer) = listener.accept().await?;
            Ok::<_, io::Error>((stream, peer, place))
        };
        let accepted = tokio::select! {
            accepted = next => accepted,
            () = ear.speaking.closed() => return,
        };
        match accepted {
            Ok((stream, peer, place)) => drop(tokio::spawn(ear.clone().hear(stream, peer, place))),
            Err(error) => {
                if complained.is_none_or(|at| at.elapsed() >= COMPLAINT_INTERVAL) {
                    tracing::warn!(%error, "connections cannot be accepted, trying on; too few file descriptors?");
                    complained = Some(time::Instant::now());
                }
                time::sleep(ACCEPT_PAUSE).await;
            }
        }
    }
}

/// What is spoken on a listener's connections.
#[derive(Clone)]
enum Speech {
    /// gRPC, and so HTTP/2; under TLS where there is an acceptor.
    Grpc { acceptor: Option<TlsAcceptor> },
    /// HTTP/1.
    Http,
}

impl Speech {
    const fn most_connections(&self) -> usize {
        match self {
            Self::Grpc { .. } => MAX_GRPC_CONNECTIONS,
            Self::Http => MAX_HTTP_CONNECTIONS,
        }
    }

    fn silence(&self, patience: Duration) -> Silence {
        match self {
            Self::Grpc { .. } => Silence::opening(patience, HTTP2_OPENING_BYTES),
            Self::Http => Silence::idle(HTTP1_IDLE),
        }
    }
}

/// Waits for what a connection has to say first.
#[derive(Clone)]
struct Ear {
    speech: Speech,
    patience: Duration,
    speaking: mpsc::Sender<(ControlStream, SocketAddr)>,
}

impl Ear {
    /// Hands a connection on once there is something to read, and its handshake, if it has one, is through.
    async fn hear(self, mut stream: TcpStream, peer: SocketAddr, place: OwnedSemaphorePermit) {
        let mut first = [0];
        let heard = tokio::select! {
            heard = time::timeout(self.patience, stream.peek(&mut first)) => heard,
            () = self.speaking.closed() => return,
        };
        match heard {
            Ok(Ok(1..)) => {}
            Ok(_) => return tracing::debug!(%peer, "a connection ended before its first byte"),
            Err(_) => return tracing::debug!(%peer, "a connection was silent for too long"),
        }
        // A socket without the option is slower, not wrong.
        let _ = stream.set_nodelay();
        let silence = self.speech.silence(self.patience);
        let stream = match &self.speech {
            Speech::Grpc { acceptor: Some(acceptor) } if first == [TLS_HANDSHAKE] => {
                match time::timeout(self.patience, acceptor.accept(stream)).await {
                    Ok(Ok(stream)) => ControlStream::tls(stream, peer, silence, place),
                    Ok(Err(error)) => return tracing::warn!(%peer, %error, "a stranger was refused"),
                    Err(_) => return tracing::debug!(%peer, "a handshake took too long"),
                }
            }
            Speech::Grpc { .. } | Speech::Http => ControlStream::plain(stream, peer, silence, place),
        };
        // Nobody serves any more: the connection goes with it.
        let _ = self.speaking.send((stream, peer)).await;
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a step that fails fails its test")]
mod tests {
    use tokio::{
        io::{AsyncReadExt as _, AsyncWriteExt as _},
        net::TcpStream,
    };

    use super::*;

    #[tokio::test]
    async fn silent_connections_are_let_go_and_speaking_ones_keep_their_first_byte() {
        let listener = TcpListener::bind("127.0.0.1:0".parse().unwrap()).await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut incoming =
            Incoming::patient(listener, Speech::Grpc { acceptor: None }, Duration::from_millis(200));
        let mut silent = TcpStream::connect(address).await.unwrap();
        let mut speaking = TcpStream::connect(address).await.unwrap();
        speaking.write_all(b"hello").await.unwrap();
        let (mut heard, _) = incoming.accept().await.unwrap();
        let mut text = [0; 5];
        heard.read_exact(&mut text).await.unwrap();
        assert_eq!(&text, b"hello");
        assert_eq!(silent.read(&mut [0]).await.unwrap(), 0, "the silent one was closed");
        let error = heard.read(&mut text).await.unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::TimedOut, "a few bytes are no preface");
        drop(incoming);
    }

    #[tokio::test]
    async fn who_has_begun_as_http2_does_may_be_silent() {
        let listener = TcpListener::bind("127.0.0.1:0".parse().unwrap()).await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut incoming =
            Incoming::patient(listener, Speech::Grpc { acceptor: None }, Duration::from_millis(50));
        let mut peer = TcpStream::connect(address).await.unwrap();
        peer.write_all(&[b'x'; HTTP2_OPENING_BYTES]).await.unwrap();
        let (mut heard, _) = incoming.accept().await.unwrap();
        heard.read_exact(&mut [0; HTTP2_OPENING_BYTES]).await.unwrap();
        let silent = time::timeout(Duration::from_millis(200), heard.read(&mut [0])).await;
        assert!(silent.is_err(), "pings find out: {silent:?}");
    }

    #[tokio::test]
    async fn a_browser_that_neither_asks_nor_reads_is_let_go() {
        let most = Duration::from_millis(40);
        let (mut silence, begun) = (Silence::idle(most), time::Instant::now());
        time::sleep(most / 2).await;
        silence.broken(0, 1);
        let ended = std::future::poll_fn(|context| silence.poll_end(context)).await;
        assert_eq!(ended.unwrap_err().kind(), io::ErrorKind::TimedOut);
        assert!(begun.elapsed() >= most * 3 / 2, "a byte in either direction breaks it");
    }
}
