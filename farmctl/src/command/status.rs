//! `farmctl status`: the farm on one screen.

use std::{collections::BTreeMap, io::IsTerminal as _, time::Duration};

use farm_core::coordinator::{AppStatus, DeviceStatus, FarmStatus, NodeState, NodeStatus};

use crate::{
    admin::Admin,
    cli::{Format, StatusArgs},
    failure::Failure,
    output::{self, printable},
    target::Target,
};

/// Prints the status once, or again and again.
pub(crate) async fn run(arguments: &StatusArgs, target: &Target<'_>, format: Format) -> Result<(), Failure> {
    let admin = Admin::new(target.existing().await?);
    let format = arguments.output.unwrap_or(format);
    let on_screen = matches!(format, Format::Table | Format::Wide) && std::io::stdout().is_terminal();
    loop {
        let mut text = output::text_of(&admin.status().await?, format, screen)?;
        if arguments.watch.is_some() && on_screen {
            // Home and clear to the end: the screen does not flicker and keeps its scrollback.
            text.insert_str(0, "\x1b[H\x1b[J");
        }
        let read = output::was_read(&text)?;
        let Some(interval) = arguments.watch.filter(|_| read) else { return Ok(()) };
        tokio::time::sleep(interval.max(Duration::from_millis(100))).await;
    }
}

/// The farm as text; `wide` adds addresses.
fn screen(status: &FarmStatus, wide: bool) -> String {
    let mut text = headline(status);
    if !status.nodes.is_empty() {
        text.push('\n');
        text.push_str(&nodes_table(&status.nodes, wide));
    }
    if !status.apps.is_empty() {
        text.push('\n');
        text.push_str(&apps_table(&status.apps, status.projects.len() > 1));
    }
    text
}

fn headline(status: &FarmStatus) -> String {
    let devices: Vec<&DeviceStatus> = status.nodes.iter().flat_map(|node| &node.devices).collect();
    let lost = devices.iter().filter(|device| device.lost).count();
    let busy = devices.iter().filter(|device| device.running_jobs > 0).count();
    let mut by_state: BTreeMap<&str, usize> = BTreeMap::new();
    for node in &status.nodes {
        *by_state.entry(state_word(node.state)).or_default() += 1;
    }
    let nodes = match by_state.is_empty() {
        true => "no nodes: start one with `farm-worker --coordinator HOST:PORT`".to_owned(),
        false => {
            by_state.iter().map(|(state, count)| format!("{count} {state}")).collect::<Vec<_>>().join(", ")
        }
    };
    let waiting: u64 = status.apps.iter().map(|app| app.waiting_jobs).sum();
    let outstanding: u64 = status.apps.iter().map(|app| app.outstanding_jobs).sum();
    // Jobs that wait while others of their application have a place are nothing to look after: they are placed in parts.
    let stuck = status.apps.iter().any(|app| app.waiting_jobs > 0 && app.outstanding_jobs == 0);
    let word = match (status.nodes.is_empty(), stuck, outstanding > 0 || busy > 0) {
        (true, _, _) => "EMPTY",
        (false, true, _) => "WAITING",
        (false, false, true) => "WORKING",
        (false, false, false) => "IDLE",
    };
    format!(
        "{word}  nodes: {nodes}  devices: {busy} of {} busy{}  jobs: {outstanding} placed, {waiting} waiting, {} delivered, \
         {} stolen, {} replanned  (coordinator {}{})\n",
        devices.len() - lost,
        if lost == 0 { String::new() } else { format!(", {lost} LOST") },
        status.delivered_jobs,
        status.stolen_jobs,
        status.replanned_jobs,
        status.epoch,
        match &status.standbys[..] {
            [] => String::new(),
            standbys => format!(", standing by: {}", printable(&standbys.join(", "))),
        },
    )
}

fn nodes_table(nodes: &[NodeStatus], wide: bool) -> String {
    let mut header =
        vec!["NODE", "NAME", "STATE", "DEVICE", "KIND", "SCORE", "QUEUED", "RUNNING", "DONE", "DEVICE TIME"];
    if wide {
        header.push("ADDRESSES");
    }
    let mut table = output::table([]);
    table.set_header(header);
    for node in nodes {
        for device in &node.devices {
            let mut row = vec![
                node.node.to_string(),
                printable(&node.name),
                if device.lost { "lost" } else { state_word(node.state) }.to_owned(),
                format!("{} {}", device.device.0, printable(&device.name)),
                device.kind.to_string(),
                score(device.score),
                device.planned_jobs.saturating_sub(u64::from(device.running_jobs)).to_string(),
                device.running_jobs.to_string(),
                device.executed_jobs.to_string(),
                seconds(device.device_time_ns),
            ];
            if wide {
                row.push(printable(&node.addresses.join(" ")));
            }
            table.add_row(row);
        }
    }
    format!("{table}\n")
}

/// A farm of one project does not name it.
fn apps_table(apps: &[AppStatus], projects: bool) -> String {
    let mut header = vec!["APP", "NAME", "LINK", "WEIGHT", "WAITING", "PLACED", "DELIVERED", "DEVICE TIME"];
    if projects {
        header.push("PROJECT");
    }
    let mut table = output::table([]);
    table.set_header(header);
    for app in apps {
        let mut row = vec![
            app.app.to_string(),
            printable(&app.name),
            if app.connected { "up" } else { "lost" }.to_owned(),
            format!("{}", app.weight),
            app.waiting_jobs.to_string(),
            app.outstanding_jobs.to_string(),
            app.delivered_jobs.to_string(),
            seconds(app.device_time_ns),
        ];
        if projects {
            row.push(printable(&app.project));
        }
        table.add_row(row);
    }
    format!("{table}\n")
}

const fn state_word(state: NodeState) -> &'static str {
    match state {
        NodeState::Alive => "alive",
        NodeState::Suspect => "suspect",
        NodeState::Draining => "draining",
    }
}

/// GFLOP/s; a software device has less than one.
fn score(gflops: f64) -> String {
    if gflops < 10.0 { format!("{gflops:.2}") } else { format!("{gflops:.0}") }
}

fn seconds(nanoseconds: u64) -> String {
    format!("{:.1} s", Duration::from_nanos(nanoseconds).as_secs_f64())
}

#[cfg(test)]
mod tests {
    use farm_core::{
        device::DeviceKind,
        id::{AppId, DeviceIndex, Epoch, NodeId},
        message::CacheFigures,
    };

    use super::*;

    fn farm() -> FarmStatus {
        let device = DeviceStatus {
            device: DeviceIndex(0),
            name: "llvmpipe".to_owned(),
            kind: DeviceKind::Cpu,
            score: 12.4,
            planned_jobs: 5,
            running_jobs: 1,
            executed_jobs: 7,
            device_time_ns: 1_500_000_000,
            lost: false,
        };
        let node = NodeStatus {
            node: NodeId(1),
            name: "w0".to_owned(),
            state: NodeState::Alive,
            addresses: vec!["127.0.0.1:7800".to_owned()],
            devices: vec![device],
            cache: CacheFigures::default(),
        };
        let app = AppStatus {
            app: AppId(3),
            name: "render".to_owned(),
            project: "films".to_owned(),
            weight: 1.0,
            connected: true,
            waiting_jobs: 0,
            outstanding_jobs: 5,
            delivered_jobs: 7,
            device_time_ns: 1_500_000_000,
        };
        FarmStatus {
            epoch: Epoch(2),
            nodes: vec![node],
            apps: vec![app],
            projects: Vec::new(),
            delivered_jobs: 7,
            replanned_jobs: 0,
            stolen_jobs: 0,
            speculations: 0,
            policy_fallbacks: 0,
            standbys: Vec::new(),
        }
    }

    #[test]
    fn the_screen_says_who_works_on_what() {
        let text = screen(&farm(), false);
        for wanted in ["WORKING", "1 alive", "1 of 1 busy", "llvmpipe", "render", "1.5 s"] {
            assert!(text.contains(wanted), "{wanted:?} is missing in\n{text}");
        }
        assert!(!text.contains("7800"), "addresses are for `-o wide`");
        assert!(screen(&farm(), true).contains("7800"), "`-o wide` shows addresses");
    }

    #[test]
    fn waiting_is_whose_jobs_have_no_place_at_all() {
        let mut status = farm();
        status.apps[0].waiting_jobs = 40;
        assert!(screen(&status, false).starts_with("WORKING"), "the next part of many");
        status.apps[0].outstanding_jobs = 0;
        assert!(screen(&status, false).starts_with("WAITING"));
    }

    #[test]
    fn who_stands_by_is_named() {
        let status = FarmStatus { standbys: vec!["process 7 of two".to_owned()], ..farm() };
        let text = screen(&status, false);
        assert!(text.contains("(coordinator epoch-2, standing by: process 7 of two)"), "{text}");
    }

    #[test]
    fn a_lost_device_is_shown_as_lost() {
        let mut status = farm();
        let mut lost = status.nodes[0].devices[0].clone();
        (lost.lost, lost.running_jobs) = (true, 0);
        status.nodes[0].devices.push(lost);
        let text = screen(&status, false);
        assert!(text.contains("1 of 1 busy, 1 LOST") && text.contains(" lost "), "{text}");
    }

    #[test]
    fn an_empty_farm_says_what_to_do() {
        let empty = FarmStatus { nodes: Vec::new(), apps: Vec::new(), ..farm() };
        assert!(screen(&empty, false).contains("farm-worker"), "{}", screen(&empty, false));
    }
}
