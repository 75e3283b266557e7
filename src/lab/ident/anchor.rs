//! Determines the SOC of every raw row of a measured part (one record of a battery cycler). A part that starts at an
//! unknown SOC is rejected.
//!
//! 1. A part must start with a full cell. Its first voltage must be at most [`REST_SAG_V`] below the cell's highest
//!    allowed voltage, or at most [`LOAD_SAG_V`] below it if a discharge current already flows.
//! 2. The cycler's charge counter rises during discharge and falls during charge. If its first value is within
//!    [`COUNTER_NEAR`] of 0, SOC = 1 - counter / capacity. If its first value is lower, the counter was reset before
//!    the charge, so the first value is subtracted from all values. If its first value is higher, charge was taken out
//!    before the first row, so the part is rejected.
//! 3. Without a counter, the current is integrated, starting at SOC 1.

use super::{MeasuredPart, charge_ah};

/// Largest difference between the highest allowed voltage and the voltage of a full cell at rest (V). The voltage falls
/// after a charge, and a charge in the cold ends early.
const REST_SAG_V: f64 = 0.1;
/// Largest difference between the highest allowed voltage and the voltage of a full cell under load (V).
const LOAD_SAG_V: f64 = 0.35;
/// Discharge current above which a cell is under load: current divided by capacity (1/h).
const LOAD_SHARE: f64 = 0.02;
/// The charge counter was 0 when the cell was full if its first value is at most this fraction of the capacity away
/// from 0.
const COUNTER_NEAR: f64 = 0.003;

impl MeasuredPart {
    /// Returns the charge taken out since the cell was full, for every row (Ah).
    ///
    /// # Errors
    /// The part does not start with a full cell, or its counter shows that charge was taken out before the first row.
    pub fn taken_out_ah(&self, voltage_max_v: f64, capacity_hint_ah: f64) -> Result<Vec<f64>, String> {
        self.begins_full(voltage_max_v, capacity_hint_ah)?;
        if self.discharged_ah[0].is_nan() {
            return Ok(charge_ah(&self.time_s, &self.current_a));
        }
        let first_ah = self.discharged_ah[0];
        let near_ah = COUNTER_NEAR * capacity_hint_ah;
        if first_ah > near_ah {
            return Err(format!(
                "discharged_ah begins at {first_ah} Ah, expected 0 or below: charge was taken out before the first row"
            ));
        }
        let zero_ah = if first_ah >= -near_ah { 0.0 } else { first_ah };
        let mut last = first_ah - zero_ah;
        // An empty field repeats the last counter value.
        let mut hold = |counter: f64| {
            last = if counter.is_nan() { last } else { counter - zero_ah };
            last
        };
        Ok(self.discharged_ah.iter().map(|&counter| hold(counter)).collect())
    }

    fn begins_full(&self, voltage_max_v: f64, capacity_hint_ah: f64) -> Result<(), String> {
        let loaded = self.current_a[0] > LOAD_SHARE * capacity_hint_ah;
        let needed_v = voltage_max_v - if loaded { LOAD_SAG_V } else { REST_SAG_V };
        let voltage_v = self.voltage_v[0];
        (voltage_v >= needed_v).then_some(()).ok_or_else(|| {
            format!("begins at {voltage_v} V, expected a full cell (at least {needed_v:.2} V): its SOC is unknown")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn taken_out(voltage_v: f64, current_a: f64, counter: [f64; 2]) -> Result<Vec<f64>, String> {
        let mut part = MeasuredPart::default();
        part.push(0.0, current_a, voltage_v, f64::NAN, counter[0]);
        part.push(3600.0, current_a, voltage_v, f64::NAN, counter[1]);
        part.taken_out_ah(4.2, 2.0)
    }

    #[test]
    fn counter_near_zero_is_used_as_is_otherwise_differences() {
        assert_eq!(taken_out(4.17, 0.1, [0.002, 0.5]), Ok(vec![0.002, 0.5]));
        assert_eq!(taken_out(4.17, 0.1, [-0.5, 0.5]), Ok(vec![0.0, 1.0]));
        assert_eq!(taken_out(3.95, 2.0, [-1.0, 0.5]), Ok(vec![0.0, 1.5]));
    }

    #[test]
    fn counter_with_charge_taken_out_is_rejected() {
        let refused = taken_out(4.15, 0.1, [0.12, 0.5]).expect_err("taken before");
        assert!(
            refused.starts_with("discharged_ah begins at 0.12 Ah, expected 0 or below: charge was taken"),
            "{refused}"
        );
    }

    #[test]
    fn current_is_integrated_from_full_without_counter() {
        assert_eq!(taken_out(4.2, 1.5, [f64::NAN; 2]), Ok(vec![0.0, 1.5]));
    }

    #[test]
    fn part_that_does_not_start_full_is_rejected() {
        let refused = taken_out(3.45, 0.0, [0.0, -2.3]).expect_err("not full");
        assert!(refused.starts_with("begins at 3.45 V, expected a full cell (at least 4.10 V)"), "{refused}");
    }
}
