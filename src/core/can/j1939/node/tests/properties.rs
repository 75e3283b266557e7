//! Tests properties of the J1939 node that must hold for any sequence of inputs.

use std::collections::BTreeMap;

use proptest::prelude::*;

use super::*;

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
    // Identifiers of messages to the node are chosen more often.
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
            // Simulates the program around the node: it sleeps until the node has something to send, but polls the node
            // at most once a tick (here 1 ms).
            let (end, mut next_tick) = (bench.now_ms + i64::from(*ms), bench.now_ms);
            while let Some(due) = bench.node.next_due().filter(|due| *due <= at(end) && next_tick <= end) {
                bench.now_ms = next_tick.max(due.nanos().saturating_add(999_999) / 1_000_000);
                bench.node.poll(at(bench.now_ms), &mut bench.out);
                bench.take();
                next_tick = bench.now_ms + 1;
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
            bench.node.start(at(bench.now_ms), &mut bench.out);
        }
    }
    if bench.node.is_silent() {
        bench.transfer = None;
    }
    bench.take();
}

/// Gives the same inputs to two nodes. Polls the first node only when it has something to send, and the second node
/// every millisecond.
fn sleeping_and_polled(acts: &[Act]) -> (Bench, Bench) {
    let (mut sleeper, mut busy) = (Bench::new(), Bench::new());
    for act in acts {
        perform(&mut sleeper, act);
        match act {
            Act::Wait(ms) => {
                busy.node.poll(at(busy.now_ms), &mut busy.out);
                busy.run_to(busy.now_ms + i64::from(*ms));
            }
            Act::Poll | Act::Set { .. } | Act::Frame { .. } | Act::Start | Act::Gap => perform(&mut busy, act),
        }
        if busy.node.is_silent() {
            busy.transfer = None;
        }
    }
    (sleeper, busy)
}

/// While a long DM2 (previously active codes) is sent, both codes of the DM1 (active codes) become inactive. The DM1
/// then fits into one frame.
#[test]
fn dm1_shortened_during_transfer_is_due() {
    let set = |spns: &[(u8, u8)], previously| Act::Set { spns: spns.to_vec(), previously, all_known: true };
    let dm2 = Act::Frame { id: 0x18EA_FF21, data: pgn_bytes(PGN_DM2).to_vec() };
    let waits = |ms: &[u16]| ms.iter().map(|&ms| Act::Wait(ms)).collect::<Vec<_>>();
    let acts =
        [vec![set(&[(0, 0), (1, 0)], 0), Act::Start], waits(&[130, 471]), vec![set(&[], 25), dm2], waits(&[487, 312])];
    let (sleeper, busy) = sleeping_and_polled(&acts.concat());
    assert_eq!(sleeper.frames, busy.frames);
    assert_eq!(busy.received(PGN_DM1).last().unwrap(), &(1400, vec![]));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 128, ..ProptestConfig::default() })]

    /// A replay skips all polls before the due time; a live daemon does not. Both must give the same frames.
    #[test]
    fn polls_before_due_time_change_nothing(acts in proptest::collection::vec(act(), 1..60)) {
        let (sleeper, busy) = sleeping_and_polled(&acts);
        prop_assert_eq!(sleeper.frames, busy.frames);
        prop_assert_eq!(sleeper.events, busy.events);
    }

    #[test]
    fn node_keeps_its_limits_for_any_input(acts in proptest::collection::vec(act(), 1..120)) {
        let sent_ids = NodeConfig { name: name(100), address: ADDRESS }.sent_ids();
        let mut bench = Bench::new();
        for act in &acts {
            let before = bench.frames.len();
            let was_silent = bench.node.is_silent();
            perform(&mut bench, act);
            let claims_only = was_silent && bench.node.is_silent() && !matches!(act, Act::Wait(_));
            for (_, frame) in &bench.frames[before..] {
                let is_claim = frame.id().raw() & 0x00FF_FF00 == 0x00EE_FF00;
                prop_assert!(is_claim || !claims_only, "{frame:?} from a silent node");
                prop_assert!(sent_ids.contains(&frame.id()));
            }
            // The program around the node must neither poll without pause nor sleep forever.
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
    fn codes_change_once_a_second_and_none_is_lost(
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
        let received = bench.received(PGN_DM1);
        let last: std::collections::BTreeSet<u32> = received.last().unwrap().1.iter().copied().collect();
        prop_assert_eq!(&last, &before, "the last message must show the current codes");
        for (spn, from) in became_active {
            prop_assert!(received[from..].iter().any(|(_, codes)| codes.contains(&spn)), "{} was never sent", spn);
            let mut changes = Vec::new();
            let mut shown = false;
            for (ms, codes) in &received {
                if codes.contains(&spn) != shown {
                    shown = !shown;
                    changes.push(*ms);
                }
            }
            prop_assert!(changes.windows(2).all(|pair| pair[1] - pair[0] >= 1000), "{}: {:?}", spn, changes);
        }
    }
}
