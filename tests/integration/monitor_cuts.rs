//! Tests that a monitor restored from a snapshot continues with byte-identical frames, events and estimates.
//!
//! A pack of three cells runs through random drives, faults, gaps, sleep and backward clock steps. It uses all kinds of
//! inputs, alarms and commands. One monitor runs without interruption. A second monitor receives the same inputs. After
//! random inputs, it is replaced by a monitor that is restored from its snapshot (through JSON). Each replacement is a
//! cut.
//!
//! Two more packs run in the same way: one learns its cell model, the other authenticates its frames. Authenticated
//! frames are compared without the freshness because it restarts by design.
//!
//! `PACKWATCH_CUTS` sets the number of cuts.

use packwatch::alarm::{Rule, Selector};
use packwatch::can::e2e::{Profile, Protection};
use packwatch::can::encode::InputEncoder;
use packwatch::can::{CanId, Frame};
use packwatch::monitor::{
    BusEvent, Command, Downtime, Monitor, MonitorConfig, Outputs, Record, RecordKind, Snapshot, Transmit,
};
use packwatch::quantity::{BusIndex, CellIndex, Channel, SensorIndex, Timestamp};

use crate::support::config_texts;
use crate::support::dice::Dice;
use crate::support::rig::{PACK, command_frame};

/// The signals of `support::rig`, with space for a protection header in the current's message.
const DBC: &str = r#"VERSION ""
NS_ :
BS_:
BU_: A
BO_ 256 Status: 8 A
 SG_ Current : 16|16@1- (0.01,0) [-300|300] "A" A
 SG_ Temperature1 : 32|8@1+ (1,-40) [-40|200] "degC" A
 SG_ Temperature2 : 40|8@1+ (1,-40) [-40|200] "degC" A
 SG_ Contactor : 48|4@1+ (1,0) [0|14] "" A
BO_ 257 Pack: 8 A
 SG_ Soc : 0|16@1+ (0.01,0) [0|120] "%" A
BO_ 272 Cells: 8 A
 SG_ Voltage1 : 0|16@1+ (0.0001,0) [0|5] "V" A
 SG_ Voltage2 : 16|16@1+ (0.0001,0) [0|5] "V" A
 SG_ Voltage3 : 32|16@1+ (0.0001,0) [0|5] "V" A
 SG_ Serial : 48|16@1+ (1,0) [0|0] "" A
"#;

const MORE: &str = r#"
[input.contactor]
signal = "Status.Contactor"
open = [0]
[input.pack_identity]
signal = "Cells.Serial"
accept_unprotected = true
[[input.protected]]
message = "Status"
profile = "1A"
data_id = 0x0123
[[input.diagnostic]]
name = "Bms"
request = 0x79B
response = 0x7BB
service = 0x21
identifier = 0x01
parked_every_s = 3
drive_every_s = 2
charge_every_s = 2
signals = [{ name = "Soh", bit = 0, length = 16, factor = 0.01, unit = "%", minimum = 0, maximum = 100 }]
[input.reported_soh]
signal = "Bms.Soh"
[poll]
enabled = true
[j1939]
address = 249
identity_number = 1234
manufacturer_code = 2047
[[alarm]]
rule = "capacity_low"
warning = 5.0
[[alarm]]
rule = "estimate_untrusted"
warning = 4
[[alarm]]
rule = "input_missing"
warning = 1
severe = 5
[[alarm]]
rule = "input_implausible"
warning = 0.3
debounce_s = 2
[[alarm]]
rule = "temperature_high"
warning = { set = 50, clear = 45 }
severe = 60
debounce_s = 1
latched = true
[[alarm]]
rule = "soc_low"
info = 0.5
warning = 0.2
[[alarm]]
rule = "cell_imbalance"
warning = 0.05
[[alarm]]
rule = "bms_disagrees"
warning = 0.1
[[alarm]]
rule = "bus_fault"
warning = 1
[[alarm]]
rule = "store_failed"
warning = 10
[[alarm]]
rule = "recharge_period_low"
info = 1000
[[alarm]]
rule = "cell_leak"
warning = 0.001
[[alarm]]
rule = "connection_resistance"
warning = 0.2
[[alarm]]
rule = "channel_faulty"
warning = 0.5
[[alarm]]
rule = "thermal_event"
severe = 0.5
"#;

fn is_command(record: &Record) -> bool {
    matches!(record.kind, RecordKind::Frame { frame, .. } if frame.id() == CanId::Standard(1715))
}

fn configs() -> [MonitorConfig; 3] {
    // packwatch compares cells with each other only if the pack has at least three.
    let pack = PACK
        .replace("Status.Soc", "Pack.Soc")
        .replace("cells = 2\n", "cells = 3\n")
        .replace("cells = \"2\"", "cells = \"2-3\"");
    let label = "chemistry = \"nmc811-graphite\"\nrated_capacity_ah = 2.6";
    let learning = pack.replace("cell_model = \"cells/example_nmc_2600.toml\"", label);
    let secoc = "fd = true\nsecoc = \"fd\"\ndata_id = ";
    let secured = pack
        .replace("name = \"can0\"\n", "name = \"can0\"\nfd = true\n")
        .replace("e2e = \"1A\"\ndata_id = 0x0321\n", "secoc = \"1\"\ndata_id = 0x0321\n")
        .replace("[output.alarm]\n", &format!("[output.status]\n{secoc}0x0323\n[output.alarm]\n{secoc}0x0324\n"));
    let tables = "[output.freshness]\ndata_id = 0x0322\n[authentication]\nkey_file = \"can.key\"\n";
    assert!(learning != pack && secured.matches("secoc").count() == 3, "{secured}");
    [pack, learning, format!("{secured}{tables}")].map(|pack| config_texts::load(&format!("{pack}{MORE}"), DBC).monitor)
}

struct Vehicle {
    encoder: InputEncoder,
    now_ns: i64,
    counter: u8,
    command_counter: u8,
    current_a: f64,
    soc: f64,
    temperature_c: f64,
    silent_until: i64,
    identity: f64,
}

impl Vehicle {
    fn now(&self) -> Timestamp {
        Timestamp::from_nanos(self.now_ns)
    }

    /// Advances by 0.1 s: frames, ticks, and occasional rare inputs.
    fn step(&mut self, dice: &mut Dice, records: &mut Vec<Record>) {
        if dice.one_in(60) {
            self.current_a = [0.0, 0.0, 5.0, -5.0, 12.0, -1.0][dice.below(6)];
        }
        if dice.one_in(100) {
            self.temperature_c = dice.between(0.0, 80.0);
        }
        self.soc = (self.soc - self.current_a * 0.1 / 3600.0 * 20.0 / 2.6).clamp(0.02, 0.98);
        if dice.one_in(300) {
            self.silent_until = self.now_ns + [2_000_000_000, 8_000_000_000, 90_000_000_000][dice.below(3)];
        }
        if self.now_ns >= self.silent_until {
            self.frames(dice, records);
        }
        for _ in 0..if dice.one_in(5) { 10 } else { 1 } {
            self.now_ns += if dice.one_in(3) { 10_000_000 } else { 100_000_000 };
            records.push(Record::tick(self.now()));
        }
        self.rarities(dice, records);
    }

    fn frames(&mut self, dice: &mut Dice, records: &mut Vec<Record>) {
        let voltage_v = 3.3 + 0.8 * self.soc - 0.03 * self.current_a;
        let mut odd = |value: f64, noise: f64| {
            if dice.one_in(200) { dice.between(-50.0, 200.0) } else { value + dice.between(-noise, noise) }
        };
        let (current_a, temperature_c) = (odd(self.current_a, 0.02), odd(self.temperature_c, 0.0));
        let [first_v, second_v, third_v] = [0.0, -0.02, 0.01].map(|off_v| odd(voltage_v + off_v, 0.002));
        let values = [
            (Channel::Current, Some(current_a)),
            (Channel::Temperature(SensorIndex(0)), (!dice.one_in(50)).then_some(temperature_c)),
            (Channel::Temperature(SensorIndex(1)), Some(25.0)),
            (Channel::ReportedSoc, Some(self.soc)),
            (Channel::PackIdentity, Some(self.identity)),
            (Channel::Contactor, Some(if dice.one_in(100) { 0.0 } else { 1.0 })),
            (Channel::CellVoltage(CellIndex(0)), Some(first_v)),
            (Channel::CellVoltage(CellIndex(1)), Some(second_v)),
            (Channel::CellVoltage(CellIndex(2)), Some(third_v)),
        ];
        let mut made = Vec::new();
        self.encoder.encode(&values, &mut made);
        for (_, frame) in made {
            let frame = if frame.id() == CanId::Standard(0x100) { self.protected(dice, &frame) } else { frame };
            if dice.one_in(40) {
                continue;
            }
            for _ in 0..if dice.one_in(500) { 600 } else { 1 } {
                records.push(Record::frame(self.now(), BusIndex(0), &frame));
            }
            self.now_ns += 300_000;
        }
    }

    fn protected(&mut self, dice: &mut Dice, frame: &Frame) -> Frame {
        self.counter = Profile::P01A.next_counter(self.counter);
        if dice.one_in(100) {
            self.counter = 3;
        }
        let mut payload: [u8; 8] = frame.data().try_into().expect("8 bytes");
        let protection = Protection { profile: Profile::P01A, data_id: 0x0123 };
        protection.protect(&mut payload, self.counter).expect("long enough");
        Frame::classic(frame.id(), &payload).expect("8 bytes")
    }

    fn rarities(&mut self, dice: &mut Dice, records: &mut Vec<Record>) {
        let (time, bus) = (self.now(), BusIndex(0));
        let tester = |id: u16, data: &[u8]| Frame::classic(CanId::Standard(id), data).expect("short");
        match dice.below(400) {
            0 => self.now_ns += [700_000_000, 6_000_000_000, 3_600_000_000_000][dice.below(3)],
            1 => self.now_ns -= [200_000_000, 4_000_000_000][dice.below(2)],
            2 => records.push(Record::unknown_gap(time)),
            3 => records.push(Record::command(time, Command::Acknowledge(Selector::default()))),
            4 => records.push(Record::command(time, Command::Clear(Selector::default()))),
            5 => {
                let (rule, seconds) = (Rule::SocLow, dice.between(0.0, 5.0));
                records.push(Record::command(time, Command::Test { rule, seconds }));
            }
            6 => records.push(Record::store(time, dice.one_in(2))),
            7 => {
                let event = [BusEvent::Up, BusEvent::Down, BusEvent::SendFailed { frames: 2 }][dice.below(3)];
                records.push(Record::bus(time, bus, event));
            }
            8..=15 => {
                self.command_counter = (self.command_counter + 1) % 15;
                let code = u64::try_from(dice.below(3)).expect("small");
                let frame = command_frame(code, 31, 0x7FF, self.command_counter);
                let damaged = tester(1715, &frame.data()[..7]);
                records.push(Record::frame(time, BusIndex(0), if dice.one_in(4) { &damaged } else { &frame }));
            }
            16 => self.identity = f64::from(u8::try_from(dice.below(3)).expect("small")),
            // An answer of one frame, an answer of two frames (the second may be missing), or "response pending"
            // (0x78).
            17..=30 => {
                records.push(Record::frame(time, BusIndex(0), &tester(0x7BB, &[4, 0x61, 1, 0x20, 0x10, 0, 0, 0])))
            }
            31..=34 => {
                records.push(Record::frame(time, BusIndex(0), &tester(0x7BB, &[0x10, 9, 0x61, 1, 0x20, 0x20, 0, 0])))
            }
            35..=38 => records.push(Record::frame(time, BusIndex(0), &tester(0x7BB, &[0x21, 0, 0, 0, 0, 0, 0, 0]))),
            39 => records.push(Record::frame(time, BusIndex(0), &tester(0x7BB, &[3, 0x7F, 0x21, 0x78, 0, 0, 0, 0]))),
            40 => records.push(Record::frame(time, BusIndex(0), &tester(0x7DF, &[2, 1, 0, 0, 0, 0, 0, 0]))),
            41..=44 => {
                let [low, middle, high] = [[0xCA, 0xFE, 0], [0xCB, 0xFE, 0], [0, 0xEE, 0]][dice.below(3)];
                let request = Frame::classic(CanId::Extended(0x18EA_FF01), &[low, middle, high]).expect("short");
                records.push(Record::frame(time, BusIndex(0), &request));
            }
            _ => {}
        }
    }
}

fn records(seed: u64, steps: usize, config: &MonitorConfig) -> Vec<Record> {
    let mut dice = Dice::new(seed);
    let mut vehicle = Vehicle {
        encoder: InputEncoder::new(&config.input),
        now_ns: 1_700_000_000_000_000_000,
        counter: 0,
        command_counter: 0,
        current_a: 0.0,
        soc: 0.7,
        temperature_c: 25.0,
        silent_until: 0,
        identity: 7.0,
    };
    let mut records = Vec::new();
    (0..steps).for_each(|_| vehicle.step(&mut dice, &mut records));
    records
}

fn outputs(monitor: &mut Monitor, record: &Record, out: &mut Outputs) -> String {
    out.clear();
    monitor.handle(record, out);
    if out.is_empty() {
        return String::new();
    }
    let frames: Vec<_> = out.frames.iter().map(without_freshness).collect();
    format!("{frames:?}{:?}{:?}", out.events, out.estimates)
}

/// A sent frame without the authentication trailer. If the frame announces a freshness, no data are kept.
fn without_freshness(sent: &Transmit) -> String {
    let Some(secured) = sent.secured else { return format!("{sent:?}") };
    let data = sent.frame.data();
    let data = &data[..data.len() - secured.authentication.profile.trailer_bytes()];
    format!("{:?} {:?} {:?} {data:?} {}", sent.time, sent.bus, sent.frame.id(), sent.announces)
}

fn restored(monitor: &Monitor, config: &MonitorConfig) -> Monitor {
    let text = serde_json::to_string(&monitor.snapshot()).expect("a snapshot serialises to JSON");
    let snapshot: Snapshot = serde_json::from_str(&text).expect("reads back");
    let mut restored = Monitor::new(config.clone());
    restored.restore(snapshot, Downtime::AsStamped).expect("fits");
    restored
}

/// Runs one seed with cuts at random inputs. Returns the number of cuts.
fn cut(seed: u64, config: &MonitorConfig, one_in: usize) -> usize {
    let mut dice = Dice::new(seed ^ 0x5555);
    let (mut whole, mut cut) = (Monitor::new(config.clone()), Monitor::new(config.clone()));
    let wanting = || Outputs { want_estimates: true, ..Outputs::default() };
    let (mut out_whole, mut out_cut, mut cuts) = (wanting(), wanting(), 0);
    let mut before = Timestamp::from_nanos(0);
    let is_secured = !config.authentications().is_empty();
    for (nth, record) in records(seed, 3000, config).iter().enumerate() {
        // Skip commands. The freshness decides whether a forged command counts as old, and it differs after a cut.
        if is_secured && is_command(record) {
            continue;
        }
        // After a long time without input, a restored monitor assumes that the program was off.
        let is_break = record.time.since(before).abs() > 30.0;
        before = record.time;
        if nth > 0 && !is_break && dice.one_in(one_in) {
            cut = restored(&cut, config);
            cuts += 1;
        }
        let (expected, found) = (outputs(&mut whole, record, &mut out_whole), outputs(&mut cut, record, &mut out_cut));
        assert!(expected == found, "run {seed}, input {nth}: {record:?}\n whole {expected}\n cut   {found}");
    }
    cuts
}

#[test]
fn restored_snapshot_continues_byte_identical() {
    let wanted: usize = std::env::var("PACKWATCH_CUTS").map_or(3000, |cuts| cuts.parse().expect("a number"));
    let configs = configs();
    let first: u64 = std::env::var("PACKWATCH_FIRST").map_or(1, |seed| seed.parse().expect("a number"));
    let (mut cuts, mut seed) = (0, first);
    while cuts < wanted || seed < first + 6 {
        let number = usize::try_from(seed).expect("small");
        cuts += cut(seed, &configs[number % 3], [3, 30][number % 2]);
        seed += 1;
    }
    eprintln!("{cuts} cuts in {} runs: no difference", seed - first);
}
