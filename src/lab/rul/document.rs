//! Writes forecasts of remaining useful life as one JSON document that ends in a line feed.

use serde::Serialize;

use super::{CurrentForecast, HistoryScore, ScoreTotal, total};
use crate::error::LabError;

const VERSION: u32 = 1;
/// Quantiles of the interval.
const INTERVAL: [f64; 2] = [0.05, 0.95];

#[derive(Serialize)]
struct NowDocument<'a> {
    version: u32,
    interval: [f64; 2],
    forecasts: &'a [CurrentForecast],
}

#[derive(Serialize)]
struct ScoredDocument<'a> {
    version: u32,
    interval: [f64; 2],
    alpha: f64,
    files: &'a [HistoryScore],
    total: Option<ScoreTotal>,
}

/// Returns the JSON document of the forecasts at the end of the histories.
///
/// # Errors
/// Never: every value can be written as JSON.
pub fn now_json(forecasts: &[CurrentForecast]) -> Result<String, LabError> {
    pretty(&NowDocument { version: VERSION, interval: INTERVAL, forecasts })
}

/// Returns the JSON document of the scored forecasts.
///
/// # Errors
/// Never: every value can be written as JSON.
pub fn scored_json(files: &[HistoryScore], alpha: f64) -> Result<String, LabError> {
    pretty(&ScoredDocument { version: VERSION, interval: INTERVAL, alpha, files, total: total(files) })
}

fn pretty(document: &impl Serialize) -> Result<String, LabError> {
    Ok(serde_json::to_string_pretty(document)? + "\n")
}
