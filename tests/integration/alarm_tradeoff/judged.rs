//! Applies one alarm rule to one life: the estimates of a simulated ageing cell, with its true capacity.

use packwatch::alarm::{AlarmEngine, Change, Comparison, Observation, Rule, RuleConfig, Severity};
use packwatch::quantity::CellIndex;

use super::life::{Evaluation, Life, RATED_AH, THRESHOLD};

/// The default hysteresis, relative to the threshold.
const HYSTERESIS: f64 = 0.02;

/// A rule to compare.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Candidate {
    pub(crate) name: &'static str,
    pub(crate) when: Comparison,
    pub(crate) debounce_events: u32,
}

const fn candidate(name: &'static str, when: Comparison, debounce_events: u32) -> Candidate {
    Candidate { name, when, debounce_events }
}

/// The rules to compare. The Monitor itself also runs the rules in `MONITORED`.
pub(crate) const CANDIDATES: [Candidate; 8] = [
    candidate("p = 0.05", Comparison::Probability(0.05), 1),
    candidate("p = 0.2", Comparison::Probability(0.2), 1),
    candidate("p = 0.5", Comparison::Probability(0.5), 1),
    candidate("mean", Comparison::Mean, 1),
    candidate("mean, 2 events", Comparison::Mean, 2),
    candidate("p = 0.8", Comparison::Probability(0.8), 1),
    candidate("p = 0.95", Comparison::Probability(0.95), 1),
    candidate("p = 0.99", Comparison::Probability(0.99), 1),
];

/// Indices of the candidates that the Monitor runs with the severities info, warning and severe.
pub(crate) const MONITORED: [usize; 3] = [0, 3, 6];
pub(crate) const HALF: usize = 2;
pub(crate) const MEAN: usize = 3;
pub(crate) const P95: usize = 6;

/// Outcome of one rule for one life.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RuleOutcome {
    /// The evaluation at which the alarm was first raised.
    pub(crate) first: Option<Evaluation>,
    /// Number of times that the alarm was raised while the true capacity was above the threshold. `far_false_raises`
    /// counts only those at which it was above the threshold by more than 1 % of the rated capacity.
    pub(crate) false_raises: u32,
    pub(crate) far_false_raises: u32,
    /// Number of times that the alarm cleared before the end of life.
    pub(crate) flickers: u32,
}

impl RuleOutcome {
    /// Whether the true capacity was above the threshold by more than `margin` (fraction of the rated capacity) when
    /// the alarm was first raised.
    pub(crate) fn is_false(&self, margin: f64) -> bool {
        self.first.is_some_and(|evaluation| evaluation.true_ah > (THRESHOLD + margin) * RATED_AH)
    }

    /// The evaluation at which the alarm was first raised; `None` unless this was before the end of life.
    pub(crate) fn in_time(&self, life: &Life) -> Option<Evaluation> {
        self.first.filter(|evaluation| life.end.is_none_or(|end| evaluation.cycle < end.cycle))
    }
}

/// How the rule's alarm changes at each evaluation of a life; `None` = no change.
pub(crate) fn changes(rule: &Candidate, life: &Life) -> Vec<Option<Change>> {
    let threshold = THRESHOLD * RATED_AH;
    let config = RuleConfig {
        rule: Rule::CapacityLow,
        severity: Severity::Warning,
        threshold,
        clear: threshold * (1.0 + HYSTERESIS),
        when: rule.when,
        debounce_s: 0.0,
        debounce_events: rule.debounce_events,
        is_latching: false,
    };
    let mut engine = AlarmEngine::new(vec![config], 1);
    let mut observe = |evaluation: &Evaluation| {
        let mut out = Vec::new();
        if evaluation.is_measured {
            let seen = Observation::new(Some(evaluation.mean_ah)).with_std(evaluation.std_ah);
            engine.observe(evaluation.time, Rule::CapacityLow, Some(CellIndex(0)), &seen, &mut out);
        }
        out.first().map(|change| change.change)
    };
    life.evaluations.iter().map(&mut observe).collect()
}

pub(crate) fn judge(rule: &Candidate, life: &Life) -> RuleOutcome {
    let mut judged = RuleOutcome::default();
    for (evaluation, change) in life.evaluations.iter().zip(changes(rule, life)) {
        let margin = evaluation.true_ah / RATED_AH - THRESHOLD;
        match change {
            Some(Change::Raised) => {
                judged.first.get_or_insert(*evaluation);
                judged.false_raises += u32::from(margin > 0.0);
                judged.far_false_raises += u32::from(margin > 0.01);
            }
            Some(Change::Cleared) if life.end.is_none_or(|end| evaluation.cycle < end.cycle) => judged.flickers += 1,
            _ => {}
        }
    }
    judged
}
