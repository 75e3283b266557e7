//! The journal: every input of the core, in order, so that a replay gives what the live run gave.
//!
//! A text file whose frames are candump lines with nanosecond stamps, so that `canplayer` can play it; the rest
//! are lines that canplayer skips. First line `PACKWATCH-JOURNAL 1`, then
//!
//! ```text
//! (1700000000.123456789) can0 123#1122
//! TICK (1700000000.130000000)
//! BUS (1700000000.200000000) can0 up|down|missing|dropped N|error_frame CLASS|send_failed N
//! GAP (1700000000.300000000)
//! RESTORE (1700000000.000000000) AWAY_SECONDS|-|unknown
//! COMMAND (1700000000.400000000) {"command":"acknowledge",...}
//! STORE (1700000000.500000000) works|fails
//! RELOAD (1700000000.600000000)
//! ```
//!
//! `RELOAD`: from here on another configuration is in force, which the journal does not contain.
//! `RESTORE` is the first line of a run that restored a stored state, with the time it did not run (`-`: as the stamps
//! say).
//! A last line without line feed was torn by a power cut and is a bad line, even where it could be read.

use std::io::{self, Write};

use super::candump::{self, LineError, StampDigits};
use crate::monitor::{BusEvent, Command, Downtime, Input};
use crate::quantity::Timestamp;

/// First line of every journal.
pub const HEADER: &str = "PACKWATCH-JOURNAL 1";

/// A journal line other than a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Mark<'a> {
    Tick { time: Timestamp },
    Bus { time: Timestamp, interface: &'a [u8], event: BusEvent },
    Gap { time: Timestamp },
    Restore { time: Timestamp, away: Downtime },
    Command { time: Timestamp, command: Command },
    Store { time: Timestamp, works: bool },
    Reload { time: Timestamp },
}

/// Reads a journal line that does not begin with `(`; `None` = not a line of the journal.
///
/// # Errors
/// When the line begins as one of the journal's and breaks its grammar.
pub fn parse_mark(line: &[u8]) -> Result<Option<Mark<'_>>, LineError> {
    let line = line.strip_suffix(b"\r").unwrap_or(line);
    let Some(space) = memchr::memchr(b' ', line) else { return Ok(None) };
    let keyword = &line[..space];
    if ![&b"TICK"[..], b"BUS", b"GAP", b"RESTORE", b"COMMAND", b"STORE", b"RELOAD"].contains(&keyword) {
        return Ok(None);
    }
    let shifted = |e: LineError| LineError { column: e.column + space + 1, ..e };
    let (time, rest) = candump::parse_stamp(&line[space + 1..]).map_err(shifted)?;
    let fail = |expected| Err(LineError { column: line.len() - rest.len() + 1, expected });
    let rest_text = rest.strip_prefix(b" ").unwrap_or_default();
    match keyword {
        b"TICK" | b"GAP" | b"RELOAD" if !rest.is_empty() => fail("the line's end after the stamp"),
        b"TICK" => Ok(Some(Mark::Tick { time })),
        b"GAP" => Ok(Some(Mark::Gap { time })),
        b"RELOAD" => Ok(Some(Mark::Reload { time })),
        b"RESTORE" => match parse_away(rest_text) {
            Some(away) => Ok(Some(Mark::Restore { time, away })),
            None => fail("seconds away, - or unknown"),
        },
        b"COMMAND" => match serde_json::from_slice(rest_text) {
            Ok(command) => Ok(Some(Mark::Command { time, command })),
            Err(_) => fail("a command as JSON"),
        },
        b"STORE" => match rest_text {
            b"works" => Ok(Some(Mark::Store { time, works: true })),
            b"fails" => Ok(Some(Mark::Store { time, works: false })),
            _ => fail("works or fails"),
        },
        _ => match parse_bus(rest_text) {
            Some((interface, event)) => Ok(Some(Mark::Bus { time, interface, event })),
            None => {
                fail("an interface and up, down, missing, dropped N, error_frame CLASS (8 hex digits) or send_failed N")
            }
        },
    }
}

fn parse_away(text: &[u8]) -> Option<Downtime> {
    std::str::from_utf8(text).ok()?.parse().ok()
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
    /// Begins a journal; `interfaces` are the configured names in order.
    ///
    /// # Errors
    /// Those of `out`.
    pub fn new(mut out: W, interfaces: Vec<String>) -> io::Result<Self> {
        writeln!(out, "{HEADER}")?;
        Ok(Self { out, interfaces })
    }

    /// Notes that a stored state was restored, and how old it was; before any input.
    ///
    /// # Errors
    /// Those of the file.
    pub fn restored(&mut self, now: Timestamp, away: Downtime) -> io::Result<()> {
        self.mark("RESTORE", now)?;
        writeln!(self.out, " {away}")
    }

    /// Notes that another configuration is in force.
    ///
    /// # Errors
    /// Those of the file.
    pub fn reloaded(&mut self, time: Timestamp) -> io::Result<()> {
        self.mark("RELOAD", time)?;
        self.out.write_all(b"\n")
    }

    /// Appends one input, as the core receives it.
    ///
    /// # Errors
    /// Those of the file; an interface that is not configured is invalid input.
    pub fn append(&mut self, input: &Input<'_>) -> io::Result<()> {
        match *input {
            Input::Frame { time, bus, frame } => {
                let interface = name(&self.interfaces, bus.index())?;
                candump::write_line(&mut self.out, time, StampDigits::Nanos, interface, frame)
            }
            Input::Tick { time } => {
                self.mark("TICK", time)?;
                self.out.write_all(b"\n")
            }
            Input::UnknownGap { time } => {
                self.mark("GAP", time)?;
                self.out.write_all(b"\n")
            }
            Input::Command { time, command } => {
                self.mark("COMMAND", time)?;
                writeln!(self.out, " {}", serde_json::to_string(&command)?)
            }
            Input::Store { time, works } => {
                self.mark("STORE", time)?;
                writeln!(self.out, " {}", if works { "works" } else { "fails" })
            }
            Input::Bus { time, bus, event } => {
                self.mark("BUS", time)?;
                let interface = name(&self.interfaces, bus.index())?;
                write_bus(&mut self.out, interface, event)
            }
        }
    }

    /// Hands everything to the operating system.
    ///
    /// # Errors
    /// Those of the file.
    pub fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }

    /// The file.
    pub fn into_inner(self) -> W {
        self.out
    }

    fn mark(&mut self, keyword: &str, time: Timestamp) -> io::Result<()> {
        write!(self.out, "{keyword} ")?;
        candump::write_stamp(&mut self.out, time, StampDigits::Nanos)
    }
}

fn name(interfaces: &[String], index: usize) -> io::Result<&str> {
    interfaces.get(index).map(String::as_str).ok_or_else(|| {
        let text = format!("interface number {index}, configured are {}", interfaces.len());
        io::Error::new(io::ErrorKind::InvalidInput, text)
    })
}

fn write_bus(out: &mut impl Write, interface: &str, event: BusEvent) -> io::Result<()> {
    match event {
        BusEvent::Up => writeln!(out, " {interface} up"),
        BusEvent::Down => writeln!(out, " {interface} down"),
        BusEvent::Missing => writeln!(out, " {interface} missing"),
        BusEvent::Dropped { frames } => writeln!(out, " {interface} dropped {frames}"),
        BusEvent::SendFailed { frames } => writeln!(out, " {interface} send_failed {frames}"),
        BusEvent::ErrorFrame { class } => writeln!(out, " {interface} error_frame {class:08X}"),
    }
}
