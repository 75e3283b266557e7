//! Tests the uncertainty bands of models that are built from a label (chemistry and rated capacity), and of a model
//! without a stated error. Also tests the advice.

use super::*;
use crate::cell::model::tests::small_model;
use crate::cell::{Chemistry, Label, Table};

fn of_label(chemistry: Chemistry) -> CellModel {
    Label::usual(chemistry, 5.0).model().expect("a model")
}

/// Pairs of SOC and temperature (degrees C), some outside the model's tables.
fn places() -> impl Iterator<Item = (f64, f64)> {
    let of_soc = |k: u32| [-40.0, -10.0, 5.0, 25.0, 70.0].map(|t| (f64::from(k) / 40.0, t));
    (0..=40).flat_map(of_soc)
}

#[test]
fn bands_of_every_chemistry_are_positive_numbers() {
    for (chemistry, name) in Chemistry::ALL {
        let model = of_label(chemistry);
        let bands = ModelBands::new(&model);
        for (soc, t) in places() {
            let resistance = bands.resistance(soc, t);
            let load = bands.load_soc_std(soc, t).expect("stated");
            let rest = bands.rest_soc_std(soc).expect("stated");
            for value in [bands.curve_std_v(soc).expect("stated"), resistance.std(), rest, load] {
                assert!(value.is_finite() && value > 0.0, "{name} at {soc}, {t} degrees C: {value}");
            }
            assert!(rest <= load && load <= 0.29, "{name} at {soc}: {rest} at rest, {load} under load");
        }
    }
}

#[test]
fn model_without_error_has_no_band() {
    let model = small_model();
    let bands = ModelBands::new(&model);
    assert_eq!((bands.curve_std_v(0.5), bands.rest_soc_std(0.5), bands.load_soc_std(0.5, 20.0)), (None, None, None));
    assert_eq!(advise(&bands), None);
    // Without a stated error, the usual differences within one cell type apply.
    assert_eq!((bands.resistance(0.5, 20.0).std(), bands.capacity_std()), (0.2, 0.1));
}

#[test]
fn cold_error_counts_as_resistance_error() {
    let errors = vec![vec![0.03; 3], vec![0.005; 3]];
    let model = CellModel { voltage_error_v: Some(Table { values: errors }), ..small_model() };
    let bands = ModelBands::new(&model);
    assert!(bands.curve_std_v(0.5).is_some_and(|v| (v - 0.005).abs() < 1e-12));
    // A load of C/2 (1 A) through 0.08 ohm at 0 degrees C drops 80 mV.
    let cold = bands.resistance(0.5, 0.0);
    assert!((cold.local - (0.03_f64.powi(2) - 0.005_f64.powi(2)).sqrt() / 0.08).abs() < 1e-12, "{cold:?}");
    let warm = bands.resistance(0.5, 40.0);
    assert!(warm.common == 0.2 && warm.local < 1e-6, "{warm:?}");
    let (points, advice) = advise(&bands).expect("stated");
    assert!(points > 0.5 && points < 8.0, "{points}");
    let first = advice.first().map(|it| it.measurement);
    assert!(matches!(first, Some(Measurement::Drive(temperature_c)) if temperature_c < 10.0), "{advice:?}");
}

#[test]
fn advice_reduces_the_error_step_by_step() {
    for (chemistry, name) in Chemistry::ALL {
        let model = of_label(chemistry);
        let (points, advice) = advise(&ModelBands::new(&model)).expect("stated");
        assert!(!advice.is_empty(), "{name}: a model of a label has much to learn");
        let mut before = points;
        for Advice { left_points, measurement } in advice {
            assert!(
                left_points > 0.0 && left_points < before,
                "{name}: {measurement} leaves {left_points} of {before}"
            );
            before = left_points;
        }
    }
}

#[test]
fn certain_model_needs_no_measurement() {
    let errors = vec![vec![0.001; 3], vec![0.001; 3]];
    let spread = ModelSpread { log_resistance: 0.05, capacity: 0.01, ..ModelSpread::usual(1, 0.0) };
    let model = CellModel { voltage_error_v: Some(Table { values: errors }), spread: Some(spread), ..small_model() };
    let (points, advice) = advise(&ModelBands::new(&model)).expect("stated");
    assert!(points < 1.0 && advice.is_empty(), "{points}: {advice:?}");
}

#[test]
fn measurements_read_as_instructions() {
    let words = [
        Measurement::Rest(0.4),
        Measurement::Drive(-7.0),
        Measurement::Drive(3.0),
        Measurement::Drive(20.0),
        Measurement::Charge,
    ];
    assert_eq!(
        words.map(|it| it.to_string()),
        [
            "one rest of an hour near 40 %",
            "a drive below -5 \u{b0}C",
            "a drive below 5 \u{b0}C",
            "a drive near 20 \u{b0}C",
            "one charge from below 20 % to full"
        ]
    );
}
