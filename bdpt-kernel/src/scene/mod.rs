//! Scenes: the model after loading, and how files become it.

pub mod model;
