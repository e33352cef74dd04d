//! How fast a large content goes from an application to a worker over loopback, beside a plain copy of the same bytes over QUIC
//! (quinn as it comes) and over TCP. In turn, several rounds; the median counts, and only ratios of one run mean anything.
//!
//! `cargo run --release --example bulk -p proto -- [MEBIBYTES] [ROUNDS]`

use std::{env, error::Error, net::SocketAddr, sync::Arc, time::Instant};

use bytes::Bytes;
use farm_core::{
    message::{AppToNode, NodeToApp},
    program::Content,
};
use proto::link::{Arrived, ContentBytes, ContentSource, DataServer, Link, connect};
use quinn::{ClientConfig, Endpoint, ServerConfig, crypto::rustls::QuicClientConfig};
use rustls::pki_types::PrivateKeyDer;
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::{TcpListener, TcpStream},
};

type Outcome<T> = Result<T, Box<dyn Error + Send + Sync>>;

/// Least part of plain quinn's speed that a content should have.
const LEAST_OF_QUINN: f64 = 0.9;

#[tokio::main]
async fn main() -> Outcome<()> {
    let mut arguments = env::args().skip(1).map(|text| text.parse::<u16>());
    let mebibytes = arguments.next().transpose()?.unwrap_or(512);
    let rounds = arguments.next().transpose()?.unwrap_or(5).max(1);
    let bytes: Bytes = (0..u32::from(mebibytes) << 18).flat_map(u32::to_le_bytes).collect();

    let content = ContentCopy::prepare(&bytes).await?;
    let quinn = QuinnCopy::prepare().await?;
    let tcp = TcpListener::bind(loopback()).await?;
    let mut times = [const { Vec::new() }; 3];
    for _ in 0..rounds {
        times[0].push(timed(content.copy(&bytes)).await?);
        times[1].push(timed(quinn.copy(&bytes)).await?);
        times[2].push(timed(tcp_copy(&tcp, &bytes)).await?);
    }
    let megabytes = bytes.len() as f64 / 1e6;
    let speeds = times.map(|mut times| {
        times.sort_unstable_by(f64::total_cmp);
        megabytes / times[times.len() / 2]
    });
    for (what, speed) in ["content, checked by blake3", "plain quinn", "plain TCP"].iter().zip(speeds) {
        println!("{what:<28} {speed:>8.0} MB/s");
    }
    let ratio = speeds[0] / speeds[1];
    let ok = if ratio >= LEAST_OF_QUINN { "yes" } else { "NO" };
    println!("content / quinn              {ratio:>8.2}  bar >= {LEAST_OF_QUINN}  {ok}");
    Ok(())
}

fn loopback() -> SocketAddr {
    SocketAddr::from(([127, 0, 0, 1], 0))
}

/// Seconds.
async fn timed(work: impl Future<Output = Outcome<()>>) -> Outcome<f64> {
    let began = Instant::now();
    work.await?;
    Ok(began.elapsed().as_secs_f64())
}

/// As a worker fetches from an application.
struct ContentCopy {
    content: Content,
    _app: Link<AppToNode, NodeToApp>,
    node: Link<NodeToApp, AppToNode>,
    _server: DataServer,
}

impl ContentCopy {
    async fn prepare(bytes: &Bytes) -> Outcome<Self> {
        let server = DataServer::bind(loopback(), None)?;
        let kept = ContentBytes::new(bytes.clone());
        let content = kept.content();
        let source = ContentSource::new(move |_| Some(kept.clone()));
        let addresses = [server.local_addr().to_string()];
        let accepted = async {
            let incoming = server.accept().await.ok_or("nobody dials")?;
            Ok::<_, Box<dyn Error + Send + Sync>>(incoming.establish(|_| ContentSource::empty()).await?)
        };
        let (app, node) = tokio::join!(connect(&addresses, server.certificate_der(), None, source), accepted);
        Ok(Self { content, _app: app?, node: node?.0, _server: server })
    }

    async fn copy(&self, bytes: &Bytes) -> Outcome<()> {
        let came = self.node.sender.fetch(self.content, &mut Arrived::default()).await?;
        same(&came, bytes)
    }
}

/// One stream of one connection, with quinn's own settings.
struct QuinnCopy {
    receiving: quinn::Connection,
    sending: quinn::Connection,
    _ends: [Endpoint; 2],
}

impl QuinnCopy {
    async fn prepare() -> Outcome<Self> {
        let made = rcgen::generate_simple_self_signed(["localhost".to_owned()])?;
        let certificate = made.cert.der().clone();
        let key = PrivateKeyDer::try_from(made.signing_key.serialize_der())?;
        let server = ServerConfig::with_single_cert(vec![certificate.clone()], key)?;
        let server = Endpoint::server(server, loopback())?;
        let mut roots = rustls::RootCertStore::empty();
        roots.add(certificate)?;
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let client = rustls::ClientConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&rustls::version::TLS13])?
            .with_root_certificates(roots)
            .with_no_client_auth();
        let client = ClientConfig::new(Arc::new(QuicClientConfig::try_from(client)?));
        let mut dialling = Endpoint::client(loopback())?;
        dialling.set_default_client_config(client);
        let connecting = dialling.connect(server.local_addr()?, "localhost")?;
        let accepted = async {
            Ok::<_, Box<dyn Error + Send + Sync>>(server.accept().await.ok_or("nobody dials")?.await?)
        };
        let (sending, receiving) = tokio::join!(connecting, accepted);
        Ok(Self { receiving: receiving?, sending: sending?, _ends: [server, dialling] })
    }

    async fn copy(&self, bytes: &Bytes) -> Outcome<()> {
        let (connection, sent) = (self.sending.clone(), bytes.clone());
        let sender = tokio::spawn(async move {
            let mut stream = connection.open_uni().await?;
            stream.write_chunk(sent).await?;
            stream.finish()?;
            Outcome::Ok(())
        });
        let mut stream = self.receiving.accept_uni().await?;
        let came = stream.read_to_end(bytes.len()).await?;
        sender.await??;
        same(&came, bytes)
    }
}

async fn tcp_copy(listener: &TcpListener, bytes: &Bytes) -> Outcome<()> {
    let (address, sent) = (listener.local_addr()?, bytes.clone());
    let sender = tokio::spawn(async move {
        TcpStream::connect(address).await?.write_all(&sent).await?;
        Outcome::Ok(())
    });
    let (mut stream, _) = listener.accept().await?;
    let mut came = Vec::with_capacity(bytes.len());
    stream.read_to_end(&mut came).await?;
    sender.await??;
    same(&came, bytes)
}

fn same(came: &[u8], sent: &[u8]) -> Outcome<()> {
    if came == sent { Ok(()) } else { Err("other bytes came than were sent".into()) }
}
