//! Counts the charge and the energy that a pack takes up and delivers while the program runs.
//!
//! In: pack current (A, positive = discharge) and pack voltage (V). Out: sums in both directions, which never decrease.
//! Time with an unknown current is not counted. The voltage is read once a second, and the energy is this voltage times
//! the charge since the last reading. While the voltage is unknown, the charge waits for the next known voltage.

use serde::{Deserialize, Serialize};

use crate::quantity::{InvalidState, Timestamp};

/// Shortest time between two readings of the voltage (s).
const VOLTAGE_PERIOD_S: f64 = 1.0;
/// Longest time between two current readings over which charge is counted (s).
const LONGEST_S: f64 = 60.0;

/// Charge and energy moved since the program first ran with the pack.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct MovedSums {
    /// Charge into the pack (Ah).
    pub charged_ah: f64,
    /// Charge out of the pack (Ah).
    pub discharged_ah: f64,
    /// Energy into the pack (Wh).
    pub charged_wh: f64,
    /// Energy out of the pack (Wh).
    pub discharged_wh: f64,
}

/// The sums, and the charge that is not counted as energy yet, because no voltage has been read since it flowed.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct MovedCounter {
    pub(crate) sums: MovedSums,
    latest: Option<Timestamp>,
    /// Charge into and out of the pack since the last voltage (Ah), and the time since then (s).
    waiting_ah: [f64; 2],
    waiting_s: f64,
}

impl MovedCounter {
    /// Counts the current up to `now`; `None` = unknown. `voltage_v` returns the voltage of the pack.
    pub(crate) fn observe(&mut self, now: Timestamp, current_a: Option<f64>, voltage_v: impl FnOnce() -> Option<f64>) {
        // The time before and after an unknown current is not counted.
        let before = std::mem::replace(&mut self.latest, current_a.map(|_| now));
        let seconds = before.map_or(0.0, |before| now.since(before));
        let Some(current_a) = current_a.filter(|_| seconds > 0.0 && seconds <= LONGEST_S) else { return };
        let charge_ah = current_a.abs() * seconds / 3600.0;
        let is_discharge = current_a > 0.0;
        self.waiting_ah[usize::from(is_discharge)] += charge_ah;
        *(if is_discharge { &mut self.sums.discharged_ah } else { &mut self.sums.charged_ah }) += charge_ah;
        self.waiting_s += seconds;
        if self.waiting_s < VOLTAGE_PERIOD_S {
            return;
        }
        let Some(voltage_v) = voltage_v() else { return };
        let [charged_ah, discharged_ah] = std::mem::take(&mut self.waiting_ah);
        self.sums.charged_wh += voltage_v * charged_ah;
        self.sums.discharged_wh += voltage_v * discharged_ah;
        self.waiting_s = 0.0;
    }

    /// Keeps the sums. The time until the next current is not counted.
    pub(crate) fn interrupted(&self) -> Self {
        Self { latest: None, ..*self }
    }

    pub(crate) fn check(&self) -> Result<(), InvalidState> {
        let MovedSums { charged_ah, discharged_ah, charged_wh, discharged_wh } = self.sums;
        let [waiting, other] = self.waiting_ah;
        [charged_ah, discharged_ah, charged_wh, discharged_wh, waiting, other, self.waiting_s]
            .into_iter()
            .try_for_each(|sum| InvalidState::unless_natural("the charge and energy moved", sum))
    }

    pub(crate) fn rebase(&mut self, by_nanos: i64) {
        self.latest = self.latest.map(|latest| latest.plus_nanos(by_nanos));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn charge_and_energy_are_counted_by_direction() {
        let mut counter = MovedCounter::default();
        let mut drive = |from: u32, to: u32, current_a: Option<f64>, voltage_v: Option<f64>| {
            (from..=to).for_each(|tenth| {
                counter.observe(Timestamp::from_secs(f64::from(tenth) / 10.0), current_a, || voltage_v);
            });
            counter.sums
        };
        let close = |sums: MovedSums, expected: [f64; 4]| {
            let MovedSums { charged_ah, discharged_ah, charged_wh, discharged_wh } = sums;
            let found = [charged_ah, discharged_ah, charged_wh, discharged_wh];
            assert!(
                found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-3 * b.max(1.0)),
                "{found:?} {expected:?}"
            );
        };
        close(drive(0, 36_000, Some(10.0), Some(400.0)), [0.0, 10.0, 0.0, 4000.0]);
        close(drive(36_001, 54_000, Some(-10.0), Some(420.0)), [5.0, 10.0, 2100.0, 4000.0]);
        // No charge is counted while the current is unknown. While the voltage is unknown, the charge waits.
        close(drive(54_001, 56_000, None, Some(420.0)), [5.0, 10.0, 2100.0, 4000.0]);
        close(drive(56_001, 92_000, Some(1.0), None), [5.0, 11.0, 2100.0, 4000.0]);
        close(drive(92_001, 92_010, Some(0.0), Some(400.0)), [5.0, 11.0, 2100.0, 4400.0]);
        // Neither an unknown current nor the time until the next current is counted.
        drive(92_011, 92_011, None, Some(400.0));
        close(drive(92_210, 92_210, Some(100.0), Some(400.0)), [5.0, 11.0, 2100.0, 4400.0]);
        // A gap is not counted.
        close(drive(200_000, 200_000, Some(100.0), Some(400.0)), [5.0, 11.0, 2100.0, 4400.0]);
    }
}
