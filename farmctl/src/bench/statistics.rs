//! The arithmetic of the figures (10-scheduling.md section 5). Pure.

/// The value at or below which the share `quantile` of the values lies; NaN of none.
pub(super) fn percentile(values: &[f64], quantile: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let last = sorted.len().saturating_sub(1);
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "an index of a list in memory, scaled by a number in 0..=1"
    )]
    let index = (last as f64 * quantile).round() as usize;
    sorted.get(index).copied().unwrap_or(f64::NAN)
}

/// The middle value (of an even number the upper one of the two); NaN of none.
pub(super) fn median(values: &[f64]) -> f64 {
    percentile(values, 0.5)
}

/// Jain's index of fairness of `received / entitled`: 1 when all have their due, 1/n when one has everything (Jain,
/// Chiu, Hawe 1984).
pub(super) fn jain(received: &[f64], entitled: &[f64]) -> f64 {
    let ratios = || received.iter().zip(entitled).map(|(received, entitled)| received / entitled);
    let (sum, squares): (f64, f64) =
        ratios().fold((0.0, 0.0), |(sum, squares), ratio| (sum + ratio, squares + ratio * ratio));
    sum * sum / (received.len() as f64 * squares)
}

/// No schedule ends before this: all work on all devices, or the longest job on the fastest one. `jobs` are durations on
/// a device of speed 1; the bound has their unit.
pub(super) fn lower_bound(jobs: &[f64], speeds: &[f64]) -> f64 {
    let work: f64 = jobs.iter().sum();
    let rate: f64 = speeds.iter().sum();
    let longest = jobs.iter().copied().fold(0.0, f64::max);
    let fastest = speeds.iter().copied().fold(0.0, f64::max);
    (work / rate).max(longest / fastest)
}

/// When the jobs end if every device takes the next one from a single queue the moment it is free: as well as can be
/// done without knowing how long jobs take, in this order. What is above it is the farm's.
pub(super) fn one_queue(jobs: &[f64], speeds: &[f64]) -> f64 {
    let mut free_at = vec![0.0_f64; speeds.len()];
    for job in jobs {
        let devices = free_at.iter_mut().zip(speeds);
        if let Some((at, speed)) = devices.min_by(|(one, _), (other, _)| one.total_cmp(other)) {
            *at += job / speed;
        }
    }
    free_at.into_iter().fold(0.0, f64::max)
}

/// The best makespan of `jobs` equal jobs, exactly: `min{T: sum floor(T / p_i) >= jobs}`, where `times[i]` is how long
/// device `i` takes for one.
pub(super) fn equal_jobs_optimum(jobs: usize, times: &[f64]) -> f64 {
    // The optimum is the time at which some device ends a job: the jobs-th such time of all. One after the other.
    let mut done = vec![0_u32; times.len()];
    let mut at = 0.0;
    for _ in 0..jobs {
        let next = |(device, time): (usize, &f64)| (device, f64::from(done[device] + 1) * time);
        let first = times.iter().enumerate().map(next).min_by(|(_, one), (_, other)| one.total_cmp(other));
        let Some((device, end)) = first else { return f64::NAN };
        done[device] += 1;
        at = end;
    }
    at
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(one: f64, other: f64) -> bool {
        (one - other).abs() < 1e-9
    }

    #[test]
    fn percentiles_do_not_need_sorted_lists() {
        let values: Vec<f64> = (1..=101).rev().map(f64::from).collect();
        assert!(close(median(&values), 51.0), "the median of 1..=101 is 51");
        assert!(close(percentile(&values, 0.95), 96.0), "95 % of 1..=101 lie at or below 96");
        assert!(close(percentile(&values, 1.0), 101.0) && close(percentile(&values, 0.0), 1.0));
        assert!(!close(percentile(&values, 0.95), median(&values)), "another quantile is another value");
        assert!(median(&[]).is_nan(), "no median of nothing");
        assert!(close(median(&[1.0, 1.0, 1e9, 2.0, 1.0]), 1.0), "an outlier does not move it");
    }

    #[test]
    fn jain_is_one_only_when_all_have_their_due() {
        let entitled = [3.0, 2.0, 1.0];
        assert!(close(jain(&[30.0, 20.0, 10.0], &entitled), 1.0));
        assert!(close(jain(&[7.0, 0.0, 0.0], &entitled), 1.0 / 3.0), "one has everything");
        let equal = jain(&[20.0, 20.0, 20.0], &entitled);
        assert!(equal < 0.9, "equal shares are not fair to unequal weights: {equal}");
    }

    #[test]
    fn the_lower_bound_is_work_or_the_longest_job() {
        assert!(close(lower_bound(&[10.0; 8], &[1.0; 4]), 20.0));
        assert!(
            close(lower_bound(&[10.0, 10.0, 90.0], &[1.0, 2.0]), 45.0),
            "the long one on the fast device"
        );
        assert!(!close(lower_bound(&[10.0; 9], &[1.0; 4]), lower_bound(&[10.0; 8], &[1.0; 4])));
    }

    #[test]
    fn one_queue_knows_the_order_and_no_more() {
        assert!(close(one_queue(&[10.0; 8], &[1.0; 4]), 20.0));
        assert!(close(one_queue(&[30.0, 10.0, 10.0, 10.0], &[1.0, 1.0]), 30.0));
        assert!(close(one_queue(&[10.0, 10.0, 10.0, 30.0], &[1.0, 1.0]), 40.0), "the long one comes last");
        assert!(close(one_queue(&[4.0, 4.0, 4.0], &[1.0, 2.0]), 4.0), "the fast device is free first");
    }

    #[test]
    fn equal_jobs_have_an_exact_optimum() {
        assert!(close(equal_jobs_optimum(64, &[2.0; 32]), 4.0));
        assert!(close(equal_jobs_optimum(65, &[2.0; 32]), 6.0), "one job more costs a whole round");
        assert!(
            close(equal_jobs_optimum(3, &[1.0, 2.0]), 2.0),
            "two on the fast device, one on the slow one"
        );
        assert!(close(equal_jobs_optimum(4, &[1.0, 2.0]), 3.0));
        let bound = lower_bound(&[1.0; 4], &[1.0, 0.5]);
        assert!(bound < 3.0, "the general bound is below it here: {bound}");
    }
}
