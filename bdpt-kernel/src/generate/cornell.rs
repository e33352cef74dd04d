//! The Cornell box, after the measured data of the Cornell University Program of Computer Graphics (1998): lengths in
//! millimetres, colours as the usual linear RGB of its spectra.

use std::io;

use glam::Vec3;

use super::shape::{Finish, ObjWriter};

/// What stands in the box.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CornellVariant {
    /// Two white boxes.
    Diffuse,
    /// The tall box is a mirror.
    Mirror,
    /// The short box is glass.
    Glass,
    /// A mirror ball and a glass ball.
    Spheres,
}

pub(super) const DESCRIPTION: &str = "\
[film]
width = 512
height = 512

[camera]
eye = [278, 273, -800]
target = [278, 273, 0]
up = [0, 1, 0]
hfov_deg = 39.3
";

pub(super) const LIBRARY: &str = "\
newmtl white
Kd 0.725 0.71 0.68
newmtl red
Kd 0.63 0.065 0.05
newmtl green
Kd 0.14 0.45 0.091
newmtl lamp
Kd 0 0 0
Ke 17 12 4
newmtl mirror
Kd 0 0 0
Ks 0.95 0.95 0.95
illum 5
newmtl glass
Kd 0 0 0
Ni 1.5
illum 7
";

/// (x, z) of the short block; 165 high.
const SHORT: [(f32, f32); 4] = [(130.0, 65.0), (82.0, 225.0), (240.0, 272.0), (290.0, 114.0)];
/// (x, z) of the tall block; 330 high.
const TALL: [(f32, f32); 4] = [(423.0, 247.0), (265.0, 296.0), (314.0, 456.0), (472.0, 406.0)];
/// Glass must not touch the floor, or the two surfaces would be one.
const GAP: f32 = 0.5;

pub(super) fn geometry(variant: CornellVariant, obj: &mut ObjWriter<'_>) -> io::Result<()> {
    let mut face = |name: &str, material: &str, corners: [[f32; 3]; 4]| {
        obj.object(name, material)?;
        obj.polygon(&corners.map(Vec3::from))
    };
    let (back, top) = (559.2, 548.8);
    face("floor", "white", [[552.8, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, back], [549.6, 0.0, back]])?;
    face("ceiling", "white", [[556.0, top, 0.0], [556.0, top, back], [0.0, top, back], [0.0, top, 0.0]])?;
    face("back_wall", "white", [[549.6, 0.0, back], [0.0, 0.0, back], [0.0, top, back], [556.0, top, back]])?;
    face("right_wall", "green", [[0.0, 0.0, back], [0.0, 0.0, 0.0], [0.0, top, 0.0], [0.0, top, back]])?;
    face("left_wall", "red", [[552.8, 0.0, 0.0], [549.6, 0.0, back], [556.0, top, back], [556.0, top, 0.0]])?;
    // A little below the ceiling, which it would else coincide with.
    let lamp = top - 0.3;
    face(
        "lamp",
        "lamp",
        [[343.0, lamp, 227.0], [343.0, lamp, 332.0], [213.0, lamp, 332.0], [213.0, lamp, 227.0]],
    )?;

    let (tall, short) = match variant {
        CornellVariant::Spheres => {
            obj.object("mirror_ball", "mirror")?;
            obj.ball(Vec3::new(380.0, 100.0, 370.0), 100.0, 96, 48, Finish::Round)?;
            obj.object("glass_ball", "glass")?;
            return obj.ball(Vec3::new(170.0, 90.0 + GAP, 190.0), 90.0, 96, 48, Finish::Round);
        }
        CornellVariant::Diffuse => ("white", "white"),
        CornellVariant::Mirror => ("mirror", "white"),
        CornellVariant::Glass => ("white", "glass"),
    };
    obj.object("tall_box", tall)?;
    obj.prism(&TALL, 0.0, 330.0)?;
    obj.object("short_box", short)?;
    let lift = if variant == CornellVariant::Glass { GAP } else { 0.0 };
    obj.prism(&SHORT, lift, 165.0)
}
