//! Tests that the same frames are read as the same items from a log of every text format.

use packwatch_core::can::{CanId, Frame};
use packwatch_core::quantity::Timestamp;

use super::read;
use crate::Item;

/// Start of the logs, 14 November 2023 22:13:20 UTC.
const START_US: i64 = 1_700_000_000_000_000;

/// Frames with their time since the start in us. Times and contents are random, so that every digit varies.
fn frames() -> Vec<(i64, Frame)> {
    let mut seed = 1_u64;
    let mut next = move || {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        seed >> 33
    };
    let mut at_us = 0;
    (0..500)
        .map(|_| {
            at_us += next() as i64 % 3_000_000;
            let raw = next() as u32;
            let id =
                if next() % 2 == 0 { CanId::standard(raw & 0x7FF) } else { CanId::extended(raw & 0x1FFF_FFFF | 0x800) };
            let data: Vec<u8> = (0..next() % 9).map(|_| next() as u8).collect();
            (at_us, Frame::classic(id.expect("in range"), &data).expect("at most 8 bytes"))
        })
        .collect()
}

/// Writes the frames with a header and one line per frame.
fn written(header: &str, line: impl Fn(i64, &Frame) -> String) -> String {
    let lines: String = frames().iter().map(|(at_us, frame)| line(*at_us, frame) + "\n").collect();
    format!("{header}{lines}")
}

fn hex(frame: &Frame, separator: &str) -> String {
    frame.data().iter().map(|byte| format!("{byte:02X}{separator}")).collect()
}

fn is_extended(frame: &Frame) -> bool {
    matches!(frame.id(), CanId::Extended(_))
}

/// Decimal seconds or milliseconds of a time in us.
fn decimal(us: i64, unit: i64, digits: usize) -> String {
    format!("{}.{:0digits$}", us / unit, us % unit)
}

fn asc(frame: &Frame, is_hex: bool) -> String {
    let x = if is_extended(frame) { "x" } else { "" };
    let (raw, len) = (frame.id().raw(), frame.len());
    let data: String =
        frame.data().iter().map(|byte| if is_hex { format!(" {byte:02X}") } else { format!(" {byte:3}") }).collect();
    let id = if is_hex { format!("{raw:X}{x}") } else { format!("{raw}{x}") };
    format!("1  {id:15} Rx   d {len}{data}")
}

fn base64(data: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let group = |bytes: &[u8]| {
        let word = bytes.iter().chain([0, 0].iter()).take(3).fold(0, |word, byte| word << 8 | usize::from(*byte));
        let digit =
            |place: usize| if place <= bytes.len() { char::from(DIGITS[word >> (18 - 6 * place) & 63]) } else { '=' };
        (0..4).map(digit).collect::<String>()
    };
    data.chunks(3).map(group).collect()
}

#[test]
fn same_frames_give_identical_items_in_every_format() {
    let date = "Tue Nov 14 10:13:20.000 pm 2023";
    let id = |frame: &Frame, standard: usize| {
        let width = if is_extended(frame) { 8 } else { standard };
        format!("{:0width$X}", frame.id().raw())
    };
    let bits = |frame: &Frame| if is_extended(frame) { 29 } else { 11 };
    let logs = [
        written(&format!("date {date}\nbase hex  timestamps absolute\n"), |us, f| {
            format!("{} {}", decimal(us, 1_000_000, 6), asc(f, true))
        }),
        written(&format!("base dec  timestamps absolute\nBegin Triggerblock {date}\n"), |us, f| {
            format!("{} {} Length = 1 BitCount = 2", decimal(us, 1_000_000, 6), asc(f, false))
        }),
        written(";$FILEVERSION=1.2\n;$STARTTIME=45244.92592592593\n", |us, f| {
            format!(" 1) {} 1 Rx {} {} {}", decimal(us, 1000, 3), id(f, 4), f.len(), hex(f, " "))
        }),
        written(";$FILEVERSION=2.1\n;$STARTTIME=45244.92592592593\n", |us, f| {
            format!(" 1 {} DT 1 {} Rx - {} {}", decimal(us, 1000, 3), id(f, 4), f.len(), hex(f, " "))
        }),
        written("", |us, f| {
            format!(" ({})  1  {}   [{}]  {}", decimal(START_US + us, 1_000_000, 6), id(f, 3), f.len(), hex(f, " "))
        }),
        written("Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n", |us, f| {
            format!("{},{:08X},{},Rx,0,{},{}", START_US + us, f.id().raw(), is_extended(f), f.len(), hex(f, ","))
        }),
        written("timestamp,arbitration_id,extended,remote,error,dlc,data\n", |us, f| {
            let extended = u8::from(is_extended(f));
            format!(
                "{},0x{:x},{extended},0,0,{},{}",
                decimal(START_US + us, 1_000_000, 6),
                f.id().raw(),
                f.len(),
                base64(f.data())
            )
        }),
        written("", |us, f| {
            format!("{} 1R{} {:X} {}", decimal(START_US + us, 1_000_000, 6), bits(f), f.id().raw(), hex(f, " "))
        }),
    ];
    let expected: Vec<Item> = frames()
        .into_iter()
        .map(|(us, frame)| Item::Frame { time: Timestamp::from_nanos((START_US + us) * 1000), channel: 0, frame })
        .collect();
    for log in logs {
        let (items, channels) = read(log.as_bytes());
        let items: Vec<Item> = items.into_iter().filter(|item| *item != Item::Other).collect();
        assert!(
            items == expected,
            "{}: {:?}",
            &log[..80],
            items.iter().zip(&expected).find(|(item, other)| item != other)
        );
        assert_eq!(channels.len(), 1, "{}", &log[..80]);
    }
}
