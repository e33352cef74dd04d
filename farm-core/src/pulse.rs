//! The heartbeats of one end of a session with the coordinator: when the next one leaves, and whether they are answered.
//!
//! Whoever lacks acknowledgements takes the other end for down (20-delivery.md, "one-way partition"), and says so with its
//! heartbeats: they may arrive all the same.

use std::time::Duration;

use crate::{message::Liveness, time::Instant};

/// When to say what.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Pulse {
    liveness: Liveness,
    next: Instant,
    answer_by: Instant,
    answers: Answers,
}

/// Whether heartbeats are answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Answers {
    /// As far as is known.
    Come,
    /// For as long as makes the coordinator suspect.
    Missing,
}

impl Pulse {
    /// The session begins.
    pub(crate) fn new(now: Instant, liveness: Liveness) -> Self {
        let (next, answer_by) = (now.after(beat(&liveness)), now.after(patience(&liveness)));
        Self { liveness, next, answer_by, answers: Answers::Come }
    }

    /// The timings of the session.
    pub(crate) const fn liveness(&self) -> &Liveness {
        &self.liveness
    }

    /// When [`Self::beat`] has something to say.
    pub(crate) fn due(&self) -> Instant {
        match self.answers {
            Answers::Come => self.next.min(self.answer_by),
            Answers::Missing => self.next,
        }
    }

    /// A heartbeat was answered.
    pub(crate) fn answered(&mut self, now: Instant) {
        self.answer_by = now.after(patience(&self.liveness));
        self.answers = Answers::Come;
    }

    /// The heartbeat that is due: whether earlier ones are answered.
    pub(crate) fn beat(&mut self, now: Instant) -> Option<Answers> {
        if self.due() > now {
            return None;
        }
        // Who overslept does not know: what came meanwhile waits to be read.
        if now.since(self.next) >= beat(&self.liveness) {
            self.answer_by = self.answer_by.max(now.after(beat(&self.liveness)));
        }
        if self.answer_by <= now {
            self.answers = Answers::Missing;
        }
        self.next = now.after(beat(&self.liveness));
        Some(self.answers)
    }
}

fn beat(liveness: &Liveness) -> Duration {
    Duration::from_millis(liveness.heartbeat_ms.max(1))
}

fn patience(liveness: &Liveness) -> Duration {
    Duration::from_millis(liveness.suspect_ms)
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn at_ms(ms: u64) -> Instant {
        Instant(ms * 1_000_000)
    }

    /// What is said when, until then, on time.
    fn said(pulse: &mut Pulse, until_ms: u64) -> Vec<(Instant, Answers)> {
        std::iter::from_fn(|| {
            let due = pulse.due();
            let answers = (due <= at_ms(until_ms)).then(|| pulse.beat(due))?;
            Some((due, answers.expect("it is due")))
        })
        .collect()
    }

    #[test]
    fn missing_answers_are_said_at_once_and_until_one_comes() {
        let mut pulse = Pulse::new(at_ms(0), Liveness::default());
        said(&mut pulse, 1_000);
        pulse.answered(at_ms(1_300));
        let expected = [
            (at_ms(2_000), Answers::Come),
            (at_ms(3_000), Answers::Come),
            (at_ms(4_000), Answers::Come),
            (at_ms(4_300), Answers::Missing),
            (at_ms(5_300), Answers::Missing),
        ];
        assert_eq!(said(&mut pulse, 6_000), expected);
        pulse.answered(at_ms(6_000));
        assert_eq!(said(&mut pulse, 6_300), [(at_ms(6_300), Answers::Come)]);
    }

    #[test]
    fn who_overslept_waits_for_what_is_still_to_be_read() {
        let mut pulse = Pulse::new(at_ms(0), Liveness::default());
        assert_eq!(pulse.beat(at_ms(60_000)), Some(Answers::Come));
        assert_eq!(pulse.beat(at_ms(61_000)), Some(Answers::Missing), "a heartbeat later it has been read");
    }
}
