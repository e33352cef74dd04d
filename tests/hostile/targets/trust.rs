//! What says who somebody is: tokens, certificates, capabilities, and the files that hold them.

use std::{
    sync::LazyLock,
    time::{Duration, SystemTime},
};

use proto::trust::{
    Authority, Capability, IDENTITY_LIFETIME, Identity, JoinToken, Member, Membership, NewKey, Principal,
    Role,
};

use super::{Verdict, refused, state::Folder, text};

/// An authority of no farm, whose identities are the corpus. The key is public: it guards nothing.
const AUTHORITY_PEM: &str = include_str!("../../../fuzz/corpus/authority_file/valid-authority");
/// A node's identity of that authority.
const NODE_PEM: &str = include_str!("../../../fuzz/corpus/identity_file/valid-node");
/// Within the lives of the certificates in the corpus: 2027-01-01, in seconds since 1970.
const NOW: Duration = Duration::from_secs(1_798_761_600);

/// The authority of the corpus.
pub(crate) fn authority() -> Authority {
    Folder::new()
        .with("authority.pem", AUTHORITY_PEM.as_bytes(), Authority::read)
        .expect("it is in the corpus")
}

/// A node of its farm.
pub(crate) fn node() -> Identity {
    Folder::new().with("node.pem", NODE_PEM.as_bytes(), Identity::read).expect("it is in the corpus")
}

/// When the certificates of the corpus are read.
pub(crate) fn now() -> SystemTime {
    SystemTime::UNIX_EPOCH + NOW
}

/// Whose the capability of the corpus is.
pub(crate) fn holder() -> Principal {
    Principal::new("hostile", Role::App, "a").expect("a name")
}

pub(super) fn join_token(bytes: &[u8]) -> Verdict {
    let token: JoinToken = text(bytes)?.parse().map_err(refused)?;
    assert!(
        token.to_string().parse::<JoinToken>().is_ok_and(|again| again == token),
        "a token comes back another"
    );
    Ok(())
}

pub(super) fn principal(bytes: &[u8]) -> Verdict {
    let text = text(bytes)?;
    let principal: Principal = text.parse().map_err(refused)?;
    assert_eq!(principal.to_string(), text, "a principal has one text");
    Ok(())
}

/// What a peer shows in a handshake.
pub(super) fn certificate(bytes: &[u8]) -> Verdict {
    Member::of_certificate(bytes).map(drop).map_err(refused)
}

/// What a coordinator answers to who joins or renews: a certificate, beside its authority.
pub(super) fn membership(bytes: &[u8]) -> Verdict {
    thread_local! {
        // Its renewals are written where it was read from.
        static NODE: (Identity, Folder) = {
            let folder = Folder::new();
            (folder.with("node.pem", NODE_PEM.as_bytes(), Identity::read).expect("it is in the corpus"), folder)
        };
    }
    static AUTHORITY: LazyLock<Authority> = LazyLock::new(authority);
    let renewal = Membership { certificate_der: bytes.to_vec(), authority_der: Vec::new() };
    let renewed = NODE.with(|(node, _)| node.renew(&renewal));
    let key = NewKey::generate().map_err(refused)?;
    let given = AUTHORITY
        .admit(Role::Node, "n", &key.request().map_err(refused)?, IDENTITY_LIFETIME)
        .map_err(refused)?;
    let joined = key.join(&Membership { authority_der: bytes.to_vec(), ..given }).map(drop);
    joined.map_err(refused).or_else(|_| renewed.map_err(refused))
}

/// What somebody who joins asks for.
pub(super) fn signing_request(bytes: &[u8]) -> Verdict {
    static AUTHORITY: LazyLock<Authority> = LazyLock::new(authority);
    AUTHORITY.admit(Role::Node, "n", bytes, IDENTITY_LIFETIME).map(drop).map_err(refused)
}

/// What an application shows to a node.
pub(super) fn capability(bytes: &[u8]) -> Verdict {
    static NODE: LazyLock<Identity> = LazyLock::new(node);
    Capability::check(bytes, &NODE, &holder(), now()).map(drop).map_err(refused)
}

pub(super) fn identity_file(bytes: &[u8]) -> Verdict {
    let identity =
        Folder::of_thread(|folder| folder.with("identity.pem", bytes, Identity::read)).map_err(refused)?;
    let _ = (identity.renew_at(), identity.is_over(), identity.member().map_err(refused)?);
    Ok(())
}

pub(super) fn authority_file(bytes: &[u8]) -> Verdict {
    Folder::of_thread(|folder| folder.with("authority.pem", bytes, Authority::read))
        .map(drop)
        .map_err(refused)
}
