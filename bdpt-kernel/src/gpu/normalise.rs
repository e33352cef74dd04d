//! Scenes in the units that the kernels are made for: around the origin, bounding radius 2..=4.
//!
//! f32 offsets and the recursion's d^2 factors need a known scale (50-bdpt.md section 3, trap 6).

use glam::{DVec3, Vec3};

use crate::scene::model::{Camera, Scene, Triangle};

/// Bounding radius that a normalised scene stays under.
const RADIUS_MAX: f64 = 4.0;

/// A scene moved to the origin and scaled by a power of two. Radiance, materials and image stay as they were.
#[derive(Clone, Debug)]
pub struct NormalisedScene {
    scene: Scene,
    world_per_unit: f32,
    radius: f32,
}

impl NormalisedScene {
    /// Moves and scales a scene. One without extent keeps its scale.
    #[must_use]
    pub fn new(scene: &Scene) -> Self {
        let (low, high) = bounds(&scene.triangles);
        let center = (low + high) * 0.5;
        let radius = scene
            .triangles
            .iter()
            .flat_map(|t| t.positions)
            .map(|p| (p.as_dvec3() - center).length())
            .fold(0.0_f64, f64::max);
        // A power of two scales without rounding: 2^e with RADIUS_MAX / 2 < radius * 2^e <= RADIUS_MAX.
        let exponent =
            if radius > 0.0 { (RADIUS_MAX / radius).log2().floor().clamp(-100.0, 100.0) } else { 0.0 };
        let scale = exponent.exp2();
        let place = |p: Vec3| ((p.as_dvec3() - center) * scale).as_vec3();
        let triangles =
            scene.triangles.iter().map(|t| Triangle { positions: t.positions.map(place), ..*t }).collect();
        let camera =
            Camera { eye: place(scene.camera.eye), target: place(scene.camera.target), ..scene.camera };
        let scaled = Scene { triangles, camera, ..scene.clone_without_triangles() };
        Self { scene: scaled, world_per_unit: to_f32(1.0 / scale), radius: to_f32(radius * scale) }
    }

    /// The scene in kernel units: build the hierarchy over its triangles.
    #[must_use]
    pub const fn scene(&self) -> &Scene {
        &self.scene
    }

    /// World units per kernel unit, a power of two.
    #[must_use]
    pub const fn world_per_unit(&self) -> f32 {
        self.world_per_unit
    }

    /// Radius of the sphere around the origin that holds all triangles.
    #[must_use]
    pub const fn radius(&self) -> f32 {
        self.radius
    }
}

impl Scene {
    /// Everything but the geometry, which is large and about to be replaced.
    fn clone_without_triangles(&self) -> Self {
        Self {
            film: self.film,
            camera: self.camera,
            triangles: Vec::new(),
            materials: self.materials.clone(),
            environment: self.environment,
        }
    }
}

fn bounds(triangles: &[Triangle]) -> (DVec3, DVec3) {
    let mut points = triangles.iter().flat_map(|t| t.positions).map(|p| p.as_dvec3());
    let Some(first) = points.next() else { return (DVec3::ZERO, DVec3::ZERO) };
    points.fold((first, first), |(low, high), p| (low.min(p), high.max(p)))
}

#[allow(clippy::cast_possible_truncation, reason = "rounding to f32 is meant")]
fn to_f32(value: f64) -> f32 {
    value as f32
}
