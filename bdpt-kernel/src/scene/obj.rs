//! Wavefront OBJ geometry: text that the scan has passed, read by `tobj`, then made triangles.
//!
//! Every line goes through [`super::scan`] first, which gives errors their places. `tobj` reads the plain text that the scan
//! writes, never the user's, and opens no file. Polygons become fans here: `tobj`'s would hide which of them bend inwards.

use std::io::Read;

use glam::{DVec3, Vec3};
use tobj::{LoadError, LoadOptions, Mesh};

use super::{
    error::{GeometryFault, Place, SceneError},
    model::Triangle,
    scan::{Checked, UsedMaterial},
    source::Source,
};

/// A triangle of less than this, in squares of the scene's extent, has no area: its edges would be a billionth of the
/// scene, and single precision resolves a ten-millionth.
const LEAST_CROSS_SQUARED: f32 = 1e-36;

/// What a file holds, before its materials are known.
#[derive(Debug, Default)]
pub(crate) struct Geometry {
    /// With indices into [`Self::materials`].
    pub(crate) triangles: Vec<Triangle>,
    /// Materials that faces use, in the order of first use.
    pub(crate) materials: Vec<UsedMaterial>,
    /// `mtllib` names and their lines.
    pub(crate) libraries: Vec<(String, usize)>,
    /// Triangles left out: no area.
    pub(crate) degenerate: usize,
    /// Corners whose normal was zero or not finite and became the face's.
    pub(crate) replaced_normals: usize,
    /// Triangles whose three normals all pointed to the back and were turned round.
    pub(crate) turned_normals: usize,
    /// Polygons that bend inwards: a fan covers too much.
    pub(crate) concave: usize,
    pub(crate) warnings: Vec<String>,
}

/// A corner of a face; its normal as [`unit`] leaves it.
#[derive(Clone, Copy, Debug)]
struct Corner {
    position: Vec3,
    normal: Vec3,
}

impl Geometry {
    /// Reads a file's text.
    pub(crate) fn parse(source: &Source) -> Result<Self, SceneError> {
        let refused = |fault| {
            let place = Place { file: source.path.clone(), line: None };
            SceneError::Geometry { place, object: None, fault }
        };
        let checked = Checked::scan(source)?;
        let meshes =
            read(&checked).map_err(|error| refused(GeometryFault::Parser { reason: error.to_string() }))?;

        let nameless = checked.materials.iter().position(|used| used.name.is_none());
        let scale = inverse_extent(&meshes);
        let mut geometry = Self {
            triangles: Vec::with_capacity(checked.triangles),
            materials: checked.materials,
            libraries: checked.libraries,
            warnings: checked.warnings,
            ..Self::default()
        };
        for mesh in meshes {
            let material = mesh.material_id.or(nameless).unwrap_or(0);
            let material =
                u32::try_from(material).expect("fewer materials than lines, of which 2^32 do not fit");
            geometry.add_mesh(&mesh, material, scale);
        }
        if geometry.triangles.is_empty() {
            let (faces, degenerate) = (checked.faces, geometry.degenerate);
            return Err(refused(GeometryFault::NoTriangle { faces, degenerate }));
        }
        Ok(geometry)
    }

    fn add_mesh(&mut self, mesh: &Mesh, material: u32, scale: f32) {
        let positions: Vec<Vec3> = points(&mesh.positions).collect();
        let normals: Vec<Vec3> = points(&mesh.normals).map(unit).collect();
        let indices = mesh.indices.iter().zip(&mesh.normal_indices);
        let corners: Vec<Corner> = indices
            .map(|(&vertex, &normal)| Corner {
                position: positions[vertex as usize],
                normal: normals[normal as usize],
            })
            .collect();
        let mut rest = &corners[..];
        let mut arities = mesh.face_arities.iter();
        while !rest.is_empty() {
            // A mesh without arities is all triangles.
            let (polygon, others) = rest.split_at(arities.next().map_or(3, |&corners| corners as usize));
            self.concave += usize::from(is_concave(polygon));
            fan(polygon).for_each(|triangle| self.add_triangle(triangle, material, scale));
            rest = others;
        }
    }

    fn add_triangle(&mut self, corners: [Corner; 3], material: u32, scale: f32) {
        let positions = corners.map(|corner| corner.position);
        let [a, b, c] = positions;
        let cross = ((b - a) * scale).cross((c - a) * scale);
        let squared = cross.length_squared();
        if squared.is_nan() || squared <= LEAST_CROSS_SQUARED {
            self.degenerate += 1;
            return;
        }
        let face = ((b - a).as_dvec3()).cross((c - a).as_dvec3()).normalize().as_vec3();
        let mut normals = corners.map(|Corner { normal, .. }| {
            self.replaced_normals += usize::from(normal == Vec3::ZERO);
            if normal == Vec3::ZERO || normal.is_nan() { face } else { normal }
        });
        if normals.iter().all(|normal| normal.dot(face) < 0.0) {
            normals = normals.map(|normal| -normal);
            self.turned_normals += 1;
        }
        self.triangles.push(Triangle { positions, normals, material });
    }
}

/// The meshes of a checked file, its faces in their order. Faces before any `usemtl` have no material.
fn read(checked: &Checked) -> Result<Vec<Mesh>, LoadError> {
    let options =
        LoadOptions { single_index: false, triangulate: false, ignore_points: true, ignore_lines: true };
    let names = || {
        let named = checked.materials.iter().enumerate();
        named.filter_map(|(index, used)| Some((used.name.clone()?, index))).collect()
    };
    let mut text = checked.points.as_bytes().chain(checked.faces_text.as_bytes());
    // What a name means is found later, where scene.toml has its say: the names and their numbers are enough.
    let (models, _) = tobj::load_obj_buf(&mut text, &options, |_| Ok((Vec::new(), names())))?;
    Ok(models.into_iter().map(|model| model.mesh).collect())
}

/// One over the longest edge of the box around what faces use: a stray vertex far out must not make the rest look small.
fn inverse_extent(meshes: &[Mesh]) -> f32 {
    let (low, high) = meshes
        .iter()
        .flat_map(|mesh| points(&mesh.positions))
        .fold((Vec3::MAX, Vec3::MIN), |(low, high), position| (low.min(position), high.max(position)));
    let extent = (high - low).max_element();
    if extent > 0.0 { extent.recip() } else { 1.0 }
}

fn points(numbers: &[f32]) -> impl Iterator<Item = Vec3> {
    numbers.chunks_exact(3).map(Vec3::from_slice)
}

/// A normal at unit length. Zero (the file's is unusable) and NaN (the file has none) stay.
fn unit(normal: Vec3) -> Vec3 {
    if normal == Vec3::ZERO { normal } else { normal.as_dvec3().normalize().as_vec3() }
}

fn fan(polygon: &[Corner]) -> impl Iterator<Item = [Corner; 3]> {
    polygon[1..].windows(2).map(|edge| [polygon[0], edge[0], edge[1]])
}

/// Whether a triangle of the fan winds against the whole polygon.
fn is_concave(polygon: &[Corner]) -> bool {
    if polygon.len() == 3 {
        return false;
    }
    let crosses = || {
        fan(polygon).map(|corners| -> DVec3 {
            let [a, b, c] = corners.map(|corner| corner.position.as_dvec3());
            (b - a).cross(c - a)
        })
    };
    let whole: DVec3 = crosses().sum();
    crosses().any(|cross| cross.dot(whole) < -1e-9 * whole.length_squared())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Geometry, SceneError> {
        Geometry::parse(&Source { path: "a.obj".into(), text: text.to_owned() })
    }

    const SQUARE: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";

    #[test]
    fn polygons_relative_indices_and_later_vertices_are_read() {
        let square = parse(&format!("{SQUARE}f 1 2 3 4")).unwrap();
        assert_eq!(square.triangles.len(), 2);
        assert_eq!(square.triangles[1].positions, [Vec3::ZERO, Vec3::new(1.0, 1.0, 0.0), Vec3::Y]);
        assert_eq!(square.triangles[0].normals, [Vec3::Z; 3]);
        let relative = parse(&format!("{SQUARE}f -4 -3 -2 -1 # all four")).unwrap();
        assert_eq!(relative.triangles, square.triangles);
        let ahead = parse(&format!("f 1 2 3 4\n{SQUARE}")).unwrap();
        assert_eq!(ahead.triangles, square.triangles);
        let windows = parse(&format!("{SQUARE}\tf\t1 2 3 4").replace('\n', "\r\n")).unwrap();
        assert_eq!(windows.triangles, square.triangles);
        let textured = parse(&format!("{SQUARE}vt 0 0\nvn 0 0 2\nf 1/1/1 2/1/1 3//1 4/1")).unwrap();
        assert_eq!(textured.triangles, square.triangles);
    }

    #[test]
    fn what_the_parser_alone_would_read_otherwise() {
        let plain = parse(&format!("{SQUARE}f 1 2 3\nf 1 3 4")).unwrap().triangles;
        for (what, text) in [
            (
                "a weight, a colour, half a colour",
                "v 0 0 0 2\nv 1 0 0 .1 .2 .3\nv 1 1 0 1 1\nv 0 1 0\nf 1 2 3 4",
            ),
            ("comments behind statements", "v 0 0 0 # a\nv 1 0 0 # b\nv 1 1 0\nv 0 1 0\nf 1 2 3 4 # 5 6"),
            ("groups before their vertices", &format!("g a\nf 1 2 3\ng b\nf 1 3 4\ng c\n{SQUARE}")),
            ("polylines and points", &format!("{SQUARE}l 1 2 3 4 1\nl 1 2 3\np 1\nf 1 2 3 4")),
            ("an old face, signs, tabs", &format!("{SQUARE}fo\t+1\t2\t3\nf\t-4\t-2\t-1")),
            ("corners of every form", &format!("{SQUARE}vt 0\nvn 0 0 1\nf 1/ 2// 3/1\nf 1//1 3/1/-1 4")),
            (
                "a corner without a normal behind one",
                &format!("{SQUARE}vn 1 0 .1\nf 1 2 3\nl 1//1 2\nf 1 3 4"),
            ),
        ] {
            assert_eq!(parse(text).unwrap().triangles, plain, "{what}");
        }
        let mixed = parse(&format!("{SQUARE}vn 0.6 0 0.8\nf 1//1 2 3\nf 1 3//1 4")).unwrap();
        let own = Vec3::new(0.6, 0.0, 0.8);
        assert_eq!(mixed.triangles[0].normals, [own, Vec3::Z, Vec3::Z]);
        assert_eq!((mixed.triangles[1].normals, mixed.replaced_normals), ([Vec3::Z, own, Vec3::Z], 0));
    }

    #[test]
    fn meshes_end_and_the_order_of_faces_stays() {
        // Three meshes, as the reader sees them, of faces that each use another corner first.
        let faces: String = (0..150_000).map(|i| ["f 1 2 3\n", "f 2 3 4\n", "f 3 4 1\n"][i % 3]).collect();
        let geometry = parse(&format!("{SQUARE}usemtl a\n{faces}")).unwrap();
        assert_eq!((geometry.triangles.len(), geometry.materials.len()), (150_000, 1));
        let firsts = [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0)];
        assert!(geometry.triangles.iter().enumerate().all(|(i, t)| t.positions[0] == firsts[i % 3]));
    }

    #[test]
    fn materials_are_named_by_use() {
        let text = format!(
            "{SQUARE}mtllib  a b.mtl\no box\nusemtl unused\nusemtl\tred wall\nf 1 2 3\nusemtl blue\nf 1 2 4\n\
             usemtl red wall\nf 1 3 4"
        );
        let geometry = parse(&text).unwrap();
        assert_eq!(geometry.libraries, [("a b.mtl".to_owned(), 5)]);
        let names: Vec<_> = geometry.materials.iter().map(|used| used.name.as_deref().unwrap()).collect();
        assert_eq!(names, ["red wall", "blue"]);
        assert_eq!((geometry.materials[0].line, geometry.materials[0].object.as_deref()), (8, Some("box")));
        let order: Vec<u32> = geometry.triangles.iter().map(|triangle| triangle.material).collect();
        assert_eq!(order, [0, 1, 0]);
    }

    #[test]
    fn normals_are_repaired_and_counted() {
        let text =
            format!("{SQUARE}vn 0 0 0\nvn nan 0 1\nvn 0 1 1\nvn 0 0 -1\nf 1//1 2//2 3//3\nf 1//4 3//4 4//4");
        let geometry = parse(&text).unwrap();
        assert_eq!((geometry.replaced_normals, geometry.turned_normals), (2, 1));
        assert_eq!(geometry.triangles[0].normals[..2], [Vec3::Z; 2]);
        assert!(
            (geometry.triangles[0].normals[2] - Vec3::new(0.0, 0.5_f32.sqrt(), 0.5_f32.sqrt())).length()
                < 1e-6
        );
        assert_eq!(geometry.triangles[1].normals, [Vec3::Z; 3]);
    }

    #[test]
    fn degenerate_and_concave_faces_are_counted() {
        let geometry = parse(&format!("{SQUARE}v 2 0 0\nf 1 2 3\nf 1 1 2\nf 1 2 5")).unwrap();
        assert_eq!((geometry.triangles.len(), geometry.degenerate), (1, 2));
        let small = SQUARE.replace('1', "0.01");
        let stray = parse(&format!("{small}v 9e8 9e8 9e8\nf 1 2 3")).unwrap();
        assert_eq!((stray.triangles.len(), stray.degenerate), (1, 0), "a vertex that nobody uses");
        let arrow = "v 0 0 0\nv 2 -1 0\nv 1 0 0\nv 2 1 0\nf 2 3 4 1\n";
        assert_eq!(parse(arrow).unwrap().concave, 1, "the fan from the arrow's barb leaves the polygon");
        assert_eq!(parse(&format!("{SQUARE}f 1 2 3 4")).unwrap().concave, 0, "a square is convex");
    }

    #[test]
    fn faults_name_file_line_and_object() {
        for (text, expected) in [
            ("v 0 0 0\nv 1 0\n", "a.obj:2: `v` needs 3 numbers, found `1 0`"),
            ("v 0 0 zero", "a.obj:1: `v` needs 3 numbers"),
            ("v 0 nan 0", "a.obj:1: vertex 1 is not finite: `0 nan 0`"),
            ("v 0 0 0\no ball\nv 0 -inf 0", "a.obj:3: object \"ball\": vertex 2 is not finite"),
            ("v 0 1e40 0", "a.obj:1: vertex 1 is not finite"),
            ("v 0 1e30 0", "a.obj:1: vertex 1 is farther out than 1000000000"),
            ("vn 0 1", "a.obj:1: `vn` needs 3 numbers"),
            ("vt", "a.obj:1: `vt` needs 1 numbers"),
            ("g lid\nf 1 2", "a.obj:2: object \"lid\": a face needs at least 3 corners, found 2"),
            ("f", "a.obj:1: a face needs at least 3 corners, found 0"),
            ("f 1", "a.obj:1: a face needs at least 3 corners, found 1"),
            ("f 1 2 x", "a.obj:1: `x` is no corner of a face"),
            ("f 1 2 3/1/1/1", "a.obj:1: `3/1/1/1` is no corner of a face"),
            ("f 1 2 /3", "a.obj:1: `/3` is no corner of a face"),
            ("f 1 2 99999999999999999999", "a.obj:1: `99999999999999999999` is no corner"),
            ("f 1 2 0", "a.obj:1: vertex index 0 is out of range"),
            ("v 0 0 0\nf -1 -1 -2", "a.obj:2: vertex index -2 is out of range: the file has 1"),
            ("f 1 2 9999999999", "a.obj:1: vertex index 9999999999 is out of range"),
            ("usemtl", "a.obj:1: `usemtl` needs a name"),
            ("mtllib ", "a.obj:1: `mtllib` needs a name"),
            ("f 1 2 \\", "a.obj:1: a line continued"),
            ("surf 0 1 0 1 1 2 3", "a.obj:1: `surf` (free-form geometry) cannot be read"),
            ("# nothing", "a.obj: no face with an area: 0 faces"),
            ("v 0 0 0\nf 1 1 1", "a.obj: no face with an area: 1 faces, 1 degenerate triangles"),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.starts_with(expected), "{text:?}: {error}");
        }
        for (face, expected) in [
            ("f 1 2 5", "a.obj:6: object \"lid\": vertex index 5 is out of range: the file has 4"),
            (
                "f 1/1 2/1 3/1",
                "a.obj:6: object \"lid\": texture coordinate index 1 is out of range: the file has 0",
            ),
            ("f 1//2 2//1 3//1", "a.obj:6: object \"lid\": normal index 2 is out of range: the file has 0"),
        ] {
            let error = parse(&format!("{SQUARE}o lid\n{face}\no other\nf 1 2 3")).unwrap_err().to_string();
            assert!(error.starts_with(expected), "{face:?}: {error}");
        }
    }
}
