//! Tests the reader and the writer of MF4 files on files that are built in memory, whole, cut and damaged.

use std::io::Cursor;

use packwatch_core::can::{CanId, Frame};
use packwatch_core::quantity::Timestamp;

use super::Mf4Writer;
use crate::testing::{assert_damage_is_survived, fd_frame, frame, read};
use crate::{Channel, Item};

const START_NS: i64 = 1_700_000_000_123_456_789;

/// Writes a file with [`Mf4Writer`]: all kinds of frames, 1 us apart. Returns its bytes, and the items that a reader
/// must find.
fn written(count: i64) -> (Vec<u8>, Vec<Item>) {
    let mut writer = Mf4Writer::new(Cursor::new(Vec::new())).expect("memory");
    let mut items = Vec::new();
    for n in 0..count {
        let (time, byte) = (Timestamp::from_nanos(START_NS + 1000 * n), n as u8);
        let found = match n % 4 {
            0 => frame(0x123, &[byte; 3]),
            1 => fd_frame(0x1234, &[byte; 12]),
            2 => CanId::standard(0x7FF).and_then(|id| Frame::remote(id, 5)).expect("valid"),
            _ => {
                writer.write_error_frame(time, 1, 0x20).expect("memory");
                items.push(Item::ErrorFrame { time, channel: 0, class: 0x20 });
                continue;
            }
        };
        writer.write_frame(time, 1, &found).expect("memory");
        items.push(Item::Frame { time, channel: 0, frame: found });
    }
    (writer.finish().expect("memory").into_inner(), items)
}

/// Builds files as the logger CANedge writes them: not finalised, with the records of all groups in one sequence. The
/// payload of a frame is a record of another group.
struct Unsorted {
    bytes: Vec<u8>,
    values: u64,
}

impl Unsorted {
    fn block(&mut self, id: &[u8; 4], links: &[u64], data: &[u8]) -> u64 {
        let at = self.bytes.len() as u64;
        let len = 24 + 8 * links.len() as u64 + data.len() as u64;
        self.bytes.extend(id);
        self.bytes.extend([0; 4]);
        self.bytes.extend(len.to_le_bytes());
        self.bytes.extend((links.len() as u64).to_le_bytes());
        self.bytes.extend(links.iter().flat_map(|link| link.to_le_bytes()));
        self.bytes.extend(data);
        self.bytes.resize(self.bytes.len().next_multiple_of(8), 0);
        at
    }

    fn channel(&mut self, next: u64, name: &str, kind: [u8; 4], byte: u32, bits: u32, links: [u64; 2]) -> u64 {
        let name = self.block(b"##TX", &[], &[name.as_bytes(), b"\0"].concat());
        let mut data = kind.to_vec();
        data.extend([byte, bits, 0].iter().flat_map(|number| number.to_le_bytes()));
        data.resize(72, 0);
        self.block(b"##CN", &[next, 0, name, 0, links[0], links[1], 0, 0], &data)
    }

    fn group(&mut self, next: u64, first: u64, id: u64, len: u32, flags: u16) -> u64 {
        let mut data = id.to_le_bytes().to_vec();
        data.resize(16, 0);
        data.extend(flags.to_le_bytes());
        data.resize(24, 0);
        data.extend(len.to_le_bytes());
        data.resize(32, 0);
        self.block(b"##CG", &[next, first, 0, 0, 0, 0], &data)
    }

    /// Writes the blocks that describe the groups: group 1 contains frames, group 2 payloads. If `is_circular` is true,
    /// the data are a list that links to itself.
    fn new(is_circular: bool) -> Self {
        let mut file = Self { bytes: b"UnFinMF 4.11    test    ".to_vec(), values: 0 };
        file.bytes.resize(60, 0);
        file.bytes.extend([0x25, 0, 0, 0]);
        let header = file.block(b"##HD", &[0; 6], &[&START_NS.to_le_bytes()[..], &[0; 24]].concat());
        let mut linear = vec![1, 0, 0, 0, 0, 0, 2, 0];
        linear.extend([0.0, 0.0, 0.0, 1e-6_f64].iter().flat_map(|value| value.to_le_bytes()));
        let linear = file.block(b"##CC", &[0; 4], &linear);
        let values = file.group(0, 0, 2, 0, 1);
        let data = file.channel(0, "CAN_DataFrame.DataBytes", [1, 0, 10, 0], 13, 64, [0, values]);
        let len = file.channel(data, "CAN_DataFrame.DataLength", [0, 0, 0, 1], 12, 7, [0, 0]);
        let fd = file.channel(len, "CAN_DataFrame.EDL", [0, 0, 0, 0], 12, 1, [0, 0]);
        let id = file.channel(fd, "CAN_DataFrame.ID", [0, 0, 0, 3], 8, 29, [0, 0]);
        let extended = file.channel(id, "CAN_DataFrame.IDE", [0, 0, 0, 0], 8, 1, [0, 0]);
        let time = file.channel(extended, "Timestamp", [2, 1, 0, 0], 0, 64, [linear, 0]);
        let frames = file.group(values, time, 1, 21, 6);
        let at = file.bytes.len() as u64 + 24 + 4 * 8 + 8;
        let group = file.block(b"##DG", &[0, frames, at, 0], &[1, 0, 0, 0, 0, 0, 0, 0]);
        if is_circular {
            let block = at + 24 + 16 + 8;
            file.block(b"##DL", &[at, block], &[0, 0, 0, 0, 1, 0, 0, 0]);
        }
        file.bytes[header as usize + 24..][..8].copy_from_slice(&group.to_le_bytes());
        file
    }

    fn open_data(mut self) -> Self {
        self.block(b"##DT", &[], &[]);
        self
    }

    fn record(&self, us: u64, id: u32, len: u8) -> Vec<u8> {
        let id = (id << 3 | u32::from(id > 0x7FF)).to_le_bytes();
        [&[1][..], &us.to_le_bytes(), &id, &[len << 1], &self.values.to_le_bytes()].concat()
    }

    fn value(&mut self, data: &[u8]) -> Vec<u8> {
        self.values += 4 + data.len() as u64;
        [&[2][..], &(data.len() as u32).to_le_bytes(), data].concat()
    }

    /// Adds a frame and its payload. If `value_first` is true, the payload precedes the frame.
    fn add(&mut self, us: u64, id: u32, data: &[u8], value_first: bool) {
        let record = self.record(us, id, data.len() as u8);
        let value = self.value(data);
        let (first, second) = if value_first { (value, record) } else { (record, value) };
        self.bytes.extend(first);
        self.bytes.extend(second);
    }
}

fn unsorted(value_first: bool) -> Vec<u8> {
    let mut file = Unsorted::new(false).open_data();
    for n in 0..5 {
        file.add(10 * n, 0x100 + n as u32, &[n as u8; 6], value_first);
    }
    file.bytes
}

#[test]
fn written_file_reads_back_in_order_of_time() {
    let (bytes, items) = written(100);
    let log = read(&bytes);
    assert_eq!((log.items, log.error), (items, None));
    assert_eq!(log.channels, [Channel::Number { written: 1, index: 0 }]);
}

#[test]
fn blocks_of_a_group_continue_each_other() {
    let (bytes, items) = written(200_000);
    assert!(bytes.windows(4).filter(|id| *id == b"##DZ").count() > 5, "several blocks per group");
    let log = read(&bytes);
    assert!(log.items == items, "{} items, {:?}", log.items.len(), log.error);
}

#[test]
fn payload_before_or_after_record_belongs_to_it() {
    for value_first in [false, true] {
        let log = read(&unsorted(value_first));
        let found: Vec<_> = log.frames().into_iter().map(|(ns, _, frame)| (ns - START_NS, frame)).collect();
        let expected: Vec<_> = (0..5).map(|n| (10_000 * n, frame(0x100 + n as u32, &[n as u8; 6]))).collect();
        assert_eq!((found, log.error), (expected, None), "value first: {value_first}");
    }
}

#[test]
fn cut_unfinalized_file_keeps_frames_before_cut() {
    let bytes = unsorted(false);
    let (whole, record) = (read(&bytes).frames(), 22 + 11);
    for len in bytes.len() - 5 * record..bytes.len() {
        let log = read(&bytes[..len]);
        let frames = (5 * record + len - bytes.len()) / record;
        assert_eq!(log.frames(), whole[..frames], "cut after {len} bytes");
        let is_between = (bytes.len() - len).is_multiple_of(record);
        assert_eq!(log.error.is_none(), is_between, "cut after {len} bytes: {:?}", log.error);
    }
}

#[test]
fn cut_finalized_file_gives_error_with_place() {
    let (bytes, _) = written(40);
    // The last eight bytes are reserved, so a cut there is not an error.
    for len in 32..bytes.len() - 8 {
        assert!(read(&bytes[..len]).error.is_some(), "cut after {len} bytes");
    }
    let (_, text) = read(&bytes[..bytes.len() - 200]).error.expect("an error");
    assert!(text.contains("link to byte") && text.contains("before the end at byte"), "{text}");
}

#[test]
fn damaged_byte_never_stops_reader() {
    assert_damage_is_survived(&written(12).0);
    assert_damage_is_survived(&unsorted(true));
}

#[test]
fn circle_of_links_ends_after_each_block_was_read() {
    let mut file = Unsorted::new(true);
    let mut data = Vec::new();
    for n in 0..3_u8 {
        data.extend(file.record(10 * u64::from(n), 0x7, 2));
        data.extend(file.value(&[n; 2]));
    }
    file.block(b"##DT", &[], &data);
    let log = read(&file.bytes);
    assert_eq!(log.frames().len(), 3);
    assert_eq!(log.error.expect("an error").1, "the list of data blocks is a circle");
}

#[test]
fn file_without_frames_names_its_signals() {
    let text = |bytes: &[u8]| read(bytes).error.expect("an error").1;
    let mut bytes = unsorted(true);
    while let Some(at) = bytes.windows(13).position(|part| part == b"CAN_DataFrame") {
        bytes[at..at + 13].copy_from_slice(b"engine_values");
    }
    assert!(text(&bytes).starts_with("no CAN frames (channel CAN_DataFrame), only signals ("), "{}", text(&bytes));
}

#[test]
fn unknown_record_ends_with_error_after_frames() {
    let mut bytes = unsorted(true);
    bytes.push(9);
    let log = read(&bytes);
    assert_eq!(log.frames().len(), 5);
    assert_eq!(log.error.expect("an error").1, "record of group 9, which the file does not describe");
}
