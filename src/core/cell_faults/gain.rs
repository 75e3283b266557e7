//! Detects that the gain of the current sensor, which all cells share, has risen.
//!
//! In: once per day, the learned capacity and resistance of all cells. Out: the rise of the gain.
//!
//! If the sensor begins to show `g` times the true current, every learned resistance changes by the factor `1/g` at
//! once. Every learned capacity changes by the factor `g` as new half-cycles (charges and discharges) are measured. In
//! a real battery, the capacity never rises while the resistance falls. A falling gain looks like ageing and is not
//! reported.

use serde::{Deserialize, Serialize};

use super::fault::{GAIN, REPORTED};
use crate::filter::{ScalarGaussian, median, normal_cdf};
use crate::quantity::{DAY_S, InvalidState, Timestamp};

/// Maximum number of days that are compared with each other. Changes that take longer are caused by the seasons or by
/// ageing.
const DAYS: usize = 10;
/// Time within which the resistances must fall (s). The estimated resistances follow within hours, so the fall may
/// spread over two consecutive daily checks.
const APART_S: f64 = 2.5 * DAY_S;
/// Standard deviation of changes within `DAYS` days that have other causes than the gain, fraction.
const ERROR: f64 = 0.005;
/// Maximum relative standard deviation of the capacities (median of the cells). A day with a larger value is not
/// compared, because capacities that are still being learned change too much.
const KNOWN: f64 = 0.03;

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Day {
    time: Timestamp,
    /// Logarithm of the capacity in Ah.
    log_capacity: f64,
    /// Logarithm of the resistance ratio (cell to model).
    log_resistance: f64,
    temperature_c: f64,
}

/// Learned capacity and resistance of one cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellAgeing {
    /// Capacity (Ah).
    pub capacity_ah: ScalarGaussian,
    /// Logarithm of the resistance ratio (cell to model).
    pub log_resistance: f64,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Gain {
    last: Option<Timestamp>,
    days: Vec<Day>,
}

impl Gain {
    pub(super) fn is_due(&self, now: Timestamp) -> bool {
        self.last.is_none_or(|last| !(0.0..DAY_S).contains(&now.since(last)))
    }

    /// Adds the values of a day. Returns the probability that the gain has risen by more than [`GAIN`], and the rise
    /// (fraction). While a rise is reported, the days before the rise are kept for comparison.
    pub(super) fn take(&mut self, time: Timestamp, temperature_c: f64, cells: &[CellAgeing]) -> (f64, ScalarGaussian) {
        let none = (0.0, ScalarGaussian { mean: 0.0, variance: ERROR * ERROR });
        let part = |cell: &CellAgeing| cell.capacity_ah.std() / cell.capacity_ah.mean;
        let is_known = median(cells.iter().map(part)).is_some_and(|part| part <= KNOWN);
        let now = Day {
            time,
            log_capacity: median(cells.iter().map(|cell| libm::log(cell.capacity_ah.mean))).unwrap_or(f64::NAN),
            log_resistance: median(cells.iter().map(|cell| cell.log_resistance)).unwrap_or(f64::NAN),
            temperature_c,
        };
        let is_possible = [now.log_capacity, now.log_resistance, temperature_c].iter().all(|it| it.is_finite());
        let is_later = self.last.replace(time).is_none_or(|last| time.since(last) >= 0.0);
        if !is_known || !is_possible || !is_later {
            self.days.clear();
            return none;
        }
        self.days.push(now);
        let pairs = self
            .days
            .iter()
            .enumerate()
            .flat_map(|(i, before)| self.days[i + 1..].iter().map(move |after| (before, after)));
        let rises = pairs.filter_map(|(before, after)| rise(before, after, &now));
        let size = ScalarGaussian { mean: rises.fold(0.0, f64::max), ..none.1 };
        let probability = normal_cdf((size.mean - GAIN) / ERROR);
        if probability >= REPORTED {
            self.days.pop();
        } else if self.days.len() > DAYS {
            self.days.remove(0);
        }
        (probability, size)
    }

    pub(super) fn rebase(&mut self, by_nanos: i64) {
        let stamps = self.days.iter_mut().map(|day| &mut day.time).chain(&mut self.last);
        stamps.for_each(|stamp| *stamp = stamp.plus_nanos(by_nanos));
    }

    pub(super) fn check(&self) -> Result<(), InvalidState> {
        let numbers = self.days.iter().flat_map(|day| [day.log_capacity, day.log_resistance, day.temperature_c]);
        InvalidState::unless_numbers("a day of the current's gain", numbers)?;
        let count = self.days.len();
        InvalidState::unless(count <= DAYS, "the days of the current's gain", count as f64, "10 at most")
    }
}

/// Rise of the gain between two days, fraction, if the rise still exists at `now`. The rise is the smaller of two
/// values: the fall of the resistance and the rise of the capacity. `None` if the days cannot be compared.
fn rise(before: &Day, after: &Day, now: &Day) -> Option<f64> {
    let is_near = |day: &Day| (day.temperature_c - before.temperature_c).abs() <= 5.0;
    let is_next = after.time.since(before.time) <= APART_S;
    let fell = before.log_resistance - after.log_resistance.max(now.log_resistance);
    (is_next && is_near(after) && is_near(now)).then(|| fell.min(now.log_capacity - before.log_capacity))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Probability and size after each day. `gains`: the gain on each day. Each day, the learned capacity moves by a
    /// third of its distance from the new value.
    fn after_days(gains: &[f64], temperatures_c: impl Fn(usize) -> f64) -> Vec<(f64, f64)> {
        let (mut watch, mut capacity_ah) = (Gain::default(), 60.0);
        gains
            .iter()
            .enumerate()
            .map(|(day, gain)| {
                let time = Timestamp::from_secs(day as f64 * DAY_S + 60.0 * (day % 2) as f64);
                capacity_ah += (60.0 * gain - capacity_ah) / 3.0;
                let capacity_ah = ScalarGaussian::from_std(capacity_ah, 1.0);
                let cell = CellAgeing { capacity_ah, log_resistance: 0.1 - libm::log(*gain) };
                let (probability, size) = watch.take(time, temperatures_c(day), &[cell; 5]);
                (probability, size.mean)
            })
            .collect()
    }

    #[test]
    fn risen_gain_is_reported_until_it_falls() {
        let gains: Vec<f64> = (0..60).map(|day| if (8..45).contains(&day) { 1.05 } else { 1.0 }).collect();
        let found = after_days(&gains, |_| 25.0);
        let since = found.iter().position(|(probability, _)| *probability >= REPORTED);
        assert!(since.is_some_and(|day| (9..14).contains(&day)), "{found:?}");
        assert!(found[14..45].iter().all(|(probability, _)| *probability >= REPORTED), "{found:?}");
        assert!((found[44].1 - 0.05).abs() < 0.005 && found[50].0 < 0.5, "{found:?}");
    }

    #[test]
    fn fall_of_resistance_in_two_steps_is_found() {
        let gains: Vec<f64> = [1.0; 6].into_iter().chain([1.015]).chain([1.05; 10]).collect();
        let found = after_days(&gains, |_| 25.0);
        assert!(found.last().is_some_and(|(probability, _)| *probability >= REPORTED), "{found:?}");
    }

    #[test]
    fn ageing_seasons_and_learning_are_not_a_gain() {
        let falls: Vec<f64> = (0..40).map(|day| if day < 8 { 1.0 } else { 0.9 }).collect();
        assert!(after_days(&falls, |_| 25.0).iter().all(|(probability, _)| *probability < 0.01));
        let slowly: Vec<f64> = (0..60).map(|day| 1.0 + 0.003 * f64::from(day)).collect();
        assert!(after_days(&slowly, |_| 25.0).iter().all(|(probability, _)| *probability < 0.01));
        let rises: Vec<f64> = (0..40).map(|day| if day < 8 { 1.0 } else { 1.05 }).collect();
        let warmer = |day: usize| if day < 8 { 10.0 } else { 20.0 };
        assert!(after_days(&rises, warmer).iter().all(|(probability, _)| *probability < 0.01));
        let mut watch = Gain::default();
        for (day, capacity_ah) in [(0, 60.0), (1, 66.0), (2, 66.0)] {
            let cell = CellAgeing {
                capacity_ah: ScalarGaussian::from_std(capacity_ah, 3.0),
                log_resistance: -0.1 * f64::from(day),
            };
            let (probability, _) = watch.take(Timestamp::from_secs(f64::from(day) * DAY_S), 25.0, &[cell; 3]);
            assert!(probability < 0.01);
        }
    }

    #[test]
    fn impossible_numbers_leave_a_valid_state() {
        let mut watch = Gain::default();
        for (day, number) in [f64::NAN, f64::INFINITY, 0.0, -1.0, 1e300, 60.0].into_iter().enumerate() {
            let cell = CellAgeing { capacity_ah: ScalarGaussian::from_std(number, 0.001), log_resistance: number };
            watch.take(Timestamp::from_secs(-(day as f64) * 1e6), number, &[cell; 3]);
            assert_eq!(watch.check(), Ok(()), "{number}");
        }
        assert!(watch.take(Timestamp::ZERO, 25.0, &[]).0 < 0.5);
    }
}
