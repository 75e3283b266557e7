//! Tests reassembly, the fault for each kind of damage, and arbitrary frames.

#![allow(clippy::unwrap_used, reason = "tests may panic")]

use proptest::prelude::*;

use super::*;

fn at(ms: i64) -> Timestamp {
    Timestamp::from_nanos(ms * 1_000_000)
}

type Harm = fn(&mut Vec<Vec<u8>>);

/// Receives a payload every millisecond. Returns messages and faults.
fn receive(extension: Option<u8>, payloads: &[Vec<u8>]) -> (Vec<Vec<u8>>, Vec<IsoTpFault>) {
    let mut receiver = Receiver::new(extension);
    let (mut messages, mut faults) = (Vec::new(), Vec::new());
    for (ms, payload) in (0..).zip(payloads) {
        let received = receiver.handle(at(ms), payload);
        faults.extend(received.fault);
        if received.progress == Progress::Complete {
            messages.push(receiver.message().to_vec());
        }
    }
    (messages, faults)
}

fn payloads(message: &[u8]) -> Vec<Vec<u8>> {
    segment(None, message, 0xCC).into_iter().map(|payload| payload.to_vec()).collect()
}

fn message(length: usize) -> Vec<u8> {
    (0..length).map(|index| (index % 251).to_le_bytes()[0]).collect()
}

#[test]
fn leaf_response_is_reassembled() {
    // From the log of a 2019 Leaf: group 1 of service 0x21, 53 bytes (0x35).
    let frames: Vec<Vec<u8>> = [
        [0x10, 0x35, 0x61, 0x01, 0xFF, 0xFF, 0xF3, 0xCC],
        [0x21, 0x02, 0xAF, 0xFF, 0xFF, 0xEB, 0xA6, 0xFF],
        [0x22, 0xFF, 0xD9, 0x6D, 0x03, 0xE8, 0x30, 0xD4],
        [0x23, 0x98, 0x76, 0x39, 0x5F, 0x03, 0x8C, 0x00],
        [0x24, 0x01, 0x70, 0x00, 0x29, 0x10, 0x00, 0x0D],
        [0x25, 0x9D, 0x7E, 0x00, 0x10, 0xAD, 0x79, 0x80],
        [0x26, 0x00, 0x05, 0xFF, 0xFF, 0xEB, 0xA6, 0xFF],
        [0x27, 0xFF, 0xEC, 0x3B, 0x01, 0xAD, 0xFF, 0xFF],
    ]
    .map(|payload| payload.to_vec())
    .to_vec();
    let (messages, faults) = receive(None, &frames);
    assert_eq!((messages.len(), faults), (1, vec![]));
    assert_eq!(
        (messages[0].len(), &messages[0][..4], &messages[0][50..]),
        (53, &[0x61, 1, 255, 255][..], &[0x3B, 1, 0xAD][..])
    );
}

#[test]
fn faults_are_reported_once_and_next_message_received() {
    use IsoTpFault::*;
    let whole = payloads(&message(30));
    let with = |change: fn(&mut Vec<Vec<u8>>)| {
        let mut frames = whole.clone();
        change(&mut frames);
        frames.extend(payloads(&message(30)));
        receive(None, &frames)
    };
    let cases: [(&str, Harm, &[IsoTpFault], usize); 9] = [
        ("missing", |f| drop(f.remove(2)), &[WrongSequence], 1),
        ("doubled", |f| f.insert(2, f[2].clone()), &[WrongSequence], 1),
        ("out of order", |f| f.swap(1, 2), &[WrongSequence], 1),
        ("cut at the end", |f| drop(f.pop()), &[Overlap], 1),
        ("without a beginning", |f| drop(f.remove(0)), &[NotBegun], 1),
        ("a short frame", |f| f[2].truncate(5), &[ShortFrame], 1),
        ("a length of 0", |f| f[0] = vec![0; 8], &[WrongLength, NotBegun], 1),
        ("what fits into one frame", |f| f[0][1] = 6, &[WrongLength], 1),
        ("4 GB", |f| f[0] = vec![0x10, 0, 255, 255, 255, 255, 1, 2], &[TooLong], 1),
    ];
    for (name, change, faults, messages) in cases {
        let (found, found_faults) = with(change);
        assert_eq!((found_faults.as_slice(), found.len()), (faults, messages), "{name}");
        assert!(found.iter().all(|found| *found == message(30)), "{name}");
    }
}

#[test]
fn message_times_out_after_one_second() {
    let frames = payloads(&message(30));
    let mut receiver = Receiver::new(None);
    receiver.handle(at(0), &frames[0]);
    assert_eq!(receiver.handle(at(1000), &frames[1]).progress, Progress::Continued);
    assert_eq!(receiver.poll(at(2000)), None);
    assert_eq!(receiver.poll(at(2001)), Some(IsoTpFault::Timeout));
    assert_eq!(receiver.handle(at(2002), &frames[2]), Received::default(), "the loss was already reported");
    receiver.handle(at(3000), &frames[0]);
    let late = receiver.handle(at(4001), &frames[1]);
    assert_eq!(late, Received { fault: Some(IsoTpFault::Timeout), progress: Progress::None });
}

#[test]
fn refusing_flow_control_ends_message() {
    let mut receiver = Receiver::new(None);
    receiver.handle(at(0), &payloads(&message(30))[0]);
    for goes_on in [[0x30, 0, 0], [0x31, 0, 0], [0x22, 0, 0]] {
        assert_eq!(receiver.handle_flow_control(None, &goes_on), None);
    }
    assert_eq!(receiver.handle_flow_control(None, &[0x32, 0, 0]), Some(IsoTpFault::Refused));
    assert_eq!(receiver.handle_flow_control(None, &[0x32, 0, 0]), None, "no message is being received");
}

#[test]
fn can_fd_frames_are_reassembled() {
    // A message of 20 bytes in one frame with an escaped length, and a message of 100 bytes in frames of 64 bytes.
    let single = [&[0x00, 20][..], &message(20), &[0xCC; 2]].concat();
    let long = message(100);
    let first = [&[0x10, 100][..], &long[..62]].concat();
    let rest = [&[0x21][..], &long[62..], &[0xCC; 9]].concat();
    assert_eq!(receive(None, &[single, first, rest]), (vec![message(20), long], vec![]));
    // Lengths above 4,095 use an escape of four bytes.
    let long = message(5000);
    let mut frames = vec![[&[0x10, 0, 0, 0, 0x13, 0x88][..], &long[..58]].concat()];
    let numbers = (1..16_u8).chain([0]).cycle();
    frames.extend(long[58..].chunks(63).zip(numbers).map(|(body, n)| [&[0x20 | n][..], body].concat()));
    assert_eq!(receive(None, &frames), (vec![long], vec![]));
}

#[test]
fn extended_addressing_uses_first_byte() {
    let frames: Vec<Vec<u8>> = segment(Some(0xF1), &message(25), 0).into_iter().map(|f| f.to_vec()).collect();
    assert!(frames.iter().all(|frame| frame[0] == 0xF1));
    assert_eq!(receive(Some(0xF1), &frames), (vec![message(25)], vec![]));
    assert_eq!(receive(Some(0xF2), &frames), (vec![], vec![]), "for another tester");
}

proptest! {
    #[test]
    fn segmented_messages_are_reassembled(length in 1_usize..4096, extension in any::<Option<u8>>(), padding in any::<u8>()) {
        let frames: Vec<Vec<u8>> = segment(extension, &message(length), padding).into_iter().map(|f| f.to_vec()).collect();
        prop_assert_eq!(receive(extension, &frames), (vec![message(length)], vec![]));
    }

    /// One frame is lost, duplicated or out of order. Frames of different messages are never swapped, because the
    /// protocol cannot detect this fault.
    #[test]
    fn damaged_messages_are_never_accepted(
        lengths in proptest::collection::vec(1_usize..80, 1..20), place in any::<proptest::sample::Index>(), kind in 0..3_u8
    ) {
        // Each message has its own byte value.
        let sent: Vec<Vec<u8>> = (0_u8..).zip(&lengths).map(|(tag, &length)| vec![tag; length]).collect();
        let mut frames: Vec<(usize, Vec<u8>)> =
            sent.iter().enumerate().flat_map(|(n, m)| payloads(m).into_iter().map(move |p| (n, p))).collect();
        let at = place.index(frames.len());
        let other = (at + 1) % frames.len();
        let harmed = frames[at].0;
        match kind {
            0 => drop(frames.remove(at)),
            1 => frames.insert(at, frames[at].clone()),
            _ if frames[other].0 == harmed => frames.swap(at, other),
            _ => {}
        }
        let plain: Vec<Vec<u8>> = frames.into_iter().map(|(_, payload)| payload).collect();
        let (received, _) = receive(None, &plain);
        prop_assert!(received.iter().all(|message| sent.contains(message)));
        for (number, message) in sent.iter().enumerate().filter(|(number, _)| *number != harmed) {
            prop_assert!(received.contains(message), "message {} arrived intact", number);
        }
    }

    #[test]
    fn arbitrary_bytes_never_panic(payloads in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 0..64), 0..60)) {
        let (messages, _) = receive(None, &payloads);
        let bytes: usize = payloads.iter().map(Vec::len).sum();
        prop_assert!(messages.iter().map(Vec::len).sum::<usize>() <= bytes);
    }
}
