//! Everything that crosses between host and device, byte for byte. The tests compare each struct with the offsets that
//! naga finds in the WGSL text.

use bytemuck::{Pod, Zeroable};

/// Storage bindings of the module, one number per array over all its kernels.
pub mod binding {
    /// `nodes`: the wide hierarchy, five `vec4<u32>` a node.
    pub const NODES: u32 = 0;
    /// `triangles`: three `vec4<f32>` a triangle in leaf order.
    pub const TRIANGLES: u32 = 1;
    /// `shading`: one [`super::Shading`] a triangle in leaf order.
    pub const SHADING: u32 = 2;
    /// `materials`.
    pub const MATERIALS: u32 = 3;
    /// `lights`.
    pub const LIGHTS: u32 = 4;
    /// `counters`: [`super::Counters`].
    pub const COUNTERS: u32 = 5;
    /// `vertex_a`: light vertices, position and geometric normal.
    pub const VERTEX_A: u32 = 6;
    /// `vertex_b`: light vertices, throughput and dVCM.
    pub const VERTEX_B: u32 = 7;
    /// `vertex_c`: light vertices, shading normal, incoming direction, material and edges, dVC.
    pub const VERTEX_C: u32 = 8;
    /// `slot_sums`: one [`super::SlotSum`] per pixel and slot.
    pub const SLOT_SUMS: u32 = 9;
    /// `pixel_sums`: one [`super::SlotSum`] per pixel.
    pub const PIXEL_SUMS: u32 = 10;
    /// `first_hits`: one [`super::FirstHitSum`] per pixel.
    pub const FIRST_HITS: u32 = 11;
    /// `splat_red`: 32.32 fixed point per pixel, low word first.
    pub const SPLAT_RED: u32 = 12;
    /// `splat_green`.
    pub const SPLAT_GREEN: u32 = 13;
    /// `splat_blue`.
    pub const SPLAT_BLUE: u32 = 14;
    /// `splat_layer`: three `f32` per pixel.
    pub const SPLAT_LAYER: u32 = 15;
}

/// Lanes of a workgroup of the tracing kernels: a block of 8 by 8 pixels.
pub const BLOCK_EDGE_PX: u32 = 8;
/// Lanes of every workgroup.
pub const GROUP_LANES: u32 = 64;
/// Longest path in edges; the image equals Mitsuba's `max_depth` 16 (50-bdpt.md section 3, trap 1).
pub const MAX_EDGES: u32 = 16;
/// Most light vertices that a lane stores: connections need a camera vertex, an eye vertex and the edge between, so the
/// light subpath has at most `MAX_EDGES - 2` surface vertices.
pub const MAX_LIGHT_VERTICES: u32 = MAX_EDGES - 2;

/// `Shading` in WGSL: what a hit needs besides the corners. 16 B.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
pub struct Shading {
    /// Octahedral shading normals at the corners.
    pub normals: [u32; 3],
    /// Index of the material; bit 31 set where the shading normal is the face's.
    pub material: u32,
}

/// In [`Shading::material`]: the shading normal is the geometric one.
pub const FLAT: u32 = 1 << 31;

/// [`Material::kind`]: Lambertian.
pub const DIFFUSE: u32 = 0;
/// [`Material::kind`]: perfect reflector.
pub const MIRROR: u32 = 1;
/// [`Material::kind`]: smooth glass.
pub const DIELECTRIC: u32 = 2;

/// `Material` in WGSL. 32 B.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct Material {
    /// Albedo or reflectance; 1 for glass.
    pub reflectance: [f32; 3],
    /// [`DIFFUSE`], [`MIRROR`] or [`DIELECTRIC`].
    pub kind: u32,
    /// Radiance from the counter-clockwise face.
    pub emission: [f32; 3],
    /// Index of refraction inside; 1 where it means nothing.
    pub ior: f32,
}

/// [`Light::kind`]: an emitting triangle.
pub const AREA: u32 = 0;
/// [`Light::kind`]: the constant environment.
pub const ENVIRONMENT: u32 = 1;

/// `Light` in WGSL: a light and its entry of the alias table (Walker 1977; Vose 1991). 64 B.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct Light {
    /// First corner.
    pub v0: [f32; 3],
    /// Below this the column's own light is taken, else its alias.
    pub alias_threshold: f32,
    /// Edge to the second corner.
    pub e1: [f32; 3],
    /// The column's other light.
    pub alias_index: u32,
    /// Edge to the third corner.
    pub e2: [f32; 3],
    /// [`AREA`] or [`ENVIRONMENT`].
    pub kind: u32,
    /// Emitted radiance.
    pub radiance: [f32; 3],
    /// Probability of this light, Pl.
    pub pl: f32,
}

/// `Frame` in WGSL, the uniform `frame`: what all jobs of one image share. Lengths in scene units after normalisation.
/// 144 B.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct Frame {
    /// Camera position.
    pub eye: [f32; 3],
    /// Distance to the image plane in pixels: W / (2 tan(hfov/2)).
    pub d_img: f32,
    /// Camera's right, unit.
    pub right: [f32; 3],
    /// Columns of the whole image.
    pub width_px: u32,
    /// Camera's up, unit.
    pub up: [f32; 3],
    /// Rows of the whole image.
    pub height_px: u32,
    /// View axis, unit.
    pub forward: [f32; 3],
    /// Light subpaths per eye sample in every pixel: W*H, always of the whole image (trap 3).
    pub nl: f32,
    /// Radiance of the environment.
    pub environment: [f32; 3],
    /// Probability of the environment among the lights; 0 without one.
    pub environment_pl: f32,
    /// Centre of the bounding sphere.
    pub center: [f32; 3],
    /// Radius of the bounding sphere.
    pub radius: f32,
    /// Lights in the table.
    pub light_count: u32,
    /// Longest path in edges, 1..=16.
    pub max_edges: u32,
    /// 1 when light subpaths are connected (s >= 2), 0 for plain path tracing.
    pub connect: f32,
    /// 1 when a light image exists (t = 1), else 0.
    pub splat: f32,
    /// One unit of the splats' fixed point, radiance.
    pub splat_unit: f32,
    /// Edges before roulette starts.
    pub roulette_edges: u32,
    /// Luminance under which a connection's shadow ray plays roulette; 0 never.
    pub connection_threshold: f32,
    /// Area-light density over luminance: `dirPdfA = luminance(Le) * area_pdf_scale`.
    pub area_pdf_scale: f32,
    /// World units per scene unit.
    pub world_per_unit: f32,
    /// Padding to 16 B.
    pub padding: [u32; 3],
}

/// `Tile` in WGSL, the uniform `tile`. 48 B.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
pub struct Tile {
    /// Left column in the image.
    pub x_px: u32,
    /// Top row in the image.
    pub y_px: u32,
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Sample number of slot 0 in this launch.
    pub first_sample: u32,
    /// Slots of the tile, the stride of `slot_sums` being one pixel.
    pub slots: u32,
    /// Low half of the seed.
    pub seed_lo: u32,
    /// High half of the seed.
    pub seed_hi: u32,
    /// Lanes that the scratch is sized for, its stride between vertices.
    pub scratch_lanes: u32,
    /// Samples averaged into the first hits.
    pub first_hit_samples: u32,
    /// Padding to 16 B.
    pub padding: [u32; 2],
}

/// `LightRange` in WGSL, the uniform `light_range`. 32 B.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
pub struct LightRange {
    /// Low half of the first path's index.
    pub first_path_lo: u32,
    /// High half of the first path's index.
    pub first_path_hi: u32,
    /// Paths of the job.
    pub paths: u32,
    /// Workgroups in x.
    pub groups_x: u32,
    /// Low half of the seed.
    pub seed_lo: u32,
    /// High half of the seed.
    pub seed_hi: u32,
    /// Padding to 16 B.
    pub padding: [u32; 2],
}

/// `SlotSum` in WGSL: sums over the samples of one slot, or of a pixel. 32 B.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct SlotSum {
    /// Sum of the samples' radiance, linear RGB.
    pub rgb: [f32; 3],
    /// Sum of the samples' luminance.
    pub luminance: f32,
    /// Sum of the samples' squared luminance.
    pub luminance_squared: f32,
    /// Samples.
    pub count: u32,
    /// Rays traced.
    pub rays: u32,
    /// Padding to 16 B.
    pub padding: u32,
}

/// `FirstHitSum` in WGSL: sums over the first-hit samples of a pixel. 48 B.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct FirstHitSum {
    /// Sum of albedo over the samples; a miss adds nothing.
    pub albedo: [f32; 3],
    /// Samples.
    pub samples: u32,
    /// Sum of shading normals over the hits, each facing the camera.
    pub normal: [f32; 3],
    /// Sum of distances along the path over the hits, in world units.
    pub depth: f32,
    /// Samples that hit a surface.
    pub hits: u32,
    /// Padding to 16 B.
    pub padding: [u32; 3],
}

/// `Counters` in WGSL: what a device had to cut or drop; all zero in a sound render, save `rays`. 32 B.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct Counters {
    /// Rays whose traversal ran into its step limit.
    pub traversals_cut: u32,
    /// Rays whose traversal stack was full.
    pub stack_overflows: u32,
    /// Contributions dropped because they were infinite or not a number.
    pub non_finite: u32,
    /// Splats that left the fixed-point range.
    pub splat_overflows: u32,
    /// Paths cut by the state machine's step limit.
    pub paths_cut: u32,
    /// Rays of a light job (tile jobs count theirs per pixel).
    pub rays: u32,
    /// Padding.
    pub padding: [u32; 2],
}

impl Counters {
    /// Faults, by name; empty in a sound render.
    #[must_use]
    pub fn faults(&self) -> Vec<(&'static str, u32)> {
        let named = [
            ("traversals cut", self.traversals_cut),
            ("traversal stack overflows", self.stack_overflows),
            ("non-finite contributions dropped", self.non_finite),
            ("splat overflows", self.splat_overflows),
            ("paths cut", self.paths_cut),
        ];
        named.into_iter().filter(|(_, count)| *count > 0).collect()
    }

    /// Adds another job's counts; a count that would wrap stays at its maximum.
    pub fn add(&mut self, other: &Self) {
        self.traversals_cut = self.traversals_cut.saturating_add(other.traversals_cut);
        self.stack_overflows = self.stack_overflows.saturating_add(other.stack_overflows);
        self.non_finite = self.non_finite.saturating_add(other.non_finite);
        self.splat_overflows = self.splat_overflows.saturating_add(other.splat_overflows);
        self.paths_cut = self.paths_cut.saturating_add(other.paths_cut);
        self.rays = self.rays.saturating_add(other.rays);
    }
}
