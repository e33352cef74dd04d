//! `farmctl cache ...`: what nodes keep of task allocations and modules.

use farm_core::{
    coordinator::{ContentsStatus, NodeStatus},
    id::{ContentHash, NodeId},
    message::CacheFigures,
};
use serde::Serialize;

use crate::{
    admin::Admin,
    cli::{CacheVerb, Format},
    failure::Failure,
    output::{self, printable},
    target::Target,
};

/// Characters of a digest in a table: enough to tell the contents of a farm apart, and to be named by.
const SHOWN_CHARACTERS: usize = 16;
/// Least characters by which a content can be named.
const MIN_PREFIX_CHARACTERS: usize = 4;

/// Runs one of the verbs.
pub(crate) async fn run(verb: &CacheVerb, target: &Target<'_>, format: Format) -> Result<(), Failure> {
    let admin = Admin::new(target.existing().await?);
    match verb {
        CacheVerb::Ls { output } => {
            let listing = Listing::new(admin.status().await?.nodes, admin.contents().await?);
            output::print(&listing, output.unwrap_or(format), screen)
        }
        CacheVerb::Evict { contents, all: _, node } => {
            let at = match node {
                None => None,
                Some(node) => Some(admin.find_node(node).await?),
            };
            let known = admin.contents().await?;
            let named =
                contents.iter().map(|prefix| resolve(prefix, &known)).collect::<Result<Vec<_>, _>>()?;
            admin.evict(at.as_ref().map(|node| node.node), &named).await?;
            let what = match named.len() {
                0 => "everything".to_owned(),
                1 => "1 content".to_owned(),
                count => format!("{count} contents"),
            };
            let whom = at.map_or_else(|| "all nodes".to_owned(), |node| printable(&node.name));
            output::print_text(&format!("asked {whom} to drop {what} that no job needs\n"))
        }
    }
}

/// What is printed, as JSON too.
#[derive(Debug, Serialize)]
struct Listing {
    nodes: Vec<NodeLine>,
    contents: Vec<ContentLine>,
    /// Contents beyond those listed.
    omitted: u64,
}

#[derive(Debug, Serialize)]
struct NodeLine {
    node: NodeId,
    name: String,
    cache: CacheFigures,
}

#[derive(Debug, Serialize)]
struct ContentLine {
    /// blake3, in hexadecimal.
    hash: String,
    size_bytes: u64,
    nodes: Vec<NodeId>,
}

impl Listing {
    fn new(nodes: Vec<NodeStatus>, contents: ContentsStatus) -> Self {
        let nodes =
            nodes.into_iter().map(|node| NodeLine { node: node.node, name: node.name, cache: node.cache });
        let listed = contents.contents.into_iter().map(|held| ContentLine {
            hash: held.content.hash.to_string(),
            size_bytes: held.content.size_bytes,
            nodes: held.nodes,
        });
        Self { nodes: nodes.collect(), contents: listed.collect(), omitted: contents.omitted }
    }
}

fn screen(listing: &Listing, wide: bool) -> String {
    let mut nodes = output::table([
        "NODE",
        "NAME",
        "IN MEMORY",
        "BYTES",
        "ON DISK",
        "BYTES",
        "HITS",
        "FROM DISK",
        "FETCHED",
        "BYTES",
        "EVICTED",
    ]);
    for NodeLine { node, name, cache } in &listing.nodes {
        nodes.add_row([
            node.to_string(),
            printable(name),
            cache.memory_contents.to_string(),
            size(cache.memory_bytes),
            cache.disk_contents.to_string(),
            size(cache.disk_bytes),
            cache.memory_hits.to_string(),
            cache.disk_hits.to_string(),
            cache.fetches.to_string(),
            size(cache.fetched_bytes),
            (cache.memory_evictions + cache.disk_evictions).to_string(),
        ]);
    }
    let mut text = format!("{nodes}\n");
    if listing.contents.is_empty() {
        text.push_str("\nno content of 1 MiB or more is cached\n");
        return text;
    }
    let mut contents = output::table(["CONTENT", "SIZE", "NODES"]);
    for ContentLine { hash, size_bytes, nodes } in &listing.contents {
        let nodes: Vec<String> = nodes.iter().map(ToString::to_string).collect();
        let shown = if wide { hash.as_str() } else { &hash[..SHOWN_CHARACTERS] };
        contents.add_row([shown.to_owned(), size(*size_bytes), nodes.join(" ")]);
    }
    text.push_str(&format!("\n{contents}\n"));
    if listing.omitted > 0 {
        text.push_str(&format!("and {} smaller ones\n", listing.omitted));
    }
    text
}

/// The one content whose digest begins so.
fn resolve(prefix: &str, known: &ContentsStatus) -> Result<ContentHash, Failure> {
    let usage = |text: String| Failure::Usage(anyhow::anyhow!(text));
    if prefix.len() < MIN_PREFIX_CHARACTERS || !prefix.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return Err(usage(format!(
            "{prefix:?} names no content: say {MIN_PREFIX_CHARACTERS} or more hexadecimal digits of its digest, as \
             `farmctl cache ls` shows it"
        )));
    }
    let prefix = prefix.to_ascii_lowercase();
    let mut found = known.contents.iter().filter(|held| held.content.hash.to_string().starts_with(&prefix));
    match (found.next(), found.next()) {
        (Some(one), None) => Ok(one.content.hash),
        (None, _) => Err(Failure::Work(anyhow::anyhow!(
            "no content {prefix}... is listed; `farmctl cache ls` shows those that can be named"
        ))),
        (Some(_), Some(_)) => Err(usage(format!("{prefix}... names several contents: say more digits"))),
    }
}

/// Bytes for people.
pub(crate) fn size(bytes: u64) -> String {
    const UNITS: [&str; 4] = ["KiB", "MiB", "GiB", "TiB"];
    if bytes < 1_024 {
        return format!("{bytes} B");
    }
    let mut value = bytes as f64 / 1_024.0;
    let mut unit = 0;
    while value >= 1_024.0 && unit + 1 < UNITS.len() {
        value /= 1_024.0;
        unit += 1;
    }
    format!("{value:.1} {}", UNITS[unit])
}

#[cfg(test)]
mod tests {
    use farm_core::{coordinator::ContentStatus, program::Content};

    use super::*;

    fn known() -> ContentsStatus {
        let held = |first: u8, size_bytes| {
            let mut hash = [0xab; 32];
            hash[0] = first;
            ContentStatus {
                content: Content { hash: ContentHash(hash), size_bytes },
                nodes: vec![NodeId(1), NodeId(4)],
            }
        };
        ContentsStatus { contents: vec![held(1, 5 << 30), held(0x1f, 3 << 20)], omitted: 2 }
    }

    #[test]
    fn contents_are_named_by_the_beginning_of_their_digest() {
        let known = known();
        assert_eq!(resolve("01AB", &known).ok(), Some(known.contents[0].content.hash), "in any case");
        for (prefix, words) in
            [("01a", "4 or more"), ("zzzz", "hexadecimal"), ("1fff", "no content"), ("", "4 or")]
        {
            let error = resolve(prefix, &known).expect_err(prefix).describe();
            assert!(error.contains(words), "{prefix:?}: {error}");
        }
        let twins =
            ContentsStatus { contents: [known.contents.clone(), known.contents].concat(), omitted: 0 };
        assert!(resolve("01ab", &twins).expect_err("two").describe().contains("several"));
    }

    #[test]
    fn the_screen_lists_nodes_and_contents() {
        let cache = CacheFigures {
            memory_contents: 2,
            memory_bytes: 1_536,
            fetched_bytes: 7,
            ..CacheFigures::default()
        };
        let listing = Listing {
            nodes: vec![NodeLine { node: NodeId(1), name: "w\u{1b}0".to_owned(), cache }],
            ..Listing::new(Vec::new(), known())
        };
        let text = screen(&listing, false);
        for wanted in
            ["node-1", "1.5 KiB", "7 B", "01abababababab", "5.0 GiB", "3.0 MiB", "node-1 node-4", "2 smaller"]
        {
            assert!(text.contains(wanted), "{wanted:?} is missing in\n{text}");
        }
        assert!(!text.contains('\u{1b}'), "names do not steer the terminal");
        assert!(screen(&listing, true).contains(&"ab".repeat(31)), "`-o wide` shows whole digests");
    }
}
