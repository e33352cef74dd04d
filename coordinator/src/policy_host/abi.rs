//! The Rust twins of `include/gleaner_policy_v1.h`: what crosses between the host and a plug-in. Layout alone; the header
//! says what the fields mean. The test below compares both by a C program.

use std::ffi::{c_char, c_int};

/// `GLEANER_POLICY_ABI_V1`.
pub(super) const ABI_VERSION: u32 = 1;

/// `GLEANER_NONE_V1`.
pub(super) const NONE: u32 = u32::MAX;

/// `gleaner_job_v1`, 16 bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub(super) struct Job {
    pub(super) load: f64,
    pub(super) index: u32,
    pub(super) reserved: u32,
}

/// `gleaner_device_v1`, 40 bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub(super) struct Device {
    pub(super) free_at_ns: f64,
    pub(super) time_per_load: f64,
    pub(super) ready_at_ns: f64,
    pub(super) node: u64,
    pub(super) device: u32,
    pub(super) reserved: u32,
}

/// `gleaner_batch_v1`, 40 bytes.
#[repr(C)]
#[derive(Debug)]
pub(super) struct Batch {
    pub(super) app: u64,
    pub(super) jobs: *const Job,
    pub(super) devices: *const Device,
    pub(super) job_count: u32,
    pub(super) device_count: u32,
    pub(super) task: u32,
    pub(super) reserved: u32,
}

/// `gleaner_choice_v1`, 8 bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Choice {
    pub(super) job: u32,
    pub(super) device: u32,
}

/// The type of `struct gleaner_policy_v1`'s `place`. `int32_t` is `int` on every platform that Rust knows.
pub(super) type Place = unsafe extern "C" fn(*const Batch, *mut Choice) -> c_int;

/// `struct gleaner_policy_v1`, 24 bytes.
#[repr(C)]
#[derive(Debug)]
pub(super) struct Policy {
    pub(super) abi_version: u32,
    pub(super) struct_size: u32,
    pub(super) about: *const c_char,
    pub(super) place: Option<Place>,
}

#[cfg(test)]
mod tests {
    use std::{
        mem::{align_of, offset_of, size_of},
        path::Path,
        process::Command,
    };

    use super::*;

    /// Name in C, size, alignment, and name and offset of each field.
    type Layout = (&'static str, usize, usize, Vec<(&'static str, usize)>);

    macro_rules! layout {
        ($c_name:literal, $twin:ty, $($field:ident),+) => {
            ($c_name, size_of::<$twin>(), align_of::<$twin>(), vec![$((stringify!($field), offset_of!($twin, $field))),+])
        };
    }

    fn layouts() -> [Layout; 5] {
        [
            layout!("gleaner_job_v1", Job, load, index, reserved),
            layout!(
                "gleaner_device_v1",
                Device,
                free_at_ns,
                time_per_load,
                ready_at_ns,
                node,
                device,
                reserved
            ),
            layout!("gleaner_batch_v1", Batch, app, jobs, devices, job_count, device_count, task, reserved),
            layout!("gleaner_choice_v1", Choice, job, device),
            layout!("struct gleaner_policy_v1", Policy, abi_version, struct_size, about, place),
        ]
    }

    /// The same lines from either side.
    fn lines_of_the_twins() -> String {
        let mut lines = format!("abi {ABI_VERSION} none {NONE}\n");
        for (name, size, align, fields) in layouts() {
            lines += &format!("{name} {size} {align}\n");
            for (field, offset) in fields {
                lines += &format!("{name}.{field} {offset}\n");
            }
        }
        lines
    }

    fn lines_of_the_header() -> String {
        let mut program = String::from(
            "#include <stddef.h>\n#include <stdio.h>\n#include \"gleaner_policy_v1.h\"\n\
             #define ALIGN(type) offsetof(struct { char first; type second; }, second)\n\
             int main(void) {\n printf(\"abi %u none %u\\n\", GLEANER_POLICY_ABI_V1, GLEANER_NONE_V1);\n",
        );
        for (name, _, _, fields) in layouts() {
            program += &format!(" printf(\"{name} %zu %zu\\n\", sizeof({name}), ALIGN({name}));\n");
            for (field, _) in fields {
                program += &format!(" printf(\"{name}.{field} %zu\\n\", offsetof({name}, {field}));\n");
            }
        }
        program += " return 0;\n}\n";
        let folder = tempfile::tempdir().unwrap();
        let source = folder.path().join("layout.c");
        let binary = folder.path().join("layout");
        std::fs::write(&source, program).unwrap();
        let include = Path::new(env!("CARGO_MANIFEST_DIR")).join("include");
        let compiled =
            Command::new("cc").arg("-I").arg(include).arg("-o").arg(&binary).arg(&source).output().unwrap();
        assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
        String::from_utf8(Command::new(&binary).output().unwrap().stdout).unwrap()
    }

    #[test]
    fn the_header_and_its_twins_have_one_layout() {
        assert_eq!(lines_of_the_twins(), lines_of_the_header());
        // Nothing hides between fields: what a plug-in reads was written.
        assert_eq!(size_of::<Job>(), 8 + 4 + 4);
        assert_eq!(size_of::<Device>(), 3 * 8 + 8 + 4 + 4);
        assert_eq!(size_of::<Batch>(), 8 + 2 * size_of::<usize>() + 4 * 4);
        assert_eq!(size_of::<Policy>(), 2 * 4 + 2 * size_of::<usize>());
    }
}
