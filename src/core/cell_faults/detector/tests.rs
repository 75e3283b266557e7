//! Tests the cell fault detector on simulated packs, with models derived from labels and with cells that are not
//! compared.

use super::*;
use crate::cell::chemistry::{Chemistry, Label};
use crate::cell_faults::difference::{CAPACITY, CHANNEL, SOC};
use crate::cell_faults::fault;

#[test]
fn cell_no_longer_compared_is_reset() {
    let mut diagnosis = CellFaultDetector::new(6);
    diagnosis.middle = 4;
    diagnosis.lowest = Some(5);
    diagnosis.last_row = Some((Timestamp::ZERO, 0.5, 0.0));
    for cell in [1, 4] {
        diagnosis.cells[cell].settled[SOC] = 0.3;
        let cells = Some((CellIndex(cell as u16), CellIndex(cell as u16)));
        let size = ScalarGaussian { mean: 1.0, variance: 0.0 };
        let (kind, since) = (CellFaultKind::VoltageChannel, Timestamp::ZERO);
        diagnosis.put(CellFault { kind, cells, since, reported: since, probability: 1.0, size });
    }
    let mut stored: CellFaultDetector = serde_json::from_str(&serde_json::to_string(&diagnosis).unwrap()).unwrap();
    stored.compare_only(&[0, 1, 2, 3]);
    assert_eq!((stored.middle, stored.lowest, stored.findings().len()), (0, None, 1));
    let faults = [0, 1, 4, 5].map(|cell| stored.has_channel_fault(CellIndex(cell)));
    assert_eq!(faults, [Some(false), Some(true), None, None]);
    assert_eq!(stored.sizes([CellFaultKind::Leak, CellFaultKind::Contact])[4], [None, None]);
    assert!(stored.difference(CellIndex(4)).is_none() && stored.difference(CellIndex(1)).is_some());
    assert_eq!(stored.relative(CellIndex(4)), Some([None; STATES]));
    let again: CellFaultDetector = serde_json::from_str(&serde_json::to_string(&stored).unwrap()).unwrap();
    assert_eq!(again, stored);
    stored.compare_only(&[0, 1, 2, 3, 4, 5]);
    assert_eq!((stored.cells[4].settled[SOC], stored.cells[1].settled[SOC]), (0.0, 0.3));
}

/// Open-circuit voltage of the simulated cells (V). `slopes`: factors of the model's slope below and above SOC 0.5.
fn true_ocv_v(model: &CellModel, slopes: [f64; 2], soc: f64) -> f64 {
    let at_v = |soc: f64| model.ocv_v(&model.grid_position(soc, 25.0));
    at_v(0.5) + slopes[usize::from(soc > 0.5)] * (at_v(soc) - at_v(0.5))
}

/// Simulates eight days of discharge, rest and charge, and returns the detector. The cells differ only in charge
/// (`charges`, fraction). `slopes`: error of the model's open-circuit curve, see [`true_ocv_v`].
fn watched(charges: &[f64], slopes: [f64; 2]) -> CellFaultDetector {
    watched_with_offset(charges, slopes, 0.0, true)
}

/// Like [`watched`], but the channel of cell 4 has an offset (V) from the first day. `is_prior`: whether the detector
/// assumes that the model was derived from a label.
fn watched_with_offset(charges: &[f64], slopes: [f64; 2], offset_v: f64, is_prior: bool) -> CellFaultDetector {
    const CAPACITY_AH: f64 = 100.0;
    let model = Label::usual(Chemistry::NmcGraphite, CAPACITY_AH).model().expect("a model");
    let (ohm, mut detector) = (0.001, CellFaultDetector::new(charges.len()));
    let (mut soc, mut charge_ah, mut seconds) = (0.9, 0.0, 0.0);
    let currents_a = [(30.0, 144), (0.0, 40), (-20.0, 216), (0.0, 40)];
    for (current_a, steps) in (0..8).flat_map(|_| currents_a) {
        for step in 0..steps {
            (seconds, soc, charge_ah) =
                (seconds + 50.0, soc - current_a / 72.0 / CAPACITY_AH, charge_ah + current_a / 72.0);
            // Driving: the current changes from sample to sample, with the same mean.
            let current_a = if current_a > 0.0 && step % 2 == 0 {
                2.0 * current_a
            } else if current_a > 0.0 {
                0.0
            } else {
                current_a
            };
            let time = Timestamp::from_secs(seconds);
            for (cell, charge) in charges.iter().enumerate() {
                // Noise of 1 mV, as in a typical cell monitor.
                let noise_v = 0.001 * f64::from((7 * cell as u32 + 13 * step) % 11).mul_add(0.2, -1.0);
                let offset_v = if cell == 4 { offset_v } else { 0.0 };
                let voltage_v = true_ocv_v(&model, slopes, soc + charge) - ohm * current_a + noise_v + offset_v;
                detector.add(cell, time, voltage_v, Some(current_a), Some(25.0));
            }
            let model_soc = model.soc_of_ocv(true_ocv_v(&model, slopes, soc), 25.0);
            let mean = MeanCell { soc: model_soc, current_a, drop_v: ohm * current_a, temperature_c: 25.0, charge_ah };
            if detector.note(time, &mean, CAPACITY_AH) {
                detector.close_row((&model, is_prior), CAPACITY_AH, |_| Some(model_soc), false, None);
            }
        }
    }
    detector
}

const SLOPES: [[f64; 2]; 5] = [[1.0, 1.0], [0.6, 0.6], [1.7, 1.7], [0.6, 1.4], [1.4, 0.8]];

#[test]
fn low_charge_is_found_with_wrong_curve() {
    for slopes in SLOPES {
        let charges: Vec<f64> =
            (0..12).map(|cell| if cell == 4 { -0.08 } else { 0.002 * f64::from(cell % 5) - 0.004 }).collect();
        let detector = watched(&charges, slopes);
        let found: Vec<_> = detector.findings().iter().map(|found| (found.kind, found.cells)).collect();
        let cell = CellIndex(4);
        assert_eq!(found, [(CellFaultKind::LowCharge, Some((cell, cell)))], "{slopes:?}");
        let size = detector.findings()[0].size;
        assert!((size.mean + 0.08).abs() < 0.02, "{slopes:?}: {size:?}");
    }
}

#[test]
fn healthy_cells_have_no_finding_with_wrong_curve() {
    for slopes in SLOPES {
        // The charge rises from the first cell to the last cell, as in a car whose pack is out of balance.
        let charges: Vec<f64> = (0..24).map(|cell| 0.004 * f64::from(cell) - 0.04).collect();
        let detector = watched(&charges, slopes);
        assert_eq!(detector.findings(), [], "{slopes:?}");
        for [leak, contact] in detector.sizes([CellFaultKind::Leak, CellFaultKind::Contact]) {
            let is_below = |size: Option<ScalarGaussian>, limit: f64| size.is_none_or(|size| size.mean < limit);
            assert!(is_below(leak, fault::LEAK_PER_DAY) && is_below(contact, fault::CONTACT), "{slopes:?}");
        }
        let lowest = detector.relative(CellIndex(0)).unwrap()[SOC].unwrap();
        let highest = detector.relative(CellIndex(23)).unwrap()[SOC].unwrap();
        let (difference, true_difference) = (highest.mean - lowest.mean, 0.092);
        assert!((difference / true_difference - 1.0).abs() < 0.25, "{slopes:?}: {difference}");
    }
}

#[test]
fn lasting_offset_looks_like_charge_with_label() {
    let charges: Vec<f64> = (0..12).map(|cell| 0.0004 * f64::from(cell)).collect();
    let found = |is_prior: bool| {
        let detector = watched_with_offset(&charges, [1.0, 1.0], 0.06, is_prior);
        detector.findings().iter().map(|found| found.kind).collect::<Vec<_>>()
    };
    assert_eq!(found(false), [CellFaultKind::VoltageChannel]);
    assert_eq!(found(true), [CellFaultKind::HighCharge]);
}

#[test]
fn weak_cell_is_not_reported_with_label() {
    let charges: Vec<f64> = (0..12).map(|cell| 0.0004 * f64::from(cell)).collect();
    let mut detector = watched(&charges, [1.0, 1.0]);
    let mut mean = [0.0; STATES];
    mean[CAPACITY] = -0.2;
    detector.cells[4].difference.settle(&mean);
    let mut found = |is_prior: bool| {
        detector.is_prior = is_prior;
        detector.judge(Timestamp::from_secs(1e6), None);
        detector.findings().iter().map(|found| found.kind).collect::<Vec<_>>()
    };
    assert_eq!(found(true), []);
    assert_eq!(found(false), [CellFaultKind::WeakCell]);
}

#[test]
fn charge_must_show_in_voltage() {
    let charges: Vec<f64> = (0..12).map(|cell| 0.002 * f64::from(cell % 5) - 0.004).collect();
    let mut detector = watched(&charges, [1.0, 1.0]);
    let slope_v = detector.slope_v;
    let mut probability = |charge: f64, channel_v: f64| {
        let mut mean = [0.0; STATES];
        (mean[SOC], mean[CHANNEL]) = (charge, channel_v);
        detector.cells[4].difference.settle(&mean);
        let populations = std::array::from_fn(|state| detector.population(state));
        detector.constant_charge(4, &populations, 1.0).1
    };
    assert!(probability(0.08, 0.0) > 0.99);
    assert_eq!(probability(0.08, -0.08 * slope_v), 0.0);
}
