//! Estimates against truth: measured files through the real core, and what the estimates were worth.
//!
//! In: files as cyclers write them ([`MeasuredFile`]), a core's configuration, and the cases to be tried: where in the
//! file the estimator starts, what SOC and capacity it is told. Each row becomes the frame that would have carried it
//! ([`feed`]), so every stage of the core takes part. Out: per file and case the SOC's errors in points (percent of full),
//! the share of samples whose 95 % interval holds the truth, and for whole lives the same of the usable capacity.
//!
//! The truth of the SOC is 1 - `discharged_ah` / C with one C for all files; that of the usable capacity is a table of
//! published capacities. Every estimate counts once (no weighting by time), so a stretch logged at 10 Hz counts more than
//! a rest logged once a minute. Estimates without a truth, and rows without an estimate, are left out and counted.

mod case;
mod cycles;
mod feed;
mod life;
mod picture;
mod soc;
mod window;

use std::path::PathBuf;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};

pub use case::{Case, CaseScore, Start};
pub use cycles::CycleTable;
pub use life::{DischargeScore, LifeScore};
pub use soc::{CONVERGED_HOLD_S, CONVERGED_POINTS, SocScore};

use super::chart::PlotError;
use super::measured::{MeasuredError, MeasuredFile};
use crate::monitor::MonitorConfig;

/// Half-width of a Gaussian's 95 % interval in standard deviations.
const STD_OF_95: f64 = 1.96;

/// What all files and cases have in common.
#[derive(Debug, Clone)]
pub struct Settings {
    /// The core.
    pub monitor: MonitorConfig,
    /// Charge from full to empty that the truth of the SOC is stated in, Ah.
    pub truth_capacity_ah: f64,
    /// Part of that charge already taken out where a start in the middle begins, fraction.
    pub remove: f64,
    /// Samples earlier than this after the start are left out of the statistics, s.
    pub settle_s: f64,
    /// Standard deviation of the SOC told, fraction; `None` = as [`Settings::told_std`] says.
    pub soc_std: Option<f64>,
    /// Standard deviation of the capacity started with, as a fraction of the model's; `None` = the configuration's.
    pub capacity_std: Option<f64>,
    /// A hole longer than this means that nobody measured, s.
    pub sleep_gap_s: f64,
    /// First fall of the capacity below this is looked for, Ah.
    pub threshold_ah: f64,
    /// Discharges before the capacity's statistics begin.
    pub skip_cycles: usize,
    /// Smallest and largest part of each half-cycle's charge that is seen; `None` = all of it.
    pub window: Option<(f64, f64)>,
    /// Folder for the plots.
    pub plots: Option<PathBuf>,
}

impl Settings {
    /// Least standard deviation of a told SOC that nobody states, fraction: nobody knows it better.
    const LEAST_TOLD_STD: f64 = 0.05;

    /// Standard deviation that goes with a told SOC: as stated, or as large as the error told, 5 points at least.
    pub fn told_std(&self, told_points: f64) -> f64 {
        self.soc_std.unwrap_or((told_points.abs() / 100.0).max(Self::LEAST_TOLD_STD))
    }
}

/// One file to score.
#[derive(Debug, Clone)]
pub struct Job {
    /// The measured file.
    pub path: PathBuf,
    /// Its table of published capacities.
    pub cycles: Option<CycleTable>,
    /// Unique name in tables and of plots.
    pub name: String,
}

/// Why there is no score.
#[derive(Debug, thiserror::Error)]
pub enum ScoreError {
    /// A file cannot be read.
    #[error(transparent)]
    Measured(#[from] MeasuredError),
    /// A plot cannot be written.
    #[error(transparent)]
    Plot(#[from] PlotError),
    /// A file, a table or what was asked for does not fit: place, found, allowed.
    #[error("{0}")]
    Unfit(String),
}

/// Scores every file in every case, files in parallel; in the order of `jobs`, and within a file of `cases`.
/// `progress` is told the file's index and the part of its work just done (fraction).
///
/// # Errors
/// The first file's (in order) that cannot be scored.
pub fn run(
    jobs: &[Job],
    cases: &[Case],
    settings: &Settings,
    progress: &(dyn Fn(usize, f64) + Sync),
) -> Result<Vec<CaseScore>, ScoreError> {
    let next = AtomicUsize::new(0);
    let results: Vec<OnceLock<Outcome>> = jobs.iter().map(|_| OnceLock::new()).collect();
    let work = || {
        while let Some((index, job)) = Some(next.fetch_add(1, Ordering::Relaxed)).and_then(|i| Some((i, jobs.get(i)?)))
        {
            let outcome = score_file(job, cases, settings, &|part| progress(index, part));
            // Each index is handed out once: nobody has set it before.
            let _ = results[index].set(outcome);
        }
    };
    let workers = std::thread::available_parallelism().map_or(1, usize::from).min(jobs.len());
    std::thread::scope(|scope| (0..workers).for_each(|_| drop(scope.spawn(work))));
    let lists: Result<Vec<_>, _> = results.into_iter().filter_map(OnceLock::into_inner).collect();
    Ok(lists?.into_iter().flatten().collect())
}

type Outcome = Result<Vec<CaseScore>, ScoreError>;

fn score_file(
    job: &Job,
    cases: &[Case],
    settings: &Settings,
    progress: &dyn Fn(f64),
) -> Result<Vec<CaseScore>, ScoreError> {
    let file = MeasuredFile::read(&job.path)?;
    let share = 1.0 / cases.len().max(1) as f64;
    cases.iter().map(|case| case::run(job, &file, case, settings, &|part| progress(part * share))).collect()
}
