//! A scene as the bytes that the kernels read: triangles in leaf order, materials, the table of lights.

use bytemuck::{Zeroable, cast_slice};
use farm_core::program::Content;
use glam::Vec3;
use thiserror::Error;

use super::{layout, normalise::NormalisedScene};
use crate::{
    bvh::Bvh,
    scene::model::{Bsdf, Camera, Scene, Triangle},
};

/// Most levels of nodes that the traversal's stack holds: one entry a level (`STACK_SIZE` in `traverse.wgsl`).
pub const MAX_DEPTH: u32 = 32;
/// Share of light samples that the environment gets at most where emitting triangles exist. The power estimate counts the
/// whole bounding sphere, most of which walls may hide.
const ENVIRONMENT_PL_MAX: f64 = 0.5;

/// A scene that cannot be rendered. Not to be retried.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum PackError {
    /// Nothing to hit.
    #[error("the scene has no triangle")]
    NoTriangle,
    /// Nothing to see.
    #[error("the scene has no light: no material emits and there is no environment")]
    NoLight,
    /// A triangle names a material that does not exist.
    #[error("triangle {triangle} names material {material}, the scene has {materials}")]
    UnknownMaterial {
        /// Index of the triangle.
        triangle: usize,
        /// The index that it names.
        material: u32,
        /// How many there are.
        materials: usize,
    },
    /// The hierarchy is of another scene.
    #[error("the hierarchy is of another scene: {0}")]
    ForeignHierarchy(&'static str),
    /// The hierarchy is deeper than the kernels' stack.
    #[error("the hierarchy has {depth} levels, the kernels hold {MAX_DEPTH}")]
    TooDeep {
        /// Its levels.
        depth: u32,
    },
}

/// The five arrays of a scene, each one task allocation, and what the frame's uniform takes from them.
#[derive(Clone, Debug)]
pub struct PackedScene {
    /// Nodes of the hierarchy, 80 B each.
    pub nodes: Vec<u8>,
    /// Three `vec4<f32>` a triangle: corner, edge, edge.
    pub triangles: Vec<u8>,
    /// [`layout::Shading`] per triangle.
    pub shading: Vec<u8>,
    /// [`layout::Material`]s.
    pub materials: Vec<u8>,
    /// [`layout::Light`]s.
    pub lights: Vec<u8>,
    pub(crate) globals: SceneGlobals,
}

/// A scene's part of the frame's uniform.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SceneGlobals {
    pub(crate) camera: Camera,
    pub(crate) environment: Vec3,
    pub(crate) environment_pl: f32,
    pub(crate) radius: f32,
    pub(crate) light_count: u32,
    pub(crate) area_pdf_scale: f32,
    pub(crate) brightest: f32,
    pub(crate) world_per_unit: f32,
}

/// Handles of a packed scene's arrays and of the module, once the SDK has registered their bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SceneContents {
    /// [`PackedScene::nodes`].
    pub nodes: Content,
    /// [`PackedScene::triangles`].
    pub triangles: Content,
    /// [`PackedScene::shading`].
    pub shading: Content,
    /// [`PackedScene::materials`].
    pub materials: Content,
    /// [`PackedScene::lights`].
    pub lights: Content,
    /// [`super::module_source`].
    pub module: Content,
}

impl PackedScene {
    /// Packs a scene and the hierarchy over its triangles.
    ///
    /// # Errors
    /// No triangle, no light, a material index out of range, or a hierarchy that is not this scene's or too deep.
    pub fn new(normalised: &NormalisedScene, bvh: &Bvh) -> Result<Self, PackError> {
        let scene = normalised.scene();
        check(scene, bvh)?;
        let order = &bvh.cwbvh.primitive_indices;
        let in_leaf_order = || order.iter().map(|&index| &scene.triangles[index as usize]);
        let corners: Vec<[f32; 12]> = in_leaf_order().map(pack_triangle).collect();
        let shading: Vec<layout::Shading> = in_leaf_order().map(pack_shading).collect();
        let materials: Vec<layout::Material> = scene.materials.iter().map(pack_material).collect();
        let table = LightTable::new(scene, normalised.radius())?;
        let globals = SceneGlobals {
            camera: scene.camera,
            environment: scene.environment.unwrap_or(Vec3::ZERO),
            environment_pl: table.environment_pl,
            radius: normalised.radius(),
            light_count: u32::try_from(table.lights.len()).expect("no more lights than triangles and one"),
            area_pdf_scale: table.area_pdf_scale,
            brightest: table.lights.iter().map(|l| luminance(l.radiance.into())).fold(0.0, f32::max),
            world_per_unit: normalised.world_per_unit(),
        };
        Ok(Self {
            nodes: cast_slice(&bvh.cwbvh.nodes).to_vec(),
            triangles: cast_slice(&corners).to_vec(),
            shading: cast_slice(&shading).to_vec(),
            materials: cast_slice(&materials).to_vec(),
            lights: cast_slice(&table.lights).to_vec(),
            globals,
        })
    }

    /// The arrays by name, in the order of their bindings.
    #[must_use]
    pub fn arrays(&self) -> [(&'static str, &[u8]); 5] {
        [
            ("nodes", &self.nodes),
            ("triangles", &self.triangles),
            ("shading", &self.shading),
            ("materials", &self.materials),
            ("lights", &self.lights),
        ]
    }
}

fn check(scene: &Scene, bvh: &Bvh) -> Result<(), PackError> {
    if scene.triangles.is_empty() {
        return Err(PackError::NoTriangle);
    }
    let materials = scene.materials.len();
    let stray = scene.triangles.iter().position(|t| t.material as usize >= materials);
    if let Some(triangle) = stray {
        return Err(PackError::UnknownMaterial {
            triangle,
            material: scene.triangles[triangle].material,
            materials,
        });
    }
    if bvh.cwbvh.nodes.is_empty() {
        return Err(PackError::ForeignHierarchy("it has no node"));
    }
    if bvh.cwbvh.primitive_indices.iter().any(|&index| index as usize >= scene.triangles.len()) {
        return Err(PackError::ForeignHierarchy("it names a triangle that the scene lacks"));
    }
    if bvh.cwbvh.primitive_indices.len() < scene.triangles.len() {
        return Err(PackError::ForeignHierarchy("it lacks triangles of the scene"));
    }
    if bvh.depth > MAX_DEPTH {
        return Err(PackError::TooDeep { depth: bvh.depth });
    }
    Ok(())
}

fn pack_triangle(triangle: &Triangle) -> [f32; 12] {
    let [v0, v1, v2] = triangle.positions;
    let (e1, e2) = (v1 - v0, v2 - v0);
    [v0.x, v0.y, v0.z, 0.0, e1.x, e1.y, e1.z, 0.0, e2.x, e2.y, e2.z, 0.0]
}

fn pack_shading(triangle: &Triangle) -> layout::Shading {
    // Normals that agree with the face to f32 rounding come from a file without normals.
    const FLAT_COSINE: f32 = 1.0 - 1e-6;
    let [v0, v1, v2] = triangle.positions;
    let face = (v1 - v0).cross(v2 - v0).normalize_or_zero();
    let flat = triangle.normals.iter().all(|n| n.dot(face) >= FLAT_COSINE);
    layout::Shading {
        normals: triangle.normals.map(encode_octahedral),
        material: triangle.material | if flat { layout::FLAT } else { 0 },
    }
}

fn pack_material(material: &crate::scene::model::Material) -> layout::Material {
    let (reflectance, kind, ior) = match material.bsdf {
        Bsdf::Diffuse { reflectance } => (reflectance, layout::DIFFUSE, 1.0),
        Bsdf::Mirror { reflectance } => (reflectance, layout::MIRROR, 1.0),
        Bsdf::Dielectric { ior } => (Vec3::ONE, layout::DIELECTRIC, ior),
    };
    layout::Material { reflectance: reflectance.into(), kind, emission: material.emission.into(), ior }
}

struct LightTable {
    lights: Vec<layout::Light>,
    environment_pl: f32,
    area_pdf_scale: f32,
}

impl LightTable {
    /// All lights, each with a probability in proportion to its power (trap 4: one table for light starts, s=0 and s=1).
    fn new(scene: &Scene, radius: f32) -> Result<Self, PackError> {
        let emission = |t: &Triangle| scene.materials[t.material as usize].emission;
        let emitters: Vec<&Triangle> =
            scene.triangles.iter().filter(|t| luminance(emission(t)) > 0.0).collect();
        let flux = |t: &&Triangle| f64::from(luminance(emission(t))) * area(t);
        let area_flux: f64 = emitters.iter().map(flux).sum();
        let environment = scene.environment.filter(|radiance| luminance(*radiance) > 0.0);
        // Power over pi: area lights emit pi*A*L; the bounding sphere takes in 4*pi^2*R^2*L from the environment.
        let environment_flux = environment.map_or(0.0, |radiance| {
            4.0 * std::f64::consts::PI * f64::from(radius).powi(2) * f64::from(luminance(radiance))
        });
        if area_flux + environment_flux <= 0.0 {
            return Err(PackError::NoLight);
        }
        let environment_pl = if area_flux > 0.0 {
            (environment_flux / (area_flux + environment_flux)).min(ENVIRONMENT_PL_MAX)
        } else {
            1.0
        };
        let area_scale = if area_flux > 0.0 { (1.0 - environment_pl) / area_flux } else { 0.0 };
        let mut pls: Vec<f64> = emitters.iter().map(|t| flux(t) * area_scale).collect();
        let mut lights: Vec<layout::Light> = emitters.iter().map(|t| area_light(t, emission(t))).collect();
        if let Some(radiance) = environment {
            lights.push(layout::Light {
                kind: layout::ENVIRONMENT,
                radiance: radiance.into(),
                ..Zeroable::zeroed()
            });
            pls.push(environment_pl);
        }
        fill_alias_table(&mut lights, &pls);
        Ok(Self {
            lights,
            environment_pl: if environment.is_some() { to_f32(environment_pl) } else { 0.0 },
            area_pdf_scale: to_f32(area_scale),
        })
    }
}

fn area_light(triangle: &Triangle, radiance: Vec3) -> layout::Light {
    let [v0, v1, v2] = triangle.positions;
    layout::Light {
        v0: v0.into(),
        e1: (v1 - v0).into(),
        e2: (v2 - v0).into(),
        kind: layout::AREA,
        radiance: radiance.into(),
        ..Zeroable::zeroed()
    }
}

/// Vose's construction: each column holds 1/n of the probability, its own light's below the threshold, one other's above.
fn fill_alias_table(lights: &mut [layout::Light], pls: &[f64]) {
    let count = lights.len();
    #[allow(clippy::cast_precision_loss, reason = "counts of lights are far below 2^52")]
    let mut heights: Vec<f64> = pls.iter().map(|pl| pl * count as f64).collect();
    let (mut low, mut high): (Vec<usize>, Vec<usize>) = (0..count).partition(|&index| heights[index] < 1.0);
    for (index, (light, pl)) in lights.iter_mut().zip(pls).enumerate() {
        light.pl = to_f32(*pl);
        light.alias_threshold = 1.0;
        light.alias_index = u32::try_from(index).expect("no more lights than triangles and one");
    }
    while let (Some(&small), Some(&large)) = (low.last(), high.last()) {
        low.pop();
        lights[small].alias_threshold = to_f32(heights[small]);
        lights[small].alias_index = u32::try_from(large).expect("no more lights than triangles and one");
        heights[large] -= 1.0 - heights[small];
        if heights[large] < 1.0 {
            high.pop();
            low.push(large);
        }
    }
}

/// Luminance of linear sRGB (Rec. 709).
#[must_use]
pub fn luminance(rgb: Vec3) -> f32 {
    rgb.dot(Vec3::new(0.212_671, 0.715_160, 0.072_169))
}

/// A unit vector in 2 x 16 bits (Meyer et al. 2010, octahedral normal vectors), the error below 1e-4 rad.
#[must_use]
pub fn encode_octahedral(n: Vec3) -> u32 {
    let p = n / (n.x.abs() + n.y.abs() + n.z.abs());
    let sign = |v: f32| if v < 0.0 { -1.0 } else { 1.0 };
    let (x, y) =
        if p.z < 0.0 { ((1.0 - p.y.abs()) * sign(p.x), (1.0 - p.x.abs()) * sign(p.y)) } else { (p.x, p.y) };
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "clamped to 0..=65535; NaN gives 0"
    )]
    let quantise = |v: f32| ((v * 0.5 + 0.5) * 65_535.0 + 0.5).clamp(0.0, 65_535.0) as u32;
    quantise(x) | (quantise(y) << 16)
}

fn area(triangle: &Triangle) -> f64 {
    let [v0, v1, v2] = triangle.positions.map(|p| p.as_dvec3());
    (v1 - v0).cross(v2 - v0).length() * 0.5
}

#[allow(clippy::cast_possible_truncation, reason = "rounding to f32 is meant")]
fn to_f32(value: f64) -> f32 {
    value as f32
}
