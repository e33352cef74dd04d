// One eye sample per lane: a light subpath, then an eye subpath; at each eye vertex a light sample (s = 1) and all light
// vertices (s >= 2), and emitters hit (s = 0). One traversal serves all rays: each turn of the loop traces the lane's next
// ray, whatever its kind, so that lanes of unlike path lengths stay together. Twin: src/twin/eye.rs.

const PHASE_LIGHT: u32 = 0u;
const PHASE_EYE: u32 = 1u;
const PHASE_SHADOW: u32 = 2u;
// 15 light and 16 eye rays and for 15 eye vertices 1 + 14 shadow rays make 256.
const MAX_EYE_TURNS: u32 = 256u;

// s = 1 at an eye vertex.
fn connect_to_light(walk: Walk, x: Surface, material: Material, u: vec3<f32>) -> Candidate {
    let light = sample_light(x.position, u);
    let w_e = -walk.direction;
    let f = bsdf_eval(material, x, w_e, light.direction);
    if light.direct_pdf <= 0.0 || max_component(f) <= 0.0 {
        return no_candidate();
    }
    let pdf_fwd = bsdf_pdf(material, x, w_e, light.direction);
    let pdf_rev = bsdf_pdf(material, x, light.direction, w_e);
    let cos_x = abs(dot(light.direction, x.ng));
    let weight =
        mis_weight_light_sample(walk.mis, light.direct_pdf, light.emission_pdf_over_cos, cos_x, pdf_fwd, pdf_rev);
    let cosine = abs(dot(light.direction, x.ns));
    let value = walk.throughput * f * light.radiance * (cosine / light.direct_pdf * weight);
    let origin = offset_along(x.position, x.ng, light.direction);
    if light.infinite {
        return Candidate(value, INFINITE, origin, light.direction);
    }
    return Candidate(value, 1.0, origin, light.end - origin);
}

// s >= 2, t >= 2.
fn connect_to_vertex(walk: Walk, x: Surface, material: Material, y: LightVertex) -> Candidate {
    let offset = y.surface.position - x.position;
    let distance_squared = dot(offset, offset);
    if distance_squared <= 0.0 {
        return no_candidate();
    }
    let w = offset / sqrt(distance_squared);
    let w_e = -walk.direction;
    let material_y = materials[y.surface.material];
    let f = bsdf_eval(material, x, w_e, w) * bsdf_eval(material_y, y.surface, -w, y.w_light);
    if max_component(f) <= 0.0 {
        return no_candidate();
    }
    let cos_x = abs(dot(w, x.ng)) / distance_squared;
    let cos_y = abs(dot(w, y.surface.ng)) / distance_squared;
    let pdf_area_y = bsdf_pdf(material, x, w_e, w) * cos_y;
    let pdf_area_x = bsdf_pdf(material_y, y.surface, y.w_light, -w) * cos_x;
    let pdf_rev_x = bsdf_pdf(material, x, w, w_e);
    let pdf_rev_y = bsdf_pdf(material_y, y.surface, -w, y.w_light);
    let weight = mis_weight_connect(walk.mis, pdf_area_x, pdf_rev_x, y.mis, pdf_area_y, pdf_rev_y);
    let value = walk.throughput * y.throughput * f * (abs(dot(w, x.ns)) * cos_y * weight);
    let origin = offset_along(x.position, x.ng, w);
    return Candidate(value, 1.0, origin, offset_along(y.surface.position, y.surface.ng, -w) - origin);
}

// s = 0: radiance of an emitter that the eye path hit, weighted.
fn emitted(walk: Walk, surface: Surface, material: Material) -> vec3<f32> {
    let cos_light = -dot(walk.direction, surface.ng);
    if cos_light <= 0.0 || luminance(material.emission) <= 0.0 {
        return vec3<f32>(0.0);
    }
    let direct_pdf = area_direct_pdf(material.emission);
    let weight = mis_weight_emitter(walk.mis, direct_pdf, direct_pdf * cos_light / PI);
    return walk.throughput * material.emission * select(weight, 1.0, walk.edges == 1u);
}

// s = 0: radiance of the environment that the eye path left to, weighted.
fn escaped(walk: Walk) -> vec3<f32> {
    let weight = mis_weight_emitter(walk.mis, environment_pdf(), environment_emission_pdf());
    return walk.throughput * frame.environment * select(weight, 1.0, walk.edges == 0u);
}

// Adds a contribution; an infinite one or no number is counted instead.
fn gather(sum: ptr<function, vec3<f32>>, value: vec3<f32>) {
    if is_finite(value) {
        *sum += value;
    } else {
        atomicAdd(&counters.non_finite, 1u);
    }
}

@compute @workgroup_size(64, 1, 1)
fn eye(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let column = group.x * BLOCK_EDGE_PX + local % BLOCK_EDGE_PX;
    let row = group.y * BLOCK_EDGE_PX + local / BLOCK_EDGE_PX;
    if column >= tile.width_px || row >= tile.height_px {
        return;
    }
    let slot = group.z + first_slot;
    let lane = ((group.z * groups.y + group.y) * groups.x + group.x) * GROUP_LANES + local;
    let pixel = vec2<u32>(tile.x_px + column, tile.y_px + row);
    let index = vec2<u32>(pixel.y * frame.width_px + pixel.x, tile.first_sample + slot);
    var rng = rng_new(index, STREAM_EYE, vec2<u32>(tile.seed_lo, tile.seed_hi));
    let jitter = rng_next(&rng);
    let point = vec2<f32>(pixel) + jitter.xy;

    var sum = vec3<f32>(0.0);
    var rays = 0u;
    var phase = PHASE_LIGHT;
    var walk: Walk;
    // A connection needs the edge to the camera and the one between: y has at most max_edges - 2 edges.
    let light_edges = select(0u, frame.max_edges - 2u, frame.connect > 0.0 && frame.max_edges > 2u);
    if light_edges > 0u {
        walk = light_start(&rng);
    } else {
        walk = eye_start(point);
        phase = PHASE_EYE;
    }
    var stored = 0u;
    // Next thing to connect to: 0 the light sample, i the light vertex i - 1.
    var next = 0u;
    var pending = no_candidate();
    var surface: Surface;
    var material: Material;

    loop {
        if rays >= MAX_EYE_TURNS {
            atomicAdd(&counters.paths_cut, 1u);
            break;
        }
        let shadow = phase == PHASE_SHADOW;
        let hit = trace(
            select(walk.origin, pending.origin, shadow),
            select(walk.direction, pending.direction, shadow),
            select(INFINITE, pending.t_max, shadow),
            shadow,
        );
        rays += 1u;
        let missed = hit.triangle == NO_HIT;
        if shadow {
            if missed {
                gather(&sum, pending.value);
            }
        } else if missed {
            if phase == PHASE_EYE {
                gather(&sum, escaped(walk));
                break;
            }
            walk = eye_start(point);
            phase = PHASE_EYE;
            continue;
        } else {
            let on_light_path = phase == PHASE_LIGHT;
            surface = surface_at(hit);
            material = materials[surface.material];
            walk_arrive(&walk, surface, hit.t, on_light_path);
            if on_light_path {
                if !is_delta(material) {
                    store_light_vertex(stored, lane, walk, surface);
                    stored += 1u;
                }
                let goes_on = walk.edges < light_edges && walk_scatter(&walk, surface, material, rng_next(&rng), true);
                if !goes_on {
                    walk = eye_start(point);
                    phase = PHASE_EYE;
                }
                continue;
            }
            gather(&sum, emitted(walk, surface, material));
            if walk.edges >= frame.max_edges {
                break;
            }
            next = select(0u, stored + 1u, is_delta(material));
        }

        var found = false;
        while next <= stored && !found {
            if next == 0u {
                pending = connect_to_light(walk, surface, material, rng_next(&rng).xyz);
            } else {
                let y = load_light_vertex(next - 1u, lane);
                pending = no_candidate();
                if walk.edges + 1u + y.edges <= frame.max_edges {
                    pending = connect_to_vertex(walk, surface, material, y);
                    let strength = luminance(pending.value);
                    if strength > 0.0 && strength < frame.connection_threshold {
                        let survival = strength / frame.connection_threshold;
                        let survives = rng_next(&rng).x < survival;
                        pending.value = select(vec3<f32>(0.0), pending.value / survival, survives);
                    }
                }
            }
            next += 1u;
            // Not "> 0": a value that is no number has to reach the counter.
            found = !(max_component(pending.value) <= 0.0);
        }
        if found {
            phase = PHASE_SHADOW;
            continue;
        }
        if !walk_scatter(&walk, surface, material, rng_next(&rng), false) {
            break;
        }
        phase = PHASE_EYE;
    }

    let place = slot * tile.width_px * tile.height_px + row * tile.width_px + column;
    let brightness = luminance(sum);
    let before = slot_sums[place];
    slot_sums[place] = SlotSum(
        before.rgb + sum,
        before.luminance + brightness,
        before.luminance_squared + brightness * brightness,
        before.count + 1u,
        before.rays + rays,
        0u,
    );
}
