//! The ordinary step of L cells at once: predict over a measured time, take a voltage in that passes the gate.
//!
//! The same filter as [`Gaussian`](crate::filter::Gaussian) with the circuit of [`crate::cell::circuit`], to rounding. What
//! is saved, all of it exact:
//! * With the points in pairs x +- s L_k (s = sqrt(N + lambda)) and f's odd and even parts over each pair, o_k = (f+ - f-) / 2s
//!   and e_k = ((f+ + f-) / 2 - f0) / s, the weighted sums become f0 + m with m = sum e_k / s for the mean, and
//!   sum (o_k o_k' + e_k e_k') plus beta - alpha^2 times m m' for the covariance. A pair that is moved by a linear map has
//!   its image for o_k, and e_k = 0.
//! * The state is ordered so that only the first three columns of the Cholesky factor L move what the circuit is not
//!   linear in. Those of the branches add up to P less the first three columns: they are never computed.
//! * SOC differs in one pair only, so a phase looks its tables up at three places and not at 2 N + 1.
//! * exp(x + d) = exp(x) exp(d), and exp(-2x) = exp(-x)^2 for the branches' noise.
//!
//! In: states, and for each the charge, time, current, temperature and voltage. Out: the new states, and where they may be
//! used: all numbers finite, the covariance with a factor, the reading within the gate.
#![expect(clippy::needless_range_loop, reason = "indices of states say more than iterators over parts of a matrix")]

use std::array::from_fn;

use super::super::noise::{MAX_WALK_S, REST_REPEATS_S};
use super::super::{BRANCHES, CAPACITY, LOG_RESISTANCE, square};
use super::tables::{Around, ERROR_V, Spot, Tables, branch};
use crate::cell::config::{Discretisation, EstimatorConfig};
use crate::cell::model::{CellModel, ERROR_WINDOW_S};
use crate::filter::lanes::{Lanes, Mask};

/// Columns of the factor that move more than branch voltages.
const COLUMNS: usize = 3;

/// What the filters of L cells know: N numbers each, the T of their covariance's lower half, and a memory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct State<const L: usize, const N: usize, const T: usize> {
    /// Means in the order of the estimator's state.
    pub(super) mean: [Lanes<L>; N],
    /// Covariance, row by row to the diagonal.
    pub(super) covariance: [Lanes<L>; T],
    /// See the estimator's `Memory`.
    pub(super) memory: [Lanes<L>; MEMORY],
}

/// Numbers of the estimator's memory that every step changes.
pub(super) const MEMORY: usize = 4;
/// |current| low-passed, A.
pub(super) const LOAD_A: usize = 0;
/// Mean normalised innovation squared.
pub(super) const MEAN_NIS: usize = 1;
/// Time the next reading speaks for, s.
pub(super) const INFORMATION_S: usize = 2;
/// Time at rest, s.
pub(super) const REST_S: usize = 3;

/// Where the covariance of `i` and `j` <= `i` is.
pub(super) const fn at(i: usize, j: usize) -> usize {
    i * (i + 1) / 2 + j
}

/// What happened to L cells since their last step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Input<const L: usize> {
    pub(super) measured_s: Lanes<L>,
    pub(super) charge_as: Lanes<L>,
    pub(super) current_a: Lanes<L>,
    pub(super) voltage_v: Lanes<L>,
    pub(super) temperature_c: Lanes<L>,
    /// What the measured time leaves of memories.
    pub(super) kept: Kept<L>,
}

/// What a time leaves of what fades with it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Kept<const L: usize> {
    /// Of the load's memory.
    load: Lanes<L>,
    /// Of the consistency monitor's.
    consistency: Lanes<L>,
    /// 1 / time, 1/s; 0 where no time passed.
    per_s: Lanes<L>,
}

impl<const L: usize> Kept<L> {
    /// Nothing fades.
    pub(super) const NONE: Self = Self { load: Lanes([1.0; L]), consistency: Lanes([1.0; L]), per_s: Lanes([0.0; L]) };

    #[inline(always)]
    pub(super) fn after(c: &Constants, time_s: Lanes<L>) -> Self {
        Self {
            load: (-(time_s / c.load_memory_s)).exp(),
            consistency: (-(time_s.at_least(1e-3) / c.consistency_window_s)).exp(),
            per_s: time_s.reciprocal().or_else(time_s.above_number(0.0), Lanes::splat(0.0)),
        }
    }

    /// The same of every lane.
    pub(super) fn splat(one: &Kept<1>) -> Self {
        let splat = |x: &Lanes<1>| Lanes::splat(x.0[0]);
        Self { load: splat(&one.load), consistency: splat(&one.consistency), per_s: splat(&one.per_s) }
    }

    pub(super) fn lane(&self, lane: usize) -> Kept<1> {
        let take = |x: &Lanes<L>| Lanes([x.0[lane]]);
        Kept { load: take(&self.load), consistency: take(&self.consistency), per_s: take(&self.per_s) }
    }
}

/// What became of it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Outcome<const L: usize> {
    /// The new state may be used.
    pub(super) is_usable: Mask<L>,
    pub(super) innovation_v: Lanes<L>,
    pub(super) innovation_variance: Lanes<L>,
    pub(super) test_ratio: Lanes<L>,
}

/// The settings as the kernel uses them.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Constants {
    /// s: spread of the sigma points.
    scale: f64,
    /// beta - alpha^2.
    excess: f64,
    euler: bool,
    soc_variance_per_s: f64,
    charge_variance_per_soc: f64,
    branch_variance_per_s: f64,
    log_resistance_variance_per_s: f64,
    sensor_variance: f64,
    /// One-second variance of the model's error; where the tables have none.
    model_variance: f64,
    drop_variance: f64,
    load_variance: f64,
    gate_variance: f64,
    gate_soc_variance: f64,
    gate_limit: f64,
    rest_current_a: f64,
    load_memory_s: f64,
    max_information_s: f64,
    consistency_window_s: f64,
    ocv_ageing_shift: f64,
    new_capacity_ah: f64,
}

impl Constants {
    pub(super) fn new<const N: usize>(model: &CellModel, config: &EstimatorConfig) -> Self {
        Self {
            scale: (square(config.alpha) * (N as f64 + config.kappa)).sqrt(),
            excess: config.beta - square(config.alpha),
            euler: config.discretisation == Discretisation::Euler,
            soc_variance_per_s: square(config.soc_noise_per_sqrt_s),
            charge_variance_per_soc: square(config.charge_noise_per_sqrt_soc),
            branch_variance_per_s: square(config.branch_noise_v_per_sqrt_s),
            log_resistance_variance_per_s: square(config.log_resistance_noise_per_sqrt_s),
            sensor_variance: square(config.voltage_noise_v),
            model_variance: square(config.model_error_v_sqrt_s),
            drop_variance: square(config.drop_error_sqrt_s),
            load_variance: square(config.load_error_sqrt_s),
            gate_variance: square(config.voltage_noise_v) + square(config.gate_model_error_v),
            gate_soc_variance: square(config.gate_soc_error),
            gate_limit: square(config.gate_sigma),
            rest_current_a: config.rest_current_a,
            load_memory_s: config.load_memory_s,
            max_information_s: config.max_information_s,
            consistency_window_s: config.consistency_window_s,
            ocv_ageing_shift: model.ocv_ageing_shift,
            new_capacity_ah: model.capacity_ah,
        }
    }
}

impl<const N: usize, const T: usize> State<1, N, T> {
    /// Copies the states of one lane.
    pub(super) fn of_lane<const L: usize>(all: &State<L, N, T>, lane: usize) -> Self {
        let take = |x: &Lanes<L>| Lanes([x.0[lane]]);
        Self {
            mean: from_fn(|i| take(&all.mean[i])),
            covariance: from_fn(|i| take(&all.covariance[i])),
            memory: from_fn(|i| take(&all.memory[i])),
        }
    }
}

impl<const L: usize, const N: usize, const T: usize> State<L, N, T> {
    /// Puts the state of one cell into a lane.
    pub(super) fn set_lane(&mut self, lane: usize, one: &State<1, N, T>) {
        let all = self.mean.iter_mut().chain(&mut self.covariance).chain(&mut self.memory);
        let new = one.mean.iter().chain(&one.covariance).chain(&one.memory);
        all.zip(new).for_each(|(all, new)| all.0[lane] = new.0[0]);
    }

    /// The new state where the mask says so.
    #[inline(always)]
    pub(super) fn take_where(&mut self, mask: Mask<L>, new: &Self) {
        for i in 0..N {
            self.mean[i] = new.mean[i].or_else(mask, self.mean[i]);
        }
        for i in 0..T {
            self.covariance[i] = new.covariance[i].or_else(mask, self.covariance[i]);
        }
        for i in 0..MEMORY {
            self.memory[i] = new.memory[i].or_else(mask, self.memory[i]);
        }
    }
}

/// The first columns of the lower Cholesky factor, and what they leave of the branches' covariance.
struct Factor<const L: usize, const N: usize> {
    columns: [[Lanes<L>; N]; COLUMNS],
    /// `rest[i][j]`, both of the branches, j <= i; zero elsewhere.
    rest: [[Lanes<L>; N]; N],
    is_positive: Mask<L>,
}

impl<const L: usize, const N: usize> Factor<L, N> {
    #[inline(always)]
    fn new<const T: usize>(covariance: &[Lanes<L>; T]) -> Self {
        let first = column::<L, N, T, 0>(covariance, []);
        let second = column::<L, N, T, 1>(covariance, [&first]);
        let third = column::<L, N, T, 2>(covariance, [&first, &second]);
        let columns = [first, second, third];
        let mut rest = [[Lanes::splat(0.0); N]; N];
        for i in COLUMNS..N {
            for j in COLUMNS..=i {
                let mut left = covariance[at(i, j)];
                for column in &columns {
                    left = left - column[i] * column[j];
                }
                rest[i][j] = left;
            }
        }
        Self { columns, is_positive: is_positive(&rest), rest }
    }
}

/// Column K of the factor, from those before it. NaN where there is none: it goes on into every result.
#[inline(always)]
fn column<const L: usize, const N: usize, const T: usize, const K: usize>(
    covariance: &[Lanes<L>; T],
    done: [&[Lanes<L>; N]; K],
) -> [Lanes<L>; N] {
    let left = |i: usize| done.iter().fold(covariance[at(i, K)], |left, done| left - done[i] * done[K]);
    let root = left(K).sqrt();
    let inverse = root.reciprocal();
    let mut column = [Lanes::splat(0.0); N];
    column[K] = root;
    for i in K + 1..N {
        column[i] = left(i) * inverse;
    }
    column
}

/// Whether what is left has a factor, too.
#[inline(always)]
fn is_positive<const L: usize, const N: usize>(rest: &[[Lanes<L>; N]; N]) -> Mask<L> {
    let mut left = *rest;
    let mut positive = Mask::splat(true);
    for k in COLUMNS..N {
        positive = positive & left[k][k].above_number(0.0);
        for i in k + 1..N {
            let factor = left[i][k] / left[k][k];
            for j in k + 1..=i {
                left[i][j] = left[i][j] - factor * left[j][k];
            }
        }
    }
    positive
}

/// The resistance ratios of the sigma points: at the centre, and growth over the first two pairs.
struct Ratios<const L: usize> {
    /// Factor of the first pair's plus and minus point.
    first: [Lanes<L>; 2],
    /// Odd and even part of the second pair's factor: sinh d / s and (cosh d - 1) / s.
    second: [Lanes<L>; 2],
}

impl<const L: usize> Ratios<L> {
    #[inline(always)]
    fn new<const N: usize>(c: &Constants, columns: &[[Lanes<L>; N]; COLUMNS]) -> Self {
        let (up, down) = (columns[0][LOG_RESISTANCE] * c.scale).exp_of_both_signs();
        let (grown, shrunk) = (columns[1][LOG_RESISTANCE] * c.scale).exp_of_both_signs();
        let per_scale = 1.0 / c.scale;
        Self {
            first: [up, down],
            second: [(grown - shrunk) * (0.5 * per_scale), ((grown + shrunk) * 0.5 - Lanes::splat(1.0)) * per_scale],
        }
    }
}

/// One ordinary step.
#[inline(always)]
pub(super) fn step<const L: usize, const N: usize, const T: usize, const W: usize>(
    tables: &mut Tables<W>,
    around: &mut Around<L, W>,
    c: &Constants,
    before: &State<L, N, T>,
    input: &Input<L>,
) -> (State<L, N, T>, Outcome<L>) {
    tables.warm(around, &input.temperature_c);
    let ratio = before.mean[LOG_RESISTANCE].exp();
    let (mean, covariance, has_factor) = predict(tables, around, c, before, input, ratio);
    let mut x = State { mean, covariance, memory: before.memory };
    let information_s = remember(c, &mut x, input);
    let mut outcome = update(tables, around, c, &mut x, input, ratio, information_s);
    x.memory[INFORMATION_S] = Lanes::splat(0.0);
    let forget = Lanes::splat(1.0) - input.kept.consistency;
    x.memory[MEAN_NIS] = x.memory[MEAN_NIS] + forget * (outcome.test_ratio - x.memory[MEAN_NIS]);
    // One number that is not finite makes the sum one that is not.
    let mut sum = outcome.innovation_variance + outcome.test_ratio;
    for number in x.mean.iter().chain(&x.covariance) {
        sum = sum + *number;
    }
    let least = (1..N).fold(x.covariance[at(0, 0)], |least, i| least.smaller(x.covariance[at(i, i)]));
    outcome.is_usable = outcome.is_usable & has_factor & sum.is_finite() & least.above_number(0.0);
    (x, outcome)
}

/// A branch at L places of the tables.
struct BranchAt<const L: usize> {
    /// Resistance of new cells, ohm.
    r_ohm: Lanes<L>,
    tau_s: Lanes<L>,
    /// What is left of the branch's voltage after the measured time.
    kept: Lanes<L>,
    /// The same, exact whatever the rule.
    exact: Lanes<L>,
}

impl<const L: usize> BranchAt<L> {
    #[inline(always)]
    fn new<const W: usize>(c: &Constants, input: &Input<L>, spot: &Spot<L, W>, i: usize) -> Self {
        let (r_ohm, tau_s) = spot.branch(i - BRANCHES);
        let ratio = input.measured_s / tau_s;
        let exact = (-ratio).exp();
        let one = Lanes::splat(1.0);
        let kept = if c.euler { (one - ratio).or_else(one.above(ratio), exact) } else { exact };
        Self { r_ohm, tau_s, kept, exact }
    }

    /// Voltage of a branch that was at `u` under a current that would take a new one's to `r_ohm` x `drive`.
    #[inline(always)]
    fn voltage_v(&self, drive: Lanes<L>, u: Lanes<L>) -> Lanes<L> {
        self.r_ohm * drive * (Lanes::splat(1.0) - self.kept) + u * self.kept
    }
}

#[inline(always)]
fn sum<const L: usize>(a: [Lanes<L>; COLUMNS], b: [Lanes<L>; COLUMNS]) -> Lanes<L> {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Odd and even parts of something over the pairs of the first columns.
#[derive(Clone, Copy)]
struct Parts<const L: usize> {
    odd: [Lanes<L>; COLUMNS],
    even: [Lanes<L>; COLUMNS],
}

impl<const L: usize> Parts<L> {
    const NONE: Self = Self { odd: [Lanes([0.0; L]); COLUMNS], even: [Lanes([0.0; L]); COLUMNS] };

    /// Of the first pair, from what its plus and minus point and the centre became.
    #[inline(always)]
    fn put(&mut self, c: &Constants, k: usize, plus: Lanes<L>, minus: Lanes<L>, centre: Lanes<L>) {
        self.odd[k] = (plus - minus) * (0.5 / c.scale);
        self.even[k] = ((plus + minus) * 0.5 - centre) * (1.0 / c.scale);
    }

    /// Mean of what the pairs are moved by beside the centre.
    #[inline(always)]
    fn shift(&self, c: &Constants) -> Lanes<L> {
        (self.even[0] + self.even[1] + self.even[2]) * (1.0 / c.scale)
    }
}

/// What the charge `charge_ah` that was taken out does to the SOC: what it loses at the centre, and over the pairs, linear
/// but for the charge over the capacity.
#[inline(always)]
fn soc_parts<const L: usize, const N: usize>(
    c: &Constants,
    l: &[[Lanes<L>; N]; COLUMNS],
    capacity_ah: Lanes<L>,
    charge_ah: Lanes<L>,
) -> (Lanes<L>, Parts<L>) {
    let per_capacity = capacity_ah.reciprocal();
    let mut parts = Parts::NONE;
    for k in 0..COLUMNS {
        let spread = l[k][CAPACITY] * c.scale;
        let pair = charge_ah / (capacity_ah.square() - spread.square());
        parts.odd[k] = l[k][CAPACITY] * pair;
        parts.even[k] = -(parts.odd[k] * spread * per_capacity);
    }
    parts.odd[0] = parts.odd[0] + l[0][0];
    (charge_ah * per_capacity, parts)
}

/// What a branch becomes.
struct BranchParts<const L: usize> {
    /// Its voltage at the centre.
    centre_v: Lanes<L>,
    /// What is left of what it was, at the centre.
    kept: Lanes<L>,
    noise: Lanes<L>,
    parts: Parts<L>,
}

/// Branch `i` of the state under a current that would take a new cell's to its resistance times `drive`: the pair of the
/// first column has other tables, that of the second another resistance.
#[inline(always)]
fn branch_parts<const L: usize, const N: usize, const W: usize>(
    c: &Constants,
    input: &Input<L>,
    spots: &[Spot<L, W>; 3],
    l: &[[Lanes<L>; N]; COLUMNS],
    (i, before_v, drive, ratios): (usize, Lanes<L>, Lanes<L>, &Ratios<L>),
) -> BranchParts<L> {
    let one = Lanes::splat(1.0);
    let here = BranchAt::new(c, input, &spots[0], i);
    let kept = here.kept;
    let gain = here.r_ohm * drive * (one - kept);
    let centre_v = gain + before_v * kept;
    let reach = l[0][i] * c.scale;
    let plus = BranchAt::new(c, input, &spots[1], i).voltage_v(drive * ratios.first[0], before_v + reach);
    let minus = BranchAt::new(c, input, &spots[2], i).voltage_v(drive * ratios.first[1], before_v - reach);
    let mut parts = Parts::NONE;
    parts.put(c, 0, plus, minus, centre_v);
    parts.odd[1] = gain * ratios.second[0] + kept * l[1][i];
    parts.even[1] = gain * ratios.second[1];
    parts.odd[2] = kept * l[2][i];
    let noise = here.tau_s * (0.5 * c.branch_variance_per_s) * (one - here.exact.square());
    BranchParts { centre_v, kept, noise, parts }
}

/// The circuit's equations over the measured time: mean, covariance, and where the covariance before had a factor.
#[inline(always)]
fn predict<const L: usize, const N: usize, const T: usize, const W: usize>(
    tables: &mut Tables<W>,
    around: &mut Around<L, W>,
    c: &Constants,
    x: &State<L, N, T>,
    input: &Input<L>,
    ratio: Lanes<L>,
) -> ([Lanes<L>; N], [Lanes<L>; T], Mask<L>) {
    let Factor { columns: l, is_positive, .. } = Factor::<L, N>::new(&x.covariance);
    let dt = input.measured_s;
    let charge_ah = input.charge_as * (1.0 / 3600.0);
    let (moved, soc) = soc_parts(c, &l, x.mean[CAPACITY], charge_ah);
    let spots = tables.spots(around, x.mean[0] - moved * 0.5, l[0][0] * c.scale);
    let ratios = Ratios::new(c, &l);
    let drive = ratio * (input.charge_as * input.kept.per_s);

    let soc_shift = soc.shift(c);
    let (mut mean, mut p) = (x.mean, x.covariance);
    mean[0] = x.mean[0] - moved + soc_shift;
    let capacity_column = [l[0][CAPACITY], l[1][CAPACITY], l[2][CAPACITY]];
    let soc_noise = dt * c.soc_variance_per_s + moved.abs() * c.charge_variance_per_soc;
    p[at(0, 0)] = sum(soc.odd, soc.odd) + sum(soc.even, soc.even) + soc_shift.square() * c.excess + soc_noise;
    p[at(LOG_RESISTANCE, 0)] = soc.odd[0] * l[0][LOG_RESISTANCE] + soc.odd[1] * l[1][LOG_RESISTANCE];
    p[at(CAPACITY, 0)] = sum(soc.odd, capacity_column);
    let log_resistance = at(LOG_RESISTANCE, LOG_RESISTANCE);
    p[log_resistance] = p[log_resistance] + dt.at_most(MAX_WALK_S) * c.log_resistance_variance_per_s;
    let mut done = [(Parts::NONE, Lanes::splat(0.0)); N];
    for i in BRANCHES..N {
        let branch = branch_parts(c, input, &spots, &l, (i, x.mean[i], drive, &ratios));
        let Parts { odd, even } = branch.parts;
        let u_shift = branch.parts.shift(c);
        done[i] = (branch.parts, branch.kept);
        mean[i] = branch.centre_v + u_shift;
        p[at(i, 0)] = sum(soc.odd, odd) + sum(soc.even, even) + soc_shift * u_shift * c.excess;
        p[at(i, LOG_RESISTANCE)] = l[0][LOG_RESISTANCE] * odd[0] + l[1][LOG_RESISTANCE] * odd[1];
        p[at(i, CAPACITY)] = sum(capacity_column, odd);
        for j in BRANCHES..=i {
            let (other, other_kept) = &done[j];
            // All columns beyond the second are moved alike.
            let others = x.covariance[at(i, j)] - l[0][i] * l[0][j] - l[1][i] * l[1][j];
            p[at(i, j)] = odd[0] * other.odd[0]
                + odd[1] * other.odd[1]
                + branch.kept * *other_kept * others
                + even[0] * other.even[0]
                + even[1] * other.even[1]
                + u_shift * other.shift(c) * c.excess;
        }
        p[at(i, i)] = p[at(i, i)] + branch.noise;
    }
    (mean, p, is_positive)
}

/// Follows the load, and the time the reading speaks for, which is given, s.
#[inline(always)]
fn remember<const L: usize, const N: usize, const T: usize>(
    c: &Constants,
    x: &mut State<L, N, T>,
    input: &Input<L>,
) -> Lanes<L> {
    let dt = input.measured_s;
    let moved_as = input.charge_as.abs();
    let load_a = x.memory[LOAD_A];
    let mean_a = moved_as * input.kept.per_s;
    let kept_a = mean_a + (load_a - mean_a) * input.kept.load;
    x.memory[LOAD_A] = kept_a.or_else(dt.above_number(0.0), load_a);

    let is_loaded = moved_as.above(dt * c.rest_current_a);
    let rested_s = x.memory[REST_S] + dt;
    let mut new_s = dt;
    if (!is_loaded).any() {
        let repeats = Lanes::splat(REST_REPEATS_S);
        let logarithm = ((repeats + rested_s) / (repeats + x.memory[REST_S])).ln();
        new_s = dt.or_else(is_loaded, logarithm * REST_REPEATS_S);
    }
    x.memory[REST_S] = Lanes::splat(0.0).or_else(is_loaded, rested_s);
    (x.memory[INFORMATION_S] + new_s).at_least(1e-3).at_most(c.max_information_s)
}

/// The voltage that is foreseen.
struct Foreseen<const L: usize> {
    /// At the centre, V.
    centre_v: Lanes<L>,
    /// Over the pairs of the first columns.
    parts: Parts<L>,
    /// Slope of the open-circuit voltage, V per unit of SOC.
    slope_v: Lanes<L>,
    /// Voltage lost in the cell now, V.
    lost_v: Lanes<L>,
    /// Standard deviation of the model's error over one second, squared.
    base_variance: Lanes<L>,
    /// Resistance of new cells once every branch has settled, ohm.
    settled_ohm: Lanes<L>,
}

impl<const L: usize> Foreseen<L> {
    #[inline(always)]
    fn new<const N: usize, const T: usize, const W: usize>(
        tables: &mut Tables<W>,
        around: &mut Around<L, W>,
        c: &Constants,
        x: &State<L, N, T>,
        input: &Input<L>,
        l: &[[Lanes<L>; N]; COLUMNS],
        ratio: Lanes<L>,
    ) -> Self {
        let reach = l[0][0] * c.scale;
        let mut parts = Parts::NONE;
        let aged = (c.ocv_ageing_shift != 0.0).then(|| aged_voltages(tables, around, c, x, l, &mut parts));
        let spots = tables.spots(around, x.mean[0], reach);
        let ratios = Ratios::new(c, l);
        let (mut ocv_v, slope_v, r0_ohm) = spots[0].ocv_and_r0();
        let (plus_v, _, plus_ohm) = spots[1].ocv_and_r0();
        let (minus_v, _, minus_ohm) = spots[2].ocv_and_r0();
        let mut side_v = [plus_v, minus_v];
        if let Some(aged) = aged {
            (ocv_v, side_v) = aged;
        }
        let mut settled_ohm = r0_ohm;
        let mut branches_v = Lanes::splat(0.0);
        let mut branches = [Lanes::splat(0.0); COLUMNS];
        for i in BRANCHES..N {
            settled_ohm = settled_ohm + spots[0].one(branch(i - BRANCHES));
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
            spots[0].one(ERROR_V).square() * ERROR_WINDOW_S
        } else {
            Lanes::splat(c.model_variance)
        };
        Self { centre_v, parts, slope_v, lost_v: drop_v + branches_v, base_variance, settled_ohm }
    }
}

/// Open-circuit voltages of aged cells at the centre and the first pair, V; the parts of the other pairs, whose capacity is
/// another.
#[inline(always)]
fn aged_voltages<const L: usize, const N: usize, const T: usize, const W: usize>(
    tables: &mut Tables<W>,
    around: &Around<L, W>,
    c: &Constants,
    x: &State<L, N, T>,
    l: &[[Lanes<L>; N]; COLUMNS],
    parts: &mut Parts<L>,
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
    // A loop, not seven copies of the look-up: few cells are modelled so.
    let mut voltages = [Lanes::splat(0.0); 7];
    for (voltage, (soc, capacity_ah)) in voltages.iter_mut().zip(places) {
        *voltage = aged_ocv_v(tables, around, c, soc, capacity_ah);
    }
    let [centre_v, plus, minus, plus_1, minus_1, plus_2, minus_2] = voltages;
    parts.put(c, 1, plus_1, minus_1, centre_v);
    parts.put(c, 2, plus_2, minus_2, centre_v);
    (centre_v, [plus, minus])
}

/// The measurement update: moves `x`, whether that may be used or not.
#[inline(always)]
fn update<const L: usize, const N: usize, const T: usize, const W: usize>(
    tables: &mut Tables<W>,
    around: &mut Around<L, W>,
    c: &Constants,
    x: &mut State<L, N, T>,
    input: &Input<L>,
    ratio: Lanes<L>,
    information_s: Lanes<L>,
) -> Outcome<L> {
    let Factor { columns: l, rest, is_positive } = Factor::<L, N>::new(&x.covariance);
    let foreseen = Foreseen::new(tables, around, c, x, input, &l, ratio);
    let Parts { odd, even } = foreseen.parts;
    let shift_v = foreseen.parts.shift(c);

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

    // What noise the reading carries: see `noise::Reading`.
    let load_v = foreseen.settled_ohm * ratio * x.memory[LOAD_A];
    let model = foreseen.base_variance + foreseen.lost_v.square() * c.drop_variance + load_v.square() * c.load_variance;
    let total = variance + (model / information_s + c.sensor_variance);
    let innovation_v = input.voltage_v - (foreseen.centre_v + shift_v);
    let gate = variance + (foreseen.slope_v.square() * c.gate_soc_variance + c.gate_variance);
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
    let is_usable = is_positive & total.above_number(0.0) & !test_ratio.above_number(c.gate_limit);
    Outcome { is_usable, innovation_v, innovation_variance: total, test_ratio }
}

/// Open-circuit voltage of a cell that has aged to a capacity, V: that of a new one at [`CellModel::ocv_soc`].
#[inline(always)]
fn aged_ocv_v<const L: usize, const W: usize>(
    tables: &mut Tables<W>,
    around: &Around<L, W>,
    c: &Constants,
    soc: Lanes<L>,
    capacity_ah: Lanes<L>,
) -> Lanes<L> {
    let one = Lanes::splat(1.0);
    let lost = (one - capacity_ah / c.new_capacity_ah) * c.ocv_ageing_shift;
    let inside = soc.at_least(0.0).at_most(1.0);
    let soc = soc + lost.at_least(-0.9).at_most(0.9) * inside * (one - inside);
    tables.ocv_v(around, &soc)
}
