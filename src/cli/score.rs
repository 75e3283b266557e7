//! `packwatch score`: measured files against truth.

mod args;
mod report;

use std::path::{Path, PathBuf};

pub(crate) use args::Args;

use super::Failure;
use super::label::BUILT_IN;
use super::output::{create_folder, failure, short_names, unless_closed};
use crate::config::{self, Config, ConfigFaults, ConfigFiles};
use crate::health::UsableConfig;
use crate::lab::score::{self, Case, CycleTable, ScoreJob, ScoreSettings};

/// Runs the command.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    args.check()?;
    let config = configuration(args)?;
    let settings = settings(args, &config)?;
    let jobs = jobs(args)?;
    let cases = args.cases();
    settings.plots.iter().try_for_each(|folder| create_folder(folder))?;
    let bar = report::Bar::new(&jobs);
    let scores = score::run(&jobs, &cases, &settings, &|index, part| bar.advance(index, part));
    bar.clear();
    let scores = scores.map_err(failure)?;
    let report = report::ScoreReport { config: &config, settings: &settings, cases: &cases, scores: &scores };
    unless_closed(if args.output.json { report.json() } else { report.table() })
}

/// Loads the configuration, with the cell model of --cell in place of its own.
fn configuration(args: &Args) -> Result<Config, Failure> {
    let built_in = args.config.is_none();
    let path = args.config.clone().unwrap_or_else(|| PathBuf::from("score.toml"));
    if let Some(config) = args.label.configuration()? {
        return Ok(config);
    }
    let Some(cell) = &args.cell else { return Ok(config::load(&path)?) };
    // Faults of the model are reported with its own file name.
    config::cell_model::load(cell)?;
    let read = |file: &Path| {
        let known = BUILT_IN.iter().find(|(name, _)| built_in && Path::new(name) == file);
        known.map_or_else(|| std::fs::read(file), |(_, bytes)| Ok(bytes.to_vec()))
    };
    let files = if built_in { ConfigFiles::alone(&path) } else { ConfigFiles::find(&path)? };
    let named = named_cell(&files, &read)?;
    let read = |file: &Path| if file == named { std::fs::read(cell) } else { read(file) };
    Ok(config::load_with(&files, &read)?)
}

/// The path of the cell model that a configuration names.
fn named_cell(files: &ConfigFiles, read: config::ReadFile<'_>) -> Result<PathBuf, ConfigFaults> {
    let text = config::merged_with(files, read)?;
    let named = text.parse::<toml::Table>().ok().and_then(|table| {
        let model = table.get("pack")?.get("cell_model")?.as_str()?.to_owned();
        Some(files.main.parent().unwrap_or(Path::new("")).join(model))
    });
    // Without one, reading the configuration reports the fault.
    Ok(named.unwrap_or_default())
}

fn settings(args: &Args, config: &Config) -> Result<ScoreSettings, Failure> {
    let mut monitor = config.monitor.clone();
    if monitor.sample.cells != 1 {
        let found = monitor.sample.cells;
        return Err(Failure::new(format!(
            "{}: pack.cells = {found}, must be 1 to score files of one cell",
            config.path.display()
        )));
    }
    if let Some([current_a, temperature_c, cutoff_v]) = args.life.load {
        let taper_current_a =
            monitor.health.usable.map_or(monitor.model.rated_capacity_ah / 20.0, |u| u.taper_current_a);
        monitor.health.usable = Some(UsableConfig { current_a, temperature_c, cutoff_v, taper_current_a });
    }
    if !args.life.cycles.is_empty() && monitor.health.usable.is_none() {
        return Err(Failure::new(
            "no load for the usable capacity: --cycles needs --load CURRENT,TEMPERATURE,CUTOFF or a [usable] table",
        ));
    }
    let learned = (!args.learn.is_empty())
        .then(|| score::learn(&args.learn, &monitor, args.statistics.sleep_gap))
        .transpose()
        .map_err(failure)?;
    Ok(ScoreSettings {
        learned,
        truth_capacity_ah: args.statistics.truth_capacity.unwrap_or(monitor.model.capacity_ah),
        monitor,
        remove: args.starts.remove,
        settle_s: args.statistics.settle,
        soc_std: args.starts.soc_std.map(|points| points / 100.0),
        capacity_std: args.starts.capacity_std.map(|percent| percent / 100.0),
        sleep_gap_s: args.statistics.sleep_gap,
        threshold_ah: args.life.threshold,
        skip_cycles: args.life.skip_cycles,
        window: args.life.window,
        plots: args.output.plot.clone(),
    })
}

fn jobs(args: &Args) -> Result<Vec<ScoreJob>, Failure> {
    let names = short_names(&args.files);
    let tables = args.life.cycles.iter().map(|path| CycleTable::read(path).map(Some));
    let tables: Result<Vec<_>, _> = tables.collect();
    let mut tables = tables.map_err(failure)?;
    tables.resize(args.files.len(), None);
    let jobs = args.files.iter().zip(names).zip(tables);
    Ok(jobs.map(|((path, name), cycles)| ScoreJob { path: path.clone(), cycles, name }).collect())
}

impl Args {
    /// Every combination, in the order of the lists.
    fn cases(&self) -> Vec<Case> {
        let seeds = if self.life.window.is_some() {
            self.life.seed.iter().map(|&seed| Some(seed)).collect()
        } else {
            vec![None]
        };
        let mut cases = Vec::new();
        for start in &self.starts.start {
            for error in &self.starts.soc_error {
                for &capacity_error_percent in &self.starts.capacity_error {
                    for &current_offset_a in &self.starts.current_offset {
                        cases.extend(seeds.iter().map(|&seed| Case {
                            start: *start,
                            soc_error_points: error.0,
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
