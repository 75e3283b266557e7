//! Tests internal short circuits of a cell. Prints the table for the manual's page "Thermal event".

use std::fmt::Write as _;

use packwatch::alarm::{AlarmState, Rule};
use packwatch::can::decode::Channel;
use packwatch::can::encode::InputEncoder;
use packwatch::can::{CanId, Frame};
use packwatch::monitor::{Command, EventKind, Monitor, MonitorConfig, Outputs, Record, RecordKind};
use packwatch::quantity::{CellIndex, SensorIndex, Timestamp};

use crate::support::config_texts;

const CELLS: u16 = 12;
const SENSORS: u16 = 4;
const SHORTED: CellIndex = CellIndex(4);

const PACK: &str = r#"
[pack]
cells = 12
chemistry = "nmc-graphite"
rated_capacity_ah = 50.0
[[interface]]
name = "can0"
[input]
dbc = ["pack.dbc"]
[input.current]
signal = "Status.Current"
positive = "discharge"
[input.cell_voltage]
signal = "Cells{m}.Voltage{n}"
[limits.temperature]
max_c = 80.0
max_rate_c_per_s = 0.5
[limits.voltage]
max_rate_v_per_s = 0.1
[output]
[output.alarm]
id = 0x6B2
[[alarm]]
rule = "thermal_event"
severe = 0.5
"#;

fn config() -> MonitorConfig {
    let mut dbc = String::from("VERSION \"\"\nNS_ :\nBS_:\nBU_: A\nBO_ 256 Status: 8 A\n");
    dbc += " SG_ Current : 0|16@1- (0.1,0) [-3000|3000] \"A\" A\n";
    let mut pack = PACK.to_owned();
    for sensor in 0..SENSORS {
        let bit = 16 + 8 * sensor;
        writeln!(dbc, " SG_ Temperature{} : {bit}|8@1+ (1,-40) [-40|215] \"degC\" A", sensor + 1).unwrap();
        let (first, last) = (3 * sensor + 1, 3 * sensor + 3);
        let signal = format!("signal = \"Status.Temperature{}\"", sensor + 1);
        writeln!(pack, "[[input.temperature]]\n{signal}\ncells = \"{first}-{last}\"").unwrap();
    }
    for message in 0..CELLS / 4 {
        writeln!(dbc, "BO_ {} Cells{message}: 8 A", 512 + message).unwrap();
        for cell in 0..4 {
            let (name, bit) = (4 * message + cell + 1, 16 * cell);
            writeln!(dbc, " SG_ Voltage{name} : {bit}|16@1+ (0.001,0) [0|6.5] \"V\" A").unwrap();
        }
    }
    config_texts::load(&pack, &dbc).monitor
}

/// A pack at rest. From [`SHORT_S`] on, one cell has an internal short circuit of `ohm`.
struct Pack {
    ohm: f64,
    cell_c: f64,
    sensor_c: f64,
    lost_ah: f64,
}

const SHORT_S: u32 = 300;
/// Resistance (ohm), heat capacity (J/K) and open-circuit voltage (V) of a large cell, and the time constant of its
/// temperature sensor (s).
const CELL_OHM: f64 = 0.001;
const CELL_J_PER_K: f64 = 1000.0;
const OCV_V: f64 = 3.7;
const SENSOR_DELAY_S: f64 = 20.0;

impl Pack {
    /// Advances by one second. Returns the voltage of the shorted cell (V).
    fn step(&mut self) -> f64 {
        let short_a = OCV_V / (self.ohm + CELL_OHM);
        self.cell_c += OCV_V * short_a / CELL_J_PER_K;
        self.sensor_c += (self.cell_c - self.sensor_c) / SENSOR_DELAY_S;
        self.lost_ah += short_a / 3600.0;
        (OCV_V - 0.012 * self.lost_ah).max(0.0) - short_a * CELL_OHM
    }
}

/// The first alarm: time after the short circuit (s), cell, value, and temperature of the cell (degrees C).
type Alarm = (f64, CellIndex, f64, f64);

/// Passes the frames of a pack with a short circuit to the monitor; the clock starts at `begin_s`. Returns the first
/// new alarm in the ten minutes after the short circuit.
fn first_alarm(ohm: f64, begin_s: f64, monitor: &mut Monitor) -> Option<Alarm> {
    let encoder = InputEncoder::new(&config().input);
    let mut pack = Pack { ohm, cell_c: 25.0, sensor_c: 25.0, lost_ah: 0.0 };
    let (mut out, mut frames) = (Outputs::default(), Vec::new());
    for second in 0..SHORT_S + 600 {
        let shorted_v = if second >= SHORT_S { pack.step() } else { OCV_V };
        let volts = |cell: u16| if cell == SHORTED.0 { shorted_v } else { OCV_V };
        let celsius = |sensor: u16| if sensor == SHORTED.0 / 3 { pack.sensor_c } else { 25.0 };
        let mut values = vec![(Channel::Current, Some(0.0))];
        values.extend((0..SENSORS).map(|it| (Channel::Temperature(SensorIndex(it)), Some(celsius(it).min(214.0)))));
        values.extend((0..CELLS).map(|it| (Channel::CellVoltage(CellIndex(it)), Some(volts(it)))));
        frames.clear();
        encoder.encode(&values, &mut frames);
        let time = Timestamp::from_secs(begin_s + f64::from(second));
        for (bus, frame) in &frames {
            monitor.handle(&Record { time, kind: RecordKind::Frame { bus: *bus, frame: *frame } }, &mut out);
        }
        let raised = out.events.iter().find_map(|event| match event.kind {
            EventKind::Alarm { rule: Rule::ThermalEvent, cell, value, active: true, .. } => Some((cell, value)),
            _ => None,
        });
        if let Some((cell, value)) = raised {
            let is_alarm = |frame: &Frame| {
                frame.id() == CanId::Standard(0x6B2) && frame.data()[2] & 0x1F == Rule::ThermalEvent as u8
            };
            let sent = out.frames.iter().find(|sent| is_alarm(&sent.frame));
            assert!(sent.is_some_and(|sent| sent.time == time), "the alarm frame leaves with the sample: {sent:?}");
            return Some((f64::from(second - SHORT_S), cell.unwrap(), value.unwrap(), pack.cell_c));
        }
        out.clear();
        for tick in 1..10 {
            let time = time.plus_secs(0.1 * f64::from(tick));
            monitor.handle(&Record { time, kind: RecordKind::Tick }, &mut out);
        }
        out.clear();
    }
    None
}

#[test]
fn short_circuit_raises_alarm_of_its_cell() {
    println!("| short circuit (mohm) | alarm after (s) | evidence | temperature of the cell (degrees C) |");
    // Resistance of the short circuit (ohm), latest time of the alarm (s), and value of the alarm. A short circuit of
    // 0.5 ohm must raise no thermal event: it discharges 15 % in an hour, and the rule `cell_leak` detects it.
    let wanted = [(0.001, 4.0, 1.0), (0.003, 10.0, 1.0), (0.005, 25.0, 2.0), (0.02, 60.0, 2.0), (0.05, 120.0, 2.0)];
    for (ohm, latest_s, evidence) in wanted {
        let (after_s, cell, value, cell_c) = first_alarm(ohm, 0.0, &mut Monitor::new(config())).expect("an alarm");
        println!("| {} | {after_s} | {value} | {cell_c:.0} |", 1000.0 * ohm);
        assert_eq!(cell, SHORTED, "{ohm}");
        assert!(after_s <= latest_s && value == evidence, "{ohm}: {after_s} s, {value}");
    }
    assert_eq!(first_alarm(0.5, 0.0, &mut Monitor::new(config())), None);
}

#[test]
fn alarm_stays_until_person_clears_it() {
    let mut monitor = Monitor::new(config());
    let (after_s, cell, ..) = first_alarm(0.001, 0.0, &mut monitor).unwrap();
    let state = |monitor: &Monitor| monitor.alarms().raised().next().map(|alarm| alarm.state);
    assert_eq!(state(&monitor), Some(AlarmState::Active));
    let mut out = Outputs::default();
    let mut time = Timestamp::from_secs(f64::from(SHORT_S) + after_s);
    for _ in 0..3600 {
        time = time.plus_secs(0.1);
        monitor.handle(&Record { time, kind: RecordKind::Tick }, &mut out);
        assert!(state(&monitor).is_some());
    }
    let snapshot = monitor.snapshot().for_restart();
    let mut restarted = Monitor::new(config());
    restarted.restore(snapshot, packwatch::monitor::Downtime::Seconds(5.0)).unwrap();
    restarted.handle(&Record { time, kind: RecordKind::Tick }, &mut out);
    assert!(state(&restarted).is_some());
    // Good readings end the evidence, but the alarm stays latched.
    assert_eq!(first_alarm(f64::INFINITY, f64::from(SHORT_S) + 400.0, &mut restarted), None);
    assert_eq!(state(&restarted), Some(AlarmState::Latched), "{cell:?}");
    let clear = Command::Clear(packwatch::alarm::Selector::default());
    let after = Timestamp::from_secs(f64::from(2 * SHORT_S + 1000));
    restarted.handle(&Record::command(after, clear), &mut out);
    assert_eq!(state(&restarted), None);
}
