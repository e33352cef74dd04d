//! From an order to what can be submitted: the first half of the program interpreter.
//!
//! It checks everything against the device and the modules, takes buffers and pipelines, uploads host bytes. It
//! runs nothing: a staged job is prepared while another one runs. Errors name the command at fault.

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use bytes::Bytes;
use farm_core::{
    id::{ContentHash, JobAttempt},
    message::{JobFailure, LatencyClass},
    program::{Access, Buffer, Command, Kernel, ProgramQuota, ProgramSummary, Slicing, validate},
};

use super::{
    adapter::Gpu,
    memory::{AllocationCache, Pool, Pooled, Purpose, SliceTable},
    pipeline::{Pipeline, PipelineCache},
};
use crate::executor::{ExecutorConfig, Host, Order};

/// What a device holds over the jobs.
#[derive(Debug)]
pub(crate) struct Caches {
    pub(crate) pool: Pool,
    pub(crate) allocations: AllocationCache,
    pub(crate) pipelines: PipelineCache,
    pub(crate) slices: SliceTable,
}

impl Caches {
    pub(crate) fn new(gpu: &Gpu, config: &ExecutorConfig) -> Self {
        Self {
            pool: Pool::new(gpu, config),
            allocations: AllocationCache::new(gpu, config),
            pipelines: PipelineCache::new(gpu, config),
            slices: SliceTable::default(),
        }
    }
}

/// A job with everything on the device.
#[derive(Debug)]
pub(crate) struct Prepared {
    pub(crate) job: JobAttempt,
    pub(crate) class: LatencyClass,
    pub(crate) limit: Duration,
    pub(crate) steps: Vec<Step>,
    /// Lengths of the result's sections.
    pub(crate) sections: Vec<u64>,
    pub(crate) held: Held,
}

/// What a job holds on the device until it ends.
#[derive(Debug, Default)]
pub(crate) struct Held {
    pub(crate) buffers: Vec<Pooled>,
    pub(crate) readback: Option<Pooled>,
    /// Pins of task allocations.
    allocations: Vec<Arc<wgpu::Buffer>>,
}

impl Held {
    /// Hands everything back, once the device no longer uses it.
    pub(crate) fn release(self, caches: &mut Caches) {
        self.buffers.into_iter().chain(self.readback).for_each(|pooled| caches.pool.give(pooled));
        drop(self.allocations);
        caches.allocations.settle();
    }
}

/// One thing to record, in order.
#[derive(Debug)]
pub(crate) enum Step {
    /// Staged bytes into a job allocation.
    Copy {
        source: wgpu::Buffer,
        source_offset: u64,
        target: wgpu::Buffer,
        target_offset: u64,
        size_bytes: u64,
    },
    /// A kernel.
    Launch(Launch),
}

/// One launch, bound.
#[derive(Debug)]
pub(crate) struct Launch {
    /// Index of the command, for messages.
    pub(crate) command: usize,
    pub(crate) pipeline: Arc<Pipeline>,
    pub(crate) bind_groups: Vec<Option<wgpu::BindGroup>>,
    pub(crate) groups: [u32; 3],
    pub(crate) slices: Option<Slices>,
}

/// How a sliced launch binds the first layer of each run.
#[derive(Debug)]
pub(crate) struct Slices {
    pub(crate) max_groups_z: u32,
    group: u32,
    binding: u32,
    table: wgpu::Buffer,
    stride_bytes: u64,
    /// The other uniforms of the group.
    others: Vec<(u32, Region)>,
}

impl Slices {
    /// The group that holds the slicing global, with `first_z` in it.
    pub(crate) fn bind(&self, gpu: &Gpu, pipeline: &Pipeline, first_z: u32) -> (u32, wgpu::BindGroup) {
        let first = Region {
            buffer: self.table.clone(),
            offset_bytes: u64::from(first_z) * self.stride_bytes,
            size_bytes: 4,
        };
        let all =
            self.others.iter().map(|(binding, region)| (*binding, region)).chain([(self.binding, &first)]);
        (self.group, bind(gpu, pipeline, self.group, all))
    }
}

#[derive(Clone, Debug)]
struct Region {
    buffer: wgpu::Buffer,
    offset_bytes: u64,
    size_bytes: u64,
}

fn bind<'a>(
    gpu: &Gpu,
    pipeline: &Pipeline,
    group: u32,
    regions: impl Iterator<Item = (u32, &'a Region)>,
) -> wgpu::BindGroup {
    let entries: Vec<_> = regions
        .map(|(binding, region)| wgpu::BindGroupEntry {
            binding,
            resource: wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                buffer: &region.buffer,
                offset: region.offset_bytes,
                size: wgpu::BufferSize::new(region.size_bytes),
            }),
        })
        .collect();
    let layout = pipeline.layouts[group as usize].as_ref().expect("a bound group has a layout");
    gpu.device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout, entries: &entries })
}

/// Prepares an order. When the device has no memory, idle buffers are freed and it is tried once more.
pub(crate) fn prepare(
    gpu: &Gpu,
    caches: &mut Caches,
    order: &Order,
    host: &dyn Host,
) -> Result<Prepared, JobFailure> {
    let quota = ProgramQuota {
        memory_bytes: gpu.memory_bytes(),
        result_bytes: ProgramQuota::default().result_bytes.min(gpu.limits.max_buffer_size & !3),
        groups_per_dimension: gpu.limits.max_compute_workgroups_per_dimension,
        ..ProgramQuota::default()
    };
    let summary =
        validate(&order.program, &quota).map_err(|error| JobFailure::InvalidProgram(error.to_string()))?;
    check_limits(gpu, &summary)?;
    match attempt(gpu, caches, order, host, &summary) {
        Err(JobFailure::OutOfMemory(reason)) => {
            tracing::info!(job = %order.job, reason, "freeing idle device memory");
            caches.pool.trim();
            caches.allocations.trim();
            attempt(gpu, caches, order, host, &summary)
        }
        outcome => outcome,
    }
}

fn check_limits(gpu: &Gpu, summary: &ProgramSummary) -> Result<(), JobFailure> {
    let limits = gpu.farm_limits();
    let checks = [
        ("buffer of", summary.largest_buffer_bytes, limits.buffer_bytes, "B"),
        ("parameter of", summary.largest_binding_bytes, limits.binding_bytes, "B"),
        ("kernel of", summary.storage_buffers.into(), limits.storage_buffers.into(), "parameters"),
    ];
    for (what, needed, limit, unit) in checks {
        if needed > limit {
            return Err(JobFailure::InvalidProgram(format!(
                "a {what} {needed} {unit} is over this device's {limit}; say so in the job's requirements"
            )));
        }
    }
    Ok(())
}

fn attempt(
    gpu: &Gpu,
    caches: &mut Caches,
    order: &Order,
    host: &dyn Host,
    summary: &ProgramSummary,
) -> Result<Prepared, JobFailure> {
    let mut preparation = Preparation::new(gpu, caches, order, host);
    let built = gpu.scoped(|| {
        preparation.allocate()?;
        preparation.replay(&summary.sections)
    });
    let Preparation { held, steps, .. } = preparation;
    let failure = match built {
        Ok(Ok(())) => None,
        Ok(Err(failure)) => Some(failure),
        Err(refusal) => Some(refusal.into_failure("program")),
    };
    if let Some(failure) = failure {
        // Without memory some of the buffers are invalid: none of them may reach the pool.
        if !matches!(failure, JobFailure::OutOfMemory(_)) {
            held.release(caches);
        }
        return Err(failure);
    }
    Ok(Prepared {
        job: order.job,
        class: order.class,
        limit: order.limit,
        steps,
        sections: summary.sections.clone(),
        held,
    })
}

struct Preparation<'a> {
    gpu: &'a Gpu,
    caches: &'a mut Caches,
    order: &'a Order,
    host: &'a dyn Host,
    held: Held,
    steps: Vec<Step>,
    buffers: BTreeMap<Buffer, wgpu::Buffer>,
    kernels: BTreeMap<Kernel, KernelState>,
    staging: Option<wgpu::Buffer>,
}

/// A kernel's bindings as the replay has reached them.
struct KernelState {
    pipeline: Arc<Pipeline>,
    parameters: BTreeMap<u32, Region>,
    globals: BTreeMap<(u32, u32), Region>,
    /// Bind groups of the last launch, while nothing changed since.
    bound: Option<Vec<Option<wgpu::BindGroup>>>,
}

/// A content's bytes, from the order or from the host.
fn content_bytes(order: &Order, host: &dyn Host, hash: ContentHash) -> Option<Bytes> {
    let brought = order.contents.iter().find(|(named, _)| *named == hash);
    brought.map(|(_, bytes)| bytes.clone()).or_else(|| host.content(&hash))
}

impl<'a> Preparation<'a> {
    fn new(gpu: &'a Gpu, caches: &'a mut Caches, order: &'a Order, host: &'a dyn Host) -> Self {
        Self {
            gpu,
            caches,
            order,
            host,
            held: Held::default(),
            steps: Vec::with_capacity(order.program.commands().len()),
            buffers: BTreeMap::new(),
            kernels: BTreeMap::new(),
            staging: None,
        }
    }

    /// First pass: buffers, zero-filled; pipelines; one staging buffer for all that is copied or bound later.
    fn allocate(&mut self) -> Result<(), JobFailure> {
        let (order, host) = (self.order, self.host);
        let (mut staging_bytes, mut device_touched) = (0_u64, false);
        let alignment = self.gpu.global_alignment();
        let mut fills = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        for (index, command) in order.program.commands().iter().enumerate() {
            match command {
                Command::Malloc { buffer, size_bytes } => {
                    let pooled = self.caches.pool.take(self.gpu, Purpose::Allocation, *size_bytes);
                    if pooled.reused {
                        fills.clear_buffer(&pooled.buffer, 0, Some(*size_bytes));
                    }
                    self.buffers.insert(*buffer, pooled.buffer.clone());
                    self.held.buffers.push(pooled);
                }
                Command::TaskAllocation { buffer, content } => {
                    let cached = self
                        .caches
                        .allocations
                        .get(self.gpu, content.hash, || content_bytes(order, host, content.hash))
                        .ok_or(JobFailure::ContentUnavailable(content.hash))?
                        .map_err(|refusal| refusal.into_failure(&format!("command {index}")))?;
                    self.buffers.insert(*buffer, wgpu::Buffer::clone(&cached));
                    self.held.allocations.push(cached);
                }
                Command::Function { kernel, module, entry, constants } => {
                    let pipeline = self
                        .caches
                        .pipelines
                        .get(self.gpu, module.hash, entry, constants, || {
                            content_bytes(order, host, module.hash)
                        })
                        .map_err(|failure| at_command(index, failure))?;
                    self.kernels.insert(*kernel, KernelState::new(pipeline));
                }
                Command::MemcpyHtoD { bytes, .. } if device_touched => staging_bytes += bytes.len() as u64,
                Command::GlobalHtoD { bytes, .. } => {
                    staging_bytes = staging_bytes.next_multiple_of(alignment) + bytes.len() as u64;
                    staging_bytes = staging_bytes.next_multiple_of(4);
                }
                Command::Launch { .. } | Command::MemcpyDtoH { .. } => device_touched = true,
                Command::MemcpyHtoD { .. } | Command::Param { .. } => {}
            }
        }
        // Before any write below: queued writes go ahead of the next submit.
        self.gpu.queue.submit([fills.finish()]);
        if staging_bytes > 0 {
            let pooled = self.caches.pool.take(self.gpu, Purpose::Staging, staging_bytes);
            self.staging = Some(pooled.buffer.clone());
            self.held.buffers.push(pooled);
        }
        Ok(())
    }

    /// Second pass: host bytes, bindings, steps.
    fn replay(&mut self, sections: &[u64]) -> Result<(), JobFailure> {
        let order = self.order;
        let result_bytes: u64 = sections.iter().sum();
        let readback = (result_bytes > 0).then(|| {
            let pooled = self.caches.pool.take(self.gpu, Purpose::Readback, result_bytes);
            self.held.readback.insert(pooled).buffer.clone()
        });
        let (mut staged, mut device_touched, mut result_offset) = (Vec::new(), false, 0);
        for (index, command) in order.program.commands().iter().enumerate() {
            match command {
                Command::Malloc { .. } | Command::TaskAllocation { .. } | Command::Function { .. } => {}
                Command::MemcpyHtoD { buffer, offset_bytes, bytes } => {
                    let target = self.buffer(index, *buffer)?;
                    if device_touched {
                        let source_offset = stage(&mut staged, bytes, 4);
                        self.copy_staged(source_offset, target, *offset_bytes, bytes.len() as u64);
                    } else {
                        // Nothing reads the buffer before the first launch or readback: the queue writes it directly.
                        self.gpu.queue.write_buffer(&target, *offset_bytes, bytes);
                    }
                }
                Command::GlobalHtoD { kernel, name, bytes } => {
                    let alignment = self.gpu.global_alignment();
                    let offset_bytes = stage(&mut staged, bytes, alignment);
                    self.set_global(index, *kernel, name, offset_bytes, bytes.len() as u64)?;
                }
                Command::Param { kernel, index: parameter, buffer, offset_bytes, size_bytes, access } => {
                    let buffer = self.buffer(index, *buffer)?;
                    // A task allocation's last bytes are padded to a multiple of 4.
                    let size_bytes =
                        size_bytes.next_multiple_of(4).min(buffer.size().saturating_sub(*offset_bytes));
                    let region = Region { buffer, offset_bytes: *offset_bytes, size_bytes };
                    self.set_parameter(index, *kernel, *parameter, region, *access)?;
                }
                Command::Launch { kernel, groups, slicing, .. } => {
                    device_touched = true;
                    self.launch(index, *kernel, *groups, slicing.as_ref())?;
                }
                Command::MemcpyDtoH { buffer, offset_bytes, size_bytes } => {
                    device_touched = true;
                    let source = self.buffer(index, *buffer)?;
                    let target = readback.clone().expect("a program with a section has result bytes");
                    self.steps.push(Step::Copy {
                        source,
                        source_offset: *offset_bytes,
                        target,
                        target_offset: result_offset,
                        size_bytes: *size_bytes,
                    });
                    result_offset += size_bytes;
                }
            }
        }
        if let Some(staging) = &self.staging {
            staged.resize(staged.len().next_multiple_of(4), 0);
            self.gpu.queue.write_buffer(staging, 0, &staged);
        }
        // Starts the uploads now, while another job may be running.
        self.gpu.queue.submit([]);
        Ok(())
    }

    fn set_global(
        &mut self,
        index: usize,
        kernel: Kernel,
        name: &str,
        offset_bytes: u64,
        size_bytes: u64,
    ) -> Result<(), JobFailure> {
        let buffer = self.staging.clone().expect("a program with a global has staged bytes");
        let state = self.kernel(index, kernel)?;
        let Some(global) = state.pipeline.module.globals.get(name).copied() else {
            let known =
                state.pipeline.module.globals.keys().map(String::as_str).collect::<Vec<_>>().join(", ");
            return Err(invalid(index, &format!("the module has no `var<uniform> {name}`; it has: {known}")));
        };
        if global.size_bytes != size_bytes {
            return Err(invalid(
                index,
                &format!("global `{name}` takes {} B, not {size_bytes} B", global.size_bytes),
            ));
        }
        let region = Region { buffer, offset_bytes, size_bytes };
        state.globals.insert((global.group, global.binding), region);
        state.bound = None;
        Ok(())
    }

    fn set_parameter(
        &mut self,
        index: usize,
        kernel: Kernel,
        parameter: u32,
        region: Region,
        access: Access,
    ) -> Result<(), JobFailure> {
        let state = self.kernel(index, kernel)?;
        if !state.pipeline.module.parameters.contains(&parameter) {
            return Err(invalid(
                index,
                &format!("the module has no storage buffer @group(0) @binding({parameter})"),
            ));
        }
        if let Some(declared) = state.pipeline.entry.parameters.get(&parameter) {
            if declared.writable && access == Access::In {
                return Err(invalid(
                    index,
                    &format!(
                        "parameter {parameter} is `read_write` in the module and bound for reading only"
                    ),
                ));
            }
            if region.size_bytes < declared.least_bytes {
                return Err(invalid(
                    index,
                    &format!(
                        "parameter {parameter} takes at least {} B, not {} B",
                        declared.least_bytes, region.size_bytes
                    ),
                ));
            }
        }
        state.parameters.insert(parameter, region);
        state.bound = None;
        Ok(())
    }

    fn launch(
        &mut self,
        index: usize,
        kernel: Kernel,
        groups: [u32; 3],
        slicing: Option<&Slicing>,
    ) -> Result<(), JobFailure> {
        let gpu = self.gpu;
        let table = slicing.map(|_| self.caches.slices.get(gpu, groups[2]));
        let state = self.kernel(index, kernel)?;
        let pipeline = Arc::clone(&state.pipeline);
        let slices = match (slicing, table) {
            (Some(slicing), Some((table, stride_bytes))) => {
                Some(state.slices(index, slicing, table, stride_bytes)?)
            }
            _ => None,
        };
        let sliced = slices.as_ref().map(|slices| (slices.group, slices.binding));
        let bind_groups = match &state.bound {
            Some(bound) if slices.is_none() => bound.clone(),
            _ => {
                let bound = state.bind_groups(gpu, index, sliced)?;
                state.bound = slices.is_none().then(|| bound.clone());
                bound
            }
        };
        self.steps.push(Step::Launch(Launch { command: index, pipeline, bind_groups, groups, slices }));
        Ok(())
    }

    fn copy_staged(&mut self, source_offset: u64, target: wgpu::Buffer, target_offset: u64, size_bytes: u64) {
        let source = self.staging.clone().expect("a program with a late copy has staged bytes");
        self.steps.push(Step::Copy { source, source_offset, target, target_offset, size_bytes });
    }

    fn buffer(&self, index: usize, buffer: Buffer) -> Result<wgpu::Buffer, JobFailure> {
        self.buffers.get(&buffer).cloned().ok_or_else(|| invalid(index, &format!("no buffer {}", buffer.0)))
    }

    fn kernel(&mut self, index: usize, kernel: Kernel) -> Result<&mut KernelState, JobFailure> {
        self.kernels.get_mut(&kernel).ok_or_else(|| invalid(index, &format!("no kernel {}", kernel.0)))
    }
}

impl KernelState {
    fn new(pipeline: Arc<Pipeline>) -> Self {
        Self { pipeline, parameters: BTreeMap::new(), globals: BTreeMap::new(), bound: None }
    }

    fn slices(
        &self,
        index: usize,
        slicing: &Slicing,
        table: wgpu::Buffer,
        stride_bytes: u64,
    ) -> Result<Slices, JobFailure> {
        let name = &slicing.global;
        let Some(global) = self.pipeline.used_global(name).filter(|global| global.is_u32) else {
            return Err(invalid(
                index,
                &format!("slicing global `{name}` is no u32 uniform of the entry point"),
            ));
        };
        let mut others = Vec::new();
        for (other_name, other) in self.used_globals() {
            if other.group == global.group && other.binding != global.binding {
                let region = self.globals.get(&(other.group, other.binding));
                let region = region.ok_or_else(|| never_set(index, other_name))?;
                others.push((other.binding, region.clone()));
            }
        }
        Ok(Slices {
            max_groups_z: slicing.max_groups_z.max(1),
            group: global.group,
            binding: global.binding,
            table,
            stride_bytes,
            others,
        })
    }

    /// All groups of the pipeline, but for the one that a slicing global is in: that one is bound run by run.
    fn bind_groups(
        &self,
        gpu: &Gpu,
        index: usize,
        sliced: Option<(u32, u32)>,
    ) -> Result<Vec<Option<wgpu::BindGroup>>, JobFailure> {
        let mut regions: BTreeMap<u32, Vec<(u32, &Region)>> = BTreeMap::new();
        for &parameter in self.pipeline.entry.parameters.keys() {
            let Some(region) = self.parameters.get(&parameter) else {
                return Err(invalid(index, &format!("launch: parameter {parameter} was never bound")));
            };
            regions.entry(0).or_default().push((parameter, region));
        }
        for (name, global) in self.used_globals() {
            if sliced.is_some_and(|(group, _)| group == global.group) {
                continue;
            }
            let region = self.globals.get(&(global.group, global.binding));
            let region = region.ok_or_else(|| never_set(index, name))?;
            regions.entry(global.group).or_default().push((global.binding, region));
        }
        let groups = (0_u32..).zip(&self.pipeline.layouts);
        let bound = groups.map(|(group, _)| {
            regions.remove(&group).map(|regions| bind(gpu, &self.pipeline, group, regions.into_iter()))
        });
        Ok(bound.collect())
    }

    fn used_globals(&self) -> impl Iterator<Item = (&str, super::module::Global)> {
        let globals = self.pipeline.entry.globals.iter();
        globals.filter_map(|name| Some((name.as_str(), *self.pipeline.module.globals.get(name)?)))
    }
}

/// Appends bytes at the next multiple of `alignment`; gives their offset.
fn stage(staged: &mut Vec<u8>, bytes: &[u8], alignment: u64) -> u64 {
    let alignment = usize::try_from(alignment).expect("an alignment of at most 256 B");
    staged.resize(staged.len().next_multiple_of(alignment), 0);
    let offset_bytes = staged.len() as u64;
    staged.extend_from_slice(bytes);
    staged.resize(staged.len().next_multiple_of(4), 0);
    offset_bytes
}

fn invalid(index: usize, text: &str) -> JobFailure {
    JobFailure::InvalidProgram(format!("command {index}: {text}"))
}

fn never_set(index: usize, name: &str) -> JobFailure {
    invalid(index, &format!("launch: global `{name}` was never set"))
}

fn at_command(index: usize, failure: JobFailure) -> JobFailure {
    match failure {
        JobFailure::InvalidProgram(text) => invalid(index, &text),
        other => other,
    }
}
