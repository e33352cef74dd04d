//! Twin of `shaders/shared/camera.wgsl`.

use glam::{Vec2, Vec3};

use super::TwinScene;

/// A direction from the camera, on the image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Projection {
    /// Column and row.
    pub pixel: [u32; 2],
    /// pCam: `pdf_solid_angle` of the direction per pixel area.
    pub pdf: f32,
}

#[allow(clippy::cast_precision_loss, reason = "image edges as real numbers")]
fn size(scene: &TwinScene) -> Vec2 {
    Vec2::new(scene.frame.width_px as f32, scene.frame.height_px as f32)
}

/// Unit direction through a point of the image, in pixels from the top left.
#[must_use]
pub fn camera_direction(scene: &TwinScene, point: Vec2) -> Vec3 {
    let frame = &scene.frame;
    let half = size(scene) * 0.5;
    let (x, y) = (point.x - half.x, half.y - point.y);
    (Vec3::from(frame.right) * x + Vec3::from(frame.up) * y + Vec3::from(frame.forward) * frame.d_img)
        .normalize()
}

/// pCam(w) = dImg^2 / cos^3(theta).
#[must_use]
pub fn camera_pdf(scene: &TwinScene, direction: Vec3) -> f32 {
    let cosine = direction.dot(Vec3::from(scene.frame.forward));
    scene.frame.d_img * scene.frame.d_img / (cosine * cosine * cosine)
}

/// Where the unit direction from the camera meets the image, if it does.
#[must_use]
pub fn camera_project(scene: &TwinScene, direction: Vec3) -> Option<Projection> {
    let frame = &scene.frame;
    let cosine = direction.dot(Vec3::from(frame.forward));
    if cosine <= 0.0 {
        return None;
    }
    let scale = frame.d_img / cosine;
    let whole = size(scene);
    let x = direction.dot(Vec3::from(frame.right)) * scale + 0.5 * whole.x;
    let y = 0.5 * whole.y - direction.dot(Vec3::from(frame.up)) * scale;
    let inside = x >= 0.0 && x < whole.x && y >= 0.0 && y < whole.y;
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "inside the image")]
    inside.then(|| Projection { pixel: [x as u32, y as u32], pdf: camera_pdf(scene, direction) })
}
