// The pinhole camera in pixel units (50-bdpt.md section 1). Twin: src/twin/camera.rs.

struct Projection {
    // Column and row; valid when `inside`.
    pixel: vec2<u32>,
    inside: bool,
    // pCam: pdf_solid_angle of the direction per pixel area.
    pdf: f32,
}

// Unit direction through a point of the image, in pixels from the top left.
fn camera_direction(point: vec2<f32>) -> vec3<f32> {
    let x = point.x - 0.5 * f32(frame.width_px);
    let y = 0.5 * f32(frame.height_px) - point.y;
    return normalize(frame.right * x + frame.up * y + frame.forward * frame.d_img);
}

// pCam(w) = dImg^2 / cos^3(theta).
fn camera_pdf(direction: vec3<f32>) -> f32 {
    let cosine = dot(direction, frame.forward);
    return frame.d_img * frame.d_img / (cosine * cosine * cosine);
}

// Where the unit direction from the camera meets the image.
fn camera_project(direction: vec3<f32>) -> Projection {
    let cosine = dot(direction, frame.forward);
    if cosine <= 0.0 {
        return Projection(vec2<u32>(0u), false, 0.0);
    }
    let scale = frame.d_img / cosine;
    let x = dot(direction, frame.right) * scale + 0.5 * f32(frame.width_px);
    let y = 0.5 * f32(frame.height_px) - dot(direction, frame.up) * scale;
    let inside = x >= 0.0 && x < f32(frame.width_px) && y >= 0.0 && y < f32(frame.height_px);
    let pixel = vec2<u32>(u32(clamp(x, 0.0, 1.0e6)), u32(clamp(y, 0.0, 1.0e6)));
    return Projection(pixel, inside, camera_pdf(direction));
}
