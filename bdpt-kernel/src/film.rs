//! The film: eye sums and splat sums, merged from jobs' layers in job order.
//!
//! Floating-point sums depend on their order, so each tile takes its slices in order, and the light layer its jobs: a layer that
//! comes early is held until its turn. The image is then the same, byte for byte, whatever nodes rendered it. The
//! estimator is I = eye sum / samples of the pixel + splat sum / light paths (50-bdpt.md section 3, trap 3): valid at
//! any time, for any part of the jobs. Never talks to a farm, never writes files.

use std::collections::{BTreeMap, btree_map::Entry};

use thiserror::Error;

use crate::{
    gpu::{Counters, SplatLayer, TileLayer},
    plan::{RenderPlan, TileTurn},
    scene::model::FilmSize,
};

/// Most layers that wait for their turn. The source of jobs keeps its jobs in flight below it.
pub const MAX_HELD_TILES: usize = 512;
/// Most memory of light layers that wait for their turn; two are held whatever their size.
const MAX_HELD_SPLAT_BYTES: u64 = 512 << 20;
/// Most light layers that wait for their turn.
const MAX_HELD_SPLATS: u64 = 16;

/// A layer that cannot be merged. The result is wrong, or its sender is: not to be retried.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum FilmError {
    /// The layer was merged or held before.
    #[error("{layer} came twice")]
    Twice {
        /// Which.
        layer: String,
    },
    /// The plan has no such job.
    #[error("{layer} is not of this image")]
    Foreign {
        /// Which.
        layer: String,
    },
    /// The layer has another shape than its job.
    #[error("{layer} has {found}, expected {expected}")]
    Shape {
        /// Which.
        layer: String,
        /// What it should have.
        expected: String,
        /// What it has.
        found: String,
    },
    /// Too many layers came before their turn.
    #[error("{layer} came too early: {held} layers wait for their turn already")]
    TooEarly {
        /// Which.
        layer: String,
        /// The bound.
        held: usize,
    },
}

/// Sums over the eye samples of one pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct EyePixel {
    rgb: [f64; 3],
    luminance: f64,
    luminance_squared: f64,
    samples: u64,
}

/// Sums over the first hits of one pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct FirstHitPixel {
    albedo: [f32; 3],
    normal: [f32; 3],
    depth: f32,
    samples: u32,
    hits: u32,
}

/// An image in the making.
#[derive(Clone, Debug)]
pub struct Film {
    plan: RenderPlan,
    eye: Vec<EyePixel>,
    first_hits: Vec<FirstHitPixel>,
    splat: Vec<[f64; 3]>,
    light_paths: u64,
    /// By tile: the slice whose turn it is.
    next_slice: Vec<u32>,
    held_tiles: BTreeMap<TileTurn, TileLayer>,
    next_light: u32,
    held_splats: BTreeMap<u32, SplatLayer>,
    merged_tiles: u64,
    eye_samples: u64,
    empty_pixels: u64,
    rays: u64,
    counters: Counters,
}

/// How far a film is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FilmProgress {
    /// Eye samples merged.
    pub samples: u64,
    /// Eye samples of the whole image.
    pub total_samples: u64,
    /// Light paths merged.
    pub light_paths: u64,
    /// Light paths of the whole image.
    pub total_light_paths: u64,
    /// Pixels without an eye sample, black in the image.
    pub empty_pixels: u64,
    /// Rays traced for what is merged.
    pub rays: u64,
    /// What the devices had to cut or drop.
    pub counters: Counters,
}

impl FilmProgress {
    /// Whether every job is merged.
    #[must_use]
    pub const fn is_complete(&self) -> bool {
        self.samples == self.total_samples && self.light_paths == self.total_light_paths
    }
}

/// An image with its layers, row by row from the top left, linear RGB.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Its size.
    pub size: FilmSize,
    /// Radiance: eye and splat together; 0 where no eye sample is merged yet.
    pub beauty: Vec<[f32; 3]>,
    /// Part of eye paths (s >= 0, t >= 2).
    pub eye: Vec<[f32; 3]>,
    /// Part of light paths that meet the camera (t = 1).
    pub splat: Vec<[f32; 3]>,
    /// Mean albedo of the first surface; 0 where there is none.
    pub albedo: Vec<[f32; 3]>,
    /// Mean shading normal of the first surface, facing the camera; 0 where there is none.
    pub normal: Vec<[f32; 3]>,
    /// Mean distance of the first surface in world units; 0 where there is none.
    pub depth: Vec<f32>,
    /// Eye samples.
    pub samples: Vec<u32>,
}

impl Film {
    /// An empty film for the jobs of a plan.
    #[must_use]
    pub fn new(plan: RenderPlan) -> Self {
        let pixels = usize::try_from(plan.size().pixels()).expect("FilmSize bounds the pixels");
        Self {
            plan,
            eye: vec![EyePixel::default(); pixels],
            first_hits: vec![FirstHitPixel::default(); pixels],
            splat: vec![[0.0; 3]; pixels],
            light_paths: 0,
            next_slice: vec![0; plan.tiles() as usize],
            held_tiles: BTreeMap::new(),
            next_light: 0,
            held_splats: BTreeMap::new(),
            merged_tiles: 0,
            eye_samples: 0,
            empty_pixels: plan.size().pixels(),
            rays: 0,
            counters: Counters::default(),
        }
    }

    /// Light layers that may wait for their turn at an image of this size.
    #[must_use]
    pub fn max_held_splats(size: FilmSize) -> usize {
        let most = (MAX_HELD_SPLAT_BYTES / (size.pixels() * 12)).clamp(2, MAX_HELD_SPLATS);
        usize::try_from(most).expect("at most 16")
    }

    /// Takes a tile's layer, whenever it comes.
    ///
    /// # Errors
    /// The layer is not of this image, came before, or too far ahead of its turn.
    pub fn add_tile(&mut self, turn: TileTurn, layer: TileLayer) -> Result<(), FilmError> {
        let name = || format!("slice {} of tile {}", turn.slice, turn.tile);
        self.check_tile(turn, &layer, &name)?;
        let next = self.next_slice[turn.tile as usize];
        if turn.slice < next {
            return Err(FilmError::Twice { layer: name() });
        }
        let held = self.held_tiles.len();
        match self.held_tiles.entry(turn) {
            Entry::Occupied(_) => return Err(FilmError::Twice { layer: name() }),
            Entry::Vacant(_) if turn.slice > next && held >= MAX_HELD_TILES => {
                return Err(FilmError::TooEarly { layer: name(), held });
            }
            Entry::Vacant(place) => place.insert(layer),
        };
        loop {
            let turn = TileTurn { slice: self.next_slice[turn.tile as usize], ..turn };
            let Some(layer) = self.held_tiles.remove(&turn) else { return Ok(()) };
            self.merge_tile(&layer);
            self.next_slice[turn.tile as usize] += 1;
        }
    }

    /// Takes a light job's layer, whenever it comes.
    ///
    /// # Errors
    /// The layer is not of this image, came before, or too far ahead of its turn.
    pub fn add_splats(&mut self, turn: u32, layer: SplatLayer) -> Result<(), FilmError> {
        let name = || format!("light layer {turn}");
        if turn >= self.plan.light_jobs() {
            return Err(FilmError::Foreign { layer: name() });
        }
        let job = self.plan.light_job(turn);
        let expected = (self.eye.len(), job.paths);
        let found = (layer.rgb.len(), layer.paths);
        if expected != found {
            let words = |(pixels, paths)| format!("{pixels} pixels of {paths} light paths");
            return Err(FilmError::Shape { layer: name(), expected: words(expected), found: words(found) });
        }
        if turn < self.next_light {
            return Err(FilmError::Twice { layer: name() });
        }
        let (held, most) = (self.held_splats.len(), Self::max_held_splats(self.plan.size()));
        match self.held_splats.entry(turn) {
            Entry::Occupied(_) => return Err(FilmError::Twice { layer: name() }),
            Entry::Vacant(_) if turn > self.next_light && held >= most => {
                return Err(FilmError::TooEarly { layer: name(), held });
            }
            Entry::Vacant(place) => place.insert(layer),
        };
        while let Some(layer) = self.held_splats.remove(&self.next_light) {
            self.merge_splats(&layer);
            self.next_light += 1;
        }
        Ok(())
    }

    /// Merges what is held, turn or not, because nothing will come any more: the most of a render that was stopped.
    pub fn merge_held(&mut self) {
        for (turn, layer) in std::mem::take(&mut self.held_tiles) {
            self.merge_tile(&layer);
            self.next_slice[turn.tile as usize] = turn.slice + 1;
        }
        for (turn, layer) in std::mem::take(&mut self.held_splats) {
            self.merge_splats(&layer);
            self.next_light = turn + 1;
        }
    }

    /// Tile jobs merged.
    #[must_use]
    pub const fn merged_tiles(&self) -> u64 {
        self.merged_tiles
    }

    /// Light jobs merged.
    #[must_use]
    pub const fn merged_lights(&self) -> u32 {
        self.next_light
    }

    /// How far the film is.
    #[must_use]
    pub fn progress(&self) -> FilmProgress {
        FilmProgress {
            samples: self.eye_samples,
            total_samples: self.plan.total_samples(),
            light_paths: self.light_paths,
            total_light_paths: self.plan.total_light_paths(),
            empty_pixels: self.empty_pixels,
            rays: self.rays,
            counters: self.counters,
        }
    }

    /// The image of what is merged. A pixel without eye samples is black in `beauty`, whatever light paths met it: their
    /// share alone looks like a picture, and is a wrong one.
    #[must_use]
    pub fn image(&self) -> Image {
        let mean = |sum: f64, count: u64| if count == 0 { 0.0 } else { sum / to_f64(count) };
        let eye = |pixel: &EyePixel| pixel.rgb.map(|sum| mean(sum, pixel.samples));
        let splat = |sums: &[f64; 3]| sums.map(|sum| mean(sum, self.light_paths));
        let beauty = |(pixel, sums): (&EyePixel, &[f64; 3])| {
            if pixel.samples == 0 {
                return [0.0; 3];
            }
            let (eye, splat) = (eye(pixel), splat(sums));
            std::array::from_fn(|c| to_f32(eye[c] + splat[c]))
        };
        let share =
            |sum: f32, count: u32| if count == 0 { 0.0 } else { to_f32(f64::from(sum) / f64::from(count)) };
        Image {
            size: self.plan.size(),
            beauty: self.eye.iter().zip(&self.splat).map(beauty).collect(),
            eye: self.eye.iter().map(|pixel| eye(pixel).map(to_f32)).collect(),
            splat: self.splat.iter().map(|sums| splat(sums).map(to_f32)).collect(),
            albedo: self.first_hits.iter().map(|hit| hit.albedo.map(|sum| share(sum, hit.samples))).collect(),
            normal: self.first_hits.iter().map(|hit| hit.normal.map(|sum| share(sum, hit.hits))).collect(),
            depth: self.first_hits.iter().map(|hit| share(hit.depth, hit.hits)).collect(),
            samples: self.eye.iter().map(|pixel| u32::try_from(pixel.samples).unwrap_or(u32::MAX)).collect(),
        }
    }

    fn check_tile(
        &self,
        turn: TileTurn,
        layer: &TileLayer,
        name: &impl Fn() -> String,
    ) -> Result<(), FilmError> {
        if turn.tile >= self.plan.tiles() || turn.slice >= self.plan.slices() {
            return Err(FilmError::Foreign { layer: name() });
        }
        let number = u64::from(turn.slice) * u64::from(self.plan.tiles()) + u64::from(turn.tile);
        let (_, job) = self.plan.tile_job(number);
        let pixels = job.width_px as usize * job.height_px as usize;
        let expected = (job.x_px, job.y_px, job.width_px, job.height_px, pixels, pixels);
        let (sums, hits) = (layer.pixels.len(), layer.first_hits.len());
        let found = (layer.x_px, layer.y_px, layer.width_px, layer.height_px, sums, hits);
        if expected != found {
            let words = |(x, y, width, height, sums, hits)| {
                format!("{width}x{height} pixels at ({x}, {y}) with {sums} sums and {hits} first hits")
            };
            return Err(FilmError::Shape { layer: name(), expected: words(expected), found: words(found) });
        }
        match layer.pixels.iter().find(|pixel| pixel.count != job.samples) {
            None => Ok(()),
            Some(pixel) => Err(FilmError::Shape {
                layer: name(),
                expected: format!("{} samples in each pixel", job.samples),
                found: format!("{} in one", pixel.count),
            }),
        }
    }

    fn merge_tile(&mut self, layer: &TileLayer) {
        let (width, tile_width) = (self.plan.size().width_px as usize, layer.width_px as usize);
        let start = layer.y_px as usize * width + layer.x_px as usize;
        let rows = layer.pixels.chunks(tile_width).zip(layer.first_hits.chunks(tile_width));
        for (row, (sums, hits)) in rows.enumerate() {
            let at = start + row * width;
            for (pixel, sum) in self.eye[at..at + tile_width].iter_mut().zip(sums) {
                self.empty_pixels -= u64::from(pixel.samples == 0 && sum.count > 0);
                add(&mut pixel.rgb, sum.rgb);
                pixel.luminance += f64::from(sum.luminance);
                pixel.luminance_squared += f64::from(sum.luminance_squared);
                pixel.samples += u64::from(sum.count);
                self.eye_samples += u64::from(sum.count);
                self.rays += u64::from(sum.rays);
            }
            for (pixel, hit) in self.first_hits[at..at + tile_width].iter_mut().zip(hits) {
                pixel.albedo = std::array::from_fn(|c| pixel.albedo[c] + hit.albedo[c]);
                pixel.normal = std::array::from_fn(|c| pixel.normal[c] + hit.normal[c]);
                pixel.depth += hit.depth;
                pixel.samples += hit.samples;
                pixel.hits += hit.hits;
            }
        }
        self.merged_tiles += 1;
        self.rays += u64::from(layer.counters.rays);
        self.counters.add(&layer.counters);
    }

    fn merge_splats(&mut self, layer: &SplatLayer) {
        for (pixel, rgb) in self.splat.iter_mut().zip(&layer.rgb) {
            add(pixel, *rgb);
        }
        self.light_paths += u64::from(layer.paths);
        self.rays += u64::from(layer.counters.rays);
        self.counters.add(&layer.counters);
    }
}

fn add(sum: &mut [f64; 3], value: [f32; 3]) {
    for (sum, value) in sum.iter_mut().zip(value) {
        *sum += f64::from(value);
    }
}

#[allow(clippy::cast_precision_loss, reason = "counts of samples are far below 2^53")]
fn to_f64(count: u64) -> f64 {
    count as f64
}

#[allow(clippy::cast_possible_truncation, reason = "rounding to f32 is meant")]
fn to_f32(value: f64) -> f32 {
    value as f32
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{
        gpu::{FirstHit, PixelSum},
        plan::{Cursor, LightImage, PlannedJob},
    };

    fn plan() -> RenderPlan {
        RenderPlan::new(FilmSize::new(100, 70).unwrap(), 14, 3, LightImage::Traced)
    }

    /// Values of such unlike sizes that sums in f64 depend on their order.
    fn value(a: u32, b: u32) -> f32 {
        let exponent = (a.wrapping_mul(2_654_435_761).wrapping_add(b.wrapping_mul(40_503)) >> 16) % 60;
        let sign = if (a + b).is_multiple_of(2) { 1.0 } else { -1.0 };
        sign * (1.0 + f32::from(u8::try_from((a * 7 + b * 13) % 251).unwrap()) / 251.0)
            * (exponent as f32 - 30.0).exp2()
    }

    fn layer_of(job: PlannedJob) -> Layer {
        match job {
            PlannedJob::Tile(turn, job) => {
                let pixels = job.width_px * job.height_px;
                let sum = |i: u32| PixelSum {
                    rgb: [value(turn.slice, i), value(turn.slice + 50, i), 0.5],
                    luminance: 1.0,
                    luminance_squared: 2.0,
                    count: job.samples,
                    rays: 3,
                    padding: 0,
                };
                let hit = FirstHit {
                    albedo: [0.5; 3],
                    samples: 2,
                    normal: [0.0, 0.0, 1.0],
                    depth: 8.0,
                    hits: 1,
                    padding: [0; 3],
                };
                Layer::Tile(
                    turn,
                    TileLayer {
                        x_px: job.x_px,
                        y_px: job.y_px,
                        width_px: job.width_px,
                        height_px: job.height_px,
                        pixels: (0..pixels).map(sum).collect(),
                        first_hits: vec![hit; pixels as usize],
                        counters: Counters::default(),
                    },
                )
            }
            PlannedJob::Light(turn, job) => Layer::Splats(
                turn,
                SplatLayer {
                    width_px: 100,
                    height_px: 70,
                    rgb: (0..7_000)
                        .map(|i| [value(turn, i), value(turn + 9, i), value(turn + 5, i)])
                        .collect(),
                    paths: job.paths,
                    counters: Counters { rays: 10, ..Counters::default() },
                },
            ),
        }
    }

    #[derive(Clone, Debug)]
    enum Layer {
        Tile(TileTurn, TileLayer),
        Splats(u32, SplatLayer),
    }

    fn layers() -> Vec<Layer> {
        let mut cursor = Cursor::new(plan());
        std::iter::from_fn(|| cursor.next(true, true)).map(layer_of).collect()
    }

    fn add(film: &mut Film, layer: Layer) -> Result<(), FilmError> {
        match layer {
            Layer::Tile(turn, layer) => film.add_tile(turn, layer),
            Layer::Splats(turn, layer) => film.add_splats(turn, layer),
        }
    }

    fn image_of(layers: impl IntoIterator<Item = Layer>) -> (Image, FilmProgress) {
        let mut film = Film::new(plan());
        layers.into_iter().for_each(|layer| add(&mut film, layer).unwrap());
        (film.image(), film.progress())
    }

    fn bytes(image: &Image) -> Vec<u8> {
        let colours = [&image.beauty, &image.eye, &image.splat, &image.albedo, &image.normal];
        let floats = colours.into_iter().flatten().flatten().chain(&image.depth);
        floats.flat_map(|value| value.to_bits().to_le_bytes()).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn any_order_of_arrival_gives_the_same_bytes(order in Just(layers()).prop_shuffle()) {
            let (shuffled, progress) = image_of(order);
            prop_assert!(progress.is_complete());
            prop_assert_eq!(bytes(&shuffled), bytes(&image_of(layers()).0));
        }
    }

    #[test]
    fn sums_in_order_of_arrival_would_differ() {
        // The control of the test above: the same values, summed as they come, are told apart by the same bytes.
        let slices = plan().slices();
        assert!(slices >= 3, "two values have no order: {slices} slices");
        let sum = |order: &mut dyn Iterator<Item = u32>, i: u32| {
            order.fold(0.0_f64, |sum, slice| sum + f64::from(value(slice, i)))
        };
        let differ =
            (0..4_096).filter(|&i| sum(&mut (0..slices), i) != sum(&mut (0..slices).rev(), i)).count();
        assert!(differ > 0, "the values do not depend on their order");
    }

    #[test]
    fn a_part_of_the_jobs_is_a_valid_image() {
        let empty = Film::new(plan());
        assert!(
            empty.image().beauty.iter().flatten().all(|value| *value == 0.0),
            "nothing merged is black, not NaN"
        );
        let constant = |layer: Layer| match layer {
            Layer::Tile(turn, mut layer) => {
                // Each sample 0.5 in red: the mean is 0.5 after any number of slices.
                layer.pixels.iter_mut().for_each(|sum| sum.rgb = [sum.count as f32 * 0.5, 0.0, 0.0]);
                Layer::Tile(turn, layer)
            }
            Layer::Splats(turn, mut layer) => {
                layer.rgb.iter_mut().for_each(|rgb| *rgb = [layer.paths as f32 * 0.25, 0.0, 0.0]);
                Layer::Splats(turn, layer)
            }
        };
        let all: Vec<Layer> = layers().into_iter().map(constant).collect();
        for count in [1, 5, all.len() / 2, all.len()] {
            let (image, progress) = image_of(all[..count].iter().cloned());
            let splat = if progress.light_paths > 0 { 0.25 } else { 0.0 };
            for (at, beauty) in image.beauty.iter().enumerate() {
                let expected = if image.samples[at] > 0 { 0.5 + splat } else { 0.0 };
                assert!((beauty[0] - expected).abs() < 1e-6, "{count} jobs, pixel {at}: {beauty:?}");
            }
        }
        let (image, progress) = image_of(all);
        assert_eq!(progress.samples, 14 * 7_000);
        assert!(image.samples.iter().all(|count| *count == 14), "every pixel has its samples");
        assert_eq!((image.albedo[0], image.normal[0], image.depth[0]), ([0.25; 3], [0.0, 0.0, 1.0], 8.0));
    }

    #[test]
    fn pixels_without_eye_samples_are_black_and_counted() {
        let (lights, tiles): (Vec<Layer>, Vec<Layer>) =
            layers().into_iter().partition(|layer| matches!(layer, Layer::Splats(..)));
        let (dark, progress) = image_of(lights.iter().cloned());
        assert_eq!(progress.empty_pixels, 7_000);
        assert!(dark.beauty.iter().flatten().all(|value| *value == 0.0), "light paths alone are no picture");
        assert!(dark.splat.iter().flatten().any(|value| *value != 0.0), "the layer keeps them");
        let (part, progress) = image_of(lights.iter().chain(&tiles[..1]).cloned());
        let empty = part.samples.iter().filter(|count| **count == 0).count();
        assert_eq!(progress.empty_pixels, u64::try_from(empty).unwrap());
        assert!((1..7_000).contains(&empty), "one tile of several: {empty}");
        for (beauty, samples) in part.beauty.iter().zip(&part.samples) {
            assert_eq!(*beauty == [0.0; 3], *samples == 0);
        }
        assert_eq!(image_of(layers()).1.empty_pixels, 0);
    }

    #[test]
    fn held_layers_can_be_merged_when_nothing_more_comes() {
        let mut film = Film::new(plan());
        let late: Vec<Layer> = layers()
            .into_iter()
            .filter(|layer| !matches!(layer, Layer::Tile(t, _) if t.slice == 0))
            .collect();
        late.into_iter().for_each(|layer| add(&mut film, layer).unwrap());
        assert_eq!(film.progress().samples, 0, "nothing has its turn before the first slices");
        film.merge_held();
        assert_eq!(film.progress().samples, (14 - 4) * 7_000);
    }

    #[test]
    fn wrong_layers_are_refused_and_change_nothing() {
        let all = layers();
        let mut film = Film::new(plan());
        for layer in &all[..4] {
            add(&mut film, layer.clone()).unwrap();
        }
        let before = bytes(&film.image());
        for layer in &all[..4] {
            let error = add(&mut film, layer.clone()).unwrap_err();
            assert!(matches!(error, FilmError::Twice { .. }), "{error}");
        }
        let early = all.iter().rev().find(|layer| matches!(layer, Layer::Tile(..))).unwrap();
        add(&mut film, early.clone()).unwrap();
        assert!(matches!(add(&mut film, early.clone()), Err(FilmError::Twice { .. })), "held ones count too");
        let Layer::Tile(turn, layer) = early.clone() else { panic!("a tile was looked for") };
        let foreign = [TileTurn { tile: 99, ..turn }, TileTurn { slice: 99, ..turn }];
        for turn in foreign {
            assert!(matches!(film.add_tile(turn, layer.clone()), Err(FilmError::Foreign { .. })), "{turn:?}");
        }
        let next = TileTurn { slice: turn.slice - 1, ..turn };
        let mut short = layer.clone();
        short.pixels.pop();
        assert!(matches!(film.add_tile(next, short), Err(FilmError::Shape { .. })), "a pixel is missing");
        assert!(
            matches!(film.add_tile(next, layer), Err(FilmError::Shape { .. })),
            "the last slice has fewer samples"
        );
        assert_eq!(bytes(&film.image()), before);
    }

    #[test]
    fn layers_too_far_ahead_are_refused() {
        let plan = RenderPlan::new(FilmSize::new(2, 2).unwrap(), 256 * 600, 0, LightImage::Left);
        let mut wide = Film::new(plan);
        let slices = plan.slices();
        assert!(slices as usize > MAX_HELD_TILES, "{slices} slices");
        let planned = |slice: u32| {
            let (turn, job) = plan.tile_job(u64::from(slice));
            PlannedJob::Tile(turn, job)
        };
        let tile = |slice: u32| match layer_of(planned(slice)) {
            Layer::Tile(turn, layer) => (turn, layer),
            Layer::Splats(..) => unreachable!("a tile was asked for"),
        };
        let mut refused = None;
        for slice in 1..slices {
            let (turn, layer) = tile(slice);
            if let Err(error) = wide.add_tile(turn, layer) {
                refused = Some((slice, error));
                break;
            }
        }
        let (slice, error) = refused.expect("the bound is reached");
        assert!(matches!(error, FilmError::TooEarly { held: MAX_HELD_TILES, .. }), "{error}");
        let (turn, layer) = tile(0);
        wide.add_tile(turn, layer).expect("the one whose turn it is always has room");
        assert_eq!(wide.merged_tiles(), u64::from(slice), "and lets the held ones go");
    }
}
