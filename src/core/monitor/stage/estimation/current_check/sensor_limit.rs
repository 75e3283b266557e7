//! Detects readings at which a current sensor is at its limit (the largest current that it can report). A noisy sensor
//! repeats a reading exactly only at its limit.
//!
//! In: readings of the current (A), and whether the load is steady. Out: evidence against the sensor.
//!
//! If the last digits of a sensor usually change under a steady load, a run of equal readings shows that the sensor is
//! at its limit. Two kinds of sensors repeat their readings for other reasons, so their repeats are not evidence. A
//! coarse sensor repeats its readings, or changes them by one step. A sensor without noise repeats its readings while a
//! charger or a cycler holds the current. A sensor without noise is recognised when it has repeated two different
//! currents.

use serde::{Deserialize, Serialize};

use super::{DOUBTFUL, MAX_EVIDENCE};
use crate::quantity::{InvalidState, bounds};

/// Weight of a new reading in the running average [`SensorLimit::noisy`].
const NOISE_GAIN: f64 = 0.02;
/// Lowest probability that a good sensor repeats a reading exactly.
const MIN_REPEAT: f64 = 0.01;
/// Probability that a sensor at its limit repeats a reading.
const FAULTY_REPEAT: f64 = 0.5;
/// Changes of a reading above this multiple of the sensor's resolution are noise. A coarse sensor without noise changes
/// by one step.
const NOISE_STEPS: f64 = 1.5;
/// Assumed resolution of the current before the first change (A).
const MAX_RESOLUTION_A: f64 = 1e3;
/// A noisy sensor has this number of equal readings in a row only at its limit.
const QUIET_READINGS: u32 = 20;
/// If `repeated` (ln of the odds for a good sensor) falls to this value, the sensor is at its limit.
const REPEATED: f64 = -10.0;

/// Repeated readings of a sensor, and its limits; part of the stored state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SensorLimit {
    /// Share of readings of a steady current that differ from the previous reading by noise.
    noisy: f64,
    /// Smallest change of the current (A).
    resolution_a: f64,
    /// Evidence of the present run of equal readings: ln of the odds for a good sensor, at most 0.
    repeated: f64,
    /// Number of times that the present reading has repeated.
    equal: u32,
    /// Size of a current (A) that the sensor has repeated [`QUIET_READINGS`] times in a row while most of its readings
    /// showed no noise; 0 = no such current.
    quiet_a: f64,
    /// Whether the sensor has repeated two currents of different size, so that its repeats are not evidence.
    is_quiet: bool,
    /// Largest reading of discharge and of charge (A).
    largest_a: [f64; 2],
    /// Readings at which the sensor was at its limit, for discharge and for charge (A); 0 = never.
    pub(super) limits_a: [f64; 2],
}

impl Default for SensorLimit {
    fn default() -> Self {
        Self {
            noisy: 0.0,
            resolution_a: MAX_RESOLUTION_A,
            repeated: 0.0,
            equal: 0,
            quiet_a: 0.0,
            is_quiet: false,
            largest_a: [0.0; 2],
            limits_a: [0.0; 2],
        }
    }
}

impl SensorLimit {
    /// Judges a reading (A). `is_steady`: whether the voltages, and so the load, are steady. Returns evidence against
    /// the sensor: ln of the odds, 0 = none.
    pub(super) fn judge(&mut self, before_a: f64, now_a: f64, is_steady: bool) -> f64 {
        let change_a = (now_a - before_a).abs();
        let direction = usize::from(now_a < 0.0);
        self.largest_a[direction] = self.largest_a[direction].max(now_a.abs());
        if change_a > 0.0 {
            self.resolution_a = self.resolution_a.min(change_a);
            self.equal = 0;
        } else if now_a != 0.0 {
            self.note_equal(now_a.abs());
        }
        if now_a == 0.0 {
            self.repeated = 0.0;
            return 0.0;
        }
        let mut evidence = if self.limits_a.contains(&now_a) { DOUBTFUL } else { 0.0 };
        // Only the largest reading in its direction can be a limit.
        let is_largest = now_a.abs() >= self.largest_a[direction];
        if change_a > 0.0 || !is_largest || self.is_quiet {
            self.repeated = 0.0;
        } else {
            self.repeated += libm::log((1.0 - self.noisy).max(MIN_REPEAT) / FAULTY_REPEAT).min(0.0);
            // The sensor has already repeated one current many times. If it repeats the present reading as often, it
            // has no noise.
            let is_open = self.quiet_a > 0.0 && self.equal < QUIET_READINGS;
            if self.repeated <= REPEATED && !is_open {
                self.repeated = 0.0;
                self.limits_a[direction] = now_a;
                evidence = MAX_EVIDENCE;
            }
        }
        if is_steady && !is_largest {
            let is_noise = change_a > NOISE_STEPS * self.resolution_a;
            self.noisy += NOISE_GAIN * (f64::from(u8::from(is_noise)) - self.noisy);
        }
        evidence
    }

    /// Notes that a reading of this size (A) has repeated.
    fn note_equal(&mut self, size_a: f64) {
        self.equal = self.equal.saturating_add(1);
        if self.equal < QUIET_READINGS {
            return;
        }
        if self.quiet_a > 0.0 {
            // The limits of a sensor in the two directions differ by at most one step.
            self.is_quiet |= (size_a - self.quiet_a).abs() > NOISE_STEPS * self.resolution_a;
        } else if 1.0 - self.noisy >= FAULTY_REPEAT {
            self.quiet_a = size_a;
        }
    }

    /// Ends the present run of equal readings, because the next reading comes after a pause.
    pub(super) fn pause(&mut self) {
        (self.equal, self.repeated) = (0, 0.0);
    }

    /// Whether currents above `rest_a` have flowed in both directions.
    pub(super) fn has_seen_both(&self, rest_a: f64) -> bool {
        self.largest_a.iter().all(|&a| a > rest_a)
    }

    pub(super) fn check(&self) -> Result<(), InvalidState> {
        bounds::CURRENT_A
            .check_all("a current of the sensor's limit", self.limits_a.into_iter().chain(self.largest_a))?;
        bounds::NUMBER.check_all("the sensor's limit", [self.noisy, self.resolution_a, self.repeated, self.quiet_a])
    }
}
