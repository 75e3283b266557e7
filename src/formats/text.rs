//! Reads text logs: one item per line.
//!
//! Each format is a [`Grammar`], which parses one line. [`TextLog`] reads the lines of a log with a grammar. A line
//! that violates the grammar becomes [`Item::Bad`] with its column, and the next line is read as usual.

mod asc;
mod busmaster;
mod candump;
mod canking;
mod crtd;
mod css;
mod cursor;
pub(crate) mod date;
mod frame_table;
mod lines;
mod python_can;
#[cfg(test)]
mod tests;
mod trc;

use std::io::{self, Read};

use packwatch_core::quantity::Timestamp;

use crate::{Channel, Format, Item, LogReader, Position};
use cursor::{Cursor, Fault};
use lines::{Line, Lines};

/// Maximum number of channels in a log. The index of a channel has 8 bits.
const MAX_CHANNELS: usize = 256;
/// Maximum length of a channel's name, bytes. The name of a Linux interface has at most 15.
const MAX_NAME: usize = 64;

/// Parses the lines of a format.
trait Grammar: Sized {
    /// Creates a reader for a log that begins with these bytes.
    ///
    /// # Errors
    /// Fails if the format cannot be read, although it is recognised.
    fn new(head: &[u8]) -> io::Result<Self>;

    /// Whether a line can belong only to this format. The line may come from any file.
    fn recognises(line: &[u8]) -> bool;

    /// What was assumed about the log.
    fn remark(&self) -> Option<&'static str> {
        None
    }

    /// Reads a line.
    ///
    /// # Errors
    /// Fails if the line violates the grammar.
    fn item(&mut self, line: Cursor<'_>, channels: &mut Channels) -> Result<Item, Fault>;
}

/// Finds the text format of a log from its first bytes.
pub(crate) fn recognise(head: &[u8]) -> Option<Format> {
    type Recogniser = fn(&[u8]) -> bool;
    const FORMATS: [(Format, Recogniser); 8] = [
        (Format::Asc, asc::Asc::recognises),
        (Format::Trc, trc::Trc::recognises),
        (Format::PythonCanCsv, python_can::PythonCan::recognises),
        (Format::Css, css::Css::recognises),
        (Format::Crtd, crtd::Crtd::recognises),
        (Format::CanKing, canking::CanKing::recognises),
        (Format::Busmaster, busmaster::Busmaster::recognises),
        (Format::FrameTable, frame_table::FrameTable::recognises),
    ];
    let head = lines::decoded_head(head);
    for line in head.split(|byte| matches!(byte, b'\n' | b'\r')) {
        if line.starts_with(b"PACKWATCH-JOURNAL") {
            return None;
        }
        if candump::is_log_line(line) {
            return candump::has_deltas(&head).then_some(Format::CandumpDeltas);
        }
        if candump::is_screen_line(line) {
            return Some(if candump::has_deltas(&head) { Format::CandumpDeltas } else { Format::Candump });
        }
        if let Some((format, _)) = FORMATS.iter().find(|(_, recognises)| recognises(line)) {
            return Some(*format);
        }
    }
    None
}

/// Opens a log of a text format.
///
/// # Errors
/// Fails if the source cannot be read or the log cannot be used.
pub(crate) fn open(format: Format, source: Box<dyn Read>) -> io::Result<Box<dyn LogReader>> {
    match format {
        Format::Candump => TextLog::<candump::Candump>::open(source),
        Format::CandumpDeltas => TextLog::<candump::CandumpDeltas>::open(source),
        Format::Asc => TextLog::<asc::Asc>::open(source),
        Format::Trc => TextLog::<trc::Trc>::open(source),
        Format::FrameTable => TextLog::<frame_table::FrameTable>::open(source),
        Format::PythonCanCsv => TextLog::<python_can::PythonCan>::open(source),
        Format::Css => TextLog::<css::Css>::open(source),
        Format::Crtd => TextLog::<crtd::Crtd>::open(source),
        Format::CanKing => TextLog::<canking::CanKing>::open(source),
        Format::Busmaster => TextLog::<busmaster::Busmaster>::open(source),
        Format::Blf | Format::Mf4 | Format::Pcap | Format::PcapNg => {
            Err(io::Error::new(io::ErrorKind::InvalidInput, format!("{} is not a text format", format.name())))
        }
    }
}

/// A text log that is being read.
struct TextLog<G> {
    lines: Lines,
    grammar: G,
    channels: Channels,
}

impl<G: Grammar + 'static> TextLog<G> {
    fn open(source: Box<dyn Read>) -> io::Result<Box<dyn LogReader>> {
        let mut lines = Lines::new(source)?;
        let grammar = G::new(lines.head(Format::HEAD_BYTES))?;
        Ok(Box::new(Self { lines, grammar, channels: Channels::default() }))
    }
}

impl<G: Grammar> LogReader for TextLog<G> {
    fn next_item(&mut self) -> io::Result<Option<Item>> {
        let (text, is_whole) = match self.lines.next_line()? {
            None => return Ok(None),
            Some(Line::TooLong) => return Ok(Some(Item::Bad("longer than 256 KiB".to_owned()))),
            Some(Line::Whole(text)) => (text, true),
            Some(Line::Last(text)) => (text, false),
        };
        let line = Cursor { text: text.trim_ascii_end(), at: 0, is_whole };
        let item = self.grammar.item(line, &mut self.channels);
        Ok(Some(item.unwrap_or_else(|fault| Item::Bad(fault.describe(line.text)))))
    }

    fn position(&self) -> Position {
        Position::Line(self.lines.number())
    }

    fn remark(&self) -> Option<&'static str> {
        self.grammar.remark()
    }

    fn channels(&self) -> &[Channel] {
        &self.channels.list
    }
}

/// The channels found in a log.
#[derive(Default)]
struct Channels {
    list: Vec<Channel>,
}

impl Channels {
    /// Returns the position of a numbered channel in the list. `first` is the number from which such logs usually
    /// count. If the first channel found has a smaller number, channels count from that number. `None` if there are too
    /// many channels.
    #[inline]
    fn number(&mut self, written: u32, first: u32) -> Option<u8> {
        let is_known =
            |channel: &Channel| matches!(channel, Channel::Number { written: known, .. } if *known == written);
        if let Some(place) = self.list.iter().position(is_known) {
            return u8::try_from(place).ok();
        }
        let counts_from = match self.list.first() {
            Some(Channel::Number { written, index: 0 }) => first.min(*written),
            _ => first.min(written),
        };
        self.add(Channel::Number { written, index: written.saturating_sub(counts_from) })
    }

    /// Returns the position of a named channel in the list. `None` if there are too many channels, or if the name is
    /// longer than 64 bytes or contains characters other than visible ASCII.
    #[inline]
    fn name(&mut self, name: &[u8]) -> Option<u8> {
        let is_known = |channel: &Channel| matches!(channel, Channel::Name(known) if known.as_bytes() == name);
        if let Some(place) = self.list.iter().position(is_known) {
            return u8::try_from(place).ok();
        }
        let is_name = !name.is_empty() && name.len() <= MAX_NAME && name.iter().all(u8::is_ascii_graphic);
        if is_name { self.add(Channel::Name(String::from_utf8_lossy(name).into_owned())) } else { None }
    }

    fn add(&mut self, channel: Channel) -> Option<u8> {
        if self.list.len() == MAX_CHANNELS {
            return None;
        }
        self.list.push(channel);
        u8::try_from(self.list.len() - 1).ok()
    }
}

/// Text after "expected" in the fault of a line whose channel [`Channels`] rejects.
const CHANNEL: &str = "a channel (at most 256 channels)";

/// A sum of times; `None` beyond the range of [`Timestamp`].
fn time(start_ns: i64, offset_ns: i64) -> Option<Timestamp> {
    start_ns.checked_add(offset_ns).map(Timestamp::from_nanos)
}
