//! What the machines log, for whoever counts it.

use std::{
    fmt::{Debug, Write as _},
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
};

use tracing::{
    Event, Level, Metadata, Subscriber,
    field::{Field, Visit},
    span::{Attributes, Id, Record},
    subscriber::with_default,
};

/// Counts what is logged at one level or above, and formats each word of it, as a real subscriber would.
#[derive(Debug)]
struct Counter {
    level: Level,
    events: Arc<AtomicUsize>,
}

struct Words(String);

impl Visit for Words {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        let _ = write!(self.0, "{field}={value:?} ");
    }
}

impl Subscriber for Counter {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        *metadata.level() <= self.level
    }

    fn new_span(&self, _span: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _span: &Id, _values: &Record<'_>) {}

    fn record_follows_from(&self, _span: &Id, _follows: &Id) {}

    fn event(&self, event: &Event<'_>) {
        let mut words = Words(String::new());
        event.record(&mut words);
        self.events.fetch_add(usize::from(!words.0.is_empty()), Ordering::Relaxed);
    }

    fn enter(&self, _span: &Id) {}

    fn exit(&self, _span: &Id) {}
}

/// How often something is logged at this level or above while `happens`, and what comes of it.
pub(super) fn logged_while<T>(level: Level, happens: impl FnOnce() -> T) -> (usize, T) {
    let events = Arc::new(AtomicUsize::new(0));
    let counter = Counter { level, events: Arc::clone(&events) };
    let result = with_default(counter, happens);
    (events.load(Ordering::Relaxed), result)
}

/// How many errors are logged while `happens`.
pub(super) fn errors_logged_while(happens: impl FnOnce()) -> usize {
    logged_while(Level::ERROR, happens).0
}
