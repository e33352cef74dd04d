//! Programs of the jobs are sound by the farm's own check, and what cannot be rendered gets an error that says why.

mod boxes;

use bdpt_kernel::{
    bvh::{BuildQuality, Bvh},
    gpu::{
        DecodeError, FrameError, FrameParams, LightJob, NormalisedScene, PackError, PackedScene,
        RenderOptions, SceneContents, TileJob, layout,
    },
    scene::model::{Bsdf, Camera, FilmSize, Scene},
};
use boxes::{Builder, Furniture};
use farm_core::{
    id::ContentHash,
    program::{Command, Content, DispatchError, JobProgram, ProgramQuota, validate},
};
use glam::Vec3;

const TILE: TileJob =
    TileJob { x_px: 64, y_px: 0, width_px: 64, height_px: 64, first_sample: 0, samples: 100, seed: 1 };

fn film(width_px: u32, height_px: u32) -> FilmSize {
    FilmSize { width_px, height_px }
}

fn contents(packed: &PackedScene) -> SceneContents {
    let name = |index: u8, bytes: usize| Content { hash: ContentHash([index; 32]), size_bytes: bytes as u64 };
    SceneContents {
        nodes: name(0, packed.nodes.len()),
        triangles: name(1, packed.triangles.len()),
        shading: name(2, packed.shading.len()),
        materials: name(3, packed.materials.len()),
        lights: name(4, packed.lights.len()),
        module: name(5, bdpt_kernel::gpu::module_source().len()),
    }
}

fn pack(scene: &Scene) -> Result<PackedScene, PackError> {
    let normalised = NormalisedScene::new(scene);
    let bvh = Bvh::build(&normalised.scene().triangles, BuildQuality::Fast);
    PackedScene::new(&normalised, &bvh)
}

fn room() -> PackedScene {
    pack(&boxes::room(Furniture::Block)).expect("the room can be packed")
}

fn is_application(result: &Result<(), DispatchError>, words: &str) -> bool {
    matches!(result, Err(DispatchError::Application(reason)) if reason.contains(words))
}

#[test]
fn a_tile_of_full_hd_is_a_valid_program_of_bounded_bindings() {
    let packed = room();
    let frame =
        FrameParams::new(&packed, film(1920, 1152), RenderOptions::default()).expect("full HD is sound");
    let mut program = JobProgram::default();
    TILE.program(&contents(&packed), &frame, &mut program).expect("the tile lies in the image");
    let summary = validate(&program, &ProgramQuota::default()).expect("the program is valid");
    let pixels = 64 * 64;
    assert_eq!(summary.sections, [pixels * 32, pixels * 48, 32], "pixels, first hits, counters");
    assert!(
        summary.largest_binding_bytes <= 128 << 20,
        "lavapipe's limit: {}",
        summary.largest_binding_bytes
    );
    let launches: Vec<u32> = program
        .commands()
        .iter()
        .filter_map(|c| match c {
            Command::Launch { groups, slicing: Some(slicing), .. } => {
                assert!(
                    slicing.max_groups_z <= groups[2].max(64),
                    "no more slots in a run than the scratch holds"
                );
                Some(groups[2])
            }
            _ => None,
        })
        .collect();
    assert_eq!(launches, [64, 36], "a hundred samples in launches of at most 64 slots");
    assert_eq!(
        summary.cost.0 / 1_000_000,
        410,
        "a million samples a second at speed 1.0, and the first hits"
    );
}

#[test]
fn a_light_job_is_a_valid_program() {
    let packed = room();
    let frame =
        FrameParams::new(&packed, film(1920, 1152), RenderOptions::default()).expect("full HD is sound");
    let mut program = JobProgram::default();
    let job = LightJob { first_path: 1 << 40, paths: 3_000_000, seed: 1 };
    job.program(&contents(&packed), &frame, &mut program).expect("the range is sound");
    let summary = validate(&program, &ProgramQuota::default()).expect("the program is valid");
    assert_eq!(summary.sections, [1920 * 1152 * 12, 32], "a full frame and the counters");
    assert!(summary.largest_binding_bytes <= 128 << 20, "lavapipe's limit");
}

#[test]
fn jobs_out_of_range_are_refused() {
    let packed = room();
    let scene = contents(&packed);
    let frame =
        FrameParams::new(&packed, film(128, 64), RenderOptions::default()).expect("the frame is sound");
    let tile = |job: TileJob| job.program(&scene, &frame, &mut JobProgram::default());
    assert!(tile(TILE).is_ok(), "the last tile of the row");
    assert!(is_application(&tile(TileJob { x_px: 65, ..TILE }), "inside the image of 128x64"));
    assert!(is_application(&tile(TileJob { y_px: u32::MAX, ..TILE }), "inside the image"));
    assert!(is_application(&tile(TileJob { width_px: 0, ..TILE }), "must have 1..="));
    assert!(is_application(&tile(TileJob { samples: 0, ..TILE }), "samples 0..+0"));
    assert!(is_application(&tile(TileJob { first_sample: u32::MAX, ..TILE }), "end below 2^32"));
    let light = |job: LightJob| job.program(&scene, &frame, &mut JobProgram::default());
    assert!(is_application(&light(LightJob { first_path: 0, paths: 0, seed: 1 }), "must be 1..="));
    assert!(is_application(&light(LightJob { first_path: u64::MAX, paths: 2, seed: 1 }), "end below 2^64"));
    assert!(is_application(&light(LightJob { first_path: 0, paths: u32::MAX, seed: 1 }), "must be 1..="));
}

#[test]
fn frames_out_of_range_are_refused() {
    let packed = room();
    let frame = |size, options| FrameParams::new(&packed, size, options);
    let plain = RenderOptions::default();
    assert_eq!(frame(film(0, 5), plain), Err(FrameError::Size { width_px: 0, height_px: 5 }));
    assert!(
        matches!(frame(film(70_000, 70_000), plain), Err(FrameError::Size { .. })),
        "more than a binding holds"
    );
    assert_eq!(frame(film(8, 8), RenderOptions { max_edges: 17, ..plain }), Err(FrameError::MaxEdges(17)));
    assert_eq!(frame(film(8, 8), RenderOptions { max_edges: 0, ..plain }), Err(FrameError::MaxEdges(0)));
    assert_eq!(frame(film(8, 8), RenderOptions { roulette_edges: 0, ..plain }), Err(FrameError::Zero));
    let blind = |camera: Camera| {
        let scene = Scene { camera, ..boxes::room(Furniture::Block) };
        let packed = pack(&scene).expect("the geometry is sound");
        FrameParams::new(&packed, film(8, 8), plain)
    };
    let camera = boxes::camera_in_room();
    assert_eq!(blind(Camera { target: camera.eye, ..camera }), Err(FrameError::Camera));
    assert_eq!(blind(Camera { up: camera.target - camera.eye, ..camera }), Err(FrameError::Camera));
    assert_eq!(blind(Camera { hfov_deg: 180.0, ..camera }), Err(FrameError::Camera));
    assert_eq!(blind(Camera { hfov_deg: f32::NAN, ..camera }), Err(FrameError::Camera));
}

#[test]
fn scenes_that_cannot_be_rendered_are_refused() {
    let nothing = Builder::new().finish(boxes::camera_in_room(), Some(Vec3::ONE));
    assert_eq!(pack(&nothing).err(), Some(PackError::NoTriangle));
    let mut dark = boxes::room(Furniture::Block);
    dark.materials.iter_mut().for_each(|m| m.emission = Vec3::ZERO);
    assert_eq!(pack(&dark).err(), Some(PackError::NoLight));
    dark.environment = Some(Vec3::ZERO);
    assert_eq!(pack(&dark).err(), Some(PackError::NoLight), "a black sky is no light");
    dark.environment = Some(Vec3::ONE);
    assert!(pack(&dark).is_ok(), "a sky is one");
    let mut stray = boxes::room(Furniture::Block);
    stray.triangles[3].material = 99;
    assert_eq!(
        pack(&stray).err(),
        Some(PackError::UnknownMaterial { triangle: 3, material: 99, materials: 4 })
    );
    let normalised = NormalisedScene::new(&boxes::room(Furniture::Block));
    let foreign = Bvh::build(&normalised.scene().triangles[..5], BuildQuality::Fast);
    assert!(matches!(PackedScene::new(&normalised, &foreign), Err(PackError::ForeignHierarchy(_))));
}

#[test]
fn results_of_another_shape_are_refused() {
    let none: [Vec<u8>; 0] = [];
    assert_eq!(TILE.decode(&none).err(), Some(DecodeError::SectionCount { expected: 3, got: 0 }));
    let pixels = 64 * 64;
    let mut sections = [vec![0_u8; pixels * 32], vec![0; pixels * 48], vec![0; 32]];
    assert!(TILE.decode(&sections).is_ok(), "the right shape decodes");
    sections[1].pop();
    let expected = pixels * 48;
    assert_eq!(
        TILE.decode(&sections).err(),
        Some(DecodeError::SectionSize { section: 1, expected, got: expected - 1 })
    );
}

#[test]
fn scenes_of_any_scale_come_to_kernel_units() {
    for scale in [1e-4_f32, 0.3, 1.0, 77.0, 1e6] {
        let mut scene = boxes::room(Furniture::Block);
        let shift = Vec3::new(5.0, -3.0, 2.0) * scale;
        for triangle in &mut scene.triangles {
            triangle.positions = triangle.positions.map(|p| p * scale + shift);
        }
        let normalised = NormalisedScene::new(&scene);
        let radius = normalised.radius();
        assert!(radius > 2.0 && radius <= 4.0, "scale {scale}: radius {radius}");
        assert_eq!(normalised.world_per_unit().log2().fract(), 0.0, "a power of two rounds nothing");
        let far = normalised
            .scene()
            .triangles
            .iter()
            .flat_map(|t| t.positions)
            .map(Vec3::length)
            .fold(0.0, f32::max);
        assert!(
            (far / radius - 1.0).abs() < 1e-3,
            "scale {scale}: the sphere around the origin fits: {far}, {radius}"
        );
    }
}

#[test]
fn lights_are_drawn_by_power_and_sum_to_one() {
    let mut b = Builder::new();
    let grey = b.diffuse([0.5; 3]);
    let dim = b.material(Bsdf::Diffuse { reflectance: Vec3::ZERO }, Vec3::splat(1.0));
    let bright = b.material(Bsdf::Diffuse { reflectance: Vec3::ZERO }, Vec3::splat(9.0));
    b.quad(Vec3::ZERO, Vec3::X, Vec3::Y, grey);
    b.quad(Vec3::Z, Vec3::X, Vec3::Y, dim);
    b.quad(Vec3::Z * 2.0, Vec3::X, Vec3::Y, bright);
    let packed =
        pack(&b.finish(boxes::camera_in_room(), Some(Vec3::splat(1e-3)))).expect("the scene can be packed");
    let lights: Vec<layout::Light> = bytemuck::pod_collect_to_vec(&packed.lights);
    assert_eq!(lights.len(), 5, "four triangles and the sky");
    let sum: f32 = lights.iter().map(|l| l.pl).sum();
    assert!((sum - 1.0).abs() < 1e-6, "probabilities sum to {sum}");
    assert!((lights[2].pl / lights[0].pl - 9.0).abs() < 1e-4, "nine times the radiance, nine times as often");
    // What the alias table's columns give each light is its probability.
    let mut drawn = vec![0.0_f32; lights.len()];
    for (own, light) in lights.iter().enumerate() {
        drawn[own] += light.alias_threshold / 5.0;
        drawn[light.alias_index as usize] += (1.0 - light.alias_threshold) / 5.0;
    }
    for (light, drawn) in lights.iter().zip(drawn) {
        assert!((light.pl - drawn).abs() < 1e-6, "{} is drawn {drawn}", light.pl);
    }
}
