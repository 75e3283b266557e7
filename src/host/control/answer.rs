//! Computes answers to requests from the current alarms. All functions are pure.

use std::cmp::Reverse;

use super::MAX_LISTED;
use super::protocol::{AlarmList, Answer, CommandOutcome, UnknownAlarms};
use crate::alarm::{Alarm, AlarmEngine, AlarmState, Selector};
use crate::monitor::{Command, Event, EventKind, Source};
use crate::quantity::Timestamp;

/// Lists the alarms. Without `all`, lists only alarms that need attention (raised, about to be raised, or not yet
/// acknowledged).
pub fn list(engine: &AlarmEngine, time: Timestamp, all: bool) -> Answer {
    Answer::Alarms(alarm_list(engine, time, all))
}

/// Lists the alarms like [`list`], but returns the bare list instead of an [`Answer`].
pub fn alarm_list(engine: &AlarmEngine, time: Timestamp, all: bool) -> AlarmList {
    let mut alarms: Vec<Alarm> = engine.all().filter(|alarm| all || needs_attention(alarm)).collect();
    let omitted = shorten(&mut alarms);
    let unknown = engine.unknown_thresholds().map(|(rule, severity, alarms)| UnknownAlarms { rule, severity, alarms });
    let (thresholds, _) = engine.unknown();
    AlarmList { time, thresholds, unknown: unknown.collect(), alarms, omitted }
}

fn needs_attention(alarm: &Alarm) -> bool {
    match alarm.state {
        AlarmState::Inactive | AlarmState::Unknown => alarm.occurrences > 0 && !alarm.is_acknowledged,
        AlarmState::Pending
        | AlarmState::Active
        | AlarmState::Clearing
        | AlarmState::Suppressed
        | AlarmState::Latched
        | AlarmState::Cleared => true,
    }
}

/// Keeps as many alarms as fit into an answer, raised and severe alarms first. Returns the number of omitted alarms.
fn shorten(alarms: &mut Vec<Alarm>) -> usize {
    let omitted = alarms.len().saturating_sub(MAX_LISTED);
    if omitted > 0 {
        alarms.sort_by_key(|alarm| (!alarm.state.is_raised(), Reverse(alarm.severity)));
        alarms.truncate(MAX_LISTED);
    }
    omitted
}

/// Returns the error for a command that selects no configured alarm; `None` = the command selects at least one
/// alarm, or does not concern alarms.
pub fn meaningless(engine: &AlarmEngine, command: &Command) -> Option<Answer> {
    let (Command::Acknowledge(which) | Command::Clear(which)) = command else { return None };
    if engine.all().any(|alarm| which.matches(alarm.rule, alarm.severity, alarm.cell)) {
        return None;
    }
    let mut watched: Vec<&str> = Vec::new();
    for name in engine.all().map(|alarm| alarm.rule.name()) {
        if watched.last() != Some(&name) {
            watched.push(name);
        }
    }
    let watched = if watched.is_empty() { "none".to_owned() } else { watched.join(", ") };
    let selection = describe(which);
    Some(Answer::Error(format!("no configured alarm matches {selection}; rules with a threshold are: {watched}")))
}

fn describe(which: &Selector) -> String {
    let words = [
        which.rule.map(|rule| format!("rule {}", rule.name())),
        which.severity.map(|severity| format!("severity {severity:?}").to_lowercase()),
        which.cell.map(|cell| format!("cell {} (the first is 1)", u32::from(cell.0) + 1)),
    ];
    let words: Vec<String> = words.into_iter().flatten().collect();
    if words.is_empty() { "\"all\"".to_owned() } else { words.join(", ") }
}

/// Computes the outcome of a command from the events that the command caused and from the alarms after the command. The
/// caller sets `is_stored`.
///
/// # Errors
/// Fails if the core has not reported an outcome.
pub fn outcome(
    engine: &AlarmEngine,
    command: &Command,
    events: &[Event],
    time: Timestamp,
) -> Result<CommandOutcome, Answer> {
    let counts = events.iter().rev().find_map(|event| match event.kind {
        EventKind::Command { source: Source::Local, changed, refused, .. } => Some((changed, refused)),
        _ => None,
    });
    let Some((changed, refused)) = counts else {
        return Err(Answer::Error("the daemon's core did not report the outcome".to_owned()));
    };
    let mut refused_alarms: Vec<Alarm> = match command {
        Command::Clear(which) if refused > 0 => {
            engine.raised().filter(|alarm| which.matches(alarm.rule, alarm.severity, alarm.cell)).collect()
        }
        _ => Vec::new(),
    };
    shorten(&mut refused_alarms);
    Ok(CommandOutcome { time, changed, refused, refused_alarms, is_stored: None })
}

/// Why an alarm was not cleared, in words.
pub fn refusal(alarm: &Alarm) -> &'static str {
    match alarm.state {
        AlarmState::Suppressed => "its value is unknown",
        AlarmState::Clearing => "healthy again, but not yet for long enough",
        AlarmState::Active if alarm.value.is_none() => "its value is unknown",
        _ => "still beyond its threshold",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alarm::{Comparison, Observation, Rule, RuleConfig, Severity};
    use crate::quantity::CellIndex;

    fn engine(cells: u16) -> AlarmEngine {
        let rule = |rule, threshold, clear| RuleConfig {
            rule,
            severity: Severity::Warning,
            threshold,
            clear,
            when: Comparison::Mean,
            debounce_s: 0.0,
            debounce_events: 1,
            is_latching: false,
        };
        AlarmEngine::new(vec![rule(Rule::CapacityLow, 2.0, 2.1), rule(Rule::TemperatureHigh, 50.0, 45.0)], cells)
    }

    fn see(engine: &mut AlarmEngine, rule: Rule, cell: Option<u16>, value: Option<f64>) {
        for second in 0..2 {
            let now = Timestamp::from_secs(f64::from(second));
            engine.observe(now, rule, cell.map(CellIndex), &Observation::new(value), &mut Vec::new());
        }
    }

    fn listed(answer: Answer) -> AlarmList {
        match answer {
            Answer::Alarms(list) => list,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn quiet_alarms_are_listed_only_on_request() {
        let mut engine = engine(3);
        see(&mut engine, Rule::CapacityLow, Some(1), Some(1.9));
        see(&mut engine, Rule::CapacityLow, Some(2), Some(2.5));
        let list = listed(super::list(&engine, Timestamp::ZERO, false));
        assert_eq!(list.alarms.iter().map(|alarm| alarm.cell).collect::<Vec<_>>(), [Some(CellIndex(1))]);
        let unknown: Vec<_> = list.unknown.iter().map(|unknown| (unknown.rule, unknown.alarms)).collect();
        assert_eq!((list.thresholds, unknown), (2, vec![(Rule::CapacityLow, 1), (Rule::TemperatureHigh, 1)]));
        assert_eq!(listed(super::list(&engine, Timestamp::ZERO, true)).alarms.len(), 4);
    }

    #[test]
    fn long_list_keeps_raised_alarms() {
        let mut engine = engine(1024);
        see(&mut engine, Rule::TemperatureHigh, None, Some(60.0));
        let list = listed(super::list(&engine, Timestamp::ZERO, true));
        assert_eq!((list.alarms.len(), list.omitted), (MAX_LISTED, 1));
        assert_eq!(list.alarms[0].rule, Rule::TemperatureHigh);
    }

    #[test]
    fn command_without_matching_alarm_lists_rules() {
        let engine = engine(2);
        let clear = |rule, cell: Option<u16>| {
            meaningless(&engine, &Command::Clear(Selector { rule, severity: None, cell: cell.map(CellIndex) }))
        };
        assert_eq!(clear(None, None), None);
        assert_eq!(clear(Some(Rule::CapacityLow), Some(1)), None);
        let Some(Answer::Error(error)) = clear(Some(Rule::SocLow), Some(2)) else {
            panic!("the command was not rejected")
        };
        assert_eq!(
            error,
            "no configured alarm matches rule soc_low, cell 3 (the first is 1); rules with a threshold are: \
             capacity_low, temperature_high"
        );
        assert_eq!(meaningless(&engine, &Command::PackReplaced), None);
    }

    #[test]
    fn refused_alarms_state_the_reason() {
        let mut engine = engine(1);
        see(&mut engine, Rule::TemperatureHigh, None, Some(60.0));
        let command = Command::Clear(Selector::default());
        let kind = EventKind::Command { source: Source::Local, command, changed: 0, refused: 1 };
        let events = [Event { time: Timestamp::ZERO, kind }];
        let Ok(done) = outcome(&engine, &command, &events, Timestamp::ZERO) else { panic!("no outcome") };
        assert_eq!((done.changed, done.refused, done.refused_alarms.len()), (0, 1, 1));
        assert_eq!(refusal(&done.refused_alarms[0]), "still beyond its threshold");
        see(&mut engine, Rule::TemperatureHigh, None, None);
        let Ok(done) = outcome(&engine, &command, &events, Timestamp::ZERO) else { panic!("no outcome") };
        assert_eq!(refusal(&done.refused_alarms[0]), "its value is unknown");
    }
}
