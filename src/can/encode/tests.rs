//! What goes out reads back with the same DBC, and unknown never reads as a number.

use super::*;
use crate::can::decode::{SensorIndex, tests::map};
use crate::quantity::Fault;

fn plan() -> (Database, OutputPlan) {
    let dbc = Database::parse(PACKWATCH_DBC).expect("the shipped DBC parses");
    let id = |name: &str| dbc.message(name).map(|message| message.id);
    let ids = OutputIds { status: id(STATUS), health: id(HEALTH), alarm: id(ALARM) };
    let plan = OutputPlan::new(&dbc, &ids).expect("the shipped DBC has everything");
    (dbc, plan)
}

/// Raw code and physical value of a signal in a frame.
fn read(dbc: &Database, name: &str, frame: &Frame) -> (u64, Result<f64, Fault>) {
    let (_, signal) = dbc.signal(name).expect("is there");
    let plan = signal.layout.plan().expect("readable");
    (plan.raw(frame.data()).expect("long enough"), plan.decode(frame.data()))
}

fn close(found: Result<f64, Fault>, expected: f64, within: f64) {
    assert!(found.is_ok_and(|value| (value - expected).abs() <= within + 1e-9), "{found:?} for {expected}");
}

#[test]
fn status_reads_back_within_half_a_bit() {
    let (dbc, plan) = plan();
    let fields = StatusFields {
        soc: Some(0.7312),
        soc_std: Some(0.0123),
        mode: Mode::Discharge,
        validity: 1,
        highest_severity: 2,
        active_alarms: 3,
        limiting_cell: Some(CellIndex(1023)),
    };
    let frame = plan.status(&fields).expect("has an id");
    close(read(&dbc, "PACKWATCH_Status.Soc", &frame).1, 73.12, 0.0125);
    close(read(&dbc, "PACKWATCH_Status.SocStd", &frame).1, 1.23, 0.05);
    for (name, code) in
        [("Mode", 3), ("Validity", 1), ("HighestSeverity", 2), ("ActiveAlarms", 3), ("LimitingCell", 1023)]
    {
        assert_eq!(read(&dbc, &format!("PACKWATCH_Status.{name}"), &frame).0, code, "{name}");
    }
    assert_eq!(frame.data()[..2], [0, 0], "kept free for end-to-end protection");
}

#[test]
fn unknown_is_not_available_and_beyond_the_range_is_its_end() {
    let (dbc, plan) = plan();
    for page in 0..plan.health_pages() {
        let frame = plan.health(page, &HealthFields::default()).expect("has an id");
        let names = &plan.pages[page].1;
        for name in names {
            let (code, value) = read(&dbc, &format!("PACKWATCH_Health.{name}"), &frame);
            let (_, signal) = dbc.signal(&format!("PACKWATCH_Health.{name}")).expect("is there");
            assert_eq!(vec![code], signal.not_available_codes(), "{name} has its own code for unknown");
            assert_eq!(value, Err(Fault::OutOfRange), "{name}: unknown is outside the range");
        }
    }
    let huge = HealthFields { capacity_ah: Some(1e9), soh: Some(-3.0), ..HealthFields::default() };
    let frame = plan.health(0, &huge).expect("has an id");
    close(read(&dbc, "PACKWATCH_Health.Capacity", &frame).1, 655.34, 0.0);
    close(read(&dbc, "PACKWATCH_Health.Soh", &frame).1, 0.0, 0.0);
    assert_eq!(read(&dbc, "PACKWATCH_Health.CapacityStd", &frame).0, 0xFFFF);
}

#[test]
fn every_rule_has_value_and_threshold_on_the_wire() {
    let (dbc, plan) = plan();
    for (rule, name, value) in [
        (1, "CapacityLow", 1.4),
        (2, "UsableCapacityLow", 1.4),
        (3, "RechargePeriodLow", 3600.0),
        (4, "InputMissing", 2.5),
        (5, "InputImplausible", 0.25),
        (6, "EstimateUntrusted", 9.5),
    ] {
        assert!(plan.knows_rule(rule));
        let fields =
            AlarmFields { rule, state: 1, severity: 3, cell: None, value: Some(value), threshold: Some(value * 1.1) };
        let frame = plan.alarm(&fields).expect("has an id");
        let (_, signal) = dbc.signal(&format!("PACKWATCH_Alarm.Value_{name}")).expect("is there");
        let scale = if signal.unit == "%" { 100.0 } else { 1.0 };
        let half_bit = signal.layout.factor / 2.0;
        close(read(&dbc, &format!("PACKWATCH_Alarm.Value_{name}"), &frame).1, value * scale, half_bit);
        close(read(&dbc, &format!("PACKWATCH_Alarm.Threshold_{name}"), &frame).1, value * 1.1 * scale, half_bit);
        assert_eq!(read(&dbc, "PACKWATCH_Alarm.Cell", &frame).0, 2047, "the pack");
        assert_eq!(read(&dbc, "PACKWATCH_Alarm.Rule", &frame).0, u64::from(rule));
        let unknown = plan.alarm(&AlarmFields { value: None, ..fields }).expect("has an id");
        assert_eq!(read(&dbc, &format!("PACKWATCH_Alarm.Value_{name}"), &unknown).0, 8191);
    }
    assert!(!plan.knows_rule(31));
}

#[test]
fn without_an_identifier_nothing_is_made() {
    let dbc = Database::parse(PACKWATCH_DBC).expect("parses");
    let plan = OutputPlan::new(&dbc, &OutputIds::default()).expect("nothing asked, nothing missing");
    assert_eq!(plan.health(0, &HealthFields::default()), None);
    assert_eq!(plan.health_pages(), 0);
}

#[test]
fn everything_missing_is_told_at_once() {
    let dbc =
        Database::parse("VERSION \"\"\nBU_: X\nBO_ 1 PACKWATCH_Status: 8 X\n SG_ Soc : 0|8@1+ (1,0) [0|100] \"%\" X\n")
            .expect("parses");
    let id = Some(CanId::Standard(1));
    let faults = OutputPlan::new(&dbc, &OutputIds { status: id, health: id, alarm: None }).expect_err("incomplete");
    assert_eq!(faults[0], "message PACKWATCH_Health is missing");
    assert!(faults.contains(&"signal PACKWATCH_Status.LimitingCell is missing".to_owned()), "{faults:?}");
    assert_eq!(faults.len(), 1 + STATUS_FIELDS.len() - 1);
}

#[test]
fn input_frames_decode_to_the_values_they_were_made_from() {
    let values = [
        (Channel::Current, Some(-12.3)),
        (Channel::Temperature(SensorIndex(0)), None),
        (Channel::CellVoltage(CellIndex(2)), Some(3.321)),
    ];
    let mut frames = Vec::new();
    InputEncoder::new(&map()).encode(&values, &mut frames);
    let mut found = Vec::new();
    for (bus, frame) in &frames {
        map().decode(*bus, frame, |reading| found.push((reading.channel, reading.value)));
    }
    assert_eq!(found.len(), 3);
    close(found[0].1, -12.3, 1e-9);
    assert_eq!(found[1].1, Err(Fault::NotAvailable));
    close(found[2].1, 3.321, 1e-9);
}

#[test]
fn a_frame_that_would_have_to_lie_is_not_made() {
    // Cell 2 shares its page with cell 1, has no value and no "not available" code.
    let mut frames = Vec::new();
    InputEncoder::new(&map()).encode(&[(Channel::CellVoltage(CellIndex(0)), Some(3.3))], &mut frames);
    assert_eq!(frames, []);
}
