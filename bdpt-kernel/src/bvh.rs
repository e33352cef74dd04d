//! The bounding volume hierarchy over a scene's triangles: PLOC, reinsertion, compressed to eight-wide nodes (obvhs).
//!
//! Owns how a hierarchy is built and how good; packing it for a device is the packer's. Never changes geometry.

use std::time::{Duration, Instant};

use glam::Vec3A;
use obvhs::{
    Boundable, BvhBuildParams,
    aabb::Aabb,
    bvh2::{Bvh2, node::Bvh2Node, reinsertion::ReinsertionOptimizer},
    cwbvh::{CwBvh, bvh2_to_cwbvh::bvh2_to_cwbvh},
    ploc::{PlocBuilder, SortPrecision},
};

use crate::scene::model::Triangle;

/// Most triangles in one leaf; the node layout holds no more.
const MAX_TRIANGLES_PER_LEAF: u32 = 3;

/// Most levels of eight-wide nodes: what a traversal's stack holds. Real scenes have about 15.
pub const MAX_DEPTH: u32 = 32;

/// Most levels of the binary hierarchy before it is compressed, which recurses. PLOC gives about 60 for real scenes.
const MAX_BINARY_DEPTH: u32 = 1_024;

/// Most triangles with one centroid, at 2^-20 of the scene, that PLOC gets. Coincident boxes pair up one at a time:
/// quadratic time and a chain for a tree. Real scenes pile up a few.
const MAX_TRIANGLES_PER_CELL: usize = 1_000;

/// How much work goes into a hierarchy. The image does not depend on it, only the speed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BuildQuality {
    /// Seconds for tens of millions of triangles.
    Fast,
    /// 3 s for a million triangles on one core.
    Medium,
    /// Three times medium's time, a tenth faster to traverse.
    High,
}

impl BuildQuality {
    /// What keeps the build at a few seconds on one core.
    #[must_use]
    pub const fn for_triangles(count: usize) -> Self {
        // Measured on one core (50-bdpt.md section 4): 1.05 M triangles take 2.3 s fast, 3.2 s medium, 9.4 s very slow.
        match count {
            0..=300_000 => Self::High,
            300_001..=4_000_000 => Self::Medium,
            _ => Self::Fast,
        }
    }

    fn parameters(self) -> BvhBuildParams {
        match self {
            Self::Fast => BvhBuildParams::fastest_build(),
            Self::Medium => BvhBuildParams::medium_build(),
            // Without the presets' pre-splits: each triangle stays in exactly one leaf.
            Self::High => BvhBuildParams {
                pre_split: false,
                sort_precision: SortPrecision::U64,
                ..BvhBuildParams::very_slow_build()
            },
        }
    }
}

/// A built hierarchy.
#[derive(Clone, Debug)]
pub struct Bvh {
    /// Nodes, and the order of the triangles in the leaves: leaf slot `i` is triangle `primitive_indices[i]`.
    pub cwbvh: CwBvh,
    /// Levels of nodes from the root; bounds a traversal's stack.
    pub depth: u32,
    /// How long the build took.
    pub build_time: Duration,
}

impl Bvh {
    /// Builds the hierarchy of `triangles`, which must be finite. No triangle gives no node.
    #[must_use]
    pub fn build(triangles: &[Triangle], quality: BuildQuality) -> Self {
        let start = Instant::now();
        if triangles.is_empty() {
            return Self { cwbvh: CwBvh::default(), depth: 0, build_time: start.elapsed() };
        }
        let parameters = quality.parameters();
        let boxes: Vec<Bounds> = triangles.iter().map(Bounds::of).collect();
        let count = u32::try_from(boxes.len()).expect("the loader bounds triangles far below 2^32");
        let bvh2 = if most_in_one_cell(&boxes) > MAX_TRIANGLES_PER_CELL {
            median_split(&boxes)
        } else {
            let mut bvh2 = PlocBuilder::with_capacity(boxes.len()).build(
                parameters.ploc_search_distance,
                &boxes,
                (0..count).collect(),
                parameters.sort_precision,
                parameters.search_depth_threshold,
            );
            ReinsertionOptimizer::default().run(&mut bvh2, parameters.reinsertion_batch_ratio, None);
            if binary_depth_of(&bvh2) > MAX_BINARY_DEPTH { median_split(&boxes) } else { bvh2 }
        };
        let leaf = parameters.max_prims_per_leaf.clamp(1, MAX_TRIANGLES_PER_LEAF);
        let cwbvh = bvh2_to_cwbvh(&bvh2, leaf, true, false);
        let depth = depth_of(&cwbvh);
        if depth <= MAX_DEPTH {
            return Self { cwbvh, depth, build_time: start.elapsed() };
        }
        let cwbvh = bvh2_to_cwbvh(&median_split(&boxes), leaf, true, false);
        let depth = depth_of(&cwbvh);
        assert!(depth <= MAX_DEPTH, "halving 2^32 triangles takes 32 levels, not {depth}");
        Self { cwbvh, depth, build_time: start.elapsed() }
    }
}

/// A triangle's box, which is all that the builder looks at.
struct Bounds(Aabb);

impl Bounds {
    fn of(triangle: &Triangle) -> Self {
        Self(Aabb::from_points(&triangle.positions.map(Vec3A::from)))
    }
}

impl Boundable for Bounds {
    fn aabb(&self) -> Aabb {
        self.0
    }
}

/// How many boxes share a centroid, to 2^-20 of the scene's extent.
fn most_in_one_cell(boxes: &[Bounds]) -> usize {
    let scene = boxes.iter().fold(Aabb::empty(), |scene, bounds| scene.union(&bounds.0));
    let scale =
        Vec3A::splat(1_048_576.0) / (scene.max - scene.min).max(Vec3A::splat(f32::MIN_POSITIVE * 1e9));
    let mut cells: Vec<[u32; 3]> =
        boxes.iter().map(|bounds| ((bounds.0.center() - scene.min) * scale).as_uvec3().to_array()).collect();
    cells.sort_unstable();
    cells.chunk_by(|a, b| a == b).map(<[_]>::len).max().unwrap_or(0)
}

/// Halves the triangles at the median of the widest axis of their centroids: at most 32 levels, whatever the input.
/// The way out for piles of coincident triangles, where no order is better than another.
fn median_split(boxes: &[Bounds]) -> Bvh2 {
    let mut order: Vec<u32> = (0..).take(boxes.len()).collect();
    let mut nodes = vec![Bvh2Node::default()];
    let mut open = vec![(0_usize, 0_usize, boxes.len())];
    let at = |index: u32| &boxes[index as usize].0;
    let position = |index: usize| u32::try_from(index).expect("fewer than 2^32 nodes and triangles");
    while let Some((node, start, end)) = open.pop() {
        let part = &mut order[start..end];
        let bounds = part.iter().fold(Aabb::empty(), |bounds, &index| bounds.union(at(index)));
        if let [_] = part {
            nodes[node] = Bvh2Node::new(bounds, 1, position(start));
            continue;
        }
        let centroids = part
            .iter()
            .fold(Aabb::empty(), |bounds, &index| bounds.union(&Aabb::from_point(at(index).center())));
        let extent = centroids.max - centroids.min;
        let axis = (0..3).max_by(|&a, &b| extent[a].total_cmp(&extent[b])).expect("three axes");
        let middle = part.len() / 2;
        part.select_nth_unstable_by(middle, |&a, &b| at(a).center()[axis].total_cmp(&at(b).center()[axis]));
        let children = nodes.len();
        nodes[node] = Bvh2Node::new(bounds, 0, position(children));
        nodes.extend([Bvh2Node::default(); 2]);
        open.push((children, start, start + middle));
        open.push((children + 1, start + middle, end));
    }
    Bvh2 { nodes, primitive_indices: order, ..Bvh2::default() }
}

/// Levels of a binary hierarchy.
fn binary_depth_of(bvh2: &Bvh2) -> u32 {
    let mut deepest = 0;
    let mut open = vec![(0_u32, 1_u32)];
    while let Some((index, depth)) = open.pop() {
        deepest = deepest.max(depth);
        let node = &bvh2.nodes[index as usize];
        if !node.is_leaf() {
            open.extend([(node.first_index, depth + 1), (node.first_index + 1, depth + 1)]);
        }
    }
    deepest
}

/// Levels of nodes under and with the root.
fn depth_of(cwbvh: &CwBvh) -> u32 {
    let mut depth = 0;
    let mut level: Vec<u32> = vec![0];
    while !level.is_empty() {
        depth += 1;
        level = level
            .iter()
            .flat_map(|&index| {
                let node = &cwbvh.nodes[index as usize];
                let children = node.imask.count_ones();
                (node.child_base_idx..).take(children as usize)
            })
            .collect();
    }
    depth
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use obvhs::ray::{Ray, RayHit};

    use super::*;

    fn triangle(corners: [Vec3; 3]) -> Triangle {
        let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalize_or_zero();
        Triangle { positions: corners, normals: [normal; 3], material: 0 }
    }

    /// A sheet of `edge` by `edge` unit quads in z = bumps.
    fn sheet(edge: u16) -> Vec<Triangle> {
        let height = |x: u16, y: u16| (f32::from(x) * 0.7).sin() * (f32::from(y) * 1.3).cos();
        let at = |x: u16, y: u16| Vec3::new(f32::from(x), f32::from(y), height(x, y));
        (0..edge)
            .flat_map(|x| (0..edge).map(move |y| (x, y)))
            .flat_map(|(x, y)| {
                let [a, b, c, d] = [at(x, y), at(x + 1, y), at(x + 1, y + 1), at(x, y + 1)];
                [triangle([a, b, c]), triangle([a, c, d])]
            })
            .collect()
    }

    fn first_hit(bvh: &Bvh, triangles: &[Triangle], ray: Ray) -> Option<(u32, f32)> {
        let corners = |index: u32| triangles[index as usize].positions.map(Vec3A::from);
        let intersect = |ray: &Ray, index: u32| {
            let [v0, v1, v2] = corners(index);
            obvhs::triangle::Triangle { v0, v1, v2 }.intersect(ray)
        };
        let mut hit = RayHit::none();
        bvh.cwbvh
            .ray_traverse(ray, &mut hit, |ray, slot| intersect(ray, bvh.cwbvh.primitive_indices[slot]))
            .then(|| (bvh.cwbvh.primitive_indices[hit.primitive_id as usize], hit.t))
    }

    #[test]
    fn every_quality_finds_what_brute_force_finds() {
        let triangles = sheet(12);
        for quality in [BuildQuality::Fast, BuildQuality::Medium, BuildQuality::High] {
            let bvh = Bvh::build(&triangles, quality);
            let mut order = bvh.cwbvh.primitive_indices.clone();
            order.sort_unstable();
            assert!(order.iter().copied().eq(0..288), "{quality:?}: each triangle lies in exactly one leaf");
            for step in 0..200_u16 {
                let origin = Vec3A::new(f32::from(step % 20) * 0.63, f32::from(step / 20) * 1.17, 5.0);
                let direction = Vec3A::new(0.01, 0.02 - f32::from(step) * 1e-4, -1.0).normalize();
                let ray = Ray::new_inf(origin, direction);
                let brute = triangles
                    .iter()
                    .map(|t| {
                        let [v0, v1, v2] = t.positions.map(Vec3A::from);
                        obvhs::triangle::Triangle { v0, v1, v2 }.intersect(&ray)
                    })
                    .fold(f32::INFINITY, f32::min);
                match first_hit(&bvh, &triangles, ray) {
                    Some((_, t)) => {
                        assert!((t - brute).abs() <= 1e-5 * t, "{quality:?} ray {step}: {t} != {brute}")
                    }
                    None => assert!(brute.is_infinite(), "{quality:?} ray {step}: missed a hit at {brute}"),
                }
            }
        }
    }

    #[test]
    fn none_one_and_coincident_triangles_build() {
        assert_eq!(Bvh::build(&[], BuildQuality::High).depth, 0, "nothing has no level");
        let one = triangle([Vec3::ZERO, Vec3::X, Vec3::Y]);
        let bvh = Bvh::build(&[one], BuildQuality::High);
        assert_eq!((bvh.depth, bvh.cwbvh.nodes.len()), (1, 1), "one triangle is one node");
        let ray = Ray::new_inf(Vec3A::new(0.2, 0.2, 1.0), Vec3A::NEG_Z);
        assert!(first_hit(&bvh, &[one], ray).is_some(), "the one triangle is hit");
        for count in [900, 100_000] {
            let bvh = Bvh::build(&vec![one; count], BuildQuality::Medium);
            assert!(bvh.depth <= MAX_DEPTH, "{count} coincident triangles give {} levels", bvh.depth);
            assert_eq!(bvh.cwbvh.primitive_indices.len(), count, "each triangle lies in one leaf");
            assert!(first_hit(&bvh, &[one; 1].repeat(count), ray).is_some(), "the pile is hit");
        }
    }
}
