// Albedo, normal and depth of the first surface that is no mirror and no glass, averaged over a few samples of the same
// primary rays as the eye kernel's. Twin: src/twin/first_hit.rs.

@compute @workgroup_size(64, 1, 1)
fn first_hit(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let column = group.x * BLOCK_EDGE_PX + local % BLOCK_EDGE_PX;
    let row = group.y * BLOCK_EDGE_PX + local / BLOCK_EDGE_PX;
    if column >= tile.width_px || row >= tile.height_px {
        return;
    }
    let pixel = vec2<u32>(tile.x_px + column, tile.y_px + row);
    var sum = FirstHitSum(vec3<f32>(0.0), 0u, vec3<f32>(0.0), 0.0, 0u, 0u, 0u, 0u);
    for (var sample_index = 0u; sample_index < tile.first_hit_samples; sample_index += 1u) {
        let index = vec2<u32>(pixel.y * frame.width_px + pixel.x, tile.first_sample + sample_index);
        var rng = rng_new(index, STREAM_EYE, vec2<u32>(tile.seed_lo, tile.seed_hi));
        let jitter = rng_next(&rng);
        var walk = eye_start(vec2<f32>(pixel) + jitter.xy);
        var path_length = 0.0;
        sum.samples += 1u;
        while walk.edges < frame.max_edges {
            let hit = trace(walk.origin, walk.direction, INFINITE, false);
            if hit.triangle == NO_HIT {
                break;
            }
            let surface = surface_at(hit);
            let material = materials[surface.material];
            walk_arrive(&walk, surface, hit.t, false);
            path_length += hit.t;
            if !is_delta(material) {
                sum.albedo += walk.throughput * material.reflectance;
                sum.normal += surface.ns * sign_not_zero(-dot(walk.direction, surface.ng));
                sum.depth += path_length * frame.world_per_unit;
                sum.hits += 1u;
                break;
            }
            if !walk_scatter(&walk, surface, material, rng_next(&rng), false) {
                break;
            }
        }
    }
    first_hits[row * tile.width_px + column] = sum;
}
