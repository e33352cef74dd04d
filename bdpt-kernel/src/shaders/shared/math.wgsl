// Vectors, their octahedral form, sampling of hemisphere, sphere, disk and triangle. Twin: src/twin/math.rs.

const PI: f32 = 3.14159265358979;
const INFINITE: f32 = 3.0e38;

// On bits: compilers may fold x != x.
fn is_finite(v: vec3<f32>) -> bool {
    let exponents = bitcast<vec3<u32>>(v) & vec3<u32>(0x7f800000u);
    return exponents.x != 0x7f800000u && exponents.y != 0x7f800000u && exponents.z != 0x7f800000u;
}

fn luminance(rgb: vec3<f32>) -> f32 {
    return dot(rgb, vec3<f32>(0.212671, 0.715160, 0.072169));
}

fn max_component(v: vec3<f32>) -> f32 {
    return max(v.x, max(v.y, v.z));
}

fn sign_not_zero(v: f32) -> f32 {
    return select(1.0, -1.0, v < 0.0);
}

// Unit vector in 2 x 16 bits (Meyer et al. 2010).
fn encode_octahedral(n: vec3<f32>) -> u32 {
    let p = n / (abs(n.x) + abs(n.y) + abs(n.z));
    var x = p.x;
    var y = p.y;
    if p.z < 0.0 {
        x = (1.0 - abs(p.y)) * sign_not_zero(p.x);
        y = (1.0 - abs(p.x)) * sign_not_zero(p.y);
    }
    let qx = u32(clamp((x * 0.5 + 0.5) * 65535.0 + 0.5, 0.0, 65535.0));
    let qy = u32(clamp((y * 0.5 + 0.5) * 65535.0 + 0.5, 0.0, 65535.0));
    return qx | (qy << 16u);
}

fn decode_octahedral(bits: u32) -> vec3<f32> {
    let x = f32(bits & 0xffffu) * (2.0 / 65535.0) - 1.0;
    let y = f32(bits >> 16u) * (2.0 / 65535.0) - 1.0;
    let z = 1.0 - abs(x) - abs(y);
    if z < 0.0 {
        return normalize(vec3<f32>((1.0 - abs(y)) * sign_not_zero(x), (1.0 - abs(x)) * sign_not_zero(y), z));
    }
    return normalize(vec3<f32>(x, y, z));
}

// From the frame whose z axis is n to the world (Duff et al. 2017).
fn to_world(n: vec3<f32>, v: vec3<f32>) -> vec3<f32> {
    let s = sign_not_zero(n.z);
    let a = -1.0 / (s + n.z);
    let b = n.x * n.y * a;
    let tangent = vec3<f32>(1.0 + s * n.x * n.x * a, s * b, -s * n.x);
    let bitangent = vec3<f32>(b, s + n.y * n.y * a, -n.y);
    return tangent * v.x + bitangent * v.y + n * v.z;
}

// Cosine-weighted around +z; pdf_solid_angle = z / pi. z > 0 because u < 1.
fn sample_cosine_hemisphere(u: vec2<f32>) -> vec3<f32> {
    let r = sqrt(u.x);
    let phi = 2.0 * PI * u.y;
    return vec3<f32>(r * cos(phi), r * sin(phi), sqrt(1.0 - u.x));
}

// pdf_solid_angle = 1 / (4 pi).
fn sample_sphere(u: vec2<f32>) -> vec3<f32> {
    let z = 1.0 - 2.0 * u.x;
    let r = sqrt(max(0.0, 1.0 - z * z));
    let phi = 2.0 * PI * u.y;
    return vec3<f32>(r * cos(phi), r * sin(phi), z);
}

// Unit disk; pdf_area = 1 / pi.
fn sample_disk(u: vec2<f32>) -> vec2<f32> {
    let r = sqrt(u.x);
    let phi = 2.0 * PI * u.y;
    return vec2<f32>(r * cos(phi), r * sin(phi));
}

// Barycentric weights of the second and third corner; uniform in area.
fn sample_triangle(u: vec2<f32>) -> vec2<f32> {
    let r = sqrt(u.x);
    return vec2<f32>(r * (1.0 - u.y), r * u.y);
}
