//! Learns the slope of the open-circuit curve from the pack itself.
//!
//! In, per row (a few minutes of samples): the counted charge, the differences between the cells, and the middle
//! voltage (V). The middle voltage is the voltage of the pack's middle cell; the voltage drop of the current is added
//! to it. Out: for each tenth of the SOC range, a factor: the true slope divided by the slope of the cell model. All
//! cells share these factors.
//!
//! The slope is learned while the cell model is derived from a label (chemistry and capacity). Such a curve can have
//! half or twice the slope of the real curve. A constant difference in charge then looks like a difference that depends
//! on the SOC. The comparison of cells would mistake this difference for a bad contact or a lost capacity.
//!
//! The pack shows its own slope in two ways:
//! * From the middle voltage: its change, divided by the charge that moved.
//! * From cells with different charge: their voltage differences grow and shrink with the slope. This gives only the
//!   ratio of the slopes in two tenths, because the charge differences themselves are still being learned.
//!
//! The factor of a tenth is the slope from the cells. The slopes from the cells are scaled so that their sum over the
//! tenths agrees with the slopes from the middle voltage. In a tenth without cells of different charge, the factor is
//! the slope from the middle voltage.

use serde::{Deserialize, Serialize};

use crate::cell::CellModel;
use crate::filter::ScalarGaussian;
use crate::quantity::InvalidState;

const TENTHS: usize = 10;
/// Standard deviation of the factor before the first measurement.
const LABEL_STD: f64 = 0.4;
/// Standard deviations that decide where on the curve a row is: `SOC_STD` of the filter's SOC (fraction), `OCV_STD_V`
/// of the open-circuit voltage (V). On a steep curve, the voltage decides. On a flat curve, the SOC decides.
const SOC_STD: f64 = 0.05;
const OCV_STD_V: f64 = 0.01;
/// Minimum relative standard deviations of a slope. `LEAST_STD` applies to the middle voltage, because the voltage
/// drop also changes with the SOC. `LEAST_STD_OF_CELLS` applies to the cells, because the slope varies within a
/// tenth.
const LEAST_STD: f64 = 0.2;
const LEAST_STD_OF_CELLS: f64 = 0.1;
/// Maximum relative standard deviation at which the slope from the cells is used.
const SEEN_STD: f64 = 0.2;
/// Initial variance of the logarithm of the slope from the cells.
const FIRST_VARIANCE: f64 = 1.0;
/// Minimum charge difference of a cell that is used, fraction. With smaller differences, offsets of the voltage
/// channels would look like a slope.
const LEAST_CHARGE: f64 = 0.005;
/// Maximum contribution of one cell to the sum of the charge differences. If one cell contributed more, a fault of this
/// cell could look like a slope.
const MOST_OF_ONE: f64 = 1.0 / 3.0;
/// Errors of the slope from the cells. `CELL_V`: error of each cell's voltage difference, equal in every row (V).
/// `CELLS`: error of one row (fraction), because the charge differences are still being learned.
const CELL_V: f64 = 0.004;
const CELLS: f64 = 0.3;
const FACTORS: (f64, f64) = (0.2, 4.0);
/// Number of recent rows kept. The voltage change is measured between the newest row and a kept row.
const RECENT: usize = 24;
/// Allowed SOC change between the two rows of a measurement. A smaller change has a larger error. A larger change
/// blurs the tenths.
const APART: (f64, f64) = (0.03, 0.12);
/// Errors of the change of the open-circuit voltage: `ROW_V` of each row (V), `DROP` as a fraction of the change of
/// the voltage drop.
const ROW_V: f64 = 0.004;
const DROP: f64 = 0.3;
/// Number of consecutive measurements that share about the same rows. Their errors are not independent.
const SHARED: f64 = 3.0;
/// Number of standard deviations above which the weight of a measurement is reduced (Huber).
const HUBER: f64 = 3.0;
/// Maximum number by which [`PackSlope::factor`] multiplies the variance of a factor. That function multiplies by the
/// number of rows in a tenth. The number is limited, because older rows hardly influence the filter of a cell.
const MOST_ROWS: u32 = 200;

/// Values of a row from which the slope is learned.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct SlopeRow {
    /// Charge taken out since any fixed time (Ah).
    pub(super) charge_ah: f64,
    /// SOC of the middle cell on the model's curve.
    pub(super) soc: f64,
    /// Middle voltage of the pack plus its voltage drop (V).
    pub(super) ocv_v: f64,
    pub(super) drop_v: f64,
}

/// Slope of the pack's open-circuit curve relative to the model's curve, per tenth of SOC.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PackSlope {
    tenths: Vec<Tenth>,
    /// The latest rows since the last gap, oldest first.
    recent: Vec<SlopeRow>,
    /// Voltages of the model at SOC 0.3 and 0.7 (V). If they change, everything learned is discarded.
    curve_v: [f64; 2],
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Tenth {
    /// Factor from the middle voltage.
    of_middle: ScalarGaussian,
    /// Logarithm of the cells' mean charge difference (fraction), computed from their voltage differences with the
    /// model's slope. If the true slope is twice the model's slope, this computed difference doubles, so it is
    /// proportional to the factor. `None` before the first row with cells of different charge.
    of_cells: Option<ScalarGaussian>,
    /// Number of rows in this tenth.
    rows: u32,
}

fn tenth(soc: f64) -> usize {
    ((soc.clamp(0.0, 1.0) * TENTHS as f64) as usize).min(TENTHS - 1)
}

impl PackSlope {
    /// Discards the recent rows, because charge may have moved without being measured.
    pub(super) fn interrupt(&mut self) {
        self.recent.clear();
    }

    pub(super) fn forget(&mut self) {
        *self = Self::default();
    }

    /// SOC of the row on the model's curve. `soc`: SOC of the middle cell in the filter, which may be wrong by
    /// several points while the model is derived from a label.
    pub(super) fn position(model: &CellModel, capacity_ah: f64, temperature_c: f64, soc: f64, ocv_v: f64) -> f64 {
        let temperature = model.temperature_position(temperature_c);
        let slope_v = model.ocv_slope_v(&model.grid_position_at(&temperature, soc.clamp(0.0, 1.0)), capacity_ah);
        let by_voltage = model.soc_of_aged_ocv(&temperature, capacity_ah, ocv_v);
        let of_voltage = (SOC_STD * slope_v) * (SOC_STD * slope_v);
        let weight = of_voltage / (of_voltage + OCV_STD_V * OCV_STD_V);
        soc + weight * (by_voltage - soc)
    }

    /// Adds a row and measures the slope between this row and a recent row.
    pub(super) fn add(&mut self, model: &CellModel, capacity_ah: f64, temperature_c: f64, row: SlopeRow) {
        let curve_v = [0.3, 0.7].map(|soc| model.ocv_v(&model.grid_position(soc, 25.0)));
        if self.tenths.is_empty() || self.curve_v != curve_v {
            self.forget();
            self.curve_v = curve_v;
            let factor = ScalarGaussian { mean: 1.0, variance: LABEL_STD * LABEL_STD };
            self.tenths = vec![Tenth { of_middle: factor, of_cells: None, rows: 0 }; TENTHS];
        }
        let here = &mut self.tenths[tenth(row.soc)];
        here.rows = (here.rows + 1).min(MOST_ROWS);
        let charged = |from: &SlopeRow| (from.charge_ah - row.charge_ah) / capacity_ah;
        let far_enough = self.recent.iter().filter(|from| (APART.0..=APART.1).contains(&charged(from).abs()));
        let change_v = |from: &SlopeRow| (row.drop_v - from.drop_v).abs();
        if let Some(from) = far_enough.min_by(|a, b| change_v(a).total_cmp(&change_v(b))).copied() {
            let (middle, half) = (0.5 * (row.soc + from.soc), 0.5 * charged(&from));
            let at_v =
                |soc: f64| model.aged_ocv_v(&model.grid_position(soc.clamp(0.0, 1.0), temperature_c), capacity_ah);
            let expected_v = at_v(middle + half) - at_v(middle - half);
            let error_v = (DROP * change_v(&from)).hypot(ROW_V * std::f64::consts::SQRT_2);
            let measured = (row.ocv_v - from.ocv_v) / expected_v;
            let variance = SHARED * error_v * error_v / (expected_v * expected_v);
            if measured.is_finite() && variance.is_finite() {
                let factor = &mut self.tenths[tenth(middle)].of_middle;
                let open = (factor.variance - LEAST_STD * LEAST_STD).max(0.0);
                *factor = updated(*factor, open, measured, variance);
                factor.mean = factor.mean.clamp(FACTORS.0, FACTORS.1);
            }
        }
        if self.recent.len() == RECENT {
            self.recent.remove(0);
        }
        self.recent.push(row);
    }

    /// SOC at which the charge differences of the cells are known best: the middle of the tenth with the most rows.
    pub(super) fn reference_soc(&self) -> f64 {
        let busiest = (0..self.tenths.len()).max_by_key(|&tenth| (self.tenths[tenth].rows, tenth.min(TENTHS - tenth)));
        busiest.map_or(0.5, |tenth| (tenth as f64 + 0.5) / TENTHS as f64)
    }

    /// Learns the slope at `soc` from several cells. `slope_v`: slope of the model (V per unit of SOC). `cells`
    /// contains two values per cell: its charge difference at the reference SOC (fraction), and its voltage
    /// difference divided by the model's voltage difference for this charge.
    pub(super) fn learn_from_cells(&mut self, soc: f64, slope_v: f64, mut cells: Vec<(f64, f64)>) {
        let Some(tenth) = self.tenths.get_mut(tenth(soc)) else { return };
        let mean_charge = cells.iter().map(|(charge, _)| charge.abs()).sum::<f64>() / cells.len().max(1) as f64;
        cells.retain(|(charge, multiple)| charge.abs() >= LEAST_CHARGE && multiple.is_finite());
        let total: f64 = cells.iter().map(|(charge, _)| charge.abs()).sum();
        if cells.iter().any(|(charge, _)| charge.abs() > MOST_OF_ONE * total) {
            return;
        }
        cells.sort_by(|a, b| a.1.total_cmp(&b.1));
        let mut below = 0.0;
        let median = cells.iter().find(|(charge, _)| {
            below += charge.abs();
            below >= 0.5 * total
        });
        let squares: f64 = cells.iter().map(|(charge, _)| charge * charge).sum();
        // The offsets of the voltage channels are the same in every row, so this part of the error does not average
        // out.
        let lasting = CELL_V * CELL_V / (slope_v * slope_v * squares);
        // `multiple` is relative to the charge differences, whose scale is unknown. Multiplying by the mean charge
        // removes this scale.
        let measured = libm::log(median.map_or(0.0, |(_, multiple)| multiple * mean_charge));
        if measured.is_finite() && lasting <= FIRST_VARIANCE {
            let before = tenth.of_cells.unwrap_or(ScalarGaussian { mean: measured, variance: FIRST_VARIANCE });
            let ScalarGaussian { mean, variance } = updated(before, before.variance, measured, lasting + CELLS * CELLS);
            let least = lasting.max(LEAST_STD_OF_CELLS * LEAST_STD_OF_CELLS);
            tenth.of_cells = Some(ScalarGaussian { mean, variance: variance.max(least) });
        }
    }

    /// Factor by which the slopes from the cells are multiplied, so that their sum equals the sum of the slopes from
    /// the middle voltage. Only tenths with both slopes count. `None` if there is no such tenth.
    fn scale(&self) -> Option<f64> {
        let seen = || {
            self.tenths.iter().filter_map(|tenth| Some((tenth.of_middle.mean, libm::exp(tenth.clear_of_cells()?.mean))))
        };
        let (of_middle, of_cells) = seen().fold((0.0, 0.0), |sums, (a, b)| (sums.0 + a, sums.1 + b));
        (of_cells > 0.0).then(|| of_middle / of_cells)
    }

    /// Factor of the slope at a SOC, and variance of its error in a single row.
    ///
    /// All rows of a tenth share the factor's error, but the filter of a cell treats the errors of rows as
    /// independent. The variance is therefore multiplied by the number of rows. All rows of a tenth together then
    /// count as one row.
    pub(super) fn factor(&self, soc: f64) -> ScalarGaussian {
        let Some(tenth) = self.tenths.get(tenth(soc)) else { return ScalarGaussian { mean: 1.0, variance: 0.0 } };
        let scaled = |(scale, of_cells): (f64, ScalarGaussian)| {
            let mean = (scale * libm::exp(of_cells.mean)).clamp(FACTORS.0, FACTORS.1);
            ScalarGaussian { mean, variance: mean * mean * of_cells.variance }
        };
        let of_cells = self.scale().zip(tenth.clear_of_cells()).map(scaled);
        let ScalarGaussian { mean, variance } = of_cells.unwrap_or(tenth.of_middle);
        ScalarGaussian { mean, variance: variance * f64::from(tenth.rows.max(1)) }
    }

    pub(super) fn check(&self) -> Result<(), InvalidState> {
        let count = self.tenths.len();
        let is_possible = (count == 0 || count == TENTHS) && self.recent.len() <= RECENT;
        InvalidState::unless(is_possible, "the tenths of a slope", count as f64, "0 or 10")?;
        for Tenth { of_middle, of_cells, rows } in &self.tenths {
            let is_possible = (FACTORS.0..=FACTORS.1).contains(&of_middle.mean) && *rows <= MOST_ROWS;
            InvalidState::unless(is_possible, "the factor of a slope", of_middle.mean, "0.2 to 4")?;
            InvalidState::unless_positive("the variance of a slope's factor", of_middle.variance)?;
            InvalidState::unless_numbers("a slope from the cells", of_cells.iter().map(|it| it.mean))?;
            of_cells.iter().try_for_each(|it| InvalidState::unless_positive("the variance of a slope", it.variance))?;
        }
        InvalidState::unless_numbers("the curve of a slope", self.curve_v)?;
        let numbers = self.recent.iter().flat_map(|row| [row.charge_ah, row.soc, row.ocv_v, row.drop_v]);
        InvalidState::unless_numbers("a row of a slope", numbers)
    }
}

impl Tenth {
    /// The slope from the cells, if it is certain enough.
    fn clear_of_cells(&self) -> Option<ScalarGaussian> {
        self.of_cells.filter(|it| it.variance <= SEEN_STD * SEEN_STD)
    }
}

/// A factor after a measurement. `open`: the part of the factor's variance that the measurement can reduce.
fn updated(factor: ScalarGaussian, open: f64, measured: f64, variance: f64) -> ScalarGaussian {
    let total = open + variance;
    let off = (measured - factor.mean).abs() / total.sqrt();
    let gain = open / (total * (off / HUBER).max(1.0));
    let mean = factor.mean + gain * (measured - factor.mean);
    ScalarGaussian { mean, variance: factor.variance - gain * open }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::{Chemistry, Label};

    fn model(chemistry: Chemistry) -> CellModel {
        Label::usual(chemistry, 100.0).model().expect("a model")
    }

    /// The slope after 30 rows at a SOC of 0.35 and 30 rows at 0.75. The voltages of six cells differ by 0.5 times the
    /// model's difference at SOC 0.35, and by 1.5 times at 0.75. No charge moves.
    fn seen(model: &CellModel) -> PackSlope {
        let mut slope = PackSlope::default();
        for (soc, multiple) in [(0.35, 0.5), (0.75, 1.5)] {
            for _ in 0..30 {
                slope.add(model, 100.0, 25.0, SlopeRow { charge_ah: 0.0, soc, ocv_v: 3.7, drop_v: 0.0 });
                let cells = [-0.03, -0.02, -0.01, 0.01, 0.02, 0.03].map(|charge| (charge, multiple));
                slope.learn_from_cells(soc, 0.8, cells.to_vec());
            }
        }
        slope
    }

    #[test]
    fn cells_show_slope_of_one_tenth_relative_to_another() {
        let slope = seen(&model(Chemistry::NmcGraphite));
        let (low, high) = (slope.factor(0.35), slope.factor(0.75));
        assert!((high.mean / low.mean / 3.0 - 1.0).abs() < 0.05, "{low:?} {high:?}");
        assert!((low.mean + high.mean - 2.0).abs() < 0.05, "the middle voltage has shown no other slope");
        assert_eq!(slope.factor(0.55), ScalarGaussian { mean: 1.0, variance: LABEL_STD * LABEL_STD });
        assert_eq!(slope.check(), Ok(()));
    }

    #[test]
    fn another_curve_resets_slope() {
        let mut slope = seen(&model(Chemistry::NmcGraphite));
        let row = SlopeRow { charge_ah: 0.0, soc: 0.35, ocv_v: 3.7, drop_v: 0.0 };
        slope.add(&model(Chemistry::NmcGraphite), 100.0, 25.0, row);
        assert_ne!(slope.factor(0.75).mean, 1.0);
        slope.add(&model(Chemistry::LcoGraphite), 100.0, 25.0, row);
        assert_eq!(slope.factor(0.75).mean, 1.0);
    }

    #[test]
    fn impossible_rows_leave_valid_slope() {
        let model = model(Chemistry::LfpGraphite);
        let mut slope = PackSlope::default();
        let values = [0.0, 1e18, -1e18, 1e-300];
        for (step, ocv_v) in values.iter().cycle().take(200).enumerate() {
            let (charge_ah, drop_v) = (5.0 * step as f64, values[step / 2 % 4]);
            slope.add(&model, 100.0, 25.0, SlopeRow { charge_ah, soc: ocv_v / 2.0, ocv_v: *ocv_v, drop_v });
            let cells = [0.02, -0.02, 0.01, f64::NAN, 1e300].map(|charge| (charge, ocv_v / charge));
            slope.learn_from_cells(step as f64 / 200.0, drop_v, cells.to_vec());
            slope.learn_from_cells(0.5, 1e-12, vec![(0.02, 1.0); 5]);
            assert_eq!(slope.check(), Ok(()), "row {step}");
        }
    }
}
