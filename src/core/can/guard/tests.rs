//! Tests messages that fail and recover, missing frames, and the effects of a restart.

#![allow(clippy::unwrap_used, reason = "tests may panic")]

use super::*;
use crate::can::e2e::{Profile, Protection};

const BUS: BusIndex = BusIndex(0);
const ID: CanId = CanId::Standard(0x100);
const PERIOD_NS: i64 = 100_000_000;

fn config(id: CanId, cycle_time_s: Option<f64>) -> GuardConfig {
    let protection = Protection { profile: Profile::P01A, data_id: 0x0123 };
    GuardConfig { bus: BUS, id, check: CheckConfig::new(protection), cycle_time_s }
}

fn guards(cycle_time_s: Option<f64>) -> Guards {
    Guards::new(vec![config(CanId::Standard(0x200), None), config(ID, cycle_time_s)])
}

fn frame(counter: u8) -> Frame {
    let mut payload = [7; 8];
    config(ID, None).check.protection.protect(&mut payload, counter).unwrap();
    Frame::classic(ID, &payload).unwrap()
}

fn damaged() -> Frame {
    Frame::classic(ID, &[0; 8]).unwrap()
}

/// A time in tenths of a period after the start.
fn at(tenths: i64) -> Timestamp {
    Timestamp::from_nanos(1_700_000_000_000_000_000 + tenths * PERIOD_NS / 10)
}

fn changes(guards: &mut Guards) -> Vec<(Status, bool, u64)> {
    guards.changes.drain(..).map(|change| (change.status, change.usable, change.count)).collect()
}

fn count(guards: &Guards, status: Status) -> u64 {
    guards.counts().find(|of| of.id == ID).unwrap().counts.get(status)
}

#[test]
fn only_protected_messages_are_checked() {
    let mut guards = guards(None);
    assert_eq!(guards.check(at(0), BUS, &frame(0)), Some(Status::Initial));
    assert_eq!(guards.check(at(0), BusIndex(1), &frame(1)), None);
    assert_eq!(guards.check(at(0), BUS, &Frame::classic(CanId::Extended(0x100), &[0; 8]).unwrap()), None);
    assert_eq!(guards.check(at(0), BUS, &Frame::remote(ID, 8).unwrap()), None, "a remote request carries no data");
    assert_eq!(guards.check(at(0), BUS, &frame(1)), Some(Status::Ok));
    assert_eq!(Guards::default().check(at(0), BUS, &frame(0)), None);
}

#[test]
fn failing_message_is_reported_once_and_on_recovery() {
    let mut guards = guards(None);
    [frame(0), frame(1)].iter().for_each(|frame| assert!(guards.check(at(0), BUS, frame).is_some()));
    assert_eq!(changes(&mut guards), [], "a first frame is not a failure");
    (0..5).for_each(|_| assert_eq!(guards.check(at(1), BUS, &damaged()), Some(Status::WrongCrc)));
    assert_eq!(changes(&mut guards), [(Status::WrongCrc, false, 1)]);
    assert_eq!(guards.check(at(2), BUS, &frame(1)), Some(Status::Repeated));
    assert_eq!(guards.check(at(2), BUS, &frame(2)), Some(Status::Ok));
    assert_eq!(changes(&mut guards), [(Status::Ok, true, 6)]);
    assert_eq!((count(&guards, Status::WrongCrc), count(&guards, Status::Repeated)), (5, 1));
}

#[test]
fn missed_periods_count_once_for_any_poll_rate() {
    let mut guards = guards(Some(0.1));
    guards.check(at(0), BUS, &frame(0));
    guards.check(at(10), BUS, &frame(1));
    for tenths in 11..=24 {
        guards.poll(at(tenths));
    }
    assert_eq!(count(&guards, Status::NoNewData), 0, "none missed before one and a half periods");
    for tenths in 25..=54 {
        guards.poll(at(tenths));
    }
    assert_eq!(count(&guards, Status::NoNewData), 3);
    assert_eq!(changes(&mut guards), [(Status::NoNewData, false, 2)], "the configuration allows one lost frame");
    assert_eq!(guards.check(at(57), BUS, &frame(6)), Some(Status::OkSomeLost), "the missed frames were counted");
    assert_eq!(changes(&mut guards), [(Status::OkSomeLost, true, 4)]);
    assert_eq!(count(&guards, Status::NoNewData), 4, "including the one before this frame");
}

#[test]
fn allowed_number_of_missed_frames_changes_nothing() {
    let mut guards = guards(Some(0.1));
    guards.check(at(0), BUS, &frame(0));
    for turn in 1..=100 {
        let counter = u8::try_from(2 * turn % 15).unwrap();
        assert_eq!(guards.check(at(20 * turn), BUS, &frame(counter)), Some(Status::OkSomeLost));
    }
    assert_eq!((count(&guards, Status::NoNewData), changes(&mut guards)), (100, vec![]));
}

#[test]
fn missed_periods_do_not_depend_on_poll_times() {
    let (mut often, mut rarely) = (guards(Some(0.1)), guards(Some(0.1)));
    for guards in [&mut often, &mut rarely] {
        guards.check(at(0), BUS, &frame(0));
    }
    (0..=1000).for_each(|tenths| often.poll(at(tenths)));
    rarely.poll(at(1000));
    assert_eq!(count(&often, Status::NoNewData), 99);
    assert!(often.counts().eq(rarely.counts()));
}

#[test]
fn absent_message_is_missed_from_first_poll() {
    let mut guards = guards(Some(0.1));
    guards.poll(at(0));
    guards.poll(at(100));
    assert_eq!(count(&guards, Status::NoNewData), 9);
    assert_eq!(changes(&mut guards), [(Status::NoNewData, false, 9)]);
}

#[test]
fn after_sleep_nothing_is_missed_and_frame_is_initial() {
    let mut guards = guards(Some(0.1));
    guards.check(at(0), BUS, &frame(0));
    guards.check(at(10), BUS, &frame(1));
    guards.restart();
    guards.poll(at(1_000_000));
    assert_eq!(guards.check(at(1_000_001), BUS, &frame(9)), Some(Status::Initial));
    assert_eq!(guards.check(at(1_000_011), BUS, &frame(10)), Some(Status::Ok));
    assert_eq!((count(&guards, Status::NoNewData), changes(&mut guards)), (0, vec![]));
}

#[test]
fn failed_message_is_reported_usable_after_restart() {
    let mut guards = guards(None);
    guards.check(at(0), BUS, &damaged());
    guards.restart();
    assert_eq!(guards.check(at(1), BUS, &frame(3)), Some(Status::Initial));
    assert_eq!(guards.check(at(2), BUS, &frame(4)), Some(Status::Ok));
    assert_eq!(changes(&mut guards), [(Status::WrongCrc, false, 1), (Status::Ok, true, 2)]);
}

#[test]
fn snapshot_keeps_counts_but_no_counter() {
    let mut before = guards(Some(0.1));
    [frame(0), frame(1), damaged()].iter().for_each(|frame| assert!(before.check(at(0), BUS, frame).is_some()));
    let text = serde_json::to_string(&before.counts().collect::<Vec<_>>()).unwrap();
    let mut after = guards(Some(0.1));
    after.restore(&serde_json::from_str::<Vec<GuardCounts>>(&text).unwrap());
    assert!(after.counts().eq(before.counts()));
    assert_eq!(after.check(at(50), BUS, &frame(2)), Some(Status::Initial), "not OK: frames in between are unknown");
    let mut other = Guards::new(vec![config(CanId::Standard(0x300), None)]);
    other.restore(&before.counts().collect::<Vec<_>>());
    assert_eq!(other.counts().map(|of| of.counts.total()).sum::<u64>(), 0, "the message is no longer protected");
}
