//! Which Vulkan adapters there are, and opening one as a device.

use std::{
    collections::BTreeSet,
    sync::{
        Arc, LazyLock,
        atomic::{AtomicBool, Ordering},
    },
};

use farm_core::device::{DeviceKind, Features, Limits};

use crate::{error::OpenError, spec::DeviceSpec};

/// Memory that a software adapter may plan with. lavapipe's one heap is 2 GiB (Mesa 22.3), whatever the machine has.
const CPU_MEMORY_BYTES: u64 = 2 << 30;
/// Memory that a GPU may plan with where nothing better is known. wgpu 30 does not tell a heap's size; a smaller one
/// answers an allocation too many with out of memory, and the job is retried elsewhere.
const GPU_MEMORY_BYTES: u64 = 16 << 30;

/// Lives as long as the process. The last instance to go would unload the driver, and NVIDIA's (580) then crashes the
/// process when a thread that had used it ends: its thread-local destructors are gone.
static INSTANCE: LazyLock<wgpu::Instance> = LazyLock::new(new_instance);

/// An adapter of this machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Adapter {
    /// The value of `--device` that opens it.
    pub spec: String,
    /// The driver's name for it.
    pub name: String,
    /// GPU or software.
    pub kind: DeviceKind,
    /// The driver and its version.
    pub driver: String,
}

/// Every Vulkan adapter of this machine, GPUs first, each once. Empty where there is no Vulkan.
#[must_use]
pub fn enumerate() -> Vec<Adapter> {
    found(&INSTANCE).into_iter().map(Found::describe).collect()
}

/// What `all` stands for: every GPU, or the first software adapter where there is none.
pub(crate) fn all() -> Result<Vec<DeviceSpec>, OpenError> {
    let found = found(&INSTANCE);
    let gpus: Vec<_> =
        found.iter().map(|found| found.spec).filter(|spec| matches!(spec, DeviceSpec::Gpu(_))).collect();
    match (gpus.is_empty(), found.first()) {
        (false, _) => Ok(gpus),
        (true, Some(_)) => Ok(vec![DeviceSpec::Cpu]),
        (true, None) => Err(OpenError::NoAdapter { spec: DeviceSpec::All }),
    }
}

/// An open device. Dropping it waits for its work, so a hung one is dropped on a thread of its own.
#[derive(Clone, Debug)]
pub(crate) struct Gpu {
    pub(crate) device: wgpu::Device,
    pub(crate) queue: wgpu::Queue,
    pub(crate) limits: wgpu::Limits,
    pub(crate) name: String,
    pub(crate) kind: DeviceKind,
    /// What the driver compiles here is of use to adapters with the same key; `None` where it is kept nowhere.
    pub(crate) compiled_key: Option<String>,
    /// Nanoseconds a timestamp tick, where the device has usable timestamps.
    pub(crate) timestamp_period_ns: Option<f64>,
    lost: Arc<AtomicBool>,
}

impl Gpu {
    /// Opens the adapter that `spec` names.
    pub(crate) fn open(spec: DeviceSpec) -> Result<Self, OpenError> {
        Self::open_on(&INSTANCE, spec)
    }

    /// Opens the adapter again after its device was lost or hung: on an instance of its own.
    pub(crate) fn reopen(spec: DeviceSpec) -> Result<Self, OpenError> {
        Self::open_on(&new_instance(), spec)
    }

    fn open_on(instance: &wgpu::Instance, spec: DeviceSpec) -> Result<Self, OpenError> {
        let mut adapters = found(instance);
        if adapters.is_empty() {
            return Err(OpenError::NoAdapter { spec });
        }
        let Some(position) = adapters.iter().position(|found| found.spec == spec) else {
            let describe = |found: &Found| format!("{} ({})", found.spec, found.info.name);
            let found = adapters.iter().map(describe).collect::<Vec<_>>().join(", ");
            return Err(OpenError::NotFound { spec, found });
        };
        let Found { adapter, info, .. } = adapters.swap_remove(position);
        let kind = kind_of(&info);
        let features = adapter.features() & wanted_features();
        let limits = adapter.limits();
        let request = wgpu::DeviceDescriptor {
            label: Some("gleaner"),
            required_features: features,
            required_limits: limits.clone(),
            memory_hints: wgpu::MemoryHints::Performance,
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&request)).map_err(|error| {
            OpenError::Device { spec, adapter: info.name.clone(), reason: error.to_string() }
        })?;
        let lost = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&lost);
        device.set_device_lost_callback(move |reason, message| {
            if reason != wgpu::DeviceLostReason::Destroyed {
                tracing::warn!(message, "device lost");
            }
            flag.store(true, Ordering::Release);
        });
        // Errors belong to scopes (prepare, record); what arrives here came late, and the wait for the submit sees it.
        device
            .on_uncaptured_error(Arc::new(|error| tracing::warn!(%error, "device error outside any scope")));
        // lavapipe's dispatches leave no time between two timestamps: they are taken where the commands are recorded.
        let timestamps = features.contains(wgpu::Features::TIMESTAMP_QUERY) && kind == DeviceKind::Gpu;
        let timestamp_period_ns = timestamps.then(|| f64::from(queue.get_timestamp_period()));
        let compiled_key = features
            .contains(wgpu::Features::PIPELINE_CACHE)
            .then(|| wgpu::util::pipeline_cache_key(&info))
            .flatten();
        Ok(Self { device, queue, limits, name: info.name, kind, compiled_key, timestamp_period_ns, lost })
    }

    /// Whether the driver has given the device up.
    pub(crate) fn is_lost(&self) -> bool {
        self.lost.load(Ordering::Acquire)
    }

    /// Memory to plan with, estimated.
    pub(crate) fn memory_bytes(&self) -> u64 {
        match self.kind {
            DeviceKind::Gpu => GPU_MEMORY_BYTES,
            DeviceKind::Cpu | DeviceKind::Simulated => CPU_MEMORY_BYTES,
        }
    }

    /// The largest storage binding; always a multiple of 4.
    pub(crate) fn binding_bytes(&self) -> u64 {
        self.limits.max_storage_buffer_binding_size.min(self.limits.max_buffer_size) & !3
    }

    /// Distance between named globals in a buffer, in bytes, whether they are bound as uniforms or as storage.
    pub(crate) fn global_alignment(&self) -> u64 {
        let limits = &self.limits;
        limits.min_uniform_buffer_offset_alignment.max(limits.min_storage_buffer_offset_alignment).into()
    }

    /// What the node announces.
    pub(crate) fn farm_limits(&self) -> Limits {
        Limits {
            memory_bytes: self.memory_bytes(),
            buffer_bytes: self.limits.max_buffer_size & !3,
            binding_bytes: self.binding_bytes(),
            storage_buffers: self.limits.max_storage_buffers_per_shader_stage,
            workgroup_memory_bytes: self.limits.max_compute_workgroup_storage_size,
            workgroup_invocations: self.limits.max_compute_invocations_per_workgroup,
        }
    }

    /// What the node announces.
    pub(crate) fn farm_features(&self) -> Features {
        let have = self.device.features();
        let table = [
            (wgpu::Features::SHADER_INT64, Features::INT64),
            (wgpu::Features::SHADER_F16, Features::FLOAT16),
            (wgpu::Features::SUBGROUP, Features::SUBGROUP),
            (wgpu::Features::TIMESTAMP_QUERY, Features::TIMESTAMP),
        ];
        let both = |set: Features, (theirs, ours)| if have.contains(theirs) { set.union(ours) } else { set };
        table.into_iter().fold(Features::default(), both)
    }
}

/// Abilities that kernels may use, and what the executor uses itself: timestamps and the driver's cache.
fn wanted_features() -> wgpu::Features {
    wgpu::Features::SHADER_INT64
        | wgpu::Features::SHADER_INT64_ATOMIC_ALL_OPS
        | wgpu::Features::SHADER_FLOAT32_ATOMIC
        | wgpu::Features::SHADER_F16
        | wgpu::Features::SUBGROUP
        | wgpu::Features::TIMESTAMP_QUERY
        | wgpu::Features::PIPELINE_CACHE
}

struct Found {
    spec: DeviceSpec,
    adapter: wgpu::Adapter,
    info: wgpu::AdapterInfo,
}

impl Found {
    fn describe(self) -> Adapter {
        Adapter {
            spec: self.spec.to_string(),
            kind: kind_of(&self.info),
            driver: format!("{} {}", self.info.driver, self.info.driver_info),
            name: self.info.name,
        }
    }
}

/// The machine's adapters: GPUs in the loader's order, then the first software adapter.
fn found(instance: &wgpu::Instance) -> Vec<Found> {
    let adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::VULKAN));
    let (mut gpus, mut software) = (Vec::new(), None);
    // Two drivers for one card (NVIDIA's and nouveau's, amdvlk and radv) give it twice; it has one PCI address.
    let mut seen = BTreeSet::new();
    for adapter in adapters {
        let info = adapter.get_info();
        if kind_of(&info) == DeviceKind::Cpu {
            software.get_or_insert(Found { spec: DeviceSpec::Cpu, adapter, info });
        } else if info.device_pci_bus_id.is_empty() || seen.insert(info.device_pci_bus_id.clone()) {
            gpus.push(Found { spec: DeviceSpec::Gpu(gpus.len()), adapter, info });
        }
    }
    gpus.extend(software);
    gpus
}

fn new_instance() -> wgpu::Instance {
    wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends: wgpu::Backends::VULKAN,
        // Validation layers are for wgpu's own developers; wgpu validates all calls itself.
        flags: wgpu::InstanceFlags::empty(),
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    })
}

fn kind_of(info: &wgpu::AdapterInfo) -> DeviceKind {
    match info.device_type {
        wgpu::DeviceType::Cpu => DeviceKind::Cpu,
        wgpu::DeviceType::Other
        | wgpu::DeviceType::IntegratedGpu
        | wgpu::DeviceType::DiscreteGpu
        | wgpu::DeviceType::VirtualGpu => DeviceKind::Gpu,
    }
}
