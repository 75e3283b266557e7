//! The measurement update.
//!
//! In: the state before it, and the reading, V. Out: the state after it, innovation, V, its variance, V^2, and the test
//! ratio, which is 1 for an innovation of one standard deviation. A lane outside the gate is marked as not usable.

use super::points::{COLUMNS, OddEvenParts, PartialCholesky, ResistanceRatios};
use super::types::{FilterState, KernelConstants, LOAD_A, StepInput, StepOutcome, at};
use crate::cell::estimator::bank::tables::{ERROR_V, LineCache, Tables, branch};
use crate::cell::estimator::state_vector::{BRANCHES, CAPACITY};
use crate::cell::model::ERROR_WINDOW_S;
use crate::filter::simd::Lanes;

/// Predicted voltage.
struct PredictedVoltage<const L: usize> {
    /// At the centre, V.
    centre_v: Lanes<L>,
    /// Over the pairs of the first columns.
    parts: OddEvenParts<L>,
    /// Slope of the open-circuit voltage, V per unit of SOC.
    slope_v: Lanes<L>,
    /// Present voltage drop in the cell, V.
    lost_v: Lanes<L>,
    /// Standard deviation of the model's error over one second, squared.
    base_variance: Lanes<L>,
    /// Resistance of new cells once every branch has settled, ohm.
    settled_ohm: Lanes<L>,
}

impl<const L: usize> PredictedVoltage<L> {
    #[inline(always)]
    fn new<const N: usize, const T: usize, const W: usize>(
        tables: &mut Tables<W>,
        cache: &mut LineCache<L, W>,
        c: &KernelConstants,
        x: &FilterState<L, N, T>,
        input: &StepInput<L>,
        l: &[[Lanes<L>; N]; COLUMNS],
        ratio: Lanes<L>,
    ) -> Self {
        let (reach, capacity_ah) = (l[0][0] * c.scale, x.mean[CAPACITY]);
        let reach_ah = l[0][CAPACITY] * c.scale;
        let table_points = tables.table_points(cache, x.mean[0], reach);
        let ratios = ResistanceRatios::new(c, l);
        let (ocv_v, slope_v, r0_ohm) = table_points[0].ocv_and_r0(capacity_ah);
        let (plus_v, _, plus_ohm) = table_points[1].ocv_and_r0(capacity_ah + reach_ah);
        let (minus_v, _, minus_ohm) = table_points[2].ocv_and_r0(capacity_ah - reach_ah);
        let per_ah_v = table_points[0].ocv_per_ah();
        let mut settled_ohm = r0_ohm;
        let mut branches_v = Lanes::splat(0.0);
        let mut branches = [Lanes::splat(0.0); COLUMNS];
        for i in BRANCHES..N {
            settled_ohm = settled_ohm + table_points[0].one(branch(i - BRANCHES));
            branches_v = branches_v + x.mean[i];
            for k in 0..COLUMNS {
                branches[k] = branches[k] + l[k][i];
            }
        }
        let drop_v = r0_ohm * ratio * input.current_a;
        let centre_v = ocv_v - branches_v - drop_v;
        let plus = plus_v - plus_ohm * ratio * ratios.first[0] * input.current_a;
        let minus = minus_v - minus_ohm * ratio * ratios.first[1] * input.current_a;
        let mut parts = OddEvenParts::NONE;
        parts.put(c, 0, plus, minus, centre_v + branches_v);
        parts.odd[0] = parts.odd[0] - branches[0];
        parts.odd[1] = per_ah_v * l[1][CAPACITY] - branches[1] - drop_v * ratios.second[0];
        parts.even[1] = -(drop_v * ratios.second[1]);
        parts.odd[2] = per_ah_v * l[2][CAPACITY] - branches[2];
        let base_variance = if tables.has_error() {
            table_points[0].one(ERROR_V).square() * ERROR_WINDOW_S
        } else {
            Lanes::splat(c.reading.model)
        };
        Self { centre_v, parts, slope_v, lost_v: drop_v + branches_v, base_variance, settled_ohm }
    }
}

/// The measurement update. Moves `x` in every lane; the outcome marks the usable ones.
#[inline(always)]
pub(super) fn update<const L: usize, const N: usize, const T: usize, const W: usize>(
    tables: &mut Tables<W>,
    cache: &mut LineCache<L, W>,
    c: &KernelConstants,
    x: &mut FilterState<L, N, T>,
    input: &StepInput<L>,
    ratio: Lanes<L>,
    information_s: Lanes<L>,
) -> StepOutcome<L> {
    let PartialCholesky { columns: l, rest, is_positive } = PartialCholesky::<L, N>::new(&x.covariance);
    let predicted = PredictedVoltage::new(tables, cache, c, x, input, &l, ratio);
    let OddEvenParts { odd, even } = predicted.parts;
    let shift_v = predicted.parts.shift(c);

    // Covariance of state and voltage, and the voltage's variance.
    let mut cross = [Lanes::splat(0.0); N];
    let mut variance = shift_v.square() * c.excess;
    for k in 0..COLUMNS {
        variance = variance + odd[k].square() + even[k].square();
        for i in k..N {
            cross[i] = cross[i] + l[k][i] * odd[k];
        }
    }
    for i in BRANCHES..N {
        let mut others = rest[i][i];
        for j in BRANCHES..N {
            if j != i {
                others = others + rest[i.max(j)][i.min(j)];
            }
        }
        cross[i] = cross[i] - others;
        variance = variance + others;
    }

    // Measurement noise: see `noise::VoltageReading`.
    let load_v = predicted.settled_ohm * ratio * x.memory[LOAD_A];
    let model = predicted.base_variance + predicted.lost_v.square() * c.reading.drop + load_v.square() * c.reading.load;
    let total = variance + (model / information_s + c.reading.sensor);
    let innovation_v = input.voltage_v - (predicted.centre_v + shift_v);
    let gate = variance + (predicted.slope_v.square() * c.reading.gate_soc + c.reading.gate);
    let test_ratio = innovation_v.square() / gate;

    let inverse = total.reciprocal();
    for i in 0..N {
        let gain = cross[i] * inverse;
        x.mean[i] = x.mean[i] + gain * innovation_v;
        for j in 0..N {
            if j <= i {
                x.covariance[at(i, j)] = x.covariance[at(i, j)] - gain * cross[j];
            }
        }
    }
    let is_usable = is_positive & total.above_number(0.0) & !test_ratio.above_number(c.reading.gate_limit);
    StepOutcome { is_usable, innovation_v, innovation_variance: total, test_ratio }
}
