// Everything that crosses between host and device: structs, bindings, limits. Twin: src/gpu/layout.rs.

const BLOCK_EDGE_PX: u32 = 8u;
const GROUP_LANES: u32 = 64u;
const MAX_LIGHT_VERTICES: u32 = 14u;

// The shading normal is the face's (bit of Shading.material).
const FLAT: u32 = 0x80000000u;

const DIFFUSE: u32 = 0u;
const MIRROR: u32 = 1u;
const DIELECTRIC: u32 = 2u;

const AREA: u32 = 0u;
const ENVIRONMENT: u32 = 1u;

struct Shading {
    normals: array<u32, 3>,
    material: u32,
}

struct Material {
    reflectance: vec3<f32>,
    kind: u32,
    emission: vec3<f32>,
    ior: f32,
}

struct Light {
    v0: vec3<f32>,
    alias_threshold: f32,
    e1: vec3<f32>,
    alias_index: u32,
    e2: vec3<f32>,
    kind: u32,
    radiance: vec3<f32>,
    pl: f32,
}

struct Frame {
    eye: vec3<f32>,
    d_img: f32,
    right: vec3<f32>,
    width_px: u32,
    up: vec3<f32>,
    height_px: u32,
    forward: vec3<f32>,
    nl: f32,
    environment: vec3<f32>,
    environment_pl: f32,
    center: vec3<f32>,
    radius: f32,
    light_count: u32,
    max_edges: u32,
    connect: f32,
    splat: f32,
    splat_unit: f32,
    roulette_edges: u32,
    connection_threshold: f32,
    area_pdf_scale: f32,
    world_per_unit: f32,
}

struct Tile {
    x_px: u32,
    y_px: u32,
    width_px: u32,
    height_px: u32,
    first_sample: u32,
    slots: u32,
    seed_lo: u32,
    seed_hi: u32,
    scratch_lanes: u32,
    first_hit_samples: u32,
    padding_0: u32,
    padding_1: u32,
}

struct LightRange {
    first_path_lo: u32,
    first_path_hi: u32,
    paths: u32,
    groups_x: u32,
    seed_lo: u32,
    seed_hi: u32,
    padding_0: u32,
    padding_1: u32,
}

struct SlotSum {
    rgb: vec3<f32>,
    luminance: f32,
    luminance_squared: f32,
    count: u32,
    rays: u32,
    padding: u32,
}

struct FirstHitSum {
    albedo: vec3<f32>,
    samples: u32,
    normal: vec3<f32>,
    depth: f32,
    hits: u32,
    padding_0: u32,
    padding_1: u32,
    padding_2: u32,
}

struct Counters {
    traversals_cut: atomic<u32>,
    stack_overflows: atomic<u32>,
    non_finite: atomic<u32>,
    splat_overflows: atomic<u32>,
    paths_cut: atomic<u32>,
    rays: atomic<u32>,
    padding_0: u32,
    padding_1: u32,
}

@group(0) @binding(0) var<storage, read> nodes: array<vec4<u32>>;
@group(0) @binding(1) var<storage, read> triangles: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> shading: array<Shading>;
@group(0) @binding(3) var<storage, read> materials: array<Material>;
@group(0) @binding(4) var<storage, read> lights: array<Light>;
@group(0) @binding(5) var<storage, read_write> counters: Counters;

// Light vertices of the lanes of one run, [vertex][lane], in three arrays so that each fits a small binding.
@group(0) @binding(6) var<storage, read_write> vertex_a: array<vec4<u32>>;
@group(0) @binding(7) var<storage, read_write> vertex_b: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> vertex_c: array<vec4<u32>>;

@group(0) @binding(9) var<storage, read_write> slot_sums: array<SlotSum>;
@group(0) @binding(10) var<storage, read_write> pixel_sums: array<SlotSum>;
@group(0) @binding(11) var<storage, read_write> first_hits: array<FirstHitSum>;

// 32.32 fixed point per pixel: low word, high word.
@group(0) @binding(12) var<storage, read_write> splat_red: array<atomic<u32>>;
@group(0) @binding(13) var<storage, read_write> splat_green: array<atomic<u32>>;
@group(0) @binding(14) var<storage, read_write> splat_blue: array<atomic<u32>>;
@group(0) @binding(15) var<storage, read_write> splat_layer: array<f32>;

@group(1) @binding(0) var<uniform> frame: Frame;
@group(1) @binding(1) var<uniform> tile: Tile;
@group(1) @binding(2) var<uniform> light_range: LightRange;
// Written by the executor before each run of a cut launch: the run's first workgroup_id.z.
@group(1) @binding(3) var<uniform> first_slot: u32;
