//! Reads logs of any format as one stream of core inputs: journals, candump logs, logs of other tools and CSV,
//! uncompressed or as gzip or zstd.
//!
//! The first bytes decide the format; for CSV, the file name decides too. Several logs are read one after another on
//! one clock. A log, or a CSV section without a start time, may begin before the latest record read so far. In that
//! case, the log or section is moved to one second after this record, and an unknown gap is inserted before the log or
//! section. [`LogCounts`] counts everything that does not become a record.

use std::collections::{BTreeMap, VecDeque};
#[cfg(feature = "formats")]
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

#[cfg(feature = "formats")]
use packwatch_formats::{Channel as LogChannel, Item};
use serde::Serialize;

use super::candump::{Body, Line, LineError, LineHead, LineParser, ParsedLine};
use super::csv_log::{self, CsvLog, CsvOptions, RowTime, TableReading};
use super::journal;
use super::lines::{self, Lines, RawLine};
use super::segments;
#[cfg(feature = "formats")]
use super::tool_log::ToolLog;
use crate::can::Frame;
use crate::can::decode::Channel;
use crate::monitor::{BusEvent, Record, RecordKind};
use crate::quantity::{BusIndex, Timestamp};

pub use super::record::Batch;
use super::record::UNUSED;
pub use super::table::TableError as LogError;

/// Maximum number of unconfigured interfaces that are counted separately. Further interfaces are counted together under
/// "...".
const MAX_FOREIGN_NAMES: usize = 64;

/// Maximum number of interfaces that get a number: the configured interfaces, and the interfaces that
/// [`LogSource::adopt_foreign`] adds. Usual logs have fewer than ten.
pub const MAX_ADOPTED: usize = 64;

/// Encodes the values of a CSV row in the frames that carry them. Returns the number of values that no frame can carry.
pub type RowEncoder = Box<dyn FnMut(&[(Channel, Option<f64>)], &mut Vec<(BusIndex, Frame)>) -> usize>;

/// Options for reading logs.
pub struct LogOptions {
    /// Configured interface names, in the order of their numbers.
    pub interfaces: Vec<String>,
    /// Maps a channel or interface, as written in the log, to an interface.
    pub channels: Vec<(String, String)>,
    /// Whether reading ends at the first bad line.
    pub strict: bool,
    /// How CSV logs are read.
    pub csv: CsvOptions,
    /// Encodes rows of CSV logs.
    pub encode_row: RowEncoder,
}

/// Counts of lines, of frames, and of everything that did not become a record.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct LogCounts {
    /// Number of lines, CSV rows and parts of binary logs read, including bad ones.
    pub lines: u64,
    /// Frames returned.
    pub frames: u64,
    /// Lines and parts that violate their format, and files with a damaged end.
    pub bad_lines: u64,
    /// The first bad line or part: file, place, found and allowed.
    pub first_bad_line: Option<String>,
    /// Lines without a record, such as headers, comments and blank lines.
    pub ignored_lines: u64,
    /// The first of them that is not blank or a comment: file, line and text.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub first_ignored_line: Option<String>,
    /// CAN XL frames, which are not supported.
    pub xl_frames: u64,
    /// Error frames.
    pub error_frames: u64,
    /// Frames lost according to the recorder.
    pub dropped_frames: u64,
    /// Frames and events of unconfigured interfaces, by name.
    pub foreign: BTreeMap<String, u64>,
    /// Records whose stamp is before the latest stamp of the earlier records.
    pub time_backwards: u64,
    /// The first such record: file, line, its stamp and the latest stamp before it.
    pub first_time_backwards: Option<String>,
    /// Number of files and CSV sections that follow a gap of unknown length.
    pub unknown_gaps: u64,
    /// CSV values that no input frame can carry (out of the signal's range, or no such signal).
    pub uncarried_values: u64,
    /// How each log of another tool was read: file, format, and the interface of each channel.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub inputs: Vec<String>,
    /// Segments of a journal that are missing before the first segment read (deleted or not given).
    pub deleted_segments: u64,
    /// What was read of each table.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub tables: Vec<TableReading>,
}

/// Reads logs one after another.
pub struct LogSource {
    files: VecDeque<PathBuf>,
    current: Option<OpenLog>,
    queue: VecDeque<Record>,
    frames: Vec<(BusIndex, Frame)>,
    encode_row: RowEncoder,
    csv: CsvOptions,
    state: ReadState,
    read_bytes: Arc<AtomicU64>,
}

struct OpenLog {
    name: String,
    form: LogForm,
}

enum LogForm {
    Text {
        lines: Lines,
        journal: bool,
    },
    Csv(Box<CsvLog>),
    #[cfg(feature = "formats")]
    Tool(Box<ToolLog>),
}

/// State shared by the parsers: counts, names, clock.
struct ReadState {
    counts: LogCounts,
    strict: bool,
    interfaces: Vec<String>,
    /// Number of configured interfaces, which are the first ones.
    #[cfg(feature = "formats")]
    configured: usize,
    channels: Vec<(String, String)>,
    /// Parser that knows the interfaces.
    parser: LineParser,
    /// Whether unconfigured interfaces also get a number, so that their records are returned.
    adopt: bool,
    shift_ns: i64,
    latest: Option<Timestamp>,
    /// Whether the next record begins a file or section.
    fresh: bool,
    /// Whether the time between the latest record and the next record is unknown.
    unknown: bool,
    /// Whether the stamps of a file or section were moved, so that they follow the latest record.
    has_moved_stamps: bool,
}

impl LogSource {
    /// Reads these logs in this order.
    pub fn new(files: impl IntoIterator<Item = PathBuf>, options: LogOptions) -> Self {
        Self {
            files: files.into_iter().collect(),
            current: None,
            queue: VecDeque::new(),
            frames: Vec::new(),
            encode_row: options.encode_row,
            csv: options.csv,
            state: ReadState {
                counts: LogCounts::default(),
                strict: options.strict,
                parser: LineParser::new(&options.interfaces),
                #[cfg(feature = "formats")]
                configured: options.interfaces.len(),
                interfaces: options.interfaces,
                channels: options.channels,
                adopt: false,
                shift_ns: 0,
                latest: None,
                fresh: true,
                unknown: false,
                has_moved_stamps: false,
            },
            read_bytes: Arc::default(),
        }
    }

    /// Makes the source also return records of unconfigured interfaces. Each such interface gets the next number, up to
    /// [`MAX_ADOPTED`] in total.
    pub fn adopt_foreign(&mut self) {
        self.state.adopt = true;
    }

    /// Names of the interfaces by number. Adopted interfaces come last.
    pub fn interfaces(&self) -> &[String] {
        &self.state.interfaces
    }

    /// Counts of the lines and frames already read.
    pub fn counts(&self) -> &LogCounts {
        &self.state.counts
    }

    /// Whether a file or section began before the latest record. In that case, its stamps were moved and are not real
    /// dates.
    pub fn has_moved_stamps(&self) -> bool {
        self.state.has_moved_stamps
    }

    /// Number of bytes already read from the files (compressed size).
    pub fn read_bytes(&self) -> &Arc<AtomicU64> {
        &self.read_bytes
    }

    /// Whether the current log contains ticks (times at which the core ran without another input), as journals do.
    pub fn carries_ticks(&self) -> bool {
        matches!(self.current, Some(OpenLog { form: LogForm::Text { journal: true, .. }, .. }))
    }

    /// The next record; `None` at the end of the last log.
    ///
    /// # Errors
    /// Fails if a log cannot be opened or a CSV header does not fit. If `strict`, also fails at the first bad line.
    pub fn next_record(&mut self) -> Result<Option<Record>, LogError> {
        loop {
            if let Some(record) = self.queue.pop_front() {
                return Ok(Some(record));
            }
            if let Some(OpenLog { form: LogForm::Text { lines, .. }, name }) = &mut self.current
                && let mut slot = [UNUSED]
                && self.state.next_frames(lines, name, &mut slot) > 0
            {
                return Ok(Some(slot[0]));
            }
            let Some(open) = &mut self.current else {
                let first = self.files.front().map(|path| path.display().to_string()).unwrap_or_default();
                let next = segments::next_log(&mut self.files);
                let next =
                    next.map_err(|error| LogError::of_io(format!("{first}: cannot be read: {error}"), &error))?;
                let Some(parts) = next else { return Ok(None) };
                self.state.counts.deleted_segments += parts.deleted;
                self.current = Some(self.open(&parts.paths)?);
                continue;
            };
            let more = match &mut open.form {
                LogForm::Text { lines, journal } => match self.state.next_text(lines, *journal, &open.name)? {
                    Some(record) => {
                        let (gap, time) = self.state.place(record.time, || format!("{}:{}", open.name, lines.number()));
                        let record = Record { time, ..record };
                        let Some(gap) = gap else { return Ok(Some(record)) };
                        self.queue.push_back(record);
                        return Ok(Some(gap));
                    }
                    None => false,
                },
                LogForm::Csv(log) => self.state.next_row(log)?.is_some_and(|(line, raw)| {
                    let (gap, time) = self.state.place(raw, || format!("{}:{line}", open.name));
                    self.queue.extend(gap);
                    let uncarried = (self.encode_row)(&log.values, &mut self.frames);
                    self.state.counts.uncarried_values += uncarried as u64;
                    self.state.counts.frames += self.frames.len() as u64;
                    self.queue.extend(self.frames.drain(..).map(|(bus, frame)| Record::frame(time, bus, &frame)));
                    true
                }),
                #[cfg(feature = "formats")]
                LogForm::Tool(log) => match self.state.next_item(log, &open.name)? {
                    Some(record) => {
                        let place = || format!("{}{}", open.name, log.position());
                        let (gap, time) = self.state.place(record.time, place);
                        let record = Record { time, ..record };
                        let Some(gap) = gap else { return Ok(Some(record)) };
                        self.queue.push_back(record);
                        return Ok(Some(gap));
                    }
                    None => false,
                },
            };
            if !more {
                self.note_table();
                self.current = None;
            }
        }
    }

    /// Puts the next records into `batch`: at least one record, and more only if they are already in the buffer. At the
    /// end of the last log, returns `false`; the batch is then empty.
    ///
    /// # Errors
    /// Fails like [`next_record`](Self::next_record). Earlier calls have then returned all records before the error.
    pub fn next_batch(&mut self, batch: &mut Batch) -> Result<bool, LogError> {
        batch.len = 0;
        if let Some(open) = &mut self.current
            && let LogForm::Text { lines, journal } = &mut open.form
            && self.queue.is_empty()
        {
            batch.carries_ticks = *journal;
            batch.len = self.state.next_frames(lines, &open.name, &mut batch.slots);
            if batch.len > 0 {
                return Ok(true);
            }
        }
        #[cfg(feature = "formats")]
        if let Some(open) = &mut self.current
            && let LogForm::Tool(log) = &mut open.form
            && self.queue.is_empty()
            && !self.state.fresh
        {
            batch.carries_ticks = false;
            batch.len = self.state.next_items(log, &open.name, &mut batch.slots)?;
            if batch.len > 0 {
                return Ok(true);
            }
        }
        let Some(record) = self.next_record()? else { return Ok(false) };
        (batch.slots[0], batch.len, batch.carries_ticks) = (record, 1, self.carries_ticks());
        Ok(true)
    }

    /// Updates the counts of the current table.
    fn note_table(&mut self) {
        if let Some(OpenLog { form: LogForm::Csv(log), .. }) = &self.current
            && let Some(last) = self.state.counts.tables.last_mut()
        {
            last.clone_from(log.reading());
        }
    }

    fn open(&mut self, paths: &[PathBuf]) -> Result<OpenLog, LogError> {
        let path = paths.first().map_or(Path::new(""), PathBuf::as_path);
        let name = path.display().to_string();
        let failed = |e: std::io::Error| LogError::of_io(format!("{name}: cannot be read: {e}"), &e);
        let mut lines = Lines::new(lines::open_parts(paths, &self.read_bytes).map_err(failed)?);
        (self.state.fresh, self.state.unknown) = (true, false);
        #[cfg(feature = "formats")]
        if let Some(format) = ToolLog::recognise(&mut lines).map_err(failed)? {
            let log = ToolLog::open(format, lines, paths).map_err(failed)?;
            self.state.counts.inputs.push(format!("{name}: {}", format.name()));
            return Ok(OpenLog { name, form: LogForm::Tool(Box::new(log)) });
        }
        let first = lines.peek().map_err(failed)?.trim_ascii_end();
        let journal = first == journal::HEADER.as_bytes();
        if first.starts_with(b"PACKWATCH-JOURNAL") && !journal {
            let found = String::from_utf8_lossy(first);
            return Err(LogError::Data(format!("{name}:1: found {found:?}, must be {:?}", journal::HEADER)));
        }
        let csv = !journal && csv_log::is_table(path, lines.unread());
        let form = if csv {
            let log = CsvLog::open(Box::new(lines.into_reader()), path, &self.csv)?;
            self.state.counts.tables.push(log.reading().clone());
            LogForm::Csv(Box::new(log))
        } else {
            LogForm::Text { lines, journal }
        };
        Ok(OpenLog { name, form })
    }
}

/// Whether a line is blank or a comment.
fn is_remark(line: &[u8]) -> bool {
    matches!(line.trim_ascii(), [] | [b'#' | b';' | b'%', ..])
}

impl ReadState {
    /// Fills slots with the next frames of a text log, as far as complete lines are already in the buffer. Does nothing
    /// before the first record of a file. Returns the number of frames.
    fn next_frames(&mut self, lines: &mut Lines, name: &str, slots: &mut [Record]) -> usize {
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

    /// Counts a record at `time`, which is before the time `latest` of an earlier record.
    #[cold]
    fn note_backwards(&mut self, time: Timestamp, latest: Timestamp, place: impl FnOnce() -> String) {
        self.counts.time_backwards += 1;
        self.counts.first_time_backwards.get_or_insert_with(|| {
            let [stamp_s, latest_s] = [time, latest].map(|time| time.plus_nanos(-self.shift_ns).secs());
            format!("{}: stamp {stamp_s:.6} s is before {latest_s:.6} s", place())
        });
    }

    fn bad(&mut self, what: impl FnOnce() -> String) -> Result<(), LogError> {
        self.counts.bad_lines += 1;
        if self.strict {
            return Err(LogError::Data(what()));
        }
        self.counts.first_bad_line.get_or_insert_with(what);
        Ok(())
    }

    /// The next record of a text log, on the log's own clock.
    fn next_text(&mut self, lines: &mut Lines, journal: bool, name: &str) -> Result<Option<Record>, LogError> {
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
                Ok(ParsedLine { line: Line::Other, .. }) => {
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

    fn note_ignored(&mut self, name: &str, number: u64, line: &[u8]) {
        /// Length of the quoted text, bytes.
        const SHOWN: usize = 60;
        self.counts.ignored_lines += 1;
        if self.counts.first_ignored_line.is_none() && !is_remark(line) {
            let text = String::from_utf8_lossy(&line[..line.len().min(SHOWN)]).into_owned();
            let more = if line.len() > SHOWN { "..." } else { "" };
            self.counts.first_ignored_line = Some(format!("{name}:{number}: {text:?}{more}"));
        }
    }

    fn line_record(&mut self, line: &Line<'_>) -> Option<Record> {
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
                // The line has no stamp. The line belongs to the preceding frame, if any.
                let time = self.latest?.plus_nanos(-self.shift_ns);
                (!self.fresh).then_some(Record::bus(time, bus, BusEvent::Dropped { frames }))
            }
            Line::Xl { .. } => {
                self.counts.xl_frames += 1;
                None
            }
            Line::Other => None,
        }
    }

    /// Returns the interface's number. If the interface has no number, counts the line and returns `None`.
    fn bus(&mut self, interface: &[u8]) -> Option<BusIndex> {
        let name = String::from_utf8_lossy(interface);
        let bus = self.find_bus(&name);
        if bus.is_none() {
            self.count_foreign(&name);
        }
        bus
    }

    /// Returns the number of an interface, given as written in the log. Adopts the interface if it has none.
    fn find_bus(&mut self, written: &str) -> Option<BusIndex> {
        let mapped = self.channels.iter().find(|(channel, _)| channel == written);
        let name = mapped.map_or(written, |(_, interface)| interface.as_str()).to_owned();
        let known = self.interfaces.iter().position(|known| *known == name);
        let index = match known {
            Some(index) => index,
            None if self.adopt && self.interfaces.len() < MAX_ADOPTED => {
                self.interfaces.push(name);
                self.parser = LineParser::new(&self.interfaces);
                self.interfaces.len() - 1
            }
            None => return None,
        };
        u8::try_from(index).ok().map(BusIndex)
    }

    fn count_foreign(&mut self, name: &str) {
        let foreign = &mut self.counts.foreign;
        let full = foreign.len() >= MAX_FOREIGN_NAMES && !foreign.contains_key(name);
        *foreign.entry(if full { "..." } else { name }.to_owned()).or_default() += 1;
    }

    /// The next record of a log of another tool, on the log's own clock.
    #[cfg(feature = "formats")]
    fn next_item(&mut self, log: &mut ToolLog, name: &str) -> Result<Option<Record>, LogError> {
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
    fn next_items(&mut self, log: &mut ToolLog, name: &str, slots: &mut [Record]) -> Result<usize, LogError> {
        // In strict mode, an error must follow all records before it, so each call reads one record.
        let wanted = if self.strict { 1 } else { slots.len() };
        for (count, slot) in slots[..wanted].iter_mut().enumerate() {
            let Some(record) = self.next_item(log, name)? else { return Ok(count) };
            let (_, time) = self.place(record.time, || format!("{name}{}", log.position()));
            *slot = Record { time, ..record };
        }
        Ok(wanted)
    }

    /// Returns the number of a channel's interface. If the channel has none, counts the frame and returns `None`.
    #[cfg(feature = "formats")]
    fn channel_bus(&mut self, log: &mut ToolLog, channel: u8) -> Option<BusIndex> {
        let bus = log.bus(channel, |channel| self.find_channel(channel));
        if bus.is_none() {
            self.count_foreign(&log.channel_name(channel));
        }
        bus
    }

    /// Finds the interface of a channel of a log of another tool. Numbered channels are the configured interfaces in
    /// their order, unless the user maps them.
    #[cfg(feature = "formats")]
    fn find_channel(&mut self, channel: &LogChannel) -> Option<BusIndex> {
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
    fn next_row(&mut self, log: &mut CsvLog) -> Result<Option<(u64, Timestamp)>, LogError> {
        loop {
            let row = match log.next_row() {
                Ok(None) => return Ok(None),
                Ok(Some(row)) => row,
                Err(error) => {
                    self.bad(|| error.to_string())?;
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
    fn place(&mut self, raw: Timestamp, place: impl FnOnce() -> String) -> (Option<Record>, Timestamp) {
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
