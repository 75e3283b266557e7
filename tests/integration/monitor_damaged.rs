//! Tests a stored state with one damaged number. It must be rejected, or restored with finite outputs.
//!
//! In the state of a two-cell pack, each number in turn is replaced by values that damage or a failed calculation may
//! leave. A restored state then runs through a charge and a discharge.

use crate::support::rig::{Rig, learned};
use packwatch::monitor::{Downtime, EventKind, Monitor, RestoreError, Snapshot};
use serde_json::Value;

/// The JSON path of every number of a document.
fn numbers(value: &Value, path: &str, found: &mut Vec<String>) {
    match value {
        Value::Number(_) => found.push(path.to_owned()),
        Value::Array(all) => all.iter().enumerate().for_each(|(i, one)| numbers(one, &format!("{path}/{i}"), found)),
        Value::Object(all) => all.iter().for_each(|(key, one)| numbers(one, &format!("{path}/{key}"), found)),
        Value::Null | Value::Bool(_) | Value::String(_) => {}
    }
}

/// Values that replace a number to simulate damage. JSON writes a non-finite number as null.
fn damages(number: &Value) -> [Value; 4] {
    let negative =
        number.as_i64().map_or_else(|| (-number.as_f64().unwrap().abs() - 1e-3).into(), |n| (-n.abs() - 1).into());
    [Value::Null, 0.into(), negative, 1e300.into()]
}

impl Rig {
    /// Runs one second of frames. Returns whether all outputs are finite.
    fn is_finite_for_a_second(&mut self) -> bool {
        self.out.want_estimates = true;
        self.events.clear();
        self.tick_with_frames();
        // A signal counts as missing only after some seconds, so one step of 1 s can replace ten steps of 0.1 s.
        self.deci += 9;
        let finite = self.out.estimates.drain(..).all(|estimate| {
            let e =
                [estimate.soc, estimate.soc_std, estimate.capacity_ah, estimate.capacity_std_ah, estimate.branch_v[0]];
            e.iter().chain(&[estimate.resistance_ratio, estimate.resistance_ratio_std]).all(|x| x.is_finite())
        });
        finite && !self.events.iter().any(|event| is_odd(&format!("{event:?}")))
    }

    /// Feeds a charge, a rest, a discharge and a rest (500 s). Returns the second of the first implausible output.
    fn first_odd_second(&mut self) -> Option<i64> {
        (0..500).find(|second| {
            let current_a = [-20.0, 0.0, 20.0, 0.0][usize::try_from(second / 125).unwrap()];
            self.current_a = Some(current_a);
            self.voltages_v = [Some(3.7 - 0.005 * current_a), Some(3.69 - 0.005 * current_a)];
            !self.is_finite_for_a_second()
        })
    }
}

fn is_odd(text: &str) -> bool {
    ["NaN", " inf", "-inf", "(inf"].iter().any(|odd| text.contains(odd))
}

#[test]
fn damaged_number_is_rejected_or_harmless() {
    let mut rig = learned();
    let whole = serde_json::to_value(rig.monitor.snapshot().for_restart()).unwrap();
    let start_deci = rig.deci;
    let mut paths = Vec::new();
    numbers(&whole, "", &mut paths);
    let (mut unreadable, mut refused, mut taken) = (0, 0, 0);
    for path in &paths {
        for damage in damages(whole.pointer(path).unwrap()) {
            let mut document = whole.clone();
            *document.pointer_mut(path).unwrap() = damage.clone();
            let Ok(snapshot) = serde_json::from_value::<Snapshot>(document) else {
                unreadable += 1;
                continue;
            };
            rig.monitor = Monitor::new(rig.config.clone());
            rig.deci = start_deci;
            if rig.monitor.restore(snapshot, Downtime::Seconds(0.1)).is_err() {
                refused += 1;
                continue;
            }
            taken += 1;
            assert_eq!(rig.first_odd_second(), None, "{path} = {damage}: {:?}", rig.events);
            let resets = rig.events.iter().any(|event| matches!(event.kind, EventKind::FilterReset { .. }));
            assert!(!resets, "{path} = {damage}: the filter never stops resetting");
        }
    }
    println!("{} numbers: {unreadable} unreadable states, {refused} rejected, {taken} harmless", paths.len());
    assert!(refused > paths.len() / 2 && taken > 0);
}

#[test]
fn rejected_state_names_number_and_range() {
    let mut document = serde_json::to_value(learned().monitor.snapshot()).unwrap();
    let covariance = document.pointer_mut("/cells/1/estimator/covariance").unwrap().as_array_mut().unwrap();
    *covariance.last_mut().unwrap() = (-0.25).into();
    let mut rig = Rig::new("");
    let error = rig.monitor.restore(serde_json::from_value(document).unwrap(), Downtime::AsStamped).unwrap_err();
    assert!(matches!(error, RestoreError::Number { cell: Some(1), .. }), "{error:?}");
    let reported = "snapshot is damaged: a variance of a cell's filter (cell 1) = -0.25, must be 1e-150 to 1e20";
    assert_eq!(error.to_string(), reported);
    // The monitor must not use any part of the state. It must start as if there were no state.
    rig.seconds(5);
    assert!(rig.monitor.latest().flatten().count() == 2);
}

/// Names of a JSON object's own members, in order. No string in the object may contain a bracket.
fn names_of(text: &str) -> Vec<&str> {
    let (mut depth, mut names, mut rest) = (0, Vec::new(), text);
    while let Some(at) = rest.find(['{', '}', '[', ']', '"']) {
        let (mark, after) = (rest.as_bytes()[at], &rest[at + 1..]);
        rest = after;
        match mark {
            b'{' | b'[' => depth += 1,
            b'}' | b']' => depth -= 1,
            _ => {
                let (word, after) = after.split_once('"').unwrap();
                rest = after;
                if depth == 1 && after.starts_with(':') {
                    names.push(word);
                }
            }
        }
    }
    names
}

#[test]
fn stored_state_keeps_names_and_order() {
    let snapshot = learned().monitor.snapshot();
    let expected = "version time may_continue time_backwards intake sampling estimation cells modelling learning diagnosis \
                    thermal alarming sending statistics asleep_since packs";
    assert_eq!(names_of(&serde_json::to_string(&snapshot).unwrap()), expected.split_whitespace().collect::<Vec<_>>());
    let mut document = serde_json::to_value(snapshot).unwrap();
    assert!(serde_json::from_value::<Snapshot>(document.clone()).is_ok());
    document["surprise"] = 1.into();
    assert!(
        serde_json::from_value::<Snapshot>(document).is_err(),
        "a state of a newer version must be rejected as a whole"
    );
}
