//! The kernels' CPU twins: for reading and for proof. Same names and order as the WGSL under `shaders/`, one module a
//! file, on the same packed arrays. Never fast at the price of plainness, never a second renderer.

pub mod bsdf;
pub mod camera;
pub mod eye;
pub mod first_hit;
pub mod light;
pub mod lights;
pub mod math;
pub mod mis;
pub mod rng;
pub mod surface;
pub mod traverse;
pub mod walk;

use bytemuck::pod_collect_to_vec;
use glam::Vec3;
use obvhs::cwbvh::node::CwBvhNode;

use crate::gpu::{FrameParams, PackedScene, layout};

/// A packed scene and a frame as the kernels see them.
#[derive(Clone, Debug)]
pub struct TwinScene {
    pub(crate) nodes: Vec<CwBvhNode>,
    pub(crate) triangles: Vec<[Vec3; 3]>,
    pub(crate) shading: Vec<layout::Shading>,
    pub(crate) materials: Vec<layout::Material>,
    pub(crate) lights: Vec<layout::Light>,
    pub(crate) frame: layout::Frame,
}

impl TwinScene {
    /// Unpacks a scene's arrays.
    #[must_use]
    pub fn new(packed: &PackedScene, frame: &FrameParams) -> Self {
        let corners: Vec<[f32; 12]> = pod_collect_to_vec(&packed.triangles);
        let xyz = |c: &[f32]| Vec3::new(c[0], c[1], c[2]);
        Self {
            nodes: pod_collect_to_vec(&packed.nodes),
            triangles: corners.iter().map(|c| [xyz(&c[0..]), xyz(&c[4..]), xyz(&c[8..])]).collect(),
            shading: pod_collect_to_vec(&packed.shading),
            materials: pod_collect_to_vec(&packed.materials),
            lights: pod_collect_to_vec(&packed.lights),
            frame: frame.frame,
        }
    }

    /// The frame's uniform.
    #[must_use]
    pub const fn frame(&self) -> &layout::Frame {
        &self.frame
    }

    /// The lights' table.
    #[must_use]
    pub fn lights(&self) -> &[layout::Light] {
        &self.lights
    }

    /// Corner and edges of each triangle in leaf order.
    #[must_use]
    pub fn triangles(&self) -> &[[Vec3; 3]] {
        &self.triangles
    }

    /// A surface's material.
    #[must_use]
    pub fn material(&self, surface: &surface::Surface) -> &layout::Material {
        &self.materials[surface.material as usize]
    }
}
