//! Attacks on the coordinator's two TCP ports.

use std::{io, net::SocketAddr, time::Duration};

use bytes::Bytes;
use h2::{
    SendStream,
    client::{ResponseFuture, SendRequest},
};
use http::Request;
use proto::control::MAX_MESSAGE_BYTES;
use rand::{RngCore as _, SeedableRng as _, rngs::SmallRng};
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::TcpStream,
    task::{JoinSet, yield_now},
    time::{sleep, timeout},
};

use crate::attack::{PATIENCE, STALL, Tally, Target};

/// Connections that speak slowly or not at all.
pub(crate) const SLOW_CONNECTIONS: u64 = 300;
/// And to the status page, which has 256 at most.
pub(crate) const SLOW_BROWSERS: u64 = 200;
/// Connections with a message on it that is as large as a message may be and lacks its last byte.
pub(crate) const FILLERS: u64 = 4;
/// Between two bytes of a slow one.
const SLOWNESS: Duration = Duration::from_millis(100);
/// What is left of a connection that its server does not close.
const LEFT_ALONE: Duration = Duration::from_secs(30);

const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
/// An empty SETTINGS frame.
const SETTINGS: &[u8] = &[0, 0, 0, 4, 0, 0, 0, 0, 0];

/// Whatever is no gRPC.
pub(crate) async fn garbage(target: Target, tally: Tally) {
    let mut random = SmallRng::seed_from_u64(31);
    loop {
        for opening in openings(&mut random) {
            // Refused connections are an answer, too.
            let _ = timeout(PATIENCE, say(target.grpc, &opening)).await;
            tally.add(1);
            yield_now().await;
        }
    }
}

fn openings(random: &mut SmallRng) -> Vec<Vec<u8>> {
    let mut noise = vec![0; 4 << 10];
    random.fill_bytes(&mut noise);
    let after_settings = |frames: &[&[u8]]| [&[PREFACE, SETTINGS], frames].concat().concat();
    // Length (3 bytes), type, flags, stream (4 bytes).
    let longest = [0xff, 0xff, 0xff, 0, 0, 0, 0, 0, 1];
    let headers = [0, 0x10, 0, 1, 4, 0, 0, 0, 1];
    let endless_headers = [0, 0x10, 0, 1, 0, 0, 0, 0, 1];
    let continuation = [[0, 0x10, 0, 9, 0, 0, 0, 0, 1].as_slice(), &noise].concat();
    let ping = [0, 0, 8, 6, 0, 0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8];
    let window_of_nothing = [0, 0, 4, 8, 0, 0, 0, 0, 0, 0, 0, 0, 0];
    // A handshake record that is longer than a record may be.
    let tls = [[22, 3, 1, 0xff, 0xff, 1, 0xff, 0xff, 0xff].as_slice(), &noise].concat();
    vec![
        noise.clone(),
        after_settings(&[&longest, &noise]),
        after_settings(&[&headers, &noise]),
        after_settings(&[&endless_headers, &noise, &continuation.repeat(64)]),
        after_settings(&[&ping.repeat(4_096)]),
        after_settings(&[&SETTINGS.repeat(4_096)]),
        after_settings(&[&window_of_nothing]),
        tls,
    ]
}

/// Says something and listens until the peer closes; gives what it said.
async fn say(to: SocketAddr, words: &[u8]) -> io::Result<Vec<u8>> {
    let mut stream = TcpStream::connect(to).await?;
    stream.write_all(words).await?;
    let mut heard = Vec::new();
    stream.read_to_end(&mut heard).await?;
    Ok(heard)
}

/// Slowloris: some say nothing, some open byte by byte, some open well and then ask byte by byte.
pub(crate) async fn slow(target: Target, tally: Tally) {
    let request = [[0, 0x3f, 0xff, 1, 0, 0, 0, 0, 1].as_slice(), &[0x40; 0x3fff]].concat();
    let opened = [PREFACE, SETTINGS].concat();
    let ways = [(Vec::new(), Vec::new()), (Vec::new(), opened.clone()), (opened, request)];
    crawl(target.grpc, &ways, SLOW_CONNECTIONS, &tally).await;
}

/// The same to the status page.
pub(crate) async fn slow_pages(target: Target, tally: Tally) {
    let request = [b"GET / HTTP/1.1\r\nhost: farm\r\nx: ".as_slice(), &[b'x'; 4 << 10]].concat();
    crawl(target.http, &[(Vec::new(), Vec::new()), (Vec::new(), request)], SLOW_BROWSERS, &tally).await;
}

/// Keeps so many connections, each of which says the first part at once and the second slowly, in turns.
async fn crawl(to: SocketAddr, ways: &[(Vec<u8>, Vec<u8>)], connections: u64, tally: &Tally) {
    let mut crowd = JoinSet::new();
    let mut next = ways.iter().cycle();
    loop {
        while (crowd.len() as u64) < connections {
            let (at_once, slowly) = next.next().cloned().unwrap_or_default();
            tally.add(1);
            crowd.spawn(async move {
                let mut stream = TcpStream::connect(to).await?;
                stream.write_all(&at_once).await?;
                for byte in slowly {
                    sleep(SLOWNESS).await;
                    stream.write_all(&[byte]).await?;
                }
                let mut heard = Vec::new();
                let _ = timeout(LEFT_ALONE, stream.read_to_end(&mut heard)).await;
                Ok::<_, io::Error>(())
            });
        }
        crowd.join_next().await;
    }
}

/// Asks for pages, and with more than an HTTP request has.
pub(crate) async fn pages(target: Target, tally: Tally) {
    let long = format!("GET / HTTP/1.1\r\nx: {}\r\n\r\n", "x".repeat(1 << 20));
    let many = format!("GET / HTTP/1.1\r\n{}\r\n", "a: b\r\n".repeat(10_000));
    let body = "POST / HTTP/1.1\r\nhost: farm\r\ncontent-length: 18446744073709551615\r\n\r\n".to_owned();
    let chunk =
        "POST / HTTP/1.1\r\nhost: farm\r\ntransfer-encoding: chunked\r\n\r\nffffffffffffffff\r\n".to_owned();
    let page = "GET / HTTP/1.0\r\n\r\n".to_owned();
    let words = [long, many, body, chunk, page];
    loop {
        for words in &words {
            let _ = timeout(PATIENCE, say(target.http, words.as_bytes())).await;
            tally.add(1);
        }
    }
}

/// A request that no gRPC client makes.
#[derive(Clone, Debug)]
pub(crate) struct Hostile {
    pub(crate) what: &'static str,
    path: &'static str,
    encoding: Option<&'static str>,
    body: Bytes,
    /// The gRPC status that says so, in an open farm.
    pub(crate) status: &'static str,
}

const ADMIN: &str = "/gleaner.v1.Admin/Status";
const SESSION: &str = "/gleaner.v1.Apps/Session";
const OUT_OF_RANGE: &str = "11";
const UNIMPLEMENTED: &str = "12";
const INTERNAL: &str = "13";
const OK: &str = "0";

/// A gRPC message: whether it is compressed, how long it claims to be, what there is of it.
fn message(compressed: u8, length: u32, bytes: &[u8]) -> Bytes {
    [&[compressed], &length.to_be_bytes()[..], bytes].concat().into()
}

/// Groups of an unknown field inside each other (tags: field 1, group begins or ends).
fn nested(depth: usize) -> Bytes {
    let bytes = [[0x0b].repeat(depth), [0x0c].repeat(depth)].concat();
    message(0, u32::try_from(bytes.len()).unwrap(), &bytes)
}

pub(crate) fn hostile_requests() -> Vec<Hostile> {
    let plain =
        Hostile { what: "nothing wrong", path: ADMIN, encoding: None, body: message(0, 0, &[]), status: OK };
    let hostile = |what, body, status| Hostile { what, body, status, ..plain.clone() };
    let session = |what, body| Hostile { what, path: SESSION, body, ..plain.clone() };
    vec![
        plain.clone(),
        hostile("a message of 4 GiB", message(0, u32::MAX, &[0; 64]), OUT_OF_RANGE),
        hostile("compressed by nothing", message(1, 4, &[0; 4]), INTERNAL),
        Hostile {
            encoding: Some("gzip"),
            ..hostile("compressed by gzip", message(1, 4, &[0; 4]), UNIMPLEMENTED)
        },
        Hostile {
            encoding: Some("zstd"),
            ..hostile("compressed by zstd", message(1, 4, &[0; 4]), UNIMPLEMENTED)
        },
        hostile("8,000 levels", nested(8_000), INTERNAL),
        hostile(
            "a length in a message of 2^64 - 1",
            message(0, 11, &[0x0a, 255, 255, 255, 255, 255, 255, 255, 255, 255, 1]),
            INTERNAL,
        ),
        // Sessions end without a word to who does not know the protocol.
        session("100,000 levels", nested(100_000)),
        session("a first message of 4 GiB", message(0, u32::MAX, &[0; 64])),
    ]
}

/// An HTTP/2 connection of an attacker.
pub(crate) struct Peer(SendRequest<Bytes>);

impl Peer {
    pub(crate) async fn connect(to: SocketAddr) -> io::Result<Self> {
        let stream = TcpStream::connect(to).await?;
        let (requests, connection) = h2::client::handshake(stream).await.map_err(io::Error::other)?;
        // What ends it shows in the requests.
        tokio::spawn(async move { drop(connection.await) });
        Ok(Self(requests))
    }

    /// Begins a request.
    async fn request(
        &self,
        path: &str,
        encoding: Option<&str>,
    ) -> Result<(ResponseFuture, SendStream<Bytes>), h2::Error> {
        let request = Request::post(format!("http://farm{path}"))
            .header("content-type", "application/grpc")
            .header("te", "trailers");
        let request =
            encoding.into_iter().fold(request, |request, name| request.header("grpc-encoding", name));
        let request = request.body(()).expect("the headers are well-formed");
        self.0.clone().ready().await?.send_request(request, false)
    }

    /// The gRPC status that a request ends with; empty if it ends without.
    pub(crate) async fn ask(&self, hostile: &Hostile) -> Result<String, h2::Error> {
        let (answer, mut body) = self.request(hostile.path, hostile.encoding).await?;
        body.send_data(hostile.body.clone(), true)?;
        let (head, mut answer) = answer.await?.into_parts();
        while let Some(data) = answer.data().await {
            answer.flow_control().release_capacity(data?.len())?;
        }
        // In the head, where there is no answer.
        let trailers = answer.trailers().await?.unwrap_or(head.headers);
        let status = trailers.get("grpc-status").and_then(|status| status.to_str().ok());
        Ok(status.unwrap_or_default().to_owned())
    }
}

/// Hostile requests, one after the other.
pub(crate) async fn requests(target: Target, tally: Tally) {
    let requests = hostile_requests();
    loop {
        let peer = timeout(PATIENCE, Peer::connect(target.grpc)).await;
        let Ok(Ok(peer)) = peer else { continue };
        for request in &requests {
            let _ = timeout(PATIENCE, peer.ask(request)).await;
            tally.add(1);
        }
    }
}

/// Sessions whose first message has all bytes that a message may have but one. They end, and come again.
pub(crate) async fn fillers(target: Target, tally: Tally) {
    let length = u32::try_from(MAX_MESSAGE_BYTES).unwrap();
    let body = message(0, length, &vec![0; MAX_MESSAGE_BYTES - 1]);
    let mut fillers = JoinSet::new();
    loop {
        while (fillers.len() as u64) < FILLERS {
            tally.add(1);
            let body = body.clone();
            fillers.spawn(async move {
                let peer = Peer::connect(target.grpc).await.ok()?;
                let (answer, mut stream) = peer.request(SESSION, None).await.ok()?;
                stream.send_data(body, false).ok()?;
                let kept = async {
                    let mut answer = answer.await.ok()?.into_body();
                    while let Some(Ok(_)) = answer.data().await {}
                    Some(())
                };
                timeout(STALL, kept).await.ok()?
            });
        }
        fillers.join_next().await;
    }
}
