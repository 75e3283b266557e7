//! Cell model of this pack's own cells. It starts from the model of the label (chemistry, rated capacity, voltage
//! limits) and is corrected by the vehicle's readings.
//!
//! In: a [`Label`] and the rows (averaged readings) of a [`Notebook`](super::notebook::Notebook). Out: an [`OwnModel`],
//! from which the [`CellModel`] of the filters is made. In SOC and temperature ranges without rows, the label's model
//! and its uncertainty remain.

pub mod fit;
pub mod task;

use serde::{Deserialize, Serialize};

use super::chemistry::{CurveOfCells, FACTOR_SOC, Label, LabelPrior, ResistanceFactors, TEMPERATURE_NODES};
use super::config::EstimatorConfig;
use super::model::{CellModel, ModelSpread};
use super::notebook::Row;
use crate::filter::{ScalarGaussian, median};
use crate::quantity::InvalidState;

/// Number of SOC breakpoints of a fitted model.
pub const SOC_NODES: usize = 21;

/// A fitted model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OwnModel {
    /// Open-circuit curve (V), rising.
    pub curve_v: [f64; SOC_NODES],
    /// Two independent shapes (modes) of the curve's error: the voltage at each node that one standard deviation adds
    /// (V).
    pub modes_v: [[f64; SOC_NODES]; 2],
    /// Standard deviation of the part of the curve's error that the modes do not explain (V).
    pub rest_v: [f64; SOC_NODES],
    /// Resistances relative to the resistances of the label's model.
    pub factors: ResistanceFactors,
    /// Standard deviation of ln(voltage drop) at each temperature breakpoint of the model.
    pub drop_std: [f64; TEMPERATURE_NODES],
    /// Sag of the curve at 0 degrees C relative to 25 degrees C (V).
    pub cold_sag_v: ScalarGaussian,
    /// Capacity (Ah).
    pub capacity: ScalarGaussian,
    /// Root mean square of the predicted minus the measured voltages of the rows (V).
    pub residual_v: f64,
}

impl OwnModel {
    /// The cell model for the filters; `None` if the label has no model.
    pub fn cell_model(&self, label: &Label) -> Option<CellModel> {
        let name = format!("{} {} Ah (learned)", label.chemistry.name(), label.rated_ah);
        self.cell_model_with(label, self.spread_within_pack(), name)
    }

    /// Cell model with the given spread and name; `None` if the label has no model.
    pub(super) fn cell_model_with(&self, label: &Label, spread: ModelSpread, name: String) -> Option<CellModel> {
        let curve = CurveOfCells {
            mean_v: self.curve_v.to_vec(),
            modes_v: self.modes_v.each_ref().map(|mode_v| mode_v.to_vec()),
            rest_v: self.rest_v.to_vec(),
            cold_sag_v: self.cold_sag_v,
            electrodes: label.curve()?.electrodes,
        };
        let mut model = label.model_of(self.capacity.mean, &curve, &self.factors, &self.drop_std, spread);
        model.name = name;
        Some(model)
    }

    /// Expected differences between the cells of this pack.
    pub(super) fn spread_within_pack(&self) -> ModelSpread {
        ModelSpread {
            curve_v: median(self.rest_v.iter().copied()).unwrap_or_default(),
            // The cells of one pack are similar.
            log_resistance: 0.1,
            slow_branch: 0.2,
            capacity: self.capacity.std() / self.capacity.mean,
            // The voltage drop has an error of 10 % that persists for 100 s, even with fitted resistances.
            drop_sqrt_s: 1.0,
        }
    }

    /// The estimator's settings for the learned `model`, derived from the settings for the label's model.
    pub fn estimator_config(&self, base: &EstimatorConfig, label: &CellModel, model: &CellModel) -> EstimatorConfig {
        let (Some(old), Some(new)) = (label.spread, model.spread) else { return *base };
        // Values of `base` that differ from the label's values come from the configuration and are kept.
        let instead = |value: f64, old: f64, new: f64| if value == old { new } else { value };
        let parts = |value: f64, old: f64, new: f64| (value * value - old * old).max(0.0).sqrt().hypot(new);
        let mut config = *base;
        config.initial.soc = None;
        config.initial.capacity_ah = self.capacity.mean;
        config.initial.capacity_std_ah = self.capacity.std();
        config.initial.curve = self.capacity;
        config.initial.log_resistance_std =
            instead(base.initial.log_resistance_std, old.log_resistance, new.log_resistance);
        config.voltage.drop_error_sqrt_s = parts(base.voltage.drop_error_sqrt_s, old.drop_sqrt_s, new.drop_sqrt_s);
        config.voltage.load_error_sqrt_s = parts(base.voltage.load_error_sqrt_s, old.drop_sqrt_s, new.drop_sqrt_s);
        config.sensor.voltage_offset_v = parts(base.sensor.voltage_offset_v, old.curve_v, new.curve_v);
        config.sensor.slow_branch = instead(base.sensor.slow_branch, old.slow_branch, new.slow_branch);
        config
    }

    /// Whether the uncertainty is small: the standard deviation of the capacity is below 3 %.
    pub fn is_settled(&self) -> bool {
        self.capacity.std() < 0.03 * self.capacity.mean
    }

    /// Checks the numbers of a stored model.
    ///
    /// # Errors
    /// The first impossible number.
    pub fn check(&self) -> Result<(), InvalidState> {
        let rises = self.curve_v.windows(2).all(|pair| pair[0] < pair[1]);
        InvalidState::unless(rises, "the curve of a learned model", self.curve_v[0], "rising over SOC")?;
        let factors = self.factors.ln.iter().flatten().chain(&self.factors.by_temperature);
        for &factor in factors {
            InvalidState::unless(
                factor.abs() <= 5.0,
                "a resistance of a learned model",
                factor,
                "-5 to 5 (ln of a ratio)",
            )?;
        }
        let numbers = self.curve_v.iter().chain(self.modes_v.iter().flatten());
        InvalidState::unless_numbers("the curve of a learned model", numbers.copied())?;
        let naturals = self.rest_v.iter().chain(&self.drop_std).chain([&self.residual_v]);
        InvalidState::unless_naturals("an error of a learned model", naturals.copied())?;
        InvalidState::unless_numbers("the curve's sag in the cold of a learned model", [self.cold_sag_v.mean])?;
        InvalidState::unless_positive("the variance of that sag", self.cold_sag_v.variance)?;
        InvalidState::unless_capacity("the capacity of a learned model", self.capacity.mean)?;
        InvalidState::unless_positive("the variance of the capacity of a learned model", self.capacity.variance)
    }
}

/// Returns the cost of the rows under a model: minus the logarithm of the rows' probability density. The model is
/// `own`, or the label's model if `own` is `None`. Returns `None` if there are no rows.
pub fn rows_cost(prior: &LabelPrior, own: Option<&OwnModel>, rows: &[Row]) -> Option<f64> {
    fit::rows_cost(prior, own, rows)
}

/// Number of SOC nodes of the resistance factors.
pub const FACTOR_NODES: usize = FACTOR_SOC.len();
