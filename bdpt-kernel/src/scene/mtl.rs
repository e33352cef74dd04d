//! Material libraries (MTL): every statement is read, mapped to what renders, or named in a warning.
//!
//! | library says | rendered as |
//! |---|---|
//! | `d` < 1 (or `Tr` > 0) or `illum` 4, 6, 7, 9, with an `Ni` in 0.01..100 that is not 1 | smooth dielectric of that `Ni` |
//! | `illum` 5; or black `Kd` and a `Ks` with `illum` 3, 8 or `Ns` >= 1000 | mirror of `Ks` |
//! | any `Ke` | emission, beside the rest |
//! | else without `Ks`, PBR keys or transparency | diffuse of `Kd` (absent: grey; black if it emits) |
//! | gloss (`Ks` beside `Kd`, low `Ns`), PBR (`Pr Pm Ps Pc aniso`), transparency without `Ni`, unknown `illum` | diffuse of `Kd` (black: `Ks`), named in a warning |
//!
//! Textures (`map_*`, `bump`, `disp`, `decal`, `refl`, `norm`) and `Tf` are ignored with a warning. Reading is ours: `tobj`'s
//! panics on `Kd 0.5`, and the check before it, which needs every number and its line, would leave it nothing to do.

use std::collections::BTreeMap;

use glam::Vec3;

use super::{
    error::SceneError,
    model::{Bsdf, IOR_RANGE, MAX_RADIANCE},
    source::{Source, excerpt},
    surface::{GREY, Surface},
    toml::DescribedMaterial,
};

/// A specular exponent from which a highlight is taken for a mirror image.
const MIRROR_EXPONENT: f32 = 1_000.0;

/// A parsed library.
#[derive(Debug, Default)]
pub(crate) struct Library {
    pub(crate) materials: BTreeMap<String, DescribedMaterial>,
    pub(crate) warnings: Vec<String>,
}

/// One `newmtl` block as written.
#[derive(Debug, Default)]
struct Block {
    name: String,
    line: usize,
    diffuse: Option<Vec3>,
    specular: Option<Vec3>,
    emission: Option<Vec3>,
    filter: Option<Vec3>,
    exponent: Option<f32>,
    index: Option<f32>,
    dissolve: Option<f32>,
    illumination: Option<u32>,
    /// PBR keys that ask for something other than plain diffuse.
    pbr: Vec<&'static str>,
    textures: Vec<String>,
}

impl Library {
    /// Reads a library's text.
    pub(crate) fn parse(source: &Source) -> Result<Self, SceneError> {
        let mut library = Self::default();
        let mut unknown: Option<(usize, String, usize)> = None;
        let mut block: Option<Block> = None;
        for (index, text) in source.text.split('\n').enumerate() {
            let line = index + 1;
            let text = text.trim();
            let (statement, rest) = text.split_once(char::is_whitespace).unwrap_or((text, ""));
            let rest = rest.trim();
            if statement.is_empty() || statement.starts_with('#') {
                continue;
            }
            if statement == "newmtl" {
                library.keep(source, block.take());
                if rest.is_empty() {
                    return Err(fault(source, line, None, "`newmtl` needs a name"));
                }
                block = Some(Block { name: rest.to_owned(), line, ..Block::default() });
                continue;
            }
            let Some(block) = block.as_mut() else {
                return Err(fault(
                    source,
                    line,
                    None,
                    format!("`{}` before any `newmtl`", excerpt(statement)),
                ));
            };
            let known = block
                .read(statement, rest)
                .map_err(|reason| fault(source, line, Some(&block.name), reason))?;
            if let Some(index) = block.index.filter(|index| !IOR_RANGE.contains(index)) {
                let (place, name) = (source.line(line), &block.name);
                let (least, most) = (IOR_RANGE.start(), IOR_RANGE.end());
                library.warnings.push(format!(
                    "{place}: material \"{name}\": `Ni` {index} is not in {least}..{most}: ignored"
                ));
                block.index = None;
            }
            if !known {
                unknown.get_or_insert_with(|| (line, excerpt(statement), 0)).2 += 1;
            }
        }
        library.keep(source, block.take());
        if let Some((line, statement, count)) = unknown {
            let place = source.line(line);
            library
                .warnings
                .push(format!("{place}: {count} unknown statements ignored, the first is `{statement}`"));
        }
        Ok(library)
    }

    fn keep(&mut self, source: &Source, block: Option<Block>) {
        let Some(block) = block else { return };
        let place = source.line(block.line);
        let material = DescribedMaterial { surface: block.surface(), place: place.clone() };
        if self.materials.insert(block.name.clone(), material).is_some() {
            self.warnings
                .push(format!("{place}: material \"{}\" is defined again: the later one counts", block.name));
        }
    }
}

fn fault(source: &Source, line: usize, material: Option<&str>, fault: impl Into<String>) -> SceneError {
    let material = material.map(excerpt);
    SceneError::MaterialLibrary { place: source.line(line), material, fault: fault.into() }
}

impl Block {
    /// Takes a statement in; `false` when it is unknown.
    fn read(&mut self, statement: &str, rest: &str) -> Result<bool, String> {
        match statement {
            "Ka" => drop(colour(statement, rest)?),
            "Kd" => self.diffuse = Some(colour(statement, rest)?),
            "Ks" => self.specular = Some(colour(statement, rest)?),
            "Ke" => {
                let emission = colour(statement, rest)?;
                if emission.max_element() > MAX_RADIANCE {
                    return Err(format!("`Ke` must be at most {MAX_RADIANCE:e}, found `{}`", excerpt(rest)));
                }
                self.emission = Some(emission);
            }
            "Tf" => self.filter = Some(colour(statement, rest)?),
            "Ns" => self.exponent = Some(number(statement, rest)?),
            "Ni" => self.index = Some(number(statement, rest)?),
            "d" => self.dissolve = Some(number(statement, rest.trim_start_matches("-halo"))?),
            "Tr" => self.dissolve = Some(1.0 - number(statement, rest)?),
            "illum" => {
                let model = rest.split_whitespace().next().unwrap_or("");
                let model = model
                    .parse()
                    .map_err(|_| format!("`illum` needs a whole number, found `{}`", excerpt(rest)))?;
                self.illumination = Some(model);
            }
            "Pr" => self.physical("Pr", number(statement, rest)? < 1.0),
            "Pm" => self.physical("Pm", number(statement, rest)? > 0.0),
            "Ps" => self.physical("Ps", colour(statement, rest)?.max_element() > 0.0),
            "Pc" => self.physical("Pc", number(statement, rest)? > 0.0),
            "aniso" => self.physical("aniso", number(statement, rest)? > 0.0),
            "Pcr" | "anisor" | "sharpness" => drop(number(statement, rest)?),
            "bump" | "disp" | "decal" | "refl" | "norm" => self.textures.push(statement.to_owned()),
            _ if statement.starts_with("map_") => self.textures.push(excerpt(statement)),
            _ => return Ok(false),
        }
        Ok(true)
    }

    fn physical(&mut self, key: &'static str, asks: bool) {
        if asks {
            self.pbr.push(key);
        }
    }

    fn surface(&self) -> Surface {
        let emission = self.emission.unwrap_or(Vec3::ZERO);
        let unset = if emission == Vec3::ZERO { GREY } else { Vec3::ZERO };
        let diffuse = self.diffuse.unwrap_or(unset);
        let specular = self.specular.unwrap_or(Vec3::ZERO);
        let mut ignored: Vec<String> = self
            .textures
            .iter()
            .map(|texture| format!("texture `{texture}` is not supported yet: ignored"))
            .collect();

        let surface = if self.is_transparent() {
            self.transparent(diffuse, &mut ignored)
        } else if self.is_mirror(diffuse, specular) {
            Surface::of(Bsdf::Mirror {
                reflectance: capped("Ks", self.specular.unwrap_or(Vec3::ONE), &mut ignored),
            })
        } else {
            let (key, colour) = if diffuse == Vec3::ZERO && specular != Vec3::ZERO {
                ("Ks", specular)
            } else {
                ("Kd", diffuse)
            };
            let colour = capped(key, colour, &mut ignored);
            match self.gloss(specular) {
                Some(look) => Surface::instead_of(&look, colour),
                None => Surface::of(Bsdf::Diffuse { reflectance: colour }),
            }
        };
        Surface { emission, ignored, ..surface }
    }

    fn is_transparent(&self) -> bool {
        self.dissolve.is_some_and(|opaque| opaque < 1.0) || matches!(self.illumination, Some(4 | 6 | 7 | 9))
    }

    fn transparent(&self, diffuse: Vec3, ignored: &mut Vec<String>) -> Surface {
        match self.index {
            Some(ior) if (ior - 1.0).abs() > f32::EPSILON => {
                if self.filter.is_some_and(|filter| filter != Vec3::ONE) {
                    ignored.push("`Tf` (coloured glass) is not supported yet: ignored".to_owned());
                }
                Surface::of(Bsdf::Dielectric { ior })
            }
            _ => Surface::instead_of("transparent without an `Ni`", capped("Kd", diffuse, ignored)),
        }
    }

    fn is_mirror(&self, diffuse: Vec3, specular: Vec3) -> bool {
        let sharp = self.exponent.is_some_and(|exponent| exponent >= MIRROR_EXPONENT);
        let pure = diffuse == Vec3::ZERO && specular != Vec3::ZERO;
        self.illumination == Some(5) || pure && (sharp || matches!(self.illumination, Some(3 | 8)))
    }

    /// The look beyond plain diffuse that the block asks for.
    fn gloss(&self, specular: Vec3) -> Option<String> {
        match self.illumination {
            _ if !self.pbr.is_empty() => Some(self.pbr.join(" ")),
            Some(model @ 10..) => Some(format!("illum {model}")),
            // 0 and 1 are without highlights, whatever Ks says.
            Some(0 | 1) => None,
            _ => (specular != Vec3::ZERO).then(|| "glossy Ks".to_owned()),
        }
    }
}

/// A reflectance of at most 1; more would make energy.
fn capped(key: &str, colour: Vec3, ignored: &mut Vec<String>) -> Vec3 {
    if colour.max_element() > 1.0 {
        ignored.push(format!("`{key}` above 1 is cut to 1"));
    }
    colour.min(Vec3::ONE)
}

/// Three numbers, or one for all three; not negative.
fn colour(statement: &str, rest: &str) -> Result<Vec3, String> {
    let wrong = || {
        format!("`{statement}` needs 3 numbers that are finite and not negative, found `{}`", excerpt(rest))
    };
    let mut numbers = Vec::with_capacity(3);
    for word in rest.split_whitespace().take_while(|word| !word.starts_with('#')).take(3) {
        let value: f32 = word.parse().map_err(|_| wrong())?;
        if !value.is_finite() || value < 0.0 {
            return Err(wrong());
        }
        numbers.push(value);
    }
    match numbers[..] {
        [all] => Ok(Vec3::splat(all)),
        [red, green, blue] => Ok(Vec3::new(red, green, blue)),
        _ => Err(wrong()),
    }
}

fn number(statement: &str, rest: &str) -> Result<f32, String> {
    let word = rest.split_whitespace().next().unwrap_or("");
    word.parse()
        .ok()
        .filter(|value: &f32| value.is_finite())
        .ok_or_else(|| format!("`{statement}` needs a finite number, found `{}`", excerpt(rest)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Library, SceneError> {
        Library::parse(&Source { path: "a.mtl".into(), text: text.to_owned() })
    }

    fn surface(text: &str) -> Surface {
        let mut library = parse(&format!("newmtl m\n{text}")).unwrap();
        library.materials.remove("m").unwrap().surface
    }

    #[test]
    fn blocks_become_what_the_table_says() {
        let half = Vec3::splat(0.5);
        let diffuse = |reflectance| Bsdf::Diffuse { reflectance };
        for (text, bsdf, fallback) in [
            ("Kd 0.1 0.2 0.3", diffuse(Vec3::new(0.1, 0.2, 0.3)), None),
            ("Kd 0.5", diffuse(half), None),
            ("", diffuse(GREY), None),
            ("Ke 1 1 1", diffuse(Vec3::ZERO), None),
            ("Kd 0 0 0\nKs .5 .5 .5\nillum 3", Bsdf::Mirror { reflectance: half }, None),
            ("Kd 0 0 0\nKs .5 .5 .5\nNs 5000", Bsdf::Mirror { reflectance: half }, None),
            ("illum 5", Bsdf::Mirror { reflectance: Vec3::ONE }, None),
            ("Kd 0 0 0\nNi 1.5\nillum 7", Bsdf::Dielectric { ior: 1.5 }, None),
            ("Ni 0.763\nillum 7", Bsdf::Dielectric { ior: 0.763 }, None),
            ("Ni 1.33\nd 0.5", Bsdf::Dielectric { ior: 1.33 }, None),
            ("Ni 1.33\nTr 0.5", Bsdf::Dielectric { ior: 1.33 }, None),
            ("Kd .5 .5 .5\nNi 1.45\nd 1.0\nillum 2", diffuse(half), None),
            ("Kd .5 .5 .5\nd 0.5", diffuse(half), Some("transparent without an `Ni`")),
            ("Kd .5 .5 .5\nKs 1 1 1\nNs 50\nillum 2", diffuse(half), Some("glossy Ks")),
            ("Kd .5 .5 .5\nKs 1 1 1\nillum 1", diffuse(half), None),
            ("Kd 0 0 0\nKs .5 .5 .5\nNs 50", diffuse(half), Some("glossy Ks")),
            ("Kd .5 .5 .5\nPr 0.2\nPm 1", diffuse(half), Some("Pr Pm")),
            ("Kd .5 .5 .5\nPr 1\nPm 0", diffuse(half), None),
            ("Kd .5 .5 .5\nillum 42", diffuse(half), Some("illum 42")),
        ] {
            let got = surface(text);
            assert_eq!((got.bsdf, got.fallback.as_deref()), (bsdf, fallback), "{text:?}");
        }
    }

    #[test]
    fn what_is_dropped_is_told() {
        let textured = surface("Kd 2 1 1\nmap_Kd wood.png\nbump b.png");
        assert_eq!(textured.bsdf, Bsdf::Diffuse { reflectance: Vec3::ONE });
        assert_eq!(textured.ignored.len(), 3, "two textures and a cut: {:?}", textured.ignored);
        let library = parse("newmtl a\nfoo 1\nbar 2\nnewmtl a\nKd 1 1 1").unwrap();
        assert_eq!(library.warnings.len(), 2, "{:?}", library.warnings);
        assert!(library.warnings[1].starts_with("a.mtl:2: 2 unknown statements"), "{:?}", library.warnings);
    }

    #[test]
    fn faults_name_file_line_and_material() {
        for (text, place) in [
            ("newmtl", "a.mtl:1: `newmtl` needs a name"),
            ("Kd 1 1 1", "a.mtl:1: `Kd` before any `newmtl`"),
            ("newmtl m\nKd 1 1", "a.mtl:2: material \"m\": `Kd` needs 3 numbers"),
            ("newmtl m\nKd", "a.mtl:2: material \"m\": `Kd` needs 3 numbers"),
            ("newmtl m\n\nKd nan 0 0", "a.mtl:3: material \"m\": `Kd` needs 3 numbers"),
            ("newmtl m\nKe -1 0 0", "a.mtl:2: material \"m\": `Ke` needs 3 numbers"),
            ("newmtl m\nKd spectral x.rfl", "a.mtl:2: material \"m\": `Kd` needs 3 numbers"),
            ("newmtl m\nNi inf", "a.mtl:2: material \"m\": `Ni` needs a finite number"),
            ("newmtl m\nillum bright", "a.mtl:2: material \"m\": `illum` needs a whole number"),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.starts_with(place), "{text:?}: {error}");
        }
    }
}
