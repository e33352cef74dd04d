//! Twin of `shaders/shared/surface.wgsl`.

use glam::Vec3;

use super::{
    TwinScene,
    math::{decode_octahedral, sign_not_zero},
    traverse::Hit,
};
use crate::gpu::layout::FLAT;

/// Offset of ray ends along the geometric normal.
pub const RAY_OFFSET: f32 = 3.0e-5;

/// What a hit becomes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surface {
    /// Position.
    pub position: Vec3,
    /// Geometric normal, unit, on the counter-clockwise side.
    pub ng: Vec3,
    /// Shading normal, unit, on the same side.
    pub ns: Vec3,
    /// Index of the material.
    pub material: u32,
}

/// The surface at a hit.
#[must_use]
pub fn surface_at(scene: &TwinScene, hit: &Hit) -> Surface {
    let [v0, e1, e2] = scene.triangles[hit.triangle as usize];
    let record = scene.shading[hit.triangle as usize];
    let position = v0 + e1 * hit.u + e2 * hit.v;
    let ng = e1.cross(e2).normalize();
    let mut ns = ng;
    if record.material & FLAT == 0 {
        let [n0, n1, n2] = record.normals.map(decode_octahedral);
        let blend = n0 * (1.0 - hit.u - hit.v) + n1 * hit.u + n2 * hit.v;
        let size = blend.length();
        if size > 1.0e-3 {
            ns = blend * (sign_not_zero(blend.dot(ng)) / size);
        }
    }
    Surface { position, ng, ns, material: record.material & !FLAT }
}

/// A ray's end at a surface, moved to the side that `w` points to.
#[must_use]
pub fn offset_along(position: Vec3, ng: Vec3, w: Vec3) -> Vec3 {
    position + ng * (RAY_OFFSET * sign_not_zero(w.dot(ng)))
}

/// Whether both normals see `w` on the same side.
#[must_use]
pub fn is_consistent(surface: &Surface, w: Vec3) -> bool {
    w.dot(surface.ns) * w.dot(surface.ng) > 0.0
}
