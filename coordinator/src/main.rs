//! The binary `farm-coordinator`.

fn main() {}
