//! The same numbers whatever the tiling, the cuts of a launch and the scratch memory; byte for byte.

mod boxes;
mod device;

use std::time::Duration;

use bdpt_kernel::gpu::{LightJob, RenderOptions, TileJob, TileLayer};
use boxes::{Furniture, Prepared};
use device::Device;

const WHOLE: TileJob =
    TileJob { x_px: 0, y_px: 0, width_px: 50, height_px: 38, first_sample: 4, samples: 7, seed: 42 };

fn prepared(options: RenderOptions) -> Prepared {
    boxes::prepare(&boxes::room(Furniture::GlassAndMirror), [50, 38], options)
}

/// Bytes of the pixels of a tile, keyed by their place in the image.
fn placed(layer: &TileLayer) -> Vec<((u32, u32), Vec<u8>)> {
    let pixels = layer.pixels.iter().zip(&layer.first_hits);
    (0_u32..)
        .zip(pixels)
        .map(|(index, (sum, hit))| {
            let place = (layer.y_px + index / layer.width_px, layer.x_px + index % layer.width_px);
            (place, [bytemuck::bytes_of(sum), bytemuck::bytes_of(hit)].concat())
        })
        .collect()
}

#[test]
fn tiles_make_the_image_that_the_whole_makes() {
    let device = Device::open(Duration::from_millis(200));
    let prepared = prepared(RenderOptions::default());
    let whole = device.tile(&prepared, WHOLE);
    assert_eq!(whole.counters.faults(), []);
    let mut tiles = Vec::new();
    // Unequal tiles in an order of their own, one of them twice.
    for (x, y, w, h) in [(31, 0, 19, 17), (0, 17, 31, 21), (0, 0, 31, 17), (31, 17, 19, 21), (0, 17, 31, 21)]
    {
        let job = TileJob { x_px: x, y_px: y, width_px: w, height_px: h, ..WHOLE };
        tiles.extend(placed(&device.tile(&prepared, job)));
    }
    tiles.sort();
    tiles.dedup();
    assert_eq!(tiles.len(), 50 * 38, "the tile that came twice is the same both times");
    assert!(tiles == placed(&whole), "tiles and whole are the same bytes");

    let other = device.tile(&prepared, TileJob { seed: 43, ..WHOLE });
    assert!(placed(&other) != placed(&whole), "another seed is another image");
}

#[test]
fn cuts_and_scratch_do_not_show() {
    let prepared_wide = prepared(RenderOptions::default());
    // One slot at a time in one run, and a device that cuts at every layer.
    let prepared_narrow = prepared(RenderOptions { lanes_per_run: 1, ..RenderOptions::default() });
    let wide = Device::open(Duration::from_secs(10)).tile(&prepared_wide, WHOLE);
    let narrow = Device::open(Duration::from_millis(1)).tile(&prepared_narrow, WHOLE);
    assert!(placed(&wide) == placed(&narrow), "scratch and cuts leave no trace");
}

#[test]
fn more_samples_than_slots_come_in_order() {
    // 70 samples: two launches, the second with six slots. Sums of counts and first moments over samples taken one by
    // one are those of the whole up to the rounding of another order.
    let device = Device::open(Duration::from_millis(200));
    let prepared = prepared(RenderOptions::default());
    let job =
        TileJob { x_px: 20, y_px: 10, width_px: 9, height_px: 5, first_sample: 0, samples: 70, seed: 42 };
    let whole = device.tile(&prepared, job);
    let first = device.tile(&prepared, TileJob { samples: 64, ..job });
    let rest = device.tile(&prepared, TileJob { first_sample: 64, samples: 6, ..job });
    for (index, pixel) in whole.pixels.iter().enumerate() {
        let (a, b) = (&first.pixels[index], &rest.pixels[index]);
        assert_eq!((pixel.count, pixel.rays), (a.count + b.count, a.rays + b.rays), "integers are exact");
        let sum = a.luminance + b.luminance;
        assert!((pixel.luminance - sum).abs() <= 1e-4 * sum.max(1.0), "{} is not {sum}", pixel.luminance);
    }
}

#[test]
fn light_images_repeat_bit_for_bit_whatever_the_cuts() {
    let prepared = prepared(RenderOptions::default());
    let job = LightJob { first_path: 10_000, paths: 9_000, seed: 42 };
    let once = Device::open(Duration::from_secs(10)).light(&prepared, job);
    let again = Device::open(Duration::from_millis(1)).light(&prepared, job);
    assert_eq!(once.counters.faults(), []);
    let bits = |layer: &bdpt_kernel::gpu::SplatLayer| -> Vec<[u32; 3]> {
        layer.rgb.iter().map(|rgb| rgb.map(f32::to_bits)).collect()
    };
    assert!(bits(&once) == bits(&again), "fixed point does not see the order of splats");
    assert!(once.rgb.iter().any(|rgb| rgb[0] > 0.0), "there is light");
}

/// lavapipe compiled kernels anew for what jobs put into uniforms, and kept them all: a worker grew by 2.7 MB with each job.
#[test]
fn jobs_leave_no_memory_behind() {
    const JOBS: u32 = 40;
    let device = Device::open(Duration::from_millis(200));
    let prepared = prepared(RenderOptions::default());
    let tile = |at: u32| TileJob { x_px: at % 40, y_px: at % 30, width_px: 8, height_px: 8, ..WHOLE };
    let run = |jobs: std::ops::Range<u32>| {
        for at in jobs {
            assert_eq!(device.tile(&prepared, tile(at)).pixels.len(), 64);
        }
        resident_bytes()
    };
    let before_bytes = run(0..10);
    let grown_bytes = run(10..10 + JOBS).saturating_sub(before_bytes);
    assert!(grown_bytes < 16 << 20, "{JOBS} jobs left {grown_bytes} B behind");
}

fn resident_bytes() -> u64 {
    let sizes = std::fs::read_to_string("/proc/self/statm").expect("this is Linux");
    let pages = sizes.split(' ').nth(1).and_then(|pages| pages.parse::<u64>().ok());
    pages.expect("the second number is of resident pages") * 4_096
}
