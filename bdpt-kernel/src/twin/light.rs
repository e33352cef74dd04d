//! Twin of `shaders/light.wgsl`: one light path, every vertex connected to the camera.

use glam::Vec3;

use super::{
    TwinScene,
    bsdf::{bsdf_eval, bsdf_pdf, is_delta},
    camera::camera_project,
    eye::{Strategy, Tally},
    math::INFINITE,
    mis::mis_weight_camera,
    rng::{STREAM_LIGHT, rng_new, rng_next},
    surface::{Surface, offset_along, surface_at},
    traverse::{NO_HIT, Search, trace},
    walk::{Candidate, Walk, light_start, walk_arrive, walk_scatter},
};
use crate::gpu::layout::Material;

/// Takes splats one by one.
pub trait SplatTally: Tally {
    /// The next contributions go to this pixel.
    fn aim(&mut self, pixel: [u32; 2]);
}

/// One light path.
pub fn light(scene: &TwinScene, path: u64, seed: u64, tally: &mut impl SplatTally) {
    let frame = &scene.frame;
    let mut rng = rng_new([(path & 0xffff_ffff) as u32, (path >> 32) as u32], STREAM_LIGHT, seed);
    let mut walk = light_start(scene, &mut rng);
    // The edge to the camera is one of max_edges.
    let light_edges = frame.max_edges - 1;
    while walk.edges < light_edges {
        tally.ray();
        let hit = trace(scene, walk.origin, walk.direction, INFINITE, Search::Nearest);
        if hit.triangle == NO_HIT {
            return;
        }
        let surface = surface_at(scene, &hit);
        let material = scene.material(&surface);
        walk_arrive(&mut walk, &surface, hit.t);
        if !is_delta(material)
            && let Some((candidate, pixel)) = connect_to_camera(scene, &walk, &surface, material)
            && candidate.value.max_element() > 0.0
        {
            tally.ray();
            let hit = trace(scene, candidate.origin, candidate.direction, candidate.t_max, Search::Any);
            if hit.triangle == NO_HIT {
                tally.aim(pixel);
                tally.gather(Strategy { s: walk.edges + 1, t: 1 }, candidate.value, candidate.weight);
            }
        }
        if walk.edges >= light_edges
            || !walk_scatter(scene, &mut walk, &surface, material, rng_next(&mut rng))
        {
            return;
        }
    }
}

/// t = 1: the splat of a light vertex and its pixel.
#[must_use]
pub fn connect_to_camera(
    scene: &TwinScene,
    walk: &Walk,
    y: &Surface,
    material: &Material,
) -> Option<(Candidate, [u32; 2])> {
    let eye = Vec3::from(scene.frame.eye);
    let offset = eye - y.position;
    let distance_squared = offset.dot(offset);
    let w = offset / distance_squared.sqrt();
    let w_light = -walk.direction;
    let projection = camera_project(scene, -w)?;
    let f = bsdf_eval(material, y, w, w_light);
    if distance_squared <= 0.0 || f.max_element() <= 0.0 {
        return None;
    }
    let pdf_area_camera = projection.pdf * w.dot(y.ng).abs() / distance_squared;
    let pdf_rev = bsdf_pdf(material, y, w, w_light);
    let weight = mis_weight_camera(&scene.frame, walk.mis, pdf_area_camera, pdf_rev);
    let value = walk.throughput * f * (pdf_area_camera * weight);
    let origin = offset_along(y.position, y.ng, w);
    Some((Candidate { value, weight, t_max: 1.0, origin, direction: eye - origin }, projection.pixel))
}
