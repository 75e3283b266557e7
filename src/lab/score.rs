//! Scores estimates against truth: measured files run through the real monitor, and the errors of its estimates.
//!
//! Input: files as cyclers write them ([`MeasuredFile`]), a monitor's configuration, and the cases to try: where in the file the
//! estimator starts, and its initial SOC and capacity. Each row becomes the frame that would have carried it ([`feed`]), so every stage of
//! the monitor takes part. Output: per file and case the errors of the SOC in points (percent of full), the share of samples whose 95 %
//! interval contains the truth, and for whole lives the same for the usable capacity.
//!
//! The true SOC is 1 - `discharged_ah` / C with one C for all files; the true usable capacity comes from a table of published capacities.
//! Every estimate counts once, without weighting by time, so a part logged at 10 Hz counts more than a rest logged once a minute.
//! Estimates without a truth and rows without an estimate are left out and counted.

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
use crate::monitor::MonitorConfig;

/// Settings of all files and cases.
#[derive(Debug, Clone)]
pub struct ScoreSettings {
    /// Configuration of the monitor.
    pub monitor: MonitorConfig,
    /// Charge from full to empty that defines the true SOC, Ah.
    pub truth_capacity_ah: f64,
    /// Share of that charge that has been taken out where a start in the middle begins, fraction.
    pub remove: f64,
    /// Time after the start without statistics, s.
    pub settle_s: f64,
    /// Standard deviation of the initial SOC, fraction; `None` = as in [`ScoreSettings::initial_soc_std`].
    pub soc_std: Option<f64>,
    /// Standard deviation of the initial capacity, as a fraction of the model's; `None` = as configured.
    pub capacity_std: Option<f64>,
    /// A longer gap means that the recorder was asleep, s.
    pub sleep_gap_s: f64,
    /// Capacity whose first undershoot is reported, Ah.
    pub threshold_ah: f64,
    /// Number of discharges before the statistics of the capacity.
    pub skip_cycles: usize,
    /// Smallest and largest share of each half-cycle's charge that is visible; `None` = all of it.
    pub window: Option<(f64, f64)>,
    /// State after the files that preceded each scored one; `None` = each file is the first.
    pub learned: Option<Learned>,
    /// Folder for the plots.
    pub plots: Option<PathBuf>,
}

impl ScoreSettings {
    /// Returns the standard deviation of the initial SOC, fraction: the configured value, or else the size of its error, at least 5
    /// points.
    pub fn initial_soc_std(&self, error_points: f64) -> f64 {
        self.soc_std.unwrap_or((error_points.abs() / 100.0).max(0.05))
    }
}

/// One file to score.
#[derive(Debug, Clone)]
pub struct ScoreJob {
    /// The measured file.
    pub path: PathBuf,
    /// Its table of published capacities.
    pub cycles: Option<CycleTable>,
    /// Unique name in tables and of plots.
    pub name: String,
}

/// Scores every file in every case, files in parallel; the result is in the order of `jobs`, and within a file of `cases`.
/// `progress` receives the index of the file and the share of its work just done (fraction).
///
/// # Errors
/// The error of the first file (in order) that cannot be scored.
pub fn run(
    jobs: &[ScoreJob],
    cases: &[Case],
    settings: &ScoreSettings,
    progress: &(dyn Fn(usize, f64) + Sync),
) -> Result<Vec<CaseScore>, LabError> {
    let score = |(index, job)| score_file(job, cases, settings, &|part| progress(index, part));
    // One file at a time, because files differ much in length.
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
    let file = MeasuredFile::read(&job.path)?;
    let share = 1.0 / cases.len().max(1) as f64;
    cases.iter().map(|case| case::run(job, &file, case, settings, &|part| progress(part * share))).collect()
}
