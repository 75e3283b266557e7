//! Tests alarm rules through the whole core.

use crate::support::rig::{NO_VALUE, Rig, WHOLE_PACK, Wire, command_frame, learned};
use packwatch::alarm::{AlarmState, Change, Rule, Selector};
use packwatch::can::{CanId, Frame};
use packwatch::monitor::{BusEvent, Command, EventKind, Record, Source};
use packwatch::quantity::{BusIndex, CellIndex};

#[test]
fn hottest_sensor_raises_despite_lost_sensor() {
    let mut rig = Rig::new("[[alarm]]\nrule = \"temperature_high\"\nwarning = { set = 50, clear = 45 }\n");
    rig.seconds(2);
    assert_eq!((rig.changes(Rule::TemperatureHigh), rig.unknown_rules()), (vec![], 0));
    // One sensor is lost. The other temperature is low, but the lost sensor's temperature may be high.
    rig.temperatures_c[1] = None;
    rig.seconds(4);
    assert_eq!((rig.changes(Rule::TemperatureHigh), rig.unknown_rules()), (vec![], 2));
    rig.temperatures_c[0] = Some(60.0);
    rig.seconds(1);
    assert_eq!(rig.changes(Rule::TemperatureHigh), [Change::Raised], "one hot sensor suffices");
    rig.temperatures_c[0] = Some(30.0);
    rig.seconds(1);
    assert_eq!(rig.changes(Rule::TemperatureHigh), [Change::Raised, Change::Suppressed]);
    let wire = rig.last_wire(Rule::TemperatureHigh);
    assert_eq!((wire.state, wire.value, wire.cell), (5, NO_VALUE, WHOLE_PACK));
    rig.temperatures_c[1] = Some(30.0);
    rig.seconds(1);
    assert_eq!(rig.changes(Rule::TemperatureHigh), [Change::Raised, Change::Suppressed, Change::Cleared]);
    assert_eq!(rig.last_wire(Rule::TemperatureHigh).state, 2);
}

#[test]
fn all_frames_except_status_are_announced() {
    let mut rig = Rig::new("[[alarm]]\nrule = \"temperature_high\"\nwarning = { set = 50, clear = 45 }\n");
    rig.temperatures_c[0] = Some(60.0);
    rig.seconds(12);
    rig.command(1, 31, 2047);
    let [status, health, alarm, digest, reply] =
        [0x6B0, 0x6B1, 0x6B2, 0x6B4, 0x6B5].map(|id| CanId::standard(id).unwrap());
    assert_eq!(
        rig.sent.iter().copied().collect::<Vec<_>>(),
        [(status, false), (health, true), (alarm, true), (digest, true), (reply, true)]
    );
}

#[test]
fn empty_cell_and_spread_raise_alarms() {
    let mut rig = Rig::new(
        "[[alarm]]\nrule = \"soc_low\"\nwarning = \"20 %\"\n[[alarm]]\nrule = \"cell_imbalance\"\nsevere = \"30 %\"\n\
         [estimator]\nlost_after_s = 5\n",
    );
    rig.seconds(5);
    assert_eq!((rig.changes(Rule::SocLow), rig.changes(Rule::CellImbalance)), (vec![], vec![]));
    // Cell 2 reports a voltage that only an empty cell has.
    rig.voltages_v[1] = Some(3.2);
    rig.seconds(120);
    assert_eq!(rig.changes(Rule::SocLow), [Change::Raised]);
    assert_eq!(rig.changes(Rule::CellImbalance), [Change::Raised]);
    // The fuller cell is lost, so the spread is unknown. The SOC of the empty cell is still known.
    rig.voltages_v[0] = None;
    rig.seconds(5);
    assert_eq!(rig.changes(Rule::SocLow), [Change::Raised]);
    assert_eq!(rig.changes(Rule::CellImbalance), [Change::Raised, Change::Suppressed]);
}

#[test]
fn lasting_soc_disagreement_raises_alarm() {
    let mut rig = Rig::new("[[alarm]]\nrule = \"bms_disagrees\"\nwarning = \"15 %\"\ndebounce_s = 30\n");
    rig.seconds(40);
    let ours = rig.monitor.pack().unwrap().soc;
    assert_eq!(rig.changes(Rule::BmsDisagrees), []);
    rig.reported_soc = Some(ours + 0.2);
    rig.seconds(20);
    rig.reported_soc = Some(ours);
    rig.seconds(20);
    assert_eq!(rig.changes(Rule::BmsDisagrees), [], "a short disagreement must not raise");
    rig.reported_soc = Some(ours + 0.2);
    rig.seconds(31);
    assert_eq!(rig.changes(Rule::BmsDisagrees), [Change::Raised]);
    let value = f64::from(rig.last_wire(Rule::BmsDisagrees).value) * 0.00025;
    assert!((value - 0.2).abs() < 0.01, "{value}");
    rig.reported_soc = None;
    rig.seconds(15);
    assert_eq!(rig.changes(Rule::BmsDisagrees), [Change::Raised, Change::Suppressed]);
}

#[test]
fn interface_and_file_faults_raise_alarms() {
    let mut rig = Rig::new(
        "[[alarm]]\nrule = \"bus_fault\"\nwarning = 1\nlatched = true\n[[alarm]]\nrule = \"store_failed\"\nsevere = 0\n",
    );
    rig.seconds(1);
    assert_eq!(rig.unknown_rules(), 1, "the state of the files is still unknown");
    rig.give(Record::store(rig.now(), true));
    rig.give(Record::bus(rig.now(), BusIndex(0), BusEvent::Up));
    rig.seconds(1);
    assert_eq!(rig.unknown_rules(), 0);
    rig.give(Record::store(rig.now(), false));
    rig.give(Record::bus(rig.now(), BusIndex(0), BusEvent::Down));
    rig.seconds(3);
    assert_eq!(rig.changes(Rule::StoreFailed), [Change::Raised]);
    assert_eq!(rig.changes(Rule::BusFault), [Change::Raised]);
    rig.give(Record::store(rig.now(), true));
    rig.give(Record::bus(rig.now(), BusIndex(0), BusEvent::Up));
    rig.seconds(1);
    assert_eq!(rig.changes(Rule::StoreFailed), [Change::Raised, Change::Cleared]);
    assert_eq!(rig.changes(Rule::BusFault), [Change::Raised, Change::Latched]);
    assert_eq!(rig.last_wire(Rule::BusFault).state, 4);
}

#[test]
fn learned_alarm_is_suppressed_while_inputs_lost() {
    let mut rig = learned();
    let before = rig.last_wire(Rule::CapacityLow);
    assert_eq!((before.state, rig.unknown_rules()), (1, 0));
    // The reported SOC is still received, so the buses are not asleep.
    (rig.current_a, rig.voltages_v, rig.temperatures_c) = (None, [None; 2], [None; 2]);
    rig.seconds(10);
    assert_eq!(rig.changes(Rule::CapacityLow)[2..], [Change::Suppressed, Change::Suppressed]);
    let lost = rig.last_wire(Rule::CapacityLow);
    assert_eq!((lost.state, lost.value, rig.unknown_rules()), (5, NO_VALUE, 2));
    (rig.current_a, rig.voltages_v) = (Some(0.0), [Some(3.3); 2]);
    rig.seconds(3);
    assert_eq!(rig.changes(Rule::CapacityLow)[4..], [Change::Resumed, Change::Resumed]);
    let back = rig.wire().into_iter().rfind(|wire| (wire.rule, wire.cell) == (1, before.cell)).unwrap();
    assert_eq!((back.state, back.value), (1, before.value));
}

#[test]
fn unjudged_rule_is_sent_as_unknown() {
    let mut rig = Rig::new("[[alarm]]\nrule = \"capacity_low\"\nwarning = 2.0\n");
    rig.seconds(5);
    assert_eq!(rig.unknown_rules(), 2);
    let reported = rig.wire();
    assert!(reported.len() >= 8, "twice a second: {}", reported.len());
    assert!(reported.iter().all(|wire| (wire.rule, wire.state, wire.value, wire.test) == (1, 6, NO_VALUE, false)));
}

#[test]
fn bus_commands_need_protection_and_sequence() {
    let mut rig = learned();
    let reported = |rig: &Rig| rig.events.iter().filter(|e| matches!(e.kind, EventKind::Command { .. })).count();
    let bad = |rig: &Rig| rig.events.iter().filter(|e| matches!(e.kind, EventKind::BadCommand { .. })).count();
    rig.command(1, 31, 2047);
    assert_eq!((reported(&rig), bad(&rig)), (0, 1), "the first frame only synchronises the counter");
    rig.command(1, 1, 0);
    assert_eq!((reported(&rig), bad(&rig)), (1, 1));
    let marked = rig.last_wire(Rule::CapacityLow);
    assert!((marked.acknowledged, marked.cell, marked.state) == (true, 0, 1), "{marked:?}");
    // Repeat the frame, then send a wrong CRC and an unknown command. All three must be ignored, with at most one
    // report per second.
    rig.seconds(2);
    let again = command_frame(1, 1, 0, 1);
    rig.give(Record::frame(rig.now(), BusIndex(0), &again));
    let harmed = {
        let mut data: [u8; 8] = command_frame(2, 31, 2047, 2).data().try_into().unwrap();
        data[4] ^= 1;
        Frame::classic(CanId::Standard(1715), &data).unwrap()
    };
    rig.give(Record::frame(rig.now(), BusIndex(0), &harmed));
    rig.command(9, 31, 2047);
    assert_eq!((reported(&rig), bad(&rig)), (1, 2));
    // While an alarm's value is beyond its threshold, the command to clear the alarm must be rejected and erase
    // nothing.
    let capacity = rig.monitor.capacity(CellIndex(0));
    rig.command(2, 31, 2047);
    let refused = rig.events.iter().rev().find_map(|event| match event.kind {
        EventKind::Command { source: Source::Bus(_), changed, refused, .. } => Some((changed, refused)),
        _ => None,
    });
    assert_eq!(refused, Some((0, 2)));
    assert_eq!((rig.monitor.capacity(CellIndex(0)), rig.monitor.alarms().count()), (capacity, 2));
}

#[test]
fn new_pack_starts_from_configuration() {
    let mut rig = learned();
    let old_ah = rig.monitor.capacity(CellIndex(0)).mean.min(rig.monitor.capacity(CellIndex(1)).mean);
    rig.give(Record::command(rig.now(), Command::PackReplaced));
    let reported = rig.events.iter().rev().find_map(|event| match event.kind {
        EventKind::PackReplaced { capacity_ah, .. } => capacity_ah,
        _ => None,
    });
    assert_eq!(reported, Some(old_ah));
    assert_eq!(rig.changes(Rule::CapacityLow)[2..], [Change::Forgotten, Change::Forgotten]);
    let alarm = rig.monitor.alarms().get(Rule::CapacityLow, Some(CellIndex(0))).unwrap();
    assert_eq!((alarm.state, alarm.occurrences, rig.monitor.alarms().count()), (AlarmState::Unknown, 0, 0));
    rig.seconds(2);
    assert_eq!((rig.unknown_rules(), rig.monitor.capacity(CellIndex(0)).mean), (2, 2.6));
}

#[test]
fn alarm_test_is_marked_and_hides_nothing() {
    let mut rig = learned();
    rig.frames.clear();
    rig.give(Record::command(rig.now(), Command::Test { rule: Rule::CapacityLow, seconds: 2.0 }));
    rig.seconds(3);
    let (tests, real): (Vec<Wire>, Vec<Wire>) = rig.wire().into_iter().partition(|wire| wire.test);
    assert_eq!(tests.len(), 21, "ten per second, and the final frame");
    assert!(tests.iter().all(|test| (test.rule, test.value, test.cell) == (1, NO_VALUE, WHOLE_PACK)));
    assert_eq!((tests[0].state, tests[20].state), (1, 0));
    assert!(real.len() >= 5 && real.iter().all(|wire| wire.state == 1 && wire.value != NO_VALUE));
    assert_eq!(rig.monitor.alarms().count(), 2, "a test must not raise an alarm");
    let selector = Selector::default();
    rig.give(Record::command(rig.now(), Command::Acknowledge(selector)));
    assert_eq!(rig.changes(Rule::CapacityLow)[2..], [Change::Acknowledged, Change::Acknowledged]);
}
