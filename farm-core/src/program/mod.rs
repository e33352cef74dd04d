//! A job as plain data: a command buffer over handles (thesis 5.3.2, appendix B), built by an application's
//! `dispatch()`, validated once, serialised, and replayed by `gpu-exec`'s one interpreter.
//!
//! The verbs mirror the CUDA driver API (malloc, memcpy, function, param, launch). How they meet WGSL: parameter `i` of
//! a kernel is the storage buffer `@group(0) @binding(i)`; a named global is a `var<uniform>` found by its name
//! (any group but 0).

mod build;
mod validate;

use serde::{Deserialize, Serialize};

pub use self::{
    build::DispatchError,
    validate::{ProgramError, ProgramQuota, ProgramSummary, validate},
};
use crate::{id::ContentHash, message::CostNs};

/// A task allocation or a module, named by the digest of its bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Content {
    /// blake3 of the bytes.
    pub hash: ContentHash,
    /// Their number.
    pub size_bytes: u64,
}

/// A buffer of a program: a job allocation or a bound task allocation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Buffer(pub u32);

/// A kernel of a program: an entry point of a module.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Kernel(pub u32);

/// How a kernel uses a parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Access {
    /// `var<storage, read>`.
    In,
    /// `var<storage, read_write>`; never a task allocation.
    InOut,
}

/// A launch whose z extent the executor may cut into runs, so that each submit stays bounded on a slow device and full
/// on a fast one. Before each run the executor writes the run's first z into `global` (a `u32` uniform); the
/// kernel adds it to `workgroup_id.z`. A kernel's results must not depend on the cuts.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Slicing {
    /// Name of the `var<uniform>` of type `u32`.
    pub global: String,
    /// Most z groups in one run (what the kernel's scratch memory is sized for), >= 1.
    pub max_groups_z: u32,
}

/// One step of a program.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Command {
    /// A job allocation: zero-filled, freed when the job ends.
    Malloc {
        /// The handle defined.
        buffer: Buffer,
        /// Size, a multiple of 4.
        size_bytes: u64,
    },
    /// A task allocation: fetched once per node, cached, read-only.
    TaskAllocation {
        /// The handle defined.
        buffer: Buffer,
        /// What it holds.
        content: Content,
    },
    /// An entry point of a WGSL module, with values for its `override` constants.
    Function {
        /// The handle defined.
        kernel: Kernel,
        /// The module's text.
        module: Content,
        /// The `@compute` function.
        entry: String,
        /// Values of `override` constants by name.
        constants: Vec<(String, f64)>,
    },
    /// Host bytes into a job allocation.
    MemcpyHtoD {
        /// Where to.
        buffer: Buffer,
        /// Offset in the buffer, a multiple of 4.
        offset_bytes: u64,
        /// What; its length is a multiple of 4.
        #[serde(with = "build::bytes_field")]
        bytes: Vec<u8>,
    },
    /// Host bytes into a kernel's named uniform; holds for the kernel's later launches.
    GlobalHtoD {
        /// Whose.
        kernel: Kernel,
        /// The global's name in the module.
        name: String,
        /// Its value.
        #[serde(with = "build::bytes_field")]
        bytes: Vec<u8>,
    },
    /// Binds a buffer (or a part of it) to a kernel's parameter; holds for the kernel's later launches.
    Param {
        /// Whose.
        kernel: Kernel,
        /// `@group(0) @binding(index)`.
        index: u32,
        /// What.
        buffer: Buffer,
        /// Start of the part, a multiple of 256.
        offset_bytes: u64,
        /// Length of the part, > 0.
        size_bytes: u64,
        /// How.
        access: Access,
    },
    /// Runs a kernel. A yield point lies after each launch and after each run of a sliced one.
    Launch {
        /// Which.
        kernel: Kernel,
        /// Workgroups in x, y, z.
        groups: [u32; 3],
        /// Whether z may be cut.
        slicing: Option<Slicing>,
        /// Work of the whole launch: how long a simulated device of speed 1.0 takes; a hint for the others.
        cost: CostNs,
    },
    /// A part of a job allocation into the result: one section, in program order.
    MemcpyDtoH {
        /// From where.
        buffer: Buffer,
        /// Offset in the buffer, a multiple of 4.
        offset_bytes: u64,
        /// Length, a multiple of 4.
        size_bytes: u64,
    },
}

/// A job's command buffer.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct JobProgram {
    commands: Vec<Command>,
    buffers: u32,
    kernels: u32,
    /// What the verbs look up; follows from `commands`.
    #[serde(skip)]
    definitions: build::Definitions,
}

impl JobProgram {
    /// The commands in order.
    #[must_use]
    pub fn commands(&self) -> &[Command] {
        &self.commands
    }

    /// The same program with other names for its contents.
    #[must_use]
    pub fn with_contents_named(mut self, name: impl Fn(ContentHash) -> ContentHash) -> Self {
        for command in &mut self.commands {
            if let Command::TaskAllocation { content, .. } | Command::Function { module: content, .. } =
                command
            {
                content.hash = name(content.hash);
            }
        }
        self.definitions = build::Definitions::default();
        self
    }
}
