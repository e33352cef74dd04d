//! The verbs that an application's `dispatch()` uses to fill a program. Each checks what it can see; `validate` checks
//! the whole, also of programs that came over a wire.

use std::collections::BTreeMap;

use thiserror::Error;

use super::{
    Access, Buffer, Command, Content, JobProgram, Kernel, Slicing,
    validate::{MAX_GLOBAL_BYTES, PARAM_ALIGNMENT_BYTES},
};
use crate::message::CostNs;

/// A verb refused its arguments. Not to be retried: the application is wrong.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum DispatchError {
    /// A size is zero or not a multiple of 4.
    #[error("{verb}: size {size_bytes} B must be a positive multiple of 4")]
    Size {
        /// The verb.
        verb: &'static str,
        /// The size given.
        size_bytes: u64,
    },
    /// A global's value is too large for a uniform.
    #[error("{verb}: {size_bytes} B are more than the {MAX_GLOBAL_BYTES} B of a uniform")]
    GlobalSize {
        /// The verb.
        verb: &'static str,
        /// The size given.
        size_bytes: u64,
    },
    /// An offset is not aligned.
    #[error("{verb}: offset {offset_bytes} B must be a multiple of {alignment_bytes}")]
    Offset {
        /// The verb.
        verb: &'static str,
        /// The offset given.
        offset_bytes: u64,
        /// What it must be a multiple of.
        alignment_bytes: u64,
    },
    /// A handle does not belong to this program.
    #[error("{verb}: {what} {handle} is not of this program")]
    UnknownHandle {
        /// The verb.
        verb: &'static str,
        /// `buffer` or `kernel`.
        what: &'static str,
        /// Its number.
        handle: u32,
    },
    /// A range leaves its buffer.
    #[error("{verb}: bytes {offset_bytes}..+{size_bytes} leave buffer {buffer} of {buffer_bytes} B")]
    OutOfRange {
        /// The verb.
        verb: &'static str,
        /// The buffer.
        buffer: u32,
        /// Start of the range.
        offset_bytes: u64,
        /// Its length.
        size_bytes: u64,
        /// The buffer's size.
        buffer_bytes: u64,
    },
    /// A task allocation was to be written.
    #[error("{verb}: buffer {buffer} is a task allocation and read-only")]
    ReadOnly {
        /// The verb.
        verb: &'static str,
        /// The buffer.
        buffer: u32,
    },
    /// A launch of no workgroup.
    #[error("launch: workgroups {groups:?} must all be positive")]
    EmptyLaunch {
        /// What was asked.
        groups: [u32; 3],
    },
    /// The application's own reason.
    #[error("{0}")]
    Application(String),
}

impl JobProgram {
    /// A job allocation of `size_bytes` zero bytes.
    ///
    /// # Errors
    /// The size is zero or not a multiple of 4.
    pub fn malloc(&mut self, size_bytes: u64) -> Result<Buffer, DispatchError> {
        if size_bytes == 0 || !size_bytes.is_multiple_of(4) {
            return Err(DispatchError::Size { verb: "malloc", size_bytes });
        }
        let buffer = self.new_buffer(size_bytes, Access::InOut);
        self.commands.push(Command::Malloc { buffer, size_bytes });
        Ok(buffer)
    }

    /// Binds a task allocation; the same content gives the same handle.
    pub fn task_allocation(&mut self, content: Content) -> Buffer {
        self.refresh_definitions();
        if let Some(&known) = self.definitions.allocations.get(&content) {
            return known;
        }
        let buffer = self.new_buffer(content.size_bytes, Access::In);
        self.definitions.allocations.insert(content, buffer);
        self.commands.push(Command::TaskAllocation { buffer, content });
        buffer
    }

    /// An entry point of a module.
    pub fn function(&mut self, module: Content, entry: &str) -> Kernel {
        self.function_with_constants(module, entry, &[])
    }

    /// An entry point of a module with values for its `override` constants.
    pub fn function_with_constants(
        &mut self,
        module: Content,
        entry: &str,
        constants: &[(&str, f64)],
    ) -> Kernel {
        let kernel = Kernel(self.kernels);
        self.kernels += 1;
        let constants = constants.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect();
        self.commands.push(Command::Function { kernel, module, entry: entry.to_owned(), constants });
        kernel
    }

    /// Host bytes into a kernel's named global (thesis listing B.2: `clMemcpyHtoD` on a module global).
    ///
    /// # Errors
    /// The kernel is not of this program, or the size is zero, not a multiple of 4, or larger than a uniform.
    pub fn memcpy_htod(&mut self, kernel: Kernel, global: &str, bytes: &[u8]) -> Result<(), DispatchError> {
        const VERB: &str = "memcpy_htod";
        let size_bytes = bytes.len() as u64;
        self.check_kernel(VERB, kernel)?;
        if size_bytes == 0 || !size_bytes.is_multiple_of(4) {
            return Err(DispatchError::Size { verb: VERB, size_bytes });
        }
        if size_bytes > MAX_GLOBAL_BYTES {
            return Err(DispatchError::GlobalSize { verb: VERB, size_bytes });
        }
        self.commands.push(Command::GlobalHtoD { kernel, name: global.to_owned(), bytes: bytes.to_vec() });
        Ok(())
    }

    /// Host bytes into a job allocation at `offset_bytes`.
    ///
    /// # Errors
    /// The range leaves the buffer, is not aligned to 4, or the buffer is a task allocation.
    pub fn memcpy_htod_buffer(
        &mut self,
        buffer: Buffer,
        offset_bytes: u64,
        bytes: &[u8],
    ) -> Result<(), DispatchError> {
        const VERB: &str = "memcpy_htod_buffer";
        self.check_writable(VERB, buffer)?;
        self.check_range(VERB, buffer, offset_bytes, bytes.len() as u64)?;
        check_offset(VERB, offset_bytes, 4)?;
        self.commands.push(Command::MemcpyHtoD { buffer, offset_bytes, bytes: bytes.to_vec() });
        Ok(())
    }

    /// Binds a whole buffer to a kernel's parameter for reading.
    ///
    /// # Errors
    /// The kernel or buffer is not of this program.
    pub fn param_in(&mut self, kernel: Kernel, index: u32, buffer: Buffer) -> Result<(), DispatchError> {
        let size_bytes = self.buffer_bytes("param_in", buffer)?;
        self.param(kernel, index, buffer, 0, size_bytes, Access::In)
    }

    /// Binds a whole job allocation to a kernel's parameter for reading and writing.
    ///
    /// # Errors
    /// The kernel or buffer is not of this program, or the buffer is a task allocation.
    pub fn param_in_out(&mut self, kernel: Kernel, index: u32, buffer: Buffer) -> Result<(), DispatchError> {
        let size_bytes = self.buffer_bytes("param_in_out", buffer)?;
        self.check_writable("param_in_out", buffer)?;
        self.param(kernel, index, buffer, 0, size_bytes, Access::InOut)
    }

    /// Binds a part of a buffer: large arrays are split over bindings where a device's binding limit asks for it.
    ///
    /// # Errors
    /// A handle is not of this program, the range leaves the buffer, the offset is not a multiple of 256, or a task
    /// allocation is to be written.
    pub fn param(
        &mut self,
        kernel: Kernel,
        index: u32,
        buffer: Buffer,
        offset_bytes: u64,
        size_bytes: u64,
        access: Access,
    ) -> Result<(), DispatchError> {
        self.check_kernel("param", kernel)?;
        self.check_range("param", buffer, offset_bytes, size_bytes)?;
        check_offset("param", offset_bytes, PARAM_ALIGNMENT_BYTES)?;
        match access {
            Access::In => {}
            Access::InOut => self.check_writable("param", buffer)?,
        }
        self.commands.push(Command::Param { kernel, index, buffer, offset_bytes, size_bytes, access });
        Ok(())
    }

    /// Runs a kernel over `groups` workgroups.
    ///
    /// # Errors
    /// The kernel is not of this program, or an extent is zero.
    pub fn launch(&mut self, kernel: Kernel, groups: [u32; 3]) -> Result<(), DispatchError> {
        self.push_launch(kernel, groups, None, CostNs(0))
    }

    /// Runs a kernel and says how much work it is: the time a simulated device of speed 1.0 takes.
    ///
    /// # Errors
    /// As [`Self::launch`].
    pub fn launch_with_cost(
        &mut self,
        kernel: Kernel,
        groups: [u32; 3],
        cost: CostNs,
    ) -> Result<(), DispatchError> {
        self.push_launch(kernel, groups, None, cost)
    }

    /// Runs a kernel whose z extent the executor may cut into bounded runs; see [`Slicing`].
    ///
    /// # Errors
    /// As [`Self::launch`].
    pub fn launch_sliced(
        &mut self,
        kernel: Kernel,
        groups: [u32; 3],
        slicing: Slicing,
        cost: CostNs,
    ) -> Result<(), DispatchError> {
        self.push_launch(kernel, groups, Some(slicing), cost)
    }

    /// A part of a job allocation into the result, as its next section.
    ///
    /// # Errors
    /// The range leaves the buffer or is not aligned to 4, or the buffer is a task allocation.
    pub fn memcpy_dtoh(
        &mut self,
        buffer: Buffer,
        offset_bytes: u64,
        size_bytes: u64,
    ) -> Result<(), DispatchError> {
        const VERB: &str = "memcpy_dtoh";
        self.check_writable(VERB, buffer)?;
        self.check_range(VERB, buffer, offset_bytes, size_bytes)?;
        check_offset(VERB, offset_bytes, 4)?;
        self.commands.push(Command::MemcpyDtoH { buffer, offset_bytes, size_bytes });
        Ok(())
    }

    fn new_buffer(&mut self, size_bytes: u64, access: Access) -> Buffer {
        self.refresh_definitions();
        self.buffers += 1;
        self.definitions.buffers.push((size_bytes, access));
        Buffer(self.buffers - 1)
    }

    fn push_launch(
        &mut self,
        kernel: Kernel,
        groups: [u32; 3],
        slicing: Option<Slicing>,
        cost: CostNs,
    ) -> Result<(), DispatchError> {
        self.check_kernel("launch", kernel)?;
        if groups.contains(&0) {
            return Err(DispatchError::EmptyLaunch { groups });
        }
        self.commands.push(Command::Launch { kernel, groups, slicing, cost });
        Ok(())
    }

    fn check_kernel(&self, verb: &'static str, kernel: Kernel) -> Result<(), DispatchError> {
        if kernel.0 < self.kernels {
            return Ok(());
        }
        Err(DispatchError::UnknownHandle { verb, what: "kernel", handle: kernel.0 })
    }

    fn buffer_bytes(&mut self, verb: &'static str, buffer: Buffer) -> Result<u64, DispatchError> {
        self.definition(buffer).map(|(size_bytes, _)| size_bytes).ok_or(DispatchError::UnknownHandle {
            verb,
            what: "buffer",
            handle: buffer.0,
        })
    }

    fn check_writable(&mut self, verb: &'static str, buffer: Buffer) -> Result<(), DispatchError> {
        match self.definition(buffer) {
            None => Err(DispatchError::UnknownHandle { verb, what: "buffer", handle: buffer.0 }),
            Some((_, Access::In)) => Err(DispatchError::ReadOnly { verb, buffer: buffer.0 }),
            Some((_, Access::InOut)) => Ok(()),
        }
    }

    fn check_range(
        &mut self,
        verb: &'static str,
        buffer: Buffer,
        offset_bytes: u64,
        size_bytes: u64,
    ) -> Result<(), DispatchError> {
        let buffer_bytes = self.buffer_bytes(verb, buffer)?;
        if size_bytes == 0 || !size_bytes.is_multiple_of(4) {
            return Err(DispatchError::Size { verb, size_bytes });
        }
        if offset_bytes.checked_add(size_bytes).is_none_or(|end| end > buffer_bytes) {
            return Err(DispatchError::OutOfRange {
                verb,
                buffer: buffer.0,
                offset_bytes,
                size_bytes,
                buffer_bytes,
            });
        }
        Ok(())
    }

    /// Size of a buffer, and whether it may be written.
    fn definition(&mut self, wanted: Buffer) -> Option<(u64, Access)> {
        self.refresh_definitions();
        self.definitions.buffers.get(usize::try_from(wanted.0).ok()?).copied()
    }

    /// A program that came over a wire brings its commands only.
    fn refresh_definitions(&mut self) {
        if self.buffers == 0 || !self.definitions.buffers.is_empty() {
            return;
        }
        for command in &self.commands {
            match command {
                Command::Malloc { size_bytes, .. } => {
                    self.definitions.buffers.push((*size_bytes, Access::InOut))
                }
                Command::TaskAllocation { buffer, content } => {
                    self.definitions.buffers.push((content.size_bytes, Access::In));
                    self.definitions.allocations.insert(*content, *buffer);
                }
                Command::Function { .. }
                | Command::MemcpyHtoD { .. }
                | Command::GlobalHtoD { .. }
                | Command::Param { .. }
                | Command::Launch { .. }
                | Command::MemcpyDtoH { .. } => {}
            }
        }
    }
}

/// The buffers of a program under construction: what each verb would otherwise search the commands for.
#[derive(Clone, Debug, Default)]
pub(super) struct Definitions {
    /// Size and use, by handle.
    buffers: Vec<(u64, Access)>,
    allocations: BTreeMap<Content, Buffer>,
}

/// Two programs of the same commands are the same, whether they were built here or came over a wire.
impl PartialEq for Definitions {
    fn eq(&self, _: &Self) -> bool {
        true
    }
}

fn check_offset(verb: &'static str, offset_bytes: u64, alignment_bytes: u64) -> Result<(), DispatchError> {
    if offset_bytes.is_multiple_of(alignment_bytes) {
        return Ok(());
    }
    Err(DispatchError::Offset { verb, offset_bytes, alignment_bytes })
}

/// Bytes as one serde value instead of a sequence of numbers: one copy, not one call per byte.
pub(super) mod bytes_field {
    use std::fmt;

    use serde::{Deserializer, Serializer, de::Visitor};

    pub(in crate::program) fn serialize<S: Serializer>(
        bytes: &[u8],
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(bytes)
    }

    pub(in crate::program) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<Vec<u8>, D::Error> {
        struct Bytes;
        impl Visitor<'_> for Bytes {
            type Value = Vec<u8>;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("bytes")
            }
            fn visit_bytes<E>(self, bytes: &[u8]) -> Result<Vec<u8>, E> {
                Ok(bytes.to_vec())
            }
            fn visit_byte_buf<E>(self, bytes: Vec<u8>) -> Result<Vec<u8>, E> {
                Ok(bytes)
            }
        }
        deserializer.deserialize_byte_buf(Bytes)
    }
}
