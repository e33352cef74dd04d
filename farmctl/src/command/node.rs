//! `farmctl node ...`: looking after nodes.

use crate::{admin::Admin, cli::NodeVerb, failure::Failure, output, target::Target};

/// Runs one of the verbs.
pub(crate) async fn run(verb: &NodeVerb, target: &Target<'_>) -> Result<(), Failure> {
    let admin = Admin::new(target.existing().await?);
    match verb {
        NodeVerb::Drain { node } => {
            let status = admin.status().await?;
            let found = status.nodes.iter().find(|candidate| {
                candidate.name == *node
                    || candidate.node.to_string() == *node
                    || candidate.node.0.to_string() == *node
            });
            let Some(found) = found else {
                let names: Vec<String> =
                    status.nodes.iter().map(|node| output::printable(&node.name)).collect();
                return Err(Failure::Work(anyhow::anyhow!(
                    "there is no node {node:?}; the farm has: {}",
                    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
                )));
            };
            admin.drain(found.node).await?;
            output::print_text(&format!("{} ({}) is draining\n", output::printable(&found.name), found.node))
        }
    }
}
