//! Remaining useful life of measured capacity histories: the forecast now, and forecasts made at parts of the life
//! against what came of it.
//!
//! The forecast is the one on board ([`crate::health::forecast`]), fed reading by reading; nothing of what comes after
//! the moment of a forecast is looked at.
//!
//! Words: *use* is what the axis counts from the first reading on (discharges where the file tells them, else days). The
//! *end of life* is where the non-increasing line of least squares through all capacities passes the threshold for good,
//! between the readings on both sides in proportion: capacity that comes back after a rest and goes again neither delays
//! nor hastens it.

mod baseline;
mod history;
mod truth;

use std::path::Path;

use serde::Serialize;

use crate::health::{Axis, CapacityReading, Forecast, InsufficientData, RemainingLife, Usage};

pub use history::{History, HistoryError, Row};
pub use truth::end_of_life;

/// An error larger than this part of the life counts as this: one baseline that never ends must not decide a mean.
pub const WORST_ERROR: f64 = 1.0;

/// The capacity at which a cell is at its end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Threshold {
    /// Ah.
    AmpereHours(f64),
    /// Part of the history's first reading.
    OfFirst(f64),
}

/// What was said at a part of the life, and what came of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Judged {
    /// Part of the life gone.
    pub at: f64,
    /// Readings until then.
    pub readings: usize,
    /// What remained, units of use.
    pub truth: f64,
    /// 5, 50 and 95 % of what was forecast, units of use; `None` = refused.
    pub forecast: Option<[f64; 3]>,
    /// Why it was refused.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
    /// Whether the median is within alpha of the truth.
    pub within_alpha: bool,
    /// Whether the truth is in the interval.
    pub covered: bool,
    /// |median - truth| as a part of the life, [`WORST_ERROR`] at most; that when refused.
    pub error: f64,
    /// What a straight line through the last points says; `None` = it never gets there.
    pub straight: Option<f64>,
    /// Its error, as `error`.
    pub straight_error: f64,
    /// What a double exponential by least squares says; `None` = it never gets there.
    pub double_exponential: Option<f64>,
    /// Its error, as `error`.
    pub double_exponential_error: f64,
}

/// A file's forecasts.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Scored {
    /// Of the file.
    pub name: String,
    /// What counts as use.
    pub axis: Axis,
    /// Ah.
    pub threshold_ah: f64,
    /// Use at the end of life; `None` = not reached, so nothing is judged.
    pub end_of_life: Option<f64>,
    /// Least capacity of the file, Ah.
    pub least_capacity_ah: f64,
    /// In order of the parts asked for.
    pub judged: Vec<Judged>,
}

/// Over all forecasts of all files.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Total {
    /// Forecasts asked for.
    pub forecasts: usize,
    /// Of these, refused.
    pub refused: usize,
    /// Part whose interval holds the truth; a refused one does not.
    pub coverage: f64,
    /// Part whose median is within alpha of the truth; a refused one is not.
    pub within_alpha: f64,
    /// Mean error, part of the life.
    pub mean_error: f64,
    /// The same of the straight line.
    pub straight_mean_error: f64,
    /// The same of the double exponential.
    pub double_exponential_mean_error: f64,
}

/// The forecast at a history's end.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Now {
    /// Of the file.
    pub name: String,
    /// What counts as use.
    pub axis: Axis,
    /// Ah.
    pub threshold_ah: f64,
    /// Readings.
    pub readings: usize,
    /// Use at the last one.
    pub used: f64,
    /// Capacity without what rest has brought back, mean and standard deviation, Ah.
    pub level_ah: (f64, f64),
    /// Loss per unit of use, mean and standard deviation, Ah.
    pub rate_ah: (f64, f64),
    /// What remains; `None` = refused.
    pub remaining: Option<RemainingLife>,
    /// Why it was refused.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
}

impl Threshold {
    /// In Ah for this history.
    pub fn ampere_hours(self, history: &History) -> f64 {
        match self {
            Self::AmpereHours(ah) => ah,
            Self::OfFirst(part) => part * history.first_capacity_ah(),
        }
    }
}

/// Reads a history.
///
/// # Errors
/// It cannot be read or a field is wrong, with file, line, column, what was found and what is allowed.
pub fn read(path: &Path) -> Result<History, HistoryError> {
    History::read(path)
}

/// The forecast at the end of the history.
pub fn now(history: &History, name: &str, threshold: Threshold) -> Now {
    let forecast = fed(history, f64::INFINITY);
    let threshold_ah = threshold.ampere_hours(history);
    let remaining = forecast.remaining(threshold_ah);
    Now {
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

/// Forecasts at these parts of the life, judged.
pub fn score(history: &History, name: &str, threshold: Threshold, at: &[f64], alpha: f64) -> Scored {
    let threshold_ah = threshold.ampere_hours(history);
    let end_of_life = end_of_life(history, threshold_ah);
    let judge = |end: f64| at.iter().map(|&at| judge(history, threshold_ah, end, at, alpha)).collect();
    Scored {
        name: name.to_owned(),
        axis: history.axis,
        threshold_ah,
        end_of_life,
        least_capacity_ah: history.rows.iter().map(|row| row.capacity_ah).fold(f64::INFINITY, f64::min),
        judged: end_of_life.map_or_else(Vec::new, judge),
    }
}

/// Over all of them; `None` = nothing was judged.
pub fn total(scored: &[Scored]) -> Option<Total> {
    let judged: Vec<&Judged> = scored.iter().flat_map(|file| &file.judged).collect();
    let mean = |of: &dyn Fn(&Judged) -> f64| judged.iter().map(|one| of(one)).sum::<f64>() / judged.len() as f64;
    let part = |is: bool| if is { 1.0 } else { 0.0 };
    (!judged.is_empty()).then(|| Total {
        forecasts: judged.len(),
        refused: judged.iter().filter(|one| one.forecast.is_none()).count(),
        coverage: mean(&|one| part(one.covered)),
        within_alpha: mean(&|one| part(one.within_alpha)),
        mean_error: mean(&|one| one.error),
        straight_mean_error: mean(&|one| one.straight_error),
        double_exponential_mean_error: mean(&|one| one.double_exponential_error),
    })
}

/// One forecast, made after `at` of the life.
fn judge(history: &History, threshold_ah: f64, end: f64, at: f64, alpha: f64) -> Judged {
    let moment = at * end;
    let truth = end - moment;
    let known: Vec<[f64; 2]> =
        history.rows.iter().take_while(|row| row.used <= moment).map(|row| [row.used, row.capacity_ah]).collect();
    let told = fed(history, moment).remaining(threshold_ah).map(|life| quantiles(history.axis, &life));
    let (forecast, refused) = match told {
        Ok(forecast) => (forecast, None),
        Err(why) => (None, Some(why.to_string())),
    };
    // From the moment on, like the forecast; a line that has passed already says 0.
    let ahead = |crossing: Option<f64>| crossing.map(|used| (used - moment).max(0.0));
    let straight = ahead(baseline::straight(&known, threshold_ah));
    let double_exponential = ahead(baseline::double_exponential(&known, threshold_ah));
    let error = |said: Option<f64>| said.map_or(WORST_ERROR, |said| ((said - truth).abs() / end).min(WORST_ERROR));
    Judged {
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

/// The filter after everything until `moment`, units of use.
fn fed(history: &History, moment: f64) -> Forecast {
    let mut forecast = Forecast::new(history.axis, history.first_capacity_ah());
    let mut before = Row::default();
    for row in &history.rows {
        let passed = row.since(&before);
        if row.used > moment {
            // Part of the way to the next reading has gone, without a reading.
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
