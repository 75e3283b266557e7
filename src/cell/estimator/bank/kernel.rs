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
use super::tables::{ERROR_V, Spot, Tables, branch};
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
    /// What the measured time leaves of memories.
    pub(super) kept: Kept<L>,
    /// Places of the temperatures in the tables: [`Tables::isotherm`].
    pub(super) isotherms: [usize; L],
}

/// What a time leaves of what fades with it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Kept<const L: usize> {
    /// Of the load's memory.
    load: Lanes<L>,
    /// Of the consistency monitor's.
    consistency: Lanes<L>,
}

impl<const L: usize> Kept<L> {
    /// Nothing fades.
    pub(super) const NONE: Self = Self { load: Lanes([1.0; L]), consistency: Lanes([1.0; L]) };

    #[inline(always)]
    pub(super) fn after(c: &Constants, time_s: Lanes<L>) -> Self {
        Self {
            load: (-(time_s / c.load_memory_s)).exp(),
            consistency: (-(time_s.at_least(1e-3) / c.consistency_window_s)).exp(),
        }
    }

    /// The same of every lane.
    pub(super) fn splat(one: &Kept<1>) -> Self {
        Self { load: Lanes::splat(one.load.0[0]), consistency: Lanes::splat(one.consistency.0[0]) }
    }

    pub(super) fn lane(&self, lane: usize) -> Kept<1> {
        Kept { load: Lanes([self.load.0[lane]]), consistency: Lanes([self.consistency.0[lane]]) }
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
        let zero = Lanes::splat(0.0);
        let mut columns = [[zero; N]; COLUMNS];
        for k in 0..COLUMNS {
            // NaN where there is no factor: it goes on into every result.
            let mut pivot = covariance[at(k, k)];
            for done in &columns[..k] {
                pivot = pivot - done[k].square();
            }
            let root = pivot.sqrt();
            let inverse = root.reciprocal();
            columns[k][k] = root;
            for i in k + 1..N {
                let mut below = covariance[at(i, k)];
                for done in &columns[..k] {
                    below = below - done[i] * done[k];
                }
                columns[k][i] = below * inverse;
            }
        }
        let mut rest = [[zero; N]; N];
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

/// Whether what is left has a factor, too.
#[inline(always)]
fn is_positive<const L: usize, const N: usize>(rest: &[[Lanes<L>; N]; N]) -> Mask<L> {
    let zero = Lanes::splat(0.0);
    let mut left = *rest;
    let mut positive = Mask([true; L]);
    for k in COLUMNS..N {
        positive = positive & left[k][k].above(zero);
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
        let up = (columns[0][LOG_RESISTANCE] * c.scale).exp();
        let grown = (columns[1][LOG_RESISTANCE] * c.scale).exp();
        let shrunk = grown.reciprocal();
        let per_scale = 1.0 / c.scale;
        Self {
            first: [up, up.reciprocal()],
            second: [(grown - shrunk) * (0.5 * per_scale), ((grown + shrunk) * 0.5 - Lanes::splat(1.0)) * per_scale],
        }
    }
}

/// One ordinary step.
#[inline(always)]
pub(super) fn step<const L: usize, const N: usize, const T: usize, const W: usize>(
    tables: &Tables<W>,
    c: &Constants,
    before: &State<L, N, T>,
    input: &Input<L>,
) -> (State<L, N, T>, Outcome<L>) {
    let ratio = before.mean[LOG_RESISTANCE].exp();
    let (mean, covariance, has_factor) = predict(tables, c, before, input, ratio);
    let mut x = State { mean, covariance, memory: before.memory };
    let information_s = remember(c, &mut x, input);
    let mut outcome = update(tables, c, &mut x, input, ratio, information_s);
    x.memory[INFORMATION_S] = Lanes::splat(0.0);
    let forget = Lanes::splat(1.0) - input.kept.consistency;
    x.memory[MEAN_NIS] = x.memory[MEAN_NIS] + forget * (outcome.test_ratio - x.memory[MEAN_NIS]);
    // One number that is not finite makes the sum one that is not.
    let mut sum = x.mean[0];
    for number in x.mean[1..].iter().chain(&x.covariance) {
        sum = sum + *number;
    }
    let mut least = x.covariance[at(0, 0)];
    for i in 1..N {
        least = least.smaller(x.covariance[at(i, i)]);
    }
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
    fn new<const W: usize>(tables: &Tables<W>, c: &Constants, input: &Input<L>, spot: &Spot<L>, i: usize) -> Self {
        let (r_ohm, tau_s) = tables.branch(spot, i - BRANCHES);
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

/// Mean of what the pairs are moved by beside the centre.
#[inline(always)]
fn shift<const L: usize>(c: &Constants, even: [Lanes<L>; COLUMNS]) -> Lanes<L> {
    (even[0] + even[1] + even[2]) * (1.0 / c.scale)
}

/// The circuit's equations over the measured time: mean, covariance, and where the covariance before had a factor.
#[inline(always)]
fn predict<const L: usize, const N: usize, const T: usize, const W: usize>(
    tables: &Tables<W>,
    c: &Constants,
    x: &State<L, N, T>,
    input: &Input<L>,
    ratio: Lanes<L>,
) -> ([Lanes<L>; N], [Lanes<L>; T], Mask<L>) {
    let one = Lanes::splat(1.0);
    let Factor { columns: l, is_positive, .. } = Factor::<L, N>::new(&x.covariance);
    let dt = input.measured_s;
    let charge_ah = input.charge_as * (1.0 / 3600.0);
    let per_capacity = x.mean[CAPACITY].reciprocal();
    let moved = charge_ah * per_capacity;

    // SOC: linear but for the charge over the capacity.
    let mut soc_odd = [Lanes::splat(0.0); COLUMNS];
    let mut soc_even = [Lanes::splat(0.0); COLUMNS];
    for k in 0..COLUMNS {
        let spread = l[k][CAPACITY] * c.scale;
        let pair = charge_ah / (x.mean[CAPACITY].square() - spread.square());
        soc_odd[k] = l[k][CAPACITY] * pair;
        soc_even[k] = -(soc_odd[k] * spread * per_capacity);
    }
    soc_odd[0] = soc_odd[0] + l[0][0];

    // Branches: the pair of the first column has other tables, that of the second another resistance.
    let middle = x.mean[0] - moved * 0.5;
    let reach = l[0][0] * c.scale;
    let spots = tables.spots(&input.isotherms, middle, reach);
    let ratios = Ratios::new(c, &l);
    let is_moving = dt.above_number(0.0);
    let mean_current_a = (input.charge_as / dt).or_else(is_moving, Lanes::splat(0.0));
    let per_scale = 1.0 / c.scale;
    let mut u = [Lanes::splat(0.0); N];
    let mut keeps = [Lanes::splat(0.0); N];
    let mut u_odd = [[Lanes::splat(0.0); N]; COLUMNS];
    let mut u_even = [[Lanes::splat(0.0); N]; COLUMNS];
    let mut noise = [Lanes::splat(0.0); N];
    for i in BRANCHES..N {
        let here = BranchAt::new(tables, c, input, &spots[0], i);
        let kept = here.kept;
        let settled_v = ratio * mean_current_a;
        let gain = here.r_ohm * settled_v * (one - kept);
        u[i] = gain + x.mean[i] * kept;
        keeps[i] = kept;
        noise[i] = here.tau_s * (0.5 * c.branch_variance_per_s) * (one - here.exact.square());

        let reach = l[0][i] * c.scale;
        let plus = BranchAt::new(tables, c, input, &spots[1], i);
        let plus = plus.voltage_v(settled_v * ratios.first[0], x.mean[i] + reach);
        let minus = BranchAt::new(tables, c, input, &spots[2], i);
        let minus = minus.voltage_v(settled_v * ratios.first[1], x.mean[i] - reach);
        u_odd[0][i] = (plus - minus) * (0.5 * per_scale);
        u_even[0][i] = ((plus + minus) * 0.5 - u[i]) * per_scale;
        u_odd[1][i] = gain * ratios.second[0] + kept * l[1][i];
        u_even[1][i] = gain * ratios.second[1];
        u_odd[2][i] = kept * l[2][i];
    }

    let soc_shift = shift(c, soc_even);
    let mut mean = x.mean;
    mean[0] = x.mean[0] - moved + soc_shift;
    let capacity_column = [l[0][CAPACITY], l[1][CAPACITY], l[2][CAPACITY]];
    let mut p = x.covariance;
    let soc_noise = dt * c.soc_variance_per_s + moved.abs() * c.charge_variance_per_soc;
    p[at(0, 0)] = sum(soc_odd, soc_odd) + sum(soc_even, soc_even) + soc_shift.square() * c.excess + soc_noise;
    p[at(LOG_RESISTANCE, 0)] = soc_odd[0] * l[0][LOG_RESISTANCE] + soc_odd[1] * l[1][LOG_RESISTANCE];
    p[at(CAPACITY, 0)] = sum(soc_odd, capacity_column);
    let log_resistance = at(LOG_RESISTANCE, LOG_RESISTANCE);
    p[log_resistance] = p[log_resistance] + dt.at_most(MAX_WALK_S) * c.log_resistance_variance_per_s;
    for i in BRANCHES..N {
        let odd = [u_odd[0][i], u_odd[1][i], u_odd[2][i]];
        let even = [u_even[0][i], u_even[1][i], u_even[2][i]];
        let u_shift = shift(c, even);
        mean[i] = u[i] + u_shift;
        p[at(i, 0)] = sum(soc_odd, odd) + sum(soc_even, even) + soc_shift * u_shift * c.excess;
        p[at(i, LOG_RESISTANCE)] = l[0][LOG_RESISTANCE] * odd[0] + l[1][LOG_RESISTANCE] * odd[1];
        p[at(i, CAPACITY)] = sum(capacity_column, odd);
        for j in BRANCHES..=i {
            let other = [u_even[0][j], u_even[1][j], u_even[2][j]];
            let moved_alike = x.covariance[at(i, j)] - l[0][i] * l[0][j] - l[1][i] * l[1][j];
            p[at(i, j)] = odd[0] * u_odd[0][j]
                + odd[1] * u_odd[1][j]
                + keeps[i] * keeps[j] * moved_alike
                + even[0] * other[0]
                + even[1] * other[1]
                + u_shift * shift(c, other) * c.excess;
        }
        p[at(i, i)] = p[at(i, i)] + noise[i];
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
    let mean_a = moved_as / dt;
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

/// The measurement update: moves `x`, whether that may be used or not.
#[inline(always)]
fn update<const L: usize, const N: usize, const T: usize, const W: usize>(
    tables: &Tables<W>,
    c: &Constants,
    x: &mut State<L, N, T>,
    input: &Input<L>,
    ratio: Lanes<L>,
    information_s: Lanes<L>,
) -> Outcome<L> {
    let Factor { columns: l, rest, is_positive } = Factor::<L, N>::new(&x.covariance);
    let per_scale = 1.0 / c.scale;
    let reach = l[0][0] * c.scale;
    let soc = x.mean[0];
    let spots = tables.spots(&input.isotherms, soc, reach);
    let ratios = Ratios::new(c, &l);
    let (mut ocv_v, slope_v, r0_ohm) = tables.ocv_and_r0(&spots[0]);
    let (plus_v, _, plus_ohm) = tables.ocv_and_r0(&spots[1]);
    let (minus_v, _, minus_ohm) = tables.ocv_and_r0(&spots[2]);
    // Odd and even parts of the voltage over the pairs of the first three columns.
    let mut odd = [Lanes::splat(0.0); COLUMNS];
    let mut even = [Lanes::splat(0.0); COLUMNS];
    let mut side_v = [plus_v, minus_v];
    if c.ocv_ageing_shift != 0.0 {
        let capacity = x.mean[CAPACITY];
        let reach_ah = l[0][CAPACITY] * c.scale;
        ocv_v = aged_ocv_v(tables, c, &input.isotherms, soc, capacity);
        side_v = [
            aged_ocv_v(tables, c, &input.isotherms, soc + reach, capacity + reach_ah),
            aged_ocv_v(tables, c, &input.isotherms, soc - reach, capacity - reach_ah),
        ];
        for k in 1..COLUMNS {
            let reach_ah = l[k][CAPACITY] * c.scale;
            let plus = aged_ocv_v(tables, c, &input.isotherms, soc, capacity + reach_ah);
            let minus = aged_ocv_v(tables, c, &input.isotherms, soc, capacity - reach_ah);
            odd[k] = (plus - minus) * (0.5 * per_scale);
            even[k] = ((plus + minus) * 0.5 - ocv_v) * per_scale;
        }
    }
    // Sums over the branches: the voltage, and the columns.
    let mut branches_v = Lanes::splat(0.0);
    let mut branches = [Lanes::splat(0.0); COLUMNS];
    for i in BRANCHES..N {
        branches_v = branches_v + x.mean[i];
        for k in 0..COLUMNS {
            branches[k] = branches[k] + l[k][i];
        }
    }
    let drop_v = r0_ohm * ratio * input.current_a;
    let centre = ocv_v - branches_v - drop_v;
    let plus = side_v[0] - plus_ohm * ratio * ratios.first[0] * input.current_a;
    let minus = side_v[1] - minus_ohm * ratio * ratios.first[1] * input.current_a;
    odd[0] = (plus - minus) * (0.5 * per_scale) - branches[0];
    even[0] = ((plus + minus) * 0.5 - branches_v - centre) * per_scale;
    odd[1] = odd[1] - branches[1] - drop_v * ratios.second[0];
    even[1] = even[1] - drop_v * ratios.second[1];
    odd[2] = odd[2] - branches[2];
    let shift = shift(c, even);

    // Covariance of state and voltage, and the voltage's variance.
    let mut cross = [Lanes::splat(0.0); N];
    let mut variance = shift.square() * c.excess;
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
    let mut settled_ohm = r0_ohm;
    for i in BRANCHES..N {
        settled_ohm = settled_ohm + tables.one(&spots[0], branch(i - BRANCHES));
    }
    let load_v = settled_ohm * ratio * x.memory[LOAD_A];
    let base = if tables.has_error() {
        tables.one(&spots[0], ERROR_V).square() * ERROR_WINDOW_S
    } else {
        Lanes::splat(c.model_variance)
    };
    let model = base + (drop_v + branches_v).square() * c.drop_variance + load_v.square() * c.load_variance;
    let total = variance + (model / information_s + c.sensor_variance);
    let innovation_v = input.voltage_v - (centre + shift);
    let gate = variance + (slope_v.square() * c.gate_soc_variance + c.gate_variance);
    let test_ratio = innovation_v.square() / gate;

    let inverse = total.reciprocal();
    for i in 0..N {
        let gain = cross[i] * inverse;
        x.mean[i] = x.mean[i] + gain * innovation_v;
        for j in 0..=i {
            x.covariance[at(i, j)] = x.covariance[at(i, j)] - gain * cross[j];
        }
    }
    let is_within = !test_ratio.above_number(c.gate_limit) & total.above_number(0.0) & total.is_finite();
    let is_usable = is_positive & is_within & test_ratio.is_finite();
    Outcome { is_usable, innovation_v, innovation_variance: total, test_ratio }
}

/// Open-circuit voltage of a cell that has aged to a capacity, V: that of a new one at [`CellModel::ocv_soc`].
#[inline(always)]
fn aged_ocv_v<const L: usize, const W: usize>(
    tables: &Tables<W>,
    c: &Constants,
    isotherms: &[usize; L],
    soc: Lanes<L>,
    capacity_ah: Lanes<L>,
) -> Lanes<L> {
    let one = Lanes::splat(1.0);
    let lost = (one - capacity_ah / c.new_capacity_ah) * c.ocv_ageing_shift;
    let inside = soc.at_least(0.0).at_most(1.0);
    let soc = soc + lost.at_least(-0.9).at_most(0.9) * inside * (one - inside);
    tables.ocv_and_r0(&tables.spot(isotherms, soc)).0
}
