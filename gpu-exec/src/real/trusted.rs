//! The one place of unsafe code: compiling a module without runtime checks.
//!
//! It decides nothing: the operator's permission is [`crate::ExecutorConfig::unchecked`].

#![allow(unsafe_code, reason = "wgpu compiles without runtime checks by unsafe functions only; audited here")]

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
