//! `farmctl project ...`: whose applications may have how much of the farm.

use farm_core::{
    coordinator::ProjectStatus,
    project::{Quota, QuotaChange},
};
use serde_json::json;

use super::cache::size;
use crate::{
    admin::Admin,
    cli::{Format, ProjectVerb},
    failure::Failure,
    output::{self, printable},
    target::Target,
};

/// Runs one of the verbs.
pub(crate) async fn run(verb: &ProjectVerb, target: &Target<'_>, format: Format) -> Result<(), Failure> {
    let admin = Admin::new(target.existing().await?);
    match verb {
        ProjectVerb::Ls { output } => {
            let projects = admin.status().await?.projects;
            output::print(&projects, output.unwrap_or(format), |projects, _| table(projects))
        }
        ProjectVerb::Set { project, devices, queued_jobs, bytes, weight } => {
            let change = QuotaChange {
                devices: devices.map(|bound| bound.0),
                queued_jobs: queued_jobs.map(|bound| bound.0),
                bytes: bytes.map(|bound| bound.0),
                weight: weight.map(|bound| bound.0),
            };
            let quota = admin.set_project(project, change).await?;
            let set = json!({ "project": project, "quota": quota });
            output::print(&set, format, |_, _| format!("{} may have {}\n", printable(project), words(&quota)))
        }
        ProjectVerb::Rm { project } => {
            admin.remove_project(project).await?;
            output::print_text(&format!("{} is no project any more\n", printable(project)))
        }
    }
}

/// What each project has, of what it may have.
fn table(projects: &[ProjectStatus]) -> String {
    fn of<T: ToString>(has: impl ToString, most: Option<T>) -> String {
        let most = most.map_or_else(String::new, |most| format!(" of {}", most.to_string()));
        has.to_string() + &most
    }
    let header = ["PROJECT", "APPS", "DEVICES", "QUEUED JOBS", "WAITING", "BYTES", "WEIGHT"];
    let mut table = output::table(header);
    for project in projects {
        let quota = &project.quota;
        table.add_row([
            printable(&project.project),
            project.apps.to_string(),
            of(project.devices, quota.devices),
            of(project.queued_jobs, quota.queued_jobs),
            project.waiting_jobs.to_string(),
            of(size(project.bytes), quota.bytes.map(size)),
            of(project.weight, quota.weight),
        ]);
    }
    format!("{table}\n")
}

fn counted(count: u64, what: &str) -> String {
    if count == 1 { format!("1 {what}") } else { format!("{count} {what}s") }
}

fn words(quota: &Quota) -> String {
    let bounds: Vec<String> = [
        quota.devices.map(|most| counted(most.into(), "device")),
        quota.queued_jobs.map(|most| counted(most, "queued job")),
        quota.bytes.map(size),
        quota.weight.map(|most| format!("a weight of {most}")),
    ]
    .into_iter()
    .flatten()
    .collect();
    match (quota.is_suspension(), bounds.is_empty()) {
        (true, _) => format!("nothing new, it is suspended ({})", bounds.join(", ")),
        (false, true) => "as much as there is".to_owned(),
        (false, false) => bounds.join(", "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_shows_what_a_project_has_of_what_it_may_have() {
        let quota = Quota { devices: Some(4), bytes: Some(1 << 30), ..Quota::default() };
        let project = ProjectStatus {
            project: "films\u{7}".to_owned(),
            quota,
            apps: 2,
            devices: 3,
            queued_jobs: 120,
            waiting_jobs: 7,
            bytes: 3 << 20,
            weight: 2.5,
        };
        let table = table(&[project]);
        for said in ["films\u{fffd}", "3 of 4", "120 ", "3.0 MiB of 1.0 GiB", "2.5"] {
            assert!(table.contains(said), "{said}: {table}");
        }
        assert_eq!(words(&quota), "4 devices, 1.0 GiB");
        assert_eq!(words(&Quota { queued_jobs: Some(1), ..Quota::default() }), "1 queued job");
        assert_eq!(words(&Quota::default()), "as much as there is");
        let suspended = Quota { queued_jobs: Some(0), ..Quota::default() };
        assert_eq!(words(&suspended), "nothing new, it is suspended (0 queued jobs)");
    }
}
