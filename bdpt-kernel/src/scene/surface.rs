//! What a file says about a surface, mapped to what renders. A look that cannot be rendered yet becomes diffuse of a fitting
//! colour, and says so by name; it is never dropped in silence.

use glam::Vec3;

use super::model::Bsdf;

/// Colour of surfaces that have none: no material, or a look whose colour is not known.
pub(crate) const GREY: Vec3 = Vec3::splat(0.5);

/// A surface as it will be rendered.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Surface {
    pub(crate) bsdf: Bsdf,
    pub(crate) emission: Vec3,
    /// The look asked for, where it is rendered as diffuse instead: `rough_conductor`, `illum 8`.
    pub(crate) fallback: Option<String>,
    /// What else the file asks for and does not get: `map_Kd is not supported yet: ignored`.
    pub(crate) ignored: Vec<String>,
}

impl Surface {
    /// A surface that is rendered as the file says.
    pub(crate) const fn of(bsdf: Bsdf) -> Self {
        Self { bsdf, emission: Vec3::ZERO, fallback: None, ignored: Vec::new() }
    }

    /// Diffuse in place of `look`.
    pub(crate) fn instead_of(look: &str, reflectance: Vec3) -> Self {
        let bsdf = Bsdf::Diffuse { reflectance: reflectance.clamp(Vec3::ZERO, Vec3::ONE) };
        Self { fallback: Some(look.to_owned()), ..Self::of(bsdf) }
    }

    /// What to tell the user about the surface of this name.
    pub(crate) fn warnings<'a>(&'a self, name: &'a str) -> impl Iterator<Item = String> + 'a {
        let fallback = self.fallback.iter().map(move |look| {
            format!("material \"{name}\" ({look}) is not supported yet: rendered as diffuse")
        });
        fallback.chain(self.ignored.iter().map(move |what| format!("material \"{name}\": {what}")))
    }
}

/// Reflectance of a conductor at normal incidence, by channel: ((eta-1)^2 + k^2) / ((eta+1)^2 + k^2).
pub(crate) fn normal_incidence(eta: Vec3, k: Vec3) -> Vec3 {
    let k2 = k * k;
    let below = eta + Vec3::ONE;
    let above = eta - Vec3::ONE;
    (above * above + k2) / (below * below + k2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn conductors_keep_their_colour() {
        // Copper is red, its tabulated normal-incidence reflectance about (0.93, 0.60, 0.5).
        let copper = normal_incidence(Vec3::new(0.200, 0.924, 1.102), Vec3::new(3.912, 2.452, 2.142));
        assert!((copper - Vec3::new(0.953, 0.620, 0.514)).abs().max_element() < 0.02, "{copper}");
        // Without absorption it is the dielectric's ((n-1)/(n+1))^2.
        let glass = normal_incidence(Vec3::splat(1.5), Vec3::ZERO);
        assert!((glass - Vec3::splat(0.04)).abs().max_element() < 1e-6, "{glass}");
    }

    #[test]
    fn a_fallback_names_material_and_look() {
        let surface = Surface::instead_of("rough_conductor", Vec3::splat(1.5));
        assert_eq!(surface.bsdf, Bsdf::Diffuse { reflectance: Vec3::ONE });
        let told: Vec<String> = surface.warnings("Steel").collect();
        assert_eq!(told, ["material \"Steel\" (rough_conductor) is not supported yet: rendered as diffuse"]);
    }
}
