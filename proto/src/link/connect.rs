//! Making links: the node's listening socket and the application's race over a node's addresses.

use std::{
    collections::BTreeSet,
    io,
    net::{Ipv4Addr, Ipv6Addr, SocketAddr},
    sync::Arc,
    time::Duration,
};

use quinn::{
    ClientConfig, Connection, Endpoint, EndpointConfig, IdleTimeout, MtuDiscoveryConfig, ServerConfig,
    TokioRuntime, TransportConfig, VarInt,
};
use rustls::pki_types::CertificateDer;
use thiserror::Error;
use tokio::task::JoinSet;

use super::{
    BULK_STREAMS, ContentSource, FETCH_STREAMS, Header, Link, LinkError, LinkReceiver, LinkSender, fetch,
    shared::{Guard, Shared},
};
use crate::{
    net,
    tls::{self, NodeCertificate, TlsError},
    trust::{Identity, Principal},
};

/// How long `connect` tries in all, and how long an accepted handshake may take.
pub const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Links of one data server; further ones are refused until one ends.
pub const MAX_LINKS: usize = 1_024;
/// Socket addresses that one name may resolve to; the rest are not tried.
const ADDRESSES_PER_NAME: usize = 8;
/// Handshakes that wait to be accepted.
const MAX_INCOMING: usize = 256;
/// Either side sends something at least this often.
const KEEP_ALIVE: Duration = Duration::from_secs(1);
/// A link whose peer is silent for this long after it was last spoken to is lost: 6 s after its last word at most.
const IDLE_TIMEOUT_MS: u32 = 5_000;
/// Unread bytes of one stream, at most.
const STREAM_WINDOW_BYTES: u32 = 16 << 20;
/// Unread bytes of one link, at most.
pub const LINK_WINDOW_BYTES: u32 = 64 << 20;
/// Bytes sent on one link and not acknowledged, at most.
const SEND_WINDOW_BYTES: u64 = 32 << 20;
/// The largest UDP payload tried. Ten of them, the network stack's segments for each system call, must fit one UDP
/// datagram of 65,507 bytes: loopback carries them with a fifth of the packets that Ethernet's 1,452 would need.
const MAX_DATAGRAM_BYTES: u16 = 6_400;
/// How long `shutdown` waits for the peers to hear of it.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(1);

/// A data server could not start.
#[derive(Debug, Error)]
pub enum BindError {
    /// The address cannot be had.
    #[error("cannot listen on {address} (UDP)")]
    Address {
        /// The address asked for.
        address: SocketAddr,
        /// Why not.
        source: io::Error,
    },
    /// No certificate.
    #[error(transparent)]
    Tls(#[from] TlsError),
}

/// No address of a node gave a link. May be retried.
#[derive(Debug, Error)]
pub enum ConnectError {
    /// The contact names no address.
    #[error("the node has no address")]
    NoAddress,
    /// The pinned certificate cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// Each address failed.
    #[error("no address answered: {}", list(.0))]
    Unreachable(Vec<(String, String)>),
}

fn list(failures: &[(String, String)]) -> String {
    failures.iter().map(|(address, reason)| format!("{address}: {reason}")).collect::<Vec<_>>().join("; ")
}

/// A node's listening end.
#[derive(Debug)]
pub struct DataServer {
    endpoint: Endpoint,
    local_addr: SocketAddr,
    certificate: NodeCertificate,
}

impl DataServer {
    /// Listens on a UDP address (port 0: the system chooses) under a fresh certificate; with an identity, for members of its
    /// farm alone. Needs a tokio runtime.
    ///
    /// # Errors
    /// The address cannot be had, or no certificate can be made.
    pub fn bind(address: SocketAddr, identity: Option<&Identity>) -> Result<Self, BindError> {
        let certificate = NodeCertificate::generate()?;
        let mut config = ServerConfig::with_crypto(Arc::new(certificate.server_config(identity)?));
        config.transport_config(Arc::new(transport_config())).max_incoming(MAX_INCOMING);
        let at_address = |source| BindError::Address { address, source };
        let endpoint = endpoint(address, Some(config)).map_err(at_address)?;
        let local_addr = endpoint.local_addr().map_err(at_address)?;
        Ok(Self { endpoint, local_addr, certificate })
    }

    /// Where it listens.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    /// The certificate to pin, DER.
    #[must_use]
    pub fn certificate_der(&self) -> &[u8] {
        self.certificate.der()
    }

    /// The next application that dials; `None` after [`Self::shutdown`]. Cancel-safe.
    pub async fn accept(&self) -> Option<Incoming> {
        loop {
            let incoming = self.endpoint.accept().await?;
            if self.endpoint.open_connections() < MAX_LINKS {
                return Some(Incoming { incoming });
            }
            tracing::warn!(peer = %incoming.remote_address(), limit = MAX_LINKS, "link refused: too many");
            incoming.refuse();
        }
    }

    /// Closes every link and waits (at most a second) until the peers were told.
    pub async fn shutdown(&self, reason: &str) {
        self.endpoint.close(VarInt::from_u32(0), reason.as_bytes());
        // Peers that do not answer find out by their own timeouts.
        let _ = tokio::time::timeout(SHUTDOWN_TIMEOUT, self.endpoint.wait_idle()).await;
    }
}

/// A dialling application before its handshake.
#[derive(Debug)]
pub struct Incoming {
    incoming: quinn::Incoming,
}

impl Incoming {
    /// Who dials.
    #[must_use]
    pub fn remote_address(&self) -> SocketAddr {
        self.incoming.remote_address()
    }

    /// Completes the handshake; run it on a task of its own, for a peer may dawdle up to [`CONNECT_TIMEOUT`]. An
    /// application that raced several addresses closes the links that lost at once. `contents` says what the peer may fetch.
    /// The link comes with who the peer is; `None` where the server asks nobody.
    ///
    /// # Errors
    /// The handshake failed.
    pub async fn establish<S: Header, R: Header>(
        self,
        contents: impl FnOnce(Option<&Principal>) -> ContentSource,
    ) -> Result<(Link<S, R>, Option<Principal>), LinkError> {
        let connecting = self.incoming.accept().map_err(LinkError::from)?;
        match tokio::time::timeout(CONNECT_TIMEOUT, connecting).await {
            Ok(Ok(connection)) => {
                let shown = connection.peer_identity();
                let shown =
                    shown.as_ref().and_then(|shown| shown.downcast_ref::<Vec<CertificateDer<'static>>>());
                let peer = tls::member(shown.map(Vec::as_slice)).map(|member| member.principal);
                let contents = contents(peer.as_ref());
                Ok((open(connection, contents), peer))
            }
            Ok(Err(error)) => Err(LinkError::from(error)),
            Err(_) => Err(LinkError::Lost { reason: "the handshake took too long".to_owned() }),
        }
    }
}

/// Dials a node: all addresses (`host:port`) side by side, the first that answers with the pinned certificate wins. Nodes of a
/// secured farm want to see an identity.
///
/// # Errors
/// None answered within [`CONNECT_TIMEOUT`]; the error names each address and its reason.
pub async fn connect<S: Header, R: Header>(
    addresses: &[String],
    certificate_der: &[u8],
    identity: Option<&Identity>,
    contents: ContentSource,
) -> Result<Link<S, R>, ConnectError> {
    let connection = dial(addresses, certificate_der, identity).await?;
    Ok(open(connection, contents))
}

/// Starts a link's tasks on an established connection.
fn open<S: Header, R: Header>(connection: Connection, contents: ContentSource) -> Link<S, R> {
    let shared = Arc::new(Shared::new(connection));
    tokio::spawn(fetch::serve_contents(Arc::clone(&shared), contents));
    let guard = Arc::new(Guard::new(shared));
    Link { sender: LinkSender::new(Arc::clone(&guard)), receiver: LinkReceiver::new(guard) }
}

/// What one step of the race ended with.
enum Step {
    Resolved(String, io::Result<Vec<SocketAddr>>),
    Dialled(String, Result<Connection, String>),
}

/// Races all addresses for a connection.
pub(super) async fn dial(
    addresses: &[String],
    certificate_der: &[u8],
    identity: Option<&Identity>,
) -> Result<Connection, ConnectError> {
    if addresses.is_empty() {
        return Err(ConnectError::NoAddress);
    }
    let mut config = ClientConfig::new(Arc::new(tls::pinned_client_config(certificate_der, identity)?));
    config.transport_config(Arc::new(transport_config()));

    let deadline = tokio::time::Instant::now() + CONNECT_TIMEOUT;
    let mut race = JoinSet::new();
    let mut pending = BTreeSet::new();
    for address in addresses {
        if pending.insert(address.clone()) {
            let address = address.clone();
            race.spawn(async move {
                let resolved = tokio::net::lookup_host(&address).await;
                let resolved = resolved.map(|found| found.take(ADDRESSES_PER_NAME).collect());
                Step::Resolved(address, resolved)
            });
        }
    }

    let mut failures = Vec::new();
    while let Ok(Some(step)) = tokio::time::timeout_at(deadline, race.join_next()).await {
        // A panic in a step is a bug of the network stack; the other addresses go on.
        let Ok(step) = step else { continue };
        match step {
            Step::Resolved(address, Ok(found)) => {
                pending.remove(&address);
                if found.is_empty() {
                    failures.push((address, "the name has no address".to_owned()));
                    continue;
                }
                for target in found {
                    let label = if target.to_string() == address {
                        address.clone()
                    } else {
                        format!("{address} ({target})")
                    };
                    pending.insert(label.clone());
                    let config = config.clone();
                    race.spawn(async move { Step::Dialled(label, dial_one(target, config).await) });
                }
            }
            Step::Dialled(_, Ok(connection)) => return Ok(connection),
            Step::Resolved(address, Err(error)) => {
                pending.remove(&address);
                failures.push((address, format!("cannot be resolved: {error}")));
            }
            Step::Dialled(address, Err(reason)) => {
                pending.remove(&address);
                failures.push((address, reason));
            }
        }
    }
    let silent =
        pending.into_iter().map(|address| (address, format!("no answer within {CONNECT_TIMEOUT:?}")));
    failures.extend(silent);
    Err(ConnectError::Unreachable(failures))
}

async fn dial_one(target: SocketAddr, config: ClientConfig) -> Result<Connection, String> {
    let any = match target {
        SocketAddr::V4(_) => SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0)),
        SocketAddr::V6(_) => SocketAddr::from((Ipv6Addr::UNSPECIFIED, 0)),
    };
    // One socket for each link: its driver is a task of its own, so links do not wait for each other. The endpoint
    // lives on inside the connection.
    let endpoint = endpoint(any, None).map_err(|error| error.to_string())?;
    let connecting =
        endpoint.connect_with(config, target, tls::NODE_NAME).map_err(|error| error.to_string())?;
    connecting.await.map_err(|error| error.to_string())
}

fn endpoint(address: SocketAddr, server: Option<ServerConfig>) -> io::Result<Endpoint> {
    let mut config = EndpointConfig::default();
    config.max_udp_payload_size(MAX_DATAGRAM_BYTES).map_err(io::Error::other)?;
    Endpoint::new_with_abstract_socket(config, server, net::datagrams(address)?, Arc::new(TokioRuntime))
}

fn transport_config() -> TransportConfig {
    let mut mtu = MtuDiscoveryConfig::default();
    mtu.upper_bound(MAX_DATAGRAM_BYTES);
    let mut config = TransportConfig::default();
    config
        .max_concurrent_uni_streams(VarInt::from_u32(1 + BULK_STREAMS))
        .max_concurrent_bidi_streams(VarInt::from_u32(FETCH_STREAMS))
        .stream_receive_window(VarInt::from_u32(STREAM_WINDOW_BYTES))
        .receive_window(VarInt::from_u32(LINK_WINDOW_BYTES))
        .send_window(SEND_WINDOW_BYTES)
        .datagram_receive_buffer_size(None)
        .keep_alive_interval(Some(KEEP_ALIVE))
        .max_idle_timeout(Some(IdleTimeout::from(VarInt::from_u32(IDLE_TIMEOUT_MS))))
        .mtu_discovery_config(Some(mtu));
    config
}
