//! Predicts the voltages of rows (means of readings over a short time) from the parameters of a fit, with derivatives.
//!
//! In: parameters and rows. Out: voltages (V) and their derivatives. A row's voltage is linear in the curve and in all
//! resistances.

use nalgebra::{DMatrix, DVector};

use crate::cell::chemistry::curve::CurvePrior;
use crate::cell::chemistry::{FACTOR_SOC, LabelPrior, RESISTANCES, SOC, cold_share, usual_cold_sag_v};
use crate::cell::model::{CellModel, arrhenius};
use crate::cell::notebook::Row;
use crate::cell::own_model::{FACTOR_NODES, OwnModel, SOC_NODES};
use crate::filter::interpolation::{between, locate_clamped};

/// Index of the first parameter of each group. The groups are:
/// * from index 0: the curve at the SOC breakpoints, as difference from the curve of the label's model (V);
/// * [`FACTORS`]: ln of the resistance factors over SOC;
/// * [`BY_TEMPERATURE`]: relative deviation of each resistance's activation energy;
/// * [`COLD_SAG`]: how far the curve falls in the cold, as difference from the label's model (V);
/// * [`LOG_CAPACITY`]: ln of the capacity (Ah);
/// * [`OFFSET`]: offset of the current sensor (A, measured minus true);
/// * [`BEGINNINGS`]: SOC at the start of each stretch (a period with a continuously measured current).
pub(super) const FACTORS: usize = SOC_NODES;
pub(super) const BY_TEMPERATURE: usize = FACTORS + RESISTANCES * FACTOR_NODES;
pub(super) const COLD_SAG: usize = BY_TEMPERATURE + RESISTANCES;
pub(super) const LOG_CAPACITY: usize = COLD_SAG + 1;
pub(super) const OFFSET: usize = LOG_CAPACITY + 1;
pub(super) const BEGINNINGS: usize = OFFSET + 1;
/// Number of parameters that change the voltage of a row and do not belong to a resistance.
pub(super) const CURVE_AND_SOC: usize = 6;

pub(super) const BEGINNING: (f64, f64) = (-0.05, 1.05);

pub(super) struct Basis<'a> {
    pub(super) model: &'a CellModel,
    pub(super) curve: &'a CurvePrior,
    /// The model that is expected before the fit; `None` = the label's model.
    expected: Option<&'a OwnModel>,
    pub(super) rows: &'a [Row],
    /// Stretch of each row, counted from 0.
    pub(super) stretch: Vec<usize>,
}

pub(super) struct Prediction {
    pub(super) voltage_v: f64,
    pub(super) drop_v: f64,
    pub(super) soc: f64,
    pub(super) slope_v: f64,
    pub(super) ohm: [f64; RESISTANCES],
    /// Derivatives of ln(resistance) by the three parameters of a resistance: the factors at two SOC nodes, and the
    /// deviation of the activation energy.
    pub(super) by_factor: [f64; 3],
    /// Indices of the parameters that change the voltage: [`CURVE_AND_SOC`] parameters, then three per resistance.
    pub(super) index: Vec<usize>,
    pub(super) slope: Vec<f64>,
}

impl<'a> Basis<'a> {
    pub(super) fn new(prior: &'a LabelPrior, rows: &'a [Row]) -> Self {
        let stretches = rows.chunk_by(|a, b| a.stretch == b.stretch);
        let stretch = stretches.enumerate().flat_map(|(k, rows)| vec![k; rows.len()]).collect();
        Self { model: &prior.model, curve: &prior.curve, expected: prior.expected.as_ref(), rows, stretch }
    }

    pub(super) fn size(&self) -> usize {
        BEGINNINGS + self.stretch.last().map_or(0, |last| last + 1)
    }

    /// The parameters of a model (`None` = the expected model). Each stretch starts at its most likely SOC.
    pub(super) fn parameters(&self, own: Option<&OwnModel>) -> DVector<f64> {
        let own = own.or(self.expected);
        let mut theta = DVector::zeros(self.size());
        theta[LOG_CAPACITY] = libm::log(own.map_or(self.model.rated_capacity_ah, |own| own.capacity.mean));
        if let Some(own) = own {
            (0..SOC_NODES).for_each(|s| theta[s] = own.curve_v[s] - self.curve.mean_v[s]);
            theta[COLD_SAG] = own.cold_sag_v.mean - usual_cold_sag_v().mean;
            for j in 0..RESISTANCES {
                (0..FACTOR_NODES).for_each(|n| theta[FACTORS + j * FACTOR_NODES + n] = own.factors.ln[j][n]);
                theta[BY_TEMPERATURE + j] = own.factors.by_temperature[j];
            }
        }
        for k in BEGINNINGS..self.size() {
            theta[k] = self.likeliest_beginning(&theta, k);
        }
        theta
    }

    pub(super) fn bound(theta: &mut DVector<f64>) {
        for (i, value) in theta.iter_mut().enumerate().skip(FACTORS) {
            let (low, high) = match i {
                ..BY_TEMPERATURE => (-2.5, 2.5),
                BY_TEMPERATURE..COLD_SAG => (-1.5, 1.5),
                COLD_SAG..=OFFSET => continue,
                BEGINNINGS.. => BEGINNING,
            };
            *value = value.clamp(low, high);
        }
    }

    pub(super) fn predict(&self, theta: &DVector<f64>, at: usize) -> Prediction {
        let row = &self.rows[at];
        let beginning = BEGINNINGS + self.stretch[at];
        let capacity_ah = libm::exp(theta[LOG_CAPACITY]);
        let hours = f64::from(row.elapsed_s) / 3600.0;
        let moved = (f64::from(row.charge_ah) - hours * theta[OFFSET]) / capacity_ah;
        let soc = theta[beginning] - moved;
        let temperature_c = f64::from(row.temperature_c);
        let position = self.model.grid_position(soc, temperature_c);
        let (node, along) = locate_clamped(&SOC, soc);
        let own_v = between(theta.as_slice(), node, along);
        let own_slope_v =
            if (0.0..1.0).contains(&soc) { (theta[node + 1] - theta[node]) / (SOC[node + 1] - SOC[node]) } else { 0.0 };
        let slope_v = self.model.ocv_slope_v(&position, self.model.capacity_ah) + own_slope_v;
        let cold = cold_share(temperature_c);
        let mut index = vec![node, node + 1, COLD_SAG, LOG_CAPACITY, OFFSET, beginning];
        let mut slope = vec![1.0 - along, along, -cold, slope_v * moved, slope_v * hours / capacity_ah, slope_v];
        let (low, part) = locate_clamped(&FACTOR_SOC, soc);
        let by_temperature = libm::log(arrhenius(temperature_c));
        let by_factor = [1.0 - part, part, by_temperature];
        let mut drop_v = 0.0;
        let ohm: [f64; RESISTANCES] = std::array::from_fn(|j| {
            let first = FACTORS + j * FACTOR_NODES + low;
            let ln = between(theta.as_slice(), first, part) + by_temperature * theta[BY_TEMPERATURE + j];
            let label_ohm = match j {
                0 => self.model.r0_ohm(&position),
                j => self.model.branch_r_ohm(j - 1, &position),
            };
            let ohm = label_ohm * libm::exp(ln);
            let current_a = f64::from(if j == 0 { row.current_a } else { row.filtered_a[j - 1] });
            let part_v = ohm * current_a;
            drop_v += part_v;
            index.extend([first, first + 1, BY_TEMPERATURE + j]);
            slope.extend(by_factor.map(|factor| -factor * part_v));
            ohm
        });
        let voltage_v = self.model.ocv_v(&position) + own_v - cold * theta[COLD_SAG] - drop_v;
        Prediction { voltage_v, drop_v, soc, slope_v, ohm, by_factor, index, slope }
    }

    /// The most likely value of the parameter `k` (SOC at the start of a stretch) if all other parameters stay fixed.
    fn likeliest_beginning(&self, theta: &DVector<f64>, k: usize) -> f64 {
        let mut theta = theta.clone();
        let rows: Vec<usize> = (0..self.rows.len()).filter(|&at| BEGINNINGS + self.stretch[at] == k).collect();
        let mut cost = |soc: f64| {
            theta[k] = soc;
            let row_cost = |&at: &usize| {
                let Prediction { voltage_v, drop_v, .. } = self.predict(&theta, at);
                let deviations =
                    (voltage_v - f64::from(self.rows[at].voltage_v)).abs() / f64::hypot(0.02, 0.1 * drop_v);
                // Beyond three standard deviations, the cost grows linearly (Huber).
                if deviations <= 3.0 { 0.5 * deviations * deviations } else { 3.0 * (deviations - 1.5) }
            };
            rows.iter().map(row_cost).sum::<f64>()
        };
        let tried = (0..=44).map(|step| BEGINNING.0 + (BEGINNING.1 - BEGINNING.0) * f64::from(step) / 44.0);
        tried.map(|soc| (soc, cost(soc))).min_by(|a, b| a.1.total_cmp(&b.1)).map_or(0.5, |found| found.0)
    }

    /// Standard deviation of ln(voltage drop) at SOC 0.5 and a temperature, for a constant current.
    pub(super) fn drop_std(&self, theta: &DVector<f64>, covariance: &DMatrix<f64>, temperature_c: f64) -> f64 {
        let position = self.model.grid_position(0.5, temperature_c);
        let by_temperature = libm::log(arrhenius(temperature_c));
        let (low, part) = locate_clamped(&FACTOR_SOC, 0.5);
        let mut share = DVector::zeros(theta.len());
        let mut settled_ohm = 0.0;
        for j in 0..RESISTANCES {
            let first = FACTORS + j * FACTOR_NODES + low;
            let ln = between(theta.as_slice(), first, part) + by_temperature * theta[BY_TEMPERATURE + j];
            let label_ohm =
                if j == 0 { self.model.r0_ohm(&position) } else { self.model.branch_r_ohm(j - 1, &position) };
            let ohm = label_ohm * libm::exp(ln);
            settled_ohm += ohm;
            share[first] += (1.0 - part) * ohm;
            share[first + 1] += part * ohm;
            share[BY_TEMPERATURE + j] += by_temperature * ohm;
        }
        share /= settled_ohm;
        share.dot(&(covariance * &share)).max(0.0).sqrt()
    }
}
