//! Updates the state with a measured voltage.
//!
//! In: a state and the reading (V). Out: the updated state, the innovation (V), its variance (V^2), and the test ratio.
//! The innovation is measured minus predicted voltage. The gate is a bound on the innovation: a reading beyond it does
//! not change the state. The test ratio is the squared innovation divided by the variance that the gate assumes. One
//! mask marks the lanes (cells) whose result is usable, and another mask marks the lanes whose reading is within the
//! gate.
//!
//! [`super`] explains the centre, the pairs, and the odd and even parts of the sigma points. A constant error is an
//! error that does not change with time, such as the offset of a sensor.

use super::points::{COLUMNS, OddEvenParts, PartialCholesky, ResistanceRatios};
use super::types::{
    CURVE_STD_AH, FilterState, KernelConstants, LOAD_A, OFFSET_INFORMATION, OFFSET_SCORE, SLOW_INFORMATION, SLOW_RATIO,
    SLOW_SCORE, SLOW_STD, StepInput, StepOutcome, at,
};
use crate::cell::aged_ocv::MIXES;
use crate::cell::estimator::bank::tables::{ERROR_V, LineCache, Tables, branch};
use crate::cell::estimator::state_vector::{
    BRANCHES, CONSIDERED, CONSTANT_ERRORS, CURRENT_GAIN, CURRENT_OFFSET, CURVE_CAPACITY, CURVE_MIXES, LOG_RESISTANCE,
    SLOW_BRANCH, VOLTAGE_OFFSET,
};
use crate::cell::model::ERROR_WINDOW_S;
use crate::filter::simd::Lanes;

struct PredictedVoltage<const L: usize> {
    /// At the centre sigma point (V).
    centre_v: Lanes<L>,
    /// For each of the first [`COLUMNS`] pairs of sigma points.
    parts: OddEvenParts<L>,
    slope_v: Lanes<L>,
    /// Changes of the open-circuit voltage. The first is per Ah of capacity (V per Ah). Each of the others is per
    /// standard deviation of one electrode's share in the capacity loss (V, a "mix" in `crate::cell::aged_ocv`).
    changes_v: [Lanes<L>; 1 + MIXES],
    lost_v: Lanes<L>,
    r0_ohm: Lanes<L>,
    /// Variance of the model's error over one second (V^2).
    base_variance: Lanes<L>,
    /// Resistance of new cells after all branches have settled (ohm).
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
        let table_points = tables.table_points(cache, x.mean[0], reach);
        let ratios = ResistanceRatios::new(c, l);
        let (ocv_v, slope_v, r0_ohm) = table_points[0].ocv_and_r0();
        let (plus_v, _, plus_ohm) = table_points[1].ocv_and_r0();
        let (minus_v, _, minus_ohm) = table_points[2].ocv_and_r0();
        let changes_v = table_points[0].ocv_changes();
        let mut settled_ohm = r0_ohm;
        let mut branches_v = Lanes::splat(0.0);
        let mut branches = [Lanes::splat(0.0); COLUMNS];
        for i in BRANCHES..N {
            settled_ohm = settled_ohm + table_points[0].one(branch(i - BRANCHES));
            branches_v = branches_v + weighed(x, i, x.mean[i]);
            for k in 0..COLUMNS {
                branches[k] = branches[k] + weighed(x, i, l[k][i]);
            }
        }
        let drop_v = r0_ohm * ratio * input.current_a;
        let centre_v = ocv_v - branches_v - drop_v;
        let plus = plus_v - plus_ohm * ratio * ratios.first[0] * input.current_a;
        let minus = minus_v - minus_ohm * ratio * ratios.first[1] * input.current_a;
        let mut parts = OddEvenParts::NONE;
        parts.put(c, 0, plus, minus, centre_v + branches_v);
        parts.odd[0] = parts.odd[0] - branches[0];
        parts.odd[1] = -branches[1] - drop_v * ratios.second[0];
        parts.even[1] = -(drop_v * ratios.second[1]);
        parts.odd[2] = -branches[2];
        let base_variance = if tables.has_error() {
            table_points[0].one(ERROR_V).square() * ERROR_WINDOW_S
        } else {
            Lanes::splat(c.reading.model)
        };
        let lost_v = drop_v + branches_v;
        Self { centre_v, parts, slope_v, changes_v, lost_v, r0_ohm: r0_ohm * ratio, base_variance, settled_ohm }
    }
}

/// Converts `part_v`, a part of branch `i`'s voltage, to its part of the cell's voltage. For the slowest branch, this
/// multiplies by the learned resistance ratio of the branch; for the others, it changes nothing.
#[inline(always)]
fn weighed<const L: usize, const N: usize, const T: usize>(
    x: &FilterState<L, N, T>,
    i: usize,
    part_v: Lanes<L>,
) -> Lanes<L> {
    if i == N - 1 { part_v * x.memory[SLOW_RATIO] } else { part_v }
}

/// For each constant error, the shift of the innovation by one standard deviation of the error (V).
#[inline(always)]
fn by_constant<const L: usize, const N: usize, const T: usize>(
    c: &KernelConstants,
    x: &FilterState<L, N, T>,
    input: &StepInput<L>,
    predicted: &PredictedVoltage<L>,
) -> [Lanes<L>; CONSTANT_ERRORS] {
    let drop_v = predicted.r0_ohm * input.current_a;
    let is_live = input.current_a.abs().above_number(0.0);
    let mut effect_v = [Lanes::splat(0.0); CONSTANT_ERRORS];
    effect_v[VOLTAGE_OFFSET] = Lanes::splat(c.sensor.voltage_offset_v);
    effect_v[CURRENT_OFFSET] = (predicted.r0_ohm * c.sensor.current_offset_a).or_else(is_live, Lanes::splat(0.0));
    effect_v[CURRENT_GAIN] = drop_v * c.sensor.current_gain;
    effect_v[SLOW_BRANCH] = -(x.mean[N - 1] * x.memory[SLOW_STD]);
    effect_v[CURVE_CAPACITY] = -(predicted.changes_v[0] * x.memory[CURVE_STD_AH]);
    effect_v[CURVE_MIXES..].copy_from_slice(&predicted.changes_v[1..]);
    for k in 0..CONSTANT_ERRORS {
        let column = &x.by_constant[k];
        effect_v[k] = effect_v[k] + predicted.slope_v * column[0] - drop_v * column[LOG_RESISTANCE];
        for i in BRANCHES..N {
            effect_v[k] = effect_v[k] - weighed(x, i, column[i]);
        }
    }
    effect_v
}

/// Updates the state `x` in every lane. The outcome marks the lanes whose result is usable.
#[inline(always)]
pub(in crate::cell::estimator::bank) fn update<const L: usize, const N: usize, const T: usize, const W: usize>(
    tables: &mut Tables<W>,
    cache: &mut LineCache<L, W>,
    c: &KernelConstants,
    x: &mut FilterState<L, N, T>,
    input: &StepInput<L>,
    (ratio, information_s): (Lanes<L>, Lanes<L>),
) -> StepOutcome<L> {
    let PartialCholesky { columns: l, rest, is_positive } = PartialCholesky::<L, N>::new(&x.covariance);
    let predicted = PredictedVoltage::new(tables, cache, c, x, input, &l, ratio);
    let OddEvenParts { odd, even } = predicted.parts;
    let shift_v = predicted.parts.shift(c);

    let mut cross = [Lanes::splat(0.0); N];
    let mut variance = shift_v.square() * c.excess;
    for k in 0..COLUMNS {
        variance = variance + odd[k].square() + even[k].square();
        for i in k..N {
            cross[i] = cross[i] + l[k][i] * odd[k];
        }
    }
    for i in BRANCHES..N {
        let mut others = weighed(x, i, rest[i][i]);
        for j in BRANCHES..N {
            if j != i {
                others = others + weighed(x, j, rest[i.max(j)][i.min(j)]);
            }
        }
        cross[i] = cross[i] - others;
        variance = variance + weighed(x, i, others);
    }

    // Measurement noise, see "Deviation 4" in `estimator`.
    let load_v = predicted.settled_ohm * ratio * x.memory[LOAD_A];
    let model = predicted.base_variance + predicted.lost_v.square() * c.reading.drop + load_v.square() * c.reading.load;
    let own_variance = variance + (model / information_s + c.reading.sensor);
    let innovation_v = input.voltage_v - (predicted.centre_v + shift_v);

    let by_constant = by_constant(c, x, input, &predicted);
    let mut constant_variance = Lanes::splat(0.0);
    for k in 0..CONSIDERED {
        constant_variance = constant_variance + by_constant[k].square();
    }
    let total = own_variance + constant_variance;
    let gate = variance + constant_variance + (predicted.slope_v.square() * c.reading.gate_soc + c.reading.gate);
    let test_ratio = innovation_v.square() / gate;
    for (k, information, score) in
        [(CURRENT_OFFSET, OFFSET_INFORMATION, OFFSET_SCORE), (SLOW_BRANCH, SLOW_INFORMATION, SLOW_SCORE)]
    {
        let effect_v = by_constant[k];
        let per_variance = effect_v / (total - effect_v.square());
        x.memory[information] = x.memory[information] + per_variance * effect_v;
        x.memory[score] = x.memory[score] + per_variance * innovation_v;
    }

    let inverse = total.reciprocal();
    let mut gain = cross;
    for i in 0..N {
        for k in 0..CONSIDERED {
            gain[i] = gain[i] + x.by_constant[k][i] * by_constant[k];
        }
        gain[i] = gain[i] * inverse;
        x.mean[i] = x.mean[i] + gain[i] * innovation_v;
        for k in 0..CONSTANT_ERRORS {
            x.by_constant[k][i] = x.by_constant[k][i] - gain[i] * by_constant[k];
        }
    }
    for i in 0..N {
        let weighed = gain[i] * own_variance - cross[i];
        for j in 0..=i {
            x.covariance[at(i, j)] = x.covariance[at(i, j)] + weighed * gain[j] - gain[i] * cross[j];
        }
    }
    let is_accepted = !test_ratio.above_number(c.reading.gate_limit);
    let is_usable = is_positive & total.above_number(0.0);
    StepOutcome { is_usable, is_accepted, innovation_v, innovation_variance: total, test_ratio }
}
