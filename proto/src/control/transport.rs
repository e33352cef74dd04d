//! Settings of the gRPC connections, the same at both ends.

use std::{
    error::Error,
    io,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use hyper_util::rt::TokioIo;
use rustls::pki_types::ServerName;
use tokio::{
    task::JoinSet,
    time::{Instant, sleep},
};
use tokio_rustls::TlsConnector;
use tonic::{
    Code, Request, Status,
    codegen::http::uri::PathAndQuery,
    transport::{Channel, Endpoint, Server, Uri},
};
use tonic_prost::ProstCodec;

use super::{SessionError, session::within_timeout, v1};
use crate::net::TcpStream;

/// How long connecting and each admin request may take.
pub const ADMIN_TIMEOUT: Duration = Duration::from_secs(5);
/// Most bytes of one message, in either direction.
pub const MAX_MESSAGE_BYTES: usize = 16 << 20;
/// Most bytes of one request outside of sessions: it is read before its sender is asked who it is, and a signing request, the
/// largest, has half a kilobyte.
const MAX_REQUEST_BYTES: usize = 16 << 10;
/// What clients call the coordinator in the handshake.
const COORDINATOR_NAME: &str = "gleaner-coordinator";
/// HTTP/2 pings go this often (off by default).
const KEEP_ALIVE: Duration = Duration::from_secs(5);
/// A connection that does not answer a ping for this long is closed.
const KEEP_ALIVE_TIMEOUT: Duration = Duration::from_secs(5);
/// Unread bytes of one session, at most: a plan of 4,096 jobs is about 10 kB.
const STREAM_WINDOW_BYTES: u32 = 4 << 20;
/// Unread bytes of one connection, at most.
pub const CONNECTION_WINDOW_BYTES: u32 = 8 << 20;
/// Most addresses of a farm's coordinators.
const MAX_COORDINATORS: usize = 8;
/// Pause before one of several coordinators that did not answer is tried again, while another one is waited for.
const REDIAL: Duration = Duration::from_millis(250);
/// Sessions and requests of one connection at a time.
const STREAMS_PER_CONNECTION: u32 = 64;

/// A gRPC server with the farm's keepalive, windows and stream limits; serve it on [`super::Incoming`].
#[must_use]
pub fn server() -> Server {
    Server::builder()
        .http2_keepalive_interval(Some(KEEP_ALIVE))
        .http2_keepalive_timeout(Some(KEEP_ALIVE_TIMEOUT))
        .initial_stream_window_size(STREAM_WINDOW_BYTES)
        .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
        .max_concurrent_streams(STREAMS_PER_CONNECTION)
}

/// The service of applications, with message caps.
pub fn apps_server<A: v1::apps_server::Apps>(apps: A) -> v1::apps_server::AppsServer<A> {
    v1::apps_server::AppsServer::new(apps)
        .max_decoding_message_size(MAX_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES)
}

/// The service of worker nodes, with message caps.
pub fn nodes_server<N: v1::nodes_server::Nodes>(nodes: N) -> v1::nodes_server::NodesServer<N> {
    v1::nodes_server::NodesServer::new(nodes)
        .max_decoding_message_size(MAX_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES)
}

/// The service of operators, with message caps.
pub fn admin_server<A: v1::admin_server::Admin>(admin: A) -> v1::admin_server::AdminServer<A> {
    v1::admin_server::AdminServer::new(admin)
        .max_decoding_message_size(MAX_REQUEST_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES)
}

/// The service of members and those who become one, with message caps.
pub fn trust_server<T: v1::trust_server::Trust>(trust: T) -> v1::trust_server::TrustServer<T> {
    v1::trust_server::TrustServer::new(trust)
        .max_decoding_message_size(MAX_REQUEST_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES)
}

/// The addresses in a coordinator's `HOST:PORT[,HOST:PORT]...`: its own, and its standbys'.
///
/// # Errors
/// [`SessionError::Address`] names the one that is none.
pub fn coordinator_addresses(coordinator: &str) -> Result<Vec<&str>, SessionError> {
    let addresses: Vec<&str> = coordinator.split(',').map(str::trim).collect();
    if addresses.len() > MAX_COORDINATORS {
        let reason = format!("at most {MAX_COORDINATORS} coordinators may be named");
        return Err(SessionError::Address { address: coordinator.to_owned(), reason });
    }
    addresses.iter().try_for_each(|address| endpoint(address).map(drop))?;
    Ok(addresses)
}

/// Connects to the coordinator, under TLS if a configuration is given. Of several addresses to the first that answers: all are
/// dialled side by side, and one that only takes connections, as a process that was stopped does, is not taken for alive.
pub(super) async fn connect(
    coordinator: &str,
    tls: Option<rustls::ClientConfig>,
) -> Result<Channel, SessionError> {
    let addresses = coordinator_addresses(coordinator)?;
    if let [only] = addresses[..] {
        return dial(only, tls).await;
    }
    let end = Instant::now() + ADMIN_TIMEOUT;
    // Those that have neither answered nor failed.
    let open = Arc::new(AtomicUsize::new(addresses.len()));
    let mut dials = JoinSet::new();
    for address in addresses {
        let (address, tls, open) = (address.to_owned(), tls.clone(), Arc::clone(&open));
        dials.spawn(async move {
            let mut failed = false;
            loop {
                let error = match dial_and_ask(&address, tls.clone()).await {
                    Ok(channel) => return Ok(channel),
                    Err(error) => error,
                };
                if !std::mem::replace(&mut failed, true) {
                    open.fetch_sub(1, Ordering::Relaxed);
                }
                // A standby may begin to lead while a leader that was stopped is waited for.
                let waits = open.load(Ordering::Relaxed) > 0 && Instant::now() < end;
                if !(waits && matches!(error, SessionError::Unreachable { .. })) {
                    return Err(error);
                }
                sleep(REDIAL).await;
            }
        });
    }
    let (mut silent, mut telling) = (Vec::new(), None);
    while let Some(dialled) = dials.join_next().await {
        match dialled {
            Ok(Ok(channel)) => return Ok(channel),
            Ok(Err(SessionError::Unreachable { address, reason })) => {
                silent.push(format!("{address}: {reason}"));
            }
            // Somebody is there, and is none, or does not let the caller in.
            Ok(Err(error)) => telling = telling.filter(is_denial).or(Some(error)),
            Err(error) => silent.push(error.to_string()),
        }
    }
    let reason = silent.join("; ");
    Err(telling.unwrap_or_else(|| SessionError::Unreachable { address: coordinator.to_owned(), reason }))
}

async fn dial_and_ask(address: &str, tls: Option<rustls::ClientConfig>) -> Result<Channel, SessionError> {
    let channel = dial(address, tls).await?;
    answers(address, channel.clone()).await?;
    Ok(channel)
}

const fn is_denial(error: &SessionError) -> bool {
    matches!(error, SessionError::Denied { .. })
}

/// Asks for a standard service that no coordinator has: whoever says so is there.
async fn answers(address: &str, channel: Channel) -> Result<(), SessionError> {
    let mut client = tonic::client::Grpc::new(channel);
    let asked = async {
        client.ready().await.map_err(|error| Status::unavailable(root_cause(&error)))?;
        let path = PathAndQuery::from_static("/grpc.health.v1.Health/Check");
        match client.unary::<(), (), _>(Request::new(()), path, ProstCodec::default()).await {
            Err(status) if status.code() != Code::Unimplemented => Err(status),
            Ok(_) | Err(_) => Ok(()),
        }
    };
    within_timeout(address, asked).await
}

/// Connects to `HOST:PORT`.
async fn dial(coordinator: &str, tls: Option<rustls::ClientConfig>) -> Result<Channel, SessionError> {
    let endpoint = endpoint(coordinator)?;
    let address: Arc<str> = coordinator.into();
    let connected = match tls {
        None => {
            let dial = move |_: Uri| {
                let address = Arc::clone(&address);
                async move { TcpStream::connect(&address).await.map(TokioIo::new) }
            };
            endpoint.connect_with_connector(tower::service_fn(dial)).await
        }
        Some(config) => {
            let connector = TlsConnector::from(Arc::new(config));
            let dial = move |_: Uri| {
                let (connector, address) = (connector.clone(), Arc::clone(&address));
                async move {
                    let stream = TcpStream::connect(&address).await?;
                    // Nobody compares it: the certificate's URI and its signature say who it is.
                    let name = ServerName::try_from(COORDINATOR_NAME).map_err(io::Error::other)?;
                    Ok::<_, io::Error>(TokioIo::new(connector.connect(name, stream).await?))
                }
            };
            endpoint.connect_with_connector(tower::service_fn(dial)).await
        }
    };
    connected.map_err(|error| refusal(coordinator, &error))
}

/// A connection that was not made: nobody is there, or who is there is not of the caller's farm.
fn refusal(coordinator: &str, error: &(dyn Error + 'static)) -> SessionError {
    match tls_error(error) {
        None => SessionError::Unreachable { address: coordinator.to_owned(), reason: root_cause(error) },
        Some(rustls::Error::InvalidCertificate(_)) => SessionError::Denied {
            reason: format!("who answers at {coordinator} is not this farm's coordinator"),
        },
        Some(rustls::Error::InvalidMessage(_)) => SessionError::Denied {
            reason: format!("the farm at {coordinator} is not secured; --insecure says that it is meant"),
        },
        Some(error) => SessionError::Denied { reason: error.to_string() },
    }
}

/// What TLS says among an error's causes.
fn tls_error<'error>(error: &'error (dyn Error + 'static)) -> Option<&'error rustls::Error> {
    let within = error.downcast_ref::<io::Error>().and_then(io::Error::get_ref);
    let tls = error.downcast_ref().or_else(|| within?.downcast_ref());
    tls.or_else(|| tls_error(error.source()?))
}

/// The innermost error says what happened ("connection refused"); the outer ones say "transport error".
pub(super) fn root_cause(error: &dyn Error) -> String {
    let mut cause = error;
    while let Some(source) = cause.source() {
        cause = source;
    }
    cause.to_string()
}

/// The client's end of a connection to `HOST:PORT`.
fn endpoint(coordinator: &str) -> Result<Endpoint, SessionError> {
    let bad =
        |reason: &str| SessionError::Address { address: coordinator.to_owned(), reason: reason.to_owned() };
    let (host, port) = coordinator.rsplit_once(':').ok_or_else(|| bad("the port is missing"))?;
    if host.is_empty() {
        return Err(bad("the host is missing"));
    }
    if host.contains('/') {
        return Err(bad("it is host and port alone, without http://"));
    }
    if !port.parse::<u16>().is_ok_and(|port| port > 0) {
        return Err(bad("the port is not a number from 1 to 65535"));
    }
    let endpoint =
        Endpoint::from_shared(format!("http://{coordinator}")).map_err(|error| bad(&error.to_string()))?;
    Ok(endpoint
        .connect_timeout(ADMIN_TIMEOUT)
        .http2_keep_alive_interval(KEEP_ALIVE)
        .keep_alive_timeout(KEEP_ALIVE_TIMEOUT)
        .keep_alive_while_idle(true)
        .initial_stream_window_size(STREAM_WINDOW_BYTES)
        .initial_connection_window_size(CONNECTION_WINDOW_BYTES))
}
