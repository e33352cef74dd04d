// Sums that end a job: slots of a pixel in order, fixed point to f32.

@compute @workgroup_size(64, 1, 1)
fn resolve_eye(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let pixels = tile.width_px * tile.height_px;
    let pixel = group.x * GROUP_LANES + local;
    if pixel >= pixels {
        return;
    }
    var sum = SlotSum(vec3<f32>(0.0), 0.0, 0.0, 0u, 0u, 0u);
    for (var slot = 0u; slot < tile.slots; slot += 1u) {
        let part = slot_sums[slot * pixels + pixel];
        sum.rgb += part.rgb;
        sum.luminance += part.luminance;
        sum.luminance_squared += part.luminance_squared;
        sum.count += part.count;
        sum.rays += part.rays;
    }
    pixel_sums[pixel] = sum;
}

@compute @workgroup_size(64, 1, 1)
fn resolve_splat(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let column = group.x * GROUP_LANES + local;
    if column >= frame.width_px {
        return;
    }
    let pixel = group.y * frame.width_px + column;
    let low = vec3<f32>(
        f32(atomicLoad(&splat_red[pixel * 2u])),
        f32(atomicLoad(&splat_green[pixel * 2u])),
        f32(atomicLoad(&splat_blue[pixel * 2u])),
    );
    let high = vec3<f32>(
        f32(atomicLoad(&splat_red[pixel * 2u + 1u])),
        f32(atomicLoad(&splat_green[pixel * 2u + 1u])),
        f32(atomicLoad(&splat_blue[pixel * 2u + 1u])),
    );
    let value = (high + low * (1.0 / 4294967296.0)) * (frame.splat_unit * frame.nl);
    splat_layer[pixel * 3u] = value.x;
    splat_layer[pixel * 3u + 1u] = value.y;
    splat_layer[pixel * 3u + 2u] = value.z;
}
