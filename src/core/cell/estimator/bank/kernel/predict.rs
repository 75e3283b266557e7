//! The circuit's equations over a measured time.
//!
//! In: the state before, the charge and the time. Out: mean and covariance after it, in the units of the states.

use super::points::{COLUMNS, Factor, Parts, Ratios, sum};
use super::{Constants, Input, State, at};
use crate::cell::estimator::bank::tables::{Around, Spot, Tables};
use crate::cell::estimator::noise::MAX_WALK_S;
use crate::cell::estimator::{BRANCHES, CAPACITY, LOG_RESISTANCE};
use crate::filter::simd::{Lanes, Mask};

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
pub(super) fn predict<const L: usize, const N: usize, const T: usize, const W: usize>(
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
