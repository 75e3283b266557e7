//! Defines, checks and runs a request for scores from the command line or the Python module.
//!
//! The measured files are read when they are scored.

use std::path::PathBuf;

use super::{Case, CaseScore, CycleTable, ScoreJob, ScoreReport, ScoreSettings, Start, learn};
use crate::config::Config;
use crate::error::{LabError, RequestError, check_values as check, create_folder};
use crate::health::UsableConfig;
use crate::io::csv_log::CsvOptions;
use crate::io::paths::{check_distinct, short_names};
use crate::single_cell::CellSource;

/// A request. Each file runs in every combination of starts, errors, offsets and seeds.
#[derive(Debug, Clone, PartialEq)]
pub struct ScoreRequest {
    /// Measured files.
    pub files: Vec<PathBuf>,
    /// Configuration of the cell.
    pub source: CellSource,
    /// Files from which the monitor learns first, in order.
    pub learn: Vec<PathBuf>,
    /// Starts of the estimator in each file.
    pub start: Vec<Start>,
    /// [`Start::Middle`] skips the rows until this fraction of the full charge has been discharged.
    pub remove: f64,
    /// Errors of the initial SOC (points); `None` = no initial SOC.
    pub soc_error_points: Vec<Option<f64>>,
    /// Standard deviation of the initial SOC (points).
    pub soc_std_points: Option<f64>,
    /// Errors of the initial capacity (percent of the model's capacity).
    pub capacity_error_percent: Vec<f64>,
    /// Standard deviation of the initial capacity (percent).
    pub capacity_std_percent: Option<f64>,
    /// Offsets of the current sensor (A).
    pub current_offset_a: Vec<f64>,
    /// Time after the start that is left out of the statistics (s).
    pub settle_s: f64,
    /// Charge from full to empty that defines the true SOC (Ah); `None` = the model's capacity.
    pub truth_capacity_ah: Option<f64>,
    /// Columns and current sign of the files, if their headers do not state them.
    pub table: CsvOptions,
    /// A gap between two rows that is longer than this (s) means that the recorder was asleep.
    pub sleep_gap_s: f64,
    /// Tables of published capacities, one per file; empty = no tables.
    pub cycles: Vec<PathBuf>,
    /// Load at which the capacities were published: current (A), temperature (degrees Celsius), cut-off voltage (V).
    /// `None` = `[usable]` of the configuration.
    pub load: Option<[f64; 3]>,
    /// Capacity threshold (Ah); the first discharge below it is reported.
    pub threshold_ah: f64,
    /// Number of discharges at the start of a life that are left out of the statistics.
    pub skip_cycles: usize,
    /// If set, the monitor receives only the rows in one random window of each half-cycle. The values are the smallest
    /// and the largest size of a window, as fractions of the charge that flows in the half-cycle. `None` = the monitor
    /// receives all rows.
    pub window: Option<(f64, f64)>,
    /// Seeds of the windows.
    pub seeds: Vec<u64>,
    /// Folder for a plot per file and case.
    pub plots: Option<PathBuf>,
}

impl Default for ScoreRequest {
    fn default() -> Self {
        Self {
            files: vec![],
            source: CellSource::default(),
            learn: vec![],
            table: CsvOptions::default(),
            start: vec![Start::Full],
            remove: 0.3,
            soc_error_points: vec![None],
            soc_std_points: None,
            capacity_error_percent: vec![0.0],
            capacity_std_percent: None,
            current_offset_a: vec![0.0],
            settle_s: 600.0,
            truth_capacity_ah: None,
            sleep_gap_s: 90.0,
            cycles: vec![],
            load: None,
            threshold_ah: 1.4,
            skip_cycles: 10,
            window: None,
            seeds: vec![1],
            plots: None,
        }
    }
}

/// A checked request with its configuration and tables.
#[derive(Debug)]
pub struct ScoreRun {
    config: Config,
    settings: ScoreSettings,
    jobs: Vec<ScoreJob>,
    cases: Vec<Case>,
}

impl ScoreRun {
    /// Files with their tables.
    pub fn jobs(&self) -> &[ScoreJob] {
        &self.jobs
    }

    /// Scores every file in every case. `progress` is used as in [`super::run`].
    ///
    /// # Errors
    /// The folder for the plots cannot be created, or a file cannot be scored. If several files cannot be scored, the
    /// error of the first file (in order) is returned.
    pub fn run(self, progress: &(dyn Fn(usize, f64) + Sync)) -> Result<ScoreReport, LabError> {
        self.settings.plots.as_deref().map_or(Ok(()), create_folder)?;
        let scores: Vec<CaseScore> = super::run(&self.jobs, &self.cases, &self.settings, progress)?;
        let Self { config, settings, cases, .. } = self;
        Ok(ScoreReport { config: config.path, settings, cases, scores })
    }
}

impl ScoreRequest {
    /// Reads the configuration, the tables and the files to learn from. `progress` is used as in [`learn`].
    ///
    /// # Errors
    /// The configuration is faulty, a number is out of range, arguments are incompatible, or a table or a file to learn
    /// from cannot be read.
    pub fn prepare(&self, progress: &dyn Fn()) -> Result<ScoreRun, RequestError> {
        self.check()?;
        let config = self.source.load()?;
        let settings = self.settings(&config, progress)?;
        let jobs = self.jobs()?;
        Ok(ScoreRun { config, settings, jobs, cases: self.cases() })
    }

    fn check(&self) -> Result<(), LabError> {
        self.check_lists()?;
        let (files, tables) = (self.files.len(), self.cycles.len());
        if tables != 0 && tables != files {
            return Err(LabError::Data(format!(
                "--cycles given {tables} times for {files} files, must be once per file"
            )));
        }
        if self.source.config.is_none() && self.source.cell.is_none() && self.source.label.is_none() {
            return Err("no cell: give a configuration, a cell model, or a chemistry with the rated capacity".into());
        }
        check_distinct(&self.files)?;
        self.check_numbers()
    }

    /// Rejects empty lists, which would score nothing.
    fn check_lists(&self) -> Result<(), LabError> {
        let lists = [
            ("files", self.files.len()),
            ("start", self.start.len()),
            ("soc_error_points", self.soc_error_points.len()),
            ("capacity_error_percent", self.capacity_error_percent.len()),
            ("current_offset_a", self.current_offset_a.len()),
            ("seeds", self.seeds.len()),
        ];
        if let Some((name, _)) = lists.into_iter().find(|(_, values)| *values == 0) {
            return Err(LabError::Data(format!("no {name}, must be one or more")));
        }
        if !self.learn.is_empty() && !self.cycles.is_empty() {
            return Err("learn must not be given together with cycles".into());
        }
        Ok(())
    }

    fn check_numbers(&self) -> Result<(), LabError> {
        let above_0 = |value: f64| value > 0.0 && value.is_finite();
        let to_100 = |value: f64| value > 0.0 && value <= 100.0;
        check("remove", [self.remove], |value| value > 0.0 && value < 1.0, "above 0 and below 1")?;
        let points = self.soc_error_points.iter().copied().flatten();
        check("soc_error_points", points, |value| value.abs() <= 100.0, "-100 to 100")?;
        check("soc_std_points", self.soc_std_points, to_100, "above 0 and at most 100")?;
        let percent = self.capacity_error_percent.iter().copied();
        check(
            "capacity_error_percent",
            percent,
            |value| value > -100.0 && value <= 100.0,
            "above -100 and at most 100",
        )?;
        check("capacity_std_percent", self.capacity_std_percent, to_100, "above 0 and at most 100")?;
        check("current_offset_a", self.current_offset_a.iter().copied(), f64::is_finite, "a finite number")?;
        check("settle_s", [self.settle_s], |value| value >= 0.0 && value.is_finite(), "0 or more")?;
        check("truth_capacity_ah", self.truth_capacity_ah, above_0, "a finite number above 0")?;
        check("sleep_gap_s", [self.sleep_gap_s], above_0, "a finite number above 0")?;
        check("threshold_ah", [self.threshold_ah], above_0, "a finite number above 0")?;
        if let Some((least, most)) =
            self.window.filter(|(least, most)| !(*least > 0.0 && least <= most && *most <= 1.0))
        {
            let allowed = "two parts above 0 and at most 1, the smaller first";
            return Err(LabError::Data(format!("window = {least}, {most}, must be {allowed}")));
        }
        let unfit = |[current_a, temperature_c, cutoff_v]: &[f64; 3]| {
            !(above_0(*current_a) && temperature_c.is_finite() && above_0(*cutoff_v))
        };
        if let Some([current_a, temperature_c, cutoff_v]) = self.load.filter(unfit) {
            let allowed = "amperes above 0, degrees C and volts above 0";
            return Err(LabError::Data(format!("load = {current_a}, {temperature_c}, {cutoff_v}, must be {allowed}")));
        }
        Ok(())
    }

    fn settings(&self, config: &Config, progress: &dyn Fn()) -> Result<ScoreSettings, LabError> {
        let mut monitor = config.monitor.clone();
        if monitor.sample.cells != 1 {
            let found = monitor.sample.cells;
            return Err(LabError::Data(format!(
                "{}: pack.cells = {found}, must be 1 to score files of one cell",
                config.path.display()
            )));
        }
        if let Some([current_a, temperature_c, cutoff_v]) = self.load {
            let taper_current_a =
                monitor.health.usable.map_or(monitor.model.rated_capacity_ah / 20.0, |u| u.taper_current_a);
            monitor.health.usable = Some(UsableConfig { current_a, temperature_c, cutoff_v, taper_current_a });
        }
        if !self.cycles.is_empty() && monitor.health.usable.is_none() {
            return Err(LabError::from(
                "no load for the usable capacity: --cycles needs --load CURRENT,TEMPERATURE,CUTOFF or a [usable] table",
            ));
        }
        let model = &monitor.model;
        let table = CsvOptions { capacity_ah: Some(model.rated_capacity_ah), ..self.table.clone() };
        let learned = match &self.learn[..] {
            [] => None,
            files => Some(learn(files, &table, &monitor, self.sleep_gap_s, progress)?),
        };
        Ok(ScoreSettings {
            table,
            learned,
            truth_capacity_ah: self.truth_capacity_ah.unwrap_or(monitor.model.capacity_ah),
            monitor,
            remove: self.remove,
            settle_s: self.settle_s,
            soc_std: self.soc_std_points.map(|points| points / 100.0),
            capacity_std: self.capacity_std_percent.map(|percent| percent / 100.0),
            sleep_gap_s: self.sleep_gap_s,
            threshold_ah: self.threshold_ah,
            skip_cycles: self.skip_cycles,
            window: self.window,
            plots: self.plots.clone(),
        })
    }

    fn jobs(&self) -> Result<Vec<ScoreJob>, LabError> {
        let names = short_names(&self.files);
        let tables: Result<Vec<_>, _> = self.cycles.iter().map(|path| CycleTable::read(path).map(Some)).collect();
        let mut tables = tables?;
        tables.resize(self.files.len(), None);
        let jobs = self.files.iter().zip(names).zip(tables);
        Ok(jobs.map(|((path, name), cycles)| ScoreJob { path: path.clone(), cycles, name }).collect())
    }

    /// Returns every combination of starts, errors, offsets and seeds, in the order of the lists.
    fn cases(&self) -> Vec<Case> {
        let seeds = match self.window {
            Some(_) => self.seeds.iter().map(|&seed| Some(seed)).collect(),
            None => vec![None],
        };
        let mut cases = Vec::new();
        for start in &self.start {
            for &soc_error_points in &self.soc_error_points {
                for &capacity_error_percent in &self.capacity_error_percent {
                    for &current_offset_a in &self.current_offset_a {
                        cases.extend(seeds.iter().map(|&seed| Case {
                            start: *start,
                            soc_error_points,
                            capacity_error_percent,
                            current_offset_a,
                            seed,
                        }));
                    }
                }
            }
        }
        cases
    }
}
