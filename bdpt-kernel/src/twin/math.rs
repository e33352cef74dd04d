//! Twin of `shaders/shared/math.wgsl`.

use std::f32::consts::PI;

use glam::{Vec2, Vec3};

pub use crate::gpu::pack::{encode_octahedral, luminance};

/// Stands for an unbounded ray.
pub const INFINITE: f32 = 3.0e38;

/// -1 below zero, else 1.
#[must_use]
pub fn sign_not_zero(v: f32) -> f32 {
    if v < 0.0 { -1.0 } else { 1.0 }
}

/// The unit vector of [`encode_octahedral`]'s bits.
#[must_use]
pub fn decode_octahedral(bits: u32) -> Vec3 {
    let unpack = |half: u16| f32::from(half) * (2.0 / 65_535.0) - 1.0;
    let [b0, b1, b2, b3] = bits.to_le_bytes();
    let (x, y) = (unpack(u16::from_le_bytes([b0, b1])), unpack(u16::from_le_bytes([b2, b3])));
    let z = 1.0 - x.abs() - y.abs();
    if z < 0.0 {
        return Vec3::new((1.0 - y.abs()) * sign_not_zero(x), (1.0 - x.abs()) * sign_not_zero(y), z)
            .normalize();
    }
    Vec3::new(x, y, z).normalize()
}

/// From the frame whose z axis is `n` to the world (Duff et al. 2017).
#[must_use]
pub fn to_world(n: Vec3, v: Vec3) -> Vec3 {
    let s = sign_not_zero(n.z);
    let a = -1.0 / (s + n.z);
    let b = n.x * n.y * a;
    let tangent = Vec3::new(1.0 + s * n.x * n.x * a, s * b, -s * n.x);
    let bitangent = Vec3::new(b, s + n.y * n.y * a, -n.y);
    tangent * v.x + bitangent * v.y + n * v.z
}

/// Cosine-weighted around +z; `pdf_solid_angle = z / pi`.
#[must_use]
pub fn sample_cosine_hemisphere(u: Vec2) -> Vec3 {
    let (r, phi) = (u.x.sqrt(), 2.0 * PI * u.y);
    Vec3::new(r * phi.cos(), r * phi.sin(), (1.0 - u.x).sqrt())
}

/// Uniform on the sphere; `pdf_solid_angle = 1 / (4 pi)`.
#[must_use]
pub fn sample_sphere(u: Vec2) -> Vec3 {
    let z = 1.0 - 2.0 * u.x;
    let (r, phi) = ((1.0 - z * z).max(0.0).sqrt(), 2.0 * PI * u.y);
    Vec3::new(r * phi.cos(), r * phi.sin(), z)
}

/// Uniform on the unit disk; `pdf_area = 1 / pi`.
#[must_use]
pub fn sample_disk(u: Vec2) -> Vec2 {
    let (r, phi) = (u.x.sqrt(), 2.0 * PI * u.y);
    Vec2::new(r * phi.cos(), r * phi.sin())
}

/// Barycentric weights of the second and third corner; uniform in area.
#[must_use]
pub fn sample_triangle(u: Vec2) -> Vec2 {
    let r = u.x.sqrt();
    Vec2::new(r * (1.0 - u.y), r * u.y)
}
