//! `farmctl timeline`: what ran when and where.

use anyhow::Context as _;
use farm_core::{
    coordinator::timeline::{MAX_SEGMENTS, Timeline, TimelineApp, TimelineHead, TimelineQuery},
    id::{AppId, TaskId},
};

use crate::{
    admin::Admin,
    cli::{Format, TimelineArgs, TimelineFormat},
    failure::Failure,
    output::{self, printable},
    target::Target,
    timeline::{Chart, perfetto, summary, svg},
};

/// Asks, draws, and writes.
pub(crate) async fn run(
    arguments: &TimelineArgs,
    target: &Target<'_>,
    format: Format,
) -> Result<(), Failure> {
    let admin = Admin::new(target.existing().await?);
    let everything = TimelineQuery { app: None, task: None, max_segments: 0 };
    let head = admin.timeline(everything).await?.head;
    let (app, task) = choose(&arguments.task, &head)?;
    let timeline = admin.timeline(TimelineQuery { app, task, max_segments: MAX_SEGMENTS }).await?;
    let text = match arguments.output.unwrap_or_else(|| format.into()) {
        TimelineFormat::Svg => svg::picture(&Chart::new(&timeline)),
        TimelineFormat::Perfetto => serde_json::to_string(&perfetto::trace(&Chart::new(&timeline)))? + "\n",
        TimelineFormat::Json => serde_json::to_string(&timeline)? + "\n",
        TimelineFormat::Table => table(&timeline),
    };
    match &arguments.out {
        None => output::print_text(&text),
        Some(path) => {
            std::fs::write(path, text).with_context(|| format!("{} cannot be written", path.display()))?;
            Ok(())
        }
    }
}

fn table(timeline: &Timeline) -> String {
    let TimelineHead { dropped_segments: dropped, omitted_segments: omitted, .. } = timeline.head;
    let mut text = summary::table(&Chart::new(timeline));
    if omitted > 0 || dropped > 0 {
        text += &format!("{omitted} older jobs are left out, {dropped} of all applications are forgotten\n");
    }
    text
}

/// What a name of the command line means in this farm.
fn choose(name: &str, head: &TimelineHead) -> Result<(Option<AppId>, Option<TaskId>), Failure> {
    let unknown = || Failure::Work(anyhow::anyhow!("nothing of {name:?} ran; {}", listing(&head.apps)));
    match name {
        "@all" => return Ok((None, None)),
        "@last" => {
            let last = head.apps.last().ok_or_else(unknown)?;
            return Ok((Some(last.app), None));
        }
        _ => {}
    }
    let (app, task) = match name.split_once('/') {
        Some((app, task)) => (app, Some(task)),
        None => (name, None),
    };
    let wanted: AppId =
        format!("app-{}", app.strip_prefix("app-").unwrap_or(app)).parse().map_err(|_| unknown())?;
    // A number alone is of any life of the coordinator where the first one had none.
    let of_number = || head.apps.iter().rev().find(|ran| u64::from(ran.app.number()) == wanted.0);
    let found = head.apps.iter().find(|ran| ran.app == wanted).or_else(of_number).ok_or_else(unknown)?;
    let Some(task) = task else { return Ok((Some(found.app), None)) };
    let task = task.strip_prefix("task-").unwrap_or(task);
    let ran = found.tasks.iter().map(|(task, _)| *task).find(|ran| ran.0.to_string() == task);
    Ok((Some(found.app), Some(ran.ok_or_else(unknown)?)))
}

/// Most applications named in an error.
const MAX_LISTED: usize = 20;

fn listing(apps: &[TimelineApp]) -> String {
    if apps.is_empty() {
        return "nothing has run yet".to_owned();
    }
    let newest = apps.iter().rev().take(MAX_LISTED);
    let names: Vec<String> = newest
        .map(|app| format!("{} ({}, {} tasks)", app.app, printable(&app.name), app.tasks.len()))
        .collect();
    format!("there is @all, {}", names.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn head() -> TimelineHead {
        let app = |id| TimelineApp {
            app: AppId(id),
            name: "render".to_owned(),
            tasks: vec![(TaskId(0), 5), (TaskId(2), 1)],
        };
        TimelineHead {
            apps: vec![app(1), app(3), app(6 << 32 | 3), app(8 << 32 | 4)],
            ..TimelineHead::default()
        }
    }

    #[test]
    fn names_mean_applications_and_tasks() {
        let (third, last) = (Some(AppId(3)), Some(AppId(8 << 32 | 4)));
        for (name, meant) in [
            ("@last", (last, None)),
            ("app-9.4", (last, None)),
            ("4/2", (last, Some(TaskId(2)))),
            ("7.3", (Some(AppId(6 << 32 | 3)), None)),
            ("@all", (None, None)),
            ("3", (third, None)),
            ("app-3", (third, None)),
            ("app-3/task-2", (third, Some(TaskId(2)))),
            ("3/0", (third, Some(TaskId(0)))),
        ] {
            assert_eq!(choose(name, &head()).unwrap(), meant, "{name}");
        }
    }

    #[test]
    fn an_unknown_name_is_answered_with_what_there_is() {
        for name in ["2", "app-2", "3/1", "3/", "", "task-0", "app-app-3", "5.4"] {
            let text = choose(name, &head()).unwrap_err().describe();
            assert!(text.contains("app-1 (render, 2 tasks)") && text.contains("app-3"), "{name:?}: {text}");
        }
        assert!(
            choose("@last", &TimelineHead::default()).unwrap_err().describe().contains("nothing has run")
        );
    }
}
