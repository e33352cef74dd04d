//! How an image is cut into jobs. A pure function of image size and samples: the farm's devices have no say, so that the same
//! bytes come out on any of them.
//!
//! **Tile jobs** cover 64x64 pixels times a slice of the samples. The slice is the largest power of two in 4..=256
//! that still leaves 256 tile jobs, at most the samples there are. So a large render fills a large device (64
//! samples of a tile are the 262,144 lanes of an H200; 256 are four launches of that), and a small one still spreads over
//! several workers, in jobs of at least 16,384 samples: some 0.2 s on a two-core CPU.
//!
//! **Light jobs** trace samples x pixels light paths in all, and each returns a layer of the whole frame; so they are
//! few: one for every 16,384 paths up to 16 jobs, more only beyond 2^24 paths a job.
//!
//! | image | samples | slice | tile jobs | light jobs |
//! |---|---|---|---|---|
//! | 128x96 | 16 | 4 | 16 | 12 |
//! | 512x512 | 16 | 4 | 256 | 16 |
//! | 1920x1152 | 64 | 64 | 540 | 16 |
//! | 1920x1152 | 1,024 | 256 | 2,160 | 135 |

use crate::{
    gpu::{LightJob, TileJob},
    scene::model::FilmSize,
};

/// Edge of a tile (thesis 5.5.2).
pub const TILE_EDGE_PX: u32 = 64;
/// Tile jobs that an image is cut into at least, if its samples allow.
const SPREAD_JOBS: u64 = 256;
/// Fewest samples per pixel of a tile job, where there are so many.
const MIN_SLICE: u32 = 4;
/// Most samples per pixel of a tile job.
const MAX_SLICE: u32 = 256;
/// Light jobs that an image is cut into, if it has the paths.
const SPREAD_LIGHT_JOBS: u64 = 16;
/// Fewest light paths worth a job.
const MIN_LIGHT_PATHS: u64 = 1 << 14;
/// Most light paths of a job.
const MAX_LIGHT_PATHS: u64 = 1 << 24;

/// Whether an image has a light layer (t = 1).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LightImage {
    /// As many light paths as eye samples.
    Traced,
    /// No light jobs.
    Left,
}

/// A position in the merge order of one tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TileTurn {
    /// The tile, row by row.
    pub tile: u32,
    /// The slice of its samples, in order.
    pub slice: u32,
}

/// One job of an image and its place in the merge order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlannedJob {
    /// Eye samples of a tile.
    Tile(TileTurn, TileJob),
    /// Light paths; the number is its place.
    Light(u32, LightJob),
}

/// All jobs of an image, by number: none is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RenderPlan {
    size: FilmSize,
    samples: u32,
    seed: u64,
    slice: u32,
    light_jobs: u32,
}

impl RenderPlan {
    /// Cuts an image of `samples` > 0 eye samples per pixel into jobs.
    ///
    /// # Panics
    /// Without a sample; callers take it from a checked request.
    #[must_use]
    pub fn new(size: FilmSize, samples: u32, seed: u64, light_image: LightImage) -> Self {
        assert!(samples > 0, "an image needs at least one sample per pixel");
        let tiles = u64::from(tiles_across(size.width_px)) * u64::from(tiles_across(size.height_px));
        let mut slice = MAX_SLICE;
        while slice > MIN_SLICE && tiles * u64::from(samples.div_ceil(slice)) < SPREAD_JOBS {
            slice /= 2;
        }
        let paths = u64::from(samples) * size.pixels();
        let light_jobs = match light_image {
            LightImage::Left => 0,
            LightImage::Traced => {
                (paths / MIN_LIGHT_PATHS).clamp(1, SPREAD_LIGHT_JOBS).max(paths.div_ceil(MAX_LIGHT_PATHS))
            }
        };
        let light_jobs =
            u32::try_from(light_jobs).expect("2^32 samples of 2^28 pixels are 2^36 jobs of 2^24 at most");
        Self { size, samples, seed, slice: slice.min(samples), light_jobs }
    }

    /// The image's size.
    #[must_use]
    pub const fn size(&self) -> FilmSize {
        self.size
    }

    /// Samples per pixel of a tile job; the last one of a tile may have fewer.
    #[must_use]
    pub const fn slice(&self) -> u32 {
        self.slice
    }

    /// Tiles of the image.
    #[must_use]
    pub const fn tiles(&self) -> u32 {
        tiles_across(self.size.width_px) * tiles_across(self.size.height_px)
    }

    /// Jobs of each tile.
    #[must_use]
    pub const fn slices(&self) -> u32 {
        self.samples.div_ceil(self.slice)
    }

    /// Tile jobs of the image.
    #[must_use]
    pub fn tile_jobs(&self) -> u64 {
        u64::from(self.tiles()) * u64::from(self.slices())
    }

    /// Light jobs of the image.
    #[must_use]
    pub const fn light_jobs(&self) -> u32 {
        self.light_jobs
    }

    /// Eye samples of the whole image.
    #[must_use]
    pub fn total_samples(&self) -> u64 {
        u64::from(self.samples) * self.size.pixels()
    }

    /// Light paths of the whole image.
    #[must_use]
    pub fn total_light_paths(&self) -> u64 {
        if self.light_jobs == 0 { 0 } else { self.total_samples() }
    }

    /// Tile job `number` of [`Self::tile_jobs`]: all tiles' first slices, then all tiles' second ones.
    #[must_use]
    pub fn tile_job(&self, number: u64) -> (TileTurn, TileJob) {
        assert!(number < self.tile_jobs(), "tile job {number} of {}", self.tile_jobs());
        let tiles = u64::from(self.tiles());
        let narrow = |value: u64| u32::try_from(value).expect("tiles and slices are numbered in 32 bits");
        let turn = TileTurn { tile: narrow(number % tiles), slice: narrow(number / tiles) };
        let columns = tiles_across(self.size.width_px);
        let x_px = turn.tile % columns * TILE_EDGE_PX;
        let y_px = turn.tile / columns * TILE_EDGE_PX;
        let first_sample = turn.slice * self.slice;
        let job = TileJob {
            x_px,
            y_px,
            width_px: TILE_EDGE_PX.min(self.size.width_px - x_px),
            height_px: TILE_EDGE_PX.min(self.size.height_px - y_px),
            first_sample,
            samples: self.slice.min(self.samples - first_sample),
            seed: self.seed,
        };
        (turn, job)
    }

    /// Light job `number` of [`Self::light_jobs`].
    #[must_use]
    pub fn light_job(&self, number: u32) -> LightJob {
        assert!(number < self.light_jobs, "light job {number} of {}", self.light_jobs);
        // The first `extra` jobs have one path more.
        let (paths, jobs, number) = (self.total_light_paths(), u64::from(self.light_jobs), u64::from(number));
        let (least, extra) = (paths / jobs, paths % jobs);
        let count = least + u64::from(number < extra);
        LightJob {
            first_path: number * least + number.min(extra),
            paths: u32::try_from(count).expect("a light job has at most 2^24 paths"),
            seed: self.seed,
        }
    }
}

const fn tiles_across(edge_px: u32) -> u32 {
    edge_px.div_ceil(TILE_EDGE_PX)
}

/// Walks through a plan's jobs in the order they should run, tiles and light spread evenly, while there is room.
#[derive(Clone, Copy, Debug)]
pub struct Cursor {
    plan: RenderPlan,
    next_tile: u64,
    next_light: u32,
}

impl Cursor {
    /// At the start.
    #[must_use]
    pub const fn new(plan: RenderPlan) -> Self {
        Self { plan, next_tile: 0, next_light: 0 }
    }

    /// Tile jobs handed out.
    #[must_use]
    pub const fn tiles_out(&self) -> u64 {
        self.next_tile
    }

    /// Light jobs handed out.
    #[must_use]
    pub const fn lights_out(&self) -> u32 {
        self.next_light
    }

    /// The next job of a kind that has room; `None` when there is none.
    pub fn next(&mut self, tile_room: bool, light_room: bool) -> Option<PlannedJob> {
        let tile = tile_room && self.next_tile < self.plan.tile_jobs();
        let light = light_room && self.next_light < self.plan.light_jobs();
        // The kind that is behind goes first: compare next_light / light_jobs with next_tile / tile_jobs.
        let light_behind = u128::from(self.next_light) * u128::from(self.plan.tile_jobs())
            <= u128::from(self.next_tile) * u128::from(self.plan.light_jobs());
        match (tile, light) {
            (false, false) => None,
            (tile, true) if light_behind || !tile => {
                self.next_light += 1;
                Some(PlannedJob::Light(self.next_light - 1, self.plan.light_job(self.next_light - 1)))
            }
            _ => {
                self.next_tile += 1;
                let (turn, job) = self.plan.tile_job(self.next_tile - 1);
                Some(PlannedJob::Tile(turn, job))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn plan(width: u32, height: u32, samples: u32) -> RenderPlan {
        RenderPlan::new(FilmSize::new(width, height).unwrap(), samples, 7, LightImage::Traced)
    }

    #[test]
    fn the_documented_sizes_hold() {
        for (width, height, samples, slice, tiles, lights) in [
            (128, 96, 16, 4, 16, 12),
            (512, 512, 16, 4, 256, 16),
            (1920, 1152, 64, 64, 540, 16),
            (1920, 1152, 1_024, 256, 2_160, 135),
            (1, 1, 1, 1, 1, 1),
            (64, 64, 1_000_000, 256, 3_907, 245),
        ] {
            let plan = plan(width, height, samples);
            let got = (plan.slice(), plan.tile_jobs(), plan.light_jobs());
            assert_eq!(got, (slice, tiles, lights), "{width}x{height} at {samples}");
        }
    }

    #[test]
    fn an_image_without_a_light_layer_has_no_light_jobs() {
        let plan = RenderPlan::new(FilmSize::new(640, 480).unwrap(), 8, 1, LightImage::Left);
        assert_eq!((plan.light_jobs(), plan.total_light_paths()), (0, 0));
        let mut cursor = Cursor::new(plan);
        let tiles = std::iter::from_fn(|| cursor.next(true, true)).count();
        assert_eq!(tiles as u64, plan.tile_jobs());
    }

    proptest! {
        #[test]
        fn jobs_cover_every_sample_and_path_once(
            width in 1_u32..300, height in 1_u32..200, samples in 1_u32..700,
        ) {
            let plan = plan(width, height, samples);
            let mut covered = vec![0_u32; (width * height) as usize];
            let mut cursor = Cursor::new(plan);
            let (mut next_path, mut previous) = (0, None::<TileTurn>);
            while let Some(job) = cursor.next(true, true) {
                match job {
                    PlannedJob::Tile(turn, job) => {
                        prop_assert!(previous.is_none_or(|p| (p.slice, p.tile) < (turn.slice, turn.tile)));
                        previous = Some(turn);
                        for y in job.y_px..job.y_px + job.height_px {
                            for x in job.x_px..job.x_px + job.width_px {
                                let pixel = &mut covered[(y * width + x) as usize];
                                prop_assert_eq!(*pixel, job.first_sample, "samples in order, none left out");
                                *pixel += job.samples;
                            }
                        }
                    }
                    PlannedJob::Light(_, job) => {
                        prop_assert_eq!(job.first_path, next_path);
                        next_path += u64::from(job.paths);
                    }
                }
            }
            prop_assert!(covered.iter().all(|count| *count == samples));
            prop_assert_eq!(next_path, plan.total_light_paths());
        }

        #[test]
        fn a_full_kind_lets_the_other_go_on(tile_room: bool, light_room: bool) {
            let mut cursor = Cursor::new(plan(256, 256, 32));
            while cursor.next(tile_room, light_room).is_some() {}
            let plan = plan(256, 256, 32);
            prop_assert_eq!(cursor.tiles_out(), if tile_room { plan.tile_jobs() } else { 0 });
            prop_assert_eq!(cursor.lights_out(), if light_room { plan.light_jobs() } else { 0 });
        }
    }
}
