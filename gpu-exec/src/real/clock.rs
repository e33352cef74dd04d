//! Device time of submits: timestamp queries where the device has them, else wall time.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use super::adapter::Gpu;

/// Most launches of one submit: each takes two timestamps of a slot.
pub(crate) const MAX_LAUNCHES_PER_SUBMIT: u32 = 32;

const QUERIES: u32 = 2 * MAX_LAUNCHES_PER_SUBMIT;
const QUERY_BYTES: u64 = QUERIES as u64 * wgpu::QUERY_SIZE as u64;

/// Timestamps of one submit's launches.
#[derive(Debug)]
pub(crate) struct Timestamps {
    queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    readable: wgpu::Buffer,
    mapped: Arc<AtomicBool>,
    launches: u32,
}

/// Idle slots of timestamps; as many as submits were ever on the way at once.
#[derive(Debug, Default)]
pub(crate) struct TimestampPool {
    idle: Vec<Timestamps>,
}

impl TimestampPool {
    /// A slot, or `None` on a device without timestamps.
    pub(crate) fn take(&mut self, gpu: &Gpu) -> Option<Timestamps> {
        gpu.timestamp_period_ns?;
        Some(self.idle.pop().unwrap_or_else(|| Timestamps::new(gpu)))
    }

    pub(crate) fn give(&mut self, timestamps: Timestamps) {
        self.idle.push(timestamps);
    }
}

impl Timestamps {
    fn new(gpu: &Gpu) -> Self {
        let buffer = |usage| {
            gpu.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("timestamps"),
                size: QUERY_BYTES,
                usage,
                mapped_at_creation: false,
            })
        };
        Self {
            queries: gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("timestamps"),
                ty: wgpu::QueryType::Timestamp,
                count: QUERIES,
            }),
            resolved: buffer(wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC),
            readable: buffer(wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST),
            mapped: Arc::default(),
            launches: 0,
        }
    }

    /// Where the next launch's pass writes its begin and end.
    pub(crate) fn next_launch(&mut self) -> wgpu::ComputePassTimestampWrites<'_> {
        let first = 2 * self.launches;
        self.launches += 1;
        wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        }
    }

    /// Records the way of the timestamps to the host, after the last launch.
    pub(crate) fn resolve(&self, encoder: &mut wgpu::CommandEncoder) {
        if self.launches > 0 {
            let bytes = u64::from(2 * self.launches) * u64::from(wgpu::QUERY_SIZE);
            encoder.resolve_query_set(&self.queries, 0..2 * self.launches, &self.resolved, 0);
            encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.readable, 0, bytes);
        }
    }

    /// Asks for the values, after the submit.
    pub(crate) fn request(&self) {
        let mapped = Arc::clone(&self.mapped);
        self.readable.map_async(wgpu::MapMode::Read, .., move |outcome| {
            mapped.store(outcome.is_ok(), Ordering::Release);
        });
    }

    /// What each launch took, once the submit is done; `None` when the values did not come.
    pub(crate) fn read(&mut self, period_ns: f64) -> Option<Vec<Duration>> {
        let launches = std::mem::take(&mut self.launches);
        if !self.mapped.swap(false, Ordering::Acquire) {
            return None;
        }
        let durations = self.readable.get_mapped_range(..).ok().map(|view| {
            let ticks: &[u64] = bytemuck::cast_slice(&view);
            let taken = |pair: &[u64]| pair[1].saturating_sub(pair[0]) as f64 * period_ns;
            let pairs = ticks.chunks_exact(2).take(launches as usize);
            pairs.map(|pair| Duration::from_secs_f64(taken(pair) / 1e9)).collect()
        });
        self.readable.unmap();
        durations
    }
}

/// Wall time of submits that run one after the other: from the later of its submission and the end of the one before.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WallClock {
    previous_end: Instant,
}

impl WallClock {
    pub(crate) fn new(now: Instant) -> Self {
        Self { previous_end: now }
    }

    /// The share of a submit that was seen to end `now`.
    pub(crate) fn charge(&mut self, submitted: Instant, now: Instant) -> Duration {
        let begin = submitted.max(self.previous_end);
        self.previous_end = now;
        now.saturating_duration_since(begin)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn overlapping_submits_are_charged_once() {
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        let mut clock = WallClock::new(start);
        assert_eq!(clock.charge(at(0), at(10)), Duration::from_millis(10));
        assert_eq!(clock.charge(at(1), at(25)), Duration::from_millis(15), "began when the first ended");
        assert_eq!(clock.charge(at(40), at(45)), Duration::from_millis(5), "the device was idle in between");
    }
}
