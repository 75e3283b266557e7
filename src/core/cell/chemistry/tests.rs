//! Tests that every chemistry has a model with a plausible curve.

use super::*;
use crate::cell::TemperaturePosition;

#[test]
fn all_chemistries_have_a_model() {
    for (chemistry, name) in Chemistry::ALL {
        let label = Label::usual(chemistry, 60.0);
        let model = label.model().expect(name);
        assert_eq!((chemistry.name(), model.capacity_ah, model.rated_capacity_ah), (name, 60.0, 60.0));
        let rises = |row: &Vec<f64>| row.windows(2).all(|pair| pair[0] < pair[1]);
        assert!(model.ocv_v.values.iter().all(rises), "{name}: {:?}", model.ocv_v);
        let warm = TEMPERATURE_C.iter().position(|t| *t == 25.0).expect("the temperature of the cut-offs");
        let row = &model.ocv_v.values[warm];
        assert!((row[0] - label.voltage_min_v).abs() < 0.01, "{name}: {row:?}");
        assert!((label.voltage_max_v - 0.25..=label.voltage_max_v).contains(&row[row.len() - 1]), "{name}: {row:?}");
    }
}

#[test]
fn aged_curve_rises_everywhere() {
    for (chemistry, name) in Chemistry::ALL {
        let model = Label::usual(chemistry, 3.0).model().expect(name);
        for capacity_ah in [1.2, 1.8, 2.4, 3.0, 3.3] {
            let temperature: TemperaturePosition = model.temperature_position(10.0);
            let at = |soc: f64| model.aged_ocv_v(&model.grid_position_at(&temperature, soc), capacity_ah);
            let rises = (0..100).map(f64::from).all(|k| at(0.01 * k) < at(0.01 * (k + 1.0)));
            assert!(rises, "{name} at {capacity_ah} Ah");
        }
    }
}

#[test]
fn resistances_scale_with_cell_size() {
    let model = |rated_ah: f64| Label::usual(Chemistry::NmcGraphite, rated_ah).model().expect("a model");
    let settled_ohm = |rated_ah: f64| {
        let model = model(rated_ah);
        model.settled_ohm(&model.grid_position(0.5, 25.0))
    };
    assert!((settled_ohm(3.0) / settled_ohm(60.0) - 20.0).abs() < 1e-9);
    // A load of C/2 at half charge causes a drop of 50 to 150 mV in usual cells.
    assert!((0.05..0.15).contains(&(30.0 * settled_ohm(60.0))), "{}", settled_ohm(60.0));
}

#[test]
fn modes_explain_the_spread() {
    for (chemistry, name) in Chemistry::ALL {
        let curve = Label::usual(chemistry, 3.0).curve().expect(name);
        let (modes_v, rest_v) = curve.modes_v();
        for s in 0..curve.soc.len() {
            let sum = modes_v.iter().map(|mode_v| mode_v[s].powi(2)).sum::<f64>() + rest_v[s].powi(2);
            let variance = curve.covariance[(s, s)];
            assert!(sum >= variance * (1.0 - 1e-9), "{name} at {}: {sum} {variance}", curve.soc[s]);
            assert!(rest_v[s] < 0.11, "{name} at {}: {}", curve.soc[s], rest_v[s]);
        }
    }
}

#[test]
fn foreign_cut_offs_give_no_model() {
    let label = Label { voltage_min_v: 3.9, voltage_max_v: 4.4, ..Label::usual(Chemistry::LfpGraphite, 100.0) };
    assert!(label.model().is_none());
}
