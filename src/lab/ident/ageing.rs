//! Determines the SOC in the first cycles of an ageing cell. Full charges and full discharges alternate, and the record
//! has no charge counter.
//!
//! The SOC is anchored at two points. The first point is the end of every full charge, where the charger stops: the SOC
//! is 1. The second point is the knee, where a discharge falls through a fixed voltage ([`KNEE_SHARE`]). The SOC at the
//! knee is the same in every discharge, because the voltage falls fastest there and little charge is left. These
//! anchors prevent capacity fade and the gain error of the charger's current from distorting the curves. At the cut-off
//! under load, the mean SOC is assumed to be [`SOC_LEFT`]. Half-cycles before the first discharge start at an unknown
//! SOC and are left out.

use super::{MeasuredPart, charge_ah};
use crate::filter::median;

/// SOC of a new cell at the cut-off under load.
pub(crate) const SOC_LEFT: f64 = 0.045;
/// Voltage of the knee, as a share of the range from the lowest to the highest voltage: 3.0 V for 2.7 to 4.2 V.
const KNEE_SHARE: f64 = 0.2;
/// A row is under load if its current exceeds this share of the median current of the discharge.
const LOADED_SHARE: f64 = 0.5;
/// If the current changes by more than this between two rows (A per Ah of capacity), the row's voltage and current may
/// belong to different instants.
const STEP_PER_AH: f64 = 0.25;
/// Below this SOC, discharge rows without load do not count in the fit, because the voltage recovers more slowly than
/// any branch of the model.
const RECOVERY_SOC: f64 = 0.5;

/// A half-cycle with its SOC.
#[derive(Debug, Clone, PartialEq)]
pub struct AnchoredHalfCycle {
    /// Index of the half-cycle.
    pub index: usize,
    /// Current without the load pulses of a charger (A).
    pub current_a: Vec<f64>,
    /// SOC of each row.
    pub soc: Vec<f64>,
    /// For each row, whether its voltage counts in the fit.
    pub judged: Vec<bool>,
}

/// A charge is full if the charged ampere-hours, divided by the ampere-hours that were missing before, are in this
/// range. Aborted charges and charges with too few samples are left out.
const FULL_CHARGE: std::ops::RangeInclusive<f64> = 0.8..=1.25;

/// Charge from the start of a discharge to its knee and to its cut-off (Ah).
struct Marks {
    knee_ah: f64,
    cut_off_ah: f64,
}

/// Returns the capacity (Ah, mean over the discharges), and the SOC of the half-cycles from the first discharge on.
/// Charges that are not full are left out.
///
/// # Errors
/// The cycles contain no discharge, or a discharge has no knee.
pub fn anchor(cycles: &[MeasuredPart], voltage_v: (f64, f64)) -> Result<(f64, Vec<AnchoredHalfCycle>), String> {
    let first = cycles.iter().position(MeasuredPart::is_discharge).ok_or("no discharge among the first cycles")?;
    let knee_v = voltage_v.0 + KNEE_SHARE * (voltage_v.1 - voltage_v.0);
    let discharges = cycles.iter().filter(|cycle| cycle.is_discharge());
    let marks: Vec<Marks> = discharges
        .enumerate()
        .map(|(n, cycle)| {
            marks(cycle, knee_v, voltage_v.0).ok_or_else(|| {
                format!(
                    "discharge number {} does not fall to {knee_v:.2} V under load: its end cannot serve as an anchor",
                    n + 1
                )
            })
        })
        .collect::<Result<_, _>>()?;
    let mean = |value: &dyn Fn(&Marks) -> f64| marks.iter().map(value).sum::<f64>() / marks.len() as f64;
    let beyond_ah = mean(&|m| m.cut_off_ah - m.knee_ah);
    let capacity_ah = (mean(&|m| m.knee_ah) + beyond_ah) / (1.0 - SOC_LEFT);
    let knee_soc = SOC_LEFT + beyond_ah / capacity_ah;
    let (mut anchored, mut left, mut number) = (Vec::new(), 1.0, 0);
    for (index, cycle) in cycles.iter().enumerate().skip(first) {
        if cycle.time_s.is_empty() {
            continue;
        }
        let current_a = without_load_pulses(cycle, capacity_ah);
        let out_ah = charge_ah(&cycle.time_s, &current_a);
        let soc: Vec<f64> = if cycle.is_discharge() {
            let per_ah = (1.0 - knee_soc) / marks[number].knee_ah;
            number += 1;
            out_ah.iter().map(|ah| 1.0 - ah * per_ah).collect()
        } else {
            let all_ah = out_ah[out_ah.len() - 1];
            if !FULL_CHARGE.contains(&(-all_ah / ((1.0 - left) * capacity_ah))) {
                continue;
            }
            out_ah.iter().map(|ah| left + (1.0 - left) * ah / all_ah).collect()
        };
        left = soc[soc.len() - 1];
        let judged = judged(cycle.is_discharge(), &current_a, &soc, capacity_ah);
        anchored.push(AnchoredHalfCycle { index, current_a, soc, judged });
    }
    Ok((capacity_ah, anchored))
}

fn marks(cycle: &MeasuredPart, knee_v: f64, cut_off_v: f64) -> Option<Marks> {
    let loaded_a = LOADED_SHARE * median(cycle.current_a.iter().copied())?;
    let loaded: Vec<usize> = (0..cycle.time_s.len()).filter(|&k| cycle.current_a[k] > loaded_a).collect();
    let out_ah = charge_ah(&cycle.time_s, &cycle.current_a);
    let crossing = |level_v: f64| {
        let at = loaded.iter().position(|&k| cycle.voltage_v[k] <= level_v)?;
        let (k, before) = (loaded[at], loaded[at.checked_sub(1)?]);
        let along = (cycle.voltage_v[before] - level_v) / (cycle.voltage_v[before] - cycle.voltage_v[k]);
        Some(out_ah[before] + along * (out_ah[k] - out_ah[before]))
    };
    let last_ah = out_ah[*loaded.last()?];
    Some(Marks { knee_ah: crossing(knee_v)?, cut_off_ah: crossing(cut_off_v).unwrap_or(last_ah) })
}

/// Sets the current of short load pulses to 0. Chargers test themselves with such pulses. The pulses move almost no
/// charge, but an integral over rows that are seconds apart would count too much.
fn without_load_pulses(cycle: &MeasuredPart, capacity_ah: f64) -> Vec<f64> {
    let pulse = |i: f64| !cycle.is_discharge() && i > STEP_PER_AH * capacity_ah;
    cycle.current_a.iter().map(|&i| if pulse(i) { 0.0 } else { i }).collect()
}

fn judged(discharge: bool, current_a: &[f64], soc: &[f64], capacity_ah: f64) -> Vec<bool> {
    let step = STEP_PER_AH * capacity_ah;
    let of_row = |k: usize| {
        let before_a = if k == 0 { current_a[0] } else { current_a[k - 1] };
        let recovering = discharge && current_a[k] < 2.0 * step && soc[k] < RECOVERY_SOC;
        (current_a[k] - before_a).abs() < step && !recovering
    };
    (0..soc.len()).map(of_row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn half_cycle(kind: &str, time_s: &[f64], current_a: &[f64], voltage_v: &[f64]) -> MeasuredPart {
        let [time_s, current_a, voltage_v] = [time_s, current_a, voltage_v].map(<[f64]>::to_vec);
        MeasuredPart { kind: kind.to_owned(), time_s, current_a, voltage_v, ..MeasuredPart::default() }
    }

    #[test]
    fn knees_share_one_soc_and_charges_end_full() {
        let time_s: Vec<f64> = (0..=100).map(|k| 36.0 * f64::from(k)).collect();
        let fall = |k: f64| if k < 90.0 { 4.2 - 0.01 * k } else { 3.3 - 0.06 * (k - 90.0) };
        let voltage_v: Vec<f64> = (0..=100).map(|k| fall(f64::from(k))).collect();
        let half = |kind, current_a| half_cycle(kind, &time_s, &[current_a; 101], &voltage_v);
        let cycles = [half("discharge", 2.0), half("charge", -2.1), half("discharge", 1.9)];
        let (capacity_ah, anchored) = anchor(&cycles, (2.7, 4.2)).expect("anchored");
        assert!((capacity_ah - 1.95 / 0.955).abs() < 1e-9, "{capacity_ah}");
        let knee = 95;
        assert!((anchored[0].soc[knee] - anchored[2].soc[knee]).abs() < 1e-12);
        assert_eq!(anchored[1].soc[0], anchored[0].soc[100]);
        assert!((anchored[1].soc[100] - 1.0).abs() < 1e-12);
    }

    #[test]
    fn aborted_charge_is_left_out() {
        let time_s: Vec<f64> = (0..=100).map(|k| 36.0 * f64::from(k)).collect();
        let voltage_v: Vec<f64> = (0..=100).map(|k| 4.2 - 0.016 * f64::from(k)).collect();
        let half = |kind, current_a| half_cycle(kind, &time_s, &[current_a; 101], &voltage_v);
        let (discharge, charge) = (half("discharge", 2.0), half("charge", -2.0));
        let one_row = half_cycle("charge", &[0.0], &[-1.0], &[3.5]);
        let aborted = half("charge", -0.01);
        let whole = anchor(&[discharge.clone(), charge.clone(), discharge.clone()], (2.7, 4.2)).expect("anchored");
        let found = anchor(&[discharge.clone(), one_row, aborted, charge, discharge], (2.7, 4.2)).expect("anchored");
        assert_eq!(found.0, whole.0);
        let socs = |anchored: &[AnchoredHalfCycle]| anchored.iter().map(|a| a.soc.clone()).collect::<Vec<_>>();
        assert_eq!(socs(&found.1), socs(&whole.1));
        assert_eq!(found.1.iter().map(|a| a.index).collect::<Vec<_>>(), [0, 3, 4]);
    }

    #[test]
    fn discharge_without_knee_is_rejected() {
        let cycle = half_cycle("discharge", &[0.0, 100.0, 200.0], &[2.0; 3], &[4.0, 3.9, 3.8]);
        let error = anchor(&[cycle], (2.7, 4.2)).expect_err("no knee");
        assert_eq!(error, "discharge number 1 does not fall to 3.00 V under load: its end cannot serve as an anchor");
    }
}
