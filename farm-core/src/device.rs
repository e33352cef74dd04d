//! What a device is, what a job needs of one, and whether the one fulfils the other.

use std::fmt;

use serde::{Deserialize, Serialize};

/// How a device computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum DeviceKind {
    /// A GPU of its own memory or an integrated one.
    Gpu,
    /// A Vulkan implementation on the CPU (Mesa lavapipe).
    Cpu,
    /// No computation: a launch takes as long as its cost says and changes no buffer.
    Simulated,
}

impl fmt::Display for DeviceKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Gpu => "gpu",
            Self::Cpu => "cpu",
            Self::Simulated => "sim",
        })
    }
}

/// Optional abilities of a device, as a set of bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Features(pub u32);

impl Features {
    /// 64-bit integers in shaders.
    pub const INT64: Self = Self(1);
    /// 16-bit floats in shaders.
    pub const FLOAT16: Self = Self(1 << 1);
    /// Subgroup operations.
    pub const SUBGROUP: Self = Self(1 << 2);
    /// Timestamp queries.
    pub const TIMESTAMP: Self = Self(1 << 3);

    /// Both sets together.
    #[must_use]
    pub const fn union(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// Whether every bit of `other` is set here.
    #[must_use]
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }
}

/// Sizes a device can serve, or a job needs. Units are in the names.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Limits {
    /// Memory for buffers.
    pub memory_bytes: u64,
    /// The largest single buffer.
    pub buffer_bytes: u64,
    /// The largest storage binding (128 MiB on lavapipe).
    pub binding_bytes: u64,
    /// Storage buffers of one kernel.
    pub storage_buffers: u32,
    /// Workgroup memory of one kernel.
    pub workgroup_memory_bytes: u32,
    /// Invocations of one workgroup.
    pub workgroup_invocations: u32,
}

impl Limits {
    /// Needs nothing.
    pub const NONE: Self = Self {
        memory_bytes: 0,
        buffer_bytes: 0,
        binding_bytes: 0,
        storage_buffers: 0,
        workgroup_memory_bytes: 0,
        workgroup_invocations: 0,
    };

    /// Has everything: the limits of a simulated device.
    pub const UNBOUNDED: Self = Self {
        memory_bytes: u64::MAX,
        buffer_bytes: u64::MAX,
        binding_bytes: u64::MAX,
        storage_buffers: u32::MAX,
        workgroup_memory_bytes: u32::MAX,
        workgroup_invocations: u32::MAX,
    };

    /// Whether a device of these limits can serve a job that needs `needs`.
    #[must_use]
    pub const fn cover(&self, needs: &Self) -> bool {
        self.memory_bytes >= needs.memory_bytes
            && self.buffer_bytes >= needs.buffer_bytes
            && self.binding_bytes >= needs.binding_bytes
            && self.storage_buffers >= needs.storage_buffers
            && self.workgroup_memory_bytes >= needs.workgroup_memory_bytes
            && self.workgroup_invocations >= needs.workgroup_invocations
    }
}

/// A device as its node announces it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DeviceInfo {
    /// What the driver calls the device, for people.
    pub name: String,
    /// How it computes.
    pub kind: DeviceKind,
    /// Measured single-precision throughput in GFLOP/s (thesis 5.4.1), or a simulated device's declared score.
    pub score: f64,
    /// Optional abilities.
    pub features: Features,
    /// Sizes.
    pub limits: Limits,
}

impl DeviceInfo {
    /// Whether a job planned for `other` may run here: the same kind, and nothing that `other` has is lacking. The node
    /// does not know what the job itself needs.
    #[must_use]
    pub fn stands_in_for(&self, other: &Self) -> bool {
        self.kind == other.kind && self.features.contains(other.features) && self.limits.cover(&other.limits)
    }
}

/// What a job needs of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Requirements {
    /// Abilities that must be there.
    pub features: Features,
    /// Least sizes.
    pub limits: Limits,
    /// Whether a simulated device may take the job. Real kernels say no: their results would be zeros.
    pub simulated: SimulatedDevices,
}

/// Whether simulated devices may take a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum SimulatedDevices {
    /// Only devices that compute.
    Refused,
    /// Any device, simulated ones too (benchmarks, tests of the farm itself).
    Accepted,
}

impl Requirements {
    /// Any device that computes.
    pub const ANY_REAL: Self =
        Self { features: Features(0), limits: Limits::NONE, simulated: SimulatedDevices::Refused };
    /// Any device at all.
    pub const ANY: Self = Self { simulated: SimulatedDevices::Accepted, ..Self::ANY_REAL };

    /// Whether `device` can take a job of these requirements.
    #[must_use]
    pub fn fulfilled_by(&self, device: &DeviceInfo) -> bool {
        (device.kind != DeviceKind::Simulated || self.simulated == SimulatedDevices::Accepted)
            && device.features.contains(self.features)
            && device.limits.cover(&self.limits)
    }
}
