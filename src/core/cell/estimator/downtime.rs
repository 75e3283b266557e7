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

use nalgebra::SMatrix;

use super::filter::update;
use super::noise::VoltageReading;
use super::state_vector::{BRANCHES, LOG_RESISTANCE, square, widened};
use crate::cell::{CellModel, EstimatorConfig};
use crate::filter::{FilterError, Gaussian, Update};

/// Updates with the first reading after a downtime.
pub(super) fn update_after_downtime<const N: usize>(
    x: &mut Gaussian<N>,
    model: &CellModel,
    config: &EstimatorConfig,
    reading: &VoltageReading,
    (downtime_std, used_probability): (f64, f64),
) -> Result<Update, FilterError> {
    let before_soc = x.mean[0];
    let mut used = used_prior(x, config, downtime_std);
    // The load of the reading may have begun at any time: its branches are anywhere between relaxed and settled.
    let position = model.grid_position_at(&reading.temperature, before_soc);
    let settled_v = reading.current_a * libm::exp(x.mean[LOG_RESISTANCE]);
    for i in BRANCHES..N {
        let most_v = settled_v * model.branch_r_ohm(i - BRANCHES, &position);
        used.mean[i] = 0.5 * most_v;
        used.covariance[(i, i)] += square(most_v) / 12.0;
    }
    // The odds are those of a prior that wide; the copy is discarded.
    let (wide, _) = update(&mut used.clone(), model, config, reading)?;
    let drop_v = reading.current_a * model.r0_ohm(&position) * libm::exp(x.mean[LOG_RESISTANCE])
        + reading.branches_v(&used.mean);
    let reach = 3.0_f64.sqrt() * downtime_std;
    let soc = model.soc_of_aged_ocv(&reading.temperature, reading.curve.mean, reading.voltage_v + drop_v);
    // Every SOC within reach is as likely: the prior is centred where the voltage is, so that the curve is linear there.
    used.mean[0] = soc.clamp(before_soc - reach, before_soc + reach);
    let (by_used, _) = update(&mut used, model, config, reading)?;
    let (by_left_alone, _) = update(x, model, config, reading)?;
    let log_likelihood =
        |u: &Update| -0.5 * (libm::log(u.innovation_variance) + square(u.innovation) / u.innovation_variance);
    let odds = libm::exp(log_likelihood(&by_left_alone) - log_likelihood(&wide)).max(f64::MIN_POSITIVE);
    let weight = used_probability / (used_probability + (1.0 - used_probability) * odds);
    merge(x, &used, weight);
    Ok(if weight > 0.5 { by_used } else { by_left_alone })
}

/// Prior of a cell that was used: SOC anywhere within reach and uncorrelated, branches as at a start.
fn used_prior<const N: usize>(x: &Gaussian<N>, config: &EstimatorConfig, downtime_std: f64) -> Gaussian<N> {
    let mut used = *x;
    let soc_variance = widened(x.marginal(0).variance, square(downtime_std));
    for i in std::iter::once(0).chain(BRANCHES..N) {
        for j in 0..N {
            if i != j {
                (used.covariance[(i, j)], used.covariance[(j, i)]) = (0.0, 0.0);
            }
        }
    }
    used.covariance[(0, 0)] = soc_variance;
    used.by_constant.row_mut(0).fill(0.0);
    for i in BRANCHES..N {
        used.by_constant.row_mut(i).fill(0.0);
        used.covariance[(i, i)] += square(config.initial.branch_std_v);
    }
    used
}

/// Mean and covariance of the mixture of two Gaussians, the second with `weight`. The difference of their constant errors is
/// left out: it is small against that of their means.
fn merge<const N: usize>(x: &mut Gaussian<N>, other: &Gaussian<N>, weight: f64) {
    let apart = other.mean - x.mean;
    let between: SMatrix<f64, N, N> = apart * apart.transpose();
    x.covariance = x.covariance * (1.0 - weight) + other.covariance * weight + between * (weight * (1.0 - weight));
    x.by_constant = x.by_constant * (1.0 - weight) + other.by_constant * weight;
    x.mean += apart * weight;
}
