//! Scenes as users bring them, broken in every way we know: each gets an error that names the place, or a counted warning.

use std::{fs, path::Path};

use bdpt_kernel::scene::{self, LoadedScene, SceneError, model::Bsdf};
use glam::Vec3;
use tempfile::TempDir;

const SCENE: &str = "\
geometry = [\"a.obj\"]
[film]
width = 64
height = 48
[camera]
eye = [0, 0, 5]
target = [0, 0, 0]
up = [0, 1, 0]
hfov_deg = 40
[environment]
radiance = [1, 1, 1]
";
const OBJ: &str = "mtllib a.mtl\no square\nusemtl white\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n";
const MTL: &str = "newmtl white\nKd 0.5 0.5 0.5\n";

/// A folder of files by name.
fn folder(files: &[(&str, &[u8])]) -> TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder can be made");
    for (name, bytes) in files {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().expect("it lies in the folder")).expect("a folder can be made");
        fs::write(path, bytes).expect("a file can be written");
    }
    folder
}

fn scene_of(toml: &str, obj: &str, mtl: &str) -> Result<LoadedScene, SceneError> {
    let files = [("scene.toml", toml), ("a.obj", obj), ("a.mtl", mtl)];
    let folder = folder(&files.map(|(name, text)| (name, text.as_bytes())));
    scene::load(folder.path())
}

/// The message of a refused scene, with the temporary folder's name left out.
fn refused(files: &[(&str, &[u8])]) -> String {
    let folder = folder(files);
    match scene::load(&folder.path().join("scene.toml")) {
        Ok(loaded) => panic!("{files:?} was loaded: {:?}", loaded.report),
        Err(error) => error.to_string().replace(&format!("{}/", folder.path().display()), ""),
    }
}

fn refused_toml(toml: &str) -> String {
    refused(&[("scene.toml", toml.as_bytes()), ("a.obj", OBJ.as_bytes()), ("a.mtl", MTL.as_bytes())])
}

#[test]
fn a_scene_loads_by_file_and_by_folder() {
    let folder =
        folder(&[("scene.toml", SCENE.as_bytes()), ("a.obj", OBJ.as_bytes()), ("a.mtl", MTL.as_bytes())]);
    for path in [folder.path().to_owned(), folder.path().join("scene.toml")] {
        let LoadedScene { scene, report } = scene::load(&path).unwrap();
        assert_eq!((scene.film.width_px, scene.film.height_px), (64, 48));
        assert_eq!((scene.camera.eye, scene.camera.hfov_deg), (Vec3::new(0.0, 0.0, 5.0), 40.0));
        assert_eq!((scene.triangles.len(), scene.environment), (2, Some(Vec3::ONE)));
        assert_eq!(scene.materials[0].bsdf, Bsdf::Diffuse { reflectance: Vec3::splat(0.5) });
        assert!(report.warnings.is_empty(), "{:?}", report.warnings);
    }
}

#[test]
fn paths_that_are_no_scenes_say_what_is_needed() {
    let folder = folder(&[("a.obj", OBJ.as_bytes())]);
    for path in [folder.path().join("a.obj"), folder.path().to_owned()] {
        let error = scene::load(&path).unwrap_err();
        assert!(error.to_string().contains("a scene needs a scene.toml"), "{error}");
    }
    for name in ["no.toml", "no/such/folder", "no.obj"] {
        let error = scene::load(&folder.path().join(name)).unwrap_err();
        assert!(matches!(error, SceneError::Read { .. }), "{name}: {error}");
        assert!(error.to_string().contains(name), "{error}");
    }
    let error = scene::load(Path::new("/dev/zero")).unwrap_err();
    assert!(matches!(error, SceneError::NotAScene { .. }), "{error}");
}

#[test]
fn every_mistake_in_a_description_names_line_and_key() {
    let with = |from: &str, to: &str| {
        assert!(SCENE.contains(from), "{from} is part of the good scene");
        SCENE.replace(from, to)
    };
    let material = |entry: &str| format!("{SCENE}[materials.\"white\"]\n{entry}");
    let light = |entry: &str| format!("{SCENE}[[light]]\n{entry}");
    for (toml, expected) in [
        ("geometry = [".to_owned(), "scene.toml:1: "),
        ("\n".to_owned(), "missing field `geometry`"),
        (with("geometry = [\"a.obj\"]", "geometry = []"), "scene.toml:1: geometry: names no file"),
        (with("geometry = [\"a.obj\"]", "geometry = \"a.obj\""), "scene.toml:1: "),
        (with("a.obj", "../a.obj"), "scene.toml:1: geometry file \"../a.obj\" leaves the scene's folder"),
        (with("a.obj", "/tmp/a.obj"), "scene.toml:1: geometry file \"/tmp/a.obj\" leaves the scene's folder"),
        (with("a.obj", "b.obj"), "scene.toml:1: geometry file \"b.obj\" is not there (b.obj)"),
        (with("a.obj", "a.mtl"), "scene.toml:1: geometry file \"a.mtl\": only OBJ can be read"),
        (with("width = 64", "width = 0"), "scene.toml:3: film.width: 0 must be in 1..16384"),
        (with("height = 48", "height = 0"), "scene.toml:4: film.height: 0 must be in 1..16384"),
        (with("width = 64", "width = -64"), "scene.toml:3: film.width: -64 must be"),
        (with("width = 64", "width = 99999999999"), "scene.toml:3: film.width: 99999999999 must be"),
        (with("width = 64", "width = 1.5"), "scene.toml:3: "),
        (
            with("width = 64\nheight = 48", "width = 16000\nheight = 16000"),
            "scene.toml:3: film: image size 16000x16000",
        ),
        (with("width = 64\n", ""), "missing field `width`"),
        (with("width = 64", "wdith = 64"), "scene.toml:3: unknown field `wdith`"),
        (with("[film]", "[fim]"), "unknown field `fim`"),
        (with("eye = [0, 0, 5]", "eye = [0, 0, 0]"), "scene.toml:7: camera.target: equals camera.eye"),
        (with("eye = [0, 0, 5]", "eye = [0, 0]"), "scene.toml:6: "),
        (with("eye = [0, 0, 5]", "eye = [0, nan, 5]"), "scene.toml:6: camera.eye: NaN must be finite"),
        (
            with("target = [0, 0, 0]", "target = [inf, 0, 0]"),
            "scene.toml:7: camera.target: inf must be finite",
        ),
        (with("up = [0, 1, 0]", "up = [0, 0, 1]"), "scene.toml:8: camera.up: is parallel"),
        (with("up = [0, 1, 0]", "up = [0, 0, 0]"), "scene.toml:8: camera.up: must not be zero"),
        (with("hfov_deg = 40", "hfov_deg = 0"), "scene.toml:9: camera.hfov_deg: 0 must be between"),
        (with("hfov_deg = 40", "hfov_deg = 180"), "scene.toml:9: camera.hfov_deg: 180 must be between"),
        (with("hfov_deg = 40", "hfov_deg = nan"), "scene.toml:9: camera.hfov_deg: NaN must be between"),
        (with("hfov_deg = 40", "hfov_deg = \"wide\""), "scene.toml:9: "),
        (
            with("hfov_deg = 40", "hfov_deg = 40\nlens_radius = 0.1"),
            "scene.toml:10: a thin lens (camera.lens_radius) is not supported yet",
        ),
        (
            with("hfov_deg = 40", "hfov_deg = 40\nlens_radius = -1"),
            "scene.toml:10: camera.lens_radius: -1 must be",
        ),
        (
            with("radiance = [1, 1, 1]", "radiance = [1, -1, 1]"),
            "scene.toml:11: environment.radiance: -1 must be",
        ),
        (
            with("radiance = [1, 1, 1]", "map = \"sky.exr\""),
            "scene.toml:11: an environment map (environment.map) is not supported yet",
        ),
        (
            with("radiance = [1, 1, 1]", "scale = 2"),
            "scene.toml:11: environment.scale: belongs to environment.map",
        ),
        (with("radiance = [1, 1, 1]", ""), "environment: needs `radiance`"),
        (
            light("type = \"point\"\nposition = [0, 1, 0]\nintensity = [1, 1, 1]"),
            "scene.toml:12: a point light ([[light]]) is not supported yet",
        ),
        (
            light("type = \"directional\"\ndirection = [0, 1, 0]\nirradiance = [1, 1, 1]"),
            "a directional light ([[light]]) is not supported yet",
        ),
        (light("type = \"point\"\nposition = [0, 1, 0]"), "light.intensity: is missing"),
        (
            light("type = \"point\"\nposition = [0, 1, 0]\nintensity = [1, 1, nan]"),
            "scene.toml:15: light.intensity: NaN must be finite",
        ),
        (light("type = \"spot\""), "scene.toml:13: light.type: unknown type \"spot\""),
        (light("type = \"point\"\nradius = 1"), "scene.toml:14: unknown field `radius`"),
        (material("type = \"velvet\""), "scene.toml:13: materials.\"white\".type: unknown type \"velvet\""),
        (material("type = 3"), "scene.toml:13: "),
        (material("reflectance = [0, 0, 0]"), "missing field `type`"),
        (material("type = \"diffuse\"\ncolour = [1, 1, 1]"), "scene.toml:14: unknown field `colour`"),
        (
            material("type = \"diffuse\"\nreflectance = [1, 1.5, 1]"),
            "scene.toml:14: materials.\"white\".reflectance: 1.5 must be in 0..1",
        ),
        (
            material("type = \"diffuse\"\nreflectance = [1, nan, 1]"),
            "materials.\"white\".reflectance: NaN must be in 0..1",
        ),
        (material("type = \"diffuse\"\nreflectance = [1, 1]"), "scene.toml:14: "),
        (material("type = \"diffuse\"\nemission = [1, -1, 1]"), "materials.\"white\".emission: -1 must be"),
        (material("type = \"diffuse\"\nemission = [1, inf, 1]"), "materials.\"white\".emission: inf must be"),
        (
            material("type = \"diffuse\"\nior = 1.5"),
            "scene.toml:14: materials.\"white\".ior: does not belong to type \"diffuse\"",
        ),
        (material("type = \"dielectric\""), "materials.\"white\".ior: is missing"),
        (material("type = \"dielectric\"\nior = 0"), "materials.\"white\".ior: 0 must be positive"),
        (material("type = \"rough_conductor\""), "materials.\"white\".alpha: is missing"),
        (material("type = \"rough_conductor\"\nalpha = 0"), "materials.\"white\".alpha: 0 must be in 0..1"),
        (
            material("type = \"rough_conductor\"\nalpha_u = 0.1"),
            "materials.\"white\".alpha_u: and alpha_v belong together",
        ),
        (
            material("type = \"rough_conductor\"\nalpha = 0.1\nalpha_u = 0.1\nalpha_v = 0.1"),
            "alpha: and alpha_u, alpha_v exclude",
        ),
        (
            material("type = \"rough_conductor\"\nalpha = 0.1\neta = [1, 1, 1]"),
            "materials.\"white\".eta: needs `k` too",
        ),
        (
            material("type = \"rough_conductor\"\nalpha = 0.1\ndistribution = \"phong\""),
            "unknown distribution \"phong\"",
        ),
    ] {
        let error = refused_toml(&toml);
        assert!(error.contains(expected), "{toml}\nexpected {expected}\ngot {error}");
        assert!(error.starts_with("scene.toml"), "the file is named: {error}");
    }
}

#[test]
fn files_that_are_no_text_or_not_there_are_named() {
    let good = [("scene.toml", SCENE.as_bytes()), ("a.obj", OBJ.as_bytes()), ("a.mtl", MTL.as_bytes())];
    let junk: Vec<u8> = (0..4_096_u32).map(|i| u8::try_from(i * i % 251).unwrap()).collect();
    for (broken, bytes, expected) in [
        ("scene.toml", &b""[..], "scene.toml: the file is empty"),
        ("scene.toml", &junk, "scene.toml:1: not a text file (found a byte 0x00)"),
        ("a.obj", b"", "a.obj: the file is empty"),
        ("a.obj", &junk, "a.obj:1: not a text file (found a byte 0x00)"),
        ("a.obj", b"\n\n", "a.obj: no face with an area: 0 faces"),
        ("a.obj", b"hello\nworld\n", "a.obj: no face with an area: 0 faces"),
        ("a.mtl", b"", "a.mtl: the file is empty"),
        ("a.mtl", &junk, "a.mtl:1: not a text file"),
        ("a.obj", b"mtllib b.mtl\nv 0 0 0", "a.obj: no face with an area"),
    ] {
        let files = good.map(|(name, text)| (name, if name == broken { bytes } else { text }));
        let error = refused(&files);
        assert!(error.starts_with(expected), "{broken}: expected {expected}, got {error}");
    }
    let error = refused(&good[..2]);
    assert_eq!(error, "a.obj:1: material library \"a.mtl\" is not there (a.mtl)");
}

#[test]
fn material_libraries_stay_inside_the_folder() {
    for name in ["/etc/passwd", "../a.mtl", "sub/../../a.mtl", "..\\a.mtl", "C:\\a.mtl"] {
        let obj = OBJ.replace("a.mtl", name);
        let error = refused(&[
            ("scene.toml", SCENE.as_bytes()),
            ("a.obj", obj.as_bytes()),
            ("a.mtl", MTL.as_bytes()),
        ]);
        assert!(
            error.starts_with(&format!("a.obj:1: material library \"{name}\" leaves the scene's folder")),
            "{error}"
        );
    }
    let inside = OBJ.replace("a.mtl", "looks\\plain white.mtl");
    let folder = folder(&[
        ("scene.toml", SCENE.as_bytes()),
        ("a.obj", inside.as_bytes()),
        ("looks/plain white.mtl", MTL.as_bytes()),
    ]);
    scene::load(folder.path()).expect("a folder below, a blank in the name and a backslash are fine");
}

#[test]
fn materials_are_found_or_named() {
    let unknown = OBJ.replace("usemtl white", "usemtl black");
    let error = scene_of(SCENE, &unknown, MTL).unwrap_err().to_string();
    assert!(error.contains("a.obj:3: object \"square\": material \"black\" is neither in"), "{error}");

    let no_library = unknown.replace("mtllib a.mtl\n", "");
    let loaded = scene_of(SCENE, &no_library, MTL).unwrap();
    assert!(
        loaded.report.warnings[0].contains("material \"black\" is defined nowhere"),
        "{:?}",
        loaded.report
    );

    let by_toml = format!(
        "{SCENE}[materials.\"black\"]\ntype = \"mirror\"\n[materials.\"unused\"]\ntype = \"mirror\"\n"
    );
    for obj in [&unknown, &no_library] {
        let loaded = scene_of(&by_toml, obj, MTL).unwrap();
        assert_eq!(loaded.scene.materials[0].bsdf, Bsdf::Mirror { reflectance: Vec3::ONE });
        let [warning] = &loaded.report.warnings[..] else { panic!("{:?}", loaded.report.warnings) };
        assert!(warning.contains("scene.toml:14: material \"unused\" is used by no geometry"), "{warning}");
    }

    let nameless = OBJ.replace("usemtl white\n", "");
    let loaded = scene_of(SCENE, &nameless, MTL).unwrap();
    assert!(loaded.report.warnings[0].contains("faces without a material"), "{:?}", loaded.report);
}

#[test]
fn looks_that_cannot_be_rendered_yet_are_counted_and_named() {
    for (entry, albedo) in [
        ("type = \"rough_conductor\"\nalpha = 0.1\nreflectance = [0.5, 0.5, 0.5]", 0.5),
        ("type = \"conductor\"\nreflectance = [0.5, 0.5, 0.5]\neta = [1, 1, 1]\nk = [2, 2, 2]", 0.25),
        ("type = \"ashikhmin_shirley\"\nreflectance = [0.3, 0.3, 0.3]\nspecular = [0.1, 0.1, 0.1]", 0.4),
        ("type = \"rough_dielectric\"\nior = 1.5\nalpha = 0.1\ndistribution = \"beckmann\"", 0.5),
    ] {
        let loaded = scene_of(&format!("{SCENE}[materials.\"white\"]\n{entry}"), OBJ, MTL).unwrap();
        let Bsdf::Diffuse { reflectance } = loaded.scene.materials[0].bsdf else {
            panic!("{entry} is not diffuse")
        };
        assert!((reflectance - Vec3::splat(albedo)).abs().max_element() < 1e-6, "{entry}: {reflectance}");
        let kind = entry.split('"').nth(1).unwrap();
        let expected = format!("material \"white\" ({kind}) is not supported yet: rendered as diffuse");
        assert_eq!((loaded.report.fallback_materials, &loaded.report.warnings[..]), (1, &[expected][..]));
    }
}

#[test]
fn a_scene_without_light_is_refused() {
    let dark = SCENE.replace("radiance = [1, 1, 1]", "radiance = [0, 0, 0]");
    for toml in [dark.clone(), dark.replace("[environment]\nradiance = [0, 0, 0]\n", "")] {
        let error = scene_of(&toml, OBJ, MTL).unwrap_err();
        assert!(matches!(error, SceneError::NoLight { .. }), "{error}");
        assert!(error.to_string().contains("scene.toml: the scene has no light"), "{error}");
    }
    let unused_lamp = format!("{dark}[materials.\"lamp\"]\ntype = \"diffuse\"\nemission = [1, 1, 1]\n");
    assert!(
        matches!(scene_of(&unused_lamp, OBJ, MTL), Err(SceneError::NoLight { .. })),
        "a lamp nobody uses"
    );
    let lamp = scene_of(&dark, OBJ, &format!("{MTL}Ke 1 2 3\n")).unwrap();
    assert_eq!(
        (lamp.scene.materials[0].emission, lamp.report.emitting_triangles),
        (Vec3::new(1.0, 2.0, 3.0), 2)
    );
}

#[test]
fn degenerate_triangles_are_left_out_and_counted() {
    let obj = format!("{OBJ}f 1 1 2\nf 1 2 2\nv 2 0 0\nf 1 2 5\n");
    let loaded = scene_of(SCENE, &obj, MTL).unwrap();
    assert_eq!((loaded.scene.triangles.len(), loaded.report.degenerate_triangles), (2, 3));
    assert!(loaded.report.warnings[0].contains("a.obj: 3 degenerate triangles"), "{:?}", loaded.report);
}

#[test]
fn several_geometry_files_keep_their_own_materials() {
    let toml = SCENE.replace("[\"a.obj\"]", "[\"a.obj\", \"more/b.obj\"]");
    let other = OBJ.replace("a.mtl", "b.mtl");
    let folder = folder(&[
        ("scene.toml", toml.as_bytes()),
        ("a.obj", OBJ.as_bytes()),
        ("a.mtl", MTL.as_bytes()),
        ("more/b.obj", other.as_bytes()),
        ("more/b.mtl", b"newmtl white\nKd 0.25 0.25 0.25\n"),
    ]);
    let scene = scene::load(folder.path()).unwrap().scene;
    assert_eq!(scene.triangles.iter().map(|t| t.material).collect::<Vec<_>>(), [0, 0, 1, 1]);
    assert_eq!(scene.materials[1].bsdf, Bsdf::Diffuse { reflectance: Vec3::splat(0.25) });
}

#[test]
fn warnings_have_a_bound() {
    let uses: String = (0..600).map(|i| format!("usemtl m{i}\nf 1 2 3\n")).collect();
    let obj = format!("v 0 0 0\nv 1 0 0\nv 0 1 0\n{uses}");
    let report = scene_of(SCENE, &obj, MTL).unwrap().report;
    assert_eq!((report.warnings.len(), report.warnings_dropped), (500, 100));
}

#[test]
fn numbers_in_a_file_never_size_memory() {
    // A few bytes that name huge indices must fail at once, not allocate.
    for face in ["f 1 2 4000000000", "f 1 2 -4000000000", "f 1/4000000000 2 3", "f 1 2 9223372036854775807"] {
        let error = scene_of(SCENE, &format!("{OBJ}{face}\n"), MTL).unwrap_err().to_string();
        assert!(
            error.contains("a.obj:9: object \"square\": ") && error.contains("out of range"),
            "{face}: {error}"
        );
    }
}

#[test]
fn a_byte_order_mark_is_no_part_of_a_file() {
    let marked = |text: &str| format!("\u{feff}{text}");
    let plain = scene_of(SCENE, OBJ, MTL).unwrap();
    let all = scene_of(&marked(SCENE), &marked(OBJ), &marked(MTL)).unwrap();
    assert_eq!(
        (&all.scene.triangles, &all.scene.materials),
        (&plain.scene.triangles, &plain.scene.materials)
    );
    let vertex_first = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nmtllib a.mtl\nusemtl white\nf 1 2 3 4\n";
    let first = scene_of(SCENE, &marked(vertex_first), MTL).unwrap();
    assert_eq!(first.scene.triangles, plain.scene.triangles, "no vertex is lost");
    assert!(first.report.warnings.is_empty(), "{:?}", first.report.warnings);
}

#[test]
fn unknown_statements_are_counted_with_file_and_first_line() {
    let report = scene_of(SCENE, &format!("{OBJ}V 1 2 3\nvertex 1 2 3\n"), MTL).unwrap().report;
    let [warning] = &report.warnings[..] else { panic!("{:?}", report.warnings) };
    assert!(warning.ends_with("a.obj:9: 2 unknown statements ignored, the first is `V`"), "{warning}");
}

#[test]
fn arrays_have_exactly_their_length() {
    let white = format!("{SCENE}[materials.\"white\"]\ntype = \"diffuse\"\nreflectance = [0, 0, 0, 0]");
    for (toml, line, key) in [
        (SCENE.replace("eye = [0, 0, 5]", "eye = [1, 2, 3, 4]"), 6, "eye"),
        (SCENE.replace("up = [0, 1, 0]", "up = [0, 1, 0, 0]"), 8, "up"),
        (SCENE.replace("radiance = [1, 1, 1]", "radiance = [1, 1, 1, 1]"), 11, "radiance"),
        (white, 14, "reflectance"),
    ] {
        let error = refused_toml(&toml);
        assert!(error.starts_with(&format!("scene.toml:{line}: ")) && error.contains(key), "{error}");
        assert!(error.contains("needs exactly 3 numbers, found 4"), "{error}");
    }
}

#[test]
fn values_that_single_precision_cannot_take_are_refused_with_their_place() {
    let with = |from: &str, to: &str| SCENE.replace(from, to);
    let white = |entry: &str| format!("{SCENE}[materials.\"white\"]\n{entry}");
    for (toml, expected) in [
        (with("[0, 0, 5]", "[1e30, 1e30, -1e30]"), "scene.toml:6: camera.eye: 1e30 must be finite and"),
        (with("target = [0, 0, 0]", "target = [0, -2e9, 0]"), "scene.toml:7: camera.target: "),
        (with("up = [0, 1, 0]", "up = [0, 1e30, 0]"), "scene.toml:8: camera.up: "),
        (with("hfov_deg = 40", "hfov_deg = 1e-30"), "scene.toml:9: camera.hfov_deg: "),
        (with("hfov_deg = 40", "hfov_deg = 179.99"), "scene.toml:9: camera.hfov_deg: "),
        (with("radiance = [1, 1, 1]", "radiance = [1, 1e38, 1]"), "scene.toml:11: environment.radiance: "),
        (
            white("type = \"diffuse\"\nemission = [1e38, 0, 0]"),
            "scene.toml:14: materials.\"white\".emission: ",
        ),
        (white("type = \"dielectric\"\nior = 1e30"), "scene.toml:14: materials.\"white\".ior: "),
    ] {
        let error = refused_toml(&toml).replace("1000000000000000000000000000000 must", "1e30 must");
        assert!(error.starts_with(expected), "expected {expected}, got {error}");
    }
    let error = scene_of(SCENE, OBJ, &format!("{MTL}Ke 1e38 0 0\n")).unwrap_err().to_string();
    assert!(error.contains("a.mtl:3: material \"white\": `Ke` must be at most 1e12"), "{error}");
    for index in ["0", "-1.5", "1e30"] {
        let report = scene_of(SCENE, OBJ, &format!("{MTL}Ni {index}\nd 0.5\n")).unwrap().report;
        assert!(report.warnings[0].contains("a.mtl:3: material \"white\": `Ni` "), "{:?}", report.warnings);
    }
}

#[test]
fn lights_are_not_supported_whatever_they_say() {
    for entry in ["", "type = \"point\"", "type = \"spot\"", "radius = 1", "position = [0]"] {
        let error = refused_toml(&format!("{SCENE}[[light]]\n{entry}\n"));
        let expected = "scene.toml:12: a light ([[light]]) is not supported yet; moreover scene.toml:";
        assert!(error.starts_with(expected), "{entry:?}: {error}");
    }
    scene_of(&format!("light = []\n{SCENE}"), OBJ, MTL).expect("no light is no light");
}

#[test]
fn what_is_named_twice_is_told() {
    let again = scene_of(SCENE, OBJ, &format!("{MTL}newmtl white\nKd 1 1 1\n")).unwrap().report.warnings;
    assert!(again[0].contains("a.mtl:3: material \"white\" is defined again"), "{again:?}");
    let toml = SCENE.replace("[\"a.obj\"]", "[\"a.obj\",\n\"./a.obj\"]");
    let twice = scene_of(&toml, OBJ, MTL).unwrap().report.warnings;
    let expected = "scene.toml:2: geometry file \"./a.obj\" is named again";
    assert!(twice.len() == 1 && twice[0].contains(expected), "{twice:?}");
    let libraries = folder(&[
        ("scene.toml", SCENE.as_bytes()),
        ("a.obj", OBJ.replace("a.mtl", "a.mtl b.mtl").as_bytes()),
        ("a.mtl", MTL.as_bytes()),
        ("b.mtl", MTL.as_bytes()),
    ]);
    let both = scene::load(libraries.path()).unwrap().report.warnings;
    assert!(both.len() == 1 && both[0].contains("b.mtl:1: material \"white\" is defined again"), "{both:?}");
}
