//! Tests the rules that compare each cell with its pack, on simulated packs with one fault. The diagnosis evaluates
//! rows: sums of each cell's samples over a few minutes.

use std::fmt::Write as _;

use crate::support::config_texts;
use packwatch::alarm::{AlarmState, Change, Rule};
use packwatch::can::decode::{Binding, InputMap};
use packwatch::can::encode::InputEncoder;
use packwatch::cell_faults::difference::LEAK;
use packwatch::cell_faults::{BalancingConfig, CellFault, CellFaultKind};
use packwatch::io::ticks::Ticks;
use packwatch::monitor::{
    Command, Downtime, Event, EventKind, Monitor, MonitorConfig, Outputs, Record, TICK_PERIOD_MS,
};
use packwatch::quantity::{CellIndex, Channel, Timestamp};
use packwatch::sim::{Balancing, Scenario, SensorQuality, Sensors, Settings, Simulation, Wiring};

const CELLS: u16 = 12;
/// If no input arrives for this long (s), the vehicle counts as asleep.
const SLEEP_GAP_S: f64 = 30.0;

const PACK: &str = r#"
[pack]
cells = 12
cell_model = "cells/example_nmc_2600.toml"
[[interface]]
name = "can0"
[input]
dbc = ["pack.dbc"]
[input.current]
signal = "Pack.Current"
positive = "discharge"
[input.cell_voltage]
signal = "Cells.Voltage{n}"
[[input.temperature]]
signal = "Pack.Temperature"
[usable]
current_a = 2.6
temperature_c = 25.0
cutoff_v = 2.8
[output]
[[alarm]]
rule = "cell_leak"
warning = "0.1 %"
when = { probability = 0.99 }
[[alarm]]
rule = "connection_resistance"
warning = "20 %"
when = { probability = 0.99 }
[[alarm]]
rule = "channel_faulty"
warning = 0.5
[[alarm]]
rule = "capacity_low"
warning = "80 %"
[[alarm]]
rule = "usable_capacity_low"
warning = "60 %"
[[alarm]]
rule = "resistance_high"
warning = 1.8
[[alarm]]
rule = "estimate_untrusted"
warning = 4.0
debounce_s = 600.0
[[alarm]]
rule = "soc_low"
warning = "1 %"
[[alarm]]
rule = "cell_imbalance"
warning = "8 %"
"#;

const OF_CELL: [Rule; 6] = [
    Rule::CapacityLow,
    Rule::UsableCapacityLow,
    Rule::ResistanceHigh,
    Rule::EstimateUntrusted,
    Rule::CellLeak,
    Rule::ConnectionResistance,
];

fn config() -> MonitorConfig {
    load(PACK, "Temperature")
}

fn config_with_three_sensors() -> MonitorConfig {
    let one = "[[input.temperature]]\nsignal = \"Pack.Temperature\"\n";
    let three = ["1-4", "5-8", "9-12"]
        .iter()
        .zip(1..)
        .map(|(cells, n)| format!("[[input.temperature]]\nsignal = \"Pack.Temperature{n}\"\ncells = \"{cells}\"\n"));
    load(&PACK.replace(one, &three.collect::<String>()), "Temperature1 Temperature2 Temperature3")
}

fn load(pack: &str, temperatures: &str) -> MonitorConfig {
    let mut dbc = String::from("VERSION \"\"\nNS_ :\nBS_:\nBU_: A\nBO_ 256 Pack: 8 A\n");
    dbc += " SG_ Current : 0|16@1- (0.01,0) [-300|300] \"A\" A\n";
    for (name, bit) in temperatures.split(' ').zip([16, 32, 48]) {
        let _ = writeln!(dbc, " SG_ {name} : {bit}|16@1- (0.1,0) [-100|200] \"degC\" A");
    }
    dbc += "BO_ 272 Cells: 8 A\n SG_ Page M : 0|8@1+ (1,0) [0|255] \"\" A\n";
    for cell in 0..CELLS {
        let (page, bit) = (cell / 3, 16 + 16 * (cell % 3));
        let _ = writeln!(dbc, " SG_ Voltage{} m{page} : {bit}|16@1+ (0.0001,0) [0|6.5] \"V\" A", cell + 1);
    }
    dbc += "BO_ 304 Balancing: 2 A\n";
    (0..CELLS).for_each(|cell| dbc += &format!(" SG_ Bleed{} : {cell}|1@1+ (1,0) [0|1] \"\" A\n", cell + 1));
    config_texts::load(pack, &dbc).monitor
}

fn settings() -> Settings {
    let mut settings = Settings::of(Scenario::EvDay, 2.6);
    settings.pack.cells = CELLS;
    settings.sensors = Sensors::of_quality(SensorQuality::Good);
    (settings.current_period_ns, settings.cell_period_ns) = (1_000_000_000, 1_000_000_000);
    settings.duration_s = None;
    settings
}

struct FaultyPack {
    sim: Simulation,
    encoder: InputEncoder,
    config: MonitorConfig,
    monitor: Monitor,
    ticks: Ticks,
    events: Vec<Event>,
}

impl FaultyPack {
    fn new(fault: &str) -> Self {
        Self::of(config(), fault)
    }

    fn of(config: MonitorConfig, fault: &str) -> Self {
        let mut settings = settings();
        settings.pack.spread.resistance = 0.01;
        Self::simulated(config, settings, Wiring::single(), fault)
    }

    fn simulated(config: MonitorConfig, settings: Settings, wiring: Wiring, fault: &str) -> Self {
        let faults: Vec<_> = fault.split_whitespace().map(|text| text.parse().unwrap()).collect();
        Self {
            sim: Simulation::new(config.model.clone(), settings, wiring).with_faults(&faults),
            encoder: InputEncoder::new(&config.input),
            monitor: Monitor::new(config.clone()),
            config,
            ticks: Ticks::new(TICK_PERIOD_MS, SLEEP_GAP_S),
            events: Vec::new(),
        }
    }

    fn balanced(seed: u64, quality: SensorQuality) -> Self {
        let mut settings = settings();
        (settings.seed, settings.pack.spread.soc) = (seed, 0.005);
        settings.sensors = Sensors::of_quality(quality);
        let mut pack = Self::simulated(config(), settings, Wiring::single(), "");
        pack.sim = pack.sim.with_balancing(Balancing::usual(2.6));
        pack
    }

    /// Runs to the given day plus a quarter of an hour. By then the latest row has ended, and all inputs are back.
    fn run_to(&mut self, day: f64) {
        let (mut out, mut frames) = (Outputs::default(), Vec::new());
        let mut moments_after = 0;
        while moments_after < 900 {
            moments_after += u32::from(self.monitor.now() >= Timestamp::from_secs(day * 86_400.0));
            let moment = self.sim.advance().unwrap();
            frames.clear();
            self.encoder.encode(self.sim.readings(), &mut frames);
            self.ticks.advance(moment.time);
            while let Some(time) = self.ticks.pop(self.monitor.next_due()) {
                self.monitor.handle(&Record::tick(time), &mut out);
            }
            for (bus, frame) in &frames {
                self.monitor.handle(&Record::frame(moment.time, *bus, frame), &mut out);
            }
            self.events.append(&mut out.events);
            out.clear();
        }
    }

    fn restart(&mut self) {
        let stored = self.monitor.snapshot();
        self.monitor = Monitor::new(self.config.clone());
        self.monitor.restore(stored, Downtime::Seconds(1.0)).unwrap();
    }

    fn raised(&self, rule: Rule) -> Vec<Option<u16>> {
        let raised = self.events.iter().filter_map(|event| match event.kind {
            EventKind::Alarm { rule: of, cell, change: Change::Raised, .. } if of == rule => {
                Some(cell.map(|cell| cell.0))
            }
            _ => None,
        });
        let mut cells: Vec<_> = raised.collect();
        cells.sort_unstable();
        cells
    }

    fn state(&self, rule: Rule, cell: u16) -> AlarmState {
        self.monitor.alarms().get(rule, Some(CellIndex(cell))).unwrap().state
    }

    fn value(&self, rule: Rule, cell: u16) -> Option<f64> {
        self.monitor.alarms().get(rule, Some(CellIndex(cell))).unwrap().value
    }
}

#[test]
fn leak_alarm_names_its_cell_and_survives_restart() {
    let mut pack = FaultyPack::new("leak:7:2mA@day1");
    pack.run_to(6.0);
    assert_eq!(pack.raised(Rule::CellLeak), [Some(6)]);
    assert_eq!((pack.raised(Rule::ConnectionResistance), pack.raised(Rule::ChannelFaulty)), (vec![], vec![]));
    let (leak, truth) = (pack.value(Rule::CellLeak, 6).unwrap(), 24.0 * 0.002 / 2.6);
    assert!((leak / truth - 1.0).abs() < 0.3, "leak {leak} a day, truth {truth}");
    let before = pack.monitor.alarms().get(Rule::CellLeak, Some(CellIndex(6))).unwrap();
    pack.restart();
    pack.events.clear();
    pack.run_to(6.0 + 0.02);
    let after = pack.monitor.alarms().get(Rule::CellLeak, Some(CellIndex(6))).unwrap();
    assert_eq!((before.state, after.state, after.occurrences), (AlarmState::Active, AlarmState::Active, 1));
    assert_eq!(pack.raised(Rule::CellLeak), []);
}

#[test]
fn loose_contact_raises_alarm_for_its_cell() {
    let mut pack = FaultyPack::new("contact:3:+50%@day1");
    pack.run_to(4.0);
    assert_eq!(pack.raised(Rule::ConnectionResistance), [Some(2)]);
    assert_eq!(pack.raised(Rule::ChannelFaulty), []);
    // A loose contact of a cell may first look like a loss of the cell's charge.
    assert!(pack.raised(Rule::CellLeak).iter().all(|cell| *cell == Some(2)));
    assert_ne!(pack.state(Rule::CellLeak, 2), AlarmState::Active);
    let contact = pack.value(Rule::ConnectionResistance, 2).unwrap();
    assert!((contact - 0.5).abs() < 0.15, "{contact}");
}

#[test]
fn healthy_cells_are_judged_without_alarm() {
    let mut pack = FaultyPack::new("");
    pack.run_to(6.0);
    for rule in [Rule::CellLeak, Rule::ConnectionResistance, Rule::ChannelFaulty] {
        assert_eq!(pack.raised(rule), []);
        let unknown: Vec<_> = (0..CELLS).filter(|cell| pack.state(rule, *cell) != AlarmState::Inactive).collect();
        assert_eq!(unknown, [0_u16; 0], "{rule:?}");
    }
}

#[test]
fn stuck_channel_raises_only_channel_faulty() {
    let mut pack = FaultyPack::new("voltage-stuck:5@30h");
    pack.run_to(4.0);
    assert_eq!(pack.raised(Rule::ChannelFaulty), [Some(4)]);
    for rule in OF_CELL {
        assert_eq!(pack.raised(rule), [], "{rule:?}");
        assert_eq!(pack.state(rule, 4), AlarmState::Unknown, "{rule:?}");
    }
    assert_ne!(pack.state(Rule::CapacityLow, 3), AlarmState::Unknown, "the other cells must still be judged");
    assert_eq!(pack.raised(Rule::SocLow), []);
}

#[test]
fn faulty_channel_suppresses_alarm_until_new_pack() {
    let mut pack = FaultyPack::new("contact:5:+50%@6h voltage-offset:5:60mV@day3");
    pack.run_to(6.0);
    assert_eq!(pack.raised(Rule::ConnectionResistance), [Some(4)]);
    assert_eq!(pack.raised(Rule::ChannelFaulty), [Some(4)]);
    assert_eq!(pack.state(Rule::ConnectionResistance, 4), AlarmState::Suppressed);
    pack.restart();
    pack.run_to(6.05);
    assert_eq!(pack.state(Rule::ConnectionResistance, 4), AlarmState::Suppressed);
    assert_eq!(pack.state(Rule::ChannelFaulty, 4), AlarmState::Active);
    let mut out = Outputs::default();
    pack.monitor.handle(&Record::command(pack.monitor.now(), Command::PackReplaced), &mut out);
    assert_eq!(pack.state(Rule::ConnectionResistance, 4), AlarmState::Unknown);
    assert_eq!(
        pack.state(Rule::ChannelFaulty, 4),
        AlarmState::Suppressed,
        "alarms must stay suppressed until the first row of the new pack"
    );
}

fn found(pack: &FaultyPack) -> Vec<(CellFaultKind, Option<(CellIndex, CellIndex)>)> {
    pack.monitor.findings().iter().map(|finding| (finding.kind, finding.cells)).collect()
}

/// The channel of a healthy cell reads too high, so the BMS bleeds this cell below the other cells.
#[test]
fn bled_cells_raise_no_leak() {
    use SensorQuality::{Good, Poor};
    for (seed, quality) in [(1, Good), (3, Good), (7, Poor), (8, Poor)] {
        let mut pack = FaultyPack::balanced(seed, quality);
        pack.run_to(14.0);
        let is_leak =
            |event: &&Event| matches!(event.kind, EventKind::Finding(CellFault { kind: CellFaultKind::Leak, .. }));
        assert_eq!(pack.events.iter().filter(is_leak).collect::<Vec<_>>(), Vec::<&Event>::new(), "{quality:?} {seed}");
    }
}

#[test]
fn leak_is_found_despite_balancing() {
    let mut settings = settings();
    settings.pack.spread.soc = 0.005;
    let mut pack = FaultyPack::simulated(config(), settings, Wiring::single(), "leak:7:20mA@day3");
    pack.sim = pack.sim.with_balancing(Balancing::usual(2.6));
    pack.run_to(5.0);
    assert!(found(&pack).contains(&(CellFaultKind::Leak, Some((CellIndex(6), CellIndex(6))))), "{:?}", found(&pack));
}

/// Findings of 14 days in a pack whose BMS balances with `bleed` times the usual current. `configure` changes what the
/// monitor is told about the balancing.
fn found_in_balanced(
    fault: &str,
    bleed: f64,
    configure: impl Fn(MonitorConfig) -> MonitorConfig,
) -> Vec<(CellFaultKind, Option<(CellIndex, CellIndex)>)> {
    let keys = "[input.balancing]\nsignal = \"Balancing.Bleed{n}\"\nbleed_a = 0.0026\nmax_age_s = 90.0\nonly_while_sent = true\n[output]\n";
    let config = configure(load(&PACK.replace("[output]\n", keys), "Temperature"));
    let mut settings = settings();
    settings.pack.spread.soc = 0.005;
    let mut pack = FaultyPack::simulated(config, settings, Wiring::single(), fault);
    let usual = Balancing::usual(2.6);
    pack.sim = pack.sim.with_balancing(Balancing { bleed_a: bleed * usual.bleed_a, ..usual }).with_balancing_bits();
    pack.run_to(14.0);
    let finding = |event: &Event| match event.kind {
        EventKind::Finding(CellFault { kind, cells, .. }) => Some((kind, cells)),
        _ => None,
    };
    let mut found: Vec<_> = pack.events.iter().filter_map(finding).collect();
    found.sort();
    found
}

fn with_balancing(change: fn(BalancingConfig) -> BalancingConfig) -> impl Fn(MonitorConfig) -> MonitorConfig {
    move |config| MonitorConfig { balancing: config.balancing.map(change), ..config }
}

/// Cells 7 and 3 leak; the leak of cell 7 is larger. Without the balancing bits, only cell 7 is found, because it is
/// the lowest cell, which a BMS never bleeds. The BMS may have bled cell 3.
#[test]
fn balancing_bits_reveal_leaks_of_other_cells() {
    let leak_of = |cell| (CellFaultKind::Leak, Some((CellIndex(cell), CellIndex(cell))));
    let faults = "leak:7:0.4mA@day3 leak:3:0.2mA@day3";
    assert_eq!(found_in_balanced(faults, 1.0, |config| config), [leak_of(2), leak_of(6)]);
    let without_bits = |config| MonitorConfig { balancing: None, ..config };
    assert_eq!(found_in_balanced(faults, 1.0, without_bits), [leak_of(6)]);
}

/// While a cell's balancing bit is missing or unknown, bleeding may explain the cell's loss.
#[test]
fn loss_explained_by_bleeding_raises_no_leak() {
    let unseen = with_balancing(|it| BalancingConfig { is_only_while_sent: false, max_age_s: 10.0, ..it });
    assert_eq!(found_in_balanced("", 1.0, unseen), []);
    assert_eq!(found_in_balanced("", 1.2, |config| config), [], "a bleed current 20 % above `bleed_a` is not a leak");
    let without_a_bit = |mut config: MonitorConfig| {
        let is_kept = |binding: &Binding| binding.channel != Channel::Balancing(CellIndex(4));
        config.input = InputMap::new(config.input.bindings().iter().filter(|it| is_kept(it)).cloned().collect());
        config
    };
    assert_eq!(found_in_balanced("", 1.0, without_a_bit), []);
}

/// During a downtime the monitor receives no balancing bits, so a cell may have been bled.
#[test]
fn downtime_reduces_knowledge_of_leak() {
    let leak_std = |bleed_a: f64| {
        let keys =
            "[input.balancing]\nsignal = \"Balancing.Bleed{n}\"\nbleed_a = 0.0026\nonly_while_sent = true\n[output]\n";
        let change = |it: BalancingConfig| BalancingConfig { bleed_a, ..it };
        let config = load(&PACK.replace("[output]\n", keys), "Temperature");
        let config = MonitorConfig { balancing: config.balancing.map(change), ..config };
        let mut pack = FaultyPack::simulated(config, settings(), Wiring::single(), "");
        pack.sim = pack.sim.with_balancing_bits();
        pack.run_to(0.01);
        // Stop the daemon during the first drive. Start it again in the second drive, after the vehicle was parked.
        let stored = pack.monitor.snapshot();
        while pack.sim.advance().unwrap().time < Timestamp::from_secs(9.0 * 3600.0) {}
        pack.monitor = Monitor::new(pack.config.clone());
        pack.monitor.restore(stored, Downtime::AsStamped).unwrap();
        pack.run_to(0.45);
        let stds = (0..CELLS).map(|cell| pack.monitor.difference(CellIndex(cell)).unwrap().state(LEAK).std());
        stds.sum::<f64>() / f64::from(CELLS)
    };
    let (bled, never) = (leak_std(0.0026), leak_std(1e-9));
    assert!(bled > 1.2 * never, "standard deviation {bled} with bleeding, {never} without");
}

#[test]
fn frozen_current_is_found_once() {
    let mut pack = FaultyPack::new("current-stuck@24h");
    pack.run_to(1.03);
    assert_eq!(found(&pack), [(CellFaultKind::CurrentFrozen, None)]);
    pack.restart();
    pack.run_to(1.04);
    let is_it =
        |event: &&Event| matches!(event.kind, EventKind::Finding(CellFault { kind: CellFaultKind::CurrentFrozen, .. }));
    assert_eq!(pack.events.iter().filter(is_it).count(), 1);
}

/// If the offsets of the sensors are several kelvins, the median of three readings may come from the detached sensor.
#[test]
fn detached_temperature_sensor_is_found_despite_offsets() {
    let mut settings = settings();
    settings.sensors = Sensors::of_quality(SensorQuality::Poor);
    let temperature_at = [0, 4, 8].map(|cell| Some(CellIndex(cell))).to_vec();
    for sensor in 1..=3 {
        let wiring = Wiring { strings: 1, temperature_at: temperature_at.clone() };
        let fault = format!("temperature-stuck:{sensor}@day1");
        let mut pack = FaultyPack::simulated(config_with_three_sensors(), settings, wiring, &fault);
        pack.run_to(12.0);
        let first = 4 * (sensor - 1);
        let detached = (CellFaultKind::TemperatureSensor, Some((CellIndex(first), CellIndex(first + 3))));
        assert!(found(&pack).contains(&detached), "sensor {sensor}: {:?}", found(&pack));
    }
}

#[test]
fn swapped_channels_are_found_and_keep_their_cells() {
    for (fault, other) in [("weak:3:-12% swap:3:8@day3", 7), ("weak:3:-12% swap:3:4@day3", 3)] {
        let mut pack = FaultyPack::of(MonitorConfig { is_balanced: false, ..config() }, fault);
        pack.run_to(1.9);
        assert_eq!(found(&pack), [(CellFaultKind::WeakCell, Some((CellIndex(2), CellIndex(2))))]);
        pack.run_to(6.0);
        let swapped = (CellFaultKind::SwappedChannels, Some((CellIndex(2), CellIndex(other))));
        assert!(found(&pack).contains(&swapped), "{fault}: {:?}", found(&pack));
    }
}

#[test]
fn replaced_module_gives_one_finding() {
    let mut pack = FaultyPack::new("module:5-8:+15%@day2");
    pack.run_to(6.0);
    assert_eq!(found(&pack), [(CellFaultKind::Module, Some((CellIndex(4), CellIndex(7))))]);
}

#[test]
fn contact_and_aged_cell_are_distinguished() {
    for (fault, kind) in
        [("contact:3:+40%", CellFaultKind::Contact), ("resistance:3:+30%", CellFaultKind::HighResistance)]
    {
        let mut pack = FaultyPack::new(fault);
        pack.run_to(3.0);
        assert_eq!(found(&pack), [(kind, Some((CellIndex(2), CellIndex(2))))], "{fault}");
    }
}
