//! Use of a cell while nothing is measured: the program does not run, the bus sleeps, the log has a hole.
//!
//! In: the downtime, s, and the first voltage reading after it, V. Out: the updated filter. A reading that cannot be used
//! leaves the filter as it was, with its error.
//!
//! Deviation 6: two hypotheses cover downtime. Most likely the cell rested: its SOC is the one before, less
//! self-discharge, and all correlations still hold. Or it was used or charged: then its SOC is anywhere within the charge
//! that can be moved in that time, and its branches are as uncertain as at a start. The first voltage under a known
//! current decides: both hypotheses are updated with it, weighted by their likelihoods (Bayes' rule, prior of [`Memory`])
//! and merged into one Gaussian with their common mean and covariance. Effect: a night without use keeps the accuracy of
//! the counted charge, and the rested voltage of the morning keeps its information about the capacity; a day's unseen use
//! is found at the first reading, not after the hours that a confident filter needs. A single wide Gaussian would lose
//! the first, a single narrow one the second.
//!
//! Until that voltage arrives, the published deviation is that of the second hypothesis.
//!
//! A gap (sleep, a hole in a log) has the same hypotheses. A load next to it may have continued or ended, neither more
//! likely. At rest on both sides only a charger may have come: rarely, since a bus in use wakes its listeners, and the more
//! likely the longer the gap. Without the second hypothesis, charge that is not on record is learned as capacity.
//!
//! [`Memory`]: super::memory::Memory

use super::bank::SingleCell;
use super::gaussian::Gaussian;
use super::memory::Memory;
use super::state_vector::{BRANCHES, LOG_RESISTANCE, square, widened};
use super::step::{CellStep, Update};
use crate::cell::{CellModel, EstimatorConfig};

/// Updates with the first reading after a downtime. It says nothing of the sensor's offset and the slowest branch: their evidence
/// stays.
pub(super) fn update_after_downtime(
    kernel: &mut SingleCell,
    (x, memory): (&mut Gaussian, &Memory),
    (model, config): (&CellModel, &EstimatorConfig),
    step: &CellStep,
) -> Option<Update> {
    let mut update = |x: &mut Gaussian| kernel.update((x, &mut { *memory }), step);
    let (before_soc, ratio) = (x.mean[0], libm::exp(x.mean[LOG_RESISTANCE]));
    let mut used = used_prior(x, config, memory.downtime_std);
    // The load of the reading may have begun at any time: its branches are anywhere between relaxed and settled.
    let current_a = step.current_a.unwrap_or(0.0);
    let temperature = model.temperature_position(step.temperature_c.unwrap_or(step.ambient_c));
    let position = model.grid_position_at(&temperature, before_soc);
    let mut drop_v = current_a * model.r0_ohm(&position) * ratio;
    for i in BRANCHES..used.states {
        let most_v = current_a * ratio * model.branch_r_ohm(i - BRANCHES, &position);
        used.mean[i] = 0.5 * most_v;
        used.covariance[(i, i)] += square(most_v) / 12.0;
        drop_v += if i + 1 < used.states { used.mean[i] } else { memory.slow_branch.ratio * used.mean[i] };
    }
    // The odds are those of a prior that wide; the copy is discarded.
    let wide = update(&mut used.clone())?;
    let reach = 3.0_f64.sqrt() * memory.downtime_std;
    let soc = model.soc_of_aged_ocv(&temperature, memory.curve.mean, step.voltage_v + drop_v);
    // Every SOC within reach is as likely: the prior is centred where the voltage is, so that the curve is linear there.
    used.mean[0] = soc.clamp(before_soc - reach, before_soc + reach);
    let by_used = update(&mut used)?;
    let by_left_alone = update(x)?;
    let log_likelihood =
        |u: &Update| -0.5 * (libm::log(u.innovation_variance) + square(u.innovation) / u.innovation_variance);
    let odds = libm::exp(log_likelihood(&by_left_alone) - log_likelihood(&wide)).max(f64::MIN_POSITIVE);
    let weight = memory.used_prior / (memory.used_prior + (1.0 - memory.used_prior) * odds);
    x.merge(&used, weight);
    Some(if weight > 0.5 { by_used } else { by_left_alone })
}

/// Prior of a cell that was used: SOC anywhere within reach and uncorrelated, branches as at a start.
fn used_prior(x: &Gaussian, config: &EstimatorConfig, downtime_std: f64) -> Gaussian {
    let mut used = *x;
    used.covariance[(0, 0)] = widened(x.marginal(0).variance, square(downtime_std));
    used.isolate(0);
    for i in BRANCHES..used.states {
        used.isolate(i);
        used.covariance[(i, i)] += square(config.initial.branch_std_v);
    }
    used
}
