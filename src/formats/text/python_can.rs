//! Reads the CSV of python-can: `timestamp,arbitration_id,extended,remote,error,dlc,data`, with the data in base64.
//!
//! This format has no flag for CAN FD; frames with more than 8 bytes are CAN FD frames. It has no channel.

use std::io;

use packwatch_core::can::{Frame, MAX_DATA};

use super::cursor::{Base, Cursor, Fault, frame, identifier, number, scaled};
use super::{CHANNEL, Channels, Grammar, time};
use crate::Item;

const HEADER: &[u8] = b"timestamp,arbitration_id,extended,remote,error,dlc,data";

/// The reader of a log. It has no state, because each line is complete.
pub(super) struct PythonCan;

impl Grammar for PythonCan {
    fn new(_head: &[u8]) -> io::Result<Self> {
        Ok(Self)
    }

    fn recognises(line: &[u8]) -> bool {
        line.trim_ascii().eq_ignore_ascii_case(HEADER)
    }

    fn item(&mut self, mut line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        if line.text.is_empty() || Self::recognises(line.text) {
            return Ok(Item::Other);
        }
        let start = line;
        let mut field = |expected| {
            let at = line;
            line.field(b',').map(|field| (field, at.fault(expected))).ok_or_else(|| at.fault(expected))
        };
        let (stamp, bad_time) = field("a time in seconds")?;
        let (id, bad_id) = field("an identifier")?;
        let (extended, bad_extended) = field("0 or 1 (extended)")?;
        let (remote, bad_remote) = field("0 or 1 (remote)")?;
        let (error, bad_error) = field("0 or 1 (error)")?;
        let (len, bad_len) = field("a length of 0 to 64")?;
        let (text, bad_data) = field("as many bytes in base64 as dlc states")?;
        let time = scaled(stamp, 9).and_then(|ns| time(0, ns)).ok_or(bad_time)?;
        let raw = number(id, Base::Hex).ok_or(bad_id)?;
        let (is_extended, is_remote) = (flag(extended).ok_or(bad_extended)?, flag(remote).ok_or(bad_remote)?);
        let channel = channels.number(0, 0).ok_or_else(|| start.fault(CHANNEL))?;
        if flag(error).ok_or(bad_error)? {
            return Ok(Item::ErrorFrame { time, channel, class: raw & 0x1FFF_FFFF });
        }
        let id = identifier(raw, is_extended).ok_or(bad_id)?;
        let len = number(len, Base::Dec).map(|len| len as usize).filter(|len| *len <= MAX_DATA).ok_or(bad_len)?;
        let frame = if is_remote {
            Frame::remote(id, len as u8)
        } else {
            let data = base64(text).filter(|(_, found)| *found == len).ok_or(bad_data)?.0;
            frame(id, len, &data)
        };
        Ok(Item::Frame { time, channel, frame: frame.ok_or(bad_len)? })
    }
}

fn flag(field: &[u8]) -> Option<bool> {
    match field {
        b"0" => Some(false),
        b"1" => Some(true),
        _ => None,
    }
}

/// Decodes at most 64 bytes. Returns the bytes, followed by zeros, and their number.
fn base64(text: &[u8]) -> Option<([u8; MAX_DATA], usize)> {
    let mut data = [0; MAX_DATA];
    let (mut bits, mut count, mut len) = (0_u32, 0, 0);
    let digits = text.strip_suffix(b"==").or_else(|| text.strip_suffix(b"=")).unwrap_or(text);
    for &byte in digits {
        let value = match byte {
            b'A'..=b'Z' => byte - b'A',
            b'a'..=b'z' => byte - b'a' + 26,
            b'0'..=b'9' => byte - b'0' + 52,
            b'+' => 62,
            b'/' => 63,
            _ => return None,
        };
        (bits, count) = (bits << 6 | u32::from(value), count + 6);
        if count >= 8 {
            count -= 8;
            *data.get_mut(len)? = (bits >> count) as u8;
            len += 1;
        }
    }
    text.len().is_multiple_of(4).then_some((data, len))
}
