//! Tests replies to commands, the digest (a cyclic summary of all alarms), and counters across a kill of the daemon.

use packwatch::alarm::Rule;
use packwatch::can::e2e::{Profile, Protection};
use packwatch::can::encode::CommandRefusal;
use packwatch::can::{CanId, Frame};
use packwatch::monitor::{Downtime, EventKind, Monitor, Record};
use packwatch::quantity::BusIndex;

use crate::support::config_texts;
use crate::support::rig::{DBC, PACK, Rig, command_frame, learned};

const STATUS: u32 = 0x6B0;
const HEALTH: u32 = 0x6B1;
const ALARM: u32 = 0x6B2;
const DIGEST: u32 = 0x6B4;
const REPLY: u32 = 0x6B5;
const HOT: &str = "[[alarm]]\nrule = \"temperature_high\"\nwarning = { set = 50, clear = 45 }\n";

impl Rig {
    fn frames_with(&self, id: u32) -> Vec<Frame> {
        self.frames.iter().filter(|frame| frame.id() == CanId::standard(id).unwrap()).copied().collect()
    }

    /// Fields of the last reply: result, reason, command, expected counter, changed, refused.
    fn last_reply(&self) -> [u64; 6] {
        let frame = *self.frames_with(REPLY).last().unwrap();
        [(16, 3), (19, 4), (23, 4), (45, 9), (54, 6), (60, 4)].map(|(start, length)| field(&frame, start, length))
    }

    fn send_raw(&mut self, frame: &Frame) {
        let time = self.now();
        self.give(Record::frame(time, BusIndex(0), frame));
    }

    fn last_refusal(&self) -> Option<(bool, Option<CommandRefusal>)> {
        self.events.iter().rev().find_map(|event| match event.kind {
            EventKind::BadCommand { intact, reason, .. } => Some((intact, Some(reason))),
            _ => None,
        })
    }

    fn digest(&self, page: u64, start: u32, length: u32) -> u64 {
        let frames = self.frames_with(DIGEST);
        field(frames.iter().rev().find(|frame| field(frame, 16, 4) == page).unwrap(), start, length)
    }
}

fn field(frame: &Frame, start: u32, length: u32) -> u64 {
    u64::from_le_bytes(frame.data().try_into().unwrap()) >> start & ((1 << length) - 1)
}

#[test]
fn every_command_reply_states_reason_and_counter() {
    const NONE: u64 = 63;
    let mut rig = learned();
    rig.command(1, 31, 2047);
    assert_eq!(rig.last_reply(), [2, 1, 1, 1, NONE, 15], "the first frame only shows the counter");
    assert_eq!(rig.last_refusal(), Some((true, Some(CommandRefusal::FirstFrame))), "the first frame is intact");
    rig.command(1, 1, 0);
    assert_eq!(rig.last_reply(), [1, 0, 1, 2, 1, 0]);
    rig.seconds(2);
    rig.send_raw(&command_frame(1, 1, 0, 1));
    assert_eq!(rig.last_reply(), [2, 3, 1, 2, NONE, 15], "repeated");
    let mut harmed: [u8; 8] = command_frame(2, 31, 2047, 2).data().try_into().unwrap();
    harmed[4] ^= 1;
    rig.send_raw(&Frame::classic(CanId::Standard(1715), &harmed).unwrap());
    assert_eq!(rig.last_reply(), [2, 2, 15, 2, NONE, 15], "the reply does not repeat untrusted content");
    rig.seconds(2);
    rig.send_raw(&command_frame(1, 1, 0, 9));
    assert_eq!(rig.last_reply(), [2, 4, 1, 2, NONE, 15], "the counter skips too far");
    rig.send_raw(&command_frame(9, 31, 2047, 2));
    assert_eq!(rig.last_reply(), [2, 5, 15, 3, NONE, 15], "no meaning");
    rig.seconds(2);
    rig.send_raw(&command_frame(2, 31, 2047, 3));
    assert_eq!(rig.last_reply(), [2, 6, 2, 4, 0, 2], "both cells are beyond their threshold");
    rig.send_raw(&command_frame(1, 1, 0, 4));
    assert_eq!(rig.last_reply(), [1, 7, 1, 5, 0, 0], "acknowledged before");
}

#[test]
fn acknowledge_reply_follows_changed_alarm_frames() {
    let mut rig = learned();
    rig.command(1, 31, 2047);
    rig.seconds(2);
    rig.frames.clear();
    rig.command(1, 31, 2047);
    let is_alarm = |frame: &Frame| frame.id() == CanId::standard(ALARM).unwrap();
    let reply = rig.frames.iter().position(|frame| frame.id() == CanId::standard(REPLY).unwrap()).unwrap();
    let last_alarm = rig.frames.iter().rposition(is_alarm).unwrap();
    assert!(last_alarm < reply, "{:?}", rig.frames);
    let acknowledged: Vec<_> = rig.wire().iter().filter(|wire| wire.acknowledged).map(|wire| wire.cell).collect();
    assert_eq!(acknowledged, [0, 1], "one frame of each alarm that the command changed");
    assert_eq!(rig.last_reply(), [1, 0, 1, 2, 2, 0], "two alarms must change");
}

#[test]
fn long_downtime_restarts_all_cyclic_frames() {
    for away in [Downtime::Seconds(1.0), Downtime::Seconds(2.3), Downtime::Seconds(60.0), Downtime::Unknown] {
        // The daemon stops at the end of a period, or 0.1 s or 0.6 s later.
        for more_deci in [0, 1, 6] {
            let mut rig = Rig::new("");
            rig.seconds(3);
            (0..more_deci).for_each(|_| rig.tick_with_frames());
            rig.restart(away);
            rig.frames.clear();
            let cyclic = |rig: &Rig| {
                let pages = |id| rig.frames_with(id).iter().map(|frame| field(frame, 16, 4)).collect::<Vec<_>>();
                (rig.frames_with(STATUS).len(), pages(HEALTH), pages(DIGEST))
            };
            rig.tick();
            assert_eq!(cyclic(&rig), (1, (0..5).collect(), (0..4).collect()), "{away:?} {more_deci}");
            (0..10).for_each(|_| rig.tick());
            let twice = |pages: u64| (0..pages).chain(0..pages).collect();
            assert_eq!(cyclic(&rig), (11, twice(5), twice(4)), "{away:?} {more_deci}");
        }
    }
}

#[test]
fn short_downtime_keeps_cyclic_periods() {
    for more_deci in [0, 3, 6] {
        let mut rig = Rig::new("");
        rig.seconds(3);
        (0..more_deci).for_each(|_| rig.tick_with_frames());
        let stopped = rig.deci;
        rig.restart(Downtime::Seconds(0.3));
        // The first tick comes 0.3 s after the stop.
        rig.deci -= 1;
        let restarted = rig.deci;
        rig.frames.clear();
        let mut firsts = [HEALTH, DIGEST].map(|id| (id, 0));
        while firsts.iter().any(|(_, deci)| *deci == 0) {
            rig.tick();
            for (id, deci) in firsts.iter_mut().filter(|(_, deci)| *deci == 0) {
                *deci = if rig.frames_with(*id).is_empty() { 0 } else { rig.deci };
            }
        }
        // The periods of 1 s start with the first tick of the first run, 0.1 s after the start of the test.
        let due = stopped / 10 * 10 + if stopped % 10 < 1 { 1 } else { 11 };
        let wanted = due.max(restarted + 1);
        assert_eq!(firsts.map(|(_, deci)| deci), [wanted; 2], "{more_deci}: not all at the first tick");
    }
}

#[test]
fn cleared_alarm_is_sent_four_times() {
    let mut rig = Rig::new(HOT);
    rig.heat(60.0, 6);
    rig.frames.clear();
    rig.heat(25.0, 6);
    let states: Vec<u8> = rig.wire().iter().map(|wire| wire.state).filter(|state| *state != 1).collect();
    assert_eq!(states, [2; 4]);
}

#[test]
fn digest_shows_unjudged_rule_as_unknown() {
    let rule = |rig: &Rig, number: u32| rig.digest(1, 20 + 3 * (number - 1), 3);
    let soc = "[[alarm]]\nrule = \"soc_low\"\nwarning = \"5 %\"\n";
    let mut rig = Rig::new(&format!("{HOT}{soc}"));
    rig.heat(60.0, 6);
    assert_eq!([9, 8, 1].map(|number| rule(&rig, number)), [2, 0, 5], "warning; evaluated without alarm; no threshold");
    rig.restart(Downtime::Seconds(60.0));
    rig.frames.clear();
    rig.tick();
    assert_eq!([9, 8, 1].map(|number| rule(&rig, number)), [2, 4, 5], "no input received yet");
    rig.seconds(3);
    assert_eq!([9, 8].map(|number| rule(&rig, number)), [2, 0]);
    let mut rig = Rig::new(HOT);
    rig.temperatures_c = [Some(25.0), None];
    rig.seconds(12);
    assert_eq!(rule(&rig, 9), 4);
}

#[test]
fn command_flood_gets_few_replies() {
    let mut rig = learned();
    for _ in 0..30 {
        rig.command(1, 31, 2047);
    }
    assert_eq!(rig.frames_with(REPLY).len(), 5);
    rig.seconds(3);
    rig.command(1, 31, 2047);
    assert_eq!(rig.frames_with(REPLY).len(), 6, "replies resume after a pause");
}

#[test]
fn digest_shows_rule_states_and_thresholds() {
    let mut rig = Rig::new(&format!("{HOT}[[alarm]]\nrule = \"store_failed\"\nsevere = 1\n"));
    rig.seconds(3);
    let rule = |rig: &Rig, number: u32| rig.digest(1, 20 + 3 * (number - 1), 3);
    assert_eq!((rule(&rig, 9), rule(&rig, 13), rule(&rig, 1)), (0, 4, 5), "evaluated; unknown; no threshold");
    rig.give(Record::store(rig.now(), true));
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
fn end_of_unknown_is_announced_across_kill() {
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

/// Protected messages of the counter tests: identifier, data id, frames per period, period in tenths of a second.
const COUNTED: [(u32, u16, i64, i64); 4] =
    [(STATUS, 1, 1, 1), (HEALTH, 2, 5, 10), (ALARM, 3, 1, 5), (DIGEST, 4, 4, 10)];

fn protected_rig(profile: Profile) -> Rig {
    let keys = |data_id: u32| format!("fd = true\ne2e = \"{}\"\ndata_id = {data_id}\n", profile.name());
    let pack = PACK
        .replace("name = \"can0\"\n", "name = \"can0\"\nfd = true\n")
        .replace("period_ms = 500\n", &format!("period_ms = 500\n{}", keys(3)));
    let more = [("status", 1), ("health", 2), ("digest", 4)].map(|(name, id)| format!("[output.{name}]\n{}", keys(id)));
    Rig::with(config_texts::load(&format!("{pack}{}{HOT}", more.concat()), DBC).monitor)
}

/// Counters of the frames with this identifier. All frames must be intact.
fn counters(rig: &Rig, id: u32, protection: Protection) -> Vec<i64> {
    let counter = |frame: &Frame| protection.verified_counter(frame.data()).unwrap().into();
    rig.frames_with(id).iter().map(counter).collect()
}

/// Age of the stored state at the kill, and time from the kill to the first tick of the next run, in tenths of a
/// second.
const KILLS: [(i64, i64); 5] = [(0, 3), (7, 0), (16, 2), (130, 25), (31, 600)];

/// Kills a daemon with one raised alarm. For each message of [`COUNTED`], returns the step of the counter over the
/// kill, and the smallest and largest step that are possible if the daemon does not stop.
fn steps_over_a_kill(profile: Profile, unstored_deci: i64, away_deci: i64) -> [(i64, [i64; 2]); 4] {
    let mut rig = protected_rig(profile);
    // Raise the alarm and wait for its repetitions. After them the daemon sends the alarm only at its regular period.
    rig.heat(60.0, 6);
    let stored = rig.monitor.snapshot();
    (0..unstored_deci).for_each(|_| rig.tick_with_frames());
    let of = |data_id| Protection { profile, data_id };
    let before = COUNTED.map(|(id, data_id, ..)| *counters(&rig, id, of(data_id)).last().unwrap());
    rig.monitor = Monitor::new(rig.config.clone());
    let age_s = (unstored_deci + away_deci) as f64 / 10.0;
    rig.monitor.restore(stored, Downtime::Seconds(age_s)).unwrap();
    rig.deci += away_deci;
    rig.frames.clear();
    rig.tick();
    assert_eq!(rig.frames_with(STATUS).len(), 1, "{profile:?} {unstored_deci} {away_deci}: at the first tick");
    // Each of the other messages follows within its period.
    (0..9).for_each(|_| rig.tick());
    let turn = i64::from(profile.max_counter()) + 1;
    std::array::from_fn(|n| {
        let (id, data_id, frames, period_deci) = COUNTED[n];
        let first = counters(&rig, id, of(data_id))[0];
        let lost = away_deci / period_deci;
        let allowed = [lost, lost + 1].map(|periods| (periods * frames + 1).rem_euclid(turn));
        ((first - before[n]).rem_euclid(turn), allowed)
    })
}

#[test]
fn counters_after_kill_match_uninterrupted_daemon() {
    for profile in [Profile::P01A, Profile::P01C, Profile::P05] {
        for (unstored_deci, away_deci) in KILLS {
            let steps = steps_over_a_kill(profile, unstored_deci, away_deci);
            for ((id, ..), (steps, allowed)) in COUNTED.into_iter().zip(steps).filter(|((id, ..), _)| *id != ALARM) {
                assert!(
                    allowed.contains(&steps),
                    "{profile:?} {id:X} {unstored_deci} {away_deci}: {steps} steps, must be one of {allowed:?}"
                );
            }
        }
    }
}

#[test]
fn alarm_counter_after_kill_matches_uninterrupted_daemon() {
    for (unstored_deci, away_deci) in KILLS {
        let (steps, allowed) = steps_over_a_kill(Profile::P05, unstored_deci, away_deci)[2];
        assert!(allowed.contains(&steps), "{unstored_deci} {away_deci}: {steps} steps, must be one of {allowed:?}");
    }
}

#[test]
fn reply_counter_is_not_reused_after_kill() {
    let mut rig = Rig::new("[output.reply]\ne2e = \"1C\"\ndata_id = 5\n");
    rig.seconds(2);
    rig.command(1, 31, 2047);
    let stored = rig.monitor.snapshot();
    rig.command(9, 31, 2047);
    rig.monitor = Monitor::new(rig.config.clone());
    rig.monitor.restore(stored, Downtime::Seconds(0.5)).unwrap();
    rig.deci += 5;
    rig.command(1, 31, 2047);
    assert_eq!(counters(&rig, REPLY, Protection { profile: Profile::P01C, data_id: 5 }), [0, 1, 2]);
}

#[test]
fn counters_continue_from_state_after_unknown_downtime() {
    for profile in [Profile::P01A, Profile::P01C, Profile::P05] {
        let mut rig = protected_rig(profile);
        rig.heat(60.0, 6);
        let next = COUNTED.map(|(id, data_id, ..)| {
            let last = *counters(&rig, id, Protection { profile, data_id }).last().unwrap();
            (last + 1) % (i64::from(profile.max_counter()) + 1)
        });
        let firsts = |rig: &Rig| COUNTED.map(|(id, data_id, ..)| counters(rig, id, Protection { profile, data_id })[0]);
        rig.restart(Downtime::Unknown);
        rig.frames.clear();
        rig.seconds(1);
        assert_eq!(firsts(&rig), next, "{profile:?}");
        rig.monitor = Monitor::new(rig.config.clone());
        rig.frames.clear();
        rig.seconds(6);
        assert_eq!(firsts(&rig), [0; 4], "{profile:?}");
    }
}
