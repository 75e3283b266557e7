//! Reads Vector ASC logs, as CANoe, CANalyzer and many other tools write them.
//!
//! Header: `date Tue Nov 14 10:13:20.000 pm 2023`, `base hex  timestamps absolute`. Line of a classic frame:
//! `1.000000 1  18FF1234x  Rx   d 8 05 00 ...` (data) or `... r 8` (remote); `x` marks an extended identifier. Line of a
//! CAN FD frame: `1.000000 CANFD 1 Rx 100 NAME 1 0 8 8 05 00 ...`. CANXL lines contain classic, FD and XL frames.
//!
//! Stamps count from the date of the first trigger block, or from the `date` line if the block has no date. The date is
//! local time without a zone; it is read as UTC. In `timestamps relative`, each stamp counts from the previous event. A
//! later trigger block restarts the time only if its stamps restart.
//!
//! Statistics, events, frames of other buses, and requests to send (`TxRq`) are [`Item::Other`]. A request is not a
//! frame, because the frame that was sent follows it.

use std::io;

use packwatch_core::can::{CanId, Frame, MAX_DATA};
use packwatch_core::quantity::Timestamp;

use super::cursor::{Base, Cursor, Fault, fd_length, identifier, number, scaled};
use super::{CHANNEL, Channels, Grammar, date, time};
use crate::Item;

/// Bits of the flags that end a CANFD line.
const FLAG_REMOTE: u32 = 0x10;
const FLAG_FD: u32 = 0x1000;
const FLAG_BRS: u32 = 0x2000;
const FLAG_ESI: u32 = 0x4000;

const TIME: &str = "a time below 9223372036 s";
const IDENTIFIER: &str = "an identifier of at most 7FF, or 1FFFFFFFx";
const LENGTH: &str = "a length of 0 to 64";

pub(super) struct Asc {
    base: Base,
    is_relative: bool,
    start_ns: i64,
    /// Date of a trigger block whose first stamp is not yet known, ns.
    block_start_ns: Option<i64>,
    /// The latest stamp: as written, or added up if the stamps are relative.
    latest_ns: Option<i64>,
}

impl Grammar for Asc {
    fn new(_head: &[u8]) -> io::Result<Self> {
        Ok(Self { base: Base::Hex, is_relative: false, start_ns: 0, block_start_ns: None, latest_ns: None })
    }

    fn recognises(line: &[u8]) -> bool {
        let mut line = Cursor::new(line);
        let (first, second) = (line.word(), line.word());
        if first.eq_ignore_ascii_case(b"date") {
            return date::parse(&line.text[first.len()..]).is_some();
        }
        if first.eq_ignore_ascii_case(b"base") {
            return base_of(second).is_some();
        }
        if first.eq_ignore_ascii_case(b"begin") {
            return second.eq_ignore_ascii_case(b"triggerblock");
        }
        if !first.contains(&b'.') || scaled(first, 9).is_none() {
            return false;
        }
        let is_fd = matches!(second, b"CANFD" | b"CANXL");
        let words = [line.word(), line.word(), line.word()];
        let is_classic = number(second, Base::Dec).is_some()
            && (words[0] == b"ErrorFrame" || (is_direction(words[1]) && matches!(words[2], b"d" | b"r")));
        is_classic || (is_fd && words[..2].iter().any(|word| is_direction(word)))
    }

    #[inline]
    fn item(&mut self, line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        match line.rest() {
            [b'0'..=b'9' | b'-', ..] => self.event(line, channels),
            [] | [b'/', b'/', ..] | [b'#' | b';', ..] => Ok(Item::Other),
            _ => self.header(line),
        }
    }
}

impl Asc {
    fn header(&mut self, mut line: Cursor<'_>) -> Result<Item, Fault> {
        let start = line;
        let first = line.word().to_ascii_lowercase();
        match first.as_slice() {
            b"date" => {
                let expected = "a date such as Mon Jan 1 12:00:00.000 2024";
                self.start_ns = date::parse(line.rest()).ok_or_else(|| line.fault(expected))?;
                (self.block_start_ns, self.latest_ns) = (None, None);
            }
            b"base" => {
                self.base = line.parse("hex or dec", base_of)?;
                self.is_relative = line.rest().to_ascii_lowercase().ends_with(b"relative");
            }
            b"begin" => {
                line.word();
                let date = line.rest();
                if !date.is_empty() {
                    let expected = "a date such as Mon Jan 1 12:00:00.000 2024, or the end of the line";
                    self.block_start_ns = Some(date::parse(date).ok_or_else(|| line.fault(expected))?);
                }
            }
            b"end" | b"internal" | b"no" | b"measurement" | b"previous" | b"next" | b"version" => {}
            _ => return Err(start.fault("a time, a comment //, or a header line such as date or base")),
        }
        Ok(Item::Other)
    }

    /// Reads a line with a stamp.
    #[inline]
    fn event(&mut self, mut line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        let start = line;
        let written = line.time(9)?;
        let time = self.place(written).ok_or_else(|| start.fault(TIME))?;
        let after_time = line;
        match line.word() {
            b"CANFD" => self.fd(time, line, channels),
            b"CANXL" => self.xl(time, line, channels),
            [b'0'..=b'9', ..] => self.classic(time, after_time, channels),
            [] => Err(line.fault("an event")),
            _ => Ok(Item::Other),
        }
    }

    /// Returns the time of a written stamp. `None` if it is out of range.
    #[inline]
    fn place(&mut self, written_ns: i64) -> Option<Timestamp> {
        let from_start_ns = match self.latest_ns {
            Some(latest_ns) if self.is_relative => latest_ns.checked_add(written_ns)?,
            _ => written_ns,
        };
        if let Some(block_start_ns) = self.block_start_ns.take()
            && self.latest_ns.is_none_or(|latest_ns| from_start_ns < latest_ns)
        {
            self.start_ns = block_start_ns;
        }
        self.latest_ns = Some(from_start_ns);
        time(self.start_ns, from_start_ns)
    }

    /// Reads `CHANNEL ID DIRECTION d LENGTH DATA` or another event of a CAN channel.
    #[inline]
    fn classic(&self, time: Timestamp, mut line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        let channel = channel(&mut line, channels)?;
        let at_id = line;
        let id = line.word();
        if is_error_frame(id) {
            return Ok(Item::ErrorFrame { time, channel, class: 0 });
        }
        let at_direction = line;
        let direction = line.word();
        if is_request(direction) {
            return Ok(Item::Other);
        }
        let id = self.id(id);
        if !is_direction(direction) {
            // Other events of a channel begin with a word, such as `Statistic:`.
            return if id.is_some() { Err(at_direction.fault("Rx, Tx or TxRq")) } else { Ok(Item::Other) };
        }
        let id = id.ok_or_else(|| at_id.fault(IDENTIFIER))?;
        let at_kind = line;
        let frame = match line.word() {
            b"d" | b"D" => {
                let code = line.parse("a length code of 0 to F", length_code)?;
                let len = (code as usize).min(8);
                let data = line.data(len, self.base)?;
                Frame::classic(id, &data[..len])
            }
            b"r" | b"R" => Frame::remote(id, remote_length(line)),
            _ => None,
        };
        let frame = frame.ok_or_else(|| at_kind.fault("d or r"))?;
        Ok(Item::Frame { time, channel, frame })
    }

    /// Reads the rest of a CANFD line: `CHANNEL DIRECTION ID [NAME] BRS ESI CODE LENGTH DATA DURATION BITS FLAGS`, or the
    /// older form `CHANNEL ID DIRECTION BRS ESI d CODE LENGTH DATA`.
    fn fd(&self, time: Timestamp, mut line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        let channel = channel(&mut line, channels)?;
        let mut at_id = line;
        let (mut id, mut direction) = (line.word(), line.peek());
        if is_direction(id) || is_request(id) {
            direction = id;
            at_id = line;
            id = line.word();
        } else {
            line.word();
        }
        if is_error_frame(id) {
            return Ok(Item::ErrorFrame { time, channel, class: 0 });
        }
        if is_request(direction) {
            return Ok(Item::Other);
        }
        let id = self.id(id).filter(|_| is_direction(direction)).ok_or_else(|| at_id.fault(IDENTIFIER))?;
        let brs = skip_name(&mut line)?;
        let esi = line.parse("0 or 1 (ESI)", flag)?;
        if is_kind(line) && line.word() == b"r" {
            let frame = Frame::remote(id, remote_length(line)).ok_or_else(|| line.fault(LENGTH))?;
            return Ok(Item::Frame { time, channel, frame });
        }
        let code = line.parse("a length code", |word| number(word, Base::Hex))?;
        let len = line.parse(LENGTH, length)?;
        let data = line.data(len, self.base)?;
        let flags = flags(line);
        let is_fd = len > 8 || brs || esi || flags.is_none_or(|flags| flags & FLAG_FD != 0);
        let is_remote = !is_fd && flags.is_some_and(|flags| flags & FLAG_REMOTE != 0);
        let frame = fd_frame(id, if is_fd { Some((brs, esi)) } else { None }, is_remote.then_some(code), len, &data);
        let frame = frame.ok_or_else(|| line.fault(LENGTH))?;
        Ok(Item::Frame { time, channel, frame })
    }

    /// Reads the rest of a CANXL line: `CHANNEL DIRECTION FORMAT DURATION BITS ID [NAME] CODE LENGTH DATA ... FLAGS`. The
    /// format is CBFF or CEFF (classic), FBFF or FEFF (FD), or XLFF.
    fn xl(&self, time: Timestamp, mut line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault> {
        let channel = channel(&mut line, channels)?;
        let direction = line.word();
        let kind = line.word();
        if is_error_frame(direction) || is_error_frame(kind) {
            return Ok(Item::ErrorFrame { time, channel, class: 0 });
        }
        if is_request(direction) || !matches!(kind, b"CBFF" | b"CEFF" | b"FBFF" | b"FEFF" | b"XLFF") {
            return Ok(Item::Other);
        }
        if kind == b"XLFF" {
            return Ok(Item::Xl);
        }
        line.word();
        line.word();
        let id = line.parse(IDENTIFIER, |word| self.id(word))?;
        // A length code of one digit and a length follow the optional name.
        let mut ahead = line;
        if ahead.word().len() != 1 || length(ahead.word()).is_none() {
            line.word();
        }
        let code = line.parse("a length code", |word| number(word, Base::Hex))?;
        let len = line.parse(LENGTH, length)?;
        let data = line.data(len, Base::Hex)?;
        let is_fd = kind.starts_with(b"F");
        // FD frames have a count of stuff bits before the checksum.
        for _ in 0..1 + usize::from(is_fd) {
            line.word();
        }
        let flags = number(line.word(), Base::Hex).unwrap_or(0);
        let fd = is_fd.then_some((flags & FLAG_BRS != 0, flags & FLAG_ESI != 0));
        let is_remote = !is_fd && flags & FLAG_REMOTE != 0;
        let frame = fd_frame(id, fd, is_remote.then_some(code), len, &data);
        let frame = frame.ok_or_else(|| line.fault("a length that the frame can have"))?;
        Ok(Item::Frame { time, channel, frame })
    }

    /// Parses an identifier; `x` at its end marks an extended identifier.
    #[inline]
    fn id(&self, word: &[u8]) -> Option<CanId> {
        let (digits, is_extended) = match word {
            [digits @ .., b'x' | b'X'] => (digits, true),
            digits => (digits, false),
        };
        identifier(number(digits, self.base)?, is_extended)
    }
}

/// Builds a frame: FD with these flags (bit rate switch, error state), or classic. `remote` is the length code of a
/// remote request.
fn fd_frame(
    id: CanId,
    fd: Option<(bool, bool)>,
    remote: Option<u32>,
    len: usize,
    data: &[u8; MAX_DATA],
) -> Option<Frame> {
    match (fd, remote) {
        (Some((brs, esi)), _) => Frame::fd_padded(id, brs, esi, len, data),
        (None, Some(code)) => Frame::remote(id, fd_length(code.min(8))? as u8),
        (None, None) => Frame::classic(id, &data[..len]),
    }
}

/// Takes an optional symbolic name, which may be `-`, and the bit rate switch after it.
fn skip_name(line: &mut Cursor<'_>) -> Result<bool, Fault> {
    const EXPECTED: &str = "0 or 1 (BRS)";
    let mut ahead = *line;
    if flag(ahead.word()).is_none() || flag(ahead.word()).is_none() {
        line.word();
    }
    line.parse(EXPECTED, flag)
}

/// Whether the next word is `d` or `r` of the older form of a CANFD line. In `d 32`, the `d` is a length code (13 = 32
/// bytes).
fn is_kind(mut line: Cursor<'_>) -> bool {
    match line.word() {
        b"d" => line.word() != b"32",
        word => word == b"r",
    }
}

/// The flags after the data of a CANFD line; `None` if the line ends with something else.
fn flags(mut line: Cursor<'_>) -> Option<u32> {
    number(line.word(), Base::Dec)?;
    number(line.word(), Base::Dec)?;
    number(line.word(), Base::Hex)
}

#[inline]
fn channel(line: &mut Cursor<'_>, channels: &mut Channels) -> Result<u8, Fault> {
    line.parse(CHANNEL, |word| channels.number(number(word, Base::Dec)?, 1))
}

fn base_of(word: &[u8]) -> Option<Base> {
    match word.to_ascii_lowercase().as_slice() {
        b"hex" => Some(Base::Hex),
        b"dec" => Some(Base::Dec),
        _ => None,
    }
}

#[inline]
fn is_direction(word: &[u8]) -> bool {
    matches!(word, [b'R' | b'r' | b'T' | b't', b'x' | b'X'])
}

fn is_request(word: &[u8]) -> bool {
    word.eq_ignore_ascii_case(b"TxRq")
}

#[inline]
fn is_error_frame(word: &[u8]) -> bool {
    word.len() == 10 && word.eq_ignore_ascii_case(b"ErrorFrame")
}

fn flag(word: &[u8]) -> Option<bool> {
    match word {
        b"0" => Some(false),
        b"1" => Some(true),
        _ => None,
    }
}

/// Parses a length code: one hex digit, or 10 to 15.
#[inline]
fn length_code(word: &[u8]) -> Option<u32> {
    number(word, if word.len() == 1 { Base::Hex } else { Base::Dec }).filter(|code| *code <= 15)
}

fn length(word: &[u8]) -> Option<usize> {
    number(word, Base::Dec).map(|len| len as usize).filter(|len| *len <= MAX_DATA)
}

/// Length of a remote request; 0 if it is missing.
fn remote_length(line: Cursor<'_>) -> u8 {
    length_code(line.peek()).map_or(0, |code| code.min(8) as u8)
}
