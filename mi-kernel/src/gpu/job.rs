//! Programs of the null model's jobs, and what their results mean.

use std::ops::Range;

use bytemuck::{bytes_of, pod_collect_to_vec};
use farm_core::{
    message::CostNs,
    program::{Access, Buffer, Content, DispatchError, JobProgram, Kernel, Slicing},
};
use thiserror::Error;

use super::{
    layout::{self, KEYS_HEADER, LANES, ROWS_A_LANE, WORDS_A_LANE, binding},
    pack::{AlignmentContents, Chunk, Method, Shape},
};
use crate::{Accumulators, NullModelError, PairSums, Seed, philox::split};

/// Most iterations of one job: its commands stay below the farm's quota of 4,096.
const MAX_ITERATIONS: u64 = 512;

/// Pairs times sequences that a simulated device of speed 1.0 counts in a nanosecond: an H200's rate, roughly.
const COUNTS_A_NS: u64 = 1_000;

/// What a job computes.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum Pass {
    /// Scores of the alignment as it is.
    Observed,
    /// Sums over a range of iterations, for the pairs of some consecutive chunks (`reduce` mode).
    Reduce {
        /// Which iterations.
        iterations: Range<u64>,
        /// Positions in [`Shape::chunks`]; the shape's [`Shape::parts`] are such ranges.
        chunks: Range<usize>,
    },
    /// All scores of each iteration of a range (`matrix` mode).
    Matrix(Range<u64>),
}

/// A job of the null model. The same values always give the same bytes, on any device.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct MiJob {
    /// The null model's seed.
    pub seed: Seed,
    /// What to compute.
    pub pass: Pass,
}

/// A job's result is not what its program asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum DecodeError {
    /// Too few or too many sections.
    #[error("result has {got} sections, expected {expected}")]
    SectionCount {
        /// What the program asks for.
        expected: usize,
        /// What came.
        got: usize,
    },
    /// A section of another length.
    #[error("section {section} has {got} B, expected {expected} B")]
    SectionSize {
        /// Its index.
        section: usize,
        /// What the program asks for.
        expected: usize,
        /// What came.
        got: usize,
    },
    /// Sums that cannot be.
    #[error(transparent)]
    Sums(#[from] NullModelError),
}

impl MiJob {
    /// Fills a program with the job. `observed` names the observed scores, one content a chunk; only
    /// [`Pass::Reduce`] reads it.
    ///
    /// # Errors
    /// No iteration, no chunk, more than a program holds, or contents of another shape.
    pub fn program(
        &self,
        shape: &Shape,
        contents: &AlignmentContents,
        observed: &[Content],
        cmd: &mut JobProgram,
    ) -> Result<(), DispatchError> {
        let iterations = self.iterations();
        let (first, chunks) = self.chunks(shape);
        let count = iterations.end.saturating_sub(iterations.start);
        let commands = count * (4 + 3 * chunks.len() as u64);
        if count == 0 || chunks.is_empty() || count > MAX_ITERATIONS || commands > 3_500 {
            let reason = format!("{count} iterations over {} chunks in one job", chunks.len());
            return Err(DispatchError::Application(reason));
        }
        let observed_fit = observed.len() == shape.chunks.len() || !matches!(self.pass, Pass::Reduce { .. });
        if contents.orders.len() != shape.chunks.len() || !observed_fit {
            return Err(DispatchError::Application("contents of another shape".to_owned()));
        }
        let passes = Passes::new(shape, chunks, contents, cmd)?;
        let maxima = cmd.malloc(count * 4)?;
        let mut counters = Vec::with_capacity(chunks.len());
        for (index, chunk) in (first..).zip(chunks) {
            counters.push(match self.pass {
                Pass::Reduce { .. } => {
                    passes.reduce(shape, contents, (index, *chunk), observed[index], maxima, cmd)?
                }
                Pass::Observed | Pass::Matrix(_) => passes.matrix(shape, contents, (index, *chunk), cmd)?,
            });
        }
        for (slot, number) in (0_u32..).zip(iterations) {
            let (number_hi, number_lo) = split(number);
            let (seed_hi, seed_lo) = split(self.seed.0);
            let iteration = layout::Iteration {
                number_lo,
                number_hi,
                seed_lo,
                seed_hi,
                slot,
                shuffled: u32::from(self.pass != Pass::Observed),
                padding: [0; 2],
            };
            passes.shuffle(shape, &iteration, cmd)?;
            for counter in &counters {
                counter.run(shape, cmd)?;
                if let Outputs::Matrix(scores) = counter.outputs {
                    cmd.memcpy_dtoh(scores, 0, u64::from(counter.chunk.pairs) * 4)?;
                }
            }
        }
        for counter in &counters {
            if let Outputs::Reduce { sums, squares, reached } = counter.outputs {
                let pairs = u64::from(counter.chunk.pairs);
                cmd.memcpy_dtoh(sums, 0, pairs * 8)?;
                cmd.memcpy_dtoh(squares, 0, pairs * 8)?;
                cmd.memcpy_dtoh(reached, 0, pairs * 4)?;
            }
        }
        if let Pass::Reduce { .. } = self.pass {
            cmd.memcpy_dtoh(maxima, 0, count * 4)?;
        }
        Ok(())
    }

    /// The sums in the result of a [`Pass::Reduce`] (of its chunks' pairs) or [`Pass::Matrix`] (of all); `observed` holds the
    /// observed scores.
    ///
    /// # Errors
    /// The sections are not those that the program asks for, or no iterations make such sums.
    pub fn sums<B: AsRef<[u8]>>(
        &self,
        shape: &Shape,
        observed: &[i32],
        sections: &[B],
    ) -> Result<PairSums, DecodeError> {
        let l = shape.l as usize;
        let Pass::Reduce { iterations, .. } = &self.pass else {
            let mut sums = Accumulators::new(l);
            for (iteration, scores) in self.iterations().zip(self.scores(shape, sections)?) {
                sums.add(iteration, &scores, observed)?;
            }
            return Ok(sums.into_pair_sums());
        };
        let (_, chunks) = self.chunks(shape);
        let expected = chunks.len() * 3 + 1;
        if sections.len() != expected {
            return Err(DecodeError::SectionCount { expected, got: sections.len() });
        }
        let (mut sum, mut squares, mut reached) = (Vec::new(), Vec::new(), Vec::new());
        for (index, chunk) in chunks.iter().enumerate() {
            let pairs = chunk.pairs as usize;
            append(&mut sum, section(sections, index * 3, pairs)?);
            append(&mut squares, section(sections, index * 3 + 1, pairs)?);
            append(&mut reached, section(sections, index * 3 + 2, pairs)?);
        }
        let count = iterations.clone().count();
        let maxima = section::<u32, B>(sections, expected - 1, count)?;
        let maxima = iterations.clone().zip(maxima.into_iter().map(|word| (word ^ (1 << 31)).cast_signed()));
        let first_place = chunks.first().map_or(0, |chunk| chunk.first_place as usize);
        Ok(PairSums::new(l, first_place, sum, squares, reached, maxima.collect())?)
    }

    /// All scores in the result of a [`Pass::Observed`] or [`Pass::Matrix`], one vector an iteration.
    ///
    /// # Errors
    /// The sections are not those that the program asks for.
    pub fn scores<B: AsRef<[u8]>>(
        &self,
        shape: &Shape,
        sections: &[B],
    ) -> Result<Vec<Vec<i32>>, DecodeError> {
        let iterations = self.iterations().count();
        let expected = iterations * shape.chunks.len();
        if sections.len() != expected {
            return Err(DecodeError::SectionCount { expected, got: sections.len() });
        }
        let mut all = Vec::with_capacity(iterations);
        for iteration in 0..iterations {
            let mut scores = Vec::with_capacity(shape.pairs());
            for (index, chunk) in shape.chunks.iter().enumerate() {
                let place = iteration * shape.chunks.len() + index;
                scores.extend(section::<i32, B>(sections, place, chunk.pairs as usize)?);
            }
            all.push(scores);
        }
        Ok(all)
    }

    /// Estimated work of `iterations` iterations.
    #[must_use]
    pub fn cost(shape: &Shape, iterations: u64) -> CostNs {
        CostNs((u64::from(shape.n) * shape.pairs() as u64 / COUNTS_A_NS + 1).saturating_mul(iterations))
    }

    /// Which iterations it is of; the observed scores are none's, and count as the first.
    pub(crate) fn iterations(&self) -> Range<u64> {
        match &self.pass {
            Pass::Observed => 0..1,
            Pass::Reduce { iterations, .. } | Pass::Matrix(iterations) => iterations.clone(),
        }
    }

    /// The chunks that it is of, after the position of the first; none if the shape has no such chunks.
    fn chunks<'shape>(&self, shape: &'shape Shape) -> (usize, &'shape [Chunk]) {
        match &self.pass {
            Pass::Observed | Pass::Matrix(_) => (0, &shape.chunks),
            Pass::Reduce { chunks, .. } => {
                (chunks.start, shape.chunks.get(chunks.clone()).unwrap_or_default())
            }
        }
    }
}

fn section<T: bytemuck::Pod, B: AsRef<[u8]>>(
    sections: &[B],
    index: usize,
    count: usize,
) -> Result<Vec<T>, DecodeError> {
    let bytes = sections[index].as_ref();
    let expected = count * size_of::<T>();
    if bytes.len() != expected {
        return Err(DecodeError::SectionSize { section: index, expected, got: bytes.len() });
    }
    Ok(pod_collect_to_vec(bytes))
}

/// A copy only where there is something to append to.
fn append<T: Copy>(all: &mut Vec<T>, more: Vec<T>) {
    if all.is_empty() {
        *all = more;
    } else {
        all.extend_from_slice(&more);
    }
}

/// The kernels and buffers that all chunks share.
struct Passes {
    keys: Kernel,
    /// Writes `rows`.
    shuffle: Kernel,
    round_keys: Buffer,
    rows: Rows,
}

/// One iteration's alignment, as a method counts it.
enum Rows {
    Histograms { shuffled: Buffer, grouped: Buffer },
    Planes(Buffer),
}

impl Passes {
    fn new(
        shape: &Shape,
        chunks: &[Chunk],
        contents: &AlignmentContents,
        cmd: &mut JobProgram,
    ) -> Result<Self, DispatchError> {
        let sizes = shape.sizes();
        let round_keys = cmd.malloc((KEYS_HEADER + u64::from(shape.l) * 8) * 4)?;
        let keys = cmd.function(contents.module, "keys");
        cmd.param_in_out(keys, binding::ROUND_KEYS, round_keys)?;
        cmd.memcpy_htod(keys, "sizes", bytes_of(&sizes))?;
        let (rows, shuffle) = match shape.method {
            Method::Histograms => {
                let widest = chunks.iter().map(|chunk| chunk.columns).max().unwrap_or(1);
                let shuffled = cmd.malloc(u64::from(shape.n) * u64::from(sizes.row_words) * 4)?;
                let grouped = cmd.malloc(u64::from(widest) * u64::from(sizes.order_words) * 4)?;
                let shuffle = cmd.function(contents.module, "shuffle");
                cmd.param_in_out(shuffle, binding::SHUFFLED, shuffled)?;
                (Rows::Histograms { shuffled, grouped }, shuffle)
            }
            Method::Planes => {
                let words = u64::from(sizes.plane_words) * u64::from(shape.q - 1) * u64::from(shape.l);
                let planes = cmd.malloc(words * 4)?;
                let shuffle = cmd.function(contents.module, "planes_of_rows");
                cmd.param_in_out(shuffle, binding::PLANES, planes)?;
                (Rows::Planes(planes), shuffle)
            }
        };
        let codes = cmd.task_allocation(contents.codes);
        cmd.param_in(shuffle, binding::CODES, codes)?;
        cmd.param_in_out(shuffle, binding::ROUND_KEYS, round_keys)?;
        cmd.memcpy_htod(shuffle, "sizes", bytes_of(&sizes))?;
        Ok(Self { keys, shuffle, round_keys, rows })
    }

    fn shuffle(
        &self,
        shape: &Shape,
        iteration: &layout::Iteration,
        cmd: &mut JobProgram,
    ) -> Result<(), DispatchError> {
        let sizes = shape.sizes();
        cmd.memcpy_htod(self.keys, "iteration", bytes_of(iteration))?;
        cmd.launch(self.keys, [shape.l.div_ceil(LANES), 1, 1])?;
        let groups = match self.rows {
            Rows::Histograms { .. } => [sizes.row_words.div_ceil(LANES), 1, shape.n.div_ceil(ROWS_A_LANE)],
            Rows::Planes(_) => [shape.l.div_ceil(LANES), 1, sizes.plane_words],
        };
        cmd.launch_sliced(self.shuffle, groups, slicing(groups[2]), CostNs(0))
    }

    /// The counting kernel of a chunk with all that both modes bind, and the kernel that groups its rows, if it needs
    /// them grouped.
    fn counter(
        &self,
        shape: &Shape,
        contents: &AlignmentContents,
        (index, chunk): (usize, Chunk),
        mode: &str,
        cmd: &mut JobProgram,
    ) -> Result<(Option<Kernel>, Kernel), DispatchError> {
        let sizes = shape.sizes();
        let (range, _) = shape.range(chunk);
        let (group, count) = match self.rows {
            Rows::Histograms { shuffled, grouped } => {
                let grouped_bytes = u64::from(chunk.columns) * u64::from(sizes.order_words) * 4;
                let group = cmd.function(contents.module, "group");
                let order = cmd.task_allocation(contents.orders[index]);
                cmd.param_in(group, binding::SYMBOL_ORDER, order)?;
                cmd.param_in_out(group, binding::ROUND_KEYS, self.round_keys)?;
                cmd.param(group, binding::GROUPED, grouped, 0, grouped_bytes, Access::InOut)?;
                let count = cmd.function(contents.module, &format!("count_{mode}"));
                cmd.param_in_out(count, binding::SHUFFLED, shuffled)?;
                cmd.param(count, binding::GROUPED, grouped, 0, grouped_bytes, Access::InOut)?;
                (Some(group), count)
            }
            Rows::Planes(planes) => {
                let count = cmd.function(contents.module, &format!("planes_{mode}"));
                cmd.param_in_out(count, binding::PLANES, planes)?;
                (None, count)
            }
        };
        for (place, content) in [
            (binding::BOUNDS, contents.bounds),
            (binding::TABLE, contents.table),
            (binding::COLUMN_TERMS, contents.column_terms),
        ] {
            let buffer = cmd.task_allocation(content);
            cmd.param_in(count, place, buffer)?;
        }
        for kernel in group.into_iter().chain([count]) {
            cmd.memcpy_htod(kernel, "sizes", bytes_of(&sizes))?;
            cmd.memcpy_htod(kernel, "chunk", bytes_of(&range))?;
        }
        Ok((group, count))
    }

    fn reduce(
        &self,
        shape: &Shape,
        contents: &AlignmentContents,
        place: (usize, Chunk),
        observed: Content,
        maxima: Buffer,
        cmd: &mut JobProgram,
    ) -> Result<Counter, DispatchError> {
        let (group, count) = self.counter(shape, contents, place, "reduce", cmd)?;
        let pairs = u64::from(place.1.pairs);
        let (sums, squares, reached) =
            (cmd.malloc(pairs * 8)?, cmd.malloc(pairs * 8)?, cmd.malloc(pairs * 4)?);
        let observed = cmd.task_allocation(observed);
        cmd.param_in(count, binding::OBSERVED, observed)?;
        cmd.param_in_out(count, binding::ROUND_KEYS, self.round_keys)?;
        cmd.param_in_out(count, binding::SUMS, sums)?;
        cmd.param_in_out(count, binding::SQUARES, squares)?;
        cmd.param_in_out(count, binding::REACHED, reached)?;
        cmd.param_in_out(count, binding::MAXIMA, maxima)?;
        Ok(Counter { chunk: place.1, group, count, outputs: Outputs::Reduce { sums, squares, reached } })
    }

    fn matrix(
        &self,
        shape: &Shape,
        contents: &AlignmentContents,
        place: (usize, Chunk),
        cmd: &mut JobProgram,
    ) -> Result<Counter, DispatchError> {
        let (group, count) = self.counter(shape, contents, place, "matrix", cmd)?;
        let scores = cmd.malloc(u64::from(place.1.pairs) * 4)?;
        cmd.param_in_out(count, binding::SCORES, scores)?;
        Ok(Counter { chunk: place.1, group, count, outputs: Outputs::Matrix(scores) })
    }
}

/// What counts one chunk.
struct Counter {
    chunk: Chunk,
    group: Option<Kernel>,
    count: Kernel,
    outputs: Outputs,
}

enum Outputs {
    Reduce { sums: Buffer, squares: Buffer, reached: Buffer },
    Matrix(Buffer),
}

impl Counter {
    fn run(&self, shape: &Shape, cmd: &mut JobProgram) -> Result<(), DispatchError> {
        if let Some(group) = self.group {
            let groups = [shape.sizes().order_words.div_ceil(LANES * WORDS_A_LANE), 1, self.chunk.columns];
            cmd.launch_sliced(group, groups, slicing(groups[2]), CostNs(0))?;
        }
        let (range, z) = shape.range(self.chunk);
        let cost = CostNs(u64::from(self.chunk.pairs) * u64::from(shape.n) / COUNTS_A_NS + 1);
        cmd.launch_sliced(self.count, [range.columns_x, 1, z], slicing(z), cost)
    }
}

fn slicing(z: u32) -> Slicing {
    Slicing { global: "first_z".to_owned(), max_groups_z: z }
}
