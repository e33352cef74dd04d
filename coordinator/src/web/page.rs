//! The status page: server-rendered, no script; the browser asks again every two seconds.

use std::fmt::{self, Display, Write as _};

use farm_core::coordinator::{FarmStatus, NodeState};

const HEAD: &str = r#"<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="refresh" content="2"><title>Gleaner</title><style>
:root { color-scheme: light dark; --line: #8884; --soft: #888; --good: #1a7f37; --bad: #b35900; }
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem; }
h1 { font-size: 1.4rem } h2 { font-size: 1.1rem; margin-top: 2rem }
table { border-collapse: collapse; width: 100% } th, td { padding: .3rem .6rem; text-align: left; border-bottom: 1px solid var(--line) }
th { color: var(--soft); font-weight: 500 } td.n, th.n { text-align: right; font-variant-numeric: tabular-nums }
.alive { color: var(--good) } .suspect, .draining, .gone, .lost { color: var(--bad) } .none { color: var(--soft) }
@media (prefers-color-scheme: dark) { :root { --good: #57c36f; --bad: #f0a050 } }
</style></head><body>
"#;

/// The whole page. Everything that a peer named is escaped.
pub(super) fn render(status: &FarmStatus) -> String {
    let mut page = String::with_capacity(8 << 10);
    page.push_str(HEAD);
    // Writing to a string does not fail.
    let _ = write_body(&mut page, status);
    page.push_str("</body></html>\n");
    page
}

fn write_body(page: &mut String, status: &FarmStatus) -> fmt::Result {
    let devices = status.nodes.iter().flat_map(|node| &node.devices).filter(|device| !device.lost).count();
    writeln!(
        page,
        "<h1>Gleaner</h1><p>{} nodes, {devices} devices, {} applications; {} jobs delivered, {} stolen, {} replanned; {}{}{}.</p>",
        status.nodes.len(),
        status.apps.len(),
        status.delivered_jobs,
        status.stolen_jobs,
        status.replanned_jobs,
        status.epoch,
        if status.standbys.is_empty() { "" } else { "; standing by: " },
        Escaped(&status.standbys.join(", "))
    )?;
    write_nodes(page, status)?;
    write_apps(page, status)?;
    page.push_str("<p class=none><a href=\"/metrics\">metrics</a> · <a href=\"/status.json\">JSON</a></p>\n");
    Ok(())
}

fn write_nodes(page: &mut String, status: &FarmStatus) -> fmt::Result {
    page.push_str("<h2>Nodes and devices</h2>\n");
    if status.nodes.is_empty() {
        page.push_str("<p class=none>No node is registered. <code>farm-worker --coordinator HOST:PORT</code> adds one.</p>\n");
        return Ok(());
    }
    page.push_str(
        "<table><thead><tr><th>node<th>state<th>device<th>kind<th class=n>score<th class=n>planned<th class=n>running\
         <th class=n>executed<th class=n>device time</tr></thead><tbody>\n",
    );
    for node in &status.nodes {
        let state = match node.state {
            NodeState::Alive => "alive",
            NodeState::Suspect => "suspect",
            NodeState::Draining => "draining",
        };
        let addresses = node.addresses.join(", ");
        let head = format!(
            "<td title=\"{}\">{} <span class=none>{}</span><td class={state}>{state}",
            Escaped(&addresses),
            Escaped(&node.name),
            node.node
        );
        if node.devices.is_empty() {
            writeln!(page, "<tr>{head}<td class=none colspan=7>no device</tr>")?;
        }
        for device in &node.devices {
            writeln!(
                page,
                "<tr>{head}<td>{} {}{}<td>{}<td class=n>{:.1}<td class=n>{}<td class=n>{}<td class=n>{}<td class=n>{}</tr>",
                device.device.0,
                Escaped(&device.name),
                if device.lost { " <span class=lost>lost</span>" } else { "" },
                device.kind,
                device.score,
                device.planned_jobs,
                device.running_jobs,
                device.executed_jobs,
                DeviceTime(device.device_time_ns),
            )?;
        }
    }
    page.push_str("</tbody></table>\n");
    Ok(())
}

fn write_apps(page: &mut String, status: &FarmStatus) -> fmt::Result {
    page.push_str("<h2>Applications</h2>\n");
    if status.apps.is_empty() {
        page.push_str("<p class=none>No application is registered.</p>\n");
        return Ok(());
    }
    page.push_str(
        "<table><thead><tr><th>application<th>connection<th class=n>weight<th class=n>waiting<th class=n>outstanding\
         <th class=n>delivered<th class=n>device time</tr></thead><tbody>\n",
    );
    for app in &status.apps {
        let connection = if app.connected { "alive" } else { "gone" };
        writeln!(
            page,
            "<tr><td>{} <span class=none>{}</span><td class={connection}>{connection}<td class=n>{}<td class=n>{}\
             <td class=n>{}<td class=n>{}<td class=n>{}</tr>",
            Escaped(&app.name),
            app.app,
            app.weight,
            app.waiting_jobs,
            app.outstanding_jobs,
            app.delivered_jobs,
            DeviceTime(app.device_time_ns),
        )?;
    }
    page.push_str("</tbody></table>\n");
    Ok(())
}

/// Nanoseconds, shown as seconds to the millisecond.
struct DeviceTime(u64);

impl Display for DeviceTime {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{:03} s", self.0 / 1_000_000_000, self.0 / 1_000_000 % 1_000)
    }
}

/// Text that means no markup, in elements and in quoted attributes.
struct Escaped<'a>(&'a str);

impl Display for Escaped<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.chars().try_for_each(|letter| match letter {
            '&' => f.write_str("&amp;"),
            '<' => f.write_str("&lt;"),
            '>' => f.write_str("&gt;"),
            '"' => f.write_str("&quot;"),
            '\'' => f.write_str("&#39;"),
            other => f.write_char(other),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::web::samples;

    #[test]
    fn a_farm_is_shown_and_names_are_escaped() {
        let page = render(&samples::farm());
        for part in [
            "n&lt;script&gt;",
            "a &lt;b&gt;&quot;GPU&quot;&lt;/b&gt; &amp; \\co",
            "1234.5",
            "2.500 s",
            "epoch-5; standing by: process 7 of &lt;two&gt;.",
        ] {
            assert!(page.contains(part), "{part} is missing in\n{page}");
        }
        assert!(!page.contains("<script"), "a name became markup");
        assert!(page.contains("color-scheme: light dark"), "light and dark");
    }

    #[test]
    fn an_empty_farm_says_what_to_do() {
        let status = FarmStatus { nodes: Vec::new(), apps: Vec::new(), ..samples::farm() };
        assert!(render(&status).contains("farm-worker --coordinator"), "the next command");
    }
}
