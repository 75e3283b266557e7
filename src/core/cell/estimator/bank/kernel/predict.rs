//! Predicts the state with the circuit's equations over the *measured time*, in which the current was measured.
//!
//! In: a state, charge (A s) and time (s). Out: mean and covariance after this time, in the units of the states, and a
//! mask of the lanes whose covariance was positive definite. Each lane is one cell.
//!
//! [`super`] explains the centre and the pairs of the sigma points, and the odd and even parts of a function. A
//! constant error is an error that does not change with time, such as the offset of a sensor.

use super::points::{COLUMNS, OddEvenParts, PartialCholesky, ResistanceRatios, sum};
use super::types::{FilterState, KernelConstants, StepInput, at};
use crate::cell::estimator::bank::tables::{LineCache, TablePoint, Tables};
use crate::cell::estimator::state_vector::{
    BRANCHES, CAPACITY, CONSTANT_ERRORS, CURRENT_GAIN, CURRENT_OFFSET, LOG_RESISTANCE,
};
use crate::filter::simd::{Lanes, Mask};

/// Maximum time of a step (s) for the random walk of the resistance. Longer steps count as this time, because a cell
/// hardly ages in a gap.
const MAX_WALK_S: f64 = 600.0;

struct BranchStep<const L: usize> {
    r_ohm: Lanes<L>,
    tau_s: Lanes<L>,
    /// Remaining fraction of the branch's voltage after the measured time.
    decay: Lanes<L>,
    /// exp(-time / tau), even if `decay` follows Euler's rule.
    exact: Lanes<L>,
}

impl<const L: usize> BranchStep<L> {
    #[inline(always)]
    fn new<const W: usize>(c: &KernelConstants, input: &StepInput<L>, spot: &TablePoint<L, W>, i: usize) -> Self {
        let (r_ohm, tau_s) = spot.branch(i - BRANCHES);
        let ratio = input.measured_s / tau_s;
        let exact = (-ratio).exp();
        let one = Lanes::splat(1.0);
        let decay = if c.euler { (one - ratio).or_else(one.above(ratio), exact) } else { exact };
        Self { r_ohm, tau_s, decay, exact }
    }

    /// Voltage of the branch after the measured time, if it starts at the voltage `u`. `drive` is the mean current (A)
    /// times the resistance ratio of the cell. The branch settles at `r_ohm` x `drive`.
    #[inline(always)]
    fn voltage_v(&self, drive: Lanes<L>, u: Lanes<L>) -> Lanes<L> {
        self.r_ohm * drive * (Lanes::splat(1.0) - self.decay) + u * self.decay
    }
}

/// Predicts the SOC after a discharge of `charge_ah`. Returns the decrease of the SOC at the centre, and the odd and
/// even parts of the new SOC. The new SOC is nonlinear only because the charge is divided by the capacity.
#[inline(always)]
fn soc_parts<const L: usize, const N: usize>(
    c: &KernelConstants,
    l: &[[Lanes<L>; N]; COLUMNS],
    capacity_ah: Lanes<L>,
    charge_ah: Lanes<L>,
) -> (Lanes<L>, OddEvenParts<L>) {
    let per_capacity = capacity_ah.reciprocal();
    let mut parts = OddEvenParts::NONE;
    for k in 0..COLUMNS {
        let spread = l[k][CAPACITY] * c.scale;
        let pair = charge_ah / (capacity_ah.square() - spread.square());
        parts.odd[k] = l[k][CAPACITY] * pair;
        parts.even[k] = -(parts.odd[k] * spread * per_capacity);
    }
    parts.odd[0] = parts.odd[0] + l[0][0];
    (charge_ah * per_capacity, parts)
}

struct BranchPrediction<const L: usize> {
    centre_v: Lanes<L>,
    decay: Lanes<L>,
    /// Voltage gained in the measured time per ampere of mean current (ohm), for a new cell.
    gain_ohm: Lanes<L>,
    noise: Lanes<L>,
    parts: OddEvenParts<L>,
}

/// Predicts branch `i`. `drive` is the mean current (A) times the resistance ratio of the cell. The first pair of sigma
/// points differs from the centre in table points and resistances, the second pair only in resistances.
#[inline(always)]
fn predict_branch<const L: usize, const N: usize, const W: usize>(
    c: &KernelConstants,
    input: &StepInput<L>,
    table_points: &[TablePoint<L, W>; 3],
    l: &[[Lanes<L>; N]; COLUMNS],
    (i, before_v, drive, ratios): (usize, Lanes<L>, Lanes<L>, &ResistanceRatios<L>),
) -> BranchPrediction<L> {
    let one = Lanes::splat(1.0);
    let here = BranchStep::new(c, input, &table_points[0], i);
    let decay = here.decay;
    let gain_ohm = here.r_ohm * (one - decay);
    let gain = gain_ohm * drive;
    let centre_v = gain + before_v * decay;
    let reach = l[0][i] * c.scale;
    let plus = BranchStep::new(c, input, &table_points[1], i).voltage_v(drive * ratios.first[0], before_v + reach);
    let minus = BranchStep::new(c, input, &table_points[2], i).voltage_v(drive * ratios.first[1], before_v - reach);
    let mut parts = OddEvenParts::NONE;
    parts.put(c, 0, plus, minus, centre_v);
    parts.odd[1] = gain * ratios.second[0] + decay * l[1][i];
    parts.even[1] = gain * ratios.second[1];
    parts.odd[2] = decay * l[2][i];
    let noise = here.tau_s * (0.5 * c.process.branch_per_s) * (one - here.exact.square());
    BranchPrediction { centre_v, decay, gain_ohm, noise, parts }
}

/// Charge (A s) that one standard deviation of each constant error adds to the measured charge.
#[inline(always)]
fn excess_as<const L: usize>(c: &KernelConstants, input: &StepInput<L>) -> [Lanes<L>; CONSTANT_ERRORS] {
    let mut excess_as = [Lanes::splat(0.0); CONSTANT_ERRORS];
    excess_as[CURRENT_OFFSET] = input.offset_s * c.sensor.current_offset_a;
    excess_as[CURRENT_GAIN] = input.charge_as * c.sensor.current_gain;
    excess_as
}

/// Predicts the state. The SOC gains the variance `soc_per_s` per second. The mask is true if the covariance before the
/// prediction was positive definite.
#[inline(always)]
pub(in crate::cell::estimator::bank) fn predict<const L: usize, const N: usize, const T: usize, const W: usize>(
    tables: &mut Tables<W>,
    cache: &mut LineCache<L, W>,
    c: &KernelConstants,
    x: &FilterState<L, N, T>,
    input: &StepInput<L>,
    (ratio, soc_per_s): (Lanes<L>, f64),
) -> (FilterState<L, N, T>, Mask<L>) {
    let PartialCholesky { columns: l, is_positive, .. } = PartialCholesky::<L, N>::new(&x.covariance);
    let dt = input.measured_s;
    let charge_ah = input.charge_as * (1.0 / 3600.0);
    let (moved, soc) = soc_parts(c, &l, x.mean[CAPACITY], charge_ah);
    let table_points = tables.table_points(cache, x.mean[0] - moved * 0.5, l[0][0] * c.scale);
    let ratios = ResistanceRatios::new(c, &l);
    let drive = ratio * (input.charge_as * input.decay.per_s);

    let soc_shift = soc.shift(c);
    let (mut mean, mut p, mut by_constant) = (x.mean, x.covariance, x.by_constant);
    let excess_as = excess_as(c, input);
    let moved_per_ah = moved / x.mean[CAPACITY];
    let per_as = x.mean[CAPACITY].reciprocal() * (1.0 / 3600.0);
    for k in 0..CONSTANT_ERRORS {
        by_constant[k][0] = by_constant[k][0] + excess_as[k] * per_as + moved_per_ah * x.by_constant[k][CAPACITY];
    }
    mean[0] = x.mean[0] - moved + soc_shift;
    let capacity_column = [l[0][CAPACITY], l[1][CAPACITY], l[2][CAPACITY]];
    let soc_noise = dt * soc_per_s + moved.abs() * c.process.soc_per_charge;
    p[at(0, 0)] = sum(soc.odd, soc.odd) + sum(soc.even, soc.even) + soc_shift.square() * c.excess + soc_noise;
    p[at(LOG_RESISTANCE, 0)] = soc.odd[0] * l[0][LOG_RESISTANCE] + soc.odd[1] * l[1][LOG_RESISTANCE];
    p[at(CAPACITY, 0)] = sum(soc.odd, capacity_column);
    let log_resistance = at(LOG_RESISTANCE, LOG_RESISTANCE);
    p[log_resistance] = p[log_resistance] + dt.at_most(MAX_WALK_S) * c.process.log_resistance_per_s;
    let mut done = [(OddEvenParts::NONE, Lanes::splat(0.0)); N];
    for i in BRANCHES..N {
        let branch = predict_branch(c, input, &table_points, &l, (i, x.mean[i], drive, &ratios));
        let OddEvenParts { odd, even } = branch.parts;
        let u_shift = branch.parts.shift(c);
        done[i] = (branch.parts, branch.decay);
        for k in 0..CONSTANT_ERRORS {
            let driven = drive * x.by_constant[k][LOG_RESISTANCE] - ratio * (excess_as[k] * input.decay.per_s);
            by_constant[k][i] = x.by_constant[k][i] * branch.decay + branch.gain_ohm * driven;
        }
        mean[i] = branch.centre_v + u_shift;
        p[at(i, 0)] = sum(soc.odd, odd) + sum(soc.even, even) + soc_shift * u_shift * c.excess;
        p[at(i, LOG_RESISTANCE)] = l[0][LOG_RESISTANCE] * odd[0] + l[1][LOG_RESISTANCE] * odd[1];
        p[at(i, CAPACITY)] = sum(capacity_column, odd);
        for j in BRANCHES..=i {
            let (other, other_decay) = &done[j];
            // After the second column, the columns of the Cholesky factor change a branch voltage only by its decay.
            // The sum of their products is therefore multiplied by the decays of both branches, `i` and `j`.
            let others = x.covariance[at(i, j)] - l[0][i] * l[0][j] - l[1][i] * l[1][j];
            p[at(i, j)] = odd[0] * other.odd[0]
                + odd[1] * other.odd[1]
                + branch.decay * *other_decay * others
                + even[0] * other.even[0]
                + even[1] * other.even[1]
                + u_shift * other.shift(c) * c.excess;
        }
        p[at(i, i)] = p[at(i, i)] + branch.noise;
    }
    (FilterState { mean, covariance: p, by_constant, memory: x.memory }, is_positive)
}
