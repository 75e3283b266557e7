//! Use of a cell while nothing is measured: the program is stopped, the bus sleeps, the log has a gap.
//!
//! In: the possible change of the SOC in the downtime, fraction, and the first voltage after it, V. Out: the updated filter;
//! `None` if the update cannot be computed.
//!
//! Deviation 6: two hypotheses cover downtime. Most likely the cell rested: the SOC only lost the self-discharge, and all
//! correlations still hold. Otherwise the cell was used or charged: the SOC is anywhere within the charge that can be moved in
//! that time, and the branches are as uncertain as at a start. The first voltage under a known current decides. It updates both
//! hypotheses; they are weighted by their likelihoods (Bayes' rule, prior of [`Memory`]) and merged into one Gaussian with their
//! common mean and covariance. Effect: after a night without use, the counted charge stays accurate and the rested voltage keeps
//! its information about the capacity. Unseen use is found at the first reading, while a confident filter needs hours. A single
//! wide Gaussian would lose the first advantage, a single narrow one the second.
//!
//! Until that voltage arrives, the published standard deviation belongs to the second hypothesis.
//!
//! A gap (sleep, a hole in a log) has the same hypotheses. A load before or after the gap may have continued or ended, with equal
//! probability. After rest on both sides, only a charger may have been connected: rarely, because a bus in use wakes its
//! listeners, and more likely in a longer gap. Without the second hypothesis, unrecorded charge would be learned as capacity.
//!
//! [`Memory`]: super::memory::Memory

use super::bank::SingleCell;
use super::gaussian::Gaussian;
use super::memory::Memory;
use super::state_vector::{BRANCHES, LOG_RESISTANCE, square, widened};
use super::step::{CellStep, Update};
use crate::cell::{CellModel, EstimatorConfig};

/// Updates with the first reading after a downtime. The reading does not count as evidence about the sensor's offset and the slowest
/// branch.
pub(super) fn update_after_downtime(
    kernel: &mut SingleCell,
    (x, memory): (&mut Gaussian, &Memory),
    (model, config): (&CellModel, &EstimatorConfig),
    step: &CellStep,
) -> Option<Update> {
    let mut update = |x: &mut Gaussian| kernel.update((x, &mut { *memory }), step);
    let (before_soc, ratio) = (x.mean[0], libm::exp(x.mean[LOG_RESISTANCE]));
    let mut used = used_prior(x, config, memory.downtime_std);
    // The present load may have started at any time, so the branches are anywhere between relaxed and settled.
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
    // This wide prior gives the odds; its updated copy is discarded.
    let wide = update(&mut used.clone())?;
    let reach = 3.0_f64.sqrt() * memory.downtime_std;
    let soc = model.soc_of_aged_ocv(&temperature, memory.curve.mean, step.voltage_v + drop_v);
    // All SOCs within reach are equally likely. Centring the prior at the voltage makes the curve linear there.
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

/// Prior of a used cell: SOC anywhere within reach and uncorrelated, branches as at a start.
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
