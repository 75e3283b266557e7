//! Tests scenarios with a whole engine; `machine/tests.rs` tests the transition table.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::super::AlarmInput;
use super::super::{Comparison, Direction};
use super::*;

fn rule(rule: Rule, threshold: f64, hysteresis: f64, debounce_s: f64, debounce_events: u32) -> RuleConfig {
    let clear = match rule.spec().direction {
        Direction::Below => threshold + hysteresis,
        Direction::Above => threshold - hysteresis,
    };
    let (severity, when) = (Severity::Warning, Comparison::Mean);
    RuleConfig { rule, severity, threshold, clear, when, debounce_s, debounce_events, is_latching: false }
}

fn observe(
    engine: &mut AlarmEngine,
    now: Timestamp,
    rule: Rule,
    cell: Option<CellIndex>,
    value: Option<f64>,
    changes: &mut Vec<AlarmChange>,
) {
    engine.observe(now, rule, cell, &Observation::new(value), changes);
}

fn at(seconds: f64) -> Timestamp {
    Timestamp::from_secs(seconds)
}

const CELL: Option<CellIndex> = Some(CellIndex(0));

#[test]
fn noise_at_threshold_raises_and_clears_once() {
    let mut engine = AlarmEngine::new(vec![rule(Rule::EstimateUntrusted, 3.0, 0.5, 5.0, 3)], 1);
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut changes = Vec::new();
    let mut crossings = 0;
    let mut was_beyond = false;
    for second in 0..24 * 3600 {
        // The value is healthy for six hours, at the threshold for twelve hours, and healthy again for six hours. It
        // always has noise of +/- 0.4.
        let mean = if (6 * 3600..18 * 3600).contains(&second) { 3.0 } else { 1.5 };
        let value = mean + rng.random_range(-0.4..0.4);
        crossings += u32::from((value > 3.0) != was_beyond);
        was_beyond = value > 3.0;
        observe(&mut engine, at(f64::from(second)), Rule::EstimateUntrusted, CELL, Some(value), &mut changes);
    }
    assert!(crossings > 10_000, "the noise must cross the threshold often, but did so only {crossings} times");
    assert_eq!(changes.iter().map(|change| change.change).collect::<Vec<_>>(), [Change::Raised, Change::Cleared]);
    assert_eq!(engine.count(), 0);
}

#[test]
fn lost_input_keeps_active_alarm_without_value() {
    let mut engine = AlarmEngine::new(vec![rule(Rule::CapacityLow, 1.4, 0.05, 0.0, 1)], 2);
    let mut changes = Vec::new();
    observe(&mut engine, at(0.0), Rule::CapacityLow, CELL, Some(1.3), &mut changes);
    assert_eq!(changes.len(), 1);
    observe(&mut engine, at(10.0), Rule::CapacityLow, CELL, None, &mut changes);
    engine.poll(at(1e6), &mut changes);
    let heard: Vec<_> = changes.iter().map(|change| change.change).collect();
    assert_eq!(heard, [Change::Raised, Change::Suppressed], "expected neither a clear nor another raise");
    let alarms: Vec<_> = engine.raised().collect();
    assert_eq!((alarms.len(), alarms[0].value, alarms[0].last_raised), (1, None, Some(at(0.0))));
    assert_eq!((alarms[0].state, alarms[0].raised_value), (AlarmState::Suppressed, Some(1.3)));
}

#[test]
fn unknown_values_raise_no_alarm() {
    let mut engine = AlarmEngine::new(Rule::ALL.map(|r| rule(r, 1.0, 0.0, 0.0, 1)).to_vec(), 4);
    let mut changes = Vec::new();
    for r in Rule::ALL {
        for cell in [None, CELL] {
            observe(&mut engine, at(0.0), r, cell, None, &mut changes);
            observe(&mut engine, at(1.0), r, cell, Some(f64::NAN), &mut changes);
        }
    }
    engine.poll(at(100.0), &mut changes);
    assert_eq!(changes, []);
}

#[test]
fn only_learned_values_debounce_without_new_observation() {
    let rules = vec![rule(Rule::CapacityLow, 1.4, 0.0, 30.0, 1), rule(Rule::EstimateUntrusted, 3.0, 0.0, 30.0, 1)];
    let mut engine = AlarmEngine::new(rules, 1);
    let mut changes = Vec::new();
    observe(&mut engine, at(0.0), Rule::CapacityLow, CELL, Some(1.3), &mut changes);
    observe(&mut engine, at(0.0), Rule::EstimateUntrusted, CELL, Some(9.0), &mut changes);
    engine.poll(at(29.9), &mut changes);
    assert_eq!(changes, []);
    engine.poll(at(30.0), &mut changes);
    engine.poll(at(99.0), &mut changes);
    assert_eq!(changes.iter().map(|change| change.alarm.rule).collect::<Vec<_>>(), [Rule::CapacityLow]);
}

#[test]
fn gap_does_not_debounce_measured_values() {
    let mut engine = AlarmEngine::new(vec![rule(Rule::InputMissing, 5.0, 0.0, 10.0, 1)], 1);
    let mut changes = Vec::new();
    observe(&mut engine, at(0.0), Rule::InputMissing, None, Some(6.0), &mut changes);
    engine.handle_gap();
    observe(&mut engine, at(1000.0), Rule::InputMissing, None, Some(6.0), &mut changes);
    assert_eq!(changes, []);
    observe(&mut engine, at(1010.0), Rule::InputMissing, None, Some(6.0), &mut changes);
    assert_eq!(changes.len(), 1);
}

#[test]
fn poll_raises_all_due_alarms_at_once() {
    let mut engine = AlarmEngine::new(vec![rule(Rule::CapacityLow, 1.4, 0.0, 1.0, 1)], 5);
    let mut changes = Vec::new();
    for cell in 0..5 {
        observe(&mut engine, at(0.0), Rule::CapacityLow, Some(CellIndex(cell)), Some(1.0), &mut changes);
    }
    engine.poll(at(1.0), &mut changes);
    let cells: Vec<_> = changes.iter().map(|change| change.alarm.cell.map(|cell| cell.0)).collect();
    assert_eq!(cells, [Some(0), Some(1), Some(2), Some(3), Some(4)]);
}

#[test]
fn raised_alarms_are_sorted_by_rule_and_cell() {
    let mut engine = AlarmEngine::new(
        vec![
            rule(Rule::InputMissing, 5.0, 0.0, 0.0, 1),
            RuleConfig { severity: Severity::Severe, ..rule(Rule::CapacityLow, 1.2, 0.0, 0.0, 1) },
            rule(Rule::CapacityLow, 1.4, 0.0, 0.0, 1),
        ],
        3,
    );
    let mut changes = Vec::new();
    observe(&mut engine, at(0.0), Rule::InputMissing, Some(CellIndex(1)), Some(6.0), &mut changes);
    observe(&mut engine, at(0.0), Rule::InputMissing, None, Some(6.0), &mut changes);
    assert_eq!(engine.highest_severity(), Some(Severity::Warning));
    observe(&mut engine, at(0.0), Rule::CapacityLow, Some(CellIndex(2)), Some(1.3), &mut changes);
    observe(&mut engine, at(0.0), Rule::CapacityLow, Some(CellIndex(0)), Some(1.1), &mut changes);
    let listed: Vec<_> = engine.raised().map(|a| (a.rule, a.severity, a.cell.map(|cell| cell.0))).collect();
    assert_eq!(
        listed,
        [
            (Rule::CapacityLow, Severity::Warning, Some(0)),
            (Rule::CapacityLow, Severity::Warning, Some(2)),
            (Rule::CapacityLow, Severity::Severe, Some(0)),
            (Rule::InputMissing, Severity::Warning, None),
            (Rule::InputMissing, Severity::Warning, Some(1)),
        ]
    );
    assert_eq!((engine.count(), engine.highest_severity()), (5, Some(Severity::Severe)));
}

#[test]
fn values_of_unwatched_rules_and_cells_are_ignored() {
    let mut engine = AlarmEngine::new(vec![rule(Rule::CapacityLow, 1.4, 0.0, 0.0, 1)], 2);
    let mut changes = Vec::new();
    observe(&mut engine, at(0.0), Rule::CapacityLow, None, Some(0.0), &mut changes);
    observe(&mut engine, at(0.0), Rule::CapacityLow, Some(CellIndex(2)), Some(0.0), &mut changes);
    observe(&mut engine, at(0.0), Rule::RechargePeriodLow, None, Some(0.0), &mut changes);
    assert_eq!(changes, []);
    assert_eq!(engine.get(Rule::CapacityLow, Some(CellIndex(1))).map(|alarm| alarm.state), Some(AlarmState::Unknown));
    assert_eq!(engine.get(Rule::RechargePeriodLow, None), None);
}

#[test]
fn restored_engine_behaves_like_stored_engine() {
    let rules = vec![rule(Rule::CapacityLow, 1.4, 0.0, 10.0, 2), rule(Rule::RechargePeriodLow, 900.0, 0.0, 0.0, 1)];
    let mut first = AlarmEngine::new(rules.clone(), 2);
    let mut changes = Vec::new();
    observe(&mut first, at(0.0), Rule::RechargePeriodLow, None, Some(800.0), &mut changes);
    observe(&mut first, at(5.0), Rule::CapacityLow, CELL, Some(1.3), &mut changes);
    let text = serde_json::to_string(&first.snapshot()).expect("serialises");
    let mut state: AlarmSnapshot = serde_json::from_str(&text).expect("reads back");
    assert_eq!(text, serde_json::to_string(&state).expect("serialises"));
    state.rebase(1_000_000_000_000);
    let mut second = AlarmEngine::new(rules, 2);
    assert_eq!(second.restore(at(1001.0), &state), []);
    assert_eq!(second.raised().next().and_then(|a| a.last_raised), Some(at(1000.0)));
    changes.clear();
    observe(&mut second, at(1014.9), Rule::CapacityLow, CELL, Some(1.3), &mut changes);
    assert_eq!(changes, []);
    second.poll(at(1015.0), &mut changes);
    assert_eq!(changes.len(), 1);
}

/// Whether an alarm is raised, how often it was raised, whether it is acknowledged, when it was raised first and last,
/// and the value that raised it last.
type KeptThreshold = (bool, u32, bool, [Option<Timestamp>; 2], Option<f64>);

fn kept(state: &AlarmSnapshot, rules: &[RuleConfig]) -> Vec<KeptThreshold> {
    let mut engine = AlarmEngine::new(rules.to_vec(), 2);
    engine.restore(at(1e6), state);
    let of = |alarm: Alarm| {
        let raised = [alarm.first_raised, alarm.last_raised];
        let is_acknowledged = alarm.is_acknowledged && alarm.occurrences > 0;
        (alarm.state.is_raised(), alarm.occurrences, is_acknowledged, raised, alarm.raised_value)
    };
    engine.all().map(of).collect()
}

#[test]
fn repeated_changes_lead_old_state_to_new_one() {
    let latching = RuleConfig { is_latching: true, ..rule(Rule::EstimateUntrusted, 3.0, 0.5, 0.0, 1) };
    let rules = [rule(Rule::CapacityLow, 1.4, 0.1, 2.0, 1), latching];
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut engine = AlarmEngine::new(rules.to_vec(), 2);
    let (mut old, mut changes, mut recorded) = (engine.snapshot(), Vec::new(), 0);
    for second in 0..5_000 {
        // The steps are long, because an alarm that changes often stays raised.
        let now = at(300.0 * f64::from(second));
        let cell = Some(CellIndex(rng.random_range(0..2)));
        match rng.random_range(0..20) {
            0 => {
                engine.apply(now, &AlarmInput::Acknowledge(Selector::default()), &mut changes);
            }
            1 => {
                engine.apply(now, &AlarmInput::Clear(Selector::default()), &mut changes);
            }
            2..8 => observe(&mut engine, now, Rule::CapacityLow, cell, Some(rng.random_range(1.3..1.6)), &mut changes),
            8 => observe(&mut engine, now, Rule::EstimateUntrusted, cell, None, &mut changes),
            _ => {
                observe(&mut engine, now, Rule::EstimateUntrusted, cell, Some(rng.random_range(2.0..3.3)), &mut changes)
            }
        }
        engine.poll(now, &mut changes);
        for change in changes.drain(..).filter(|it| !matches!(it.change, Change::Suppressed | Change::Resumed)) {
            recorded += 1;
            old.repeat(now, &change);
        }
        assert_eq!(kept(&old, &rules), kept(&engine.snapshot(), &rules), "second {second}");
        if rng.random_range(0..100) == 0 {
            old = engine.snapshot();
        }
    }
    assert!(recorded > 500, "{recorded} changes");
}

#[test]
fn restore_returns_alarms_of_removed_rules() {
    let mut first = AlarmEngine::new(vec![rule(Rule::CapacityLow, 1.4, 0.0, 0.0, 1)], 4);
    for cell in 0..4 {
        observe(&mut first, at(0.0), Rule::CapacityLow, Some(CellIndex(cell)), Some(1.0), &mut Vec::new());
    }
    let mut fewer_cells = AlarmEngine::new(vec![rule(Rule::CapacityLow, 1.4, 0.0, 0.0, 1)], 3);
    assert_eq!(fewer_cells.restore(at(1.0), &first.snapshot()).len(), 1);
    assert_eq!(fewer_cells.count(), 3);
}

#[test]
fn unknown_thresholds_are_counted_and_rotated() {
    let rules = vec![rule(Rule::CapacityLow, 1.4, 0.0, 0.0, 1), rule(Rule::SocLow, 0.1, 0.0, 0.0, 1)];
    let mut engine = AlarmEngine::new(rules, 2);
    let mut changes = Vec::new();
    assert_eq!(engine.unknown(), (2, 2));
    let named = |engine: &AlarmEngine, turn| engine.unknown_alarm(turn).map(|alarm| (alarm.rule, alarm.cell));
    assert_eq!(named(&engine, 0), Some((Rule::CapacityLow, CELL)));
    assert_eq!(named(&engine, 1), Some((Rule::SocLow, None)));
    assert_eq!(named(&engine, 2), named(&engine, 0));
    observe(&mut engine, at(0.0), Rule::SocLow, None, Some(0.5), &mut changes);
    observe(&mut engine, at(0.0), Rule::CapacityLow, CELL, Some(1.6), &mut changes);
    assert_eq!((engine.unknown(), named(&engine, 0)), ((2, 1), Some((Rule::CapacityLow, Some(CellIndex(1))))));
    observe(&mut engine, at(0.0), Rule::CapacityLow, Some(CellIndex(1)), Some(1.6), &mut changes);
    assert_eq!((engine.unknown(), named(&engine, 0)), ((2, 0), None));
    let lost = |rule, cell| AlarmInput::InputsValid { rule, cell, valid: false };
    engine.apply(at(1.0), &lost(Rule::CapacityLow, CELL), &mut changes);
    engine.apply(at(1.0), &lost(Rule::SocLow, None), &mut changes);
    assert_eq!(engine.unknown(), (2, 1), "only a learned value is kept while its inputs are lost");
    assert_eq!(changes, []);
}

#[test]
fn commands_change_selected_alarms_and_refuse_unhealthy_ones() {
    let mut latching = rule(Rule::CapacityLow, 1.4, 0.0, 0.0, 1);
    latching.is_latching = true;
    let mut engine = AlarmEngine::new(vec![latching, rule(Rule::SocLow, 0.1, 0.0, 0.0, 1)], 3);
    let mut changes = Vec::new();
    for (cell, last) in [(0, 1.6), (1, 1.3)] {
        let cell = Some(CellIndex(cell));
        observe(&mut engine, at(0.0), Rule::CapacityLow, cell, Some(1.3), &mut changes);
        observe(&mut engine, at(1.0), Rule::CapacityLow, cell, Some(last), &mut changes);
    }
    observe(&mut engine, at(0.0), Rule::SocLow, None, Some(0.05), &mut changes);
    changes.clear();
    let cell_1 = Selector { cell: Some(CellIndex(1)), ..Selector::default() };
    assert_eq!(
        engine.apply(at(1.0), &AlarmInput::Acknowledge(cell_1), &mut changes),
        CommandOutcome { changed: 1, refused: 0 }
    );
    assert_eq!(engine.apply(at(1.0), &AlarmInput::Acknowledge(cell_1), &mut changes), CommandOutcome::default());
    let capacity = Selector { rule: Some(Rule::CapacityLow), ..Selector::default() };
    assert_eq!(
        engine.apply(at(1.0), &AlarmInput::Clear(capacity), &mut changes),
        CommandOutcome { changed: 1, refused: 1 }
    );
    let heard: Vec<_> = changes.iter().map(|c| (c.change, c.alarm.cell, c.alarm.state)).collect();
    assert_eq!(
        heard,
        [(Change::Acknowledged, Some(CellIndex(1)), AlarmState::Active), (Change::Cleared, CELL, AlarmState::Inactive),]
    );
    assert_eq!(
        engine.apply(at(1.0), &AlarmInput::Clear(Selector::default()), &mut changes),
        CommandOutcome { changed: 1, refused: 2 }
    );
    assert_eq!(engine.get(Rule::CapacityLow, CELL).map(|alarm| alarm.occurrences), Some(0), "forgotten");
    assert_eq!(engine.count(), 2);
}

#[test]
fn show_equals_observe_for_quiet_values() {
    let rules = [Rule::InputMissing, Rule::EstimateUntrusted, Rule::CellImbalance];
    let mut configs = rules.map(|r| rule(r, 3.0, 0.5, 5.0, 3)).to_vec();
    // One rule has two thresholds. Another threshold compares a probability and needs a standard deviation, which
    // values passed to `show` do not have.
    configs.push(RuleConfig { severity: Severity::Severe, ..rule(Rule::InputMissing, 3.1, 0.2, 1.0, 1) });
    configs[2].when = Comparison::Probability(0.9);
    let mut observation = AlarmEngine::new(configs, 2);
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let (mut quiet, mut loud, mut changes) = (0, 0, Vec::new());
    for second in 0..5000 {
        let (now, r) = (at(f64::from(second)), rules[rng.random_range(0..3)]);
        let cell = [None, CELL, Some(CellIndex(1)), Some(CellIndex(2))][rng.random_range(0..4)];
        // From time to time, the value is beyond the threshold for a period.
        let value = rng.random_range(0.0..3.2) + if second % 1000 > 900 { 1.0 } else { 0.0 };
        let mut shown = observation.clone();
        let is_quiet = observation.is_quiet(r, value);
        assert!(!is_quiet || r != Rule::CellImbalance);
        let before = changes.len();
        observe(&mut observation, now, r, cell, Some(value), &mut changes);
        if is_quiet {
            shown.show(r, cell, value);
            assert_eq!(format!("{shown:?}"), format!("{observation:?}"), "{r:?} {cell:?} {value}");
            assert_eq!(changes.len(), before);
        }
        quiet += u32::from(is_quiet);
        loud += u32::from(!is_quiet);
    }
    assert!(quiet > 500 && loud > 500 && changes.len() > 4, "{quiet} quiet, {loud} loud, {} changes", changes.len());
}
