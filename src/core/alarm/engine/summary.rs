//! Summarises thresholds and rules: counts and severities. Also selects a threshold, or an alarm of a threshold, by a
//! counter (`turn`), so that the sender can go through all thresholds one after the other.

use super::{Alarm, AlarmEngine, Rule, Severity, ThresholdState};
use crate::quantity::CellIndex;

/// Summary of all alarms of one rule.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RuleSummary {
    /// The worst severity of the raised alarms of the rule; `None` = no alarm is raised.
    pub worst: Option<Severity>,
    /// Whether every alarm of the rule has a known value.
    pub is_known: bool,
}

impl AlarmEngine {
    /// Every threshold, in the order of rule and severity.
    pub fn thresholds(&self) -> impl DoubleEndedIterator<Item = ThresholdState> + '_ {
        self.rules.iter().map(|rule| {
            let machines = &self.machines[rule.slots()];
            ThresholdState {
                rule: rule.config.rule,
                severity: rule.config.severity,
                is_raised: machines.iter().any(|machine| machine.state.is_raised()),
                occurrences: machines.iter().map(|machine| machine.occurrences).max().unwrap_or(0),
            }
        })
    }

    /// The worst severity of all raised alarms; `None` = no alarm is raised.
    pub fn highest_severity(&self) -> Option<Severity> {
        self.raised.iter().map(|&slot| self.rules[self.rule_of(slot)].config.severity).max()
    }

    /// Number of thresholds, and number of thresholds with an alarm whose value is unknown.
    pub fn unknown(&self) -> (usize, usize) {
        (self.rules.len(), self.rules.iter().filter(|rule| rule.unknown > 0).count())
    }

    /// Thresholds with unknown values: rule, severity, number of alarms with an unknown value.
    pub fn unknown_thresholds(&self) -> impl Iterator<Item = (Rule, Severity, usize)> + '_ {
        let waiting = self.rules.iter().filter(|rule| rule.unknown > 0);
        waiting.map(|rule| (rule.config.rule, rule.config.severity, rule.unknown))
    }

    /// Takes the `turn`-th threshold with unknown values, modulo the number of these thresholds. Returns the
    /// threshold's first alarm that has an unknown value and is not raised; `None` = no such alarm.
    pub fn unknown_alarm(&self, turn: usize) -> Option<Alarm> {
        let (_, count) = self.unknown();
        let mut waiting = self.rules.iter().enumerate().filter(|(_, rule)| rule.unknown > 0);
        let (index, rule) = waiting.nth(turn.checked_rem(count)?)?;
        let is_waiting = |slot: &usize| !self.machines[*slot].is_known && !self.machines[*slot].state.is_raised();
        rule.slots().find(is_waiting).map(|slot| self.alarm(index, slot))
    }

    /// The alarm of a rule, severity and cell; `None` = not watched.
    pub fn find(&self, rule: Rule, severity: Severity, cell: Option<CellIndex>) -> Option<Alarm> {
        self.locate(rule, severity, cell).map(|(index, slot)| self.alarm(index, slot))
    }

    /// The summary of a rule; `None` = the rule is not configured.
    pub fn rule_summary(&self, rule: Rule) -> Option<RuleSummary> {
        let thresholds = &self.rules[self.by_rule[usize::from(rule as u8)].clone()];
        if thresholds.is_empty() {
            return None;
        }
        let has_raised = |slots: &super::RuleSlots| {
            let slots = slots.slots();
            let next = self.raised.partition_point(|slot| *slot < slots.start);
            self.raised.get(next).is_some_and(|slot| slots.contains(slot))
        };
        let worst = thresholds.iter().filter(|slots| has_raised(slots)).map(|slots| slots.config.severity).max();
        Some(RuleSummary { worst, is_known: thresholds.iter().all(|slots| slots.unknown == 0) })
    }

    /// Rule, severity and value of the `turn`-th threshold, modulo the number of thresholds; `None` = no thresholds.
    pub fn threshold(&self, turn: usize) -> Option<(Rule, Severity, f64)> {
        let config = &self.rules.get(turn.checked_rem(self.rules.len())?)?.config;
        Some((config.rule, config.severity, config.threshold))
    }
}
