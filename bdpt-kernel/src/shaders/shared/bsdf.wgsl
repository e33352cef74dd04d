// How surfaces scatter. f(w_e, w_l): w_e toward the eye side, w_l toward the light side. All directions point away from
// the surface. Twin: src/twin/bsdf.rs.

const ABSORBED: u32 = 0u;
const SMOOTH: u32 = 1u;
const DELTA: u32 = 2u;

struct Scatter {
    direction: vec3<f32>,
    // ABSORBED, SMOOTH or DELTA.
    event: u32,
    // What the throughput is multiplied by: f times the cosine of the shading-normal rule over the pdf.
    factor: vec3<f32>,
    // pdf_solid_angle of the direction, and of the reverse; both 0 for DELTA, where they cancel.
    pdf_fwd: f32,
    pdf_rev: f32,
}

// Whether a material has only delta lobes: such vertices are never connected.
fn is_delta(material: Material) -> bool {
    return material.kind != DIFFUSE;
}

// f without cosines; 0 for delta lobes.
fn bsdf_eval(material: Material, surface: Surface, w_e: vec3<f32>, w_l: vec3<f32>) -> vec3<f32> {
    let one_side = dot(w_e, surface.ng) * dot(w_l, surface.ng) > 0.0;
    if material.kind == DIFFUSE && one_side && is_consistent(surface, w_e) && is_consistent(surface, w_l) {
        return material.reflectance * (1.0 / PI);
    }
    return vec3<f32>(0.0);
}

// pdf_solid_angle of sampling w_to for a path that came along w_fixed; 0 for delta lobes.
fn bsdf_pdf(material: Material, surface: Surface, w_fixed: vec3<f32>, w_to: vec3<f32>) -> f32 {
    let one_side = dot(w_fixed, surface.ng) * dot(w_to, surface.ng) > 0.0;
    if material.kind == DIFFUSE && one_side && is_consistent(surface, w_fixed) && is_consistent(surface, w_to) {
        return abs(dot(w_to, surface.ns)) * (1.0 / PI);
    }
    return 0.0;
}

// Chooses where a path goes on. `on_light_path` picks the adjoint: the geometric cosine at the light-side vertex, no eta^2.
fn bsdf_sample(
    material: Material,
    surface: Surface,
    w_fixed: vec3<f32>,
    u: vec3<f32>,
    on_light_path: bool,
) -> Scatter {
    var absorbed = Scatter(vec3<f32>(0.0), ABSORBED, vec3<f32>(0.0), 0.0, 0.0);
    if !is_consistent(surface, w_fixed) {
        return absorbed;
    }
    // Normals on the side of w_fixed.
    let side = sign_not_zero(dot(w_fixed, surface.ng));
    let ns = surface.ns * side;
    let ng = surface.ng * side;
    let cos_fixed = dot(w_fixed, ns);
    var scatter = absorbed;
    if material.kind == DIFFUSE {
        let direction = to_world(ns, sample_cosine_hemisphere(u.yz));
        let pdf_fwd = bsdf_pdf(material, surface, w_fixed, direction);
        if pdf_fwd <= 0.0 {
            return absorbed;
        }
        let cosine = select(dot(direction, ns), dot(direction, ng), on_light_path);
        scatter.direction = direction;
        scatter.event = SMOOTH;
        scatter.factor = material.reflectance * (cosine / (PI * pdf_fwd));
        scatter.pdf_fwd = pdf_fwd;
        scatter.pdf_rev = bsdf_pdf(material, surface, direction, w_fixed);
        return scatter;
    }
    var direction = ns * (2.0 * cos_fixed) - w_fixed;
    var transmitted = false;
    var scale = 1.0;
    if material.kind == DIELECTRIC {
        // Index on the side of w_fixed over the index beyond.
        let eta = select(material.ior, 1.0 / material.ior, side > 0.0);
        let sin2 = eta * eta * max(0.0, 1.0 - cos_fixed * cos_fixed);
        let cos_beyond = sqrt(max(0.0, 1.0 - sin2));
        let reflected = select(fresnel_dielectric(eta, cos_fixed, cos_beyond), 1.0, sin2 >= 1.0);
        if u.x >= reflected {
            direction = ns * (eta * cos_fixed - cos_beyond) - w_fixed * eta;
            transmitted = true;
            // Radiance is compressed by eta^2 on the eye's side (Walter et al. 2007); flux is not.
            scale = select(eta * eta, 1.0, on_light_path);
        }
    }
    direction = normalize(direction);
    let cos_ns = dot(direction, ns);
    let cos_ng = dot(direction, ng);
    let leaves = select(cos_ng > 0.0 && cos_ns > 0.0, cos_ng < 0.0 && cos_ns < 0.0, transmitted);
    if !leaves {
        return absorbed;
    }
    scatter.direction = direction;
    scatter.event = DELTA;
    scatter.factor = material.reflectance * (scale * select(1.0, cos_ng / cos_ns, on_light_path));
    return scatter;
}

// Unpolarised reflectance of a smooth interface; `eta` as above.
fn fresnel_dielectric(eta: f32, cos_fixed: f32, cos_beyond: f32) -> f32 {
    let parallel = (cos_fixed - eta * cos_beyond) / (cos_fixed + eta * cos_beyond);
    let perpendicular = (eta * cos_fixed - cos_beyond) / (eta * cos_fixed + cos_beyond);
    return 0.5 * (parallel * parallel + perpendicular * perpendicular);
}
