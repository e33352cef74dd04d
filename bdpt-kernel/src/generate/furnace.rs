//! The white furnace: a ball that absorbs nothing in a world that shines evenly. Every pixel is 1; what shows is an error of
//! the renderer. The ball is convex and flat-faceted, so one bounce is all and no shading normal bends it.

use std::io;

use glam::Vec3;

use super::shape::{Finish, ObjWriter};

pub(super) const DESCRIPTION: &str = "\
[film]
width = 128
height = 128

[camera]
eye = [0, 0, 4]
target = [0, 0, 0]
up = [0, 1, 0]
hfov_deg = 40

[environment]
radiance = [1, 1, 1]
";

pub(super) const LIBRARY: &str = "\
newmtl white
Kd 1 1 1
";

pub(super) fn geometry(obj: &mut ObjWriter<'_>) -> io::Result<()> {
    obj.object("ball", "white")?;
    obj.ball(Vec3::ZERO, 1.0, 48, 24, Finish::Facets)
}
