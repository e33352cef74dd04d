// Recursive weights of the balance heuristic, two floats a vertex (50-bdpt.md section 2; van Antwerpen 2011; Georgiev 2012,
// VCM report, eq. 31-55 without merging). Roulette stays out (trap 2). Twin: src/twin/mis.rs.

struct Mis {
    dvcm: f32,
    dvc: f32,
}

// dVCM = NL / pCam; 0 without a light image, which turns t = 1 off everywhere.
fn mis_eye_start(camera_pdf: f32) -> Mis {
    return Mis(frame.splat * frame.nl / camera_pdf, 0.0);
}

// At a hit: `distance_squared` is 1 on the first segment of an infinite light.
fn mis_arrive(mis: Mis, distance_squared: f32, cos_in: f32) -> Mis {
    return Mis(mis.dvcm * distance_squared / cos_in, mis.dvc / cos_in);
}

// Non-delta: dVC = cosOut/pF * (dVCM + pR*dVC); dVCM = 1/pF. Plain path tracing keeps dVC = 0: no s >= 2.
fn mis_scatter(mis: Mis, cos_out: f32, pdf_fwd: f32, pdf_rev: f32) -> Mis {
    return Mis(1.0 / pdf_fwd, frame.connect * (cos_out / pdf_fwd) * (mis.dvcm + pdf_rev * mis.dvc));
}

// Delta: dVC = cosOut*dVC; dVCM = 0.
fn mis_scatter_delta(mis: Mis, cos_out: f32) -> Mis {
    return Mis(0.0, cos_out * mis.dvc);
}

// s = 0 after at least two edges: wC = dirPdf*dVCM + emiPdf*dVC.
fn mis_weight_emitter(mis: Mis, direct_pdf: f32, emission_pdf: f32) -> f32 {
    return 1.0 / (1.0 + direct_pdf * mis.dvcm + emission_pdf * mis.dvc);
}

// s = 1: wL = pF(x->light)/dirPdfW; wC = emiPdf*cosX/(dirPdfW*cosL) * (dVCM + dVC*pR(x)).
fn mis_weight_light_sample(
    mis: Mis,
    direct_pdf: f32,
    emission_pdf_over_cos: f32,
    cos_x: f32,
    pdf_fwd: f32,
    pdf_rev: f32,
) -> f32 {
    let w_light = pdf_fwd / direct_pdf;
    let w_camera = frame.connect * emission_pdf_over_cos * cos_x / direct_pdf * (mis.dvcm + mis.dvc * pdf_rev);
    return 1.0 / (1.0 + w_light + w_camera);
}

// s >= 2, t >= 2: pA_y and pA_x are pdf_area of reaching each end from the other.
fn mis_weight_connect(
    mis_x: Mis,
    pdf_area_x: f32,
    pdf_rev_x: f32,
    mis_y: Mis,
    pdf_area_y: f32,
    pdf_rev_y: f32,
) -> f32 {
    let w_light = pdf_area_y * (mis_y.dvcm + mis_y.dvc * pdf_rev_y);
    let w_camera = pdf_area_x * (mis_x.dvcm + mis_x.dvc * pdf_rev_x);
    return 1.0 / (1.0 + w_light + w_camera);
}

// t = 1: pA = pCam*|w.Ng(y)|/d^2; wL = pA/NL * (dVCM + dVC*pR(y)).
fn mis_weight_camera(mis_y: Mis, pdf_area_camera: f32, pdf_rev_y: f32) -> f32 {
    return 1.0 / (1.0 + pdf_area_camera / frame.nl * (mis_y.dvcm + mis_y.dvc * pdf_rev_y));
}
