//! Replies to commands, the digest's pages, and counters over a kill of the daemon, on hand-made frames.

use packwatch::alarm::Rule;
use packwatch::can::e2e::{Profile, Protection};
use packwatch::can::encode::CommandRefusal;
use packwatch::can::{CanId, Frame};
use packwatch::monitor::{Downtime, EventKind, Input, Monitor};
use packwatch::quantity::BusIndex;

use crate::support::rig::{Rig, command_frame, learned};

const STATUS: u32 = 0x6B0;
const DIGEST: u32 = 0x6B4;
const REPLY: u32 = 0x6B5;
const HOT: &str = "[[alarm]]\nrule = \"temperature_high\"\nwarning = { set = 50, clear = 45 }\n";

impl Rig {
    fn frames_with(&self, id: u32) -> Vec<Frame> {
        self.frames.iter().filter(|frame| frame.id() == CanId::standard(id).unwrap()).copied().collect()
    }

    /// Result, reason, command, expected counter, changed and refused of the last reply.
    fn last_reply(&self) -> [u64; 6] {
        let frame = *self.frames_with(REPLY).last().unwrap();
        [(16, 3), (19, 4), (23, 4), (45, 9), (54, 6), (60, 4)].map(|(start, length)| field(&frame, start, length))
    }

    fn send_raw(&mut self, frame: &Frame) {
        let time = self.now();
        self.give(Input::Frame { time, bus: BusIndex(0), frame });
    }

    fn last_refusal(&self) -> Option<(bool, Option<CommandRefusal>)> {
        self.events.iter().rev().find_map(|event| match event.kind {
            EventKind::BadCommand { intact, reason, .. } => Some((intact, reason)),
            _ => None,
        })
    }

    /// A field of the last frame of a digest's page.
    fn digest(&self, page: u64, start: u32, length: u32) -> u64 {
        let frames = self.frames_with(DIGEST);
        field(frames.iter().rev().find(|frame| field(frame, 16, 4) == page).unwrap(), start, length)
    }
}

fn field(frame: &Frame, start: u32, length: u32) -> u64 {
    u64::from_le_bytes(frame.data().try_into().unwrap()) >> start & ((1 << length) - 1)
}

#[test]
fn every_command_frame_has_a_reply_with_its_reason_and_the_counter_expected() {
    const NONE: u64 = 63;
    let mut rig = learned();
    rig.command(1, 31, 2047);
    assert_eq!(rig.last_reply(), [2, 1, 1, 1, NONE, 15], "the first frame only shows the counter");
    assert_eq!(rig.last_refusal(), Some((true, Some(CommandRefusal::FirstFrame))), "it is intact");
    rig.command(1, 1, 0);
    assert_eq!(rig.last_reply(), [1, 0, 1, 2, 1, 0]);
    rig.seconds(2);
    rig.send_raw(&command_frame(1, 1, 0, 1));
    assert_eq!(rig.last_reply(), [2, 3, 1, 2, NONE, 15], "repeated");
    let mut harmed: [u8; 8] = command_frame(2, 31, 2047, 2).data().try_into().unwrap();
    harmed[4] ^= 1;
    rig.send_raw(&Frame::classic(CanId::Standard(1715), &harmed).unwrap());
    assert_eq!(rig.last_reply(), [2, 2, 15, 2, NONE, 15], "what cannot be trusted is not repeated");
    rig.seconds(2);
    rig.send_raw(&command_frame(1, 1, 0, 9));
    assert_eq!(rig.last_reply(), [2, 4, 1, 2, NONE, 15], "skipped too far");
    rig.send_raw(&command_frame(9, 31, 2047, 2));
    assert_eq!(rig.last_reply(), [2, 5, 15, 3, NONE, 15], "no meaning");
    rig.seconds(2);
    rig.send_raw(&command_frame(2, 31, 2047, 3));
    assert_eq!(rig.last_reply(), [2, 6, 2, 4, 0, 2], "both cells are beyond their threshold");
    rig.send_raw(&command_frame(1, 1, 0, 4));
    assert_eq!(rig.last_reply(), [1, 7, 1, 5, 0, 0], "acknowledged before");
}

#[test]
fn a_flood_of_commands_has_few_replies() {
    let mut rig = learned();
    for _ in 0..30 {
        rig.command(1, 31, 2047);
    }
    assert_eq!(rig.frames_with(REPLY).len(), 5);
    rig.seconds(3);
    rig.command(1, 31, 2047);
    assert_eq!(rig.frames_with(REPLY).len(), 6, "and again after a pause");
}

#[test]
fn the_digest_shows_raised_and_unknown_rules_and_exact_thresholds() {
    let mut rig = Rig::new(&format!("{HOT}[[alarm]]\nrule = \"store_failed\"\nsevere = 1\n"));
    rig.seconds(3);
    let rule = |rig: &Rig, number: u32| rig.digest(1, 20 + 3 * (number - 1), 3);
    assert_eq!((rule(&rig, 9), rule(&rig, 13), rule(&rig, 1)), (0, 4, 5), "judged, unknown, not watched");
    rig.give(Input::Store { time: rig.now(), works: true });
    rig.heat(60.0, 3);
    assert_eq!((rule(&rig, 9), rule(&rig, 13)), (2, 0));
    assert_eq!((rig.digest(0, 20, 12), rig.digest(0, 32, 3)), (1, 2), "one warning");
    let thresholds = rig.frames_with(DIGEST).into_iter().filter(|frame| field(frame, 16, 4) == 2);
    let bits = |frame: &Frame| f32::from_bits(u32::try_from(field(frame, 27, 32)).unwrap());
    let mut shown: Vec<_> =
        thresholds.map(|frame| (field(&frame, 20, 5), field(&frame, 25, 2), bits(&frame).to_string())).collect();
    shown.sort();
    shown.dedup();
    assert_eq!(shown, [(9, 2, "50".to_owned()), (13, 3, "1".to_owned())]);
}

#[test]
fn leaving_unknown_is_announced_four_times_and_once_more_after_a_kill() {
    for is_killed in [false, true] {
        let mut rig = Rig::new(HOT);
        rig.temperatures_c = [None; 2];
        rig.seconds(3);
        assert_eq!(rig.last_wire(Rule::TemperatureHigh).state, 6);
        if is_killed {
            rig.restart(Downtime::Seconds(2.0));
        }
        rig.frames.clear();
        rig.heat(25.0, 4);
        let states: Vec<u8> = rig.wire().iter().map(|wire| wire.state).skip_while(|state| *state == 6).collect();
        assert_eq!(states, [0; 4], "killed: {is_killed}");
    }
}

#[test]
fn counters_after_a_kill_are_those_of_a_daemon_that_never_stopped() {
    let status = Protection { profile: Profile::P01A, data_id: 1 };
    let digest = Protection { profile: Profile::P01A, data_id: 2 };
    let text = "[output.status]\ne2e = \"1A\"\ndata_id = 1\n[output.digest]\ne2e = \"1A\"\ndata_id = 2\n";
    let last = |rig: &Rig, id, protection: Protection| {
        protection.verified_counter(rig.frames_with(id).last().unwrap().data()).unwrap()
    };
    for (unstored_deci, away_deci) in [(0, 3), (7, 0), (16, 2), (130, 25), (31, 600)] {
        let mut rig = Rig::new(text);
        rig.seconds(4);
        let stored = rig.monitor.snapshot();
        (0..unstored_deci).for_each(|_| rig.tick_with_frames());
        let before = [last(&rig, STATUS, status), last(&rig, DIGEST, digest)];
        let passed = rig.frames_with(DIGEST).len();
        rig.monitor = Monitor::new(rig.config.clone());
        let age_s = (unstored_deci + away_deci) as f64 / 10.0;
        rig.monitor.restore(stored, Downtime::Seconds(age_s)).unwrap();
        rig.deci += away_deci;
        rig.frames.clear();
        rig.tick();
        let first = status.verified_counter(rig.frames_with(STATUS)[0].data()).unwrap();
        let periods = (i64::from(first) - i64::from(before[0])).rem_euclid(15);
        let wanted = (away_deci + 1).rem_euclid(15);
        assert!(
            (wanted..=wanted + 1).contains(&periods),
            "{unstored_deci} {away_deci}: {periods} after {away_deci} lost periods"
        );
        assert!(passed > 0);
        rig.seconds(2);
        let first = digest.verified_counter(rig.frames_with(DIGEST)[0].data()).unwrap();
        let pages = (i64::from(first) - i64::from(before[1])).rem_euclid(15);
        assert!(pages % 4 == 1, "{unstored_deci} {away_deci}: whole periods of four pages: {pages}");
    }
}

#[test]
fn a_state_of_an_earlier_program_is_restored_and_its_alarms_are_sent() {
    let mut rig = Rig::new(HOT);
    rig.heat(60.0, 3);
    let mut stored = serde_json::to_value(rig.monitor.snapshot()).unwrap();
    let schedule = stored["schedule"].as_object_mut().unwrap();
    for key in ["digest", "threshold_turn", "reply", "alarms"] {
        assert!(schedule.remove(key).is_some(), "{key}");
    }
    let counters = schedule["counters"].as_object_mut().unwrap();
    assert!(counters.remove("digest").is_some() && counters.remove("reply").is_some());
    rig.monitor = Monitor::new(rig.config.clone());
    rig.monitor.restore(serde_json::from_value(stored).unwrap(), Downtime::Seconds(1.0)).unwrap();
    rig.deci += 10;
    rig.frames.clear();
    rig.seconds(4);
    assert_eq!(rig.last_wire(Rule::TemperatureHigh).state, 1);
    assert!(rig.wire().len() >= 6, "twice a second: {}", rig.wire().len());
    assert_eq!(rig.digest(0, 20, 12), 1);
}
