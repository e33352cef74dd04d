//! Attacks on a worker's QUIC port, by strangers who trust whatever certificate they see.

use std::{
    collections::BTreeSet,
    io,
    net::{Ipv4Addr, SocketAddr},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use farm_core::{
    id::{AppId, AppIncarnation},
    message::{AppToNode, PROTOCOL_VERSION},
};
use proto::{
    link::{BULK_STREAMS, FETCH_STREAMS, Header as _, LINK_WINDOW_BYTES, encode_frame},
    trust::{Authority, IDENTITY_LIFETIME, Role},
};
use quinn::{
    ClientConfig, Connection, Endpoint, SendStream, ServerConfig, TransportConfig,
    crypto::rustls::{QuicClientConfig, QuicServerConfig},
    rustls::{
        self, DigitallySignedStruct, SignatureScheme,
        client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier},
        crypto::ring,
        pki_types::{CertificateDer, ServerName, UnixTime},
    },
};
use rand::{Rng as _, RngCore as _, SeedableRng as _, rngs::SmallRng};
use tokio::{
    net::UdpSocket,
    task::{JoinSet, yield_now},
    time::{sleep, timeout},
};

use crate::attack::{PATIENCE, STALL, Tally, Target};

/// Handshakes that begin and go no further, at a time.
pub(crate) const HALF_HANDSHAKES: u64 = 512;
/// Links over which tiny streams go.
pub(crate) const STREAM_LINKS: u64 = 8;
/// Links that announce the largest frames and send a byte of each.
pub(crate) const ANNOUNCING_LINKS: u64 = 16;
/// Links with as much of such frames as a link takes unread.
pub(crate) const STALLED_LINKS: u64 = 2;
/// Datagrams between two looks at what else there is to do.
const BURST: u64 = 64;
/// Between two rounds of half handshakes: less than a node's patience with one.
const ROUND: Duration = Duration::from_secs(1);

/// What a link speaks, and the first bytes of its streams (`proto/src/link/wire.rs`).
const ALPN: &[u8] = b"gleaner-data/1";
const ORDERED: u8 = 0;
const BULK: u8 = 1;
/// A fetch: a digest, a size, a first piece.
const UNKNOWN_CONTENT: [u8; 32 + 8 + 4] = [0xaa; 44];

/// Trusts everybody.
#[derive(Debug)]
struct AnyServer;

impl ServerCertVerifier for AnyServer {
    fn verify_server_cert(
        &self,
        _: &CertificateDer<'_>,
        _: &[CertificateDer<'_>],
        _: &ServerName<'_>,
        _: &[u8],
        _: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        Ok(ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _: &[u8],
        _: &CertificateDer<'_>,
        _: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        Ok(HandshakeSignatureValid::assertion())
    }

    fn verify_tls13_signature(
        &self,
        _: &[u8],
        _: &CertificateDer<'_>,
        _: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        Ok(HandshakeSignatureValid::assertion())
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        ring::default_provider().signature_verification_algorithms.supported_schemes()
    }
}

/// Who keeps every ticket and sends early data where it may.
pub(crate) fn stranger() -> Endpoint {
    let mut tls = rustls::ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(AnyServer))
        .with_no_client_auth();
    tls.alpn_protocols = vec![ALPN.to_vec()];
    tls.enable_early_data = true;
    let mut config = ClientConfig::new(Arc::new(QuicClientConfig::try_from(tls).unwrap()));
    let mut transport = TransportConfig::default();
    transport.keep_alive_interval(Some(Duration::from_secs(1)));
    config.transport_config(Arc::new(transport));
    let mut endpoint = Endpoint::client((Ipv4Addr::LOCALHOST, 0).into()).unwrap();
    endpoint.set_default_client_config(config);
    endpoint
}

async fn dial(endpoint: &Endpoint, to: SocketAddr) -> Option<Connection> {
    timeout(PATIENCE, endpoint.connect(to, "gleaner-node").ok()?).await.ok()?.ok()
}

/// Says the hello of an application that nobody has announced; in an open farm that is let in.
async fn greet(connection: &Connection) -> Option<SendStream> {
    static NEXT: AtomicU64 = AtomicU64::new(1 << 40);
    let app = AppId(NEXT.fetch_add(1, Ordering::Relaxed));
    let hello = AppToNode::Hello { protocol: PROTOCOL_VERSION, app, incarnation: AppIncarnation(1) };
    let mut ordered = connection.open_uni().await.ok()?;
    ordered.write_all(&[ORDERED]).await.ok()?;
    ordered.write_all(&encode_frame(&hello, &[]).unwrap()).await.ok()?;
    Some(ordered)
}

/// Datagrams that are no QUIC, or look like its first packets.
pub(crate) async fn datagrams(target: Target, tally: Tally) {
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
    let mut random = SmallRng::seed_from_u64(31);
    loop {
        for _ in 0..BURST {
            let _ = socket.send_to(&forged(&mut random), target.data).await;
        }
        tally.add(BURST);
        yield_now().await;
    }
}

fn forged(random: &mut SmallRng) -> Vec<u8> {
    let mut bytes = vec![0; random.random_range(1..=1_452)];
    random.fill_bytes(&mut bytes);
    // Long headers: first byte, version, and a length of the two connection ids. Initial, 0-RTT, another version; or a short one.
    let (first, version): (u8, u32) =
        [(0xc3, 1), (0xd3, 1), (0xc3, 0xface_feed), (0x40, 0)][random.random_range(0..4)];
    if random.random_bool(0.75) {
        bytes.resize(1_200, 0);
        bytes[0] = first;
        if first != 0x40 {
            bytes[1..5].copy_from_slice(&version.to_be_bytes());
            bytes[5] = 8;
            bytes[14] = 0;
        }
    }
    bytes
}

/// First packets of real handshakes, the rest of which never comes.
pub(crate) async fn half_handshakes(target: Target, tally: Tally) {
    let initials = initials(HALF_HANDSHAKES).await.unwrap();
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
    loop {
        for initial in &initials {
            let _ = socket.send_to(initial, target.data).await;
            tally.add(1);
            yield_now().await;
        }
        sleep(ROUND).await;
    }
}

/// As many first packets, of handshakes with nobody.
async fn initials(count: u64) -> io::Result<Vec<Vec<u8>>> {
    let nobody = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await?;
    let endpoint = stranger();
    let (mut initials, mut seen) = (Vec::new(), BTreeSet::new());
    while (initials.len() as u64) < count {
        let dialling = endpoint.connect(nobody.local_addr()?, "gleaner-node").map_err(io::Error::other)?;
        loop {
            let mut bytes = vec![0; 1_500];
            let (length, _) = nobody.recv_from(&mut bytes).await?;
            bytes.truncate(length);
            // What ends an earlier one, or repeats it, has its connection id.
            let id_bytes = usize::from(bytes[5]);
            if seen.insert(bytes[6..6 + id_bytes].to_vec()) {
                initials.push(bytes);
                break;
            }
        }
        drop(dialling);
    }
    Ok(initials)
}

/// Whether a server takes early data of who was there before.
pub(crate) async fn takes_early_data(to: SocketAddr) -> bool {
    let endpoint = stranger();
    let connection = dial(&endpoint, to).await.expect("it answers");
    // A ticket, if there is one, comes before what is answered.
    let (mut request, mut answer) = connection.open_bi().await.unwrap();
    request.write_all(&UNKNOWN_CONTENT).await.unwrap();
    request.finish().unwrap();
    assert!(!answer.read_to_end(16).await.unwrap().is_empty(), "it has answered");
    connection.close(0_u32.into(), b"");
    match endpoint.connect(to, "gleaner-node").unwrap().into_0rtt() {
        Ok((_early, accepted)) => accepted.await,
        Err(_) => false,
    }
}

/// Where a server is that answers every stream and takes early data.
pub(crate) fn generous() -> Endpoint {
    let identity = Authority::create("farm").unwrap().identity(Role::Node, "n", IDENTITY_LIFETIME).unwrap();
    let mut tls = rustls::ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .with_no_client_auth()
        .with_cert_resolver(Arc::new(identity));
    tls.alpn_protocols = vec![ALPN.to_vec()];
    tls.max_early_data_size = u32::MAX;
    let config = ServerConfig::with_crypto(Arc::new(QuicServerConfig::try_from(tls).unwrap()));
    let endpoint = Endpoint::server(config, (Ipv4Addr::LOCALHOST, 0).into()).unwrap();
    let server = endpoint.clone();
    tokio::spawn(async move {
        while let Some(incoming) = server.accept().await {
            tokio::spawn(async move {
                let connection = incoming.await.ok()?;
                while let Ok((mut answer, _request)) = connection.accept_bi().await {
                    answer.write_all(&[0]).await.ok()?;
                    answer.finish().ok()?;
                }
                Some(())
            });
        }
    });
    endpoint
}

/// Streams that carry a frame that says nothing, and fetches of what nobody has.
pub(crate) async fn tiny_streams(target: Target, tally: Tally) {
    let nothing = [&[BULK], &encode_frame(&AppToNode::Acks(Vec::new()), &[]).unwrap()[..]].concat();
    let mut links = JoinSet::new();
    for _ in 0..STREAM_LINKS {
        let (endpoint, tally, nothing) = (stranger(), tally.clone(), nothing.clone());
        links.spawn(async move {
            loop {
                tally.add(1);
                let Some(connection) = dial(&endpoint, target.data).await else { continue };
                let Some(_ordered) = greet(&connection).await else { continue };
                tokio::join!(frames(&connection, &nothing, &tally), fetches(&connection, &tally));
            }
        });
    }
    while links.join_next().await.is_some() {}
}

/// Until the link is over.
async fn frames(connection: &Connection, frame: &[u8], tally: &Tally) {
    while let Ok(mut stream) = connection.open_uni().await {
        if stream.write_all(frame).await.is_err() {
            return;
        }
        let _ = stream.finish();
        tally.add(1);
    }
}

/// Until the link is over.
async fn fetches(connection: &Connection, tally: &Tally) {
    let mut answers = JoinSet::new();
    while let Ok((mut request, mut answer)) = connection.open_bi().await {
        if request.write_all(&UNKNOWN_CONTENT).await.is_err() {
            return;
        }
        let _ = request.finish();
        answers.spawn(async move { drop(answer.read_to_end(16).await) });
        if answers.len() >= FETCH_STREAMS as usize {
            answers.join_next().await;
        }
        tally.add(1);
    }
}

/// The two lengths of a frame.
fn lengths(header: u32, payload: u64) -> Vec<u8> {
    [&header.to_le_bytes()[..], &payload.to_le_bytes()].concat()
}

/// Streams that break the protocol, each the first on a link of its own; gives what the node says of it.
pub(crate) fn broken_streams() -> Vec<(&'static str, Vec<u8>)> {
    let ordered = |bytes: &[u8]| [&[ORDERED], bytes].concat();
    vec![
        ("header of 4294967295 B is over", ordered(&lengths(u32::MAX, 0))),
        ("payload of 18446744073709551615 B is over", ordered(&lengths(0, u64::MAX))),
        ("payload of 65537 B is over", ordered(&lengths(1, (64 << 10) + 1))),
        ("frame header does not decode", ordered(&[&lengths(9, 0)[..], &[0xff; 9]].concat())),
        // Jobs, as many as a number holds.
        ("frame header does not decode", ordered(&[&lengths(10, 0)[..], &[1, 253], &[0xff; 8]].concat())),
        ("stream of unknown kind 7", vec![7; 64]),
        ("an empty stream", Vec::new()),
        ("into a frame", ordered(&lengths(100, 100))),
    ]
}

/// Why a node closed the link on which this was said first.
pub(crate) async fn said_alone(endpoint: &Endpoint, to: SocketAddr, bytes: &[u8]) -> Option<String> {
    let connection = dial(endpoint, to).await?;
    let mut stream = connection.open_uni().await.ok()?;
    stream.write_all(bytes).await.ok()?;
    let _ = stream.finish();
    timeout(PATIENCE, connection.closed()).await.ok().map(|reason| reason.to_string())
}

/// One after the other.
pub(crate) async fn broken_frames(target: Target, tally: Tally) {
    let (endpoint, streams) = (stranger(), broken_streams());
    loop {
        for (_, bytes) in &streams {
            let _ = said_alone(&endpoint, target.data, bytes).await;
            tally.add(1);
        }
    }
}

/// Frames as large as they may be, of which a byte comes. The links stay as long as the node keeps them.
pub(crate) async fn announcements(target: Target, tally: Tally) {
    begin_frames(target, tally, ANNOUNCING_LINKS, 1, Duration::MAX).await;
}

/// The same, of which as much comes as a link takes unread. They end, and come again.
pub(crate) async fn stalled(target: Target, tally: Tally) {
    let share = (LINK_WINDOW_BYTES / BULK_STREAMS) as usize;
    begin_frames(target, tally, STALLED_LINKS, share, STALL).await;
}

/// Has links on each of which all streams begin a frame, send so much of it, and go no further for so long.
async fn begin_frames(target: Target, tally: Tally, links: u64, sent: usize, stall: Duration) {
    let beginning = [&[BULK], &lengths(16, AppToNode::MAX_PAYLOAD_BYTES)[..], &vec![0; sent]].concat();
    let mut ends = JoinSet::new();
    for _ in 0..links {
        let (endpoint, tally, beginning) = (stranger(), tally.clone(), beginning.clone());
        ends.spawn(async move {
            loop {
                tally.add(1);
                let Some(connection) = dial(&endpoint, target.data).await else { continue };
                let Some(_ordered) = greet(&connection).await else { continue };
                let mut begun = JoinSet::new();
                for _ in 0..BULK_STREAMS {
                    let (connection, beginning) = (connection.clone(), beginning.clone());
                    begun.spawn(async move {
                        let mut stream = connection.open_uni().await.ok()?;
                        stream.write_all(&beginning).await.ok()?;
                        Some(stream)
                    });
                }
                let mut streams = Vec::new();
                while let Some(stream) = begun.join_next().await {
                    streams.push(stream);
                }
                let _ = timeout(stall, connection.closed()).await;
            }
        });
    }
    while ends.join_next().await.is_some() {}
}
