//! Fits cell models to measured data ("Battery Predictions for Electronic Prognostics", section 3.3.2).
//!
//! Data flow of a fit:
//!
//! 1. [`anchor`] determines the SOC of every raw row of a file.
//! 2. [`record`] joins raw rows into coarser rows. Each row gets a weight and a position in the tables.
//! 3. [`pass`] computes the residuals, and their exact Jacobian from recursive sensitivities.
//! 4. [`prior`] adds the prior, which keeps the tables smooth.
//! 5. [`solve`] minimises the cost (projected Levenberg-Marquardt).
//! 6. [`fit`] repeats steps 3 to 5 until the cost stops falling. Then it determines the residuals, and the seconds of
//!    data near each node of the tables.
//!
//! For records that start at an unknown SOC, [`unanchored`] estimates the SOC together with the tables. After a fit,
//! [`error_table`] estimates the model's error, and [`thermal`] fits heat capacity and thermal resistance.

pub mod ageing;
pub mod anchor;
pub mod electrodes;
pub mod error_table;
pub mod fit;
pub mod grid;
pub mod parameters;
pub mod pass;
pub mod prior;
pub mod record;
pub mod solve;
pub mod thermal;
pub mod unanchored;

/// Consecutive rows whose time does not restart.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeasuredPart {
    /// Value of the column that numbers the parts (`cycle`, `segment` or `ref`); empty if the file has no such column.
    pub key: String,
    /// Value of the `type` column in the first row, `charge` or `discharge`; empty without that column.
    pub kind: String,
    /// Seconds since the start of the part.
    pub time_s: Vec<f64>,
    /// Current (A), positive = discharge.
    pub current_a: Vec<f64>,
    /// Terminal voltage (V).
    pub voltage_v: Vec<f64>,
    /// Cell temperature (degrees C); NaN where not measured.
    pub temperature_c: Vec<f64>,
    /// Charge taken out according to the cycler's counter (Ah); NaN where not recorded.
    pub discharged_ah: Vec<f64>,
    /// State of charge, fraction; empty until determined.
    pub soc: Vec<f64>,
}

impl MeasuredPart {
    pub(crate) fn is_discharge(&self) -> bool {
        self.kind == "discharge"
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.time_s.len()
    }

    pub(crate) fn push(&mut self, time_s: f64, current_a: f64, voltage_v: f64, temperature_c: f64, discharged_ah: f64) {
        self.time_s.push(time_s);
        self.current_a.push(current_a);
        self.voltage_v.push(voltage_v);
        self.temperature_c.push(temperature_c);
        self.discharged_ah.push(discharged_ah);
    }

    /// Returns the charge taken out (Ah) at the end of a discharge while the tester holds the lowest voltage and the
    /// current falls. Returns 0 if the discharge has no such phase.
    pub(crate) fn held_ah(&self) -> f64 {
        let Some(last) = self.current_a.iter().rposition(|&current_a| current_a > 0.0) else { return 0.0 };
        let charge_ah = charge_ah(&self.time_s[..=last], &self.current_a[..=last]);
        let half_ah = 0.5 * charge_ah[last];
        // Current after half of the charge has been taken out.
        let load_a = self.current_a[charge_ah.partition_point(|&ah| ah < half_ah).min(last)];
        let lowest_v = self.voltage_v[..=last].iter().copied().fold(f64::INFINITY, f64::min);
        let is_held = |row: usize| {
            let current_a = self.current_a[row];
            // The voltage is held if it is within 50 mV of its lowest value while the current is below 97 % of the
            // load.
            current_a > 0.0 && current_a < 0.97 * load_a && self.voltage_v[row] <= lowest_v + 0.05
        };
        let first = (0..=last).rev().take_while(|&row| is_held(row)).last().unwrap_or(last);
        charge_ah[last] - charge_ah[first]
    }

    /// Whether the part has no rows.
    pub fn is_empty(&self) -> bool {
        self.time_s.is_empty()
    }
}

/// Returns the charge taken out since the first row (Ah) for every row, by the trapezoidal rule. A gap counts like any
/// other step.
pub fn charge_ah(time_s: &[f64], current_a: &[f64]) -> Vec<f64> {
    let mut sum = 0.0;
    let mut charges = Vec::with_capacity(time_s.len());
    for k in 0..time_s.len() {
        if k > 0 {
            sum += 0.5 * (current_a[k] + current_a[k - 1]) * (time_s[k] - time_s[k - 1]) / 3600.0;
        }
        charges.push(sum);
    }
    charges
}

#[cfg(test)]
mod tests {
    use super::*;

    fn discharge(rows: &[(f64, f64, f64)]) -> MeasuredPart {
        let mut part = MeasuredPart { kind: "discharge".into(), ..MeasuredPart::default() };
        rows.iter().for_each(|&(time_s, current_a, voltage_v)| part.push(time_s, current_a, voltage_v, 25.0, f64::NAN));
        part
    }

    #[test]
    fn held_charge_is_the_charge_after_the_load() {
        let load = [(0.0, 3.0, 3.4), (600.0, 3.02, 3.0), (1200.0, 2.98, 2.6), (1800.0, 3.0, 2.5)];
        assert_eq!(discharge(&load).held_ah(), 0.0);
        let mut held = load.to_vec();
        held.extend([(1900.0, 1.8, 2.502), (2260.0, 0.2, 2.498), (2300.0, 0.0, 2.6)]);
        assert!((discharge(&held).held_ah() - 0.1).abs() < 1e-12, "360 s at 1 A");
        // A varying load changes the voltage, so it does not count as held.
        assert_eq!(
            discharge(&[(0.0, 3.0, 3.4), (600.0, 3.0, 3.2), (1200.0, 1.0, 3.3), (1800.0, 2.0, 3.1)]).held_ah(),
            0.0
        );
        assert_eq!(discharge(&[(0.0, 0.0, 3.4), (600.0, -1.0, 3.5)]).held_ah(), 0.0);
    }
}
