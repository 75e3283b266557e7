//! Combines the models that many vehicles have learned into a prior for the next vehicle. All vehicles have cells with
//! the same label (chemistry, rated capacity, voltage limits).
//!
//! In: one [`OwnModel`] per vehicle. Out: a [`FleetPrior`], which replaces the values that are typical of the
//! chemistry.
//!
//! Each quantity (a point of the curve, a resistance, the capacity) varies between cells with an unknown variance P. A
//! vehicle's fit starts from the label's variance L and gives a mean and a posterior variance V. The fit pulls the mean
//! toward the label's mean, so the means vary less than the cells. The missing variance is V^2 / L (Joseph form of the
//! update). P is estimated as the variance of the means plus V^2 / L.
//!
//! For the open-circuit curve, L is a covariance matrix over the SOC breakpoints. For each vehicle, row and column of a
//! breakpoint are multiplied by the ratio V / L at this breakpoint. Because few vehicles say little about P, the
//! label's covariance counts as [`LABEL_VEHICLES`] more vehicles.

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use super::chemistry::curve::{CurvePrior, information};
use super::chemistry::{Label, LabelPrior, ResistanceFactors, SOC, TEMPERATURE_C, TEMPERATURE_NODES, usual_cold_sag_v};
use super::model::{CellModel, ModelSpread};
use super::own_model::{OwnModel, SOC_NODES};
use crate::filter::ScalarGaussian;
use crate::quantity::InvalidState;

/// Weight of the label's variance, as a number of vehicles.
const LABEL_VEHICLES: f64 = 2.0;

/// Prior for the cells of one label, learned by other vehicles.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FleetPrior {
    /// The label.
    pub label: Label,
    /// Number of vehicles.
    pub vehicles: u32,
    /// The mean cell. Its standard deviations describe the differences between cells, not the errors of a fit.
    pub mean: OwnModel,
    /// Covariance of the open-circuit curve between cells (V^2), at the SOC breakpoints of the model.
    pub curve_covariance_v2: Vec<Vec<f64>>,
    /// Spread of the other properties between cells.
    pub spread: ModelSpread,
}

impl FleetPrior {
    /// Combines the models of the vehicles. Returns `None` without vehicles, or if the label has no model.
    pub fn new(label: &Label, vehicles: &[OwnModel]) -> Option<Self> {
        if vehicles.is_empty() {
            return None;
        }
        let prior = label.prior()?;
        let label_spread = prior.model.spread?;
        let models: Vec<CellModel> = vehicles.iter().map(|own| own.cell_model(label)).collect::<Option<_>>()?;
        let curve = Self::curve(&prior.curve, vehicles)?;
        let (modes_v, rest_v) = curve.modes_v();
        let scalar = |label_std: f64, of: &dyn Fn(&OwnModel) -> ScalarGaussian| {
            combined(label_std * label_std, &vehicles.iter().map(of).collect::<Vec<_>>())
        };
        let drop = |t: usize| {
            let ln_ohm = |model: &CellModel| libm::log(model.settled_ohm(&model.grid_position(0.5, TEMPERATURE_C[t])));
            let each = models.iter().zip(vehicles).map(|(model, own)| {
                ScalarGaussian::from_std(ln_ohm(model), own.drop_std[t].min(label_spread.log_resistance))
            });
            let label_variance = label_spread.log_resistance * label_spread.log_resistance;
            combined(label_variance, &each.collect::<Vec<_>>()).variance
        };
        let drop_variance: [f64; TEMPERATURE_NODES] = std::array::from_fn(drop);
        let warm = TEMPERATURE_C.iter().position(|&t| t >= 25.0)?;
        let capacity = scalar(label_spread.capacity * label.rated_ah, &|own| own.capacity);
        let mean_of = |of: &dyn Fn(&OwnModel) -> f64| vehicles.iter().map(of).sum::<f64>() / vehicles.len() as f64;
        let array = |values: &[f64]| std::array::from_fn(|s| values[s]);
        let mean = OwnModel {
            curve_v: array(&curve.mean_v),
            modes_v: modes_v.each_ref().map(|mode_v| array(mode_v)),
            rest_v: array(&rest_v),
            factors: ResistanceFactors {
                ln: std::array::from_fn(|j| std::array::from_fn(|n| mean_of(&|own| own.factors.ln[j][n]))),
                by_temperature: std::array::from_fn(|j| mean_of(&|own| own.factors.by_temperature[j])),
            },
            drop_std: drop_variance.map(|variance| (variance - drop_variance[warm]).max(0.0).sqrt()),
            cold_sag_v: scalar(usual_cold_sag_v().std(), &|own| own.cold_sag_v),
            capacity,
            residual_v: mean_of(&|own| own.residual_v),
        };
        let own = mean.spread_within_pack();
        // The other spreads shrink by the same factor as the spread of the voltage drop.
        let share = (drop_variance[warm].sqrt() / label_spread.log_resistance).min(1.0);
        let spread = ModelSpread {
            log_resistance: drop_variance[warm].sqrt().max(own.log_resistance),
            slow_branch: own.slow_branch.max(share * label_spread.slow_branch),
            drop_sqrt_s: own.drop_sqrt_s.max(share * label_spread.drop_sqrt_s),
            ..own
        };
        let rows = curve.covariance.row_iter().map(|row| row.iter().copied().collect()).collect();
        let vehicles = u32::try_from(vehicles.len()).unwrap_or(u32::MAX);
        Some(Self { label: *label, vehicles, mean, curve_covariance_v2: rows, spread })
    }

    fn curve(label: &CurvePrior, vehicles: &[OwnModel]) -> Option<CurvePrior> {
        let count = vehicles.len() as f64;
        let mut covariance = LABEL_VEHICLES * &label.covariance;
        let mean_v: Vec<f64> =
            (0..SOC_NODES).map(|s| vehicles.iter().map(|own| own.curve_v[s]).sum::<f64>() / count).collect();
        for own in vehicles {
            let share = |s: usize| {
                let modes: f64 = own.modes_v.iter().map(|mode_v| mode_v[s] * mode_v[s]).sum();
                ((modes + own.rest_v[s] * own.rest_v[s]) / label.covariance[(s, s)]).min(1.0)
            };
            let shares: [f64; SOC_NODES] = std::array::from_fn(share);
            covariance += DMatrix::from_fn(SOC_NODES, SOC_NODES, |a, b| {
                let unseen = shares[a] * label.covariance[(a, b)] * shares[b];
                unseen + (own.curve_v[a] - mean_v[a]) * (own.curve_v[b] - mean_v[b])
            });
        }
        // The mean with the transpose removes asymmetry from rounding.
        let covariance = (&covariance + covariance.transpose()) / (2.0 * (count + LABEL_VEHICLES));
        Some(CurvePrior { soc: SOC.to_vec(), mean_v, covariance, electrodes: label.electrodes })
    }

    /// Prior for the next cell of this label; `None` if the label has no model.
    pub fn prior(&self) -> Option<LabelPrior> {
        let of_label = self.label.prior()?;
        let capacity = self.mean.capacity;
        Some(LabelPrior {
            curve: CurvePrior { covariance: self.covariance(), ..of_label.curve },
            expected: Some(self.mean.clone()),
            log_resistance_ratio: (self.spread.log_resistance / of_label.model.spread?.log_resistance).min(1.0),
            cold_sag_std_v: self.mean.cold_sag_v.std(),
            capacity_std: capacity.std() / capacity.mean,
            ..of_label
        })
    }

    fn covariance(&self) -> DMatrix<f64> {
        DMatrix::from_fn(SOC_NODES, SOC_NODES, |a, b| self.curve_covariance_v2[a][b])
    }

    /// The cell model with which a vehicle of this label starts; `None` if the label has no model.
    pub fn cell_model(&self) -> Option<CellModel> {
        let Label { chemistry, rated_ah, .. } = self.label;
        let name = format!("{} {rated_ah} Ah (prior of {} vehicles)", chemistry.name(), self.vehicles);
        self.mean.cell_model_with(&self.label, self.spread, name)
    }

    /// Checks the numbers of a stored prior.
    ///
    /// # Errors
    /// The first impossible number.
    pub fn check(&self) -> Result<(), InvalidState> {
        self.mean.check()?;
        InvalidState::unless(self.vehicles > 0, "the vehicles of a prior", f64::from(self.vehicles), "at least 1")?;
        let Label { rated_ah, voltage_min_v, voltage_max_v, .. } = self.label;
        let capacity_ah = self.mean.capacity.mean;
        let is_near = (0.4 * rated_ah..=1.4 * rated_ah).contains(&capacity_ah);
        InvalidState::unless(is_near, "the capacity of a prior", capacity_ah, "0.4 to 1.4 of the rated capacity")?;
        let mut ends_v = [self.mean.curve_v[0], self.mean.curve_v[SOC_NODES - 1]].into_iter();
        let beyond = ends_v.find(|v| !(voltage_min_v - 0.5..=voltage_max_v + 0.5).contains(v));
        let what = "the curve of a prior";
        InvalidState::unless(
            beyond.is_none(),
            what,
            beyond.unwrap_or_default(),
            "within 0.5 V of the label's voltages",
        )?;
        let rows = &self.curve_covariance_v2;
        let is_square = rows.len() == SOC_NODES && rows.iter().all(|row| row.len() == SOC_NODES);
        let what = "the number of rows of the curve's covariance";
        InvalidState::unless(is_square, what, rows.len() as f64, "21 rows of 21 numbers")?;
        let variances = self.covariance();
        let is_valid = variances == variances.transpose() && information(&variances).is_some();
        let what = "the covariance of the curve";
        InvalidState::unless(is_valid, what, variances[(0, 0)], "symmetric and positive definite")?;
        let ModelSpread { curve_v, log_resistance, slow_branch, capacity, drop_sqrt_s } = self.spread;
        let spreads = [curve_v, log_resistance, slow_branch, capacity, drop_sqrt_s];
        spreads.into_iter().try_for_each(|spread| InvalidState::unless_positive("a spread between cells", spread))
    }
}

/// Mean and variance of a quantity between cells, from the vehicles' posteriors and the label's variance.
fn combined(label_variance: f64, vehicles: &[ScalarGaussian]) -> ScalarGaussian {
    let count = vehicles.len() as f64;
    let mean = vehicles.iter().map(|one| one.mean).sum::<f64>() / count;
    let each = |one: &ScalarGaussian| {
        let (off, unseen) = (one.mean - mean, one.variance.min(label_variance));
        off * off + unseen * unseen / label_variance
    };
    let sum: f64 = vehicles.iter().map(each).sum();
    ScalarGaussian { mean, variance: (sum + LABEL_VEHICLES * label_variance) / (count + LABEL_VEHICLES) }
}

#[cfg(test)]
mod tests;
