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

use tokio::{sync::mpsc, time};
use tokio_rustls::TlsAcceptor;
use tokio_stream::Stream;

use super::ControlStream;
use crate::{
    net::{TcpListener, TcpStream},
    tls::{self, TlsError},
    trust::Identity,
};

/// How long an accepted connection may be silent before its first byte, and how long its TLS handshake may take.
const FIRST_BYTE_TIMEOUT: Duration = Duration::from_secs(10);
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
        Self::patient(listener, None, FIRST_BYTE_TIMEOUT)
    }

    /// Accepts from now on under TLS, as the coordinator of a secured farm. A connection in plain text comes, too, as a
    /// stranger's: it is told why it is refused.
    ///
    /// # Errors
    /// The TLS library refuses the identity.
    pub fn secured(listener: TcpListener, identity: &Identity) -> Result<Self, TlsError> {
        let acceptor = TlsAcceptor::from(Arc::new(tls::control_server_config(identity)?));
        Ok(Self::patient(listener, Some(acceptor), FIRST_BYTE_TIMEOUT))
    }

    fn patient(listener: TcpListener, acceptor: Option<TlsAcceptor>, patience: Duration) -> Self {
        let (speaking_sender, speaking) = mpsc::channel(QUEUED_CONNECTIONS);
        tokio::spawn(accept(listener, Ear { acceptor, patience, speaking: speaking_sender }));
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
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = ear.speaking.closed() => return,
        };
        match accepted {
            Ok((stream, peer)) => drop(tokio::spawn(ear.clone().hear(stream, peer))),
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

/// Waits for what a connection has to say first.
#[derive(Clone)]
struct Ear {
    acceptor: Option<TlsAcceptor>,
    patience: Duration,
    speaking: mpsc::Sender<(ControlStream, SocketAddr)>,
}

impl Ear {
    /// Hands a connection on once there is something to read, and its handshake, if it has one, is through.
    async fn hear(self, mut stream: TcpStream, peer: SocketAddr) {
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
        let stream = match &self.acceptor {
            Some(acceptor) if first == [TLS_HANDSHAKE] => {
                match time::timeout(self.patience, acceptor.accept(stream)).await {
                    Ok(Ok(stream)) => ControlStream::tls(stream, peer),
                    Ok(Err(error)) => return tracing::warn!(%peer, %error, "a stranger was refused"),
                    Err(_) => return tracing::debug!(%peer, "a handshake took too long"),
                }
            }
            Some(_) | None => ControlStream::plain(stream, peer),
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
        let mut incoming = Incoming::patient(listener, None, Duration::from_millis(200));
        let mut silent = TcpStream::connect(address).await.unwrap();
        let mut speaking = TcpStream::connect(address).await.unwrap();
        speaking.write_all(b"hello").await.unwrap();
        let (mut heard, _) = incoming.accept().await.unwrap();
        let mut text = [0; 5];
        heard.read_exact(&mut text).await.unwrap();
        assert_eq!(&text, b"hello");
        assert_eq!(silent.read(&mut [0]).await.unwrap(), 0, "the silent one was closed");
        drop(incoming);
    }
}
