//! Tests bad frames of messages with end-to-end protection, and floods. Each bad frame must be counted and reported,
//! and must not change an estimate.

use crate::support::config_texts;
use packwatch::can::e2e::{Profile, Protection, Status};
use packwatch::can::flood::FloodChange;
use packwatch::can::guard::GuardChange;
use packwatch::can::{CanId, Frame};
use packwatch::monitor::{Downtime, Estimate, Event, EventKind, Monitor, MonitorConfig, Outputs, Record, Snapshot};
use packwatch::quantity::{BusIndex, CellIndex, Channel, Fault, Timestamp};

const BUS: BusIndex = BusIndex(0);
const CURRENT: CanId = CanId::Standard(0x100);
const CELL_1: CanId = CanId::Standard(0x110);
const CELL_2: CanId = CanId::Standard(0x111);

/// The current is in a message with profile 1A. Each cell's voltage has its own message. The first cell's message has
/// profile 5, the second cell's is unprotected.
const DBC: &str = r#"VERSION ""
NS_ :
BS_:
BU_: A
BO_ 256 Status: 8 A
 SG_ Current : 16|16@1- (0.01,0) [-300|300] "A" A
BO_ 272 Cell1: 8 A
 SG_ Voltage1 : 24|16@1+ (0.0001,0) [0|6] "V" A
BO_ 273 Cell2: 8 A
 SG_ Voltage2 : 24|16@1+ (0.0001,0) [0|6] "V" A
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 60000;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 256 100;
"#;

const PACK: &str = r#"
[pack]
cells = 2
cell_model = "cells/nasa_b0005.toml"
[[interface]]
name = "can0"
[input]
dbc = ["pack.dbc"]
[input.current]
signal = "Status.Current"
positive = "discharge"
[input.cell_voltage]
signal = "Cell{m}.Voltage{n}"
[[input.protected]]
message = "Status"
profile = "1A"
data_id = 0x0123
[[input.protected]]
message = "Cell1"
profile = "5"
data_id = 0x4567
"#;

fn configuration() -> MonitorConfig {
    config_texts::load(PACK, DBC).monitor
}

struct Bench {
    monitor: Monitor,
    out: Outputs,
    events: Vec<Event>,
    estimates: Vec<Estimate>,
    now: Timestamp,
    counters: [u8; 2],
}

impl Bench {
    fn new() -> Self {
        Self::with(Monitor::new(configuration()))
    }

    fn with(monitor: Monitor) -> Self {
        Self {
            monitor,
            out: Outputs { want_estimates: true, ..Outputs::default() },
            events: Vec::new(),
            estimates: Vec::new(),
            now: Timestamp::from_nanos(1_700_000_000_000_000_000),
            counters: [0; 2],
        }
    }

    fn running() -> Self {
        let mut bench = Self::new();
        (0..20).for_each(|_| bench.cycle());
        bench.forget();
        bench
    }

    fn forget(&mut self) {
        self.events.clear();
        self.estimates.clear();
    }

    /// Processes the waiting samples at once, without waiting until every cell has a new voltage, and collects the
    /// outputs.
    fn take(&mut self) {
        self.monitor.settle(&mut self.out);
        self.events.append(&mut self.out.events);
        self.estimates.append(&mut self.out.estimates);
        self.out.clear();
    }

    fn give(&mut self, frame: Frame) {
        self.monitor.handle(&Record::frame(self.now, BUS, &frame), &mut self.out);
        self.take();
    }

    /// Advances by 100 ms, with ticks.
    fn wait(&mut self) {
        for _ in 0..10 {
            self.now = self.now.plus_nanos(10_000_000);
            self.monitor.handle(&Record::tick(self.now), &mut self.out);
        }
        self.take();
    }

    /// Advances by 100 ms, then sends every message once.
    fn cycle(&mut self) {
        self.wait();
        let current = self.next_current(1.0);
        self.give(current);
        let cell = self.next_cell_1(3.9);
        self.give(cell);
        self.give(cell_2(3.9));
    }

    fn next_current(&mut self, current_a: f64) -> Frame {
        let counter = self.counters[0];
        self.counters[0] = Profile::P01A.next_counter(counter);
        current(counter, current_a)
    }

    fn next_cell_1(&mut self, voltage_v: f64) -> Frame {
        let counter = self.counters[1];
        self.counters[1] = Profile::P05.next_counter(counter);
        cell_1(counter, voltage_v)
    }

    fn count(&self, id: CanId, status: Status) -> u64 {
        self.monitor.protected().find(|of| of.id == id).unwrap().counts.get(status)
    }

    /// Reports about protected messages: (id, status, usable, count).
    fn reported(&self) -> Vec<(CanId, Status, bool, u64)> {
        let reported = self.events.iter().filter_map(|event| match event.kind {
            EventKind::Protection(GuardChange { id, status, usable, count, .. }) => Some((id, status, usable, count)),
            _ => None,
        });
        reported.collect()
    }

    fn has(&self, kind: &EventKind) -> bool {
        self.events.iter().any(|event| event.kind == *kind)
    }

    fn estimates_of(&self, cell: u16) -> usize {
        self.estimates.iter().filter(|estimate| estimate.cell == CellIndex(cell)).count()
    }

    fn soc(&self, cell: usize) -> f64 {
        self.monitor.latest().nth(cell).flatten().unwrap().soc
    }
}

fn current(counter: u8, current_a: f64) -> Frame {
    let mut payload = [0; 8];
    payload[2..4].copy_from_slice(&((current_a * 100.0).round() as i16).to_le_bytes());
    Protection { profile: Profile::P01A, data_id: 0x0123 }.protect(&mut payload, counter).unwrap();
    Frame::classic(CURRENT, &payload).unwrap()
}

fn cell_1(counter: u8, voltage_v: f64) -> Frame {
    let mut payload = [0; 8];
    payload[3..5].copy_from_slice(&((voltage_v * 1e4).round() as u16).to_le_bytes());
    Protection { profile: Profile::P05, data_id: 0x4567 }.protect(&mut payload, counter).unwrap();
    Frame::classic(CELL_1, &payload).unwrap()
}

fn cell_2(voltage_v: f64) -> Frame {
    let mut payload = [0; 8];
    payload[3..5].copy_from_slice(&((voltage_v * 1e4).round() as u16).to_le_bytes());
    Frame::classic(CELL_2, &payload).unwrap()
}

fn damaged(frame: Frame) -> Frame {
    let mut payload = frame.data().to_vec();
    payload[7] ^= 1;
    Frame::classic(frame.id(), &payload).unwrap()
}

#[test]
fn valid_stream_is_accepted_after_first_frame() {
    let mut bench = Bench::new();
    (0..50).for_each(|_| bench.cycle());
    for id in [CURRENT, CELL_1] {
        assert_eq!((bench.count(id, Status::Initial), bench.count(id, Status::Ok)), (1, 49));
    }
    assert_eq!(bench.reported(), []);
    assert_eq!((bench.estimates_of(0), bench.estimates_of(1)), (49, 50), "the first protected frame must not be used");
    assert_eq!(bench.monitor.dropped().count(), 0);
}

#[test]
fn wrong_crc_is_reported_once_and_ignored() {
    let (mut bench, mut untouched) = (Bench::running(), Bench::running());
    for _ in 0..3 {
        bench.wait();
        untouched.wait();
        let frame = bench.next_cell_1(2.7); // 1.2 V lower, which would change the estimate
        bench.give(damaged(frame));
        for bench in [&mut bench, &mut untouched] {
            let current = bench.next_current(1.0);
            bench.give(current);
            bench.give(cell_2(3.9));
        }
    }
    assert_eq!(bench.soc(0), untouched.soc(0), "the frame must have no effect");
    assert_eq!((bench.estimates_of(0), bench.estimates_of(1)), (0, 3), "the other cell must still be estimated");
    assert_eq!(
        (bench.count(CELL_1, Status::WrongCrc), bench.reported()),
        (3, vec![(CELL_1, Status::WrongCrc, false, 1)])
    );
    let cell = Channel::CellVoltage(CellIndex(0));
    assert!(bench.has(&EventKind::SignalBad { channel: cell, fault: Fault::EndToEnd }));
    bench.forget();
    let good = cell_1(bench.counters[1].wrapping_sub(3), 3.9);
    bench.give(good);
    assert_eq!(bench.reported(), [(CELL_1, Status::Ok, true, 3)]);
    assert!(bench.has(&EventKind::SignalGood { channel: cell, bad_readings: 3 }));
    assert_eq!(bench.estimates_of(0), 1);
}

#[test]
fn repeated_counter_is_rejected() {
    let mut bench = Bench::running();
    bench.wait();
    let frame = bench.next_cell_1(3.9);
    bench.give(frame);
    let soc = bench.soc(0);
    bench.wait();
    bench.give(frame);
    assert_eq!((bench.soc(0), bench.estimates_of(0)), (soc, 1));
    assert_eq!(bench.count(CELL_1, Status::Repeated), 1);
    assert_eq!(bench.reported(), [(CELL_1, Status::Repeated, false, 1)]);
}

#[test]
fn allowed_counter_skip_is_used_and_counted() {
    let mut bench = Bench::running();
    let _lost = bench.next_current(1.0);
    bench.cycle();
    assert_eq!((bench.count(CURRENT, Status::OkSomeLost), bench.reported()), (1, vec![]));
    assert_eq!(bench.estimates_of(0), 1);
}

#[test]
fn excessive_counter_skip_is_rejected() {
    let mut bench = Bench::running();
    (0..5).for_each(|_| _ = bench.next_cell_1(2.7));
    bench.cycle();
    assert_eq!(bench.count(CELL_1, Status::WrongSequence), 1);
    assert_eq!(bench.reported(), [(CELL_1, Status::WrongSequence, false, 1)]);
    assert_eq!((bench.estimates_of(0), bench.estimates_of(1)), (0, 1));
    bench.cycle();
    assert_eq!(
        bench.reported()[1..],
        [(CELL_1, Status::Ok, true, 1)],
        "profile 5 must continue from the sender's counter"
    );
}

#[test]
fn replayed_frame_is_rejected_and_stream_continues() {
    let mut bench = Bench::running();
    bench.wait();
    let old = current(bench.counters[0].wrapping_sub(4), -50.0); // this frame was already sent and used
    bench.give(old);
    assert_eq!(bench.count(CURRENT, Status::WrongSequence), 1);
    let current_bad = EventKind::SignalBad { channel: Channel::Current, fault: Fault::EndToEnd };
    assert!(bench.has(&current_bad));
    (0..10).for_each(|_| bench.cycle());
    assert_eq!(bench.reported().last(), Some(&(CURRENT, Status::Ok, true, 1)), "the sender's next frame must be valid");
    assert!(bench.estimates.iter().all(|estimate| estimate.measured.current_a == 1.0), "-50 A must not be used");
    assert_eq!(bench.estimates_of(0), 10);
}

#[test]
fn frame_of_other_message_is_rejected() {
    let mut bench = Bench::running();
    let mut payload = [0; 8];
    let masquerade = Protection { profile: Profile::P01A, data_id: 0x0124 };
    masquerade.protect(&mut payload, bench.counters[0]).unwrap();
    bench.give(Frame::classic(CURRENT, &payload).unwrap());
    bench.give(Frame::classic(CURRENT, &[]).unwrap());
    assert_eq!(bench.count(CURRENT, Status::WrongCrc), 2);
}

#[test]
fn missing_frames_are_counted_with_known_period() {
    let mut bench = Bench::running();
    for _ in 0..20 {
        bench.wait();
        bench.give(cell_2(3.9));
    }
    assert_eq!(
        bench.count(CURRENT, Status::NoNewData),
        18,
        "2 s minus the first half period and the last one, which is not checked yet"
    );
    assert_eq!(bench.count(CELL_1, Status::NoNewData), 0, "the DBC has no cycle time");
    assert_eq!(bench.reported(), [(CURRENT, Status::NoNewData, false, 2)], "one loss is tolerated");
    assert_eq!(bench.estimates_of(1), 20);
}

#[test]
fn flood_of_one_identifier_is_limited() {
    let mut bench = Bench::running();
    let mut sent = 0;
    for _ in 0..20 {
        // Send 10,000 frames a second of an unprotected message. This is five times the limit.
        for _ in 0..1000 {
            bench.now = bench.now.plus_nanos(100_000);
            bench.give(cell_2(3.9));
            sent += 1;
        }
        bench.monitor.handle(&Record::tick(bench.now), &mut bench.out);
        let (current, cell) = (bench.next_current(1.0), bench.next_cell_1(3.9));
        bench.give(current);
        bench.give(cell);
    }
    let dropped = bench.monitor.dropped().next().unwrap();
    assert_eq!((dropped.bus, dropped.id), (BUS, CELL_2));
    let taken = sent - dropped.dropped;
    assert!((4000..=4201).contains(&taken), "accepted {taken} of {sent} frames in 2 s, must be about 2000 a second");
    assert_eq!((bench.estimates_of(0), bench.estimates_of(1) as u64), (20, taken));
    (0..15).for_each(|_| bench.cycle());
    let floods = bench.events.iter().filter_map(|event| match event.kind {
        EventKind::Flood(FloodChange { bus, id, active, dropped }) => Some((bus, id, active, dropped)),
        _ => None,
    });
    assert_eq!(floods.collect::<Vec<_>>(), [(BUS, CELL_2, true, 1), (BUS, CELL_2, false, dropped.dropped)]);
    assert_eq!(bench.reported(), []);
    assert_eq!(bench.estimates_of(0), 35);
}

#[test]
fn protected_flood_is_limited_before_check() {
    let mut bench = Bench::running();
    bench.wait();
    let soc = bench.soc(0);
    let forged = Frame::classic(CELL_1, &[0; 8]).unwrap();
    (0..5000).for_each(|_| bench.give(forged));
    assert_eq!(bench.count(CELL_1, Status::WrongCrc), 200, "dropped frames must not be checked");
    assert_eq!(bench.monitor.dropped().next().unwrap().dropped, 4800);
    assert_eq!((bench.soc(0), bench.estimates_of(0)), (soc, 0));
}

#[test]
fn restart_keeps_counts_and_awaits_first_frame() {
    let mut bench = Bench::running();
    let frame = bench.next_cell_1(3.9);
    bench.give(damaged(frame));
    (0..500).for_each(|_| bench.give(cell_2(3.9)));
    let text = serde_json::to_string(&bench.monitor.snapshot()).unwrap();
    let snapshot: Snapshot = serde_json::from_str(&text).unwrap();
    let mut monitor = Monitor::new(configuration());
    monitor.restore(snapshot, Downtime::Seconds(10.0)).unwrap();
    let mut after = Bench { counters: bench.counters, ..Bench::with(monitor) };
    after.cycle();
    after.cycle();
    let of_cell = |bench: &Bench| [Status::WrongCrc, Status::Initial].map(|status| bench.count(CELL_1, status));
    assert_eq!((of_cell(&bench), of_cell(&after)), ([1, 1], [1, 2]));
    assert_eq!(after.count(CELL_1, Status::Ok), bench.count(CELL_1, Status::Ok) + 1);
    assert_eq!(after.monitor.dropped().next(), bench.monitor.dropped().next());
}
