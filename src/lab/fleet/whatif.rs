//! Evaluates the alarms of every combination of settings in each log.
//!
//! Combinations that differ only in alarms share one replay per log ([`VariantBatch`]). The charge moved and the
//! learned capacity of a log come from a replay with the original configuration.

use std::path::PathBuf;

use serde::Serialize;

use super::drive::{DriveSummary, LogAccess, drive};
use super::judge::{AlarmScore, Horizon, LogLife, judge};
use super::track::Track;
use super::truth::{EndOfLifeSource, Truth};
use super::variant_batch::VariantBatch;
use super::variants::VariantGrid;

use crate::alarm::{Rule, Severity};
use crate::config::Config;
use crate::error::LabError;
use crate::monitor::{Monitor, Outputs};

/// A log, and the file with its true capacities.
#[derive(Debug, Clone)]
pub struct WhatifJob {
    /// The log.
    pub log: PathBuf,
    /// CSV file of the true capacities; `None` = there is no file.
    pub truth: Option<PathBuf>,
}

/// Settings that apply to all logs.
#[derive(Clone, Copy)]
pub struct WhatifSettings<'a> {
    /// How to read the logs.
    pub access: LogAccess<'a>,
    /// Capacity at which the life of a cell ends (Ah).
    pub end_of_life_ah: f64,
    /// Whether `end_of_life_ah` limits the usable capacity (only if the usable capacity is configured).
    pub judges_usable: bool,
    /// Maximum time from a correct alarm to the end of life; `None` = unlimited.
    pub horizon: Option<Horizon>,
    /// Number of threads; `None` = all cores.
    pub jobs: Option<usize>,
}

/// The end of a cell's life.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EndOfLife {
    /// Time on the clock of the log (s).
    pub time_s: f64,
    /// Days since the first stamp of the log.
    pub days: f64,
    /// Equivalent full cycles up to this time.
    pub cycles: f64,
    /// The cell whose life ended, counted from 0.
    pub cell: u16,
}

/// Alarms of one threshold in one combination.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ThresholdScore {
    /// Index of the combination.
    pub setting: usize,
    /// The rule.
    pub rule: Rule,
    /// Severity of the threshold.
    pub severity: Severity,
    /// The threshold, in the unit of the rule.
    pub threshold: f64,
    /// Score of the alarms.
    #[serde(flatten)]
    pub judged: AlarmScore,
}

/// Result of one log.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LogResult {
    /// The log.
    pub log: PathBuf,
    /// CSV file of the true capacities.
    pub truth: Option<PathBuf>,
    /// Capacity that determined the end of life.
    pub judged_by: EndOfLifeSource,
    /// Time from the first stamp to the last (days).
    pub days: f64,
    /// Equivalent full cycles of the whole log.
    pub cycles: f64,
    /// Weakest learned capacity at the end (Ah).
    pub learned_ah: Option<f64>,
    /// End of life; `None` = not reached.
    pub end_of_life: Option<EndOfLife>,
    /// Scores of every threshold in every combination.
    pub alarms: Vec<ThresholdScore>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

struct ReplayResult {
    driven: DriveSummary,
    track: Track,
    batch: VariantBatch,
    /// True capacities. They are read only for the first replay of a log.
    truth: Option<Truth>,
}

/// Replays all logs. Returns the result or the error of each log. `report` receives the number of bytes read since its
/// last call.
///
/// # Errors
/// No threads can be started.
pub fn run(
    grid: &VariantGrid,
    jobs: &[WhatifJob],
    settings: &WhatifSettings<'_>,
    report: &(dyn Fn(u64) + Sync),
) -> Result<Vec<Result<LogResult, LabError>>, LabError> {
    // Several cores can work on one log, because its replays are independent.
    let tasks: Vec<(usize, usize)> = (0..jobs.len()).flat_map(|job| (0..grid.replays).map(move |r| (job, r))).collect();
    let replays = super::in_parallel(&tasks, settings.jobs, |_, &(job, number)| {
        replay(grid, number, &jobs[job], settings, report)
    })?;
    let mut replays = replays.into_iter();
    let of_job = |job: &WhatifJob| {
        // Take all results of this job, even after a failed one, because the results of the next job follow.
        let own: Vec<Result<ReplayResult, LabError>> = replays.by_ref().take(grid.replays).collect();
        judge_log(grid, job, own.into_iter().collect::<Result<_, _>>()?, settings)
    };
    Ok(jobs.iter().map(of_job).collect())
}

/// Returns the thresholds of replay `number`. For each combination with this replay, also returns its index and the
/// numbers of its thresholds.
fn watch(grid: &VariantGrid, number: usize) -> (VariantBatch, Vec<(usize, Vec<usize>)>) {
    let mut batch = VariantBatch::default();
    let own = grid.variants.iter().enumerate().filter(|(_, variant)| variant.replay == number);
    let places = own.map(|(index, variant)| {
        let rules = variant.config.monitor.rules.iter();
        (index, rules.map(|rule| batch.watch(rule)).collect())
    });
    let places = places.collect();
    (batch, places)
}

fn replay(
    grid: &VariantGrid,
    number: usize,
    job: &WhatifJob,
    settings: &WhatifSettings<'_>,
    report: &(dyn Fn(u64) + Sync),
) -> Result<ReplayResult, LabError> {
    let variant = grid.variants.iter().find(|variant| variant.replay == number);
    let config: &Config = &variant.ok_or("a replay without a setting")?.config;
    // Read the truth first, so that an unreadable table prevents a replay that may take hours.
    let truth = job.truth.as_deref().filter(|_| number == 0).map(Truth::read).transpose()?;
    let monitor = &config.monitor;
    let (mut batch, _) = watch(grid, number);
    let mut engines = batch.engines(monitor.sample.cells);
    let is_usable = settings.judges_usable && monitor.health.usable.is_some();
    let learned = if is_usable { EndOfLifeSource::LearnedUsable } else { EndOfLifeSource::Learned };
    let mut track = Track::new(monitor.model.rated_capacity_ah, learned);
    let out = Outputs { want_alarm_inputs: true, ..Outputs::default() };
    let source = (settings.access.open)(config, std::slice::from_ref(&job.log));
    let mut each = |_: &Monitor, out: &mut Outputs| {
        track.observe(&out.events);
        engines.take(&out.alarm_inputs, &mut batch);
        out.clear();
        Ok(())
    };
    let driven =
        drive(source, Monitor::new(monitor.clone()), out, settings.access.sleep_gap_of_s(monitor), &mut each, report)?;
    Ok(ReplayResult { driven, track, batch, truth })
}

fn judge_log(
    grid: &VariantGrid,
    job: &WhatifJob,
    replays: Vec<ReplayResult>,
    settings: &WhatifSettings<'_>,
) -> Result<LogResult, LabError> {
    let plain = replays.first().ok_or("no replay")?;
    let truth = plain.truth.as_ref();
    let span = plain.driven.span_of(&job.log)?;
    if let Some((from, to)) = truth.map(Truth::span).filter(|(from, to)| *from > span.1 || *to < span.0) {
        let file = job.truth.as_deref().unwrap_or(&job.log).display();
        let ((a, b), (c, d)) = ((from.secs(), to.secs()), (span.0.secs(), span.1.secs()));
        return Err(LabError::Data(format!(
            "{file}: covers {a} to {b} s, must overlap the log's {c} to {d} s (--start-times dates a CSV)"
        )));
    }
    let (judged_by, end) = end_of_life(&plain.track, truth, settings.end_of_life_ah);
    let mut notes = plain.driven.notes.clone();
    if end.is_some_and(|(time, _)| time <= span.0) {
        notes.push("the end of life came before the log started: alarms are not judged by it".to_owned());
    }
    let end = end.filter(|(time, _)| *time <= span.1);
    let mut alarms = Vec::new();
    for (number, replayed) in replays.iter().enumerate() {
        let end = end.map(|(time, _)| time);
        let life = LogLife { track: &plain.track, truth, span, end, horizon: settings.horizon };
        for (setting, places) in watch(grid, number).1 {
            let rules = &grid.variants[setting].config.monitor.rules;
            let judged = rules.iter().zip(places).filter_map(|(config, place)| {
                let judged = judge(config, replayed.batch.history(place)?, &life);
                Some(ThresholdScore {
                    setting,
                    rule: config.rule,
                    severity: config.severity,
                    threshold: config.threshold,
                    judged,
                })
            });
            alarms.extend(judged);
        }
    }
    alarms.sort_by_key(|row| (row.rule, row.severity, row.setting));
    let end_of_life = end.map(|(time, cell)| EndOfLife {
        time_s: time.secs(),
        days: time.since(span.0) / 86_400.0,
        cycles: plain.track.cycles_at(time),
        cell: cell.0,
    });
    Ok(LogResult {
        log: job.log.clone(),
        truth: job.truth.clone(),
        judged_by,
        days: plain.driven.days(),
        cycles: plain.track.cycles(),
        learned_ah: plain.track.last_ah(),
        end_of_life,
        alarms,
        notes,
    })
}

type End = Option<(crate::quantity::Timestamp, crate::quantity::CellIndex)>;

fn end_of_life(track: &Track, truth: Option<&Truth>, end_ah: f64) -> (EndOfLifeSource, End) {
    match truth {
        Some(truth) => (truth.kind, truth.falls_below(end_ah)),
        None => (track.learned(), track.stays_below(end_ah)),
    }
}
