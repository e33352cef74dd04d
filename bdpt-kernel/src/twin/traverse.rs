//! Twin of `shaders/shared/traverse.wgsl`.

use glam::{Vec3, Vec4};
use obvhs::cwbvh::node::CwBvhNode;

use super::TwinScene;

/// No triangle.
pub const NO_HIT: u32 = u32::MAX;
const DIRECTION_EPSILON: f32 = 1.0e-18;
const SLAB_SLACK: f32 = 1.000_001;
const EDGE_SLACK: f32 = 1.0e-6;

/// Where a ray meets a triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Along the ray, in lengths of its direction.
    pub t: f32,
    /// In leaf order, or [`NO_HIT`].
    pub triangle: u32,
    /// Barycentric weight of the second corner.
    pub u: f32,
    /// Barycentric weight of the third corner.
    pub v: f32,
}

/// Nearest or any.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Search {
    /// The nearest hit.
    Nearest,
    /// The first found.
    Any,
}

fn away_from_zero(v: f32) -> f32 {
    if v.abs() < DIRECTION_EPSILON { if v < 0.0 { -DIRECTION_EPSILON } else { DIRECTION_EPSILON } } else { v }
}

fn bytes(word: &[u8]) -> Vec4 {
    Vec4::new(f32::from(word[0]), f32::from(word[1]), f32::from(word[2]), f32::from(word[3]))
}

/// Four children of a node, from `half * 4`, against the ray in the node's own units: bits of the hit mask.
fn children_hit(
    node: &CwBvhNode,
    half: usize,
    octant: u32,
    direction: Vec3,
    scale: Vec3,
    start: Vec3,
    t_max: f32,
) -> u32 {
    let part = half * 4..half * 4 + 4;
    let slab = |low: &[u8; 8], high: &[u8; 8], d: f32, scale: f32, start: f32| {
        let (near, far) = if d < 0.0 { (high, low) } else { (low, high) };
        let place = |side: &[u8; 8]| bytes(&side[part.clone()]) * scale + Vec4::splat(start);
        (place(near), place(far))
    };
    let (low_x, high_x) = slab(&node.child_min_x, &node.child_max_x, direction.x, scale.x, start.x);
    let (low_y, high_y) = slab(&node.child_min_y, &node.child_max_y, direction.y, scale.y, start.y);
    let (low_z, high_z) = slab(&node.child_min_z, &node.child_max_z, direction.z, scale.z, start.z);
    let t_low = low_x.max(low_y).max(low_z.max(Vec4::ZERO));
    let t_high = high_x.min(high_y).min(high_z.min(Vec4::splat(t_max))) * SLAB_SLACK;
    let mut mask = 0;
    for child in 0..4 {
        if t_low[child] <= t_high[child] {
            let description = u32::from(node.child_meta[half * 4 + child]);
            let is_inner = description & (description << 1) & 0x10 != 0;
            let bit_index = (description ^ if is_inner { octant & 0xff } else { 0 }) & 0x1f;
            mask |= ((description >> 5) & 7) << bit_index;
        }
    }
    mask
}

/// Nearest hit in `0 < t < t_max`, or the first found. `direction` need not be a unit vector.
#[must_use]
pub fn trace(scene: &TwinScene, origin: Vec3, direction: Vec3, t_max: f32, search: Search) -> Hit {
    let mut hit = Hit { t: t_max, triangle: NO_HIT, u: 0.0, v: 0.0 };
    let d = Vec3::new(away_from_zero(direction.x), away_from_zero(direction.y), away_from_zero(direction.z));
    let inverse = 1.0 / d;
    let bit = |negative: bool, bit: u32| if negative { 0 } else { bit };
    let octant = bit(d.x < 0.0, 4) | bit(d.y < 0.0, 2) | bit(d.z < 0.0, 1);
    let mut group = (0_u32, 0x8000_0000_u32);
    let mut stack: Vec<(u32, u32)> = Vec::new();
    loop {
        // The child of the group that comes first along the ray; the rest waits on the stack.
        let bit = 31 - group.1.leading_zeros();
        let slot = (bit - 24) ^ octant;
        let index = group.0 + (group.1 & !(u32::MAX << slot)).count_ones();
        group.1 &= !(1 << bit);
        if group.1 > 0x00ff_ffff {
            stack.push(group);
        }
        let node = &scene.nodes[index as usize];
        let extent = Vec3::from(node.e.map(|e| f32::from_bits(u32::from(e) << 23)));
        let scale = extent * inverse;
        let start = (node.p - origin) * inverse;
        let mask = children_hit(node, 0, octant, d, scale, start, hit.t)
            | children_hit(node, 1, octant, d, scale, start, hit.t);
        group = (node.child_base_idx, (mask & 0xff00_0000) | u32::from(node.imask));
        let mut leaf = mask & 0x00ff_ffff;
        while leaf != 0 {
            let first = leaf.trailing_zeros();
            leaf &= leaf - 1;
            intersect(scene, node.primitive_base_idx + first, origin, direction, &mut hit);
        }
        if search == Search::Any && hit.triangle != NO_HIT {
            break;
        }
        if group.1 <= 0x00ff_ffff {
            let Some(waiting) = stack.pop() else { break };
            group = waiting;
        }
    }
    hit
}

/// Moeller-Trumbore; shortens `hit` when the triangle is nearer.
pub fn intersect(scene: &TwinScene, triangle: u32, origin: Vec3, direction: Vec3, hit: &mut Hit) {
    let [v0, e1, e2] = scene.triangles[triangle as usize];
    let p = direction.cross(e2);
    let determinant = e1.dot(p);
    if determinant == 0.0 {
        return;
    }
    let inverse = 1.0 / determinant;
    let s = origin - v0;
    let u = s.dot(p) * inverse;
    let q = s.cross(e1);
    let v = direction.dot(q) * inverse;
    let t = e2.dot(q) * inverse;
    if u >= -EDGE_SLACK && v >= -EDGE_SLACK && u + v <= 1.0 + EDGE_SLACK && t > 0.0 && t < hit.t {
        *hit = Hit { t, triangle, u, v };
    }
}
