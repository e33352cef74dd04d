//! A scene after loading: checked, complete, in world units. What the loader yields and what packing and the CPU twins read.

use glam::Vec3;

/// Image size in pixels, both > 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FilmSize {
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
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
    /// Horizontal field of view in degrees, 0 < hfov < 180.
    pub hfov_deg: f32,
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
        /// Index of refraction inside, > 0.
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
