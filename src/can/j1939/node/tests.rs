//! The node on a fake bus with a fake clock, heard by a receiver that puts transfers together again.

use std::collections::BTreeMap;

use proptest::prelude::*;

use super::super::{Lamp, MAX_CODES, NameFields};
use super::*;

const OURS: u8 = 0xF9;
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
    frame(0x18EE_FF00 | u32::from(OURS), &name(identity_number).to_bytes())
}

/// A complete message as a receiver has it.
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

/// A node, its bus, and what was heard.
struct Bench {
    node: Node,
    now_ms: i64,
    out: NodeOutputs,
    frames: Vec<(i64, Frame)>,
    events: Vec<NodeEvent>,
    messages: Vec<Message>,
    /// Announced transfer: group, bytes, and what came of it.
    transfer: Option<(u32, usize, Vec<u8>)>,
}

impl Bench {
    fn new() -> Self {
        Self {
            node: Node::new(&NodeConfig { name: name(100), address: OURS }),
            now_ms: 0,
            out: NodeOutputs::default(),
            frames: Vec::new(),
            events: Vec::new(),
            messages: Vec::new(),
            transfer: None,
        }
    }

    /// Claimed, everything known, nothing active; the first DM1 is out at 250 ms.
    fn claimed() -> Self {
        let mut bench = Self::new();
        bench.set(&[]);
        bench.node.start(at(0), &mut bench.out);
        bench.run_to(250);
        assert_eq!(bench.events, [NodeEvent::Claimed { address: OURS }]);
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

    /// Polls every millisecond.
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
            self.hear(&frame);
            self.frames.push((self.now_ms, frame));
        }
    }

    fn hear(&mut self, frame: &Frame) {
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

    /// When each DM of a group was complete, and its codes.
    fn told(&self, pgn: u32) -> Vec<(i64, Vec<u32>)> {
        self.messages.iter().filter(|m| m.pgn == pgn).map(|m| (m.ms, m.codes())).collect()
    }

    fn ids(&self) -> Vec<(i64, u32)> {
        self.frames.iter().map(|(ms, frame)| (*ms, frame.id().raw())).collect()
    }
}

#[test]
fn nothing_is_sent_before_the_start() {
    let mut bench = Bench::new();
    bench.set(&[active(1, Lamp::Red)]);
    bench.receive(&request(PGN_ADDRESS_CLAIMED, GLOBAL_ADDRESS));
    bench.run_to(3000);
    assert_eq!((bench.frames.len(), bench.node.next_due(), bench.node.is_silent()), (0, None, true));
}

#[test]
fn the_first_dm1_comes_250_ms_after_the_claim_and_then_one_a_second_without_any_code() {
    let mut bench = Bench::claimed();
    bench.run_to(3500);
    let dm1 = 0x18FE_CA00 | u32::from(OURS);
    assert_eq!(bench.ids(), [(0, 0x18EE_FFF9), (250, dm1), (1250, dm1), (2250, dm1), (3250, dm1)]);
    assert_eq!(bench.frames[1].1.data(), [0x00, 0xFF, 0, 0, 0, 0, 0xFF, 0xFF]);
}

#[test]
fn without_any_word_about_the_alarms_every_lamp_is_unknown() {
    let mut bench = Bench::new();
    bench.node.start(at(0), &mut bench.out);
    bench.run_to(250);
    assert_eq!(bench.frames[1].1.data(), [0x3F, 0xFF, 0, 0, 0, 0, 0xFF, 0xFF]);
}

#[test]
fn a_change_is_sent_at_once_and_the_rhythm_starts_again_from_it() {
    let mut bench = Bench::claimed();
    bench.run_to(600);
    bench.set(&[active(1, Lamp::Amber)]);
    bench.run_to(1700);
    assert_eq!(bench.told(PGN_DM1), [(250, vec![]), (601, vec![1]), (1601, vec![1])]);
}

#[test]
fn a_flickering_code_changes_once_a_second_on_the_bus() {
    let mut bench = Bench::claimed();
    for step in 0..100 {
        let codes = [active(1, Lamp::Amber)];
        bench.set(if step % 2 == 0 { &codes } else { &[] });
        bench.run_to(250 + 100 * (step + 1));
    }
    let mut changes = Vec::new();
    let mut before = vec![];
    for (ms, codes) in bench.told(PGN_DM1) {
        if codes != before {
            changes.push(ms);
            before = codes;
        }
    }
    assert!(changes.len() >= 9, "{changes:?}");
    assert!(changes.windows(2).all(|pair| pair[1] - pair[0] >= 1000), "{changes:?}");
}

#[test]
fn two_codes_go_by_bam_with_50_ms_between_packets() {
    let mut bench = Bench::claimed();
    bench.set(&[active(2, Lamp::Amber), active(1, Lamp::Red)]);
    bench.run_to(1000);
    assert_eq!(bench.ids()[2..], [(251, 0x1CEC_FFF9), (301, 0x1CEB_FFF9), (351, 0x1CEB_FFF9)]);
    assert_eq!(bench.frames[2].1.data(), [32, 10, 0, 2, 0xFF, 0xCA, 0xFE, 0]);
    assert_eq!(bench.frames[3].1.data(), [1, 0x14, 0xFF, 1, 0, 31, 1, 2]);
    assert_eq!(bench.frames[4].1.data(), [2, 0, 31, 1, 0xFF, 0xFF, 0xFF, 0xFF]);
}

#[test]
fn a_changed_set_waits_for_the_transfers_end() {
    let mut bench = Bench::claimed();
    bench.set(&[active(1, Lamp::Red), active(2, Lamp::Red)]);
    bench.run_to(300);
    bench.set(&[active(1, Lamp::Red), active(2, Lamp::Red), active(3, Lamp::Red)]);
    bench.run_to(700);
    assert_eq!(bench.told(PGN_DM1), [(250, vec![]), (351, vec![1, 2]), (501, vec![1, 2, 3])]);
}

#[test]
fn a_transfer_counts_as_seen_at_its_end() {
    let mut bench = Bench::claimed();
    bench.set(&[active(1, Lamp::Red), active(2, Lamp::Red)]);
    bench.run_to(400);
    bench.set(&[]);
    bench.run_to(3000);
    let wanted = [(351, vec![1, 2]), (1351, vec![1, 2]), (1351, vec![])];
    assert_eq!(bench.told(PGN_DM1)[1..4], wanted, "a second after its last packet, behind the cyclic one");
}

#[test]
fn dm2_comes_only_when_asked_for_and_with_the_lamps_of_now() {
    let mut bench = Bench::claimed();
    bench.set_dm2(&[active(9, Lamp::Amber)], 7..=7);
    bench.run_to(5000);
    assert_eq!(bench.told(PGN_DM2), []);
    for to in [OURS, GLOBAL_ADDRESS] {
        bench.receive(&request(PGN_DM2, to));
        bench.run_to(bench.now_ms + 100);
    }
    assert_eq!(bench.told(PGN_DM2), [(5000, vec![7]), (5100, vec![7])]);
    assert_eq!(bench.messages.iter().find(|m| m.pgn == PGN_DM2).unwrap().data[..2], [0x04, 0xFF]);
    bench.receive(&request(PGN_DM2, OTHER));
    bench.run_to(6000);
    assert_eq!(bench.told(PGN_DM2).len(), 2, "what another is asked for is not ours");
}

#[test]
fn dm1_asked_for_is_sent_between_two_cyclic_ones() {
    let mut bench = Bench::claimed();
    bench.run_to(700);
    bench.receive(&request(PGN_DM1, OURS));
    bench.run_to(1300);
    assert_eq!(bench.told(PGN_DM1), [(250, vec![]), (700, vec![]), (1250, vec![])]);
}

#[test]
fn an_unknown_request_is_refused_when_it_is_for_us_alone() {
    let mut bench = Bench::claimed();
    bench.receive(&request(0xFEE5, GLOBAL_ADDRESS));
    bench.receive(&request(0xFEE5, OTHER));
    bench.run_to(300);
    assert_eq!(bench.frames.len(), 2, "claim and DM1");
    bench.receive(&request(0xFEE5, OURS));
    let (_, refusal) = bench.frames[2];
    assert_eq!(refusal.id().raw(), 0x18E8_FFF9);
    assert_eq!(refusal.data(), [1, 0xFF, 0xFF, 0xFF, OTHER, 0xE5, 0xFE, 0x00]);
}

#[test]
fn whoever_asks_hears_who_has_the_address() {
    for to in [OURS, GLOBAL_ADDRESS] {
        let mut bench = Bench::claimed();
        bench.receive(&request(PGN_ADDRESS_CLAIMED, to));
        assert_eq!(bench.ids()[2], (250, 0x18EE_FFF9));
        assert_eq!(bench.frames[2].1.data(), name(100).to_bytes());
    }
}

#[test]
fn a_flood_of_requests_is_answered_every_50_ms_and_what_is_dropped_is_counted() {
    let mut bench = Bench::claimed();
    let mut asked = 0;
    while bench.now_ms < 1250 {
        bench.receive(&request(0xF000 + asked, OURS));
        asked += 1;
        bench.run_to(bench.now_ms + 1);
    }
    bench.run_to(1500);
    let refused = bench.ids().iter().filter(|(_, id)| *id == 0x18E8_FFF9).count();
    assert_eq!(refused, 24, "20 in the second and the 4 that waited");
    assert_eq!(bench.node.counters().answers_dropped, u64::from(asked) - 24);
    assert_eq!(bench.told(PGN_DM1).len(), 2, "DM1 does not suffer");
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
    assert_eq!(bench.told(PGN_DM2).len(), 1);
    assert_eq!(bench.node.counters(), NodeCounters::default());
}

#[test]
fn long_dm1_and_dm2_take_turns_under_a_flood() {
    let mut bench = Bench::claimed();
    let codes: Vec<_> = (1..=27).map(|spn| active(spn, Lamp::Amber)).collect();
    bench.set_dm2(&codes, 28..=54);
    while bench.now_ms < 20_000 {
        bench.receive(&request(PGN_DM2, OURS));
        bench.receive(&request(0xF000, OURS));
        bench.run_to(bench.now_ms + 10);
    }
    let (dm1, dm2) = (bench.told(PGN_DM1), bench.told(PGN_DM2));
    assert!(dm1.len() >= 11 && dm2.len() >= 10, "{} {}", dm1.len(), dm2.len());
    assert!(dm1.windows(2).all(|pair| pair[1].0 - pair[0].0 <= 2000), "{dm1:?}");
    assert!(dm1[1..].iter().all(|(_, codes)| codes.len() == 27));
}

#[test]
fn a_dm1_of_one_frame_passes_a_dm2_under_way() {
    let mut bench = Bench::claimed();
    bench.set_dm2(&[], 1..=27);
    bench.receive(&request(PGN_DM2, OURS));
    bench.run_to(400);
    bench.set_dm2(&[active(99, Lamp::Red)], 1..=27);
    bench.run_to(402);
    assert_eq!(bench.told(PGN_DM1), [(250, vec![]), (401, vec![99])]);
    bench.run_to(2000);
    assert_eq!(bench.told(PGN_DM2), [(1050, (1..=27).collect())]);
}

#[test]
fn of_too_many_codes_the_most_severe_are_told_and_the_rest_is_counted() {
    let mut bench = Bench::claimed();
    let codes: Vec<_> = (1..=30).map(|spn| active(spn, if spn > 5 { Lamp::Red } else { Lamp::Protect })).collect();
    bench.set(&codes);
    bench.run_to(1200);
    let told = bench.told(PGN_DM1);
    assert_eq!(told[1].1, (6..=30).chain(1..=2).collect::<Vec<u32>>());
    assert_eq!(told[1].1.len(), MAX_CODES);
    assert_eq!(bench.messages[1].data[0], 0x11, "the lamps are those of all");
    assert_eq!(bench.events[1..], [NodeEvent::CodesLeftOut { codes: 3 }]);
    assert_eq!(bench.node.counters().codes_left_out, 3);
    bench.set(&[]);
    bench.run_to(4000);
    assert_eq!(bench.events[2..], [NodeEvent::CodesLeftOut { codes: 0 }]);
}

#[test]
fn the_longest_dm1_still_comes_once_a_second() {
    let mut bench = Bench::claimed();
    let codes: Vec<_> = (1..=27).map(|spn| active(spn, Lamp::Amber)).collect();
    bench.set(&codes);
    bench.run_to(10_300);
    let ends: Vec<i64> = bench.told(PGN_DM1)[1..].iter().map(|(ms, _)| *ms).collect();
    assert_eq!(ends.len(), 10);
    assert!(ends.windows(2).all(|pair| pair[1] - pair[0] == 1000), "{ends:?}");
}

#[test]
fn losing_the_address_stops_everything_even_within_a_transfer() {
    let mut bench = Bench::claimed();
    bench.set(&[active(1, Lamp::Red), active(2, Lamp::Red)]);
    bench.run_to(310);
    bench.receive(&request(PGN_DM2, OURS));
    bench.receive(&claim_of(99));
    let sent = bench.frames.len();
    bench.run_to(10_000);
    assert_eq!(bench.events[1..], [NodeEvent::AddressLost { to: name(99) }]);
    assert_eq!(bench.frames.len(), sent + 1);
    assert_eq!(bench.ids()[sent].1, 0x18EE_FFFE, "cannot claim");
    assert!(bench.node.is_silent());
    for pgn in [PGN_DM1, PGN_DM2, 0xF000] {
        bench.receive(&request(pgn, OURS));
        bench.receive(&request(pgn, GLOBAL_ADDRESS));
    }
    bench.receive(&request(PGN_ADDRESS_CLAIMED, OURS));
    bench.run_to(11_000);
    assert_eq!(bench.frames.len(), sent + 1, "the address is another's, it answers");
    bench.receive(&request(PGN_ADDRESS_CLAIMED, GLOBAL_ADDRESS));
    bench.run_to(12_000);
    assert_eq!(bench.ids()[sent + 1].1, 0x18EE_FFFE);
}

#[test]
fn a_weaker_contender_is_answered_and_dm1_goes_on() {
    let mut bench = Bench::claimed();
    bench.receive(&claim_of(101));
    bench.run_to(1300);
    assert_eq!(bench.events[1..], [NodeEvent::AddressDefended { against: name(101) }]);
    assert_eq!(bench.ids()[2], (250, 0x18EE_FFF9));
    assert_eq!(bench.told(PGN_DM1).len(), 2);
}

#[test]
fn after_a_gap_the_address_is_claimed_again_and_the_codes_told_again() {
    let mut bench = Bench::claimed();
    bench.set(&[active(1, Lamp::Red)]);
    bench.run_to(300);
    bench.receive(&claim_of(99));
    bench.run_to(5000);
    bench.node.handle_gap(at(5000), &mut bench.out);
    bench.run_to(5300);
    assert_eq!(bench.events[2..], [NodeEvent::Claimed { address: OURS }]);
    assert_eq!(bench.told(PGN_DM1).last(), Some(&(5250, vec![1])));
}

#[test]
fn what_was_active_while_the_address_was_being_claimed_is_told() {
    let mut bench = Bench::new();
    bench.node.start(at(0), &mut bench.out);
    bench.set(&[active(1, Lamp::Red)]);
    bench.run_to(100);
    bench.set(&[]);
    bench.run_to(1300);
    assert_eq!(bench.told(PGN_DM1), [(250, vec![1]), (1250, vec![])]);
}

#[test]
fn frames_that_are_no_business_of_ours_do_nothing() {
    let mut bench = Bench::claimed();
    bench.receive(&frame(0x18EE_FF00 | u32::from(OTHER), &name(1).to_bytes()));
    bench.receive(&Frame::classic(CanId::Standard(0x7FF), &[0; 8]).unwrap());
    bench.receive(&Frame::remote(CanId::Extended(0x18EE_FFF9), 8).unwrap());
    bench.receive(&Frame::fd(CanId::Extended(0x18EE_FFF9), false, false, &[0; 8]).unwrap());
    bench.receive(&frame(0x19EA_F921, &[0, 0xEE, 0]));
    assert_eq!((bench.frames.len(), bench.events.len()), (2, 1));
    assert_eq!(bench.node.counters(), NodeCounters::default());
}

#[test]
fn short_claims_and_requests_are_counted() {
    let mut bench = Bench::claimed();
    bench.receive(&frame(0x18EE_FFF9, &[0; 7]));
    bench.receive(&frame(0x18EA_FF21, &[0, 0xEE]));
    assert_eq!(bench.node.counters().malformed_frames, 2);
    assert!(!bench.node.is_silent());
}

#[test]
fn the_filters_let_through_what_concerns_the_node() {
    let node = Bench::new().node;
    let passes = |id: u32| node.wanted().iter().any(|(wanted, mask)| id & mask == *wanted);
    for id in [0x18EE_FFF9, 0x1CEE_FFF9, 0x18EA_F900, 0x18EA_FFFE, 0x00EA_FF21] {
        assert!(passes(id), "{id:08X}");
    }
    for id in [0x18EE_FF21, 0x18EA_2100, 0x18FE_CAF9, 0x19EA_FF21, 0x1CEC_FF21] {
        assert!(!passes(id), "{id:08X}");
    }
}

/// Something that may happen to a node.
#[derive(Debug, Clone)]
enum Act {
    Wait(u16),
    Poll,
    Set { spns: Vec<(u8, u8)>, previously: u8, all_known: bool },
    Frame { id: u32, data: Vec<u8> },
    Start,
    Gap,
}

fn act() -> impl Strategy<Value = Act> {
    // Identifiers that concern the node more often than chance would bring them.
    let id = prop_oneof![
        Just(0x18EE_FFF9_u32),
        Just(0x18EA_F921),
        Just(0x18EA_FF21),
        any::<u32>().prop_map(|id| id & 0x1FFF_FFFF)
    ];
    let data = prop_oneof![
        proptest::collection::vec(any::<u8>(), 0..=8),
        prop_oneof![Just(PGN_DM1), Just(PGN_DM2), Just(PGN_ADDRESS_CLAIMED), Just(0xF000)]
            .prop_map(|pgn| pgn_bytes(pgn).to_vec()),
        (98_u32..102).prop_map(|number| name(number).to_bytes().to_vec()),
    ];
    let spns = proptest::collection::vec((0_u8..40, 0_u8..4), 0..40);
    prop_oneof![
        6 => (0_u16..700).prop_map(Act::Wait),
        6 => Just(Act::Poll),
        3 => (spns, any::<u8>(), any::<bool>())
            .prop_map(|(spns, previously, all_known)| Act::Set { spns, previously: previously % 40, all_known }),
        4 => (id, data).prop_map(|(id, data)| Act::Frame { id, data }),
        1 => Just(Act::Start),
        1 => Just(Act::Gap),
    ]
}

fn lamp_of(number: u8) -> Lamp {
    [Lamp::None, Lamp::Protect, Lamp::Amber, Lamp::Red][usize::from(number % 4)]
}

fn perform(bench: &mut Bench, act: &Act) {
    match act {
        Act::Wait(ms) => {
            // As a driver that sleeps until something is due.
            let end = bench.now_ms + i64::from(*ms);
            while let Some(due) = bench.node.next_due().filter(|due| *due <= at(end)) {
                bench.now_ms = (due.nanos() + 999_999) / 1_000_000;
                bench.node.poll(at(bench.now_ms), &mut bench.out);
                bench.take();
            }
            bench.now_ms = end;
        }
        Act::Poll => bench.node.poll(at(bench.now_ms), &mut bench.out),
        Act::Set { spns, previously, all_known } => {
            let codes: Vec<_> = spns.iter().map(|&(spn, lamp)| active(u32::from(spn) + 1, lamp_of(lamp))).collect();
            let previously: Vec<_> = (0..u32::from(*previously)).map(|n| active(n + 1, Lamp::None).code).collect();
            bench.node.set_codes(at(bench.now_ms), &codes, &previously, *all_known);
        }
        Act::Frame { id, data } => bench.node.handle_frame(at(bench.now_ms), &frame(*id, data), &mut bench.out),
        Act::Start => {
            bench.transfer = None;
            bench.node.start(at(bench.now_ms), &mut bench.out);
        }
        Act::Gap => {
            bench.transfer = None;
            bench.node.handle_gap(at(bench.now_ms), &mut bench.out);
        }
    }
    if bench.node.is_silent() {
        bench.transfer = None;
    }
    bench.take();
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 128, ..ProptestConfig::default() })]

    #[test]
    fn whatever_happens_the_node_keeps_its_promises(acts in proptest::collection::vec(act(), 1..120)) {
        let sent_ids = NodeConfig { name: name(100), address: OURS }.sent_ids();
        let mut bench = Bench::new();
        for act in &acts {
            let heard = bench.frames.len();
            let was_silent = bench.node.is_silent();
            perform(&mut bench, act);
            let claims_only = was_silent && bench.node.is_silent() && !matches!(act, Act::Wait(_));
            for (_, frame) in &bench.frames[heard..] {
                let is_claim = frame.id().raw() & 0x00FF_FF00 == 0x00EE_FF00;
                prop_assert!(is_claim || !claims_only, "{frame:?} from a silent node");
                prop_assert!(sent_ids.contains(&frame.id()));
            }
            // A driver that sleeps until something is due neither spins nor sleeps for ever.
            bench.node.poll(at(bench.now_ms), &mut bench.out);
            bench.take();
            if let Some(due) = bench.node.next_due() {
                prop_assert!(due > at(bench.now_ms), "due {due:?} at {}", bench.now_ms);
            }
            prop_assert!(bench.node.is_silent() || bench.node.next_due().is_some());
        }
        let packets: Vec<i64> =
            bench.ids().iter().filter(|(_, id)| id >> 16 == 0x1CEB).map(|(ms, _)| *ms).collect();
        prop_assert!(packets.windows(2).all(|pair| pair[1] - pair[0] >= 50), "{packets:?}");
    }

    #[test]
    fn no_code_changes_twice_within_a_second_and_none_is_lost(
        sets in proptest::collection::vec((0_i64..900, proptest::collection::btree_set(1_u32..6, 0..5)), 1..40)
    ) {
        let mut bench = Bench::claimed();
        let mut became_active: BTreeMap<u32, usize> = BTreeMap::new();
        let mut before = std::collections::BTreeSet::new();
        for (wait_ms, spns) in sets {
            bench.run_to(bench.now_ms + wait_ms);
            let codes: Vec<_> = spns.iter().map(|&spn| active(spn, Lamp::Amber)).collect();
            bench.set(&codes);
            for spn in spns.difference(&before) {
                became_active.entry(*spn).or_insert(bench.messages.len());
            }
            before = spns;
        }
        bench.run_to(bench.now_ms + 4000);
        let told = bench.told(PGN_DM1);
        let last: std::collections::BTreeSet<u32> = told.last().unwrap().1.iter().copied().collect();
        prop_assert_eq!(&last, &before, "in the end the bus knows what is");
        for (spn, from) in became_active {
            prop_assert!(told[from..].iter().any(|(_, codes)| codes.contains(&spn)), "{} was never told", spn);
            let mut changes = Vec::new();
            let mut shown = false;
            for (ms, codes) in &told {
                if codes.contains(&spn) != shown {
                    shown = !shown;
                    changes.push(*ms);
                }
            }
            prop_assert!(changes.windows(2).all(|pair| pair[1] - pair[0] >= 1000), "{}: {:?}", spn, changes);
        }
    }
}
