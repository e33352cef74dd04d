// What a hit becomes: position, normals, material. Twin: src/twin/surface.rs.

// Offset of ray ends along the geometric normal, for scenes of bounding radius 2 to 4: some 60 roundings of a position
// (trap 6).
const RAY_OFFSET: f32 = 3.0e-5;

struct Surface {
    position: vec3<f32>,
    ng: vec3<f32>,
    ns: vec3<f32>,
    material: u32,
}

fn surface_at(hit: Hit) -> Surface {
    let v0 = triangles[hit.triangle * 3u].xyz;
    let e1 = triangles[hit.triangle * 3u + 1u].xyz;
    let e2 = triangles[hit.triangle * 3u + 2u].xyz;
    let record = shading[hit.triangle];
    let position = v0 + e1 * hit.u + e2 * hit.v;
    let ng = normalize(cross(e1, e2));
    var ns = ng;
    if (record.material & FLAT) == 0u {
        let blend = decode_octahedral(record.normals[0]) * (1.0 - hit.u - hit.v)
            + decode_octahedral(record.normals[1]) * hit.u
            + decode_octahedral(record.normals[2]) * hit.v;
        let size = length(blend);
        if size > 1.0e-3 {
            // Both normals on one side, so that the winding alone tells the outside.
            ns = blend * (sign_not_zero(dot(blend, ng)) / size);
        }
    }
    return Surface(position, ng, ns, record.material & ~FLAT);
}

// A ray's end at a surface, moved to the side that `w` points to.
fn offset_along(position: vec3<f32>, ng: vec3<f32>, w: vec3<f32>) -> vec3<f32> {
    return position + ng * (RAY_OFFSET * sign_not_zero(dot(w, ng)));
}

// Whether both normals see `w` on the same side (50-bdpt.md section 1: else f = 0).
fn is_consistent(surface: Surface, w: vec3<f32>) -> bool {
    return dot(w, surface.ns) * dot(w, surface.ng) > 0.0;
}
