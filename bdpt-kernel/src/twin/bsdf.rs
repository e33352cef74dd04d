//! Twin of `shaders/shared/bsdf.wgsl`.

use std::f32::consts::PI;

use glam::{Vec2, Vec3};

use super::{
    math::{sample_cosine_hemisphere, sign_not_zero, to_world},
    surface::{Surface, is_consistent},
};
use crate::gpu::layout::{DIELECTRIC, DIFFUSE, Material};

/// Which kind of subpath scatters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PathKind {
    /// Carries importance from the camera.
    Eye,
    /// Carries flux from a light: the adjoint.
    Light,
}

/// How a path goes on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scatter {
    /// It does not.
    Absorbed,
    /// Through a lobe with a density.
    Smooth {
        /// Where to.
        direction: Vec3,
        /// What the throughput is multiplied by.
        factor: Vec3,
        /// `pdf_solid_angle` of the direction.
        pdf_fwd: f32,
        /// `pdf_solid_angle` of the reverse.
        pdf_rev: f32,
    },
    /// Through a delta lobe.
    Delta {
        /// Where to.
        direction: Vec3,
        /// What the throughput is multiplied by.
        factor: Vec3,
    },
}

/// Whether a material has only delta lobes: such vertices are never connected.
#[must_use]
pub fn is_delta(material: &Material) -> bool {
    material.kind != DIFFUSE
}

fn reflects(material: &Material, surface: &Surface, a: Vec3, b: Vec3) -> bool {
    let one_side = a.dot(surface.ng) * b.dot(surface.ng) > 0.0;
    material.kind == DIFFUSE && one_side && is_consistent(surface, a) && is_consistent(surface, b)
}

/// f(w_e, w_l) without cosines; 0 for delta lobes.
#[must_use]
pub fn bsdf_eval(material: &Material, surface: &Surface, w_e: Vec3, w_l: Vec3) -> Vec3 {
    if reflects(material, surface, w_e, w_l) {
        Vec3::from(material.reflectance) * (1.0 / PI)
    } else {
        Vec3::ZERO
    }
}

/// `pdf_solid_angle` of sampling `w_to` for a path that came along `w_fixed`; 0 for delta lobes.
#[must_use]
pub fn bsdf_pdf(material: &Material, surface: &Surface, w_fixed: Vec3, w_to: Vec3) -> f32 {
    if reflects(material, surface, w_fixed, w_to) { w_to.dot(surface.ns).abs() * (1.0 / PI) } else { 0.0 }
}

/// Chooses where a path goes on.
#[must_use]
pub fn bsdf_sample(
    material: &Material,
    surface: &Surface,
    w_fixed: Vec3,
    u: Vec3,
    kind: PathKind,
) -> Scatter {
    if !is_consistent(surface, w_fixed) {
        return Scatter::Absorbed;
    }
    // Normals on the side of w_fixed.
    let side = sign_not_zero(w_fixed.dot(surface.ng));
    let (ns, ng) = (surface.ns * side, surface.ng * side);
    let cos_fixed = w_fixed.dot(ns);
    let reflectance = Vec3::from(material.reflectance);
    if material.kind == DIFFUSE {
        let direction = to_world(ns, sample_cosine_hemisphere(Vec2::new(u.y, u.z)));
        let pdf_fwd = bsdf_pdf(material, surface, w_fixed, direction);
        if pdf_fwd <= 0.0 {
            return Scatter::Absorbed;
        }
        let cosine = match kind {
            PathKind::Eye => direction.dot(ns),
            PathKind::Light => direction.dot(ng),
        };
        return Scatter::Smooth {
            direction,
            factor: reflectance * (cosine / (PI * pdf_fwd)),
            pdf_fwd,
            pdf_rev: bsdf_pdf(material, surface, direction, w_fixed),
        };
    }
    let mut direction = ns * (2.0 * cos_fixed) - w_fixed;
    let mut transmitted = false;
    let mut scale = 1.0;
    if material.kind == DIELECTRIC {
        // Index on the side of w_fixed over the index beyond.
        let eta = if side > 0.0 { 1.0 / material.ior } else { material.ior };
        let sin2 = eta * eta * (1.0 - cos_fixed * cos_fixed).max(0.0);
        let cos_beyond = (1.0 - sin2).max(0.0).sqrt();
        let reflected = if sin2 >= 1.0 { 1.0 } else { fresnel_dielectric(eta, cos_fixed, cos_beyond) };
        if u.x >= reflected {
            direction = ns * (eta * cos_fixed - cos_beyond) - w_fixed * eta;
            transmitted = true;
            // Radiance is compressed by eta^2 on the eye's side (Walter et al. 2007); flux is not.
            scale = if kind == PathKind::Light { 1.0 } else { eta * eta };
        }
    }
    let direction = direction.normalize();
    let (cos_ns, cos_ng) = (direction.dot(ns), direction.dot(ng));
    let leaves = if transmitted { cos_ng < 0.0 && cos_ns < 0.0 } else { cos_ng > 0.0 && cos_ns > 0.0 };
    if !leaves {
        return Scatter::Absorbed;
    }
    let adjoint = if kind == PathKind::Light { cos_ng / cos_ns } else { 1.0 };
    Scatter::Delta { direction, factor: reflectance * (scale * adjoint) }
}

/// Unpolarised reflectance of a smooth interface; `eta` as in [`bsdf_sample`].
#[must_use]
pub fn fresnel_dielectric(eta: f32, cos_fixed: f32, cos_beyond: f32) -> f32 {
    let parallel = (cos_fixed - eta * cos_beyond) / (cos_fixed + eta * cos_beyond);
    let perpendicular = (eta * cos_fixed - cos_beyond) / (eta * cos_fixed + cos_beyond);
    0.5 * (parallel * parallel + perpendicular * perpendicular)
}
