// Appended to the renderer's module by tests/gpu_vs_twin.rs: each stage's functions on arrays of inputs.

@group(0) @binding(20) var<storage, read> probe_in: array<vec4<f32>>;
@group(0) @binding(21) var<storage, read_write> probe_out: array<vec4<f32>>;

fn probe_surface(place: u32) -> Surface {
    let material = u32(probe_in[place].w);
    return Surface(vec3<f32>(0.0), probe_in[place].xyz, probe_in[place + 1u].xyz, material);
}

// In: index as bits of four words. Out: eight numbers of either stream.
@compute @workgroup_size(64, 1, 1)
fn probe_rng(@builtin(global_invocation_id) id: vec3<u32>) {
    let key = bitcast<vec4<u32>>(probe_in[id.x]);
    var eye = rng_new(key.xy, STREAM_EYE, key.zw);
    probe_out[id.x * 4u] = rng_next(&eye);
    probe_out[id.x * 4u + 1u] = rng_next(&eye);
    var light = rng_new(key.xy, STREAM_LIGHT, key.zw);
    probe_out[id.x * 4u + 2u] = rng_next(&light);
    probe_out[id.x * 4u + 3u] = rng_next(&light);
}

// In: origin and t_max, direction. Out: nearest hit; whether any hit, and the surface of the nearest.
@compute @workgroup_size(64, 1, 1)
fn probe_trace(@builtin(global_invocation_id) id: vec3<u32>) {
    let origin = probe_in[id.x * 2u];
    let direction = probe_in[id.x * 2u + 1u].xyz;
    let hit = trace(origin.xyz, direction, origin.w, false);
    let any = trace(origin.xyz, direction, origin.w, true);
    var ns = vec3<f32>(0.0);
    var position = vec3<f32>(0.0);
    if hit.triangle != NO_HIT {
        let surface = surface_at(hit);
        ns = surface.ns;
        position = surface.position;
    }
    probe_out[id.x * 3u] = vec4<f32>(hit.t, bitcast<f32>(hit.triangle & 0x00ffffffu | 0x3f000000u), hit.u, hit.v);
    probe_out[id.x * 3u + 1u] = vec4<f32>(ns, select(1.0, 0.0, any.triangle == NO_HIT));
    probe_out[id.x * 3u + 2u] = vec4<f32>(position, 0.0);
}

// In: ng and material, ns, w_fixed and 1 on light paths, w_other, u. Out: eval and pdf; the sample.
@compute @workgroup_size(64, 1, 1)
fn probe_bsdf(@builtin(global_invocation_id) id: vec3<u32>) {
    let place = id.x * 5u;
    let surface = probe_surface(place);
    let material = materials[surface.material];
    let fixed_side = probe_in[place + 2u].xyz;
    let other = probe_in[place + 3u].xyz;
    let on_light_path = probe_in[place + 2u].w > 0.5;
    let f = bsdf_eval(material, surface, fixed_side, other);
    let scatter = bsdf_sample(material, surface, fixed_side, probe_in[place + 4u].xyz, on_light_path);
    probe_out[id.x * 4u] = vec4<f32>(f, bsdf_pdf(material, surface, fixed_side, other));
    probe_out[id.x * 4u + 1u] = vec4<f32>(scatter.direction, f32(scatter.event));
    probe_out[id.x * 4u + 2u] = vec4<f32>(scatter.factor, scatter.pdf_fwd);
    probe_out[id.x * 4u + 3u] = vec4<f32>(scatter.pdf_rev, 0.0, 0.0, 0.0);
}

// In: position and pick, u. Out: an emission, then a light sample.
@compute @workgroup_size(64, 1, 1)
fn probe_lights(@builtin(global_invocation_id) id: vec3<u32>) {
    let a = probe_in[id.x * 2u];
    let u = probe_in[id.x * 2u + 1u];
    let start = sample_emission(a.w, u);
    let light = sample_light(a.xyz, vec3<f32>(a.w, u.xy));
    probe_out[id.x * 6u] = vec4<f32>(start.origin, select(0.0, 1.0, start.infinite));
    probe_out[id.x * 6u + 1u] = vec4<f32>(start.direction, start.dvcm);
    probe_out[id.x * 6u + 2u] = vec4<f32>(start.throughput, start.dvc);
    probe_out[id.x * 6u + 3u] = vec4<f32>(light.direction, light.direct_pdf);
    probe_out[id.x * 6u + 4u] = vec4<f32>(light.radiance, light.emission_pdf_over_cos);
    probe_out[id.x * 6u + 5u] = vec4<f32>(light.end, select(0.0, 1.0, light.infinite));
}

// In: a point of the image, a direction. Out: the ray through the point and its pdf; the direction's projection.
@compute @workgroup_size(64, 1, 1)
fn probe_camera(@builtin(global_invocation_id) id: vec3<u32>) {
    let point = probe_in[id.x * 2u].xy;
    let direction = camera_direction(point);
    let projection = camera_project(probe_in[id.x * 2u + 1u].xyz);
    probe_out[id.x * 2u] = vec4<f32>(direction, camera_pdf(direction));
    probe_out[id.x * 2u + 1u] = vec4<f32>(
        f32(projection.pixel.x),
        f32(projection.pixel.y),
        projection.pdf,
        select(0.0, 1.0, projection.inside),
    );
}

// In: dVCM, dVC, cosines and pdfs. Out: each function of the recursion.
@compute @workgroup_size(64, 1, 1)
fn probe_mis(@builtin(global_invocation_id) id: vec3<u32>) {
    let a = probe_in[id.x * 2u];
    let b = probe_in[id.x * 2u + 1u];
    let mis = Mis(a.x, a.y);
    let arrived = mis_arrive(mis, a.z, a.w);
    let scattered = mis_scatter(mis, a.w, b.x, b.y);
    let passed = mis_scatter_delta(mis, a.w);
    probe_out[id.x * 3u] = vec4<f32>(arrived.dvcm, arrived.dvc, scattered.dvcm, scattered.dvc);
    probe_out[id.x * 3u + 1u] = vec4<f32>(
        passed.dvcm,
        passed.dvc,
        mis_weight_emitter(mis, b.x, b.y),
        mis_weight_light_sample(mis, b.x, b.y, a.w, b.z, b.w),
    );
    probe_out[id.x * 3u + 2u] = vec4<f32>(
        mis_weight_connect(mis, b.x, b.y, scattered, b.z, b.w),
        mis_weight_camera(mis, b.x, b.y),
        mis_eye_start(b.z).dvcm,
        0.0,
    );
}
