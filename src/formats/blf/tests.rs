//! Tests the reader of BLF files on files that are built in memory, whole, cut and damaged.

use packwatch_core::can::{CanId, Frame};
use packwatch_core::quantity::Timestamp;

use super::unix_ns;
use crate::testing::{assert_cuts_keep_frames, assert_damage_is_survived, fd_frame, frame, read, zlib};
use crate::{Channel, Item, Position};

/// 14 November 2023, 22:13:20.500, in ms of Unix time.
const START_MS: i64 = 1_700_000_000_500;

fn header() -> Vec<u8> {
    let mut head = b"LOGG".to_vec();
    head.extend(144_u32.to_le_bytes());
    head.resize(40, 0);
    head.extend([2023_u16, 11, 2, 14, 22, 13, 20, 500].iter().flat_map(|part| part.to_le_bytes()));
    head.resize(144, 0);
    head
}

fn object(kind: u32, flags: u32, stamp: u64, body: &[u8]) -> Vec<u8> {
    let size = 32 + body.len() as u32;
    let mut bytes = b"LOBJ".to_vec();
    bytes.extend([32_u16, 1].iter().flat_map(|part| part.to_le_bytes()));
    bytes.extend([size, kind, flags, 0].iter().flat_map(|part| part.to_le_bytes()));
    bytes.extend(stamp.to_le_bytes());
    bytes.extend(body);
    bytes.resize(bytes.len() + size as usize % 4, 0);
    bytes
}

/// A classic message on channel 1 with a stamp in ns.
fn message(stamp: u64, id: u32, data: &[u8]) -> Vec<u8> {
    let mut body = vec![1, 0, 0, data.len() as u8];
    body.extend(id.to_le_bytes());
    body.extend(data);
    body.resize(16, 0);
    object(1, 2, stamp, &body)
}

fn container(content: &[u8], method: u16) -> Vec<u8> {
    let data = if method == 2 { zlib(content) } else { content.to_vec() };
    let size = 32 + data.len() as u32;
    let mut bytes = b"LOBJ".to_vec();
    bytes.extend([16_u16, 1].iter().flat_map(|part| part.to_le_bytes()));
    bytes.extend([size, 10].iter().flat_map(|part| part.to_le_bytes()));
    bytes.extend(method.to_le_bytes());
    bytes.resize(bytes.len() + 6, 0);
    bytes.extend([content.len() as u32, 0].iter().flat_map(|part| part.to_le_bytes()));
    bytes.extend(data);
    bytes.resize(bytes.len() + size as usize % 4, 0);
    bytes
}

fn file(parts: &[Vec<u8>]) -> Vec<u8> {
    [vec![header()], parts.to_vec()].concat().concat()
}

fn messages(count: u8) -> Vec<u8> {
    (0..count).flat_map(|n| message(u64::from(n) * 1_000_000, 0x100 + u32::from(n), &[n; 5])).collect()
}

fn ns(ms: i64) -> i64 {
    (START_MS + ms) * 1_000_000
}

#[test]
fn every_object_of_a_bus_becomes_its_frame() {
    let fd_body = |len: u8| {
        let mut body = vec![2, 0, 0, 9];
        body.extend((0x8000_0000_u32 | 0x1234).to_le_bytes());
        body.extend([0, 0, 0, 0, 0, 3, len, 0, 0, 0, 0, 0]);
        body.extend([7; 64]);
        body
    };
    let mut fd_64 = vec![3, 9, 12, 0];
    fd_64.extend((0x8000_0000_u32 | 0x1234).to_le_bytes());
    fd_64.extend([0, 0, 0, 0]);
    fd_64.extend(0x3000_u32.to_le_bytes());
    fd_64.resize(40, 0);
    fd_64.extend([7; 12]);
    let mut remote = vec![1, 0, 0x80, 4];
    remote.extend(0x123_u32.to_le_bytes());
    remote.extend([0; 8]);
    let mut error = vec![1, 0, 0, 0, 1, 0, 0, 0];
    error.resize(32, 0);
    let objects = [
        message(1_000_000, 0x8000_0000 | 0x1_2345, &[1, 2]),
        object(86, 1, 200, &[&remote[..], &[0; 8]].concat()),
        object(100, 2, 3_000_000, &fd_body(12)),
        object(101, 2, 4_000_000, &fd_64),
        object(73, 2, 5_000_000, &error),
        object(65, 2, 6_000_000, b"a comment"),
    ];
    let log = read(&file(&[container(&objects.concat(), 2)]));
    assert_eq!(log.error, None);
    let time = |ms| Timestamp::from_nanos(ns(ms));
    let extended = CanId::extended(0x1_2345).and_then(|id| Frame::classic(id, &[1, 2])).expect("valid");
    let remote = CanId::standard(0x123).and_then(|id| Frame::remote(id, 4)).expect("valid");
    let expected = [
        Item::Frame { time: time(1), channel: 0, frame: extended },
        Item::Frame { time: time(2), channel: 0, frame: remote },
        Item::Frame { time: time(3), channel: 1, frame: fd_frame(0x1234, &[7; 12]) },
        Item::Frame { time: time(4), channel: 2, frame: fd_frame(0x1234, &[7; 12]) },
        Item::ErrorFrame { time: time(5), channel: 0, class: 8 },
        Item::Other,
    ];
    assert_eq!(log.items, expected);
    assert_eq!(log.channels[1], Channel::Number { written: 2, index: 1 });
}

#[test]
fn bytes_that_are_not_stored_are_zero() {
    let mut body = vec![3, 15, 64, 0];
    body.extend((0x8000_0000_u32 | 0x1234).to_le_bytes());
    body.extend([0, 0, 0, 0]);
    body.extend(0x3000_u32.to_le_bytes());
    body.resize(40, 0);
    body.extend([7; 48]);
    // An object may have further fields after its payload. The first object has none. The second object has such
    // fields, and byte 35 states their position.
    let place = 32 + body.len() as u8;
    let further = [&body[..35], &[place], &body[36..], &[9; 8]].concat();
    for body in [body, further] {
        let log = read(&file(&[object(101, 2, 0, &body)]));
        assert_eq!(log.frames()[0].2, fd_frame(0x1234, &[&[7; 48][..], &[0; 16]].concat()));
    }
}

#[test]
fn object_continues_in_next_container() {
    let content = messages(4);
    let whole = read(&file(&[container(&content, 2)])).frames();
    assert_eq!((whole.len(), whole[3]), (4, (ns(3), 0, frame(0x103, &[3; 5]))));
    for size in 1..content.len() {
        let method = if size % 2 == 0 { 0 } else { 2 };
        let parts: Vec<_> = content.chunks(size).map(|part| container(part, method)).collect();
        let log = read(&file(&parts));
        assert_eq!((log.frames(), log.error), (whole.clone(), None), "containers of {size} bytes");
    }
    assert_eq!(read(&file(&[content])).frames(), whole, "objects without a container");
}

#[test]
fn cut_file_keeps_frames_before_cut() {
    let content = messages(6);
    for method in [0, 2] {
        let parts: Vec<_> = content.chunks(100).map(|part| container(part, method)).collect();
        let bytes = file(&parts);
        assert_cuts_keep_frames(&bytes);
        let (position, text) = read(&bytes[..bytes.len() - 20]).error.expect("an error");
        assert!(text.contains("the file ends in"), "{text}");
        assert!(matches!(position, Position::Byte(144..)), "{position:?}");
    }
}

#[test]
fn damaged_byte_never_stops_reader() {
    let content = messages(4);
    for method in [0, 2] {
        let parts: Vec<_> = content.chunks(70).map(|part| container(part, method)).collect();
        assert_damage_is_survived(&file(&parts));
    }
}

#[test]
fn damaged_container_loses_only_its_objects() {
    let mut parts = [messages(2), messages(3), messages(4)].map(|content| container(&content, 2));
    let len = parts[1].len();
    parts[1][40..len - 4].fill(0x55);
    let log = read(&file(&parts));
    assert_eq!((log.frames().len(), log.error.clone()), (6, None));
    assert!(log.bad()[0].contains("damaged zlib data"), "{:?}", log.bad());
}

#[test]
fn object_longer_than_its_container_loses_only_itself() {
    let mut long = message(0, 0x7, &[1]);
    long[8..12].copy_from_slice(&0x00FF_FFFF_u32.to_le_bytes());
    let log = read(&file(&[container(&long, 2), container(&messages(3), 2)]));
    assert_eq!((log.frames().len(), log.error.clone()), (3, None));
    assert_eq!(log.bad(), ["object of kind 1 and 16777215 bytes, must be 16 to 4096 bytes"]);
}

#[test]
fn container_with_too_much_content_is_refused() {
    let mut bomb = container(&[0; 1000], 2);
    bomb[24..28].copy_from_slice(&u32::MAX.to_le_bytes());
    let log = read(&file(&[bomb, container(&messages(3), 2)]));
    assert_eq!((log.frames().len(), log.error.clone()), (3, None));
    assert_eq!(log.bad(), ["container with 4294967295 bytes, must be at most 67108864"]);
}

#[test]
fn noise_below_a_microsecond_is_rounded_away() {
    let log = read(&file(&[container(&message(12_999_761, 1, &[]), 2)]));
    assert_eq!(log.frames()[0].0, ns(13));
}

#[test]
fn date_gives_unix_time() {
    assert_eq!(unix_ns([2023, 11, 2, 14, 22, 13, 20, 500]), Some(START_MS * 1_000_000));
    assert_eq!(unix_ns([1970, 1, 4, 1, 0, 0, 0, 0]), Some(0));
    assert_eq!(unix_ns([2024, 2, 4, 29, 23, 59, 59, 999]), Some(1_709_251_199_999_000_000));
    assert_eq!(unix_ns([0; 8]), None);
}
