//! The ledger by its rules, driven by hand: which results wait to be kept, what is compared with nodes, whose results
//! count.

mod application;
mod compare;
mod kept;
mod unplanned;
