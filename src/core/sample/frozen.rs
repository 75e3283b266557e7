//! Detects a frozen current sensor: its reading stays bit-identical while the voltages show a changing load.
//!
//! In: good readings of the current (A) and of the cells' voltages (V). Out: whether the reading of the current is
//! frozen. The reading counts as frozen until it changes.
//!
//! A constant reading alone proves nothing. A parked pack, a charger and a laboratory hold a current for hours, and a
//! coarse sensor then shows one value. In these cases, the voltages rest or drift in one direction. A changing load
//! moves the voltages back and forth.
//!
//! The check takes the median of the cells' voltages in each *round* (one voltage per cell). The median must move in
//! one direction and turn back within [`MAX_TURN_S`]. Both movements must be at least as large as the *step*, which
//! exceeds the noise of the median. The sensor counts as frozen if at least [`MIN_READINGS`] readings were equal and
//! the reading stays unchanged for [`MIN_FROZEN_S`] after the turn.
//!
//! A frozen sensor is not detected if the voltages do not turn back, or if they move by less than the step. A faulty
//! sensor whose last digits still change is not detected either, but the voltages then contradict the estimate.

use serde::{Deserialize, Serialize};

use crate::quantity::{InvalidState, Timestamp, bounds};

const MIN_READINGS: u32 = 20;
/// How long the reading must remain unchanged after the turn (s). A healthy sensor's reading follows the voltages
/// within this time.
const MIN_FROZEN_S: f64 = 5.0;
/// Longest time from an extreme voltage to the turn (s). The voltages of cells that rest, cool or balance turn more
/// slowly.
const MAX_TURN_S: f64 = 60.0;
/// The step is at least this multiple of the configured standard deviation of a voltage's noise.
const STEP_SIGMA: f64 = 5.0;
/// The step is also at least this multiple of the median change from round to round, because the noise may exceed the
/// configured noise. The multiple corresponds to 8 standard deviations, so that two consecutive readings do not exceed
/// the step by chance within a day.
const STEP_MOVES: f64 = 8.4;
/// Maximum and minimum number of changes from which the median change is calculated.
const MAX_MOVES: usize = 32;
const MIN_MOVES: usize = 8;
/// Smallest step (V). Smaller movements may come from a charger's ripple, or from a load that changes by less than the
/// resolution of a coarse current sensor.
const MIN_STEP_V: f64 = 0.02;
/// Maximum number of cells in the median. The first cells of the pack are enough to distinguish a glitch from a load.
const MAX_MEDIAN: usize = 15;
/// Longest time between two current readings (s). After a longer pause, the check restarts, unless the sensor already
/// counts as frozen.
const MAX_PAUSE_S: f64 = 5.0;

/// Turning points of a voltage.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Reversals {
    /// Lowest and highest voltage since the last turning point.
    range_v: Option<(f64, f64)>,
    /// Whether the voltage has risen since the last turning point; `None` = no turning point yet.
    is_rising: Option<bool>,
    /// Time of the extreme (highest or lowest) voltage since the last turning point.
    extreme_at: Timestamp,
    /// Whether the next reading must confirm a turn.
    is_unconfirmed: bool,
    /// Whether the voltage has turned back within [`MAX_TURN_S`].
    has_turned: bool,
}

impl Reversals {
    fn handle(&mut self, now: Timestamp, voltage_v: f64, step_v: f64) {
        let Some((low, high)) = self.range_v else {
            (self.range_v, self.extreme_at) = (Some((voltage_v, voltage_v)), now);
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
            self.has_turned |= self.is_rising.is_some() && now.since(self.extreme_at) <= MAX_TURN_S;
            self.is_rising = Some(rose && !(fell && self.is_rising == Some(true)));
            (self.range_v, self.extreme_at) = (Some((voltage_v, voltage_v)), now);
        } else {
            if (voltage_v > high && self.is_rising != Some(false)) || (voltage_v < low && self.is_rising != Some(true))
            {
                self.extreme_at = now;
            }
            self.range_v = Some((low.min(voltage_v), high.max(voltage_v)));
        }
    }
}

/// State of the check; part of the stored state.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct FrozenCheck {
    /// The unchanged reading, the time of its latest occurrence, and the number of occurrences.
    current_a: Option<f64>,
    latest: Timestamp,
    readings: u32,
    reversals: Reversals,
    /// Time of the first current reading after the turn.
    turned_at: Option<Timestamp>,
    /// Voltages of the present round, at most [`MAX_MEDIAN`]. The first cell starts a round.
    round_v: Vec<f64>,
    /// Whether the present round started before the reading of the current changed.
    is_mixed: bool,
    /// Median of the previous round.
    median_v: f64,
    /// Latest absolute changes of the median, at most [`MAX_MOVES`]. Kept when the reading of the current changes.
    moves_v: Vec<f64>,
    is_frozen: bool,
}

/// Step (V) that exceeds noise with the standard deviation `noise_v` (V).
pub(super) fn step_v(noise_v: f64) -> f64 {
    (STEP_SIGMA * noise_v).max(MIN_STEP_V)
}

impl FrozenCheck {
    #[inline]
    pub(super) fn is_frozen(&self) -> bool {
        self.is_frozen
    }

    /// Handles a current reading. Returns whether the sensor is frozen.
    pub(super) fn handle_current(&mut self, now: Timestamp, current_a: f64) -> bool {
        let is_paused = now.since(self.latest) > MAX_PAUSE_S;
        if self.current_a != Some(current_a) || (is_paused && !self.is_frozen) {
            *self = Self {
                current_a: Some(current_a),
                is_mixed: true,
                round_v: std::mem::take(&mut self.round_v),
                median_v: self.median_v,
                moves_v: std::mem::take(&mut self.moves_v),
                ..Self::default()
            };
        }
        (self.latest, self.readings) = (now, self.readings.saturating_add(1));
        if self.reversals.has_turned && self.turned_at.is_none() {
            self.turned_at = Some(now);
        }
        let is_late = self.turned_at.is_some_and(|turned_at| now.since(turned_at) >= MIN_FROZEN_S);
        self.is_frozen = self.is_frozen || (is_late && self.readings >= MIN_READINGS);
        self.is_frozen
    }

    /// Handles a cell's voltage. The first cell starts a round.
    #[inline]
    pub(super) fn handle_voltage(&mut self, now: Timestamp, cell: usize, voltage_v: f64, step_v: f64) {
        if cell >= MAX_MEDIAN {
            return;
        }
        if cell == 0 && !self.round_v.is_empty() {
            self.end_round(now, step_v);
        }
        if self.round_v.len() < MAX_MEDIAN {
            self.round_v.push(voltage_v);
        }
    }

    fn end_round(&mut self, now: Timestamp, step_v: f64) {
        self.round_v.sort_unstable_by(f64::total_cmp);
        let cells = self.round_v.len();
        // With an even number of cells there are two middle cells. Take the one that changed less: a load moves both, a
        // glitch only one.
        let (low, high) = (self.round_v[(cells - 1) / 2], self.round_v[cells / 2]);
        let is_low_nearer = (low - self.median_v).abs() <= (high - self.median_v).abs();
        let median = if is_low_nearer { low } else { high };
        if self.moves_v.len() == MAX_MOVES {
            self.moves_v.remove(0);
        }
        self.moves_v.push((median - self.median_v).abs());
        self.median_v = median;
        self.round_v.clear();
        let is_mixed = std::mem::take(&mut self.is_mixed);
        if !is_mixed && self.readings >= 2 && !self.reversals.has_turned && self.moves_v.len() >= MIN_MOVES {
            self.reversals.handle(now, median, step_v.max(STEP_MOVES * self.median_move_v()));
        }
    }

    fn median_move_v(&self) -> f64 {
        let mut moves_v = [0.0; MAX_MOVES];
        let moves_v = &mut moves_v[..self.moves_v.len()];
        moves_v.copy_from_slice(&self.moves_v);
        *moves_v.select_nth_unstable_by(self.moves_v.len() / 2, f64::total_cmp).1
    }

    pub(super) fn restart(&mut self) {
        *self = Self::default();
    }

    pub(super) fn rebase(&mut self, by_nanos: i64) {
        for stamp in [&mut self.latest, &mut self.reversals.extreme_at].into_iter().chain(&mut self.turned_at) {
            *stamp = stamp.plus_nanos(by_nanos);
        }
    }

    /// Returns the first impossible number.
    pub(super) fn check(&self) -> Result<(), InvalidState> {
        let (low, high) = self.reversals.range_v.unwrap_or_default();
        bounds::VOLTAGE_V.check("the median voltage of the frozen-current check", self.median_v)?;
        bounds::NUMBER.check_all("voltage changes of the frozen-current check", self.moves_v.iter().copied())?;
        let moves = self.moves_v.len();
        InvalidState::unless(
            moves <= MAX_MOVES,
            "the number of voltage changes of the frozen-current check",
            moves as f64,
            "at most 32",
        )?;
        bounds::VOLTAGE_V
            .check_all("a voltage of the frozen-current check", self.round_v.iter().copied().chain([low, high]))?;
        bounds::CURRENT_A.check_all("the current of the frozen-current check", self.current_a)?;
        let cells = self.round_v.len() as f64;
        InvalidState::unless(
            self.round_v.len() <= MAX_MEDIAN,
            "the number of voltages of the frozen-current check",
            cells,
            "at most 15",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Simulates ten readings a second of a current and of three cells. Returns when the current was found frozen (s).
    fn found_s(seconds: u32, current: impl Fn(f64) -> f64, voltage: impl Fn(f64) -> f64) -> Option<f64> {
        let mut check = FrozenCheck::default();
        (0..10 * seconds).map(|k| f64::from(k) / 10.0).find(|&time_s| {
            for cell in 0..3 {
                let (now, voltage_v) = (Timestamp::from_secs(time_s), voltage(time_s) + 0.01 * cell as f64);
                check.handle_voltage(now, cell, voltage_v, step_v(0.005));
            }
            check.handle_current(Timestamp::from_secs(time_s), current(time_s))
        })
    }

    /// A load that changes every few seconds.
    fn load_a(time_s: f64) -> f64 {
        40.0 + 60.0 * libm::sin(0.7 * time_s) * libm::sin(0.11 * time_s)
    }

    #[test]
    fn frozen_current_is_found_within_a_minute() {
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
    fn constant_current_with_drifting_voltages_is_not_frozen() {
        let noise = |time_s: f64| 0.004 * libm::sin(37.0 * time_s) + 0.004 * libm::sin(91.0 * time_s);
        for (current_a, drift_v_per_s) in [(0.0, 0.0), (5.0, -2e-4), (-5.0, 2e-4), (5.0, -5e-3)] {
            let found = found_s(600, |_| current_a, |time_s| 3.7 + drift_v_per_s * time_s + noise(time_s));
            assert_eq!(found, None, "{current_a} {drift_v_per_s}");
        }
    }

    #[test]
    fn late_current_and_slow_turns_are_not_frozen() {
        // At the end of the charge, the voltages fall three seconds before the reading of the current changes.
        let charge = |time_s: f64| if time_s < 100.0 { 3.6 + 2e-3 * time_s } else { 3.7 };
        assert_eq!(found_s(200, |time_s| if time_s < 103.0 { -50.0 } else { 0.0 }, charge), None);
        let found = found_s(200, |_| -50.0, charge);
        assert!(found.is_some_and(|found_s| found_s > 105.0 && found_s < 106.0), "{found:?}");
        assert_eq!(found_s(4000, |_| 0.0, |time_s| 3.7 + 0.04 * libm::sin(time_s / 200.0)), None);
    }

    #[test]
    fn measured_load_and_glitches_are_not_frozen() {
        let voltage = |time_s: f64| 3.7 - 1.5e-3 * load_a(time_s);
        assert_eq!(found_s(600, load_a, voltage), None);
        // A coarse sensor may have five times the configured noise. This noise is pseudorandom and uniform.
        let noise = |time_s: f64| {
            let bits = ((10.0 * time_s) as u64).wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            let bits = (bits ^ (bits >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            0.087 * ((bits >> 40) as f64 / f64::from(1 << 24) - 0.5)
        };
        assert_eq!(found_s(3600, |_| 5.0, |time_s| 3.7 + noise(time_s)), None);
        let glitch = |time_s: f64| if (time_s * 10.0).round() % 70.0 == 0.0 { 3.2 } else { 3.7 };
        assert_eq!(found_s(600, |_| 5.0, glitch), None);
    }

    #[test]
    fn changing_reading_ends_frozen_state() {
        let mut check = FrozenCheck { current_a: Some(5.0), is_frozen: true, readings: 99, ..FrozenCheck::default() };
        assert!(check.handle_current(Timestamp::from_secs(1.0), 5.0));
        assert!(!check.handle_current(Timestamp::from_secs(2.0), 5.1));
    }
}
