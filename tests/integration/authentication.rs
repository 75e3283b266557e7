//! Tests command authentication against an attacker, across restarts, and in a journal replay. Forged, replayed,
//! delayed and outdated frames must never be executed. A genuine command must be executed, at the latest when its
//! sender repeats it.

mod ecu;

use packwatch::can::secoc::{Authentication, Profile};
use packwatch::can::{CanId, Frame};
use packwatch::io::can_key::CanKey;
use packwatch::monitor::{Downtime, EventKind, Monitor, Outputs, Record};
use packwatch::quantity::{BusIndex, Timestamp};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use ecu::{Daemon, Ecu, FRESHNESS, REPLY, config, frame_of, key};

const RECORDED: usize = 512;

/// An attacker who receives all traffic but has no key.
struct Attacker {
    rng: ChaCha8Rng,
    recorded: Vec<Frame>,
    /// Genuine frames that never arrived, with their creation times.
    withheld: Vec<(i64, Frame)>,
    frames: u64,
    of_kind: [u64; 6],
}

impl Attacker {
    fn record(&mut self, frame: Frame) {
        if self.recorded.len() == RECORDED {
            self.recorded.remove(0);
        }
        self.recorded.push(frame);
    }

    /// Returns a frame that must not be executed. `announced` is the last announcement; `other` is a sender with
    /// another key.
    fn frame(&mut self, now_ms: i64, announced: &Frame, other: &Ecu) -> Option<Frame> {
        let kind = self.rng.random_range(0..6);
        let fresh = freshness_of(announced) + self.rng.random_range(0..16);
        let old = |rng: &mut ChaCha8Rng, recorded: &[Frame]| recorded[rng.random_range(0..recorded.len())];
        let frame = match kind {
            0 => old(&mut self.rng, &self.recorded),
            1 => {
                // A frame withheld for longer than two announcement periods.
                let due = self.withheld.iter().position(|(made, _)| now_ms - made > 2000)?;
                self.withheld[due].1
            }
            2 => {
                let mut payload = old(&mut self.rng, &self.recorded).data().to_vec();
                let bit = self.rng.random_range(0..payload.len() * 8);
                payload[bit / 8] ^= 1 << (bit % 8);
                frame_of(&payload)
            }
            3 => {
                // A correct command with a fresh value but a random authenticator.
                let mut payload = other.encode_command(3, 2047, fresh).data().to_vec();
                other.authentication.write_mac(&mut payload, self.rng.random::<u128>().to_be_bytes());
                frame_of(&payload)
            }
            4 => other.encode_command(3, 2047, fresh),
            _ => {
                // The data of one recorded frame with the authenticator of another.
                let (a, b) = (old(&mut self.rng, &self.recorded), old(&mut self.rng, &self.recorded));
                if a.data()[..4] == b.data()[..4] {
                    return None;
                }
                frame_of(&[&a.data()[..4], &b.data()[4..]].concat())
            }
        };
        self.of_kind[kind] += 1;
        self.frames += 1;
        Some(frame)
    }
}

/// Delivers the daemon's sent frames to the ECU. Returns the last announcement.
fn deliver_sent_frames(daemon: &Daemon, ecu: &mut Ecu) -> Option<Frame> {
    daemon.sent.iter().for_each(|frame| ecu.handle_frame(frame));
    daemon.sent.iter().rev().find(|frame| frame.id() == CanId::standard(FRESHNESS).unwrap()).copied()
}

/// The announced freshness value. It is below 2^36, so the frame carries it completely.
fn freshness_of(announced: &Frame) -> u64 {
    let bits = announced.data().iter().fold(0, |bits, byte| bits << 8 | u64::from(*byte));
    bits >> Profile::Announcement.mac_bits()
}

fn attack(profile: Profile, frames: u64, seed: u64) {
    let mut daemon = Daemon::new(config(profile.name(), ""));
    let mut ecu = Ecu::new(profile, key(0xA0));
    let other = Ecu::new(profile, key(0xB0));
    let rng = ChaCha8Rng::seed_from_u64(seed);
    let mut attacker = Attacker { rng, recorded: Vec::new(), withheld: Vec::new(), frames: 0, of_kind: [0; 6] };
    let (mut announced, mut genuine, mut repeated, mut round) = (None, 0_u64, 0_u64, 0_u64);
    let mut stored = daemon.monitor.snapshot();
    while attacker.frames < frames {
        round += 1;
        daemon.pass(20);
        announced = deliver_sent_frames(&daemon, &mut ecu).or(announced);
        let Some(latest) = announced else { continue };
        if attacker.rng.random_range(0..40) == 0
            && let Some(frame) = ecu.command(attacker.rng.random_range(1..=3), 2047)
        {
            // If the command is rejected, repeat it with the next freshness value. The repetition must be executed.
            let mut sent = frame;
            let mut is_executed = daemon.receive(&sent);
            if !is_executed {
                repeated += 1;
                let codes = frame.data()[0] & 0x0F;
                sent = ecu.command(codes, 2047).unwrap_or_else(|| panic!("round {round}: no freshness left"));
                is_executed = daemon.receive(&sent);
            }
            assert!(is_executed, "round {round}: genuine frame was not executed");
            genuine += 1;
            attacker.record(frame);
            attacker.record(sent);
        }
        if attacker.rng.random_range(0..50) == 0
            && let Some(frame) = ecu.command(3, 2047)
        {
            attacker.withheld.push((daemon.ms, frame));
            attacker.withheld.drain(..attacker.withheld.len().saturating_sub(64));
        }
        if attacker.recorded.is_empty() {
            continue;
        }
        for _ in 0..30 {
            let executed = daemon.executed;
            if let Some(frame) = attacker.frame(daemon.ms, &latest, &other) {
                assert!(!daemon.receive(&frame), "round {round}: executed the attacker's {frame:?}");
                assert_eq!(daemon.executed, executed);
            }
        }
        if round % 300 == 0 {
            // Restart from a state up to six seconds old. In one of four restarts the clock has been set back.
            let downtime = [Downtime::AsStamped, Downtime::Unknown, Downtime::Seconds(3.0)][(round / 300 % 3) as usize];
            let away_ms = [50, 30_000, -4_000, 4_000_000][(round / 300 % 4) as usize];
            daemon.restart(stored.clone(), downtime, away_ms);
            attacker.withheld.iter_mut().for_each(|(made, _)| *made = i64::MIN / 2);
            ecu = Ecu::new(profile, key(0xA0));
            announced = deliver_sent_frames(&daemon, &mut ecu);
        } else if round % 300 == 10 {
            stored = daemon.monitor.snapshot();
        }
    }
    println!(
        "{profile:?}: {} frames of an attacker {:?}, 0 executed; {genuine} genuine commands, all executed, {repeated} on \
         repetition; {} authenticators computed",
        attacker.frames,
        attacker.of_kind,
        daemon.macs.borrow()
    );
    assert!(genuine > frames / 2000 && attacker.of_kind.iter().all(|count| *count > frames / 20));
    assert_eq!(daemon.executed, genuine);
    assert_eq!(daemon.monitor.dropped().count(), 0, "the flood limit dropped frames");
}

#[test]
fn only_genuine_frames_of_million_execute() {
    attack(Profile::P1, 1_000_000, 1);
}

#[test]
fn other_profiles_withstand_attacks() {
    attack(Profile::P3, 50_000, 2);
    attack(Profile::Fd, 50_000, 3);
}

#[test]
fn manual_example_matches_computed_authenticator() {
    let key = CanKey::parse(b"2b7e151628aed2a6abf7158809cf4f3c").unwrap();
    let mut ecu = Ecu::new(Profile::P1, key);
    ecu.authentication = Authentication { profile: Profile::P1, data_id: 0x124 };
    let frame = ecu.encode_command(2, 2047, 28_800_000_000);
    assert_eq!(format!("{frame:?}"), "Frame(6B3, Classic, [F2, F9, 3F, 00, 00, A2, 9B, 91])");
    let manual = include_str!("../../docs/src/ecu/commands.md");
    assert!(manual.contains("`F2F93F0000A29B91`"));
}

#[test]
fn every_command_reply_carries_reason() {
    let mut daemon = Daemon::new(config("1", ""));
    let mut ecu = Ecu::new(Profile::P1, key(0xA0));
    daemon.pass(1000);
    daemon.sent.iter().for_each(|frame| ecu.handle_frame(frame));
    let reply = |daemon: &Daemon| {
        let frame = daemon.sent.iter().rev().find(|frame| frame.id() == CanId::standard(REPLY).unwrap()).unwrap();
        let bits = u64::from_le_bytes(frame.data().try_into().unwrap());
        [(16, 3), (19, 4), (23, 4), (45, 9)].map(|(start, length): (u32, u32)| bits >> start & ((1 << length) - 1))
    };
    let first = ecu.command(1, 2047).unwrap();
    assert!(daemon.receive(&first));
    assert_eq!(reply(&daemon), [1, 7, 1, 511], "accepted without effect");
    daemon.pass(200);
    assert!(!daemon.receive(&first));
    assert_eq!(reply(&daemon), [2, 9, 15, 511], "old freshness: the reply does not repeat the content");
    daemon.pass(200);
    let mut forged = ecu.command(3, 2047).unwrap().data().to_vec();
    forged[7] ^= 1;
    assert!(!daemon.receive(&frame_of(&forged)));
    assert_eq!(reply(&daemon), [2, 8, 15, 511], "not authentic");
    (0..11).for_each(|_| assert!(!daemon.receive(&frame_of(&forged))));
    daemon.pass(1000);
    daemon.sent.iter().for_each(|frame| ecu.handle_frame(frame));
    assert!(!daemon.receive(&ecu.command(1, 2047).unwrap()));
    assert_eq!(reply(&daemon), [2, 10, 1, 511], "during an attack the sender must repeat the command");
    daemon.pass(200);
    assert!(daemon.receive(&ecu.command(1, 2047).unwrap()));
    daemon.pass(200);
    assert!(
        !daemon.receive(&ecu.command(2, 2047).unwrap()) && !daemon.receive(&ecu.command(3, 2047).unwrap()),
        "another"
    );
    daemon.pass(200_000);
    daemon.sent.iter().for_each(|frame| ecu.handle_frame(frame));
    assert!(daemon.receive(&ecu.command(2, 2047).unwrap()), "rejected after the end of the attack");
    let counts = daemon.counts();
    assert_eq!((counts.authentic, counts.unconfirmed), (3, 3));
}

#[test]
fn journal_replay_without_key_equals_live_run() {
    let more = "[output.alarm]\nfd = true\nsecoc = \"fd\"\ndata_id = 0x500\n[[alarm]]\nrule = \"input_missing\"\nwarning = 1\n";
    let config = config("1", &more.replace("[output.alarm]\n", "[output.digest]\n"));
    let mut daemon = Daemon::new(config.clone());
    daemon.journal = Some(Vec::new());
    daemon.monitor = Monitor::new(config.clone());
    let mut ecu = Ecu::new(Profile::P1, key(0xA0));
    for second in 0..60 {
        daemon.pass(1000);
        daemon.sent.iter().for_each(|frame| ecu.handle_frame(frame));
        let frame = ecu.command(1 + second % 3, 2047).unwrap();
        assert!(daemon.receive(&frame));
        assert!(!daemon.receive(&frame));
    }
    let live = serde_json::to_string(&daemon.monitor.snapshot()).unwrap();
    let (mut replay, mut out) = (Monitor::new(config), Outputs::default());
    for (ms, frame) in daemon.journal.take().unwrap() {
        let time = Timestamp::from_nanos(ms * 1_000_000);
        match &frame {
            None => replay.handle(&Record::tick(time), &mut out),
            Some((frame, freshness)) => {
                let input = Record::secured_frame(time, BusIndex(0), frame, *freshness);
                replay.handle(&input, &mut out);
            }
        }
    }
    assert_eq!(serde_json::to_string(&replay.snapshot()).unwrap(), live);
    let executed = out.events.iter().filter(|event| matches!(event.kind, EventKind::Command { .. })).count();
    assert_eq!(executed, 60);
    assert!(!live.contains("a0010203") && !live.contains("0102030405"), "the state contains the key");
}

#[test]
fn announcement_expires_after_two_seconds() {
    for (stalled_ms, is_executed) in [(1_900, true), (2_100, false)] {
        let mut daemon = Daemon::new(config("1", ""));
        let mut ecu = Ecu::new(Profile::P1, key(0xA0));
        daemon.pass(1000);
        daemon.sent.iter().for_each(|frame| ecu.handle_frame(frame));
        daemon.pass(20);
        // Send no ticks until about `stalled_ms` after the announcement, as if the main loop had stalled.
        let frame = ecu.command(1, 2047).unwrap();
        daemon.ms += stalled_ms - 20;
        assert_eq!(daemon.receive(&frame), is_executed, "{stalled_ms}");
    }
}

#[test]
fn frame_with_unchecked_authenticator_is_ignored() {
    let mut daemon = Daemon::new(config("1", ""));
    let mut ecu = Ecu::new(Profile::P1, key(0xA0));
    daemon.pass(1000);
    daemon.sent.iter().for_each(|frame| ecu.handle_frame(frame));
    let (frame, mut out) = (ecu.command(3, 2047).unwrap(), Outputs::default());
    let time = Timestamp::from_nanos(daemon.ms * 1_000_000);
    daemon.monitor.handle(&Record::frame(time, BusIndex(0), &frame), &mut out);
    assert_eq!((daemon.counts().forged, daemon.counts().authentic), (1, 0));
}

#[test]
fn sent_freshness_rises_across_restarts() {
    let frames = "[output.digest]\nfd = true\nsecoc = \"fd\"\ndata_id = 0x501\n[output.status]\nfd = true\nsecoc = \"fd\"\ndata_id = 0x502\ne2e = \"1C\"\n";
    let mut daemon = Daemon::new(config("1", frames));
    let of = |id: u32| Authentication { profile: Profile::Fd, data_id: if id == 0x6B0 { 0x502 } else { 0x501 } };
    let (mut last, mut verified) = ([0_u64; 2], 0);
    for run in 0..6 {
        let stored = daemon.monitor.snapshot();
        for _ in 0..20 {
            daemon.pass(1000);
            for frame in daemon.sent.iter().filter(|frame| matches!(frame.id().raw(), 0x6B0 | 0x6B4)) {
                let (authentication, last) = (of(frame.id().raw()), &mut last[usize::from(frame.id().raw() == 0x6B0)]);
                // Reconstruct the freshness as a receiver does: the lowest value above the last freshness that has the
                // received low bits.
                let sent = authentication.sent_freshness(frame.data()).unwrap();
                let freshness = *last + 1 + (sent.wrapping_sub(*last + 1) & 0xFFFF_FFFF);
                let freshness =
                    if *last == 0 { sent + (daemon.ms as u64 / 1000 * 256) / (1 << 32) * (1 << 32) } else { freshness };
                let input = authentication.mac_input(frame.data(), freshness).unwrap();
                assert!(authentication.has_mac(frame.data(), key(0xA0).mac(input.bytes())), "run {run}: {frame:?}");
                assert!(freshness > *last);
                (*last, verified) = (freshness, verified + 1);
            }
        }
        daemon.restart(stored, Downtime::AsStamped, 100);
    }
    assert!(verified > 1200, "{verified}");
}
