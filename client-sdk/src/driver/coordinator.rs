//! The connection to the coordinator: one session at a time, and tries with back-off for a bounded time when it is lost.
//! It never looks into messages.

use std::time::Duration;

use bytes::Bytes;
use farm_core::message::AppToCoordinator;
use proto::{
    control::{SessionError, SessionReceiver, SessionSender, connect_app},
    trust::Identity,
};
use tokio::{sync::mpsc, time::Instant};

use super::{AppSession, CoordinatorToApp, Input};

/// Pause before the first try after a loss; doubles with each.
const FIRST_BACK_OFF: Duration = Duration::from_millis(100);
/// Longest pause between two tries.
const LONGEST_BACK_OFF: Duration = Duration::from_secs(3);

pub(super) struct Coordinator {
    address: String,
    identity: Option<Identity>,
    /// By which a secured farm knows the application when it comes back.
    capability: Bytes,
    reconnect_timeout: Duration,
    inputs: mpsc::Sender<Input>,
    /// Number of the newest session.
    serial: u64,
    state: State,
    /// Since when there is no registration, if there was one that was lost.
    loss: Option<Loss>,
}

enum State {
    /// A session stands (registered or about to be).
    Up(SessionSender<AppToCoordinator>),
    /// A try is on its way.
    Trying,
    /// The next try waits for its time.
    BackingOff { until: Instant },
    /// No further try.
    GivenUp,
}

struct Loss {
    since: Instant,
    tries: u32,
    reason: String,
}

/// The coordinator did not come back.
#[derive(Debug)]
pub(super) struct GaveUp {
    pub(super) waited: Duration,
    pub(super) reason: String,
}

impl Coordinator {
    pub(super) const fn new(
        address: String,
        identity: Option<Identity>,
        reconnect_timeout: Duration,
        inputs: mpsc::Sender<Input>,
    ) -> Self {
        Self {
            address,
            identity,
            capability: Bytes::new(),
            reconnect_timeout,
            inputs,
            serial: 0,
            state: State::Trying,
            loss: None,
        }
    }

    pub(super) fn keep(&mut self, capability: Bytes) {
        self.capability = capability;
    }

    pub(super) const fn is_current(&self, serial: u64) -> bool {
        matches!(self.state, State::Up(_)) && self.serial == serial
    }

    /// Whether a new session is wanted: a try may end after the farm was given up.
    pub(super) const fn is_trying(&self) -> bool {
        matches!(self.state, State::Trying)
    }

    pub(super) const fn is_lost(&self) -> bool {
        self.loss.is_some()
    }

    /// A session stands: listens on it.
    pub(super) fn connected(&mut self, session: AppSession) {
        self.serial += 1;
        self.state = State::Up(session.sender);
        tokio::spawn(listen(self.serial, session.receiver, self.inputs.clone()));
    }

    /// The loss, if there was one, is over.
    pub(super) fn welcomed(&mut self) {
        self.loss = None;
    }

    /// # Errors
    /// The coordinator does not take messages in; the session is to be given up.
    pub(super) fn send(&self, message: AppToCoordinator) -> Result<(), SessionError> {
        let State::Up(sender) = &self.state else { return Ok(()) };
        match sender.try_send(message) {
            Err(SessionError::Full) => Err(SessionError::Full),
            // An ended session is reported by its listener.
            Ok(()) | Err(_) => Ok(()),
        }
    }

    /// A try gave no session, or the session is over: waits before the next.
    pub(super) fn lost(&mut self, error: &SessionError, now: Instant) {
        if matches!(self.state, State::GivenUp) {
            return;
        }
        let loss = self.loss.get_or_insert_with(|| Loss { since: now, tries: 0, reason: String::new() });
        loss.reason = error.to_string();
        let back_off = FIRST_BACK_OFF.saturating_mul(1 << loss.tries.min(16)).min(LONGEST_BACK_OFF);
        loss.tries += 1;
        self.state = State::BackingOff { until: now + back_off };
    }

    pub(super) fn next_wake(&self) -> Option<Instant> {
        let next_try = match self.state {
            State::BackingOff { until } => Some(until),
            State::Up(_) | State::Trying => None,
            State::GivenUp => return None,
        };
        let end = self.loss.as_ref().map(|loss| loss.since + self.reconnect_timeout);
        next_try.into_iter().chain(end).min()
    }

    /// Starts the try that is due; says when it is time to give up.
    pub(super) fn act_on_timers(&mut self, now: Instant) -> Option<GaveUp> {
        if matches!(self.state, State::GivenUp) {
            return None;
        }
        if let Some(loss) = &self.loss {
            let waited = now.saturating_duration_since(loss.since);
            if waited >= self.reconnect_timeout {
                return Some(GaveUp { waited, reason: loss.reason.clone() });
            }
        }
        if matches!(self.state, State::BackingOff { until } if until <= now) {
            self.state = State::Trying;
            let (address, identity) = (self.address.clone(), self.identity.clone());
            let (inputs, capability) = (self.inputs.clone(), self.capability.clone());
            tokio::spawn(async move {
                let outcome = connect_app(&address, identity.as_ref(), &capability).await;
                // Without an owner task nobody wants the session.
                let _ = inputs.send(Input::CoordinatorTried(outcome)).await;
            });
        }
        None
    }

    /// No further try, no further word.
    pub(super) fn give_up(&mut self) {
        self.state = State::GivenUp;
    }

    /// Lets what is queued be sent, and nothing after it. Gives the session's number, if there was one.
    pub(super) fn say_no_more(&mut self) -> Option<u64> {
        let up = matches!(self.state, State::Up(_));
        self.state = State::GivenUp;
        up.then_some(self.serial)
    }
}

/// Passes a session's messages on until it ends.
async fn listen(serial: u64, mut receiver: SessionReceiver<CoordinatorToApp>, inputs: mpsc::Sender<Input>) {
    loop {
        let (input, over) = match receiver.recv().await {
            Ok(message) => (Input::CoordinatorSaid { serial, message }, false),
            Err(error) => (Input::CoordinatorEnded { serial, error }, true),
        };
        if inputs.send(input).await.is_err() || over {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tries_get_rarer_and_end() {
        let (inputs, _receiver) = mpsc::channel(1);
        let mut coordinator = Coordinator::new("nowhere:1".to_owned(), None, Duration::from_secs(30), inputs);
        let start = Instant::now();
        let gone = SessionError::Ended { reason: "gone".to_owned() };
        let mut pauses = Vec::new();
        for _ in 0..8 {
            coordinator.lost(&gone, start);
            let State::BackingOff { until } = coordinator.state else { panic!("a failed try backs off") };
            pauses.push(until - start);
        }
        assert_eq!(pauses[0], FIRST_BACK_OFF);
        assert_eq!(pauses[1], 2 * FIRST_BACK_OFF);
        assert_eq!(pauses[7], LONGEST_BACK_OFF);
        assert!(coordinator.is_lost());
        let gave_up = coordinator.act_on_timers(start + Duration::from_secs(30)).expect("30 s are over");
        assert_eq!(gave_up.waited, Duration::from_secs(30));
        assert_eq!(gave_up.reason, gone.to_string());
        coordinator.give_up();
        assert_eq!(coordinator.next_wake(), None);
        assert!(coordinator.act_on_timers(start + Duration::from_secs(60)).is_none(), "given up once");
    }
}
