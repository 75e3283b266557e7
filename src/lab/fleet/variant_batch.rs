//! Evaluates the alarms of many settings in one replay.
//!
//! Estimates do not depend on alarm thresholds, and the alarms of one threshold do not depend on other thresholds. The
//! alarm inputs of one monitor are therefore passed to additional alarm engines, the *lanes*. For each pair of rule and
//! severity, lane n has the n-th distinct threshold. For example, five thresholds each of two rules make 25
//! combinations but need only five lanes.

use crate::alarm::{AlarmChange, AlarmEngine, AlarmInput, Change, Rule, RuleConfig, Severity};
use crate::quantity::{CellIndex, Timestamp};

/// Maximum number of raises, and of clears, that are stored per threshold and log. Further ones are only counted.
const MAX_KEPT: usize = 20_000;

/// A raised alarm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Raise {
    /// Time of the raise.
    pub time: Timestamp,
    /// Cell with the alarm; `None` = the pack.
    pub cell: Option<CellIndex>,
    /// Value that raised the alarm, in the unit of the rule.
    pub value: Option<f64>,
}

/// Raises and clears of one threshold in one log.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct AlarmHistory {
    /// Raises in the order of time.
    pub raises: Vec<Raise>,
    /// Times of the clears, in order.
    pub clears: Vec<Timestamp>,
    /// Number of raises and clears that were not stored.
    pub not_kept: u64,
}

#[derive(Debug, Clone)]
struct BatchThreshold {
    config: RuleConfig,
    lane: usize,
    history: AlarmHistory,
}

#[derive(Debug, Clone, Default)]
pub(super) struct VariantBatch {
    watched: Vec<BatchThreshold>,
}

impl VariantBatch {
    pub(super) fn watch(&mut self, config: &RuleConfig) -> usize {
        if let Some(known) = self.watched.iter().position(|watched| watched.config == *config) {
            return known;
        }
        let same = |watched: &&BatchThreshold| has_rule(watched, config.rule, config.severity);
        let lane = self.watched.iter().filter(same).count();
        self.watched.push(BatchThreshold { config: config.clone(), lane, history: AlarmHistory::default() });
        self.watched.len() - 1
    }

    pub(super) fn engines(&self, cells: u16) -> LaneEngines {
        let batch = self.watched.iter().map(|watched| watched.lane + 1).max().unwrap_or(0);
        let rules = |lane| self.watched.iter().filter(move |watched| watched.lane == lane);
        let engine = |lane| AlarmEngine::new(rules(lane).map(|watched| watched.config.clone()).collect(), cells);
        let watches = |lane| {
            let numbers: Vec<u32> = rules(lane).map(|watched| 1 << (watched.config.rule as u8)).collect();
            numbers.iter().fold(0, |mask, bit| mask | bit)
        };
        LaneEngines { engines: (0..batch).map(|lane| (engine(lane), watches(lane))).collect(), changes: Vec::new() }
    }

    fn note(&mut self, lane: usize, time: Timestamp, change: &AlarmChange) {
        let alarm = &change.alarm;
        let found = self
            .watched
            .iter_mut()
            .find(|watched| watched.lane == lane && has_rule(watched, alarm.rule, alarm.severity));
        let Some(BatchThreshold { history, .. }) = found else { return };
        match change.change {
            Change::Raised if history.raises.len() < MAX_KEPT => {
                history.raises.push(Raise { time, cell: alarm.cell, value: alarm.value });
            }
            Change::Cleared if history.clears.len() < MAX_KEPT => history.clears.push(time),
            Change::Raised | Change::Cleared => history.not_kept += 1,
            Change::Suppressed | Change::Resumed | Change::Latched | Change::Acknowledged | Change::Forgotten => {}
        }
    }

    pub(super) fn history(&self, number: usize) -> Option<&AlarmHistory> {
        self.watched.get(number).map(|watched| &watched.history)
    }
}

fn has_rule(watched: &BatchThreshold, rule: Rule, severity: Severity) -> bool {
    (watched.config.rule, watched.config.severity) == (rule, severity)
}

#[derive(Debug)]
pub(super) struct LaneEngines {
    /// Each engine with its rules: bit n is set for the rule with wire number n.
    engines: Vec<(AlarmEngine, u32)>,
    changes: Vec<AlarmChange>,
}

impl LaneEngines {
    /// Passes the monitor's alarm inputs to all lanes, and records the changes of their alarms.
    pub(super) fn take(&mut self, inputs: &[(Timestamp, AlarmInput)], batch: &mut VariantBatch) {
        for (time, input) in inputs {
            for (lane, (engine, watches)) in self.engines.iter_mut().enumerate() {
                if concerns(input, *watches) {
                    engine.apply(*time, input, &mut self.changes);
                }
                self.changes.drain(..).for_each(|change| batch.note(lane, *time, &change));
            }
        }
    }
}

fn concerns(input: &AlarmInput, watches: u32) -> bool {
    match input {
        AlarmInput::Observe { rule, .. } | AlarmInput::InputsValid { rule, .. } => watches & 1 << (*rule as u8) != 0,
        AlarmInput::Poll
        | AlarmInput::Gap
        | AlarmInput::Acknowledge(_)
        | AlarmInput::Clear(_)
        | AlarmInput::ForgetLearned => true,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alarm::{Comparison, Observation};

    fn low(rule: Rule, threshold: f64) -> RuleConfig {
        RuleConfig {
            rule,
            severity: Severity::Warning,
            threshold,
            clear: threshold * 1.02,
            when: Comparison::Mean,
            debounce_s: 0.0,
            debounce_events: 1,
            is_latching: false,
        }
    }

    #[test]
    fn grid_needs_as_many_lanes_as_the_longer_list() {
        let mut batch = VariantBatch::default();
        for capacity in [1.5, 1.6, 1.7] {
            for soc in [0.1, 0.2] {
                batch.watch(&low(Rule::CapacityLow, capacity));
                batch.watch(&low(Rule::SocLow, soc));
            }
        }
        assert_eq!(batch.watched.len(), 5);
        assert_eq!(batch.engines(1).engines.len(), 3);
    }

    #[test]
    fn each_threshold_has_its_own_history() {
        let mut batch = VariantBatch::default();
        let numbers = [1.5, 1.6].map(|threshold| batch.watch(&low(Rule::CapacityLow, threshold)));
        let mut engines = batch.engines(1);
        for (second, value) in [(1, 1.9), (2, 1.55), (3, 1.9), (4, 1.4)] {
            let (rule, cell) = (Rule::CapacityLow, Some(CellIndex(0)));
            let seen = Observation::new(Some(value)).with_std(0.1);
            let time = Timestamp::from_secs(f64::from(second));
            engines.take(&[(time, AlarmInput::Observe { rule, cell, observation: seen })], &mut batch);
        }
        let seconds = |number: usize| {
            let history = batch.history(number).expect("watched");
            let raised: Vec<f64> = history.raises.iter().map(|raise| raise.time.secs()).collect();
            (raised, history.clears.len())
        };
        assert_eq!(seconds(numbers[0]), (vec![4.0], 0));
        assert_eq!(seconds(numbers[1]), (vec![2.0, 4.0], 1));
        assert_eq!(batch.watch(&low(Rule::CapacityLow, 1.5)), numbers[0]);
    }
}
