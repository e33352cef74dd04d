// Subpaths of both kinds: start, arrival at a surface, scattering, the light vertices that are kept.
// Twin: src/twin/walk.rs.

struct Walk {
    // The next ray.
    origin: vec3<f32>,
    // Edges up to the last surface.
    edges: u32,
    direction: vec3<f32>,
    // Largest component of the throughput at the start: roulette measures against it.
    strength: f32,
    throughput: vec3<f32>,
    // On the first segment of an infinite light.
    from_infinity: bool,
    mis: Mis,
}

// A shadow ray and what it carries when nothing blocks it; `value` is 0 when there is nothing to trace.
struct Candidate {
    value: vec3<f32>,
    t_max: f32,
    origin: vec3<f32>,
    direction: vec3<f32>,
}

struct LightVertex {
    surface: Surface,
    throughput: vec3<f32>,
    edges: u32,
    // Toward the previous vertex, the light side.
    w_light: vec3<f32>,
    mis: Mis,
}

fn no_candidate() -> Candidate {
    return Candidate(vec3<f32>(0.0), 0.0, vec3<f32>(0.0), vec3<f32>(0.0));
}

fn light_start(rng: ptr<function, Rng>) -> Walk {
    let pick = rng_next(rng);
    let u = rng_next(rng);
    let start = sample_emission(pick.x, u);
    return Walk(
        start.origin,
        0u,
        start.direction,
        max_component(start.throughput),
        start.throughput,
        start.infinite,
        Mis(start.dvcm, start.dvc),
    );
}

// `point` in pixels from the image's top left.
fn eye_start(point: vec2<f32>) -> Walk {
    let direction = camera_direction(point);
    return Walk(frame.eye, 0u, direction, 1.0, vec3<f32>(1.0), false, mis_eye_start(camera_pdf(direction)));
}

fn walk_arrive(walk: ptr<function, Walk>, surface: Surface, t: f32, on_light_path: bool) {
    let cos_in = abs(dot((*walk).direction, surface.ng));
    (*walk).mis = mis_arrive((*walk).mis, select(t * t, 1.0, (*walk).from_infinity), cos_in);
    (*walk).from_infinity = false;
    (*walk).edges += 1u;
    if on_light_path {
        // Shading cosine at the eye-side end of the edge just travelled, geometric at its light-side end.
        (*walk).throughput *= abs(dot((*walk).direction, surface.ns)) / cos_in;
    }
}

// Goes on from a surface, or ends the path: absorbed or by roulette.
fn walk_scatter(
    walk: ptr<function, Walk>,
    surface: Surface,
    material: Material,
    u: vec4<f32>,
    on_light_path: bool,
) -> bool {
    let scatter = bsdf_sample(material, surface, -(*walk).direction, u.xyz, on_light_path);
    if scatter.event == ABSORBED {
        return false;
    }
    var throughput = (*walk).throughput * scatter.factor;
    if max_component(throughput) <= 0.0 {
        return false;
    }
    if (*walk).edges >= frame.roulette_edges {
        let survival = min(1.0, max_component(throughput) / (*walk).strength);
        if u.w >= survival {
            return false;
        }
        throughput = throughput / survival;
    }
    (*walk).throughput = throughput;
    let cos_out = abs(dot(scatter.direction, surface.ng));
    if scatter.event == DELTA {
        (*walk).mis = mis_scatter_delta((*walk).mis, cos_out);
    } else {
        (*walk).mis = mis_scatter((*walk).mis, cos_out, scatter.pdf_fwd, scatter.pdf_rev);
    }
    (*walk).origin = offset_along(surface.position, surface.ng, scatter.direction);
    (*walk).direction = scatter.direction;
    return true;
}

fn store_light_vertex(index: u32, lane: u32, walk: Walk, surface: Surface) {
    let place = index * tile.scratch_lanes + lane;
    vertex_a[place] = vec4<u32>(bitcast<vec3<u32>>(surface.position), encode_octahedral(surface.ng));
    vertex_b[place] = vec4<f32>(walk.throughput, walk.mis.dvcm);
    vertex_c[place] = vec4<u32>(
        encode_octahedral(surface.ns),
        encode_octahedral(-walk.direction),
        surface.material | (walk.edges << 24u),
        bitcast<u32>(walk.mis.dvc),
    );
}

fn load_light_vertex(index: u32, lane: u32) -> LightVertex {
    let place = index * tile.scratch_lanes + lane;
    let a = vertex_a[place];
    let b = vertex_b[place];
    let c = vertex_c[place];
    let surface = Surface(
        bitcast<vec3<f32>>(a.xyz),
        decode_octahedral(a.w),
        decode_octahedral(c.x),
        c.z & 0x00ffffffu,
    );
    return LightVertex(surface, b.xyz, c.z >> 24u, decode_octahedral(c.y), Mis(b.w, bitcast<f32>(c.w)));
}
