//! Results as files' bytes: matrices for numpy, a table of the top pairs, pictures. Opens no file.

use std::io::{self, Write};

use image::{ExtendedColorType, ImageEncoder, ImageError, codecs::png::PngEncoder};
use rayon::prelude::*;

use crate::{Alignment, PairStatistics, Reference};

/// Largest edge of a picture in pixels; larger matrices show the largest value of each block.
const PICTURE_EDGE_PX: usize = 2_048;

/// Share of the values that a picture's scale ends at.
const CLIP_SHARE: f64 = 0.995;

/// Names and matrices of all results, L x L row by row: bits, z and p. On the diagonal stand entropies, which shuffling
/// does not change (z 0, p 1).
#[must_use]
pub fn matrices(reference: &Reference<'_>, pairs: &[PairStatistics]) -> [(&'static str, Vec<f64>); 5] {
    let l = reference.alignment().l();
    let entropy = |column: usize| reference.bits(f64::from(reference.entropy(column)));
    let fill = |diagonal: &dyn Fn(usize) -> f64, value: fn(&PairStatistics) -> f64| {
        let mut matrix = vec![0.0; l * l];
        for column in 0..l {
            matrix[column * l + column] = diagonal(column);
        }
        for pair in pairs {
            matrix[pair.i * l + pair.j] = value(pair);
            matrix[pair.j * l + pair.i] = value(pair);
        }
        matrix
    };
    [
        ("mi_bits", fill(&entropy, |pair| pair.mi_bits)),
        ("null_mean_bits", fill(&entropy, |pair| pair.null_mean_bits)),
        ("null_sd_bits", fill(&|_| 0.0, |pair| pair.null_sd_bits)),
        ("z", fill(&|_| 0.0, |pair| pair.z)),
        ("p", fill(&|_| 1.0, |pair| pair.p)),
    ]
}

/// A square matrix of `f64` as NPY, format 1.0.
///
/// # Errors
/// `out` refuses.
pub fn write_npy(out: &mut impl Write, l: usize, matrix: &[f64]) -> io::Result<()> {
    let mut header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({l}, {l}), }}");
    // Magic, version, length and header together are a multiple of 64; a newline ends it.
    let padded = (10 + header.len() + 1).next_multiple_of(64) - 10;
    header.extend(std::iter::repeat_n(' ', padded - header.len() - 1));
    header.push('\n');
    let length = u16::try_from(header.len()).expect("the header is short");
    out.write_all(b"\x93NUMPY\x01\x00")?;
    out.write_all(&length.to_le_bytes())?;
    out.write_all(header.as_bytes())?;
    for value in matrix {
        out.write_all(&value.to_le_bytes())?;
    }
    Ok(())
}

/// The `top` pairs with the highest z as CSV, ties by mutual information and place. Columns have their numbers in the input
/// ([`Alignment::number`]); residues are the first sequence's. `mi_apc_bits` is corrected by the average product (Dunn, Wahl and Gloor 2008).
///
/// # Errors
/// `out` refuses.
pub fn write_top_pairs(
    out: &mut impl Write,
    alignment: &Alignment,
    pairs: &[PairStatistics],
    top: usize,
) -> io::Result<()> {
    let means = ColumnMeans::new(alignment.l(), pairs);
    let mut order: Vec<&PairStatistics> = pairs.iter().collect();
    order.par_sort_unstable_by(|a, b| {
        b.z.total_cmp(&a.z).then(b.mi_bits.total_cmp(&a.mi_bits)).then((a.i, a.j).cmp(&(b.i, b.j)))
    });
    writeln!(out, "i,a_i,j,a_j,separation,mi_bits,null_mean_bits,null_sd_bits,z,p,mi_apc_bits,z_undefined")?;
    for pair in order.into_iter().take(top) {
        let residue = |column: usize| char::from(alignment.symbol(0, column));
        writeln!(
            out,
            "{},{},{},{},{},{},{},{},{},{},{},{}",
            alignment.number(pair.i),
            residue(pair.i),
            alignment.number(pair.j),
            residue(pair.j),
            alignment.number(pair.j) - alignment.number(pair.i),
            pair.mi_bits,
            pair.null_mean_bits,
            pair.null_sd_bits,
            pair.z,
            pair.p,
            pair.mi_bits - means.product(pair.i, pair.j),
            pair.z_undefined
        )?;
    }
    Ok(())
}

/// Mean mutual information of each column with all others, and over all pairs.
struct ColumnMeans {
    columns: Vec<f64>,
    all: f64,
}

impl ColumnMeans {
    fn new(l: usize, pairs: &[PairStatistics]) -> Self {
        let mut columns = vec![0.0; l];
        for pair in pairs {
            columns[pair.i] += pair.mi_bits;
            columns[pair.j] += pair.mi_bits;
        }
        let others = l.saturating_sub(1).max(1) as f64;
        for column in &mut columns {
            *column /= others;
        }
        let all = columns.iter().sum::<f64>() / l.max(1) as f64;
        Self { columns, all }
    }

    fn product(&self, i: usize, j: usize) -> f64 {
        if self.all > 0.0 { self.columns[i] * self.columns[j] / self.all } else { 0.0 }
    }
}

/// A heat map of a square matrix as PNG: dark is 0, bright is what 99.5 % of the values off the diagonal stay below.
///
/// # Errors
/// The encoder refuses.
pub fn heat_map(l: usize, matrix: &[f64]) -> Result<Vec<u8>, ImageError> {
    let block = l.div_ceil(PICTURE_EDGE_PX).max(1);
    let edge = l.div_ceil(block);
    let mut pixels = vec![0.0_f64; edge * edge];
    let off_diagonal = (0..l).flat_map(|i| (0..l).filter(move |j| *j != i).map(move |j| (i, j)));
    for (i, j) in off_diagonal {
        let pixel = &mut pixels[(i / block) * edge + j / block];
        *pixel = pixel.max(matrix[i * l + j]);
    }
    let mut sorted = pixels.clone();
    sorted.sort_by(f64::total_cmp);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a place in the list")]
    let place = (sorted.len() as f64 * CLIP_SHARE) as usize;
    let brightest = sorted.get(place).or_else(|| sorted.last()).copied().unwrap_or(0.0);
    let scale = if brightest > 0.0 { 1.0 / brightest } else { 0.0 };
    let bytes: Vec<u8> = pixels.iter().flat_map(|value| colour(value * scale)).collect();
    let edge = u32::try_from(edge).expect("a picture's edge is bounded");
    let mut png = Vec::new();
    PngEncoder::new(&mut png).write_image(&bytes, edge, edge, ExtendedColorType::Rgb8)?;
    Ok(png)
}

/// A colour for 0..=1 between five of the viridis map (Smith and van der Walt 2015).
fn colour(share: f64) -> [u8; 3] {
    const STOPS: [[f64; 3]; 5] = [
        [68.0, 1.0, 84.0],
        [59.0, 82.0, 139.0],
        [33.0, 145.0, 140.0],
        [94.0, 201.0, 98.0],
        [253.0, 231.0, 37.0],
    ];
    let place = share.clamp(0.0, 1.0) * 4.0;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 3")]
    let first = (place as usize).min(3);
    let between = place - first as f64;
    std::array::from_fn(|channel| {
        let value = STOPS[first][channel] * (1.0 - between) + STOPS[first + 1][channel] * between;
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 255")]
        let byte = value.round() as u8;
        byte
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{NullModel, Seed, ShuffleKind, parse};

    #[test]
    fn a_matrix_is_a_numpy_file() {
        let mut file = Vec::new();
        write_npy(&mut file, 2, &[1.0, 2.0, 3.0, 4.0]).unwrap();
        assert_eq!(file.len() % 64, 32, "the data begins at a multiple of 64");
        assert!(file.starts_with(b"\x93NUMPY\x01\x00\x76\x00{'descr': '<f8'"));
        assert!(file.ends_with(&4.0_f64.to_le_bytes()));
        assert_eq!(file[127], b'\n');
    }

    #[test]
    fn pairs_are_ranked_and_pictures_have_the_right_size() {
        let alignment = parse(b"ACA\nACC\nGTA\nGTC\n").unwrap().alignment;
        let reference = Reference::new(&alignment).unwrap();
        let null = NullModel::new(&reference, Seed(1), ShuffleKind::Feistel);
        let pairs = null.run(0..40).unwrap().statistics(&null);
        let mut csv = Vec::new();
        write_top_pairs(&mut csv, &alignment, &pairs, 2).unwrap();
        let text = String::from_utf8(csv).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 3, "{text}");
        assert!(lines[1].starts_with("1,A,2,C,1,1,"), "{text}");
        let [(name, mi), ..] = matrices(&reference, &pairs);
        assert_eq!((name, mi[0], mi[1], mi[3]), ("mi_bits", 1.0, 1.0, 1.0));
        let picture = image::load_from_memory(&heat_map(3, &mi).unwrap()).unwrap();
        assert_eq!((picture.width(), picture.height()), (3, 3));
        let wide = heat_map(2_049, &vec![0.0; 2_049 * 2_049]).unwrap();
        assert_eq!(image::load_from_memory(&wide).unwrap().width(), 1_025, "blocks of 2");
    }
}
