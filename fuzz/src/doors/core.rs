//! Fuzz entry points of the core. The bytes encode up to 3000 inputs of a small simulated vehicle, with its driver,
//! faults, diagnostic testers and attackers. At a cut, a new monitor, restored from a snapshot, replaces the old
//! monitor.

use std::sync::atomic::{AtomicU64, Ordering};

use packwatch::alarm::{Change, Rule, Selector};
use packwatch::can::e2e::{Profile, Protection};
use packwatch::can::encode::InputEncoder;
use packwatch::can::{CanId, Frame};
use packwatch::monitor::{
    BusEvent, Command, Downtime, Estimate, EventKind, MeasuredValues, Monitor, Outputs, Record, Snapshot,
};
use packwatch::quantity::{BusIndex, CellIndex, Channel, SensorIndex, Timestamp};

use super::source::Source;
use super::world;

/// Maximum number of inputs per execution. These inputs take about 50 ms.
const MAX_INPUTS: usize = 3000;
/// Maximum number of cuts per execution. Each cut takes as long as some hundred inputs.
const MAX_CUTS: usize = 100;
/// Maximum number of outputs per input, for three cells and 14 alarm rules.
const MAX_OUTPUTS: usize = 2000;
/// Numbers of inputs and cuts in all executions of this process. They are printed for `tests/fuzz`.
static INPUTS: AtomicU64 = AtomicU64::new(0);
static CUTS: AtomicU64 = AtomicU64::new(0);
/// Number of inputs between two prints of these counts.
const REPORT_EVERY: u64 = 100_000;
const BUS: BusIndex = BusIndex(0);
/// CAN identifiers that the monitor uses with this configuration: output messages and diagnostic requests.
const OWN: [u16; 8] = [0x6B0, 0x6B1, 0x6B2, 0x6B4, 0x6B5, 0x6B6, 0x79B, 0x7DF];
/// Address of the J1939 node, and its source address until it has claimed an address.
const OWN_ADDRESSES: [u32; 2] = [249, 254];
const MS: i64 = 1_000_000;
/// If no input arrives for longer than this (s), a restored monitor assumes that the program was off.
const BREAK_S: f64 = 30.0;

/// Feeds the inputs to a monitor and checks its outputs. In one of eight executions, a second run must give the same
/// outputs.
pub fn core(data: &[u8]) {
    let mut source = Source::new(data);
    let is_repeated = source.byte().is_multiple_of(8);
    let records = records(&mut source);
    let first = run(&records, true);
    if is_repeated {
        assert!(first == run(&records, false), "a second run gives different outputs");
    }
}

/// Feeds the same inputs to two monitors, one of which is cut regularly. Both must give the same outputs.
pub fn cuts(data: &[u8]) {
    let mut source = Source::new(data);
    let steps = [1 + usize::from(source.byte()), 1 + usize::from(source.byte())];
    let records = records(&mut source);
    let (mut whole, mut cut) = (monitor(), monitor());
    let (mut expected, mut found) = (outputs(), outputs());
    let (mut until_cut, mut cuts) = (steps[0], 0);
    for (nth, record) in records.iter().enumerate() {
        // The break is measured from the monitor's clock, not from the previous stamp. The two may differ: after a
        // stamp in the far future, the monitor does not immediately set its clock back when earlier stamps arrive.
        let is_break = record.time.since(whole.now()).abs() > BREAK_S;
        if until_cut == 0 && cuts < MAX_CUTS && !is_break {
            cuts += 1;
            until_cut = steps[cuts % steps.len()];
            cut = restored(&cut);
        }
        until_cut = until_cut.saturating_sub(1);
        handle(&mut whole, record, &mut expected);
        handle(&mut cut, record, &mut found);
        assert!(
            is_same(&expected, &found),
            "after {cuts} cuts, input {nth}: {record:?}\n whole {expected:?}\n cut   {found:?}"
        );
    }
    count(records.len(), cuts);
}

/// Feeds the inputs to a monitor, and checks the outputs if `is_checked` is set. Returns a hash of the outputs.
fn run(records: &[Record], is_checked: bool) -> u64 {
    let (mut monitor, mut out, mut digest) = (monitor(), outputs(), 0xCBF2_9CE4_8422_2325);
    let mut digested = |number: u64| digest = (digest ^ number).wrapping_mul(0x0100_0000_01B3);
    for record in records {
        handle(&mut monitor, record, &mut out);
        if is_checked {
            check(record, &out);
        }
        out.frames.iter().flat_map(|sent| sent.frame.data()).for_each(|byte| digested(u64::from(*byte)));
        out.estimates.iter().flat_map(numbers).for_each(&mut digested);
        digested(out.events.len() as u64);
    }
    count(records.len(), 0);
    digest
}

fn monitor() -> Monitor {
    Monitor::new(world::config().monitor.clone())
}

fn outputs() -> Outputs {
    Outputs { want_estimates: true, ..Outputs::default() }
}

fn handle(monitor: &mut Monitor, record: &Record, out: &mut Outputs) {
    out.clear();
    monitor.handle(record, out);
}

fn count(inputs: usize, cuts: usize) {
    let (inputs, cuts) = (inputs as u64, cuts as u64);
    let before = INPUTS.fetch_add(inputs, Ordering::Relaxed);
    let cuts = CUTS.fetch_add(cuts, Ordering::Relaxed) + cuts;
    if (before + inputs) / REPORT_EVERY > before / REPORT_EVERY {
        eprintln!("inputs of the core: {}, cuts: {cuts}", before + inputs);
    }
}

fn restored(monitor: &Monitor) -> Monitor {
    let text = serde_json::to_string(&monitor.snapshot()).expect("a snapshot serialises to JSON");
    let snapshot: Snapshot = serde_json::from_str(&text).expect("its own snapshot reads back");
    let mut restored = Monitor::new(world::config().monitor.clone());
    restored.restore(snapshot, Downtime::AsStamped).expect("a monitor accepts its own state");
    restored
}

fn is_same(one: &Outputs, other: &Outputs) -> bool {
    let are_events_same = || match (one.events.is_empty(), other.events.is_empty()) {
        (true, true) => true,
        // In text, NaN equals NaN, and zero differs from minus zero.
        _ => format!("{:?}", one.events) == format!("{:?}", other.events),
    };
    one.frames == other.frames
        && one.estimates.iter().flat_map(numbers).eq(other.estimates.iter().flat_map(numbers))
        && are_events_same()
}

fn numbers(estimate: &Estimate) -> impl Iterator<Item = u64> + use<> {
    let Estimate { time, cell, soc, soc_std, branch_v, capacity_ah, capacity_std_ah, .. } = *estimate;
    let Estimate { resistance_ratio, resistance_ratio_std, innovation_v, innovation_std_v, accepted, measured, .. } =
        *estimate;
    let MeasuredValues { voltage_v, current_a, temperature_c } = measured;
    let numbers = [
        soc,
        soc_std,
        capacity_ah,
        capacity_std_ah,
        resistance_ratio,
        resistance_ratio_std,
        innovation_v,
        innovation_std_v,
        voltage_v,
        current_a,
        temperature_c,
    ];
    let whole = [time.nanos() as u64, u64::from(cell.0), u64::from(accepted)];
    whole.into_iter().chain(numbers.into_iter().chain(branch_v).map(f64::to_bits))
}

pub(super) fn check(record: &Record, out: &Outputs) {
    assert!(
        out.frames.len() + out.events.len() + out.estimates.len() < MAX_OUTPUTS,
        "{record:?}: found too many outputs"
    );
    for sent in &out.frames {
        let is_own = match sent.frame.id() {
            CanId::Standard(id) => OWN.contains(&id),
            CanId::Extended(id) => OWN_ADDRESSES.contains(&(id & 0xFF)),
        };
        assert!(is_own, "{record:?} sends a foreign identifier: {:?}", sent.frame);
    }
    for e in &out.estimates {
        let numbers = [e.soc, e.soc_std, e.capacity_ah, e.capacity_std_ah, e.resistance_ratio, e.resistance_ratio_std];
        assert!(numbers.iter().all(|number| number.is_finite()), "{record:?}: {e:?}");
        assert!(e.soc_std >= 0.0 && e.capacity_std_ah >= 0.0 && e.resistance_ratio_std >= 0.0, "{record:?}: {e:?}");
    }
    let is_asked = out.events.iter().any(|event| {
        use EventKind::{Command, PackIdentity, PackReplaced, PackReturned};
        matches!(event.kind, Command { .. } | PackIdentity { .. } | PackReplaced { .. } | PackReturned { .. })
    });
    for event in &out.events {
        if let EventKind::Alarm { change: Change::Cleared, value: None, .. } = event.kind {
            assert!(is_asked, "{record:?}: an unknown value cleared an alarm: {event:?}");
        }
    }
}

struct Vehicle {
    encoder: InputEncoder,
    now_ns: i64,
    counter: u8,
    command_counter: u8,
    current_a: f64,
    soc: f64,
    temperature_c: f64,
    offset_v: f64,
    identity: f64,
    contactor: f64,
    records: Vec<Record>,
}

pub(super) fn records(source: &mut Source<'_>) -> Vec<Record> {
    let mut vehicle = Vehicle {
        encoder: InputEncoder::new(&world::config().monitor.input),
        now_ns: 1_700_000_000_000 * MS,
        counter: 0,
        command_counter: 0,
        current_a: 0.0,
        soc: 0.7,
        temperature_c: 25.0,
        offset_v: 0.0,
        identity: 7.0,
        contactor: 1.0,
        records: Vec::new(),
    };
    while !source.is_empty() && vehicle.records.len() < MAX_INPUTS {
        vehicle.act(source);
    }
    vehicle.records.truncate(MAX_INPUTS);
    vehicle.records
}

impl Vehicle {
    fn push(&mut self, record: Record) {
        self.records.push(record);
    }

    fn frame(&mut self, id: CanId, data: &[u8]) {
        if let Some(frame) = Frame::classic(id, data) {
            self.records.push(Record::frame(Timestamp::from_nanos(self.now_ns), BUS, &frame));
        }
    }

    fn act(&mut self, source: &mut Source<'_>) {
        let (time, bus) = (Timestamp::from_nanos(self.now_ns), BUS);
        match source.byte() % 24 {
            0..=5 => (0..=source.byte() % 32).for_each(|_| self.drive(100 * MS)),
            6 => (0..=source.byte() % 32).for_each(|_| self.drive(1000 * MS)),
            7 => self.current_a = f64::from(source.i16()) / 1000.0,
            8 => self.temperature_c = f64::from(source.byte()) - 50.0,
            9 => self.offset_v = f64::from(source.i16()) / 20_000.0,
            10 => {
                let id = source.one_of(&[0x100, 0x101, 0x110, 0x6B3, 0x6B0, 0x7BB, 0x79B, 0x7DF]);
                let (length, data) = (source.byte() % 9, source.array::<8>());
                self.frame(CanId::Standard(id), &data[..usize::from(length)]);
            }
            11 => {
                let data = source.array();
                self.protected(Profile::P01A, 0x0123, data);
            }
            12 => {
                let steps = [
                    1,
                    20,
                    700,
                    6000,
                    90_000,
                    3_600_000,
                    86_400_000,
                    10_000_000_000,
                    -200,
                    -4000,
                    -3_600_000,
                    i64::MAX / MS / 2,
                ];
                self.now_ns = self.now_ns.saturating_add(source.one_of(&steps) * MS);
                self.push(Record::tick(Timestamp::from_nanos(self.now_ns)));
            }
            13 => self.push(Record::unknown_gap(time)),
            14 => {
                let (rule, seconds) = (Rule::from_number(source.byte() % 20).unwrap_or(Rule::SocLow), source.number());
                let cell = source.one_of(&[None, Some(CellIndex(0)), Some(CellIndex(1)), Some(CellIndex(900))]);
                let which = Selector { rule: source.one_of(&[None, Some(rule)]), severity: None, cell };
                let commands = [
                    Command::Acknowledge(which),
                    Command::Clear(which),
                    Command::PackReplaced,
                    Command::Poll { standby: true },
                    Command::Poll { standby: false },
                    Command::Test { rule, seconds: if seconds.is_finite() { seconds } else { 1.0 } },
                ];
                let command = source.one_of(&commands);
                self.push(Record::command(time, command));
            }
            15 => self.command(source),
            16 => {
                let count = u64::from(source.u16());
                let class = u32::from(source.u16());
                let event = source.one_of(&[
                    BusEvent::Up,
                    BusEvent::Down,
                    BusEvent::Missing,
                    BusEvent::Dropped { frames: count },
                    BusEvent::Dropped { frames: u64::MAX },
                    BusEvent::ErrorFrame { class },
                    BusEvent::SendFailed { frames: count },
                ]);
                self.push(Record::bus(time, bus, event));
            }
            17 => self.push(Record::store(time, source.byte().is_multiple_of(2))),
            18 => self.identity = f64::from(source.byte() % 12),
            19 => self.contactor = f64::from(source.byte() % 16),
            20 => {
                let data = source.array::<8>();
                self.frame(CanId::Standard(0x7BB), &data);
            }
            21 => {
                let (pgn, source_address, data) = (source.u16(), source.byte(), source.array::<8>());
                let id =
                    u32::from(pgn) << 8 | u32::from(source_address) | u32::from(source.byte() % 2) << 26 | 0x1800_0000;
                self.frame(CanId::Extended(id & 0x1FFF_FFFF), &data[..usize::from(source.byte() % 9)]);
            }
            // A flood of frames with one identifier.
            22 => (0..u16::from(source.byte()) * 2).for_each(|_| self.frame(CanId::Standard(0x110), &[1; 8])),
            // A valid answer of a controller.
            _ => self.frame(CanId::Standard(0x7BB), &[4, 0x61, 1, 0x20, source.byte(), 0, 0, 0]),
        }
    }

    /// Adds the frames of a healthy pack in one period, and the tick at its end.
    fn drive(&mut self, period_ns: i64) {
        self.soc = (self.soc - self.current_a * period_ns as f64 / 1e9 / 3600.0 / 2.6 * 10.0).clamp(0.02, 0.98);
        let voltage_v = 3.3 + 0.8 * self.soc - 0.03 * self.current_a + self.offset_v;
        let values = [
            (Channel::Current, Some(self.current_a)),
            (Channel::Temperature(SensorIndex(0)), Some(self.temperature_c)),
            (Channel::Temperature(SensorIndex(1)), Some(25.0)),
            (Channel::ReportedSoc, Some(self.soc)),
            (Channel::PackIdentity, Some(self.identity)),
            (Channel::Contactor, Some(self.contactor)),
            (Channel::CellVoltage(CellIndex(0)), Some(voltage_v)),
            (Channel::CellVoltage(CellIndex(1)), Some(voltage_v - 0.02)),
            (Channel::CellVoltage(CellIndex(2)), Some(voltage_v + 0.01)),
        ];
        let mut made = Vec::new();
        self.encoder.encode(&values, &mut made);
        for (_, frame) in made {
            match frame.id() {
                CanId::Standard(0x100) => {
                    self.protected(Profile::P01A, 0x0123, frame.data().try_into().unwrap_or_default())
                }
                id => self.frame(id, frame.data()),
            }
            self.now_ns = self.now_ns.saturating_add(MS / 3);
        }
        self.now_ns = self.now_ns.saturating_add(period_ns);
        self.push(Record::tick(Timestamp::from_nanos(self.now_ns)));
    }

    fn protected(&mut self, profile: Profile, data_id: u16, mut payload: [u8; 8]) {
        self.counter = profile.next_counter(self.counter);
        Protection { profile, data_id }.protect(&mut payload, self.counter).expect("8 bytes suffice");
        self.frame(CanId::Standard(0x100), &payload);
    }

    /// Adds a command frame with arbitrary content and a correct or repeated counter.
    fn command(&mut self, source: &mut Source<'_>) {
        let (profile, mut payload) = (Profile::P01A, source.array::<8>());
        if !source.byte().is_multiple_of(4) {
            self.command_counter = profile.next_counter(self.command_counter);
        }
        Protection { profile, data_id: 0x0321 }.protect(&mut payload, self.command_counter).expect("8 bytes suffice");
        self.frame(CanId::Standard(0x6B3), &payload);
    }
}
