//! The replay loop reads records, runs the core, writes results and returns a summary.
//!
//! Guarantee: the same logs and configuration give the same result files, byte for byte. The replay of a journal (all
//! inputs that a running daemon has recorded) gives the results of the recorded run. A journal contains the ticks
//! (periodic inputs that advance the time) of this run. For plain logs and CSV, [`Ticks`] creates the ticks. Wall time
//! is used only for pacing (`speed`) and for reports.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::sync::atomic::Ordering;

mod cells;
mod clock;
mod driver;
mod failure;
mod in_order;
mod intake;
mod rows;
mod summary;

use super::store::Recorder;
use crate::can::Frame;
use crate::io::event_log;
use crate::io::log::{Batch, LogCounts, LogError, LogSource};
use crate::io::result_file::ResultFile;
use crate::io::ticks::Ticks;
use crate::monitor::{
    Downtime, MERGE_TOLERANCE_NS, Monitor, Outputs, Record, RecordKind, RestoreError, Snapshot, TICK_PERIOD_MS,
};
use crate::quantity::catalogue::RecordedValues;
use crate::quantity::{BusIndex, CellIndex, Timestamp};
use crate::sample::ReadingCounts;

pub use crate::io::reading::{LogReading, RowFrames, sleep_gap_s};
pub use cells::CellSummary;
pub use clock::LogTime;
use clock::{Pace, RecordSpan, TimeWindow, WindowPosition};
pub use driver::MonitorDriver;
pub use in_order::in_order;
pub use intake::ProtectedSummary;
pub use rows::ESTIMATE_COLUMNS;
use rows::{write_estimate, write_estimates_header, write_frame};
pub use summary::ReplaySummary;
use summary::{note_event, peak_memory_kib};

const REPORT_EVERY: usize = 4096;

/// Settings of a replay. The default replays everything as fast as possible and stores nothing.
#[derive(Debug, Default)]
pub struct ReplaySettings {
    /// Multiple of real time; `None` = as fast as possible.
    pub speed: Option<f64>,
    /// Records before this time are skipped.
    pub from: Option<LogTime>,
    /// Records after this time are skipped.
    pub until: Option<LogTime>,
    /// Sleep gap (s). If the next record arrives later than this after a record, the computer that recorded the log
    /// counts as asleep: the ticks stop after this time, and a paced replay does not wait through the gap.
    pub sleep_gap_s: f64,
    /// Whether to take a snapshot.
    pub snapshot: bool,
    /// Time of the snapshot; `None` = at the end.
    pub snapshot_at: Option<LogTime>,
    /// Initial state.
    pub restore: Option<Snapshot>,
    /// Age of the initial state. `None` = from the journal if it states the age, else from the state's stamp.
    pub away: Option<Downtime>,
    /// Store of state and history, in the daemon's format.
    pub store: Option<Recorder>,
    /// Names of the interfaces, for frames that would be sent.
    pub interfaces: Vec<String>,
}

impl ReplaySettings {
    /// Settings for a replay of the whole log as fast as possible, which stores nothing.
    pub fn plain(sleep_gap_s: f64, interfaces: Vec<String>) -> Self {
        Self { sleep_gap_s, interfaces, ..Self::default() }
    }
}

/// A callback that receives each input and its outputs.
pub type OutputWatch = Box<dyn FnMut(&Record, &Outputs)>;

/// A callback that receives outputs before they are cleared.
pub type OutputSink = Box<dyn FnMut(&Outputs)>;

/// Files and callbacks for the results.
#[derive(Default)]
pub struct Sinks {
    /// CSV with a row per estimate.
    pub estimates: Option<ResultFile>,
    /// One JSON line per event.
    pub events: Option<ResultFile>,
    /// The frames that would be sent, as candump lines.
    pub frames: Option<ResultFile>,
    /// Called with each input and its outputs.
    pub watch: Option<OutputWatch>,
    /// Called with all outputs in order, including those after the last input.
    pub outputs: Option<OutputSink>,
}

/// Why a replay ended early.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// A log cannot be read further.
    #[error(transparent)]
    Log(#[from] LogError),
    /// A result cannot be written.
    #[error(transparent)]
    Write(#[from] io::Error),
    /// The snapshot cannot be restored.
    #[error(transparent)]
    Restore(#[from] RestoreError),
    /// State or history cannot be written.
    #[error("{0}")]
    Store(String),
    /// The log was read, but the result says nothing about the battery.
    #[error("{0}")]
    Unused(String),
    /// The log ends before the requested time of the snapshot.
    #[error("no snapshot taken: the log ends at {end_s} s, before the requested time")]
    SnapshotNotReached {
        /// The log's last stamp.
        end_s: f64,
    },
}

/// Progress of a replay.
#[derive(Debug, Clone, Copy)]
pub struct ReplayProgress {
    /// Bytes read from the logs.
    pub bytes: u64,
    /// Frames read from the logs by [`run`], or frames sent by [`play`].
    pub frames: u64,
    /// Average speed, as a multiple of real time.
    pub times_real_time: f64,
}

/// Replays `source` through a monitor that has had no input. Returns the summary and, if requested, the snapshot.
///
/// # Errors
/// Fails if a log cannot be read or a result cannot be written. Also fails if the initial state cannot be restored, or
/// if the log ends before the snapshot's time.
pub fn run(
    source: &mut LogSource,
    monitor: Monitor,
    sinks: Sinks,
    settings: ReplaySettings,
    report: &mut dyn FnMut(ReplayProgress),
) -> Result<(ReplaySummary, Option<Snapshot>), ReplayError> {
    let mut replay = Replay::new(monitor, sinks, settings)?;
    // If a replay is paced or stops before the end of the log, the replay must not read beyond the current record.
    let one_by_one = replay.pace.speed.is_some() || replay.window.until.is_some();
    let mut batch = Batch::new(if one_by_one { 1 } else { Batch::MAX });
    let mut unreported: usize = 0;
    'log: while source.next_batch(&mut batch)? {
        for record in batch.records() {
            if !replay.take(record, batch.carries_ticks())? {
                break 'log;
            }
        }
        unreported += batch.records().len();
        if unreported >= REPORT_EVERY || replay.pace.speed.is_some() {
            unreported = 0;
            report(progress(source, source.counts().frames, &replay.span));
        }
    }
    replay.finish(source.counts())
}

fn progress(source: &LogSource, frames: u64, span: &RecordSpan) -> ReplayProgress {
    let bytes = source.read_bytes().load(Ordering::Relaxed);
    ReplayProgress { bytes, frames, times_real_time: span.times_real_time() }
}

/// Sends the frames of `source` at the speed of the settings; returns the number of frames sent. `send` may block.
///
/// # Errors
/// Fails if a log cannot be read or `send` fails.
pub fn play(
    source: &mut LogSource,
    settings: &ReplaySettings,
    send: &mut dyn FnMut(BusIndex, &Frame) -> io::Result<()>,
    report: &mut dyn FnMut(ReplayProgress),
) -> Result<u64, ReplayError> {
    let (mut span, mut pace, mut window) = (
        RecordSpan::new(settings.sleep_gap_s),
        Pace::new(settings.speed),
        TimeWindow::new(settings.from, settings.until),
    );
    let mut sent = 0;
    while let Some(record) = source.next_record()? {
        match window.judge(record.time) {
            WindowPosition::Before => continue,
            WindowPosition::After => break,
            WindowPosition::Inside => {}
        }
        if span.advance(record.time) || record.is_unknown_gap() {
            pace.rebase();
        }
        if let RecordKind::Frame { bus, frame } = &record.kind {
            pace.wait(record.time);
            send(*bus, frame)?;
            sent += 1;
            report(progress(source, sent, &span));
        }
    }
    Ok(sent)
}

struct Replay {
    monitor: Monitor,
    out: Outputs,
    ticks: Ticks,
    pace: Pace,
    span: RecordSpan,
    window: TimeWindow,
    sinks: Sinks,
    settings: ReplaySettings,
    /// Requested time of the snapshot; `None` before the first record, and when the snapshot has been taken.
    snapshot_at: Option<Timestamp>,
    snapshot: Option<Snapshot>,
    summary: ReplaySummary,
    is_journal: bool,
    /// Whether the summary already notes a reload of the recorded run.
    reloaded: bool,
    learned: BTreeMap<CellIndex, RecordedValues>,
    /// Counts before this replay. They are 0 if no state was restored. If a state was restored, they are `None` until
    /// the first input has been handled.
    before: Option<CountsBefore>,
}

/// Counts of a restored state.
#[derive(Debug, Clone, Default)]
struct CountsBefore {
    /// Voltage readings that reached an estimator.
    steps: u64,
    readings: ReadingCounts,
}

impl CountsBefore {
    fn of(monitor: &Monitor) -> Self {
        Self { steps: cell_steps(monitor), readings: monitor.reading_counts() }
    }
}

impl Replay {
    fn new(monitor: Monitor, mut sinks: Sinks, settings: ReplaySettings) -> io::Result<Self> {
        if let Some(file) = &mut sinks.estimates {
            write_estimates_header(file)?;
        }
        let want_estimates = sinks.estimates.is_some() || sinks.watch.is_some() || sinks.outputs.is_some();
        let out = Outputs { want_estimates, ..Outputs::default() };
        Ok(Self {
            monitor,
            out,
            ticks: Ticks::new(TICK_PERIOD_MS, settings.sleep_gap_s),
            pace: Pace::new(settings.speed),
            span: RecordSpan::new(settings.sleep_gap_s),
            window: TimeWindow::new(settings.from, settings.until),
            sinks,
            settings,
            snapshot_at: None,
            snapshot: None,
            summary: ReplaySummary::default(),
            is_journal: false,
            reloaded: false,
            learned: BTreeMap::new(),
            before: Some(CountsBefore::default()),
        })
    }

    /// Handles one record. Returns `false` if the rest of the log is not needed.
    fn take(&mut self, record: &Record, carries_ticks: bool) -> Result<bool, ReplayError> {
        let time = record.time;
        match self.window.judge(time) {
            WindowPosition::Before => {
                self.summary.skipped_records += 1;
                return Ok(true);
            }
            WindowPosition::After => return Ok(false),
            WindowPosition::Inside => {}
        }
        self.is_journal |= carries_ticks;
        if self.span.first.is_none() {
            self.begin(record)?;
        }
        let unknown_gap = record.is_unknown_gap();
        if self.span.advance(time) || unknown_gap {
            self.pace.rebase();
        }
        if unknown_gap || carries_ticks {
            self.ticks.sleep();
        } else {
            self.ticks.advance(time);
        }
        self.make_ticks()?;
        match record.kind {
            RecordKind::Reload => self.note_reload(time),
            RecordKind::Restore { .. } => {}
            _ => self.feed(record)?,
        }
        Ok(true)
    }

    /// Notes the first reload of the recorded run, because the results of this replay may differ after it.
    fn note_reload(&mut self, time: Timestamp) {
        if !std::mem::replace(&mut self.reloaded, true) {
            let at_s = time.secs();
            self.summary.notes.push(format!(
                "the recorded run changed its configuration at {at_s:.3} s; results may differ from there on"
            ));
        }
    }

    /// Prepares the first record: computes the time of the snapshot and restores the initial state.
    fn begin(&mut self, record: &Record) -> Result<(), ReplayError> {
        let first = self.window.first.unwrap_or(record.time);
        self.snapshot_at = self.settings.snapshot_at.filter(|_| self.settings.snapshot).map(|at| at.resolve(first));
        let recorded = if let RecordKind::Restore { away } = record.kind { Some(away) } else { None };
        match (self.settings.restore.take(), recorded) {
            (Some(snapshot), recorded) => {
                self.before = None;
                self.monitor.restore(snapshot, self.settings.away.or(recorded).unwrap_or_default())?;
            }
            (None, Some(_)) => self
                .summary
                .notes
                .push("the recorded run started from a stored state; without --restore the results differ".to_owned()),
            (None, None) => {}
        }
        Ok(())
    }

    fn make_ticks(&mut self) -> Result<(), ReplayError> {
        while self.ticks.is_pending() {
            if let Some(time) = self.ticks.pop(self.monitor.next_due()) {
                self.feed(&Record::tick(time))?;
            }
        }
        Ok(())
    }

    fn feed(&mut self, record: &Record) -> Result<(), ReplayError> {
        if self.snapshot_at.is_some_and(|at| record.time > at) {
            self.snapshot_at = None;
            self.snapshot = Some(self.monitor.snapshot());
        }
        self.pace.wait(record.time);
        self.summary.ticks += u64::from(matches!(record.kind, RecordKind::Tick));
        self.monitor.handle(record, &mut self.out);
        self.before.get_or_insert_with(|| CountsBefore::of(&self.monitor));
        if let Some(store) = &mut self.settings.store {
            store.record(&self.out.events, &self.monitor, record.time).map_err(ReplayError::Store)?;
        }
        if let Some(watch) = &mut self.sinks.watch {
            watch(record, &self.out);
        }
        self.write_out()?;
        Ok(())
    }

    fn write_out(&mut self) -> io::Result<()> {
        let out = &mut self.out;
        if out.is_empty() && self.sinks.watch.is_none() && self.pace.speed.is_none() {
            return Ok(());
        }
        if let Some(take) = &mut self.sinks.outputs {
            take(out);
        }
        if let Some(file) = &mut self.sinks.estimates {
            self.summary.estimates += out.estimates.len() as u64;
            out.estimates.iter().try_for_each(|estimate| write_estimate(file, estimate))?;
        }
        for event in &out.events {
            note_event(&mut self.summary, &mut self.learned, event);
            if let Some(file) = &mut self.sinks.events {
                event_log::write_line(file, event)?;
            }
        }
        self.summary.frames_out += out.frames.len() as u64;
        if let Some(file) = &mut self.sinks.frames {
            let interfaces = &self.settings.interfaces;
            out.frames.iter().try_for_each(|transmit| write_frame(file, interfaces, transmit))?;
        }
        out.clear();
        if self.pace.speed.is_some() {
            self.sinks.flush()?;
        }
        Ok(())
    }

    fn finish(mut self, counts: &LogCounts) -> Result<(ReplaySummary, Option<Snapshot>), ReplayError> {
        self.ticks.sleep();
        self.make_ticks()?;
        self.monitor.settle(&mut self.out);
        if let (Some(store), Some(end)) = (&mut self.settings.store, self.span.latest) {
            store.record(&self.out.events, &self.monitor, end).map_err(ReplayError::Store)?;
        }
        self.write_out()?;
        if let (Some(store), Some(end)) = (self.settings.store.take(), self.span.latest) {
            store.finish(&self.monitor, end).map_err(ReplayError::Store)?;
        }
        if self.settings.snapshot && self.snapshot.is_none() {
            // A snapshot time equal to the time of the last record counts as reached.
            let reached = self.settings.snapshot_at.is_none() || self.snapshot_at == self.span.latest;
            let end_s = self.span.latest.map_or(f64::NAN, Timestamp::secs);
            if !reached {
                return Err(ReplayError::SnapshotNotReached { end_s });
            }
            self.snapshot = Some(self.monitor.snapshot());
        }
        for file in [self.sinks.estimates, self.sinks.events, self.sinks.frames].into_iter().flatten() {
            file.finish()?;
        }
        let (span, mut summary) = (self.span, self.summary);
        summary.log = counts.clone();
        summary.cells = cells::summaries(&self.monitor, &self.learned);
        let offset = self.monitor.current_offset();
        summary.current_offset_a = offset.map(|offset| offset.mean);
        summary.current_offset_std_a = offset.map(|offset| offset.std());
        (summary.protected, summary.dropped, summary.controllers) =
            intake::summaries(&self.monitor, &self.settings.interfaces);
        summary.first_s = span.first.map(Timestamp::secs);
        summary.last_s = span.latest.map(Timestamp::secs);
        summary.awake_s = span.awake_s();
        summary.wall_s = span.started.elapsed().as_secs_f64();
        summary.frames_per_s = counts.frames as f64 / summary.wall_s.max(1e-9);
        let before = self.before.unwrap_or_default();
        let steps = cell_steps(&self.monitor).saturating_sub(before.steps);
        summary.cell_steps_per_s = steps as f64 / summary.wall_s.max(1e-9);
        summary.times_real_time = span.times_real_time();
        summary.peak_memory_kib = peak_memory_kib();
        if counts.deleted_segments > 0 {
            summary.notes.push(format!(
                "the beginning of the journal is missing, {} segments: results differ from the recorded run",
                counts.deleted_segments
            ));
        }
        if let Some(count) = summary.events.get("time_backwards") {
            summary.notes.push(format!(
                "the time goes back {count} times by more than {} s; each counts as a gap of unknown length. If no \
                 clock was set back, sort the log by time",
                MERGE_TOLERANCE_NS / 1_000_000_000
            ));
        }
        let readings = self.monitor.reading_counts().since(&before.readings);
        let failure = failure::failure(&summary, &span, steps, &readings, &self.settings.interfaces);
        // For a plain log, the reason is a failure, because the log may have a wrong format or be of another vehicle. A
        // journal was recorded by packwatch with its configuration, so the reason is only a note.
        match failure {
            Some(reason) if self.is_journal => summary.notes.push(reason),
            failure => summary.failure = failure,
        }
        Ok((summary, self.snapshot))
    }
}

/// Voltage readings that reached an estimator since the monitor's first start.
fn cell_steps(monitor: &Monitor) -> u64 {
    let counts = monitor.statistics();
    counts.voltages.total()
}

impl Sinks {
    /// Flushes all files, because a person may watch a paced replay.
    fn flush(&mut self) -> io::Result<()> {
        [&mut self.estimates, &mut self.events, &mut self.frames].into_iter().flatten().try_for_each(Write::flush)
    }
}
