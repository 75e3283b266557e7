//! Tests the first sentence, the known figures and the unknown figures of the page.

use super::*;
use crate::cell::{Chemistry, Label};
use crate::config::of_label;
use crate::report::data::{AlarmRecord, CapacityRecord, Origin};
use crate::report::known::Tile;
use crate::report::{examples, forecast};

fn alarm(time_s: f64, rule: &str, severity: &str, is_active: bool) -> AlarmRecord {
    let (rule, severity, change) = (rule.to_owned(), severity.to_owned(), "raised".to_owned());
    AlarmRecord { time_s, rule, severity, cell: Some(2), change, is_active, value: Some(1.38), threshold: Some(1.4) }
}

fn summary(data: &Data) -> Summary {
    of(data, &PageContext::default(), &Err("too little".into()))
}

fn with_alarms(alarms: Vec<AlarmRecord>) -> Data {
    let mut data = Data::new(Origin::Store);
    data.alarms = alarms;
    data
}

#[test]
fn summary_without_data_is_unknown() {
    let summary = summary(&Data::new(Origin::Store));
    assert_eq!(summary.condition, Condition::Unknown);
    assert_eq!(summary.problems[0].what, "Unknown: nothing has been learned about this battery yet.");
    let tiles: Vec<&str> = summary.knowledge.tiles.iter().map(|tile| tile.name).collect();
    assert_eq!(tiles, ["Alarms raised now"], "unknown figures are gaps");
    let gaps = &summary.knowledge.gaps;
    assert!(gaps.len() >= 5 && gaps.iter().all(|gap| !gap.why.is_empty() && !gap.teaches.is_empty()), "{gaps:?}");
}

#[test]
fn worst_raised_alarm_decides_and_cleared_one_does_not() {
    let over = vec![alarm(1.0, "capacity_low", "severe", true), alarm(2.0, "capacity_low", "severe", false)];
    assert_eq!(summary(&with_alarms(over.clone())).condition, Condition::Unknown);
    let mut both = over;
    both.push(alarm(3.0e8, "usable_capacity_low", "warning", true));
    let plan = summary(&with_alarms(both.clone()));
    assert_eq!(plan.condition, Condition::Plan);
    let text = "The usable capacity of cell 3 was 1.38 Ah, below the limit of 1.4 Ah when the alarm was raised.";
    assert_eq!(plan.problems[0].what, text);
    both.push(alarm(4.0e8, "resistance_high", "severe", true));
    let act = summary(&with_alarms(both));
    assert_eq!((act.condition, act.problems.len()), (Condition::Act, 2));
    assert!(act.problems[0].what.starts_with("The resistance relative to new of cell 3"), "{act:?}");
}

fn learned(time_s: f64, cell: usize, measured_ah: Option<f64>) -> CapacityRecord {
    let (measured_std_ah, usable_ah, resistance) = (measured_ah.map(|_| 0.01), None, (1.0, 0.1));
    let (capacity_ah, losses) = ((1.2, 0.01), None);
    CapacityRecord { time_s, cell, measured_ah, measured_std_ah, capacity_ah, usable_ah, losses, resistance }
}

#[test]
fn good_needs_every_cell_and_a_limit() {
    let of = |rows: &[CapacityRecord], alarms: Vec<AlarmRecord>, doubt: Option<&str>| {
        let mut data = with_alarms(alarms);
        data.learned = rows.to_vec();
        doubt.into_iter().for_each(|doubt| data.doubt(doubt.to_owned()));
        summary(&data)
    };
    let cell = |cell: usize| learned(3.0, cell, Some(1.2));
    let limit =
        |threshold: f64| AlarmRecord { threshold: Some(threshold), ..alarm(4.0, "capacity_low", "severe", false) };
    let good = of(&[cell(0), cell(1)], vec![limit(1.0)], None);
    assert_eq!(
        (good.condition, good.problems[0].what.as_str()),
        (Condition::Good, "Nothing is wrong. No alarm is raised.")
    );
    let no_limit = of(&[cell(0), cell(1)], Vec::new(), None);
    assert_eq!(no_limit.condition, Condition::Unknown);
    assert!(no_limit.problems[0].what.contains("states no limit") && no_limit.problems[0].advice.contains("-c"));
    let one_missing = of(&[cell(1)], vec![limit(1.0)], None);
    let text = "Unknown: nothing has been learned yet about 1 of 2 cells. No alarm is raised.";
    assert_eq!(one_missing.problems[0].what, text);
    assert_eq!(of(&[cell(0), learned(3.0, 1, None)], vec![limit(1.0)], None).condition, Condition::Unknown);
    // The capacity is below the end of life, although no alarm is raised.
    assert_eq!(of(&[cell(0), cell(1)], vec![limit(1.6)], None).condition, Condition::Watch);
    let changed = of(&[cell(0), cell(1)], vec![limit(1.0)], Some("the history was changed"));
    assert_eq!(changed.problems[0].what, "The figures may be wrong: the history was changed.");
}

#[test]
fn missing_input_does_not_make_the_battery_bad() {
    let summary = summary(&with_alarms(vec![alarm(1.0, "input_missing", "severe", true)]));
    assert_eq!(summary.condition, Condition::Watch);
    assert_eq!(summary.problems[0].what, "Readings of cell 3 are missing.");
    assert!(summary.problems[0].advice.contains("Check sensors"), "{summary:?}");
}

#[test]
fn first_sentence_has_current_value_and_figures_have_doubts() {
    let mut data = Data::new(Origin::Replay);
    data.alarms = vec![alarm(1.7e9, "usable_capacity_low", "severe", true)];
    data.learned = vec![CapacityRecord { usable_ah: Some((0.9, 0.01)), ..learned(1.71e9, 2, Some(1.0)) }];
    let said = summary(&data);
    assert_eq!(said.problems[0].what, "The usable capacity of cell 3 is 0.9 Ah, below the limit of 1.4 Ah.");
    let capacity = |summary: &Summary| {
        summary.knowledge.tiles.iter().find(|tile| tile.name == "Capacity").cloned().expect("a tile")
    };
    assert_eq!((capacity(&said).note.as_str(), capacity(&said).doubt), ("\u{b1} 0.010, cell 3", None));
    data.learned.push(CapacityRecord { capacity_ah: (1.1, 0.01), ..learned(1.71e9, 0, None) });
    data.untrusted.insert(2);
    let doubted = capacity(&summary(&data));
    assert_eq!(doubted.note, "\u{b1} 0.010, cell 1; assumed, not measured yet");
    assert_eq!(doubted.doubt.as_deref(), Some("not trusted: cell 3"));
}

#[test]
fn capacity_that_was_not_measured_is_a_gap() {
    let mut data = Data::new(Origin::Replay);
    data.learned = vec![learned(1.71e9, 0, None)];
    let knowledge = summary(&data).knowledge;
    assert!(knowledge.tiles.iter().all(|tile| tile.name != "Capacity"));
    let gap = &knowledge.gaps[0];
    assert_eq!(gap.why, "No charge or discharge has measured it yet. Until then 1.200 \u{b1} 0.010 Ah is assumed.");
}

#[test]
fn label_is_the_reason_why_the_capacity_is_unknown() {
    let gap = |chemistry, data: &Data| {
        let context = PageContext { model: of_label(&Label::usual(chemistry, 2.9)), ..PageContext::default() };
        let gaps = Knowledge::of(data, &context, &Err("too little".into())).gaps;
        gaps.into_iter().find(|gap| gap.name.starts_with("Capacity")).expect("a gap")
    };
    let nothing = Data::new(Origin::Replay);
    let nmc = gap(Chemistry::Nmc811Graphite, &nothing);
    assert_eq!(nmc.why, "No charge of more than a quarter of the capacity has measured it yet.");
    assert_eq!(nmc.teaches, "A discharge and a charge of more than a quarter of the capacity.");
    let lfp = gap(Chemistry::LfpGraphite, &nothing);
    assert!(lfp.teaches.ends_with("nearly empty at one end and nearly full at the other."), "{lfp:?}");
    // For cells that were not measured, the advice is the same.
    let mut one_of_two = Data::new(Origin::Replay);
    one_of_two.learned = vec![learned(1.71e9, 0, Some(1.2)), learned(1.71e9, 1, None)];
    let other = gap(Chemistry::Nmc811Graphite, &one_of_two);
    assert_eq!((other.name, other.teaches), ("Capacity of the other cells", nmc.teaches));
}

#[test]
fn only_estimates_are_marked_as_untrusted() {
    let config = examples::config();
    let context = PageContext { config: Some(&config), ..PageContext::default() };
    let mut data = examples::worn(3);
    let tiles = |data: &Data| of(data, &context, &forecast::outlook(data, &context)).knowledge.tiles;
    assert!(tiles(&data).iter().all(|tile| tile.doubt.is_none()));
    data.untrusted.insert(2);
    let (marked, unmarked): (Vec<Tile>, _) = tiles(&data).into_iter().partition(|tile| tile.doubt.is_some());
    assert!(marked.iter().all(|tile| tile.doubt.as_deref() == Some("not trusted: cell 3")), "{marked:?}");
    let names = |tiles: Vec<Tile>| tiles.into_iter().map(|tile| tile.name).collect::<Vec<_>>();
    let estimates = ["State of health", "Capacity", "Usable capacity", "Lithium lost", "Resistance", "Recharge period"];
    assert_eq!(names(marked), [&estimates[..], &["Remaining life"]].concat());
    assert_eq!(names(unmarked), ["Use so far", "Alarms raised now"]);
}

#[test]
fn first_sentence_has_the_worst_of_many_cells() {
    let mut data = Data::new(Origin::Replay);
    for (cell, usable_ah) in [1.1, 0.9, 1.0].into_iter().enumerate() {
        data.alarms.push(AlarmRecord { cell: Some(cell), ..alarm(1.7e9, "usable_capacity_low", "severe", true) });
        let usable_ah = Some((usable_ah, 0.01));
        data.learned.push(CapacityRecord { usable_ah, ..learned(1.71e9, cell, Some(1.0)) });
    }
    let text = "The usable capacity of cells 1 to 3 is below the limit of 1.4 Ah: 0.9 Ah in cell 2.";
    assert_eq!(summary(&data).problems[0].what, text);
}
