//! The one check of a whole program, also of one that came over a wire from a stranger.

use std::collections::{BTreeMap, BTreeSet};

use thiserror::Error;

use super::{Access, Buffer, Command, Content, JobProgram, Kernel, Slicing};
use crate::{id::ContentHash, message::CostNs};

/// Most bytes of one named global: what WebGPU guarantees for a uniform binding.
pub(super) const MAX_GLOBAL_BYTES: u64 = 64 << 10;

/// Bindings start at multiples of this (WebGPU's `minStorageBufferOffsetAlignment`), in bytes.
pub(super) const PARAM_ALIGNMENT_BYTES: u64 = 256;

/// Parameters of one kernel are numbered below this.
const MAX_PARAMS: u32 = 64;

/// Most `override` constants of one kernel.
const MAX_CONSTANTS: usize = 256;

/// Longest name of an entry point, global or constant, in bytes.
const MAX_NAME_BYTES: usize = 128;

/// Longest text of a module, in bytes.
const MAX_MODULE_BYTES: u64 = 16 << 20;

/// Upper bounds for one program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ProgramQuota {
    /// Most commands.
    pub commands: usize,
    /// Most memory of job and task allocations together.
    pub memory_bytes: u64,
    /// Most bytes of results.
    pub result_bytes: u64,
    /// Most workgroups in one dimension of a launch (65,535 is what WebGPU guarantees).
    pub groups_per_dimension: u32,
}

impl Default for ProgramQuota {
    fn default() -> Self {
        Self { commands: 4_096, memory_bytes: 64 << 30, result_bytes: 1 << 30, groups_per_dimension: 65_535 }
    }
}

/// What a valid program needs and yields.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ProgramSummary {
    /// Task allocations, each once.
    pub allocations: Vec<Content>,
    /// Modules, each once.
    pub modules: Vec<Content>,
    /// Job and task allocations together.
    pub memory_bytes: u64,
    /// The largest buffer.
    pub largest_buffer_bytes: u64,
    /// The largest parameter binding.
    pub largest_binding_bytes: u64,
    /// Most parameters of one kernel.
    pub storage_buffers: u32,
    /// Lengths of the result's sections in bytes.
    pub sections: Vec<u64>,
    /// Work of all the launches.
    pub cost: CostNs,
}

/// Why a program is refused; `command` is the index of the command at fault.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("command {command}: {fault}")]
pub struct ProgramError {
    /// Index in [`JobProgram::commands`].
    pub command: usize,
    /// What is wrong with it.
    pub fault: String,
}

/// Checks every handle, size, alignment and bound of a program, in one pass.
///
/// Handles are numbered in the order of their definitions, each kind from 0: the verbs do so, and it makes every
/// look-up a step. In one launch a buffer is either only read (any overlap) or only written through disjoint
/// ranges: WebGPU refuses a buffer that is both.
///
/// # Errors
/// The first command at fault, and why.
pub fn validate(program: &JobProgram, quota: &ProgramQuota) -> Result<ProgramSummary, ProgramError> {
    let commands = program.commands();
    if commands.len() > quota.commands {
        let fault = format!("the program has {} commands, {} are allowed", commands.len(), quota.commands);
        return Err(ProgramError { command: quota.commands, fault });
    }
    let mut checker = Checker::new(quota);
    for (index, command) in commands.iter().enumerate() {
        checker.command(command).map_err(|fault| ProgramError { command: index, fault })?;
    }
    Ok(checker.finish())
}

/// A buffer defined so far.
struct DefinedBuffer {
    size_bytes: u64,
    access: Access,
}

/// A kernel defined so far, with what is bound to it now.
#[derive(Default)]
struct DefinedKernel {
    params: BTreeMap<u32, Binding>,
    /// Whether `params` changed since they were last found consistent.
    unchecked: bool,
}

#[derive(Clone, Copy)]
struct Binding {
    buffer: Buffer,
    offset_bytes: u64,
    end_bytes: u64,
    access: Access,
}

/// The state of one pass.
struct Checker<'quota> {
    quota: &'quota ProgramQuota,
    buffers: Vec<DefinedBuffer>,
    kernels: Vec<DefinedKernel>,
    /// Size of every content named: one hash has one.
    content_bytes: BTreeMap<ContentHash, u64>,
    allocations: BTreeSet<Content>,
    modules: BTreeSet<Content>,
    result_bytes: u64,
    summary: ProgramSummary,
}

impl<'quota> Checker<'quota> {
    fn new(quota: &'quota ProgramQuota) -> Self {
        Self {
            quota,
            buffers: Vec::new(),
            kernels: Vec::new(),
            content_bytes: BTreeMap::new(),
            allocations: BTreeSet::new(),
            modules: BTreeSet::new(),
            result_bytes: 0,
            summary: ProgramSummary::default(),
        }
    }

    fn finish(mut self) -> ProgramSummary {
        self.summary.allocations = self.allocations.into_iter().collect();
        self.summary.modules = self.modules.into_iter().collect();
        self.summary
    }

    fn command(&mut self, command: &Command) -> Result<(), String> {
        match command {
            Command::Malloc { buffer, size_bytes } => self.define_buffer(*buffer, *size_bytes, Access::InOut),
            Command::TaskAllocation { buffer, content } => {
                self.define_buffer(*buffer, content.size_bytes, Access::In)?;
                self.name_content(*content)?;
                self.allocations.insert(*content);
                Ok(())
            }
            Command::Function { kernel, module, entry, constants } => {
                self.define_kernel(*kernel, *module, entry, constants)
            }
            Command::MemcpyHtoD { buffer, offset_bytes, bytes } => {
                self.job_range(*buffer, *offset_bytes, bytes.len() as u64)
            }
            Command::GlobalHtoD { kernel, name, bytes } => self.set_global(*kernel, name, bytes.len() as u64),
            Command::Param { kernel, index, buffer, offset_bytes, size_bytes, access } => {
                self.bind(*kernel, *index, *buffer, *offset_bytes, *size_bytes, *access)
            }
            Command::Launch { kernel, groups, slicing, cost } => {
                self.launch(*kernel, groups, slicing.as_ref(), *cost)
            }
            Command::MemcpyDtoH { buffer, offset_bytes, size_bytes } => {
                self.job_range(*buffer, *offset_bytes, *size_bytes)?;
                self.add_section(*size_bytes)
            }
        }
    }

    fn define_buffer(&mut self, buffer: Buffer, size_bytes: u64, access: Access) -> Result<(), String> {
        check_next_handle("buffer", buffer.0, self.buffers.len())?;
        check_size(size_bytes)?;
        let quota = self.quota.memory_bytes;
        let total = self.summary.memory_bytes.checked_add(size_bytes).filter(|total| *total <= quota);
        let Some(total) = total else {
            return Err(format!("with {size_bytes} B more the buffers exceed the {quota} B allowed"));
        };
        self.summary.memory_bytes = total;
        self.summary.largest_buffer_bytes = self.summary.largest_buffer_bytes.max(size_bytes);
        self.buffers.push(DefinedBuffer { size_bytes, access });
        Ok(())
    }

    fn define_kernel(
        &mut self,
        kernel: Kernel,
        module: Content,
        entry: &str,
        constants: &[(String, f64)],
    ) -> Result<(), String> {
        check_next_handle("kernel", kernel.0, self.kernels.len())?;
        check_name("entry point", entry)?;
        if module.size_bytes == 0 || module.size_bytes > MAX_MODULE_BYTES {
            return Err(format!("a module of {} B: 1..={MAX_MODULE_BYTES} B are allowed", module.size_bytes));
        }
        if constants.len() > MAX_CONSTANTS {
            return Err(format!("{} constants, {MAX_CONSTANTS} are allowed", constants.len()));
        }
        let mut names = BTreeSet::new();
        for (name, value) in constants {
            check_name("constant", name)?;
            if !value.is_finite() {
                return Err(format!("constant `{name}` is {value}, which no WGSL constant can be"));
            }
            if !names.insert(name) {
                return Err(format!("constant `{name}` is given twice"));
            }
        }
        self.name_content(module)?;
        self.modules.insert(module);
        self.kernels.push(DefinedKernel::default());
        Ok(())
    }

    fn set_global(&self, kernel: Kernel, name: &str, size_bytes: u64) -> Result<(), String> {
        if position(kernel.0).is_none_or(|at| at >= self.kernels.len()) {
            return Err(undefined("kernel", kernel.0));
        }
        check_name("global", name)?;
        check_size(size_bytes)?;
        if size_bytes > MAX_GLOBAL_BYTES {
            return Err(format!(
                "global `{name}` of {size_bytes} B: a uniform holds at most {MAX_GLOBAL_BYTES} B"
            ));
        }
        Ok(())
    }

    fn bind(
        &mut self,
        kernel: Kernel,
        index: u32,
        buffer: Buffer,
        offset_bytes: u64,
        size_bytes: u64,
        access: Access,
    ) -> Result<(), String> {
        let defined = self.buffer(buffer)?;
        check_size(size_bytes)?;
        let end_bytes = check_range(buffer, defined, offset_bytes, size_bytes)?;
        if !offset_bytes.is_multiple_of(PARAM_ALIGNMENT_BYTES) {
            return Err(format!("offset {offset_bytes} B is not a multiple of {PARAM_ALIGNMENT_BYTES}"));
        }
        if index >= MAX_PARAMS {
            return Err(format!("parameter {index}: numbers go up to {}", MAX_PARAMS - 1));
        }
        if (defined.access, access) == (Access::In, Access::InOut) {
            return Err(format!("buffer {} is a task allocation and read-only", buffer.0));
        }
        let bound_to = position(kernel.0).and_then(|at| self.kernels.get_mut(at));
        let Some(bound_to) = bound_to else { return Err(undefined("kernel", kernel.0)) };
        bound_to.params.insert(index, Binding { buffer, offset_bytes, end_bytes, access });
        bound_to.unchecked = true;
        let count = u32::try_from(bound_to.params.len()).unwrap_or(MAX_PARAMS);
        self.summary.storage_buffers = self.summary.storage_buffers.max(count);
        self.summary.largest_binding_bytes = self.summary.largest_binding_bytes.max(size_bytes);
        Ok(())
    }

    fn launch(
        &mut self,
        kernel: Kernel,
        groups: &[u32; 3],
        slicing: Option<&Slicing>,
        cost: CostNs,
    ) -> Result<(), String> {
        let launched = position(kernel.0).and_then(|at| self.kernels.get_mut(at));
        let Some(launched) = launched else { return Err(undefined("kernel", kernel.0)) };
        if std::mem::take(&mut launched.unchecked) {
            check_aliasing(&launched.params)?;
        }
        let most = self.quota.groups_per_dimension;
        if groups.iter().any(|extent| !(1..=most).contains(extent)) {
            return Err(format!("workgroups {groups:?}: each extent must be 1..={most}"));
        }
        if let Some(slicing) = slicing {
            check_name("slicing global", &slicing.global)?;
            if slicing.max_groups_z == 0 {
                return Err("a slice must hold at least one z group".to_owned());
            }
        }
        let total = self.summary.cost.0.checked_add(cost.0);
        self.summary.cost = CostNs(total.ok_or_else(|| "the launches' costs together overflow".to_owned())?);
        Ok(())
    }

    fn add_section(&mut self, size_bytes: u64) -> Result<(), String> {
        let quota = self.quota.result_bytes;
        let total = self.result_bytes.checked_add(size_bytes).filter(|total| *total <= quota);
        let Some(total) = total else {
            return Err(format!("with {size_bytes} B more the result exceeds the {quota} B allowed"));
        };
        self.result_bytes = total;
        self.summary.sections.push(size_bytes);
        Ok(())
    }

    /// A range of a job allocation that is copied from or to the host.
    fn job_range(&self, buffer: Buffer, offset_bytes: u64, size_bytes: u64) -> Result<(), String> {
        let defined = self.buffer(buffer)?;
        if defined.access == Access::In {
            return Err(format!(
                "buffer {} is a task allocation: it is neither written nor read back",
                buffer.0
            ));
        }
        check_size(size_bytes)?;
        if !offset_bytes.is_multiple_of(4) {
            return Err(format!("offset {offset_bytes} B is not a multiple of 4"));
        }
        check_range(buffer, defined, offset_bytes, size_bytes).map(|_| ())
    }

    fn buffer(&self, buffer: Buffer) -> Result<&DefinedBuffer, String> {
        position(buffer.0).and_then(|at| self.buffers.get(at)).ok_or_else(|| undefined("buffer", buffer.0))
    }

    fn name_content(&mut self, content: Content) -> Result<(), String> {
        let known = *self.content_bytes.entry(content.hash).or_insert(content.size_bytes);
        if known == content.size_bytes {
            return Ok(());
        }
        Err(format!("content {} is named with {known} B and with {} B", content.hash, content.size_bytes))
    }
}

/// In one launch a buffer is read, or written through disjoint ranges.
fn check_aliasing(params: &BTreeMap<u32, Binding>) -> Result<(), String> {
    let mut bindings: Vec<(u32, Binding)> =
        params.iter().map(|(&index, &binding)| (index, binding)).collect();
    bindings.sort_unstable_by_key(|(_, binding)| (binding.buffer, binding.offset_bytes));
    for pair in bindings.windows(2) {
        let [(first, one), (second, other)] = pair else { continue };
        if one.buffer != other.buffer {
            continue;
        }
        let both =
            |what: &str| Err(format!("parameters {first} and {second}: buffer {} {what}", one.buffer.0));
        match (one.access, other.access) {
            (Access::In, Access::In) => {}
            (Access::InOut, Access::InOut) if one.end_bytes <= other.offset_bytes => {}
            (Access::InOut, Access::InOut) => return both("is written through overlapping ranges"),
            (Access::In, Access::InOut) | (Access::InOut, Access::In) => return both("is read and written"),
        }
    }
    Ok(())
}

fn check_next_handle(what: &str, handle: u32, defined: usize) -> Result<(), String> {
    match position(handle) {
        Some(at) if at == defined => Ok(()),
        Some(at) if at < defined => Err(format!("{what} {handle} is defined twice")),
        Some(_) | None => Err(format!("{what} {handle} is defined out of order, {defined} comes next")),
    }
}

fn check_name(what: &str, name: &str) -> Result<(), String> {
    if (1..=MAX_NAME_BYTES).contains(&name.len()) {
        return Ok(());
    }
    Err(format!("{what}: a name of {} B, 1..={MAX_NAME_BYTES} B are allowed", name.len()))
}

fn check_size(size_bytes: u64) -> Result<(), String> {
    if size_bytes > 0 && size_bytes.is_multiple_of(4) {
        return Ok(());
    }
    Err(format!("size {size_bytes} B must be a positive multiple of 4"))
}

/// The end of the range, if it lies in the buffer.
fn check_range(
    buffer: Buffer,
    defined: &DefinedBuffer,
    offset_bytes: u64,
    size_bytes: u64,
) -> Result<u64, String> {
    let end_bytes = offset_bytes.checked_add(size_bytes).filter(|end| *end <= defined.size_bytes);
    end_bytes.ok_or_else(|| {
        format!("bytes {offset_bytes}..+{size_bytes} leave buffer {} of {} B", buffer.0, defined.size_bytes)
    })
}

fn undefined(what: &str, handle: u32) -> String {
    format!("{what} {handle} is used before its definition")
}

fn position(handle: u32) -> Option<usize> {
    usize::try_from(handle).ok()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SMALL: ProgramQuota =
        ProgramQuota { commands: 64, memory_bytes: 1 << 20, result_bytes: 4_096, groups_per_dimension: 100 };

    fn content(tag: u8, size_bytes: u64) -> Content {
        Content { hash: ContentHash([tag; 32]), size_bytes }
    }

    fn program(commands: Vec<Command>) -> JobProgram {
        JobProgram { commands, ..JobProgram::default() }
    }

    fn malloc(handle: u32, size_bytes: u64) -> Command {
        Command::Malloc { buffer: Buffer(handle), size_bytes }
    }

    fn task(handle: u32, size_bytes: u64) -> Command {
        Command::TaskAllocation { buffer: Buffer(handle), content: content(1, size_bytes) }
    }

    fn function(handle: u32) -> Command {
        Command::Function {
            kernel: Kernel(handle),
            module: content(9, 100),
            entry: "main".into(),
            constants: vec![],
        }
    }

    fn param(index: u32, buffer: u32, offset_bytes: u64, size_bytes: u64, access: Access) -> Command {
        Command::Param { kernel: Kernel(0), index, buffer: Buffer(buffer), offset_bytes, size_bytes, access }
    }

    fn launch(groups: [u32; 3]) -> Command {
        Command::Launch { kernel: Kernel(0), groups, slicing: None, cost: CostNs(7) }
    }

    fn read(buffer: u32, offset_bytes: u64, size_bytes: u64) -> Command {
        Command::MemcpyDtoH { buffer: Buffer(buffer), offset_bytes, size_bytes }
    }

    /// The fault of the last command of a program whose other commands are in order.
    fn last_fault(commands: Vec<Command>) -> String {
        let last = commands.len() - 1;
        validate(&program(commands[..last].to_vec()), &SMALL).expect("only the last command is wrong");
        let error = validate(&program(commands), &SMALL).expect_err("the last command is wrong");
        assert_eq!(error.command, last, "{error}");
        error.fault
    }

    #[test]
    fn a_program_of_every_verb_is_summed_up() {
        let mut built = JobProgram::default();
        let triangles = built.task_allocation(content(1, 1_024));
        let image = built.malloc(512).unwrap();
        let kernel = built.function_with_constants(content(9, 100), "render", &[("TILE", 8.0)]);
        built.memcpy_htod(kernel, "camera", &[0; 64]).unwrap();
        built.memcpy_htod_buffer(image, 4, &[1; 8]).unwrap();
        built.param(kernel, 0, triangles, 256, 768, Access::In).unwrap();
        built.param_in_out(kernel, 1, image).unwrap();
        built.launch_with_cost(kernel, [3, 2, 1], CostNs(5)).unwrap();
        let slicing = Slicing { global: "first_z".into(), max_groups_z: 4 };
        built.launch_sliced(kernel, [1, 1, 9], slicing, CostNs(6)).unwrap();
        built.memcpy_dtoh(image, 0, 16).unwrap();
        built.memcpy_dtoh(image, 16, 32).unwrap();
        assert_eq!(built.task_allocation(content(1, 1_024)), triangles, "one handle per content");
        let summary = validate(&built, &SMALL).unwrap();
        assert_eq!(
            summary,
            ProgramSummary {
                allocations: vec![content(1, 1_024)],
                modules: vec![content(9, 100)],
                memory_bytes: 1_536,
                largest_buffer_bytes: 1_024,
                largest_binding_bytes: 768,
                storage_buffers: 2,
                sections: vec![16, 32],
                cost: CostNs(11),
            }
        );
    }

    #[test]
    fn the_empty_program_is_valid() {
        assert_eq!(
            validate(&JobProgram::default(), &SMALL),
            Ok(ProgramSummary::default()),
            "nothing to object to"
        );
    }

    #[test]
    fn handles_are_defined_once_in_order_before_use() {
        assert!(last_fault(vec![malloc(0, 4), malloc(0, 4)]).contains("buffer 0 is defined twice"), "twice");
        assert!(last_fault(vec![malloc(1, 4)]).contains("out of order"), "gap");
        assert!(last_fault(vec![malloc(u32::MAX, 4)]).contains("out of order"), "far away");
        assert!(
            last_fault(vec![function(0), function(0)]).contains("kernel 0 is defined twice"),
            "kernel twice"
        );
        assert!(last_fault(vec![read(0, 0, 4)]).contains("used before its definition"), "copy");
        assert!(last_fault(vec![launch([1; 3])]).contains("kernel 0 is used before"), "launch");
        assert!(
            last_fault(vec![malloc(0, 4), param(0, 0, 0, 4, Access::In)]).contains("kernel 0 is used"),
            "param"
        );
        assert!(
            last_fault(vec![function(0), param(0, 0, 0, 4, Access::In)]).contains("buffer 0 is used"),
            "buffer"
        );
        let global = Command::GlobalHtoD { kernel: Kernel(3), name: "x".into(), bytes: vec![0; 4] };
        assert!(last_fault(vec![global]).contains("kernel 3 is used before"), "global");
    }

    #[test]
    fn sizes_and_alignment_are_checked() {
        for size_bytes in [0, 3, 1_026] {
            assert!(last_fault(vec![malloc(0, size_bytes)]).contains("positive multiple of 4"), "malloc");
            assert!(
                last_fault(vec![task(0, size_bytes)]).contains("positive multiple of 4"),
                "task allocation"
            );
            assert!(
                last_fault(vec![malloc(0, 4_096), read(0, 0, size_bytes)]).contains("multiple of 4"),
                "copy"
            );
        }
        assert!(last_fault(vec![malloc(0, 64), read(0, 2, 4)]).contains("offset 2 B"), "copy offset");
        let binding =
            |offset, size| vec![function(0), malloc(0, 1_024), param(0, 0, offset, size, Access::In)];
        assert!(last_fault(binding(128, 4)).contains("multiple of 256"), "binding offset");
        assert!(last_fault(binding(0, 6)).contains("multiple of 4"), "binding size");
        for size in [0, 5, (64 << 10) + 4] {
            let global =
                Command::GlobalHtoD { kernel: Kernel(0), name: "camera".into(), bytes: vec![0; size] };
            let fault = last_fault(vec![function(0), global]);
            assert!(fault.contains("multiple of 4") || fault.contains("uniform holds at most"), "{fault}");
        }
    }

    #[test]
    fn ranges_stay_in_their_buffers() {
        assert!(last_fault(vec![malloc(0, 64), read(0, 32, 36)]).contains("leave buffer 0"), "past the end");
        assert!(
            last_fault(vec![malloc(0, 64), read(0, u64::MAX - 3, 4)]).contains("leave buffer 0"),
            "overflow"
        );
        let write = Command::MemcpyHtoD { buffer: Buffer(0), offset_bytes: 60, bytes: vec![0; 8] };
        assert!(last_fault(vec![malloc(0, 64), write]).contains("leave buffer 0"), "write");
        let binding = param(0, 0, 256, 1_024, Access::In);
        assert!(
            last_fault(vec![function(0), malloc(0, 1_024), binding]).contains("leave buffer 0"),
            "binding"
        );
    }

    #[test]
    fn task_allocations_are_read_only() {
        let write = Command::MemcpyHtoD { buffer: Buffer(0), offset_bytes: 0, bytes: vec![0; 4] };
        assert!(last_fault(vec![task(0, 64), write]).contains("task allocation"), "write");
        assert!(last_fault(vec![task(0, 64), read(0, 0, 4)]).contains("task allocation"), "read back");
        let binding = param(0, 0, 0, 64, Access::InOut);
        assert!(last_fault(vec![function(0), task(0, 64), binding]).contains("read-only"), "binding");
    }

    #[test]
    fn a_launch_reads_or_writes_a_buffer_but_not_both() {
        let with =
            |one: Command, other: Command| vec![function(0), malloc(0, 1_024), one, other, launch([1; 3])];
        let both_ways = with(param(0, 0, 0, 512, Access::In), param(1, 0, 512, 512, Access::InOut));
        assert!(last_fault(both_ways).contains("is read and written"), "two uses");
        let overlapping = with(param(0, 0, 0, 516, Access::InOut), param(1, 0, 512, 512, Access::InOut));
        assert!(last_fault(overlapping).contains("overlapping ranges"), "overlap");
        let disjoint = with(param(0, 0, 0, 512, Access::InOut), param(1, 0, 512, 512, Access::InOut));
        validate(&program(disjoint), &SMALL).unwrap();
        let shared = with(param(0, 0, 0, 1_024, Access::In), param(1, 0, 512, 512, Access::In));
        validate(&program(shared), &SMALL).unwrap();
        let mut rebound = with(param(0, 0, 0, 512, Access::In), param(0, 0, 0, 512, Access::InOut));
        validate(&program(rebound.clone()), &SMALL).expect("a binding holds until it is replaced");
        rebound.extend([param(1, 0, 0, 4, Access::In), launch([1; 3])]);
        assert!(last_fault(rebound).contains("is read and written"), "bindings hold for later launches");
    }

    #[test]
    fn launches_keep_to_the_quota() {
        for groups in [[0, 1, 1], [1, 101, 1], [1, 1, u32::MAX]] {
            assert!(last_fault(vec![function(0), launch(groups)]).contains("1..=100"), "{groups:?}");
        }
        let sliced = |global: &str, max_groups_z| Command::Launch {
            kernel: Kernel(0),
            groups: [1; 3],
            slicing: Some(Slicing { global: global.into(), max_groups_z }),
            cost: CostNs(0),
        };
        assert!(
            last_fault(vec![function(0), sliced("z", 0)]).contains("at least one z group"),
            "empty slice"
        );
        assert!(last_fault(vec![function(0), sliced("", 1)]).contains("slicing global"), "nameless");
        let endless =
            Command::Launch { kernel: Kernel(0), groups: [1; 3], slicing: None, cost: CostNs(u64::MAX) };
        assert!(last_fault(vec![function(0), launch([1; 3]), endless]).contains("overflow"), "cost");
    }

    #[test]
    fn names_and_constants_are_bounded() {
        let named = |entry: &str, constants: Vec<(String, f64)>| {
            let entry = entry.to_owned();
            vec![Command::Function { kernel: Kernel(0), module: content(9, 100), entry, constants }]
        };
        assert!(last_fault(named("", vec![])).contains("entry point"), "empty");
        assert!(last_fault(named(&"x".repeat(129), vec![])).contains("129 B"), "long");
        assert!(last_fault(named("main", vec![("A".into(), f64::NAN)])).contains("NaN"), "not a number");
        assert!(last_fault(named("main", vec![(String::new(), 1.0)])).contains("constant"), "nameless");
        assert!(
            last_fault(named("main", vec![("A".into(), 1.0), ("A".into(), 2.0)])).contains("twice"),
            "twice"
        );
        let many = (0..257).map(|index| (format!("C{index}"), 0.0)).collect();
        assert!(last_fault(named("main", many)).contains("257 constants"), "many");
        let nameless = Command::GlobalHtoD { kernel: Kernel(0), name: String::new(), bytes: vec![0; 4] };
        assert!(last_fault(vec![function(0), nameless]).contains("global"), "nameless global");
        assert!(
            last_fault(vec![function(0), malloc(0, 4), param(64, 0, 0, 4, Access::In)]).contains("up to 63"),
            "far parameter"
        );
    }

    #[test]
    fn one_hash_has_one_size() {
        let other = Command::TaskAllocation { buffer: Buffer(1), content: content(1, 8) };
        assert!(last_fault(vec![task(0, 4), other]).contains("is named with 4 B and with 8 B"), "two sizes");
        let module = Command::Function {
            kernel: Kernel(0),
            module: Content { hash: ContentHash([9; 32]), size_bytes: MAX_MODULE_BYTES + 1 },
            entry: "main".into(),
            constants: vec![],
        };
        assert!(last_fault(vec![module]).contains("a module of"), "huge module");
    }

    #[test]
    fn totals_keep_to_the_quota() {
        assert!(
            last_fault(vec![malloc(0, 1 << 19), malloc(1, 1 << 19), malloc(2, 4)]).contains("exceed"),
            "memory"
        );
        assert!(last_fault(vec![malloc(0, 4), malloc(1, u64::MAX - 3)]).contains("exceed"), "overflow");
        let reads = vec![malloc(0, 4_096), read(0, 0, 4_096), read(0, 0, 4)];
        assert!(last_fault(reads).contains("exceeds the 4096 B"), "result");
        let error = validate(&program(vec![function(0); 65]), &SMALL).unwrap_err();
        assert_eq!((error.command, error.fault.contains("65 commands")), (64, true), "{error}");
    }

    fn handle() -> impl Strategy<Value = u32> {
        prop_oneof![8 => 0_u32..4, 1 => any::<u32>()]
    }

    fn bytes_count() -> impl Strategy<Value = u64> {
        prop_oneof![8 => (0_u64..64).prop_map(|words| words * 256), 2 => any::<u64>(), 1 => 0_u64..9]
    }

    fn name() -> impl Strategy<Value = String> {
        prop_oneof![Just(String::new()), Just("main".to_owned()), Just("x".repeat(200))]
    }

    fn access() -> impl Strategy<Value = Access> {
        prop_oneof![Just(Access::In), Just(Access::InOut)]
    }

    fn hostile_command() -> impl Strategy<Value = Command> {
        let content = (0_u8..3, bytes_count()).prop_map(|(tag, size_bytes)| content(tag, size_bytes)).boxed();
        let bytes = prop::collection::vec(any::<u8>(), 0..20).boxed();
        let constants = prop::collection::vec((name(), any::<f64>()), 0..3);
        let slicing = prop::option::of(
            (name(), 0_u32..3).prop_map(|(global, max_groups_z)| Slicing { global, max_groups_z }),
        );
        prop_oneof![
            (handle(), bytes_count()).prop_map(|(handle, size_bytes)| malloc(handle, size_bytes)),
            (handle(), content.clone())
                .prop_map(|(handle, content)| Command::TaskAllocation { buffer: Buffer(handle), content }),
            (handle(), content, name(), constants).prop_map(|(handle, module, entry, constants)| {
                Command::Function { kernel: Kernel(handle), module, entry, constants }
            }),
            (handle(), bytes_count(), bytes.clone()).prop_map(|(handle, offset_bytes, bytes)| {
                Command::MemcpyHtoD { buffer: Buffer(handle), offset_bytes, bytes }
            }),
            (handle(), name(), bytes).prop_map(|(handle, name, bytes)| Command::GlobalHtoD {
                kernel: Kernel(handle),
                name,
                bytes
            }),
            (handle(), handle(), handle(), bytes_count(), bytes_count(), access()).prop_map(
                |(kernel, index, buffer, offset_bytes, size_bytes, access)| Command::Param {
                    kernel: Kernel(kernel),
                    index,
                    buffer: Buffer(buffer),
                    offset_bytes,
                    size_bytes,
                    access
                }
            ),
            (handle(), any::<[u32; 3]>(), slicing, any::<u64>()).prop_map(
                |(kernel, groups, slicing, cost)| {
                    Command::Launch { kernel: Kernel(kernel), groups, slicing, cost: CostNs(cost) }
                }
            ),
            (handle(), bytes_count(), bytes_count()).prop_map(|(handle, offset_bytes, size_bytes)| read(
                handle,
                offset_bytes,
                size_bytes
            )),
        ]
    }

    /// Plays one verb with arguments from a small range; refusals are part of the game.
    fn play(built: &mut JobProgram, verb: (u8, u32, u32, u64, u64)) {
        let (verb, one, other, offset_bytes, size_bytes) = verb;
        let (buffer, kernel) = (Buffer(one), Kernel(other));
        // A refused verb leaves the program as it was; that is what the caller then checks.
        let _refused = match verb {
            0 => built.malloc(size_bytes).map(|_| ()),
            1 => {
                built.task_allocation(content(u8::try_from(one).unwrap(), u64::from(one + 1) * 512));
                Ok(())
            }
            2 => {
                built.function(content(9, 100), "main");
                Ok(())
            }
            3 => built.memcpy_htod(kernel, "camera", &vec![0; usize::try_from(size_bytes).unwrap()]),
            4 => {
                built.memcpy_htod_buffer(buffer, offset_bytes, &vec![0; usize::try_from(size_bytes).unwrap()])
            }
            5 => built.param(kernel, one % 64, buffer, offset_bytes, size_bytes, Access::In),
            6 => built.launch(kernel, [one, other, 1]),
            _ => built.memcpy_dtoh(buffer, offset_bytes, size_bytes),
        };
    }

    proptest! {
        #[test]
        fn hostile_programs_never_panic(commands in prop::collection::vec(hostile_command(), 0..40)) {
            let result = validate(&program(commands.clone()), &SMALL);
            if let Err(error) = result {
                prop_assert!(error.command <= commands.len());
            }
        }

        #[test]
        fn what_the_verbs_build_is_valid(
            verbs in prop::collection::vec((0_u8..8, 0_u32..5, 0_u32..4, 0_u64..1_100, 0_u64..1_100), 0..60)
        ) {
            let mut built = JobProgram::default();
            verbs.into_iter().for_each(|verb| play(&mut built, verb));
            // The verbs know no quota.
            let roomy = ProgramQuota { commands: 64, ..ProgramQuota::default() };
            prop_assert!(validate(&built, &roomy).is_ok(), "{:?}", validate(&built, &roomy));
        }
    }
}
