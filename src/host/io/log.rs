//! Reads logs of any format as one stream of core inputs: journals, candump logs, logs of other tools, and CSV. Logs
//! may be compressed as gzip or zstd. Without the feature `formats`, only journals and candump logs are read.
//!
//! The first bytes decide the format; for CSV, the file name decides too. Several logs are read one after another on
//! one clock. A log, or a CSV section without a start time, may begin before the latest record read so far. In that
//! case, it is moved to one second after this record, and an unknown gap is inserted before it. [`LogCounts`] counts
//! everything that does not become a record.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use serde::Serialize;

use super::candump::LineParser;
use super::csv_log::{self, CsvLog, CsvOptions, TableReading};
use super::journal;
use super::lines::{self, Lines};
use super::segments;
#[cfg(feature = "formats")]
use super::tool_log::ToolLog;
use crate::can::Frame;
use crate::can::decode::Channel;
use crate::monitor::Record;
use crate::quantity::BusIndex;

mod read_state;

pub use super::record::Batch;
use super::record::UNUSED;
pub use super::table::TableError as LogError;
use read_state::ReadState;

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
    /// The first bad line or part: file, place, what was found, and what is allowed.
    pub first_bad_line: Option<String>,
    /// Lines without a record, such as headers, comments and blank lines.
    pub ignored_lines: u64,
    /// The first ignored line that is neither blank nor a comment: file, line and text.
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
    /// Number of missing segments of a journal before the first segment read (deleted or not given).
    pub deleted_segments: u64,
    /// How each table was read.
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
    /// Fails like [`next_record`](Self::next_record). In that case, earlier calls have already returned all records
    /// that precede the error.
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
            let remark = log.remark().map_or_else(String::new, |remark| format!(", {remark}"));
            self.state.counts.inputs.push(format!("{name}: {}{remark}", format.name()));
            return Ok(OpenLog { name, form: LogForm::Tool(Box::new(log)) });
        }
        let first = lines.peek().map_err(failed)?.trim_ascii_end();
        let journal = first == journal::HEADER.as_bytes();
        if first.starts_with(b"PACKWATCH-JOURNAL") && !journal {
            let found = String::from_utf8_lossy(first);
            return Err(LogError::Data(format!("{name}:1: found {found:?}, must be {:?}", journal::HEADER)));
        }
        let csv = !journal && csv_log::is_table(path, lines.unread());
        let form = if csv && !cfg!(feature = "formats") {
            let reason =
                "is a table, and the vehicle's program reads only candump logs and journals; use the full program";
            return Err(LogError::Data(format!("{name}: {reason}")));
        } else if csv {
            let log = CsvLog::open(Box::new(lines.into_reader()), path, &self.csv)?;
            self.state.counts.tables.push(log.reading().clone());
            LogForm::Csv(Box::new(log))
        } else {
            LogForm::Text { lines, journal }
        };
        Ok(OpenLog { name, form })
    }
}
