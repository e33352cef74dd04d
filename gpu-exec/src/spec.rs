//! What `--device` accepts: `all | gpu:N | cpu | sim[:score=1000,speed=1.0]`.

use std::{fmt, str::FromStr};

use thiserror::Error;

/// Longest value, in bytes: errors repeat it.
const MAX_SPEC_BYTES: usize = 256;

/// Which device, or devices, to open.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DeviceSpec {
    /// Every distinct GPU, or the software adapter where there is none.
    All,
    /// The N-th GPU, counted from 0 over the adapters that are not software.
    Gpu(usize),
    /// The first software adapter (Mesa lavapipe).
    Cpu,
    /// A simulated device.
    Sim(SimSpec),
}

/// A simulated device: its launches take as long as their cost says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimSpec {
    /// The score it declares, GFLOP/s; > 0.
    pub score: f64,
    /// How much faster than its cost says a launch is; > 0.
    pub speed: f64,
}

impl Default for SimSpec {
    fn default() -> Self {
        Self { score: 1_000.0, speed: 1.0 }
    }
}

/// A `--device` value that is not understood.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum SpecError {
    /// The word is none of the four.
    #[error("device `{0}`: expected all, gpu:N, cpu or sim[:score=S,speed=V]")]
    UnknownKind(String),
    /// Longer than any device's name; the text is its start.
    #[error("device `{0}...`: a value of more than {MAX_SPEC_BYTES} B")]
    TooLong(String),
    /// `gpu:` without a number.
    #[error("device `{spec}`: `{value}` is no GPU number (expected gpu:0, gpu:1, ...)")]
    GpuIndex {
        /// The whole value.
        spec: String,
        /// The part at fault.
        value: String,
    },
    /// A key that `sim` does not know.
    #[error("device `{spec}`: unknown key `{key}` (sim knows score and speed)")]
    UnknownKey {
        /// The whole value.
        spec: String,
        /// The key.
        key: String,
    },
    /// A key came twice.
    #[error("device `{spec}`: key `{key}` is given twice")]
    RepeatedKey {
        /// The whole value.
        spec: String,
        /// The key.
        key: String,
    },
    /// A key's value is no positive number.
    #[error("device `{spec}`: {key} `{value}` is not a positive number")]
    Value {
        /// The whole value.
        spec: String,
        /// The key.
        key: &'static str,
        /// Its value.
        value: String,
    },
}

impl FromStr for DeviceSpec {
    type Err = SpecError;

    fn from_str(text: &str) -> Result<Self, SpecError> {
        if text.len() > MAX_SPEC_BYTES {
            return Err(SpecError::TooLong(text.chars().take(MAX_SPEC_BYTES / 8).collect()));
        }
        let (kind, rest) = text.split_once(':').map_or((text, None), |(kind, rest)| (kind, Some(rest)));
        match (kind, rest) {
            ("all", None) => Ok(Self::All),
            ("cpu", None) => Ok(Self::Cpu),
            ("gpu", rest) => {
                let value = rest.unwrap_or_default();
                let error = || SpecError::GpuIndex { spec: text.to_owned(), value: value.to_owned() };
                value.parse().map(Self::Gpu).map_err(|_| error())
            }
            ("sim", rest) => parse_sim(text, rest.unwrap_or_default()).map(Self::Sim),
            _ => Err(SpecError::UnknownKind(text.to_owned())),
        }
    }
}

impl fmt::Display for DeviceSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::All => f.write_str("all"),
            Self::Gpu(index) => write!(f, "gpu:{index}"),
            Self::Cpu => f.write_str("cpu"),
            Self::Sim(SimSpec { score, speed }) => write!(f, "sim:score={score},speed={speed}"),
        }
    }
}

fn parse_sim(spec: &str, settings: &str) -> Result<SimSpec, SpecError> {
    let (mut score, mut speed) = (None, None);
    for setting in settings.split(',').filter(|setting| !setting.is_empty()) {
        let (key, value) = setting.split_once('=').unwrap_or((setting, ""));
        let (name, slot) = match key {
            "score" => ("score", &mut score),
            "speed" => ("speed", &mut speed),
            _ => return Err(SpecError::UnknownKey { spec: spec.to_owned(), key: key.to_owned() }),
        };
        let number = value.parse::<f64>().ok().filter(|number| number.is_finite() && *number > 0.0);
        let Some(number) = number else {
            return Err(SpecError::Value { spec: spec.to_owned(), key: name, value: value.to_owned() });
        };
        if slot.replace(number).is_some() {
            return Err(SpecError::RepeatedKey { spec: spec.to_owned(), key: key.to_owned() });
        }
    }
    let default = SimSpec::default();
    Ok(SimSpec { score: score.unwrap_or(default.score), speed: speed.unwrap_or(default.speed) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_form_parses_and_prints_back() {
        for text in ["all", "cpu", "gpu:0", "gpu:12", "sim:score=1000,speed=1", "sim:score=2.5,speed=0.125"] {
            let spec: DeviceSpec = text.parse().unwrap();
            assert_eq!(spec.to_string(), text);
        }
        assert_eq!("sim".parse(), Ok(DeviceSpec::Sim(SimSpec::default())));
        assert_eq!("sim:speed=4".parse(), Ok(DeviceSpec::Sim(SimSpec { score: 1_000.0, speed: 4.0 })));
    }

    #[test]
    fn errors_name_the_part_at_fault() {
        let message = |text: &str| text.parse::<DeviceSpec>().unwrap_err().to_string();
        for text in ["", "tpu", "all:1", "cpu:0", "GPU:0"] {
            assert!(message(text).contains("expected all, gpu:N"), "{text}: {}", message(text));
        }
        assert!(message("gpu:").contains("`` is no GPU number"), "{}", message("gpu:"));
        assert!(message("gpu:-1").contains("`-1`"), "{}", message("gpu:-1"));
        assert!(message("sim:sped=1").contains("unknown key `sped`"), "{}", message("sim:sped=1"));
        assert!(message("sim:speed=0").contains("speed `0`"), "{}", message("sim:speed=0"));
        assert!(message("sim:speed=inf").contains("speed `inf`"), "{}", message("sim:speed=inf"));
        assert!(message("sim:score").contains("score ``"), "{}", message("sim:score"));
        assert!(message("sim:speed=1,speed=2").contains("twice"), "{}", message("sim:speed=1,speed=2"));
    }
}
