//! Scattering: densities, agreement of sample, eval and pdf, reciprocity, white furnace (50-bdpt.md section 6).
#![allow(clippy::cast_possible_truncation, reason = "clamped cells of a histogram")]

use std::f32::consts::PI;

use bdpt_kernel::{
    gpu::layout::{DIELECTRIC, DIFFUSE, MIRROR, Material},
    twin::{
        bsdf::{PathKind, Scatter, bsdf_eval, bsdf_pdf, bsdf_sample, fresnel_dielectric, is_delta},
        math::sample_sphere,
        rng::{Rng, STREAM_EYE, rng_new, rng_next},
        surface::Surface,
    },
};
use glam::{Vec2, Vec3, Vec4Swizzles};

fn material(kind: u32, reflectance: f32, ior: f32) -> Material {
    Material { reflectance: [reflectance; 3], kind, emission: [0.0; 3], ior }
}

/// A surface whose shading normal leans away from its geometric one by `lean`.
fn surface(lean: f32) -> Surface {
    Surface { position: Vec3::ZERO, ng: Vec3::Z, ns: Vec3::new(lean, 0.0, 1.0).normalize(), material: 0 }
}

fn direction(rng: &mut Rng) -> Vec3 {
    let u = rng_next(rng);
    sample_sphere(Vec2::new(u.x, u.y))
}

/// Integrals over the sphere by the midpoint rule.
fn integrate(mut f: impl FnMut(Vec3) -> f64) -> f64 {
    const ROWS: u32 = 200;
    const COLUMNS: u32 = 400;
    let mut sum = 0.0;
    for row in 0..ROWS {
        for column in 0..COLUMNS {
            let u = Vec2::new((row as f32 + 0.5) / ROWS as f32, (column as f32 + 0.5) / COLUMNS as f32);
            sum += f(sample_sphere(u));
        }
    }
    sum * 4.0 * std::f64::consts::PI / f64::from(ROWS * COLUMNS)
}

#[test]
fn densities_integrate_to_at_most_one() {
    let diffuse = material(DIFFUSE, 0.8, 1.0);
    let mut rng = rng_new([1, 1], STREAM_EYE, 5);
    for lean in [0.0, 0.3, 1.0] {
        for _ in 0..8 {
            let fixed = direction(&mut rng);
            let total = integrate(|w| f64::from(bsdf_pdf(&diffuse, &surface(lean), fixed, w)));
            assert!(total <= 1.001, "lean {lean}: {total}");
            if lean == 0.0 {
                assert!((total - 1.0).abs() < 1e-3, "a flat surface loses nothing: {total}");
            }
        }
    }
}

#[test]
fn samples_have_the_density_that_pdf_says() {
    // Chi-square over 8 x 16 cells of equal solid angle on the upper hemisphere around the geometric normal.
    const SAMPLES: u32 = 200_000;
    let diffuse = material(DIFFUSE, 0.8, 1.0);
    for lean in [0.0, 0.5] {
        let at = surface(lean);
        let fixed = Vec3::new(0.3, -0.2, 0.8).normalize();
        let cell = |w: Vec3| {
            let row = ((1.0 - w.z) * 8.0).clamp(0.0, 7.0) as usize;
            let column = ((w.y.atan2(w.x) / (2.0 * PI) + 0.5) * 16.0).clamp(0.0, 15.0) as usize;
            row * 16 + column
        };
        let mut expected = [0.0_f64; 128];
        const FINE: u32 = 40;
        for row in 0..8 * FINE {
            for column in 0..16 * FINE {
                let z = 1.0 - (row as f32 + 0.5) / (8 * FINE) as f32;
                let phi = ((column as f32 + 0.5) / (16 * FINE) as f32 - 0.5) * 2.0 * PI;
                let r = (1.0 - z * z).sqrt();
                let w = Vec3::new(r * phi.cos(), r * phi.sin(), z);
                let solid_angle = 2.0 * f64::from(PI) / f64::from(8 * FINE * 16 * FINE);
                expected[cell(w)] +=
                    f64::from(bsdf_pdf(&diffuse, &at, fixed, w)) * solid_angle * f64::from(SAMPLES);
            }
        }
        let mut seen = [0_u32; 128];
        let mut rng = rng_new([2, 2], STREAM_EYE, 5);
        for _ in 0..SAMPLES {
            let u = rng_next(&mut rng).xyz();
            if let Scatter::Smooth { direction, .. } = bsdf_sample(&diffuse, &at, fixed, u, PathKind::Eye) {
                seen[cell(direction)] += 1;
            }
        }
        let chi2: f64 = expected
            .iter()
            .zip(seen)
            .filter(|(e, _)| **e > 5.0)
            .map(|(e, s)| (f64::from(s) - e).powi(2) / e)
            .sum();
        let cells = expected.iter().filter(|e| **e > 5.0).count() as f64;
        // Mean of chi-square is the number of cells, its deviation sqrt(2 * cells); five of them, and 1 % for the
        // cells that the horizon cuts.
        assert!(
            chi2 < cells * 1.01 + 5.0 * (2.0 * cells).sqrt(),
            "lean {lean}: chi2 {chi2} over {cells} cells"
        );
    }
}

#[test]
fn sampling_equals_eval_over_pdf_on_both_kinds_of_path() {
    let diffuse = material(DIFFUSE, 0.6, 1.0);
    let mut rng = rng_new([3, 3], STREAM_EYE, 5);
    let mut smooth = 0;
    for number in 0..2_000 {
        let at = surface(if number % 2 == 0 { 0.0 } else { 0.6 });
        let fixed = direction(&mut rng);
        for kind in [PathKind::Eye, PathKind::Light] {
            let u = rng_next(&mut rng).xyz();
            let Scatter::Smooth { direction, factor, pdf_fwd, pdf_rev } =
                bsdf_sample(&diffuse, &at, fixed, u, kind)
            else {
                continue;
            };
            smooth += 1;
            let (w_e, w_l) = if kind == PathKind::Eye { (fixed, direction) } else { (direction, fixed) };
            let cosine = direction.dot(if kind == PathKind::Eye { at.ns } else { at.ng }).abs();
            let expected = bsdf_eval(&diffuse, &at, w_e, w_l) * cosine / pdf_fwd;
            assert!((factor - expected).abs().max_element() < 1e-4, "{kind:?}: {factor} != {expected}");
            assert_eq!(pdf_fwd, bsdf_pdf(&diffuse, &at, fixed, direction), "forward density is pdf()'s");
            assert_eq!(pdf_rev, bsdf_pdf(&diffuse, &at, direction, fixed), "reverse density is pdf()'s");
        }
    }
    assert!(smooth > 2_000, "most samples scatter: {smooth}");
}

#[test]
fn diffuse_is_reciprocal_and_keeps_the_horizon() {
    let diffuse = material(DIFFUSE, 0.6, 1.0);
    let mut rng = rng_new([4, 4], STREAM_EYE, 5);
    for _ in 0..2_000 {
        let (a, b) = (direction(&mut rng), direction(&mut rng));
        let at = surface(0.7);
        assert_eq!(bsdf_eval(&diffuse, &at, a, b), bsdf_eval(&diffuse, &at, b, a));
        let hidden =
            a.dot(at.ns) * a.dot(at.ng) <= 0.0 || b.dot(at.ns) * b.dot(at.ng) <= 0.0 || a.z * b.z <= 0.0;
        assert_eq!(
            bsdf_eval(&diffuse, &at, a, b) == Vec3::ZERO,
            hidden,
            "f = 0 exactly where a normal disagrees"
        );
    }
}

#[test]
fn delta_lobes_go_back_the_way_they_came() {
    // Reciprocity of f/eta^2 for delta lobes: the reverse direction scatters back, by the same Fresnel share, and the
    // radiance factors of the two ways are eta^2 and 1/eta^2.
    let mut rng = rng_new([5, 5], STREAM_EYE, 5);
    for (kind, ior) in [(MIRROR, 1.0), (DIELECTRIC, 1.5), (DIELECTRIC, 0.7)] {
        let delta = material(kind, 1.0, ior);
        assert!(is_delta(&delta));
        let (mut reflected, mut transmitted) = (0, 0);
        for _ in 0..3_000 {
            let at = surface(0.0);
            let fixed = direction(&mut rng);
            let u = rng_next(&mut rng).xyz();
            let Scatter::Delta { direction, factor } = bsdf_sample(&delta, &at, fixed, u, PathKind::Eye)
            else {
                continue;
            };
            assert!((direction.length() - 1.0).abs() < 1e-5, "unit direction");
            assert_eq!(
                bsdf_eval(&delta, &at, fixed, direction),
                Vec3::ZERO,
                "delta lobes are never connected"
            );
            if fixed.z * direction.z > 0.0 {
                reflected += 1;
                assert!((factor - Vec3::ONE).abs().max_element() < 1e-5, "reflection keeps radiance");
                assert!((fixed.x + direction.x).abs() < 1e-5, "mirrored");
            } else {
                transmitted += 1;
                let eta = if fixed.z > 0.0 { 1.0 / ior } else { ior };
                assert!((factor.x - eta * eta).abs() < 1e-5, "radiance is compressed by eta^2");
                let snell = fixed.truncate().length() * eta - direction.truncate().length();
                assert!(snell.abs() < 1e-4, "Snell: {snell}");
                // Back again with a draw that transmits.
                let back = bsdf_sample(&delta, &at, direction, Vec3::splat(0.999_99), PathKind::Eye);
                if let Scatter::Delta { direction: home, factor: inverse } = back {
                    let grazing = fixed.z.abs() < 0.05;
                    assert!(grazing || (home - fixed).length() < 1e-2, "{home} is not {fixed}");
                    assert!((factor.x * inverse.x - 1.0).abs() < 1e-4, "the two factors cancel");
                }
            }
        }
        assert!(reflected > 50, "{kind}: {reflected} reflections");
        assert!(
            kind == MIRROR && transmitted == 0 || kind == DIELECTRIC && transmitted > 500,
            "{transmitted}"
        );
    }
}

#[test]
fn fresnel_has_its_known_values() {
    // Normal incidence: ((n1 - n2)/(n1 + n2))^2; the same from both sides.
    assert!((fresnel_dielectric(1.0 / 1.5, 1.0, 1.0) - 0.04).abs() < 1e-6);
    assert!((fresnel_dielectric(1.5, 1.0, 1.0) - 0.04).abs() < 1e-6);
    // Brewster's angle: no parallel reflection, so half of the perpendicular one.
    let brewster = 1.5_f32.atan();
    let cos_beyond = (1.0 - (brewster.sin() / 1.5).powi(2)).sqrt();
    let (n, c) = (1.5_f32, brewster.cos());
    let perpendicular = ((c - n * cos_beyond) / (c + n * cos_beyond)).powi(2);
    assert!((fresnel_dielectric(1.0 / 1.5, c, cos_beyond) - 0.5 * perpendicular).abs() < 1e-6);
    assert!((fresnel_dielectric(1.0 / 1.5, 1e-6, 0.745_356) - 1.0).abs() < 1e-4, "grazing reflects all");
}

#[test]
fn white_furnace_gains_nothing() {
    // Under unit radiance from everywhere, a surface sends back at most the unit: diffuse albedo 1, mirror, glass.
    // Glass compresses radiance by eta^2, so what counts is the factor with eta^2 taken out.
    let mut rng = rng_new([6, 6], STREAM_EYE, 5);
    for (name, material) in [
        ("diffuse", material(DIFFUSE, 1.0, 1.0)),
        ("mirror", material(MIRROR, 1.0, 1.0)),
        ("glass", material(DIELECTRIC, 1.0, 1.5)),
    ] {
        for lean in [0.0, 0.5] {
            let at = surface(lean);
            for _ in 0..20 {
                let fixed = direction(&mut rng);
                let mut sum = 0.0_f64;
                const SAMPLES: u32 = 2_000;
                for _ in 0..SAMPLES {
                    let u = rng_next(&mut rng).xyz();
                    sum += match bsdf_sample(&material, &at, fixed, u, PathKind::Eye) {
                        Scatter::Absorbed => 0.0,
                        Scatter::Smooth { factor, .. } => f64::from(factor.x),
                        Scatter::Delta { direction, factor } => {
                            let crossed = fixed.z * direction.z < 0.0;
                            let eta = if fixed.z > 0.0 { 1.0 / material.ior } else { material.ior };
                            f64::from(factor.x / if crossed { eta * eta } else { 1.0 })
                        }
                    };
                }
                let mean = sum / f64::from(SAMPLES);
                assert!(mean <= 1.0 + 1e-4, "{name}, lean {lean}: {mean}");
                assert!(lean > 0.0 || mean > 1.0 - 1e-4, "{name}: a flat surface keeps all: {mean}");
            }
        }
    }
}
