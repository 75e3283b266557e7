//! Tests the sentences about findings and alarms.

use super::*;
use crate::cell_faults::imbalance::{CellSpread, LimitReason, LimitingCell};
use crate::filter::ScalarGaussian;
use crate::quantity::{DAY_S, Timestamp};
use crate::report::data::AlarmRecord;
use crate::report::examples;

const FIRST_S: f64 = 1.7e9;

fn found(kind: CellFaultKind, cell: u16, mean: f64, since_days: f64) -> CellFault {
    let since = Timestamp::from_secs(FIRST_S + since_days * DAY_S);
    let size = ScalarGaussian { mean, variance: 0.02_f64.powi(2) };
    let cells = Some((CellIndex(cell), CellIndex(cell)));
    CellFault { kind, cells, since, reported: since, probability: 1.0, size }
}

/// Creates a record of 27 days in which the contacts were first reported with the size `first`.
fn record(contacts: &[CellFault], first: f64) -> Data {
    let mut data = examples::recording(FIRST_S, 27.0 * DAY_S);
    for found in contacts {
        let key = (found.kind, found.cells.expect("a cell").0);
        data.first_sizes.insert(key, ScalarGaussian { mean: first, ..found.size });
    }
    data
}

fn alarm(rule: &str, severity: &str, cell: Option<usize>) -> AlarmRecord {
    AlarmRecord {
        time_s: FIRST_S + 20.0 * DAY_S,
        rule: rule.to_owned(),
        severity: severity.to_owned(),
        cell,
        change: "raised".to_owned(),
        is_active: true,
        value: Some(0.2),
        threshold: Some(0.15),
    }
}

fn list(findings: &[CellFault], data: &Data) -> Vec<Problem> {
    of_battery(findings, data, &PageContext::default(), None)
}

#[test]
fn cells_of_one_kind_are_one_problem_with_numbers_from_1() {
    let low = [found(CellFaultKind::LowCharge, 1, -0.027, 1.0), found(CellFaultKind::LowCharge, 80, -0.029, 1.0)];
    let problems = list(&low, &record(&[], 0.0));
    assert_eq!(problems.len(), 1, "{problems:?}");
    assert_eq!(problems[0].what, "Cells 2 and 81 have 2.7 to 2.9 points less charge than the others.");
    assert!(problems[0].advice.starts_with("Balance the pack, because a cell with less charge ends a discharge early"));
    let leak = list(&[found(CellFaultKind::Leak, 81, 0.013, 1.0)], &record(&[], 0.0));
    assert_eq!(leak[0].what, "Cell 82 loses 1.30 \u{b1} 2.00 % of the capacity per day without a load.");
}

#[test]
fn contact_from_the_beginning_differs_from_one_that_grows() {
    let contacts = [9, 51, 62].map(|cell| found(CellFaultKind::Contact, cell, 0.2, 5.0));
    let of = |contacts: &[CellFault], first| list(contacts, &record(contacts, first)).remove(0);
    let steady = of(&contacts, 0.19);
    assert!(steady.what.ends_with("has not grown, as in longer links between modules."), "{}", steady.what);
    assert!(steady.what.starts_with("Cells 10, 52 and 63 have 20 % more contact resistance"), "{}", steady.what);
    assert_eq!(steady.condition, Condition::Watch);
    let grown = of(&contacts, 0.11);
    assert!(grown.what.contains("comes loose") && grown.advice.starts_with("Tighten and clean"), "{grown:?}");
    assert_eq!(grown.condition, Condition::Plan);
    let late = [found(CellFaultKind::Contact, 9, 0.2, 15.0)];
    assert!(of(&late, 0.19).what.contains("comes loose"));
    // The history in a store does not contain the size at the first report.
    assert!(list(&contacts, &record(&[], 0.0))[0].what.ends_with("Whether the resistance grows is not known yet."));
}

#[test]
fn growing_contact_is_separate_from_steady_ones() {
    let contacts = [9, 51, 62].map(|cell| found(CellFaultKind::Contact, cell, 0.2, 5.0));
    let mut data = record(&contacts, 0.19);
    let first = ScalarGaussian { mean: 0.11, ..contacts[1].size };
    data.first_sizes.insert((CellFaultKind::Contact, CellIndex(51)), first);
    let problems = list(&contacts, &data);
    assert_eq!(problems.len(), 2, "{problems:?}");
    let [steady, grown] = [&problems[0], &problems[1]];
    assert!(steady.what.starts_with("Cells 10 and 63 have 20 % more") && steady.what.contains("has not grown"));
    assert!(grown.what.starts_with("Cell 52 has 20 ") && grown.what.contains("The resistance grows"), "{grown:?}");
    assert_eq!((steady.condition, grown.condition), (Condition::Watch, Condition::Plan));
}

#[test]
fn alarm_of_a_finding_is_part_of_its_problem() {
    let contacts = [found(CellFaultKind::Contact, 9, 0.2, 5.0)];
    let low = found(CellFaultKind::LowCharge, 1, -0.027, 1.0);
    let mut data = record(&contacts, 0.19);
    data.alarms.push(alarm("connection_resistance", "warning", Some(9)));
    data.alarms.push(alarm("cell_imbalance", "severe", None));
    let problems = list(&[contacts[0], low], &data);
    assert_eq!(problems.len(), 2, "{problems:?}");
    assert!(problems[0].what.starts_with("Cell 2 has"), "charge first: {problems:?}");
    assert_eq!(problems[0].condition, Condition::Act, "as severe as its alarm");
    assert!(problems[0].note.contains(" Alarm cell_imbalance (severe) of pack since 2023-12-04"), "{problems:?}");
    assert!(problems[1].note.contains("Alarm connection_resistance (warning) of cell 10 since 2023-12-04"));
    assert_eq!(problems[1].condition, Condition::Plan);
    data.alarms.push(alarm("connection_resistance", "warning", Some(11)));
    let other = list(&[contacts[0], low], &data);
    assert!(other[2].what.starts_with("The contact resistance in excess of the other cells of cell 12"), "{other:?}");
}

#[test]
fn pack_out_of_balance_is_named_without_a_failing_cell() {
    let spread = CellSpread { std: 0.02, error: 0.003, lowest: (CellIndex(9), -0.02), highest: (CellIndex(90), 0.06) };
    let limit = |cell, reason| LimitingCell { cell: CellIndex(cell), reason, by_charge: 0.03, by_capacity: 0.0 };
    let value = |mean, std: f64| ScalarGaussian { mean, variance: std * std };
    let pack = |lost| Imbalance {
        time: Timestamp::from_secs(FIRST_S),
        cells: 96,
        mean_ah: value(126.0, 12.0),
        usable: value(1.0 - lost, 0.008),
        lost_by_imbalance: value(lost, 0.008),
        lost_by_weakest: value(0.0, 0.002),
        weakest: CellIndex(64),
        discharge_limit: limit(9, LimitReason::LeastCharge),
        charge_limit: limit(90, LimitReason::MostCharge),
        soc: spread,
        capacity: spread,
        resistance: spread,
        left_out: Vec::new(),
    };
    let of = |lost, findings: &[CellFault], data: &Data| {
        let context = PageContext { imbalance: Some(Ok(pack(lost))), ..PageContext::default() };
        of_battery(findings, data, &context, None)
    };
    let mut data = record(&[], 0.0);
    let text = "The pack is out of balance: 5.7 \u{b1} 0.8 % of its capacity cannot be used. Cell 10 is empty first, and cell 91 \
                is full first. No failing cell was found.";
    assert_eq!(of(0.057, &[], &data)[0].what, text);
    assert_eq!(of(0.04, &[], &data), [], "within two standard deviations of the limit");
    data.alarms.push(alarm("cell_imbalance", "severe", None));
    let with_alarm = of(0.057, &[], &data);
    assert_eq!(with_alarm.len(), 1, "the alarm says the same");
    assert_eq!(with_alarm[0].condition, Condition::Act, "as severe as its alarm");
    assert!(with_alarm[0].note.starts_with("Alarm cell_imbalance (severe) of pack since"), "{with_alarm:?}");
    let low = [found(CellFaultKind::LowCharge, 1, -0.027, 1.0)];
    let with_cost = of(0.057, &low, &data);
    assert_eq!(with_cost.len(), 1);
    assert!(
        with_cost[0].what.ends_with("Because of imbalance, 5.7 \u{b1} 0.8 % of the pack's capacity cannot be used."),
        "{with_cost:?}"
    );
}

#[test]
fn every_kind_of_finding_has_a_sentence() {
    for kind in CellFaultKind::ALL {
        let text = sentence(kind, "Cells 3 and 4", true, "2.0");
        assert!(text.ends_with('.') && text.starts_with(char::is_uppercase), "{kind:?}: {text}");
    }
}

#[test]
fn end_of_life_is_listed_unless_capacity_low_is_raised() {
    let said = |alarms: &[AlarmRecord]| {
        let mut data = examples::worn(1);
        // Without a configuration, the limit of the cleared alarm is the end of life.
        let cleared =
            AlarmRecord { is_active: false, threshold: Some(2.5), ..alarm("capacity_low", "warning", Some(0)) };
        data.alarms.push(cleared);
        data.alarms.extend_from_slice(alarms);
        let what = list(&[], &data).into_iter().map(|problem| problem.what);
        what.filter(|what| what.contains("end of life")).collect::<Vec<String>>()
    };
    assert_eq!(said(&[]), ["The capacity is below the end of life, but no alarm is raised."]);
    let text = "The capacity is below the end of life.";
    for severity in ["info", "severe"] {
        assert_eq!(said(&[alarm("temperature_high", severity, None)]), [text], "{severity}");
    }
    let raised = AlarmRecord { threshold: Some(2.5), ..alarm("capacity_low", "warning", Some(0)) };
    assert!(said(&[raised]).is_empty());
}

#[test]
fn alarms_of_two_rules_are_two_problems() {
    let mut data = examples::worn(4);
    for cell in 0..4 {
        // The monitor raises all alarms of one cell before those of the next.
        for rule in ["capacity_low", "usable_capacity_low"] {
            data.alarms.push(AlarmRecord { threshold: Some(2.5), ..alarm(rule, "warning", Some(cell)) });
        }
    }
    let what: Vec<String> = list(&[], &data).into_iter().map(|problem| problem.what).collect();
    assert_eq!(what.len(), 2, "{what:?}");
    assert!(
        what[0].starts_with("The capacity of cells 1 to 4 is below the limit of 2.5 Ah: 2.289 Ah in cell 4"),
        "{what:?}"
    );
    assert!(
        what[1].starts_with("The usable capacity of cells 1 to 4 is below the limit of 2.5 Ah: 2.105 Ah in cell 1"),
        "{what:?}"
    );
}
