//! The check of OBJ text: every line, with its place in errors, before a parser sees it.
//!
//! Reads `v vn vt f fo o g usemtl mtllib` and writes anew what makes surfaces, for `tobj`, whose OBJ is another one than users
//! bring: it divides by the `w` of `v x y z w`, refuses a comment behind a corner and `usemtl<TAB>x`, skips `fo`, gives a
//! corner without a normal its neighbour's, takes NaN for a position, polylines for polygons, drops materials without a
//! library, and refuses a group that ends before its vertices. None of that reaches it: points come before faces, each
//! statement alone and in full. Memory grows with the file's length only, never with a number written in it.

use std::collections::HashSet;

use glam::Vec3;

use super::{
    error::{GeometryFault, SceneError},
    model::MAX_COORDINATE,
    source::{Source, excerpt},
};

/// Most vertices, normals or texture coordinates of a file.
const MAX_VERTICES: usize = 1 << 27;

/// Most triangles of a file.
pub(crate) const MAX_TRIANGLES: usize = 1 << 26;

/// Most faces of a mesh: `tobj` keeps some 100 B for each until its mesh ends.
const MAX_MESH_FACES: usize = 1 << 16;

/// A file that parses.
#[derive(Debug, Default)]
pub(crate) struct Checked {
    /// `v` and `vn` lines, three numbers each, the normals usable or zero; the last normal is NaN, for corners without one.
    pub(crate) points: String,
    /// `usemtl` lines, and `f` lines of `v//vn` corners that all name a point.
    pub(crate) faces_text: String,
    /// Materials that faces use, in the order of first use.
    pub(crate) materials: Vec<UsedMaterial>,
    /// `mtllib` names and their lines.
    pub(crate) libraries: Vec<(String, usize)>,
    /// Faces in the file.
    pub(crate) faces: usize,
    /// Triangles that their fans make.
    pub(crate) triangles: usize,
    pub(crate) warnings: Vec<String>,
}

/// A material as faces name it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct UsedMaterial {
    /// `None`: faces before any `usemtl`.
    pub(crate) name: Option<String>,
    /// Line of the first `usemtl`, or of the first face.
    pub(crate) line: usize,
    /// Start of the name of the object or group there.
    pub(crate) object: Option<String>,
}

impl Checked {
    /// Checks a file's text.
    pub(crate) fn scan(source: &Source) -> Result<Self, SceneError> {
        let mut scan = Scan::new(source);
        for text in source.text.split('\n') {
            scan.line += 1;
            scan.read(text.trim())?;
        }
        scan.check_indices()?;
        Ok(scan.finish())
    }

    fn write_point(&mut self, statement: &str, [x, y, z]: [&str; 3]) {
        self.points.extend([statement, " ", x, " ", y, " ", z, "\n"]);
    }
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
    /// Vertices, texture coordinates and normals so far.
    counts: [usize; 3],
    largest: [Largest<'a>; 3],
    current: Option<(&'a str, usize)>,
    /// Whether a face has used `current`.
    current_is_used: bool,
    /// Names in `checked.materials`.
    names: HashSet<Option<&'a str>>,
    unknown: Option<(usize, String, usize)>,
    checked: Checked,
}

/// What the three numbers of a corner name, in their order.
const WHAT: [&str; 3] = ["vertex", "texture coordinate", "normal"];

impl<'a> Scan<'a> {
    fn new(source: &'a Source) -> Self {
        // A library without a file: its line makes `tobj` ask for the names of materials.
        let checked = Checked { points: "mtllib names\n".to_owned(), ..Checked::default() };
        Self {
            source,
            line: 0,
            object: None,
            counts: [0; 3],
            largest: Default::default(),
            current: None,
            current_is_used: false,
            names: HashSet::new(),
            unknown: None,
            checked,
        }
    }

    fn fault(&self, fault: GeometryFault) -> SceneError {
        SceneError::Geometry { place: self.source.line(self.line), object: self.object.map(excerpt), fault }
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
                    self.checked.libraries.push((name.to_owned(), self.line));
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
        let (words, position) = self.three_numbers("v", rest)?;
        let number = self.counts[0] + 1;
        if !position.is_finite() {
            return Err(self.fault(GeometryFault::NotFinite { number, found: excerpt(rest.trim()) }));
        }
        if position.abs().max_element() > MAX_COORDINATE {
            let found = excerpt(rest.trim());
            return Err(self.fault(GeometryFault::TooFar { number, most: MAX_COORDINATE, found }));
        }
        self.room("vertices", self.counts[0], MAX_VERTICES)?;
        self.counts[0] += 1;
        self.checked.write_point("v", words);
        Ok(())
    }

    fn normal(&mut self, rest: &str) -> Result<(), SceneError> {
        let (words, normal) = self.three_numbers("vn", rest)?;
        self.room("normals", self.counts[2], MAX_VERTICES)?;
        self.counts[2] += 1;
        // Zero stands for every unusable normal; the faces that use it get their own.
        let usable = normal.is_finite() && normal.as_dvec3().length() > 1e-20;
        self.checked.write_point("vn", if usable { words } else { ["0"; 3] });
        Ok(())
    }

    fn texture_coordinate(&mut self, rest: &str) -> Result<(), SceneError> {
        let first = rest.split_whitespace().next().and_then(|word| word.parse::<f32>().ok());
        if first.is_none() {
            let found = excerpt(rest.trim());
            return Err(self.fault(GeometryFault::Numbers { statement: "vt", needs: 1, found }));
        }
        self.room("texture coordinates", self.counts[1], MAX_VERTICES)?;
        self.counts[1] += 1;
        Ok(())
    }

    fn three_numbers<'t>(
        &self,
        statement: &'static str,
        rest: &'t str,
    ) -> Result<([&'t str; 3], Vec3), SceneError> {
        let mut words = rest.split_ascii_whitespace();
        let mut next = || words.next().and_then(|word| Some((word, word.parse::<f32>().ok()?)));
        match (next(), next(), next()) {
            (Some((a, x)), Some((b, y)), Some((c, z))) => Ok(([a, b, c], Vec3::new(x, y, z))),
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
        self.note_material();
        self.checked.faces_text.push('f');
        let mut corners = 0;
        for word in rest.split_ascii_whitespace().take_while(|word| !word.starts_with('#')) {
            self.corner(word)?;
            corners += 1;
        }
        self.checked.faces_text.push('\n');
        if corners < 3 {
            return Err(self.fault(GeometryFault::FewCorners { corners }));
        }
        self.room("triangles", self.checked.triangles + corners - 3, MAX_TRIANGLES)?;
        self.checked.triangles += corners - 2;
        self.checked.faces += 1;
        if self.checked.faces.is_multiple_of(MAX_MESH_FACES) {
            self.checked.faces_text.push_str("g\n");
        }
        Ok(())
    }

    fn corner(&mut self, word: &str) -> Result<(), SceneError> {
        let mut has_normal = false;
        for (slot, part) in word.split('/').enumerate() {
            let malformed = || self.fault(GeometryFault::Corner { corner: excerpt(word) });
            // `v//vn` leaves the middle out; `v/` and `v//` end short, which exporters write too.
            if part.is_empty() && slot > 0 {
                continue;
            }
            let (what, count) = (*WHAT.get(slot).ok_or_else(malformed)?, self.counts[slot]);
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
            let text = &mut self.checked.faces_text;
            match slot {
                0 => text.push(' '),
                1 => continue,
                _ => has_normal = true,
            }
            // Relative indices count from the points so far; in what is written all points come first.
            if index > 0 {
                text.push_str(part)
            } else {
                text.push_str(&(from_zero + 1).to_string())
            }
            if slot == 0 {
                text.push_str("//");
            }
        }
        if !has_normal {
            // Counts from the end: the NaN behind the file's normals.
            self.checked.faces_text.push_str("-1");
        }
        Ok(())
    }

    fn use_material(&mut self, name: &'a str) -> Result<(), SceneError> {
        if name.is_empty() {
            return Err(self.fault(GeometryFault::NoName { statement: "usemtl" }));
        }
        self.current = Some((name, self.line));
        self.current_is_used = false;
        Ok(())
    }

    /// A face uses the current material.
    fn note_material(&mut self) {
        if self.current_is_used {
            return;
        }
        self.current_is_used = true;
        let name = self.current.map(|(name, _)| name);
        if let Some(name) = name {
            self.checked.faces_text.extend(["usemtl ", name, "\n"]);
        }
        if self.names.insert(name) {
            let line = self.current.map_or(self.line, |(_, line)| line);
            // The name of an object is for errors only. In full it would be kept once for each of its materials: gigabytes for
            // a name of a megabyte and a thousand `usemtl`.
            let (name, object) = (name.map(ToOwned::to_owned), self.object.map(excerpt));
            self.checked.materials.push(UsedMaterial { name, line, object });
        }
    }

    fn check_indices(&mut self) -> Result<(), SceneError> {
        for ((largest, what), count) in self.largest.clone().into_iter().zip(WHAT).zip(self.counts) {
            // Line 0: no corner named one.
            if largest.line > 0 && usize::try_from(largest.index).is_ok_and(|index| index >= count) {
                (self.line, self.object) = (largest.line, largest.object);
                return Err(self.fault(GeometryFault::Index { what, index: largest.index + 1, count }));
            }
        }
        Ok(())
    }

    fn finish(mut self) -> Checked {
        self.checked.write_point("vn", ["NaN"; 3]);
        if let Some((line, statement, count)) = self.unknown {
            let place = self.source.line(line);
            let warning = format!("{place}: {count} unknown statements ignored, the first is `{statement}`");
            self.checked.warnings.push(warning);
        }
        self.checked
    }
}
