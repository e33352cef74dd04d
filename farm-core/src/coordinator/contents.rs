//! Who has a content, and who brings it where it is needed: an application sends each large content once, nodes take it
//! from each other (30-programs-and-data.md section 2). Bytes never come here.
//!
//! Of the nodes that need a content one fetches it from the application; the others wait until it has it, and take it
//! from there, each then a source itself. A wait is bounded: every [`LANE_MS`] one more goes to the application.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::Duration,
};

use super::{ContentStatus, ContentsStatus, CoordinatorMachine, model::Node};
use crate::{
    id::{ContentHash, NodeId},
    message::CoordinatorToNode,
    program::Content,
    time::Instant,
};

/// Most contents whose whereabouts are kept; nodes fetch further ones from the application.
const MAX_SPREADS: usize = 65_536;

/// Nodes that take one content from one node at a time.
const MAX_SERVED: usize = 4;

/// Peers that a node tries in vain before it goes to the application.
const MAX_PEER_TRIES: u32 = 2;

/// When nodes wait for a content that does not come along, one more of them goes to the application, in milliseconds:
/// time for 600 MB over a link of 1 Gbit/s.
const LANE_MS: u64 = 5_000;

/// Where contents are and where they go.
#[derive(Debug, Default)]
pub(super) struct Spreads {
    contents: BTreeMap<ContentHash, Spread>,
    /// No later than the earliest `next_lane`.
    due: Option<Instant>,
}

/// Where one content is and where it goes. A node is in at most one of the four.
#[derive(Debug, Default)]
struct Spread {
    /// 0 while nobody has said it.
    size_bytes: u64,
    holders: BTreeSet<NodeId>,
    /// Fetch it from the application.
    from_app: BTreeSet<NodeId>,
    /// Fetch it from a holder, by the node that does.
    from_peer: BTreeMap<NodeId, NodeId>,
    /// Asked and not answered, first come, first served.
    waiting: VecDeque<NodeId>,
    /// Peers that nodes still without it tried in vain.
    vain_tries: BTreeMap<NodeId, u32>,
    /// When one of `waiting` goes to the application in any case.
    next_lane: Option<Instant>,
}

/// Where a node is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Source {
    Application,
    Peer(NodeId),
}

impl Spread {
    fn is_empty(&self) -> bool {
        self.holders.is_empty()
            && self.from_app.is_empty()
            && self.from_peer.is_empty()
            && self.waiting.is_empty()
    }

    /// The node is neither source nor target any more; those that it serves find out by themselves.
    fn forget(&mut self, node: NodeId) {
        self.holders.remove(&node);
        self.from_app.remove(&node);
        self.from_peer.remove(&node);
        self.waiting.retain(|waiting| *waiting != node);
        self.vain_tries.remove(&node);
    }

    /// Where a node that needs it should go now, if anywhere.
    fn source_for(&self, node: NodeId, nodes: &BTreeMap<NodeId, Node>) -> Option<Source> {
        if self.vain_tries.get(&node).is_some_and(|tries| *tries >= MAX_PEER_TRIES) {
            return Some(Source::Application);
        }
        let serves = |peer: NodeId| self.from_peer.values().filter(|source| **source == peer).count();
        let peers = self.holders.iter().filter(|peer| nodes.get(peer).is_some_and(Node::is_up));
        let least = peers.map(|peer| (serves(*peer), *peer)).min();
        match least {
            Some((served, peer)) if served < MAX_SERVED => Some(Source::Peer(peer)),
            // Their peers will have it soon.
            Some(_) => None,
            None if self.from_app.is_empty() => Some(Source::Application),
            None => None,
        }
    }
}

impl CoordinatorMachine {
    /// A node needs a content. Asked again, it could not have it where it was sent.
    pub(super) fn locate(&mut self, now: Instant, node: NodeId, content: Content) {
        let full = self.spreads.contents.len() >= MAX_SPREADS;
        if full && !self.spreads.contents.contains_key(&content.hash) {
            return self.send_to(node, content.hash, Source::Application);
        }
        let spread = self.spreads.contents.entry(content.hash).or_default();
        spread.size_bytes = content.size_bytes;
        let tries = spread.vain_tries.remove(&node).unwrap_or(0);
        let failed = spread.from_peer.get(&node).copied();
        spread.forget(node);
        if let Some(peer) = failed {
            // It has it no more, or cannot be reached.
            spread.holders.remove(&peer);
            spread.vain_tries.insert(node, tries + 1);
        }
        spread.waiting.push_back(node);
        self.serve(now, content.hash);
    }

    /// A node's cache changed.
    pub(super) fn cache_changed(
        &mut self,
        now: Instant,
        node: NodeId,
        held: &[Content],
        gone: &[ContentHash],
    ) {
        for &Content { hash, size_bytes } in held {
            if self.spreads.contents.len() >= MAX_SPREADS && !self.spreads.contents.contains_key(&hash) {
                continue;
            }
            let spread = self.spreads.contents.entry(hash).or_default();
            // An earlier version does not say it.
            if size_bytes > 0 {
                spread.size_bytes = size_bytes;
            }
            spread.forget(node);
            spread.holders.insert(node);
            self.serve(now, hash);
        }
        for &hash in gone {
            if let Some(known) = self.nodes.get_mut(&node) {
                known.holds_no_more(hash);
            }
            if let Some(spread) = self.spreads.contents.get_mut(&hash) {
                spread.forget(node);
                self.serve(now, hash);
            }
        }
    }

    /// The node is gone, or begins anew and will say what it holds.
    pub(super) fn forget_cache_of(&mut self, now: Instant, node: NodeId) {
        let named = |spread: &Spread| {
            spread.holders.contains(&node)
                || spread.from_app.contains(&node)
                || spread.from_peer.contains_key(&node)
                || spread.waiting.contains(&node)
        };
        let touched: Vec<ContentHash> =
            self.spreads.contents.iter().filter(|(_, spread)| named(spread)).map(|(&hash, _)| hash).collect();
        for hash in touched {
            if let Some(spread) = self.spreads.contents.get_mut(&hash) {
                spread.forget(node);
            }
            self.serve(now, hash);
        }
    }

    /// Sends waiting nodes to sources that are free.
    fn serve(&mut self, now: Instant, hash: ContentHash) {
        let mut sent = Vec::new();
        if let Some(spread) = self.spreads.contents.get_mut(&hash) {
            while let Some(&node) = spread.waiting.front()
                && let Some(source) = spread.source_for(node, &self.nodes)
            {
                spread.waiting.pop_front();
                match source {
                    Source::Application => drop(spread.from_app.insert(node)),
                    Source::Peer(peer) => drop(spread.from_peer.insert(node, peer)),
                }
                sent.push((node, source));
            }
            let waits = !spread.waiting.is_empty();
            spread.next_lane = waits.then(|| {
                let lane = now.after(Duration::from_millis(LANE_MS));
                spread.next_lane.map_or(lane, |earlier| earlier.min(lane))
            });
            if let Some(lane) = spread.next_lane {
                self.spreads.due = Some(self.spreads.due.map_or(lane, |due| due.min(lane)));
                self.arm(lane);
            } else if spread.is_empty() {
                self.spreads.contents.remove(&hash);
            }
        }
        for (node, source) in sent {
            self.send_to(node, hash, source);
        }
    }

    fn send_to(&mut self, node: NodeId, content: ContentHash, source: Source) {
        let peer = match source {
            Source::Application => None,
            Source::Peer(peer) => self.nodes.get(&peer).map(|peer| peer.contact.clone()),
        };
        self.tell_node(node, CoordinatorToNode::Located { content, peer });
    }

    /// What nodes wait for does not come along: one of them goes to the application.
    pub(super) fn open_lanes(&mut self, now: Instant) {
        if self.spreads.due.take_if(|due| *due <= now).is_none() {
            return;
        }
        let due = |spread: &Spread| spread.next_lane.is_some_and(|at| at <= now);
        let late: Vec<ContentHash> =
            self.spreads.contents.iter().filter(|(_, spread)| due(spread)).map(|(&hash, _)| hash).collect();
        for hash in late {
            let Some(spread) = self.spreads.contents.get_mut(&hash) else { continue };
            spread.next_lane = None;
            if let Some(node) = spread.waiting.pop_front() {
                spread.from_app.insert(node);
                self.send_to(node, hash, Source::Application);
            }
            self.serve(now, hash);
        }
        self.spreads.due = self.spreads.contents.values().filter_map(|spread| spread.next_lane).min();
    }

    /// When [`Self::open_lanes`] wants to be called.
    pub(super) const fn lanes_due(&self) -> Option<Instant> {
        self.spreads.due
    }

    /// The contents that nodes hold, the largest first, at most `most`.
    #[must_use]
    pub fn contents(&self, most: usize) -> ContentsStatus {
        let held = self.spreads.contents.iter().filter(|(_, spread)| !spread.holders.is_empty());
        let mut contents: Vec<ContentStatus> = held
            .map(|(&hash, spread)| ContentStatus {
                content: Content { hash, size_bytes: spread.size_bytes },
                nodes: spread.holders.iter().copied().collect(),
            })
            .collect();
        contents.sort_by_key(|held| (Reverse(held.content.size_bytes), held.content.hash));
        let omitted = contents.len().saturating_sub(most) as u64;
        contents.truncate(most);
        ContentsStatus { contents, omitted }
    }

    /// Has nodes drop contents that no job needs; all nodes if none is named, all contents if none is.
    pub(super) fn evict(&mut self, node: Option<NodeId>, contents: &[ContentHash]) {
        // A node of before this message would end its session over it. One that joined a heartbeat ago has said nothing yet.
        let knows = |(id, known): (&NodeId, &Node)| known.cache.is_some().then_some(*id);
        let named = |id: &NodeId| node.is_none_or(|node| node == *id);
        let asked: Vec<NodeId> = self.nodes.iter().filter_map(knows).filter(named).collect();
        for id in asked {
            self.tell_node(id, CoordinatorToNode::Evict { contents: contents.to_vec() });
        }
    }

    pub(super) fn check_spreads(&self) {
        assert!(self.spreads.contents.len() <= MAX_SPREADS, "I8: more than {MAX_SPREADS} contents are known");
        for (hash, spread) in &self.spreads.contents {
            assert!(!spread.is_empty(), "I8: {hash} is kept for nobody");
            assert_eq!(
                spread.waiting.is_empty(),
                spread.next_lane.is_none(),
                "{hash}: who waits has a bound"
            );
            let everywhere = spread
                .holders
                .iter()
                .chain(&spread.from_app)
                .chain(spread.from_peer.keys())
                .chain(&spread.waiting);
            let mut seen = BTreeSet::new();
            for node in everywhere {
                assert!(self.nodes.contains_key(node), "{hash} is on {node}, which is gone");
                assert!(seen.insert(*node), "{hash}: {node} is in two places");
            }
        }
    }
}
