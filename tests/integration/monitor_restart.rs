//! Tests the effects of a restart and of sleep on estimates and alarms.

use crate::support::rig::{Rig, learned};
use packwatch::alarm::{AlarmState, Change, Rule, Selector};
use packwatch::can::{CanId, Frame};
use packwatch::monitor::{BusEvent, Command, Downtime, EventKind, Outputs, Record, Source};
use packwatch::quantity::{BusIndex, CellIndex};

impl Rig {
    fn soc_std(&self, cell: usize) -> f64 {
        self.monitor.latest().nth(cell).unwrap().unwrap().soc_std
    }

    fn gaps(&self) -> Vec<Option<f64>> {
        let of = |kind| if let EventKind::Gap { seconds } = kind { Some(seconds) } else { None };
        self.events.iter().filter_map(|event| of(event.kind)).collect()
    }
}

#[test]
fn unknown_downtime_keeps_only_learned_values() {
    let mut rig = learned();
    let (capacity, before) = (rig.monitor.capacity(CellIndex(1)), rig.soc_std(0));
    // No current is measured, so only the downtime has an effect.
    rig.current_a = None;
    rig.restart(Downtime::Unknown);
    rig.seconds(1);
    assert_eq!(rig.gaps(), [None]);
    assert!(before < 0.05 && rig.soc_std(0) > 0.25, "{before} {}", rig.soc_std(0));
    assert_eq!(rig.monitor.capacity(CellIndex(1)), capacity);
}

#[test]
fn state_from_future_has_unknown_age() {
    let mut rig = learned();
    (rig.current_a, rig.deci) = (None, rig.deci - 36_000);
    rig.restart(Downtime::AsStamped);
    rig.seconds(1);
    assert_eq!(rig.gaps(), [None]);
    assert!(rig.soc_std(0) > 0.25, "{}", rig.soc_std(0));
    // The first frame is only about half a second older than the state. This does not count as a clock that was set
    // back, because frames of several interfaces may arrive slightly out of order.
    let mut rig = learned();
    (rig.current_a, rig.deci) = (None, rig.deci - 5);
    rig.restart(Downtime::AsStamped);
    rig.seconds(1);
    assert_eq!(rig.gaps(), []);
    assert!(rig.soc_std(0) < 0.05, "{}", rig.soc_std(0));
}

/// Stored learned values: capacities with their drift terms, and the filters' resistances.
fn learned_parts(rig: &Rig) -> Vec<serde_json::Value> {
    let document = serde_json::to_value(rig.monitor.snapshot()).unwrap();
    let learner = &document["learning"]["learner"];
    let mut parts = vec![learner["capacity"].clone(), learner["drift"].clone(), learner["learned"].clone()];
    for cell in document["cells"].as_array().unwrap() {
        let mean = cell["estimator"]["mean"].as_array().unwrap();
        // The filter's mean contains SOC, branches, resistance ratio and capacity, in this order.
        parts.push(mean[mean.len() - 2].clone());
        parts.extend([cell["usable"].clone(), cell["discharge_resistance"].clone()]);
    }
    parts
}

#[test]
fn learned_values_survive_restart_bit_identical() {
    for away in [
        Downtime::Seconds(0.5),
        Downtime::Seconds(3.0),
        Downtime::Seconds(3e4),
        Downtime::Seconds(3e8),
        Downtime::Unknown,
    ] {
        let mut rig = learned();
        let before = learned_parts(&rig);
        assert!(before[0].to_string().contains("mean") && before[2].to_string().contains("true"));
        for _ in 0..3 {
            rig.restart(away);
            rig.tick();
            assert_eq!(learned_parts(&rig), before, "{away:?}");
        }
    }
}

const HOT: &str =
    "[[alarm]]\nrule = \"temperature_high\"\nwarning = { set = 50, clear = 45 }\ndebounce_s = 10\nlatched = true\n";

impl Rig {
    fn stands(&self, rule: Rule) -> (AlarmState, u32, bool) {
        let cell = matches!(rule, Rule::CapacityLow | Rule::EstimateUntrusted).then_some(CellIndex(0));
        let alarm = self.monitor.alarms().get(rule, cell).unwrap();
        (alarm.state, alarm.occurrences, alarm.is_acknowledged)
    }

    fn ask(&mut self, command: Command) {
        self.give(Record::command(self.now(), command));
    }

    fn refused(&self) -> Option<u32> {
        self.events.iter().rev().find_map(|event| match event.kind {
            EventKind::Command { refused, .. } => Some(refused),
            _ => None,
        })
    }
}

const AWAYS: [Downtime; 5] = [
    Downtime::Seconds(0.0),
    Downtime::Seconds(2.0),
    Downtime::Seconds(60.0),
    Downtime::Seconds(3e5),
    Downtime::Unknown,
];

#[test]
fn all_alarm_states_survive_restart() {
    for away in AWAYS {
        let mut rig = Rig::new(HOT);
        rig.heat(60.0, 12);
        assert_eq!(rig.changes(Rule::TemperatureHigh), [Change::Raised]);
        rig.restart(away);
        rig.heat(60.0, 30);
        assert_eq!(rig.stands(Rule::TemperatureHigh), (AlarmState::Active, 1, false), "{away:?}");
        rig.ask(Command::Acknowledge(Selector::default()));
        rig.restart(away);
        rig.heat(60.0, 30);
        assert_eq!(rig.stands(Rule::TemperatureHigh), (AlarmState::Active, 1, true), "{away:?}");
        rig.heat(20.0, 12);
        assert_eq!(rig.stands(Rule::TemperatureHigh), (AlarmState::Latched, 1, true));
        rig.restart(away);
        rig.heat(20.0, 30);
        assert_eq!(rig.stands(Rule::TemperatureHigh), (AlarmState::Latched, 1, true), "{away:?}");
        rig.ask(Command::Clear(Selector::default()));
        assert_eq!(rig.stands(Rule::TemperatureHigh), (AlarmState::Inactive, 1, true));
        rig.restart(away);
        rig.heat(20.0, 5);
        assert_eq!(rig.stands(Rule::TemperatureHigh), (AlarmState::Inactive, 1, true), "{away:?}");
        let heard = rig.changes(Rule::TemperatureHigh);
        let count = |change| heard.iter().filter(|found| **found == change).count();
        assert_eq!((count(Change::Raised), count(Change::Latched), count(Change::Cleared)), (1, 1, 1), "{away:?}");
    }
}

#[test]
fn raised_alarm_is_never_sent_as_cleared() {
    for away in AWAYS {
        let mut rig = learned();
        let states = |rig: &Rig| rig.wire().iter().map(|wire| wire.state).collect::<Vec<_>>();
        rig.frames.clear();
        rig.restart(away);
        rig.seconds(20);
        let states = states(&rig);
        assert!(states.len() >= 20 && states.iter().all(|state| [1, 5].contains(state)), "{away:?}: {states:?}");
        assert_eq!(rig.stands(Rule::CapacityLow), (AlarmState::Active, 1, false), "{away:?}");
        assert!(!rig.changes(Rule::CapacityLow)[2..].contains(&Change::Raised));
    }
}

#[test]
fn debounce_survives_restart_without_downtime() {
    for away in [Downtime::Seconds(60.0), Downtime::Seconds(3e5)] {
        let mut rig = Rig::new(HOT);
        rig.heat(60.0, 7);
        assert_eq!(rig.stands(Rule::TemperatureHigh).0, AlarmState::Pending);
        rig.restart(away);
        rig.heat(60.0, 2);
        assert_eq!(
            rig.changes(Rule::TemperatureHigh),
            [],
            "{away:?}: seven seconds and two are less than the debounce"
        );
        rig.heat(60.0, 3);
        assert_eq!(rig.changes(Rule::TemperatureHigh), [Change::Raised], "{away:?}");
    }
}

#[test]
fn stored_alarm_without_rule_is_ended() {
    let mut rig = Rig::new(HOT);
    rig.heat(60.0, 12);
    rig.config.rules.clear();
    (rig.events, rig.frames) = Default::default();
    rig.restart(Downtime::Seconds(60.0));
    rig.tick();
    let dropped = rig.events.iter().find_map(|event| match event.kind {
        EventKind::AlarmDropped { rule, active, occurrences, cell, .. } => Some((rule, active, occurrences, cell)),
        _ => None,
    });
    assert_eq!(dropped, Some((Rule::TemperatureHigh, true, 1, None)));
    assert_eq!(rig.last_wire(Rule::TemperatureHigh).state, 6);
    rig.restart(Downtime::Seconds(60.0));
    rig.tick();
    assert_eq!(rig.events.iter().filter(|e| matches!(e.kind, EventKind::AlarmDropped { .. })).count(), 1);
}

#[test]
fn missing_input_stays_missing_across_restart() {
    for away in AWAYS {
        let mut rig = Rig::new("[[alarm]]\nrule = \"input_missing\"\nwarning = 5\n");
        rig.seconds(3);
        rig.temperatures_c[1] = None;
        rig.current_a = None;
        (rig.temperatures_c, rig.reported_soc) = ([None; 2], None);
        rig.seconds(8);
        assert_eq!(rig.changes(Rule::InputMissing), [Change::Raised]);
        rig.restart(away);
        rig.seconds(20);
        let heard = rig.changes(Rule::InputMissing);
        assert!(heard[1..].iter().all(|c| [Change::Suppressed, Change::Resumed].contains(c)), "{away:?}: {heard:?}");
        assert_eq!(rig.stands(Rule::InputMissing), (AlarmState::Active, 1, false), "{away:?}");
        (rig.current_a, rig.temperatures_c, rig.reported_soc) = (Some(0.0), [Some(25.0); 2], Some(0.5));
        rig.seconds(3);
        assert_eq!(rig.changes(Rule::InputMissing).last(), Some(&Change::Cleared), "{away:?}");
    }
}

#[test]
fn faulty_interface_stays_faulty_across_restart() {
    let fault = |event| move |rig: &mut Rig| rig.give(Record::bus(rig.now(), BusIndex(0), event));
    for (event, away) in [
        (BusEvent::Down, Downtime::Seconds(2.0)),
        (BusEvent::Missing, Downtime::Seconds(3e4)),
        (BusEvent::SendFailed { frames: 1 }, Downtime::Seconds(2.0)),
    ] {
        let mut rig = Rig::new("[[alarm]]\nrule = \"bus_fault\"\nwarning = 5\n");
        let silent = |rig: &mut Rig| (0..5).for_each(|_| rig.tick());
        for _ in 0..20 {
            fault(event)(&mut rig);
            silent(&mut rig);
        }
        assert_eq!(rig.changes(Rule::BusFault), [Change::Raised], "{event:?}");
        rig.restart(away);
        for _ in 0..20 {
            silent(&mut rig);
            fault(event)(&mut rig);
        }
        let heard = rig.changes(Rule::BusFault);
        assert!(
            !heard.contains(&Change::Cleared) && heard.iter().filter(|c| **c == Change::Raised).count() == 1,
            "{heard:?}"
        );
        fault(BusEvent::Up)(&mut rig);
        rig.seconds(2);
        assert_eq!(rig.changes(Rule::BusFault).last(), Some(&Change::Cleared), "{event:?}");
    }
}

#[test]
fn low_soc_is_not_judged_by_old_value() {
    for (restarted, away_s) in [(false, 36_000.0), (true, 36_000.0), (true, 60.0)] {
        let mut rig = Rig::new("[[alarm]]\nrule = \"soc_low\"\nwarning = \"20 %\"\n[estimator]\nlost_after_s = 5\n");
        rig.voltages_v = [Some(3.2); 2];
        rig.seconds(120);
        assert_eq!(rig.changes(Rule::SocLow), [Change::Raised]);
        if restarted {
            rig.restart(Downtime::Seconds(away_s));
        } else {
            rig.deci += 360_000;
        }
        // The pack was charged during the sleep. At first only voltages are received, so the SOC is ambiguous.
        (rig.voltages_v, rig.current_a) = ([Some(4.0); 2], None);
        rig.seconds(1);
        assert_eq!(rig.stands(Rule::SocLow), (AlarmState::Suppressed, 1, false), "{restarted} {away_s}");
        if away_s > 1e3 {
            rig.current_a = Some(0.0);
            rig.seconds(1);
            let heard = rig.changes(Rule::SocLow);
            assert_eq!((heard[1], heard.last()), (Change::Suppressed, Some(&Change::Cleared)));
            // After a sleep, the filter trusts the old SOC more than after a downtime, so it corrects this SOC slightly
            // later.
            assert!(!restarted || heard.len() == 3, "{heard:?}");
        }
    }
    // The opposite case: the pack is full before the downtime and empty after it.
    let mut rig = Rig::new("[[alarm]]\nrule = \"soc_low\"\nwarning = \"20 %\"\n");
    rig.voltages_v = [Some(4.0); 2];
    rig.seconds(60);
    assert_eq!(rig.stands(Rule::SocLow).0, AlarmState::Inactive);
    rig.restart(Downtime::Seconds(36_000.0));
    (rig.voltages_v, rig.current_a) = ([Some(3.1); 2], None);
    rig.seconds(1);
    assert_eq!(rig.stands(Rule::SocLow).0, AlarmState::Unknown, "the old SOC must not report a healthy pack");
    rig.current_a = Some(0.0);
    rig.seconds(1);
    assert_eq!(rig.changes(Rule::SocLow), [Change::Raised]);
}

#[test]
fn untrusted_estimate_is_suppressed_once() {
    let mut rig = Rig::new(
        "[[alarm]]\nrule = \"estimate_untrusted\"\nwarning = 4\n[estimator]\nlost_after_s = 1e6\ngate_sigma = 1e3\n",
    );
    rig.seconds(30);
    // The first cell's voltage jumps although no current flows.
    rig.voltages_v = [Some(3.0), Some(3.7)];
    rig.seconds(2);
    for _ in 0..200 {
        rig.voltages_v[0] = Some(if rig.voltages_v[0] == Some(3.0) { 4.2 } else { 3.0 });
        rig.seconds(1);
    }
    assert_eq!(rig.changes(Rule::EstimateUntrusted), [Change::Raised]);
    rig.current_a = None;
    rig.seconds(60);
    assert_eq!(rig.changes(Rule::EstimateUntrusted), [Change::Raised, Change::Suppressed]);
}

#[test]
fn latched_alarm_in_debounce_is_not_cleared() {
    for away in [None, Some(Downtime::Seconds(2.0)), Some(Downtime::Seconds(600.0))] {
        let mut rig = Rig::new(HOT);
        rig.heat(60.0, 12);
        rig.heat(20.0, 12);
        assert_eq!(rig.stands(Rule::TemperatureHigh).0, AlarmState::Latched);
        rig.heat(60.0, 5);
        if let Some(away) = away {
            rig.restart(away);
        }
        rig.ask(Command::Clear(Selector::default()));
        assert_eq!((rig.stands(Rule::TemperatureHigh).0, rig.refused()), (AlarmState::Latched, Some(1)), "{away:?}");
        rig.heat(20.0, 1);
        rig.ask(Command::Clear(Selector::default()));
        assert_eq!((rig.stands(Rule::TemperatureHigh).0, rig.refused()), (AlarmState::Inactive, Some(0)), "{away:?}");
    }
}

#[test]
fn bad_command_flood_is_reported_once_per_second() {
    let mut rig = Rig::new(HOT);
    rig.seconds(1);
    for _ in 0..50 {
        rig.tick();
        for _ in 0..10 {
            let nonsense = Frame::classic(CanId::Standard(1715), &[0xAA; 8]).unwrap();
            rig.give(Record::frame(rig.now(), BusIndex(0), &nonsense));
        }
    }
    let reported = rig.events.iter().filter(|event| matches!(event.kind, EventKind::BadCommand { .. })).count();
    assert!((4..=6).contains(&reported), "{reported} reports in five seconds");
}

#[test]
fn zero_length_test_ends_running_test() {
    let mut rig = Rig::new(HOT);
    rig.seconds(1);
    let tests = |rig: &Rig| {
        let of = |kind| if let EventKind::Test { running, .. } = kind { Some(running) } else { None };
        rig.events.iter().filter_map(|event| of(event.kind)).collect::<Vec<_>>()
    };
    let test = |seconds| Command::Test { rule: Rule::TemperatureHigh, seconds };
    rig.ask(test(60.0));
    rig.seconds(1);
    rig.ask(test(0.0));
    assert_eq!((tests(&rig), rig.refused()), (vec![true, false], Some(0)));
    let last = rig.last_wire(Rule::TemperatureHigh);
    assert_eq!((last.state, last.test), (0, true));
    rig.frames.clear();
    rig.seconds(2);
    assert!(rig.wire().iter().all(|wire| !wire.test));
    rig.ask(test(0.0));
    assert_eq!(tests(&rig), [true, false], "no test was running");
}

#[test]
fn trouble_codes_wait_for_address_after_restart() {
    let j1939 = "[j1939]\naddress = 249\nidentity_number = 1\nmanufacturer_code = 2047\n";
    for away in [Downtime::Seconds(0.5), Downtime::Seconds(20.0), Downtime::Unknown] {
        let mut rig = Rig::new(&(HOT.to_owned() + j1939));
        rig.heat(60.0, 12);
        rig.restart(away);
        let (mut out, mut claimed, mut reported) = (Outputs::default(), None, None);
        for tick in 1..100 {
            let time = rig.now().plus_nanos(tick * 10_000_000);
            rig.monitor.handle(&Record::tick(time), &mut out);
            for sent in out.frames.drain(..) {
                match sent.frame.id() {
                    CanId::Extended(0x18EE_FFF9) => claimed = claimed.or(Some(time)),
                    CanId::Extended(0x18FE_CAF9) => reported = reported.or(Some(time)),
                    _ => {}
                }
            }
        }
        let waited_s = reported.unwrap().since(claimed.unwrap());
        assert!((0.3..0.35).contains(&waited_s), "{away:?}: {waited_s} s");
    }
}

const IDENTITY: &str = "[input.pack_identity]\nsignal = \"Cells.Serial\"\nreadings = 5\naccept_unprotected = true\n";

fn packs(rig: &Rig) -> (Vec<f64>, usize) {
    let of = |kind| if let EventKind::PackIdentity { identity } = kind { Some(identity) } else { None };
    let replaced = rig.events.iter().filter(|event| matches!(event.kind, EventKind::PackReplaced { .. })).count();
    (rig.events.iter().filter_map(|event| of(event.kind)).collect(), replaced)
}

#[test]
fn changed_identity_means_new_pack() {
    let mut rig = Rig::new(&("[[alarm]]\nrule = \"capacity_low\"\nwarning = 5.0\n".to_owned() + IDENTITY));
    assert_eq!(rig.monitor.pack_identity(), None);
    rig.identity = Some(1001.0);
    rig.seconds(2);
    assert_eq!((rig.monitor.pack_identity(), packs(&rig)), (Some(1001.0), (vec![1001.0], 0)));
    rig.discharge();
    let learned = rig.monitor.capacity(CellIndex(0));
    // Invalid and missing readings must not change the identity.
    for odd in [Some(7.0), Some(1001.0), None, Some(8.0), Some(9.0), Some(1001.0)] {
        rig.identity = odd;
        rig.tick_with_frames();
    }
    rig.restart(Downtime::Seconds(3600.0));
    rig.seconds(2);
    assert_eq!((packs(&rig).1, rig.monitor.capacity(CellIndex(0))), (0, learned));
    // The pack is replaced while the computer is off.
    rig.restart(Downtime::Seconds(3600.0));
    rig.identity = Some(1002.0);
    (0..4).for_each(|_| rig.tick_with_frames());
    assert_eq!(packs(&rig).1, 0);
    rig.tick_with_frames();
    assert_eq!((rig.monitor.pack_identity(), packs(&rig)), (Some(1002.0), (vec![1001.0, 1002.0], 1)));
    assert_eq!(rig.monitor.capacity(CellIndex(0)).mean, 2.6);
    let who = rig.events.iter().find_map(|event| match event.kind {
        EventKind::Command { source, command: Command::PackReplaced, .. } => Some(source),
        _ => None,
    });
    assert_eq!(who, Some(Source::Bus(BusIndex(0))));
}

#[test]
fn restart_begins_with_used_up_budget_of_alarm_frames() {
    // How long ago the budget of alarm frames would have allowed the next frame (s). Above 0.2 s, a burst is allowed.
    let unused_s = |away| {
        let mut rig = Rig::new("");
        rig.seconds(20);
        rig.restart(away);
        rig.tick();
        let state = serde_json::to_value(rig.monitor.snapshot()).unwrap();
        let free = state["sending"]["schedule"]["alarms"]["free"].as_i64().unwrap();
        (rig.now().nanos() - free) as f64 * 1e-9
    };
    for away in [Downtime::Unknown, Downtime::Seconds(5.0)] {
        assert!(unused_s(away) < 0.001, "{away:?}: {} s", unused_s(away));
    }
    // Without a downtime, the budget is the same as before the restart.
    assert!(unused_s(Downtime::Seconds(0.0)) > 10.0, "{}", unused_s(Downtime::Seconds(0.0)));
}
