//! How reads are printed: a function from data to text, the same for every verb.

use comfy_table::{ContentArrangement, Table, presets};
use serde::Serialize;

use crate::{cli::Format, failure::Failure};

/// Prints `data`: as JSON by serde, or by `table(data, wide)`.
pub(crate) fn print<T: Serialize>(
    data: &T,
    format: Format,
    table: impl Fn(&T, bool) -> String,
) -> Result<(), Failure> {
    print_text(&text_of(data, format, table)?)
}

/// What [`print`] prints.
pub(crate) fn text_of<T: Serialize>(
    data: &T,
    format: Format,
    table: impl Fn(&T, bool) -> String,
) -> Result<String, Failure> {
    Ok(match format {
        Format::Json => serde_json::to_string_pretty(data)? + "\n",
        Format::Ndjson => serde_json::to_string(data)? + "\n",
        Format::Table => table(data, false),
        Format::Wide => table(data, true),
    })
}

/// Writes to stdout; a reader that went away (`| head`) is no failure.
pub(crate) fn print_text(text: &str) -> Result<(), Failure> {
    was_read(text).map(drop)
}

/// Writes to stdout; whether somebody reads it.
pub(crate) fn was_read(text: &str) -> Result<bool, Failure> {
    use std::io::Write as _;

    let mut stdout = std::io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(error.into()),
    }
}

/// What a run's last line says of jobs that got more than one attempt; nothing if none did.
pub(crate) fn moved(attempts: u64) -> String {
    match attempts {
        0 => String::new(),
        1 => ", 1 job moved or run again".to_owned(),
        _ => format!(", {attempts} jobs moved or run again"),
    }
}

/// What a run's last line says of jobs whose results were in a journal; nothing if none were.
pub(crate) fn taken_over(jobs: u64) -> String {
    if jobs == 0 { String::new() } else { format!(", {jobs} of them from the journal") }
}

/// An empty table with a header and no lines.
pub(crate) fn table<const N: usize>(header: [&str; N]) -> Table {
    let mut table = Table::new();
    table
        .load_preset(presets::NOTHING)
        .set_content_arrangement(ContentArrangement::Disabled)
        .set_header(header);
    table
}

/// Text from elsewhere (names of devices, nodes, applications) without what could steer a terminal.
pub(crate) fn printable(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { '\u{fffd}' } else { c }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_do_not_reach_the_terminal() {
        assert_eq!(printable("w0\u{1b}[2J\n"), "w0\u{fffd}[2J\u{fffd}");
    }
}
