//! Scenes: each of a scene's files as the hostile one, and the results of render jobs.

use bdpt_kernel::{
    bvh::{BuildQuality, Bvh},
    gpu::{FrameParams, LightJob, NormalisedScene, PackedScene, RenderOptions, TileJob},
    scene::{self, model::FilmSize},
};

use super::{Verdict, refused, state::Folder};

/// A scene that loads, of one file each.
pub(crate) const DESCRIPTION: &[u8] = include_bytes!("../../../fuzz/corpus/scene_toml/valid-scene");
/// Its geometry.
pub(crate) const GEOMETRY: &[u8] = include_bytes!("../../../fuzz/corpus/scene_obj/valid-geometry");
/// Its materials.
pub(crate) const LIBRARY: &[u8] = include_bytes!("../../../fuzz/corpus/scene_mtl/valid-library");

pub(super) fn description(bytes: &[u8]) -> Verdict {
    load([bytes, GEOMETRY, LIBRARY])
}

pub(super) fn geometry(bytes: &[u8]) -> Verdict {
    load([DESCRIPTION, bytes, LIBRARY])
}

pub(super) fn library(bytes: &[u8]) -> Verdict {
    load([DESCRIPTION, GEOMETRY, bytes])
}

fn load(files: [&[u8]; 3]) -> Verdict {
    Folder::of_thread(|folder| {
        for (name, bytes) in ["scene.toml", "a.obj", "a.mtl"].into_iter().zip(files) {
            folder.write(name, bytes);
        }
        scene::load(folder.path()).map(drop).map_err(refused)
    })
}

/// The first byte says of which kind of job; the sections follow.
pub(super) fn result(bytes: &[u8]) -> Verdict {
    let (kind, rest) = bytes.split_first().ok_or("no kind")?;
    let sections = sections(rest);
    let tile = TileJob { x_px: 0, y_px: 0, width_px: 2, height_px: 2, first_sample: 0, samples: 4, seed: 1 };
    if kind % 2 == 0 {
        return tile.decode(&sections).map(drop).map_err(refused);
    }
    let frame = FRAME.with(|frame| *frame);
    let light = LightJob { first_path: 0, paths: 4, seed: 1 };
    light.decode(&frame, &sections).map(drop).map_err(refused)
}

thread_local! {
    static FRAME: FrameParams = frame();
}

/// The frame of the corpus' results: two pixels by two.
fn frame() -> FrameParams {
    let scene = Folder::of_thread(|folder| {
        for (name, bytes) in [("scene.toml", DESCRIPTION), ("a.obj", GEOMETRY), ("a.mtl", LIBRARY)] {
            folder.write(name, bytes);
        }
        scene::load(folder.path()).expect("the corpus' scene loads").scene
    });
    let normalised = NormalisedScene::new(&scene);
    let bvh = Bvh::build(&normalised.scene().triangles, BuildQuality::Fast);
    let packed = PackedScene::new(&normalised, &bvh).expect("it is small");
    let film = FilmSize::new(2, 2).expect("a size");
    FrameParams::new(&packed, film, RenderOptions::default()).expect("it has a camera")
}

/// Cuts bytes into sections: each begins with its length, in words of 4 B (`u8`).
pub(super) fn sections(mut bytes: &[u8]) -> Vec<&[u8]> {
    let mut sections = Vec::new();
    while let Some((&length, rest)) = bytes.split_first() {
        let (section, rest) = rest.split_at((usize::from(length) * 4).min(rest.len()));
        sections.push(section);
        bytes = rest;
    }
    sections
}
