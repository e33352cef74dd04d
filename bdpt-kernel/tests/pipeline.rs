//! From generated files to an image, by the parts that a farm render is made of: loader, hierarchy, plan, the jobs on this
//! machine's device, film.

mod boxes;
mod device;

use bdpt_kernel::{
    bvh::{BuildQuality, Bvh},
    film::{Film, Image},
    generate,
    gpu::{FrameParams, Integrator, NormalisedScene, PackedScene, RenderOptions, SplatLayer, TileLayer},
    plan::{Cursor, LightImage, PlannedJob, RenderPlan, TileTurn},
    scene::{self, model::FilmSize},
    twin::TwinScene,
};

use crate::{boxes::Prepared, device::Device};

/// Every layer of an image, in the order the jobs were planned.
#[derive(Clone)]
enum Layer {
    Tile(TileTurn, TileLayer),
    Splats(u32, SplatLayer),
}

fn layers(device: &Device, name: &str, plan: RenderPlan, integrator: Integrator) -> Vec<Layer> {
    let folder = tempfile::tempdir().expect("a temporary folder can be made");
    let file =
        generate::write(name.parse().expect("a known scene"), folder.path()).expect("the folder is writable");
    let normalised = NormalisedScene::new(&scene::load(&file).expect("generated scenes load").scene);
    let bvh = Bvh::build(&normalised.scene().triangles, BuildQuality::High);
    let packed = PackedScene::new(&normalised, &bvh).expect("generated scenes can be packed");
    let options = RenderOptions { integrator, ..RenderOptions::default() };
    let params = FrameParams::new(&packed, plan.size(), options).expect("the frame is sound");
    let twin = TwinScene::new(&packed, &params);
    let prepared = Prepared { packed, params, twin };
    let mut cursor = Cursor::new(plan);
    std::iter::from_fn(|| cursor.next(true, true))
        .map(|planned| match planned {
            PlannedJob::Tile(turn, job) => Layer::Tile(turn, device.tile(&prepared, job)),
            PlannedJob::Light(turn, job) => Layer::Splats(turn, device.light(&prepared, job)),
        })
        .collect()
}

fn image(plan: RenderPlan, layers: impl IntoIterator<Item = Layer>) -> Image {
    let mut film = Film::new(plan);
    for layer in layers {
        match layer {
            Layer::Tile(turn, layer) => film.add_tile(turn, layer).expect("the layer is the plan's"),
            Layer::Splats(turn, layer) => film.add_splats(turn, layer).expect("the layer is the plan's"),
        }
    }
    let progress = film.progress();
    assert!(progress.is_complete(), "all jobs are merged: {progress:?}");
    assert!(progress.counters.faults().is_empty(), "a sound render: {:?}", progress.counters);
    film.image()
}

fn plan(width: u32, height: u32, samples: u32, light_image: LightImage) -> RenderPlan {
    RenderPlan::new(FilmSize::new(width, height).expect("a small image"), samples, 5, light_image)
}

fn mean(values: &[[f32; 3]]) -> [f64; 3] {
    #[allow(clippy::cast_precision_loss, reason = "a few thousand pixels")]
    let count = values.len() as f64;
    std::array::from_fn(|c| values.iter().map(|value| f64::from(value[c])).sum::<f64>() / count)
}

#[test]
fn a_white_ball_vanishes_in_a_white_world() {
    let device = Device::open(std::time::Duration::from_millis(50));
    let plan = plan(48, 48, 32, LightImage::Traced);
    let image = image(plan, layers(&device, "furnace", plan, Integrator::Bidirectional));
    assert!(image.depth.iter().filter(|depth| **depth > 0.0).count() > 400, "the ball is in the picture");
    // The ball's outline has a radius of 17 pixels: tan(asin(1/4)) / tan(20 deg) * 24.
    let mut sky = 0;
    for (at, beauty) in image.beauty.iter().enumerate() {
        let (x, y) = (at % 48, at / 48);
        if (2 * x).abs_diff(47).pow(2) + (2 * y).abs_diff(47).pow(2) > 38_usize.pow(2) {
            assert_eq!(*beauty, [1.0; 3], "pixel ({x}, {y}) sees the sky alone");
            sky += 1;
        }
    }
    assert!(sky > 1_000, "most of the picture is sky: {sky} pixels");
    let whole = mean(&image.beauty);
    assert!(whole.iter().all(|value| (value - 1.0).abs() < 5e-3), "a mean of {whole:?} must be 1");
}

#[test]
fn the_layers_add_up_to_what_plain_paths_give_in_any_order() {
    let device = Device::open(std::time::Duration::from_millis(50));
    let with_light = plan(64, 64, 48, LightImage::Traced);
    let forward = layers(&device, "cornell-box", with_light, Integrator::Bidirectional);
    let both = image(with_light, forward.iter().cloned());
    let backward = image(with_light, forward.into_iter().rev());
    assert!(both == backward, "the order of arrival shows in the image");

    let (eye, splat) = (mean(&both.eye), mean(&both.splat));
    assert!(splat.iter().all(|value| *value > 0.0), "light paths give a part: {splat:?}");
    let alone = plan(64, 64, 96, LightImage::Left);
    let paths = mean(&image(alone, layers(&device, "cornell-box", alone, Integrator::PathTracing)).beauty);
    for c in 0..3 {
        let ratio = (eye[c] + splat[c]) / paths[c];
        assert!((ratio - 1.0).abs() < 0.02, "channel {c}: {} + {} against {}", eye[c], splat[c], paths[c]);
        // The control: without its light layer the image is darker by more than the tolerance.
        assert!(eye[c] / paths[c] < 0.97, "channel {c}: the light layer is too small to test: {}", splat[c]);
    }
}
