//! A WGSL module: checked, compiled, and what its entry points take.
//!
//! Parameter `i` of a kernel is the storage buffer `@group(0) @binding(i)`; a named global is a `var<uniform>` of any
//! other group. Everything else (textures, immediates, storage elsewhere) is refused when an entry point uses it.

use std::{borrow::Cow, collections::BTreeMap};

use farm_core::device::DeviceKind;
use naga::{
    AddressSpace, StorageAccess, TypeInner, WithSpan,
    valid::{Capabilities, ModuleInfo, ValidationError, ValidationFlags, Validator},
};

use super::{adapter::Gpu, scope::Refusal, trusted};
use crate::text;

/// A compiled module.
#[derive(Debug)]
pub(crate) struct Module {
    pub(crate) shader: wgpu::ShaderModule,
    /// Every `@compute` function by name.
    pub(crate) entries: BTreeMap<String, EntryPoint>,
    /// Every `var<uniform>` by name, whether an entry point uses it or not.
    pub(crate) globals: BTreeMap<String, Global>,
    /// Every binding of group 0, used or not.
    pub(crate) parameters: Vec<u32>,
    /// Where the device reads named globals from.
    pub(crate) globals_in: GlobalsIn,
    /// `override` constants: name in the text, and the key that the compiler wants.
    overrides: BTreeMap<String, String>,
}

/// Where a device reads named globals from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum GlobalsIn {
    /// As the text says.
    Uniforms,
    /// From storage buffers that are only read: lavapipe compiles a kernel anew for each value of a uniform that decides
    /// where it goes, and keeps them all (2.7 MB for each job of a render).
    Storage,
}

/// What one entry point uses.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct EntryPoint {
    /// Storage buffers of group 0 by binding.
    pub(crate) parameters: BTreeMap<u32, Parameter>,
    /// Names of the uniforms it reads.
    pub(crate) globals: Vec<String>,
    /// It cannot run here, and why.
    pub(crate) unusable: Option<String>,
}

/// A storage buffer of an entry point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Parameter {
    /// `var<storage, read_write>`.
    pub(crate) writable: bool,
    /// Size of its type; of one element for an array without length.
    pub(crate) least_bytes: u64,
}

/// A `var<uniform>`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Global {
    pub(crate) group: u32,
    pub(crate) binding: u32,
    /// Size of its type.
    pub(crate) size_bytes: u64,
    /// Its type is `u32`: it can be a slicing global.
    pub(crate) is_u32: bool,
}

impl Module {
    /// Checks and compiles a module's bytes.
    pub(crate) fn compile(gpu: &Gpu, bytes: &[u8], unchecked: bool) -> Result<Self, Refusal> {
        let invalid = |text: String| Refusal::Invalid(text);
        let (source, parsed) = text::parse(bytes).map_err(|error| invalid(error.to_string()))?;
        let info = validated(&parsed).map_err(|error| invalid(text::cut(&error.emit_to_string(source))))?;
        let reflected = reflect(&parsed, &info);
        let on_storage = (gpu.kind == DeviceKind::Cpu)
            .then(|| globals_on_storage(parsed, gpu.limits.max_storage_buffers_per_shader_stage, &reflected))
            .flatten();
        let globals_in = if on_storage.is_some() { GlobalsIn::Storage } else { GlobalsIn::Uniforms };
        let shader = gpu.scoped(|| {
            let source = match on_storage {
                Some(module) => wgpu::ShaderSource::Naga(Cow::Owned(module)),
                None => wgpu::ShaderSource::Wgsl(source.into()),
            };
            let descriptor = wgpu::ShaderModuleDescriptor { label: None, source };
            if unchecked {
                trusted::create_shader_module_unchecked(&gpu.device, descriptor)
            } else {
                gpu.device.create_shader_module(descriptor)
            }
        })?;
        let Reflected { entries, globals, parameters, overrides } = reflected;
        Ok(Self { shader, entries, globals, parameters, globals_in, overrides })
    }

    /// The compiler's key of an `override` constant.
    pub(crate) fn override_key(&self, name: &str) -> Option<&str> {
        self.overrides.get(name).map(String::as_str)
    }
}

fn validated(module: &naga::Module) -> Result<ModuleInfo, Box<WithSpan<ValidationError>>> {
    Ok(Validator::new(ValidationFlags::all(), Capabilities::all()).validate(module)?)
}

/// The module with its named globals as read-only storage buffers; none where that is more than a device binds, or where
/// the text names pointers to uniforms.
fn globals_on_storage(
    mut module: naga::Module,
    max_storage_buffers: u32,
    reflected: &Reflected,
) -> Option<naga::Module> {
    let most = reflected.entries.values().map(|entry| entry.parameters.len() + entry.globals.len()).max()?;
    if most > usize::try_from(max_storage_buffers).unwrap_or(usize::MAX) {
        return None;
    }
    for (_, variable) in module.global_variables.iter_mut() {
        if variable.space == AddressSpace::Uniform {
            variable.space = AddressSpace::Storage { access: StorageAccess::LOAD };
        }
    }
    validated(&module).is_ok().then_some(module)
}

struct Reflected {
    entries: BTreeMap<String, EntryPoint>,
    globals: BTreeMap<String, Global>,
    parameters: Vec<u32>,
    overrides: BTreeMap<String, String>,
}

fn reflect(module: &naga::Module, info: &ModuleInfo) -> Reflected {
    let size_of = |ty: naga::Handle<naga::Type>| match module.types[ty].inner {
        TypeInner::Array { size: naga::ArraySize::Dynamic, stride, .. } => u64::from(stride),
        ref inner => u64::from(inner.size(module.to_ctx())),
    };
    let mut globals = BTreeMap::new();
    let mut parameters = Vec::new();
    for (_, variable) in module.global_variables.iter() {
        let Some(binding) = variable.binding else { continue };
        match variable.space {
            AddressSpace::Uniform if binding.group != 0 => {
                let is_u32 = matches!(module.types[variable.ty].inner, TypeInner::Scalar(naga::Scalar::U32));
                let size_bytes = size_of(variable.ty);
                let global = Global { group: binding.group, binding: binding.binding, size_bytes, is_u32 };
                globals.insert(variable.name.clone().unwrap_or_default(), global);
            }
            AddressSpace::Storage { .. } if binding.group == 0 => parameters.push(binding.binding),
            _ => {}
        }
    }
    let compute =
        module.entry_points.iter().enumerate().filter(|(_, entry)| entry.stage == naga::ShaderStage::Compute);
    let entries = compute
        .map(|(index, entry)| {
            let uses = info.get_entry_point(index);
            let mut point = EntryPoint::default();
            for (handle, variable) in module.global_variables.iter() {
                if !uses[handle].is_empty() {
                    point.add(variable, size_of(variable.ty));
                }
            }
            (entry.name.clone(), point)
        })
        .collect();
    let overrides = module
        .overrides
        .iter()
        .filter_map(|(_, constant)| {
            let name = constant.name.clone()?;
            let key = constant.id.map_or_else(|| name.clone(), |id| id.to_string());
            Some((name, key))
        })
        .collect();
    Reflected { entries, globals, parameters, overrides }
}

impl EntryPoint {
    fn add(&mut self, variable: &naga::GlobalVariable, size_bytes: u64) {
        let name = variable.name.as_deref().unwrap_or("(unnamed)");
        let group = variable.binding.map(|binding| binding.group);
        match (variable.space, variable.binding) {
            (AddressSpace::Storage { access }, Some(binding)) if binding.group == 0 => {
                let writable = access.contains(StorageAccess::STORE);
                self.parameters.insert(binding.binding, Parameter { writable, least_bytes: size_bytes });
            }
            (AddressSpace::Uniform, Some(binding)) if binding.group != 0 => {
                self.globals.push(name.to_owned());
            }
            (AddressSpace::Private | AddressSpace::WorkGroup | AddressSpace::Function, _) => {}
            (AddressSpace::Storage { .. }, _) => self.refuse(format!(
                "storage buffer `{name}` is in group {}; parameters are in group 0",
                group.unwrap_or_default()
            )),
            (AddressSpace::Uniform, _) => {
                self.refuse(format!("uniform `{name}` is in group 0; named globals are in any other group"))
            }
            (
                AddressSpace::Handle
                | AddressSpace::Immediate
                | AddressSpace::TaskPayload
                | AddressSpace::RayPayload
                | AddressSpace::IncomingRayPayload,
                _,
            ) => self.refuse(format!("`{name}` is neither a storage buffer nor a uniform")),
        }
    }

    fn refuse(&mut self, reason: String) {
        self.unusable.get_or_insert(reason);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reflected(source: &str) -> Reflected {
        let module = naga::front::wgsl::parse_str(source).unwrap();
        let info = validated(&module).unwrap();
        reflect(&module, &info)
    }

    #[test]
    fn an_entry_point_lists_what_it_uses_and_nothing_else() {
        let Reflected { entries, globals, parameters, overrides } = reflected(
            "struct Camera { eye: vec3f, scale: f32, size: vec2u }
             @group(0) @binding(0) var<storage, read> a: array<vec2f>;
             @group(0) @binding(2) var<storage, read_write> b: array<u32, 5>;
             @group(0) @binding(3) var<storage, read> unused: array<u32>;
             @group(1) @binding(0) var<uniform> camera: Camera;
             @group(1) @binding(1) var<uniform> first_z: u32;
             override width = 4u;
             @id(7) override depth = 4u;
             fn far() -> u32 { return first_z; }
             @compute @workgroup_size(1) fn one() { b[0] = u32(a[0].x) + far() + width + depth; }
             @compute @workgroup_size(1) fn two() { b[1] = u32(camera.scale); }",
        );
        let one = &entries["one"];
        assert_eq!(one.parameters[&0], Parameter { writable: false, least_bytes: 8 });
        assert_eq!(one.parameters[&2], Parameter { writable: true, least_bytes: 20 });
        assert_eq!(one.parameters.len(), 2);
        assert_eq!(one.globals, ["first_z"]);
        assert_eq!(entries["two"].globals, ["camera"]);
        assert_eq!(entries["two"].unusable, None);
        assert_eq!(globals["camera"], Global { group: 1, binding: 0, size_bytes: 32, is_u32: false });
        assert!(globals["first_z"].is_u32);
        assert_eq!(parameters, [0, 2, 3]);
        assert_eq!(overrides["width"], "width");
        assert_eq!(overrides["depth"], "7");
    }

    #[test]
    fn what_no_program_can_bind_makes_its_user_unusable() {
        let Reflected { entries, .. } = reflected(
            "@group(1) @binding(0) var<storage, read_write> elsewhere: array<u32>;
             @group(0) @binding(0) var<uniform> zero: u32;
             @compute @workgroup_size(1) fn one() { elsewhere[0] = 1u; }
             @compute @workgroup_size(1) fn two() { _ = zero; }
             @compute @workgroup_size(1) fn three() { }",
        );
        assert!(entries["one"].unusable.as_ref().unwrap().contains("`elsewhere` is in group 1"));
        assert!(entries["two"].unusable.as_ref().unwrap().contains("uniform `zero` is in group 0"));
        assert_eq!(entries["three"].unusable, None);
    }
}
