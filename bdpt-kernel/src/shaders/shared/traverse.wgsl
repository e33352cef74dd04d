// Nearest hit or any hit of a ray: compressed eight-wide hierarchy (Ylitie et al. 2017, in obvhs' layout of interleaved
// lows and highs), Moeller-Trumbore on f32 triangles. Twin: src/twin/traverse.rs.

const NO_HIT: u32 = 0xffffffffu;
const NODE_WORDS: u32 = 5u;
// One entry a level; the packer refuses deeper hierarchies.
const STACK_SIZE: u32 = 32u;
// Far above the nodes that a ray through a million triangles visits (hundreds): only a broken ray gets here.
const MAX_TRAVERSAL_STEPS: u32 = 8192u;
// Zero direction components in box tests: 1/eps stays finite.
const DIRECTION_EPSILON: f32 = 1.0e-18;
// Rounding of a slab's far end, so that boxes without thickness are not missed.
const SLAB_SLACK: f32 = 1.000001;
// Barycentric overlap of neighbours, so that no ray slips between.
const EDGE_SLACK: f32 = 1.0e-6;

struct Hit {
    t: f32,
    triangle: u32,
    u: f32,
    v: f32,
}

// Private, not function, memory: zeroed once per lane, not once per ray.
var<private> stack: array<vec2<u32>, 32>;

fn away_from_zero(v: f32) -> f32 {
    return select(v, select(DIRECTION_EPSILON, -DIRECTION_EPSILON, v < 0.0), abs(v) < DIRECTION_EPSILON);
}

fn bytes(word: u32) -> vec4<f32> {
    return vec4<f32>(f32(word & 0xffu), f32((word >> 8u) & 0xffu), f32((word >> 16u) & 0xffu), f32(word >> 24u));
}

// Four children of a node against the ray in the node's own units: bits of the hit mask.
fn children_hit(
    description: u32,
    octant: u32,
    low: vec3<u32>,
    high: vec3<u32>,
    scale: vec3<f32>,
    start: vec3<f32>,
    t_max: f32,
) -> u32 {
    let inner = (description & (description << 1u)) & 0x10101010u;
    let inner_mask = (inner >> 4u) * 0xffu;
    let bit_index = (description ^ (octant & inner_mask)) & 0x1f1f1f1fu;
    let bits = (description >> 5u) & 0x07070707u;
    let t_low_x = bytes(low.x) * scale.x + start.x;
    let t_low_y = bytes(low.y) * scale.y + start.y;
    let t_low_z = bytes(low.z) * scale.z + start.z;
    let t_high_x = bytes(high.x) * scale.x + start.x;
    let t_high_y = bytes(high.y) * scale.y + start.y;
    let t_high_z = bytes(high.z) * scale.z + start.z;
    let t_low = max(max(t_low_x, t_low_y), max(t_low_z, vec4<f32>(0.0)));
    let t_high = min(min(t_high_x, t_high_y), min(t_high_z, vec4<f32>(t_max))) * SLAB_SLACK;
    let hit = t_low <= t_high;
    var mask = 0u;
    if hit.x {
        mask |= (bits & 0xffu) << (bit_index & 0x1fu);
    }
    if hit.y {
        mask |= ((bits >> 8u) & 0xffu) << ((bit_index >> 8u) & 0x1fu);
    }
    if hit.z {
        mask |= ((bits >> 16u) & 0xffu) << ((bit_index >> 16u) & 0x1fu);
    }
    if hit.w {
        mask |= (bits >> 24u) << (bit_index >> 24u);
    }
    return mask;
}

// Nearest hit in 0 < t < t_max, or with `any` the first found. `direction` need not be a unit vector.
fn trace(origin: vec3<f32>, direction: vec3<f32>, t_max: f32, any: bool) -> Hit {
    var hit = Hit(t_max, NO_HIT, 0.0, 0.0);
    let d = vec3<f32>(away_from_zero(direction.x), away_from_zero(direction.y), away_from_zero(direction.z));
    let inverse = 1.0 / d;
    let octant = select(0x04040404u, 0u, d.x < 0.0) | select(0x02020202u, 0u, d.y < 0.0)
        | select(0x01010101u, 0u, d.z < 0.0);
    var group = vec2<u32>(0u, 0x80000000u);
    var depth = 0u;
    var steps = 0u;
    loop {
        steps += 1u;
        if steps > MAX_TRAVERSAL_STEPS {
            atomicAdd(&counters.traversals_cut, 1u);
            break;
        }
        // The child of the group that comes first along the ray; the rest waits on the stack.
        let bit = firstLeadingBit(group.y);
        let slot = (bit - 24u) ^ (octant & 0xffu);
        let index = group.x + countOneBits(group.y & ~(0xffffffffu << slot));
        group.y &= ~(1u << bit);
        if group.y > 0x00ffffffu {
            if depth < STACK_SIZE {
                stack[depth] = group;
                depth += 1u;
            } else {
                atomicAdd(&counters.stack_overflows, 1u);
            }
        }
        let n0 = nodes[index * NODE_WORDS];
        let n1 = nodes[index * NODE_WORDS + 1u];
        let n2 = nodes[index * NODE_WORDS + 2u];
        let n3 = nodes[index * NODE_WORDS + 3u];
        let n4 = nodes[index * NODE_WORDS + 4u];
        let extent = vec3<f32>(
            bitcast<f32>((n0.w & 0xffu) << 23u),
            bitcast<f32>(((n0.w >> 8u) & 0xffu) << 23u),
            bitcast<f32>(((n0.w >> 16u) & 0xffu) << 23u),
        );
        let scale = extent * inverse;
        let start = (bitcast<vec3<f32>>(n0.xyz) - origin) * inverse;
        let x = select(n2, n2.zwxy, d.x < 0.0);
        let y = select(n3, n3.zwxy, d.y < 0.0);
        let z = select(n4, n4.zwxy, d.z < 0.0);
        let first_low = vec3<u32>(x.x, y.x, z.x);
        let first_high = vec3<u32>(x.z, y.z, z.z);
        let second_low = vec3<u32>(x.y, y.y, z.y);
        let second_high = vec3<u32>(x.w, y.w, z.w);
        let mask = children_hit(n1.z, octant, first_low, first_high, scale, start, hit.t)
            | children_hit(n1.w, octant, second_low, second_high, scale, start, hit.t);
        group = vec2<u32>(n1.x, (mask & 0xff000000u) | (n0.w >> 24u));
        var leaf = mask & 0x00ffffffu;
        while leaf != 0u {
            let first = firstTrailingBit(leaf);
            leaf &= leaf - 1u;
            intersect(n1.y + first, origin, direction, &hit);
        }
        if any && hit.triangle != NO_HIT {
            break;
        }
        if group.y <= 0x00ffffffu {
            if depth == 0u {
                break;
            }
            depth -= 1u;
            group = stack[depth];
        }
    }
    return hit;
}

fn intersect(triangle: u32, origin: vec3<f32>, direction: vec3<f32>, hit: ptr<function, Hit>) {
    let v0 = triangles[triangle * 3u].xyz;
    let e1 = triangles[triangle * 3u + 1u].xyz;
    let e2 = triangles[triangle * 3u + 2u].xyz;
    let p = cross(direction, e2);
    let determinant = dot(e1, p);
    if determinant == 0.0 {
        return;
    }
    let inverse = 1.0 / determinant;
    let s = origin - v0;
    let u = dot(s, p) * inverse;
    let q = cross(s, e1);
    let v = dot(direction, q) * inverse;
    let t = dot(e2, q) * inverse;
    if u >= -EDGE_SLACK && v >= -EDGE_SLACK && u + v <= 1.0 + EDGE_SLACK && t > 0.0 && t < (*hit).t {
        *hit = Hit(t, triangle, u, v);
    }
}
