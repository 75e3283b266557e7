//! The journal records every input of the core in order, so that a replay reproduces the live run.
//!
//! The journal is a text file. Frames are candump lines with nanosecond stamps, which `canplayer` can play; `canplayer`
//! skips the other lines. The first line is `PACKWATCH-JOURNAL 1`. Further lines have these forms:
//!
//! ```text
//! (1700000000.123456789) can0 123#1122
//! SECURED (1700000000.125000000) can0 6B3#1122334455667788 27200000016|-
//! TICK (1700000000.130000000)
//! BUS (1700000000.200000000) can0 up|down|missing|dropped N|error_frame CLASS|send_failed N
//! GAP (1700000000.300000000)
//! RESTORE (1700000000.000000000) AWAY_SECONDS|-|unknown
//! COMMAND (1700000000.400000000) {"command":"acknowledge",...}
//! STORE (1700000000.500000000) works|fails
//! RELOAD (1700000000.600000000)
//! ```
//!
//! `SECURED` is a frame of an authenticated message. The last field is the freshness value with which the
//! authenticator was valid, so a replay needs no key (`-`: the authenticator was not valid). `RELOAD` means that
//! another configuration applies after this line. The journal does not contain this configuration. `RESTORE` is the
//! first line of a run that restored a stored state, and contains the downtime (`-`: it follows from the stamps;
//! `unknown`: it is not known). If the last line has no line feed, a power cut interrupted it. Such a line counts as
//! a bad line, even if it can be parsed.

use std::io::{self, Write};

use super::candump::{self, LineError, StampDigits};
use crate::can::Frame;
use crate::monitor::{BusEvent, Downtime, Record, RecordKind};
use crate::quantity::{BusIndex, Timestamp};

/// First line of every journal.
pub const HEADER: &str = "PACKWATCH-JOURNAL 1";

/// Keywords of lines that are not frames.
const KEYWORDS: [&[u8]; 8] = [b"SECURED", b"TICK", b"BUS", b"GAP", b"RESTORE", b"COMMAND", b"STORE", b"RELOAD"];

/// Whether a line begins with a keyword of the journal.
pub fn is_mark(line: &[u8]) -> bool {
    line.iter().position(|&b| b == b' ').is_some_and(|space| KEYWORDS.contains(&&line[..space]))
}

/// Parses a journal line that [`is_mark`] recognises. Returns `None` if `bus` does not know the interface of the line.
///
/// # Errors
/// Fails if the line breaks the journal's grammar.
pub fn parse_mark(line: &[u8], bus: impl FnOnce(&[u8]) -> Option<BusIndex>) -> Result<Option<Record>, LineError> {
    let line = line.strip_suffix(b"\r").unwrap_or(line);
    let space = memchr::memchr(b' ', line).unwrap_or(line.len());
    let shifted = |e: LineError| LineError { column: e.column + space + 1, ..e };
    let (time, rest) = candump::parse_stamp(line.get(space + 1..).unwrap_or_default()).map_err(shifted)?;
    let rest_text = rest.strip_prefix(b" ").unwrap_or_default();
    let alone = |record: Record| rest.is_empty().then_some(record);
    let (record, expected) = match &line[..space] {
        b"TICK" => (alone(Record::tick(time)), "the end of the line after the stamp"),
        b"GAP" => (alone(Record::unknown_gap(time)), "the end of the line after the stamp"),
        b"RELOAD" => (alone(Record::reload(time)), "the end of the line after the stamp"),
        b"RESTORE" => {
            (parse_away(rest_text).map(|away| Record::restore(time, away)), "the downtime in seconds, - or unknown")
        }
        b"COMMAND" => {
            let command = serde_json::from_slice(rest_text).ok();
            (command.map(|command| Record::command(time, command)), "a command as JSON")
        }
        b"STORE" => {
            let works = [(&b"works"[..], true), (b"fails", false)].into_iter().find(|(word, _)| *word == rest_text);
            (works.map(|(_, works)| Record::store(time, works)), "works or fails")
        }
        b"SECURED" => match parse_secured(rest_text) {
            Some((interface, frame, freshness)) => {
                return Ok(bus(interface).map(|bus| Record::secured_frame(time, bus, &frame, freshness)));
            }
            None => (None, "an interface, a frame, and its freshness value or -"),
        },
        _ => match parse_bus(rest_text) {
            Some((interface, event)) => return Ok(bus(interface).map(|bus| Record::bus(time, bus, event))),
            None => (
                None,
                "an interface and up, down, missing, dropped N, error_frame CLASS (8 hex digits) or send_failed N",
            ),
        },
    };
    let column = line.len() - rest.len() + 1;
    record.map(Some).ok_or(LineError { column, expected })
}

fn parse_away(text: &[u8]) -> Option<Downtime> {
    std::str::from_utf8(text).ok()?.parse().ok()
}

fn parse_secured(text: &[u8]) -> Option<(&[u8], Frame, Option<u64>)> {
    let (interface, frame, rest) = candump::parse_frame(text)?;
    let freshness = match rest.strip_prefix(b" ")? {
        b"-" => None,
        digits => Some(std::str::from_utf8(digits).ok()?.parse().ok()?),
    };
    Some((interface, frame, freshness))
}

fn parse_bus(text: &[u8]) -> Option<(&[u8], BusEvent)> {
    let mut words = text.split(|&b| b == b' ');
    let (interface, what, value) = (words.next()?, words.next()?, words.next());
    let value = value.map(std::str::from_utf8).transpose().ok()?;
    let event = match (what, value) {
        (b"up", None) => BusEvent::Up,
        (b"down", None) => BusEvent::Down,
        (b"missing", None) => BusEvent::Missing,
        (b"dropped", Some(n)) => BusEvent::Dropped { frames: n.parse().ok()? },
        (b"send_failed", Some(n)) => BusEvent::SendFailed { frames: n.parse().ok()? },
        (b"error_frame", Some(class)) => BusEvent::ErrorFrame { class: u32::from_str_radix(class, 16).ok()? },
        _ => return None,
    };
    (!interface.is_empty() && words.next().is_none()).then_some((interface, event))
}

/// Writes a journal. `W` should be buffered; only [`flush`](Self::flush) flushes it.
#[derive(Debug)]
pub struct JournalWriter<W: Write> {
    out: W,
    interfaces: Vec<String>,
}

impl<W: Write> JournalWriter<W> {
    /// Begins a journal. `interfaces` are the configured names in order.
    pub fn new(mut out: W, interfaces: Vec<String>) -> io::Result<Self> {
        writeln!(out, "{HEADER}")?;
        Ok(Self { out, interfaces })
    }

    /// Records that a stored state was restored and how old it was. Must precede every input.
    pub fn restored(&mut self, now: Timestamp, away: Downtime) -> io::Result<()> {
        write_mark(&mut self.out, "RESTORE", now, format_args!(" {away}"))
    }

    /// Records that another configuration applies after this point.
    pub fn reloaded(&mut self, time: Timestamp) -> io::Result<()> {
        write_mark(&mut self.out, "RELOAD", time, "")
    }

    /// Appends one record, as the core receives it.
    ///
    /// # Errors
    /// Returns the errors of the file. Also fails if the interface of the record is not configured.
    pub fn append(&mut self, record: &Record) -> io::Result<()> {
        let time = record.time;
        match &record.kind {
            RecordKind::Frame { bus, frame } => {
                let interface = name(&self.interfaces, bus.index())?;
                candump::write_line(&mut self.out, time, StampDigits::Nanos, interface, frame)
            }
            RecordKind::SecuredFrame { bus, frame, freshness } => {
                let interface = name(&self.interfaces, bus.index())?;
                let frame = candump::frame_text(frame);
                let freshness = freshness.map_or("-".to_owned(), |freshness| freshness.to_string());
                write_mark(&mut self.out, "SECURED", time, format_args!(" {interface} {frame} {freshness}"))
            }
            RecordKind::Tick => write_mark(&mut self.out, "TICK", time, ""),
            RecordKind::UnknownGap => write_mark(&mut self.out, "GAP", time, ""),
            RecordKind::Command { command } => {
                write_mark(&mut self.out, "COMMAND", time, format_args!(" {}", serde_json::to_string(command)?))
            }
            RecordKind::Store { works } => {
                write_mark(&mut self.out, "STORE", time, if *works { " works" } else { " fails" })
            }
            RecordKind::Bus { bus, event } => {
                let interface = name(&self.interfaces, bus.index())?;
                write_mark(&mut self.out, "BUS", time, format_args!(" {interface} {}", bus_words(*event)))
            }
            RecordKind::Reload => write_mark(&mut self.out, "RELOAD", time, ""),
            RecordKind::Restore { away } => write_mark(&mut self.out, "RESTORE", time, format_args!(" {away}")),
        }
    }

    /// Passes all written bytes to the operating system.
    pub fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }

    /// The underlying file.
    pub fn into_inner(self) -> W {
        self.out
    }
}

fn write_mark(out: &mut impl Write, keyword: &str, time: Timestamp, rest: impl std::fmt::Display) -> io::Result<()> {
    write!(out, "{keyword} ")?;
    candump::write_stamp(out, time, StampDigits::Nanos)?;
    writeln!(out, "{rest}")
}

fn name(interfaces: &[String], index: usize) -> io::Result<&str> {
    interfaces.get(index).map(String::as_str).ok_or_else(|| {
        let text = format!("interface number {index}, must be below {}, the number of interfaces", interfaces.len());
        io::Error::new(io::ErrorKind::InvalidInput, text)
    })
}

fn bus_words(event: BusEvent) -> String {
    match event {
        BusEvent::Up => "up".to_owned(),
        BusEvent::Down => "down".to_owned(),
        BusEvent::Missing => "missing".to_owned(),
        BusEvent::Dropped { frames } => format!("dropped {frames}"),
        BusEvent::SendFailed { frames } => format!("send_failed {frames}"),
        BusEvent::ErrorFrame { class } => format!("error_frame {class:08X}"),
    }
}
