//! Tests a reload of the configuration while the core runs: what is applied, what continues, and what needs a restart.

use crate::support::rig::{Rig, learned, load};
use packwatch::alarm::{AlarmState, Change, Rule, Severity};
use packwatch::can::CanId;
use packwatch::cell::CapacityState;
use packwatch::health::{Axis, CapacityReading, Forecast, Usage};
use packwatch::monitor::{Command, Downtime, EventKind, Monitor, MonitorConfig, Record};
use packwatch::quantity::CellIndex;

const HOT: &str = "[[alarm]]\nrule = \"temperature_high\"\nwarning = { set = 50, clear = 45 }\n";

impl Rig {
    fn state(&self, rule: Rule, cell: Option<CellIndex>) -> (AlarmState, u32, bool) {
        let alarm = self.monitor.alarms().get(rule, cell).unwrap();
        (alarm.state, alarm.occurrences, alarm.is_acknowledged)
    }

    fn frames_of(&self, id: u16) -> Vec<u8> {
        self.frames
            .iter()
            .filter(|frame| frame.id() == CanId::Standard(id))
            .map(|frame| frame.data()[1] & 0xF)
            .collect()
    }
}

fn hot() -> Rig {
    let mut rig = Rig::new(HOT);
    rig.heat(60.0, 2);
    rig.give(Record::command(rig.now(), Command::Acknowledge(Default::default())));
    assert_eq!(rig.state(Rule::TemperatureHigh, None), (AlarmState::Active, 1, true));
    rig.events.clear();
    rig.frames.clear();
    rig
}

#[test]
fn reload_keeps_raised_alarm_with_same_threshold() {
    let mut rig = hot();
    let done = rig.reload(|config| config.health.transition.min_duration_s += 1.0).unwrap();
    assert_eq!((done.changed, done.alarms_ended), (vec!["[transition]"], 0));
    assert!(matches!(rig.events[..], [event] if event.kind == EventKind::Reconfigured { alarms_ended: 0 }));
    rig.heat(60.0, 2);
    assert_eq!(rig.state(Rule::TemperatureHigh, None), (AlarmState::Active, 1, true));
    assert_eq!(rig.changes(Rule::TemperatureHigh), []);
    rig.heat(40.0, 1);
    assert_eq!(rig.changes(Rule::TemperatureHigh), [Change::Cleared]);
}

#[test]
fn changed_threshold_is_judged_at_once() {
    let mut rig = hot();
    let changed = |set: f64, clear: f64| {
        move |config: &mut MonitorConfig| (config.rules[0].threshold, config.rules[0].clear) = (set, clear)
    };
    assert_eq!(rig.reload(changed(70.0, 65.0)).unwrap().changed, ["[[alarm]]"]);
    assert_eq!(rig.changes(Rule::TemperatureHigh), [Change::Cleared]);
    assert_eq!(rig.state(Rule::TemperatureHigh, None), (AlarmState::Inactive, 1, true));
    rig.reload(changed(55.0, 50.0)).unwrap();
    assert_eq!(rig.changes(Rule::TemperatureHigh), [Change::Cleared, Change::Raised]);
    assert_eq!(rig.state(Rule::TemperatureHigh, None), (AlarmState::Active, 2, false));
}

#[test]
fn changed_threshold_restarts_debounce() {
    let mut rig = Rig::new(&(HOT.to_owned() + "debounce_s = 10\n"));
    rig.heat(60.0, 9);
    rig.reload(|config| config.rules[0].threshold = 55.0).unwrap();
    rig.heat(60.0, 9);
    assert_eq!(rig.changes(Rule::TemperatureHigh), []);
    rig.heat(60.0, 2);
    assert_eq!(rig.changes(Rule::TemperatureHigh), [Change::Raised]);
    // If the threshold is unchanged, the debounce continues.
    let mut rig = Rig::new(&(HOT.to_owned() + "debounce_s = 10\n"));
    rig.heat(60.0, 9);
    rig.reload(|config| config.sample.ambient_c += 1.0).unwrap();
    rig.heat(60.0, 2);
    assert_eq!(rig.changes(Rule::TemperatureHigh), [Change::Raised]);
}

#[test]
fn removed_rule_ends_its_alarm() {
    let mut rig = hot();
    let done = rig.reload(|config| config.rules[0].severity = Severity::Severe).unwrap();
    assert_eq!(done.alarms_ended, 1);
    assert_eq!(rig.changes(Rule::TemperatureHigh), [Change::Forgotten]);
    let wire = rig.last_wire(Rule::TemperatureHigh);
    assert_eq!((wire.state, wire.test), (6, false), "the alarm state is unknown");
    assert!(rig.events.iter().any(|event| event.kind == EventKind::Reconfigured { alarms_ended: 1 }));
    // The rule now has a severe threshold instead of a warning threshold. The severe alarm must be raised as usual.
    rig.heat(60.0, 1);
    assert_eq!(rig.changes(Rule::TemperatureHigh), [Change::Forgotten, Change::Raised]);
    assert_eq!(rig.state(Rule::TemperatureHigh, None), (AlarmState::Active, 1, false));
    rig.reload(|config| config.rules.clear()).unwrap();
    assert_eq!((rig.monitor.alarms().count(), rig.monitor.alarms().all().count()), (0, 0));
}

#[test]
fn new_threshold_applies_to_learned_values() {
    let mut rig = learned();
    let capacity_ah = [0, 1].map(|cell| rig.monitor.capacity(CellIndex(cell)).mean);
    rig.events.clear();
    rig.reload(|config| (config.rules[0].threshold, config.rules[0].clear) = (0.5, 0.6)).unwrap();
    assert_eq!(rig.changes(Rule::CapacityLow), [Change::Cleared; 2]);
    rig.reload(|config| (config.rules[0].threshold, config.rules[0].clear) = (5.0, 5.0)).unwrap();
    assert_eq!(rig.changes(Rule::CapacityLow)[2..], [Change::Raised; 2]);
    assert_eq!([0, 1].map(|cell| rig.monitor.capacity(CellIndex(cell)).mean), capacity_ah);
}

#[test]
fn changed_end_of_life_discards_old_forecast() {
    let mut rig = Rig::new("[[alarm]]\nrule = \"remaining_life_low\"\nwarning = 30\n");
    rig.seconds(2);
    // The forecast expects that the fade becomes faster. It predicts about 60 cycles to 2.08 Ah and about 90 cycles to
    // 1.82 Ah.
    let mut forecast = Forecast::new(Axis::Cycles, 2.6);
    for cycle in 0..60 {
        let passed = Usage { cycles: 1.0, days: 0.5, rest_days: 0.0 };
        let capacity_ah = 2.6 - 0.004 * f64::from(cycle);
        forecast.update(passed, Some(CapacityReading { capacity_ah, variance_ah2: 1e-6, shared_variance_ah2: 0.0 }));
    }
    let mut stored = serde_json::to_value(rig.monitor.snapshot()).unwrap();
    (0..2).for_each(|cell| stored["cells"][cell]["forecast"] = serde_json::to_value(&forecast).unwrap());
    rig.monitor = Monitor::new(rig.config.clone());
    rig.monitor.restore(serde_json::from_value(stored).unwrap(), Downtime::AsStamped).unwrap();
    rig.seconds(1);
    let cycles = |rig: &Rig| rig.monitor.pack_remaining_life().unwrap().1.cycles.unwrap().median;
    assert!((50.0..90.0).contains(&cycles(&rig)), "{}", cycles(&rig));
    rig.reload(|_| ()).unwrap();
    rig.events.clear();
    rig.reload(|config| {
        config.health.end_of_life_ah = 1.82;
        (config.rules[0].threshold, config.rules[0].clear) = (72.0, 74.0);
    })
    .unwrap();
    assert!(cycles(&rig) > 74.0, "{}", cycles(&rig));
    assert_eq!(
        rig.changes(Rule::RemainingLifeLow),
        [],
        "the remaining life to the old end of life is below the new threshold"
    );
    let reported = rig.events.iter().filter_map(|event| match event.kind {
        EventKind::RemainingLife { cycles, .. } => cycles,
        _ => None,
    });
    assert_eq!(reported.collect::<Vec<_>>(), [cycles(&rig)]);
    rig.reload(|config| config.health.end_of_life_ah = 2.2).unwrap();
    assert_eq!(rig.changes(Rule::RemainingLifeLow), [Change::Raised]);
}

#[test]
fn changed_load_makes_usable_capacity_unknown() {
    let mut rig = Rig::with({
        let mut config = learned().config;
        config.health.usable =
            load("[usable]\ncurrent_a = 5\ntemperature_c = 25\ncutoff_v = 3.0\n").monitor.health.usable;
        config
    });
    rig.discharge();
    assert!(rig.monitor.usable_capacity(CellIndex(0)).is_some());
    rig.reload(|config| config.rules[0].threshold = 1.0).unwrap();
    assert!(rig.monitor.usable_capacity(CellIndex(0)).is_some());
    rig.reload(|config| config.health.usable.as_mut().unwrap().cutoff_v = 3.2).unwrap();
    assert_eq!(rig.monitor.usable_capacity(CellIndex(0)), None);
}

#[test]
fn reload_keeps_counters_and_applies_period() {
    let protected = "[output.status]\nperiod_ms = 200\ne2e = \"1A\"\ndata_id = 1\n\
        [output.health]\nperiod_ms = 60000\ne2e = \"1A\"\ndata_id = 2\n";
    let mut rig = Rig::new(protected);
    rig.seconds(5);
    rig.reload(|config| config.output.as_mut().unwrap().health_period_s = 1.0).unwrap();
    rig.seconds(3);
    let status = rig.frames_of(0x6B0);
    assert_eq!(status.len(), 40);
    assert!(status.windows(2).all(|pair| pair[1] == (pair[0] + 1) % 15), "{status:?}");
    let health = rig.frames_of(0x6B1);
    assert!((15..=20).contains(&health.len()), "five pages at the start, then five per second: {health:?}");
    assert!(health.windows(2).all(|pair| pair[1] == (pair[0] + 1) % 15), "{health:?}");
    rig.frames.clear();
    rig.reload(|config| config.output = None).unwrap();
    rig.seconds(2);
    assert_eq!(rig.frames.len(), 0);
}

#[test]
fn reload_keeps_command_sequence() {
    let mut rig = learned();
    rig.command(1, 31, 2047);
    rig.reload(|config| config.rules[0].threshold = 4.9).unwrap();
    // If the reload had reset the counter check, this frame would count as the first one and be ignored.
    rig.command(1, 31, 2047);
    assert!(rig.events.iter().any(|event| matches!(event.kind, EventKind::Command { changed: 2, .. })));
}

#[test]
fn restart_only_settings_are_rejected_by_name() {
    type Edit = fn(&mut MonitorConfig);
    let edits: [(Edit, &str); 11] = [
        (|config| config.interfaces = 2, "[[interface]]: 2, running with 1: needs a restart"),
        (|config| config.sample.cells = 3, "pack.cells: 3, running with 2: needs a restart"),
        (|config| config.sample.strings = 4, "pack.strings: 4, running with 1: needs a restart"),
        (
            |config| config.model.branches.push(config.model.branches[0].clone()),
            "pack.cell_model: branches: 2, running with 1: needs a restart",
        ),
        (|config| config.model.capacity_ah *= 1.1, "pack.cell_model: changed frames"),
        (|config| config.input = Default::default(), "[input]: changed frames, signals or tables"),
        (|config| config.sample.sensor_of_cell.swap(0, 1), "[[input.temperature]]: changed"),
        (|config| config.sample.reported_soc = None, "[input.reported_soc] and [input.reported_soh]: changed"),
        (|config| config.commands = None, "[commands]: changed"),
        (|config| config.estimator.capacity_state = CapacityState::Held, "estimator.capacity_state: changed"),
        (
            |config| {
                config.j1939 =
                    load("[j1939]\naddress = 249\nidentity_number = 1\nmanufacturer_code = 2047\n").monitor.j1939
            },
            "[j1939]: changed",
        ),
    ];
    let mut rig = hot();
    for (edit, said) in edits {
        let error = rig.reload(edit).expect_err(said).to_string();
        assert!(error.starts_with(said) && error.ends_with("needs a restart"), "{error}");
    }
    rig.heat(60.0, 2);
    assert_eq!((rig.state(Rule::TemperatureHigh, None), rig.events.len()), ((AlarmState::Active, 1, true), 0));
}

#[test]
fn reload_keeps_address_and_changes_codes() {
    let j1939 = "[j1939]\naddress = 249\nidentity_number = 1\nmanufacturer_code = 2047\n";
    let mut rig = Rig::new(&(HOT.to_owned() + j1939));
    rig.heat(60.0, 3);
    rig.frames.clear();
    let spn = |rig: &Rig| {
        let dm1 = rig.frames.iter().rev().find(|frame| frame.id() == CanId::Extended(0x18FE_CAF9)).unwrap();
        u32::from(dm1.data()[2]) | u32::from(dm1.data()[3]) << 8 | u32::from(dm1.data()[4] >> 5) << 16
    };
    let other = load(&(HOT.to_owned() + "spn = 7001\n" + j1939)).monitor.j1939;
    assert_eq!(rig.reload(|config| config.j1939 = other).unwrap().changed, ["[j1939]"]);
    rig.heat(60.0, 3);
    assert_eq!(spn(&rig), 7001);
    let claims = |rig: &Rig| rig.frames.iter().filter(|frame| frame.id() == CanId::Extended(0x18EE_FFF9)).count();
    assert_eq!(claims(&rig), 0);
    // If the NAME changes, the node must claim an address again.
    rig.reload(|config| {
        let other = j1939.replace("number = 1", "number = 2");
        config.j1939 = load(&(HOT.to_owned() + &other)).monitor.j1939;
    })
    .unwrap();
    rig.heat(60.0, 1);
    assert_eq!(claims(&rig), 1);
}
