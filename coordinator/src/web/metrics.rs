//! The farm's status as Prometheus text, base units.

use std::fmt::{self, Display, Write as _};

use farm_core::{
    coordinator::{FarmStatus, NodeState, ProjectStatus},
    device::DeviceKind,
    message::CacheFigures,
    project::Quota,
};

/// One page of metrics.
pub(super) fn render(status: &FarmStatus) -> String {
    let mut page = Page(String::with_capacity(4 << 10));
    let devices =
        || status.nodes.iter().flat_map(|node| node.devices.iter().map(move |device| (node, device)));

    page.family("gleaner_epoch", "gauge", "Life of the coordinator.");
    page.sample("gleaner_epoch", &[], status.epoch.0);
    page.family("gleaner_standbys", "gauge", "Coordinators that would take over.");
    page.sample("gleaner_standbys", &[], status.standbys.len());

    page.family("gleaner_jobs_total", "counter", "Jobs by outcome since this start.");
    page.sample("gleaner_jobs_total", &[("outcome", &"delivered")], status.delivered_jobs);
    page.sample("gleaner_jobs_total", &[("outcome", &"replanned")], status.replanned_jobs);

    page.family(
        "gleaner_stolen_jobs_total",
        "counter",
        "Jobs moved between nodes by stealing since this start.",
    );
    page.sample("gleaner_stolen_jobs_total", &[], status.stolen_jobs);
    page.family(
        "gleaner_speculations_total",
        "counter",
        "Second attempts beside running ones since this start.",
    );
    page.sample("gleaner_speculations_total", &[], status.speculations);
    page.family(
        "gleaner_policy_fallbacks_total",
        "counter",
        "Batches placed first come, first served since this start because a plug-in failed.",
    );
    page.sample("gleaner_policy_fallbacks_total", &[], status.policy_fallbacks);

    page.family("gleaner_jobs", "gauge", "Jobs of the registered applications by state.");
    let waiting: u64 = status.apps.iter().map(|app| app.waiting_jobs).sum();
    let outstanding: u64 = status.apps.iter().map(|app| app.outstanding_jobs).sum();
    page.sample("gleaner_jobs", &[("state", &"waiting")], waiting);
    page.sample("gleaner_jobs", &[("state", &"outstanding")], outstanding);

    page.family("gleaner_nodes", "gauge", "Registered nodes by state.");
    for (name, state) in
        [("alive", NodeState::Alive), ("suspect", NodeState::Suspect), ("draining", NodeState::Draining)]
    {
        let count = status.nodes.iter().filter(|node| node.state == state).count();
        page.sample("gleaner_nodes", &[("state", &name)], count);
    }

    page.family("gleaner_devices", "gauge", "Devices of the registered nodes by kind.");
    for kind in [DeviceKind::Gpu, DeviceKind::Cpu, DeviceKind::Simulated] {
        let count = devices().filter(|(_, device)| device.kind == kind && !device.lost).count();
        page.sample("gleaner_devices", &[("kind", &kind)], count);
    }
    page.family("gleaner_lost_devices", "gauge", "Devices that are lost until their node starts anew.");
    page.sample("gleaner_lost_devices", &[], devices().filter(|(_, device)| device.lost).count());

    page.family("gleaner_apps", "gauge", "Registered applications by connection.");
    let connected = status.apps.iter().filter(|app| app.connected).count();
    page.sample("gleaner_apps", &[("connected", &"true")], connected);
    page.sample("gleaner_apps", &[("connected", &"false")], status.apps.len() - connected);

    page.family("gleaner_device_executed_jobs_total", "counter", "Jobs executed by each device.");
    for (node, device) in devices() {
        let labels: [Label<'_>; 2] = [("node", &node.name), ("device", &device.device.0)];
        page.sample("gleaner_device_executed_jobs_total", &labels, device.executed_jobs);
    }
    page.family("gleaner_device_time_seconds_total", "counter", "Device time of these jobs.");
    for (node, device) in devices() {
        let labels: [Label<'_>; 2] = [("node", &node.name), ("device", &device.device.0)];
        page.sample("gleaner_device_time_seconds_total", &labels, Seconds(device.device_time_ns));
    }
    page.family("gleaner_device_planned_jobs", "gauge", "Jobs planned on each device and not yet executed.");
    for (node, device) in devices() {
        let labels: [Label<'_>; 2] = [("node", &node.name), ("device", &device.device.0)];
        page.sample("gleaner_device_planned_jobs", &labels, device.planned_jobs);
    }
    caches(&mut page, status);
    page.family(
        "gleaner_app_device_time_seconds_total",
        "counter",
        "Device time received by each application.",
    );
    for app in &status.apps {
        let labels: [Label<'_>; 2] = [("app", &app.app.0), ("name", &app.name)];
        page.sample("gleaner_app_device_time_seconds_total", &labels, Seconds(app.device_time_ns));
    }
    projects(&mut page, status);
    page.0
}

/// What projects have, and their bounds, of those that have one.
fn projects(page: &mut Page, status: &FarmStatus) {
    type Figure = fn(&ProjectStatus) -> f64;
    type Most = fn(&Quota) -> Option<f64>;
    let families: [(&str, &str, Figure, Most); 4] = [
        (
            "gleaner_project_devices",
            "Devices that each project's jobs are on.",
            |project| project.devices as f64,
            |quota| quota.devices.map(f64::from),
        ),
        (
            "gleaner_project_queued_jobs",
            "Jobs of each project that are planned and not delivered.",
            |project| project.queued_jobs as f64,
            |quota| quota.queued_jobs.map(|most| most as f64),
        ),
        (
            "gleaner_project_bytes",
            "Bytes of task data and modules of each project's planned jobs.",
            |project| project.bytes as f64,
            |quota| quota.bytes.map(|most| most as f64),
        ),
        (
            "gleaner_project_weight",
            "What the fair-share weights of each project's applications come to.",
            |project| project.weight,
            |quota| quota.weight,
        ),
    ];
    page.family(
        "gleaner_project_waiting_jobs",
        "gauge",
        "Jobs of each project that wait at the coordinator.",
    );
    for project in &status.projects {
        page.sample("gleaner_project_waiting_jobs", &[("project", &project.project)], project.waiting_jobs);
    }
    for (name, help, figure, most) in families {
        page.family(name, "gauge", help);
        for project in &status.projects {
            page.sample(name, &[("project", &project.project)], figure(project));
        }
        let quota = format!("{name}_quota");
        page.family(&quota, "gauge", "Its quota, of the projects that have one.");
        for project in &status.projects {
            if let Some(most) = most(&project.quota) {
                page.sample(&quota, &[("project", &project.project)], most);
            }
        }
    }
}

/// How a kind of storage is named, and what it shows of a node's cache.
type PerStorage = [(&'static str, fn(&CacheFigures) -> u64); 2];

/// The nodes' caches of task allocations and modules.
fn caches(page: &mut Page, status: &FarmStatus) {
    let families: [(&str, &str, &str, PerStorage); 4] = [
        (
            "gleaner_cache_contents",
            "gauge",
            "Contents in the cache of each node.",
            [("memory", |cache| cache.memory_contents), ("disk", |cache| cache.disk_contents)],
        ),
        (
            "gleaner_cache_bytes",
            "gauge",
            "Their bytes.",
            [("memory", |cache| cache.memory_bytes), ("disk", |cache| cache.disk_bytes)],
        ),
        (
            "gleaner_cache_hits_total",
            "counter",
            "Contents that jobs needed and that were in the cache.",
            [("memory", |cache| cache.memory_hits), ("disk", |cache| cache.disk_hits)],
        ),
        (
            "gleaner_cache_evictions_total",
            "counter",
            "Contents that went to make room.",
            [("memory", |cache| cache.memory_evictions), ("disk", |cache| cache.disk_evictions)],
        ),
    ];
    for (name, kind, help, values) in families {
        page.family(name, kind, help);
        for node in &status.nodes {
            for (storage, value) in values {
                page.sample(name, &[("node", &node.name), ("storage", &storage)], value(&node.cache));
            }
        }
    }
    page.family("gleaner_cache_misses_total", "counter", "Contents that each node fetched from elsewhere.");
    for node in &status.nodes {
        page.sample("gleaner_cache_misses_total", &[("node", &node.name)], node.cache.fetches);
    }
    page.family("gleaner_cache_fetched_bytes_total", "counter", "Their bytes.");
    for node in &status.nodes {
        page.sample("gleaner_cache_fetched_bytes_total", &[("node", &node.name)], node.cache.fetched_bytes);
    }
}

type Label<'a> = (&'a str, &'a dyn Display);

/// Nanoseconds, shown as seconds.
struct Seconds(u64);

impl Display for Seconds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{:09}", self.0 / 1_000_000_000, self.0 % 1_000_000_000)
    }
}

/// Text in the exposition format. Writing to a string does not fail.
struct Page(String);

impl Page {
    fn family(&mut self, name: &str, kind: &str, help: &str) {
        let _ = writeln!(self.0, "# HELP {name} {help}\n# TYPE {name} {kind}");
    }

    fn sample(&mut self, name: &str, labels: &[Label<'_>], value: impl Display) {
        self.0.push_str(name);
        for (position, (label, text)) in labels.iter().enumerate() {
            let text = text.to_string().replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n");
            let opening = if position == 0 { '{' } else { ',' };
            let _ = write!(self.0, "{opening}{label}=\"{text}\"");
        }
        if !labels.is_empty() {
            self.0.push('}');
        }
        let _ = writeln!(self.0, " {value}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::web::samples;

    #[test]
    fn a_farm_reads_as_prometheus_text() {
        let text = render(&samples::farm());
        for line in [
            "gleaner_epoch 5",
            "gleaner_standbys 1",
            "gleaner_jobs_total{outcome=\"delivered\"} 40",
            "gleaner_jobs_total{outcome=\"replanned\"} 6",
            "gleaner_jobs{state=\"waiting\"} 1",
            "gleaner_nodes{state=\"alive\"} 1",
            "gleaner_devices{kind=\"gpu\"} 1",
            "gleaner_lost_devices 1",
            "gleaner_cache_bytes{node=\"n<script>\",storage=\"disk\"} 77",
            "gleaner_cache_hits_total{node=\"n<script>\",storage=\"memory\"} 5",
            "gleaner_nodes{state=\"suspect\"} 0",
            "gleaner_devices{kind=\"gpu\"} 1",
            "gleaner_apps{connected=\"true\"} 1",
            "gleaner_device_executed_jobs_total{node=\"n<script>\",device=\"0\"} 41",
            "gleaner_device_time_seconds_total{node=\"n<script>\",device=\"0\"} 2.500000000",
            "gleaner_app_device_time_seconds_total{app=\"9\",name=\"render\"} 0.004000000",
        ] {
            assert!(text.lines().any(|found| found == line), "{line} is missing in\n{text}");
        }
    }

    #[test]
    fn every_sample_belongs_to_a_family_told_before() {
        let text = render(&samples::farm());
        let mut families = Vec::new();
        for line in text.lines() {
            match line.strip_prefix("# TYPE ") {
                Some(family) => families.push(family.split(' ').next().unwrap().to_owned()),
                None if line.starts_with('#') => {}
                None => {
                    let name = line.split(['{', ' ']).next().unwrap();
                    assert_eq!(families.last().map(String::as_str), Some(name), "{line}");
                }
            }
        }
    }

    #[test]
    fn labels_are_escaped() {
        let mut page = Page(String::new());
        page.sample("a", &[("b", &"x\"y\\z\nw")], 1);
        assert_eq!(page.0, "a{b=\"x\\\"y\\\\z\\nw\"} 1\n");
    }
}
