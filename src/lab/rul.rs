//! Forecasts the remaining useful life from measured capacity histories, at the end of a history or at earlier points.
//! Earlier forecasts are scored against the truth.
//!
//! Forecasts are made by the filter of the monitor ([`crate::health::forecast`]), which receives only the readings up
//! to the time of the forecast.
//!
//! *Use* is the number of discharges since the first reading, or the number of days if the file lists no discharges.
//! The capacities are fitted by the non-increasing curve with the least squared error (isotonic fit). The *end of life*
//! is the use at which this curve falls below the threshold, interpolated between readings. A temporary recovery after
//! a rest therefore hardly moves the end of life.

mod baseline;
mod document;
mod history;
mod truth;

use std::str::FromStr;

use serde::Serialize;

use crate::health::{Axis, CapacityReading, Forecast, InsufficientData, RemainingLife, Usage};

pub use document::{now_json, scored_json};
pub use history::{History, MeasuredCapacity};
pub use truth::end_of_life;

/// Upper limit of an error, as a share of the life. Without this limit, a baseline forecast (straight line or double
/// exponential) that never reaches the end of life would dominate the mean.
pub const WORST_ERROR: f64 = 1.0;

/// The capacity at which a life ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Threshold {
    /// Capacity (Ah).
    AmpereHours(f64),
    /// Share of the capacity in the first reading of the history.
    OfFirst(f64),
}

/// A forecast made after a share of the life, and its errors.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ForecastScore {
    /// Share of the life that has passed at the time of the forecast.
    pub at: f64,
    /// Number of readings up to the forecast.
    pub readings: usize,
    /// True remaining life, units of use.
    pub truth: f64,
    /// Forecast quantiles 5, 50 and 95 %, units of use; `None` = no forecast.
    pub forecast: Option<[f64; 3]>,
    /// Reason for a missing forecast.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
    /// Whether the relative error of the median is at most alpha (an argument of [`score`]).
    pub within_alpha: bool,
    /// Whether the interval contains the truth.
    pub covered: bool,
    /// |median - truth| as a share of the life, at most [`WORST_ERROR`]. A missing forecast has this maximum.
    pub error: f64,
    /// Remaining life from a straight line through the last points; `None` = it never reaches the threshold.
    pub straight: Option<f64>,
    /// Error of the straight line, computed like `error`.
    pub straight_error: f64,
    /// Remaining life from a double exponential fitted by least squares; `None` = it never reaches the threshold.
    pub double_exponential: Option<f64>,
    /// Error of the double exponential, computed like `error`.
    pub double_exponential_error: f64,
}

/// All scored forecasts of one file.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HistoryScore {
    /// Name of the file.
    pub name: String,
    /// Unit of use.
    pub axis: Axis,
    /// Capacity at which the life ends (Ah).
    pub threshold_ah: f64,
    /// Use at the end of life. `None` = it is not reached or was passed before the first reading, so nothing is scored.
    pub end_of_life: Option<f64>,
    /// Smallest capacity of the file (Ah).
    pub least_capacity_ah: f64,
    /// Scores in the order of the requested shares of the life.
    pub judged: Vec<ForecastScore>,
}

/// Totals over all forecasts of all files.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ScoreTotal {
    /// Number of requested forecasts.
    pub forecasts: usize,
    /// Number of missing forecasts.
    pub refused: usize,
    /// Share of forecasts whose interval contains the truth. A missing forecast counts as a miss.
    pub coverage: f64,
    /// Share of forecasts whose median has a relative error of at most alpha. A missing forecast counts as a miss.
    pub within_alpha: f64,
    /// Mean error, as a share of the life.
    pub mean_error: f64,
    /// Mean error of the straight line.
    pub straight_mean_error: f64,
    /// Mean error of the double exponential.
    pub double_exponential_mean_error: f64,
}

/// The forecast at the end of a history.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CurrentForecast {
    /// Name of the file.
    pub name: String,
    /// Unit of use.
    pub axis: Axis,
    /// Capacity at which the life ends (Ah).
    pub threshold_ah: f64,
    /// Number of readings.
    pub readings: usize,
    /// Use at the last reading.
    pub used: f64,
    /// Capacity without the recovery during rests (Ah): mean and standard deviation.
    pub level_ah: (f64, f64),
    /// Capacity loss per unit of use (Ah): mean and standard deviation.
    pub rate_ah: (f64, f64),
    /// Remaining life; `None` = no forecast.
    pub remaining: Option<RemainingLife>,
    /// Why there is no forecast.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
}

impl FromStr for Threshold {
    type Err = String;

    /// Parses `1.4`, `1.4 Ah` or `70 %`.
    fn from_str(text: &str) -> Result<Self, String> {
        let expected = "must be Ah above 0 like 1.4, or percent of the first capacity, above 0 and below 100, like 70%";
        let above_0 = |text: &str| text.trim().parse::<f64>().ok().filter(|value| value.is_finite() && *value > 0.0);
        let found = match text.trim().strip_suffix('%') {
            Some(percent) => {
                above_0(percent).filter(|percent| *percent < 100.0).map(|percent| Self::OfFirst(percent / 100.0))
            }
            None => above_0(text.trim().trim_end_matches("Ah")).map(Self::AmpereHours),
        };
        found.ok_or_else(|| expected.to_owned())
    }
}

impl Threshold {
    /// Converts the threshold to Ah for this history.
    pub fn ampere_hours(self, history: &History) -> f64 {
        match self {
            Self::AmpereHours(ah) => ah,
            Self::OfFirst(part) => part * history.first_capacity_ah(),
        }
    }
}

/// Makes the forecast at the end of the history.
pub fn now(history: &History, name: &str, threshold: Threshold) -> CurrentForecast {
    let forecast = forecast_until(history, f64::INFINITY);
    let threshold_ah = threshold.ampere_hours(history);
    let remaining = forecast.remaining(threshold_ah);
    CurrentForecast {
        name: name.to_owned(),
        axis: history.axis,
        threshold_ah,
        readings: history.rows.len(),
        used: history.rows.last().map_or(0.0, |row| row.used),
        level_ah: forecast.level_ah(),
        rate_ah: forecast.rate_ah(),
        refused: remaining.as_ref().err().map(InsufficientData::to_string),
        remaining: remaining.ok(),
    }
}

/// Makes forecasts after these shares of the life and scores them. `progress` is called before each forecast and may
/// unwind to abort.
pub fn score(
    history: &History,
    name: &str,
    threshold: Threshold,
    at: &[f64],
    alpha: f64,
    progress: &dyn Fn(),
) -> HistoryScore {
    let threshold_ah = threshold.ampere_hours(history);
    let end_of_life = end_of_life(history, threshold_ah);
    let judge_at = |end: f64, at: f64| {
        progress();
        judge(history, threshold_ah, end, at, alpha)
    };
    let judge = |end: f64| at.iter().map(|&at| judge_at(end, at)).collect();
    HistoryScore {
        name: name.to_owned(),
        axis: history.axis,
        threshold_ah,
        end_of_life,
        least_capacity_ah: history.rows.iter().map(|row| row.capacity_ah).fold(f64::INFINITY, f64::min),
        judged: end_of_life.map_or_else(Vec::new, judge),
    }
}

/// Returns the totals; `None` = no forecast was scored.
pub fn total(scored: &[HistoryScore]) -> Option<ScoreTotal> {
    let judged: Vec<&ForecastScore> = scored.iter().flat_map(|file| &file.judged).collect();
    let mean = |of: &dyn Fn(&ForecastScore) -> f64| judged.iter().map(|one| of(one)).sum::<f64>() / judged.len() as f64;
    let part = |is: bool| if is { 1.0 } else { 0.0 };
    (!judged.is_empty()).then(|| ScoreTotal {
        forecasts: judged.len(),
        refused: judged.iter().filter(|one| one.forecast.is_none()).count(),
        coverage: mean(&|one| part(one.covered)),
        within_alpha: mean(&|one| part(one.within_alpha)),
        mean_error: mean(&|one| one.error),
        straight_mean_error: mean(&|one| one.straight_error),
        double_exponential_mean_error: mean(&|one| one.double_exponential_error),
    })
}

fn judge(history: &History, threshold_ah: f64, end: f64, at: f64, alpha: f64) -> ForecastScore {
    let moment = at * end;
    let truth = end - moment;
    let known: Vec<[f64; 2]> =
        history.rows.iter().take_while(|row| row.used <= moment).map(|row| [row.used, row.capacity_ah]).collect();
    let result = forecast_until(history, moment).remaining(threshold_ah).map(|life| quantiles(history.axis, &life));
    let (forecast, refused) = match result {
        Ok(forecast) => (forecast, None),
        Err(why) => (None, Some(why.to_string())),
    };
    // Remaining use from the time of the forecast; 0 if the baseline is already below the threshold.
    let ahead = |crossing: Option<f64>| crossing.map(|used| (used - moment).max(0.0));
    let straight = ahead(baseline::straight(&known, threshold_ah));
    let double_exponential = ahead(baseline::double_exponential(&known, threshold_ah));
    let error = |forecast: Option<f64>| {
        forecast.map_or(WORST_ERROR, |forecast| ((forecast - truth).abs() / end).min(WORST_ERROR))
    };
    ForecastScore {
        at,
        readings: known.len(),
        truth,
        within_alpha: forecast.is_some_and(|[_, median, _]| (median - truth).abs() <= alpha * truth),
        covered: forecast.is_some_and(|[low, _, high]| low <= truth && truth <= high),
        error: error(forecast.map(|[_, median, _]| median)),
        straight,
        straight_error: error(straight),
        double_exponential,
        double_exponential_error: error(double_exponential),
        forecast,
        refused,
    }
}

fn quantiles(axis: Axis, life: &RemainingLife) -> Option<[f64; 3]> {
    let remaining = if axis == Axis::Cycles { life.cycles } else { life.days };
    remaining.map(|remaining| [remaining.low, remaining.median, remaining.high])
}

fn forecast_until(history: &History, moment: f64) -> Forecast {
    let mut forecast = Forecast::new(history.axis, history.first_capacity_ah());
    let mut before = MeasuredCapacity::default();
    for row in &history.rows {
        let passed = row.since(&before);
        if row.used > moment {
            // Add the use until the forecast, but not the capacity of the next reading.
            let part = (moment - before.used) / (row.used - before.used);
            let (cycles, days, rest_days) = (part * passed.cycles, part * passed.days, part * passed.rest_days);
            forecast.update(Usage { cycles, days, rest_days }, None);
            break;
        }
        let reading = CapacityReading { capacity_ah: row.capacity_ah, variance_ah2: 0.0, shared_variance_ah2: 0.0 };
        forecast.update(passed, Some(reading));
        before = *row;
    }
    forecast
}
