//! Tests of order, budget and repetition of alarm frames.

use super::*;
use crate::alarm::{Comparison, Observation, RuleConfig};

const PERIOD_S: f64 = 1.0;
const CELLS: u16 = 97;

fn config(rule: Rule, severity: Severity) -> RuleConfig {
    RuleConfig {
        rule,
        severity,
        threshold: 3.0,
        clear: 3.0,
        when: Comparison::Mean,
        debounce_s: 0.0,
        debounce_events: 1,
        is_latching: false,
    }
}

/// An engine with two rules: a warning for each cell, and a severe alarm of the pack.
fn engine() -> AlarmEngine {
    let rules =
        vec![config(Rule::EstimateUntrusted, Severity::Warning), config(Rule::TemperatureHigh, Severity::Severe)];
    AlarmEngine::new(rules, CELLS)
}

fn observe(engine: &mut AlarmEngine, rule: Rule, cell: Option<u16>, value: Option<f64>) {
    engine.observe(Timestamp::ZERO, rule, cell.map(CellIndex), &Observation::new(value), &mut Vec::new());
}

fn raise(engine: &mut AlarmEngine, cells: u16) {
    (0..cells).for_each(|cell| observe(engine, Rule::EstimateUntrusted, Some(cell), Some(9.0)));
}

fn cell_key(cell: u16) -> AlarmKey {
    AlarmKey::new(Rule::EstimateUntrusted, Severity::Warning, Some(CellIndex(cell)))
}

const PACK_KEY: fn() -> AlarmKey = || AlarmKey::new(Rule::TemperatureHigh, Severity::Severe, None);

/// Frames sent by the ticks from `from_ms` to `from_ms + for_ms`, each with its time, ms.
fn sent(queue: &mut AlarmQueue, engine: &AlarmEngine, from_ms: i64, for_ms: i64) -> Vec<(i64, AlarmKey)> {
    let mut sent = Vec::new();
    for ms in (from_ms..from_ms + for_ms).step_by(10) {
        while let Some(key) = queue.take(Timestamp::from_nanos(ms * NANOS_PER_MS), engine, PERIOD_S) {
            sent.push((ms, key));
        }
    }
    sent
}

#[test]
fn change_is_sent_once_and_repeated_three_times() {
    let (mut queue, engine) = (AlarmQueue::default(), engine());
    queue.note_change(Timestamp::ZERO, cell_key(4));
    let times: Vec<i64> = sent(&mut queue, &engine, 0, 5_000).into_iter().map(|(ms, _)| ms).collect();
    assert_eq!(times, [0, 100, 200, 300]);
    assert_eq!(queue.next_due(), None, "nothing waits");
}

#[test]
fn another_change_restarts_the_repetition() {
    let (mut queue, engine) = (AlarmQueue::default(), engine());
    queue.note_change(Timestamp::ZERO, cell_key(4));
    sent(&mut queue, &engine, 0, 150);
    queue.note_change(Timestamp::from_nanos(150 * NANOS_PER_MS), cell_key(4));
    assert_eq!(sent(&mut queue, &engine, 150, 5_000).len(), 4);
}

#[test]
fn many_changes_stay_within_budget_worst_first() {
    let (mut queue, mut engine) = (AlarmQueue::default(), engine());
    raise(&mut engine, CELLS);
    let start = Timestamp::from_secs(10.0);
    for cell in 0..CELLS {
        queue.note_change(start, cell_key(cell));
    }
    queue.note_change(start, PACK_KEY());
    let sent: Vec<_> =
        sent(&mut queue, &engine, 10_000, 10_000).into_iter().map(|(ms, key)| (ms - 10_000, key)).collect();
    assert_eq!(sent[0].1, PACK_KEY());
    let first_98: Vec<AlarmKey> = sent[..98].iter().map(|(_, key)| *key).collect();
    assert!(first_98.is_sorted(), "every alarm is sent once, most severe first, before any frame is repeated");
    assert!(sent[97].0 <= 800, "the last change is first sent after {} ms", sent[97].0);
    for window_ms in [0, 1_000, 3_000, 8_000] {
        let count = sent.iter().filter(|(ms, _)| (window_ms..window_ms + 1_000).contains(ms)).count();
        assert!(count <= 100 + usize::try_from(BURST).unwrap(), "{count} frames in a second");
    }
}

#[test]
fn every_raised_alarm_is_sent_within_pass_time() {
    for raised in [1, 2, 5, 50, 51, 97] {
        let (mut queue, mut engine) = (AlarmQueue::default(), engine());
        raise(&mut engine, raised);
        let pass_ms = (AlarmQueue::pass_time_s(&engine, PERIOD_S) * 1000.0).round() as i64;
        assert_eq!(pass_ms, (i64::from(raised) * 20).max(1_000), "{raised} alarms");
        sent(&mut queue, &engine, 0, 1_000);
        for pass in 0..8 {
            let mut keys: Vec<AlarmKey> = sent(&mut queue, &engine, 1_000 + pass * (pass_ms + 10), pass_ms + 10)
                .into_iter()
                .map(|(_, key)| key)
                .collect();
            keys.sort_unstable();
            keys.dedup();
            assert_eq!(keys.len(), usize::from(raised), "{raised} alarms, pass {pass}");
        }
    }
}

#[test]
fn alarm_no_longer_unknown_is_announced() {
    let (mut queue, mut engine) = (AlarmQueue::default(), engine());
    let announced = queue.take_unknown(Timestamp::ZERO, &engine, 1).unwrap();
    assert_eq!((announced.rule, announced.state), (Rule::TemperatureHigh, AlarmState::Unknown));
    queue.note_known(Timestamp::ZERO, &engine);
    assert!(sent(&mut queue, &engine, 0, 1_000).is_empty(), "it is still unknown");
    observe(&mut engine, Rule::TemperatureHigh, None, Some(1.0));
    queue.note_known(Timestamp::ZERO, &engine);
    let frames = sent(&mut queue, &engine, 1_000, 1_000);
    assert_eq!(frames.iter().map(|(_, key)| *key).collect::<Vec<_>>(), [PACK_KEY(); 4]);
}

#[test]
fn announced_unknown_alarms_are_limited() {
    let (mut queue, mut engine) = (AlarmQueue::default(), engine());
    let mut announced = 0;
    for second in 0..i64::from(CELLS) {
        // In each round, the value of one more cell becomes known, so the first unknown cell is a different one.
        observe(&mut engine, Rule::EstimateUntrusted, Some(u16::try_from(second).unwrap()), Some(1.0));
        announced += u32::from(queue.take_unknown(Timestamp::from_secs(second as f64), &engine, 0).is_some());
    }
    assert_eq!(queue.unknown.len(), MAX_UNKNOWN);
    assert!(announced >= u32::try_from(MAX_UNKNOWN).unwrap());
}

#[test]
fn frames_until_agrees_with_sent_frames() {
    for (raised, changed) in [(0, 0), (0, 3), (3, 0), (7, 2), (97, 1)] {
        let (mut queue, mut engine) = (AlarmQueue::default(), engine());
        raise(&mut engine, raised);
        sent(&mut queue, &engine, 0, 500);
        for cell in 0..changed {
            queue.note_change(Timestamp::from_nanos(500 * NANOS_PER_MS), cell_key(cell));
        }
        sent(&mut queue, &engine, 500, 10);
        let until = Timestamp::from_nanos(3_500 * NANOS_PER_MS);
        let counted = queue.frames_until(until, &engine, PERIOD_S);
        let found = u64::try_from(sent(&mut queue, &engine, 510, 3_000).len()).unwrap();
        assert!((found..=found + 1).contains(&counted), "{raised} raised: {counted} for {found}");
    }
}

#[test]
fn stored_times_far_ahead_do_not_stop_sending() {
    let (mut queue, mut engine) = (AlarmQueue::default(), engine());
    raise(&mut engine, 2);
    sent(&mut queue, &engine, 0, 2_000);
    queue.note_change(Timestamp::from_secs(2.0), cell_key(1));
    queue.rebase(i64::MAX / 2);
    queue.limit(Timestamp::from_secs(2.0), Timestamp::from_secs(2.0), PERIOD_S);
    assert!(sent(&mut queue, &engine, 2_000, 1_500).len() >= 5);
}

#[test]
fn clock_set_back_does_not_stop_sending() {
    let (mut queue, mut engine) = (AlarmQueue::default(), engine());
    raise(&mut engine, 2);
    sent(&mut queue, &engine, 1_000_000, 2_000);
    queue.note_change(Timestamp::from_secs(1_002.0), cell_key(1));
    queue.restart(Timestamp::ZERO);
    assert!(sent(&mut queue, &engine, 0, 1_500).len() >= 5);
}

#[test]
fn restart_after_burst_sends_no_second_burst() {
    let (mut queue, engine) = (AlarmQueue::default(), engine());
    for cell in 0..CELLS {
        queue.note_change(Timestamp::from_secs(10.0), cell_key(cell));
    }
    // The state was stored before the first of these frames was sent.
    let mut stored = queue.clone();
    let mut frames = sent(&mut queue, &engine, 10_000, 100).len();
    assert!(frames > usize::try_from(BURST).unwrap());
    let now = Timestamp::from_secs(10.1);
    stored.limit(Timestamp::from_secs(10.0), now, PERIOD_S);
    stored.restart(now);
    frames += sent(&mut stored, &engine, 10_100, 900).len();
    assert!(frames <= 101 + usize::try_from(BURST).unwrap(), "{frames} frames in a second");
}
