//! A stored state with one damaged number: rejected, or restored with finite outputs.
//!
//! In: the state of a pack of two cells whose capacities are learned, as JSON, with each of its numbers in turn replaced
//! by what damage or a failed calculation may leave. A restored state is fed a charge and a discharge.

use crate::support::rig::{Rig, learned};
use packwatch::monitor::{Downtime, EventKind, Monitor, RestoreError, Snapshot};
use serde_json::Value;

/// The way to every number of a document.
fn numbers(value: &Value, path: &str, found: &mut Vec<String>) {
    match value {
        Value::Number(_) => found.push(path.to_owned()),
        Value::Array(all) => all.iter().enumerate().for_each(|(i, one)| numbers(one, &format!("{path}/{i}"), found)),
        Value::Object(all) => all.iter().for_each(|(key, one)| numbers(one, &format!("{path}/{key}"), found)),
        Value::Null | Value::Bool(_) | Value::String(_) => {}
    }
}

/// What a number may have become; JSON writes what is not finite as null.
fn damages(number: &Value) -> [Value; 4] {
    let negative =
        number.as_i64().map_or_else(|| (-number.as_f64().unwrap().abs() - 1e-3).into(), |n| (-n.abs() - 1).into());
    [Value::Null, 0.into(), negative, 1e300.into()]
}

impl Rig {
    /// A second of frames; whether everything that came out is finite.
    fn is_finite_for_a_second(&mut self) -> bool {
        self.out.want_estimates = true;
        self.events.clear();
        self.tick_with_frames();
        // Signals age by seconds: a step of one is as good as ten of a tenth.
        self.deci += 9;
        let finite = self.out.estimates.drain(..).all(|estimate| {
            let e =
                [estimate.soc, estimate.soc_std, estimate.capacity_ah, estimate.capacity_std_ah, estimate.branch_v[0]];
            e.iter().chain(&[estimate.resistance_ratio, estimate.resistance_ratio_std]).all(|x| x.is_finite())
        });
        finite && !self.events.iter().any(|event| is_odd(&format!("{event:?}")))
    }

    /// 1,000 samples of the two cells with a charge, a discharge, and rests; the moment of the first odd output.
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
fn one_damaged_number_is_refused_or_harmless() {
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
    println!("{} numbers: {unreadable} times no state, {refused} times refused, {taken} times harmless", paths.len());
    assert!(refused > paths.len() / 2 && taken > 0);
}

#[test]
fn a_refused_state_names_the_number_and_its_range() {
    let mut document = serde_json::to_value(learned().monitor.snapshot()).unwrap();
    let covariance = document.pointer_mut("/cells/1/estimator/covariance").unwrap().as_array_mut().unwrap();
    *covariance.last_mut().unwrap() = (-0.25).into();
    let mut rig = Rig::new("");
    let error = rig.monitor.restore(serde_json::from_value(document).unwrap(), Downtime::AsStamped).unwrap_err();
    assert!(matches!(error, RestoreError::Number { cell: Some(1), .. }), "{error:?}");
    let reported = "snapshot is damaged: a variance of a cell's filter (cell 1) = -0.25, must be 1e-150 to 1e20";
    assert_eq!(error.to_string(), reported);
    // Nothing of it was used: the monitor begins as a new one.
    rig.seconds(5);
    assert!(rig.monitor.latest().flatten().count() == 2);
}

/// Names of a JSON object itself, in their order; no string in it holds a bracket.
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
fn the_stored_form_keeps_its_names_and_their_order() {
    let snapshot = learned().monitor.snapshot();
    let expected = "version time may_continue time_backwards intake sampling estimation cells modelling learning diagnosis \
                    alarming sending statistics asleep_since packs";
    assert_eq!(names_of(&serde_json::to_string(&snapshot).unwrap()), expected.split_whitespace().collect::<Vec<_>>());
    let mut document = serde_json::to_value(snapshot).unwrap();
    assert!(serde_json::from_value::<Snapshot>(document.clone()).is_ok());
    document["surprise"] = 1.into();
    assert!(serde_json::from_value::<Snapshot>(document).is_err(), "a state of a later program is not half read");
}
