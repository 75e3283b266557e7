//! Sums the samples of a few minutes (a row), per cell and for the pack.

use serde::{Deserialize, Serialize};

use crate::quantity::Timestamp;

/// Some loggers repeat a cell's last voltage until they read the cell again. A voltage counts as repeated if it equals
/// the last voltage bit for bit although the ohmic drop has changed by more than `REPEATED_V` (V). After `REPEATED_S`
/// (s), an equal voltage counts as read again, because then the channel may be frozen.
const REPEATED_V: f64 = 0.005;
const REPEATED_S: f64 = 30.0;

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct CellSums {
    pub(super) count: u32,
    /// Number of voltages in the sum. Repeated voltages are not added.
    readings: u32,
    /// Sum of the voltages (V). The cells are sampled at different times, and so at different currents. The ohmic drop
    /// of the mean cell at the current of the sample is therefore added to each voltage.
    voltage_v: f64,
    steps_a2: f64,
    /// Sum of the products of current step and voltage step between samples.
    steps_va: f64,
    /// Time, voltage and current of the previous sample whose voltage was not repeated.
    last: Option<(Timestamp, f64, f64)>,
    seen: Option<Timestamp>,
    temperature_c: f64,
    temperatures: u32,
    /// Hash of the sequence of voltages in the row.
    pub(super) digest: u64,
    pub(super) changes: u32,
}

impl CellSums {
    /// Adds a sample (V, A). `ohm` is the series resistance of the mean cell.
    #[inline]
    pub(super) fn add(
        &mut self,
        time: Timestamp,
        voltage_v: f64,
        current_a: f64,
        temperature_c: Option<f64>,
        ohm: f64,
    ) {
        let apart_ns = |before: Timestamp| time.nanos().wrapping_sub(before.nanos());
        // Uses at most about one sample per second, because more samples add no information.
        if self.seen.is_some_and(|before| (0..900_000_000).contains(&apart_ns(before))) {
            return;
        }
        self.seen = Some(time);
        self.count += 1;
        if let Some(temperature_c) = temperature_c {
            self.temperature_c += temperature_c;
            self.temperatures += 1;
        }
        self.digest = (self.digest.rotate_left(5) ^ voltage_v.to_bits()).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        let is_repeated = |(before, last_v, last_a): (Timestamp, f64, f64)| {
            let drop_v = ohm * (current_a - last_a).abs();
            voltage_v == last_v && drop_v > REPEATED_V && (0.0..=REPEATED_S).contains(&time.since(before))
        };
        if self.last.is_some_and(is_repeated) {
            return;
        }
        self.readings += 1;
        self.voltage_v += voltage_v + ohm * current_a;
        if let Some((before, last_v, last_a)) = self.last.replace((time, voltage_v, current_a)) {
            let (step_v, step_a) = (voltage_v - last_v, current_a - last_a);
            if (0.0..=3.0).contains(&time.since(before)) {
                self.steps_a2 += step_a * step_a;
                self.steps_va += step_a * step_v;
            }
            self.changes += u32::from(step_v != 0.0);
        }
    }

    pub(super) fn mean_v(&self) -> Option<f64> {
        (self.readings > 0).then(|| self.voltage_v / f64::from(self.readings))
    }

    pub(super) fn mean_c(&self) -> Option<f64> {
        (self.temperatures > 0).then(|| self.temperature_c / f64::from(self.temperatures))
    }

    /// Series resistance computed from current steps (ohm), and the sum of squared current steps (A^2). `None` if this
    /// sum is below `least_a2`.
    pub(super) fn ohm(&self, least_a2: f64) -> Option<(f64, f64)> {
        (self.steps_a2 >= least_a2).then(|| (-self.steps_va / self.steps_a2, self.steps_a2))
    }

    pub(super) fn begin(&mut self) {
        *self = Self { last: self.last, seen: self.seen, ..Self::default() };
    }

    pub(super) fn interrupt(&mut self) {
        *self = Self::default();
    }

    pub(super) fn numbers(&self) -> [f64; 6] {
        let (_, voltage_v, current_a) = self.last.unwrap_or((Timestamp::ZERO, 0.0, 0.0));
        [self.voltage_v, self.steps_a2, self.steps_va, voltage_v, current_a, self.temperature_c]
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct PackSums {
    pub(super) begun: Option<Timestamp>,
    pub(super) last: Option<Timestamp>,
    pub(super) count: u32,
    pub(super) current_a: f64,
    pub(super) drop_v: f64,
    pub(super) soc: f64,
    pub(super) temperature_c: f64,
    /// Sum over the samples of the charge minus `first_ah` (Ah).
    pub(super) charge_ah: f64,
    /// Charge at the first sample of the row (Ah).
    pub(super) first_ah: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repeated_voltage_is_not_averaged() {
        let mean_v = |samples: &[(f64, f64, f64)]| {
            let mut sums = CellSums::default();
            for &(seconds, voltage_v, current_a) in samples {
                sums.add(Timestamp::from_secs(seconds), voltage_v, current_a, None, 0.001);
            }
            assert_eq!(sums.count as usize, samples.len());
            sums.mean_v().unwrap()
        };
        let near = |value: f64, expected: f64| assert!((value - expected).abs() < 1e-9, "{value}, not {expected}");
        // The logger repeats 3.7 V while the current rises to 100 A, then reads 3.6 V.
        near(mean_v(&[(0.0, 3.7, 0.0), (1.0, 3.7, 100.0), (2.0, 3.7, 100.0), (3.0, 3.6, 100.0)]), 3.7);
        near(mean_v(&[(0.0, 3.7, 0.0), (1.0, 3.7, 4.0)]), 3.702);
        near(mean_v(&[(0.0, 3.7, 0.0), (40.0, 3.7, 100.0)]), 3.75);
    }
}
