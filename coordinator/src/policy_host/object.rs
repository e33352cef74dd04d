//! A loaded plug-in: the one place of the coordinator where foreign code runs, and only in the host's process.
//!
//! What can be checked about a plug-in is checked here. What cannot (that its `place` is a function that keeps to the
//! header) is why the host is a process of its own.

#![allow(
    unsafe_code,
    reason = "loading a shared object and calling into it; agreed on in docs/adr/0007-plug-ins-in-a-child-process.md"
)]

use std::{
    ffi::CStr,
    mem::{align_of, size_of},
    path::Path,
};

use farm_core::coordinator::policy::{self, Question};
use libloading::os::unix::{Library, RTLD_LOCAL, RTLD_NOW};

use super::abi;

/// The symbol that a plug-in exports.
const SYMBOL: &[u8] = b"gleaner_policy_v1\0";
/// Longest `about` of a plug-in, in bytes.
const MAX_ABOUT_BYTES: usize = 255;
/// What stands behind the last choice; a plug-in that wrote too far has changed it.
const FENCE: abi::Choice = abi::Choice { job: 0xfe4c_e000, device: 0xfe4c_e001 };

/// Why a plug-in's answer is none, for people.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub(super) enum PlaceError {
    /// It said so.
    #[error("place() returned {0}")]
    Declined(i32),
    /// It wrote past the array: nothing in this process can be trusted any more.
    #[error("place() wrote more than the {0} choices there are jobs")]
    Overrun(usize),
    /// A place was left as it was.
    #[error("place() left choice {0} empty")]
    Empty(usize),
    /// No such job.
    #[error("choice {choice} names job {job} of {jobs}")]
    NoSuchJob {
        /// Position of the choice.
        choice: usize,
        /// What it names.
        job: u32,
        /// How many there are.
        jobs: usize,
    },
    /// No such device.
    #[error("choice {choice} names device {device} of {devices}")]
    NoSuchDevice {
        /// Position of the choice.
        choice: usize,
        /// What it names.
        device: u32,
        /// How many there are.
        devices: usize,
    },
    /// A job has two places, so another one has none.
    #[error("choice {choice} names job {job}, which has a place already")]
    Twice {
        /// Position of the later choice.
        choice: usize,
        /// The job.
        job: u32,
    },
}

/// A plug-in that speaks this ABI.
#[derive(Debug)]
pub(super) struct PolicyObject {
    place: abi::Place,
    about: String,
    /// Keeps `place` mapped.
    _library: Library,
}

impl PolicyObject {
    /// Loads a shared object; the reason, for people, if it is no plug-in of this ABI.
    pub(super) fn load(path: &Path) -> Result<Self, String> {
        // SAFETY: initialisers of the object run here. They are an operator's choice, and this process has nothing to lose.
        // Every symbol it needs is resolved now, so that it does not end at its first question.
        let library = unsafe { Library::open(Some(path), RTLD_NOW | RTLD_LOCAL) };
        let library = library.map_err(|error| format!("cannot be loaded: {}", causes(&error)))?;
        // SAFETY: a symbol is an address; it is not followed before it was checked below.
        let symbol = unsafe { library.get::<*const abi::Policy>(SYMBOL) };
        let symbol = symbol.map_err(|_| "exports no gleaner_policy_v1".to_owned())?;
        let address = symbol.into_raw().cast::<abi::Policy>();
        if address.is_null() || address.addr() % align_of::<abi::Policy>() != 0 {
            return Err("gleaner_policy_v1 is not where a structure can be".to_owned());
        }
        // SAFETY: aligned, not null, and inside a mapped object. The version is its first word in every ABI to come.
        let abi_version = unsafe { (&raw const (*address).abi_version).read() };
        if abi_version != abi::ABI_VERSION {
            return Err(format!("speaks ABI {abi_version}, this coordinator speaks {}", abi::ABI_VERSION));
        }
        // SAFETY: as above; the plug-in says that it was compiled against our header.
        let struct_size = unsafe { (&raw const (*address).struct_size).read() };
        let expected = size_of::<abi::Policy>();
        if usize::try_from(struct_size) != Ok(expected) {
            return Err(format!("its gleaner_policy_v1 has {struct_size} bytes, ABI 1 has {expected}"));
        }
        // SAFETY: version and size agree with the twin, whose fields are valid for every value that C can store there.
        let &abi::Policy { about, place, .. } = unsafe { &*address };
        let Some(place) = place else { return Err("its place is NULL".to_owned()) };
        if about.is_null() {
            return Err("its about is NULL".to_owned());
        }
        // SAFETY: the header asks for a string that ends with zero; the object stays mapped, so it is constant.
        let about = unsafe { CStr::from_ptr(about) }.to_bytes();
        let about = std::str::from_utf8(about).map_err(|_| "its about is not UTF-8".to_owned())?;
        if about.len() > MAX_ABOUT_BYTES {
            return Err(format!("its about is longer than {MAX_ABOUT_BYTES} bytes"));
        }
        Ok(Self { place, about: about.to_owned(), _library: library })
    }

    /// What it says about itself.
    pub(super) fn about(&self) -> &str {
        &self.about
    }

    /// Asks for a place for every job of the question.
    pub(super) fn place(&mut self, question: &Question) -> Result<Vec<policy::Choice>, PlaceError> {
        let jobs: Vec<abi::Job> = question
            .jobs
            .iter()
            .map(|job| abi::Job { load: job.load, index: job.index.0, reserved: 0 })
            .collect();
        let devices: Vec<abi::Device> = question
            .devices
            .iter()
            .map(|device| abi::Device {
                free_at_ns: device.free_at_ns,
                time_per_load: device.time_per_load,
                ready_at_ns: device.ready_at_ns,
                node: device.node.0,
                device: device.device.0.into(),
                reserved: 0,
            })
            .collect();
        let batch = abi::Batch {
            app: question.app.0,
            jobs: jobs.as_ptr(),
            devices: devices.as_ptr(),
            job_count: count(jobs.len()),
            device_count: count(devices.len()),
            task: question.task.0,
            reserved: 0,
        };
        let mut choices = vec![abi::Choice { job: abi::NONE, device: abi::NONE }; jobs.len()];
        choices.push(FENCE);
        // SAFETY: `place` was read from a structure of this ABI and is mapped while `self` lives; the arrays are as long as
        // the counts say and outlive the call. That it keeps to the header is its author's word.
        let code = unsafe { (self.place)(&raw const batch, choices.as_mut_ptr()) };
        if choices.pop() != Some(FENCE) {
            return Err(PlaceError::Overrun(jobs.len()));
        }
        if code != 0 {
            return Err(PlaceError::Declined(code));
        }
        checked(&choices, devices.len())
    }
}

/// Lengths of a question that fitted into a line.
fn count(length: usize) -> u32 {
    u32::try_from(length).expect("a line of a few MiB holds fewer than 2^32 items")
}

/// The choices as the coordinator knows them, each job with one place.
fn checked(choices: &[abi::Choice], devices: usize) -> Result<Vec<policy::Choice>, PlaceError> {
    let jobs = choices.len();
    let mut placed = vec![false; jobs];
    let check = |(choice, &abi::Choice { job, device }): (usize, &abi::Choice)| {
        if job == abi::NONE && device == abi::NONE {
            return Err(PlaceError::Empty(choice));
        }
        let Some(placed) = usize::try_from(job).ok().and_then(|job| placed.get_mut(job)) else {
            return Err(PlaceError::NoSuchJob { choice, job, jobs });
        };
        if std::mem::replace(placed, true) {
            return Err(PlaceError::Twice { choice, job });
        }
        if usize::try_from(device).is_ok_and(|device| device < devices) {
            Ok(policy::Choice { job, device })
        } else {
            Err(PlaceError::NoSuchDevice { choice, device, devices })
        }
    };
    choices.iter().enumerate().map(check).collect()
}

/// An error with all that it says it came from.
fn causes(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        text += &format!(": {error}");
        source = error.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn choices(of: &[(u32, u32)]) -> Vec<abi::Choice> {
        of.iter().map(|&(job, device)| abi::Choice { job, device }).collect()
    }

    #[test]
    fn every_job_has_one_place() {
        let good = checked(&choices(&[(1, 0), (0, 2), (2, 0)]), 3).unwrap();
        assert_eq!(good[1], policy::Choice { job: 0, device: 2 });
        let of = |pairs: &[(u32, u32)]| checked(&choices(pairs), 2).unwrap_err();
        assert_eq!(of(&[(0, 0), (abi::NONE, abi::NONE)]), PlaceError::Empty(1));
        assert_eq!(of(&[(0, 0), (2, 1)]), PlaceError::NoSuchJob { choice: 1, job: 2, jobs: 2 });
        assert_eq!(of(&[(0, 2), (1, 1)]), PlaceError::NoSuchDevice { choice: 0, device: 2, devices: 2 });
        assert_eq!(of(&[(1, 1), (1, 0)]), PlaceError::Twice { choice: 1, job: 1 });
    }
}
