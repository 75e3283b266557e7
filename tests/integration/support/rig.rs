//! A two-cell pack with hand-made frames, shared by the tests of alarms and restarts.
#![allow(dead_code, reason = "some helpers serve only one set of features")]

use std::collections::BTreeSet;

use crate::support::config_texts;
use packwatch::alarm::{Change, Rule};
use packwatch::can::e2e::{Profile, Protection};
use packwatch::can::encode::InputEncoder;
use packwatch::can::{CanId, Frame};
use packwatch::config::Config;
use packwatch::monitor::{
    Downtime, Event, EventKind, Monitor, MonitorConfig, Outputs, ReconfigureError, Reconfigured, Record, Snapshot,
};
use packwatch::quantity::{BusIndex, CellIndex, Channel, SensorIndex, Timestamp};

pub(crate) const DBC: &str = r#"VERSION ""
NS_ :
BS_:
BU_: A
BO_ 256 Status: 8 A
 SG_ Current : 0|16@1- (0.01,0) [-300|300] "A" A
 SG_ Temperature1 : 16|8@1+ (1,-40) [-40|200] "degC" A
 SG_ Temperature2 : 24|8@1+ (1,-40) [-40|200] "degC" A
 SG_ Soc : 32|16@1+ (0.01,0) [0|120] "%" A
 SG_ Contactor : 48|4@1+ (1,0) [0|14] "" A
BO_ 272 Cells: 8 A
 SG_ Voltage1 : 0|16@1+ (0.0001,0) [0|5] "V" A
 SG_ Voltage2 : 16|16@1+ (0.0001,0) [0|5] "V" A
 SG_ Serial : 32|32@1+ (1,0) [0|0] "" A
"#;

pub(crate) const PACK: &str = r#"
[pack]
cells = 2
cell_model = "cells/example_nmc_2600.toml"
[[interface]]
name = "can0"
[input]
dbc = ["pack.dbc"]
[input.current]
signal = "Status.Current"
positive = "discharge"
[input.cell_voltage]
signal = "Cells.Voltage{n}"
[[input.temperature]]
signal = "Status.Temperature1"
cells = "1"
[[input.temperature]]
signal = "Status.Temperature2"
cells = "2"
[input.reported_soc]
signal = "Status.Soc"
[limits.temperature]
max_age_s = 2.0
[transition]
min_duration_s = 5.0
[output]
[output.alarm]
period_ms = 500
[commands]
enabled = true
e2e = "1A"
data_id = 0x0321
"#;

pub(crate) fn load(alarms: &str) -> Config {
    config_texts::load(&format!("{PACK}{alarms}"), DBC)
}

/// An alarm frame, decoded by hand according to the shipped DBC.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Wire {
    pub(crate) rule: u8,
    pub(crate) state: u8,
    pub(crate) test: bool,
    pub(crate) cell: u16,
    pub(crate) value: u16,
    pub(crate) acknowledged: bool,
}

/// Raw value in an alarm frame that means "not available".
pub(crate) const NO_VALUE: u16 = 0x1FFF;
/// Cell in an alarm frame about the whole pack.
pub(crate) const WHOLE_PACK: u16 = 0x7FF;

pub(crate) struct Rig {
    pub(crate) config: MonitorConfig,
    pub(crate) monitor: Monitor,
    pub(crate) encoder: InputEncoder,
    pub(crate) out: Outputs,
    pub(crate) events: Vec<Event>,
    pub(crate) frames: Vec<Frame>,
    /// Identifiers of the sent frames, each with whether the frame announces a change.
    pub(crate) sent: BTreeSet<(CanId, bool)>,
    pub(crate) deci: i64,
    pub(crate) commands_sent: u8,
    /// Content of the next frames; `None`: no frame is sent.
    pub(crate) current_a: Option<f64>,
    pub(crate) voltages_v: [Option<f64>; 2],
    pub(crate) temperatures_c: [Option<f64>; 2],
    pub(crate) reported_soc: Option<f64>,
    pub(crate) identity: Option<f64>,
    pub(crate) contactor: Option<f64>,
}

impl Rig {
    pub(crate) fn new(alarms: &str) -> Self {
        Self::with(load(alarms).monitor)
    }

    pub(crate) fn with(config: MonitorConfig) -> Self {
        Self {
            encoder: InputEncoder::new(&config.input),
            monitor: Monitor::new(config.clone()),
            config,
            out: Outputs::default(),
            events: Vec::new(),
            frames: Vec::new(),
            sent: BTreeSet::new(),
            deci: 0,
            commands_sent: 0,
            current_a: Some(0.0),
            voltages_v: [Some(3.7), Some(3.7)],
            temperatures_c: [Some(25.0), Some(25.0)],
            reported_soc: Some(0.5),
            identity: None,
            contactor: None,
        }
    }

    pub(crate) fn now(&self) -> Timestamp {
        Timestamp::from_nanos(self.deci * 100_000_000)
    }

    pub(crate) fn give(&mut self, record: Record) {
        self.monitor.handle(&record, &mut self.out);
        self.collect();
    }

    /// Advances by 0.1 s without frames.
    pub(crate) fn tick(&mut self) {
        self.deci += 1;
        let time = self.now();
        self.give(Record::tick(time));
    }

    fn collect(&mut self) {
        self.events.append(&mut self.out.events);
        self.sent.extend(self.out.frames.iter().map(|sent| (sent.frame.id(), sent.announces)));
        self.frames.extend(self.out.frames.drain(..).map(|sent| sent.frame));
    }

    /// Sets both sensors to `temperature_c` and advances by `seconds`.
    pub(crate) fn heat(&mut self, temperature_c: f64, seconds: i64) {
        self.temperatures_c = [Some(temperature_c); 2];
        self.seconds(seconds);
    }

    /// Advances with frames and ticks, ten of each per second.
    pub(crate) fn seconds(&mut self, seconds: i64) {
        (0..10 * seconds).for_each(|_| self.tick_with_frames());
    }

    /// Advances by 0.1 s with frames.
    pub(crate) fn tick_with_frames(&mut self) {
        {
            self.deci += 1;
            let values = [
                (Channel::Current, self.current_a),
                (Channel::Temperature(SensorIndex(0)), self.temperatures_c[0]),
                (Channel::Temperature(SensorIndex(1)), self.temperatures_c[1]),
                (Channel::ReportedSoc, self.reported_soc),
                (Channel::PackIdentity, self.identity),
                (Channel::Contactor, self.contactor),
                (Channel::CellVoltage(CellIndex(0)), self.voltages_v[0]),
                (Channel::CellVoltage(CellIndex(1)), self.voltages_v[1]),
            ];
            let mut made = Vec::new();
            self.encoder.encode(&values, &mut made);
            let time = self.now();
            for (bus, frame) in &made {
                self.give(Record::frame(time, *bus, frame));
            }
            self.give(Record::tick(time));
        }
    }

    /// Reloads an edited configuration while the monitor runs.
    pub(crate) fn reload(&mut self, edit: impl FnOnce(&mut MonitorConfig)) -> Result<Reconfigured, ReconfigureError> {
        let (mut config, now) = (self.config.clone(), self.now());
        edit(&mut config);
        let result = self.monitor.reconfigure(config.clone(), now, &mut self.out);
        self.collect();
        if result.is_ok() {
            self.config = config;
        }
        result
    }

    /// Ends the process and restarts it after `away`. If the downtime is known, advances the clock by it.
    pub(crate) fn restart(&mut self, away: Downtime) {
        let text = serde_json::to_string(&self.monitor.snapshot()).unwrap();
        let snapshot: Snapshot = serde_json::from_str(&text).unwrap();
        self.monitor = Monitor::new(self.config.clone());
        self.monitor.restore(snapshot, away).unwrap();
        if let Downtime::Seconds(seconds) = away {
            self.deci += Timestamp::from_secs(seconds).nanos() / 100_000_000;
        }
    }

    /// Discharges deeply enough to learn every cell's capacity.
    pub(crate) fn discharge(&mut self) {
        // Voltage drop at 5 A. If the current stepped without the voltages, the monitor would distrust the current.
        const DROP_V: f64 = 0.08;
        self.seconds(20);
        self.current_a = Some(5.0);
        for step in 0..60 {
            self.voltages_v = [Some(3.65 - DROP_V - 0.006 * f64::from(step)); 2];
            self.seconds(10);
        }
        self.current_a = Some(0.0);
        self.voltages_v = self.voltages_v.map(|voltage_v| voltage_v.map(|voltage_v| voltage_v + DROP_V));
        self.seconds(30);
    }

    pub(crate) fn changes(&self, rule: Rule) -> Vec<Change> {
        let of = |event: &Event| match event.kind {
            EventKind::Alarm { rule: found, change, .. } if found == rule => Some(change),
            _ => None,
        };
        self.events.iter().filter_map(of).collect()
    }

    pub(crate) fn wire(&self) -> Vec<Wire> {
        let alarms = self.frames.iter().filter(|frame| frame.id() == CanId::Standard(0x6B2));
        let of = |frame: &Frame| {
            let bits = u64::from_le_bytes(frame.data().try_into().unwrap());
            let field = |start: u32, length: u32| u16::try_from(bits >> start & ((1 << length) - 1)).unwrap();
            Wire {
                rule: u8::try_from(field(16, 5)).unwrap(),
                state: u8::try_from(field(21, 3)).unwrap(),
                test: field(26, 1) == 1,
                cell: field(27, 11),
                value: field(38, 13),
                acknowledged: field(63, 1) == 1,
            }
        };
        alarms.map(of).collect()
    }

    pub(crate) fn last_wire(&self, rule: Rule) -> Wire {
        *self.wire().iter().rev().find(|wire| wire.rule == rule as u8).unwrap_or_else(|| panic!("no frame of {rule:?}"))
    }

    pub(crate) fn unknown_rules(&self) -> u8 {
        let status = self.frames.iter().rev().find(|frame| frame.id() == CanId::Standard(0x6B0)).unwrap();
        status.data()[7] >> 6
    }

    pub(crate) fn command(&mut self, code: u64, rule: u64, cell: u64) {
        let counter = self.commands_sent % 15;
        self.commands_sent += 1;
        let frame = command_frame(code, rule, cell, counter);
        let time = self.now();
        self.give(Record::frame(time, BusIndex(0), &frame));
    }
}

pub(crate) fn command_frame(code: u64, rule: u64, cell: u64, counter: u8) -> Frame {
    let mut payload = (code << 16 | rule << 20 | cell << 27).to_le_bytes();
    Protection { profile: Profile::P01A, data_id: 0x0321 }.protect(&mut payload, counter).unwrap();
    Frame::classic(CanId::Standard(1715), &payload).unwrap()
}

/// A rig after a discharge deep enough to learn every cell's capacity, with all capacities below the threshold.
pub(crate) fn learned() -> Rig {
    let mut rig = Rig::new("[[alarm]]\nrule = \"capacity_low\"\nwarning = 5.0\n[estimator]\ngate_sigma = 1000\n");
    rig.discharge();
    assert_eq!(rig.changes(Rule::CapacityLow), [Change::Raised, Change::Raised], "both cells");
    rig
}
