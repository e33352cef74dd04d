//! The event log: everything that any machine ever wanted, as one number, and as text for whoever asks.

use std::{
    fmt::{self, Debug, Write as _},
    fs::File,
    io::{BufWriter, Write as _},
};

use farm_core::time::Instant;

use super::network::Proc;

const FNV_OFFSET: u64 = 0xcbf2_9ce4_8422_2325;
const FNV_PRIME: u64 = 0x0100_0000_01b3;

/// The log of one run.
#[derive(Debug)]
pub struct Log {
    hash: Fnv,
    entries: u64,
    text: Option<BufWriter<File>>,
}

/// FNV-1a over text as it is formatted.
#[derive(Clone, Copy, Debug)]
struct Fnv(u64);

impl fmt::Write for Fnv {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for byte in text.bytes() {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(FNV_PRIME);
        }
        Ok(())
    }
}

impl Log {
    pub(super) const fn new() -> Self {
        Self { hash: Fnv(FNV_OFFSET), entries: 0, text: None }
    }

    /// Writes every further entry to a file too, and remarks between them.
    pub fn write_to(&mut self, file: File) {
        self.text = Some(BufWriter::new(file));
    }

    /// One number for the whole run: equal runs have equal ones.
    #[must_use]
    pub const fn hash(&self) -> u64 {
        self.hash.0
    }

    /// Effects logged.
    #[must_use]
    pub const fn entries(&self) -> u64 {
        self.entries
    }

    /// Enters what a machine wants.
    pub(super) fn enter(&mut self, now: Instant, proc: Proc, effect: &impl Debug) {
        self.entries += 1;
        let _ = write!(self.hash, "{now} {proc:?} {effect:?}");
        self.write(now, format_args!("{proc:?} {effect:?}"));
    }

    /// Says what happens to the machines, for people.
    pub(super) fn remark(&mut self, now: Instant, remark: &impl Debug) {
        self.write(now, format_args!("-- {remark:?}"));
    }

    fn write(&mut self, now: Instant, line: fmt::Arguments<'_>) {
        if let Some(text) = &mut self.text {
            writeln!(text, "{now} {line}").expect("the log can be written");
        }
    }
}
