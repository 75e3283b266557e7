//! Finds a current sensor that is frozen: its reading stays the same, bit for bit, while the voltages show a changing load.
//!
//! In: good readings of the current, A, and of the cells' voltages, V. Out: whether the current is frozen; it is until its
//! reading changes.
//!
//! A constant reading alone proves nothing: a parked pack, a charger and a laboratory hold a current for hours, and a coarse
//! sensor shows one value all the while. But then the voltages rest, or drift one way. A changing load moves them to and fro:
//! the median of the cells turns back by more than a [`Reversals::step_v`] again and again. [`MIN_REVERSALS`] of these while at least
//! [`MIN_READINGS`] readings were the same, over at least [`MIN_FROZEN_S`], are not the current's.
//!
//! Limits: a load that never turns back, or moves the voltages by less than the step, is not seen; nor a sensor whose last
//! digits still change (its voltages then contradict the estimate).

use serde::{Deserialize, Serialize};

use crate::quantity::{InvalidState, Timestamp, bounds};

/// Readings of the current that were the same.
const MIN_READINGS: u32 = 20;
/// Time over which they were, s: a constant load of a few seconds is usual.
const MIN_FROZEN_S: f64 = 5.0;
/// Times the voltages turned back: one stop of a vehicle is two, braking, accelerating and cruising. A vehicle that cruises is not
/// judged, nor is its current wrong then.
const MIN_REVERSALS: u32 = 2;
/// Step that is no noise of a voltage, in its standard deviations.
const STEP_SIGMA: f64 = 5.0;
/// Least step, V: less may be a charger's ripple.
const MIN_STEP_V: f64 = 0.01;
/// Cells of which the median is taken: the first ones, as many as separate a glitch from a load.
const MAX_MEDIAN: usize = 15;
/// Without a change of the current for longer than this between two readings the time in between is not judged, s.
const MAX_PAUSE_S: f64 = 5.0;

/// Turning points of a voltage.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Reversals {
    /// Least and greatest voltage since the last turning point, V; `None` = none yet.
    range_v: Option<(f64, f64)>,
    /// The voltage rises since the last turning point, or falls.
    is_rising: Option<bool>,
    /// It has turned in one reading, which the next one has to confirm.
    is_unconfirmed: bool,
    count: u32,
}

impl Reversals {
    /// Takes a voltage.
    fn handle(&mut self, voltage_v: f64, step_v: f64) {
        let Some((low, high)) = self.range_v else {
            self.range_v = Some((voltage_v, voltage_v));
            return;
        };
        let (fell, rose) = (voltage_v <= high - step_v, voltage_v >= low + step_v);
        let turns = match self.is_rising {
            None => fell || rose,
            Some(true) => fell,
            Some(false) => rose,
        };
        if turns && !self.is_unconfirmed {
            self.is_unconfirmed = true;
            return;
        }
        self.is_unconfirmed = false;
        if turns {
            self.count += u32::from(self.is_rising.is_some());
            self.is_rising = Some(rose && !(fell && self.is_rising == Some(true)));
            self.range_v = Some((voltage_v, voltage_v));
        } else {
            self.range_v = Some((low.min(voltage_v), high.max(voltage_v)));
        }
    }
}

/// State of the check; part of the stored state.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct FrozenCheck {
    /// The unchanged reading, since when, the latest, and how many.
    current_a: Option<f64>,
    since: Timestamp,
    latest: Timestamp,
    readings: u32,
    reversals: Reversals,
    /// Voltages of the round at hand, V, at most [`MAX_MEDIAN`]; the first cell begins a round.
    round_v: Vec<f64>,
    /// Median of the round before, V.
    median_v: f64,
    is_frozen: bool,
}

/// Step that a voltage of this noise, V, is not moved by: [`STEP_SIGMA`] standard deviations.
pub(super) fn step_v(noise_v: f64) -> f64 {
    (STEP_SIGMA * noise_v).max(MIN_STEP_V)
}

impl FrozenCheck {
    /// Whether the current is frozen.
    #[inline]
    pub(super) fn is_frozen(&self) -> bool {
        self.is_frozen
    }

    /// Takes a reading of the current; whether it is that of a frozen sensor.
    pub(super) fn handle_current(&mut self, now: Timestamp, current_a: f64) -> bool {
        let is_paused = now.since(self.latest) > MAX_PAUSE_S;
        if self.current_a != Some(current_a) || (is_paused && !self.is_frozen) {
            *self = Self {
                current_a: Some(current_a),
                since: now,
                round_v: std::mem::take(&mut self.round_v),
                ..Self::default()
            };
            self.round_v.clear();
        }
        (self.latest, self.readings) = (now, self.readings.saturating_add(1));
        let is_long = self.readings >= MIN_READINGS && now.since(self.since) >= MIN_FROZEN_S;
        self.is_frozen = self.is_frozen || (is_long && self.reversals.count >= MIN_REVERSALS);
        self.is_frozen
    }

    /// Takes a cell's voltage; `is_first`: of the first cell, which begins a round.
    #[inline]
    pub(super) fn handle_voltage(&mut self, is_first: bool, voltage_v: f64, step_v: f64) {
        if self.readings < 2 || self.is_frozen {
            return;
        }
        if is_first && !self.round_v.is_empty() {
            self.end_round(step_v);
        }
        if self.round_v.len() < MAX_MEDIAN {
            self.round_v.push(voltage_v);
        }
    }

    fn end_round(&mut self, step_v: f64) {
        self.round_v.sort_unstable_by(f64::total_cmp);
        let cells = self.round_v.len();
        // Of two middle cells the one that has moved less: a load moves both.
        let (low, high) = (self.round_v[(cells - 1) / 2], self.round_v[cells / 2]);
        let is_low_nearer = (low - self.median_v).abs() <= (high - self.median_v).abs();
        let median = if is_low_nearer { low } else { high };
        self.median_v = median;
        self.round_v.clear();
        self.reversals.handle(median, step_v);
    }

    /// After a gap of unknown length nothing is known.
    pub(super) fn restart(&mut self) {
        *self = Self::default();
    }

    pub(super) fn rebase(&mut self, by_nanos: i64) {
        (self.since, self.latest) = (self.since.plus_nanos(by_nanos), self.latest.plus_nanos(by_nanos));
    }

    /// Checks a stored state; the error is its first impossible number.
    pub(super) fn check(&self) -> Result<(), InvalidState> {
        let (low, high) = self.reversals.range_v.unwrap_or_default();
        bounds::VOLTAGE_V
            .check_all("a voltage beside a constant current", self.round_v.iter().copied().chain([low, high]))?;
        bounds::CURRENT_A.check_all("a constant current", self.current_a)?;
        let cells = self.round_v.len() as f64;
        InvalidState::unless(
            self.round_v.len() <= MAX_MEDIAN,
            "the cells beside a constant current",
            cells,
            "at most 15",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ten readings a second of a current and of three cells for `seconds`; when it was found frozen, s.
    fn found_s(seconds: u32, current: impl Fn(f64) -> f64, voltage: impl Fn(f64) -> f64) -> Option<f64> {
        let mut check = FrozenCheck::default();
        (0..10 * seconds).map(|k| f64::from(k) / 10.0).find(|&time_s| {
            for cell in 0..3 {
                check.handle_voltage(cell == 0, voltage(time_s) + 0.01 * f64::from(cell), step_v(0.005));
            }
            check.handle_current(Timestamp::from_secs(time_s), current(time_s))
        })
    }

    /// A drive: the load of every few seconds is another one.
    fn load_a(time_s: f64) -> f64 {
        40.0 + 60.0 * libm::sin(0.7 * time_s) * libm::sin(0.11 * time_s)
    }

    #[test]
    fn a_frozen_current_is_found_by_the_voltages_within_a_minute() {
        for frozen_a in [0.0, 12.3] {
            let found = found_s(
                120,
                |time_s| if time_s < 30.0 { load_a(time_s) } else { frozen_a },
                |time_s| 3.7 - 1.5e-3 * load_a(time_s),
            );
            assert!(found.is_some_and(|found_s| found_s > 30.0 && found_s < 90.0), "{found:?}");
        }
    }

    #[test]
    fn a_constant_current_with_voltages_that_rest_or_drift_is_none() {
        let noise = |time_s: f64| 0.004 * libm::sin(37.0 * time_s) + 0.004 * libm::sin(91.0 * time_s);
        for (current_a, drift_v_per_s) in [(0.0, 0.0), (5.0, -2e-4), (-5.0, 2e-4), (5.0, -5e-3)] {
            let found = found_s(600, |_| current_a, |time_s| 3.7 + drift_v_per_s * time_s + noise(time_s));
            assert_eq!(found, None, "{current_a} {drift_v_per_s}");
        }
    }

    #[test]
    fn a_load_that_the_current_shows_is_none_and_glitches_are_none() {
        let voltage = |time_s: f64| 3.7 - 1.5e-3 * load_a(time_s);
        assert_eq!(found_s(600, load_a, voltage), None);
        let glitch = |time_s: f64| if (time_s * 10.0).round() % 70.0 == 0.0 { 3.2 } else { 3.7 };
        assert_eq!(found_s(600, |_| 5.0, glitch), None);
    }

    #[test]
    fn a_reading_that_moves_again_ends_it() {
        let mut check = FrozenCheck { current_a: Some(5.0), is_frozen: true, readings: 99, ..FrozenCheck::default() };
        assert!(check.handle_current(Timestamp::from_secs(1.0), 5.0));
        assert!(!check.handle_current(Timestamp::from_secs(2.0), 5.1));
    }
}
