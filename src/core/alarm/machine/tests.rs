//! Tests the transition table, and behaviour that the table does not express: counting, history, suspension.

use super::super::{Comparison, Rule, Severity};
use super::*;

const STATES: [AlarmState; 8] = [
    AlarmState::Unknown,
    AlarmState::Inactive,
    AlarmState::Pending,
    AlarmState::Active,
    AlarmState::Clearing,
    AlarmState::Suppressed,
    AlarmState::Latched,
    AlarmState::Cleared,
];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum MachineInput {
    Check(LimitCheck),
    Acknowledge,
    Clear,
}

const INPUTS: [MachineInput; 6] = [
    MachineInput::Check(LimitCheck::Beyond),
    MachineInput::Check(LimitCheck::Between),
    MachineInput::Check(LimitCheck::Healthy),
    MachineInput::Check(LimitCheck::Unknown),
    MachineInput::Acknowledge,
    MachineInput::Clear,
];

fn rule(is_latching: bool) -> RuleConfig {
    RuleConfig {
        rule: Rule::CapacityLow,
        severity: Severity::Warning,
        threshold: 1.4,
        clear: 1.5,
        when: Comparison::Mean,
        debounce_s: 10.0,
        debounce_events: 2,
        is_latching,
    }
}

fn at(seconds: f64) -> Timestamp {
    Timestamp::from_secs(seconds)
}

fn observe(machine: &mut Machine, rule: &RuleConfig, seconds: f64, check: LimitCheck) -> Option<Change> {
    let value = match check {
        LimitCheck::Beyond => Some(1.3),
        LimitCheck::Between => Some(1.45),
        LimitCheck::Healthy => Some(1.6),
        LimitCheck::Unknown => None,
    };
    machine.observe(at(seconds), rule, &Observation::new(value))
}

/// A machine that is in `state` at 100 s. If `state` has a running debounce, the debounce started at 100 s.
fn machine_in(state: AlarmState) -> (Machine, RuleConfig) {
    use LimitCheck::{Beyond, Healthy, Unknown};
    let rule = rule(state == AlarmState::Latched);
    let looks: &[(f64, LimitCheck)] = match state {
        AlarmState::Unknown => &[],
        AlarmState::Inactive => &[(0.0, Healthy)],
        AlarmState::Pending => &[(100.0, Beyond)],
        AlarmState::Active => &[(0.0, Beyond), (10.0, Beyond)],
        AlarmState::Clearing => &[(0.0, Beyond), (10.0, Beyond), (100.0, Healthy)],
        AlarmState::Suppressed => &[(0.0, Beyond), (10.0, Beyond), (100.0, Unknown)],
        AlarmState::Latched | AlarmState::Cleared => &[(0.0, Beyond), (10.0, Beyond), (20.0, Healthy), (30.0, Healthy)],
    };
    let mut machine = Machine::default();
    for &(seconds, check) in looks {
        observe(&mut machine, &rule, seconds, check);
    }
    assert_eq!(machine.state, state);
    (machine, rule)
}

/// Expected state after `input`, expected state after a second `input` at the end of the debounce, and the change that
/// the first input publishes.
fn expected(state: AlarmState, input: MachineInput) -> (AlarmState, AlarmState, Option<Change>) {
    use AlarmState::{Active, Cleared, Clearing, Inactive, Latched, Pending, Suppressed, Unknown};
    use LimitCheck::{Between, Beyond, Healthy};
    let stay = (state, state, None);
    match (state, input) {
        (Unknown | Inactive | Cleared, MachineInput::Check(Beyond)) => (Pending, Active, None),
        (Pending, MachineInput::Check(Beyond)) => (Pending, Active, None),
        (Latched, MachineInput::Check(Beyond)) => (Latched, Active, None),
        (Active, MachineInput::Check(Beyond)) => stay,
        (Clearing, MachineInput::Check(Beyond | Between)) => (Active, Active, None),
        (Suppressed, MachineInput::Check(Beyond | Between)) => (Active, Active, Some(Change::Resumed)),
        (Unknown | Pending, MachineInput::Check(Between | Healthy)) => (Inactive, Inactive, None),
        (Inactive | Latched | Cleared, MachineInput::Check(Between | Healthy)) => stay,
        (Active, MachineInput::Check(Between)) => stay,
        (Active | Clearing, MachineInput::Check(Healthy)) => (Clearing, Cleared, None),
        (Suppressed, MachineInput::Check(Healthy)) => (Clearing, Cleared, Some(Change::Resumed)),
        (Unknown, MachineInput::Check(LimitCheck::Unknown)) => stay,
        (Inactive | Cleared, MachineInput::Check(LimitCheck::Unknown)) => (Unknown, Unknown, None),
        (Pending | Suppressed | Latched, MachineInput::Check(LimitCheck::Unknown)) => stay,
        (Active | Clearing, MachineInput::Check(LimitCheck::Unknown)) => {
            (Suppressed, Suppressed, Some(Change::Suppressed))
        }
        (Unknown | Inactive | Pending, MachineInput::Acknowledge | MachineInput::Clear) => stay,
        (Active | Clearing | Suppressed | Latched, MachineInput::Acknowledge) => {
            (state, state, Some(Change::Acknowledged))
        }
        (Cleared, MachineInput::Acknowledge) => (Inactive, Inactive, Some(Change::Acknowledged)),
        (Active | Clearing | Suppressed, MachineInput::Clear) => stay,
        (Latched, MachineInput::Clear) => (Inactive, Inactive, Some(Change::Cleared)),
        (Cleared, MachineInput::Clear) => (Inactive, Inactive, Some(Change::Forgotten)),
    }
}

fn apply(machine: &mut Machine, rule: &RuleConfig, seconds: f64, input: MachineInput) -> Option<Change> {
    match input {
        MachineInput::Check(check) => observe(machine, rule, seconds, check),
        MachineInput::Acknowledge => machine.acknowledge().ok(),
        MachineInput::Clear => machine.clear().ok(),
    }
}

#[test]
fn transitions_match_table_for_all_inputs() {
    for state in STATES {
        for input in INPUTS {
            let (early, late, change) = expected(state, input);
            let (mut machine, rule) = machine_in(state);
            assert_eq!(apply(&mut machine, &rule, 101.0, input), change, "{state:?} {input:?}");
            assert_eq!(machine.state, early, "{state:?} {input:?}");
            assert_eq!(
                machine.is_known,
                !matches!(input, MachineInput::Check(LimitCheck::Unknown)) && is_known_in(state, input)
            );
            apply(&mut machine, &rule, 120.0, input);
            assert_eq!(machine.state, late, "{state:?} {input:?}, again");
        }
    }
}

/// Whether the value is known after `input`. A command does not change whether the value is known. The caller handles
/// the input that is an unknown value.
fn is_known_in(state: AlarmState, input: MachineInput) -> bool {
    match input {
        MachineInput::Check(_) => true,
        MachineInput::Acknowledge | MachineInput::Clear => {
            !matches!(state, AlarmState::Unknown | AlarmState::Suppressed)
        }
    }
}

#[test]
fn poll_counts_time_only_during_debounce() {
    for state in STATES {
        let (mut machine, rule) = machine_in(state);
        let change = machine.poll(at(1e6), &rule);
        // The debounce needs a second value, so time alone changes nothing.
        assert_eq!((machine.state, change), (state, None), "{state:?}");
        let runs = matches!(state, AlarmState::Pending | AlarmState::Clearing);
        assert_eq!(machine.index_entry().is_counting, runs, "{state:?}");
    }
}

#[test]
fn commands_without_effect_return_reason() {
    for state in STATES {
        let (machine, _) = machine_in(state);
        let mut cleared = machine;
        let refusal = cleared.clear().err();
        let wanted = match state {
            AlarmState::Unknown | AlarmState::Inactive | AlarmState::Pending => Some(Refusal::Nothing),
            AlarmState::Active | AlarmState::Clearing | AlarmState::Suppressed => Some(Refusal::NotHealthy),
            AlarmState::Latched | AlarmState::Cleared => None,
        };
        assert_eq!(refusal, wanted, "{state:?}");
        let mut twice = machine;
        let _ = twice.acknowledge();
        assert_eq!(twice.acknowledge(), Err(Refusal::Nothing), "{state:?}");
    }
}

#[test]
fn latched_alarm_beyond_again_is_new_occurrence() {
    let (mut machine, rule) = machine_in(AlarmState::Latched);
    assert_eq!(machine.occurrences, 1);
    assert_eq!(observe(&mut machine, &rule, 50.0, LimitCheck::Beyond), None);
    // A healthy value in between resets the count.
    observe(&mut machine, &rule, 55.0, LimitCheck::Healthy);
    assert_eq!(observe(&mut machine, &rule, 56.0, LimitCheck::Beyond), None);
    assert_eq!(observe(&mut machine, &rule, 65.9, LimitCheck::Beyond), None);
    assert_eq!(observe(&mut machine, &rule, 66.0, LimitCheck::Beyond), Some(Change::Raised));
    assert_eq!((machine.occurrences, machine.first_raised, machine.last_raised), (2, at(10.0), at(66.0)));
}

#[test]
fn latched_alarm_cleared_without_value_is_unknown() {
    let (mut machine, rule) = machine_in(AlarmState::Latched);
    observe(&mut machine, &rule, 50.0, LimitCheck::Unknown);
    assert_eq!(machine.clear(), Ok(Change::Cleared));
    assert_eq!((machine.state, machine.occurrences), (AlarmState::Unknown, 1));
}

#[test]
fn raising_again_resets_acknowledgement() {
    let (mut machine, rule) = machine_in(AlarmState::Active);
    machine.acknowledge().expect("raised");
    observe(&mut machine, &rule, 200.0, LimitCheck::Healthy);
    assert_eq!(observe(&mut machine, &rule, 210.0, LimitCheck::Healthy), Some(Change::Cleared));
    assert_eq!(machine.state, AlarmState::Inactive);
    observe(&mut machine, &rule, 300.0, LimitCheck::Beyond);
    observe(&mut machine, &rule, 310.0, LimitCheck::Beyond);
    assert_eq!((machine.state, machine.is_acknowledged, machine.occurrences), (AlarmState::Active, false, 2));
}

#[test]
fn past_alarm_is_cleared_when_value_returns() {
    let (mut machine, rule) = machine_in(AlarmState::Cleared);
    observe(&mut machine, &rule, 50.0, LimitCheck::Unknown);
    assert_eq!(machine.state, AlarmState::Unknown);
    observe(&mut machine, &rule, 60.0, LimitCheck::Healthy);
    assert_eq!(machine.state, AlarmState::Cleared);
    assert_eq!((machine.raised_value, machine.value()), (Some(1.3), Some(1.6)));
}

#[test]
fn raising_needs_both_time_and_values() {
    let (mut by_time, rule) = machine_in(AlarmState::Pending);
    assert_eq!(by_time.poll(at(1e6), &rule), None, "one value for a long time");
    let (mut by_values, rule) = machine_in(AlarmState::Pending);
    for _ in 0..1000 {
        assert_eq!(observe(&mut by_values, &rule, 109.9, LimitCheck::Beyond), None, "many values, 9.9 s");
    }
    assert_eq!(by_values.poll(at(110.0), &rule), Some(Change::Raised), "after another 0.1 s both conditions hold");
}

#[test]
fn unknown_value_pauses_debounce_without_reset() {
    for (state, check, change) in [
        (AlarmState::Pending, LimitCheck::Beyond, Change::Raised),
        (AlarmState::Clearing, LimitCheck::Healthy, Change::Cleared),
    ] {
        let (mut machine, rule) = machine_in(state);
        observe(&mut machine, &rule, 104.0, check);
        observe(&mut machine, &rule, 105.0, LimitCheck::Unknown);
        assert_eq!(machine.poll(at(190.0), &rule), None);
        observe(&mut machine, &rule, 200.0, check);
        assert_eq!(machine.poll(at(205.9), &rule), None, "the 4 s count, the 1 s up to the unknown value does not");
        assert_eq!(machine.poll(at(206.0), &rule), Some(change));
    }
}

#[test]
fn gap_does_not_count_towards_debounce() {
    let (mut machine, rule) = machine_in(AlarmState::Pending);
    machine.handle_gap();
    assert_eq!(observe(&mut machine, &rule, 500.0, LimitCheck::Beyond), None);
    assert_eq!(observe(&mut machine, &rule, 510.0, LimitCheck::Beyond), Some(Change::Raised));
}

#[test]
fn backward_clock_keeps_counted_time() {
    let (mut machine, rule) = machine_in(AlarmState::Pending);
    assert_eq!(observe(&mut machine, &rule, -50.0, LimitCheck::Beyond), None);
    assert_eq!(observe(&mut machine, &rule, -40.0, LimitCheck::Beyond), Some(Change::Raised));
}

#[test]
fn learned_value_is_suppressed_until_inputs_return() {
    let (mut machine, rule) = machine_in(AlarmState::Active);
    assert_eq!(machine.suspend(at(200.0), &rule), Some(Change::Suppressed));
    assert_eq!(machine.suspend(at(201.0), &rule), None, "reported once");
    assert_eq!((machine.value(), machine.state), (None, AlarmState::Suppressed));
    assert_eq!(machine.resume(at(300.0), &rule), Some(Change::Resumed));
    assert_eq!((machine.value(), machine.state), (Some(1.3), AlarmState::Active));
    let (mut healthy, rule) = machine_in(AlarmState::Inactive);
    assert_eq!((healthy.suspend(at(200.0), &rule), healthy.state), (None, AlarmState::Unknown));
    assert_eq!((healthy.resume(at(300.0), &rule), healthy.state), (None, AlarmState::Inactive));
}

#[test]
fn value_learned_without_inputs_keeps_raised_alarm() {
    for (value, change, state) in
        [(1.2, Change::Resumed, AlarmState::Active), (1.6, Change::Cleared, AlarmState::Cleared)]
    {
        let (mut machine, rule) = machine_in(AlarmState::Active);
        let rule = RuleConfig { debounce_s: 0.0, debounce_events: 1, ..rule };
        assert_eq!(machine.suspend(at(200.0), &rule), Some(Change::Suppressed));
        assert_eq!(machine.observe(at(200.2), &rule, &Observation::new(Some(value))), None);
        assert_eq!((machine.value(), machine.state), (None, AlarmState::Suppressed), "neither cleared nor up to date");
        assert_eq!(machine.suspend(at(200.3), &rule), None);
        assert_eq!(machine.resume(at(300.0), &rule), Some(change));
        assert_eq!((machine.value(), machine.state), (Some(value), state));
    }
    let (mut machine, rule) = machine_in(AlarmState::Inactive);
    let rule = RuleConfig { debounce_s: 0.0, debounce_events: 1, ..rule };
    assert_eq!(machine.suspend(at(200.0), &rule), None);
    let last = Observation::new(Some(1.2));
    assert_eq!(
        machine.observe(at(200.2), &rule, &last),
        Some(Change::Raised),
        "a value from the last half-cycle of a drive"
    );
    assert_eq!(machine.suspend(at(200.3), &rule), Some(Change::Suppressed));
}

#[test]
fn wire_codes_match_alarm_frame() {
    let codes = STATES.map(AlarmState::wire_code);
    assert_eq!(codes, [6, 0, 3, 1, 1, 5, 4, 2]);
}

#[test]
fn flickering_alarm_stays_raised_and_changes_seldom() {
    let rule = RuleConfig { debounce_s: 0.0, debounce_events: 1, ..rule(false) };
    for ends in [LimitCheck::Healthy, LimitCheck::Unknown] {
        let mut machine = Machine::default();
        let mut changes = Vec::new();
        for second in 0..86_400 {
            let check = if second % 2 == 0 { LimitCheck::Beyond } else { ends };
            if let Some(change) = observe(&mut machine, &rule, f64::from(second), check) {
                changes.push((second, change));
            }
            assert!(check != LimitCheck::Beyond || machine.state == AlarmState::Active, "raised at once");
            assert!(check != LimitCheck::Unknown || machine.shown() == AlarmState::Suppressed, "second {second}");
        }
        assert_eq!(changes.iter().filter(|(second, _)| *second < 240).count(), 240, "{changes:?}");
        assert!((515..=530).contains(&changes.len()), "{} changes on the first day", changes.len());
        // The input is steady again: the alarm ends once.
        observe(&mut machine, &rule, 86_400.0, LimitCheck::Beyond);
        let after: Vec<_> =
            (86_401..87_100).filter_map(|s| observe(&mut machine, &rule, f64::from(s), LimitCheck::Healthy)).collect();
        assert_eq!(after.last(), Some(&Change::Cleared), "{after:?}");
        assert!(!machine.state.is_raised());
        // A backward step of the clock does not hold the alarm for longer.
        for second in -1_000_000..-998_000 {
            let check = if second < -999_999 { LimitCheck::Beyond } else { LimitCheck::Healthy };
            observe(&mut machine, &rule, f64::from(second), check);
        }
        assert!(!machine.state.is_raised(), "{ends:?}");
    }
}
