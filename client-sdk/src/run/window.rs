//! How many jobs may be dispatched now: the bound on an application's memory (thesis 5.4.2: "we only handle a batch of
//! proxy objects at a time"). Pure arithmetic; never sees a job.

use crate::options::Window;

/// What is dispatched and not yet retrieved.
#[derive(Clone, Copy, Debug)]
pub(super) struct WindowUse {
    bounds: Window,
    jobs: usize,
    program_bytes: usize,
    /// Size of a program by the last chunk dispatched; 0 before the first.
    program_bytes_each: usize,
}

/// Jobs dispatched before the size of their programs is known.
const FIRST_JOBS: usize = 16;
/// A window that is this share of its capacity free is refilled; less waits, so that batches stay large.
const REFILL_SHARE: usize = 8;

impl WindowUse {
    pub(super) const fn new(bounds: Window) -> Self {
        Self { bounds, jobs: 0, program_bytes: 0, program_bytes_each: 0 }
    }

    /// How many of `pending` jobs to dispatch now.
    pub(super) fn admits(&self, pending: usize) -> usize {
        let (capacity, room) = if self.program_bytes_each == 0 {
            let capacity = self.bounds.jobs.min(FIRST_JOBS);
            (capacity, capacity.saturating_sub(self.jobs))
        } else {
            let by_bytes = |bytes: usize| bytes / self.program_bytes_each;
            let capacity = self.bounds.jobs.min(by_bytes(self.bounds.program_bytes));
            let room_bytes = self.bounds.program_bytes.saturating_sub(self.program_bytes);
            (capacity, self.bounds.jobs.saturating_sub(self.jobs).min(by_bytes(room_bytes)))
        };
        // One job goes out whatever its size.
        let room = if self.jobs == 0 { room.max(1) } else { room };
        let refill = (capacity / REFILL_SHARE).max(1);
        if pending <= room || room >= refill { pending.min(room) } else { 0 }
    }

    pub(super) fn dispatched(&mut self, jobs: usize, program_bytes: usize) {
        self.jobs += jobs;
        self.program_bytes += program_bytes;
        self.program_bytes_each = program_bytes.checked_div(jobs).unwrap_or(self.program_bytes_each).max(1);
    }

    pub(super) fn retrieved(&mut self, program_bytes: usize) {
        self.jobs = self.jobs.checked_sub(1).expect("only dispatched jobs are retrieved");
        self.program_bytes =
            self.program_bytes.checked_sub(program_bytes).expect("a program leaves as large as it entered");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn window(jobs: usize, program_bytes: usize) -> WindowUse {
        WindowUse::new(Window { jobs, program_bytes, ..Window::default() })
    }

    #[test]
    fn small_programs_are_bounded_by_number() {
        let mut window = window(100, 1 << 20);
        assert_eq!(window.admits(1), 1);
        assert_eq!(window.admits(1_000), FIRST_JOBS);
        window.dispatched(16, 16 * 10);
        assert_eq!(window.admits(1_000), 84);
        window.dispatched(84, 84 * 10);
        assert_eq!(window.admits(1_000), 0);
        (0..11).for_each(|_| window.retrieved(10));
        assert_eq!(window.admits(1_000), 0, "an eighth of 100 is 12: not worth a batch yet");
        assert_eq!(window.admits(5), 5, "what fits whole does not wait");
        window.retrieved(10);
        assert_eq!(window.admits(1_000), 12);
    }

    #[test]
    fn large_programs_are_bounded_by_bytes() {
        let mut window = window(8_192, 1_000);
        window.dispatched(2, 600);
        assert_eq!(window.admits(50), 1);
        window.dispatched(1, 300);
        assert_eq!(window.admits(50), 0);
        window.retrieved(300);
        assert_eq!(window.admits(50), 1, "the share is of what fits by bytes, not of 8,192");
    }

    #[test]
    fn a_program_over_the_bound_goes_out_alone() {
        let mut window = window(8, 100);
        window.dispatched(1, 5_000);
        assert_eq!(window.admits(3), 0);
        window.retrieved(5_000);
        assert_eq!(window.admits(3), 1);
    }
}
