//! Twin of `shaders/shared/mis.wgsl`; the equations stand there.

use crate::gpu::layout::Frame;

/// The recursion's state at a vertex.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mis {
    /// Weight of connecting at this vertex.
    pub dvcm: f32,
    /// Weight of all strategies before.
    pub dvc: f32,
}

/// One end of a connection.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConnectionEnd {
    /// The recursion's state.
    pub mis: Mis,
    /// `pdf_area` of reaching this end from the other.
    pub pdf_area: f32,
    /// `pdf_solid_angle` of going on from this end to its previous vertex.
    pub pdf_rev: f32,
}

/// Start of an eye subpath.
#[must_use]
pub fn mis_eye_start(frame: &Frame, camera_pdf: f32) -> Mis {
    Mis { dvcm: frame.splat * frame.nl / camera_pdf, dvc: 0.0 }
}

/// At a hit; `distance_squared` is 1 on the first segment of an infinite light.
#[must_use]
pub fn mis_arrive(mis: Mis, distance_squared: f32, cos_in: f32) -> Mis {
    Mis { dvcm: mis.dvcm * distance_squared / cos_in, dvc: mis.dvc / cos_in }
}

/// Through a lobe with a density.
#[must_use]
pub fn mis_scatter(frame: &Frame, mis: Mis, cos_out: f32, pdf_fwd: f32, pdf_rev: f32) -> Mis {
    Mis { dvcm: 1.0 / pdf_fwd, dvc: frame.connect * (cos_out / pdf_fwd) * (mis.dvcm + pdf_rev * mis.dvc) }
}

/// Through a delta lobe.
#[must_use]
pub fn mis_scatter_delta(mis: Mis, cos_out: f32) -> Mis {
    Mis { dvcm: 0.0, dvc: cos_out * mis.dvc }
}

/// s = 0 after at least two edges.
#[must_use]
pub fn mis_weight_emitter(mis: Mis, direct_pdf: f32, emission_pdf: f32) -> f32 {
    1.0 / (1.0 + direct_pdf * mis.dvcm + emission_pdf * mis.dvc)
}

/// s = 1.
#[must_use]
pub fn mis_weight_light_sample(
    frame: &Frame,
    mis: Mis,
    direct_pdf: f32,
    emission_pdf_over_cos: f32,
    cos_x: f32,
    pdf_fwd: f32,
    pdf_rev: f32,
) -> f32 {
    let w_light = pdf_fwd / direct_pdf;
    let w_camera =
        frame.connect * emission_pdf_over_cos * cos_x / direct_pdf * (mis.dvcm + mis.dvc * pdf_rev);
    1.0 / (1.0 + w_light + w_camera)
}

/// s >= 2, t >= 2.
#[must_use]
pub fn mis_weight_connect(x: ConnectionEnd, y: ConnectionEnd) -> f32 {
    let w_light = y.pdf_area * (y.mis.dvcm + y.mis.dvc * y.pdf_rev);
    let w_camera = x.pdf_area * (x.mis.dvcm + x.mis.dvc * x.pdf_rev);
    1.0 / (1.0 + w_light + w_camera)
}

/// t = 1.
#[must_use]
pub fn mis_weight_camera(frame: &Frame, mis_y: Mis, pdf_area_camera: f32, pdf_rev_y: f32) -> f32 {
    1.0 / (1.0 + pdf_area_camera / frame.nl * (mis_y.dvcm + mis_y.dvc * pdf_rev_y))
}
