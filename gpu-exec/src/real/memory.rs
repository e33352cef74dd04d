//! Device memory: pooled buffers for jobs, the cache of task allocations, the table of slice offsets.
//!
//! Everything is bounded in bytes. It decides what stays on the device, never what a job may use.

use std::{collections::HashMap, sync::Arc};

use bytes::Bytes;
use farm_core::id::ContentHash;

use super::{adapter::Gpu, scope::Refusal};
use crate::executor::ExecutorConfig;

/// The smallest size class.
const SMALLEST_CLASS_BYTES: u64 = 4 << 10;
/// Task allocations are uploaded in submits of this many bytes, so that a large one neither doubles the host memory nor
/// keeps the queue busy for long.
const UPLOAD_CHUNK_BYTES: usize = 32 << 20;
/// Entries of the slice table are made for this many layers at least.
const LEAST_SLICES: u32 = 1_024;

/// Named globals are bound as uniforms or as storage (`module::GlobalsIn`).
const GLOBALS: wgpu::BufferUsages = wgpu::BufferUsages::UNIFORM.union(wgpu::BufferUsages::STORAGE);

/// What a pooled buffer is for; buffers of different purposes are never exchanged.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Purpose {
    /// A job allocation. Given out zero-filled.
    Allocation,
    /// Host bytes on their way into job allocations, and values of named globals.
    Staging,
    /// Results on their way to the host.
    Readback,
}

impl Purpose {
    fn usage(self) -> wgpu::BufferUsages {
        match self {
            Self::Allocation => {
                wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST
            }
            Self::Staging => GLOBALS | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST,
            Self::Readback => wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        }
    }
}

/// A buffer of the pool, at least as large as asked for.
#[derive(Debug)]
pub(crate) struct Pooled {
    pub(crate) buffer: wgpu::Buffer,
    purpose: Purpose,
    /// It served another job before: its bytes are that job's.
    pub(crate) reused: bool,
}

/// Idle buffers by purpose and size class.
#[derive(Debug)]
pub(crate) struct Pool {
    idle: HashMap<(Purpose, u64), Vec<wgpu::Buffer>>,
    idle_bytes: u64,
    cap_bytes: u64,
    largest_bytes: u64,
}

impl Pool {
    pub(crate) fn new(gpu: &Gpu, config: &ExecutorConfig) -> Self {
        Self {
            idle: HashMap::new(),
            idle_bytes: 0,
            cap_bytes: fraction(gpu.memory_bytes(), config.pool_fraction),
            largest_bytes: gpu.limits.max_buffer_size & !3,
        }
    }

    /// A buffer of at least `size_bytes`. A fresh one is zero; a reused one is marked so.
    pub(crate) fn take(&mut self, gpu: &Gpu, purpose: Purpose, size_bytes: u64) -> Pooled {
        let class_bytes = size_class(size_bytes).min(self.largest_bytes).max(size_bytes);
        if let Some(buffer) = self.idle.get_mut(&(purpose, class_bytes)).and_then(Vec::pop) {
            self.idle_bytes -= class_bytes;
            return Pooled { buffer, purpose, reused: true };
        }
        let buffer = gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: class_bytes,
            usage: purpose.usage(),
            mapped_at_creation: false,
        });
        Pooled { buffer, purpose, reused: false }
    }

    /// Takes a buffer back that the device no longer uses; drops it where the pool is full.
    pub(crate) fn give(&mut self, pooled: Pooled) {
        let class_bytes = pooled.buffer.size();
        if self.idle_bytes + class_bytes > self.cap_bytes {
            pooled.buffer.destroy();
            return;
        }
        self.idle_bytes += class_bytes;
        self.idle.entry((pooled.purpose, class_bytes)).or_default().push(pooled.buffer);
    }

    /// Frees every idle buffer: the device has no memory left.
    pub(crate) fn trim(&mut self) {
        for buffer in self.idle.drain().flat_map(|(_, buffers)| buffers) {
            buffer.destroy();
        }
        self.idle_bytes = 0;
    }
}

/// Four classes an octave: at most a quarter of a buffer is unused.
fn size_class(size_bytes: u64) -> u64 {
    if size_bytes <= SMALLEST_CLASS_BYTES {
        return SMALLEST_CLASS_BYTES;
    }
    let step = (size_bytes.next_power_of_two() >> 3).max(1);
    size_bytes.next_multiple_of(step)
}

fn fraction(bytes: u64, of: f64) -> u64 {
    #[expect(clippy::cast_possible_truncation, reason = "a bound; a clamped fraction of it is one too")]
    #[expect(clippy::cast_sign_loss, reason = "clamped to 0..=1")]
    let part = (bytes as f64 * of.clamp(0.0, 1.0)) as u64;
    part
}

/// Task allocations on the device, least recently used first out; those that a job holds stay.
#[derive(Debug)]
pub(crate) struct AllocationCache {
    entries: HashMap<ContentHash, Entry>,
    bytes: u64,
    cap_bytes: u64,
    clock: u64,
}

#[derive(Debug)]
struct Entry {
    buffer: Arc<wgpu::Buffer>,
    used_at: u64,
}

impl AllocationCache {
    pub(crate) fn new(gpu: &Gpu, config: &ExecutorConfig) -> Self {
        let cap_bytes = fraction(gpu.memory_bytes(), config.allocation_cache_fraction);
        Self { entries: HashMap::new(), bytes: 0, cap_bytes, clock: 0 }
    }

    /// The allocation's buffer; if it is not here, `bytes` are asked for and uploaded. The caller's clone pins it.
    ///
    /// A buffer is a multiple of 4 long; the last bytes are zeros.
    pub(crate) fn get(
        &mut self,
        gpu: &Gpu,
        hash: ContentHash,
        bytes: impl FnOnce() -> Option<Bytes>,
    ) -> Option<Result<Arc<wgpu::Buffer>, Refusal>> {
        self.clock += 1;
        if let Some(entry) = self.entries.get_mut(&hash) {
            entry.used_at = self.clock;
            return Some(Ok(Arc::clone(&entry.buffer)));
        }
        let bytes = bytes()?;
        self.evict_to(self.cap_bytes.saturating_sub(bytes.len() as u64));
        let uploaded = gpu.scoped(|| upload(gpu, &bytes)).map(Arc::new);
        if let Ok(buffer) = &uploaded {
            self.bytes += buffer.size();
            self.entries.insert(hash, Entry { buffer: Arc::clone(buffer), used_at: self.clock });
        }
        Some(uploaded)
    }

    /// Brings the cache back under its cap after a job let go of what it held.
    pub(crate) fn settle(&mut self) {
        self.evict_to(self.cap_bytes);
    }

    /// Frees what no job holds: the device has no memory left.
    pub(crate) fn trim(&mut self) {
        self.evict_to(0);
    }

    fn evict_to(&mut self, most_bytes: u64) {
        while self.bytes > most_bytes {
            let idle = self.entries.iter().filter(|(_, entry)| Arc::strong_count(&entry.buffer) == 1);
            let Some(hash) = idle.min_by_key(|(_, entry)| entry.used_at).map(|(hash, _)| *hash) else {
                return;
            };
            if let Some(entry) = self.entries.remove(&hash) {
                self.bytes -= entry.buffer.size();
            }
        }
    }
}

fn upload(gpu: &Gpu, bytes: &Bytes) -> wgpu::Buffer {
    let buffer = gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: (bytes.len() as u64).next_multiple_of(4).max(4),
        usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    let (whole, tail) = bytes.split_at(bytes.len() & !3);
    let mut offset_bytes = 0;
    for chunk in whole.chunks(UPLOAD_CHUNK_BYTES) {
        gpu.queue.write_buffer(&buffer, offset_bytes, chunk);
        gpu.queue.submit([]);
        offset_bytes += chunk.len() as u64;
    }
    if !tail.is_empty() {
        let mut last = [0; 4];
        last[..tail.len()].copy_from_slice(tail);
        gpu.queue.write_buffer(&buffer, offset_bytes, &last);
    }
    buffer
}

/// The numbers 0, 1, 2, ... as uniforms: run `z` of a sliced launch binds entry `z`, so that runs need no write between
/// them and many can be on the way at once.
#[derive(Debug, Default)]
pub(crate) struct SliceTable {
    table: Option<(wgpu::Buffer, u32)>,
}

impl SliceTable {
    /// The table with at least `layers` entries, and the distance between entries in bytes.
    pub(crate) fn get(&mut self, gpu: &Gpu, layers: u32) -> (wgpu::Buffer, u64) {
        let stride = gpu.global_alignment();
        if let Some((table, entries)) = &self.table
            && *entries >= layers
        {
            return (table.clone(), stride);
        }
        let entries = layers.next_power_of_two().max(LEAST_SLICES);
        let size = u64::from(entries) * stride;
        let mut bytes =
            vec![0; usize::try_from(size).expect("65,536 entries of 256 B fit any address space")];
        let stride_bytes = usize::try_from(stride).expect("an alignment of at most 256 B");
        for (entry, value) in bytes.chunks_exact_mut(stride_bytes).zip(0_u32..) {
            entry[..4].copy_from_slice(&value.to_le_bytes());
        }
        let table = gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("slice table"),
            size,
            usage: GLOBALS | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        gpu.queue.write_buffer(&table, 0, &bytes);
        self.table = Some((table.clone(), entries));
        (table, stride)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn size_classes_waste_at_most_a_quarter_and_are_multiples_of_4() {
        for size_bytes in (4..100_000).step_by(4).chain([1 << 20, (1 << 20) + 4, (1 << 31) - 4]) {
            let class_bytes = size_class(size_bytes);
            assert!(class_bytes >= size_bytes, "{size_bytes} in {class_bytes}");
            assert!(class_bytes.is_multiple_of(4), "{size_bytes} in {class_bytes}");
            if size_bytes > SMALLEST_CLASS_BYTES {
                assert!(class_bytes - size_bytes <= class_bytes / 4, "{size_bytes} in {class_bytes}");
            }
            assert_eq!(size_class(class_bytes), class_bytes, "a class is its own class");
        }
    }
}
