//! The control plane's messages are of a protocol version. Requests of operators (`admin.proto`, `trust.proto`) may grow: a coordinator
//! that does not know one says so. What applications and nodes say in their sessions may not: what a peer does not know ends its
//! session. (The data plane: `tests/hostile`.)

use std::{fs, path::Path};

use farm_core::message::PROTOCOL_VERSION;

/// BLAKE3 of the version and the messages.
const SESSIONS: &str = "5ad666e2e3fb85e98f4b65983f23cc1937acb94236762d599d09a0c716bc8bea";

#[test]
fn another_message_of_a_session_is_another_version() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("proto/gleaner/v1");
    let mut hasher = blake3::Hasher::new();
    hasher.update(&PROTOCOL_VERSION.to_le_bytes());
    for file in ["apps.proto", "model.proto", "nodes.proto"] {
        let text = fs::read_to_string(folder.join(file)).unwrap();
        for line in text.lines().map(str::trim).filter(|line| !line.starts_with("//")) {
            hasher.update(line.as_bytes());
        }
    }
    let sessions = hasher.finalize().to_hex();
    assert!(
        sessions.as_str() == SESSIONS,
        "messages of sessions are not those of protocol version {PROTOCOL_VERSION}: where a peer that does not know the change would \
         be at a loss, raise it in farm-core/src/message.rs; then SESSIONS is {sessions}"
    );
}
