//! Output of `score`: a progress bar, tables, JSON.

use std::io::{self, Write};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;

use crate::config::Config;
use crate::lab::score::{
    CONVERGED_HOLD_S, CONVERGED_POINTS, Case, CaseScore, ScoreJob, LifeScore, ScoreSettings, SocScore, Start,
};

/// Progress on standard error, when that is a terminal; by the files' sizes.
pub(super) struct Bar {
    bar: ProgressBar,
    bytes: Vec<f64>,
}

impl Bar {
    pub(super) fn new(jobs: &[ScoreJob]) -> Self {
        let bytes: Vec<f64> =
            jobs.iter().map(|job| std::fs::metadata(&job.path).map_or(0.0, |found| found.len() as f64)).collect();
        let total = bytes.iter().sum::<f64>() as u64;
        let bar = ProgressBar::with_draw_target(Some(total), ProgressDrawTarget::stderr_with_hz(5));
        let style = ProgressStyle::with_template("{bar:32} {percent} % of {msg}, eta {eta}");
        bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
        bar.set_message(if jobs.len() == 1 { "1 file".to_owned() } else { format!("{} files", jobs.len()) });
        Self { bar, bytes }
    }

    /// Adds a share of the work on file `index`.
    pub(super) fn advance(&self, index: usize, part: f64) {
        self.bar.inc((part * self.bytes.get(index).copied().unwrap_or(0.0)).round() as u64);
    }

    pub(super) fn clear(&self) {
        self.bar.finish_and_clear();
    }
}

/// Scores with their settings.
pub(super) struct ScoreReport<'a> {
    pub(super) config: &'a Config,
    pub(super) settings: &'a ScoreSettings,
    pub(super) cases: &'a [Case],
    pub(super) scores: &'a [CaseScore],
}

/// The JSON document.
#[derive(Serialize)]
struct Document<'a> {
    config: String,
    cell_model: &'a str,
    truth_capacity_ah: f64,
    settle_s: f64,
    converged_within_points: f64,
    converged_hold_s: f64,
    scores: &'a [CaseScore],
    totals: Vec<Total<'a>>,
}

/// One case over all files.
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

impl ScoreReport<'_> {
    /// Prints one JSON document on standard output.
    pub(super) fn json(&self) -> io::Result<()> {
        let document = Document {
            config: self.config.path.display().to_string(),
            cell_model: &self.settings.monitor.model.name,
            truth_capacity_ah: self.settings.truth_capacity_ah,
            settle_s: self.settings.settle_s,
            converged_within_points: CONVERGED_POINTS,
            converged_hold_s: CONVERGED_HOLD_S,
            scores: self.scores,
            totals: self.totals(),
        };
        let mut out = io::stdout().lock();
        serde_json::to_writer_pretty(&mut out, &document)?;
        writeln!(out)
    }

    /// Prints tables on standard output.
    pub(super) fn table(&self) -> io::Result<()> {
        let mut out = io::stdout().lock();
        let settings = self.settings;
        writeln!(out, "cell model {}", settings.monitor.model.name)?;
        if self.scores.iter().any(|score| score.soc.is_some()) {
            let (truth_ah, settle_s, hold_min) =
                (settings.truth_capacity_ah, settings.settle_s, CONVERGED_HOLD_S / 60.0);
            writeln!(
                out,
                "\nSOC in points of {truth_ah} Ah, after {settle_s:.0} s; converged = within {CONVERGED_POINTS} points for {hold_min:.0} min"
            )?;
            write_table(&mut out, &self.soc_rows(), 2)?;
        }
        if self.scores.iter().any(|score| score.life.is_some()) {
            writeln!(out, "\nusable capacity after {} discharges", settings.skip_cycles)?;
            write_table(&mut out, &self.life_rows(), 2)?;
        }
        self.notes(&mut out)
    }

    fn totals(&self) -> Vec<Total<'_>> {
        self.cases
            .iter()
            .map(|case| Total::new(*case, self.scores.iter().filter(|s| s.case == *case).collect()))
            .collect()
    }

    fn soc_rows(&self) -> Vec<Vec<String>> {
        let heads = ["file", "case", "RMSE", "mean", "max", "converged", "in 95 %", "+/-", "NIS", "resets", "samples"];
        let mut rows = vec![heads.map(str::to_owned).to_vec()];
        let scored = self.scores.iter().filter_map(|score| Some((score, score.soc.as_ref()?)));
        rows.extend(scored.map(|(score, soc)| soc_row(score, soc)));
        for total in self.totals().iter().filter(|total| total.files > 1) {
            let Some(soc) = &total.soc else { continue };
            let case = describe(&total.case);
            rows.push(vec![
                "mean of files".into(),
                case.clone(),
                two(soc.mean_rmse_points),
                String::new(),
                String::new(),
                String::new(),
                percent(soc.mean_coverage),
                two(soc.mean_half_width_points),
            ]);
            rows.push(vec![
                format!("worst: {}", soc.worst_file),
                case,
                two(soc.worst_rmse_points),
                String::new(),
                String::new(),
                String::new(),
                percent(soc.least_coverage),
            ]);
        }
        rows
    }

    fn life_rows(&self) -> Vec<Vec<String>> {
        let below = format!("below {} Ah", self.settings.threshold_ah);
        let heads = [
            "file",
            "case",
            "mean |error|",
            "mean",
            "max",
            "in 95 %",
            "+/-",
            &below,
            "truth",
            "capacity",
            "resistance",
            "resets",
        ];
        let mut rows = vec![heads.map(str::to_owned).to_vec()];
        let scored = self.scores.iter().filter_map(|score| Some((score, score.life.as_ref()?)));
        rows.extend(scored.map(|(score, life)| life_row(score, life)));
        rows
    }

    /// Prints which values were not fed or not scored.
    fn notes(&self, out: &mut impl Write) -> io::Result<()> {
        for score in self.scores {
            let (name, case) = (&score.name, describe(&score.case));
            let left_out = score.soc.as_ref().map_or(0, |soc| soc.left_out_rows);
            if left_out > 0 {
                writeln!(out, "{name}, {case}: {left_out} of {} rows left out (no truth or no estimate)", score.rows)?;
            }
            if score.uncarried_values > 0 {
                writeln!(out, "{name}, {case}: {} values that no frame can carry", score.uncarried_values)?;
            }
            if let Some(life) = score.life.as_ref().filter(|life| life.left_out > 0) {
                let (left_out, all) = (life.left_out, life.discharges);
                writeln!(
                    out,
                    "{name}, {case}: {left_out} of {all} discharges left out (no estimate or no published capacity)"
                )?;
            }
        }
        let plots = self.scores.iter().filter(|score| score.plot.is_some()).count();
        if let (1.., Some(folder)) = (plots, &self.settings.plots) {
            let noun = if plots == 1 { "plot" } else { "plots" };
            writeln!(out, "{plots} {noun} in {}", folder.display())?;
        }
        Ok(())
    }
}

impl<'a> Total<'a> {
    fn new(case: Case, scores: Vec<&'a CaseScore>) -> Self {
        Self { case, files: scores.len(), soc: SocTotal::new(&scores), life: LifeTotal::new(&scores) }
    }
}

impl<'a> SocTotal<'a> {
    fn new(scores: &[&'a CaseScore]) -> Option<Self> {
        let all: Vec<(&str, &SocScore)> = scores
            .iter()
            .filter_map(|score| Some((score.name.as_str(), score.soc.as_ref()?)))
            .filter(|(_, soc)| soc.samples > 0)
            .collect();
        let (worst_file, worst) = all.iter().max_by(|a, b| a.1.rmse_points.total_cmp(&b.1.rmse_points))?;
        Some(Self {
            mean_rmse_points: mean(&all, |soc| soc.rmse_points),
            worst_rmse_points: worst.rmse_points,
            worst_file,
            mean_coverage: mean(&all, |soc| soc.coverage),
            least_coverage: all.iter().map(|(_, soc)| soc.coverage).fold(f64::INFINITY, f64::min),
            mean_half_width_points: mean(&all, |soc| soc.mean_half_width_points),
        })
    }
}

impl<'a> LifeTotal<'a> {
    fn new(scores: &[&'a CaseScore]) -> Option<Self> {
        let all: Vec<(&str, &LifeScore)> = scores
            .iter()
            .filter_map(|score| Some((score.name.as_str(), score.life.as_ref()?)))
            .filter(|(_, life)| life.scored > 0)
            .collect();
        let (worst_file, worst) = all.iter().max_by(|a, b| a.1.mean_abs_error_ah.total_cmp(&b.1.mean_abs_error_ah))?;
        Some(Self {
            mean_abs_error_ah: mean(&all, |life| life.mean_abs_error_ah),
            worst_mean_abs_error_ah: worst.mean_abs_error_ah,
            worst_file,
            least_coverage: all.iter().map(|(_, life)| life.coverage).fold(f64::INFINITY, f64::min),
        })
    }
}

fn mean<T>(all: &[(&str, &T)], value: impl Fn(&T) -> f64) -> f64 {
    all.iter().map(|(_, score)| value(score)).sum::<f64>() / all.len() as f64
}

fn describe(case: &Case) -> String {
    let mut words = vec![match case.start {
        Start::Full => "full".to_owned(),
        Start::Middle => "middle".to_owned(),
    }];
    words.extend(case.soc_error_points.map(|points| format!("told {points:+}")));
    words.extend((case.capacity_error_percent != 0.0).then(|| format!("C {:+} %", case.capacity_error_percent)));
    words.extend((case.current_offset_a != 0.0).then(|| format!("I {:+} A", case.current_offset_a)));
    words.extend(case.seed.map(|seed| format!("windows {seed}")));
    words.join(" ")
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
    let milli = |ah: f64| if ah.is_finite() { format!("{:.1} mAh", 1000.0 * ah) } else { "-".to_owned() };
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

fn two(value: f64) -> String {
    if value.is_finite() { format!("{value:.2}") } else { "-".to_owned() }
}

fn four(value: f64) -> String {
    if value.is_finite() { format!("{value:.4}") } else { "-".to_owned() }
}

fn signed(value: f64) -> String {
    if value.is_finite() { format!("{value:+.2}") } else { "-".to_owned() }
}

fn percent(value: f64) -> String {
    if value.is_finite() { format!("{:.1} %", 100.0 * value) } else { "-".to_owned() }
}

/// Columns as wide as their widest entry: the first `left` to the left, numbers to the right.
pub(crate) fn write_table(out: &mut impl Write, rows: &[Vec<String>], left: usize) -> io::Result<()> {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let entry = |row: &[String], column: usize| row.get(column).cloned().unwrap_or_default();
    let widths: Vec<usize> =
        (0..columns).map(|c| rows.iter().map(|row| entry(row, c).chars().count()).max().unwrap_or(0)).collect();
    for row in rows {
        let cells = widths.iter().enumerate().map(|(column, &width)| {
            let text = entry(row, column);
            if column < left { format!("{text:<width$}") } else { format!("{text:>width$}") }
        });
        writeln!(out, "{}", cells.collect::<Vec<_>>().join("  ").trim_end())?;
    }
    Ok(())
}
