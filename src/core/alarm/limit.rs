//! A value against a rule: beyond, between, healthy, or not to be judged.
//!
//! A rule compares the value itself (`when = "mean"`), or the probability that the truth is beyond the threshold
//! (`when = { probability = p }`): the value is then taken as normally distributed with its standard deviation, and
//!
//! ```text
//! beyond    P(truth beyond the set threshold)   >  p
//! healthy   P(truth beyond the clear threshold) <= min(p, c)
//! ```
//!
//! where c is 0.5, and 0.05 for a learned value: an alarm is cleared by a value that is at the clear threshold or better,
//! never by doubt that has grown. As the clear threshold is on the healthy side of the set threshold, the second
//! probability is the larger one: no value is both. With p = 0.5 this is the plain comparison. A value without a standard
//! deviation where one is needed is not to be judged.
//!
//! A learned value (a capacity, a resistance, a life) does not recover by itself: an estimate that wanders about its
//! threshold must not clear its alarm, whichever quantity is compared.

use serde::{Deserialize, Serialize};

use super::rule::{Direction, Rule, Severity};
use crate::filter::probability_below;

/// How a value is compared with a threshold.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Comparison {
    /// The value itself.
    Mean,
    /// The probability that the truth is beyond must pass this level, above 0 and below 1.
    Probability(f64),
}

/// One threshold of a rule, and how an alarm follows from it.
#[derive(Debug, Clone, PartialEq)]
pub struct RuleConfig {
    /// The rule.
    pub rule: Rule,
    /// Its severity. A rule has at most one threshold per severity.
    pub severity: Severity,
    /// Raised when the value is beyond this (below for `*Low`, above for the others), in the rule's unit.
    pub threshold: f64,
    /// Cleared only when the value is at this or beyond it on the healthy side; never on the bad side of `threshold`.
    pub clear: f64,
    /// The compared quantity.
    pub when: Comparison,
    /// Must hold this long before it is raised, and be healthy this long before it clears, s.
    pub debounce_s: f64,
    /// Must hold for this many new values before it is raised or cleared, at least 1.
    pub debounce_events: u32,
    /// Whether an alarm stays raised when its value is healthy again, until it is cleared.
    pub is_latching: bool,
}

/// A rule's value at one moment.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Observation {
    /// In the rule's unit; `None` or not finite = not known.
    pub value: Option<f64>,
    /// Its standard deviation, in the same unit; `None` = none known.
    pub std: Option<f64>,
    /// The truth may be worse than the value, never better: some of what it is the worst of is not known. Such a value
    /// can be beyond a threshold, but not healthy.
    pub is_bound: bool,
    /// Whether it is a new measurement, which counts for `debounce_events`.
    pub is_new: bool,
}

impl Observation {
    /// A new value.
    pub fn new(value: Option<f64>) -> Self {
        Self { value, is_new: true, ..Self::default() }
    }

    /// With a standard deviation.
    #[must_use]
    pub fn with_std(self, std: f64) -> Self {
        Self { std: Some(std), ..self }
    }

    /// The same of a part of the sources only, if `is_bound`: the others may be worse.
    #[must_use]
    pub fn of_part(self, is_bound: bool) -> Self {
        Self { is_bound, ..self }
    }
}

/// A value compared with the limits of a rule.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LimitCheck {
    /// On the bad side of the threshold.
    Beyond,
    /// Neither beyond nor healthy.
    Between,
    /// At the clear threshold or better.
    Healthy,
    /// No usable value.
    Unknown,
}

impl LimitCheck {
    /// Compares; also gives the probability that the truth is beyond the set threshold, where it can be said.
    #[inline]
    pub(super) fn of(rule: &RuleConfig, observation: &Observation) -> (Self, Option<f64>) {
        let Some(value) = observation.value.filter(|value| value.is_finite()) else { return (Self::Unknown, None) };
        let std = observation.std.filter(|std| *std >= 0.0 && std.is_finite());
        // How far the value is on the good side of a threshold.
        let good_by = |threshold: f64| match rule.rule.spec().direction {
            Direction::Below => value - threshold,
            Direction::Above => threshold - value,
        };
        let (set, clear) = (good_by(rule.threshold), good_by(rule.clear));
        let probability = std.map(|std| probability_beyond(set, std));
        // Highest probability of being beyond the clear threshold that clears, for a learned value and any other.
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

/// Probability that a normal value, on the good side by `good_by` in the mean, is on the bad side.
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
    fn the_threshold_itself_is_not_beyond_and_the_clear_threshold_is_healthy() {
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
    fn probability_is_that_of_the_normal_distribution() {
        // 1.645 standard deviations: 95 %.
        let rule = low(Comparison::Probability(0.95));
        assert_eq!(check(&rule, 1.4 - 0.1 * 1.65, Some(0.1)), LimitCheck::Beyond);
        assert_eq!(check(&rule, 1.4 - 0.1 * 1.64, Some(0.1)), LimitCheck::Between);
        // Cleared by a value at the clear threshold, not by doubt.
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
    fn half_probability_is_the_mean_rule() {
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
    fn a_learned_value_clears_when_it_is_surely_healthy() {
        let rule = low(Comparison::Mean);
        assert_eq!(check(&rule, 1.4 - 1e-9, Some(0.1)), LimitCheck::Beyond);
        // 1.645 standard deviations: 95 %.
        assert_eq!(check(&rule, 1.5 + 0.1 * 1.64, Some(0.1)), LimitCheck::Between);
        assert_eq!(check(&rule, 1.5 + 0.1 * 1.65, Some(0.1)), LimitCheck::Healthy);
        let soc = RuleConfig { rule: Rule::SocLow, ..rule };
        assert_eq!(check(&soc, 1.5, Some(0.1)), LimitCheck::Healthy);
    }

    #[test]
    fn without_deviation_probability_cannot_be_judged_and_zero_deviation_is_certain() {
        let rule = low(Comparison::Probability(0.9));
        assert_eq!(check(&rule, 1.0, None), LimitCheck::Unknown);
        assert_eq!(check(&rule, 1.0, Some(f64::NAN)), LimitCheck::Unknown);
        assert_eq!(check(&rule, 1.0, Some(0.0)), LimitCheck::Beyond);
        assert_eq!(check(&rule, 1.6, Some(0.0)), LimitCheck::Healthy);
    }

    #[test]
    fn a_bound_can_be_beyond_but_never_healthy() {
        let rule = low(Comparison::Mean);
        let bound = |value| LimitCheck::of(&rule, &Observation { is_bound: true, ..Observation::new(Some(value)) }).0;
        assert_eq!(bound(1.3), LimitCheck::Beyond);
        assert_eq!(bound(1.45), LimitCheck::Unknown);
        assert_eq!(bound(1.6), LimitCheck::Unknown);
    }

    #[test]
    fn values_that_are_not_finite_are_unknown() {
        for odd in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            assert_eq!(check(&low(Comparison::Mean), odd, None), LimitCheck::Unknown);
        }
    }
}
