//! Tests the node on a simulated bus with a simulated clock. A simulated receiver reassembles transfers.

mod peer_log;
mod properties;

use super::super::{Lamp, MAX_CODES, NameFields};
use super::*;

const ADDRESS: u8 = 0xF9;
const OTHER: u8 = 0x21;

fn at(ms: i64) -> Timestamp {
    Timestamp::from_nanos(ms * 1_000_000)
}

fn name(identity_number: u32) -> Name {
    Name::new(&NameFields { identity_number, ..Default::default() }).unwrap()
}

fn active(spn: u32, lamp: Lamp) -> ActiveCode {
    ActiveCode { code: TroubleCode::new(spn, 31, 1).unwrap(), lamp }
}

fn frame(id: u32, data: &[u8]) -> Frame {
    Frame::classic(CanId::Extended(id), data).unwrap()
}

fn request(pgn: u32, to: u8) -> Frame {
    frame(0x18EA_0000 | u32::from(to) << 8 | u32::from(OTHER), &pgn_bytes(pgn))
}

fn claim_of(identity_number: u32) -> Frame {
    frame(0x18EE_FF00 | u32::from(ADDRESS), &name(identity_number).to_bytes())
}

#[derive(Debug, Clone, PartialEq)]
struct Message {
    ms: i64,
    pgn: u32,
    data: Vec<u8>,
}

impl Message {
    fn codes(&self) -> Vec<u32> {
        let codes = self.data[2..].chunks_exact(4).filter(|code| *code != [0, 0, 0, 0]);
        codes.map(|code| u32::from(code[0]) | u32::from(code[1]) << 8 | u32::from(code[2] >> 5) << 16).collect()
    }
}

struct Bench {
    node: Node,
    now_ms: i64,
    out: NodeOutputs,
    frames: Vec<(i64, Frame)>,
    events: Vec<NodeEvent>,
    messages: Vec<Message>,
    /// The running transfer: parameter group number, total number of bytes, bytes received so far.
    transfer: Option<(u32, usize, Vec<u8>)>,
}

impl Bench {
    fn new() -> Self {
        Self {
            node: Node::new(&NodeConfig { name: name(100), address: ADDRESS }),
            now_ms: 0,
            out: NodeOutputs::default(),
            frames: Vec::new(),
            events: Vec::new(),
            messages: Vec::new(),
            transfer: None,
        }
    }

    /// Starts the node at -50 ms. 300 ms later, at 250 ms, the node has its address.
    fn start(&mut self) {
        self.now_ms = -50;
        self.node.start(at(-50), &mut self.out);
    }

    /// A node that has its address, knows all values and has no active code. It sends the first DM1 at 250 ms.
    fn claimed() -> Self {
        let mut bench = Self::new();
        bench.set(&[]);
        bench.start();
        bench.run_to(250);
        assert_eq!(bench.events, [NodeEvent::Claimed { address: ADDRESS }]);
        bench
    }

    fn set(&mut self, codes: &[ActiveCode]) {
        self.node.set_codes(at(self.now_ms), codes, &[], true);
    }

    fn set_dm2(&mut self, active: &[ActiveCode], spns: std::ops::RangeInclusive<u32>) {
        let previously: Vec<_> = spns.map(|spn| TroubleCode::new(spn, 31, 1).unwrap()).collect();
        self.node.set_codes(at(self.now_ms), active, &previously, true);
    }

    fn receive(&mut self, frame: &Frame) {
        self.node.handle_frame(at(self.now_ms), frame, &mut self.out);
        self.take();
    }

    fn run_to(&mut self, ms: i64) {
        self.take();
        while self.now_ms < ms {
            self.now_ms += 1;
            self.node.poll(at(self.now_ms), &mut self.out);
            self.take();
        }
    }

    fn take(&mut self) {
        self.events.append(&mut self.out.events);
        for frame in std::mem::take(&mut self.out.frames) {
            self.deliver(&frame);
            self.frames.push((self.now_ms, frame));
        }
    }

    fn deliver(&mut self, frame: &Frame) {
        let header = Header::of(frame.id()).unwrap();
        let (pgn, data) = match (header.pgn, frame.data()) {
            (super::super::PGN_TRANSPORT_CONTROL, &[32, low, high, packets, 0xFF, a, b, c]) => {
                assert_eq!(self.transfer, None, "one transfer at a time");
                let bytes = usize::from(u16::from_le_bytes([low, high]));
                assert_eq!(bytes.div_ceil(7), usize::from(packets));
                self.transfer = Some((pgn_of([a, b, c]), bytes, Vec::new()));
                return;
            }
            (super::super::PGN_TRANSPORT_DATA, packet) => {
                let (pgn, bytes, mut data) = self.transfer.take().expect("announced");
                assert_eq!(usize::from(packet[0]), data.len() / 7 + 1, "sequence number");
                data.extend(&packet[1..]);
                if data.len() < bytes {
                    self.transfer = Some((pgn, bytes, data));
                    return;
                }
                assert!(data[bytes..].iter().all(|&byte| byte == 0xFF), "filled with 0xFF");
                data.truncate(bytes);
                (pgn, data)
            }
            (pgn @ (PGN_DM1 | PGN_DM2), data) => (pgn, data.to_vec()),
            _ => return,
        };
        self.messages.push(Message { ms: self.now_ms, pgn, data });
    }

    /// Time (ms) at which each message was complete, and its codes.
    fn received(&self, pgn: u32) -> Vec<(i64, Vec<u32>)> {
        self.messages.iter().filter(|m| m.pgn == pgn).map(|m| (m.ms, m.codes())).collect()
    }

    fn ids(&self) -> Vec<(i64, u32)> {
        self.frames.iter().map(|(ms, frame)| (*ms, frame.id().raw())).collect()
    }
}

#[test]
fn nothing_is_sent_before_start() {
    let mut bench = Bench::new();
    bench.set(&[active(1, Lamp::Red)]);
    bench.receive(&request(PGN_ADDRESS_CLAIMED, GLOBAL_ADDRESS));
    bench.run_to(3000);
    assert_eq!((bench.frames.len(), bench.node.next_due(), bench.node.is_silent()), (0, None, true));
}

#[test]
fn dm1_starts_300_ms_after_claim_and_repeats_each_second() {
    let mut bench = Bench::claimed();
    bench.run_to(3500);
    let dm1 = 0x18FE_CA00 | u32::from(ADDRESS);
    assert_eq!(bench.ids(), [(-50, 0x18EE_FFF9), (250, dm1), (1250, dm1), (2250, dm1), (3250, dm1)]);
    assert_eq!(bench.frames[1].1.data(), [0x00, 0xFF, 0, 0, 0, 0, 0xFF, 0xFF]);
}

#[test]
fn lamps_are_unknown_before_first_codes() {
    let mut bench = Bench::new();
    bench.start();
    bench.run_to(250);
    assert_eq!(bench.frames[1].1.data(), [0x3F, 0xFF, 0, 0, 0, 0, 0xFF, 0xFF]);
}

#[test]
fn change_is_sent_at_once_and_restarts_cycle() {
    let mut bench = Bench::claimed();
    bench.run_to(600);
    bench.set(&[active(1, Lamp::Amber)]);
    bench.run_to(1700);
    assert_eq!(bench.received(PGN_DM1), [(250, vec![]), (601, vec![1]), (1601, vec![1])]);
}

#[test]
fn flickering_code_changes_once_a_second() {
    let mut bench = Bench::claimed();
    for step in 0..100 {
        let codes = [active(1, Lamp::Amber)];
        bench.set(if step % 2 == 0 { &codes } else { &[] });
        bench.run_to(250 + 100 * (step + 1));
    }
    let mut changes = Vec::new();
    let mut before = vec![];
    for (ms, codes) in bench.received(PGN_DM1) {
        if codes != before {
            changes.push(ms);
            before = codes;
        }
    }
    assert!(changes.len() >= 9, "{changes:?}");
    assert!(changes.windows(2).all(|pair| pair[1] - pair[0] >= 1000), "{changes:?}");
}

#[test]
fn two_codes_are_sent_by_bam_every_50_ms() {
    let mut bench = Bench::claimed();
    bench.set(&[active(2, Lamp::Amber), active(1, Lamp::Red)]);
    bench.run_to(1000);
    assert_eq!(bench.ids()[2..], [(251, 0x1CEC_FFF9), (301, 0x1CEB_FFF9), (351, 0x1CEB_FFF9)]);
    assert_eq!(bench.frames[2].1.data(), [32, 10, 0, 2, 0xFF, 0xCA, 0xFE, 0]);
    assert_eq!(bench.frames[3].1.data(), [1, 0x14, 0xFF, 1, 0, 31, 1, 2]);
    assert_eq!(bench.frames[4].1.data(), [2, 0, 31, 1, 0xFF, 0xFF, 0xFF, 0xFF]);
}

#[test]
fn changed_codes_wait_for_end_of_transfer() {
    let mut bench = Bench::claimed();
    bench.set(&[active(1, Lamp::Red), active(2, Lamp::Red)]);
    bench.run_to(300);
    bench.set(&[active(1, Lamp::Red), active(2, Lamp::Red), active(3, Lamp::Red)]);
    bench.run_to(700);
    assert_eq!(bench.received(PGN_DM1), [(250, vec![]), (351, vec![1, 2]), (501, vec![1, 2, 3])]);
}

#[test]
fn transferred_change_counts_from_its_end() {
    let mut bench = Bench::claimed();
    bench.set(&[active(1, Lamp::Red), active(2, Lamp::Red)]);
    bench.run_to(400);
    bench.set(&[]);
    bench.run_to(3000);
    let wanted = [(351, vec![1, 2]), (1351, vec![1, 2]), (1351, vec![])];
    assert_eq!(bench.received(PGN_DM1)[1..4], wanted, "a second after the last packet, after the cyclic DM1");
}

#[test]
fn dm2_is_sent_on_request_with_current_lamps() {
    let mut bench = Bench::claimed();
    bench.set_dm2(&[active(9, Lamp::Amber)], 7..=7);
    bench.run_to(5000);
    assert_eq!(bench.received(PGN_DM2), []);
    for to in [ADDRESS, GLOBAL_ADDRESS] {
        bench.receive(&request(PGN_DM2, to));
        bench.run_to(bench.now_ms + 100);
    }
    assert_eq!(bench.received(PGN_DM2), [(5000, vec![7]), (5100, vec![7])]);
    assert_eq!(bench.messages.iter().find(|m| m.pgn == PGN_DM2).unwrap().data[..2], [0x04, 0xFF]);
    bench.receive(&request(PGN_DM2, OTHER));
    bench.run_to(6000);
    assert_eq!(bench.received(PGN_DM2).len(), 2, "a request to another node is ignored");
}

#[test]
fn requested_dm1_is_sent_between_cyclic_ones() {
    let mut bench = Bench::claimed();
    bench.run_to(700);
    bench.receive(&request(PGN_DM1, ADDRESS));
    bench.run_to(1300);
    assert_eq!(bench.received(PGN_DM1), [(250, vec![]), (700, vec![]), (1250, vec![])]);
}

#[test]
fn unknown_request_is_rejected_only_if_addressed() {
    let mut bench = Bench::claimed();
    bench.receive(&request(0xFEE5, GLOBAL_ADDRESS));
    bench.receive(&request(0xFEE5, OTHER));
    bench.run_to(300);
    assert_eq!(bench.frames.len(), 2, "claim and DM1");
    bench.receive(&request(0xFEE5, ADDRESS));
    let (_, refusal) = bench.frames[2];
    assert_eq!(refusal.id().raw(), 0x18E8_FFF9);
    assert_eq!(refusal.data(), [1, 0xFF, 0xFF, 0xFF, OTHER, 0xE5, 0xFE, 0x00]);
}

#[test]
fn request_for_claims_is_answered_with_claim() {
    for to in [ADDRESS, GLOBAL_ADDRESS] {
        let mut bench = Bench::claimed();
        bench.receive(&request(PGN_ADDRESS_CLAIMED, to));
        assert_eq!(bench.ids()[2], (250, 0x18EE_FFF9));
        assert_eq!(bench.frames[2].1.data(), name(100).to_bytes());
    }
}

#[test]
fn flood_of_requests_is_answered_every_50_ms() {
    let mut bench = Bench::claimed();
    let mut requests = 0;
    while bench.now_ms < 1250 {
        bench.receive(&request(0xF000 + requests, ADDRESS));
        requests += 1;
        bench.run_to(bench.now_ms + 1);
    }
    bench.run_to(1500);
    let refused = bench.ids().iter().filter(|(_, id)| *id == 0x18E8_FFF9).count();
    assert_eq!(refused, 24, "20 during the second plus the 4 pending ones");
    assert!(requests > 24);
    assert_eq!(bench.received(PGN_DM1).len(), 2, "DM1 continues");
}

#[test]
fn equal_requests_are_answered_once() {
    let mut bench = Bench::claimed();
    bench.set_dm2(&[active(1, Lamp::Red), active(2, Lamp::Red)], 3..=4);
    bench.run_to(260);
    for _ in 0..100 {
        bench.receive(&request(PGN_DM2, GLOBAL_ADDRESS));
    }
    bench.run_to(1000);
    assert_eq!(bench.received(PGN_DM2).len(), 1);
}

#[test]
fn long_dm1_and_dm2_alternate_during_flood() {
    let mut bench = Bench::claimed();
    let codes: Vec<_> = (1..=27).map(|spn| active(spn, Lamp::Amber)).collect();
    bench.set_dm2(&codes, 28..=54);
    while bench.now_ms < 20_000 {
        bench.receive(&request(PGN_DM2, ADDRESS));
        bench.receive(&request(0xF000, ADDRESS));
        bench.run_to(bench.now_ms + 10);
    }
    let (dm1, dm2) = (bench.received(PGN_DM1), bench.received(PGN_DM2));
    assert!(dm1.len() >= 11 && dm2.len() >= 10, "{} {}", dm1.len(), dm2.len());
    assert!(dm1.windows(2).all(|pair| pair[1].0 - pair[0].0 <= 2000), "{dm1:?}");
    assert!(dm1[1..].iter().all(|(_, codes)| codes.len() == 27));
}

#[test]
fn single_frame_dm1_is_sent_during_dm2_transfer() {
    let mut bench = Bench::claimed();
    bench.set_dm2(&[], 1..=27);
    bench.receive(&request(PGN_DM2, ADDRESS));
    bench.run_to(400);
    bench.set_dm2(&[active(99, Lamp::Red)], 1..=27);
    bench.run_to(402);
    assert_eq!(bench.received(PGN_DM1), [(250, vec![]), (401, vec![99])]);
    bench.run_to(2000);
    assert_eq!(bench.received(PGN_DM2), [(1050, (1..=27).collect())]);
}

#[test]
fn too_many_codes_send_most_severe_and_report_rest() {
    let mut bench = Bench::claimed();
    let codes: Vec<_> = (1..=30).map(|spn| active(spn, if spn > 5 { Lamp::Red } else { Lamp::Protect })).collect();
    bench.set(&codes);
    bench.run_to(1200);
    let received = bench.received(PGN_DM1);
    assert_eq!(received[1].1, (6..=30).chain(1..=2).collect::<Vec<u32>>());
    assert_eq!(received[1].1.len(), MAX_CODES);
    assert_eq!(bench.messages[1].data[0], 0x11, "the lamps include all codes");
    assert_eq!(bench.events[1..], [NodeEvent::CodesLeftOut { codes: 3 }]);
    bench.set(&[]);
    bench.run_to(4000);
    assert_eq!(bench.events[2..], [NodeEvent::CodesLeftOut { codes: 0 }]);
}

#[test]
fn longest_dm1_is_sent_once_a_second() {
    let mut bench = Bench::claimed();
    let codes: Vec<_> = (1..=27).map(|spn| active(spn, Lamp::Amber)).collect();
    bench.set(&codes);
    bench.run_to(10_300);
    let ends: Vec<i64> = bench.received(PGN_DM1)[1..].iter().map(|(ms, _)| *ms).collect();
    assert_eq!(ends.len(), 10);
    assert!(ends.windows(2).all(|pair| pair[1] - pair[0] == 1000), "{ends:?}");
}

#[test]
fn losing_address_stops_even_running_transfer() {
    let mut bench = Bench::claimed();
    bench.set(&[active(1, Lamp::Red), active(2, Lamp::Red)]);
    bench.run_to(310);
    bench.receive(&request(PGN_DM2, ADDRESS));
    bench.receive(&claim_of(99));
    let sent = bench.frames.len();
    bench.run_to(10_000);
    assert_eq!(bench.events[1..], [NodeEvent::AddressLost { to: name(99) }]);
    assert_eq!(bench.frames.len(), sent + 1);
    assert_eq!(bench.ids()[sent].1, 0x18EE_FFFE, "cannot claim");
    assert!(bench.node.is_silent());
    for pgn in [PGN_DM1, PGN_DM2, 0xF000] {
        bench.receive(&request(pgn, ADDRESS));
        bench.receive(&request(pgn, GLOBAL_ADDRESS));
    }
    bench.receive(&request(PGN_ADDRESS_CLAIMED, ADDRESS));
    bench.run_to(11_000);
    assert_eq!(bench.frames.len(), sent + 1, "the other node has the address and answers");
    bench.receive(&request(PGN_ADDRESS_CLAIMED, GLOBAL_ADDRESS));
    bench.run_to(12_000);
    assert_eq!(bench.ids()[sent + 1].1, 0x18EE_FFFE);
}

#[test]
fn weaker_contender_is_answered_and_dm1_continues() {
    let mut bench = Bench::claimed();
    bench.receive(&claim_of(101));
    bench.run_to(1300);
    assert_eq!(bench.events[1..], [NodeEvent::AddressDefended { against: name(101) }]);
    assert_eq!(bench.ids()[2], (250, 0x18EE_FFF9));
    assert_eq!(bench.received(PGN_DM1).len(), 2);
}

#[test]
fn gap_repeats_claim_and_codes() {
    let mut bench = Bench::claimed();
    bench.set(&[active(1, Lamp::Red)]);
    bench.run_to(300);
    bench.receive(&claim_of(99));
    bench.run_to(5000);
    bench.node.start(at(5000), &mut bench.out);
    bench.run_to(5300);
    assert_eq!(bench.events[2..], [NodeEvent::Claimed { address: ADDRESS }]);
    assert_eq!(bench.received(PGN_DM1).last(), Some(&(5300, vec![1])));
}

#[test]
fn code_active_during_claim_is_sent() {
    let mut bench = Bench::new();
    bench.start();
    bench.set(&[active(1, Lamp::Red)]);
    bench.run_to(100);
    bench.set(&[]);
    bench.run_to(1300);
    assert_eq!(bench.received(PGN_DM1), [(250, vec![1]), (1250, vec![])]);
}

#[test]
fn frames_for_other_nodes_are_ignored() {
    let mut bench = Bench::claimed();
    bench.receive(&frame(0x18EE_FF00 | u32::from(OTHER), &name(1).to_bytes()));
    bench.receive(&Frame::classic(CanId::Standard(0x7FF), &[0; 8]).unwrap());
    bench.receive(&Frame::remote(CanId::Extended(0x18EE_FFF9), 8).unwrap());
    bench.receive(&Frame::fd(CanId::Extended(0x18EE_FFF9), false, false, &[0; 8]).unwrap());
    bench.receive(&frame(0x19EA_F921, &[0, 0xEE, 0]));
    assert_eq!((bench.frames.len(), bench.events.len()), (2, 1));
}

#[test]
fn short_claims_and_requests_are_ignored() {
    let mut bench = Bench::claimed();
    bench.receive(&frame(0x18EE_FFF9, &[0; 7]));
    bench.receive(&frame(0x18EA_FF21, &[0, 0xEE]));
    assert_eq!((bench.frames.len(), bench.events.len()), (2, 1));
    assert!(!bench.node.is_silent());
}

#[test]
fn filters_pass_frames_for_this_node() {
    let node = Bench::new().node;
    let passes = |id: u32| node.wanted().iter().any(|(wanted, mask)| id & mask == *wanted);
    for id in [0x18EE_FFF9, 0x1CEE_FFF9, 0x18EA_F900, 0x18EA_FFFE, 0x00EA_FF21] {
        assert!(passes(id), "{id:08X}");
    }
    for id in [0x18EE_FF21, 0x18EA_2100, 0x18FE_CAF9, 0x19EA_FF21, 0x1CEC_FF21] {
        assert!(!passes(id), "{id:08X}");
    }
}
