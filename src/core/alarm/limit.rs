//! Compares a value with the two thresholds of a rule. The set threshold raises the alarm, and the clear threshold
//! clears it. The outcome is beyond, between, healthy or unknown.
//!
//! A rule compares the value itself (`when = "mean"`), or the probability P that the true value is beyond the threshold
//! (`when = { probability = p }`). For P, the value is assumed to be normally distributed with its standard deviation.
//! The outcome follows from two probabilities:
//!
//! ```text
//! beyond    P(truth beyond the set threshold)   >  p
//! healthy   P(truth beyond the clear threshold) <= min(p, c)
//! ```
//!
//! Here, c is 0.05 for a learned value and 0.5 for other values. Because c is at most 0.5, an alarm clears only if the
//! value is at the clear threshold or better. An uncertainty that grows does not clear it. The clear threshold is never
//! on the bad side of the set threshold, so the second probability is never below the first. A value is therefore never
//! beyond and healthy at the same time. With p = 0.5, the result is the same as for `when = "mean"`. If the standard
//! deviation is needed but missing, the result is unknown.
//!
//! A learned value (a capacity, a resistance, a remaining life) does not recover by itself. To clear its alarm, P(truth
//! beyond the clear threshold) <= c must therefore also hold with `when = "mean"`. An estimate that fluctuates around
//! its threshold then does not clear its alarm.

use serde::{Deserialize, Serialize};

use super::rule::{Direction, Rule, Severity};
use crate::filter::probability_below;

/// How a value is compared with a threshold.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Comparison {
    /// The value itself is compared with the threshold.
    Mean,
    /// The probability that the true value is beyond the threshold must exceed this level, between 0 and 1 (exclusive).
    Probability(f64),
}

/// One threshold of a rule, with debounce, hysteresis and latching.
#[derive(Debug, Clone, PartialEq)]
pub struct RuleConfig {
    pub rule: Rule,
    /// Severity of the alarm. A rule has at most one threshold per severity.
    pub severity: Severity,
    /// The alarm is raised if the value is beyond this threshold (below for rules named `*Low`, above for all other
    /// rules), in the rule's unit.
    pub threshold: f64,
    /// The alarm clears only if the value is at this threshold or on its healthy side. This threshold is never on the
    /// bad side of `threshold`.
    pub clear: f64,
    /// What is compared with the threshold.
    pub when: Comparison,
    /// Time (s) that the value must be beyond the threshold before the alarm is raised, and healthy before the alarm
    /// clears.
    pub debounce_s: f64,
    /// Number of new values needed before the alarm is raised or cleared, at least 1.
    pub debounce_events: u32,
    /// Whether the alarm stays raised after its value is healthy again, until a command clears it.
    pub is_latching: bool,
}

/// A rule's value at one moment.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Observation {
    /// The value in the rule's unit; `None` or not finite = unknown.
    pub value: Option<f64>,
    /// Standard deviation of the value, in the same unit; `None` = unknown.
    pub std: Option<f64>,
    /// Whether the value is the worst of several sources, and at least one source is unknown. The true value may then
    /// be worse, but not better. Such a value can be beyond a threshold, but not healthy.
    pub is_bound: bool,
    /// Whether the value is a new measurement. Only new measurements count towards `debounce_events`.
    pub is_new: bool,
}

impl Observation {
    /// A new value.
    pub fn new(value: Option<f64>) -> Self {
        Self { value, is_new: true, ..Self::default() }
    }

    /// Returns the observation with a standard deviation.
    #[must_use]
    pub fn with_std(self, std: f64) -> Self {
        Self { std: Some(std), ..self }
    }

    /// If `is_bound` is true, marks the value as a bound: only some of its sources are known, and the other sources may
    /// be worse.
    #[must_use]
    pub fn of_part(self, is_bound: bool) -> Self {
        Self { is_bound, ..self }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LimitCheck {
    /// The value counts as beyond the set threshold (see the module).
    Beyond,
    /// The value is neither beyond nor healthy.
    Between,
    /// The value counts as healthy (see the module).
    Healthy,
    /// The value or a needed standard deviation is missing. Or the value is only a bound ([`Observation::is_bound`])
    /// and is not beyond the set threshold.
    Unknown,
}

impl LimitCheck {
    /// Compares an observation with a rule. Also returns the probability that the true value is beyond the set
    /// threshold, if known.
    #[inline]
    pub(super) fn of(rule: &RuleConfig, observation: &Observation) -> (Self, Option<f64>) {
        let Some(value) = observation.value.filter(|value| value.is_finite()) else { return (Self::Unknown, None) };
        let std = observation.std.filter(|std| *std >= 0.0 && std.is_finite());
        // Distance of the value from a threshold, positive on the good side.
        let good_by = |threshold: f64| match rule.rule.spec().direction {
            Direction::Below => value - threshold,
            Direction::Above => threshold - value,
        };
        let (set, clear) = (good_by(rule.threshold), good_by(rule.clear));
        let probability = std.map(|std| probability_beyond(set, std));
        // An alarm clears only if the probability that the true value is beyond the clear threshold is at most this
        // value.
        let clear_level = if rule.rule.spec().is_learned { 0.05 } else { 0.5 };
        let (is_beyond, is_healthy) = match rule.when {
            Comparison::Mean => {
                (set < 0.0, clear >= 0.0 && std.is_none_or(|std| probability_beyond(clear, std) <= clear_level))
            }
            Comparison::Probability(level) => {
                let (Some(beyond), Some(std)) = (probability, std) else { return (Self::Unknown, None) };
                (beyond > level, probability_beyond(clear, std) <= level.min(clear_level))
            }
        };
        let check = match (is_beyond, is_healthy) {
            (true, _) => Self::Beyond,
            (false, _) if observation.is_bound => Self::Unknown,
            (false, true) => Self::Healthy,
            (false, false) => Self::Between,
        };
        (check, probability)
    }
}

/// Probability that a normally distributed value is on the bad side of a threshold. `good_by` is the distance of the
/// mean from the threshold, positive on the good side.
fn probability_beyond(good_by: f64, std: f64) -> f64 {
    if std > 0.0 {
        probability_below(-good_by, std)
    } else if good_by < 0.0 {
        1.0
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn low(when: Comparison) -> RuleConfig {
        RuleConfig {
            rule: Rule::CapacityLow,
            severity: Severity::Warning,
            threshold: 1.4,
            clear: 1.5,
            when,
            debounce_s: 0.0,
            debounce_events: 1,
            is_latching: false,
        }
    }

    fn check(rule: &RuleConfig, value: f64, std: Option<f64>) -> LimitCheck {
        LimitCheck::of(rule, &Observation { value: Some(value), std, is_bound: false, is_new: true }).0
    }

    #[test]
    fn threshold_is_not_beyond_but_clear_threshold_is_healthy() {
        let rule = low(Comparison::Mean);
        assert_eq!(check(&rule, 1.4, None), LimitCheck::Between);
        assert_eq!(check(&rule, 1.4 - 1e-9, None), LimitCheck::Beyond);
        assert_eq!(check(&rule, 1.5, None), LimitCheck::Healthy);
        let high = RuleConfig { rule: Rule::InputMissing, threshold: 5.0, clear: 4.0, ..rule };
        assert_eq!(check(&high, 5.1, None), LimitCheck::Beyond);
        assert_eq!(check(&high, 5.0, None), LimitCheck::Between);
        assert_eq!(check(&high, 4.0, None), LimitCheck::Healthy);
    }

    #[test]
    fn probability_follows_normal_distribution() {
        // A probability of 95 % is at 1.645 standard deviations.
        let rule = low(Comparison::Probability(0.95));
        assert_eq!(check(&rule, 1.4 - 0.1 * 1.65, Some(0.1)), LimitCheck::Beyond);
        assert_eq!(check(&rule, 1.4 - 0.1 * 1.64, Some(0.1)), LimitCheck::Between);
        // A value at the clear threshold clears the alarm. A growing uncertainty does not.
        assert_eq!(check(&rule, 1.5 - 0.1 * 1.64, Some(0.1)), LimitCheck::Between);
        assert_eq!(check(&rule, 1.2, Some(10.0)), LimitCheck::Between);
        let soc = RuleConfig { rule: Rule::SocLow, ..rule.clone() };
        assert_eq!(check(&soc, 1.5, Some(10.0)), LimitCheck::Healthy);
        let early = low(Comparison::Probability(0.05));
        assert_eq!(check(&early, 1.4 + 0.1 * 1.64, Some(0.1)), LimitCheck::Beyond);
        assert_eq!(check(&early, 1.5 + 0.1 * 1.64, Some(0.1)), LimitCheck::Between);
        assert_eq!(check(&early, 1.5 + 0.1 * 1.65, Some(0.1)), LimitCheck::Healthy);
        let (_, probability) = LimitCheck::of(&rule, &Observation::new(Some(1.3)).with_std(0.1));
        assert!((probability.expect("known") - 0.841_344_746_068_543).abs() < 1e-12);
    }

    #[test]
    fn probability_of_half_equals_mean_comparison() {
        for step in -20..20 {
            let value = 1.4 + 0.013 * f64::from(step) + 1e-6;
            for rule in [Rule::CapacityLow, Rule::SocLow] {
                let with = |when| RuleConfig { rule, ..low(when) };
                let by_mean = check(&with(Comparison::Mean), value, Some(0.07));
                assert_eq!(check(&with(Comparison::Probability(0.5)), value, Some(0.07)), by_mean, "{value}");
            }
        }
    }

    #[test]
    fn learned_value_clears_at_95_percent_certainty() {
        let rule = low(Comparison::Mean);
        assert_eq!(check(&rule, 1.4 - 1e-9, Some(0.1)), LimitCheck::Beyond);
        // A probability of 95 % is at 1.645 standard deviations.
        assert_eq!(check(&rule, 1.5 + 0.1 * 1.64, Some(0.1)), LimitCheck::Between);
        assert_eq!(check(&rule, 1.5 + 0.1 * 1.65, Some(0.1)), LimitCheck::Healthy);
        let soc = RuleConfig { rule: Rule::SocLow, ..rule };
        assert_eq!(check(&soc, 1.5, Some(0.1)), LimitCheck::Healthy);
    }

    #[test]
    fn probability_needs_deviation_and_zero_is_certain() {
        let rule = low(Comparison::Probability(0.9));
        assert_eq!(check(&rule, 1.0, None), LimitCheck::Unknown);
        assert_eq!(check(&rule, 1.0, Some(f64::NAN)), LimitCheck::Unknown);
        assert_eq!(check(&rule, 1.0, Some(0.0)), LimitCheck::Beyond);
        assert_eq!(check(&rule, 1.6, Some(0.0)), LimitCheck::Healthy);
    }

    #[test]
    fn bound_can_be_beyond_but_never_healthy() {
        let rule = low(Comparison::Mean);
        let bound = |value| LimitCheck::of(&rule, &Observation { is_bound: true, ..Observation::new(Some(value)) }).0;
        assert_eq!(bound(1.3), LimitCheck::Beyond);
        assert_eq!(bound(1.45), LimitCheck::Unknown);
        assert_eq!(bound(1.6), LimitCheck::Unknown);
    }

    #[test]
    fn infinite_and_nan_values_are_unknown() {
        for odd in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            assert_eq!(check(&low(Comparison::Mean), odd, None), LimitCheck::Unknown);
        }
    }
}
