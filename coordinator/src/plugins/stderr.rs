//! What a plug-in's process prints, as lines of the coordinator's log.

use tokio::{
    io::{AsyncBufReadExt as _, AsyncRead, AsyncReadExt as _, BufReader},
    time::{Duration, Instant},
};

/// Longest line that is logged in one piece, in bytes.
const MAX_LINE_BYTES: u64 = 512;
/// Lines that are logged in one window; further ones are counted.
const LINES_PER_WINDOW: u32 = 20;
/// Length of a window.
const WINDOW: Duration = Duration::from_secs(10);

/// Logs lines until the process is gone. Always reads on: a plug-in that talks much is not held up by it.
pub(super) async fn log(plugin: String, stderr: impl AsyncRead + Unpin) {
    let mut stderr = BufReader::new(stderr);
    let mut line = Vec::new();
    let mut allowance = Allowance::new(Instant::now());
    loop {
        line.clear();
        match (&mut stderr).take(MAX_LINE_BYTES).read_until(b'\n', &mut line).await {
            Ok(0) | Err(_) => return,
            Ok(_) => {}
        }
        let said = String::from_utf8_lossy(line.trim_ascii_end());
        match allowance.take(Instant::now()) {
            Verdict::Log { dropped: 0 } => tracing::info!(%plugin, "plug-in says: {said}"),
            Verdict::Log { dropped } => tracing::info!(%plugin, dropped, "plug-in says: {said}"),
            Verdict::Drop => {}
        }
    }
}

#[derive(Debug, PartialEq, Eq)]
enum Verdict {
    /// After `dropped` lines that were not.
    Log {
        dropped: u64,
    },
    Drop,
}

#[derive(Debug)]
struct Allowance {
    window_ends: Instant,
    left: u32,
    dropped: u64,
}

impl Allowance {
    fn new(now: Instant) -> Self {
        Self { window_ends: now + WINDOW, left: LINES_PER_WINDOW, dropped: 0 }
    }

    fn take(&mut self, now: Instant) -> Verdict {
        if now >= self.window_ends {
            (self.window_ends, self.left) = (now + WINDOW, LINES_PER_WINDOW);
        }
        if self.left == 0 {
            self.dropped += 1;
            return Verdict::Drop;
        }
        self.left -= 1;
        Verdict::Log { dropped: std::mem::take(&mut self.dropped) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_talker_is_cut_and_what_was_cut_is_counted() {
        let now = Instant::now();
        let mut allowance = Allowance::new(now);
        for _ in 0..LINES_PER_WINDOW {
            assert_eq!(allowance.take(now), Verdict::Log { dropped: 0 });
        }
        for _ in 0..3 {
            assert_eq!(allowance.take(now), Verdict::Drop);
        }
        assert_eq!(allowance.take(now + WINDOW), Verdict::Log { dropped: 3 });
        assert_eq!(allowance.take(now + WINDOW), Verdict::Log { dropped: 0 });
    }
}
