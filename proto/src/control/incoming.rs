//! Accepted TCP connections of a listener, each once its peer has begun to speak: a crowd of silent ones costs a descriptor each
//! for some seconds, and running out of descriptors costs no spinning.

use std::{
    io,
    net::SocketAddr,
    pin::Pin,
    task::{Context, Poll},
    time::Duration,
};

use tokio::{
    net::{TcpListener, TcpStream},
    sync::mpsc,
    time,
};
use tokio_stream::Stream;

/// How long an accepted connection may be silent before its first byte.
const FIRST_BYTE_TIMEOUT: Duration = Duration::from_secs(10);
/// Pause after the system could not give a connection, most likely for want of descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);
/// The log speaks of that at most this often.
const COMPLAINT_INTERVAL: Duration = Duration::from_secs(30);
/// Connections that wait to be served; further ones wait with their first byte unread.
const QUEUED_CONNECTIONS: usize = 64;

/// Connections whose peers have begun to speak, without Nagle's delay. Accepting ends when this is dropped.
#[derive(Debug)]
pub struct Incoming {
    speaking: mpsc::Receiver<(TcpStream, SocketAddr)>,
}

impl Incoming {
    /// Accepts from now on. Needs a tokio runtime.
    #[must_use]
    pub fn of(listener: TcpListener) -> Self {
        Self::patient(listener, FIRST_BYTE_TIMEOUT)
    }

    fn patient(listener: TcpListener, patience: Duration) -> Self {
        let (sender, speaking) = mpsc::channel(QUEUED_CONNECTIONS);
        tokio::spawn(accept(listener, patience, sender));
        Self { speaking }
    }

    /// The next one. Cancel-safe.
    pub async fn accept(&mut self) -> Option<(TcpStream, SocketAddr)> {
        self.speaking.recv().await
    }
}

impl Stream for Incoming {
    type Item = io::Result<TcpStream>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.speaking.poll_recv(context).map(|next| next.map(|(stream, _)| Ok(stream)))
    }
}

async fn accept(listener: TcpListener, patience: Duration, speaking: mpsc::Sender<(TcpStream, SocketAddr)>) {
    let mut complained: Option<time::Instant> = None;
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = speaking.closed() => return,
        };
        match accepted {
            Ok((stream, peer)) => drop(tokio::spawn(hear(stream, peer, patience, speaking.clone()))),
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

/// Hands a connection on once there is something to read.
async fn hear(
    stream: TcpStream,
    peer: SocketAddr,
    patience: Duration,
    speaking: mpsc::Sender<(TcpStream, SocketAddr)>,
) {
    let mut first = [0];
    let heard = tokio::select! {
        heard = time::timeout(patience, stream.peek(&mut first)) => heard,
        () = speaking.closed() => return,
    };
    match heard {
        Ok(Ok(1..)) => {
            // A socket without the option is slower, not wrong.
            let _ = stream.set_nodelay(true);
            // Nobody serves any more: the connection goes with it.
            let _ = speaking.send((stream, peer)).await;
        }
        Ok(_) => tracing::debug!(%peer, "a connection ended before its first byte"),
        Err(_) => tracing::debug!(%peer, "a connection was silent for too long"),
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a step that fails fails its test")]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

    use super::*;

    #[tokio::test]
    async fn silent_connections_are_let_go_and_speaking_ones_keep_their_first_byte() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut incoming = Incoming::patient(listener, Duration::from_millis(200));
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
