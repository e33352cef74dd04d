//! What all jobs of one image share: size, camera, limits of the integrator.

use thiserror::Error;

use super::{
    layout::{self, MAX_EDGES},
    pack::PackedScene,
};
use crate::scene::model::FilmSize;

/// Lanes of one run of the tile kernel, which its scratch memory is sized for: 28 MiB in each of three bindings.
/// Measured on an H200, kitchen of 1,050,722 triangles: 39 M samples/s of device time with 65,536 lanes, 45 M with
/// 131,072; 51 M with 524,288 and jobs of 256 samples, at four times the memory.
pub const LANES_PER_RUN: u32 = 1 << 17;

/// Which strategies make the image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Integrator {
    /// All: s = 0, s = 1, s >= 2 in tile jobs, t = 1 in light jobs.
    #[default]
    Bidirectional,
    /// Without a light image: s = 0, s = 1, s >= 2. No light jobs are needed.
    NoLightImage,
    /// s = 0 and s = 1 only. No light jobs are needed.
    PathTracing,
}

/// What the user may choose about the integrator.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderOptions {
    /// Which strategies.
    pub integrator: Integrator,
    /// Longest path in edges, 1..=16.
    pub max_edges: u32,
    /// Edges before Russian roulette starts, >= 1.
    pub roulette_edges: u32,
    /// A connection (s >= 2) whose contribution's luminance is below this plays roulette before its shadow ray is traced;
    /// 0 traces all. Unbiased at any value, but above a tenth of the image's dark parts it adds noise.
    pub connection_threshold: f32,
    /// Lanes of one run of the tile kernel, > 0: sizes its scratch memory, never the result.
    pub lanes_per_run: u32,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self {
            integrator: Integrator::Bidirectional,
            max_edges: MAX_EDGES,
            roulette_edges: 3,
            connection_threshold: 0.0,
            lanes_per_run: LANES_PER_RUN,
        }
    }
}

/// An image or options that the kernels cannot render. Not to be retried.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum FrameError {
    /// No pixel, or more than a light image's binding holds.
    #[error("image of {width_px}x{height_px} pixels: must have 1..={max} pixels", max = FrameParams::MAX_PIXELS)]
    Size {
        /// Columns.
        width_px: u32,
        /// Rows.
        height_px: u32,
    },
    /// A path length that the kernels do not hold.
    #[error("max_edges {0} must be 1..={MAX_EDGES}")]
    MaxEdges(u32),
    /// Roulette before the first edge, or no lane.
    #[error("roulette_edges and lanes_per_run must be positive")]
    Zero,
    /// The camera has no direction: eye and target coincide, up is along the view axis, or the field of view is not in
    /// 0..180 degrees.
    #[error(
        "the camera looks nowhere: eye and target coincide, up is parallel to the view, or hfov is not in 0..180"
    )]
    Camera,
}

/// The frame's uniform and the sizes that programs need.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameParams {
    /// Size of the whole image.
    pub film: FilmSize,
    /// The options that made it.
    pub options: RenderOptions,
    /// The uniform `frame`.
    pub frame: layout::Frame,
}

impl FrameParams {
    /// Most pixels of an image: three bindings of 8 B a pixel hold a light image, and the smallest limit is 128 MiB.
    pub const MAX_PIXELS: u64 = (128 << 20) / 12;

    /// The parameters of an image of a packed scene.
    ///
    /// # Errors
    /// An image without or with too many pixels, options out of range, a camera without a direction.
    pub fn new(scene: &PackedScene, film: FilmSize, options: RenderOptions) -> Result<Self, FrameError> {
        let FilmSize { width_px, height_px } = film;
        let pixels = u64::from(width_px) * u64::from(height_px);
        if pixels == 0 || pixels > Self::MAX_PIXELS {
            return Err(FrameError::Size { width_px, height_px });
        }
        if !(1..=MAX_EDGES).contains(&options.max_edges) {
            return Err(FrameError::MaxEdges(options.max_edges));
        }
        if options.roulette_edges == 0 || options.lanes_per_run == 0 {
            return Err(FrameError::Zero);
        }
        let globals = &scene.globals;
        let camera = &globals.camera;
        let forward = (camera.target - camera.eye).normalize_or_zero();
        let right = forward.cross(camera.up.normalize_or_zero()).normalize_or_zero();
        let up = right.cross(forward);
        let sees = camera.hfov_deg > 0.0 && camera.hfov_deg < 180.0;
        if !sees || right.length_squared() < 0.5 {
            return Err(FrameError::Camera);
        }
        #[allow(clippy::cast_precision_loss, reason = "image edges and pixel counts as real numbers")]
        let (width, nl) = (width_px as f32, pixels as f32);
        let (connect, splat) = match options.integrator {
            Integrator::Bidirectional => (1.0, 1.0),
            Integrator::NoLightImage => (1.0, 0.0),
            Integrator::PathTracing => (0.0, 0.0),
        };
        let frame = layout::Frame {
            eye: camera.eye.into(),
            d_img: width / (2.0 * (camera.hfov_deg.to_radians() * 0.5).tan()),
            right: right.into(),
            width_px,
            up: up.into(),
            height_px,
            forward: forward.into(),
            nl,
            environment: globals.environment.into(),
            environment_pl: globals.environment_pl,
            center: [0.0; 3],
            radius: globals.radius,
            light_count: globals.light_count,
            max_edges: options.max_edges,
            connect,
            splat,
            // Fixed point in units near the brightest light's radiance: 32 bits of fraction below, 31 above.
            splat_unit: globals.brightest.max(f32::MIN_POSITIVE).log2().ceil().exp2(),
            roulette_edges: options.roulette_edges,
            connection_threshold: options.connection_threshold,
            area_pdf_scale: globals.area_pdf_scale,
            world_per_unit: globals.world_per_unit,
            padding: [0; 3],
        };
        Ok(Self { film, options, frame })
    }

    /// Whether the image needs light jobs.
    #[must_use]
    pub fn needs_light_jobs(&self) -> bool {
        self.options.integrator == Integrator::Bidirectional
    }

    /// Pixels of the whole image.
    #[must_use]
    pub fn pixels(&self) -> u64 {
        u64::from(self.film.width_px) * u64::from(self.film.height_px)
    }
}
