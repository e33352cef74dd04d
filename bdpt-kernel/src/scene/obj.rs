//! Wavefront OBJ geometry: one pass over the text that checks every line, then triangles.
//!
//! Reads `v vn vt f o g usemtl mtllib`; polygons become fans. Reading is ours, not tobj's: that loses the lines of errors and
//! the names of unknown materials, reads `usemtl<TAB>x` as nameless, and takes NaN for a number. Memory grows with
//! the file's length only, never with a number written in it.

use std::collections::HashMap;

use glam::{DVec3, Vec3};

use super::{
    error::{GeometryFault, SceneError},
    model::Triangle,
    source::{Source, excerpt},
};

/// Largest coordinate: beyond it single precision has no room for squares of areas.
const MAX_COORDINATE: f32 = 1e9;

/// Most vertices, normals or texture coordinates of a file.
const MAX_VERTICES: usize = 1 << 27;

/// Most triangles of a file.
pub(crate) const MAX_TRIANGLES: usize = 1 << 26;

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

/// A material as faces name it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct UsedMaterial {
    /// `None`: faces before any `usemtl`.
    pub(crate) name: Option<String>,
    /// Line of the first `usemtl`, or of the first face.
    pub(crate) line: usize,
    /// Object or group there.
    pub(crate) object: Option<String>,
}

impl Geometry {
    /// Reads a file's text.
    pub(crate) fn parse(source: &Source) -> Result<Self, SceneError> {
        let mut scan = Scan::new(source);
        for text in source.text.split('\n') {
            scan.line += 1;
            scan.read(text.trim())?;
        }
        scan.check_indices()?;
        scan.into_geometry()
    }
}

const NO_NORMAL: u32 = u32::MAX;

/// A corner of a face: indices into the file's arrays, from 0.
#[derive(Clone, Copy, Debug, Default)]
struct Corner {
    vertex: u32,
    normal: u32,
}

/// The largest index that a corner names, and where: faces may name vertices that follow.
#[derive(Clone, Debug, Default)]
struct Largest<'a> {
    index: i64,
    line: usize,
    object: Option<&'a str>,
}

struct Scan<'a> {
    source: &'a Source,
    line: usize,
    object: Option<&'a str>,
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    texture_coordinates: usize,
    faces: usize,
    triangles: Vec<([Corner; 3], u32)>,
    /// First corners of polygons in `triangles` and their number of triangles.
    polygons: Vec<(usize, usize)>,
    corners: Vec<Corner>,
    largest: [Largest<'a>; 3],
    current: Option<(&'a str, usize)>,
    /// Index in `materials` of `current`, once a face has used it.
    current_index: Option<u32>,
    materials: Vec<UsedMaterial>,
    material_indices: HashMap<Option<&'a str>, u32>,
    libraries: Vec<(String, usize)>,
    unknown: Option<(usize, String, usize)>,
}

impl<'a> Scan<'a> {
    fn new(source: &'a Source) -> Self {
        Self {
            source,
            line: 0,
            object: None,
            positions: Vec::new(),
            normals: Vec::new(),
            texture_coordinates: 0,
            faces: 0,
            triangles: Vec::new(),
            polygons: Vec::new(),
            corners: Vec::new(),
            largest: Default::default(),
            current: None,
            current_index: None,
            materials: Vec::new(),
            material_indices: HashMap::new(),
            libraries: Vec::new(),
            unknown: None,
        }
    }

    fn fault(&self, fault: GeometryFault) -> SceneError {
        let object = self.object.map(ToOwned::to_owned);
        SceneError::Geometry { place: self.source.line(self.line), object, fault }
    }

    fn read(&mut self, text: &'a str) -> Result<(), SceneError> {
        if text.ends_with('\\') && !text.starts_with('#') {
            return Err(self.fault(GeometryFault::Continuation));
        }
        let (statement, rest) = text.split_once([' ', '\t']).unwrap_or((text, ""));
        match statement {
            "v" => self.vertex(rest),
            "vn" => self.normal(rest),
            "vt" => self.texture_coordinate(rest),
            "f" | "fo" => self.face(rest),
            "o" | "g" => {
                self.object = Some(rest.trim()).filter(|name| !name.is_empty());
                Ok(())
            }
            "usemtl" => self.use_material(rest.trim()),
            "mtllib" => match rest.trim() {
                "" => Err(self.fault(GeometryFault::NoName { statement: "mtllib" })),
                name => {
                    self.libraries.push((name.to_owned(), self.line));
                    Ok(())
                }
            },
            "surf" | "curv" | "curv2" | "call" => {
                Err(self.fault(GeometryFault::FreeForm { statement: statement.to_owned() }))
            }
            // Smoothing groups, lines, points, parameters and display hints make no surface.
            "" | "s" | "l" | "p" | "mg" | "vp" | "lod" | "bevel" | "c_interp" | "d_interp" | "shadow_obj"
            | "trace_obj" | "usemap" | "maplib" => Ok(()),
            _ if statement.starts_with('#') => Ok(()),
            _ => {
                let line = self.line;
                self.unknown.get_or_insert_with(|| (line, excerpt(statement), 0)).2 += 1;
                Ok(())
            }
        }
    }

    fn vertex(&mut self, rest: &str) -> Result<(), SceneError> {
        let position = self.three_numbers("v", rest)?;
        let number = self.positions.len() + 1;
        if !position.is_finite() {
            return Err(self.fault(GeometryFault::NotFinite { number, found: excerpt(rest.trim()) }));
        }
        if position.abs().max_element() > MAX_COORDINATE {
            let found = excerpt(rest.trim());
            return Err(self.fault(GeometryFault::TooFar { number, most: MAX_COORDINATE, found }));
        }
        self.room("vertices", self.positions.len(), MAX_VERTICES)?;
        self.positions.push(position);
        Ok(())
    }

    fn normal(&mut self, rest: &str) -> Result<(), SceneError> {
        let normal = self.three_numbers("vn", rest)?;
        self.room("normals", self.normals.len(), MAX_VERTICES)?;
        // Zero stands for every unusable normal; the faces that use it get their own.
        let usable = normal.is_finite() && normal.as_dvec3().length() > 1e-20;
        let unit = if usable { normal.as_dvec3().normalize().as_vec3() } else { Vec3::ZERO };
        self.normals.push(unit);
        Ok(())
    }

    fn texture_coordinate(&mut self, rest: &str) -> Result<(), SceneError> {
        let first = rest.split_whitespace().next().and_then(|word| word.parse::<f32>().ok());
        if first.is_none() {
            let found = excerpt(rest.trim());
            return Err(self.fault(GeometryFault::Numbers { statement: "vt", needs: 1, found }));
        }
        self.room("texture coordinates", self.texture_coordinates, MAX_VERTICES)?;
        self.texture_coordinates += 1;
        Ok(())
    }

    fn three_numbers(&self, statement: &'static str, rest: &str) -> Result<Vec3, SceneError> {
        let mut words = rest.split_ascii_whitespace();
        let mut next = || words.next().and_then(|word| word.parse::<f32>().ok());
        match (next(), next(), next()) {
            (Some(x), Some(y), Some(z)) => Ok(Vec3::new(x, y, z)),
            _ => {
                let found = excerpt(rest.trim());
                Err(self.fault(GeometryFault::Numbers { statement, needs: 3, found }))
            }
        }
    }

    fn room(&self, what: &'static str, count: usize, most: usize) -> Result<(), SceneError> {
        if count < most { Ok(()) } else { Err(self.fault(GeometryFault::TooMany { what, most })) }
    }

    fn face(&mut self, rest: &'a str) -> Result<(), SceneError> {
        let mut corners = std::mem::take(&mut self.corners);
        corners.clear();
        for word in rest.split_ascii_whitespace().take_while(|word| !word.starts_with('#')) {
            corners.push(self.corner(word)?);
        }
        if corners.len() < 3 {
            return Err(self.fault(GeometryFault::FewCorners { corners: corners.len() }));
        }
        let first = corners[0];
        self.room("triangles", self.triangles.len() + corners.len() - 3, MAX_TRIANGLES)?;
        let material = self.material();
        if corners.len() > 3 {
            self.polygons.push((self.triangles.len(), corners.len() - 2));
        }
        let fan = corners[1..].windows(2).map(|edge| ([first, edge[0], edge[1]], material));
        self.triangles.extend(fan);
        self.faces += 1;
        self.corners = corners;
        Ok(())
    }

    fn corner(&mut self, word: &str) -> Result<Corner, SceneError> {
        const WHAT: [&str; 3] = ["vertex", "texture coordinate", "normal"];
        let counts = [self.positions.len(), self.texture_coordinates, self.normals.len()];
        let mut indices: [Option<i64>; 3] = [None; 3];
        for (slot, part) in word.split('/').enumerate() {
            let malformed = || self.fault(GeometryFault::Corner { corner: excerpt(word) });
            // `v//vn` leaves the middle out; `v/` and `v//` end short, which exporters write too.
            if part.is_empty() && slot > 0 {
                continue;
            }
            let (what, count) = (*WHAT.get(slot).ok_or_else(malformed)?, counts[slot]);
            let index: i64 = part.parse().map_err(|_| malformed())?;
            let known = i64::try_from(count).unwrap_or(i64::MAX);
            let from_zero = if index > 0 { index - 1 } else { known.saturating_add(index) };
            // An index past 2^32 cannot become valid by vertices that follow.
            if index == 0 || from_zero < 0 || from_zero >= i64::from(u32::MAX) {
                return Err(self.fault(GeometryFault::Index { what, index, count }));
            }
            if from_zero >= self.largest[slot].index {
                self.largest[slot] = Largest { index: from_zero, line: self.line, object: self.object };
            }
            indices[slot] = Some(from_zero);
        }
        let narrow = |index: i64| u32::try_from(index).expect("checked to be below 2^32 above");
        match indices[0] {
            None => Err(self.fault(GeometryFault::Corner { corner: excerpt(word) })),
            Some(vertex) => {
                Ok(Corner { vertex: narrow(vertex), normal: indices[2].map_or(NO_NORMAL, narrow) })
            }
        }
    }

    fn use_material(&mut self, name: &'a str) -> Result<(), SceneError> {
        if name.is_empty() {
            return Err(self.fault(GeometryFault::NoName { statement: "usemtl" }));
        }
        self.current = Some((name, self.line));
        self.current_index = None;
        Ok(())
    }

    /// Index of the current material, which a face now uses.
    fn material(&mut self) -> u32 {
        if let Some(index) = self.current_index {
            return index;
        }
        let name = self.current.map(|(name, _)| name);
        let index = self.material_indices.get(&name).copied().unwrap_or_else(|| {
            let line = self.current.map_or(self.line, |(_, line)| line);
            let object = self.object.map(ToOwned::to_owned);
            let index = u32::try_from(self.materials.len())
                .expect("fewer materials than lines, of which 2^32 do not fit");
            self.materials.push(UsedMaterial { name: name.map(ToOwned::to_owned), line, object });
            self.material_indices.insert(name, index);
            index
        });
        self.current_index = Some(index);
        index
    }

    fn check_indices(&mut self) -> Result<(), SceneError> {
        let what = ["vertex", "texture coordinate", "normal"];
        let counts = [self.positions.len(), self.texture_coordinates, self.normals.len()];
        for ((largest, what), count) in self.largest.clone().into_iter().zip(what).zip(counts) {
            // Line 0: no corner named one.
            if largest.line > 0 && usize::try_from(largest.index).is_ok_and(|index| index >= count) {
                (self.line, self.object) = (largest.line, largest.object);
                return Err(self.fault(GeometryFault::Index { what, index: largest.index + 1, count }));
            }
        }
        Ok(())
    }

    fn into_geometry(mut self) -> Result<Geometry, SceneError> {
        // Of what faces use: a stray vertex far out must not make the rest look small.
        let used =
            self.triangles.iter().flat_map(|(corners, _)| corners).map(|c| self.positions[c.vertex as usize]);
        let (low, high) = used
            .fold((Vec3::MAX, Vec3::MIN), |(low, high), position| (low.min(position), high.max(position)));
        let extent = (high - low).max_element();
        let scale = if extent > 0.0 { extent.recip() } else { 1.0 };
        let mut geometry = Geometry { concave: self.concave_polygons(), ..Geometry::default() };
        geometry.triangles.reserve_exact(self.triangles.len());
        for (corners, material) in std::mem::take(&mut self.triangles) {
            let positions = corners.map(|corner| self.positions[corner.vertex as usize]);
            let [a, b, c] = positions;
            let cross = ((b - a) * scale).cross((c - a) * scale);
            let squared = cross.length_squared();
            if squared.is_nan() || squared <= LEAST_CROSS_SQUARED {
                geometry.degenerate += 1;
                continue;
            }
            let face = ((b - a).as_dvec3()).cross((c - a).as_dvec3()).normalize().as_vec3();
            let mut replaced = 0;
            let mut normals = corners.map(|corner| match self.normals.get(corner.normal as usize) {
                None => face,
                Some(&Vec3::ZERO) => {
                    replaced += 1;
                    face
                }
                Some(normal) => *normal,
            });
            geometry.replaced_normals += replaced;
            if normals.iter().all(|normal| normal.dot(face) < 0.0) {
                normals = normals.map(|normal| -normal);
                geometry.turned_normals += 1;
            }
            geometry.triangles.push(Triangle { positions, normals, material });
        }
        if geometry.triangles.is_empty() {
            let fault = GeometryFault::NoTriangle { faces: self.faces, degenerate: geometry.degenerate };
            let place = super::error::Place { file: self.source.path.clone(), line: None };
            return Err(SceneError::Geometry { place, object: None, fault });
        }
        if let Some((line, statement, count)) = self.unknown {
            let place = self.source.line(line);
            let warning = format!("{place}: {count} unknown statements ignored, the first is `{statement}`");
            geometry.warnings.push(warning);
        }
        (geometry.materials, geometry.libraries) = (self.materials, self.libraries);
        Ok(geometry)
    }

    /// Polygons of which a fan triangle winds against the whole.
    fn concave_polygons(&self) -> usize {
        let cross = |&(corners, _): &([Corner; 3], u32)| -> DVec3 {
            let [a, b, c] = corners.map(|corner| self.positions[corner.vertex as usize].as_dvec3());
            (b - a).cross(c - a)
        };
        let bends = |&&(start, count): &&(usize, usize)| {
            let fan = &self.triangles[start..start + count];
            let whole: DVec3 = fan.iter().map(cross).sum();
            fan.iter().any(|triangle| cross(triangle).dot(whole) < -1e-9 * whole.length_squared())
        };
        self.polygons.iter().filter(bends).count()
    }
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
