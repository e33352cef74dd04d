//! What the jobs of a batch cost, told by those that ran already: neighbours in a task are alike (spatial coherence, as the
//! tiles of an image have it: thesis figure 5.5). And what devices are worth, told by neighbours that ran on several.
//!
//! Pure arithmetic over samples. It knows no queues and decides nothing; [`super::reserve`] uses it.

use std::collections::BTreeMap;

use crate::id::{DeviceIndex, JobIndex, NodeId};

/// A device of the farm.
pub(super) type Place = (NodeId, DeviceIndex);

/// Fewer samples than this say nothing of others.
const LEAST_SAMPLES: usize = 8;

/// Neighbours on each side that a sample is compared with, and how far they are looked for: those on its own device do not
/// count.
const COMPARED: usize = 2;
const LOOKED_AT: usize = 16;

/// Costs are estimated by rates and rates by costs, in turn: six rounds come within a percent in a farm whose scores are
/// wrong by up to 2, and the time is nothing beside a plan's.
const ROUNDS: usize = 6;

/// How long jobs of a batch took, for each unit of the load that their application told.
#[derive(Debug, Default)]
pub(super) struct Samples(Vec<Sample>);

#[derive(Clone, Copy, Debug)]
struct Sample {
    index: JobIndex,
    place: Place,
    /// Nanoseconds.
    time_per_load: f64,
}

impl Samples {
    /// A job of this load was completed.
    pub(super) fn note(&mut self, index: JobIndex, place: Place, load: f64, device_time_ns: u64) {
        if load > 0.0 && device_time_ns > 0 {
            self.0.push(Sample { index, place, time_per_load: device_time_ns as f64 / load });
        }
    }

    /// What they tell. `rate` is what a device is taken for so far, in load per nanosecond, if it still stands: the estimates
    /// keep to its unit.
    pub(super) fn estimates(&self, rate: impl Fn(Place) -> Option<f64>) -> Option<Estimates> {
        if self.0.len() < LEAST_SAMPLES {
            return None;
        }
        let mut samples = self.0.clone();
        samples.sort_by_key(|sample| sample.index);
        let mut places: BTreeMap<Place, usize> = BTreeMap::new();
        let mut devices = Vec::with_capacity(samples.len());
        for sample in &samples {
            let next = places.len();
            devices.push(*places.entry(sample.place).or_insert(next));
        }
        let times: Vec<f64> = samples.iter().map(|sample| sample.time_per_load).collect();
        let known: Vec<Known> =
            samples.iter().map(|sample| Known { index: sample.index, cost: 0.0 }).collect();
        let mut rates = means(&devices, places.len(), &times);
        let mut fit = Fit { known, devices, times };
        for _ in 0..ROUNDS {
            fit.cost_by(&rates);
            rates = fit.rates(places.len());
        }
        // Only ratios are known: the devices' mean stays.
        let (mut logs, mut standing) = (0.0, 0_u32);
        for (&place, &device) in &places {
            if let Some(rate) = rate(place) {
                logs += (rate / rates[device]).ln();
                standing += 1;
            }
        }
        let unit = (logs / f64::from(standing)).exp();
        rates.iter_mut().for_each(|rate| *rate *= unit);
        fit.cost_by(&rates);
        let rates = places.into_iter().map(|(place, device)| (place, rates[device])).collect();
        let sound = |value: f64| value.is_finite() && value > 0.0;
        let estimates = Estimates { rates, known: fit.known };
        (estimates.rates.values().all(|&rate| sound(rate))
            && estimates.known.iter().all(|known| sound(known.cost)))
        .then_some(estimates)
    }
}

/// What completed jobs tell of the others.
#[derive(Debug)]
pub(super) struct Estimates {
    /// Load per nanosecond.
    pub(super) rates: BTreeMap<Place, f64>,
    /// By index; at least one.
    known: Vec<Known>,
}

#[derive(Clone, Copy, Debug)]
struct Known {
    index: JobIndex,
    /// Load for each unit that the application told.
    cost: f64,
}

impl Estimates {
    /// How much load there is to each unit that the application told, of any job of the batch: between its next neighbours
    /// on both sides.
    pub(super) fn cost(&self, index: JobIndex) -> f64 {
        let after = self.known.partition_point(|known| known.index < index);
        match (after.checked_sub(1).and_then(|before| self.known.get(before)), self.known.get(after)) {
            (Some(before), Some(after)) => {
                let [left, right] =
                    [index.0.abs_diff(before.index.0), after.index.0.abs_diff(index.0)].map(f64::from);
                (before.cost * right + after.cost * left) / (left + right)
            }
            (Some(only), None) | (None, Some(only)) => only.cost,
            (None, None) => 1.0,
        }
    }
}

/// Samples by index, seen from the rates of now.
struct Fit {
    known: Vec<Known>,
    /// On which each ran, and how long for each unit of load.
    devices: Vec<usize>,
    times: Vec<f64>,
}

impl Fit {
    fn cost_by(&mut self, rates: &[f64]) {
        for ((known, &device), time) in self.known.iter_mut().zip(&self.devices).zip(&self.times) {
            known.cost = time * rates[device];
        }
    }

    /// Devices' rates if each job costs what its neighbours on other devices cost.
    fn rates(&self, devices: usize) -> Vec<f64> {
        let mut sums = vec![(0.0, 0.0); devices];
        for (position, (&device, time)) in self.devices.iter().zip(&self.times).enumerate() {
            let (expected, took) = &mut sums[device];
            *expected += self.expected(position);
            *took += time;
        }
        sums.into_iter().map(|(expected, took)| expected / took).collect()
    }

    fn expected(&self, position: usize) -> f64 {
        let here = self.known[position];
        let elsewhere = |other: &usize| self.devices[*other] != self.devices[position];
        let first = position.saturating_sub(LOOKED_AT);
        let last = self.known.len().min(position + 1 + LOOKED_AT);
        let before = (first..position).rev().filter(elsewhere).take(COMPARED);
        let after = (position + 1..last).filter(elsewhere).take(COMPARED);
        let (mut sum, mut weights) = (0.0, 0.0);
        for other in before.chain(after).map(|other| self.known[other]) {
            // A job that ran twice is its own neighbour.
            let weight = 1.0 / f64::from(other.index.0.abs_diff(here.index.0).max(1));
            sum += weight * other.cost;
            weights += weight;
        }
        if weights > 0.0 { sum / weights } else { here.cost }
    }
}

/// The rates of devices if all jobs cost the same.
fn means(devices: &[usize], count: usize, times: &[f64]) -> Vec<f64> {
    let mut sums = vec![(0.0, 0.0); count];
    for (&device, time) in devices.iter().zip(times) {
        sums[device].0 += 1.0;
        sums[device].1 += time;
    }
    sums.into_iter().map(|(jobs, took)| jobs / took).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const JOBS: u32 = 200;

    /// A smooth cost, twice as much in the middle as at the ends.
    fn cost(index: u32) -> f64 {
        1.0 + (f64::from(index) / f64::from(JOBS) * std::f64::consts::PI).sin()
    }

    fn place(device: u16) -> Place {
        (NodeId(1), DeviceIndex(device))
    }

    /// Every third job ran, on devices of these speeds in an order of no meaning.
    fn samples(speeds: &[f64]) -> Samples {
        let mut samples = Samples::default();
        for index in (0..JOBS).step_by(3) {
            let device = usize::try_from(index.wrapping_mul(0x9e37_79b9) >> 8).unwrap() % speeds.len();
            let time_ns = (cost(index) / speeds[device] * 1e6).round();
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "a few milliseconds"
            )]
            samples.note(JobIndex(index), place(u16::try_from(device).unwrap()), 1e6, time_ns as u64);
        }
        samples
    }

    #[test]
    fn neighbours_tell_what_a_job_costs_and_what_devices_are_worth() {
        let speeds = [1.0, 1.8, 0.7, 1.3];
        let estimates = samples(&speeds).estimates(|_| Some(1.0)).unwrap();
        let unit = estimates.rates[&place(0)];
        for (device, speed) in (0_u16..).zip(speeds) {
            let rate = estimates.rates[&place(device)] / unit;
            assert!(
                (rate / speed - 1.0).abs() < 0.05,
                "device {device} of speed {speed} is taken for {rate}"
            );
        }
        for index in 0..JOBS {
            let told = estimates.cost(JobIndex(index)) / unit;
            assert!((told / cost(index) - 1.0).abs() < 0.08, "job {index}: {told}, not {}", cost(index));
        }
    }

    #[test]
    fn the_devices_mean_rate_stays_what_it_was() {
        let estimates = samples(&[1.0, 2.0, 4.0]).estimates(|_| Some(8.0)).unwrap();
        let product: f64 = estimates.rates.values().product();
        assert!((product / 512.0 - 1.0).abs() < 1e-9, "the unit is the caller's: {product}");
    }

    #[test]
    fn few_samples_and_a_single_device_tell_no_nonsense() {
        assert!(Samples::default().estimates(|_| Some(1.0)).is_none());
        let estimates = samples(&[1.0]).estimates(|_| Some(1.0)).unwrap();
        assert!((estimates.cost(JobIndex(100)) / estimates.cost(JobIndex(0)) - 2.0).abs() < 0.05);
        let mut twice = samples(&[1.0, 1.0]);
        twice.note(JobIndex(0), place(1), 1e6, 1_000_000);
        assert!(twice.estimates(|_| Some(1.0)).is_some(), "a job that ran again divides by nothing");
        twice.note(JobIndex(1), place(1), 0.0, 1);
        twice.note(JobIndex(1), place(1), 1.0, 0);
        assert!(twice.estimates(|_| Some(1.0)).is_some(), "and neither do jobs of no load or no time");
    }
}
