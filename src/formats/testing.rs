//! Helpers of the readers' tests.

use std::io::{Cursor, Write as _};

use packwatch_core::can::{CanId, Frame};

use crate::{Channel, Format, Item, Position, Source};

/// Result of a reader: items, channels, and the error at the end with its position.
#[derive(Debug)]
pub(crate) struct ReadLog {
    pub(crate) items: Vec<Item>,
    pub(crate) channels: Vec<Channel>,
    pub(crate) error: Option<(Position, String)>,
}

impl ReadLog {
    /// The frames: time (ns), channel, frame.
    pub(crate) fn frames(&self) -> Vec<(i64, u8, Frame)> {
        let frame = |item: &Item| match item {
            Item::Frame { time, channel, frame } => Some((time.nanos(), *channel, *frame)),
            _ => None,
        };
        self.items.iter().filter_map(frame).collect()
    }

    /// The texts of bad parts.
    pub(crate) fn bad(&self) -> Vec<&str> {
        self.items
            .iter()
            .filter_map(|item| if let Item::Bad(text) = item { Some(text.as_str()) } else { None })
            .collect()
    }
}

pub(crate) fn read(bytes: &[u8]) -> ReadLog {
    let format = Format::recognise(bytes).expect("a known format");
    let source = Source { reader: Box::new(Cursor::new(bytes.to_vec())), file: None };
    let mut log = ReadLog { items: Vec::new(), channels: Vec::new(), error: None };
    let mut reader = match format.open(source) {
        Ok(reader) => reader,
        Err(error) => {
            log.error = Some((Position::Byte(0), error.to_string()));
            return log;
        }
    };
    loop {
        match reader.next_item() {
            Ok(Some(item)) => log.items.push(item),
            Ok(None) => break,
            Err(error) => {
                log.error = Some((reader.position(), error.to_string()));
                assert!(matches!(reader.next_item(), Ok(None)), "nothing follows an error");
                break;
            }
        }
        assert!(log.items.len() < 1_000_000, "the reader must end");
    }
    log.channels = reader.channels().to_vec();
    log
}

/// Cuts a log after each byte: the frames before the cut must be read.
pub(crate) fn assert_cuts_keep_frames(bytes: &[u8]) {
    let whole = read(bytes).frames();
    let mut best = 0;
    for len in 32..bytes.len() {
        let cut = read(&bytes[..len]).frames();
        assert!(whole.starts_with(&cut), "cut after {len} bytes: other frames");
        assert!(cut.len() >= best, "cut after {len} bytes: fewer frames than after {} bytes", len - 1);
        best = cut.len();
    }
}

/// Damages each byte of a log in turn: the reader must end without a panic.
pub(crate) fn assert_damage_is_survived(bytes: &[u8]) {
    for at in 8..bytes.len() {
        let mut damaged = bytes.to_vec();
        damaged[at] = [0, 0xFF, bytes[at] ^ 0x80, bytes[at].wrapping_add(1)][at % 4];
        if Format::recognise(&damaged).is_some() {
            read(&damaged);
        }
    }
}

/// A classic frame with a standard identifier.
pub(crate) fn frame(id: u32, data: &[u8]) -> Frame {
    CanId::standard(id).and_then(|id| Frame::classic(id, data)).expect("a valid frame")
}

/// An FD frame with an extended identifier and bit rate switch.
pub(crate) fn fd_frame(id: u32, data: &[u8]) -> Frame {
    CanId::extended(id).and_then(|id| Frame::fd(id, true, false, data)).expect("a valid frame")
}

/// Compresses with zlib.
pub(crate) fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut packer = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::default());
    packer.write_all(bytes).expect("written to memory");
    packer.finish().expect("written to memory")
}
