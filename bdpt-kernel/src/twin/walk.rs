//! Twin of `shaders/shared/walk.wgsl`.

use glam::{Vec2, Vec3, Vec4, Vec4Swizzles};

use super::{
    TwinScene,
    bsdf::{PathKind, Scatter, bsdf_sample},
    camera::{camera_direction, camera_pdf},
    lights::sample_emission,
    math::{decode_octahedral, encode_octahedral},
    mis::{Mis, mis_arrive, mis_eye_start, mis_scatter, mis_scatter_delta},
    rng::{Rng, rng_next},
    surface::{Surface, offset_along},
};
use crate::gpu::layout::Material;

/// A subpath under way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Walk {
    /// Start of the next ray.
    pub origin: Vec3,
    /// Edges up to the last surface.
    pub edges: u32,
    /// Of the next ray, unit.
    pub direction: Vec3,
    /// Largest component of the throughput at the start.
    pub strength: f32,
    /// So far.
    pub throughput: Vec3,
    /// On the first segment of an infinite light.
    pub from_infinity: bool,
    /// The recursion's state.
    pub mis: Mis,
    /// Camera's or light's.
    pub kind: PathKind,
}

/// A shadow ray and what it carries when nothing blocks it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// Weighted contribution.
    pub value: Vec3,
    /// The weight in it.
    pub weight: f32,
    /// End of the ray in lengths of its direction.
    pub t_max: f32,
    /// Start of the ray.
    pub origin: Vec3,
    /// Of the ray, not a unit vector.
    pub direction: Vec3,
}

/// A light vertex that eye vertices connect to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LightVertex {
    /// Where.
    pub surface: Surface,
    /// Throughput of the light subpath up to it.
    pub throughput: Vec3,
    /// Edges up to it.
    pub edges: u32,
    /// Toward the previous vertex.
    pub w_light: Vec3,
    /// The recursion's state.
    pub mis: Mis,
}

/// Starts a light subpath; draws two blocks of dimensions.
#[must_use]
pub fn light_start(scene: &TwinScene, rng: &mut Rng) -> Walk {
    let pick = rng_next(rng);
    let u = rng_next(rng);
    let start = sample_emission(scene, pick.x, u);
    Walk {
        origin: start.origin,
        edges: 0,
        direction: start.direction,
        strength: start.throughput.max_element(),
        throughput: start.throughput,
        from_infinity: start.infinite,
        mis: Mis { dvcm: start.dvcm, dvc: start.dvc },
        kind: PathKind::Light,
    }
}

/// Starts an eye subpath through `point`, in pixels from the image's top left.
#[must_use]
pub fn eye_start(scene: &TwinScene, point: Vec2) -> Walk {
    let direction = camera_direction(scene, point);
    Walk {
        origin: Vec3::from(scene.frame.eye),
        edges: 0,
        direction,
        strength: 1.0,
        throughput: Vec3::ONE,
        from_infinity: false,
        mis: mis_eye_start(&scene.frame, camera_pdf(scene, direction)),
        kind: PathKind::Eye,
    }
}

/// Arrival at a surface at distance `t`.
pub fn walk_arrive(walk: &mut Walk, surface: &Surface, t: f32) {
    let cos_in = walk.direction.dot(surface.ng).abs();
    walk.mis = mis_arrive(walk.mis, if walk.from_infinity { 1.0 } else { t * t }, cos_in);
    walk.from_infinity = false;
    walk.edges += 1;
    if walk.kind == PathKind::Light {
        // Shading cosine at the eye-side end of the edge just travelled, geometric at its light-side end.
        walk.throughput *= walk.direction.dot(surface.ns).abs() / cos_in;
    }
}

/// Goes on from a surface, or ends the path (false): absorbed or by roulette.
#[must_use]
pub fn walk_scatter(
    scene: &TwinScene,
    walk: &mut Walk,
    surface: &Surface,
    material: &Material,
    u: Vec4,
) -> bool {
    let scatter = bsdf_sample(material, surface, -walk.direction, u.xyz(), walk.kind);
    let (direction, factor) = match scatter {
        Scatter::Absorbed => return false,
        Scatter::Smooth { direction, factor, .. } | Scatter::Delta { direction, factor } => {
            (direction, factor)
        }
    };
    let mut throughput = walk.throughput * factor;
    if throughput.max_element() <= 0.0 {
        return false;
    }
    if walk.edges >= scene.frame.roulette_edges {
        let survival = (throughput.max_element() / walk.strength).min(1.0);
        if u.w >= survival {
            return false;
        }
        throughput /= survival;
    }
    walk.throughput = throughput;
    let cos_out = direction.dot(surface.ng).abs();
    walk.mis = match scatter {
        Scatter::Smooth { pdf_fwd, pdf_rev, .. } => {
            mis_scatter(&scene.frame, walk.mis, cos_out, pdf_fwd, pdf_rev)
        }
        Scatter::Delta { .. } | Scatter::Absorbed => mis_scatter_delta(walk.mis, cos_out),
    };
    walk.origin = offset_along(surface.position, surface.ng, direction);
    walk.direction = direction;
    true
}

/// What a light vertex is after its way through the scratch buffer, where directions have 2 x 16 bits.
#[must_use]
pub fn store_light_vertex(walk: &Walk, surface: &Surface) -> LightVertex {
    let rounded = |w: Vec3| decode_octahedral(encode_octahedral(w));
    LightVertex {
        surface: Surface { ng: rounded(surface.ng), ns: rounded(surface.ns), ..*surface },
        throughput: walk.throughput,
        edges: walk.edges,
        w_light: rounded(-walk.direction),
        mis: walk.mis,
    }
}
