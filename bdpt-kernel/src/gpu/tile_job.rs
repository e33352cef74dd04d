//! One tile of the image times a range of samples: eye subpaths, their connections, the first hits.
//!
//! Lane = (pixel, slot). A launch gives each slot one sample; slots sum their samples in order and are summed in order
//! at the end, so the result depends on neither the executor's cuts nor the device's size.

use bytemuck::{bytes_of, pod_collect_to_vec};
use farm_core::{
    message::CostNs,
    program::{Buffer, DispatchError, JobProgram, Kernel, Slicing},
};

use super::{
    DecodeError, bind_scene, check_sections,
    frame::FrameParams,
    layout::{self, BLOCK_EDGE_PX, GROUP_LANES, MAX_LIGHT_VERTICES, binding},
    pack::SceneContents,
};

/// Sum over the samples of one pixel.
pub type PixelSum = layout::SlotSum;
/// First-hit sums of one pixel.
pub type FirstHit = layout::FirstHitSum;

/// Most slots of a tile: a 64x64 tile then has 262,144 lanes, what an H200 holds.
pub const MAX_SLOTS: u32 = 64;
/// Most samples of one job: its launches stay far below a program's command quota.
pub const MAX_SAMPLES: u32 = 65_536;
/// Samples averaged into the first hits.
pub const FIRST_HIT_SAMPLES: u32 = 8;
/// Most lanes of a tile with one slot: a tile of 512x512.
const MAX_TILE_PIXELS: u64 = 512 * 512;
/// Time of one sample on a simulated device of speed 1.0: a million samples a second, the thesis' measure of its GPUs.
const COST_PER_SAMPLE_NS: u64 = 1_000;
/// Time of one first-hit ray on a simulated device of speed 1.0: a thirtieth of a sample, which traces about 30 rays.
const COST_PER_FIRST_HIT_NS: u64 = 33;

/// A tile job. Plain values: the same ones always give the same result on the same kind of device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct TileJob {
    /// Left column in the image.
    pub x_px: u32,
    /// Top row in the image.
    pub y_px: u32,
    /// Columns, > 0.
    pub width_px: u32,
    /// Rows, > 0.
    pub height_px: u32,
    /// Number of the first sample per pixel; jobs of one image take disjoint ranges.
    pub first_sample: u32,
    /// Samples per pixel, 1..=65,536.
    pub samples: u32,
    /// The image's seed.
    pub seed: u64,
}

/// What a tile job returns.
#[derive(Clone, Debug, PartialEq)]
pub struct TileLayer {
    /// Left column in the image.
    pub x_px: u32,
    /// Top row in the image.
    pub y_px: u32,
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Row by row: the eye layer.
    pub pixels: Vec<PixelSum>,
    /// Row by row: albedo, normal, depth.
    pub first_hits: Vec<FirstHit>,
    /// What the device had to cut or drop.
    pub counters: layout::Counters,
}

impl TileJob {
    /// Fills a program with the job.
    ///
    /// # Errors
    /// The tile leaves the image, has no pixel or too many, or no samples or too many.
    pub fn program(
        &self,
        scene: &SceneContents,
        frame: &FrameParams,
        cmd: &mut JobProgram,
    ) -> Result<(), DispatchError> {
        self.check(frame)?;
        let pixels = u64::from(self.pixels());
        let slots = self.slots();
        let blocks = [self.width_px.div_ceil(BLOCK_EDGE_PX), self.height_px.div_ceil(BLOCK_EDGE_PX)];
        let lanes_per_slot = blocks[0] * blocks[1] * GROUP_LANES;
        let max_groups_z = (frame.options.lanes_per_run / lanes_per_slot).clamp(1, slots);
        let scratch_lanes = lanes_per_slot * max_groups_z;
        let scratch_bytes = u64::from(scratch_lanes) * u64::from(MAX_LIGHT_VERTICES) * 16;

        let counters = cmd.malloc(size_of::<layout::Counters>() as u64)?;
        let slot_sums = cmd.malloc(pixels * u64::from(slots) * size_of::<layout::SlotSum>() as u64)?;
        let pixel_sums = cmd.malloc(pixels * size_of::<layout::SlotSum>() as u64)?;
        let first_hits = cmd.malloc(pixels * size_of::<layout::FirstHitSum>() as u64)?;
        let tile = |first_sample: u32| layout::Tile {
            x_px: self.x_px,
            y_px: self.y_px,
            width_px: self.width_px,
            height_px: self.height_px,
            first_sample,
            slots,
            seed_lo: low_half(self.seed),
            seed_hi: high_half(self.seed),
            scratch_lanes,
            first_hit_samples: self.samples.min(FIRST_HIT_SAMPLES),
            padding: [0; 2],
        };

        let first_hit = cmd.function(scene.module, "first_hit");
        bind_scene(cmd, first_hit, scene, counters)?;
        cmd.param_in_out(first_hit, binding::FIRST_HITS, first_hits)?;
        set_uniforms(cmd, first_hit, frame, &tile(self.first_sample))?;
        let first_hit_cost =
            CostNs(pixels * u64::from(self.samples.min(FIRST_HIT_SAMPLES)) * COST_PER_FIRST_HIT_NS);
        cmd.launch_with_cost(first_hit, [blocks[0], blocks[1], 1], first_hit_cost)?;

        let eye = cmd.function(scene.module, "eye");
        bind_scene(cmd, eye, scene, counters)?;
        for binding in [binding::VERTEX_A, binding::VERTEX_B, binding::VERTEX_C] {
            let vertices = cmd.malloc(scratch_bytes)?;
            cmd.param_in_out(eye, binding, vertices)?;
        }
        cmd.param_in_out(eye, binding::SLOT_SUMS, slot_sums)?;
        let mut done = 0;
        while done < self.samples {
            let launched = slots.min(self.samples - done);
            set_uniforms(cmd, eye, frame, &tile(self.first_sample + done))?;
            let slicing = Slicing { global: "first_slot".to_owned(), max_groups_z };
            let cost = CostNs(pixels * u64::from(launched) * COST_PER_SAMPLE_NS);
            cmd.launch_sliced(eye, [blocks[0], blocks[1], launched], slicing, cost)?;
            done += launched;
        }

        self.resolve(scene, &tile(self.first_sample), slot_sums, pixel_sums, cmd)?;
        cmd.memcpy_dtoh(pixel_sums, 0, pixels * size_of::<layout::SlotSum>() as u64)?;
        cmd.memcpy_dtoh(first_hits, 0, pixels * size_of::<layout::FirstHitSum>() as u64)?;
        cmd.memcpy_dtoh(counters, 0, size_of::<layout::Counters>() as u64)
    }

    /// The layer in a result's sections.
    ///
    /// # Errors
    /// The sections are not those that the program asks for.
    pub fn decode<B: AsRef<[u8]>>(&self, sections: &[B]) -> Result<TileLayer, DecodeError> {
        let pixels = self.pixels() as usize;
        let expected = [
            pixels * size_of::<layout::SlotSum>(),
            pixels * size_of::<layout::FirstHitSum>(),
            size_of::<layout::Counters>(),
        ];
        let [sums, first_hits, counters] = check_sections(sections, expected)?;
        Ok(TileLayer {
            x_px: self.x_px,
            y_px: self.y_px,
            width_px: self.width_px,
            height_px: self.height_px,
            pixels: pod_collect_to_vec(sums),
            first_hits: pod_collect_to_vec(first_hits),
            counters: bytemuck::pod_read_unaligned(counters),
        })
    }

    /// Samples of the job: the work that its cost is in proportion to.
    #[must_use]
    pub fn total_samples(&self) -> u64 {
        u64::from(self.pixels()) * u64::from(self.samples)
    }

    fn resolve(
        &self,
        scene: &SceneContents,
        tile: &layout::Tile,
        slot_sums: Buffer,
        pixel_sums: Buffer,
        cmd: &mut JobProgram,
    ) -> Result<(), DispatchError> {
        let resolve = cmd.function(scene.module, "resolve_eye");
        cmd.param_in_out(resolve, binding::SLOT_SUMS, slot_sums)?;
        cmd.param_in_out(resolve, binding::PIXEL_SUMS, pixel_sums)?;
        cmd.memcpy_htod(resolve, "tile", bytes_of(tile))?;
        cmd.launch(resolve, [self.pixels().div_ceil(GROUP_LANES), 1, 1])
    }

    const fn pixels(&self) -> u32 {
        self.width_px * self.height_px
    }

    fn slots(&self) -> u32 {
        self.samples.min(MAX_SLOTS)
    }

    fn check(&self, frame: &FrameParams) -> Result<(), DispatchError> {
        let inside =
            |start: u32, length: u32, whole: u32| start.checked_add(length).is_some_and(|end| end <= whole);
        let pixels = u64::from(self.width_px) * u64::from(self.height_px);
        if !inside(self.x_px, self.width_px, frame.film.width_px)
            || !inside(self.y_px, self.height_px, frame.film.height_px)
            || pixels == 0
            || pixels > MAX_TILE_PIXELS
        {
            return Err(DispatchError::Application(format!(
                "tile {}x{} at ({}, {}) must have 1..={MAX_TILE_PIXELS} pixels inside the image of {}x{}",
                self.width_px,
                self.height_px,
                self.x_px,
                self.y_px,
                frame.film.width_px,
                frame.film.height_px
            )));
        }
        let last = self.first_sample.checked_add(self.samples);
        if self.samples == 0 || self.samples > MAX_SAMPLES || last.is_none() {
            return Err(DispatchError::Application(format!(
                "samples {}..+{}: must be 1..={MAX_SAMPLES} and end below 2^32",
                self.first_sample, self.samples
            )));
        }
        Ok(())
    }
}

fn set_uniforms(
    cmd: &mut JobProgram,
    kernel: Kernel,
    frame: &FrameParams,
    tile: &layout::Tile,
) -> Result<(), DispatchError> {
    cmd.memcpy_htod(kernel, "frame", bytes_of(&frame.frame))?;
    cmd.memcpy_htod(kernel, "tile", bytes_of(tile))
}

pub(super) const fn low_half(value: u64) -> u32 {
    (value & 0xffff_ffff) as u32
}

pub(super) const fn high_half(value: u64) -> u32 {
    (value >> 32) as u32
}
