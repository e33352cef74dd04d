//! What a farm has to survive, by the numbers of the design's research (`sched.md`, section 5): a story each, on virtual time,
//! with the criterion asserted and every figure printed beside its bar. `tests/README.md` is the index, also of those that are
//! tested elsewhere or not at all.

mod alarms;
mod balance;
mod clocks;
mod coordinator;
mod crashes;
mod devices;
mod farm;
mod figures;
mod partitions;
mod pressure;
mod versions;
