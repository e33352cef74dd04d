//! The histogram of z beside what chance alone would give, as a picture. Draws; opens no file.

use image::{ExtendedColorType, ImageEncoder, ImageError, codecs::png::PngEncoder};

/// Size of the picture, and what is left free around the bars, in pixels.
const WIDTH: usize = 800;
const HEIGHT: usize = 480;
const MARGIN: usize = 40;
/// Bars over the whole range, and their width in pixels.
const BARS: usize = 180;
const BAR_WIDTH: usize = (WIDTH - 2 * MARGIN) / BARS;
/// Pixels of a dot of a digit.
const DOT: usize = 2;

const WHITE: [u8; 3] = [255; 3];
const INK: [u8; 3] = [40; 3];
const BAR: [u8; 3] = [59, 82, 139];
const CHANCE: [u8; 3] = [200, 70, 40];

/// A histogram of `values` as PNG: bars count pairs on a logarithmic scale, the line is how many the normal distribution of
/// mean 0 and deviation 1 would put there, since that is what z follows without coupling. Below is z, at the top the largest
/// count.
///
/// # Errors
/// The encoder refuses.
pub fn z_histogram(values: &[f64]) -> Result<Vec<u8>, ImageError> {
    // Zero is always in the picture, and the range is never empty.
    let least = values.iter().copied().fold(-1.0, f64::min);
    let most = values.iter().copied().fold(1.0, f64::max);
    let step = (most - least) / BARS as f64;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to BARS")]
    let bar_of = |value: f64| (((value - least) / step) as usize).min(BARS - 1);
    let mut counts = vec![0_u64; BARS];
    for value in values {
        counts[bar_of(*value)] += 1;
    }
    let density = |z: f64| (-z * z / 2.0).exp() / std::f64::consts::TAU.sqrt();
    let expected = |bar: usize| values.len() as f64 * step * density(least + (bar as f64 + 0.5) * step);
    let largest = (0..BARS).map(|bar| expected(bar).max(counts[bar] as f64)).fold(1.0, f64::max);

    let mut canvas = Canvas::new();
    let (base, plot_height) = (HEIGHT - MARGIN, HEIGHT - 2 * MARGIN);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to the plot's height")]
    let row =
        |count: f64| base - ((1.0 + count).ln() / (1.0 + largest).ln() * plot_height as f64).round() as usize;
    let left = |bar: usize| MARGIN + bar * BAR_WIDTH;
    let mut before = row(expected(0));
    for (bar, count) in counts.iter().enumerate() {
        let columns = left(bar)..left(bar + 1);
        canvas.fill(columns.clone(), row(*count as f64)..base, BAR);
        let at = row(expected(bar));
        canvas.fill(columns, before.min(at).saturating_sub(1)..before.max(at) + 1, CHANCE);
        before = at;
    }
    canvas.fill(left(0)..left(BARS), base..base + 1, INK);
    for value in ticks(least, most) {
        let at = left(bar_of(value));
        canvas.fill(at..at + 1, base..base + 6, INK);
        canvas.write(at, base + 10, &value.to_string());
    }
    canvas.write(MARGIN, MARGIN - 20, &format!("{largest:.0}"));
    canvas.png()
}

/// Round numbers in a range, eight at most.
fn ticks(least: f64, most: f64) -> Vec<f64> {
    let rough = (most - least) / 8.0;
    let power = 10.0_f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|digit| digit * power).into_iter().find(|step| *step >= rough);
    let step = step.unwrap_or(rough);
    let first = (least / step).ceil();
    (0..=8).map(|tick| (first + f64::from(tick)) * step).filter(|tick| *tick <= most).collect()
}

struct Canvas(Vec<u8>);

impl Canvas {
    fn new() -> Self {
        Self(WHITE.repeat(WIDTH * HEIGHT))
    }

    fn fill(&mut self, columns: std::ops::Range<usize>, rows: std::ops::Range<usize>, colour: [u8; 3]) {
        for y in rows {
            for x in columns.start..columns.end.min(WIDTH) {
                let at = 3 * (y * WIDTH + x);
                if let Some(pixel) = self.0.get_mut(at..at + 3) {
                    pixel.copy_from_slice(&colour);
                }
            }
        }
    }

    /// A number below its middle there.
    fn write(&mut self, x: usize, y: usize, number: &str) {
        let advance = 4 * DOT;
        let x = x.saturating_sub(number.len() * advance / 2);
        for (place, character) in number.chars().enumerate() {
            for (row, dots) in dots(character).into_iter().enumerate() {
                for column in (0..3).filter(|column| dots >> (2 - column) & 1 == 1) {
                    let (left, top) = (x + place * advance + column * DOT, y + row * DOT);
                    self.fill(left..left + DOT, top..top + DOT, INK);
                }
            }
        }
    }

    fn png(&self) -> Result<Vec<u8>, ImageError> {
        let mut png = Vec::new();
        let size = |edge| u32::try_from(edge).expect("the picture is small");
        PngEncoder::new(&mut png).write_image(&self.0, size(WIDTH), size(HEIGHT), ExtendedColorType::Rgb8)?;
        Ok(png)
    }
}

/// Three dots in each of five rows.
const fn dots(character: char) -> [u8; 5] {
    match character {
        '0' => [7, 5, 5, 5, 7],
        '1' => [2, 6, 2, 2, 7],
        '2' => [7, 1, 7, 4, 7],
        '3' => [7, 1, 7, 1, 7],
        '4' => [5, 5, 7, 1, 1],
        '5' => [7, 4, 7, 1, 7],
        '6' => [7, 4, 7, 5, 7],
        '7' => [7, 1, 1, 1, 1],
        '8' => [7, 5, 7, 5, 7],
        '9' => [7, 5, 7, 1, 7],
        '-' => [0, 0, 7, 0, 0],
        _ => [0, 0, 0, 0, 2],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn share_of(picture: &[u8], colour: [u8; 3]) -> f64 {
        let picture = image::load_from_memory(picture).unwrap().to_rgb8();
        assert_eq!((picture.width() as usize, picture.height() as usize), (WIDTH, HEIGHT));
        let pixels = picture.pixels().filter(|pixel| pixel.0 == colour).count();
        pixels as f64 / (WIDTH * HEIGHT) as f64
    }

    #[test]
    fn any_values_make_a_picture() {
        for values in [&[][..], &[0.0], &[-3.5, 0.1, 0.2, 250.0], &[1e-300, -1e-300]] {
            let picture = z_histogram(values).unwrap();
            assert!(share_of(&picture, CHANCE) > 0.0, "{values:?}");
            assert_eq!(share_of(&picture, BAR) > 0.0, !values.is_empty(), "{values:?}");
        }
    }

    #[test]
    fn more_pairs_are_higher_bars() {
        let spread: Vec<f64> = (0..1_000).map(|place| f64::from(place) / 100.0).collect();
        let one = z_histogram(&[5.0; 1_000]).unwrap();
        assert!(share_of(&z_histogram(&spread).unwrap(), BAR) > 20.0 * share_of(&one, BAR));
    }
}
