//! `farmctl node ...`: looking after nodes.

use crate::{admin::Admin, cli::NodeVerb, failure::Failure, output, target::Target};

/// Runs one of the verbs.
pub(crate) async fn run(verb: &NodeVerb, target: &Target<'_>) -> Result<(), Failure> {
    let admin = Admin::new(target.existing().await?);
    match verb {
        NodeVerb::Drain { node } => {
            let found = admin.find_node(node).await?;
            admin.drain(found.node).await?;
            output::print_text(&format!("{} ({}) is draining\n", output::printable(&found.name), found.node))
        }
    }
}
