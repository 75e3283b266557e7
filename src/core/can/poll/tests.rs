//! Tests when requests are due, that the current is requested before voltages, and when polling stops.

#![allow(clippy::unwrap_used, reason = "tests may panic")]

use proptest::prelude::*;

use super::*;
use crate::can::uds::Service;

const BUS: BusIndex = BusIndex(0);
const REQUEST: CanId = CanId::Standard(0x7E4);
const RESPONSE: CanId = CanId::Standard(0x7EC);

fn at(ms: i64) -> Timestamp {
    Timestamp::from_nanos(ms * 1_000_000)
}

const CONTROLLER: Controller =
    Controller { bus: BUS, request: REQUEST, request_extension: None, response: RESPONSE, response_extension: None };

fn question(identifier: u16) -> Question {
    Question { controller: CONTROLLER, service: Service::ByIdentifier, identifier }
}

fn request(identifier: u16, every_s: f64) -> PollRequest {
    let every_s = [Some(every_s), Some(5.0 * every_s), None];
    PollRequest { question: question(identifier), every_s, has_current: false, has_voltages: false }
}

/// A poller in a moving car. While the bus is awake, another node sends a frame every 100 ms.
struct Bench {
    poller: Poller,
    out: PollOutputs,
    now_ms: i64,
    is_awake: bool,
    sent: Vec<(i64, Vec<u8>)>,
    changes: Vec<(i64, PollChange)>,
    /// Response to a request.
    answer: fn(&[u8]) -> Behaviour,
}

enum Behaviour {
    Answers,
    Refuses(u8),
    Nothing,
}

impl Bench {
    fn new(requests: Vec<PollRequest>) -> Self {
        Self::with(PollConfig { requests, max_requests_per_s: 10.0, watches_supply: false })
    }

    fn with(config: PollConfig) -> Self {
        let mut poller = Poller::new(&config);
        poller.set_state(at(0), CarState::Drive);
        let answer = |_: &[u8]| Behaviour::Answers;
        let (out, sent, changes) = (PollOutputs::default(), Vec::new(), Vec::new());
        Self { poller, out, now_ms: 0, is_awake: true, sent, changes, answer }
    }

    fn run(&mut self, ms: i64) {
        for _ in 0..ms {
            self.now_ms += 1;
            if self.is_awake && self.now_ms % 100 == 0 {
                self.hear(CanId::Standard(0x123), &[0; 8]);
            }
            if self.poller.next_due().is_some_and(|due| due <= at(self.now_ms)) {
                self.poller.poll(at(self.now_ms), &mut self.out);
            }
            self.take();
        }
    }

    fn hear(&mut self, id: CanId, payload: &[u8]) {
        let frame = Frame::classic(id, payload).unwrap();
        self.poller.handle_frame(at(self.now_ms), BUS, &frame, &mut self.out);
        self.take();
    }

    fn take(&mut self) {
        let now = at(self.now_ms);
        self.changes.extend(self.out.changes.drain(..).map(|change| (self.now_ms, change)));
        while !self.out.frames.is_empty() {
            let (bus, frame) = self.out.frames.remove(0);
            assert_eq!((bus, frame.id()), (BUS, REQUEST), "only requests are sent");
            let payload = frame.data().to_vec();
            self.sent.push((self.now_ms, payload.clone()));
            if payload[0] >> 4 != 0 {
                continue; // flow control
            }
            assert!([0x01, 0x21, 0x22].contains(&payload[1]), "{payload:?}");
            match (self.answer)(&payload) {
                Behaviour::Answers => {
                    self.poller.handle_begun(now, &CONTROLLER, &mut self.out);
                    let identifier = u16::from_be_bytes([payload[2], payload[3]]);
                    self.poller.handle_answer(now, &question(identifier), &mut self.out);
                }
                Behaviour::Refuses(code) => {
                    let refusal = Refusal { service: payload[1], code };
                    self.poller.handle_refusal(now, &CONTROLLER, refusal, &mut self.out);
                }
                Behaviour::Nothing => {}
            }
        }
        self.changes.extend(self.out.changes.drain(..).map(|change| (self.now_ms, change)));
    }

    /// Times and identifiers of the requests.
    fn requests(&self) -> Vec<(i64, u16)> {
        let requests = self.sent.iter().filter(|(_, payload)| payload[0] >> 4 == 0);
        requests.map(|(ms, payload)| (*ms, u16::from_be_bytes([payload[2], payload[3]]))).collect()
    }
}

#[test]
fn requests_keep_period_and_responses_get_flow_control() {
    let mut bench = Bench::new(vec![request(1, 1.0), request(2, 3.0)]);
    bench.run(6050);
    let of = |id: u16| bench.requests().iter().filter(|(_, other)| *other == id).map(|(ms, _)| *ms).collect::<Vec<_>>();
    assert_eq!(of(1), [100, 1100, 2100, 3100, 4100, 5100], "periodic from the first frame on");
    assert_eq!(of(2), [300, 3300], "after the other request and its flow control, at ten frames a second");
    assert_eq!(bench.sent[..2], [(100, vec![3, 0x22, 0, 1, 0, 0, 0, 0]), (100, vec![0x30, 0, 0, 0, 0, 0, 0, 0])]);
}

#[test]
fn polling_pauses_one_minute_after_other_tester() {
    let standard = [0x7DF, 0x7E0, 0x6F1, 0x710, 0x743].map(CanId::Standard);
    for foreign in [REQUEST, CanId::Extended(0x18DA_10F1), CanId::Extended(0x17FC_007B)].into_iter().chain(standard) {
        let mut bench = Bench::new(vec![request(1, 0.5)]);
        bench.run(2000);
        bench.hear(foreign, &[2, 0x3E, 0, 0, 0, 0, 0, 0]);
        let before = bench.requests().len();
        bench.run(59_999);
        assert_eq!(bench.requests().len(), before, "{foreign}");
        bench.run(200);
        assert!(bench.requests().len() > before, "{foreign}");
        let reason = PollSilence::OtherTester;
        assert_eq!(bench.changes[1..], [(2000, PollChange::Silent { reason }), (62_000, PollChange::Asking)]);
    }
}

#[test]
fn endless_first_frames_get_one_flow_control_per_request() {
    let mut bench =
        Bench::with(PollConfig { requests: vec![request(1, 0.1)], max_requests_per_s: 5.0, watches_supply: false });
    bench.answer = |_| Behaviour::Nothing;
    for _ in 0..12_000 {
        bench.run(1);
        bench.poller.handle_begun(at(bench.now_ms), &CONTROLLER, &mut bench.out);
        bench.take();
    }
    let (sent, requests) = (bench.sent.len(), bench.requests().len());
    assert!(requests > 1 && sent <= 2 * requests && sent <= 60, "{sent} frames for {requests} requests in 12 s");
}

#[test]
fn response_to_other_tester_gets_no_flow_control() {
    let mut bench = Bench::new(vec![request(1, 1.0)]);
    bench.answer = |_| Behaviour::Nothing;
    bench.run(100);
    bench.hear(REQUEST, &[3, 0x22, 1, 1, 0, 0, 0, 0]);
    let before = bench.sent.len();
    bench.poller.handle_begun(at(bench.now_ms), &CONTROLLER, &mut bench.out);
    bench.take();
    assert_eq!(bench.sent.len(), before, "a request was outstanding, but another tester is active now");
}

#[test]
fn sleeping_bus_is_not_polled_despite_own_responses() {
    let mut bench = Bench::new(vec![request(1, 0.5)]);
    bench.run(10_000);
    bench.is_awake = false;
    let last = bench.now_ms;
    bench.run(60_000);
    assert!(bench.requests().iter().all(|(ms, _)| *ms < last + 2000), "{:?}", bench.requests().last());
    let before = bench.requests().len();
    // A late response does not count as a frame from another node.
    bench.hear(RESPONSE, &[3, 0x62, 0, 1, 0, 0, 0, 0]);
    bench.run(5000);
    assert_eq!(bench.requests().len(), before);
    bench.is_awake = true;
    bench.run(1000);
    assert!(bench.requests().len() > before);
}

#[test]
fn low_or_unknown_supply_stops_polling() {
    let mut bench =
        Bench::with(PollConfig { requests: vec![request(1, 0.5)], max_requests_per_s: 10.0, watches_supply: true });
    bench.run(2000);
    assert_eq!(bench.requests(), [], "no reading yet");
    bench.poller.set_supply(Some(at(5000)));
    bench.run(10_000);
    let last = bench.requests().last().unwrap().0;
    assert!((4000..5000).contains(&last), "the reading is stale from 5000 on: {last}");
    bench.poller.set_supply(Some(at(60_000)));
    bench.run(1000);
    assert!(bench.requests().last().unwrap().0 > 12_000);
    bench.poller.set_supply(None);
    let before = bench.requests().len();
    bench.run(1000);
    assert_eq!(bench.requests().len(), before);
}

#[test]
fn standby_stops_polling() {
    let mut bench = Bench::new(vec![request(1, 0.5)]);
    bench.poller.set_standby(true);
    bench.run(5000);
    assert_eq!(bench.requests(), []);
    bench.poller.set_standby(false);
    bench.run(1000);
    assert!(!bench.requests().is_empty());
}

/// A poller after a restart at `at_ms`, with the stored progress of `bench`, in a moving car with an awake bus.
fn restarted(bench: &Bench, at_ms: i64) -> Bench {
    let mut stored = bench.poller.progress().clone();
    let taken = at(bench.now_ms);
    let mut next = Bench::new(vec![request(1, 0.5)]);
    next.now_ms = at_ms;
    if stored.restart(taken) {
        stored.rebase(at(at_ms).nanos() - taken.nanos());
        next.poller.restore_silence(&stored, at(at_ms), at(at_ms));
    }
    next
}

#[test]
fn standby_and_silence_after_tester_survive_restart() {
    let mut bench = Bench::new(vec![request(1, 0.5)]);
    bench.run(2000);
    let mut next = restarted(&bench, 0);
    next.run(1000);
    assert!(!next.requests().is_empty(), "neither standby nor a tester");
    bench.poller.set_standby(true);
    let mut next = restarted(&bench, 5000);
    next.run(100_000);
    assert_eq!(next.requests(), []);
    next.poller.set_standby(false);
    next.run(1000);
    assert!(!next.requests().is_empty());
    bench.poller.set_standby(false);
    bench.hear(CanId::Standard(0x7DF), &[2, 0x3E, 0, 0, 0, 0, 0, 0]);
    bench.run(50_000);
    for at_ms in [0, 500_000] {
        let mut next = restarted(&bench, at_ms);
        next.run(59_999);
        assert_eq!(next.requests(), [], "{at_ms}");
        next.run(1000);
        assert!(!next.requests().is_empty(), "{at_ms}");
    }
    bench.run(20_000);
    assert!(!bench.poller.progress().clone().restart(at(bench.now_ms)), "nothing is left to store");
}

#[test]
fn permanent_refusal_ends_request_and_failures_back_off() {
    let mut bench = Bench::new(vec![request(1, 1.0), request(2, 1.0), request(3, 1.0)]);
    bench.answer = |payload| match payload[3] {
        1 => Behaviour::Refuses(0x31),
        2 => Behaviour::Refuses(0x22),
        _ => Behaviour::Answers,
    };
    bench.run(60_000);
    let of = |id: u16| {
        bench.requests().iter().filter(|(_, other)| *other == id).map(|(ms, _)| ms / 1000).collect::<Vec<_>>()
    };
    assert_eq!(of(1), [0], "never again");
    assert_eq!(of(2), [0, 2, 6, 14, 30], "after 2, 4, 8, 16 s");
    assert_eq!(of(3).len(), 60);
    let refused = PollChange::Refused { id: RESPONSE, service: 0x22, identifier: 1, code: 0x31 };
    assert!(bench.changes.contains(&(100, refused)) && bench.poller.refused() == 1, "{:?}", bench.changes);
}

#[test]
fn pending_response_is_awaited_up_to_limit() {
    let mut bench = Bench::new(vec![request(1, 1.0), request(2, 1.0)]);
    bench.answer = |_| Behaviour::Nothing;
    bench.run(150);
    for _ in 0..40 {
        let refusal = Refusal { service: 0x22, code: PENDING };
        bench.poller.handle_refusal(at(bench.now_ms), &CONTROLLER, refusal, &mut bench.out);
        bench.run(1000);
    }
    let requests = bench.requests();
    assert_eq!((requests[0], requests[1].1), ((100, 1), 2));
    assert!((30_000..30_300).contains(&requests[1].0), "given up after 30 s: {requests:?}");
}

#[test]
fn current_is_requested_right_before_voltages() {
    let current = PollRequest { has_current: true, ..request(1, 1.0) };
    let cells = |identifier| PollRequest { has_voltages: true, ..request(identifier, 2.0) };
    let mut bench = Bench::new(vec![cells(2), current, cells(3)]);
    bench.run(4000);
    let order: Vec<u16> = bench.requests().iter().map(|(_, id)| *id).collect();
    assert_eq!(order[..4], [1, 2, 1, 3]);
    let before_cells = order.windows(2).filter(|pair| pair[1] != 1);
    assert!(before_cells.clone().count() > 2 && before_cells.clone().all(|pair| pair[0] == 1), "{order:?}");
}

#[test]
fn car_state_sets_request_period() {
    let mut bench = Bench::new(vec![request(1, 1.0)]);
    bench.run(5000);
    let driving = bench.requests().len();
    bench.poller.set_state(at(bench.now_ms), CarState::Charge);
    bench.run(20_000);
    let charging = bench.requests().len() - driving;
    bench.poller.set_state(at(bench.now_ms), CarState::Parked);
    let before = bench.requests().len();
    bench.run(60_000);
    assert_eq!((driving, charging, bench.requests().len()), (5, 4, before), "every 1 s, every 5 s, never");
    bench.poller.set_state(at(bench.now_ms), CarState::Drive);
    bench.run(300);
    assert_eq!(bench.requests().len(), before + 1, "at once");
}

proptest! {
    /// The poller sends only flow control and requests of reading services. It pauses for a minute after another
    /// tester's request and keeps the allowed rate. Its next due time is in the future, so that the driver does not
    /// spin.
    #[test]
    fn poller_keeps_its_limits_for_any_input(
        acts in proptest::collection::vec((0_u8..8, 0_u16..3000, any::<[u8; 8]>()), 1..80)
    ) {
        let mut bench = Bench::new(vec![request(1, 0.2), request(2, 0.7)]);
        bench.answer = |payload| match payload[3] { 1 => Behaviour::Answers, _ => Behaviour::Nothing };
        let mut foreign_ms = None;
        for (act, wait, payload) in acts {
            let from = bench.sent.len();
            match act {
                0 => { bench.hear(REQUEST, &payload); foreign_ms = Some(bench.now_ms); }
                1 => bench.hear(RESPONSE, &payload),
                2 => bench.is_awake = !bench.is_awake,
                3 => bench.poller.handle_begun(at(bench.now_ms), &CONTROLLER, &mut bench.out),
                4 => {
                    let refusal = Refusal { service: payload[0], code: payload[1] };
                    bench.poller.handle_refusal(at(bench.now_ms), &CONTROLLER, refusal, &mut bench.out);
                }
                5 => bench.poller.restart(),
                _ => {}
            }
            bench.take();
            bench.run(i64::from(wait));
            for (ms, sent) in &bench.sent[from..] {
                prop_assert!(foreign_ms.is_none_or(|foreign| *ms >= foreign + 60_000), "{ms}: {sent:?} after {foreign_ms:?}");
            }
            bench.poller.poll(at(bench.now_ms), &mut bench.out);
            bench.take();
            prop_assert!(bench.poller.next_due().is_none_or(|due| due > at(bench.now_ms)), "{:?}", bench.poller);
        }
        let (requests, sent) = (bench.requests(), bench.sent.len());
        prop_assert!(sent <= 2 * requests.len() && i64::try_from(sent).unwrap() <= 2 + bench.now_ms / 100, "{sent} frames");
        prop_assert!(requests.windows(2).all(|pair| pair[1].0 - pair[0].0 >= 100), "{requests:?}");
    }
}
