//! Tests which signals are skipped and which values are withheld, for the ids, datatypes and limits of a broker.

use packwatch_host::quantity::catalogue::Quantity;
use packwatch_host::status::client::parse;

use super::super::messages::{Texts, TypedValue};
use super::*;

const BRANCH: &str = "Vehicle.Powertrain.TractionBattery.Packwatch";
const HEALTH: &str = "Vehicle.Powertrain.TractionBattery.StateOfHealth";
const CHARGE: &str = "Vehicle.Powertrain.TractionBattery.StateOfCharge.Current";

fn document() -> StatusDocument {
    parse(include_bytes!("../../../../tests/kuksa/status.json")).unwrap()
}

fn float(number: f32) -> Value {
    Value { typed: Some(TypedValue::Float(number)) }
}

/// A signal in percent, limited to 0 to 100.
fn entry(path: &str, id: i32) -> Metadata {
    let (min, max) = (Some(float(0.0)), Some(float(100.0)));
    Metadata { path: path.into(), id, data_type: 11, allowed: None, min, max }
}

fn reason(metadata: &[Metadata], path: &str) -> String {
    let (routes, skipped) = Routes::resolve(metadata, BRANCH, true);
    assert_eq!(routes.len() + skipped.len(), signals::all().count());
    skipped.into_iter().find(|skipped| skipped.path == path).map(|skipped| skipped.reason).unwrap_or_default()
}

fn sent(points: &DataPoints, id: i32) -> Option<f32> {
    match points.by_id[&id].value.as_ref()?.typed.as_ref()? {
        TypedValue::Float(number) => Some(*number),
        other => panic!("{other:?}"),
    }
}

#[test]
fn value_is_sent_with_id_of_its_path() {
    for (health, charge) in [(7, 8), (8, 7)] {
        let (routes, _) = Routes::resolve(&[entry(HEALTH, health), entry(CHARGE, charge)], BRANCH, true);
        let points = routes.points(Some(&document()));
        assert_eq!((sent(&points, health), sent(&points, charge)), (Some(92.8), Some(63.2)));
        assert_eq!(routes.claim().signals.keys().copied().collect::<Vec<_>>(), [7, 8]);
    }
}

#[test]
fn lifetime_sums_need_record_of_new_battery() {
    let (all, skipped) = Routes::resolve(&[], BRANCH, true);
    let (some, without) = Routes::resolve(&[], BRANCH, false);
    let sums = |skipped: &[SkippedSignal]| skipped.iter().filter(|it| it.path.contains("Throughput")).count();
    assert_eq!((all.len(), some.len(), sums(&skipped), sums(&without)), (0, 0, 3, 0));
    assert_eq!(skipped.len() - without.len(), 5);
}

#[test]
fn missing_path_or_other_datatype_is_skipped() {
    let other = Metadata { data_type: 7, ..entry(HEALTH, 1) };
    assert_eq!(reason(&[other], HEALTH), "datatype uint8 in the broker, must be float");
    assert_eq!(reason(&[], CHARGE), "the broker does not know the signal");
    assert_eq!(reason(&[entry(HEALTH, 1)], HEALTH), "");
}

#[test]
fn path_with_listed_values_is_skipped() {
    let listed = Value { typed: Some(TypedValue::Texts(Texts { values: vec!["valid".into()] })) };
    let path = format!("{BRANCH}.Validity");
    let validity = Metadata { path: path.clone(), id: 3, data_type: 1, allowed: Some(listed), min: None, max: None };
    assert!(reason(&[validity], &path).starts_with("the broker allows listed values only"));
}

#[test]
fn id_of_two_paths_is_used_for_neither() {
    let twice = [entry(HEALTH, 5), entry(CHARGE, 5)];
    assert!(reason(&twice, HEALTH).contains("id 5 for another signal"));
    assert!(reason(&twice, CHARGE).contains("id 5 for another signal"));
    assert_eq!(reason(&[entry(HEALTH, 5), entry("Vehicle.Speed", 6), entry(HEALTH, 5)], HEALTH), "", "listed twice");
}

#[test]
fn value_outside_limits_is_withheld() {
    let (routes, _) = Routes::resolve(&[entry(HEALTH, 7)], BRANCH, true);
    let mut status = document();
    status.pack.values.set(Quantity::Soh, Some(1.02));
    let points = routes.points(Some(&status));
    assert_eq!((sent(&points, 7), points.withheld), (None, vec!["StateOfHealth"]));
    status.pack.values.set(Quantity::Soh, Some(1.0));
    let points = routes.points(Some(&status));
    assert_eq!((sent(&points, 7), points.withheld.len()), (Some(100.0), 0));
}

#[test]
fn missing_document_gives_points_without_values() {
    let (routes, _) = Routes::resolve(&[entry(HEALTH, 7), entry(CHARGE, 8)], BRANCH, true);
    let points = routes.points(None);
    assert_eq!(points.by_id.len(), 2);
    assert!(points.by_id.values().all(|point| point.value.is_none() && point.timestamp.is_some()));
}

#[test]
fn request_is_answered_for_own_ids_only() {
    let (routes, _) = Routes::resolve(&[entry(HEALTH, 7), entry(CHARGE, 8)], BRANCH, true);
    let points = routes.points_of(&[8, 99], Some(&document()));
    assert_eq!(points.by_id.keys().copied().collect::<Vec<_>>(), [8]);
}
