//! Under which names contents are kept on nodes: the cache's key is project and digest (20-delivery.md "Security"). Knowing a
//! digest is not having the bytes: a project's application that names a content of another project's is asked for its own.

use farm_core::{id::ContentHash, program::Content};
use serde::{Deserialize, Serialize};

/// What the names of different projects differ by.
const CONTEXT: &str = "gleaner 1 contents of a project";

/// The names of one project's contents; in an open farm, which has one project, digests are the names.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Scope(Option<[u8; blake3::KEY_LEN]>);

impl Scope {
    /// Of an open farm.
    pub const OPEN: Self = Self(None);

    /// Of a project of a secured farm.
    #[must_use]
    pub fn of(project: &str) -> Self {
        Self(Some(blake3::derive_key(CONTEXT, project.as_bytes())))
    }

    /// The name of bytes with this digest.
    #[must_use]
    pub fn name(&self, digest: ContentHash) -> ContentHash {
        self.0.map_or(digest, |key| ContentHash(*blake3::keyed_hash(&key, &digest.0).as_bytes()))
    }

    /// Names contents instead of saying their digests.
    pub fn name_all(&self, contents: &mut [Content]) {
        if self.0.is_some() {
            contents.iter_mut().for_each(|content| content.hash = self.name(content.hash));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn projects_have_names_of_their_own() {
        let digest = ContentHash([7; 32]);
        let names =
            [Scope::OPEN, Scope::of(""), Scope::of("a"), Scope::of("b")].map(|scope| scope.name(digest));
        assert_eq!(names[0], digest, "an open farm knows one project");
        for (index, name) in names.iter().enumerate() {
            assert!(!names[..index].contains(name), "{index}");
        }
        // Naming a name gives no other project's.
        assert!(!names.contains(&Scope::of("a").name(names[3])));
        assert_eq!(Scope::of("a").name(digest), names[2], "and the same ones each time");
    }
}
