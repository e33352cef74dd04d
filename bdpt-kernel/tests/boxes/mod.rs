//! Small scenes for the tests, and the packed and unpacked forms that kernels and twins read.
#![allow(dead_code, reason = "each test file uses a part")]

use std::f32::consts::PI;

use bdpt_kernel::{
    bvh::{BuildQuality, Bvh},
    gpu::{FrameParams, NormalisedScene, PackedScene, RenderOptions},
    scene::model::{Bsdf, Camera, FilmSize, Material, Scene, Triangle},
    twin::TwinScene,
};
use glam::Vec3;

/// A scene in every form that a test needs.
pub(crate) struct Prepared {
    pub(crate) packed: PackedScene,
    pub(crate) params: FrameParams,
    pub(crate) twin: TwinScene,
}

pub(crate) fn prepare(scene: &Scene, edge_px: [u32; 2], options: RenderOptions) -> Prepared {
    let normalised = NormalisedScene::new(scene);
    let bvh = Bvh::build(&normalised.scene().triangles, BuildQuality::High);
    let packed = PackedScene::new(&normalised, &bvh).expect("test scenes can be packed");
    let film = FilmSize { width_px: edge_px[0], height_px: edge_px[1] };
    let params = FrameParams::new(&packed, film, options).expect("test frames are sound");
    let twin = TwinScene::new(&packed, &params);
    Prepared { packed, params, twin }
}

/// Collects triangles and materials.
pub(crate) struct Builder {
    pub(crate) triangles: Vec<Triangle>,
    pub(crate) materials: Vec<Material>,
}

impl Builder {
    pub(crate) fn new() -> Self {
        Self { triangles: Vec::new(), materials: Vec::new() }
    }

    pub(crate) fn diffuse(&mut self, reflectance: [f32; 3]) -> u32 {
        self.material(Bsdf::Diffuse { reflectance: reflectance.into() }, Vec3::ZERO)
    }

    pub(crate) fn material(&mut self, bsdf: Bsdf, emission: Vec3) -> u32 {
        let index = self.materials.len();
        self.materials.push(Material { name: format!("material {index}"), bsdf, emission });
        u32::try_from(index).expect("a handful of materials")
    }

    pub(crate) fn triangle(&mut self, positions: [Vec3; 3], normals: [Vec3; 3], material: u32) {
        self.triangles.push(Triangle { positions, normals, material });
    }

    /// A parallelogram whose front is on the side of `u x v`.
    pub(crate) fn quad(&mut self, corner: Vec3, u: Vec3, v: Vec3, material: u32) {
        let normal = [u.cross(v).normalize(); 3];
        self.triangle([corner, corner + u, corner + u + v], normal, material);
        self.triangle([corner, corner + u + v, corner + v], normal, material);
    }

    /// As `quad`, cut into `parts`^2 pieces with normals tilted by a wave of amplitude `tilt`.
    pub(crate) fn bumpy_quad(
        &mut self,
        corner: Vec3,
        u: Vec3,
        v: Vec3,
        parts: u16,
        tilt: f32,
        material: u32,
    ) {
        let normal = u.cross(v).normalize();
        let at = |i: u16, j: u16| {
            let (x, y) = (f32::from(i) / f32::from(parts), f32::from(j) / f32::from(parts));
            let wave = u.normalize() * (11.0 * x + 3.0 * y).sin() + v.normalize() * (9.0 * y).cos();
            (corner + u * x + v * y, (normal + wave * tilt).normalize())
        };
        for i in 0..parts {
            for j in 0..parts {
                let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                self.triangle([a.0, b.0, c.0], [a.1, b.1, c.1], material);
                self.triangle([a.0, c.0, d.0], [a.1, c.1, d.1], material);
            }
        }
    }

    /// A sphere with its front outside; `smooth` gives it round normals.
    pub(crate) fn sphere(&mut self, center: Vec3, radius: f32, rings: u16, smooth: bool, material: u32) {
        let at = |i: u16, j: u16| {
            let theta = PI * f32::from(i) / f32::from(rings);
            let phi = PI * f32::from(j) / f32::from(rings);
            Vec3::new(theta.sin() * phi.cos(), theta.cos(), -theta.sin() * phi.sin())
        };
        let mut face = |corners: [Vec3; 3]| {
            let flat = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
            if flat.length() < 1e-6 {
                return;
            }
            let normals = if smooth { corners } else { [flat.normalize(); 3] };
            self.triangles.push(Triangle {
                positions: corners.map(|c| center + c * radius),
                normals,
                material,
            });
        };
        for i in 0..rings {
            for j in 0..2 * rings {
                let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                face([a, b, c]);
                face([a, c, d]);
            }
        }
    }

    /// The inside of a cube of edge 2 around the origin: left, right, floor, ceiling, back, front.
    pub(crate) fn room(&mut self, materials: [u32; 6], bump: Option<(u16, f32)>) {
        let p = Vec3::new;
        let sides = [
            (p(-1.0, -1.0, -1.0), p(0.0, 2.0, 0.0), p(0.0, 0.0, 2.0)),
            (p(1.0, -1.0, -1.0), p(0.0, 0.0, 2.0), p(0.0, 2.0, 0.0)),
            (p(-1.0, -1.0, -1.0), p(0.0, 0.0, 2.0), p(2.0, 0.0, 0.0)),
            (p(-1.0, 1.0, -1.0), p(2.0, 0.0, 0.0), p(0.0, 0.0, 2.0)),
            (p(-1.0, -1.0, -1.0), p(2.0, 0.0, 0.0), p(0.0, 2.0, 0.0)),
            (p(-1.0, -1.0, 1.0), p(0.0, 2.0, 0.0), p(2.0, 0.0, 0.0)),
        ];
        for ((corner, u, v), material) in sides.into_iter().zip(materials) {
            match bump {
                None => self.quad(corner, u, v, material),
                Some((parts, tilt)) => self.bumpy_quad(corner, u, v, parts, tilt, material),
            }
        }
    }

    pub(crate) fn finish(self, camera: Camera, environment: Option<Vec3>) -> Scene {
        let film = FilmSize { width_px: 32, height_px: 32 };
        Scene { film, camera, triangles: self.triangles, materials: self.materials, environment }
    }
}

pub(crate) fn camera_in_room() -> Camera {
    Camera {
        eye: Vec3::new(0.1, 0.05, 0.95),
        target: Vec3::new(0.0, -0.1, -1.0),
        up: Vec3::Y,
        hfov_deg: 75.0,
    }
}

/// What stands in a room.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Furniture {
    /// A block.
    Block,
    /// A block, a glass ball, a mirror; walls with bumpy shading normals.
    GlassAndMirror,
}

/// A closed room with a lamp under the ceiling.
pub(crate) fn room(furniture: Furniture) -> Scene {
    let mut b = Builder::new();
    let grey = b.diffuse([0.7, 0.7, 0.7]);
    let red = b.diffuse([0.6, 0.1, 0.1]);
    let green = b.diffuse([0.1, 0.5, 0.2]);
    let lamp = b.material(Bsdf::Diffuse { reflectance: Vec3::splat(0.3) }, Vec3::new(9.0, 8.0, 6.0));
    let bump = (furniture == Furniture::GlassAndMirror).then_some((6, 0.25));
    b.room([red, green, grey, grey, grey, grey], bump);
    // Faces down: u x v = -y.
    b.quad(Vec3::new(-0.4, 0.96, -0.6), Vec3::new(0.8, 0.0, 0.0), Vec3::new(0.0, 0.0, 0.8), lamp);
    b.sphere(Vec3::new(0.45, -0.62, -0.45), 0.35, 6, false, grey);
    if furniture == Furniture::GlassAndMirror {
        let glass = b.material(Bsdf::Dielectric { ior: 1.5 }, Vec3::ZERO);
        let mirror = b.material(Bsdf::Mirror { reflectance: Vec3::new(0.9, 0.85, 0.8) }, Vec3::ZERO);
        b.sphere(Vec3::new(-0.4, -0.55, 0.1), 0.32, 12, true, glass);
        b.quad(Vec3::new(-0.95, -0.5, -0.9), Vec3::new(0.9, 0.0, -0.05), Vec3::new(0.0, 1.0, 0.1), mirror);
    }
    b.finish(camera_in_room(), None)
}

/// A diffuse ball and a glass ball on a floor under a constant sky, with a small lamp.
pub(crate) fn outdoors() -> Scene {
    let mut b = Builder::new();
    let grey = b.diffuse([0.6, 0.55, 0.5]);
    let blue = b.diffuse([0.2, 0.3, 0.7]);
    let lamp = b.material(Bsdf::Diffuse { reflectance: Vec3::ZERO }, Vec3::splat(20.0));
    let glass = b.material(Bsdf::Dielectric { ior: 1.33 }, Vec3::ZERO);
    b.quad(Vec3::new(-2.0, 0.0, 2.0), Vec3::new(4.0, 0.0, 0.0), Vec3::new(0.0, 0.0, -4.0), grey);
    b.sphere(Vec3::new(-0.5, 0.4, 0.0), 0.4, 8, true, blue);
    b.sphere(Vec3::new(0.5, 0.4, 0.2), 0.38, 10, true, glass);
    b.quad(Vec3::new(-0.2, 1.4, -0.2), Vec3::new(0.4, 0.0, 0.0), Vec3::new(0.0, 0.0, 0.4), lamp);
    let camera = Camera {
        eye: Vec3::new(0.2, 1.0, 2.4),
        target: Vec3::new(0.0, 0.4, 0.0),
        up: Vec3::Y,
        hfov_deg: 50.0,
    };
    b.finish(camera, Some(Vec3::new(0.4, 0.5, 0.7)))
}
