//! Writes the scores as text tables and as one JSON document.

use std::fmt::Write as _;
use std::path::PathBuf;

use serde::Serialize;

use super::{CONVERGED_HOLD_S, CONVERGED_POINTS, Case, CaseScore, LifeScore, ScoreSettings, SocScore};
use crate::error::LabError;
use crate::io::text_table::text_table;
use crate::monitor::ModelState;

/// Scores with their settings.
#[derive(Debug)]
pub struct ScoreReport {
    /// Path of the configuration.
    pub config: PathBuf,
    /// Settings of all files and cases.
    pub settings: ScoreSettings,
    /// The cases (initial conditions of the estimator).
    pub cases: Vec<Case>,
    /// Scores of every file in every case.
    pub scores: Vec<CaseScore>,
}

#[rustfmt::skip]
fn life_heads(below: &str) -> [&str; 12] {
    ["file", "case", "mean |error|", "mean", "max", "in 95 %", "+/-", below, "truth", "capacity", "resistance", "resets"]
}

#[derive(Serialize)]
struct Document<'a> {
    config: String,
    cell_model: &'a str,
    truth_capacity_ah: f64,
    settle_s: f64,
    converged_within_points: f64,
    converged_hold_s: f64,
    /// State learned from the files of --learn.
    #[serde(skip_serializing_if = "Option::is_none")]
    learned: Option<LearnedDocument>,
    scores: &'a [CaseScore],
    totals: Vec<Total<'a>>,
}

#[derive(Serialize)]
struct LearnedDocument {
    model: ModelState,
    capacity_ah: f64,
    capacity_std_ah: f64,
}

#[derive(Serialize)]
struct Total<'a> {
    #[serde(flatten)]
    case: Case,
    files: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    soc: Option<SocTotal<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    life: Option<LifeTotal<'a>>,
}

#[derive(Serialize)]
struct SocTotal<'a> {
    mean_rmse_points: f64,
    worst_rmse_points: f64,
    worst_file: &'a str,
    mean_coverage: f64,
    least_coverage: f64,
    mean_half_width_points: f64,
}

#[derive(Serialize)]
struct LifeTotal<'a> {
    mean_abs_error_ah: f64,
    worst_mean_abs_error_ah: f64,
    worst_file: &'a str,
    least_coverage: f64,
}

impl ScoreReport {
    /// Returns the scores as one JSON document that ends in a line feed.
    ///
    /// # Errors
    /// Never: every value can be written as JSON.
    pub fn json(&self) -> Result<String, LabError> {
        let document = Document {
            config: self.config.display().to_string(),
            cell_model: &self.settings.monitor.model.name,
            truth_capacity_ah: self.settings.truth_capacity_ah,
            settle_s: self.settings.settle_s,
            converged_within_points: CONVERGED_POINTS,
            converged_hold_s: CONVERGED_HOLD_S,
            learned: self.settings.learned.as_ref().map(|learned| LearnedDocument {
                model: learned.model,
                capacity_ah: learned.capacity.mean,
                capacity_std_ah: learned.capacity.std(),
            }),
            scores: &self.scores,
            totals: self.totals(),
        };
        Ok(serde_json::to_string_pretty(&document)? + "\n")
    }

    /// Returns the scores as text tables.
    pub fn table(&self) -> String {
        let settings = &self.settings;
        let mut out = format!("cell model {}\n", settings.monitor.model.name);
        if self.scores.iter().any(|score| score.soc.is_some()) {
            let (truth_ah, settle_s, hold_min) =
                (settings.truth_capacity_ah, settings.settle_s, CONVERGED_HOLD_S / 60.0);
            out += &format!(
                "\nSOC in points of {truth_ah} Ah, after {settle_s:.0} s; converged = within {CONVERGED_POINTS} points for {hold_min:.0} min\n"
            );
            out += &text_table(
                &["file", "case", "RMSE", "mean", "max", "converged", "in 95 %", "+/-", "NIS", "resets", "samples"],
                self.soc_rows(),
                2,
            );
        }
        if self.scores.iter().any(|score| score.life.is_some()) {
            out += &format!("\nusable capacity after {} discharges\n", settings.skip_cycles);
            let below = format!("below {} Ah", settings.threshold_ah);
            out += &text_table(&life_heads(&below), self.life_rows(), 2);
        }
        self.add_notes(&mut out);
        out
    }

    fn totals(&self) -> Vec<Total<'_>> {
        self.cases
            .iter()
            .map(|case| Total::new(*case, self.scores.iter().filter(|s| s.case == *case).collect()))
            .collect()
    }

    fn soc_rows(&self) -> Vec<Vec<String>> {
        let scored = self.scores.iter().filter_map(|score| Some((score, score.soc.as_ref()?)));
        let mut rows: Vec<_> = scored.map(|(score, soc)| soc_row(score, soc)).collect();
        for total in self.totals().iter().filter(|total| total.files > 1) {
            let Some(soc) = &total.soc else { continue };
            let case = describe(&total.case);
            let row = |file: String, rmse: f64, coverage: f64| {
                let blank = [const { String::new() }; 3];
                [file, case.clone(), two(rmse)].into_iter().chain(blank).chain([percent(coverage)]).collect::<Vec<_>>()
            };
            let mut mean = row("mean of files".into(), soc.mean_rmse_points, soc.mean_coverage);
            mean.push(two(soc.mean_half_width_points));
            rows.push(mean);
            rows.push(row(format!("worst: {}", soc.worst_file), soc.worst_rmse_points, soc.least_coverage));
        }
        rows
    }

    fn life_rows(&self) -> Vec<Vec<String>> {
        let scored = self.scores.iter().filter_map(|score| Some((score, score.life.as_ref()?)));
        scored.map(|(score, life)| life_row(score, life)).collect()
    }

    fn add_notes(&self, out: &mut String) {
        let mut note = |text: std::fmt::Arguments<'_>| {
            // Writing to a string cannot fail.
            let _ = writeln!(out, "{text}");
        };
        for score in &self.scores {
            let (name, case) = (&score.name, describe(&score.case));
            let left_out = score.soc.as_ref().map_or(0, |soc| soc.left_out_rows);
            if score.soc.as_ref().is_some_and(|soc| soc.samples == 0) {
                let settle_s = self.settings.settle_s;
                note(format_args!(
                    "{name}, {case}: no SOC scored, because the file ends before {settle_s:.0} s; give a shorter --settle"
                ));
            }
            if left_out > 0 {
                let rows = score.rows;
                note(format_args!("{name}, {case}: {left_out} of {rows} rows left out (no truth or no estimate)"));
            }
            if score.uncarried_values > 0 {
                note(format_args!("{name}, {case}: {} values that no frame can carry", score.uncarried_values));
            }
            if let Some(life) = score.life.as_ref().filter(|life| life.left_out > 0) {
                let (left_out, all) = (life.left_out, life.discharges);
                note(format_args!(
                    "{name}, {case}: {left_out} of {all} discharges left out (no estimate or no published capacity)"
                ));
            }
        }
        let plots = self.scores.iter().filter(|score| score.plot.is_some()).count();
        if let (1.., Some(folder)) = (plots, &self.settings.plots) {
            let noun = if plots == 1 { "plot" } else { "plots" };
            note(format_args!("{plots} {noun} in {}", folder.display()));
        }
    }
}

impl<'a> Total<'a> {
    fn new(case: Case, scores: Vec<&'a CaseScore>) -> Self {
        Self { case, files: scores.len(), soc: SocTotal::new(&scores), life: LifeTotal::new(&scores) }
    }
}

impl<'a> SocTotal<'a> {
    fn new(scores: &[&'a CaseScore]) -> Option<Self> {
        let all: Vec<(&str, &SocScore)> = scored(scores, |score| score.soc.as_ref().filter(|soc| soc.samples > 0));
        let (worst_file, worst_rmse_points) = worst(&all, |soc| soc.rmse_points)?;
        Some(Self {
            mean_rmse_points: mean(&all, |soc| soc.rmse_points),
            worst_rmse_points,
            worst_file,
            mean_coverage: mean(&all, |soc| soc.coverage),
            least_coverage: least(&all, |soc| soc.coverage),
            mean_half_width_points: mean(&all, |soc| soc.mean_half_width_points),
        })
    }
}

impl<'a> LifeTotal<'a> {
    fn new(scores: &[&'a CaseScore]) -> Option<Self> {
        let all: Vec<(&str, &LifeScore)> = scored(scores, |score| score.life.as_ref().filter(|life| life.scored > 0));
        let (worst_file, worst_mean_abs_error_ah) = worst(&all, |life| life.mean_abs_error_ah)?;
        Some(Self {
            mean_abs_error_ah: mean(&all, |life| life.mean_abs_error_ah),
            worst_mean_abs_error_ah,
            worst_file,
            least_coverage: least(&all, |life| life.coverage),
        })
    }
}

fn scored<'a, T>(scores: &[&'a CaseScore], of: impl Fn(&'a CaseScore) -> Option<&'a T>) -> Vec<(&'a str, &'a T)> {
    scores.iter().filter_map(|score| Some((score.name.as_str(), of(score)?))).collect()
}

fn mean<T>(all: &[(&str, &T)], value: impl Fn(&T) -> f64) -> f64 {
    all.iter().map(|(_, score)| value(score)).sum::<f64>() / all.len() as f64
}

fn least<T>(all: &[(&str, &T)], value: impl Fn(&T) -> f64) -> f64 {
    all.iter().map(|(_, score)| value(score)).fold(f64::INFINITY, f64::min)
}

fn worst<'a, T>(all: &[(&'a str, &T)], value: impl Fn(&T) -> f64) -> Option<(&'a str, f64)> {
    all.iter().map(|(name, score)| (*name, value(score))).max_by(|a, b| a.1.total_cmp(&b.1))
}

fn describe(case: &Case) -> String {
    case.words(" ", ["C", "I"])
}

fn soc_row(score: &CaseScore, soc: &SocScore) -> Vec<String> {
    vec![
        score.name.clone(),
        describe(&score.case),
        two(soc.rmse_points),
        signed(soc.mean_error_points),
        two(soc.max_abs_error_points),
        soc.converge_s.map_or_else(|| "not".to_owned(), |s| format!("{s:.0} s")),
        percent(soc.coverage),
        two(soc.mean_half_width_points),
        four(soc.mean_normalised_innovation_squared),
        score.resets.to_string(),
        soc.samples.to_string(),
    ]
}

fn life_row(score: &CaseScore, life: &LifeScore) -> Vec<String> {
    let milli = |ah: f64| known(ah, |ah| format!("{:.1} mAh", 1000.0 * ah));
    let number = |found: Option<usize>| found.map_or_else(|| "never".to_owned(), |number| number.to_string());
    let with_std = |value: Option<f64>, std: Option<f64>, digits: usize| {
        let text = value.zip(std).map(|(value, std)| format!("{value:.digits$} +/- {std:.digits$}"));
        text.unwrap_or_else(|| "-".to_owned())
    };
    vec![
        score.name.clone(),
        describe(&score.case),
        milli(life.mean_abs_error_ah),
        milli(life.mean_error_ah),
        milli(life.max_abs_error_ah),
        percent(life.coverage),
        milli(life.mean_half_width_ah),
        number(life.first_below_estimate),
        number(life.first_below_truth),
        with_std(score.final_capacity_ah, score.final_capacity_std_ah, 3),
        with_std(score.final_resistance_ratio, score.final_resistance_ratio_std, 2),
        score.resets.to_string(),
    ]
}

fn known(value: f64, format: impl Fn(f64) -> String) -> String {
    if value.is_finite() { format(value) } else { "-".to_owned() }
}

fn two(value: f64) -> String {
    known(value, |value| format!("{value:.2}"))
}

fn four(value: f64) -> String {
    known(value, |value| format!("{value:.4}"))
}

fn signed(value: f64) -> String {
    known(value, |value| format!("{value:+.2}"))
}

fn percent(value: f64) -> String {
    known(value, |value| format!("{:.1} %", 100.0 * value))
}
