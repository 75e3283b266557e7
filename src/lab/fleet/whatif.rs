//! What every combination of settings would have told, log by log.
//!
//! In: a [`Grid`], logs, their truths. Out: per log its life and per combination and threshold a [`Judged`]. One replay
//! per log serves all combinations that differ in alarms only ([`Lanes`]); the life (charge moved, learned capacity) is
//! that of the configuration as it is.

use std::path::PathBuf;

use serde::Serialize;

use super::drive::{Driven, Reading, drive};
use super::judge::{Horizon, Judged, Life, judge};
use super::track::{Learned, Track};
use super::truth::{Truth, TruthKind};
use super::variant_batch::Lanes;
use super::variants::Grid;
use crate::alarm::{Rule, Severity};
use crate::config::Config;
use crate::monitor::{Monitor, Outputs};

/// A log and its truth.
#[derive(Debug, Clone)]
pub struct Job {
    /// The log.
    pub log: PathBuf,
    /// What was true of it.
    pub truth: Option<PathBuf>,
}

/// What all logs have in common.
#[derive(Clone, Copy)]
pub struct Settings<'a> {
    /// How they are read.
    pub reading: Reading<'a>,
    /// Capacity below which a cell's life is over, Ah.
    pub end_of_life_ah: f64,
    /// Whether the usable capacity is compared with it, where one is configured.
    pub judges_usable: bool,
    /// How soon after a raise the end of life must come.
    pub horizon: Option<Horizon>,
    /// Threads; `None` = all cores.
    pub jobs: Option<usize>,
}

/// What the end of life was judged by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub enum JudgedBy {
    /// The true capacity.
    #[serde(rename = "true_capacity")]
    Truth,
    /// Published capacities.
    #[serde(rename = "published_capacity")]
    Published,
    /// The usable capacity learned.
    #[serde(rename = "learned_usable_capacity")]
    LearnedUsable,
    /// The capacity learned.
    #[serde(rename = "learned_capacity")]
    Learned,
}

impl JudgedBy {
    /// For people.
    pub const fn words(self) -> &'static str {
        match self {
            Self::Truth => "the true capacity",
            Self::Published => "published capacities",
            Self::LearnedUsable => "the learned usable capacity",
            Self::Learned => "the learned capacity",
        }
    }
}

/// The end of a life.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EndOfLife {
    /// Stamp of the log, s.
    pub time_s: f64,
    /// Days after the log's first stamp.
    pub days: f64,
    /// Equivalent full cycles so far.
    pub cycles: f64,
    /// The cell whose it is, counted from 0.
    pub cell: u16,
}

/// One threshold under one combination.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AlarmRow {
    /// Index of the combination.
    pub setting: usize,
    /// Which rule.
    pub rule: Rule,
    /// Its severity.
    pub severity: Severity,
    /// What is compared with, in the rule's unit.
    pub threshold: f64,
    /// What it was worth.
    #[serde(flatten)]
    pub judged: Judged,
}

/// One log.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LogResult {
    /// The log.
    pub log: PathBuf,
    /// Its truth.
    pub truth: Option<PathBuf>,
    /// What the end of life was judged by.
    pub judged_by: JudgedBy,
    /// From the first stamp to the last, days.
    pub days: f64,
    /// Equivalent full cycles.
    pub cycles: f64,
    /// The weakest learned capacity at the end, Ah.
    pub learned_ah: Option<f64>,
    /// `None` = not reached.
    pub end_of_life: Option<EndOfLife>,
    /// Every threshold under every combination.
    pub alarms: Vec<AlarmRow>,
    /// What the user should know.
    pub notes: Vec<String>,
}

/// What one replay came to.
struct Replayed {
    driven: Driven,
    track: Track,
    lanes: Lanes,
    /// Of the log's first replay only.
    truth: Option<Truth>,
}

/// Replays all logs; per log its result, or why there is none. `report` is told bytes read.
///
/// # Errors
/// When no threads can be started.
pub fn run(
    grid: &Grid,
    jobs: &[Job],
    settings: &Settings<'_>,
    report: &(dyn Fn(u64) + Sync),
) -> Result<Vec<Result<LogResult, String>>, String> {
    // The replays of one log are independent too: a fleet of one log still uses all cores.
    let tasks: Vec<(usize, usize)> = (0..jobs.len()).flat_map(|job| (0..grid.replays).map(move |r| (job, r))).collect();
    let replays = super::in_parallel(&tasks, settings.jobs, |_, &(job, number)| {
        replay(grid, number, &jobs[job], settings, report)
    })?;
    let mut replays = replays.into_iter();
    let of_job = |job: &Job| {
        // All of them, also behind one that failed: the next job's begin after them.
        let own: Vec<Result<Replayed, String>> = replays.by_ref().take(grid.replays).collect();
        judge_log(grid, job, own.into_iter().collect::<Result<_, _>>()?, settings)
    };
    Ok(jobs.iter().map(of_job).collect())
}

/// The number of each combination's thresholds in the lanes of their replay, for combination `index`.
fn watch(grid: &Grid, number: usize) -> (Lanes, Vec<(usize, Vec<usize>)>) {
    let mut lanes = Lanes::default();
    let own = grid.variants.iter().enumerate().filter(|(_, variant)| variant.replay == number);
    let places = own.map(|(index, variant)| {
        let rules = variant.config.monitor.rules.iter();
        (index, rules.map(|rule| lanes.watch(rule)).collect())
    });
    let places = places.collect();
    (lanes, places)
}

fn replay(
    grid: &Grid,
    number: usize,
    job: &Job,
    settings: &Settings<'_>,
    report: &(dyn Fn(u64) + Sync),
) -> Result<Replayed, String> {
    let variant = grid.variants.iter().find(|variant| variant.replay == number);
    let config: &Config = &variant.ok_or("a replay without a setting")?.config;
    // Before the replay, which may take hours: a table that cannot be read is told at once.
    let truth = job.truth.as_deref().filter(|_| number == 0).map(Truth::read).transpose()?;
    let monitor = &config.monitor;
    let (mut lanes, _) = watch(grid, number);
    let mut engines = lanes.engines(monitor.sample.cells);
    let is_usable = settings.judges_usable && monitor.health.usable.is_some();
    let learned = if is_usable { Learned::Usable } else { Learned::Capacity };
    let mut track = Track::new(monitor.model.rated_capacity_ah, learned);
    let out = Outputs { want_alarm_inputs: true, ..Outputs::default() };
    let source = (settings.reading.open)(config, &job.log);
    let mut each = |_: &Monitor, out: &mut Outputs| {
        track.observe(&out.events);
        engines.take(&out.alarm_inputs, &mut lanes);
        out.clear();
        Ok(())
    };
    let driven = drive(source, Monitor::new(monitor.clone()), out, settings.reading.sleep_gap_s, &mut each, report)?;
    Ok(Replayed { driven, track, lanes, truth })
}

fn judge_log(grid: &Grid, job: &Job, replays: Vec<Replayed>, settings: &Settings<'_>) -> Result<LogResult, String> {
    let plain = replays.first().ok_or("no replay")?;
    let truth = plain.truth.as_ref();
    let span = plain.driven.span_of(&job.log)?;
    if let Some((from, to)) = truth.map(Truth::span).filter(|(from, to)| *from > span.1 || *to < span.0) {
        let file = job.truth.as_deref().unwrap_or(&job.log).display();
        let ((a, b), (c, d)) = ((from.secs(), to.secs()), (span.0.secs(), span.1.secs()));
        return Err(format!(
            "{file}: tells of {a} to {b} s, must tell of the log's {c} to {d} s (--start-times dates a CSV)"
        ));
    }
    let (judged_by, end) = end_of_life(&plain.track, truth, settings.end_of_life_ah);
    let mut notes = plain.driven.notes.clone();
    if end.is_some_and(|(time, _)| time <= span.0) {
        notes.push("the life was over before the log began: nothing is judged by its end".to_owned());
    }
    let end = end.filter(|(time, _)| *time <= span.1);
    let mut alarms = Vec::new();
    for (number, replayed) in replays.iter().enumerate() {
        let end = end.map(|(time, _)| time);
        let life = Life { track: &plain.track, truth, span, end, horizon: settings.horizon };
        for (setting, places) in watch(grid, number).1 {
            let rules = &grid.variants[setting].config.monitor.rules;
            let judged = rules.iter().zip(places).filter_map(|(config, place)| {
                let judged = judge(config, replayed.lanes.history(place)?, &life);
                Some(AlarmRow {
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

fn end_of_life(track: &Track, truth: Option<&Truth>, end_ah: f64) -> (JudgedBy, End) {
    match (truth, track.learned()) {
        (Some(truth), _) => {
            let by = match truth.kind {
                TruthKind::Capacity => JudgedBy::Truth,
                TruthKind::Published => JudgedBy::Published,
            };
            (by, truth.falls_below(end_ah))
        }
        (None, Learned::Usable) => (JudgedBy::LearnedUsable, track.stays_below(end_ah)),
        (None, Learned::Capacity) => (JudgedBy::Learned, track.stays_below(end_ah)),
    }
}
