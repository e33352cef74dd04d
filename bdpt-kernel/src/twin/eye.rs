//! Twin of `shaders/eye.wgsl`: one eye sample. Where the kernel's loop traces whatever ray is next, the twin has the plain
//! nested loops that it stands for; the random numbers come in the same order.

use std::f32::consts::PI;

use glam::{Vec2, Vec3, Vec4Swizzles};

use super::{
    TwinScene,
    bsdf::{bsdf_eval, bsdf_pdf, is_delta},
    lights::{area_direct_pdf, environment_emission_pdf, environment_pdf, sample_light},
    math::{INFINITE, luminance},
    mis::{ConnectionEnd, mis_weight_connect, mis_weight_emitter, mis_weight_light_sample},
    rng::{Rng, STREAM_EYE, rng_new, rng_next},
    surface::{Surface, offset_along, surface_at},
    traverse::{NO_HIT, Search, trace},
    walk::{
        Candidate, LightVertex, Walk, eye_start, light_start, store_light_vertex, walk_arrive, walk_scatter,
    },
};
use crate::gpu::layout::Material;

/// A strategy: vertices on the light's and on the camera's side, both counted with the endpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Strategy {
    /// Light vertices.
    pub s: u32,
    /// Eye vertices.
    pub t: u32,
}

/// Takes contributions one by one.
pub trait Tally {
    /// `value` is the weighted contribution, `weight` the weight in it.
    fn gather(&mut self, strategy: Strategy, value: Vec3, weight: f32);
    /// A ray was traced.
    fn ray(&mut self) {}
}

/// What the kernel keeps of a sample.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EyeSample {
    /// Sum of the contributions.
    pub rgb: Vec3,
    /// Rays traced.
    pub rays: u32,
}

impl Tally for EyeSample {
    fn gather(&mut self, _: Strategy, value: Vec3, _: f32) {
        if value.is_finite() {
            self.rgb += value;
        }
    }

    fn ray(&mut self) {
        self.rays += 1;
    }
}

/// One sample of a pixel as the kernel sums it.
#[must_use]
pub fn eye_sample(scene: &TwinScene, pixel: [u32; 2], sample: u32, seed: u64) -> EyeSample {
    let mut sum = EyeSample::default();
    eye(scene, pixel, sample, seed, &mut sum);
    sum
}

/// One sample of a pixel, contribution by contribution.
pub fn eye(scene: &TwinScene, pixel: [u32; 2], sample: u32, seed: u64, tally: &mut impl Tally) {
    let frame = &scene.frame;
    let mut rng = rng_new([pixel[1] * frame.width_px + pixel[0], sample], STREAM_EYE, seed);
    let jitter = rng_next(&mut rng);
    #[allow(clippy::cast_precision_loss, reason = "pixel coordinates as real numbers")]
    let point = Vec2::new(pixel[0] as f32, pixel[1] as f32) + jitter.xy();
    let vertices = light_subpath(scene, &mut rng, tally);

    let mut walk = eye_start(scene, point);
    loop {
        tally.ray();
        let hit = trace(scene, walk.origin, walk.direction, INFINITE, Search::Nearest);
        if hit.triangle == NO_HIT {
            let (value, weight) = escaped(scene, &walk);
            tally.gather(Strategy { s: 0, t: walk.edges + 2 }, value, weight);
            return;
        }
        let surface = surface_at(scene, &hit);
        let material = scene.material(&surface);
        walk_arrive(&mut walk, &surface, hit.t);
        let (value, weight) = emitted(scene, &walk, &surface, material);
        tally.gather(Strategy { s: 0, t: walk.edges + 1 }, value, weight);
        if walk.edges >= frame.max_edges {
            return;
        }
        if !is_delta(material) {
            connect(scene, &walk, &surface, material, &vertices, &mut rng, tally);
        }
        if !walk_scatter(scene, &mut walk, &surface, material, rng_next(&mut rng)) {
            return;
        }
    }
}

/// The light vertices of a sample.
fn light_subpath(scene: &TwinScene, rng: &mut Rng, tally: &mut impl Tally) -> Vec<LightVertex> {
    let frame = &scene.frame;
    let mut vertices = Vec::new();
    // A connection needs the edge to the camera and the one between: y has at most max_edges - 2 edges.
    let light_edges = if frame.connect > 0.0 && frame.max_edges > 2 { frame.max_edges - 2 } else { 0 };
    if light_edges == 0 {
        return vertices;
    }
    let mut walk = light_start(scene, rng);
    loop {
        tally.ray();
        let hit = trace(scene, walk.origin, walk.direction, INFINITE, Search::Nearest);
        if hit.triangle == NO_HIT {
            return vertices;
        }
        let surface = surface_at(scene, &hit);
        let material = scene.material(&surface);
        walk_arrive(&mut walk, &surface, hit.t);
        if !is_delta(material) {
            vertices.push(store_light_vertex(&walk, &surface));
        }
        if walk.edges >= light_edges || !walk_scatter(scene, &mut walk, &surface, material, rng_next(rng)) {
            return vertices;
        }
    }
}

/// All connections of an eye vertex: the light sample, then the light vertices.
fn connect(
    scene: &TwinScene,
    walk: &Walk,
    surface: &Surface,
    material: &Material,
    vertices: &[LightVertex],
    rng: &mut Rng,
    tally: &mut impl Tally,
) {
    let frame = &scene.frame;
    let t = walk.edges + 1;
    if let Some(candidate) = connect_to_light(scene, walk, surface, material, rng_next(rng).xyz()) {
        resolve(scene, Strategy { s: 1, t }, &candidate, tally);
    }
    for y in vertices.iter().filter(|y| walk.edges + 1 + y.edges <= frame.max_edges) {
        let Some(mut candidate) = connect_to_vertex(scene, walk, surface, material, y) else { continue };
        let strength = luminance(candidate.value);
        if strength > 0.0 && strength < frame.connection_threshold {
            let survival = strength / frame.connection_threshold;
            if rng_next(rng).x >= survival {
                continue;
            }
            candidate.value /= survival;
        }
        resolve(scene, Strategy { s: y.edges + 1, t }, &candidate, tally);
    }
}

/// Traces a candidate's shadow ray if it carries anything.
fn resolve(scene: &TwinScene, strategy: Strategy, candidate: &Candidate, tally: &mut impl Tally) {
    if candidate.value.max_element() <= 0.0 {
        return;
    }
    tally.ray();
    let hit = trace(scene, candidate.origin, candidate.direction, candidate.t_max, Search::Any);
    if hit.triangle == NO_HIT {
        tally.gather(strategy, candidate.value, candidate.weight);
    }
}

/// s = 1 at an eye vertex.
#[must_use]
pub fn connect_to_light(
    scene: &TwinScene,
    walk: &Walk,
    x: &Surface,
    material: &Material,
    u: Vec3,
) -> Option<Candidate> {
    let light = sample_light(scene, x.position, u);
    let w_e = -walk.direction;
    let f = bsdf_eval(material, x, w_e, light.direction);
    if light.direct_pdf <= 0.0 || f.max_element() <= 0.0 {
        return None;
    }
    let pdf_fwd = bsdf_pdf(material, x, w_e, light.direction);
    let pdf_rev = bsdf_pdf(material, x, light.direction, w_e);
    let cos_x = light.direction.dot(x.ng).abs();
    let weight = mis_weight_light_sample(
        &scene.frame,
        walk.mis,
        light.direct_pdf,
        light.emission_pdf_over_cos,
        cos_x,
        pdf_fwd,
        pdf_rev,
    );
    let cosine = light.direction.dot(x.ns).abs();
    let value = walk.throughput * f * light.radiance * (cosine / light.direct_pdf * weight);
    let origin = offset_along(x.position, x.ng, light.direction);
    let (direction, t_max) =
        if light.infinite { (light.direction, INFINITE) } else { (light.end - origin, 1.0) };
    Some(Candidate { value, weight, t_max, origin, direction })
}

/// s >= 2, t >= 2.
#[must_use]
pub fn connect_to_vertex(
    scene: &TwinScene,
    walk: &Walk,
    x: &Surface,
    material: &Material,
    y: &LightVertex,
) -> Option<Candidate> {
    let offset = y.surface.position - x.position;
    let distance_squared = offset.dot(offset);
    if distance_squared <= 0.0 {
        return None;
    }
    let w = offset / distance_squared.sqrt();
    let w_e = -walk.direction;
    let material_y = scene.material(&y.surface);
    let f = bsdf_eval(material, x, w_e, w) * bsdf_eval(material_y, &y.surface, -w, y.w_light);
    if f.max_element() <= 0.0 {
        return None;
    }
    let cos_x = w.dot(x.ng).abs() / distance_squared;
    let cos_y = w.dot(y.surface.ng).abs() / distance_squared;
    let weight = mis_weight_connect(
        ConnectionEnd {
            mis: walk.mis,
            pdf_area: bsdf_pdf(material_y, &y.surface, y.w_light, -w) * cos_x,
            pdf_rev: bsdf_pdf(material, x, w, w_e),
        },
        ConnectionEnd {
            mis: y.mis,
            pdf_area: bsdf_pdf(material, x, w_e, w) * cos_y,
            pdf_rev: bsdf_pdf(material_y, &y.surface, -w, y.w_light),
        },
    );
    let value = walk.throughput * y.throughput * f * (w.dot(x.ns).abs() * cos_y * weight);
    let origin = offset_along(x.position, x.ng, w);
    let direction = offset_along(y.surface.position, y.surface.ng, -w) - origin;
    Some(Candidate { value, weight, t_max: 1.0, origin, direction })
}

/// s = 0: radiance of an emitter that the eye path hit, and its weight.
fn emitted(scene: &TwinScene, walk: &Walk, surface: &Surface, material: &Material) -> (Vec3, f32) {
    let emission = Vec3::from(material.emission);
    let cos_light = -walk.direction.dot(surface.ng);
    if cos_light <= 0.0 || luminance(emission) <= 0.0 {
        return (Vec3::ZERO, 1.0);
    }
    let direct_pdf = area_direct_pdf(scene, emission);
    let weighted = mis_weight_emitter(walk.mis, direct_pdf, direct_pdf * cos_light / PI);
    let weight = if walk.edges == 1 { 1.0 } else { weighted };
    (walk.throughput * emission * weight, weight)
}

/// s = 0: radiance of the environment that the eye path left to, and its weight.
fn escaped(scene: &TwinScene, walk: &Walk) -> (Vec3, f32) {
    let weighted = mis_weight_emitter(walk.mis, environment_pdf(scene), environment_emission_pdf(scene));
    let weight = if walk.edges == 0 { 1.0 } else { weighted };
    (walk.throughput * Vec3::from(scene.frame.environment) * weight, weight)
}
