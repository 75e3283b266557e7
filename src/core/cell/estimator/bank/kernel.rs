//! Computes ordinary steps (see [`super`]) of L cells at once: a prediction over a measured time, and an update with a
//! voltage that passes the gate (it is not rejected as implausible).
//!
//! The filter is described in [`estimator`](crate::cell::estimator), the circuit in [`crate::cell::circuit`]. The
//! results agree with the textbook form up to rounding. These exact rearrangements save work:
//! * Sigma points come in pairs x +- s L_k with s = sqrt(N + lambda). L_k is column k of the lower Cholesky factor of
//!   the covariance P. A function f has the values f+ and f- at the two points of a pair and f0 at the centre.
//!   The odd part of f is o_k = (f+ - f-) / 2s. The even part of f is e_k = ((f+ + f-) / 2 - f0) / s.
//!   With m = sum e_k / s, the mean is f0 + m.
//!   The covariance is sum (o_k o_k' + e_k e_k') + (beta - alpha^2) m m'.
//!   If a linear map moves the pair, o_k is the image of L_k and e_k = 0.
//! * Because of the order of the states, only the first three columns of the Cholesky factor change nonlinear states.
//!   The outer products of the other columns (the branches) add up to P minus the outer products of the first three
//!   columns. The columns of the branches are therefore never computed.
//! * Only one pair has another SOC than the centre, so prediction and update each read the tables at three points
//!   instead of 2 N + 1.
//! * For each SOC interval, the tables contain a straight line per quantity (value and slope). The lines in use are
//!   cached from step to step: [`LineCache`].
//! * One exponential serves several terms: exp(x + d) = exp(x) exp(d). For the branches' noise, exp(-2x) = exp(-x)^2.
//!
//! In: states, and for each state the charge (A s), time (s), current (A), temperature (degrees C) and voltage (V).
//! Out: the new states and a mask of usable states. A state is usable if its numbers are finite and possible, its
//! covariance is positive definite, and its reading is within the gate.
#![expect(clippy::needless_range_loop, reason = "indices of states say more than iterators over parts of a matrix")]

mod points;
mod predict;
mod types;
mod update;

pub(super) use predict::predict;
pub(super) use types::{
    CURVE_AH, CURVE_STD_AH, DecayFactors, FilterState, HotMemory, INFORMATION_S, KernelConstants, LOAD_A, MEAN_NIS,
    MEMORY, OFFSET_INFORMATION, OFFSET_SCORE, REST_S, SLOW_INFORMATION, SLOW_RATIO, SLOW_SCORE, SLOW_STD, StepInput,
    StepOutcome, at,
};
pub(super) use update::update;

use super::tables::{LineCache, Tables};
use crate::cell::estimator::state_vector::{CAPACITY, LOG_RESISTANCE};
use crate::filter::simd::{Lanes, Mask};
use crate::quantity::bounds::{self, Bounds};

#[inline(always)]
pub(super) fn step<const L: usize, const N: usize, const T: usize, const W: usize>(
    tables: &mut Tables<W>,
    cache: &mut LineCache<L, W>,
    c: &KernelConstants,
    before: &FilterState<L, N, T>,
    input: &StepInput<L>,
) -> (FilterState<L, N, T>, StepOutcome<L>) {
    tables.refresh_temperatures(cache, &input.temperature_c);
    let ratio = before.mean[LOG_RESISTANCE].exp();
    tables.refresh_capacities(cache, &before.memory[CURVE_AH]);
    let (mut x, has_factor) = predict(tables, cache, c, before, input, (ratio, c.process.soc_per_s));
    update_memory(c, &mut x.memory, input);
    let information_s = c.information_s(&x.memory);
    let mut outcome = update(tables, cache, c, &mut x, input, (ratio, information_s));
    x.memory[INFORMATION_S] = Lanes::splat(0.0);
    let forget = Lanes::splat(1.0) - input.decay.consistency;
    x.memory[MEAN_NIS] = x.memory[MEAN_NIS] + forget * (outcome.test_ratio - x.memory[MEAN_NIS]);
    let evidence = EVIDENCE.iter().fold(outcome.innovation_variance + outcome.test_ratio, |sum, &i| sum + x.memory[i]);
    outcome.is_usable =
        outcome.is_usable & outcome.is_accepted & has_factor & has_variances(&x, evidence) & is_possible(&x);
    (x, outcome)
}

pub(super) const EVIDENCE: [usize; 4] = [OFFSET_INFORMATION, OFFSET_SCORE, SLOW_INFORMATION, SLOW_SCORE];

/// Whether all numbers of a state and `others` (the sum of further numbers) are finite and all variances are positive.
#[inline(always)]
pub(super) fn has_variances<const L: usize, const N: usize, const T: usize>(
    x: &FilterState<L, N, T>,
    others: Lanes<L>,
) -> Mask<L> {
    let sum = x.mean.iter().chain(&x.covariance).fold(others, |sum, number| sum + *number);
    let least = (1..N).fold(x.covariance[at(0, 0)], |least, i| least.smaller(x.covariance[at(i, i)]));
    sum.is_finite() & least.above_number(0.0)
}

/// Whether the state is physically possible (see `Gaussian::is_possible`), and whether the evidence is in the range
/// that can be stored.
#[inline(always)]
fn is_possible<const L: usize, const N: usize, const T: usize>(x: &FilterState<L, N, T>) -> Mask<L> {
    let within = |value: Lanes<L>, bounds: Bounds| {
        let (centre, reach) = (0.5 * (bounds.low + bounds.high), 0.5 * (bounds.high - bounds.low));
        !(value - Lanes::splat(centre)).abs().above_number(reach)
    };
    let mut is_possible = within(x.mean[0], bounds::FILTER_SOC)
        & within(x.mean[LOG_RESISTANCE], bounds::LOG_RESISTANCE)
        & within(x.mean[CAPACITY], bounds::CAPACITY_AH)
        & !Lanes::splat(bounds::CAPACITY_AH.low).above(x.mean[CAPACITY]);
    for i in EVIDENCE {
        is_possible = is_possible & within(x.memory[i], bounds::NUMBER);
    }
    for i in 0..N {
        is_possible = is_possible & !x.covariance[at(i, i)].above_number(bounds::NUMBER.high);
    }
    is_possible
}

/// Time at rest (s) after which further voltages add little information, because they only show relaxation that is
/// slower than the branches.
const REST_REPEATS_S: f64 = 1000.0;

#[inline(always)]
pub(super) fn update_memory<const L: usize>(
    c: &KernelConstants,
    memory: &mut [Lanes<L>; MEMORY],
    input: &StepInput<L>,
) {
    let dt = input.measured_s;
    let moved_as = input.charge_as.abs();
    let load_a = memory[LOAD_A];
    let mean_a = moved_as * input.decay.per_s;
    let kept_a = mean_a + (load_a - mean_a) * input.decay.load;
    memory[LOAD_A] = kept_a.or_else(dt.above_number(0.0), load_a);

    let is_loaded = moved_as.above(dt * c.rest_current_a);
    let rested_s = memory[REST_S] + dt;
    let mut new_s = dt;
    if (!is_loaded).any() {
        let repeats = Lanes::splat(REST_REPEATS_S);
        let logarithm = ((repeats + rested_s) / (repeats + memory[REST_S])).ln();
        new_s = dt.or_else(is_loaded, logarithm * REST_REPEATS_S);
    }
    memory[REST_S] = Lanes::splat(0.0).or_else(is_loaded, rested_s);
    memory[INFORMATION_S] = memory[INFORMATION_S] + new_s;
}
