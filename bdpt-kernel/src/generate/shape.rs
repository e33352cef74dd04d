//! Shapes as OBJ text: every one is closed where it can be, wound counter-clockwise seen from outside, y is up.

use std::{f32::consts::TAU, io};

use glam::Vec3;

/// How a turned shape is lit: by its facets or as round.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Finish {
    Facets,
    Round,
}

/// Writes shapes one after the other; nothing is kept.
pub(super) struct ObjWriter<'a> {
    out: &'a mut dyn io::Write,
    vertices: u64,
    normals: u64,
}

impl<'a> ObjWriter<'a> {
    pub(super) fn new(out: &'a mut dyn io::Write) -> Self {
        Self { out, vertices: 0, normals: 0 }
    }

    /// The shapes that follow are one object of one material.
    pub(super) fn object(&mut self, name: &str, material: &str) -> io::Result<()> {
        writeln!(self.out, "o {name}\nusemtl {material}")
    }

    /// A flat face.
    pub(super) fn polygon(&mut self, corners: &[Vec3]) -> io::Result<()> {
        let first = self.vertices + 1;
        for corner in corners {
            self.vertex(*corner)?;
        }
        write!(self.out, "f")?;
        for index in (first..).take(corners.len()) {
            write!(self.out, " {index}")?;
        }
        writeln!(self.out)
    }

    /// A horizontal footprint of (x, z) drawn up from one height to another, with floor and lid.
    pub(super) fn prism(&mut self, footprint: &[(f32, f32)], bottom: f32, top: f32) -> io::Result<()> {
        let next = |index: usize| (index + 1) % footprint.len();
        let twice_area: f32 = (0..footprint.len())
            .map(|i| footprint[i].0 * footprint[next(i)].1 - footprint[next(i)].0 * footprint[i].1)
            .sum();
        let mut ring = footprint.to_vec();
        // A lid whose (x, z) area counts negative looks up.
        if twice_area > 0.0 {
            ring.reverse();
        }
        let at = |(x, z): (f32, f32), y: f32| Vec3::new(x, y, z);
        let lid: Vec<Vec3> = ring.iter().map(|&corner| at(corner, top)).collect();
        let floor: Vec<Vec3> = ring.iter().rev().map(|&corner| at(corner, bottom)).collect();
        self.polygon(&lid)?;
        self.polygon(&floor)?;
        for i in 0..ring.len() {
            let (a, b) = (ring[i], ring[next(i)]);
            self.polygon(&[at(a, bottom), at(b, bottom), at(b, top), at(a, top)])?;
        }
        Ok(())
    }

    /// A box between two corners.
    pub(super) fn cuboid(&mut self, low: Vec3, high: Vec3) -> io::Result<()> {
        self.prism(&[(low.x, low.z), (high.x, low.z), (high.x, high.z), (low.x, high.z)], low.y, high.y)
    }

    /// A profile of (radius, height) turned about the vertical axis at `center`. The outside lies to the right of the profile's
    /// direction, so one that starts and ends at radius 0, bottom first, is closed and faces outwards.
    pub(super) fn turned(
        &mut self,
        center: Vec3,
        profile: &[(f32, f32)],
        segments: u16,
        finish: Finish,
    ) -> io::Result<()> {
        let directions: Vec<(f32, f32)> = (0..segments)
            .map(|segment| (f32::from(segment) / f32::from(segments) * TAU).sin_cos())
            .map(|(sin, cos)| (cos, sin))
            .collect();
        let mut rings = Vec::with_capacity(profile.len());
        for (index, &(radius, height)) in profile.iter().enumerate() {
            let slope = slope_at(profile, index);
            let ring = Ring { vertex: self.vertices + 1, normal: self.normals + 1, tip: radius == 0.0 };
            let count = if ring.tip { 1 } else { directions.len() };
            for &(x, z) in &directions[..count] {
                self.vertex(center + Vec3::new(radius * x, height, radius * z))?;
                if finish == Finish::Round {
                    let normal = if ring.tip {
                        Vec3::new(0.0, slope.1.signum(), 0.0)
                    } else {
                        Vec3::new(slope.0 * x, slope.1, slope.0 * z)
                    };
                    writeln!(self.out, "vn {} {} {}", normal.x, normal.y, normal.z)?;
                    self.normals += 1;
                }
            }
            rings.push(ring);
        }
        for pair in rings.windows(2) {
            for segment in 0..u64::from(segments) {
                let after = (segment + 1) % u64::from(segments);
                // Lower, upper, upper after, lower after: counter-clockwise from outside; a tip's two corners are one.
                let mut corners = vec![pair[0].corner(segment), pair[1].corner(segment)];
                if !pair[1].tip {
                    corners.push(pair[1].corner(after));
                }
                if !pair[0].tip {
                    corners.push(pair[0].corner(after));
                }
                write!(self.out, "f")?;
                for (vertex, normal) in corners {
                    match finish {
                        Finish::Facets => write!(self.out, " {vertex}")?,
                        Finish::Round => write!(self.out, " {vertex}//{normal}")?,
                    }
                }
                writeln!(self.out)?;
            }
        }
        Ok(())
    }

    /// A ball; `rings` from pole to pole.
    pub(super) fn ball(
        &mut self,
        center: Vec3,
        radius: f32,
        segments: u16,
        rings: u16,
        finish: Finish,
    ) -> io::Result<()> {
        let profile: Vec<(f32, f32)> = (0..=rings)
            .map(|ring| {
                let (sin, cos) = (f32::from(ring) / f32::from(rings) * TAU * 0.5).sin_cos();
                (if ring == 0 || ring == rings { 0.0 } else { radius * sin }, -radius * cos)
            })
            .collect();
        self.turned(center, &profile, segments, finish)
    }

    fn vertex(&mut self, position: Vec3) -> io::Result<()> {
        self.vertices += 1;
        writeln!(self.out, "v {} {} {}", position.x, position.y, position.z)
    }
}

/// One height of a turned shape; a tip is a single point on the axis.
struct Ring {
    vertex: u64,
    normal: u64,
    tip: bool,
}

impl Ring {
    fn corner(&self, segment: u64) -> (u64, u64) {
        let step = if self.tip { 0 } else { segment };
        (self.vertex + step, self.normal + step)
    }
}

/// The outward normal of a profile at a point, (radial, vertical): the mean of its two neighbours' edges.
fn slope_at(profile: &[(f32, f32)], index: usize) -> (f32, f32) {
    let edge = |from: usize, to: usize| {
        let (dr, dy) = (profile[to].0 - profile[from].0, profile[to].1 - profile[from].1);
        let length = dr.hypot(dy);
        (dy / length, -dr / length)
    };
    let last = profile.len() - 1;
    let before = edge(index.saturating_sub(1).min(last - 1), index.max(1));
    let after = edge(index.min(last - 1), (index + 1).min(last));
    let (radial, vertical) = (before.0 + after.0, before.1 + after.1);
    let length = radial.hypot(vertical);
    (radial / length, vertical / length)
}
