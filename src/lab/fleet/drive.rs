//! Replays one log through one monitor, like `packwatch replay` but without its output files.
//!
//! Inputs and ticks are the same as in `packwatch replay`, so the results are the same.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use crate::config::Config;
use crate::error::LabError;
use crate::io::log::{LogCounts, LogSource};
use crate::io::ticks::Ticks;
use crate::monitor::{Monitor, MonitorConfig, Outputs, Record, RecordKind, TICK_PERIOD_MS};
use crate::quantity::Timestamp;
use crate::replay::sleep_gap_s;

/// An opened log, and a note for the user on its interpretation.
pub type OpenedLog = (LogSource, Option<String>);

/// How to read logs.
#[derive(Clone, Copy)]
pub struct LogAccess<'a> {
    /// Opens logs with a configuration. Several logs are read one after the other as one recording.
    pub open: &'a (dyn Fn(&Config, &[PathBuf]) -> OpenedLog + Sync),
    /// A gap in a log longer than this (s) means that the recorder was asleep; `None` = the configuration decides.
    pub sleep_gap_s: Option<f64>,
}

impl LogAccess<'_> {
    /// Returns the sleep gap (s) for this configuration.
    pub(super) fn sleep_gap_of_s(&self, config: &MonitorConfig) -> f64 {
        self.sleep_gap_s.unwrap_or_else(|| sleep_gap_s(config))
    }
}

/// Summary of a replayed log.
#[derive(Debug, Clone, Default)]
pub struct DriveSummary {
    /// Counts of lines, frames and faults in the log.
    pub counts: LogCounts,
    /// Earliest and latest stamp; `None` = the log contains no record.
    pub span: Option<(Timestamp, Timestamp)>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

impl DriveSummary {
    /// Returns the time from the first stamp to the last (days).
    pub fn days(&self) -> f64 {
        self.span.map_or(0.0, |(first, last)| last.since(first) / 86_400.0)
    }
}

/// Replays a log. `each` receives the outputs after every input and must clear them. `report` receives the number of
/// bytes read since its last call.
///
/// # Errors
/// The log cannot be read, or `each` fails.
pub fn drive(
    (mut source, note): OpenedLog,
    mut monitor: Monitor,
    mut out: Outputs,
    sleep_gap_s: f64,
    each: &mut dyn FnMut(&Monitor, &mut Outputs) -> Result<(), LabError>,
    report: &dyn Fn(u64),
) -> Result<DriveSummary, LabError> {
    let mut ticks = Ticks::new(TICK_PERIOD_MS, sleep_gap_s);
    let (mut driven, mut records, mut reported) = (DriveSummary::default(), 0_u64, 0);
    driven.notes.extend(note);
    let mut tick = |ticks: &mut Ticks, monitor: &mut Monitor, record: Option<&Record>| {
        while let Some(time) = ticks.pop(monitor.next_due()) {
            monitor.handle(&Record::tick(time), &mut out);
            each(monitor, &mut out)?;
        }
        let Some(record) = record else { return Ok::<(), LabError>(()) };
        monitor.handle(record, &mut out);
        each(monitor, &mut out)
    };
    while let Some(record) = source.next_record()? {
        driven.note(&record);
        if record.is_unknown_gap() || source.carries_ticks() {
            ticks.sleep();
        } else {
            ticks.advance(record.time);
        }
        tick(&mut ticks, &mut monitor, Some(&record))?;
        records += 1;
        // Progress is reported every 4096 records.
        if records.is_multiple_of(4096) {
            let bytes = source.read_bytes().load(Ordering::Relaxed);
            report(bytes - reported);
            reported = bytes;
        }
    }
    ticks.sleep();
    tick(&mut ticks, &mut monitor, None)?;
    monitor.settle(&mut out);
    each(&monitor, &mut out)?;
    report(source.read_bytes().load(Ordering::Relaxed) - reported);
    driven.finish(source.counts());
    Ok(driven)
}

impl DriveSummary {
    /// Returns the first and last stamp of `log`.
    ///
    /// # Errors
    /// The log contains no record. The error includes the notes.
    pub fn span_of(&self, log: &Path) -> Result<(Timestamp, Timestamp), LabError> {
        let why = || self.notes.iter().map(|note| format!(": {note}")).collect::<String>();
        self.span.ok_or_else(|| LabError::Data(format!("{}: contains no record{}", log.display(), why())))
    }

    fn note(&mut self, record: &Record) {
        let time = record.time;
        let (first, last) = self.span.unwrap_or((time, time));
        self.span = Some((first.min(time), last.max(time)));
        let noted = match record.kind {
            RecordKind::Restore { .. } => "the recorded run started from a stored state, the replay does not",
            RecordKind::Reload => "the recorded run loaded another configuration, the replay does not",
            _ => return,
        };
        if !self.notes.iter().any(|note| note == noted) {
            self.notes.push(noted.to_owned());
        }
    }

    fn finish(&mut self, counts: &LogCounts) {
        self.counts = counts.clone();
        if counts.bad_lines > 0 {
            let first = counts.first_bad_line.as_deref().unwrap_or("");
            self.notes.push(format!("{} bad lines skipped, the first: {first}", counts.bad_lines));
        }
        if counts.unknown_gaps > 0 {
            self.notes
                .push(format!("{} gaps of unknown length: fewer days are counted than passed", counts.unknown_gaps));
        }
        if counts.frames == 0 {
            let others: Vec<_> = counts.foreign.keys().map(String::as_str).collect();
            let others = if others.is_empty() { String::new() } else { format!(": the log has {}", others.join(", ")) };
            self.notes.push(format!("no frame of the configured interfaces{others}"));
        }
    }
}
