//! A scene after loading: checked, complete, in world units. What the loader yields and what packing and the CPU twins read.

use glam::Vec3;
use thiserror::Error;

/// Largest coordinate of geometry and camera. Normalisation scales a scene to a radius of 2..4 and the camera with it; at 1e9
/// a triangle's squared area (1e36) still is an `f32` (up to 3e38).
pub(crate) const MAX_COORDINATE: f32 = 1e9;

/// Largest emitted radiance in a channel: its square (variance, 1e24) times 2^32 samples stays below the 3e38 of an `f32`.
pub(crate) const MAX_RADIANCE: f32 = 1e12;

/// Indices of refraction that can be rendered: far beyond any material, and Fresnel's fourth powers (1e8) leave digits.
pub(crate) const IOR_RANGE: std::ops::RangeInclusive<f32> = 0.01..=100.0;

/// Image size in pixels, both > 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FilmSize {
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
}

/// An image size that cannot be rendered.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum FilmSizeError {
    /// An edge is zero or too long.
    #[error("image size {width_px}x{height_px}: each edge must be in 1..{} pixels", FilmSize::MAX_EDGE_PX)]
    Edge {
        /// Columns asked for.
        width_px: u32,
        /// Rows asked for.
        height_px: u32,
    },
    /// Too many pixels together.
    #[error("image size {width_px}x{height_px}: more than {} pixels", FilmSize::MAX_PIXELS)]
    Area {
        /// Columns asked for.
        width_px: u32,
        /// Rows asked for.
        height_px: u32,
    },
}

impl FilmSize {
    /// Longest edge of an image.
    pub const MAX_EDGE_PX: u32 = 16_384;
    /// Most pixels of an image: its layers take some 100 B a pixel.
    pub const MAX_PIXELS: u64 = 1 << 26;

    /// A checked size.
    ///
    /// # Errors
    /// An edge is zero or longer than [`Self::MAX_EDGE_PX`], or the area exceeds [`Self::MAX_PIXELS`].
    pub const fn new(width_px: u32, height_px: u32) -> Result<Self, FilmSizeError> {
        let size = Self { width_px, height_px };
        if width_px == 0 || height_px == 0 || width_px > Self::MAX_EDGE_PX || height_px > Self::MAX_EDGE_PX {
            return Err(FilmSizeError::Edge { width_px, height_px });
        }
        if size.pixels() > Self::MAX_PIXELS {
            return Err(FilmSizeError::Area { width_px, height_px });
        }
        Ok(size)
    }

    /// Columns times rows.
    #[must_use]
    pub const fn pixels(self) -> u64 {
        // Lossless: u64::from is not const.
        self.width_px as u64 * self.height_px as u64
    }
}

/// A pinhole camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Position.
    pub eye: Vec3,
    /// A point on the view axis.
    pub target: Vec3,
    /// Roughly up; not parallel to the view axis.
    pub up: Vec3,
    /// Horizontal field of view in degrees, in [`Self::HFOV_RANGE_DEG`].
    pub hfov_deg: f32,
}

impl Camera {
    /// Fields of view that can be rendered, in degrees: at both ends the tangent of the half (9e-5, 1146) and the inverse of
    /// its square, which weighs paths to the camera, keep their digits in single precision.
    pub const HFOV_RANGE_DEG: std::ops::RangeInclusive<f32> = 0.01..=179.9;
}

/// How a surface scatters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Bsdf {
    /// Lambertian, two-sided; `reflectance` in 0..=1.
    Diffuse {
        /// Albedo, linear RGB.
        reflectance: Vec3,
    },
    /// Perfect reflector, two-sided.
    Mirror {
        /// Factor on what is reflected, linear RGB.
        reflectance: Vec3,
    },
    /// Smooth glass; the winding tells the outside (counter-clockwise = outside, index 1).
    Dielectric {
        /// Index of refraction inside, 0.01 to 100.
        ior: f32,
    },
}

/// A surface's material.
#[derive(Clone, Debug, PartialEq)]
pub struct Material {
    /// MTL name.
    pub name: String,
    /// How it scatters.
    pub bsdf: Bsdf,
    /// Emitted radiance, linear RGB, from the counter-clockwise face only; zero for most.
    pub emission: Vec3,
}

/// A triangle with everything shading needs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Triangle {
    /// Corners, counter-clockwise seen from outside.
    pub positions: [Vec3; 3],
    /// Shading normals at the corners, unit length; the face normal where the file has none.
    pub normals: [Vec3; 3],
    /// Index into [`Scene::materials`].
    pub material: u32,
}

/// A loaded scene.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Default image size of the scene file.
    pub film: FilmSize,
    /// The camera.
    pub camera: Camera,
    /// The geometry; none degenerate, all finite.
    pub triangles: Vec<Triangle>,
    /// The materials.
    pub materials: Vec<Material>,
    /// Constant radiance from all directions that miss the geometry, linear RGB.
    pub environment: Option<Vec3>,
}
