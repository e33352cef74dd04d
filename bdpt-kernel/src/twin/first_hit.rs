//! Twin of `shaders/first_hit.wgsl`.

use glam::{Vec2, Vec3, Vec4Swizzles};

use super::{
    TwinScene,
    bsdf::is_delta,
    math::{INFINITE, sign_not_zero},
    rng::{STREAM_EYE, rng_new, rng_next},
    surface::surface_at,
    traverse::{NO_HIT, Search, trace},
    walk::{eye_start, walk_arrive, walk_scatter},
};
use crate::gpu::layout::FirstHitSum;

/// First-hit sums of a pixel over `samples` samples from `first_sample` on.
#[must_use]
pub fn first_hit(
    scene: &TwinScene,
    pixel: [u32; 2],
    first_sample: u32,
    samples: u32,
    seed: u64,
) -> FirstHitSum {
    let frame = &scene.frame;
    let mut sum = FirstHitSum::default();
    for sample in first_sample..first_sample + samples {
        let mut rng = rng_new([pixel[1] * frame.width_px + pixel[0], sample], STREAM_EYE, seed);
        let jitter = rng_next(&mut rng);
        #[allow(clippy::cast_precision_loss, reason = "pixel coordinates as real numbers")]
        let point = Vec2::new(pixel[0] as f32, pixel[1] as f32) + jitter.xy();
        let mut walk = eye_start(scene, point);
        let mut path_length = 0.0;
        sum.samples += 1;
        while walk.edges < frame.max_edges {
            let hit = trace(scene, walk.origin, walk.direction, INFINITE, Search::Nearest);
            if hit.triangle == NO_HIT {
                break;
            }
            let surface = surface_at(scene, &hit);
            let material = scene.material(&surface);
            walk_arrive(&mut walk, &surface, hit.t);
            path_length += hit.t;
            if !is_delta(material) {
                let albedo = walk.throughput * Vec3::from(material.reflectance);
                let normal = surface.ns * sign_not_zero(-walk.direction.dot(surface.ng));
                sum.albedo = (Vec3::from(sum.albedo) + albedo).into();
                sum.normal = (Vec3::from(sum.normal) + normal).into();
                sum.depth += path_length * frame.world_per_unit;
                sum.hits += 1;
                break;
            }
            if !walk_scatter(scene, &mut walk, &surface, material, rng_next(&mut rng)) {
                break;
            }
        }
    }
    sum
}
