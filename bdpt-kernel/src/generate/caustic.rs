//! Glass under a small lamp: a ball and a tumbler throw caustics that path tracing hardly finds and light paths do.

use std::{f32::consts::FRAC_PI_2, io};

use glam::Vec3;

use super::shape::{Finish, ObjWriter};

pub(super) const DESCRIPTION: &str = "\
[film]
width = 640
height = 480

[camera]
eye = [0, 4.2, 7.5]
target = [0, 0.8, 0]
up = [0, 1, 0]
hfov_deg = 42
";

pub(super) const LIBRARY: &str = "\
newmtl floor
Kd 0.65 0.62 0.58
newmtl wall
Kd 0.55 0.6 0.65
newmtl glass
Kd 0 0 0
Ni 1.5
illum 7
newmtl lamp
Kd 0 0 0
Ke 650 600 525
";

/// Glass must not touch the floor, or the two surfaces would be one.
const GAP: f32 = 0.002;

pub(super) fn geometry(obj: &mut ObjWriter<'_>) -> io::Result<()> {
    obj.object("floor", "floor")?;
    let (wide, deep) = (7.0, -4.0);
    obj.polygon(&[
        Vec3::new(-wide, 0.0, 9.0),
        Vec3::new(wide, 0.0, 9.0),
        Vec3::new(wide, 0.0, deep),
        Vec3::new(-wide, 0.0, deep),
    ])?;
    obj.object("wall", "wall")?;
    obj.polygon(&[
        Vec3::new(-wide, 0.0, deep),
        Vec3::new(wide, 0.0, deep),
        Vec3::new(wide, 8.0, deep),
        Vec3::new(-wide, 8.0, deep),
    ])?;
    obj.object("ball", "glass")?;
    obj.ball(Vec3::new(-1.5, 1.0 + GAP, 0.2), 1.0, 128, 64, Finish::Round)?;
    obj.object("tumbler", "glass")?;
    obj.turned(Vec3::new(1.5, GAP, 0.4), &tumbler(), 128, Finish::Round)?;

    // Above, behind and to the left, turned to the middle of the floor.
    let (center, half) = (Vec3::new(-2.8, 6.5, -2.5), 0.18);
    let down = (Vec3::new(0.0, 0.5, 0.2) - center).normalize();
    let side = down.cross(Vec3::Y).normalize() * half;
    let front = side.cross(down).normalize() * half;
    obj.object("lamp", "lamp")?;
    obj.polygon(&[center - side - front, center - side + front, center + side + front, center + side - front])
}

/// A glass with a thick base and rounded edges: up the outside, over the rim, down the inside. Closed by the axis.
fn tumbler() -> Vec<(f32, f32)> {
    const STEPS: u16 = 12;
    let (radius, height, wall, base, edge) = (0.75_f32, 1.9_f32, 0.09_f32, 0.28_f32, 0.1_f32);
    let arc = |center: (f32, f32), size: f32, from: f32, to: f32| {
        (0..=STEPS).map(move |step| {
            let angle = from + (to - from) * f32::from(step) / f32::from(STEPS);
            (center.0 + size * angle.cos(), center.1 + size * angle.sin())
        })
    };
    let line = |from: (f32, f32), to: (f32, f32)| {
        (1..STEPS).map(move |step| {
            let t = f32::from(step) / f32::from(STEPS);
            (from.0 + (to.0 - from.0) * t, from.1 + (to.1 - from.1) * t)
        })
    };
    let rim = wall * 0.5;
    let inner = radius - wall;
    let mut profile = vec![(0.0, 0.0)];
    profile.extend(line((0.0, 0.0), (radius - edge, 0.0)));
    profile.extend(arc((radius - edge, edge), edge, -FRAC_PI_2, 0.0));
    profile.extend(line((radius, edge), (radius, height - rim)));
    profile.extend(arc((radius - rim, height - rim), rim, 0.0, 2.0 * FRAC_PI_2));
    profile.extend(line((inner, height - rim), (inner, base + edge)));
    profile.extend(arc((inner - edge, base + edge), edge, 0.0, -FRAC_PI_2));
    profile.extend(line((inner - edge, base), (0.0, base)));
    profile.push((0.0, base));
    profile
}
