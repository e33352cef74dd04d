//! Scenes that ship as code. Each becomes a real folder with scene.toml, OBJ and MTL, which the loader reads like any other.
//!
//! Owns shapes and looks; never builds a scene in memory past the loader, so that what is tested is what users load.

mod atrium;
mod caustic;
mod cornell;
mod furnace;
mod shape;

use std::{
    fmt,
    fs::{self, File, OpenOptions},
    io::{self, BufWriter, Write},
    path::{Path, PathBuf},
    str::FromStr,
};

use thiserror::Error;

use self::shape::ObjWriter;
pub use self::{atrium::MAX_TRIANGLES as MAX_ATRIUM_TRIANGLES, cornell::CornellVariant};
use crate::scene::SCENE_FILE;

/// Triangles of an atrium whose name gives no number.
const DEFAULT_ATRIUM_TRIANGLES: u32 = 300_000;

/// A scene that can be generated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SceneKind {
    /// The Cornell box: `cornell-box`, `cornell-box-mirror`, `cornell-box-glass`, `cornell-box-spheres`.
    CornellBox(CornellVariant),
    /// A glass ball and a tumbler that gather the light of a small lamp: `caustic`.
    Caustic,
    /// A white ball in a white world, which must vanish: `furnace`.
    Furnace,
    /// A colonnaded hall of about so many triangles: `atrium`, or `atrium-1000000`.
    Atrium {
        /// Aimed at, 10,000..=[`MAX_ATRIUM_TRIANGLES`].
        triangles: u32,
    },
}

/// A name that means no scene.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("unknown scene \"{name}\": {}, or atrium-N with N triangles in 10000..={MAX_ATRIUM_TRIANGLES}", SceneKind::NAMES.join(", "))]
pub struct UnknownScene {
    /// As given.
    pub name: String,
}

/// A number of triangles that a scene cannot have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum TrianglesError {
    /// The scene comes in one size.
    #[error("{kind} has no choice of triangles (only an atrium has)")]
    Fixed {
        /// The scene.
        kind: SceneKind,
    },
    /// Too few or too many.
    #[error("{triangles} triangles: an atrium has {}..={MAX_ATRIUM_TRIANGLES}", atrium::MIN_TRIANGLES)]
    OutOfRange {
        /// As given.
        triangles: u32,
    },
}

/// A scene could not be written.
#[derive(Debug, Error)]
pub enum GenerateError {
    /// The folder holds a scene; nothing is overwritten.
    #[error("{}: there is a {SCENE_FILE} already", folder.display())]
    Exists {
        /// The folder.
        folder: PathBuf,
    },
    /// A file cannot be written.
    #[error("{}: cannot be written", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
}

impl SceneKind {
    /// Every name, one example of the atrium.
    pub const NAMES: [&'static str; 7] = [
        "cornell-box",
        "cornell-box-mirror",
        "cornell-box-glass",
        "cornell-box-spheres",
        "caustic",
        "furnace",
        "atrium",
    ];

    /// The same scene of about so many triangles.
    ///
    /// # Errors
    /// The scene has one size only, or the number is out of range.
    pub fn with_triangles(self, triangles: u32) -> Result<Self, TrianglesError> {
        match self {
            Self::Atrium { .. } if (atrium::MIN_TRIANGLES..=atrium::MAX_TRIANGLES).contains(&triangles) => {
                Ok(Self::Atrium { triangles })
            }
            Self::Atrium { .. } => Err(TrianglesError::OutOfRange { triangles }),
            kind => Err(TrianglesError::Fixed { kind }),
        }
    }
}

impl FromStr for SceneKind {
    type Err = UnknownScene;

    fn from_str(name: &str) -> Result<Self, UnknownScene> {
        let unknown = || UnknownScene { name: name.to_owned() };
        match name {
            // The short name is what the README and most people type.
            "cornell" | "cornell-box" => Ok(Self::CornellBox(CornellVariant::Diffuse)),
            "cornell-box-mirror" => Ok(Self::CornellBox(CornellVariant::Mirror)),
            "cornell-box-glass" => Ok(Self::CornellBox(CornellVariant::Glass)),
            "cornell-box-spheres" => Ok(Self::CornellBox(CornellVariant::Spheres)),
            "caustic" => Ok(Self::Caustic),
            "furnace" => Ok(Self::Furnace),
            "atrium" => Ok(Self::Atrium { triangles: DEFAULT_ATRIUM_TRIANGLES }),
            _ => {
                let count = name.strip_prefix("atrium-").ok_or_else(unknown)?;
                let triangles = count.parse().map_err(|_| unknown())?;
                Self::Atrium { triangles: DEFAULT_ATRIUM_TRIANGLES }
                    .with_triangles(triangles)
                    .map_err(|_| unknown())
            }
        }
    }
}

impl fmt::Display for SceneKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::CornellBox(CornellVariant::Diffuse) => f.write_str("cornell-box"),
            Self::CornellBox(CornellVariant::Mirror) => f.write_str("cornell-box-mirror"),
            Self::CornellBox(CornellVariant::Glass) => f.write_str("cornell-box-glass"),
            Self::CornellBox(CornellVariant::Spheres) => f.write_str("cornell-box-spheres"),
            Self::Caustic => f.write_str("caustic"),
            Self::Furnace => f.write_str("furnace"),
            Self::Atrium { triangles } => write!(f, "atrium-{triangles}"),
        }
    }
}

/// Writes a scene into a folder, which is made if need be, and gives the path of its scene.toml.
///
/// # Errors
/// The folder holds a scene already, or cannot be written.
pub fn write(kind: SceneKind, folder: &Path) -> Result<PathBuf, GenerateError> {
    let failed = |path: &Path, source| GenerateError::Write { path: path.to_owned(), source };
    fs::create_dir_all(folder).map_err(|source| failed(folder, source))?;
    let scene = folder.join(SCENE_FILE);
    if scene.exists() {
        return Err(GenerateError::Exists { folder: folder.to_owned() });
    }
    let name = match kind {
        SceneKind::Atrium { .. } => "atrium".to_owned(),
        other => other.to_string(),
    };
    let (library, geometry) = (folder.join(format!("{name}.mtl")), folder.join(format!("{name}.obj")));
    fs::write(&library, library_of(kind)).map_err(|source| failed(&library, source))?;
    write_geometry(kind, &name, &geometry).map_err(|source| failed(&geometry, source))?;
    // Last, and only if nobody else made one: a folder with a scene.toml is a whole scene.
    let description = description_of(kind, &name);
    OpenOptions::new()
        .write(true)
        .create_new(true)
        .open(&scene)
        .and_then(|mut file| file.write_all(description.as_bytes()))
        .map_err(|source| failed(&scene, source))?;
    Ok(scene)
}

fn write_geometry(kind: SceneKind, name: &str, path: &Path) -> io::Result<()> {
    let mut file = BufWriter::new(File::create(path)?);
    writeln!(file, "# {kind}: generated by Gleaner\nmtllib {name}.mtl")?;
    let mut obj = ObjWriter::new(&mut file);
    match kind {
        SceneKind::CornellBox(variant) => cornell::geometry(variant, &mut obj)?,
        SceneKind::Caustic => caustic::geometry(&mut obj)?,
        SceneKind::Furnace => furnace::geometry(&mut obj)?,
        SceneKind::Atrium { triangles } => atrium::geometry(triangles, &mut obj)?,
    }
    file.flush()
}

fn library_of(kind: SceneKind) -> &'static str {
    match kind {
        SceneKind::CornellBox(_) => cornell::LIBRARY,
        SceneKind::Caustic => caustic::LIBRARY,
        SceneKind::Furnace => furnace::LIBRARY,
        SceneKind::Atrium { .. } => atrium::LIBRARY,
    }
}

fn description_of(kind: SceneKind, name: &str) -> String {
    let rest = match kind {
        SceneKind::CornellBox(_) => cornell::DESCRIPTION,
        SceneKind::Caustic => caustic::DESCRIPTION,
        SceneKind::Furnace => furnace::DESCRIPTION,
        SceneKind::Atrium { .. } => atrium::DESCRIPTION,
    };
    format!("geometry = [\"{name}.obj\"]\n\n{rest}")
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::scene::{self, LoadedScene, model::Bsdf};

    fn generated(name: &str) -> LoadedScene {
        let folder = tempfile::tempdir().unwrap();
        let file = write(name.parse().unwrap(), &folder.path().join("scene")).unwrap();
        scene::load(&file).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    #[test]
    fn every_scene_loads_without_a_word() {
        for name in SceneKind::NAMES {
            let name = if name == "atrium" { "atrium-20000" } else { name };
            let LoadedScene { scene, report } = generated(name);
            assert!(report.warnings.is_empty(), "{name}: {:?}", report.warnings);
            assert_eq!(report.degenerate_triangles, 0, "{name}");
            assert!(report.emitting_triangles > 0 || scene.environment.is_some(), "{name} has light");
        }
    }

    #[test]
    fn names_and_kinds_are_one_to_one() {
        for name in SceneKind::NAMES.into_iter().filter(|name| *name != "atrium").chain(["atrium-10000"]) {
            let kind: SceneKind = name.parse().unwrap();
            assert_eq!(kind.to_string(), name);
        }
        for name in ["", "box", "atrium-", "atrium-9999", "atrium-x", "atrium-99999999999"] {
            let error = name.parse::<SceneKind>().unwrap_err();
            assert!(error.to_string().contains("cornell-box"), "{error}");
        }
    }

    #[test]
    fn only_an_atrium_has_a_choice_of_triangles() {
        let atrium: SceneKind = "atrium".parse().unwrap();
        assert_eq!(atrium.with_triangles(50_000), Ok(SceneKind::Atrium { triangles: 50_000 }));
        assert!(matches!(atrium.with_triangles(9), Err(TrianglesError::OutOfRange { triangles: 9 })));
        assert!(matches!(SceneKind::Caustic.with_triangles(50_000), Err(TrianglesError::Fixed { .. })));
    }

    #[test]
    fn a_scene_is_never_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        write(SceneKind::Furnace, folder.path()).unwrap();
        let error = write(SceneKind::Caustic, folder.path()).unwrap_err();
        assert!(matches!(error, GenerateError::Exists { .. }), "{error}");
    }

    #[test]
    fn glass_is_closed_and_faces_outwards() {
        for name in ["cornell-box-glass", "cornell-box-spheres", "caustic", "atrium-20000"] {
            let scene = generated(name).scene;
            let glass = |index: u32| matches!(scene.materials[index as usize].bsdf, Bsdf::Dielectric { .. });
            let (mut volume, mut area, mut count) = (0.0_f64, glam::DVec3::ZERO, 0);
            for triangle in scene.triangles.iter().filter(|triangle| glass(triangle.material)) {
                let [a, b, c] = triangle.positions.map(|corner| corner.as_dvec3());
                volume += a.dot(b.cross(c)) / 6.0;
                area += (b - a).cross(c - a);
                count += 1;
                let face = (b - a).cross(c - a).normalize().as_vec3();
                let turned = triangle.normals.iter().filter(|normal| normal.dot(face) <= 0.0).count();
                assert_eq!(turned, 0, "{name}: normals and winding agree at {a}");
            }
            assert!(count > 0, "{name} has glass");
            assert!(volume > 0.0, "{name}: the winding encloses {volume}");
            assert!(area.length() < 1e-3 * volume.powf(2.0 / 3.0), "{name}: open by {area}");
        }
    }

    #[test]
    fn lights_look_into_the_room() {
        for (name, into) in [
            ("cornell-box", Vec3::new(278.0, 273.0, 280.0)),
            ("caustic", Vec3::new(0.0, 0.5, 0.0)),
            ("atrium-20000", Vec3::new(0.0, 2.0, 0.0)),
        ] {
            let scene = generated(name).scene;
            let lamps = scene
                .triangles
                .iter()
                .filter(|t| scene.materials[t.material as usize].emission != Vec3::ZERO);
            for triangle in lamps {
                let [a, b, c] = triangle.positions;
                assert!((b - a).cross(c - a).dot(into - a) > 0.0, "{name}: a lamp at {a} looks away");
            }
        }
    }

    #[test]
    fn an_atrium_has_about_as_many_triangles_as_asked() {
        for wanted in [10_000_u32, 60_000, 250_000] {
            let count = generated(&format!("atrium-{wanted}")).scene.triangles.len() as f64;
            let ratio = count / f64::from(wanted);
            assert!((0.7..1.3).contains(&ratio), "{wanted}: got {count}");
        }
    }
}
