//! Handles the possible use of a cell while nothing is measured: the program is stopped, the bus sleeps, or the log has
//! a gap.
//!
//! In: the possible change of the SOC in the downtime (fraction), and the first voltage after the downtime (V). Out:
//! the updated filter; `None` if the update cannot be computed.
//!
//! Deviation 6 (see [`super`]): a downtime is described by two hypotheses.
//! * The cell rested. This is usually more likely. The SOC has only fallen by the self-discharge, and all correlations
//!   still hold.
//! * The cell was used or charged. Every SOC that the cell can have reached in that time is possible, and the voltages
//!   of the RC branches are as uncertain as at a start.
//!
//! The first voltage with a known current updates both hypotheses. They are weighted by their likelihoods (Bayes' rule,
//! prior in [`Memory`]) and merged into one Gaussian with their common mean and covariance. Until then, the standard
//! deviation of the second hypothesis is published.
//!
//! Effect: after a night without use, the counted charge stays accurate, and the voltage at rest still gives
//! information about the capacity. If the cell was used meanwhile, the first reading shows it. With one hypothesis, a
//! narrow Gaussian would need hours to find the use, and a wide Gaussian would lose the counted charge.
//!
//! A gap (sleep, a hole in a log) is described in the same way. If a load flowed before or after the gap, it continued
//! during the gap with a probability of one half. If the cell rested before and after the gap, a charger may have been
//! connected in the gap. A charger is unlikely, because it would use the bus and so wake the daemon. In a longer gap,
//! it is more likely. Without the second hypothesis, charge that was not recorded would be learned as a change of
//! capacity.
//!
//! [`Memory`]: super::memory::Memory

use super::bank::SingleCell;
use super::gaussian::Gaussian;
use super::memory::Memory;
use super::state_vector::{BRANCHES, LOG_RESISTANCE, square, widened};
use super::step::{CellStep, Update};
use super::voltage_reach::{FAR, FLAT};
use crate::cell::{CellModel, EstimatorConfig};

/// Updates the filter with the first reading after a downtime. This reading does not count as evidence about the
/// current sensor's offset or the slowest RC branch.
pub(super) fn update_after_downtime(
    kernel: &mut SingleCell,
    (x, memory): (&mut Gaussian, &Memory),
    (model, config): (&CellModel, &EstimatorConfig),
    step: &CellStep,
) -> Option<Update> {
    let mut update = |x: &mut Gaussian| kernel.update((x, &mut { *memory }), step);
    let (before_soc, ratio) = (x.mean[0], libm::exp(x.mean[LOG_RESISTANCE]));
    let mut used = used_prior(x, config, memory.downtime_std);
    // The present load may have started at any time, so each branch is anywhere between relaxed and settled.
    let current_a = step.current_a.unwrap_or(0.0);
    let temperature = model.temperature_position(step.temperature_c.unwrap_or(step.ambient_c));
    let position = model.grid_position_at(&temperature, before_soc);
    let (mut drop_v, mut branch_variance) = (current_a * model.r0_ohm(&position) * ratio, 0.0);
    for i in BRANCHES..used.states {
        let most_v = current_a * ratio * model.branch_r_ohm(i - BRANCHES, &position);
        used.mean[i] = 0.5 * most_v;
        used.covariance[(i, i)] += square(most_v) / 12.0;
        branch_variance += used.covariance[(i, i)];
        drop_v += if i + 1 < used.states { used.mean[i] } else { memory.slow_branch.ratio * used.mean[i] };
    }
    // This wide prior serves only to compute the weights of the hypotheses; its updated copy is discarded.
    let wide = update(&mut used.clone())?;
    let reach = 3.0_f64.sqrt() * memory.downtime_std;
    let soc = model.soc_of_aged_ocv(&temperature, memory.curve.mean, step.voltage_v + drop_v);
    // All SOCs within `reach` are equally likely, so the mean may be moved. It is moved to the SOC that the voltage
    // gives, because the update linearises the curve at the mean.
    let within_reach = |soc: f64| soc.clamp(before_soc - reach, before_soc + reach);
    used.mean[0] = within_reach(soc);
    let by_used = update(&mut used)?;
    // On a flat part of the curve, a small voltage error leads to a distant SOC, so the slope at one SOC is not enough.
    let voltage_variance = square(config.sensor.voltage_offset_v)
        + square(config.gate.model_error_v)
        + branch_variance
        + square(drop_v) * x.marginal(LOG_RESISTANCE).variance;
    let error_v = FAR * voltage_variance.sqrt();
    let soc_at = |voltage_v: f64| within_reach(model.soc_of_aged_ocv(&temperature, memory.curve.mean, voltage_v));
    let far = [soc_at(step.voltage_v + drop_v - error_v), soc_at(step.voltage_v + drop_v + error_v)];
    let std = far.map(|far| (far - used.mean[0]).abs() / FAR).into_iter().fold(0.0, f64::max);
    let slope_v = model.ocv_slope_v(&model.grid_position_at(&temperature, used.mean[0]), memory.curve.mean);
    if std * slope_v > FLAT * voltage_variance.sqrt() {
        used.covariance[(0, 0)] = used.covariance[(0, 0)].max(square(std));
    }
    let by_left_alone = update(x)?;
    let log_likelihood =
        |u: &Update| -0.5 * (libm::log(u.innovation_variance) + square(u.innovation) / u.innovation_variance);
    let odds = libm::exp(log_likelihood(&by_left_alone) - log_likelihood(&wide)).max(f64::MIN_POSITIVE);
    let weight = memory.used_prior / (memory.used_prior + (1.0 - memory.used_prior) * odds);
    x.merge(&used, weight);
    Some(if weight > 0.5 { by_used } else { by_left_alone })
}

/// Prior of the second hypothesis: the SOC is widened by the possible use and has no correlations, and the branches are
/// as uncertain as at a start.
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
