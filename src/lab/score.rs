//! Scores estimates against a known truth. Measured files run through the real monitor, and its estimates are compared
//! with the truth.
//!
//! Input: the files of cyclers ([`MeasuredFile`]), the configuration of a monitor, and the cases. A case states the
//! row, the SOC and the capacity with which the estimator starts. Each row of a file becomes a CAN frame ([`feed`]), so
//! that every stage of the monitor takes part. Output, per file and case: the errors of the SOC in points (percent of a
//! full cell), and the share of samples whose 95 % interval contains the truth. For whole lives, the usable capacity is
//! scored in the same way.
//!
//! The true SOC is 1 - `discharged_ah` / C, with the same C for all files. The true usable capacity comes from a table
//! of published capacities. Every estimate counts once, so a part logged at 10 Hz counts more than a rest logged once a
//! minute. Estimates without a truth and rows without an estimate are counted but not scored.

mod case;
mod cycles;
mod feed;
mod learn;
mod life;
mod picture;
mod report;
mod request;
mod soc;
mod window;

use std::path::PathBuf;

use rayon::prelude::*;

pub use case::{Case, CaseScore, Start};
pub use cycles::CycleTable;
pub use feed::Learned;
pub use learn::learn;
pub use life::{DischargeScore, LifeScore};
pub use report::ScoreReport;
pub use request::{ScoreRequest, ScoreRun};
pub use soc::{CONVERGED_HOLD_S, CONVERGED_POINTS, SocScore};

use super::measured::MeasuredFile;
use crate::error::LabError;
use crate::io::csv_log::CsvOptions;
use crate::monitor::MonitorConfig;

/// Settings of all files and cases.
#[derive(Debug, Clone)]
pub struct ScoreSettings {
    /// Configuration of the monitor.
    pub monitor: MonitorConfig,
    /// Charge from full to empty that defines the true SOC (Ah).
    pub truth_capacity_ah: f64,
    /// For a start in the middle of a file: charge taken out before the start, as a fraction of `truth_capacity_ah`.
    pub remove: f64,
    /// Time after the start that is left out of the statistics (s).
    pub settle_s: f64,
    /// Standard deviation of the initial SOC, fraction; `None` = see [`ScoreSettings::initial_soc_std`].
    pub soc_std: Option<f64>,
    /// Standard deviation of the initial capacity, as a fraction of the model's capacity; `None` = as configured.
    pub capacity_std: Option<f64>,
    /// Columns and current sign of the files, if their headers do not state them.
    pub table: CsvOptions,
    /// A gap between two rows that is longer than this (s) means that the recorder was asleep.
    pub sleep_gap_s: f64,
    /// Capacity threshold (Ah); the first discharge below it is reported.
    pub threshold_ah: f64,
    /// Number of discharges at the start of a life that are left out of the statistics.
    pub skip_cycles: usize,
    /// Smallest and largest size of a window, as a share of the charge of a half-cycle. The monitor receives only the
    /// rows in the windows; `None` = it receives all rows.
    pub window: Option<(f64, f64)>,
    /// Learned state with which the monitor starts each file (see [`ScoreRequest::learn`]); `None` = it starts without
    /// learned values.
    pub learned: Option<Learned>,
    /// Folder for the plots.
    pub plots: Option<PathBuf>,
}

impl ScoreSettings {
    /// Returns the standard deviation of the initial SOC, fraction. If it is not configured, it is the size of the
    /// initial error, but at least 5 points.
    pub fn initial_soc_std(&self, error_points: f64) -> f64 {
        self.soc_std.unwrap_or((error_points.abs() / 100.0).max(0.05))
    }
}

/// One file to score.
#[derive(Debug, Clone)]
pub struct ScoreJob {
    /// The measured file.
    pub path: PathBuf,
    /// Table of published capacities for the file.
    pub cycles: Option<CycleTable>,
    /// Unique name of the file, used in tables and for its plots.
    pub name: String,
}

/// Scores every file in every case; several files run in parallel. The results are in the order of `jobs` and, for each
/// file, in the order of `cases`. `progress` receives the index of the file, and the fraction of its work completed
/// since the last call.
///
/// # Errors
/// Returns the error of the first file (in order) that cannot be scored.
pub fn run(
    jobs: &[ScoreJob],
    cases: &[Case],
    settings: &ScoreSettings,
    progress: &(dyn Fn(usize, f64) + Sync),
) -> Result<Vec<CaseScore>, LabError> {
    let score = |(index, job)| score_file(job, cases, settings, &|part| progress(index, part));
    // Each parallel task has only one file, because the lengths of files differ greatly.
    let lists: Vec<_> = jobs.par_iter().enumerate().with_max_len(1).map(score).collect();
    let lists: Result<Vec<_>, _> = lists.into_iter().collect();
    Ok(lists?.into_iter().flatten().collect())
}

fn score_file(
    job: &ScoreJob,
    cases: &[Case],
    settings: &ScoreSettings,
    progress: &dyn Fn(f64),
) -> Result<Vec<CaseScore>, LabError> {
    let file = MeasuredFile::read(&job.path, &settings.table)?;
    let share = 1.0 / cases.len().max(1) as f64;
    cases.iter().map(|case| case::run(job, &file, case, settings, &|part| progress(part * share))).collect()
}
