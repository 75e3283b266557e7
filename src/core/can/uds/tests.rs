//! Tests diagnostic responses: reassembly, negative responses, counts, and losses.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests may panic")]

use super::*;
use crate::can::dbc::{FrameFormat, Message, Signal};
use crate::can::isotp::segment;
use crate::can::signal::{ByteOrder, SignalLayout, ValueType};
use crate::quantity::{CellIndex, Channel};

const BUS: BusIndex = BusIndex(0);
const REQUEST: CanId = CanId::Standard(0x79B);
const RESPONSE: CanId = CanId::Standard(0x7BB);

fn at(ms: i64) -> Timestamp {
    Timestamp::from_nanos(ms * 1_000_000)
}

fn controller(response_extension: Option<u8>) -> Controller {
    Controller { bus: BUS, request: REQUEST, response: RESPONSE, request_extension: None, response_extension }
}

fn question(identifier: u16) -> Question {
    Question { controller: controller(None), service: Service::ByLocalIdentifier, identifier }
}

/// A response with consecutive cell voltages of 16 bits, in mV.
fn cells(identifier: u16, first: u16, count: u16) -> Answer {
    let layout = SignalLayout {
        start_bit: 7,
        length_bits: 16,
        byte_order: ByteOrder::BigEndian,
        value_type: ValueType::Unsigned,
        factor: 0.001,
        offset: 0.0,
        minimum: 2.0,
        maximum: 5.0,
    };
    let signal = Signal {
        name: String::new(),
        layout,
        unit: String::new(),
        receivers: vec![],
        conditions: vec![],
        is_multiplexor: false,
        values: vec![(0xFFFF, "not available".to_owned())],
        comment: None,
    };
    let message = Message {
        id: RESPONSE,
        name: String::new(),
        len_bytes: 8,
        sender: None,
        format: FrameFormat::Classic,
        is_j1939: false,
        e2e: None,
        secoc: None,
        signals: vec![],
        cycle_time_ms: None,
        repetition: Default::default(),
        comment: None,
    };
    let signals = (0..count).map(|index| AnswerSignal {
        first_byte: 2 * usize::from(index),
        binding: Binding::new(BUS, &message, &signal, Channel::CellVoltage(CellIndex(first + index))).unwrap(),
    });
    Answer { question: question(identifier), signals: signals.collect() }
}

struct Bench {
    listener: Listener,
    now_ms: i64,
    readings: Vec<(u16, Result<f64, Fault>)>,
}

impl Bench {
    fn new(answers: &[Answer]) -> Self {
        Self { listener: Listener::new(answers), now_ms: 0, readings: Vec::new() }
    }

    fn hear(&mut self, id: CanId, payload: &[u8]) {
        self.now_ms += 10;
        let frame = Frame::classic(id, payload).unwrap();
        if let FrameOutcome::Whole { answer, data, .. } = self.listener.handle(at(self.now_ms), BUS, &frame) {
            for reading in answer.readings(data) {
                let Channel::CellVoltage(cell) = reading.channel else { panic!("{reading:?}") };
                self.readings.push((cell.0, reading.value));
            }
        }
    }

    fn answer(&mut self, message: &[u8]) {
        for payload in segment(None, message, 0xFF) {
            self.hear(RESPONSE, &payload);
        }
    }

    fn ask(&mut self, identifier: u8) {
        self.hear(REQUEST, &[2, 0x21, identifier, 0, 0, 0, 0, 0]);
    }

    fn counts(&self) -> ControllerCounts {
        self.listener.counts().next().unwrap().1
    }
}

fn message(identifier: u8, codes: &[u16]) -> Vec<u8> {
    [0x61, identifier].into_iter().chain(codes.iter().flat_map(|code| code.to_be_bytes())).collect()
}

#[test]
fn responses_are_distinguished_by_echoed_identifier() {
    let mut bench = Bench::new(&[cells(2, 0, 3), cells(3, 3, 1)]);
    bench.ask(2);
    bench.answer(&message(2, &[3600, 3700, 4000]));
    bench.ask(3);
    bench.answer(&message(3, &[3900]));
    bench.ask(4);
    bench.answer(&message(4, &[1, 2, 3]));
    assert_eq!(bench.readings, [(0, Ok(3.6)), (1, Ok(3.7)), (2, Ok(4.0)), (3, Ok(3.9))]);
    assert_eq!(bench.counts(), ControllerCounts { read: 2, other: 1, ..ControllerCounts::default() });
}

#[test]
fn out_of_range_and_truncated_values_have_faults() {
    let mut bench = Bench::new(&[cells(2, 0, 4)]);
    bench.ask(2);
    bench.answer(&message(2, &[3600, 9999, 0xFFFF]));
    let bad = [(0, Ok(3.6)), (1, Err(Fault::OutOfRange)), (2, Err(Fault::NotAvailable)), (3, Err(Fault::ShortFrame))];
    assert_eq!(bench.readings, bad);
}

#[test]
fn refusals_are_counted_without_response_pending() {
    let mut bench = Bench::new(&[cells(2, 0, 1)]);
    bench.ask(2);
    for _ in 0..1000 {
        bench.answer(&[0x7F, 0x21, PENDING]); // a gateway that responds "pending" forever
    }
    bench.answer(&[0x7F, 0x21, 0x12]);
    bench.answer(&[0x7F, 0x21, 0x31]);
    let wanted =
        ControllerCounts { pending: 1000, refused: 2, latest_refusal: Some(0x31), ..ControllerCounts::default() };
    assert_eq!((bench.counts(), bench.readings.len()), (wanted, 0));
}

#[test]
fn unrequested_response_is_decoded_and_counted() {
    let mut bench = Bench::new(&[cells(2, 0, 1), cells(3, 1, 1)]);
    bench.answer(&message(2, &[3600]));
    assert_eq!((bench.counts().read, bench.counts().unasked), (1, 1));
    bench.ask(3);
    bench.answer(&message(2, &[3600]));
    assert_eq!(bench.counts().unasked, 2, "a different response was requested");
    bench.answer(&message(3, &[3600]));
    assert_eq!(bench.counts().unasked, 2);
    bench.now_ms += 6000;
    bench.answer(&message(3, &[3600]));
    assert_eq!((bench.counts().unasked, bench.readings.len()), (3, 4));
}

#[test]
fn truncated_response_gives_one_report_a_minute() {
    let mut bench = Bench::new(&[cells(2, 0, 10)]);
    let frames = segment(None, &message(2, &[3600; 10]), 0);
    for cut in 1..frames.len() {
        bench.ask(2);
        frames[..cut].iter().for_each(|payload| bench.hear(RESPONSE, payload));
        bench.now_ms += 1500;
        bench.listener.poll(at(bench.now_ms));
    }
    assert_eq!((bench.readings.len(), bench.counts().lost_in_all()), (0, u64::try_from(frames.len()).unwrap() - 1));
    let [report] = bench.listener.losses[..] else { panic!("{:?}", bench.listener.losses) };
    assert_eq!(report, MessageLoss { bus: BUS, id: RESPONSE, fault: IsoTpFault::Timeout, lost: 1 });
    bench.ask(2);
    bench.answer(&message(2, &[3600; 10]));
    assert_eq!(bench.readings.len(), 10);
}

#[test]
fn flood_of_foreign_first_frames_uses_no_memory() {
    let mut bench = Bench::new(&[cells(2, 0, 1)]);
    for id in 0..0x7FF {
        bench.hear(CanId::Standard(id), &[0x1F, 0xFF, 1, 2, 3, 4, 5, 6]);
    }
    assert_eq!(bench.listener.counts().count(), 1);
    // The frame with the response identifier started a message, which is not counted yet.
    assert_eq!(bench.counts(), ControllerCounts::default());
}

#[test]
fn extended_addressing_separates_controllers() {
    let mut answers = [cells(2, 0, 1), cells(2, 1, 1)];
    for (answer, extension) in answers.iter_mut().zip([0xF1, 0xF2]) {
        answer.question.controller = controller(Some(extension));
    }
    let mut bench = Bench::new(&answers);
    for extension in [0xF2, 0xF1] {
        for payload in segment(Some(extension), &message(2, &[3600]), 0) {
            bench.hear(RESPONSE, &payload);
        }
    }
    assert_eq!(bench.readings, [(1, Ok(3.6)), (0, Ok(3.6))]);
}

#[test]
fn restored_counts_continue() {
    let mut bench = Bench::new(&[cells(2, 0, 1)]);
    bench.answer(&message(2, &[3600]));
    let stored: Vec<_> = bench.listener.counts().collect();
    let mut again = Bench::new(&[cells(2, 0, 1)]);
    again.listener.restore(stored.into_iter());
    again.answer(&message(2, &[3600]));
    assert_eq!(again.counts().read, 2);
}

#[test]
fn requests_match_the_standards() {
    let asked = |service, identifier| Question { controller: controller(None), service, identifier }.request();
    assert_eq!(asked(Service::ByIdentifier, 0x0101), [0x22, 0x01, 0x01]);
    assert_eq!(asked(Service::ByLocalIdentifier, 0x02), [0x21, 0x02]);
    assert_eq!(asked(Service::CurrentData, 0x5B), [0x01, 0x5B]);
    assert!((0..=255).filter_map(Service::from_code).count() == 3, "no other service can be requested");
}
