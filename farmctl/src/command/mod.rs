//! One file per verb: checked arguments in, work done through the libraries, a `Failure` or nothing out.

pub(crate) mod alignment;
pub(crate) mod cache;
pub(crate) mod membership;
pub(crate) mod mi;
pub(crate) mod node;
pub(crate) mod project;
pub(crate) mod render;
pub(crate) mod scene;
pub(crate) mod status;
pub(crate) mod timeline;
pub(crate) mod up;
pub(crate) mod version;
