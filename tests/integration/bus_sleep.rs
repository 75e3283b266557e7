//! Tests the silence of buses. If all buses of a parked vehicle fall silent at once, that is not a fault. Silence under
//! load and the silence of a single input are faults.

use packwatch::alarm::{Change, Rule};
use packwatch::can::{CanId, Frame};
use packwatch::monitor::{Downtime, Event, EventKind, Record, Validity};
use packwatch::quantity::BusIndex;

use crate::support::config_texts;
use crate::support::rig::{DBC, PACK, Rig};

const ALARMS: &str = "[[alarm]]\nrule = \"input_missing\"\nwarning = 1\nsevere = 5\n[[alarm]]\nrule = \"input_implausible\"\nwarning = 0.5\n\
                      [[alarm]]\nrule = \"estimate_untrusted\"\nwarning = 4\n";
const HOUR: i64 = 3600;

/// A pack that has been driven and then parked for a minute.
fn parked() -> Rig {
    park(Rig::new(ALARMS))
}

fn park(mut rig: Rig) -> Rig {
    rig.seconds(10);
    rig.current_a = Some(5.0);
    rig.seconds(30);
    rig.current_a = Some(0.0);
    rig.seconds(60);
    rig.events.clear();
    rig
}

fn fall_silent(rig: &mut Rig) {
    (rig.current_a, rig.voltages_v, rig.temperatures_c, rig.reported_soc) = (None, [None; 2], [None; 2], None);
}

fn come_back(rig: &mut Rig) {
    (rig.current_a, rig.voltages_v) = (Some(0.0), [Some(3.69); 2]);
    (rig.temperatures_c, rig.reported_soc) = ([Some(20.0); 2], Some(0.5));
}

fn sleeps(events: &[Event]) -> Vec<(bool, Option<f64>)> {
    let sleep = |event: &Event| match event.kind {
        EventKind::BusAsleep { asleep, seconds } => Some((asleep, seconds)),
        _ => None,
    };
    events.iter().filter_map(sleep).collect()
}

#[test]
fn parked_night_gives_four_events_without_alarm() {
    let mut rig = parked();
    fall_silent(&mut rig);
    rig.seconds(8 * HOUR);
    assert!(rig.monitor.asleep_since().is_some());
    assert_eq!(rig.monitor.pack_view().validity, Validity::Unavailable, "a sleeping pack must not look healthy");
    assert_eq!(rig.monitor.lost_inputs().count(), 0, "an input is reported missing");
    come_back(&mut rig);
    rig.seconds(60);
    let kinds: Vec<_> = rig.events.iter().map(|event| event.kind).collect();
    assert!(kinds.len() <= 4, "{kinds:#?}");
    let [(true, None), (false, Some(slept_s))] = sleeps(&rig.events)[..] else { panic!("{kinds:#?}") };
    assert!((f64::from(8 * 3600 - 10)..f64::from(8 * 3600)).contains(&slept_s), "{slept_s}");
    assert_eq!((rig.changes(Rule::InputMissing), rig.monitor.pack_view().validity), (vec![], Validity::Valid));
}

#[test]
fn balancing_bits_at_night_wake_no_bus() {
    let keys = "[input.balancing]\nsignal = \"Bleeding.Bleed{n}\"\nbleed_a = 0.1\n";
    let bit = |n: u8| format!(" SG_ Bleed{n} : {}|1@1+ (1,0) [0|1] \"\" A\n", n - 1);
    let dbc = format!("{DBC}BO_ 288 Bleeding: 1 A\n{}{}", bit(1), bit(2));
    let mut rig = park(Rig::with(config_texts::load(&format!("{PACK}{keys}{ALARMS}"), &dbc).monitor));
    fall_silent(&mut rig);
    for _ in 0..60 {
        rig.seconds(60);
        let (time, frame) = (rig.now(), Frame::classic(CanId::Standard(288), &[0b10]).unwrap());
        rig.give(Record::frame(time, BusIndex(0), &frame));
    }
    assert!(rig.monitor.asleep_since().is_some());
    let kinds: Vec<_> = rig.events.iter().map(|event| event.kind).collect();
    assert_eq!(sleeps(&rig.events), [(true, None)], "{kinds:#?}");
    assert_eq!(rig.changes(Rule::InputMissing), []);
}

#[test]
fn restart_at_night_finds_sleeping_bus() {
    let mut rig = parked();
    fall_silent(&mut rig);
    rig.seconds(HOUR);
    rig.restart(Downtime::Seconds(60.0));
    rig.seconds(HOUR);
    assert!(rig.monitor.asleep_since().is_some());
    assert_eq!(rig.changes(Rule::InputMissing), []);
}

#[test]
fn sleeping_bus_carries_only_changes_unless_configured() {
    let extra = "[[alarm]]\nrule = \"store_failed\"\nwarning = 10\n[[alarm]]\nrule = \"soc_low\"\ninfo = 0.9\n\
                 [j1939]\naddress = 249\nidentity_number = 1\nmanufacturer_code = 2047\n";
    let mut rig = park(Rig::new(&format!("{ALARMS}{extra}")));
    fall_silent(&mut rig);
    rig.seconds(60);
    let frames_of = |rig: &mut Rig, seconds: i64| {
        rig.frames.clear();
        rig.seconds(seconds);
        rig.frames.len()
    };
    assert_eq!(frames_of(&mut rig, HOUR), 0, "an alarm is raised, but nothing changes");
    rig.give(Record::store(rig.now(), false));
    frames_of(&mut rig, 60);
    let wire = rig.wire();
    assert!(wire.len() == 4 && wire.iter().all(|wire| wire.rule == Rule::StoreFailed as u8), "{wire:?}");
    assert!(rig.frames.len() <= 10, "the other frames are DM1: {:?}", rig.frames);
    assert_eq!(frames_of(&mut rig, HOUR), 0);
    rig.restart(Downtime::Seconds(60.0));
    frames_of(&mut rig, 60);
    assert_eq!(frames_of(&mut rig, HOUR), 0, "after a restart");
    rig.reload(|config| config.output.as_mut().unwrap().while_asleep = true).unwrap();
    assert!(frames_of(&mut rig, 60) > 700);
    rig.reload(|config| config.output.as_mut().unwrap().while_asleep = false).unwrap();
    frames_of(&mut rig, 1);
    assert_eq!(frames_of(&mut rig, 60), 0);
    let before = rig.config.asleep_after_s;
    rig.reload(|config| config.asleep_after_s = None).unwrap();
    assert!(frames_of(&mut rig, 60) > 700, "no sleep is configured any more");
    rig.reload(|config| config.asleep_after_s = before).unwrap();
    frames_of(&mut rig, 1);
    assert_eq!(frames_of(&mut rig, 60), 0);
    come_back(&mut rig);
    assert!(frames_of(&mut rig, 1) > 10, "awake");
    let dm1 = |frame: &&Frame| frame.id().raw() & 0xFF_FF00 == 0xFE_CA00 || frame.id().raw() & 0xFF_0000 == 0xEC_0000;
    assert!(rig.frames.iter().any(|frame| dm1(&frame)), "DM1, in one frame or announced: {:?}", rig.frames);
}

#[test]
fn clock_set_back_after_restart_does_not_delay_quiet() {
    let mut rig = parked();
    rig.restart(Downtime::Seconds(1.0));
    rig.seconds(2);
    rig.deci -= 36_000;
    rig.seconds(2);
    fall_silent(&mut rig);
    rig.seconds(30);
    rig.frames.clear();
    rig.seconds(60);
    assert_eq!(rig.frames, []);
}

#[test]
fn silence_under_load_raises_fault() {
    let mut rig = parked();
    rig.current_a = Some(5.0);
    rig.seconds(20);
    fall_silent(&mut rig);
    rig.seconds(60);
    assert_eq!(sleeps(&rig.events), []);
    assert!(rig.changes(Rule::InputMissing).iter().filter(|change| **change == Change::Raised).count() >= 3);
}

#[test]
fn silent_cells_among_active_inputs_raise_fault() {
    let mut rig = parked();
    rig.voltages_v = [None; 2];
    rig.seconds(60);
    assert_eq!((sleeps(&rig.events), rig.changes(Rule::InputMissing)), (vec![], vec![Change::Raised; 4]));
    // When the other inputs also fall silent, the buses count as asleep. The missing cells stay missing.
    fall_silent(&mut rig);
    rig.seconds(60);
    assert_eq!((sleeps(&rig.events).len(), rig.changes(Rule::InputMissing).len()), (1, 4));
}

#[test]
fn bus_without_any_input_never_sleeps() {
    let mut rig = Rig::new(ALARMS);
    fall_silent(&mut rig);
    rig.seconds(60);
    assert_eq!((sleeps(&rig.events), rig.monitor.asleep_since()), (vec![], None));
    assert!(!rig.changes(Rule::InputMissing).is_empty(), "a possible wiring fault must be reported");
}

#[test]
fn silent_bus_without_timeout_is_missing() {
    let mut rig = parked();
    rig.reload(|config| config.asleep_after_s = None).unwrap();
    fall_silent(&mut rig);
    rig.seconds(60);
    assert!(sleeps(&rig.events).is_empty() && !rig.changes(Rule::InputMissing).is_empty());
}
