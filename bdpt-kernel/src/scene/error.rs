//! Why a scene cannot be loaded. Every error names the file, and the line, object and key where there is one.

use std::{fmt, io, path::PathBuf};

use thiserror::Error;

/// A place in a scene's files.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// The file.
    pub file: PathBuf,
    /// The line, counted from 1; `None` when the whole file is meant.
    pub line: Option<usize>,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.file.display())?;
        self.line.map_or(Ok(()), |line| write!(f, ":{line}"))
    }
}

/// A scene was refused. Not to be retried: the files must change.
#[derive(Debug, Error)]
pub enum SceneError {
    /// The path names geometry, not a scene.
    #[error(
        "{}: a scene needs a scene.toml (camera, image size, lights) beside its geometry; \
         give the path of a scene.toml or of the folder that holds it", path.display()
    )]
    NotAScene {
        /// What was given.
        path: PathBuf,
    },
    /// A file cannot be read.
    #[error("{place}: cannot be read")]
    Read {
        /// The file, or the line that names it.
        place: Place,
        /// Why.
        source: io::Error,
    },
    /// A file that another one names is not there.
    #[error("{place}: {what} \"{name}\" is not there ({})", tried.display())]
    Missing {
        /// Where it is named.
        place: Place,
        /// What kind of file.
        what: &'static str,
        /// Its name as written.
        name: String,
        /// Where it was looked for.
        tried: PathBuf,
    },
    /// A file lies outside the scene's folder.
    #[error("{place}: {what} \"{name}\" leaves the scene's folder: absolute paths and `..` are refused")]
    Outside {
        /// Where it is named.
        place: Place,
        /// What kind of file.
        what: &'static str,
        /// Its name as written.
        name: String,
    },
    /// A file is too large.
    #[error("{}: {size_bytes} B is more than the {most_bytes} B that can be loaded", file.display())]
    TooLarge {
        /// The file.
        file: PathBuf,
        /// Its size.
        size_bytes: u64,
        /// The bound.
        most_bytes: u64,
    },
    /// A file holds no text.
    #[error("{place}: not a text file (found a byte {byte:#04x})")]
    NotText {
        /// Where the first such byte lies.
        place: Place,
        /// The byte.
        byte: u8,
    },
    /// A file is empty.
    #[error("{}: the file is empty", file.display())]
    Empty {
        /// The file.
        file: PathBuf,
    },
    /// scene.toml is no TOML, has an unknown key, lacks a key, or a value has another type than the key asks for.
    #[error("{place}: {reason}")]
    Description {
        /// Where.
        place: Place,
        /// What the parser says, with the line at fault.
        reason: String,
    },
    /// A value is out of range.
    #[error("{place}: {key}: {reason}")]
    Value {
        /// Where.
        place: Place,
        /// The key in full, e.g. `camera.hfov_deg`.
        key: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The scene asks for something that cannot be rendered yet.
    #[error("{place}: {what} is not supported yet")]
    Unsupported {
        /// Where.
        place: Place,
        /// What.
        what: String,
    },
    /// The scene asks for something that cannot be rendered yet, and there is a mistake too.
    #[error("{place}: {what} is not supported yet; moreover {mistake}")]
    UnsupportedAndWrong {
        /// Where.
        place: Place,
        /// What.
        what: String,
        /// The mistake.
        mistake: Box<Self>,
    },
    /// A line of geometry cannot be used.
    #[error("{place}: {}{fault}", object.as_ref().map(|name| format!("object \"{name}\": ")).unwrap_or_default())]
    Geometry {
        /// Where.
        place: Place,
        /// The object or group that the line belongs to.
        object: Option<String>,
        /// What is wrong.
        fault: GeometryFault,
    },
    /// A line of a material library cannot be used.
    #[error("{place}: {}{fault}", material.as_ref().map(|name| format!("material \"{name}\": ")).unwrap_or_default())]
    MaterialLibrary {
        /// Where.
        place: Place,
        /// The material that the line belongs to.
        material: Option<String>,
        /// What is wrong.
        fault: String,
    },
    /// Geometry uses a material that nobody defines.
    #[error(
        "{place}: {}material \"{material}\" is neither in the material library nor in scene.toml",
        object.as_ref().map(|name| format!("object \"{name}\": ")).unwrap_or_default()
    )]
    UnknownMaterial {
        /// The `usemtl` line.
        place: Place,
        /// The object or group that the line belongs to.
        object: Option<String>,
        /// The name.
        material: String,
    },
    /// Nothing emits light: every image would be black.
    #[error("{}: the scene has no light: no used material has an emission and there is no environment", file.display())]
    NoLight {
        /// The scene file.
        file: PathBuf,
    },
}

/// What is wrong with a line of geometry.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum GeometryFault {
    /// A statement has too few numbers, or something that is no number.
    #[error("`{statement}` needs {needs} numbers, found `{found}`")]
    Numbers {
        /// `v`, `vn` or `vt`.
        statement: &'static str,
        /// How many numbers it needs.
        needs: usize,
        /// The line's arguments, shortened.
        found: String,
    },
    /// A vertex is NaN or infinite.
    #[error("vertex {number} is not finite: `{found}`")]
    NotFinite {
        /// Its number in the file, from 1.
        number: usize,
        /// The line's arguments, shortened.
        found: String,
    },
    /// A vertex is too far out for single precision to work with.
    #[error("vertex {number} is farther out than {most}: `{found}`")]
    TooFar {
        /// Its number in the file, from 1.
        number: usize,
        /// The bound on a coordinate.
        most: f32,
        /// The line's arguments, shortened.
        found: String,
    },
    /// A face of fewer than three corners.
    #[error("a face needs at least 3 corners, found {corners}")]
    FewCorners {
        /// How many it has.
        corners: usize,
    },
    /// A corner of a face is not of the form `v`, `v/vt`, `v//vn` or `v/vt/vn`.
    #[error("`{corner}` is no corner of a face (v, v/vt, v//vn or v/vt/vn)")]
    Corner {
        /// As written.
        corner: String,
    },
    /// An index names nothing.
    #[error(
        "{what} index {index} is out of range: the file has {count} (indices start at 1, or count back from -1)"
    )]
    Index {
        /// `vertex`, `texture coordinate` or `normal`.
        what: &'static str,
        /// As written.
        index: i64,
        /// How many there are.
        count: usize,
    },
    /// A statement has no name.
    #[error("`{statement}` needs a name")]
    NoName {
        /// `usemtl` or `mtllib`.
        statement: &'static str,
    },
    /// A line ends in a backslash.
    #[error("a line continued with `\\` cannot be read")]
    Continuation,
    /// The parser refuses what the check before it has passed.
    #[error("cannot be parsed: {reason}")]
    Parser {
        /// What the parser says; it names no line.
        reason: String,
    },
    /// A statement that would change the geometry.
    #[error("`{statement}` (free-form geometry) cannot be read")]
    FreeForm {
        /// The statement.
        statement: String,
    },
    /// No triangle is left.
    #[error("no face with an area: {faces} faces, {degenerate} degenerate triangles")]
    NoTriangle {
        /// Faces in the file.
        faces: usize,
        /// Triangles without an area.
        degenerate: usize,
    },
    /// More triangles than can be rendered.
    #[error("more than {most} {what}")]
    TooMany {
        /// `vertices` or `triangles`.
        what: &'static str,
        /// The bound.
        most: usize,
    },
}
