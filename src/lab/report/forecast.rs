//! The one place where a forecast of the remaining life comes into the report.
//!
//! Until there is a forecast in the core, every life is "unknown", and says so.

use super::data::Data;

/// Capacity to come, at a moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct FanPoint {
    pub(super) time_s: f64,
    /// 5 %, 50 % and 95 % quantile, Ah.
    pub(super) low_ah: f64,
    pub(super) median_ah: f64,
    pub(super) high_ah: f64,
}

/// What is to come.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Outlook {
    /// For the capacity chart.
    pub(super) fan: Vec<FanPoint>,
    /// In words, with its interval.
    pub(super) words: String,
}

/// The outlook of the weakest cell, or why there is none.
pub(super) fn outlook(_data: &Data, _threshold_ah: Option<f64>) -> Result<Outlook, String> {
    Err("this version makes no forecast".to_owned())
}
