//! Tests the readers of PCAP and PCAPNG files on files that are built in memory, whole, cut and damaged.

use packwatch_core::quantity::Timestamp;

use crate::testing::{assert_cuts_keep_frames, assert_damage_is_survived, fd_frame, frame, read};
use crate::{Channel, Item};

const START_NS: i64 = 1_700_000_000_000_001_000;

fn word(value: u32, big_endian: bool) -> [u8; 4] {
    if big_endian { value.to_be_bytes() } else { value.to_le_bytes() }
}

fn half(value: u16, big_endian: bool) -> [u8; 2] {
    if big_endian { value.to_be_bytes() } else { value.to_le_bytes() }
}

/// A frame as SocketCAN sends it.
fn can(id: [u8; 4], flags: u8, data: &[u8]) -> Vec<u8> {
    [&id[..], &[data.len() as u8, flags, 0, 0], data].concat()
}

/// A PCAP file whose packets are 1 us apart.
fn pcap(big_endian: bool, nanoseconds: bool, link: u32, packets: &[Vec<u8>]) -> Vec<u8> {
    let magic = if nanoseconds { 0xA1B2_3C4D } else { 0xA1B2_C3D4 };
    let mut bytes: Vec<u8> =
        [magic, 0x0004_0002, 0, 0, 0xFFFF, link].iter().flat_map(|v| word(*v, big_endian)).collect();
    for (n, packet) in (1..).zip(packets) {
        let fraction = if nanoseconds { 1000 * n } else { n };
        let len = packet.len() as u32;
        bytes.extend([1_700_000_000, fraction, len, len].iter().flat_map(|v| word(*v, big_endian)));
        bytes.extend(packet);
    }
    bytes
}

fn block(kind: u32, content: &[u8], big_endian: bool) -> Vec<u8> {
    let padded = content.len().next_multiple_of(4);
    let len = word(12 + padded as u32, big_endian);
    let mut bytes = [&word(kind, big_endian)[..], &len, content].concat();
    bytes.resize(8 + padded, 0);
    bytes.extend(len);
    bytes
}

fn option(code: u16, value: &[u8], big_endian: bool) -> Vec<u8> {
    let mut bytes = [&half(code, big_endian)[..], &half(value.len() as u16, big_endian), value].concat();
    bytes.resize(4 + value.len().next_multiple_of(4), 0);
    bytes
}

/// A PCAPNG file with the interfaces can0 (us) and can1 (ns).
fn pcapng(big_endian: bool, packets: &[(u32, u64, Vec<u8>)]) -> Vec<u8> {
    let section = [&word(0x1A2B_3C4D, big_endian)[..], &word(1, big_endian), &[0xFF; 8]].concat();
    let mut bytes = block(0x0A0D_0D0A, &section, big_endian);
    for (name, unit) in [("can0", 6), ("can1", 9)] {
        let mut content = [&half(227, big_endian)[..], &[0; 6]].concat();
        content.extend(option(2, name.as_bytes(), big_endian));
        content.extend(option(9, &[unit], big_endian));
        bytes.extend(block(1, &content, big_endian));
    }
    for (interface, stamp, packet) in packets {
        let len = packet.len() as u32;
        let numbers = [*interface, (stamp >> 32) as u32, *stamp as u32, len, len];
        let mut content: Vec<u8> = numbers.iter().flat_map(|v| word(*v, big_endian)).collect();
        content.extend(packet);
        bytes.extend(block(6, &content, big_endian));
    }
    bytes.extend(block(5, &[0; 12], big_endian));
    bytes
}

fn packets() -> Vec<Vec<u8>> {
    vec![
        can(0x123_u32.to_be_bytes(), 0, &[1, 2, 3]),
        can((0x8000_0000_u32 | 0x1234).to_be_bytes(), 5, &[9; 12]),
        can((0x2000_0000_u32 | 0x20).to_be_bytes(), 0, &[0; 8]),
    ]
}

fn ng_packets() -> Vec<(u32, u64, Vec<u8>)> {
    let [us, ns] = [START_NS / 1000, START_NS + 1000].map(i64::unsigned_abs);
    vec![(0, us, packets()[0].clone()), (1, ns, packets()[1].clone()), (0, us + 2, packets()[2].clone())]
}

fn items(channels: [u8; 3]) -> [Item; 3] {
    let time = |n: i64| Timestamp::from_nanos(START_NS + 1000 * n);
    [
        Item::Frame { time: time(0), channel: channels[0], frame: frame(0x123, &[1, 2, 3]) },
        Item::Frame { time: time(1), channel: channels[1], frame: fd_frame(0x1234, &[9; 12]) },
        Item::ErrorFrame { time: time(2), channel: channels[2], class: 0x20 },
    ]
}

#[test]
fn both_byte_orders_and_units_give_same_frames() {
    for (big_endian, nanoseconds) in [(false, false), (false, true), (true, false), (true, true)] {
        let log = read(&pcap(big_endian, nanoseconds, 227, &packets()));
        assert_eq!((log.items, log.error), (items([0; 3]).to_vec(), None), "{big_endian} {nanoseconds}");
    }
}

#[test]
fn identifiers_in_wrong_order_are_turned() {
    let ids = [0x180, 0x280, 0x7E8, 0x123, 0x8000_1234_u32, 0x98FF_50F4];
    let read_ids = |packets: &[Vec<u8>]| -> Vec<u32> {
        let log = read(&pcap(false, false, 227, packets));
        log.frames().into_iter().map(|(_, _, frame)| frame.id().raw()).collect()
    };
    let expected = ids.map(|id| id & 0x1FFF_FFFF);
    assert_eq!(read_ids(&ids.map(|id| can(id.to_le_bytes(), 0, &[1]))), expected);
    // One unusual identifier does not change the byte order of the others.
    let mut right = ids.map(|id| can(id.to_be_bytes(), 0, &[1])).to_vec();
    right.insert(0, can([0x80, 0, 0, 0x10], 0, &[1]));
    assert_eq!(read_ids(&right)[1..], expected);
}

#[test]
fn cooked_packets_have_identifier_in_order_of_recorder() {
    for big_endian in [false, true] {
        let sll = |protocol: u16, body: &[u8]| {
            [&[0, 1][..], &280_u16.to_be_bytes(), &[0; 10], &protocol.to_be_bytes(), body].concat()
        };
        let sll2 = |protocol: u16, body: &[u8]| {
            [&protocol.to_be_bytes()[..], &[0, 0], &7_u32.to_be_bytes(), &280_u16.to_be_bytes(), &[0; 10], body]
                .concat()
        };
        let body = can(word(0x123, big_endian), 0, &[5]);
        let fd = can(word(0x8000_1234, big_endian), 1, &[6; 8]);
        let ip = [&[0, 0][..], &1_u16.to_be_bytes(), &[0; 10], &[8, 0], &[0; 20]].concat();
        let log = read(&pcap(big_endian, false, 113, &[sll(0xC, &body), sll(0xD, &fd), sll(0xE, &body), ip]));
        let frames: Vec<_> = log.frames().into_iter().map(|(_, _, frame)| frame).collect();
        assert_eq!(frames, [frame(0x123, &[5]), fd_frame(0x1234, &[6; 8])]);
        assert_eq!(log.items[2..], [Item::Xl, Item::Other]);
        let log = read(&pcap(big_endian, false, 276, &[sll2(0xC, &body)]));
        assert_eq!(log.frames()[0].2, frame(0x123, &[5]));
        assert_eq!(log.channels, [Channel::Number { written: 7, index: 0 }]);
    }
}

#[test]
fn interfaces_of_pcapng_have_names_and_units() {
    for big_endian in [false, true] {
        let log = read(&pcapng(big_endian, &ng_packets()));
        let found: Vec<_> = log.items.into_iter().filter(|item| *item != Item::Other).collect();
        assert_eq!((found, log.error), (items([0, 1, 0]).to_vec(), None));
        assert_eq!(log.channels, ["can0", "can1"].map(|name| Channel::Name(name.to_owned())));
    }
}

#[test]
fn cut_capture_keeps_frames_before_cut() {
    assert_cuts_keep_frames(&pcap(false, false, 227, &packets()));
    assert_cuts_keep_frames(&pcapng(true, &ng_packets()));
}

#[test]
fn damaged_byte_never_stops_reader() {
    assert_damage_is_survived(&pcap(true, true, 227, &packets()));
    assert_damage_is_survived(&pcapng(false, &ng_packets()));
}

#[test]
fn capture_of_another_link_is_refused_by_number() {
    let (_, text) = read(&pcap(false, false, 1, &[])).error.expect("an error");
    assert_eq!(text, "capture of link type 1, must be 227 (SocketCAN), 113 or 276 (cooked capture of Linux)");
}
