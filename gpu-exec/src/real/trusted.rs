//! The one place of unsafe code of this crate: compiling a module without runtime checks, and giving a driver back what it compiled.
//!
//! It decides nothing: the operator's permission is [`crate::ExecutorConfig::unchecked`], the operator's folder is
//! [`crate::ExecutorConfig::compiled`].

#![allow(unsafe_code, reason = "wgpu does both by unsafe functions only; audited here")]

/// Compiles a module without bounds checks, loop counters and division checks.
pub(crate) fn create_shader_module_unchecked(
    device: &wgpu::Device,
    descriptor: wgpu::ShaderModuleDescriptor<'_>,
) -> wgpu::ShaderModule {
    // SAFETY: none of wgpu's own memory is at stake: the checks left out guard what the *kernel* does on the device
    // (indexing out of bounds, endless loops, division by zero). Only the operator can ask for this, and with it takes
    // the word of the module's author that the kernel does none of these, for this node's devices.
    unsafe { device.create_shader_module_trusted(descriptor, wgpu::ShaderRuntimeChecks::unchecked()) }
}

/// A driver's cache of compiled pipelines, empty or with what an earlier one held.
pub(crate) fn create_pipeline_cache(device: &wgpu::Device, data: Option<&[u8]>) -> wgpu::PipelineCache {
    let descriptor = wgpu::PipelineCacheDescriptor { label: None, data, fallback: true };
    // SAFETY: `data` is what `PipelineCache::get_data` gave: its digest was checked, and its file is in a folder that the
    // operator gave to this node alone. wgpu checks adapter, driver and version, and begins an empty one otherwise.
    unsafe { device.create_pipeline_cache(&descriptor) }
}
