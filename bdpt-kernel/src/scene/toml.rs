//! scene.toml: its whole grammar (50-bdpt.md section 5), checked value by value. Never opens the files it names.

use std::collections::BTreeMap;

use glam::Vec3;
use serde::{Deserialize, de::IgnoredAny};
use toml::Spanned;

use super::{
    error::{Place, SceneError},
    model::{Bsdf, Camera, FilmSize, IOR_RANGE, MAX_COORDINATE, MAX_RADIANCE},
    source::{Source, excerpt, shortened},
    surface::{GREY, Surface, normal_incidence},
};

/// A scene.toml after every check that needs no other file.
#[derive(Debug)]
pub(crate) struct Description {
    /// Names of geometry files, and where they are named.
    pub(crate) geometry: Vec<(String, Place)>,
    pub(crate) film: FilmSize,
    pub(crate) camera: Camera,
    pub(crate) environment: Option<Vec3>,
    /// By material name.
    pub(crate) materials: BTreeMap<String, DescribedMaterial>,
}

/// Longest message of the TOML parser that an error repeats, in characters.
const MAX_REASON_CHARS: usize = 500;

/// An entry of `[materials]`.
#[derive(Debug)]
pub(crate) struct DescribedMaterial {
    pub(crate) surface: Surface,
    pub(crate) place: Place,
}

impl Description {
    /// Reads a scene.toml's text.
    pub(crate) fn parse(source: &Source) -> Result<Self, SceneError> {
        let raw: Result<RawScene, _> =
            toml::from_str(&source.text).map_err(|error| description_error(source, error));
        let check = Check::new(source);
        // Whatever else is wrong, and with whatever keys: a light cannot be rendered.
        if let Ok(Lights { light: Some(light) }) = toml::from_str(&source.text)
            && !raw.as_ref().is_ok_and(|raw| raw.light.is_empty())
        {
            return Err(check.lights(&light, raw));
        }
        let raw = raw?;
        let geometry = raw.geometry.get_ref();
        if geometry.is_empty() {
            return Err(check.wrong(&raw.geometry, "geometry", "names no file"));
        }
        Ok(Self {
            geometry: geometry.iter().map(|name| (name.get_ref().clone(), check.place(name))).collect(),
            film: check.film(&raw.film)?,
            camera: check.camera(&raw.camera)?,
            environment: raw.environment.as_ref().map(|sky| check.environment(sky)).transpose()?.flatten(),
            materials: raw
                .materials
                .iter()
                .map(|(name, raw)| {
                    let surface = check.material(name.get_ref(), raw)?;
                    Ok((name.get_ref().clone(), DescribedMaterial { surface, place: check.place(name) }))
                })
                .collect::<Result<_, SceneError>>()?,
        })
    }
}

fn description_error(source: &Source, mut error: toml::de::Error) -> SceneError {
    let place = error.span().map(|span| source.offset(span.start));
    // It may name a key, however long. Without its input the error prints as one message and the key's path; the line is ours to show.
    error.set_input(None);
    let reason = shortened(&error.to_string(), MAX_REASON_CHARS).trim().replace('\n', " ");
    match place {
        None => SceneError::Description { place: Place { file: source.path.clone(), line: None }, reason },
        Some(place) => {
            let line = source.excerpt_of_line(place.line.unwrap_or(1));
            SceneError::Description { place, reason: format!("{reason}: `{line}`") }
        }
    }
}

/// Exactly three numbers. An array of serde's would let further ones pass unseen.
#[derive(Deserialize)]
#[serde(try_from = "Vec<f32>")]
struct Three([f32; 3]);

impl TryFrom<Vec<f32>> for Three {
    type Error = String;

    fn try_from(numbers: Vec<f32>) -> Result<Self, String> {
        let found = numbers.len();
        numbers.try_into().map(Self).map_err(|_| format!("needs exactly 3 numbers, found {found}"))
    }
}

/// Whether there are lights, whatever they and the rest of the file say.
#[derive(Deserialize)]
struct Lights {
    light: Option<Spanned<IgnoredAny>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawScene {
    geometry: Spanned<Vec<Spanned<String>>>,
    film: RawFilm,
    camera: RawCamera,
    environment: Option<Spanned<RawEnvironment>>,
    #[serde(default)]
    light: Vec<Spanned<RawLight>>,
    #[serde(default)]
    materials: BTreeMap<Spanned<String>, RawMaterial>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawFilm {
    width: Spanned<i64>,
    height: Spanned<i64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawCamera {
    eye: Spanned<Three>,
    target: Spanned<Three>,
    up: Spanned<Three>,
    hfov_deg: Spanned<f32>,
    lens_radius: Option<Spanned<f32>>,
    focus_distance: Option<Spanned<f32>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawEnvironment {
    radiance: Option<Spanned<Three>>,
    map: Option<Spanned<String>>,
    scale: Option<Spanned<f32>>,
    rotate_deg: Option<Spanned<f32>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawLight {
    #[serde(rename = "type")]
    kind: Spanned<String>,
    position: Option<Spanned<Three>>,
    intensity: Option<Spanned<Three>>,
    direction: Option<Spanned<Three>>,
    irradiance: Option<Spanned<Three>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawMaterial {
    #[serde(rename = "type")]
    kind: Spanned<String>,
    reflectance: Option<Spanned<Three>>,
    specular: Option<Spanned<Three>>,
    emission: Option<Spanned<Three>>,
    distribution: Option<Spanned<String>>,
    alpha: Option<Spanned<f32>>,
    alpha_u: Option<Spanned<f32>>,
    alpha_v: Option<Spanned<f32>>,
    eta: Option<Spanned<Three>>,
    k: Option<Spanned<Three>>,
    ior: Option<Spanned<f32>>,
}

/// Checks values and words what is wrong with them.
struct Check<'a> {
    source: &'a Source,
    /// Offset of each line's first byte. Each file and material has a place: counting lines anew for each would take an hour for
    /// the largest file.
    line_starts: Vec<usize>,
}

impl<'a> Check<'a> {
    fn new(source: &'a Source) -> Self {
        let ends = source.text.bytes().enumerate().filter(|(_, byte)| *byte == b'\n');
        Self { source, line_starts: std::iter::once(0).chain(ends.map(|(at, _)| at + 1)).collect() }
    }

    fn place<T>(&self, value: &Spanned<T>) -> Place {
        self.place_of(value.span().start)
    }

    fn place_of(&self, offset: usize) -> Place {
        self.source.line(self.line_starts.partition_point(|start| *start <= offset))
    }

    fn wrong<T>(&self, value: &Spanned<T>, key: &str, reason: impl Into<String>) -> SceneError {
        SceneError::Value { place: self.place(value), key: key.to_owned(), reason: reason.into() }
    }

    fn unsupported<T>(&self, value: &Spanned<T>, what: impl Into<String>) -> SceneError {
        SceneError::Unsupported { place: self.place(value), what: what.into() }
    }

    /// Three numbers that each fulfil `good`, else "must be `needs`".
    fn rgb(
        &self,
        value: &Spanned<Three>,
        key: &str,
        needs: &str,
        good: impl Fn(f32) -> bool,
    ) -> Result<Vec3, SceneError> {
        match value.get_ref().0.iter().find(|number| !good(**number)) {
            Some(number) => Err(self.wrong(value, key, format!("{number} must be {needs}"))),
            None => Ok(Vec3::from(value.get_ref().0)),
        }
    }

    fn finite3(&self, value: &Spanned<Three>, key: &str) -> Result<Vec3, SceneError> {
        self.rgb(value, key, "finite", f32::is_finite)
    }

    fn radiance(&self, value: &Spanned<Three>, key: &str) -> Result<Vec3, SceneError> {
        let needs = format!("finite, not negative and at most {MAX_RADIANCE:e}");
        self.rgb(value, key, &needs, |number| (0.0..=MAX_RADIANCE).contains(&number))
    }

    /// A point or direction of the camera.
    fn coordinates(&self, value: &Spanned<Three>, key: &str) -> Result<Vec3, SceneError> {
        let needs = format!("finite and at most {MAX_COORDINATE:e} from 0");
        self.rgb(value, key, &needs, |number| number.abs() <= MAX_COORDINATE)
    }

    fn reflectance(&self, value: &Spanned<Three>, key: &str) -> Result<Vec3, SceneError> {
        self.rgb(value, key, "in 0..1", |number| (0.0..=1.0).contains(&number))
    }

    fn number(
        &self,
        value: &Spanned<f32>,
        key: &str,
        needs: &str,
        good: impl Fn(f32) -> bool,
    ) -> Result<f32, SceneError> {
        let number = *value.get_ref();
        if good(number) {
            Ok(number)
        } else {
            Err(self.wrong(value, key, format!("{number} must be {needs}")))
        }
    }

    fn positive(&self, value: &Spanned<f32>, key: &str) -> Result<f32, SceneError> {
        self.number(value, key, "positive and finite", |number| number.is_finite() && number > 0.0)
    }

    fn ior(&self, value: &Spanned<f32>, key: &str) -> Result<f32, SceneError> {
        let needs = format!("positive, in {}..{}", IOR_RANGE.start(), IOR_RANGE.end());
        self.number(value, key, &needs, |number| IOR_RANGE.contains(&number))
    }

    fn film(&self, raw: &RawFilm) -> Result<FilmSize, SceneError> {
        let edge = |value: &Spanned<i64>, key: &str| {
            let px = u32::try_from(*value.get_ref()).unwrap_or(0);
            if (1..=FilmSize::MAX_EDGE_PX).contains(&px) {
                return Ok(px);
            }
            let reason = format!("{} must be in 1..{} pixels", value.get_ref(), FilmSize::MAX_EDGE_PX);
            Err(self.wrong(value, key, reason))
        };
        let (width_px, height_px) = (edge(&raw.width, "film.width")?, edge(&raw.height, "film.height")?);
        FilmSize::new(width_px, height_px).map_err(|error| self.wrong(&raw.width, "film", error.to_string()))
    }

    fn camera(&self, raw: &RawCamera) -> Result<Camera, SceneError> {
        let eye = self.coordinates(&raw.eye, "camera.eye")?;
        let target = self.coordinates(&raw.target, "camera.target")?;
        let up = self.coordinates(&raw.up, "camera.up")?;
        let range = Camera::HFOV_RANGE_DEG;
        let needs = format!("between {} and {} degrees", range.start(), range.end());
        let hfov_deg =
            self.number(&raw.hfov_deg, "camera.hfov_deg", &needs, |degrees| range.contains(&degrees))?;
        let axis = (target - eye).as_dvec3();
        if axis.length_squared() == 0.0 {
            return Err(self.wrong(
                &raw.target,
                "camera.target",
                "equals camera.eye: the camera looks nowhere",
            ));
        }
        if up == Vec3::ZERO {
            return Err(self.wrong(&raw.up, "camera.up", "must not be zero"));
        }
        // A sine of the angle below 1e-6 leaves no digits for the image's horizontal axis in single precision.
        if axis.normalize().cross(up.as_dvec3().normalize()).length() < 1e-6 {
            return Err(self.wrong(
                &raw.up,
                "camera.up",
                "is parallel to the view axis (camera.eye to camera.target)",
            ));
        }
        if let Some(distance) = &raw.focus_distance {
            self.positive(distance, "camera.focus_distance")?;
        }
        if let Some(radius) = &raw.lens_radius {
            let wide = self.number(radius, "camera.lens_radius", "finite and not negative", |number| {
                number.is_finite() && number >= 0.0
            })?;
            if wide > 0.0 {
                return Err(self.unsupported(radius, "a thin lens (camera.lens_radius)"));
            }
        }
        Ok(Camera { eye, target, up, hfov_deg })
    }

    fn environment(&self, raw: &Spanned<RawEnvironment>) -> Result<Option<Vec3>, SceneError> {
        let sky = raw.get_ref();
        if let Some(map) = &sky.map {
            return Err(self.unsupported(map, "an environment map (environment.map)"));
        }
        for (key, value) in [("environment.scale", &sky.scale), ("environment.rotate_deg", &sky.rotate_deg)] {
            if let Some(value) = value {
                return Err(self.wrong(value, key, "belongs to environment.map, which is not given"));
            }
        }
        let Some(radiance) = &sky.radiance else {
            return Err(self.wrong(raw, "environment", "needs `radiance`"));
        };
        let radiance = self.radiance(radiance, "environment.radiance")?;
        Ok((radiance != Vec3::ZERO).then_some(radiance))
    }

    /// Lights cannot be rendered: that comes first, then what is wrong besides.
    fn lights(&self, at: &Spanned<IgnoredAny>, raw: Result<RawScene, SceneError>) -> SceneError {
        let (place, mistake) = match raw {
            Err(mistake) => (self.place(at), mistake),
            Ok(raw) => match self.light(&raw.light[0]) {
                regret @ SceneError::Unsupported { .. } => return regret,
                mistake => (self.place(&raw.light[0]), mistake),
            },
        };
        let mistake = Box::new(mistake);
        SceneError::UnsupportedAndWrong { place, what: "a light ([[light]])".to_owned(), mistake }
    }

    fn light(&self, raw: &Spanned<RawLight>) -> SceneError {
        let light = raw.get_ref();
        let (needed, other) = match light.kind.get_ref().as_str() {
            "point" => {
                let needed = [("light.position", &light.position), ("light.intensity", &light.intensity)];
                (needed, [("light.direction", &light.direction), ("light.irradiance", &light.irradiance)])
            }
            "directional" => {
                let needed = [("light.direction", &light.direction), ("light.irradiance", &light.irradiance)];
                (needed, [("light.position", &light.position), ("light.intensity", &light.intensity)])
            }
            kind => {
                let reason = format!("unknown type \"{}\": point or directional", excerpt(kind));
                return self.wrong(&light.kind, "light.type", reason);
            }
        };
        let kind = light.kind.get_ref();
        for (key, value) in needed {
            match value {
                None => return self.wrong(raw, key, format!("is missing (a {kind} light needs it)")),
                Some(value) => {
                    if let Err(error) = self.finite3(value, key) {
                        return error;
                    }
                }
            }
        }
        for (key, value) in other {
            if let Some(value) = value {
                return self.wrong(value, key, format!("does not belong to a {kind} light"));
            }
        }
        self.unsupported(raw, format!("a {kind} light ([[light]])"))
    }

    fn material(&self, name: &str, raw: &RawMaterial) -> Result<Surface, SceneError> {
        let key = |key: &str| format!("materials.\"{}\".{key}", excerpt(name));
        let kind = raw.kind.get_ref().as_str();
        let allowed: &[&str] = match kind {
            "diffuse" | "mirror" => &["reflectance"],
            "dielectric" => &["ior"],
            "rough_dielectric" => &["ior", "distribution", "alpha", "alpha_u", "alpha_v"],
            "conductor" => &["reflectance", "eta", "k"],
            "rough_conductor" => &["reflectance", "eta", "k", "distribution", "alpha", "alpha_u", "alpha_v"],
            "ashikhmin_shirley" => &["reflectance", "specular", "alpha", "alpha_u", "alpha_v"],
            unknown => {
                let reason = format!(
                    "unknown type \"{}\": diffuse, ashikhmin_shirley, conductor, rough_conductor, mirror, dielectric or \
                     rough_dielectric",
                    excerpt(unknown)
                );
                return Err(self.wrong(&raw.kind, &key("type"), reason));
            }
        };
        self.belong(raw, kind, allowed, &key)?;

        let reflectance = raw.reflectance.as_ref().map(|value| self.reflectance(value, &key("reflectance")));
        let reflectance = reflectance.transpose()?;
        let specular =
            raw.specular.as_ref().map(|value| self.reflectance(value, &key("specular"))).transpose()?;
        let ior = raw.ior.as_ref().map(|value| self.ior(value, &key("ior"))).transpose()?;
        let fresnel = self.fresnel(raw, &key)?;
        self.roughness(raw, kind, &key)?;

        let surface = match kind {
            "diffuse" => Surface::of(Bsdf::Diffuse { reflectance: reflectance.unwrap_or(GREY) }),
            "mirror" => Surface::of(Bsdf::Mirror { reflectance: reflectance.unwrap_or(Vec3::ONE) }),
            "dielectric" => match ior {
                Some(ior) => Surface::of(Bsdf::Dielectric { ior }),
                None => return Err(self.wrong(&raw.kind, &key("ior"), "is missing (a dielectric needs it)")),
            },
            "conductor" | "rough_conductor" => {
                Surface::instead_of(kind, fresnel.unwrap_or(Vec3::ONE) * reflectance.unwrap_or(Vec3::ONE))
            }
            "ashikhmin_shirley" => {
                Surface::instead_of(kind, reflectance.unwrap_or(GREY) + specular.unwrap_or(Vec3::ZERO))
            }
            _ => Surface::instead_of(kind, GREY),
        };
        let emission =
            raw.emission.as_ref().map(|value| self.radiance(value, &key("emission"))).transpose()?;
        Ok(Surface { emission: emission.unwrap_or(Vec3::ZERO), ..surface })
    }

    /// A known key in the wrong place is as unknown there as any other.
    fn belong(
        &self,
        raw: &RawMaterial,
        kind: &str,
        allowed: &[&str],
        key: &impl Fn(&str) -> String,
    ) -> Result<(), SceneError> {
        let given = [
            ("reflectance", raw.reflectance.as_ref().map(Spanned::span)),
            ("specular", raw.specular.as_ref().map(Spanned::span)),
            ("distribution", raw.distribution.as_ref().map(Spanned::span)),
            ("alpha", raw.alpha.as_ref().map(Spanned::span)),
            ("alpha_u", raw.alpha_u.as_ref().map(Spanned::span)),
            ("alpha_v", raw.alpha_v.as_ref().map(Spanned::span)),
            ("eta", raw.eta.as_ref().map(Spanned::span)),
            ("k", raw.k.as_ref().map(Spanned::span)),
            ("ior", raw.ior.as_ref().map(Spanned::span)),
        ];
        for (name, span) in given {
            if let (Some(span), false) = (span, allowed.contains(&name)) {
                let reason =
                    format!("does not belong to type \"{kind}\" (which takes {})", allowed.join(", "));
                return Err(SceneError::Value { place: self.place_of(span.start), key: key(name), reason });
            }
        }
        Ok(())
    }

    /// Normal-incidence colour from eta and k; `None` without them: Fresnel is 1.
    fn fresnel(&self, raw: &RawMaterial, key: &impl Fn(&str) -> String) -> Result<Option<Vec3>, SceneError> {
        match (&raw.eta, &raw.k) {
            (None, None) => Ok(None),
            (Some(eta), Some(k)) => {
                let positive = |number: f32| number.is_finite() && number > 0.0;
                let eta = self.rgb(eta, &key("eta"), "positive and finite", positive)?;
                let k = self.radiance(k, &key("k"))?;
                Ok(Some(normal_incidence(eta, k)))
            }
            (Some(eta), None) => Err(self.wrong(eta, &key("eta"), "needs `k` too")),
            (None, Some(k)) => Err(self.wrong(k, &key("k"), "needs `eta` too")),
        }
    }

    fn roughness(
        &self,
        raw: &RawMaterial,
        kind: &str,
        key: &impl Fn(&str) -> String,
    ) -> Result<(), SceneError> {
        if let Some(distribution) = &raw.distribution
            && !["ggx", "beckmann"].contains(&distribution.get_ref().as_str())
        {
            let reason =
                format!("unknown distribution \"{}\": ggx or beckmann", excerpt(distribution.get_ref()));
            return Err(self.wrong(distribution, &key("distribution"), reason));
        }
        for (name, value) in [("alpha", &raw.alpha), ("alpha_u", &raw.alpha_u), ("alpha_v", &raw.alpha_v)] {
            if let Some(value) = value {
                self.number(value, &key(name), "in 0..1, not 0", |alpha| alpha > 0.0 && alpha <= 1.0)?;
            }
        }
        match (&raw.alpha, &raw.alpha_u, &raw.alpha_v) {
            (Some(alpha), Some(_), _) | (Some(alpha), _, Some(_)) => {
                Err(self.wrong(alpha, &key("alpha"), "and alpha_u, alpha_v exclude each other"))
            }
            (None, Some(one), None) | (None, None, Some(one)) => {
                Err(self.wrong(one, &key("alpha_u"), "and alpha_v belong together"))
            }
            (None, None, None) if kind.starts_with("rough_") => {
                Err(self.wrong(&raw.kind, &key("alpha"), format!("is missing (a {kind} needs it)")))
            }
            _ => Ok(()),
        }
    }
}
