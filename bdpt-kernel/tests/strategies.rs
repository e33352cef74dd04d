//! Unlike estimators of one image agree: bidirectional, path tracing, light tracing, each strategy by itself, and rooms
//! whose radiance is known (50-bdpt.md section 6). On the twins, which `gpu_vs_twin` ties to the kernels.

mod boxes;

use std::collections::BTreeMap;

use bdpt_kernel::{
    gpu::{Integrator, RenderOptions},
    scene::model::{Bsdf, Camera, Scene},
    twin::{
        TwinScene,
        eye::{Strategy, Tally, eye},
        light::{SplatTally, light},
        math::luminance,
    },
};
use boxes::{Builder, Furniture};
use glam::Vec3;

const EDGE_PX: u32 = 32;
const BLOCK_PX: u32 = 8;
const BLOCKS: usize = 16;
/// Independent parts of an estimate, whose spread is its error.
const BATCHES: u32 = 32;
const SEED: u64 = 2_026;

/// Which contributions count.
#[derive(Clone, Copy, PartialEq)]
enum Estimator {
    /// As the kernels do.
    Bidirectional,
    /// Without light jobs.
    NoLightImage,
    /// s <= 1 only.
    PathTracing,
    /// Only t = 1, unweighted, and emitters seen directly, which it cannot make.
    LightTracing,
}

/// Mean luminance by block, and the variance of that mean.
struct Image {
    mean: [f64; BLOCKS],
    variance: [f64; BLOCKS],
}

impl Image {
    fn of(batches: &[[f64; BLOCKS]]) -> Self {
        let n = batches.len() as f64;
        let mean = std::array::from_fn(|b| batches.iter().map(|batch| batch[b]).sum::<f64>() / n);
        let variance = std::array::from_fn(|b| {
            batches.iter().map(|batch| (batch[b] - mean[b]).powi(2)).sum::<f64>() / (n - 1.0) / n
        });
        Self { mean, variance }
    }

    fn scaled(mut self, factor: f64) -> Self {
        self.mean.iter_mut().for_each(|m| *m *= factor);
        self
    }

    fn total(&self) -> f64 {
        self.mean.iter().sum::<f64>() / BLOCKS as f64
    }
}

/// Blocks that differ by more than three standard deviations of the difference.
fn disagreeing(a: &Image, b: &Image) -> Vec<(usize, f64)> {
    (0..BLOCKS)
        .map(|i| (i, (a.mean[i] - b.mean[i]) / (a.variance[i] + b.variance[i]).sqrt().max(1e-9)))
        .filter(|(_, z)| z.abs() > 3.0)
        .collect()
}

/// One batch of an image under an estimator.
struct BlockTally {
    estimator: Estimator,
    sums: [f64; BLOCKS],
    pixel: [u32; 2],
}

impl Tally for BlockTally {
    fn gather(&mut self, strategy: Strategy, value: Vec3, weight: f32) {
        let value = match self.estimator {
            Estimator::LightTracing if strategy.t == 1 && weight > 0.0 => value / weight,
            Estimator::LightTracing if strategy == (Strategy { s: 0, t: 2 }) => value,
            Estimator::LightTracing => return,
            _ => value,
        };
        let block = self.pixel[1] / BLOCK_PX * (EDGE_PX / BLOCK_PX) + self.pixel[0] / BLOCK_PX;
        self.sums[block as usize] += f64::from(luminance(value));
    }
}

impl SplatTally for BlockTally {
    fn aim(&mut self, pixel: [u32; 2]) {
        self.pixel = pixel;
    }
}

/// Runs `batch` for each batch number on all cores.
fn in_batches<T: Send>(batch: impl Fn(u32) -> T + Sync) -> Vec<T> {
    let threads = 2;
    let batch = &batch;
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads)
            .map(|thread| {
                scope.spawn(move || (0..BATCHES).filter(|b| b % threads == thread).map(batch).collect())
            })
            .collect();
        workers
            .into_iter()
            .flat_map(|worker| -> Vec<T> { worker.join().expect("a batch panicked") })
            .collect()
    })
}

/// An image of `samples` per pixel and batch, and as many light paths.
fn render(scene: &Scene, estimator: Estimator, samples: u32) -> Image {
    let integrator = match estimator {
        Estimator::Bidirectional | Estimator::LightTracing => Integrator::Bidirectional,
        Estimator::NoLightImage => Integrator::NoLightImage,
        Estimator::PathTracing => Integrator::PathTracing,
    };
    let options = RenderOptions { integrator, ..RenderOptions::default() };
    let prepared = boxes::prepare(scene, [EDGE_PX; 2], options);
    let twin = &prepared.twin;
    let with_light_paths = integrator == Integrator::Bidirectional;
    let batches = in_batches(|batch| {
        let mut eyes = BlockTally { estimator, sums: [0.0; BLOCKS], pixel: [0, 0] };
        let mut lights = BlockTally { estimator, sums: [0.0; BLOCKS], pixel: [0, 0] };
        each_sample(samples, batch, |pixel, sample| {
            eyes.pixel = pixel;
            eye(twin, pixel, sample, SEED, &mut eyes);
        });
        let paths = u64::from(EDGE_PX * EDGE_PX * samples);
        for path in (0..paths).filter(|_| with_light_paths) {
            light(twin, u64::from(batch) * paths + path, SEED, &mut lights);
        }
        let block_samples = f64::from(BLOCK_PX * BLOCK_PX * samples);
        // I = eyeSum / n + splatSum / N; per block the splats' mean over its pixels.
        let block_pixels = f64::from(BLOCK_PX * BLOCK_PX);
        std::array::from_fn(|b| eyes.sums[b] / block_samples + lights.sums[b] / paths as f64 / block_pixels)
    });
    Image::of(&batches)
}

fn each_sample(samples: u32, batch: u32, mut visit: impl FnMut([u32; 2], u32)) {
    for y in 0..EDGE_PX {
        for x in 0..EDGE_PX {
            for sample in 0..samples {
                visit([x, y], batch * samples + sample);
            }
        }
    }
}

fn assert_agree(name: &str, a: &Image, b: &Image) {
    let disagreeing = disagreeing(a, b);
    println!("{name}: {:.5} and {:.5}, beyond 3 sigma: {disagreeing:?}", a.total(), b.total());
    // Of 16 blocks, 0.04 lie beyond 3 sigma by chance, somewhat more with 32 batches: one may, if not by far.
    let far = disagreeing.iter().any(|(_, z)| z.abs() > 4.5);
    assert!(disagreeing.len() <= 1 && !far, "{name}: {disagreeing:?}");
}

#[test]
fn bidirectional_equals_path_tracing_and_light_tracing_in_a_diffuse_room() {
    let scene = boxes::room(Furniture::Block);
    let bidirectional = render(&scene, Estimator::Bidirectional, 2);
    let path = render(&scene, Estimator::PathTracing, 4);
    let light = render(&scene, Estimator::LightTracing, 4);
    assert_agree("bidirectional, path tracing", &bidirectional, &path);
    assert_agree("bidirectional, light tracing", &bidirectional, &light);
    assert_agree(
        "bidirectional, no light image",
        &bidirectional,
        &render(&scene, Estimator::NoLightImage, 2),
    );
    let wrong = disagreeing(&bidirectional, &path.scaled(1.05));
    assert!(wrong.len() > 1, "five percent more light is noticed: {wrong:?}");
}

#[test]
fn bidirectional_equals_path_tracing_with_glass_mirror_and_bumpy_normals() {
    let scene = boxes::room(Furniture::GlassAndMirror);
    let bidirectional = render(&scene, Estimator::Bidirectional, 3);
    let path = render(&scene, Estimator::PathTracing, 8);
    assert_agree("room with glass", &bidirectional, &path);
}

#[test]
fn bidirectional_equals_path_tracing_under_a_sky() {
    let scene = boxes::outdoors();
    let bidirectional = render(&scene, Estimator::Bidirectional, 4);
    let path = render(&scene, Estimator::PathTracing, 12);
    assert_agree("outdoors", &bidirectional, &path);
    assert_agree("outdoors, no light image", &bidirectional, &render(&scene, Estimator::NoLightImage, 4));
}

/// Unweighted contributions of one batch by strategy.
#[derive(Default)]
struct StrategyTally {
    sums: BTreeMap<Strategy, f64>,
}

impl Tally for StrategyTally {
    fn gather(&mut self, strategy: Strategy, value: Vec3, weight: f32) {
        if weight > 0.0 {
            *self.sums.entry(strategy).or_default() += f64::from(luminance(value / weight));
        }
    }
}

impl SplatTally for StrategyTally {
    fn aim(&mut self, _: [u32; 2]) {}
}

#[test]
fn every_strategy_alone_gives_the_same_light_for_each_path_length() {
    let prepared = boxes::prepare(&boxes::room(Furniture::Block), [EDGE_PX; 2], RenderOptions::default());
    let twin: &TwinScene = &prepared.twin;
    const SAMPLES: u32 = 3;
    let batches = in_batches(|batch| {
        let mut tally = StrategyTally::default();
        each_sample(SAMPLES, batch, |pixel, sample| eye(twin, pixel, sample, SEED, &mut tally));
        let paths = u64::from(EDGE_PX * EDGE_PX * SAMPLES);
        for path in 0..paths {
            light(twin, u64::from(batch) * paths + path, SEED, &mut tally);
        }
        tally.sums
    });
    let count = f64::from(BATCHES);
    let samples = f64::from(EDGE_PX * EDGE_PX * SAMPLES);
    for vertices in 3..=6 {
        let estimates: Vec<(Strategy, f64, f64)> = (0..vertices)
            .map(|s| {
                let strategy = Strategy { s, t: vertices - s };
                // A splat sum over N light paths is the sum of all pixels, not their mean.
                let share = if strategy.t == 1 { samples * f64::from(EDGE_PX * EDGE_PX) } else { samples };
                let values: Vec<f64> =
                    batches.iter().map(|b| b.get(&strategy).copied().unwrap_or(0.0) / share).collect();
                let mean = values.iter().sum::<f64>() / count;
                let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (count - 1.0) / count;
                (strategy, mean, variance)
            })
            .collect();
        println!("{vertices} vertices: {estimates:.5?}");
        for (strategy, mean, variance) in &estimates {
            let (_, reference, reference_variance) =
                estimates.iter().min_by(|a, b| a.2.total_cmp(&b.2)).expect("there are strategies");
            let z = (mean - reference) / (variance + reference_variance).sqrt();
            // 18 comparisons in all; half of one percent is for ray offsets, which shorten edges by 1e-5.
            assert!(
                z.abs() < 3.5 || (mean / reference - 1.0).abs() < 0.005,
                "{strategy:?}: {mean} is not {reference}"
            );
            assert!(*mean > 0.0, "{strategy:?} finds light");
        }
    }
}

fn furnace(reflectance: f32) -> Scene {
    let mut b = Builder::new();
    let wall = b.material(Bsdf::Diffuse { reflectance: Vec3::splat(reflectance) }, Vec3::ONE);
    b.room([wall; 6], None);
    b.finish(boxes::camera_in_room(), None)
}

#[test]
fn a_closed_furnace_has_the_radiance_of_the_series() {
    // Walls that emit 1 and reflect r: edge k adds r^(k-1), sixteen edges.
    for reflectance in [0.0, 0.5, 0.8] {
        let image = render(&furnace(reflectance), Estimator::Bidirectional, 1);
        let expected: f64 = (0..16).map(|k| f64::from(reflectance).powi(k)).sum();
        for block in 0..BLOCKS {
            let sigma = image.variance[block].sqrt();
            let off = (image.mean[block] - expected).abs();
            assert!(
                off < 4.0 * sigma + 1e-4 * expected,
                "{reflectance}: {} +- {sigma} is not {expected}",
                image.mean[block]
            );
        }
        println!("furnace {reflectance}: {:.5}, expected {expected:.5}", image.total());
        assert!((image.total() / expected - 1.0).abs() < 0.01, "within one percent");
    }
}

fn ball_under_white_sky(bsdf: Bsdf) -> Scene {
    let mut b = Builder::new();
    let material = b.material(bsdf, Vec3::ZERO);
    // Flat faces: a convex body sees nothing but sky, so one bounce is all.
    let smooth = matches!(bsdf, Bsdf::Dielectric { .. });
    b.sphere(Vec3::ZERO, 1.0, 16, smooth, material);
    let camera = Camera { eye: Vec3::new(0.0, 0.3, 2.2), target: Vec3::ZERO, up: Vec3::Y, hfov_deg: 30.0 };
    b.finish(camera, Some(Vec3::ONE))
}

#[test]
fn bodies_under_a_white_sky_show_their_albedo() {
    let cases = [
        ("diffuse", Bsdf::Diffuse { reflectance: Vec3::splat(0.8) }, 0.8),
        ("mirror", Bsdf::Mirror { reflectance: Vec3::splat(0.9) }, 0.9),
        // Lossless: what goes in comes out, but for what sixteen edges cut off and what the disagreement of round
        // normals and flat faces absorbs.
        ("glass", Bsdf::Dielectric { ior: 1.5 }, 1.0),
    ];
    for (name, bsdf, expected) in cases {
        let image = render(&ball_under_white_sky(bsdf), Estimator::Bidirectional, 2);
        for block in [5, 6, 9, 10] {
            let sigma = image.variance[block].sqrt();
            let (mean, off) = (image.mean[block], (image.mean[block] - expected).abs());
            println!("{name}, block {block}: {mean:.4} +- {sigma:.4}");
            let lost = if name == "glass" { 0.01 } else { 1e-4 };
            assert!(off < 3.5 * sigma + lost, "{name}: {mean} +- {sigma} is not {expected}");
        }
    }
}
