//! Turns lines, rows and items of logs into records: counts them, finds their interface, and places them on one clock.

#[cfg(feature = "formats")]
use std::fmt::Write as _;

#[cfg(feature = "formats")]
use packwatch_formats::{Channel as LogChannel, Item};

use super::{LogCounts, LogError, MAX_ADOPTED};
use crate::io::candump::{Body, Line, LineError, LineHead, LineParser, ParsedLine};
use crate::io::csv_log::{CsvLog, RowTime};
use crate::io::journal;
use crate::io::lines::{Lines, RawLine};
#[cfg(feature = "formats")]
use crate::io::tool_log::ToolLog;
use crate::monitor::{BusEvent, Record, RecordKind};
use crate::quantity::{BusIndex, Timestamp};

/// Maximum number of unconfigured interfaces that are counted separately. Further interfaces are counted together under
/// "...".
const MAX_FOREIGN_NAMES: usize = 64;

pub(super) struct ReadState {
    pub(super) counts: LogCounts,
    pub(super) strict: bool,
    pub(super) interfaces: Vec<String>,
    /// Number of configured interfaces. They come first in `interfaces`.
    #[cfg(feature = "formats")]
    pub(super) configured: usize,
    pub(super) channels: Vec<(String, String)>,
    pub(super) parser: LineParser,
    /// Whether unconfigured interfaces also get a number, so that their records are returned.
    pub(super) adopt: bool,
    pub(super) shift_ns: i64,
    pub(super) latest: Option<Timestamp>,
    /// Whether the next record begins a file or section.
    pub(super) fresh: bool,
    /// Whether the time between the latest record and the next record is unknown.
    pub(super) unknown: bool,
    /// Whether the stamps of a file or section were moved, so that they follow the latest record.
    pub(super) has_moved_stamps: bool,
}

fn is_remark(line: &[u8]) -> bool {
    matches!(line.trim_ascii(), [] | [b'#' | b';' | b'%', ..])
}

impl ReadState {
    /// Fills slots with the next frames of a text log. Uses only complete lines that are already in the buffer. Does
    /// nothing before the first record of a file. Returns the number of frames.
    pub(super) fn next_frames(&mut self, lines: &mut Lines, name: &str, slots: &mut [Record]) -> usize {
        let Some(mut latest) = self.latest.filter(|_| !self.fresh) else { return 0 };
        let all = lines.unread();
        let (mut text, mut count, mut read_lines) = (all, 0, 0);
        while let Some(slot) = slots.get_mut(count)
            && let Ok(LineHead { time, interface, bus, rest }) = self.parser.parse_head(text)
        {
            let time = time.plus_nanos(self.shift_ns);
            // The frame is assigned in two places, so that the usual frame is built in place instead of being copied.
            let (len, is_known) = if let (Some(bus), Some((frame, len))) = (bus, rest.usual_frame_and_end()) {
                *slot = Record::frame(time, bus, &frame);
                (len, true)
            } else {
                let Ok((Body::Frame(frame), _, len)) = rest.frame_and_end() else { break };
                if len == text.len() {
                    break;
                }
                let bus = bus.or_else(|| self.bus(interface));
                *slot = Record::frame(time, bus.unwrap_or(BusIndex(0)), &frame);
                (len, bus.is_some())
            };
            text = &text[len + 1..];
            read_lines += 1;
            if !is_known {
                continue;
            }
            count += 1;
            if time < latest {
                let line = lines.number() + read_lines;
                self.note_backwards(time, latest, || format!("{name}:{line}"));
            } else {
                latest = time;
            }
        }
        let len = all.len() - text.len();
        lines.take_lines(len, read_lines);
        self.counts.lines += read_lines;
        self.counts.frames += count as u64;
        self.latest = Some(latest);
        count
    }

    #[cold]
    pub(super) fn note_backwards(&mut self, time: Timestamp, latest: Timestamp, place: impl FnOnce() -> String) {
        self.counts.time_backwards += 1;
        self.counts.first_time_backwards.get_or_insert_with(|| {
            let [stamp_s, latest_s] = [time, latest].map(|time| time.plus_nanos(-self.shift_ns).secs());
            format!("{}: stamp {stamp_s:.6} s is before {latest_s:.6} s", place())
        });
    }

    pub(super) fn bad(&mut self, what: impl FnOnce() -> String) -> Result<(), LogError> {
        self.counts.bad_lines += 1;
        if self.strict {
            return Err(LogError::Data(what()));
        }
        self.counts.first_bad_line.get_or_insert_with(what);
        Ok(())
    }

    /// The next record of a text log, on the log's own clock.
    pub(super) fn next_text(
        &mut self,
        lines: &mut Lines,
        journal: bool,
        name: &str,
    ) -> Result<Option<Record>, LogError> {
        loop {
            let number = lines.number() + 1;
            let bytes = match lines.next_line() {
                Ok(Some(RawLine::Whole(bytes))) => bytes,
                Ok(Some(RawLine::Last(bytes))) if !journal => bytes,
                Ok(Some(RawLine::Last(_))) => {
                    self.counts.lines += 1;
                    self.bad(|| format!("{name}:{number}: the last line is incomplete (no line feed)"))?;
                    continue;
                }
                Ok(Some(RawLine::TooLong)) => {
                    self.counts.lines += 1;
                    self.bad(|| format!("{name}:{number}: longer than 256 KiB"))?;
                    continue;
                }
                Ok(None) => return Ok(None),
                Err(error) => {
                    self.bad(|| format!("{name}: damaged after line {}: {error}", number - 1))?;
                    return Ok(None);
                }
            };
            // This line is the header of the next segment.
            if journal && number > 1 && bytes == journal::HEADER.as_bytes() {
                continue;
            }
            self.counts.lines += 1;
            let record = match self.parser.parse(bytes) {
                Ok(ParsedLine { line: Line::Other, .. }) if journal && journal::is_mark(bytes) => {
                    journal::parse_mark(bytes, |interface| self.bus(interface))
                }
                Ok(ParsedLine { line: Line::Other, .. }) if self.strict && !journal && !is_remark(bytes) => {
                    Err(LineError { column: 1, expected: "a candump line, a comment (#) or a blank line" })
                }
                Ok(ParsedLine { line: Line::Other, .. }) if !journal => {
                    self.note_ignored(name, number, bytes);
                    Ok(None)
                }
                Ok(parsed) => Ok(self.line_record(&parsed.line)),
                Err(error) => Err(error),
            };
            self.counts.frames +=
                u64::from(matches!(record, Ok(Some(Record { kind: RecordKind::SecuredFrame { .. }, .. }))));
            match record {
                Ok(Some(record)) => return Ok(Some(record)),
                Ok(None) => {}
                Err(error) => self.bad(|| format!("{name}:{number}: {}", error.describe(bytes)))?,
            }
        }
    }

    pub(super) fn note_ignored(&mut self, name: &str, number: u64, line: &[u8]) {
        const SHOWN: usize = 60;
        self.counts.ignored_lines += 1;
        if self.counts.first_ignored_line.is_none() && !is_remark(line) {
            let text = String::from_utf8_lossy(&line[..line.len().min(SHOWN)]).into_owned();
            let more = if line.len() > SHOWN { "..." } else { "" };
            self.counts.first_ignored_line = Some(format!("{name}:{number}: {text:?}{more}"));
        }
    }

    pub(super) fn line_record(&mut self, line: &Line<'_>) -> Option<Record> {
        match *line {
            Line::Frame { time, interface, frame, .. } => {
                let bus = self.bus(interface)?;
                self.counts.frames += 1;
                Some(Record::frame(time, bus, &frame))
            }
            Line::ErrorFrame { time, interface, class } => {
                self.counts.error_frames += 1;
                let bus = self.bus(interface)?;
                Some(Record::bus(time, bus, BusEvent::ErrorFrame { class }))
            }
            Line::Dropped { interface, frames } => {
                self.counts.dropped_frames = self.counts.dropped_frames.saturating_add(frames);
                let bus = self.bus(interface)?;
                // The line has no stamp, so it belongs to the preceding frame, if any.
                let time = self.latest?.plus_nanos(-self.shift_ns);
                (!self.fresh).then_some(Record::bus(time, bus, BusEvent::Dropped { frames }))
            }
            Line::Xl { .. } => {
                self.counts.xl_frames += 1;
                None
            }
            Line::Other => {
                self.counts.ignored_lines += 1;
                None
            }
        }
    }

    /// Returns the interface's number. If the interface has no number, counts the line and returns `None`.
    pub(super) fn bus(&mut self, interface: &[u8]) -> Option<BusIndex> {
        let name = String::from_utf8_lossy(interface);
        let bus = self.find_bus(&name);
        if bus.is_none() {
            self.count_foreign(&name);
        }
        bus
    }

    /// Returns the number of an interface, given as written in the log. Adopts the interface if it has none.
    pub(super) fn find_bus(&mut self, written: &str) -> Option<BusIndex> {
        let mapped = self.channels.iter().find(|(channel, _)| channel == written);
        let name = mapped.map_or(written, |(_, interface)| interface.as_str());
        let index = match self.interfaces.iter().position(|known| known == name) {
            Some(index) => index,
            None if self.adopt && self.interfaces.len() < MAX_ADOPTED => {
                self.interfaces.push(name.to_owned());
                self.parser = LineParser::new(&self.interfaces);
                self.interfaces.len() - 1
            }
            None => return None,
        };
        u8::try_from(index).ok().map(BusIndex)
    }

    pub(super) fn count_foreign(&mut self, name: &str) {
        let foreign = &mut self.counts.foreign;
        let full = foreign.len() >= MAX_FOREIGN_NAMES && !foreign.contains_key(name);
        *foreign.entry(if full { "..." } else { name }.to_owned()).or_default() += 1;
    }

    /// The next record of a log of another tool, on the log's own clock.
    #[cfg(feature = "formats")]
    pub(super) fn next_item(&mut self, log: &mut ToolLog, name: &str) -> Result<Option<Record>, LogError> {
        loop {
            let item = match log.next_item() {
                Ok(Some(item)) => item,
                Ok(None) => return Ok(None),
                Err(error) => {
                    self.bad(|| format!("{name}{}: {error}", log.position()))?;
                    return Ok(None);
                }
            };
            self.counts.lines += 1;
            match item {
                Item::Frame { time, channel, frame } => {
                    if let Some(bus) = self.channel_bus(log, channel) {
                        self.counts.frames += 1;
                        return Ok(Some(Record::frame(time, bus, &frame)));
                    }
                }
                Item::ErrorFrame { time, channel, class } => {
                    self.counts.error_frames += 1;
                    if let Some(bus) = self.channel_bus(log, channel) {
                        return Ok(Some(Record::bus(time, bus, BusEvent::ErrorFrame { class })));
                    }
                }
                Item::Xl => self.counts.xl_frames += 1,
                Item::Other => self.counts.ignored_lines += 1,
                Item::Bad(why) => self.bad(|| format!("{name}{}: {why}", log.position()))?,
            }
        }
    }

    /// Fills slots with the next records of a log of another tool. Must not be called before the first record. Returns
    /// the number of records.
    #[cfg(feature = "formats")]
    pub(super) fn next_items(
        &mut self,
        log: &mut ToolLog,
        name: &str,
        slots: &mut [Record],
    ) -> Result<usize, LogError> {
        // In strict mode, an error must follow all records before it, so each call reads one record.
        let wanted = if self.strict { 1 } else { slots.len() };
        for (count, slot) in slots[..wanted].iter_mut().enumerate() {
            let Some(record) = self.next_item(log, name)? else { return Ok(count) };
            let (_, time) = self.place(record.time, || format!("{name}{}", log.position()));
            *slot = Record { time, ..record };
        }
        Ok(wanted)
    }

    #[cfg(feature = "formats")]
    pub(super) fn channel_bus(&mut self, log: &mut ToolLog, channel: u8) -> Option<BusIndex> {
        let bus = log.bus(channel, |channel| self.find_channel(channel));
        if bus.is_none() {
            self.count_foreign(&log.channel_name(channel));
        }
        bus
    }

    /// Finds the interface of a channel of a log of another tool. Numbered channels are the configured interfaces in
    /// their order, unless the user maps them.
    #[cfg(feature = "formats")]
    pub(super) fn find_channel(&mut self, channel: &LogChannel) -> Option<BusIndex> {
        let (written, default) = match channel {
            LogChannel::Name(name) => (name.clone(), name.clone()),
            LogChannel::Number { written, index } => {
                let configured = self.interfaces[..self.configured].get(*index as usize).cloned();
                (written.to_string(), configured.unwrap_or_else(|| format!("can{index}")))
            }
        };
        let is_mapped = self.channels.iter().any(|(channel, _)| *channel == written);
        let bus = self.find_bus(if is_mapped { &written } else { &default })?;
        if let Some(input) = self.counts.inputs.last_mut() {
            let _ = write!(input, ", channel {written} as {}", self.interfaces[bus.index()]);
        }
        Some(bus)
    }

    /// Line and time of the next good row, on the file's own clock.
    pub(super) fn next_row(&mut self, log: &mut CsvLog) -> Result<Option<(u64, Timestamp)>, LogError> {
        loop {
            let row = match log.next_row() {
                Ok(None) => return Ok(None),
                Ok(Some(row)) => row,
                Err(error) => {
                    self.bad(|| format!("{error}; the rest of the file is not read"))?;
                    return Ok(None);
                }
            };
            self.counts.lines += 1;
            match row {
                Ok(RowTime { line, time, after_unknown_gap }) => {
                    if after_unknown_gap {
                        (self.fresh, self.unknown) = (true, true);
                    }
                    return Ok(Some((line, time)));
                }
                Err(error) => self.bad(|| error.to_string())?,
            }
        }
    }

    /// Converts the stamp in a line of a file to the common clock. If a gap must precede the record, also returns the
    /// gap. `place` returns file and line for messages.
    pub(super) fn place(&mut self, raw: Timestamp, place: impl FnOnce() -> String) -> (Option<Record>, Timestamp) {
        let mut gap = false;
        if std::mem::take(&mut self.fresh) {
            self.shift_ns = 0;
            gap = std::mem::take(&mut self.unknown);
            if let Some(latest) = self.latest.filter(|&latest| raw < latest) {
                // A file or section that goes back in time is moved to start 1 s after the latest record.
                self.shift_ns = latest.plus_nanos(1_000_000_000).nanos().saturating_sub(raw.nanos());
                (gap, self.has_moved_stamps) = (true, true);
            }
        }
        let time = raw.plus_nanos(self.shift_ns);
        if let Some(latest) = self.latest.filter(|&latest| time < latest) {
            self.note_backwards(time, latest, place);
        }
        self.latest = Some(self.latest.map_or(time, |latest| latest.max(time)));
        self.counts.unknown_gaps += u64::from(gap);
        (gap.then_some(Record::unknown_gap(time)), time)
    }
}
