//! Decodes the objects of a BLF file that belong to a CAN bus.

use packwatch_core::can::Frame;

use super::stamp;
use crate::Item;
use crate::byte_stream::{u16_at, u32_at, u64_at};
use crate::channel_list::ChannelList;
use crate::raw_frame::{RawFrame, length_of_code};

const CAN_MESSAGE: u32 = 1;
const CAN_ERROR: u32 = 2;
const CAN_ERROR_EXT: u32 = 73;
const CAN_MESSAGE2: u32 = 86;
const CAN_FD_MESSAGE: u32 = 100;
const CAN_FD_MESSAGE_64: u32 = 101;
const CAN_FD_ERROR_64: u32 = 104;

/// Maximum size of an object of a CAN bus, bytes. A longer object must be damaged, because the longest known object has
/// about 200 bytes.
pub(super) const MAX_CAN_OBJECT: usize = 4096;

/// Flag of a 29-bit identifier.
const EXTENDED: u32 = 1 << 31;
/// CAN_ERR_PROT of SocketCAN: a violation of the protocol, seen by the controller.
const PROTOCOL_ERROR: u32 = 8;

/// Whether objects of this kind become frames or error frames.
pub(super) fn is_of_can(kind: u32) -> bool {
    matches!(
        kind,
        CAN_MESSAGE | CAN_ERROR | CAN_ERROR_EXT | CAN_MESSAGE2 | CAN_FD_MESSAGE | CAN_FD_MESSAGE_64 | CAN_FD_ERROR_64
    )
}

/// Decodes a whole object of a CAN bus.
///
/// # Errors
/// Returns what was found and what is allowed.
#[inline]
pub(super) fn decode(kind: u32, object: &[u8], start_ns: i64, channels: &mut ChannelList) -> Result<Item, String> {
    let (header, version) = (usize::from(u16_at(object, 4, false)), u16_at(object, 6, false));
    if header < 32 || object.len() < header {
        let size = object.len();
        return Err(format!("object of {size} bytes with a header of {header} bytes, must be at least 32"));
    }
    if !matches!(version, 1 | 2) {
        return Ok(Item::Other);
    }
    let flags = u32_at(object, 16, false);
    let offset = i64::try_from(u64_at(object, 24)).unwrap_or(i64::MAX);
    // Flag 1: tens of microseconds; flag 2: nanoseconds.
    let offset_ns = if flags & 1 != 0 { offset.saturating_mul(10_000) } else { offset };
    let time = stamp(start_ns, offset_ns);
    let body = &object[header..];
    let channel = match kind {
        CAN_FD_MESSAGE_64 | CAN_FD_ERROR_64 => body.first().map(|channel| u32::from(*channel)),
        _ => (body.len() >= 2).then(|| u32::from(u16_at(body, 0, false))),
    };
    let needed = fields_len(kind);
    let Some(written) = channel.filter(|_| body.len() >= needed) else {
        return Err(format!("object of kind {kind} with {} bytes of content, must have {needed}", body.len()));
    };
    let channel = channels.of_number(written, 1).ok_or("more than 256 channels")?;
    Ok(match kind {
        CAN_MESSAGE | CAN_MESSAGE2 => Item::Frame { time, channel, frame: classic(body)? },
        CAN_FD_MESSAGE => Item::Frame { time, channel, frame: fd(body)? },
        CAN_FD_MESSAGE_64 => Item::Frame { time, channel, frame: fd_64(body, header)? },
        CAN_ERROR_EXT => {
            // If bit 0 or 1 of the flags is set, the controller has reported a code for the kind of error.
            let class = if u32_at(body, 4, false) & 3 != 0 { PROTOCOL_ERROR } else { 0 };
            Item::ErrorFrame { time, channel, class }
        }
        _ => Item::ErrorFrame { time, channel, class: 0 },
    })
}

/// Size of the fixed fields at the beginning of the content, bytes. A variable part may follow.
fn fields_len(kind: u32) -> usize {
    match kind {
        CAN_MESSAGE | CAN_MESSAGE2 => 16,
        CAN_FD_MESSAGE => 20,
        CAN_FD_MESSAGE_64 => 40,
        CAN_ERROR_EXT => 24,
        _ => 4,
    }
}

#[inline]
fn classic(body: &[u8]) -> Result<Frame, String> {
    let (flags, code, id) = (body[2], body[3], u32_at(body, 4, false));
    raw(id, flags & 0x80 != 0, None, &body[8..8 + length_of_code(code, false)]).check()
}

fn fd(body: &[u8]) -> Result<Frame, String> {
    let (flags, code, id, fd_flags) = (body[2], body[3], u32_at(body, 4, false), body[13]);
    let fd = (fd_flags & 1 != 0).then_some((fd_flags & 2 != 0, fd_flags & 4 != 0));
    let remote = flags & 0x80 != 0;
    let len = if remote { length_of_code(code, false) } else { usize::from(body[14]) };
    let data = body.get(20..20 + len).ok_or_else(|| missing(len, body.len() - 20))?;
    raw(id, remote, fd, data).check()
}

fn fd_64(body: &[u8], header: usize) -> Result<Frame, String> {
    let (code, valid, id, flags) = (body[1], body[2], u32_at(body, 4, false), u32_at(body, 12, false));
    let fd = (flags & 0x1000 != 0).then_some((flags & 0x2000 != 0, flags & 0x4000 != 0));
    if flags & 0x10 != 0 {
        return raw(id, true, None, &[0; 8][..length_of_code(code, false)]).check();
    }
    // Further fields may follow the payload. Byte 35 states their position from the start of the object; 0 = no further
    // fields.
    let end = match usize::from(body[35]) {
        0 => body.len(),
        place => place.saturating_sub(header).min(body.len()),
    };
    // As in Vector's own library, bytes that the object does not store are zero.
    let (len, mut data) = (usize::from(valid), [0; 64]);
    let stored = body.get(40..end).unwrap_or_default();
    data.iter_mut().zip(stored.iter().take(len)).for_each(|(to, from)| *to = *from);
    raw(id, false, fd, data.get(..len).ok_or_else(|| missing(len, stored.len()))?).check()
}

fn raw(id: u32, remote: bool, fd: Option<(bool, bool)>, data: &[u8]) -> RawFrame<'_> {
    RawFrame { id: id & !EXTENDED, extended: id & EXTENDED != 0, remote, fd, data }
}

fn missing(len: usize, found: usize) -> String {
    format!("frame of {len} bytes in an object with {found} bytes of data")
}
