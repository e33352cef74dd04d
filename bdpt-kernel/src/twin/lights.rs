//! Twin of `shaders/shared/lights.wgsl`.

use std::f32::consts::PI;

use glam::{Vec2, Vec3, Vec4};

use super::{
    TwinScene,
    math::{luminance, sample_cosine_hemisphere, sample_disk, sample_sphere, sample_triangle, to_world},
    surface::offset_along,
};
use crate::gpu::layout::ENVIRONMENT;

/// Where a light subpath starts; all pdfs include the light's probability Pl.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Emission {
    /// Start of the first ray.
    pub origin: Vec3,
    /// From the environment.
    pub infinite: bool,
    /// Unit.
    pub direction: Vec3,
    /// Start of the recursion.
    pub dvcm: f32,
    /// Radiance over emiPdf, times the cosine of an area light.
    pub throughput: Vec3,
    /// Start of the recursion.
    pub dvc: f32,
}

/// A light sample seen from a surface (s = 1).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LightSample {
    /// From the surface toward the light, unit.
    pub direction: Vec3,
    /// dirPdfW, `pdf_solid_angle`; 0 when the light shows its back.
    pub direct_pdf: f32,
    /// Emitted radiance.
    pub radiance: Vec3,
    /// emiPdf over cosL.
    pub emission_pdf_over_cos: f32,
    /// Light-side end of the shadow ray.
    pub end: Vec3,
    /// From the environment: no end.
    pub infinite: bool,
}

/// A column of the alias table, then the column's own light or its alias.
#[must_use]
pub fn pick_light(scene: &TwinScene, u: f32) -> u32 {
    let count = scene.frame.light_count;
    #[allow(clippy::cast_precision_loss, reason = "as the kernel does")]
    let scaled = u * count as f32;
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 <= u < 1")]
    let column = (scaled as u32).min(count - 1);
    #[allow(clippy::cast_precision_loss, reason = "as the kernel does")]
    let rest = scaled - column as f32;
    let light = &scene.lights[column as usize];
    if rest < light.alias_threshold { column } else { light.alias_index }
}

/// `pdf_solid_angle` of the environment as a light sample.
#[must_use]
pub fn environment_pdf(scene: &TwinScene) -> f32 {
    scene.frame.environment_pl * (1.0 / (4.0 * PI))
}

/// emiPdf of the environment.
#[must_use]
pub fn environment_emission_pdf(scene: &TwinScene) -> f32 {
    environment_pdf(scene) / (PI * scene.frame.radius * scene.frame.radius)
}

/// dirPdfA of a point on an emitting triangle.
#[must_use]
pub fn area_direct_pdf(scene: &TwinScene, emission: Vec3) -> f32 {
    luminance(emission) * scene.frame.area_pdf_scale
}

/// Starts a light subpath.
#[must_use]
pub fn sample_emission(scene: &TwinScene, pick: f32, u: Vec4) -> Emission {
    let light = &scene.lights[pick_light(scene, pick) as usize];
    let radiance = Vec3::from(light.radiance);
    if light.kind == ENVIRONMENT {
        let radius = scene.frame.radius;
        let direction = -sample_sphere(Vec2::new(u.x, u.y));
        let disk = sample_disk(Vec2::new(u.z, u.w)) * radius;
        let origin = Vec3::from(scene.frame.center) + to_world(direction, disk.extend(-radius));
        let disk_area = PI * radius * radius;
        let emission_pdf = light.pl * (1.0 / (4.0 * PI)) / disk_area;
        return Emission {
            origin,
            infinite: true,
            direction,
            dvcm: disk_area,
            throughput: radiance / emission_pdf,
            dvc: 1.0 / emission_pdf,
        };
    }
    let [v0, e1, e2] = [light.v0, light.e1, light.e2].map(Vec3::from);
    let weights = sample_triangle(Vec2::new(u.x, u.y));
    let position = v0 + e1 * weights.x + e2 * weights.y;
    let normal = e1.cross(e2);
    let size = normal.length();
    let ng = normal / size;
    let local = sample_cosine_hemisphere(Vec2::new(u.z, u.w));
    // area * pi / Pl, the inverse of emiPdf without its cosine.
    let inverse_pdf = 0.5 * size * PI / light.pl;
    Emission {
        origin: offset_along(position, ng, ng),
        infinite: false,
        direction: to_world(ng, local),
        dvcm: PI / local.z,
        throughput: radiance * inverse_pdf,
        dvc: inverse_pdf,
    }
}

/// Samples a light for a surface.
#[must_use]
pub fn sample_light(scene: &TwinScene, position: Vec3, u: Vec3) -> LightSample {
    let light = &scene.lights[pick_light(scene, u.x) as usize];
    let radiance = Vec3::from(light.radiance);
    if light.kind == ENVIRONMENT {
        return LightSample {
            direction: sample_sphere(Vec2::new(u.y, u.z)),
            direct_pdf: light.pl * (1.0 / (4.0 * PI)),
            radiance,
            emission_pdf_over_cos: environment_emission_pdf(scene),
            end: Vec3::ZERO,
            infinite: true,
        };
    }
    let [v0, e1, e2] = [light.v0, light.e1, light.e2].map(Vec3::from);
    let weights = sample_triangle(Vec2::new(u.y, u.z));
    let end = v0 + e1 * weights.x + e2 * weights.y;
    let normal = e1.cross(e2);
    let size = normal.length();
    let ng = normal / size;
    let offset = end - position;
    let distance_squared = offset.dot(offset);
    let direction = offset / distance_squared.sqrt();
    let cos_light = -direction.dot(ng);
    let area_pdf = light.pl / (0.5 * size);
    let visible = cos_light > 0.0 && distance_squared > 0.0;
    LightSample {
        direction,
        direct_pdf: if visible { area_pdf * distance_squared / cos_light } else { 0.0 },
        radiance,
        emission_pdf_over_cos: area_pdf / PI,
        end: offset_along(end, ng, ng),
        infinite: false,
    }
}
