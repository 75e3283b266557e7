//! Tests a hostile or broken bus: random absurd readings, random configurations, a second sender, frames with
//! packwatch's own identifiers, and a frozen current. Each fault must be detected in time, and an unphysical number
//! must never be shown as valid. `PACKWATCH_CONFIGS` sets the number of random configurations.

use std::path::Path;

use packwatch::alarm::{Change, Rule};
use packwatch::can::encode::InputEncoder;
use packwatch::can::{CanId, Frame};
use packwatch::config::{self, ConfigFiles};
use packwatch::monitor::{Downtime, EventKind, Monitor, MonitorConfig, Outputs, Record, Snapshot, Validity};
use packwatch::quantity::catalogue::{Estimate, Quantity};
use packwatch::quantity::{BusIndex, CellIndex, Channel, Fault, SensorIndex, Timestamp, bounds};

use crate::support::config_texts;
use crate::support::dice::Dice;
use crate::support::rig::{DBC, PACK, Rig};

mod configurations;

const BUS: BusIndex = BusIndex(0);
const ALARMS: &str = "[[alarm]]\nrule = \"input_implausible\"\nwarning = 0.5\n[[alarm]]\nrule = \"bus_fault\"\nwarning = 1\n\
                      [[alarm]]\nrule = \"estimate_untrusted\"\nwarning = 4\n";

#[derive(Debug, Clone, Copy)]
enum Behaviour {
    Normal,
    Random,
    Jumps,
    Stuck(f64),
    Lowest,
    Highest,
    Ramp(f64),
    Silent,
}

impl Behaviour {
    fn draw(dice: &mut Dice, low: f64, high: f64) -> Self {
        match dice.below(9) {
            0 | 1 => Self::Normal,
            2 => Self::Random,
            3 => Self::Jumps,
            4 => Self::Stuck(dice.between(low, high)),
            5 => Self::Lowest,
            6 => Self::Highest,
            7 => Self::Ramp(dice.between(-0.01, 0.01)),
            _ => Self::Silent,
        }
    }

    fn value(self, dice: &mut Dice, (low, high): (f64, f64), normal: f64, time_s: f64) -> Option<f64> {
        Some(match self {
            Self::Normal => normal,
            Self::Random => dice.between(low, high),
            Self::Jumps => {
                if dice.one_in(20) {
                    dice.between(low, high)
                } else {
                    normal
                }
            }
            Self::Stuck(value) => value,
            Self::Lowest => low,
            Self::Highest => high,
            Self::Ramp(per_s) => (normal + per_s * time_s).clamp(low, high),
            Self::Silent => return None,
        })
    }
}

/// If the pack's values are shown as valid, checks that they are physically possible. Returns whether they are valid.
fn check_shown(monitor: &Monitor, run: u64, second: u32) -> bool {
    let (pack, model_ah) = (monitor.pack_view(), 2.6);
    if pack.validity != Validity::Valid {
        return false;
    }
    let what = || format!("run {run}, {second} s: {pack:#?}");
    let is_soc = |soc: Estimate| (0.0..=1.0).contains(&soc.mean) && soc.std.is_some_and(|std| std > 0.0);
    let is_capacity = |ah: f64| bounds::TRUSTED_CAPACITY.has(ah / model_ah);
    assert!(pack.values.get(Quantity::Soc).is_none_or(is_soc), "{}", what());
    assert!(pack.values.mean(Quantity::Capacity).is_none_or(is_capacity), "{}", what());
    assert!(pack.values.mean(Quantity::Soh).is_none_or(is_capacity_of_rated), "{}", what());
    for cell in monitor.cell_views() {
        assert!(cell.values.get(Quantity::Soc).is_none_or(is_soc), "{cell:#?} {}", what());
        assert!(cell.values.mean(Quantity::Capacity).is_none_or(is_capacity), "{cell:#?} {}", what());
        let is_ratio = |ratio: f64| bounds::TRUSTED_LOG_RESISTANCE.has(ratio.ln());
        assert!(cell.values.mean(Quantity::ResistanceRatio).is_none_or(is_ratio), "{cell:#?} {}", what());
    }
    true
}

fn is_capacity_of_rated(soh: f64) -> bool {
    (0.05..=3.2).contains(&soh)
}

#[test]
fn hostile_readings_give_no_unphysical_estimate() {
    let mut valid = 0_u32;
    for run in 0..120 {
        let mut dice = Dice::new(run + 1);
        let mut rig = Rig::new(ALARMS);
        let current = Behaviour::draw(&mut dice, -300.0, 300.0);
        let voltages = [(); 2].map(|()| Behaviour::draw(&mut dice, 1.3, 4.7));
        let temperature = Behaviour::draw(&mut dice, -40.0, 150.0);
        let mut load_a = 0.0;
        for tick in 0..3000_u32 {
            let second = tick / 10;
            if dice.one_in(150) {
                load_a = [0.0, 2.0, -2.0, 5.0, 120.0, -250.0][dice.below(6)];
            }
            let time_s = f64::from(tick) / 10.0;
            let normal_v = 3.7 - 0.02 * load_a + 0.2 * libm::sin(time_s / 300.0);
            rig.current_a = current.value(&mut dice, (-300.0, 300.0), load_a, time_s);
            rig.voltages_v = voltages.map(|voltage| voltage.value(&mut dice, (1.3, 4.7), normal_v, time_s));
            rig.temperatures_c[0] = temperature.value(&mut dice, (-40.0, 150.0), 25.0, time_s);
            rig.tick_with_frames();
            valid += u32::from(check_shown(&rig.monitor, run, second));
        }
        let text = serde_json::to_string(&rig.monitor.snapshot()).unwrap();
        let snapshot: Snapshot = serde_json::from_str(&text).unwrap();
        let mut after = Monitor::new(rig.config.clone());
        after.restore(snapshot, Downtime::Seconds(10.0)).unwrap_or_else(|error| panic!("run {run}: {error}"));
    }
    eprintln!("valid after {valid} of 360000 rounds of readings");
    assert!(valid > 10_000, "too few valid estimates to check: {valid}");
}

/// Sends the frames of the pack ten times per second. A second sender adds `more` frames per second, which show the
/// current `current_a`.
fn with_second_sender(rig: &mut Rig, seconds: u32, more: u32, current_a: f64) {
    let encoder = InputEncoder::new(&rig.config.input);
    let mut made = Vec::new();
    let all = [Channel::Temperature(SensorIndex(0)), Channel::Temperature(SensorIndex(1)), Channel::ReportedSoc];
    let mut values = vec![(Channel::Current, Some(current_a))];
    values.extend(all.map(|channel| (channel, Some(if channel == Channel::ReportedSoc { 0.5 } else { 25.0 }))));
    encoder.encode(&values, &mut made);
    let (_, frame) = made[0];
    for _ in 0..10 * seconds {
        rig.tick_with_frames();
        for k in 0..more / 10 {
            let time = rig.now().plus_nanos(i64::from(k) * 100_000_000 / i64::from(more / 10) + 500_000);
            rig.give(Record::frame(time, BUS, &frame));
        }
    }
}

#[test]
fn second_current_sender_is_reported_and_distrusted() {
    for more in [1000, 100, 20] {
        let mut rig = Rig::new(ALARMS);
        rig.current_a = Some(0.5);
        rig.seconds(60);
        assert_eq!(rig.monitor.pack_view().validity, Validity::Valid);
        let from = rig.now();
        with_second_sender(&mut rig, 6, more, 90.0);
        let found = rig.events.iter().find(|event| matches!(event.kind, EventKind::SecondSender(it) if it.active));
        let found_s = found.unwrap_or_else(|| panic!("{more}: not found")).time.since(from);
        assert!(found_s <= 5.0, "{more} frames more a second: found after {found_s} s");
        assert_eq!(rig.monitor.pack_view().validity, Validity::Untrusted, "{more}");
        assert_eq!(rig.changes(Rule::InputImplausible), [Change::Raised], "{more}");
        assert_eq!(rig.monitor.second_senders().collect::<Vec<_>>(), [(BUS, CanId::Standard(0x100))]);
        rig.seconds(20);
        assert_eq!(rig.monitor.second_senders().count(), 0, "the second sender has stopped");
        assert_eq!(rig.changes(Rule::InputImplausible).last(), Some(&Change::Cleared), "{more}");
    }
}

#[test]
fn own_identifiers_are_reported_but_echo_is_not() {
    let mut rig = Rig::new(ALARMS);
    // Simulate an adapter that echoes sent frames.
    for _ in 0..300 {
        rig.tick_with_frames();
        let time = rig.now();
        for frame in std::mem::take(&mut rig.frames) {
            rig.give(Record::frame(time, BUS, &frame));
        }
    }
    assert_eq!(rig.monitor.own_id_uses().count(), 0);
    let status = Frame::classic(CanId::Standard(0x6B0), &[0; 8]).unwrap();
    let from = rig.now();
    for _ in 0..50 {
        rig.tick_with_frames();
        let time = rig.now();
        rig.give(Record::frame(time, BUS, &status));
    }
    let found: Vec<_> = rig.events.iter().filter(|event| matches!(event.kind, EventKind::OwnIdentifier(_))).collect();
    assert_eq!(found.len(), 1, "{found:?}");
    assert!(found[0].time.since(from) <= 5.0);
    assert_eq!(rig.changes(Rule::BusFault), [Change::Raised]);
    rig.seconds(12);
    assert_eq!(rig.changes(Rule::BusFault).last(), Some(&Change::Cleared));
    assert!(
        rig.config.wanted_ids(BUS).contains(&CanId::Standard(0x6B0)),
        "the socket must receive our own identifiers"
    );
}

/// Result of a drive. `differs_s` is the first time (s) at which the frozen current differs from the true current by
/// more than 1 % of the largest valid current.
struct Drive {
    events: Vec<(f64, EventKind)>,
    validity: Validity,
    differs_s: Option<f64>,
}

/// A drive of the shipped pack. If `frozen_s` is given, the current frames repeat the same bits from that time on.
fn drive(frozen_s: Option<f64>, seconds: f64) -> Drive {
    use packwatch::sim::{Scenario, Settings, Simulation, Wiring};
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/example.toml");
    let config: MonitorConfig = config::load(&path).unwrap_or_else(|faults| panic!("{faults:?}")).monitor;
    let settings = Settings {
        duration_s: Some(seconds),
        current_period_ns: 100_000_000,
        cell_period_ns: 1_000_000_000,
        ..Settings::of(Scenario::EvDay, config.model.capacity_ah)
    };
    let sensors = config.sample.sensor_of_cell.iter().flatten().map(|sensor| sensor.index() + 1).max().unwrap_or(0);
    let wiring = Wiring { strings: config.sample.strings, temperature_at: vec![None; sensors] };
    let mut sim = Simulation::new(config.model.clone(), settings, wiring);
    let (encoder, mut monitor) = (InputEncoder::new(&config.input), Monitor::new(config.clone()));
    let (mut out, mut made, mut events) = (Outputs::default(), Vec::new(), Vec::new());
    let (mut held_a, mut differs_s): (Option<f64>, Option<f64>) = (None, None);
    let noticeable_a = 0.01 * config.sample.current.max;
    while let Some(moment) = sim.advance() {
        let is_frozen = frozen_s.is_some_and(|frozen_s| moment.time.secs() >= frozen_s);
        let mut values: Vec<(Channel, Option<f64>)> = sim.readings().to_vec();
        for (channel, value) in &mut values {
            if *channel == Channel::Current && value.is_some() {
                held_a = if is_frozen { held_a.or(*value) } else { *value };
                let is_wrong = value.zip(held_a).is_some_and(|(true_a, held_a)| (true_a - held_a).abs() > noticeable_a);
                differs_s = differs_s.or(is_wrong.then_some(moment.time.secs()));
                *value = held_a;
            }
        }
        made.clear();
        encoder.encode(&values, &mut made);
        for (bus, frame) in &made {
            monitor.handle(&Record::frame(moment.time, *bus, frame), &mut out);
        }
        monitor.handle(&Record::tick(moment.time), &mut out);
        events.extend(out.events.drain(..).map(|event| (event.time.secs(), event.kind)));
        out.clear();
    }
    Drive { events, validity: monitor.pack_view().validity, differs_s }
}

fn frozen_at(events: &[(f64, EventKind)]) -> Option<f64> {
    let is_stuck =
        |kind: &EventKind| matches!(kind, EventKind::SignalBad { channel: Channel::Current, fault: Fault::Stuck });
    events.iter().find(|(_, kind)| is_stuck(kind)).map(|(time_s, _)| *time_s)
}

#[test]
fn frozen_current_is_found_without_false_finding() {
    let Drive { events, .. } = drive(None, 3600.0);
    assert_eq!(frozen_at(&events), None);
    assert!(!events.iter().any(|(_, kind)| matches!(kind, EventKind::SecondSender(_) | EventKind::OwnIdentifier(_))));
    // From 333.3 s on, the car cruises for 100 s. During this time the voltages cannot reveal the frozen current.
    for frozen_s in [120.0, 333.3] {
        let Drive { events, validity, differs_s } = drive(Some(frozen_s), frozen_s + 240.0);
        let after_s = frozen_at(&events).zip(differs_s).map(|(at_s, differs_s)| at_s - differs_s);
        eprintln!("frozen at {frozen_s} s, wrong from {differs_s:?} s: found {after_s:?} s later");
        assert!(after_s.is_some_and(|after_s| after_s <= 60.0), "{frozen_s}: {after_s:?}");
        assert_eq!(validity, Validity::Untrusted, "{frozen_s}");
    }
}

#[test]
fn implausible_stored_charge_is_rejected() {
    let mut rig = Rig::new("");
    rig.current_a = Some(5.0);
    rig.seconds(60);
    let good = serde_json::to_value(rig.monitor.snapshot()).unwrap();
    let refused = |edit: &dyn Fn(&mut serde_json::Value)| {
        let mut document = good.clone();
        edit(&mut document);
        let snapshot: Snapshot = serde_json::from_value(document).unwrap();
        Monitor::new(rig.config.clone()).restore(snapshot, Downtime::Seconds(1.0)).err().map(|error| error.to_string())
    };
    assert_eq!(refused(&|_| {}), None);
    let charge = refused(&|document| document["cells"][1]["consumed"]["charge_as"] = serde_json::json!(2e12));
    let charge = charge.expect("refused");
    assert!(charge.contains("cell 1") && charge.contains("charge since a cell's latest voltage"), "{charge}");
    let soc = refused(&|document| document["cells"][0]["estimator"]["mean"][0] = serde_json::json!(-58.0));
    assert!(soc.expect("refused").contains("-10 to 10"));
    let time = refused(&|document| document["time"] = serde_json::json!(i64::MAX));
    assert!(time.expect("refused").contains("145 years"));
}
