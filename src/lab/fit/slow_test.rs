//! Evaluates slow tests: a whole discharge from a full cell, about C/20, and the slow charge after it if there is one.
//!
//! Input: a file that starts with a full cell. Output: an open-circuit curve (SOC, V), and the rows for the fit.

use std::ops::Range;

use super::limits::DISCONNECTED_V;
use super::prepare::{AnchoredPart, clean, rough_capacity};
use crate::error::LabError;
use crate::ident::MeasuredPart;
use crate::ident::fit::OcvCurve;
use crate::ident::grid::interpolate;
use crate::measured::MeasuredFile;

/// A discharge or charge with fewer rows is not a slow test.
const MIN_ROWS: usize = 10;
/// The first discharge must take out at least this share of the largest charge taken out in the file.
const WHOLE_SHARE: f64 = 0.5;
/// Largest mean current of the charge, relative to the discharge. A faster charge polarises the cell differently.
const SLOW_CHARGE: f64 = 1.5;
/// A current up to this share of the discharge's mean is the sensor's noise at rest.
const REST_SHARE: f64 = 0.1;

/// A slow test.
pub(super) struct SlowTest {
    /// Mean temperature of the discharge (degrees C).
    pub(super) temperature_c: f64,
    part: MeasuredPart,
    /// Charge taken out since the cell was full, for every row of `part` (Ah).
    taken_out_ah: Vec<f64>,
    /// Charge taken out (Ah), rising, and open-circuit voltage (V).
    curve: (Vec<f64>, Vec<f64>),
    /// Rows of the slow charge; empty if there is none.
    charge: Range<usize>,
}

impl SlowTest {
    /// Evaluates the first part of `file`.
    ///
    /// # Errors
    /// The file does not start with a full cell, or its first discharge is short.
    pub(super) fn new(file: &MeasuredFile, voltage_max_v: f64) -> Result<Self, LabError> {
        Self::of_part(clean(&file.parts[0]), voltage_max_v)
            .map_err(|what| LabError::Data(format!("{}: {what}", file.path.display())))
    }

    fn of_part(part: MeasuredPart, voltage_max_v: f64) -> Result<Self, String> {
        if part.time_s.is_empty() {
            return Err("no row with current and voltage".into());
        }
        let taken_out_ah = part.taken_out_ah(voltage_max_v, rough_capacity(&part))?;
        let begin = part.current_a.iter().position(|&i| i > 0.0).ok_or("no discharge")?;
        let end = begin + part.current_a[begin..].iter().take_while(|&&i| i > 0.0).count();
        let discharge = rising(&part, &taken_out_ah, begin..end);
        let rows = discharge.0.len();
        let whole_ah = taken_out_ah.iter().fold(0.0_f64, |most, ah| most.max(*ah));
        if rows < MIN_ROWS || discharge.0[rows - 1] < WHOLE_SHARE * whole_ah {
            return Err(format!("its first discharge has {rows} rows, expected a whole slow one"));
        }
        let temperature_c = part.temperature_c[begin..end].iter().sum::<f64>() / (end - begin) as f64;
        let charge = slow_charge(&part, &taken_out_ah, begin..end);
        let curve = match rising(&part, &taken_out_ah, charge.clone()) {
            charged if charged.0.len() >= MIN_ROWS => middle(discharge, &charged),
            _ => discharge,
        };
        Ok(Self { temperature_c, part, taken_out_ah, curve, charge })
    }

    /// Charge that the discharge took out (Ah).
    pub(super) fn capacity_ah(&self) -> f64 {
        self.curve.0[self.curve.0.len() - 1]
    }

    /// The open-circuit curve of a cell with `capacity_ah`.
    pub(super) fn curve(&self, capacity_ah: f64) -> OcvCurve {
        let soc = self.curve.0.iter().rev().map(|ah| 1.0 - ah / capacity_ah).collect();
        let voltage_v = self.curve.1.iter().rev().copied().collect();
        OcvCurve { temperature_c: self.temperature_c, soc, voltage_v }
    }

    /// The rows of the test with their SOC, as data of the fit. `number` is the number of the file.
    pub(super) fn into_source(self, number: usize, capacity_ah: f64) -> AnchoredPart {
        let Self { mut part, taken_out_ah, charge, .. } = self;
        part.soc = taken_out_ah.iter().map(|ah| 1.0 - ah / capacity_ah).collect();
        let emptiest = taken_out_ah.iter().enumerate().fold(0, |k, (i, ah)| if *ah > taken_out_ah[k] { i } else { k });
        let judged = (0..part.len()).map(|k| k <= emptiest || charge.contains(&k)).collect();
        AnchoredPart::unscaled(number, part, judged)
    }
}

/// Returns charge taken out (Ah, rising) and voltage (V) of `rows`, in either direction of the current.
fn rising(part: &MeasuredPart, taken_out_ah: &[f64], rows: Range<usize>) -> (Vec<f64>, Vec<f64>) {
    let is_charge = rows.clone().next().is_some_and(|first| part.current_a[first] < 0.0);
    let (mut ah, mut voltage_v): (Vec<f64>, Vec<f64>) = (vec![], vec![]);
    let mut push = |k: usize| {
        if ah.last().is_none_or(|&last| taken_out_ah[k] > last) && part.voltage_v[k] > DISCONNECTED_V {
            ah.push(taken_out_ah[k]);
            voltage_v.push(part.voltage_v[k]);
        }
    };
    if is_charge {
        rows.rev().for_each(&mut push)
    } else {
        rows.for_each(&mut push)
    }
    (ah, voltage_v)
}

/// Returns the rows of the first charge after `discharge`. No rows if there is none, or if its mean current is more than
/// [`SLOW_CHARGE`] times that of the discharge.
fn slow_charge(part: &MeasuredPart, taken_out_ah: &[f64], discharge: Range<usize>) -> Range<usize> {
    let mean_a = |rows: &Range<usize>| {
        let (first, last) = (rows.start, rows.end - 1);
        3600.0 * (taken_out_ah[last] - taken_out_ah[first]).abs() / (part.time_s[last] - part.time_s[first])
    };
    let discharge_a = mean_a(&discharge);
    let is_charge = |current_a: &f64| *current_a < -REST_SHARE * discharge_a;
    let after = &part.current_a[discharge.end..];
    let Some(pause) = after.iter().position(is_charge) else { return 0..0 };
    let begin = discharge.end + pause;
    let charge = begin..begin + after[pause..].iter().take_while(|i| is_charge(i)).count();
    if mean_a(&charge) <= SLOW_CHARGE * discharge_a { charge } else { 0..0 }
}

/// Returns the middle between the voltages of a discharge and a charge, at the charges of the discharge. Each curve is
/// charge taken out (Ah, rising) and voltage (V).
///
/// Slow polarisation and hysteresis raise the voltage of the charge as much as they lower that of the discharge.
/// Beyond the ends of the charge, half of the gap at its end applies.
fn middle(discharge: (Vec<f64>, Vec<f64>), charge: &(Vec<f64>, Vec<f64>)) -> (Vec<f64>, Vec<f64>) {
    let (first_ah, last_ah) = (charge.0[0], charge.0[charge.0.len() - 1]);
    let half_gap_v = |ah: &f64| {
        let at = ah.clamp(first_ah, last_ah);
        0.5 * (interpolate(&charge.0, &charge.1, at) - interpolate(&discharge.0, &discharge.1, at))
    };
    let voltage_v = discharge.0.iter().zip(&discharge.1).map(|(ah, v)| v + half_gap_v(ah)).collect();
    (discharge.0, voltage_v)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A cell of 2 Ah with a straight curve from 3 V to 4 V and 50 mohm: a discharge at 0.1 A, a pause, and a charge at
    /// `charge_a` up to SOC 0.95.
    fn test_with_charge(charge_a: f64) -> SlowTest {
        let mut part = MeasuredPart::default();
        let mut push = |hour: f64, current_a: f64, out_ah: f64| {
            let ocv_v = 4.0 - 0.5 * out_ah;
            part.push(3600.0 * hour, current_a, ocv_v - 0.05 * current_a, 25.0, out_ah);
        };
        push(0.0, 0.0, 0.0);
        (0..=20).for_each(|k| push(0.1 + f64::from(k), 0.1, 0.1 * f64::from(k)));
        [-0.001, 0.002, -0.003].into_iter().for_each(|noise_a| push(21.0, noise_a, 2.0));
        (0..20).for_each(|k| push(22.0 + f64::from(k) * 0.1 / charge_a, -charge_a, 2.0 - 0.1 * f64::from(k)));
        SlowTest::of_part(part, 4.0).expect("a slow test")
    }

    #[test]
    fn curve_is_middle_between_discharge_and_slow_charge() {
        let curve = test_with_charge(0.1).curve(2.0);
        assert_eq!(curve.soc.len(), 21);
        for (soc, voltage_v) in curve.soc.iter().zip(&curve.voltage_v) {
            assert!((voltage_v - (3.0 + soc)).abs() < 1e-9, "{soc}: {voltage_v} V");
        }
    }

    #[test]
    fn fast_charge_leaves_curve_of_discharge() {
        let curve = test_with_charge(1.0).curve(2.0);
        for (soc, voltage_v) in curve.soc.iter().zip(&curve.voltage_v) {
            assert!((voltage_v - (3.0 + soc - 0.005)).abs() < 1e-9, "{soc}: {voltage_v} V");
        }
    }

    #[test]
    fn fit_judges_discharge_and_slow_charge_only() {
        let judged = |test: SlowTest| test.into_source(0, 2.0).judged.iter().filter(|&&is_judged| is_judged).count();
        assert_eq!(judged(test_with_charge(0.1)), 22 + 20);
        assert_eq!(judged(test_with_charge(1.0)), 22);
    }
}
