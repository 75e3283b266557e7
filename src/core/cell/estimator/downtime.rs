//! What may have happened to a cell while the program did not run.
//!
//! Deviation 6: over such time two things may be true. Most likely the cell was left alone: its SOC is
//! the one before, less self-discharge, and all that was learned of it still hangs together. Or it was used or
//! charged: then its SOC is anywhere within what could be moved in that time, and its branches are as uncertain as at a start.
//! Which it was the first voltage under a known current says. Both beliefs take it in; they are weighed by how well each
//! foresaw it (Bayes' rule, prior [`USED_PRIOR`]) and merged to one with their common mean and covariance.
//! Effect: a night off without use keeps the accuracy of the counted charge, and the rested voltage of the morning still
//! says what it says of the capacity; a day's use behind our back is found at the first reading, and not after the hours
//! which a filter that is sure takes to be convinced. A single wide belief would lose the first, a single narrow one the second.
//!
//! Until that voltage has come the deviation told is that of the second case.
//!
//! Time asleep is another matter: a bus that is used wakes who listens to it. There the cells were left alone (self-discharge
//! and `gap_noise_per_sqrt_s`), and a load beside the gap may have gone on in it.

use nalgebra::SMatrix;

use super::noise::Reading;
use super::{BRANCHES, CellEstimator, LOG_RESISTANCE, Memory, square, update, widened};
use crate::cell::config::EstimatorConfig;
use crate::cell::model::CellModel;
use crate::filter::{FilterError, Gaussian, Update};

/// How likely it is, before the voltage has spoken, that the cell was used while nobody looked.
const USED_PRIOR: f64 = 0.2;

/// Below this deviation of the SOC nothing happened that is worth a second look, fraction.
const NEGLIGIBLE_STD: f64 = 0.002;

impl CellEstimator {
    /// Nobody listened: until a voltage has been taken in, the SOC is the one from before.
    pub fn note_asleep(&mut self) {
        self.memory.is_unseen = self.filter.is_some();
    }

    /// The program did not run for `away_s`: what may have been moved in that time, in either direction.
    pub fn note_away(&mut self, config: &EstimatorConfig, away_s: f64) {
        let most = config.away_use_per_s * away_s;
        self.memory.away_std = (self.memory.away_std + most / 3.0_f64.sqrt()).min(1.0);
    }

    /// Whether the SOC is still the one from before time away: no voltage has been taken in since.
    pub fn is_of_before(&self) -> bool {
        self.memory.is_unseen || self.memory.away_std_if_any().is_some()
    }
}

impl Memory {
    /// Standard deviation of what may have been moved, until a voltage has told; `None` when it is negligible.
    pub(super) fn away_std_if_any(&self) -> Option<f64> {
        (self.away_std > NEGLIGIBLE_STD).then_some(self.away_std)
    }
}

/// Takes in the first reading after time away.
pub(super) fn update_after_away<const N: usize>(
    x: &mut Gaussian<N>,
    model: &CellModel,
    config: &EstimatorConfig,
    reading: &Reading,
    away_std: f64,
) -> Result<Update, FilterError> {
    let before_soc = x.mean[0];
    let mut used = used(x, config, away_std);
    // The voltage as it is foreseen by a belief that wide, without moving anything.
    let foreseen = update(&mut used.clone(), model, config, reading)?.innovation_variance;
    let drop_v =
        reading.current_a * model.r0_ohm(&model.place_in(&reading.row, before_soc)) * libm::exp(x.mean[LOG_RESISTANCE]);
    let reach = 3.0_f64.sqrt() * away_std;
    let soc = model.soc_of_ocv_in(&reading.row, reading.voltage_v + drop_v);
    // Everything within reach is as likely: the belief is taken to where the voltage is, so that the curve is straight there.
    used.mean[0] = soc.clamp(before_soc - reach, before_soc + reach);
    let by_used = update(&mut used, model, config, reading)?;
    let by_left_alone = update(x, model, config, reading)?;
    let log_likelihood = |variance: f64| -0.5 * (libm::log(variance) + square(by_left_alone.innovation) / variance);
    let odds = libm::exp(log_likelihood(by_left_alone.innovation_variance) - log_likelihood(foreseen));
    let weight = USED_PRIOR / (USED_PRIOR + (1.0 - USED_PRIOR) * odds);
    merge(x, &used, weight);
    Ok(if weight > 0.5 { by_used } else { by_left_alone })
}

/// The belief for a cell that was used: SOC anywhere within reach and tied to nothing, branches as at a start.
fn used<const N: usize>(x: &Gaussian<N>, config: &EstimatorConfig, away_std: f64) -> Gaussian<N> {
    let mut used = *x;
    let soc_variance = widened(x.covariance[(0, 0)], square(away_std));
    for i in std::iter::once(0).chain(BRANCHES..N) {
        for j in 0..N {
            if i != j {
                (used.covariance[(i, j)], used.covariance[(j, i)]) = (0.0, 0.0);
            }
        }
    }
    used.covariance[(0, 0)] = soc_variance;
    for i in BRANCHES..N {
        used.covariance[(i, i)] += square(config.initial_branch_std_v);
    }
    used
}

/// Mean and covariance of two beliefs, the second with `weight`.
fn merge<const N: usize>(x: &mut Gaussian<N>, other: &Gaussian<N>, weight: f64) {
    let apart = other.mean - x.mean;
    let between: SMatrix<f64, N, N> = apart * apart.transpose();
    x.covariance = x.covariance * (1.0 - weight) + other.covariance * weight + between * (weight * (1.0 - weight));
    x.mean += apart * weight;
}
