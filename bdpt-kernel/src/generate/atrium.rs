//! A hall of two storeys with columns, galleries and balustrades under skylights: as many triangles as asked, all of them in
//! turned shapes, so that the picture stays the same while the hierarchy grows.

use std::{f32::consts::PI, io};

use glam::Vec3;

use super::shape::{Finish, ObjWriter};

/// Fewest triangles: the hall itself, and turned shapes that still look turned.
pub(super) const MIN_TRIANGLES: u32 = 10_000;
/// Most triangles: 3 GB of OBJ text.
pub const MAX_TRIANGLES: u32 = 32_000_000;

pub(super) const DESCRIPTION: &str = "\
[film]
width = 1280
height = 720

[camera]
eye = [-13, 2.2, 1.2]
target = [4, 2.6, -0.6]
up = [0, 1, 0]
hfov_deg = 70
";

pub(super) const LIBRARY: &str = "\
newmtl plaster
Kd 0.72 0.68 0.6
newmtl slate
Kd 0.2 0.22 0.25
newmtl marble
Kd 0.75 0.74 0.72
newmtl sandstone
Kd 0.66 0.5 0.33
newmtl brick
Kd 0.45 0.16 0.1
newmtl mirror
Kd 0 0 0
Ks 0.9 0.9 0.9
illum 5
newmtl glass
Kd 0 0 0
Ni 1.5
illum 7
newmtl skylight
Kd 0 0 0
Ke 14 15 17
newmtl lamp
Kd 0 0 0
Ke 30 20 10
";

/// Half the hall's length, half its width, its height.
const HALF: Vec3 = Vec3::new(16.0, 9.0, 7.0);
/// Columns of one row.
const COLUMNS: u16 = 8;
/// Balusters of one side.
const BALUSTERS: u16 = 60;
/// Balls on plinths along the middle.
const BALLS: u16 = 6;
/// Floor tiles along the hall, across it.
const TILES: (u16, u16) = (32, 14);
/// Turned shapes: two rows of columns on two storeys, two balustrades, the balls.
const TURNED: u32 = (4 * COLUMNS + 2 * BALUSTERS + BALLS) as u32;
/// Triangles of everything that is not turned, roughly.
const FLAT_TRIANGLES: u32 = 2_200;

pub(super) fn geometry(triangles: u32, obj: &mut ObjWriter<'_>) -> io::Result<()> {
    // A turned shape of n segments and n rings has 2 n (n - 1) triangles, less at its tips.
    let each = f64::from(triangles.saturating_sub(FLAT_TRIANGLES)) / f64::from(TURNED);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "at most the root of 2^24")]
    let detail = ((each * 0.5).sqrt() + 0.5).round().max(4.0) as u16;
    hall(obj)?;
    columns(obj, detail)?;
    balustrades(obj, detail)?;
    balls(obj, detail)
}

fn hall(obj: &mut ObjWriter<'_>) -> io::Result<()> {
    let Vec3 { x, y: top, z } = HALF;
    let size = (2.0 * x / f32::from(TILES.0), 2.0 * z / f32::from(TILES.1));
    for (parity, material) in ["marble", "slate"].into_iter().enumerate() {
        obj.object(&format!("floor_{material}"), material)?;
        for column in 0..TILES.0 {
            for row in (0..TILES.1).filter(|row| usize::from((column + row) % 2) == parity) {
                let (x0, z0) = (-x + f32::from(column) * size.0, -z + f32::from(row) * size.1);
                let (x1, z1) = (x0 + size.0, z0 + size.1);
                let corners = [(x0, z0), (x0, z1), (x1, z1), (x1, z0)];
                obj.polygon(&corners.map(|(x, z)| Vec3::new(x, 0.0, z)))?;
            }
        }
    }
    obj.object("ceiling", "plaster")?;
    obj.polygon(&[(-x, -z), (x, -z), (x, z), (-x, z)].map(|(x, z)| Vec3::new(x, top, z)))?;
    for (name, material, [a, b]) in [
        ("north_wall", "sandstone", [(-x, -z), (x, -z)]),
        ("south_wall", "sandstone", [(x, z), (-x, z)]),
        ("east_wall", "brick", [(x, -z), (x, z)]),
        ("west_wall", "plaster", [(-x, z), (-x, -z)]),
    ] {
        obj.object(name, material)?;
        let at = |(x, z): (f32, f32), y: f32| Vec3::new(x, y, z);
        obj.polygon(&[at(a, 0.0), at(b, 0.0), at(b, top), at(a, top)])?;
    }
    for index in 0..4_u16 {
        obj.object(&format!("skylight_{index}"), "skylight")?;
        let (center, y) = (-12.0 + 8.0 * f32::from(index), top - 0.02);
        let corners = [(center - 2.0, -1.2), (center + 2.0, -1.2), (center + 2.0, 1.2), (center - 2.0, 1.2)];
        obj.polygon(&corners.map(|(x, z)| Vec3::new(x, y, z)))?;
    }
    for (name, side) in [("north_gallery", -1.0_f32), ("south_gallery", 1.0)] {
        obj.object(name, "plaster")?;
        let (inner, outer) = (side * 4.2, side * (z - 0.001));
        obj.cuboid(
            Vec3::new(-x + 0.001, 4.2, inner.min(outer)),
            Vec3::new(x - 0.001, 4.5, inner.max(outer)),
        )?;
        obj.object(&format!("{name}_rail"), "sandstone")?;
        let rail = side * 4.35;
        obj.cuboid(Vec3::new(-x + 0.002, 5.4, rail - 0.1), Vec3::new(x - 0.002, 5.5, rail + 0.1))?;
        obj.object(&format!("{name}_lamps"), "lamp")?;
        for index in 0..COLUMNS {
            let (center, y, middle) = (along(index, COLUMNS), 4.19, side * 6.6);
            let corners = [
                (center - 0.25, middle - 0.25),
                (center + 0.25, middle - 0.25),
                (center + 0.25, middle + 0.25),
                (center - 0.25, middle + 0.25),
            ];
            obj.polygon(&corners.map(|(x, z)| Vec3::new(x, y, z)))?;
        }
    }
    Ok(())
}

/// The `index`th of `count` places along the hall.
fn along(index: u16, count: u16) -> f32 {
    -HALF.x + 2.0 * HALF.x * (f32::from(index) + 0.5) / f32::from(count)
}

/// `detail` points along t = 0..1.
fn profile(detail: u16, at: impl Fn(f32) -> (f32, f32)) -> Vec<(f32, f32)> {
    (0..detail).map(|step| at(f32::from(step) / f32::from(detail - 1))).collect()
}

fn columns(obj: &mut ObjWriter<'_>, detail: u16) -> io::Result<()> {
    for (storey, bottom, height, radius) in [("lower", 0.0_f32, 4.2_f32, 0.36_f32), ("upper", 4.5, 2.5, 0.24)]
    {
        // Swelling in the middle, mouldings at foot and head.
        let shaft = profile(detail, |t| {
            let moulding = (-60.0 * t).exp() + (-60.0 * (1.0 - t)).exp();
            let ripple = 0.04 * (t * 9.0 * PI).sin() * ((-14.0 * t).exp() + (-14.0 * (1.0 - t)).exp());
            (radius * (0.85 + 0.12 * (PI * t).sin() + 0.3 * moulding + ripple), bottom + height * t)
        });
        for (row, side) in [("north", -1.0_f32), ("south", 1.0)] {
            for index in 0..COLUMNS {
                let center = Vec3::new(along(index, COLUMNS), 0.0, side * 4.8);
                obj.object(&format!("{storey}_{row}_column_{index}"), "marble")?;
                obj.turned(center, &shaft, detail.max(3), Finish::Round)?;
            }
        }
    }
    Ok(())
}

fn balustrades(obj: &mut ObjWriter<'_>, detail: u16) -> io::Result<()> {
    let shape = profile(detail, |t| {
        let belly = (PI * (1.0 - t).powf(1.6)).sin();
        (0.035 + 0.06 * belly * belly, 4.5 + 0.9 * t)
    });
    for (row, side) in [("north", -1.0_f32), ("south", 1.0)] {
        obj.object(&format!("{row}_balusters"), "sandstone")?;
        for index in 0..BALUSTERS {
            let center = Vec3::new(along(index, BALUSTERS), 0.0, side * 4.35);
            obj.turned(center, &shape, detail.max(3), Finish::Round)?;
        }
    }
    Ok(())
}

fn balls(obj: &mut ObjWriter<'_>, detail: u16) -> io::Result<()> {
    for index in 0..BALLS {
        let (x, z) = (along(index, BALLS), if index.is_multiple_of(2) { -1.5 } else { 1.5 });
        obj.object(&format!("plinth_{index}"), "slate")?;
        obj.cuboid(Vec3::new(x - 0.5, 0.0, z - 0.5), Vec3::new(x + 0.5, 0.9, z + 0.5))?;
        let material = if index % 3 == 0 { "mirror" } else { "glass" };
        obj.object(&format!("ball_{index}"), material)?;
        obj.ball(Vec3::new(x, 1.602, z), 0.7, detail.max(4), detail.max(4), Finish::Round)?;
    }
    Ok(())
}
