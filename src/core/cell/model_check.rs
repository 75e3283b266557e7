//! Checks whether the configured model fits the cell. A check takes a window of one hour of use.
//!
//! In: innovations (V) with their variances (V^2), SOC and the learned resistance, every 10 s of use. Out: after 10
//! minutes of use, [`ModelCheck::mismatch`], which is above 1 if the model belongs to another cell. Readings at rest,
//! after a gap, without an update or outside the innovation gate do not count.
//!
//! A filter with a wrong model corrects first the resistance and then the SOC, which hides the error from its
//! innovations. Two kinds of evidence remain:
//! * r^2, the square of ln(resistance relative to a new cell) divided by its configured standard deviation.
//! * c^2 = g' (A + P^-1)^-1 g, the part of the innovations v that a constant a and a slope b over SOC explain (score
//!   test; Cox and Hinkley, Theoretical Statistics, 1974, section 9.3). A and g are the sums of `h h' / R` and `h v /
//!   R` with h = (1, SOC - 0.5). R is the variance of an innovation, scaled to the time that the reading represents. P
//!   contains the variances of a and b for the models of other cells ([`CURVE_STD_V`]).
//!
//! The two kinds are added up. Each kind counts at most [`CORROBORATED`] times as much as the other, because only a
//! wrong model makes both large. An aged cell has a higher resistance, but its voltages fit. A local error of a cell's
//! own curve does not change the resistance.
//!
//! The check ends after [`WINDOW_S`] without a mismatch, because a cell does not become another cell. After a mismatch,
//! the following windows are judged until a window has no mismatch. An aged cell is thus trusted again after its
//! capacity and resistance have been learned.

use serde::{Deserialize, Serialize};

use crate::cell::{CellModel, Update};
use crate::filter::square;
use crate::quantity::InvalidState;

/// Duration of use in a window (s). On drives from -10 to 40 degrees C, half of this time suffices to recognise another
/// cell. In a longer window, the cell would age.
const WINDOW_S: f64 = 3600.0;

/// Standard deviations of the difference to another cell's curve: constant (V), and slope (V per unit of SOC).
const CURVE_STD_V: [f64; 2] = [0.2, 0.4];

/// Each kind of evidence counts at most this many times as much as the other kind.
const CORROBORATED: f64 = 4.0;

/// Minimum evidence of a mismatch: three parts (constant, slope, resistance) of 1.4 standard deviations each.
const LIMIT: f64 = 6.0;

/// Evidence about one cell's model.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct ModelCheck {
    /// The checked model ([`model_id`]); 0 = no check.
    model: u64,
    use_s: f64,
    /// Time (s) and charge (A s) since evidence was last taken.
    since_s: f64,
    since_as: f64,
    step_s: f64,
    voltages: VoltageSums,
    /// Maximum evidence in this window, divided by [`LIMIT`].
    mismatch: f64,
    /// `mismatch` of the previous window if it was above 1, else 0.
    before: f64,
}

/// Sums over the readings of a window, relative to the mean SOC of the readings. While the SOC hardly changes, sums
/// relative to a fixed SOC would be small differences of large numbers. The store rounds numbers, so the differences
/// would be lost.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(from = "[f64; 5]", into = "[f64; 5]")]
struct VoltageSums {
    /// Sum of 1 / R (V^-2).
    weight: f64,
    /// Mean SOC, weighted by 1 / R.
    mean_soc: f64,
    /// Sum of (SOC - mean)^2 / R (V^-2).
    spread: f64,
    /// Sums of v / R and (SOC - mean) v / R (V^-1).
    score: [f64; 2],
}

impl From<[f64; 5]> for VoltageSums {
    fn from([weight, mean_soc, spread, constant, slope]: [f64; 5]) -> Self {
        Self { weight, mean_soc, spread, score: [constant, slope] }
    }
}

impl From<VoltageSums> for [f64; 5] {
    fn from(sums: VoltageSums) -> Self {
        [sums.weight, sums.mean_soc, sums.spread, sums.score[0], sums.score[1]]
    }
}

impl VoltageSums {
    fn add(&mut self, soc: f64, innovation: f64, variance: f64) {
        let weight = 1.0 / variance;
        let before = self.mean_soc;
        self.weight += weight;
        self.mean_soc += (soc - before) * weight / self.weight;
        let distance = soc - self.mean_soc;
        self.spread += weight * (soc - before) * distance;
        self.score[1] += self.score[0] * (before - self.mean_soc) + distance * weight * innovation;
        self.score[0] += weight * innovation;
    }

    /// Computes c^2 (see the module header). Products that cancel each other are left out, so no term is negative.
    fn explained(&self) -> f64 {
        let Self { weight, mean_soc, spread, score: [constant, slope] } = *self;
        let [prior_constant, prior_slope] = CURVE_STD_V.map(|std| 1.0 / square(std));
        let from_middle = mean_soc - 0.5;
        let spread = spread + prior_slope;
        let explained = square(constant) * spread
            + square(slope) * weight
            + square(slope + constant * from_middle) * prior_constant;
        explained / (weight * spread + prior_constant * (weight * square(from_middle) + spread))
    }

    fn check(&self) -> Result<(), InvalidState> {
        let Self { weight, mean_soc, spread, score: [constant, slope] } = *self;
        InvalidState::unless_naturals("a sum of the check of a cell's model", [weight, spread])?;
        InvalidState::unless_numbers("a sum of the check of a cell's model", [mean_soc, constant, slope])
    }
}

/// State of a cell's filter when evidence is due.
#[derive(Debug, Clone, Copy)]
pub struct ModelEvidence {
    /// The latest update.
    pub update: Update,
    /// State of charge after the update (fraction).
    pub soc: f64,
    /// ln(resistance relative to a new cell).
    pub log_resistance: f64,
    /// Configured standard deviation of `log_resistance` before the first voltage.
    pub log_resistance_std: f64,
}

/// Identifies a cell model and the expected spread of resistances: the FNV-1a hash of all inputs of the check.
pub fn model_id(model: &CellModel, log_resistance_std: f64) -> u64 {
    let CellModel { soc, temperature_c, ocv_v, r0_ohm, branches, rated_capacity_ah, .. } = model;
    let text =
        format!("{rated_capacity_ah} {log_resistance_std} {soc:?} {temperature_c:?} {ocv_v:?} {r0_ohm:?} {branches:?}");
    text.bytes().fold(0xCBF2_9CE4_8422_2325, |id, byte| (id ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3))
}

impl ModelCheck {
    /// Starts a check of a model ([`model_id`]).
    pub fn new(model: u64) -> Self {
        Self { model, ..Self::default() }
    }

    /// Creates a check that has already ended without a mismatch.
    pub fn ended() -> Self {
        Self { use_s: WINDOW_S, ..Self::default() }
    }

    /// Returns this check if it belongs to the model, otherwise a new check.
    pub fn or_new(self, model: u64) -> Self {
        if self.model == model || self.model == 0 { self } else { Self::new(model) }
    }

    /// Whether this check belongs to another model.
    pub fn is_of_other(&self, model: u64) -> bool {
        self.model != 0 && self.model != model
    }

    /// Whether the check still takes evidence.
    #[inline]
    pub fn is_open(&self) -> bool {
        self.use_s < WINDOW_S
    }

    /// Adds the time (s) and the charge (A s) of a step. A step with unmeasured time discards the time and charge since
    /// the last evidence.
    #[inline]
    pub fn add_step(&mut self, measured_s: f64, charge_as: f64, unmeasured_s: f64) {
        if !self.is_open() {
            return;
        }
        if unmeasured_s > 0.0 {
            (self.since_s, self.since_as, self.step_s) = (0.0, 0.0, 0.0);
            return;
        }
        self.since_s += measured_s;
        self.since_as += charge_as;
        self.step_s = measured_s;
    }

    /// Whether evidence is due.
    #[inline]
    pub fn is_due(&self) -> bool {
        // 10 s are short compared with the 100 s over which a model's stated error is averaged.
        self.since_s >= 10.0 && self.is_open()
    }

    /// Takes the evidence that is due for a cell with the rated capacity `rated_ah` (Ah). `evidence` is `None` if the
    /// filter cannot provide evidence.
    pub fn judge(&mut self, evidence: Option<ModelEvidence>, rated_ah: f64) {
        // One reading represents at most 90 s. Currents below C/50 do not show the resistance.
        let (elapsed_s, charge_as) = (self.since_s.min(90.0), self.since_as);
        let is_used = charge_as.abs() >= 0.02 * rated_ah * self.since_s;
        (self.since_s, self.since_as) = (0.0, 0.0);
        let Some(ModelEvidence { update, soc, log_resistance, log_resistance_std }) = evidence else { return };
        // The filter's variance applies to one step. It is scaled to the time that the reading represents.
        let variance = update.innovation_variance * (self.step_s / elapsed_s).min(1.0);
        let is_number = (update.innovation / variance).is_finite() && soc.is_finite() && log_resistance.is_finite();
        if !is_used || !update.accepted || !is_number {
            return;
        }
        self.use_s += elapsed_s;
        self.voltages.add(soc, update.innovation, variance);
        if self.check().is_err() {
            *self = Self::new(self.model);
        }
        // In the first minutes, the filter still settles, and a single wrong reading has too much weight.
        if self.use_s < 600.0 {
            return;
        }
        let resistance = if log_resistance_std > 0.0 { square(log_resistance / log_resistance_std) } else { 0.0 };
        let curve = self.voltages.explained();
        let sum = resistance.min(CORROBORATED * curve) + curve.min(CORROBORATED * resistance);
        self.mismatch = self.mismatch.max(sum / LIMIT);
        if !self.is_open() {
            let found = if self.mismatch > 1.0 { self.mismatch } else { 0.0 };
            let use_s = if found > 0.0 { 0.0 } else { WINDOW_S };
            *self = Self { before: found, use_s, ..Self::new(self.model) };
        }
    }

    /// Maximum evidence for another cell in this window and the previous window, divided by the limit.
    #[inline]
    pub fn mismatch(&self) -> f64 {
        self.mismatch.max(self.before)
    }

    /// Whether the model belongs to another cell.
    #[inline]
    pub fn is_mismatched(&self) -> bool {
        self.mismatch() > 1.0
    }

    /// Checks stored numbers.
    ///
    /// # Errors
    /// The first number that is out of range.
    pub fn check(&self) -> Result<(), InvalidState> {
        let natural = [self.use_s, self.since_s, self.step_s, self.mismatch, self.before];
        InvalidState::unless_naturals("a number of the check of a cell's model", natural)?;
        InvalidState::unless_number("the charge since the last check of a cell's model", self.since_as)?;
        self.voltages.check()?;
        let most_before = if self.is_open() { f64::MAX } else { 0.0 };
        InvalidState::unless(self.before <= most_before, "a mismatch of a check that has ended", self.before, "0")
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix2, Vector2};

    use super::*;
    use crate::cell::model::tests::small_model;

    /// Returns the check after a discharge at 1 C from SOC 0.9 for `use_s` seconds. `voltage` returns the innovation
    /// (V) at a SOC.
    fn after(use_s: u32, ratio: f64, voltage: impl Fn(f64) -> f64) -> ModelCheck {
        let mut check = ModelCheck::default();
        for second in 0..use_s {
            let soc = 0.9 - f64::from(second) / 3600.0;
            check.add_step(1.0, 2.0, 0.0);
            if check.is_due() {
                let innovation = voltage(soc);
                let update = Update { innovation, innovation_variance: 0.09, test_ratio: 0.0, accepted: true };
                let evidence = ModelEvidence { update, soc, log_resistance: f64::ln(ratio), log_resistance_std: 0.2 };
                check.judge(Some(evidence), 2.0);
            }
        }
        check
    }

    #[test]
    fn other_cell_mismatches_within_half_an_hour() {
        assert!(after(1800, 0.65, |_| 0.02).is_mismatched());
        assert!(after(1800, 1.6, |soc| 0.15 * (soc - 0.65)).is_mismatched());
    }

    #[test]
    fn single_witness_does_not_mismatch() {
        let aged = after(3600, 1.8, |_| 0.0);
        assert!(!aged.is_mismatched() && !aged.is_open(), "{aged:?}");
        let local = after(3600, 1.0, |_| 0.03);
        assert!(!local.is_mismatched(), "{local:?}");
    }

    #[test]
    fn mismatch_lasts_until_a_window_passes() {
        let mut check = after(1800, 0.6, |_| 0.03);
        let judge_an_hour = |check: &mut ModelCheck, innovation, log_resistance| {
            let update = Update { innovation, innovation_variance: 0.09, test_ratio: 0.0, accepted: true };
            for _ in 0..360 {
                check.add_step(10.0, 20.0, 0.0);
                check.judge(Some(ModelEvidence { update, soc: 0.5, log_resistance, log_resistance_std: 0.2 }), 2.0);
            }
        };
        judge_an_hour(&mut check, 0.2, -0.5);
        assert!(check.is_mismatched() && check.is_open(), "the model is still another cell's");
        judge_an_hour(&mut check, 0.0, 0.5);
        judge_an_hour(&mut check, 0.0, 0.5);
        assert_eq!(check, ModelCheck::ended());
        judge_an_hour(&mut check, 0.2, -0.5);
        assert_eq!(check, ModelCheck::ended());
    }

    #[test]
    fn new_model_restarts_the_check() {
        let found = ModelCheck { model: 1, ..after(1800, 0.6, |_| 0.03) };
        assert_eq!((found.or_new(1), found.or_new(2)), (found, ModelCheck::new(2)));
        assert_eq!(ModelCheck::ended().or_new(2), ModelCheck::ended());
        let model = small_model();
        let other = CellModel { rated_capacity_ah: 3.0, ..model.clone() };
        assert_eq!(model_id(&model, 0.2), model_id(&CellModel { name: "another name".into(), ..model.clone() }, 0.2));
        assert!(model_id(&model, 0.2) != model_id(&other, 0.2) && model_id(&model, 0.2) != model_id(&model, 0.4));
    }

    #[test]
    fn stored_sums_that_cannot_be_are_refused() {
        let check = after(1800, 1.0, |soc| soc);
        assert_eq!(check.check(), Ok(()));
        let voltages = VoltageSums { spread: -1.0, ..check.voltages };
        assert!(ModelCheck { voltages, ..check }.check().is_err());
        assert!(ModelCheck { before: 2.0, ..ModelCheck::ended() }.check().is_err());
    }

    #[test]
    fn sums_match_the_score_test() {
        let readings: Vec<[f64; 3]> = (0..90)
            .map(f64::from)
            .map(|i| [0.8 - 0.004 * i, 0.03 + 0.02 * (0.3 * i).sin(), 1e-4 * (1.0 + i)])
            .collect();
        let mut sums = VoltageSums::default();
        let (mut a, mut g) = (Matrix2::zeros(), Vector2::zeros());
        for &[soc, innovation, variance] in &readings {
            sums.add(soc, innovation, variance);
            let h = Vector2::new(1.0, soc - 0.5);
            a += h * h.transpose() / variance;
            g += h * innovation / variance;
        }
        let prior = Matrix2::from_diagonal(&Vector2::from(CURVE_STD_V.map(|std| 1.0 / square(std))));
        let expected = g.dot(&((a + prior).try_inverse().unwrap() * g));
        assert!((sums.explained() / expected - 1.0).abs() < 1e-9, "{} {expected}", sums.explained());
    }

    /// Rounds each sum to 20 bits of the mantissa, which is coarser than the store.
    #[test]
    fn rounded_sums_keep_their_evidence() {
        let mut sums = VoltageSums::default();
        for i in 0..360 {
            sums.add(0.2 + 1e-7 * f64::from(i), 0.002, 1e-7);
        }
        let short = |x: f64| f64::from_bits(x.to_bits() & !((1 << 32) - 1));
        let VoltageSums { weight, mean_soc, spread, score } = sums;
        let kept = VoltageSums {
            weight: short(weight),
            mean_soc: short(mean_soc),
            spread: short(spread),
            score: score.map(short),
        };
        assert_eq!(kept.check(), Ok(()));
        assert!((kept.explained() / sums.explained() - 1.0).abs() < 1e-5, "{} {}", kept.explained(), sums.explained());
    }

    #[test]
    fn rests_gaps_and_outliers_are_not_evidence() {
        let update = Update { innovation: 0.1, innovation_variance: 0.01, test_ratio: 0.0, accepted: true };
        let good = ModelEvidence { update, soc: 0.5, log_resistance: 1.0, log_resistance_std: 0.2 };
        let mut check = ModelCheck::default();
        check.add_step(20.0, 0.0, 0.0);
        check.judge(Some(good), 2.0);
        check.add_step(20.0, 40.0, 0.0);
        check.add_step(1.0, 0.0, 5.0);
        assert!(!check.is_due());
        for update in [
            Update { accepted: false, ..update },
            Update { innovation: f64::NAN, ..update },
            Update { innovation_variance: 0.0, ..update },
        ] {
            check.add_step(20.0, 40.0, 0.0);
            check.judge(Some(ModelEvidence { update, ..good }), 2.0);
        }
        assert_eq!(check, ModelCheck { step_s: 20.0, ..ModelCheck::default() });
        assert_eq!(check.check(), Ok(()));
        assert!(ModelCheck { mismatch: f64::NAN, ..check }.check().is_err());
    }
}
