//! Exports the results of logs as tables of estimates, half-cycles, energies and alarms, in Parquet or CSV format.
//!
//! Input: a configuration and logs. Output: for each log, a folder `NAME/` with `estimates`, `half_cycles`, `outlook`,
//! `alarms` and `use_record` (`.parquet` or `.csv`; see [`columns`] for columns and units), and with `about.json`. Each
//! file gets its final name only when it is complete. `about.json` is written last, so the tables are complete if it
//! exists. If a log cannot be replayed, its folder gets no new file, and the other logs continue.

mod columns;
pub mod merge;
mod rows;
mod table;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Serialize;
use serde_json::json;

use self::rows::{AlarmRow, EstimateRow, HalfCycleRow, OutlookRow, UseRow};
use self::table::TableFile;
use super::drive::{DriveSummary, LogAccess, drive};
use super::vehicle::LearnedModel;

use crate::config::Config;
use crate::error::{LabError, create_folder};
use crate::fields::Fields;
use crate::health::UseRecord;
use crate::io::stamp;
use crate::monitor::{Event, EventKind, Monitor, Outputs};
use crate::quantity::{CellIndex, Timestamp};
use crate::status::document::ConfigFile;

pub use columns::reference;

/// File that is written after the tables of a log.
pub(super) const ABOUT: &str = "about.json";

/// Format of the tables.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TableFormat {
    /// Apache Parquet, compressed with Snappy.
    Parquet,
    /// Comma-separated values with a header line.
    Csv,
}

impl TableFormat {
    const fn ending(self) -> &'static str {
        match self {
            Self::Parquet => "parquet",
            Self::Csv => "csv",
        }
    }
}

/// Settings that apply to all logs.
#[derive(Clone)]
pub struct ExportSettings<'a> {
    /// How to read the logs.
    pub access: LogAccess<'a>,
    /// Format of the tables.
    pub format: TableFormat,
    /// Folder that contains the folders of the logs.
    pub out: PathBuf,
    /// Length of a period (s). At most one estimate per cell and period is written. 0 = all estimates; `None` = no
    /// table of estimates.
    pub period_s: Option<f64>,
    /// Number of threads; `None` = all cores.
    pub jobs: Option<usize>,
    /// Settings for reading logs, as text. Exports with different settings have different texts.
    pub reading: String,
}

/// A log's tables.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ExportResult {
    /// The log.
    pub log: PathBuf,
    /// Folder of the log's tables.
    pub folder: PathBuf,
    /// Number of rows of each table.
    pub rows: BTreeMap<&'static str, u64>,
    /// Time from the first stamp to the last (days).
    pub days: f64,
    /// Notes for the user.
    pub notes: Vec<String>,
    /// Cell model that was learned from the log.
    #[serde(skip)]
    pub model: Option<LearnedModel>,
}

/// Exports all logs. Returns the result or the error of each log. `report` receives the number of bytes read since its
/// last call.
///
/// # Errors
/// No threads can be started.
pub fn run(
    config: &Config,
    logs: &[PathBuf],
    settings: &ExportSettings<'_>,
    report: &(dyn Fn(u64) + Sync),
) -> Result<Vec<Result<ExportResult, LabError>>, LabError> {
    let names = names(logs);
    super::in_parallel(logs, settings.jobs, |index, log| {
        export(config, std::slice::from_ref(log), &names[index], settings, report)
    })
}

/// Exports the logs of one recording.
///
/// # Errors
/// A log cannot be read or a table cannot be written. If a log cannot be read, no new table is written.
pub(super) fn export(
    config: &Config,
    logs: &[PathBuf],
    name: &str,
    settings: &ExportSettings<'_>,
    report: &dyn Fn(u64),
) -> Result<ExportResult, LabError> {
    let folder = settings.out.join(name);
    create_folder(&folder)?;
    let mut tables = LogTables::create(config, name, &folder, settings)?;
    let out = Outputs { want_estimates: true, ..Outputs::default() };
    let source = (settings.access.open)(config, logs);
    let log = Path::new(&logs.iter().map(|log| log.display().to_string()).collect::<Vec<_>>().join(", ")).to_owned();
    let (mut model, mut record) = (None, UseRecord::default());
    let mut each = |monitor: &Monitor, out: &mut Outputs| {
        if out.events.iter().any(|event| matches!(event.kind, EventKind::Model { .. })) {
            let view = monitor.model();
            let has_prior = view.fleet.is_some();
            model = view.label.zip(view.own.cloned()).map(|(label, own)| LearnedModel { label, own, has_prior });
        }
        record = *monitor.use_record();
        let result = tables.take(monitor, out);
        out.clear();
        result
    };
    let monitor = Monitor::new(config.monitor.clone());
    let driven = drive(source, monitor, out, settings.access.sleep_gap_of_s(&config.monitor), &mut each, report)?;
    let span = driven.span_of(&log)?;
    let metadata = metadata(config, &log, span, settings);
    let mut notes = driven.notes.clone();
    notes.extend(remove_about(&folder, &log)?);
    let rows = tables.finish(&record, &metadata)?;
    let exported = ExportResult { log, folder, rows, days: driven.days(), notes, model };
    write_about(&exported, &driven, metadata)?;
    Ok(exported)
}

/// Removes the `about.json` of an earlier export, because its tables are then replaced one by one. Returns a note if
/// the earlier tables came from another log.
fn remove_about(folder: &Path, log: &Path) -> Result<Option<String>, LabError> {
    let path = folder.join(ABOUT);
    let Ok(text) = std::fs::read(&path) else { return Ok(None) };
    std::fs::remove_file(&path)
        .map_err(|error| LabError::File(format!("{}: cannot be removed: {error}", path.display())))?;
    let about: serde_json::Value = serde_json::from_slice(&text).unwrap_or_default();
    let other = about["metadata"]["packwatch.log"].as_str().filter(|other| Path::new(other) != log);
    Ok(other.map(|other| format!("replaced the tables of {other}")))
}

fn metadata(
    config: &Config,
    log: &Path,
    (first, last): (Timestamp, Timestamp),
    settings: &ExportSettings<'_>,
) -> Vec<(&'static str, String)> {
    let hash = ConfigFile::of(&config.path).map_or_else(|| "unknown".to_owned(), |file| file.sha256);
    let vehicle = config.vehicle.labels().into_iter().map(|(label, text)| {
        let key = match label {
            "name" => "packwatch.vehicle_name",
            "id" => "packwatch.vehicle_id",
            _ => "packwatch.vehicle_pack",
        };
        (key, text)
    });
    let run = [
        ("packwatch.version", env!("CARGO_PKG_VERSION").to_owned()),
        ("packwatch.config", config.path.display().to_string()),
        ("packwatch.config_sha256", hash),
        ("packwatch.log", log.display().to_string()),
        ("packwatch.start_utc", stamp::format_utc_micros(first)),
        ("packwatch.end_utc", stamp::format_utc_micros(last)),
    ];
    let period = settings.period_s.map(|period_s| ("packwatch.estimates_period_s", period_s.to_string()));
    run.into_iter().chain(period).chain(vehicle).collect()
}

fn write_about(
    exported: &ExportResult,
    driven: &DriveSummary,
    metadata: Vec<(&'static str, String)>,
) -> Result<(), LabError> {
    let metadata: serde_json::Map<_, _> =
        metadata.into_iter().map(|(key, value)| (key.to_owned(), json!(value))).collect();
    let document = json!({
        "version": 1,
        "metadata": metadata,
        "rows": exported.rows,
        "log": driven.counts,
        "notes": exported.notes,
    });
    Ok(crate::write_file(&exported.folder.join(ABOUT), &serde_json::to_vec_pretty(&document)?)?)
}

/// Returns a folder name per log: the file name without endings. If several logs have the same name, the name of their
/// folder is put in front, or a number is appended.
pub(super) fn names(logs: &[PathBuf]) -> Vec<String> {
    let text = |name: Option<&std::ffi::OsStr>| name.unwrap_or_default().to_string_lossy().into_owned();
    let short = |log: &PathBuf| {
        if log == Path::new("-") {
            return "stdin".to_owned();
        }
        let name = text(log.file_name());
        let name = crate::without_compression(&name);
        let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
        clean(if stem.is_empty() { "log" } else { stem })
    };
    let all: Vec<String> = logs.iter().map(short).collect();
    let mut names: Vec<String> = Vec::with_capacity(all.len());
    for (log, name) in logs.iter().zip(&all) {
        let is_twice = all.iter().filter(|other| *other == name).count() > 1;
        let folder =
            log.parent().map(|folder| text(folder.file_name())).filter(|folder| is_twice && !folder.is_empty());
        let name = folder.map_or_else(|| name.clone(), |folder| format!("{}-{name}", clean(&folder)));
        let numbered = (2..).map(|number| format!("{name}-{number}"));
        names.extend(std::iter::once(name.clone()).chain(numbered).find(|name| !names.contains(name)));
    }
    names
}

pub(super) fn clean(name: &str) -> String {
    let safe = |letter: char| if letter.is_ascii_alphanumeric() || "._-".contains(letter) { letter } else { '_' };
    let name: String = name.chars().map(safe).collect();
    if name.starts_with('.') { format!("_{name}") } else { name }
}

struct LogTables {
    log: Arc<str>,
    estimates: Option<TableFile<EstimateRow>>,
    half_cycles: TableFile<HalfCycleRow>,
    outlooks: TableFile<OutlookRow>,
    alarms: TableFile<AlarmRow>,
    uses: TableFile<UseRow>,
    period_ns: i64,
    first: Option<Timestamp>,
    /// For each cell, the period of the last written estimate.
    periods: Vec<Option<i64>>,
    rated_ah: f64,
    moved_ah: Vec<f64>,
    /// Cell and values of a half-cycle whose capacity event has not arrived.
    half_cycle: Option<(CellIndex, Fields)>,
}

impl LogTables {
    fn create(config: &Config, name: &str, folder: &Path, settings: &ExportSettings<'_>) -> Result<Self, LabError> {
        let cells = usize::from(config.monitor.sample.cells);
        let (form, ending) = (settings.format, settings.format.ending());
        let path = |table: &str| folder.join(format!("{table}.{ending}"));
        Ok(Self {
            log: name.into(),
            estimates: settings
                .period_s
                .map(|_| TableFile::create(&path("estimates"), form, columns::ESTIMATES))
                .transpose()?,
            half_cycles: TableFile::create(&path("half_cycles"), form, &columns::HALF_CYCLES)?,
            outlooks: TableFile::create(&path("outlook"), form, &columns::OUTLOOK)?,
            alarms: TableFile::create(&path("alarms"), form, columns::ALARMS)?,
            uses: TableFile::create(&path("use_record"), form, columns::USE_RECORD)?,
            period_ns: (settings.period_s.unwrap_or(0.0) * 1e9) as i64,
            first: None,
            periods: vec![None; cells],
            rated_ah: config.monitor.model.rated_capacity_ah,
            moved_ah: vec![0.0; cells],
            half_cycle: None,
        })
    }

    fn take(&mut self, monitor: &Monitor, out: &Outputs) -> Result<(), LabError> {
        for estimate in &out.estimates {
            let since_ns = self.since_ns(estimate.time);
            let Some(last) = self.periods.get_mut(estimate.cell.index()) else { continue };
            let period = since_ns.checked_div(self.period_ns);
            if period.is_none() || last.is_none_or(|last| period > Some(last)) {
                *last = period;
                let Some(estimates) = &mut self.estimates else { continue };
                estimates.push(&EstimateRow {
                    log: self.log.clone(),
                    since_s: since_ns as f64 * 1e-9,
                    estimate: *estimate,
                })?;
            }
        }
        out.events.iter().try_for_each(|event| self.take_event(monitor, event))
    }

    fn take_event(&mut self, monitor: &Monitor, event: &Event) -> Result<(), LabError> {
        let (log, time) = (self.log.clone(), event.time);
        let since_s = self.since_ns(time) as f64 * 1e-9;
        match event.kind {
            EventKind::HalfCycle { cell, charge_ah, .. } => {
                if let Some(moved_ah) = self.moved_ah.get_mut(cell.index()) {
                    *moved_ah += charge_ah;
                }
                self.half_cycle = Some((cell, Fields::of_event(&event.kind)));
            }
            EventKind::Capacity { cell, .. } => {
                let half = self.half_cycle.take().filter(|half| half.0 == cell);
                let (_, half) = half.ok_or("a capacity came without its half-cycle")?;
                let (full_cycles, remaining) = (self.full_cycles(cell), monitor.remaining_life(cell).ok());
                let (capacity, losses) = (Fields::of_event(&event.kind), monitor.loss_modes(cell));
                let row = HalfCycleRow { log, time, since_s, full_cycles, half, capacity, losses, remaining };
                self.half_cycles.push(&row)?;
            }
            EventKind::Outlook { values } => self.outlooks.push(&OutlookRow { log, time, since_s, values })?,
            EventKind::PackReplaced { .. } => self.moved_ah.fill(0.0),
            EventKind::Alarm { rule, .. } => {
                self.alarms.push(&AlarmRow { log, time, since_s, rule, alarm: Fields::of_event(&event.kind) })?;
            }
            _ => {}
        }
        Ok(())
    }

    fn full_cycles(&self, cell: CellIndex) -> f64 {
        self.moved_ah.get(cell.index()).map_or(f64::NAN, |moved_ah| moved_ah / (2.0 * self.rated_ah))
    }

    fn since_ns(&mut self, time: Timestamp) -> i64 {
        let first = *self.first.get_or_insert(time);
        time.nanos().saturating_sub(first.nanos())
    }

    fn finish(
        mut self,
        record: &UseRecord,
        metadata: &[(&'static str, String)],
    ) -> Result<BTreeMap<&'static str, u64>, LabError> {
        UseRow::of_record(&self.log, record)?.iter().try_for_each(|row| self.uses.push(row))?;
        let mut rows = BTreeMap::from([
            ("half_cycles", self.half_cycles.finish(metadata)?),
            ("outlook", self.outlooks.finish(metadata)?),
            ("alarms", self.alarms.finish(metadata)?),
            ("use_record", self.uses.finish(metadata)?),
        ]);
        if let Some(estimates) = self.estimates {
            rows.insert("estimates", estimates.finish(metadata)?);
        }
        Ok(rows)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_safe_and_no_two_are_the_same() {
        let logs =
            ["a/life.log.gz", "b/life.csv", "c/day 1.log", "b/life.log", ".log", "x/y.z.log", "-"].map(PathBuf::from);
        assert_eq!(names(&logs), ["a-life", "b-life", "day_1", "b-life-2", "log", "y.z", "stdin"]);
    }
}
