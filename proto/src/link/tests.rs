//! Links over loopback: honest ones, and peers that break the protocol on purpose.

use std::{
    net::SocketAddr,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use bytes::{BufMut, Bytes, BytesMut};
use farm_core::{
    id::{
        AppId, AppIncarnation, Attempt, ContentHash, Epoch, JobAttempt, JobId, JobIndex, NodeId, NodeSession,
        TaskId,
    },
    message::{AppToNode, NodeToApp},
    program::Content,
};
use quinn::{Connection, SendStream};

use super::{
    Arrived, ConnectError, ContentBytes, ContentSource, DataServer, FetchError, Frame, Header as _, Link,
    LinkError, MAX_CONTENT_BYTES, PIECE_BYTES, SMALL_PAYLOAD_BYTES, TrySendError, connect,
    connect::dial,
    wire::{BULK_STREAM, ORDERED_STREAM},
};
use crate::codec::{self, MAX_HEADER_BYTES};

type AppLink = Link<AppToNode, NodeToApp>;
type NodeLink = Link<NodeToApp, AppToNode>;

fn server() -> DataServer {
    DataServer::bind(SocketAddr::from(([127, 0, 0, 1], 0)), None).unwrap()
}

/// A link over loopback, whose application offers `contents`.
async fn linked(contents: ContentSource) -> (AppLink, NodeLink, DataServer) {
    let server = server();
    let addresses = [server.local_addr().to_string()];
    let (app, node) = tokio::join!(connect(&addresses, server.certificate_der(), None, contents), async {
        server.accept().await.unwrap().establish(|_| ContentSource::empty()).await
    });
    (app.unwrap(), node.unwrap().0, server)
}

fn hello() -> AppToNode {
    AppToNode::Hello { protocol: 1, app: AppId(1), incarnation: AppIncarnation(0) }
}

fn cancel(sequence: u64) -> AppToNode {
    let job = JobId { app: AppId(1), task: TaskId(2), index: JobIndex(3) };
    AppToNode::Cancel(vec![JobAttempt { job, attempt: Attempt { epoch: Epoch(1), sequence } }])
}

fn welcome() -> NodeToApp {
    NodeToApp::Welcome { node: NodeId(4), session: NodeSession(5) }
}

/// Bytes that differ from one position to the next.
fn pattern(length: usize) -> Bytes {
    (0..length).map(|position| (position.wrapping_mul(31) >> 3).to_le_bytes()[0]).collect::<Vec<u8>>().into()
}

fn content(bytes: &[u8]) -> Content {
    Content { hash: codec::content_hash(bytes), size_bytes: bytes.len() as u64 }
}

#[tokio::test]
async fn frames_go_both_ways() {
    let (mut app, mut node, _server) = linked(ContentSource::empty()).await;
    app.sender.send(hello(), vec![Bytes::from_static(b"two "), Bytes::from_static(b"chunks")]).await.unwrap();
    let frame = node.receiver.recv().await.unwrap();
    assert_eq!(frame, Frame { header: hello(), payload: Bytes::from_static(b"two chunks") });
    node.sender.try_send(welcome(), Vec::new()).unwrap();
    let frame = app.receiver.recv().await.unwrap();
    assert_eq!(frame, Frame { header: welcome(), payload: Bytes::new() });
    assert_eq!(app.receiver.try_recv().unwrap(), None, "nothing else was sent");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn ten_thousand_small_frames_keep_their_order() {
    const FRAMES: u64 = 10_000;
    let (app, mut node, _server) = linked(ContentSource::empty()).await;
    let sender = app.sender.clone();
    let sending = tokio::spawn(async move {
        for sequence in 0..FRAMES {
            let payload = pattern(usize::try_from(sequence % 300).unwrap());
            sender.send(cancel(sequence), vec![payload]).await.unwrap();
        }
    });
    let mut next = 0;
    let mut burst = Vec::new();
    while next < FRAMES {
        node.receiver.recv_many(&mut burst, 256).await.unwrap();
        assert!(burst.len() <= 256, "a burst of {} frames is over its limit", burst.len());
        for frame in burst.drain(..) {
            assert_eq!(frame.header, cancel(next), "out of order");
            assert_eq!(
                frame.payload,
                pattern(usize::try_from(next % 300).unwrap()),
                "payload of frame {next}"
            );
            next += 1;
        }
    }
    sending.await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_large_frame_arrives_whole_and_after_the_hello() {
    let (app, mut node, _server) = linked(ContentSource::empty()).await;
    let payload = pattern(50 << 20);
    app.sender.send(hello(), Vec::new()).await.unwrap();
    app.sender.send(cancel(7), vec![payload.slice(..1 << 20), payload.slice(1 << 20..)]).await.unwrap();
    app.sender.send(cancel(8), vec![pattern(SMALL_PAYLOAD_BYTES)]).await.unwrap();
    assert_eq!(node.receiver.recv().await.unwrap().header, hello(), "the hello comes first");
    let mut later = [node.receiver.recv().await.unwrap(), node.receiver.recv().await.unwrap()];
    if later[0].header != cancel(7) {
        later.swap(0, 1);
    }
    assert_eq!(later[0].header, cancel(7), "the large frame");
    assert!(later[0].payload == payload, "50 MB differ");
    assert_eq!(later[1].header, cancel(8), "the small frame at the limit");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn more_large_frames_than_streams_all_arrive() {
    let (app, mut node, _server) = linked(ContentSource::empty()).await;
    app.sender.send(hello(), Vec::new()).await.unwrap();
    let sender = app.sender.clone();
    let sending = tokio::spawn(async move {
        for sequence in 0..40 {
            sender.send(cancel(sequence), vec![pattern(200_000)]).await.unwrap();
        }
    });
    assert_eq!(node.receiver.recv().await.unwrap().header, hello(), "the hello comes first");
    let mut seen = Vec::new();
    for _ in 0..40 {
        let AppToNode::Cancel(jobs) = node.receiver.recv().await.unwrap().header else {
            panic!("another header")
        };
        seen.push(jobs[0].attempt.sequence);
    }
    sending.await.unwrap();
    seen.sort_unstable();
    assert_eq!(seen, (0..40).collect::<Vec<_>>(), "each once");
}

/// Found by a test that failed once: with both there, either was received first.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_hello_is_received_first_though_large_frames_are_there() {
    let mut links = Vec::new();
    for _ in 0..16 {
        let (app, node, server) = linked(ContentSource::empty()).await;
        app.sender.send(hello(), Vec::new()).await.unwrap();
        app.sender.send(cancel(1), vec![pattern(200_000)]).await.unwrap();
        links.push((app, node, server));
    }
    // All of it has arrived by then, on most links at least.
    tokio::time::sleep(Duration::from_millis(100)).await;
    for (_app, mut node, _server) in links {
        assert_eq!(node.receiver.recv().await.unwrap().header, hello());
        assert_eq!(node.receiver.recv().await.unwrap().header, cancel(1));
    }
}

#[tokio::test]
async fn a_full_queue_hands_the_frame_back_or_waits() {
    let (app, mut node, _server) = linked(ContentSource::empty()).await;
    // On a current-thread runtime no other task runs between these calls: the queue must fill.
    let mut taken = 0;
    let refused = loop {
        match app.sender.try_send(cancel(taken), Vec::new()) {
            Ok(()) => taken += 1,
            Err(TrySendError::Full(header, _)) => break header,
            Err(TrySendError::Link(error)) => panic!("{error}"),
        }
        assert!(taken <= super::QUEUED_FRAMES as u64, "the queue has no bound");
    };
    assert_eq!(refused, cancel(taken), "the refused frame came back");
    app.sender.send(refused, Vec::new()).await.unwrap();
    for sequence in 0..=taken {
        assert_eq!(node.receiver.recv().await.unwrap().header, cancel(sequence), "order kept");
    }
}

#[tokio::test]
async fn an_oversized_payload_is_not_sent_and_the_link_stands() {
    let (app, mut node, _server) = linked(ContentSource::empty()).await;
    let chunk = Bytes::from(vec![0; 64 << 20]);
    let error = app.sender.send(hello(), vec![chunk; 17]).await.unwrap_err();
    assert!(matches!(error, LinkError::Frame { .. }), "got {error}");
    app.sender.send(hello(), Vec::new()).await.unwrap();
    assert_eq!(node.receiver.recv().await.unwrap().header, hello(), "the link stands");
}

#[tokio::test]
async fn closing_tells_the_peer_why_and_loses_nothing_that_was_flushed() {
    let (mut app, mut node, _server) = linked(ContentSource::empty()).await;
    app.sender.send(hello(), Vec::new()).await.unwrap();
    app.sender.send(cancel(1), vec![pattern(1 << 20)]).await.unwrap();
    app.sender.close_after_sent("work is over").await;
    let mut headers =
        vec![node.receiver.recv().await.unwrap().header, node.receiver.recv().await.unwrap().header];
    headers.sort_by_key(|header| *header != hello());
    assert_eq!(headers, [hello(), cancel(1)], "both frames came");
    let by_peer = LinkError::ClosedByPeer { reason: "work is over".to_owned() };
    assert_eq!(node.receiver.recv().await.unwrap_err(), by_peer);
    assert_eq!(node.sender.closed().await, by_peer);
    let error = node.sender.send(welcome(), Vec::new()).await.err();
    assert!(error.is_none_or(|error| error == by_peer), "a late send may be queued or refused");
    let here = LinkError::ClosedHere { reason: "work is over".to_owned() };
    assert_eq!(app.sender.closed().await, here);
    assert_eq!(app.receiver.recv_error().await, here);
}

#[tokio::test]
async fn dropping_both_halves_closes_the_link() {
    let (app, mut node, _server) = linked(ContentSource::empty()).await;
    let Link { sender, receiver } = app;
    drop(sender);
    drop(receiver);
    assert_eq!(
        node.receiver.recv().await.unwrap_err(),
        LinkError::ClosedByPeer { reason: "dropped".to_owned() }
    );
}

#[tokio::test]
async fn shutting_the_server_down_ends_accept_and_its_links() {
    let (mut app, _node, server) = linked(ContentSource::empty()).await;
    server.shutdown("bye").await;
    assert!(server.accept().await.is_none(), "no more links");
    assert_eq!(app.receiver.recv_error().await, LinkError::ClosedByPeer { reason: "bye".to_owned() });
}

#[tokio::test]
async fn another_certificate_is_refused() {
    let (server, other) = (server(), server());
    let addresses = [server.local_addr().to_string()];
    let accepting = async {
        // The handshake fails on this side too: the peer's alert says so.
        server.accept().await.unwrap().establish::<NodeToApp, AppToNode>(|_| ContentSource::empty()).await
    };
    let (app, node) = tokio::join!(dial(&addresses, other.certificate_der(), None), accepting);
    let error = app.unwrap_err();
    assert!(matches!(error, ConnectError::Unreachable(_)), "got {error}");
    assert!(node.is_err(), "the node saw the refusal");
    // Negative control: the right certificate is accepted.
    let (app, node) = tokio::join!(dial(&addresses, server.certificate_der(), None), async {
        server.accept().await.unwrap().establish::<NodeToApp, AppToNode>(|_| ContentSource::empty()).await
    });
    assert!(app.is_ok() && node.is_ok(), "the pinned certificate is accepted");
}

#[tokio::test]
async fn the_race_skips_dead_and_unresolvable_addresses() {
    let server = server();
    // A socket that nobody answers on, a name that cannot be, and the node's own address.
    let silent = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let addresses = [
        silent.local_addr().unwrap().to_string(),
        "no-port".to_owned(),
        format!("localhost:{}", server.local_addr().port()),
    ];
    let (app, node) = tokio::join!(dial(&addresses, server.certificate_der(), None), async {
        server.accept().await.unwrap().establish::<NodeToApp, AppToNode>(|_| ContentSource::empty()).await
    });
    assert!(app.is_ok() && node.is_ok(), "one address answered");
}

#[tokio::test]
async fn a_contact_without_a_usable_address_says_so() {
    let server = server();
    let error = dial(&[], server.certificate_der(), None).await.unwrap_err();
    assert!(matches!(error, ConnectError::NoAddress), "got {error}");
    let error = dial(&["no-port".to_owned()], server.certificate_der(), None).await.unwrap_err();
    assert!(error.to_string().contains("no-port: cannot be resolved"), "got {error}");
}

#[tokio::test]
async fn an_address_in_use_is_named() {
    let first = server();
    let error = DataServer::bind(first.local_addr(), None).unwrap_err();
    assert!(error.to_string().contains(&first.local_addr().to_string()), "got {error}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn contents_are_fetched_and_checked() {
    let large = pattern(20 << 20);
    let small = Bytes::from_static(b"module text");
    let empty = Bytes::new();
    let liar = content(b"what was promised");
    let kept = [large.clone(), small.clone(), empty.clone()].map(ContentBytes::new);
    let source = ContentSource::new(move |hash| {
        // Same size as promised, other bytes.
        let corrupt = ContentBytes::new("What was promised");
        if hash == liar.hash {
            Some(corrupt)
        } else {
            kept.iter().find(|kept| kept.content().hash == hash).cloned()
        }
    });
    let (_app, node, _server) = linked(source).await;
    let fetches = [large, small.clone(), empty].map(|bytes| {
        let sender = node.sender.clone();
        tokio::spawn(async move {
            assert!(
                sender.fetch(content(&bytes), &mut Arrived::default()).await.unwrap().into_bytes() == bytes,
                "other bytes"
            )
        })
    });
    for fetch in fetches {
        fetch.await.unwrap();
    }
    let missing = content(b"nobody has this");
    assert_eq!(
        node.sender.fetch(missing, &mut Arrived::default()).await,
        Err(FetchError::NotFound(missing.hash))
    );
    let corrupt = node.sender.fetch(liar, &mut Arrived::default()).await;
    assert!(matches!(corrupt, Err(FetchError::Corrupt { hash, .. }) if hash == liar.hash), "got {corrupt:?}");
    let wrong_size = Content { size_bytes: 12, ..content(&small) };
    let corrupt = node.sender.fetch(wrong_size, &mut Arrived::default()).await;
    assert!(matches!(corrupt, Err(FetchError::Corrupt { .. })), "got {corrupt:?}");
    let huge = Content { hash: ContentHash([0; 32]), size_bytes: MAX_CONTENT_BYTES + 1 };
    let refused = node.sender.fetch(huge, &mut Arrived::default()).await;
    assert!(matches!(refused, Err(FetchError::TooLarge { .. })), "got {refused:?}");
}

// ---------------------------------------------------------------- peers that break the protocol

/// A raw connection to a node's link.
async fn raw_peer() -> (Connection, NodeLink, DataServer) {
    let server = server();
    let addresses = [server.local_addr().to_string()];
    let (app, node) = tokio::join!(dial(&addresses, server.certificate_der(), None), async {
        server.accept().await.unwrap().establish(|_| ContentSource::empty()).await
    });
    (app.unwrap(), node.unwrap().0, server)
}

async fn say(connection: &Connection, bytes: &[u8]) -> SendStream {
    let mut stream = connection.open_uni().await.unwrap();
    stream.write_all(bytes).await.unwrap();
    stream
}

fn lengths(kind: u8, header: u32, payload: u64) -> BytesMut {
    let mut bytes = BytesMut::new();
    bytes.put_u8(kind);
    bytes.put_u32_le(header);
    bytes.put_u64_le(payload);
    bytes
}

/// A whole frame as it should be.
fn honest(kind: u8, payload: &[u8]) -> BytesMut {
    let mut header = BytesMut::new();
    let header_bytes = codec::encode_header(&mut header, &hello()).unwrap();
    let mut bytes = lengths(kind, u32::try_from(header_bytes).unwrap(), payload.len() as u64);
    bytes.extend_from_slice(&header);
    bytes.extend_from_slice(payload);
    bytes
}

#[tokio::test]
async fn hostile_streams_end_the_link_with_a_reason() {
    let header_cap = u32::try_from(MAX_HEADER_BYTES).unwrap();
    let mut torn = honest(ORDERED_STREAM, b"");
    torn.truncate(torn.len() - 1);
    let mut trailing = honest(BULK_STREAM, b"abc");
    trailing.extend_from_slice(b"more");
    let mut garbage = lengths(ORDERED_STREAM, 4, 0);
    garbage.extend_from_slice(&[0xff; 4]);
    let mut padded = lengths(ORDERED_STREAM, 64, 0);
    padded.extend_from_slice(&[0; 64]);
    let cases: [(&str, BytesMut); 10] = [
        ("unknown kind", BytesMut::from(&[9_u8][..])),
        ("empty stream", BytesMut::new()),
        ("header length over its cap", lengths(ORDERED_STREAM, header_cap + 1, 0)),
        ("all-ones lengths", lengths(ORDERED_STREAM, u32::MAX, u64::MAX)),
        ("small payload over its cap", lengths(ORDERED_STREAM, 1, SMALL_PAYLOAD_BYTES as u64 + 1)),
        ("large payload over its cap", lengths(BULK_STREAM, 1, AppToNode::MAX_PAYLOAD_BYTES + 1)),
        ("all-ones bulk payload", lengths(BULK_STREAM, 1, u64::MAX)),
        ("a torn frame", torn),
        ("a header that does not decode", garbage),
        ("bytes after the header's value", padded),
    ];
    for (case, bytes) in cases {
        let (peer, mut node, _server) = raw_peer().await;
        if bytes.first() == Some(&BULK_STREAM) {
            let _ordered = say(&peer, &honest(ORDERED_STREAM, b"")).await;
            assert!(node.receiver.recv().await.is_ok(), "{case}: the hello comes through");
        }
        say(&peer, &bytes).await.finish().unwrap();
        let error = node.receiver.recv().await.unwrap_err();
        assert!(matches!(error, LinkError::Protocol { .. }), "{case}: got {error}");
        let told = LinkError::from(peer.closed().await);
        assert!(matches!(told, LinkError::ClosedByPeer { .. }), "{case}: the peer was told {told}");
    }
    let (peer, mut node, _server) = raw_peer().await;
    let _ordered = say(&peer, &honest(ORDERED_STREAM, b"")).await;
    say(&peer, &trailing).await.finish().unwrap();
    assert!(node.receiver.recv().await.is_ok(), "the hello comes through");
    let error = node.receiver.recv().await.unwrap_err();
    assert!(error.to_string().contains("follow the frame"), "trailing bytes: got {error}");
}

#[tokio::test]
async fn a_second_ordered_stream_ends_the_link() {
    let (peer, mut node, _server) = raw_peer().await;
    let _first = say(&peer, &honest(ORDERED_STREAM, b"one")).await;
    assert_eq!(node.receiver.recv().await.unwrap().payload, Bytes::from_static(b"one"));
    let _second = say(&peer, &honest(ORDERED_STREAM, b"two")).await;
    let error = node.receiver.recv().await.unwrap_err();
    assert!(error.to_string().contains("second ordered stream"), "got {error}");
}

#[tokio::test]
async fn a_reset_stream_ends_the_link() {
    let (peer, mut node, _server) = raw_peer().await;
    let mut stream = say(&peer, &honest(ORDERED_STREAM, b"one")).await;
    assert_eq!(node.receiver.recv().await.unwrap().payload, Bytes::from_static(b"one"));
    stream.reset(quinn::VarInt::from_u32(3)).unwrap();
    let error = node.receiver.recv().await.unwrap_err();
    assert!(error.to_string().contains("reset"), "got {error}");
}

#[tokio::test]
async fn a_frame_in_many_pieces_is_put_together() {
    let (peer, mut node, _server) = raw_peer().await;
    let bytes = honest(ORDERED_STREAM, &pattern(5_000));
    let mut stream = peer.open_uni().await.unwrap();
    for piece in bytes.chunks(7) {
        stream.write_all(piece).await.unwrap();
        tokio::task::yield_now().await;
    }
    assert_eq!(node.receiver.recv().await.unwrap(), Frame { header: hello(), payload: pattern(5_000) });
}

#[tokio::test]
async fn a_fetch_answer_that_is_too_long_or_short_is_refused() {
    for (announced, sent) in [(10_u64, 9_usize), (10, 11)] {
        let (peer, node, _server) = raw_peer().await;
        let answering = async {
            let (mut answer, _request) = peer.accept_bi().await.unwrap();
            let mut head = BytesMut::new();
            head.put_u8(1);
            head.put_u64_le(announced);
            answer.write_all(&head).await.unwrap();
            answer.write_all(&vec![0; sent]).await.unwrap();
            answer.finish().unwrap();
        };
        let asking = Arc::new(Content { hash: ContentHash([1; 32]), size_bytes: 10 });
        let mut arrived = Arrived::default();
        let (outcome, ()) = tokio::join!(node.sender.fetch(*asking, &mut arrived), answering);
        assert!(
            matches!(outcome, Err(FetchError::Corrupt { .. })),
            "{sent} of {announced} B: got {outcome:?}"
        );
    }
}

#[tokio::test]
async fn a_fetch_that_breaks_off_goes_on_at_another_peer() {
    let whole = ContentBytes::new(pattern(5 * PIECE_BYTES + 9));
    let content = whole.content();
    let mut arrived = Arrived::default();

    // Two pieces and a half, then a cut.
    let (peer, node, _server) = raw_peer().await;
    let cut = async {
        let (mut answer, _request) = peer.accept_bi().await.unwrap();
        answer.write_all(&fetch_head(&whole)).await.unwrap();
        answer.write_all(&whole[..2 * PIECE_BYTES + PIECE_BYTES / 2]).await.unwrap();
        // Until it has come, or the cut would overtake it.
        answer.finish().unwrap();
        answer.stopped().await.unwrap();
        peer.close(quinn::VarInt::from_u32(0), b"gone");
    };
    let (outcome, ()) = tokio::join!(node.sender.fetch(content, &mut arrived), cut);
    outcome.unwrap_err();
    assert_eq!(arrived.size_bytes(), 2 * PIECE_BYTES as u64, "whole pieces stay");

    // The third, and a fourth that is not right.
    let (peer, node, _server) = raw_peer().await;
    let lie = async {
        let (mut answer, mut request) = peer.accept_bi().await.unwrap();
        let asked = request.read_to_end(100).await.unwrap();
        assert_eq!(asked[40..], 2_u32.to_le_bytes(), "from the third piece on");
        answer.write_all(&fetch_head(&whole)).await.unwrap();
        answer.write_all(&whole[2 * PIECE_BYTES..3 * PIECE_BYTES]).await.unwrap();
        // The asking side stops listening in the midst of it.
        let _ = answer.write_all(&vec![7; 2 * PIECE_BYTES + 9]).await;
    };
    let (outcome, ()) = tokio::join!(node.sender.fetch(content, &mut arrived), lie);
    assert!(
        matches!(&outcome, Err(FetchError::Corrupt { reason, .. }) if reason.contains("from 3145728 on")),
        "got {outcome:?}"
    );
    assert_eq!(arrived.size_bytes(), 3 * PIECE_BYTES as u64, "a wrong piece is not kept");

    // The rest, from who has it.
    let served = Arc::new(AtomicU64::new(0));
    let kept = whole.clone();
    let source = ContentSource::new(move |_| Some(kept.clone())).counted_in(Arc::clone(&served));
    let (_app, node, _server) = linked(source).await;
    let came = node.sender.fetch(content, &mut arrived).await.unwrap();
    assert!(came.bytes() == whole.bytes(), "other bytes");
    assert_eq!(
        served.load(Ordering::Relaxed),
        2 * PIECE_BYTES as u64 + 9,
        "what was there did not come again"
    );
}

#[tokio::test]
async fn what_arrived_counts_for_its_own_content_alone() {
    let whole = ContentBytes::new(pattern(3 * PIECE_BYTES + 7));
    let kept = whole.clone();
    let source = || {
        let kept = kept.clone();
        ContentSource::new(move |_| Some(kept.clone()))
    };
    // All of it came, but not the end of the stream: the last piece comes again.
    let (_app, node, _server) = linked(source()).await;
    let mut arrived = Arrived::of(&whole);
    assert_eq!(node.sender.fetch(whole.content(), &mut arrived).await.unwrap(), whole);
    // Somebody says that it is shorter than what is here.
    let (peer, node, _server) = raw_peer().await;
    let mut arrived = Arrived::of(&whole);
    let lie = async {
        let (mut answer, _request) = peer.accept_bi().await.unwrap();
        answer.write_all(&[1]).await.unwrap();
        answer.write_all(&(PIECE_BYTES as u64).to_le_bytes()).await.unwrap();
        answer.finish().unwrap();
    };
    let shorter = Content { size_bytes: PIECE_BYTES as u64, ..whole.content() };
    let (outcome, ()) = tokio::join!(node.sender.fetch(shorter, &mut arrived), lie);
    assert!(matches!(outcome, Err(FetchError::Corrupt { .. })), "got {outcome:?}");
}

/// What an honest peer sends before the pieces.
fn fetch_head(content: &ContentBytes) -> Vec<u8> {
    let mut head = vec![1];
    head.extend((content.len() as u64).to_le_bytes());
    head.extend(content.outline().as_bytes());
    head
}

#[tokio::test]
async fn a_fetch_ends_with_its_link() {
    let (peer, node, _server) = raw_peer().await;
    let silent = async {
        let _streams = peer.accept_bi().await.unwrap();
        peer.close(quinn::VarInt::from_u32(0), b"gone");
    };
    let mut arrived = Arrived::default();
    let asking = node.sender.fetch(Content { hash: ContentHash([7; 32]), size_bytes: 10 }, &mut arrived);
    let (outcome, ()) = tokio::join!(asking, silent);
    assert_eq!(outcome, Err(FetchError::Link(LinkError::ClosedByPeer { reason: "gone".to_owned() })));
}

impl<R: super::Header> super::LinkReceiver<R> {
    /// Reads until the end of the link.
    async fn recv_error(&mut self) -> LinkError {
        loop {
            if let Err(error) = self.recv().await {
                return error;
            }
        }
    }
}
