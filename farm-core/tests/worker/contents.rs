//! Where a node's contents come from: the application, or a node that the coordinator names.

use farm_core::{
    id::{ContentHash, JobAttempt, LinkId},
    message::{Contact, CoordinatorToNode, JobFailure, NodeToCoordinator},
    program::Content,
    worker::{Event, Provider},
};

use crate::node::Node;

const SMALL: Content = Content { hash: ContentHash([1; 32]), size_bytes: 4_096 };
const LARGE: Content = Content { hash: ContentHash([2; 32]), size_bytes: 64 << 20 };
const APP: Provider = Provider::Application(LinkId(1));

fn peer() -> Contact {
    Contact { addresses: vec!["peer:1".to_owned()], certificate_der: vec![7] }
}

fn located(node: &mut Node, peer: Option<Contact>) {
    node.tell(Event::FromCoordinator(CoordinatorToNode::Located { content: LARGE.hash, peer }));
}

fn failed(node: &mut Node) {
    node.tell(Event::ContentFailed { content: LARGE.hash, reason: "test".to_owned() });
}

fn asked(node: &Node) -> usize {
    node.said
        .iter()
        .filter(|said| matches!(said, NodeToCoordinator::Locate(content) if *content == LARGE))
        .count()
}

fn told_of_cache(node: &mut Node) -> Vec<NodeToCoordinator> {
    node.said.extract_if(.., |said| matches!(said, NodeToCoordinator::CacheChanged { .. })).collect()
}

fn held() -> NodeToCoordinator {
    NodeToCoordinator::CacheChanged { held: vec![LARGE], gone: Vec::new() }
}

fn gone() -> NodeToCoordinator {
    NodeToCoordinator::CacheChanged { held: Vec::new(), gone: vec![LARGE.hash] }
}

#[test]
fn small_contents_come_from_the_application_at_once_and_large_ones_from_where_the_coordinator_says() {
    let mut node = Node::new(1, true, 1);
    node.job_with(vec![SMALL, LARGE]);
    assert_eq!(node.fetches, [(SMALL, APP)]);
    assert_eq!(asked(&node), 1);
    node.job_with(vec![LARGE]);
    assert_eq!(asked(&node), 1, "one question for all jobs");
    located(&mut node, Some(peer()));
    assert_eq!(node.fetches[1], (LARGE, Provider::Node(peer())));
    node.tell(Event::ContentReady(LARGE.hash));
    node.tell(Event::ContentReady(SMALL.hash));
    assert_eq!(told_of_cache(&mut node), [held()], "others may fetch it here");
    assert_eq!(node.orders().len(), 2, "both jobs are staged");
}

#[test]
fn what_the_cache_holds_is_not_asked_for_until_it_is_evicted() {
    let mut node = Node::new(1, true, 1);
    let job = node.job_with(vec![LARGE]);
    located(&mut node, None);
    assert_eq!(node.fetches, [(LARGE, APP)]);
    node.tell(Event::ContentReady(LARGE.hash));
    node.done(job, 0);
    node.job_with(vec![LARGE]);
    assert_eq!((asked(&node), node.fetches.len()), (1, 2), "the driver finds it in its cache");
    node.tell(Event::ContentReady(LARGE.hash));
    assert_eq!(told_of_cache(&mut node), [held()], "told once");
    node.tell(Event::ContentsEvicted(vec![LARGE.hash]));
    assert_eq!(told_of_cache(&mut node), [gone()]);
}

#[test]
fn a_peer_that_fails_is_asked_about_and_a_lost_coordinator_leaves_the_application() {
    let mut node = Node::new(1, true, 1);
    node.job_with(vec![LARGE]);
    located(&mut node, Some(peer()));
    failed(&mut node);
    assert_eq!(asked(&node), 2);
    located(&mut node, Some(peer()));
    node.tell(Event::CoordinatorLost);
    failed(&mut node);
    assert_eq!(node.fetches.last(), Some(&(LARGE, APP)), "nobody else can be asked");
    let mut node = Node::new(1, true, 1);
    node.job_with(vec![LARGE]);
    node.tell(Event::CoordinatorLost);
    assert_eq!(node.fetches, [(LARGE, APP)], "the answer will not come");
}

#[test]
fn an_answer_that_does_not_come_is_not_waited_for_for_ever() {
    let mut node = Node::new(1, true, 1);
    node.job_with(vec![LARGE]);
    for _ in 0..200 {
        node.pass_ms(1_000);
        node.machine.handle_timeout(node.now);
        node.tell(Event::FromCoordinator(CoordinatorToNode::HeartbeatAck { sequence: 0 }));
    }
    assert_eq!(node.fetches, [(LARGE, APP)]);
}

#[test]
fn a_content_that_nobody_needs_any_more_is_not_waited_for() {
    let mut node = Node::new(1, true, 1);
    let job = node.job_with(vec![LARGE]);
    node.tell(Event::FromCoordinator(CoordinatorToNode::Cancel { jobs: vec![job] }));
    assert_eq!(told_of_cache(&mut node), [gone()]);
    located(&mut node, Some(peer()));
    assert_eq!(node.fetches, []);
}

#[test]
fn nobody_waits_for_what_does_not_come_here() {
    // The application went away before the answer, during its fetch, or does not have it.
    let mut node = Node::new(1, true, 1);
    node.job_with(vec![LARGE]);
    node.tell(Event::AppLinkClosed { link: LinkId(1) });
    located(&mut node, None);
    assert_eq!((told_of_cache(&mut node), node.fetches.len()), (vec![gone()], 0));
    let mut node = Node::new(1, true, 1);
    node.job_with(vec![LARGE]);
    located(&mut node, None);
    node.tell(Event::AppLinkClosed { link: LinkId(1) });
    assert_eq!(told_of_cache(&mut node), [gone()]);
    let mut node = Node::new(1, true, 1);
    node.job_with(vec![LARGE]);
    located(&mut node, None);
    failed(&mut node);
    assert_eq!(told_of_cache(&mut node), [gone()]);
}

/// Found by reading: jobs waited for bytes that another application had said to be of another size.
#[test]
fn a_content_of_another_size_is_its_own_jobs_fault_alone() {
    const WRONG: Content = Content { hash: SMALL.hash, size_bytes: 5 };
    let mut node = Node::new(1, true, 1);
    let told = |node: &Node, job: JobAttempt| {
        let ended = node.said.iter().filter_map(|said| match said {
            NodeToCoordinator::Report { executed, .. } => Some(executed),
            _ => None,
        });
        ended.flatten().find(|ended| ended.job == job).and_then(|ended| ended.failure.clone())
    };
    let job = node.job_with(vec![SMALL]);
    let early = node.job_with(vec![WRONG]);
    assert_eq!(told(&node, early), Some(JobFailure::Returned), "either may be wrong");
    node.tell(Event::ContentReady(SMALL.hash));
    let late = node.job_with(vec![WRONG]);
    assert!(matches!(told(&node, late), Some(JobFailure::InvalidProgram(_))), "this one is");
    assert_eq!(node.orders(), [(true, 0, job)]);
}
