//! Tests every pair of receiver state and input, and realistic sequences of frames.

#![allow(clippy::unwrap_used, reason = "tests may panic")]

use super::*;

const LAST: u8 = 7;

/// Classes of receiver states. LastValidCounter is 7, except in `Waiting`.
#[derive(Debug, Clone, Copy, PartialEq)]
enum State {
    /// No frame was accepted yet.
    Waiting,
    /// The last frame was valid. The next call accepts a counter step of up to 2.
    Following,
    /// The sequence is broken, and 2 more valid frames are required.
    Syncing,
    /// There were more periods without a frame than the configuration allows.
    Silent,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Input {
    NoFrame,
    Short,
    Damaged,
    Invalid15,
    Same,
    Next,
    OneLost,
    TooFar,
}

const STATES: [State; 4] = [State::Waiting, State::Following, State::Syncing, State::Silent];
const EVENTS: [Input; 8] = [
    Input::NoFrame,
    Input::Short,
    Input::Damaged,
    Input::Invalid15,
    Input::Same,
    Input::Next,
    Input::OneLost,
    Input::TooFar,
];

fn config(profile: Profile, sync: u8) -> CheckConfig {
    let protection = Protection { profile, data_id: 0x0123 };
    CheckConfig { protection, max_delta_counter_init: 1, max_no_new_or_repeated_data: 3, sync_counter_init: sync }
}

fn in_state(state: State) -> Receiver {
    let following = Receiver { last_valid: Some(LAST), max_delta: 1, ..Receiver::default() };
    match state {
        State::Waiting => Receiver::default(),
        State::Following => following,
        State::Syncing => Receiver { sync: 2, ..following },
        State::Silent => Receiver { no_new_or_repeated: 4, max_delta: 5, ..following },
    }
}

fn frame(config: &CheckConfig, counter: u8) -> [u8; 8] {
    let mut payload = [0x55; 8];
    config.protection.protect(&mut payload, counter).unwrap();
    payload
}

fn apply(receiver: &mut Receiver, config: &CheckConfig, what: Input) -> Status {
    let counter = match what {
        Input::NoFrame => return receiver.no_new_data(config, 1),
        Input::Short => return receiver.check(config, &[0]),
        Input::Damaged => {
            let mut payload = frame(config, LAST + 1);
            payload[5] ^= 1;
            return receiver.check(config, &payload);
        }
        Input::Invalid15 => return receiver.check(config, &counter_15(config)),
        Input::Same => LAST,
        Input::Next => LAST + 1,
        Input::OneLost => LAST + 2,
        Input::TooFar => LAST + 7,
    };
    receiver.check(config, &frame(config, counter))
}

/// A frame with counter 15. In profile 1, the counter is invalid and the CRC is correct. In profile 5, where 15 is a
/// valid counter, the frame belongs to another message.
fn counter_15(config: &CheckConfig) -> [u8; 8] {
    let mut payload = frame(config, 14);
    let other = Protection { data_id: 0x0456, ..config.protection };
    match config.protection.profile {
        Profile::P01A | Profile::P01C => {
            payload[1] |= 0x0F;
            payload[0] = config.protection.crc8(&payload);
        }
        Profile::P05 => other.protect(&mut payload, 15).unwrap(),
    }
    payload
}

/// Expected result of AUTOSAR's check: the status, then LastValidCounter, MaxDeltaCounter, NoNewOrRepeatedDataCounter
/// and SyncCounter. `sync` is SyncCounterInit.
fn wanted(profile: Profile, state: State, what: Input, sync: u8) -> (Status, (Option<u8>, u8, u8, u8)) {
    use Input::{Damaged, Invalid15, Next, NoFrame, OneLost, Same, Short, TooFar};
    use State::{Following, Silent, Syncing, Waiting};
    let before = in_state(state);
    let (last, grown) = (before.last_valid, before.max_delta + 1);
    let (repeated, syncing) = (before.no_new_or_repeated, before.sync);
    let at = |step: u8| Some(LAST + step);
    // After too long a silence, synchronisation is required and starts with this frame.
    let left = sync.saturating_sub(1);
    let after_silence = |normal| if sync > 0 { Status::Sync } else { normal };
    match (state, what) {
        (_, NoFrame) => (Status::NoNewData, (last, grown, repeated + 1, syncing)),
        (_, Short | Damaged | Invalid15) => (Status::WrongCrc, (last, grown, repeated, syncing)),
        (Waiting, Same) => (Status::Initial, (at(0), 1, 0, 0)),
        (Waiting, Next) => (Status::Initial, (at(1), 1, 0, 0)),
        (Waiting, OneLost) => (Status::Initial, (at(2), 1, 0, 0)),
        (Waiting, TooFar) => (Status::Initial, (at(7), 1, 0, 0)),
        (Following | Syncing | Silent, Same) => (Status::Repeated, (last, grown, repeated + 1, syncing)),
        (Following, Next) => (Status::Ok, (at(1), 1, 0, 0)),
        (Following, OneLost) => (Status::OkSomeLost, (at(2), 1, 0, 0)),
        (Syncing, Next) => (Status::Sync, (at(1), 1, 0, 1)),
        (Syncing, OneLost) => (Status::Sync, (at(2), 1, 0, 1)),
        (Silent, Next) => (after_silence(Status::Ok), (at(1), 1, 0, left)),
        (Silent, OneLost) => (after_silence(Status::OkSomeLost), (at(2), 1, 0, left)),
        (Following | Syncing | Silent, TooFar) if sync > 0 || profile == Profile::P05 => {
            (Status::WrongSequence, (at(7), 1, 0, sync))
        }
        (Following | Syncing | Silent, TooFar) => (Status::WrongSequence, (last, grown, 0, 0)),
    }
}

#[test]
fn state_and_event_pairs_follow_standard() {
    for profile in [Profile::P01A, Profile::P01C, Profile::P05] {
        for (sync, state, what) in [0, 2]
            .into_iter()
            .flat_map(|sync| STATES.map(|state| (sync, state)))
            .flat_map(|(s, t)| EVENTS.map(|e| (s, t, e)))
        {
            let mut receiver = in_state(state);
            let status = apply(&mut receiver, &config(profile, sync), what);
            let after = (receiver.last_valid, receiver.max_delta, receiver.no_new_or_repeated, receiver.sync);
            assert_eq!(
                (status, after),
                wanted(profile, state, what, sync),
                "{profile:?} {state:?} {what:?}, sync {sync}"
            );
            assert_eq!((receiver.counts().get(status), receiver.counts().total()), (1, 1));
        }
    }
}

#[test]
fn lost_frames_are_accepted_up_to_allowed_step() {
    let config = CheckConfig { max_delta_counter_init: 3, ..config(Profile::P01A, 0) };
    for (step, status) in [(1, Status::Ok), (4, Status::OkSomeLost), (5, Status::WrongSequence)] {
        let mut receiver = Receiver { last_valid: Some(13), max_delta: 3, ..Receiver::default() };
        let counter = (13 + step) % 15;
        assert_eq!(receiver.check(&config, &frame(&config, counter)), status, "{step} steps, with wrap-around");
    }
}

#[test]
fn profile_1_without_sync_waits_for_sender_counter() {
    let config = config(Profile::P01A, 0);
    let mut receiver = in_state(State::Following);
    // The sender's counter is 6 ahead. It grows by 1 per frame, and so does the largest allowed step.
    let statuses: Vec<_> = (0..11).map(|n| receiver.check(&config, &frame(&config, (LAST + 6 + n) % 15))).collect();
    assert!(statuses[..9].iter().all(|status| *status == Status::WrongSequence), "{statuses:?}");
    assert_eq!(statuses[9..], [Status::Repeated, Status::Ok]);
}

#[test]
fn profile_5_continues_after_counter_jump() {
    let config = config(Profile::P05, 0);
    let mut receiver = in_state(State::Following);
    let statuses = [100, 101, 102].map(|counter| receiver.check(&config, &frame(&config, counter)));
    assert_eq!(statuses, [Status::WrongSequence, Status::Ok, Status::Ok]);
}

#[test]
fn counter_jump_costs_configured_sync_frames() {
    let config = config(Profile::P01C, 2);
    let mut receiver = in_state(State::Following);
    let statuses = [14, 0, 1, 2].map(|counter| receiver.check(&config, &frame(&config, counter)));
    assert_eq!(statuses, [Status::WrongSequence, Status::Sync, Status::Sync, Status::Ok]);
}

#[test]
fn endless_silence_keeps_counters_in_range() {
    for profile in [Profile::P01A, Profile::P05] {
        let config = CheckConfig::new(config(profile, 0).protection);
        let mut receiver = in_state(State::Following);
        (0..1000).for_each(|_| assert_eq!(receiver.no_new_data(&config, 1), Status::NoNewData));
        assert_eq!((receiver.no_new_or_repeated, receiver.max_delta), (14, profile.max_counter()));
        assert_eq!(receiver.check(&config, &frame(&config, 3)), Status::OkSomeLost, "any counter except the last");
    }
}

#[test]
fn restart_waits_for_first_frame_and_keeps_counts() {
    let config = config(Profile::P01A, 0);
    let mut receiver = in_state(State::Following);
    assert_eq!(receiver.check(&config, &frame(&config, 8)), Status::Ok);
    receiver.restart();
    assert_eq!(receiver.check(&config, &frame(&config, 9)), Status::Initial);
    assert_eq!((receiver.counts().get(Status::Ok), receiver.counts().get(Status::Initial)), (1, 1));
}

#[test]
fn statuses_serialise_with_number_and_name() {
    for (number, status) in Status::ALL.into_iter().enumerate() {
        assert_eq!(status as usize, number);
        assert_eq!(serde_json::to_string(&status).unwrap(), format!("\"{}\"", status.name()));
    }
}

#[test]
fn only_intact_frames_in_sequence_are_usable() {
    let usable: Vec<_> = Status::ALL.into_iter().filter(|status| status.is_usable()).collect();
    assert_eq!(usable, [Status::Ok, Status::Sync, Status::OkSomeLost]);
}

#[test]
fn every_check_and_missed_period_is_counted() {
    let config = config(Profile::P01A, 0);
    let mut receiver = Receiver::default();
    for what in [Input::Same, Input::Next, Input::Damaged, Input::Short] {
        apply(&mut receiver, &config, what);
    }
    receiver.no_new_data(&config, 3);
    let expected = [1, 3, 2, 0, 1, 0, 0, 0];
    let counts = receiver.counts();
    assert_eq!(counts.iter().collect::<Vec<_>>(), Status::ALL.into_iter().zip(expected).collect::<Vec<_>>());
    assert_eq!(counts.total(), 7);
}

#[test]
fn resumed_receiver_continues_stored_sequence_with_own_counts() {
    let config = config(Profile::P01A, 0);
    let mut stored = in_state(State::Following);
    assert_eq!(stored.check(&config, &frame(&config, 8)), Status::Ok);
    let mut receiver = Receiver::default();
    assert_eq!(receiver.next_counter(Profile::P01A), None, "no frame yet");
    assert_eq!(receiver.check(&config, &frame(&config, 3)), Status::Initial);
    receiver.resume(Profile::P01A, &stored);
    assert_eq!(receiver.next_counter(Profile::P01A), Some(9));
    assert_eq!(receiver.check(&config, &frame(&config, 9)), Status::Ok);
    let counts = receiver.counts();
    assert_eq!((counts.get(Status::Initial), counts.get(Status::Ok), counts.total()), (1, 1, 2));
}

#[test]
fn impossible_stored_counter_waits_for_first_frame() {
    for (stored, next) in [(14, Some(0)), (15, None), (255, None)] {
        let mut receiver = Receiver::default();
        receiver.resume(Profile::P01A, &Receiver { last_valid: Some(stored), ..Receiver::default() });
        assert_eq!(receiver.next_counter(Profile::P01A), next, "stored counter {stored}");
    }
}

#[test]
fn silence_up_to_limit_needs_no_synchronisation() {
    let config = config(Profile::P01A, 2);
    for (periods, status) in [(3, Status::Ok), (4, Status::Sync)] {
        let mut receiver = in_state(State::Following);
        receiver.no_new_data(&config, periods);
        assert_eq!(receiver.check(&config, &frame(&config, LAST + 1)), status, "{periods} periods without a frame");
    }
}
