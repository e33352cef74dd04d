// c = a * b for square matrices whose edge is a multiple of 64, row by row.
@group(0) @binding(0) var<storage, read> a: array<vec4f>;
@group(0) @binding(1) var<storage, read> b: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> c: array<vec4f>;

// 64 rows of 16 columns of a, and 16 rows of 64 columns of b, four columns an element.
var<workgroup> tile_a: array<vec4f, 256>;
var<workgroup> tile_b: array<vec4f, 256>;

@compute @workgroup_size(256)
fn product(
    @builtin(workgroup_id) tile: vec3u,
    @builtin(num_workgroups) tiles: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let edge4 = tiles.x * 16u; // elements of four in a row
    let column4 = local % 16u; // this invocation makes rows 4 * row4 .. +4 of column group column4
    let row4 = local / 16u;
    var sum0 = vec4f();
    var sum1 = vec4f();
    var sum2 = vec4f();
    var sum3 = vec4f();
    for (var k4 = 0u; k4 < edge4; k4 += 4u) {
        tile_a[local] = a[(tile.y * 64u + local / 4u) * edge4 + k4 + local % 4u];
        tile_b[local] = b[(k4 * 4u + local / 16u) * edge4 + tile.x * 16u + local % 16u];
        workgroupBarrier();
        for (var k = 0u; k < 4u; k++) {
            let a0 = tile_a[(row4 * 4u + 0u) * 4u + k];
            let a1 = tile_a[(row4 * 4u + 1u) * 4u + k];
            let a2 = tile_a[(row4 * 4u + 2u) * 4u + k];
            let a3 = tile_a[(row4 * 4u + 3u) * 4u + k];
            let b0 = tile_b[(k * 4u + 0u) * 16u + column4];
            let b1 = tile_b[(k * 4u + 1u) * 16u + column4];
            let b2 = tile_b[(k * 4u + 2u) * 16u + column4];
            let b3 = tile_b[(k * 4u + 3u) * 16u + column4];
            sum0 += a0.x * b0 + a0.y * b1 + a0.z * b2 + a0.w * b3;
            sum1 += a1.x * b0 + a1.y * b1 + a1.z * b2 + a1.w * b3;
            sum2 += a2.x * b0 + a2.y * b1 + a2.z * b2 + a2.w * b3;
            sum3 += a3.x * b0 + a3.y * b1 + a3.z * b2 + a3.w * b3;
        }
        workgroupBarrier();
    }
    let first = (tile.y * 64u + row4 * 4u) * edge4 + tile.x * 16u + column4;
    c[first] = sum0;
    c[first + edge4] = sum1;
    c[first + 2u * edge4] = sum2;
    c[first + 3u * edge4] = sum3;
}
