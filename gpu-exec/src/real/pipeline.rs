//! The device's modules and pipelines, least recently used first out.

use std::{
    collections::{BTreeMap, HashMap},
    sync::Arc,
};

use bytes::Bytes;
use farm_core::{id::ContentHash, message::JobFailure};

use super::{
    adapter::Gpu,
    compiled::Compiled,
    module::{EntryPoint, Global, GlobalsIn, Module},
    pace::Pace,
};
use crate::executor::ExecutorConfig;

/// A compiled entry point with its constants.
#[derive(Debug)]
pub(crate) struct Pipeline {
    pub(crate) raw: wgpu::ComputePipeline,
    pub(crate) module: Arc<Module>,
    pub(crate) entry: EntryPoint,
    /// Layouts by group; group 0 holds the parameters, the others named globals.
    pub(crate) layouts: Vec<Option<wgpu::BindGroupLayout>>,
    pub(crate) pace: Pace,
}

impl Pipeline {
    /// A uniform that the entry point reads.
    pub(crate) fn used_global(&self, name: &str) -> Option<Global> {
        let used = self.entry.globals.iter().any(|used| used == name);
        self.module.globals.get(name).copied().filter(|_| used)
    }
}

/// What tells pipelines apart on one device. Constants by the bits of their values.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Key {
    module: ContentHash,
    entry: String,
    constants: Vec<(String, u64)>,
}

/// Modules and pipelines of one device.
#[derive(Debug)]
pub(crate) struct PipelineCache {
    modules: HashMap<ContentHash, Used<Module>>,
    pipelines: HashMap<Key, Used<Pipeline>>,
    max_modules: usize,
    max_pipelines: usize,
    unchecked: bool,
    /// What the driver compiled, in this process and in earlier ones.
    compiled: Option<Compiled>,
    clock: u64,
}

#[derive(Debug)]
struct Used<T> {
    value: Arc<T>,
    at: u64,
}

impl PipelineCache {
    pub(crate) fn new(gpu: &Gpu, config: &ExecutorConfig) -> Self {
        Self {
            modules: HashMap::new(),
            pipelines: HashMap::new(),
            max_modules: config.max_modules.max(1),
            max_pipelines: config.max_pipelines.max(1),
            unchecked: config.unchecked,
            compiled: config.compiled.as_deref().and_then(|folder| Compiled::open(gpu, folder)),
            clock: 0,
        }
    }

    /// The pipeline of an entry point; compiled if it is not here. `source` gives the module's bytes.
    pub(crate) fn get(
        &mut self,
        gpu: &Gpu,
        module: ContentHash,
        entry: &str,
        constants: &[(String, f64)],
        source: impl FnOnce() -> Option<Bytes>,
    ) -> Result<Arc<Pipeline>, JobFailure> {
        self.clock += 1;
        let at = self.clock;
        let constants_bits = constants.iter().map(|(name, value)| (name.clone(), value.to_bits())).collect();
        let key = Key { module, entry: entry.to_owned(), constants: constants_bits };
        if let Some(used) = self.pipelines.get_mut(&key) {
            used.at = at;
            return Ok(Arc::clone(&used.value));
        }
        let compiled = self.module(gpu, module, source)?;
        let cache = self.compiled.as_ref().map(Compiled::cache);
        let pipeline = Arc::new(compile(gpu, module, compiled, entry, constants, cache)?);
        if let Some(compiled) = &self.compiled {
            compiled.save();
        }
        make_room(&mut self.pipelines, self.max_pipelines);
        self.pipelines.insert(key, Used { value: Arc::clone(&pipeline), at });
        Ok(pipeline)
    }

    fn module(
        &mut self,
        gpu: &Gpu,
        hash: ContentHash,
        source: impl FnOnce() -> Option<Bytes>,
    ) -> Result<Arc<Module>, JobFailure> {
        let at = self.clock;
        if let Some(used) = self.modules.get_mut(&hash) {
            used.at = at;
            return Ok(Arc::clone(&used.value));
        }
        let bytes = source().ok_or(JobFailure::ContentUnavailable(hash))?;
        let module = Module::compile(gpu, &bytes, self.unchecked)
            .map_err(|refusal| refusal.into_failure(&format!("module {hash:?}")))?;
        let module = Arc::new(module);
        make_room(&mut self.modules, self.max_modules);
        self.modules.insert(hash, Used { value: Arc::clone(&module), at });
        Ok(module)
    }
}

/// Evicts the least recently used until one more fits. What jobs still hold lives on until they end.
fn make_room<K: Clone + Eq + std::hash::Hash, T>(map: &mut HashMap<K, Used<T>>, most: usize) {
    while map.len() >= most {
        let Some(oldest) = map.iter().min_by_key(|(_, used)| used.at).map(|(key, _)| key.clone()) else {
            return;
        };
        map.remove(&oldest);
    }
}

fn compile(
    gpu: &Gpu,
    hash: ContentHash,
    module: Arc<Module>,
    name: &str,
    constants: &[(String, f64)],
    cache: Option<&wgpu::PipelineCache>,
) -> Result<Pipeline, JobFailure> {
    let invalid = |text: String| JobFailure::InvalidProgram(format!("module {hash:?}: {text}"));
    let Some(entry) = module.entries.get(name).cloned() else {
        let known = module.entries.keys().map(String::as_str).collect::<Vec<_>>().join(", ");
        return Err(invalid(format!("no @compute entry point `{name}`; it has: {known}")));
    };
    if let Some(reason) = &entry.unusable {
        return Err(invalid(format!("entry point `{name}`: {reason}")));
    }
    let mut values = Vec::with_capacity(constants.len());
    for (constant, value) in constants {
        let Some(key) = module.override_key(constant) else {
            return Err(invalid(format!("no `override` constant `{constant}`")));
        };
        values.push((key, *value));
    }
    let (layouts, raw) = gpu
        .scoped(|| {
            let layouts = group_layouts(gpu, &module, &entry);
            let by_group: Vec<_> = layouts.iter().map(Option::as_ref).collect();
            let layout = gpu.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: None,
                bind_group_layouts: &by_group,
                immediate_size: 0,
            });
            let raw = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(name),
                layout: Some(&layout),
                module: &module.shader,
                entry_point: Some(name),
                compilation_options: wgpu::PipelineCompilationOptions {
                    constants: &values,
                    ..Default::default()
                },
                cache,
            });
            (layouts, raw)
        })
        .map_err(|refusal| refusal.into_failure(&format!("module {hash:?}, entry point `{name}`")))?;
    Ok(Pipeline { raw, module, entry, layouts, pace: Pace::default() })
}

/// Explicit layouts of what the entry point uses: a derived layout would differ from one entry point to the next in
/// ways that a program's author cannot see.
fn group_layouts(gpu: &Gpu, module: &Module, entry: &EntryPoint) -> Vec<Option<wgpu::BindGroupLayout>> {
    let mut groups: BTreeMap<u32, Vec<wgpu::BindGroupLayoutEntry>> = BTreeMap::new();
    let buffer = |binding, ty, least_bytes| wgpu::BindGroupLayoutEntry {
        binding,
        visibility: wgpu::ShaderStages::COMPUTE,
        ty: wgpu::BindingType::Buffer {
            ty,
            has_dynamic_offset: false,
            min_binding_size: wgpu::BufferSize::new(least_bytes),
        },
        count: None,
    };
    for (&binding, parameter) in &entry.parameters {
        let ty = wgpu::BufferBindingType::Storage { read_only: !parameter.writable };
        groups.entry(0).or_default().push(buffer(binding, ty, parameter.least_bytes));
    }
    let globals_type = match module.globals_in {
        GlobalsIn::Uniforms => wgpu::BufferBindingType::Uniform,
        GlobalsIn::Storage => wgpu::BufferBindingType::Storage { read_only: true },
    };
    for global in entry.globals.iter().filter_map(|name| module.globals.get(name)) {
        let layout = buffer(global.binding, globals_type, global.size_bytes);
        groups.entry(global.group).or_default().push(layout);
    }
    let count = groups.keys().next_back().map_or(0, |last| last + 1);
    (0..count)
        .map(|group| {
            let entries = groups.get(&group)?;
            let descriptor = wgpu::BindGroupLayoutDescriptor { label: None, entries };
            Some(gpu.device.create_bind_group_layout(&descriptor))
        })
        .collect()
}
