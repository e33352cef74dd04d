//! The recursion against the definition: for random full paths, the balance heuristic's weights of all strategies by
//! products of pdfs sum to 1 and equal the recursion's (50-bdpt.md section 6).
#![allow(clippy::cast_possible_truncation, reason = "explicit pdfs are f64, the recursion is f32")]

mod boxes;

use std::f64::consts::PI;

use bdpt_kernel::{
    gpu::{RenderOptions, layout::ENVIRONMENT},
    twin::{
        TwinScene,
        bsdf::{PathKind, Scatter, bsdf_pdf, bsdf_sample, is_delta},
        camera::camera_pdf,
        lights::{area_direct_pdf, environment_emission_pdf, environment_pdf},
        math::{INFINITE, luminance},
        mis::{
            ConnectionEnd, Mis, mis_arrive, mis_eye_start, mis_scatter, mis_scatter_delta, mis_weight_camera,
            mis_weight_connect, mis_weight_emitter, mis_weight_light_sample,
        },
        rng::{STREAM_EYE, rng_new, rng_next},
        surface::{Surface, offset_along, surface_at},
        traverse::{NO_HIT, Search, trace},
        walk::eye_start,
    },
};
use glam::{Vec2, Vec3, Vec4Swizzles};

/// Where a path ends.
#[derive(Clone, Copy, PartialEq)]
enum End {
    /// On the last surface, which emits.
    Emitter,
    /// In this direction, in the environment.
    Sky(Vec3),
}

/// A whole path from the camera to a light.
struct Path {
    surfaces: Vec<Surface>,
    end: End,
}

/// Follows the camera ray through random scattering until it meets a light; none when it is absorbed.
fn random_path(scene: &TwinScene, number: u32, longest: usize) -> Option<Path> {
    let mut rng = rng_new([number, 0], STREAM_EYE, 99);
    let u = rng_next(&mut rng);
    let frame = scene.frame();
    let walk = eye_start(scene, Vec2::new(u.x * frame.width_px as f32, u.y * frame.height_px as f32));
    let (mut origin, mut direction) = (walk.origin, walk.direction);
    let mut surfaces: Vec<Surface> = Vec::new();
    loop {
        let hit = trace(scene, origin, direction, INFINITE, Search::Nearest);
        if hit.triangle == NO_HIT {
            let lit = frame.environment_pl > 0.0 && !surfaces.is_empty();
            return lit.then_some(Path { surfaces, end: End::Sky(direction) });
        }
        let surface = surface_at(scene, &hit);
        surfaces.push(surface);
        let material = scene.material(&surface);
        let emits = luminance(material.emission.into()) > 0.0 && direction.dot(surface.ng) < 0.0;
        // Every other path goes on past an emitter: emitters also scatter.
        if emits && surfaces.len() >= 2 && (number.is_multiple_of(2) || surfaces.len() == longest) {
            return Some(Path { surfaces, end: End::Emitter });
        }
        if surfaces.len() == longest {
            return None;
        }
        match bsdf_sample(material, &surface, -direction, rng_next(&mut rng).xyz(), PathKind::Eye) {
            Scatter::Absorbed => return None,
            Scatter::Smooth { direction: next, .. } | Scatter::Delta { direction: next, .. } => {
                origin = offset_along(surface.position, surface.ng, next);
                direction = next;
            }
        }
    }
}

/// Explicit pdfs of a path. Vertices in between are surfaces 0..n; the light is the end, the camera stands before 0.
struct Explicit<'a> {
    scene: &'a TwinScene,
    path: &'a Path,
}

impl Explicit<'_> {
    /// Scattering surfaces: all but an emitter at the end.
    fn scattering(&self) -> usize {
        self.path.surfaces.len() - usize::from(self.path.end == End::Emitter)
    }

    fn surface(&self, i: usize) -> &Surface {
        &self.path.surfaces[i]
    }

    fn delta(&self, i: usize) -> bool {
        is_delta(self.scene.material(self.surface(i)))
    }

    /// Unit direction from surface `i` toward the camera's side.
    fn to_eye(&self, i: usize) -> Vec3 {
        let before = if i == 0 { Vec3::from(self.scene.frame().eye) } else { self.surface(i - 1).position };
        (before - self.surface(i).position).normalize()
    }

    /// Unit direction from surface `i` toward the light's side.
    fn to_light(&self, i: usize) -> Vec3 {
        match self.path.end {
            End::Sky(direction) if i + 1 == self.path.surfaces.len() => direction,
            _ => (self.surface(i + 1).position - self.surface(i).position).normalize(),
        }
    }

    /// |w.Ng| at `to` over the squared distance: solid angle at `from` to area at `to`.
    fn to_area(&self, from: Vec3, to: usize) -> f64 {
        let offset = (self.surface(to).position - from).as_dvec3();
        let distance_squared = offset.length_squared();
        (offset.dot(self.surface(to).ng.as_dvec3())).abs() / distance_squared.sqrt() / distance_squared
    }

    /// pdf_solid_angle of scattering at `i` from one neighbour to the other. Delta lobes cancel between the two ways.
    fn scatter_pdf(&self, i: usize, fixed: Vec3, to: Vec3) -> f64 {
        if self.delta(i) {
            return 1.0;
        }
        f64::from(bsdf_pdf(self.scene.material(self.surface(i)), self.surface(i), fixed, to))
    }

    /// pdf of the light's own point: per area of an emitter, per solid angle of the sky.
    fn light_pdf(&self) -> f64 {
        f64::from(match self.path.end {
            End::Emitter => {
                let last = self.path.surfaces.last().expect("paths have surfaces");
                area_direct_pdf(self.scene, self.scene.material(last).emission.into())
            }
            End::Sky(_) => environment_pdf(self.scene),
        })
    }

    /// pdf_area of surface `i` when the light subpath comes from the light's side.
    fn pdf_from_light(&self, i: usize) -> f64 {
        if i + 1 < self.scattering() {
            let from = self.surface(i + 1);
            return self.scatter_pdf(i + 1, self.to_light(i + 1), self.to_eye(i + 1))
                * self.to_area(from.position, i);
        }
        match self.path.end {
            End::Emitter => {
                let emitter = self.surface(i + 1);
                let cosine = f64::from(self.to_eye(i + 1).dot(emitter.ng));
                cosine / PI * self.to_area(emitter.position, i)
            }
            End::Sky(direction) => {
                let radius = f64::from(self.scene.frame().radius);
                f64::from(direction.dot(self.surface(i).ng)).abs() / (PI * radius * radius)
            }
        }
    }

    /// pdf of vertex `i` when the eye subpath comes from the camera's side; `i = scattering()` is the light's point.
    fn pdf_from_eye(&self, i: usize) -> f64 {
        if i == 0 {
            let eye = Vec3::from(self.scene.frame().eye);
            let pdf = f64::from(camera_pdf(self.scene, -self.to_eye(0)));
            return pdf * self.to_area(eye, 0);
        }
        let pdf = self.scatter_pdf(i - 1, self.to_eye(i - 1), self.to_light(i - 1));
        if i == self.scattering() && self.path.end != End::Emitter {
            return pdf;
        }
        pdf * self.to_area(self.surface(i - 1).position, i)
    }

    /// Density of the path under the strategy with `s` light vertices, times the number of samples; 0 where a delta
    /// lobe stands at the connection.
    fn density(&self, s: usize) -> f64 {
        let n = self.scattering();
        // Eye vertices besides the camera: surfaces 0..eye; the light subpath has the rest and the light's point.
        let eye = n + 1 - s;
        let joined = |i: usize| i < n && self.delta(i);
        if s >= 1 && (eye >= 1 && joined(eye - 1) || s >= 2 && joined(eye)) {
            return 0.0;
        }
        let eye_side: f64 = (0..eye).map(|i| self.pdf_from_eye(i)).product();
        let light_side: f64 = if s == 0 {
            1.0
        } else {
            self.light_pdf() * (eye..n).map(|i| self.pdf_from_light(i)).product::<f64>()
        };
        let samples = if eye == 0 { f64::from(self.scene.frame().nl) } else { 1.0 };
        samples * eye_side * light_side
    }
}

/// The recursion along an explicit path.
struct Recursion {
    /// State of an eye subpath at each surface, the emitter included, after arrival.
    eye: Vec<Mis>,
    /// As the last scattering left it: for the sky.
    eye_left: Mis,
    /// State of a light subpath at each scattering surface after arrival.
    light: Vec<Mis>,
}

fn recursion(e: &Explicit<'_>) -> Recursion {
    let frame = e.scene.frame();
    let n = e.scattering();
    let scatter = |mis: Mis, i: usize, fixed: Vec3, to: Vec3| {
        let surface = e.surface(i);
        let cos_out = to.dot(surface.ng).abs();
        if e.delta(i) {
            return mis_scatter_delta(mis, cos_out);
        }
        let material = e.scene.material(surface);
        let (fwd, rev) = (bsdf_pdf(material, surface, fixed, to), bsdf_pdf(material, surface, to, fixed));
        mis_scatter(frame, mis, cos_out, fwd, rev)
    };
    let mut eye = Vec::new();
    let mut mis = mis_eye_start(frame, camera_pdf(e.scene, -e.to_eye(0)));
    for i in 0..e.path.surfaces.len() {
        let before = if i == 0 { Vec3::from(frame.eye) } else { e.surface(i - 1).position };
        let distance_squared = before.distance_squared(e.surface(i).position);
        mis = mis_arrive(mis, distance_squared, e.to_eye(i).dot(e.surface(i).ng).abs());
        eye.push(mis);
        if i < n {
            mis = scatter(mis, i, e.to_eye(i), e.to_light(i));
        }
    }
    let eye_left = mis;

    let mut light = vec![Mis { dvcm: 0.0, dvc: 0.0 }; n];
    // 50-bdpt.md section 2, light start.
    let direct = e.light_pdf() as f32;
    let mut mis = match e.path.end {
        End::Emitter => {
            let cosine = e.to_eye(n).dot(e.surface(n).ng);
            let emission = direct * cosine / std::f32::consts::PI;
            Mis { dvcm: direct / emission, dvc: cosine / emission }
        }
        End::Sky(_) => {
            let emission = environment_emission_pdf(e.scene);
            Mis { dvcm: direct / emission, dvc: 1.0 / emission }
        }
    };
    for i in (0..n).rev() {
        let from_sky = i + 1 == n && e.path.end != End::Emitter;
        let distance_squared =
            if from_sky { 1.0 } else { e.surface(i + 1).position.distance_squared(e.surface(i).position) };
        mis = mis_arrive(mis, distance_squared, e.to_light(i).dot(e.surface(i).ng).abs());
        light[i] = mis;
        mis = scatter(mis, i, e.to_light(i), e.to_eye(i));
    }
    Recursion { eye, eye_left, light }
}

/// The recursion's weight of the strategy with `s` light vertices.
fn recursive_weight(e: &Explicit<'_>, r: &Recursion, s: usize) -> f32 {
    let frame = e.scene.frame();
    let n = e.scattering();
    let eye = n + 1 - s;
    let direct = e.light_pdf() as f32;
    let material = |i: usize| e.scene.material(e.surface(i));
    let pdf = |i: usize, fixed: Vec3, to: Vec3| bsdf_pdf(material(i), e.surface(i), fixed, to);
    if s == 0 {
        return match e.path.end {
            End::Emitter => {
                let cosine = e.to_eye(n).dot(e.surface(n).ng);
                mis_weight_emitter(r.eye[n], direct, direct * cosine / std::f32::consts::PI)
            }
            End::Sky(_) => mis_weight_emitter(r.eye_left, direct, environment_emission_pdf(e.scene)),
        };
    }
    if eye == 0 {
        let camera = camera_pdf(e.scene, -e.to_eye(0)) * e.to_area(Vec3::from(frame.eye), 0) as f32;
        return mis_weight_camera(frame, r.light[0], camera, pdf(0, e.to_eye(0), e.to_light(0)));
    }
    let x = eye - 1;
    let (w_e, w_l) = (e.to_eye(x), e.to_light(x));
    if s == 1 {
        let cos_x = w_l.dot(e.surface(x).ng).abs();
        let (direct_pdf, emission_over_cos) = match e.path.end {
            End::Emitter => {
                let to_area = e.to_area(e.surface(x).position, n) as f32;
                (direct / to_area, direct / std::f32::consts::PI)
            }
            End::Sky(_) => (direct, environment_emission_pdf(e.scene)),
        };
        return mis_weight_light_sample(
            frame,
            r.eye[x],
            direct_pdf,
            emission_over_cos,
            cos_x,
            pdf(x, w_e, w_l),
            pdf(x, w_l, w_e),
        );
    }
    let y = eye;
    mis_weight_connect(
        ConnectionEnd {
            mis: r.eye[x],
            pdf_area: pdf(y, e.to_light(y), e.to_eye(y)) * e.to_area(e.surface(y).position, x) as f32,
            pdf_rev: pdf(x, w_l, w_e),
        },
        ConnectionEnd {
            mis: r.light[y],
            pdf_area: pdf(x, w_e, w_l) * e.to_area(e.surface(x).position, y) as f32,
            pdf_rev: pdf(y, e.to_eye(y), e.to_light(y)),
        },
    )
}

/// Largest deviations over many paths: of the sum from 1, and of a recursive weight from the explicit one.
fn deviations(scene: &TwinScene, paths: u32, break_it: f64) -> (f64, f64, usize, usize) {
    let (mut worst_sum, mut worst_weight, mut count, mut with_delta) = (0.0_f64, 0.0_f64, 0, 0);
    for number in 0..paths {
        let Some(path) = random_path(scene, number, 15) else { continue };
        let e = Explicit { scene, path: &path };
        let n = e.scattering();
        let densities: Vec<f64> = (0..=n + 1).map(|s| e.density(s)).collect();
        let total: f64 = densities.iter().sum();
        assert!(total > 0.0, "path {number} was sampled, so s = 0 has a density");
        let r = recursion(&e);
        let mut sum = 0.0;
        for (s, density) in densities.iter().enumerate().filter(|(_, density)| **density > 0.0) {
            let weight = f64::from(recursive_weight(&e, &r, s)) * if s == 1 { break_it } else { 1.0 };
            sum += weight;
            worst_weight = worst_weight.max((weight - density / total).abs());
        }
        worst_sum = worst_sum.max((sum - 1.0).abs());
        count += 1;
        with_delta += usize::from((0..n).any(|i| e.delta(i)));
    }
    (worst_sum, worst_weight, count, with_delta)
}

#[test]
fn weights_of_all_strategies_sum_to_one_and_equal_their_definition() {
    for (name, scene) in [
        ("room", boxes::room(boxes::Furniture::Block)),
        ("glass and mirror", boxes::room(boxes::Furniture::GlassAndMirror)),
        ("outdoors", boxes::outdoors()),
    ] {
        let prepared = boxes::prepare(&scene, [64, 48], RenderOptions::default());
        let (sum, weight, count, with_delta) = deviations(&prepared.twin, 20_000, 1.0);
        println!(
            "{name}: {count} paths ({with_delta} with delta vertices), sum off by {sum:.1e}, weight by {weight:.1e}"
        );
        assert!(count > 1_000, "{name}: only {count} paths reached a light");
        assert!(sum < 1e-4, "{name}: weights sum to 1 +- {sum}");
        assert!(weight < 1e-4, "{name}: a recursive weight is off by {weight}");
        assert!(name == "room" || with_delta > 100, "{name}: only {with_delta} paths with mirror or glass");
    }
}

#[test]
fn a_wrong_weight_is_noticed() {
    let prepared = boxes::prepare(&boxes::room(boxes::Furniture::Block), [64, 48], RenderOptions::default());
    let (sum, weight, ..) = deviations(&prepared.twin, 2_000, 1.01);
    assert!(sum > 1e-3 && weight > 1e-3, "one percent too much at s = 1: {sum}, {weight}");
}

#[test]
fn outdoors_has_an_environment_light() {
    let prepared = boxes::prepare(&boxes::outdoors(), [64, 48], RenderOptions::default());
    assert!(prepared.twin.lights().iter().any(|light| light.kind == ENVIRONMENT), "the sky is in the table");
}
