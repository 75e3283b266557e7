//! Runs one file through the monitor with the initial conditions of one case, and scores the result.

use std::ops::Range;
use std::path::PathBuf;

use serde::Serialize;

use super::cycles::CycleTable;
use super::feed::{Feeder, UNKNOWN_GAP_NS};
use super::life::{LifeRecorder, LifeScore};
use super::soc::{self, SocSample, SocScore};
use super::{ScoreJob, ScoreSettings, picture, window};
use crate::error::LabError;
use crate::io::csv_log::TableReading;
use crate::measured::{MeasuredFile, MeasuredPart};
use crate::monitor::{EventKind, MonitorConfig};
use crate::quantity::Timestamp;

const REPORT_EVERY: usize = 4096;
/// An initial SOC is clamped if it is outside 0 to 1 by at most this value, because a counter does not always start at
/// exactly 0.
const SOC_SLACK: f64 = 0.005;

/// Row of a file at which the estimator starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Start {
    /// The first row with a true SOC. In a file without an ampere-hour counter, the first row.
    Full,
    /// The row where a given share of the charge has been taken out. Earlier rows are dropped.
    Middle,
}

/// Initial conditions of an estimator.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Case {
    /// Start of the estimator in the file.
    pub start: Start,
    /// Error of the initial SOC (points); `None` = the estimator gets no initial SOC and starts from the first voltage.
    #[serde(rename = "told_points")]
    pub soc_error_points: Option<f64>,
    /// Error of the initial capacity, percent of the model's capacity.
    pub capacity_error_percent: f64,
    /// Offset of the current sensor (A), added to every measured current.
    pub current_offset_a: f64,
    /// Seed of the random windows (one part of each half-cycle). The monitor receives only the rows in the windows.
    /// `None` = the monitor receives all rows.
    pub seed: Option<u64>,
}

impl Case {
    /// Describes the case in words. `capacity` and `current` are the names to use for the errors of capacity and
    /// current.
    pub fn words(&self, separator: &str, [capacity, current]: [&str; 2]) -> String {
        let mut words = vec![match self.start {
            Start::Full => "full".to_owned(),
            Start::Middle => "middle".to_owned(),
        }];
        words.extend(self.soc_error_points.map(|points| format!("told {points:+}")));
        let (percent, ampere) = (self.capacity_error_percent, self.current_offset_a);
        words.extend((percent != 0.0).then(|| format!("{capacity} {percent:+} %")));
        words.extend((ampere != 0.0).then(|| format!("{current} {ampere:+} A")));
        words.extend(self.seed.map(|seed| format!("windows {seed}")));
        words.join(separator)
    }
}

/// Score of one file in one case.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CaseScore {
    /// The file.
    pub path: PathBuf,
    /// Short name of the file.
    pub name: String,
    /// The case.
    #[serde(flatten)]
    pub case: Case,
    /// Interpretation of the file's columns.
    #[serde(skip)]
    pub reading: TableReading,
    /// Rows fed to the monitor.
    pub rows: usize,
    /// Number of measured values that did not reach the monitor, because no CAN frame of the configuration can carry
    /// them.
    pub uncarried_values: usize,
    /// Number of filter resets.
    pub resets: usize,
    /// Estimated capacity at the end (Ah); `None` = no estimate.
    pub final_capacity_ah: Option<f64>,
    /// Standard deviation of `final_capacity_ah` (Ah).
    pub final_capacity_std_ah: Option<f64>,
    /// Estimated resistance at the end, relative to new; `None` = no estimate.
    pub final_resistance_ratio: Option<f64>,
    /// Standard deviation of `final_resistance_ratio`.
    pub final_resistance_ratio_std: Option<f64>,
    /// Score of the SOC; `None` = no row has both an estimate and a true SOC.
    pub soc: Option<SocScore>,
    /// Score of the usable capacity; `None` = no table of published capacities.
    pub life: Option<LifeScore>,
    /// Path of the plot.
    pub plot: Option<PathBuf>,
}

/// Runs `file` through the monitor.
///
/// # Errors
/// The file has no true SOC or never reaches the start of the case, the initial SOC is out of range, or a plot cannot
/// be written.
pub(super) fn run(
    job: &ScoreJob,
    file: &MeasuredFile,
    case: &Case,
    settings: &ScoreSettings,
    progress: &dyn Fn(f64),
) -> Result<CaseScore, LabError> {
    let begin = CaseStart::find(job, file, case, settings)?;
    let config = configure(job, case, settings, begin.truth)?;
    let cycles = job.cycles.as_ref().map(|table| table.at_load(&file.parts));
    let mut run = CaseRun::new(job, settings, config, (case.current_offset_a, cycles));
    let (mut done, rows) = (0, file.rows().max(1));
    for (index, part) in file.parts.iter().enumerate().skip(begin.part) {
        let mut seen = case.seed.zip(settings.window).map_or(0..part.len(), |(s, w)| window::rows(part, index, s, w));
        if index == begin.part {
            seen.start = seen.start.max(begin.row);
        }
        run.part(part, seen, &mut |fed| {
            done += fed;
            progress(fed as f64 / rows as f64);
        });
    }
    progress(rows.saturating_sub(done) as f64 / rows as f64);
    run.finish(case, &file.reading)
}

struct CaseStart {
    part: usize,
    row: usize,
    /// SOC at this row, fraction; NaN = no counter.
    truth: f64,
}

impl CaseStart {
    fn find(job: &ScoreJob, file: &MeasuredFile, case: &Case, settings: &ScoreSettings) -> Result<Self, LabError> {
        let unfit = |what: String| Err(LabError::Data(format!("{}: {what}", job.path.display())));
        let truths = || {
            let rows =
                file.parts.iter().enumerate().flat_map(|(p, part)| (0..part.len()).map(move |row| (p, row, part)));
            rows.map(|(p, row, part)| Self { part: p, row, truth: truth(part, row, settings) })
        };
        let Some(first) = truths().find(|at| at.truth.is_finite()) else {
            if job.cycles.is_none() {
                return unfit(
                    "no values in column discharged_ah, and no table with --cycles: nothing to score against".into(),
                );
            }
            return match (case.start, case.soc_error_points) {
                (Start::Middle, _) => {
                    unfit("no values in column discharged_ah: a start in the middle cannot be found".into())
                }
                (_, Some(_)) => {
                    unfit("no values in column discharged_ah: an initial SOC with an error cannot be derived".into())
                }
                _ => Ok(Self { part: 0, row: 0, truth: f64::NAN }),
            };
        };
        let wanted = 1.0 - settings.remove;
        match case.start {
            Start::Full => Ok(first),
            Start::Middle => match truths().find(|at| at.truth <= wanted) {
                Some(at) => Ok(at),
                None => unfit(format!(
                    "the SOC never falls to {:.3}: no start in the middle with --remove {}",
                    wanted, settings.remove
                )),
            },
        }
    }
}

/// Returns the SOC according to the counter, fraction; NaN = the counter has no value.
fn truth(part: &MeasuredPart, row: usize, settings: &ScoreSettings) -> f64 {
    1.0 - part.discharged_ah[row] / settings.truth_capacity_ah
}

fn configure(job: &ScoreJob, case: &Case, settings: &ScoreSettings, truth: f64) -> Result<MonitorConfig, LabError> {
    let mut config = settings.monitor.clone();
    let estimator = &mut config.estimator;
    if let Some(points) = case.soc_error_points {
        let initial = truth + points / 100.0;
        if !(-SOC_SLACK..=1.0 + SOC_SLACK).contains(&initial) {
            let (path, truth) = (job.path.display(), 100.0 * truth);
            return Err(LabError::Data(format!(
                "{path}: initial SOC is {truth:.1} % and {points:+} points: {:.1} %, must be 0 to 100 %",
                100.0 * initial
            )));
        }
        estimator.initial.soc = Some(initial.clamp(0.0, 1.0));
        estimator.initial.soc_std = settings.initial_soc_std(points);
    }
    if case.capacity_error_percent != 0.0 {
        estimator.initial.capacity_ah = config.model.capacity_ah * (1.0 + case.capacity_error_percent / 100.0);
    }
    if let Some(std) = settings.capacity_std {
        estimator.initial.capacity_std_ah = std * config.model.capacity_ah;
    }
    Ok(config)
}

struct CaseRun<'a> {
    job: &'a ScoreJob,
    settings: &'a ScoreSettings,
    feeder: Feeder,
    current_offset_a: f64,
    cycles: Option<CycleTable>,
    /// Time of the first row that was fed, and the latest time of all rows.
    span: Option<(Timestamp, Timestamp)>,
    rows: usize,
    left_out: usize,
    resets: usize,
    samples: Vec<SocSample>,
    life: LifeRecorder,
    last: Option<crate::monitor::Estimate>,
}

impl<'a> CaseRun<'a> {
    fn new(
        job: &'a ScoreJob,
        settings: &'a ScoreSettings,
        config: MonitorConfig,
        (current_offset_a, cycles): (f64, Option<CycleTable>),
    ) -> Self {
        Self {
            job,
            settings,
            feeder: Feeder::new(config, settings.sleep_gap_s, settings.learned.as_ref()),
            current_offset_a,
            cycles,
            span: None,
            rows: 0,
            left_out: 0,
            resets: 0,
            samples: Vec::new(),
            life: LifeRecorder::default(),
            last: None,
        }
    }

    /// Feeds the rows `seen` of a part. `report` receives the number of rows since its last call.
    fn part(&mut self, part: &MeasuredPart, seen: Range<usize>, report: &mut dyn FnMut(usize)) {
        let Some(&first_s) = part.time_s.get(seen.start).filter(|_| !seen.is_empty()) else { return };
        let known = self.cycles.as_ref().and_then(|table| table.start(&part.key));
        let base = match (known, self.span) {
            (Some(start), _) => start,
            (None, None) => Timestamp::ZERO,
            (None, Some((_, latest))) => {
                let base = latest.plus_nanos(UNKNOWN_GAP_NS).plus_secs(-first_s);
                self.feeder.unknown_gap(base.plus_secs(first_s));
                self.take_events();
                base
            }
        };
        for row in seen {
            self.row(part, row, base.plus_secs(part.time_s[row]));
            if self.rows.is_multiple_of(REPORT_EVERY) {
                report(REPORT_EVERY);
            }
        }
    }

    fn row(&mut self, part: &MeasuredPart, row: usize, time: Timestamp) {
        let (began, latest) = self.span.unwrap_or((time, time));
        self.span = Some((began, latest.max(time)));
        self.rows += 1;
        self.feeder.row(
            time,
            part.current_a[row] + self.current_offset_a,
            part.voltage_v[row],
            part.temperature_c[row],
        );
        self.take_events();
        let truth = truth(part, row, self.settings);
        let estimate = self.feeder.out().estimates.pop();
        self.feeder.out().clear();
        self.last = estimate.or(self.last);
        match estimate {
            Some(e) if truth.is_finite() && e.soc.is_finite() && e.soc_std.is_finite() => {
                self.samples.push(SocSample {
                    time_s: time.since(began),
                    truth,
                    soc: e.soc,
                    soc_std: e.soc_std,
                    nis: (e.innovation_v / e.innovation_std_v).powi(2),
                })
            }
            _ => self.left_out += 1,
        }
    }

    fn take_events(&mut self) {
        for event in self.feeder.out().events.drain(..) {
            self.resets += usize::from(matches!(event.kind, EventKind::FilterReset { .. }));
            if let Some(table) = &self.cycles {
                self.life.observe(&event, table);
            }
        }
    }

    fn finish(mut self, case: &Case, reading: &TableReading) -> Result<CaseScore, LabError> {
        if let Some((_, latest)) = self.span {
            self.feeder.unknown_gap(latest);
            self.take_events();
        }
        let (job, settings, last) = (self.job, self.settings, self.last);
        let soc = (!self.samples.is_empty()).then(|| soc::score(&self.samples, settings.settle_s, self.left_out));
        let life = self.cycles.as_ref().map(|table| self.life.score(table, settings));
        let plot = settings
            .plots
            .as_deref()
            .map(|folder| picture::draw(folder, &job.name, case, &self.samples, life.as_ref()))
            .transpose()?;
        Ok(CaseScore {
            path: job.path.clone(),
            name: job.name.clone(),
            case: *case,
            reading: reading.clone(),
            rows: self.rows,
            uncarried_values: self.feeder.uncarried(),
            resets: self.resets,
            final_capacity_ah: last.map(|e| e.capacity_ah),
            final_capacity_std_ah: last.map(|e| e.capacity_std_ah),
            final_resistance_ratio: last.map(|e| e.resistance_ratio),
            final_resistance_ratio_std: last.map(|e| e.resistance_ratio_std),
            soc,
            life,
            plot,
        })
    }
}
