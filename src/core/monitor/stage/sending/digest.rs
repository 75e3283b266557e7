//! Computes the contents of the digest frame: a summary of all raised alarms, the state of every rule, and one
//! threshold. Successive digests show the thresholds one after another.
//!
//! In: the alarm engine. Out: [`DigestFields`]. If a rule cannot be judged, its state is unknown, never "no alarm".

use super::alarm_queue::AlarmQueue;
use crate::alarm::{AlarmEngine, Rule, RuleSummary, Severity};
use crate::can::encode::{DigestFields, RuleState, TableChecksum, ThresholdFields};

/// Computes the contents of the digest; `turn` selects the threshold.
pub(crate) fn fields(engine: &AlarmEngine, alarm_period_s: f64, turn: usize) -> DigestFields {
    let mut checksum = TableChecksum::default();
    for alarm in engine.raised() {
        let (rule, severity) = (alarm.rule as u8, alarm.severity as u8);
        checksum.add(rule, severity, alarm.cell, alarm.state.wire_code(), alarm.is_acknowledged);
    }
    let state = |rule: Rule| match engine.rule_summary(rule) {
        None => RuleState::NotWatched,
        Some(RuleSummary { worst: Some(Severity::Info), .. }) => RuleState::Info,
        Some(RuleSummary { worst: Some(Severity::Warning), .. }) => RuleState::Warning,
        Some(RuleSummary { worst: Some(Severity::Severe), .. }) => RuleState::Severe,
        Some(RuleSummary { worst: None, is_known: true }) => RuleState::None,
        Some(RuleSummary { worst: None, is_known: false }) => RuleState::Unknown,
    };
    let threshold = |(rule, severity, threshold): (Rule, Severity, f64)| ThresholdFields {
        rule: rule as u8,
        severity: severity as u8,
        threshold,
    };
    DigestFields {
        raised: engine.count(),
        worst: engine.highest_severity().map_or(0, |severity| severity as u8),
        checksum,
        pass_time_s: AlarmQueue::pass_time_s(engine, alarm_period_s),
        rules: Rule::ALL.map(state),
        threshold: engine.threshold(turn).map(threshold),
    }
}
