//! Tests that sent frames decode with the same DBC, and that unknown values never decode to a number.

use super::*;
use crate::can::e2e::Profile;
use crate::can::encode::{E2eSetting, LayoutBase, LayoutSettings, MessageSettings, default_database, layout};
use crate::quantity::Fault;
use crate::quantity::catalogue::Estimate;

const TEXT: &str = include_str!("../../../../../config/packwatch.dbc");

/// A plan for tests that do not use counters.
struct Unprotected(OutputPlan);

impl Unprotected {
    fn status(&self, fields: &StatusFields) -> Frame {
        self.0.status(fields, &mut SendCounters::default())
    }

    fn health(&self, page: usize, fields: &HealthFields) -> Frame {
        self.0.health(page, fields, &mut SendCounters::default())
    }

    fn alarm(&self, fields: &AlarmFields) -> Frame {
        self.0.alarm(fields, &mut SendCounters::default())
    }
}

fn plan() -> Unprotected {
    Unprotected(OutputPlan::new(&default_database().unwrap()).unwrap())
}

/// Raw code and physical value of `Message.Signal` in a frame.
fn read(name: &str, frame: &Frame) -> (u64, Result<f64, Fault>) {
    let dbc = default_database().unwrap();
    let (_, signal) = dbc.signal(&format!("PACKWATCH_{name}")).unwrap();
    let plan = signal.layout.plan().unwrap();
    (plan.raw(frame.data()).unwrap(), plan.decode(frame.data()))
}

/// Asserts that a signal decodes to `wanted` (in the DBC's unit) within half of its resolution.
fn assert_decodes(name: &str, frame: &Frame, wanted: f64) {
    let dbc = default_database().unwrap();
    let half = dbc.signal(&format!("PACKWATCH_{name}")).unwrap().1.layout.factor / 2.0 + 1e-9;
    let (_, found) = read(name, frame);
    assert!(found.is_ok_and(|found| (found - wanted).abs() <= half), "{name}: {found:?} for {wanted}");
}

/// Asserts that a signal has its "not available" code, and that the code is out of range.
fn assert_not_available(name: &str, frame: &Frame) {
    let dbc = default_database().unwrap();
    let codes = dbc.signal(&format!("PACKWATCH_{name}")).unwrap().1.not_available_codes();
    let (code, value) = read(name, frame);
    assert_eq!(vec![code], codes, "{name}");
    // Severity 0 is the only "not available" code inside a range.
    assert!(value == Err(Fault::OutOfRange) || name == "Alarm.Severity", "{name} reads {value:?}");
}

fn faults(from: &str, to: &str) -> Vec<String> {
    assert!(TEXT.contains(from), "{from}");
    let dbc = Database::parse(&TEXT.replace(from, to)).unwrap();
    OutputPlan::new(&dbc).unwrap_err().0
}

#[test]
fn shipped_dbc_has_all_signals_and_cycle_times() {
    let plan = plan().0;
    assert_eq!(plan.ids(), [0x6B0, 0x6B1, 0x6B2, 0x6B4, 0x6B5].map(CanId::Standard));
    let times_ms: Vec<_> = plan.messages().map(|sent| sent.cycle_time_ms).collect();
    assert_eq!(times_ms, [Some(100), Some(1000), Some(1000), Some(1000), None]);
    assert_eq!(plan.digest_pages(), 4);
    assert_eq!(plan.health_pages(), 13);
}

#[test]
fn status_decodes_within_half_a_bit() {
    let fields = StatusFields {
        soc: Some(0.7312),
        soc_std: Some(0.0123),
        mode: Some(Mode::Discharge),
        validity: 2,
        highest_severity: Some(3),
        active_alarms: Some(17),
        limiting_cell: Some(CellIndex(1023)),
        unknown_rules: Some(2),
    };
    let frame = plan().status(&fields);
    for (name, wanted) in [
        ("Soc", 73.12),
        ("SocStd", 1.23),
        ("Mode", 3.0),
        ("Validity", 2.0),
        ("HighestSeverity", 3.0),
        ("ActiveAlarms", 17.0),
        ("LimitingCell", 1023.0),
        ("UnknownRules", 2.0),
    ] {
        assert_decodes(&format!("Status.{name}"), &frame, wanted);
    }
    assert_eq!((frame.len(), &frame.data()[..2]), (8, &[0, 0][..]), "reserved for end-to-end protection");
    for (mode, code) in [(Mode::Unknown, 0.0), (Mode::Charge, 1.0), (Mode::Rest, 2.0)] {
        assert_decodes("Status.Mode", &plan().status(&StatusFields { mode: Some(mode), ..fields }), code);
    }
}

/// Page, name, value in internal units, and decoded value.
const HEALTH_VALUES: [(usize, &str, f64, f64); 36] = [
    (0, "Capacity", 2.6, 2.6),
    (0, "CapacityStd", 0.0213, 0.0213),
    (0, "Soh", 0.871, 87.1),
    (1, "RechargePeriod", 3611.0, 3611.0),
    (1, "NormalizedRechargePeriod", 3500.4, 3500.4),
    (2, "UsableCapacity", 2.41, 2.41),
    (2, "UsableCapacityStd", 0.031, 0.031),
    (2, "ResistanceRatio", 1.37, 137.0),
    (3, "RemainingCycles", 412.3, 412.0),
    (3, "RemainingCyclesLow", 207.8, 208.0),
    (3, "RemainingDays", 533.0, 533.0),
    (4, "Lli", 0.1127, 11.2),
    (4, "LliStd", 0.0213, 2.0),
    (4, "LamNe", 0.0402, 4.0),
    (4, "LamNeStd", 0.0407, 4.0),
    (4, "LamPe", 0.0391, 4.0),
    (4, "LamPeStd", 0.0512, 5.0),
    (1, "ModelState", 2.0, 2.0),
    (5, "RemainingEnergy", 41_234.0, 41_234.0),
    (5, "RemainingEnergyStd", 1_803.0, 1_803.0),
    (6, "EnergyToFull", 20_000.0, 20_000.0),
    (6, "EnergyToFullStd", 950.0, 950.0),
    (7, "TimeToEmpty", 5_432.0, 5_430.0),
    (8, "TimeToEmptyStd", 611.0, 610.0),
    (7, "TimeToFull", 7_200.0, 7_200.0),
    (8, "TimeToFullStd", 305.0, 310.0),
    (7, "TimeToTarget", 3_333.0, 3_330.0),
    (8, "TimeToTargetStd", 99.0, 100.0),
    (11, "DischargePower2s", 180_004.0, 180_000.0),
    (9, "DischargePower10s", 150_000.0, 150_000.0),
    (9, "DischargePower10sStd", 4_096.0, 4_100.0),
    (11, "DischargePower30s", 120_000.0, 120_000.0),
    (12, "ChargePower2s", 90_000.0, 90_000.0),
    (10, "ChargePower10s", 80_000.0, 80_000.0),
    (10, "ChargePower10sStd", 3_000.0, 3_000.0),
    (12, "ChargePower30s", 70_000.0, 70_000.0),
];

fn health_fields(of: impl Fn(usize) -> Option<f64>) -> HealthFields {
    let mut outlook = PackValues::default();
    for (_, quantity, _) in OUTLOOK.iter().filter(|(_, _, part)| *part == Part::Mean) {
        let [mean, std] = [Part::Mean, Part::Std].map(|part| {
            let place = OUTLOOK.iter().position(|(_, other, of)| (other, *of) == (quantity, part));
            place.and_then(|place| of(HEALTH.len() + place))
        });
        // An estimate with a standard deviation also needs a mean.
        outlook.set(*quantity, mean.or(std).map(|known| Estimate { mean: mean.unwrap_or(known), std }));
    }
    HealthFields {
        capacity_ah: of(0),
        capacity_std_ah: of(1),
        soh: of(2),
        recharge_period_s: of(3),
        normalized_recharge_period_s: of(4),
        usable_capacity_ah: of(5),
        usable_capacity_std_ah: of(6),
        resistance_ratio: of(7),
        remaining_cycles: of(8),
        remaining_cycles_low: of(9),
        remaining_days: of(10),
        lli: [of(11), of(12)],
        lam_ne: [of(13), of(14)],
        lam_pe: [of(15), of(16)],
        model_state: of(17).map(|state| state as u8),
        outlook,
    }
}

#[test]
fn health_pages_decode_within_half_a_bit() {
    let fields = health_fields(|n| Some(HEALTH_VALUES[n].2));
    for (page, name, _, wanted) in HEALTH_VALUES {
        let frame = plan().health(page, &fields);
        assert_decodes(&format!("Health.{name}"), &frame, wanted);
        assert_eq!(read("Health.Page", &frame).0, u64::try_from(page).unwrap());
        assert_eq!((frame.len(), &frame.data()[..2]), (8, &[0, 0][..]));
        assert_eq!(plan().health(page + 13, &fields), frame, "the first page follows the last");
    }
}

#[test]
fn outlook_pages_are_sent_only_if_wanted() {
    let with = OutputPlan::new(&default_database().unwrap()).unwrap();
    let without = with.clone().without_outlook();
    assert_eq!((with.health_pages(), without.health_pages()), (13, 5));
    assert!(with.has_outlook() && !without.has_outlook());
    let fields = health_fields(|n| Some(HEALTH_VALUES[n].2));
    for page in 0..5 {
        let [a, b] = [&with, &without].map(|plan| plan.health(page, &fields, &mut SendCounters::default()));
        assert_eq!(a, b);
    }
}

#[test]
fn single_health_value_leaves_others_not_available() {
    for (known, (_, known_name, _, _)) in HEALTH_VALUES.into_iter().enumerate() {
        let fields = health_fields(|n| (n == known).then_some(HEALTH_VALUES[n].2));
        for (n, (page, name, _, wanted)) in HEALTH_VALUES.into_iter().enumerate() {
            let frame = plan().health(page, &fields);
            if n == known {
                assert_decodes(&format!("Health.{name}"), &frame, wanted);
            } else if known_name != format!("{name}Std") || n < HEALTH.len() {
                assert_not_available(&format!("Health.{name}"), &frame);
            }
        }
    }
}

#[test]
fn unknown_values_are_not_available_in_every_frame() {
    let status = plan().status(&StatusFields::default());
    for name in STATUS.map(|(name, _)| name).into_iter().filter(|name| *name != "Validity") {
        assert_not_available(&format!("Status.{name}"), &status);
    }
    assert_decodes("Status.Validity", &status, 0.0);
    for (page, name, _, _) in HEALTH_VALUES {
        assert_not_available(&format!("Health.{name}"), &plan().health(page, &HealthFields::default()));
    }
    for (number, rule) in (1..).zip(RULES) {
        let frame = plan().alarm(&AlarmFields { rule: number, ..Default::default() });
        for name in ["State", "Severity", "Cell"] {
            assert_not_available(&format!("Alarm.{name}"), &frame);
        }
        assert_not_available(&format!("Alarm.Value_{rule}"), &frame);
        assert_not_available(&format!("Alarm.Threshold_{rule}"), &frame);
    }
    let nan = StatusFields { soc: Some(f64::NAN), soc_std: Some(f64::NAN), ..Default::default() };
    assert_eq!(plan().status(&nan), status, "NaN is unknown");
}

#[test]
fn extremes_saturate_and_never_become_not_available() {
    let dbc = default_database().unwrap();
    for extreme in [f64::MAX, f64::INFINITY, f64::MIN, f64::NEG_INFINITY] {
        let end = |name: &str| {
            let layout = dbc.signal(&format!("PACKWATCH_{name}")).unwrap().1.layout;
            if extreme > 0.0 { layout.maximum } else { layout.minimum }
        };
        let status = plan().status(&StatusFields { soc: Some(extreme), soc_std: Some(extreme), ..Default::default() });
        for name in ["Status.Soc", "Status.SocStd"] {
            assert_decodes(name, &status, end(name));
        }
        let fields = health_fields(|_| Some(extreme));
        // Energy, time and power are unknown unless they are finite.
        let sent = if extreme.is_finite() { HEALTH_VALUES.len() } else { HEALTH.len() };
        for (page, name, _, _) in HEALTH_VALUES.into_iter().take(sent) {
            let name = format!("Health.{name}");
            assert_decodes(&name, &plan().health(page, &fields), end(&name));
        }
        for (number, rule) in (1..).zip(RULES) {
            let value = Some(extreme);
            let frame = plan().alarm(&AlarmFields { rule: number, value, threshold: value, ..Default::default() });
            for name in [format!("Alarm.Value_{rule}"), format!("Alarm.Threshold_{rule}")] {
                assert_decodes(&name, &frame, end(&name));
            }
        }
    }
    let many = StatusFields {
        active_alarms: Some(u16::MAX),
        limiting_cell: Some(CellIndex(u16::MAX)),
        validity: u8::MAX,
        highest_severity: Some(u8::MAX),
        unknown_rules: Some(u8::MAX),
        ..Default::default()
    };
    let frame = plan().status(&many);
    let ends = [
        ("ActiveAlarms", 62.0),
        ("LimitingCell", 1023.0),
        ("Validity", 3.0),
        ("HighestSeverity", 3.0),
        ("UnknownRules", 2.0),
    ];
    for (name, end) in ends {
        assert_decodes(&format!("Status.{name}"), &frame, end);
    }
}

#[test]
fn every_rule_has_its_own_value_and_threshold() {
    // Each value in internal units and as decoded. A fraction is decoded as %.
    let values: [(f64, f64); RULES.len()] = [
        (1.4, 1.4),
        (1.38, 1.38),
        (3600.0, 3600.0),
        (2.5, 2.5),
        (0.25, 25.0),
        (9.51, 9.51),
        (1.83, 183.0),
        (0.052, 5.2),
        (55.3, 55.3),
        (0.0312, 3.12),
        (87.0, 87.0),
        (0.11, 11.0),
        (3600.0, 3600.0),
        (12.0, 12.0),
        (0.0123, 1.23),
        (0.37, 37.0),
        (1.0, 1.0),
        (3.0, 3.0),
    ];
    for ((number, rule), (inside, wire)) in (1..).zip(RULES).zip(values) {
        let fields = AlarmFields {
            rule: number,
            state: Some(1),
            severity: Some(3),
            test: false,
            acknowledged: true,
            cell: Some(CellIndex(96)),
            value: Some(inside),
            threshold: Some(inside * 1.1),
        };
        let frame = plan().alarm(&fields);
        assert_decodes("Alarm.Rule", &frame, f64::from(number));
        assert_decodes("Alarm.State", &frame, 1.0);
        assert_decodes("Alarm.Severity", &frame, 3.0);
        assert_decodes("Alarm.Test", &frame, 0.0);
        assert_decodes("Alarm.Acknowledged", &frame, 1.0);
        assert_decodes("Alarm.Cell", &frame, 96.0);
        assert_decodes(&format!("Alarm.Value_{rule}"), &frame, wire);
        assert_decodes(&format!("Alarm.Threshold_{rule}"), &frame, wire * 1.1);
        assert_eq!((frame.len(), &frame.data()[..2]), (8, &[0, 0][..]));
        let other = plan().alarm(&AlarmFields { value: None, cell: None, test: true, acknowledged: false, ..fields });
        assert_not_available(&format!("Alarm.Value_{rule}"), &other);
        assert_decodes(&format!("Alarm.Threshold_{rule}"), &other, wire * 1.1);
        assert_not_available("Alarm.Cell", &other);
        assert_decodes("Alarm.Test", &other, 1.0);
        assert_decodes("Alarm.Acknowledged", &other, 0.0);
    }
}

#[test]
fn rule_numbers_and_names_match_value_table() {
    let dbc = default_database().unwrap();
    let table = &dbc.signal("PACKWATCH_Alarm.Rule").unwrap().1.values;
    let named = (1..).zip(RULES).map(|(number, name)| (number, name.to_owned()));
    assert!(named.eq(table.iter().take(RULES.len()).cloned()), "{table:?}");
}

#[test]
fn all_missing_signals_are_reported_together() {
    let text = "VERSION \"\"\nBU_: X\nBO_ 1 PACKWATCH_Status: 8 X\n SG_ Soc : 0|8@1+ (1,0) [0|100] \"%\" X\n";
    let found = OutputPlan::new(&Database::parse(text).unwrap()).unwrap_err();
    let mut wanted: Vec<_> =
        STATUS.iter().skip(1).map(|(name, _)| format!("signal PACKWATCH_Status.{name} is missing")).collect();
    wanted.extend(["Health", "Alarm"].map(|name| format!("message PACKWATCH_{name} is missing")));
    assert_eq!(found.0, wanted);
    assert_eq!(found.to_string().lines().count(), 9);
}

#[test]
fn every_filled_signal_is_required() {
    let rules = RULES.iter().flat_map(|rule| [format!("Value_{rule}"), format!("Threshold_{rule}")]);
    let all = STATUS.map(|(name, _)| format!("Status.{name}")).into_iter();
    let all = all.chain(HEALTH[..HEALTH_REQUIRED].iter().map(|(name, _)| format!("Health.{name}")));
    let all = all.chain(ALARM.map(str::to_owned).into_iter().chain(rules).map(|name| format!("Alarm.{name}")));
    let mut count = 0;
    for name in all.filter(|name| name != "Alarm.Rule") {
        let mut dbc = default_database().unwrap();
        let (message, signal) = name.split_once('.').unwrap();
        let message = dbc.messages.iter_mut().find(|m| m.name.ends_with(message)).unwrap();
        let position = message.signals.iter().position(|s| s.name == signal).unwrap();
        // Rename the signal instead of removing it, because conditions refer to signals by index.
        message.signals[position].name = "Other".to_owned();
        let found = OutputPlan::new(&dbc).unwrap_err();
        assert_eq!(found.0, [format!("signal PACKWATCH_{name} is missing")]);
        count += 1;
    }
    assert_eq!(count, 8 + 8 + 5 + 2 * RULES.len());
}

#[test]
fn ambiguous_value_signals_are_rejected() {
    assert_eq!(
        faults("Value_InputMissing m4", "Value_InputMissing m5"),
        ["signal PACKWATCH_Alarm.Value_InputMissing is present for rules [5], must be present for rule 4 only"]
    );
    assert_eq!(
        faults("Threshold_CapacityLow m1", "Threshold_CapacityLow "),
        [
            "signal PACKWATCH_Alarm.Threshold_CapacityLow is present for rules [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18], must be present for rule 1 only"
        ]
    );
    let unreachable = faults("Page M : 16|4@1+", "Page M : 16|1@1+").len();
    assert_eq!(
        unreachable, 37,
        "health: three signals on page 2, three on page 3, six on page 4, eighteen on pages 5 to 12; digest: three on page \
         2, four on page 3"
    );
}

#[test]
fn signal_beyond_message_or_invalid_layout_is_rejected() {
    assert_eq!(
        faults("LimitingCell : 51|11@1+", "LimitingCell : 54|11@1+"),
        ["signal PACKWATCH_Status.LimitingCell: extends beyond the message's 8 bytes"]
    );
    assert_eq!(faults("Soc : 16|12@1+ (0.025,0)", "Soc : 16|12@1+ (0,0)").len(), 1);
    assert_eq!(
        faults("PACKWATCH_Health: 8", "PACKWATCH_Health: 100"),
        ["message PACKWATCH_Health: 100 bytes, must be at most 64"]
    );
    assert_eq!(
        faults("PACKWATCH_Health: 8", "PACKWATCH_Health: 12"),
        ["message PACKWATCH_Health: 12 bytes, must be at most 8 in classic frames"]
    );
}

#[test]
fn known_values_avoid_not_available_code() {
    let text = TEXT
        .replace("Soc : 16|12@1+ (0.025,0) [0|102.35]", "Soc : 16|12@1- (1,0) [0|0]")
        .replace("SocStd : 28|8@1+ (0.1,0) [0|25.4]", "SocStd : 28|8@1+ (1,0) [0|0]")
        .replace("VAL_ 1712 Soc 4095 \"not available\" ;\n", "");
    let plan = Unprotected(OutputPlan::new(&Database::parse(&text).unwrap()).unwrap());
    let codes = |value: Option<f64>| {
        let frame = plan.status(&StatusFields { soc: value, soc_std: value, ..Default::default() });
        (read("Status.Soc", &frame).0, read("Status.SocStd", &frame).0)
    };
    assert_eq!(codes(None), (0x800, 255));
    assert_eq!(codes(Some(1e9)), (0x7FF, 254));
    assert_eq!(codes(Some(-1e9)), (0x801, 0), "the lowest signed code is reserved: the next higher one is used");
}

#[test]
fn messages_are_protected_with_separate_counters() {
    for profile in [Profile::P01A, Profile::P01C, Profile::P05] {
        let settings = |data_id| MessageSettings {
            fd: Some(true),
            e2e: E2eSetting::On(Protection { profile, data_id }),
            ..Default::default()
        };
        let settings =
            LayoutSettings { status: settings(1), health: settings(2), alarm: settings(3), ..Default::default() };
        let database = layout(LayoutBase::BuiltIn { rated_capacity_ah: 2.6 }, &settings).unwrap();
        let plan = OutputPlan::new(&database).unwrap();
        let protections: Vec<_> = plan.messages().filter_map(|sent| sent.protection).collect();
        let [status, health, alarm] = protections[..] else { panic!("three are protected") };
        let (mut counters, mut expected) = (SendCounters::default(), 0);
        for round in 0..600_u16 {
            let fields = StatusFields { active_alarms: Some(round % 60), ..Default::default() };
            let frame = plan.status(&fields, &mut counters);
            assert_eq!(status.verified_counter(frame.data()), Some(expected), "{profile:?} {round}");
            assert_eq!(health.verified_counter(frame.data()), None, "data id of another message");
            expected = profile.next_counter(expected);
        }
        let frame = plan.health(1, &HealthFields::default(), &mut counters);
        assert_eq!(health.verified_counter(frame.data()), Some(0));
        let frame = plan.health(2, &HealthFields::default(), &mut counters);
        assert_eq!(health.verified_counter(frame.data()), Some(1), "pages share the identifier and the counter");
        let frame = plan.alarm(&AlarmFields::default(), &mut counters);
        assert_eq!(alarm.verified_counter(frame.data()), Some(0));
        assert_eq!(frame.kind(), FrameFormat::Fd { brs: false }.kind());
        assert_eq!(frame.len(), if profile == Profile::P05 { 12 } else { 8 });
    }
}

#[test]
fn counters_survive_restart_and_profile_change() {
    let protection = Protection { profile: Profile::P01A, data_id: 9 };
    let status = MessageSettings { e2e: E2eSetting::On(protection), ..Default::default() };
    let settings = LayoutSettings { status, ..Default::default() };
    let plan = OutputPlan::new(&layout(LayoutBase::BuiltIn { rated_capacity_ah: 2.6 }, &settings).unwrap()).unwrap();
    let stored = r#"{"status":200,"health":0,"alarm":3,"digest":0,"reply":0}"#;
    let mut counters: SendCounters = serde_json::from_str(stored).unwrap();
    let frames = [(); 2].map(|()| plan.status(&StatusFields::default(), &mut counters));
    assert_eq!(frames.map(|frame| protection.verified_counter(frame.data())), [Some(14), Some(0)]);
    let stored = serde_json::to_string(&counters).unwrap();
    let wanted = r#"{"status":1,"health":0,"alarm":3,"digest":0,"reply":0}"#;
    assert_eq!(stored, wanted, "unprotected frames do not count");
    plan.skip(LayoutMessage::Status, 16, &mut counters);
    plan.skip(LayoutMessage::Alarm, 16, &mut counters);
    let frame = plan.status(&StatusFields::default(), &mut counters);
    assert_eq!(protection.verified_counter(frame.data()), Some(2), "one round of 15 and one more");
    assert_eq!(serde_json::to_value(counters).unwrap()["alarm"], 3, "not protected");
}
