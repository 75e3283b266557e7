//! Forecasts future rows from past rows, without future inputs.
//!
//! Input: a table in the order of time, with the outputs in its first columns. It may consist of independent parts. A
//! *window* at row t contains, for every column, the value and the last differences ([`ForecastPlan::lags`] values per
//! column). For every output and every horizon h, a separate Gaussian process predicts the change from row t to row t +
//! h (a direct forecast). Errors of one step therefore do not enter the next step, and each horizon has its own noise.
//! If the window contains no information about the change, the forecast is the mean change, which is close to
//! persistence (the value stays constant).
//!
//! The interval is calibrated on forecasts of known rows. The process is fitted to the first training rows and
//! forecasts the block of rows after them. This is repeated for each later block. The ratios |error| / standard
//! deviation determine the local width of the interval ([`spread`]). Leaving out single rows would not work, because
//! windows overlap and the neighbours of a row reveal its value. No row after the origin (the end of the known rows) is
//! used.

mod spread;
mod windows;

use std::path::Path;
use std::time::Instant;

use spread::Spread;

use super::{ColumnTable, interval, write_csv};

use crate::error::LabError;
use crate::regress::{
    GprSettings, Jitter, Model, Prediction, PredictionScore, ProgressCallback, TrainingRows, fit, score,
};

pub use windows::{LagWindows, RowSpacing};

/// Maximum number of values per column in a window.
pub const MAX_LAGS: usize = 200;
/// Maximum number of rows between the origin and a forecast.
pub const MAX_STEPS: usize = 10_000;
/// Maximum number of horizons with a process. Rows between these horizons are not forecast.
pub const MAX_HORIZONS: usize = 10;
/// Boundaries of the blocks for the calibration of the interval, as shares of the training rows.
const BLOCKS: [f64; 5] = [0.4, 0.55, 0.7, 0.85, 1.0];

/// Arguments of a forecast.
#[derive(Debug, Clone)]
pub struct ForecastPlan {
    /// Number of output columns; they are the first columns of the table.
    pub outputs: usize,
    /// Number of values per column in a window, at least 1.
    pub lags: usize,
    /// Largest number of rows ahead, at least 1.
    pub steps: usize,
    /// Share of the rows that is known: above 0, at most 1. The origin is the end of this share.
    pub origin: f64,
    /// Maximum number of windows to which a process is fitted. The windows are spread evenly but not at a fixed
    /// distance, so that repeating cycles are sampled at different points.
    pub rows: usize,
    /// Kernel of the processes, and settings of the search for hyperparameters.
    pub settings: GprSettings,
}

/// Forecasts of all outputs.
#[derive(Debug, Clone)]
pub struct TableForecast {
    /// Number of known rows.
    pub origin: usize,
    /// Last known row that has a window. The forecast at the origin is made from this row.
    pub from: usize,
    /// Forecasts of each output.
    pub outputs: Vec<OutputForecast>,
}

/// Forecasts of one column.
#[derive(Debug, Clone)]
pub struct OutputForecast {
    /// Name of the column.
    pub name: String,
    /// Index of the column in the table.
    pub column: usize,
    /// Forecasts of each horizon, by rising number of rows ahead.
    pub horizons: Vec<HorizonForecast>,
}

/// Forecasts of one column, `steps` rows ahead.
#[derive(Debug, Clone)]
pub struct HorizonForecast {
    /// Number of rows ahead.
    pub steps: usize,
    /// Number of windows to which the process was fitted.
    pub trained: usize,
    /// Number of forecasts on which the interval was calibrated.
    pub calibrated: usize,
    /// Half the width of the interval at average spread, as a multiple of the standard deviation. [`spread`] scales it
    /// for each window.
    pub factor: f64,
    /// Duration of fit and calibration (s).
    pub fit_s: f64,
    /// Jitter that was added to diagonals of matrices.
    pub jitter: Jitter,
    /// The forecast made at the origin.
    pub at_origin: Prediction,
    /// Forecasts after the origin, each with the row from which it was made.
    pub held_out: Vec<(usize, Prediction)>,
    /// Errors of `held_out`; `None` = no measured value is available for comparison.
    pub score: Option<PredictionScore>,
    /// Root mean squared error of persistence (the value stays constant) over the same rows.
    pub persistence_rmse: Option<f64>,
}

/// Returns the horizons that get a process. If there are at most [`MAX_HORIZONS`] steps, every step is a horizon.
/// Otherwise, at most [`MAX_HORIZONS`] horizons are spaced at constant ratios, from the first to the last step.
pub fn horizons(steps: usize) -> Vec<usize> {
    if steps <= MAX_HORIZONS {
        return (1..=steps).collect();
    }
    let last = (MAX_HORIZONS - 1) as f64;
    let mut all: Vec<usize> =
        (0..MAX_HORIZONS).map(|k| (steps as f64).powf(k as f64 / last).round() as usize).collect();
    all.dedup();
    all
}

/// Makes the forecasts. `done` receives the number of finished horizons and the number of all horizons.
///
/// # Errors
/// A number of the plan is out of range, there are too few rows for the lags and steps, or a matrix is not positive
/// definite.
pub fn run(
    table: &ColumnTable,
    plan: &ForecastPlan,
    watcher: &mut ProgressCallback<'_>,
    done: &mut dyn FnMut(usize, usize),
) -> Result<TableForecast, LabError> {
    let windows = LagWindows::new(table, plan.lags);
    let origin = ((table.len() as f64 * plan.origin).round() as usize).clamp(1, table.len().max(1));
    let from = windows.last_before(origin).ok_or_else(|| {
        LabError::Data(format!(
            "lags = {}, must be at most the rows of a part before the origin (row {origin})",
            plan.lags
        ))
    })?;
    let list = horizons(plan.steps);
    let mut outputs = Vec::new();
    for column in 0..plan.outputs {
        let mut start = Vec::new();
        let mut horizons = Vec::new();
        for &steps in &list {
            let task = HorizonTask { plan, windows: &windows, column, steps, origin };
            let (horizon, model) = task.run(&start, from, watcher)?;
            start = model.hyperparameters().into_iter().map(|h| h.value).collect();
            horizons.push(horizon);
            done(column * list.len() + horizons.len(), plan.outputs * list.len());
        }
        outputs.push(OutputForecast { name: table.names[column].clone(), column, horizons });
    }
    Ok(TableForecast { origin, from, outputs })
}

struct HorizonTask<'a> {
    plan: &'a ForecastPlan,
    windows: &'a LagWindows<'a>,
    column: usize,
    steps: usize,
    origin: usize,
}

impl HorizonTask<'_> {
    fn run(
        &self,
        start: &[f64],
        from: usize,
        watcher: &mut ProgressCallback<'_>,
    ) -> Result<(HorizonForecast, Model), LabError> {
        let begin = Instant::now();
        let (model, trained) = self.fitted(self.origin, start, None, watcher)?.ok_or_else(|| {
            let (lags, steps, origin, fewest) = (self.plan.lags, self.steps, self.origin, self.fewest());
            LabError::Data(format!(
                "fewer than {fewest} windows of {lags} lags and {steps} steps before the origin (row {origin}), must be at \
                 least as many: give fewer lags or steps, a later origin or more rows"
            ))
        })?;
        let spread = self.spread(&model, watcher)?;
        let fit_s = begin.elapsed().as_secs_f64();
        let predict = |rows: &[usize]| self.predict(&model, rows, &spread);
        let at_origin = predict(&[from])?.remove(0);
        // At most 5000 windows after the origin are scored.
        let later = chosen(&self.windows.between(self.origin - 1, usize::MAX, self.steps), 5000);
        let held_out: Vec<(usize, Prediction)> = later.iter().copied().zip(predict(&later)?).collect();
        let (score, persistence_rmse) = self.judge(&held_out);
        let horizon = HorizonForecast {
            steps: self.steps,
            trained,
            calibrated: spread.count(),
            factor: spread.factor,
            fit_s,
            jitter: model.outcome.jitter,
            at_origin,
            held_out,
            score,
            persistence_rmse,
        };
        Ok((horizon, model))
    }

    /// Returns the minimum number of training windows, which exceeds the number of features.
    fn fewest(&self) -> usize {
        (self.windows.width() + 2).max(20)
    }

    /// Fits a process to windows whose target rows (`steps` ahead) lie before row `end`. Returns the process and the
    /// number of windows; `None` = there are too few. If `fixed` contains hyperparameters, there is no search.
    fn fitted(
        &self,
        end: usize,
        start: &[f64],
        fixed: Option<&[f64]>,
        watcher: &mut ProgressCallback<'_>,
    ) -> Result<Option<(Model, usize)>, LabError> {
        let known = self.windows.between(0, end, self.steps);
        if known.len() < self.fewest() {
            return Ok(None);
        }
        let rows = chosen(&known, self.plan.rows);
        let inputs = self.windows.features(&rows);
        let targets: Vec<f64> = rows.iter().map(|row| self.windows.change(*row, self.column, self.steps)).collect();
        let mut settings = GprSettings { calibrate: false, ..self.plan.settings.clone() };
        if let Some(fixed) = fixed {
            (settings.start, settings.max_iterations, settings.restarts) = (fixed.to_vec(), 0, 0);
        } else if !start.is_empty() {
            settings.start = start.to_vec();
            // The search starts at the result of the previous horizon, so 20 steps are enough.
            settings.max_iterations = settings.max_iterations.min(20);
            settings.restarts = 0;
        }
        let rows = TrainingRows { inputs: &inputs, dimensions: self.windows.width(), targets: &targets, lines: &[] };
        Ok(Some((fit(&rows, &settings, watcher)?, targets.len())))
    }

    /// Calibrates the interval on blocks. Each block is forecast by a process fitted to the rows before it.
    fn spread(&self, model: &Model, watcher: &mut ProgressCallback<'_>) -> Result<Spread, LabError> {
        let fixed: Vec<f64> = model.hyperparameters().into_iter().map(|h| h.value).collect();
        let at = |part: f64| ((self.origin as f64) * part).round() as usize;
        let (mut judged, mut features, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
        for ends in BLOCKS.windows(2) {
            let (begin, end) = (at(ends[0]).max(1), at(ends[1]));
            // A block may be shorter than the horizon, so the forecast row may lie beyond the block.
            let mut rows = self.windows.between(begin, self.origin, self.steps);
            rows.retain(|row| *row < end);
            // At most 750 windows of a block are used for the calibration.
            let rows = chosen(&rows, 750);
            if rows.is_empty() {
                continue;
            }
            let Some((before, _)) = self.fitted(begin, &[], Some(&fixed), watcher)? else { continue };
            let windows = self.windows.features(&rows);
            let forecasts = before.predict(&windows)?;
            ratios.extend(rows.iter().zip(forecasts).map(|(row, p)| {
                (self.windows.change(*row, self.column, self.steps) - p.mean).abs() / p.measurement_variance.sqrt()
            }));
            judged.extend(rows);
            features.extend(windows);
        }
        Ok(Spread::new(judged, &features, ratios, self.steps + self.plan.lags))
    }

    /// Returns the forecasts of the value (not of its change) from these rows.
    fn predict(&self, model: &Model, rows: &[usize], spread: &Spread) -> Result<Vec<Prediction>, LabError> {
        if rows.is_empty() {
            return Ok(Vec::new());
        }
        let features = self.windows.features(rows);
        let found = model.predict(&features)?;
        let windows = features.chunks_exact(self.windows.width());
        let value = |((row, window), change): ((&usize, &[f64]), Prediction)| {
            let mean = self.windows.value(*row, self.column) + change.mean;
            let half = spread.half_width(window) * change.measurement_variance.sqrt();
            Prediction { mean, low_95: mean - half, high_95: mean + half, ..change }
        };
        Ok(rows.iter().zip(windows).zip(found).map(value).collect())
    }

    fn judge(&self, held_out: &[(usize, Prediction)]) -> (Option<PredictionScore>, Option<f64>) {
        if held_out.is_empty() {
            return (None, None);
        }
        let truth: Vec<f64> =
            held_out.iter().map(|(row, _)| self.windows.value(row + self.steps, self.column)).collect();
        let predictions: Vec<Prediction> = held_out.iter().map(|(_, prediction)| *prediction).collect();
        let squares = held_out.iter().map(|(row, _)| self.windows.change(*row, self.column, self.steps).powi(2));
        let persistence = (squares.sum::<f64>() / held_out.len() as f64).sqrt();
        (Some(score(&predictions, &truth)), Some(persistence))
    }
}

/// Writes every forecast, at the origin and after it, with the measured value if it is known.
///
/// # Errors
/// The file cannot be written.
pub fn write(path: &Path, data: &ColumnTable, forecast: &TableForecast) -> Result<(), LabError> {
    let heads = ["output", "ahead", "file", "line", "origin", "mean", "std", "low_95", "high_95", "measured"];
    let horizons = forecast.outputs.iter().flat_map(|output| output.horizons.iter().map(move |h| (output, h)));
    let rows = horizons.flat_map(|(output, horizon)| {
        let later = horizon.held_out.iter().filter(|(row, _)| *row != forecast.from).copied();
        let forecasts = std::iter::once((forecast.from, horizon.at_origin)).chain(later);
        forecasts.map(move |(row, prediction)| {
            let value = |row: usize| data.row(row)[output.column].to_string();
            let file = data.file_of(row).display().to_string();
            let (ahead, line) = (horizon.steps.to_string(), data.lines[row].to_string());
            let truth = data.after(row, horizon.steps).map(value).unwrap_or_default();
            let own = [output.name.clone(), ahead, file, line, value(row)];
            own.into_iter().chain(interval(&prediction)).chain([truth]).collect()
        })
    });
    write_csv(path, heads.map(str::to_owned).to_vec(), rows)
}

/// Returns at most `most` rows: one row from each of equal sections. The position of the row in its section varies,
/// because a fixed position would always select the same phase of repeating rows.
fn chosen(all: &[usize], most: usize) -> Vec<usize> {
    let count = all.len().min(most);
    // The fractional parts of multiples of the golden ratio fill an interval evenly and never repeat.
    let place = |k: usize| if count == all.len() { 0.0 } else { (k as f64 * 0.618_033_988_749_894_9).fract() };
    let at = |k: usize| ((k as f64 + place(k)) * all.len() as f64 / count as f64) as usize;
    let mut rows: Vec<usize> = (0..count).map(|k| all[at(k).min(all.len() - 1)]).collect();
    // Neighbouring positions can select the same row if a section has fewer than two rows.
    rows.dedup();
    rows
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn horizons_are_all_or_evenly_spread_in_ratio() {
        assert_eq!(horizons(4), [1, 2, 3, 4]);
        let many = horizons(100);
        assert!(many.len() <= MAX_HORIZONS && many[0] == 1 && many.last() == Some(&100), "{many:?}");
        assert!(many.is_sorted_by(|a, b| a < b));
    }

    #[test]
    fn chosen_rows_cover_all_stretches_and_phases() {
        let all: Vec<usize> = (100..10_100).collect();
        let some = chosen(&all, 100);
        assert!(some.len() == 100 && some.is_sorted_by(|a, b| a < b) && some[0] == 100 && some[99] >= 10_000);
        // The phase repeats every hundred rows. Each tenth of the phase is selected about equally often.
        let mut met = [0; 10];
        some.iter().for_each(|row| met[row % 100 / 10] += 1);
        assert!(met.iter().all(|count| (8..=12).contains(count)), "{met:?}");
        assert_eq!((chosen(&all[..7], 7), chosen(&all, 0)), (all[..7].to_vec(), vec![]));
    }
}
