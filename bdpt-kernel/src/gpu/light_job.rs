//! A range of light paths over the whole image: every light vertex connected to the camera (t = 1).
//!
//! Splats are summed in fixed point, so that their order does not matter and a rerun gives the same bytes.

use bytemuck::{bytes_of, pod_collect_to_vec};
use farm_core::{
    message::CostNs,
    program::{Buffer, DispatchError, JobProgram, Slicing},
};

use super::{
    DecodeError, bind_scene, check_sections,
    frame::FrameParams,
    layout::{self, GROUP_LANES, binding},
    pack::SceneContents,
    tile_job::{high_half, low_half},
};

/// Workgroups in x: 1,024 paths are the least that an executor can cut a run to.
const GROUPS_X: u32 = 16;
/// Most paths of one job: z extents stay within the 65,535 workgroups that WebGPU guarantees.
pub const MAX_PATHS: u32 = 65_535 * GROUPS_X * GROUP_LANES;
/// Time of one path on a simulated device of speed 1.0: a third of a sample, for a third of its rays.
const COST_PER_PATH_NS: u64 = 333;

/// A light job. Plain values: the same ones always give the same result on the same kind of device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct LightJob {
    /// Index of the first light path; jobs of one image take disjoint ranges.
    pub first_path: u64,
    /// Light paths, > 0.
    pub paths: u32,
    /// The image's seed.
    pub seed: u64,
}

/// What a light job returns. The image's second layer is the sum of the layers' `rgb` over the sum of their `paths`.
#[derive(Clone, Debug, PartialEq)]
pub struct SplatLayer {
    /// Columns of the image.
    pub width_px: u32,
    /// Rows of the image.
    pub height_px: u32,
    /// Row by row: sum of the splats.
    pub rgb: Vec<[f32; 3]>,
    /// Light paths traced, those that missed everything included.
    pub paths: u32,
    /// What the device had to cut or drop, and its rays.
    pub counters: layout::Counters,
}

impl LightJob {
    /// Fills a program with the job.
    ///
    /// # Errors
    /// No path, too many, or an index that does not fit.
    pub fn program(
        &self,
        scene: &SceneContents,
        frame: &FrameParams,
        cmd: &mut JobProgram,
    ) -> Result<(), DispatchError> {
        if self.paths == 0
            || self.paths > MAX_PATHS
            || self.first_path.checked_add(u64::from(self.paths)).is_none()
        {
            return Err(DispatchError::Application(format!(
                "light paths {}..+{}: must be 1..={MAX_PATHS} and end below 2^64",
                self.first_path, self.paths
            )));
        }
        let pixels = frame.pixels();
        let groups = self.paths.div_ceil(GROUP_LANES);
        let groups_x = groups.min(GROUPS_X);
        let range = layout::LightRange {
            first_path_lo: low_half(self.first_path),
            first_path_hi: high_half(self.first_path),
            paths: self.paths,
            groups_x,
            seed_lo: low_half(self.seed),
            seed_hi: high_half(self.seed),
            padding: [0; 2],
        };
        let counters = cmd.malloc(size_of::<layout::Counters>() as u64)?;
        let splats: [Buffer; 3] = [cmd.malloc(pixels * 8)?, cmd.malloc(pixels * 8)?, cmd.malloc(pixels * 8)?];
        let layer = cmd.malloc(pixels * 12)?;

        let light = cmd.function(scene.module, "light");
        bind_scene(cmd, light, scene, counters)?;
        for (binding, splat) in (binding::SPLAT_RED..).zip(splats) {
            cmd.param_in_out(light, binding, splat)?;
        }
        cmd.memcpy_htod(light, "frame", bytes_of(&frame.frame))?;
        cmd.memcpy_htod(light, "light_range", bytes_of(&range))?;
        let groups_z = groups.div_ceil(groups_x);
        let slicing = Slicing { global: "first_slot".to_owned(), max_groups_z: groups_z };
        let cost = CostNs(u64::from(self.paths) * COST_PER_PATH_NS);
        cmd.launch_sliced(light, [groups_x, 1, groups_z], slicing, cost)?;

        let resolve = cmd.function(scene.module, "resolve_splat");
        for (binding, splat) in (binding::SPLAT_RED..).zip(splats) {
            cmd.param_in_out(resolve, binding, splat)?;
        }
        cmd.param_in_out(resolve, binding::SPLAT_LAYER, layer)?;
        cmd.memcpy_htod(resolve, "frame", bytes_of(&frame.frame))?;
        let blocks = frame.film.width_px.div_ceil(GROUP_LANES);
        cmd.launch(resolve, [blocks, frame.film.height_px, 1])?;
        cmd.memcpy_dtoh(layer, 0, pixels * 12)?;
        cmd.memcpy_dtoh(counters, 0, size_of::<layout::Counters>() as u64)
    }

    /// The layer in a result's sections; `frame` as in [`Self::program`].
    ///
    /// # Errors
    /// The sections are not those that the program asks for.
    pub fn decode<B: AsRef<[u8]>>(
        &self,
        frame: &FrameParams,
        sections: &[B],
    ) -> Result<SplatLayer, DecodeError> {
        let layer_bytes = usize::try_from(frame.pixels() * 12).expect("FrameParams bounds the pixels");
        let [layer, counters] = check_sections(sections, [layer_bytes, size_of::<layout::Counters>()])?;
        Ok(SplatLayer {
            width_px: frame.film.width_px,
            height_px: frame.film.height_px,
            rgb: pod_collect_to_vec(layer),
            paths: self.paths,
            counters: bytemuck::pod_read_unaligned(counters),
        })
    }
}
