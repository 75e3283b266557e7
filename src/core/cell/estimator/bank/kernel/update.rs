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
        let reach = l[0][0] * c.scale;
        let mut parts = OddEvenParts::NONE;
        let aged = (c.ocv_ageing_shift != 0.0).then(|| aged_voltages(tables, cache, c, x, l, &mut parts));
        let table_points = tables.table_points(cache, x.mean[0], reach);
        let ratios = ResistanceRatios::new(c, l);
        let (mut ocv_v, slope_v, r0_ohm) = table_points[0].ocv_and_r0();
        let (plus_v, _, plus_ohm) = table_points[1].ocv_and_r0();
        let (minus_v, _, minus_ohm) = table_points[2].ocv_and_r0();
        let mut side_v = [plus_v, minus_v];
        if let Some(aged) = aged {
            (ocv_v, side_v) = aged;
        }
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
        let plus = side_v[0] - plus_ohm * ratio * ratios.first[0] * input.current_a;
        let minus = side_v[1] - minus_ohm * ratio * ratios.first[1] * input.current_a;
        parts.put(c, 0, plus, minus, centre_v + branches_v);
        parts.odd[0] = parts.odd[0] - branches[0];
        parts.odd[1] = parts.odd[1] - branches[1] - drop_v * ratios.second[0];
        parts.even[1] = parts.even[1] - drop_v * ratios.second[1];
        parts.odd[2] = parts.odd[2] - branches[2];
        let base_variance = if tables.has_error() {
            table_points[0].one(ERROR_V).square() * ERROR_WINDOW_S
        } else {
            Lanes::splat(c.reading.model)
        };
        Self { centre_v, parts, slope_v, lost_v: drop_v + branches_v, base_variance, settled_ohm }
    }
}

/// Open-circuit voltages of aged cells at the centre and the first pair, V; sets the parts of the other pairs, which differ
/// in capacity.
#[inline(always)]
fn aged_voltages<const L: usize, const N: usize, const T: usize, const W: usize>(
    tables: &mut Tables<W>,
    cache: &LineCache<L, W>,
    c: &KernelConstants,
    x: &FilterState<L, N, T>,
    l: &[[Lanes<L>; N]; COLUMNS],
    parts: &mut OddEvenParts<L>,
) -> (Lanes<L>, [Lanes<L>; 2]) {
    let (soc, capacity) = (x.mean[0], x.mean[CAPACITY]);
    let reach = l[0][0] * c.scale;
    let reach_ah = [l[0][CAPACITY] * c.scale, l[1][CAPACITY] * c.scale, l[2][CAPACITY] * c.scale];
    let places = [
        (soc, capacity),
        (soc + reach, capacity + reach_ah[0]),
        (soc - reach, capacity - reach_ah[0]),
        (soc, capacity + reach_ah[1]),
        (soc, capacity - reach_ah[1]),
        (soc, capacity + reach_ah[2]),
        (soc, capacity - reach_ah[2]),
    ];
    // A loop instead of seven copies of the look-up: few models have an ageing shift.
    let mut voltages = [Lanes::splat(0.0); 7];
    for (voltage, (soc, capacity_ah)) in voltages.iter_mut().zip(places) {
        *voltage = aged_ocv_v(tables, cache, c, soc, capacity_ah);
    }
    let [centre_v, plus, minus, plus_1, minus_1, plus_2, minus_2] = voltages;
    parts.put(c, 1, plus_1, minus_1, centre_v);
    parts.put(c, 2, plus_2, minus_2, centre_v);
    (centre_v, [plus, minus])
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

/// Open-circuit voltage of a cell that has aged to a capacity, V, see [`crate::cell::CellModel::ocv_soc`].
#[inline(always)]
fn aged_ocv_v<const L: usize, const W: usize>(
    tables: &mut Tables<W>,
    cache: &LineCache<L, W>,
    c: &KernelConstants,
    soc: Lanes<L>,
    capacity_ah: Lanes<L>,
) -> Lanes<L> {
    let one = Lanes::splat(1.0);
    let lost = (one - capacity_ah / c.new_capacity_ah) * c.ocv_ageing_shift;
    let inside = soc.at_least(0.0).at_most(1.0);
    let soc = soc + lost.at_least(-0.9).at_most(0.9) * inside * (one - inside);
    tables.ocv_v(cache, &soc)
}
