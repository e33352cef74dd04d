//! `farmctl render`: a scene folder in, images out, through a farm.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use anyhow::{Context as _, anyhow};
use bdpt_kernel::{
    film::Image,
    job::{RenderHandle, RenderOptions, render_graph},
    output::{self, Tone},
    scene::{self, LoadedScene, model::FilmSize},
};
use client_sdk::{FarmError, RunSummary};
use serde_json::json;

use crate::{
    cli::{ProgressStyle, RenderArgs},
    embedded::EmbeddedFarm,
    failure::Failure,
    journal,
    output::{moved, print_text, taken_over},
    progress::Units,
    running::{Stops, run_graph},
    target::Target,
};

/// How long jobs may wait for a device of the own farm: its worker was registered before.
const OWN_FARM_PATIENCE: Duration = Duration::from_secs(2);

/// Renders; the exit code is 0 only when every image is complete.
pub(crate) async fn run(arguments: &RenderArgs, target: &Target<'_>) -> Result<(), Failure> {
    let mut stops = Stops::listen()?;
    for image in &arguments.images {
        output::check_writable(image)?;
    }
    let path = arguments.scene.clone();
    // A signal ends the process's main task; a scene half loaded is not worth waiting for.
    let loaded = tokio::select! {
        loaded = tokio::task::spawn_blocking(move || scene::load(&path)) => loaded.context("loading panicked")??,
        () = stops.recv() => return Err(anyhow!("interrupted while loading the scene: no image was written").into()),
    };
    report(&loaded);
    let size = arguments
        .size
        .map_or(loaded.scene.film, |size| FilmSize { width_px: size.width_px, height_px: size.height_px });
    let (graph, render) =
        render_graph(loaded.scene, RenderOptions::new(size, arguments.spp, arguments.seed))?;

    let path = journal_path(&arguments.images[0]);
    let journal = if arguments.resume {
        let FilmSize { width_px, height_px } = size;
        let label =
            format!("render, {width_px}x{height_px} px, {} spp, seed {}", arguments.spp, arguments.seed);
        Some(journal::open(&path, &label)?)
    } else {
        journal::mention(&path);
        None
    };

    let (reach, own_farm) = tokio::select! {
        farm = EmbeddedFarm::unless_named(target, &arguments.devices) => farm?,
        () = stops.recv() => return Err(anyhow!("interrupted before rendering: no image was written").into()),
    };
    let plan = render.plan();
    let jobs = plan.tile_jobs() + u64::from(plan.light_jobs());
    #[expect(clippy::cast_precision_loss, reason = "a rate for people")]
    let units = Units {
        share: Arc::new(move |now| now.jobs_done as f64 / jobs as f64),
        total: plan.total_samples() as f64,
        name: "samples",
        early: None,
    };
    let mut farm = reach.options(app_name(&arguments.scene));
    farm.policy.clone_from(&arguments.policy);
    if own_farm.is_some() {
        // Nobody else will join: a device that does not fit now never will.
        farm.patience = OWN_FARM_PATIENCE;
    }
    let result = run_graph(farm, graph, journal, arguments.progress, units, &mut stops).await;
    let of_journal = matches!(result, Err(FarmError::Journal(_)));
    let ended = finish(result, &render, arguments).await;
    match &ended {
        Ok(()) if arguments.resume => journal::remove(&path),
        Err(_) if arguments.resume && !of_journal => journal::tell_kept(&path),
        Ok(()) | Err(_) => {}
    }
    if let Some(farm) = own_farm {
        tokio::select! {
            () = farm.stop() => {}
            () = stops.recv() => {}
        }
    }
    ended
}

/// Warnings of the loader, for the one who made the scene.
fn report(loaded: &LoadedScene) {
    for warning in &loaded.report.warnings {
        tell!("farmctl: warning: {warning}");
    }
    if loaded.report.warnings_dropped > 0 {
        tell!("farmctl: warning: {} further warnings", loaded.report.warnings_dropped);
    }
}

/// Writes the images of a complete render, or what there is of an incomplete one.
async fn finish(
    result: Result<RunSummary, FarmError>,
    render: &RenderHandle,
    arguments: &RenderArgs,
) -> Result<(), Failure> {
    match result {
        Ok(summary) => {
            write_images(render.image(), arguments.images.clone(), arguments).await?;
            tell_summary(&summary, render, arguments)
        }
        Err(error) => {
            save_partial(render, arguments).await?;
            Err(Failure::of_run(error))
        }
    }
}

async fn save_partial(render: &RenderHandle, arguments: &RenderArgs) -> Result<(), Failure> {
    let image = render.partial_image();
    let progress = render.progress();
    if progress.samples == 0 {
        tell!("farmctl: nothing was rendered yet: no image was written");
        return Ok(());
    }
    // What an earlier render has finished stays.
    let paths: Vec<PathBuf> = arguments
        .images
        .iter()
        .map(|path| if path.exists() { path.with_extension(partial_extension(path)) } else { path.clone() })
        .collect();
    write_images(image, paths.clone(), arguments).await?;
    let names: Vec<String> = paths.iter().map(|path| path.display().to_string()).collect();
    let (samples, total, names) = (progress.samples, progress.total_samples, names.join(", "));
    tell!("farmctl: saved a partial image: {samples} of {total} samples, in {names}");
    Ok(())
}

/// `partial.exr` for an image in EXR.
fn partial_extension(path: &Path) -> String {
    let format = path.extension().unwrap_or_default().to_string_lossy();
    format!("partial.{format}")
}

async fn write_images(image: Image, paths: Vec<PathBuf>, arguments: &RenderArgs) -> Result<(), Failure> {
    let tone = Tone { exposure_ev: arguments.exposure };
    // One that cannot be written must not cost the others.
    let written = tokio::task::spawn_blocking(move || {
        paths.iter().filter_map(|path| output::write(path, &image, tone).err()).collect::<Vec<_>>()
    });
    let mut failures = written.await.context("writing the image panicked")?.into_iter();
    let Some(first) = failures.next() else { return Ok(()) };
    for failure in failures {
        tell!("farmctl: {failure}");
    }
    Err(first.into())
}

fn tell_summary(summary: &RunSummary, render: &RenderHandle, arguments: &RenderArgs) -> Result<(), Failure> {
    let film = render.progress();
    for (what, count) in film.counters.faults() {
        tell!("farmctl: warning: {count} {what} while rendering");
    }
    let prepare: Duration = summary.tasks.iter().map(|task| task.prepare_time).sum();
    let seconds = summary.wall_time.saturating_sub(prepare).as_secs_f64();
    // What a journal had took no time; jobs are of much the same size.
    #[expect(clippy::cast_precision_loss, reason = "a rate for people")]
    let rate = |count: u64| {
        let computed = (summary.jobs - summary.journalled) as f64 / summary.jobs.max(1) as f64;
        count as f64 * computed / seconds
    };
    let (samples_per_second, rays_per_second) = (rate(film.samples), rate(film.rays));
    if arguments.progress == ProgressStyle::Ndjson {
        let line = json!({
            "event": "done",
            "samples": film.samples,
            "light_paths": film.light_paths,
            "rays": film.rays,
            "jobs": summary.jobs,
            "jobs_journalled": summary.journalled,
            "replanned": summary.replanned,
            "prepare_seconds": prepare.as_secs_f64(),
            "render_seconds": seconds,
            "device_seconds": summary.device_time.as_secs_f64(),
            "samples_per_second": samples_per_second,
            "rays_per_second": rays_per_second,
        });
        print_text(&format!("{line}\n"))?;
    }
    let images: Vec<String> = arguments.images.iter().map(|path| path.display().to_string()).collect();
    tell!(
        "farmctl: {} written: {} jobs{} in {seconds:.1} s, {:.3} M samples/s, {:.2} M rays/s{}",
        images.join(", "),
        summary.jobs,
        taken_over(summary.journalled),
        samples_per_second / 1e6,
        rays_per_second / 1e6,
        moved(summary.replanned),
    );
    Ok(())
}

/// Where results of an image are kept while it is rendered.
fn journal_path(image: &Path) -> PathBuf {
    let mut name = image.file_name().unwrap_or(image.as_os_str()).to_owned();
    name.push(".");
    name.push(journal::EXTENSION);
    image.with_file_name(name)
}

/// What the farm calls this application.
fn app_name(scene: &Path) -> String {
    let folder = if scene.is_file() { scene.parent().unwrap_or(scene) } else { scene };
    let name = folder.file_name().unwrap_or(folder.as_os_str());
    format!("render {}", name.to_string_lossy())
}
