// One light path per lane: every vertex is connected to the camera (t = 1). Twin: src/twin/light.rs.

// 15 surface vertices, each with a ray to it and one to the camera.
const MAX_LIGHT_TURNS: u32 = 30u;
// Splats at or above this leave the fixed point's range.
const SPLAT_LIMIT: f32 = 2147483648.0;

struct Splat {
    candidate: Candidate,
    pixel: u32,
}

fn connect_to_camera(walk: Walk, y: Surface, material: Material) -> Splat {
    let offset = frame.eye - y.position;
    let distance_squared = dot(offset, offset);
    let w = offset / sqrt(distance_squared);
    let w_light = -walk.direction;
    let projection = camera_project(-w);
    let f = bsdf_eval(material, y, w, w_light);
    if !projection.inside || distance_squared <= 0.0 || max_component(f) <= 0.0 {
        return Splat(no_candidate(), 0u);
    }
    let pdf_area_camera = projection.pdf * abs(dot(w, y.ng)) / distance_squared;
    let pdf_rev = bsdf_pdf(material, y, w, w_light);
    let weight = mis_weight_camera(walk.mis, pdf_area_camera, pdf_rev);
    let value = walk.throughput * f * (pdf_area_camera * weight);
    let origin = offset_along(y.position, y.ng, w);
    let pixel = projection.pixel.y * frame.width_px + projection.pixel.x;
    return Splat(Candidate(value, 1.0, origin, frame.eye - origin), pixel);
}

// Low and high word of v in 32.32 fixed point.
fn fixed_point(v: f32) -> vec2<u32> {
    let whole = floor(v);
    return vec2<u32>(u32((v - whole) * 4294967296.0), u32(whole));
}

// The word to add to the high half: its own and the carry of the low half.
fn carried(words: vec2<u32>, old_low: u32) -> u32 {
    return words.y + select(0u, 1u, old_low + words.x < old_low);
}

fn splat(pixel: u32, value: vec3<f32>) {
    if !is_finite(value) {
        atomicAdd(&counters.non_finite, 1u);
        return;
    }
    let scaled = value / (frame.nl * frame.splat_unit);
    if max_component(scaled) >= SPLAT_LIMIT {
        atomicAdd(&counters.splat_overflows, 1u);
        return;
    }
    let red = fixed_point(scaled.x);
    let green = fixed_point(scaled.y);
    let blue = fixed_point(scaled.z);
    let high = vec3<u32>(
        carried(red, atomicAdd(&splat_red[pixel * 2u], red.x)),
        carried(green, atomicAdd(&splat_green[pixel * 2u], green.x)),
        carried(blue, atomicAdd(&splat_blue[pixel * 2u], blue.x)),
    );
    let old = vec3<u32>(
        atomicAdd(&splat_red[pixel * 2u + 1u], high.x),
        atomicAdd(&splat_green[pixel * 2u + 1u], high.y),
        atomicAdd(&splat_blue[pixel * 2u + 1u], high.z),
    );
    let wrapped = old + high < old;
    if wrapped.x || wrapped.y || wrapped.z {
        atomicAdd(&counters.splat_overflows, 1u);
    }
}

@compute @workgroup_size(64, 1, 1)
fn light(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let path = ((group.z + first_slot) * light_range.groups_x + group.x) * GROUP_LANES + local;
    if path >= light_range.paths {
        return;
    }
    let low = light_range.first_path_lo + path;
    let index = vec2<u32>(low, light_range.first_path_hi + select(0u, 1u, low < path));
    var rng = rng_new(index, STREAM_LIGHT, vec2<u32>(light_range.seed_lo, light_range.seed_hi));
    var walk = light_start(&rng);
    var rays = 0u;
    var shadow = false;
    var pending = Splat(no_candidate(), 0u);
    var surface: Surface;
    var material: Material;
    // The edge to the camera is one of max_edges.
    let light_edges = frame.max_edges - 1u;

    while walk.edges < light_edges || shadow {
        if rays >= MAX_LIGHT_TURNS {
            atomicAdd(&counters.paths_cut, 1u);
            break;
        }
        let hit = trace(
            select(walk.origin, pending.candidate.origin, shadow),
            select(walk.direction, pending.candidate.direction, shadow),
            select(INFINITE, pending.candidate.t_max, shadow),
            shadow,
        );
        rays += 1u;
        let missed = hit.triangle == NO_HIT;
        if shadow {
            shadow = false;
            if missed {
                splat(pending.pixel, pending.candidate.value);
            }
        } else {
            if missed {
                break;
            }
            surface = surface_at(hit);
            material = materials[surface.material];
            walk_arrive(&walk, surface, hit.t, true);
            if !is_delta(material) {
                pending = connect_to_camera(walk, surface, material);
                shadow = !(max_component(pending.candidate.value) <= 0.0);
            }
            if shadow {
                continue;
            }
        }
        if walk.edges >= light_edges || !walk_scatter(&walk, surface, material, rng_next(&rng), true) {
            break;
        }
    }
    atomicAdd(&counters.rays, rays);
}
