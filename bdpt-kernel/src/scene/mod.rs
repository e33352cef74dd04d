//! Scenes: the model after loading, and how files become it.
//!
//! A scene is a folder with a `scene.toml` and the OBJ and MTL files that it names. Loading checks everything before anything is
//! rendered: an error names file, line, object and key; what is left out or replaced is counted and named in the
//! report. Nothing outside the scene's folder is read.

mod error;
pub mod model;
mod mtl;
mod obj;
mod scan;
mod source;
mod surface;
mod toml;

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use glam::Vec3;

pub use self::error::{GeometryFault, Place, SceneError};
use self::{
    model::{Bsdf, Material, Scene},
    mtl::Library,
    obj::Geometry,
    scan::{MAX_TRIANGLES, UsedMaterial},
    source::{Source, excerpt, path_inside},
    surface::{GREY, Surface},
    toml::{DescribedMaterial, Description},
};

/// Name of the file that makes a folder a scene.
pub const SCENE_FILE: &str = "scene.toml";

/// Largest scene.toml.
const MAX_DESCRIPTION_BYTES: u64 = 16 << 20;
/// Largest OBJ file.
const MAX_GEOMETRY_BYTES: u64 = 8 << 30;
/// Largest MTL file.
const MAX_LIBRARY_BYTES: u64 = 64 << 20;
/// Longest name of a file in a scene's files, in bytes: Linux' `PATH_MAX`.
const MAX_PATH_BYTES: usize = 4_096;
/// Most materials of all geometry files together. A file can be named again and again, and each time brings its materials.
const MAX_MATERIALS: usize = 1 << 20;
/// Most warnings kept; further ones are counted.
const MAX_WARNINGS: usize = 500;

/// A scene and what happened on the way to it.
#[derive(Clone, Debug)]
pub struct LoadedScene {
    /// The scene.
    pub scene: Scene,
    /// What was counted, replaced and left out.
    pub report: LoadReport,
}

/// What loading a scene came across.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LoadReport {
    /// The scene file.
    pub file: PathBuf,
    /// Triangles left out because they have no area.
    pub degenerate_triangles: usize,
    /// Materials that are rendered as diffuse instead of what the files ask for.
    pub fallback_materials: usize,
    /// Triangles that emit light.
    pub emitting_triangles: usize,
    /// What the user should know, one sentence each, naming file or material.
    pub warnings: Vec<String>,
    /// Warnings beyond the bound on `warnings`.
    pub warnings_dropped: usize,
    /// Time spent reading and checking.
    pub load_time: Duration,
}

impl LoadReport {
    fn warn(&mut self, warning: String) {
        if self.warnings.len() < MAX_WARNINGS {
            self.warnings.push(warning);
        } else {
            self.warnings_dropped += 1;
        }
    }

    fn warn_counted(&mut self, count: usize, path: &Path, what: &str) {
        if count > 0 {
            self.warn(format!("{}: {count} {what}", path.display()));
        }
    }
}

/// Loads a scene from a scene.toml, or from the folder that holds one.
///
/// # Errors
/// See [`SceneError`]: the files cannot be read, do not parse, or say something that cannot be rendered.
pub fn load(path: &Path) -> Result<LoadedScene, SceneError> {
    let start = Instant::now();
    let file = scene_file(path)?;
    let source = Source::read(&file, MAX_DESCRIPTION_BYTES)?;
    let description = Description::parse(&source)?;
    let mut loader = Loader {
        description: &description,
        named: BTreeSet::new(),
        read: BTreeMap::new(),
        report: LoadReport { file: file.clone(), ..LoadReport::default() },
        scene: Scene {
            film: description.film,
            camera: description.camera,
            triangles: Vec::new(),
            materials: Vec::new(),
            environment: description.environment,
        },
    };
    for (name, place) in &description.geometry {
        loader.add_geometry(source.folder(), name, place)?;
    }
    loader.finish(&file, start)
}

fn scene_file(path: &Path) -> Result<PathBuf, SceneError> {
    let is_toml = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("toml"));
    if path.is_dir() {
        let file = path.join(SCENE_FILE);
        return if file.exists() { Ok(file) } else { Err(SceneError::NotAScene { path: path.to_owned() }) };
    }
    // A path that is not there gets the reader's error, whatever it is called.
    if is_toml || !path.exists() {
        Ok(path.to_owned())
    } else {
        Err(SceneError::NotAScene { path: path.to_owned() })
    }
}

struct Loader<'a> {
    description: &'a Description,
    /// Names that some geometry uses.
    named: BTreeSet<String>,
    /// Geometry files read, and where each is named.
    read: BTreeMap<PathBuf, Place>,
    report: LoadReport,
    scene: Scene,
}

impl Loader<'_> {
    fn add_geometry(&mut self, folder: &Path, name: &str, place: &Place) -> Result<(), SceneError> {
        let path = inside(folder, name, place, "geometry file")?;
        if !path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("obj")) {
            let what = format!("geometry file \"{name}\": only OBJ can be read, anything else");
            return Err(SceneError::Unsupported { place: place.clone(), what });
        }
        if let Some(first) = self.read.insert(path.clone(), place.clone()) {
            let twice =
                format!("{place}: geometry file \"{name}\" is named again (first at {first}): loaded twice");
            self.report.warn(twice);
        }
        let source = Source::read(&path, MAX_GEOMETRY_BYTES)?;
        let mut geometry = Geometry::parse(&source)?;
        let (report, count) = (&mut self.report, geometry.degenerate);
        report.degenerate_triangles += count;
        report.warn_counted(count, &path, "degenerate triangles (no area) left out");
        report.warn_counted(
            geometry.replaced_normals,
            &path,
            "unusable vertex normals replaced by the face's",
        );
        report.warn_counted(
            geometry.turned_normals,
            &path,
            "triangles with normals against their winding turned round",
        );
        report.warn_counted(geometry.concave, &path, "concave polygons triangulated as fans");
        geometry.warnings.drain(..).for_each(|warning| report.warn(warning));

        let libraries = self.libraries(&source, &geometry.libraries)?;
        let too_many = |what, most| {
            let fault = GeometryFault::TooMany { what, most };
            SceneError::Geometry { place: place.clone(), object: None, fault }
        };
        if self.scene.materials.len() + geometry.materials.len() > MAX_MATERIALS {
            return Err(too_many("materials", MAX_MATERIALS));
        }
        let first = u32::try_from(self.scene.materials.len()).expect("bounded by MAX_MATERIALS");
        for used in &geometry.materials {
            let material = self.material(&source, used, libraries.as_ref())?;
            self.scene.materials.push(material);
        }
        if self.scene.triangles.len() + geometry.triangles.len() > MAX_TRIANGLES {
            return Err(too_many("triangles", MAX_TRIANGLES));
        }
        geometry.triangles.iter_mut().for_each(|triangle| triangle.material += first);
        if self.scene.triangles.is_empty() {
            self.scene.triangles = geometry.triangles;
        } else {
            self.scene.triangles.append(&mut geometry.triangles);
        }
        Ok(())
    }

    /// The materials of the libraries that a file names; `None` when it names none.
    fn libraries(
        &mut self,
        source: &Source,
        names: &[(String, usize)],
    ) -> Result<Option<BTreeMap<String, DescribedMaterial>>, SceneError> {
        let mut all = None;
        let mut read = BTreeSet::new();
        for (name, line) in names {
            for path in library_paths(source, name, &source.line(*line))? {
                if !read.insert(path.clone()) {
                    continue;
                }
                let library = Library::parse(&Source::read(&path, MAX_LIBRARY_BYTES)?)?;
                library.warnings.into_iter().for_each(|warning| self.report.warn(warning));
                let all = all.get_or_insert_with(BTreeMap::new);
                for (name, material) in library.materials {
                    let place = material.place.clone();
                    if all.insert(name.clone(), material).is_some() {
                        let again = "is defined again: the later one counts";
                        self.report.warn(format!("{place}: material \"{name}\" {again}"));
                    }
                }
            }
        }
        Ok(all)
    }

    /// What a used name means: scene.toml first, then the libraries.
    fn material(
        &mut self,
        source: &Source,
        used: &UsedMaterial,
        libraries: Option<&BTreeMap<String, DescribedMaterial>>,
    ) -> Result<Material, SceneError> {
        let grey = Surface::of(Bsdf::Diffuse { reflectance: GREY });
        let place = source.line(used.line);
        let Some(name) = &used.name else {
            self.report.warn(format!("{place}: faces without a material: rendered as grey diffuse"));
            return Ok(self.named_material("(no material)", &grey));
        };
        self.named.insert(name.clone());
        let described = self.description.materials.get(name).or_else(|| libraries?.get(name));
        match (described, libraries) {
            (Some(described), _) => Ok(self.named_material(name, &described.surface)),
            (None, None) => {
                self.report.warn(format!(
                    "{place}: material \"{name}\" is defined nowhere: rendered as grey diffuse"
                ));
                Ok(self.named_material(name, &grey))
            }
            (None, Some(_)) => Err(SceneError::UnknownMaterial {
                place,
                object: used.object.clone(),
                material: excerpt(name),
            }),
        }
    }

    fn named_material(&mut self, name: &str, surface: &Surface) -> Material {
        self.report.fallback_materials += usize::from(surface.fallback.is_some());
        surface.warnings(name).for_each(|warning| self.report.warn(warning));
        Material { name: name.to_owned(), bsdf: surface.bsdf, emission: surface.emission }
    }

    fn finish(mut self, file: &Path, start: Instant) -> Result<LoadedScene, SceneError> {
        for (name, material) in &self.description.materials {
            if !self.named.contains(name) {
                let place = &material.place;
                self.report.warn(format!("{place}: material \"{name}\" is used by no geometry"));
            }
        }
        let emits = |index: u32| self.scene.materials[index as usize].emission != Vec3::ZERO;
        self.report.emitting_triangles = self.scene.triangles.iter().filter(|t| emits(t.material)).count();
        if self.report.emitting_triangles == 0 && self.scene.environment.is_none() {
            return Err(SceneError::NoLight { file: file.to_owned() });
        }
        self.report.load_time = start.elapsed();
        Ok(LoadedScene { scene: self.scene, report: self.report })
    }
}

/// The path of a file that another one names: inside the folder, and there.
fn inside(folder: &Path, name: &str, place: &Place, what: &'static str) -> Result<PathBuf, SceneError> {
    let (shown, place) = (excerpt(name), place.clone());
    match path_inside(folder, name) {
        None => Err(SceneError::Outside { place, what, name: shown }),
        // No system has such a file, and no error should repeat its name.
        Some(_) if name.len() > MAX_PATH_BYTES => {
            Err(SceneError::Missing { place, what, name: shown, tried: folder.to_owned() })
        }
        Some(tried) if !tried.exists() => Err(SceneError::Missing { place, what, name: shown, tried }),
        Some(path) => Ok(path),
    }
}

/// The files of one `mtllib` line: one name, blanks and all, or else several between blanks.
fn library_paths(source: &Source, names: &str, place: &Place) -> Result<Vec<PathBuf>, SceneError> {
    const WHAT: &str = "material library";
    let whole = inside(source.folder(), names, place, WHAT);
    if whole.is_ok() || !names.contains(char::is_whitespace) {
        return whole.map(|path| vec![path]);
    }
    let mut paths = Vec::new();
    for name in names.split_whitespace() {
        match inside(source.folder(), name, place, WHAT) {
            Ok(path) => paths.push(path),
            // A name with blanks that leads nowhere is shown as written.
            Err(SceneError::Missing { .. }) => return whole.map(|path| vec![path]),
            Err(other) => return Err(other),
        }
    }
    Ok(paths)
}
