//! Tests digest frames, decoded with the shipped DBC.

use super::*;
use crate::can::encode::{OutputPlan, SendCounters, default_database};

fn read(frames: &[Frame], name: &str) -> f64 {
    let database = default_database().unwrap();
    let (_, signal) = database.signal(&format!("PACKWATCH_Digest.{name}")).unwrap();
    let page = signal.conditions.first().map_or(0, |condition| condition.ranges[0].0);
    let frame = frames.iter().find(|frame| u64::from(frame.data()[2] & 0x0F) == page).unwrap();
    signal.layout.plan().unwrap().decode(frame.data()).unwrap()
}

fn frames(fields: &DigestFields) -> Vec<Frame> {
    let plan = OutputPlan::new(&default_database().unwrap()).unwrap();
    let mut counters = SendCounters::default();
    (0..plan.digest_pages()).map(|page| plan.digest(page, fields, &mut counters).unwrap()).collect()
}

#[test]
fn every_page_decodes_to_its_values() {
    let mut checksum = TableChecksum::default();
    checksum.add(9, 2, None, 1, true);
    let mut rules = [RuleState::NotWatched; RULE_COUNT];
    (rules[0], rules[8], rules[13]) = (RuleState::Unknown, RuleState::Warning, RuleState::None);
    (rules[14], rules[16]) = (RuleState::Info, RuleState::Severe);
    let threshold = Some(ThresholdFields { rule: 14, severity: 3, threshold: 1.0 });
    let made = frames(&DigestFields { raised: 97, worst: 2, checksum, pass_time_s: 1.94, rules, threshold });
    assert_eq!(made.len(), 4);
    for (name, wanted) in [
        ("Raised", 97.0),
        ("Worst", 2.0),
        ("TableChecksum", f64::from(checksum.value())),
        ("PassTime", 1.9),
        ("Rule_CapacityLow", 4.0),
        ("Rule_UsableCapacityLow", 5.0),
        ("Rule_TemperatureHigh", 2.0),
        ("Rule_BusFault", 0.0),
        ("Rule_CellLeak", 1.0),
        ("Rule_ConnectionResistance", 5.0),
        ("Rule_ChannelFaulty", 3.0),
        ("Rule_ThermalEvent", 5.0),
        ("ThresholdRule", 14.0),
        ("ThresholdSeverity", 3.0),
        ("Threshold", 1.0),
    ] {
        assert!((read(&made, name) - wanted).abs() < 0.051, "{name}: {} for {wanted}", read(&made, name));
    }
}

#[test]
fn threshold_uses_unit_of_rule_signal() {
    let of = |rule, threshold| {
        let threshold = Some(ThresholdFields { rule, severity: 1, threshold });
        read(&frames(&DigestFields { threshold, ..DigestFields::default() }), "Threshold")
    };
    assert!((of(8, 0.155) - 15.5).abs() < 1e-5, "SOC in %");
    assert!((of(1, 1.82) - 1.82).abs() < 1e-6, "capacity in Ah");
    assert!((of(15, 0.001) - 0.1).abs() < 1e-7, "leak in % per day");
}

#[test]
fn checksum_ignores_order_and_covers_every_field() {
    let sum = |entries: &[(u8, u8, Option<u16>, u8, bool)]| {
        let mut checksum = TableChecksum::default();
        for &(rule, severity, cell, state, is_acknowledged) in entries {
            checksum.add(rule, severity, cell.map(CellIndex), state, is_acknowledged);
        }
        checksum.value()
    };
    let (one, other) = ((1, 2, Some(3), 1, false), (9, 3, None, 4, true));
    assert_eq!(sum(&[one, other]), sum(&[other, one]));
    assert_eq!(sum(&[]), 0);
    for changed in [
        (2, 2, Some(3), 1, false),
        (1, 3, Some(3), 1, false),
        (1, 2, Some(259), 1, false),
        (1, 2, None, 1, false),
        (1, 2, Some(3), 5, false),
        (1, 2, Some(3), 1, true),
    ] {
        assert_ne!(sum(&[one]), sum(&[changed]), "{changed:?}");
    }
    // The example in the manual.
    assert_eq!(sum(&[(9, 2, None, 1, false)]), 0x12CD);
    assert_eq!(TableChecksum(u16::MAX).value(), 65534);
}
