//! A figure beside its bar, one line each: printed first, then judged.

/// What a figure has to be.
#[derive(Clone, Copy, Debug)]
pub(super) enum Bar {
    AtMost(f64),
    AtLeast(f64),
    Exactly(f64),
    /// The product does not keep this bar yet: the figure is shown, and the index says why.
    GapAtMost(f64),
    /// The same.
    GapAtLeast(f64),
}

impl Bar {
    fn holds(self, seen: f64) -> bool {
        match self {
            Self::AtMost(bar) => seen <= bar,
            Self::AtLeast(bar) => seen >= bar,
            Self::Exactly(bar) => (seen - bar).abs() < f64::EPSILON,
            Self::GapAtMost(bar) => seen > bar,
            Self::GapAtLeast(bar) => seen < bar,
        }
    }

    fn text(self) -> String {
        match self {
            Self::AtMost(bar) => format!("at most {bar}"),
            Self::AtLeast(bar) => format!("at least {bar}"),
            Self::Exactly(bar) => format!("exactly {bar}"),
            Self::GapAtMost(bar) => format!("at most {bar}: GAP"),
            Self::GapAtLeast(bar) => format!("at least {bar}: GAP"),
        }
    }
}

/// Shows a figure, and fails if it misses its bar. A gap that is none any more fails too: then the index is out of date.
pub(super) fn figure(scenario: &str, what: &str, seen: f64, unit: &str, bar: Bar) {
    let shown = format!("{seen:.3}");
    let shown = if shown.contains('.') { shown.trim_end_matches('0').trim_end_matches('.') } else { &shown };
    println!("{scenario}  {what:<66} {shown:>9} {unit:<5} {}", bar.text());
    assert!(bar.holds(seen), "{scenario}: {what}: {shown} {unit}, bar {}", bar.text());
}

/// A count, as a figure.
pub(super) fn count(scenario: &str, what: &str, seen: usize, bar: Bar) {
    figure(scenario, what, f64::from(u32::try_from(seen).expect("small")), "", bar);
}

#[test]
#[should_panic(expected = "s00: too much: 2")]
fn a_missed_bar_is_seen() {
    figure("s00", "too much", 2.0, "s", Bar::AtMost(1.0));
}

#[test]
#[should_panic(expected = "GAP")]
fn a_gap_that_is_none_is_seen() {
    figure("s00", "enough", 1.0, "s", Bar::GapAtMost(1.0));
}
