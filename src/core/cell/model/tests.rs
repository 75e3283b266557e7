//! Tests the tables, curves and grid of a cell model, and defines a small model for the tests of other files.

use super::*;

pub(crate) fn small_model() -> CellModel {
    let table = |rows: [[f64; 3]; 2]| Table { values: rows.iter().map(|r| r.to_vec()).collect() };
    CellModel {
        name: "test".into(),
        rated_capacity_ah: 2.0,
        capacity_ah: 2.0,
        voltage_min_v: 2.7,
        voltage_max_v: 4.2,
        soc: vec![0.0, 0.5, 1.0],
        temperature_c: vec![0.0, 40.0],
        aged_ocv: AgedOcv::default(),
        ocv_v: table([[3.0, 3.6, 4.2], [3.0, 3.7, 4.2]]),
        r0_ohm: table([[0.08, 0.06, 0.06], [0.04, 0.03, 0.03]]),
        branches: vec![Branch {
            r_ohm: table([[0.04, 0.02, 0.02], [0.02, 0.01, 0.01]]),
            c_farad: table([[1000.0; 3]; 2]),
        }],
        voltage_error_v: None,
        thermal: Some(Thermal { heat_capacity_j_per_k: 45.0, resistance_k_per_w: 8.0 }),
        spread: None,
    }
}

#[test]
fn tables_are_bilinear_and_exact_at_nodes() {
    let model = small_model();
    assert_eq!(model.ocv_v(&model.grid_position(0.5, 40.0)), 3.7);
    assert!((model.ocv_v(&model.grid_position(0.25, 20.0)) - 3.325).abs() < 1e-12);
}

#[test]
fn resistances_follow_arrhenius_and_time_constants_stay() {
    let mut model = small_model();
    let ratio = arrhenius(0.0) / arrhenius(40.0);
    for (cold, warm) in [(0.08, 0), (0.06, 1), (0.06, 2)] {
        model.r0_ohm.values[0][warm] = cold;
        model.r0_ohm.values[1][warm] = cold / ratio;
    }
    let at = |t_c: f64| model.r0_ohm(&model.grid_position(1.0, t_c));
    for t_c in [0.0, 7.0, 20.0, 33.0, 40.0] {
        assert!((at(t_c) / at(0.0) - arrhenius(t_c) / arrhenius(0.0)).abs() < 1e-12, "{t_c}");
    }
    // All nodes get the same time constant with different resistances.
    for (t, s) in [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)] {
        model.branches[0].c_farad.values[t][s] = 30.0 / model.branches[0].r_ohm.values[t][s];
    }
    assert!((model.branch_tau_s(0, &model.grid_position(0.2, 13.0)) - 30.0).abs() < 1e-12);
}

#[test]
fn only_ocv_continues_outside_the_grid() {
    let model = small_model();
    assert!((model.ocv_v(&model.grid_position(1.1, 0.0)) - 4.32).abs() < 1e-12);
    assert!((model.ocv_v(&model.grid_position(-0.1, 0.0)) - 2.88).abs() < 1e-12);
    assert_eq!(model.r0_ohm(&model.grid_position(-0.1, -30.0)), 0.08);
    assert_eq!(model.r0_ohm(&model.grid_position(1.1, 60.0)), 0.03);
}

#[test]
fn soc_of_ocv_inverts_the_curve() {
    let model = small_model();
    for soc in [-0.1, 0.0, 0.3, 0.5, 0.77, 1.0, 1.05] {
        let voltage = model.ocv_v(&model.grid_position(soc, 17.0));
        assert!((model.soc_of_ocv(voltage, 17.0) - soc).abs() < 1e-9);
    }
}

#[test]
fn aged_voltage_agrees_with_slope_and_inverse() {
    let mut model = small_model();
    model.aged_ocv = AgedOcv::of_shift(0.8, &model.soc, model.capacity_ah, &[vec![3.0, 3.5, 4.0]]);
    let temperature = model.temperature_position(17.0);
    let at = |soc: f64| model.aged_ocv_v(&model.grid_position_at(&temperature, soc), 1.5);
    // A quarter of the capacity is lost. With the shift 0.8, the middle of the curve moves by 0.8 x 0.25 x 0.25 of SOC,
    // and its voltage by 0.05 V.
    let new_v = model.ocv_v(&model.grid_position(0.5, 17.0));
    assert!((at(0.5) - new_v - 0.05).abs() < 1e-12);
    for soc in [-0.1, 0.1, 0.45, 0.7, 1.05] {
        let slope_v = model.ocv_slope_v(&model.grid_position(soc, 17.0), 1.5);
        assert!(((at(soc + 1e-6) - at(soc)) / 1e-6 - slope_v).abs() < 1e-6, "{soc}");
        assert!((model.soc_of_aged_ocv(&temperature, 1.5, at(soc)) - soc).abs() < 1e-9, "{soc}");
    }
}

#[test]
fn rebased_model_has_the_aged_curve() {
    let model = crate::cell::Label::usual(crate::cell::Chemistry::NcaGraphite, 3.0).model().expect("a model");
    for capacity_ah in [2.7, 3.0, 3.1] {
        let rebased = model.rebased(capacity_ah);
        assert_eq!(rebased.capacity_ah, capacity_ah);
        for soc in [0.0, 0.3, 0.62, 1.0] {
            let [old, new] = [&model, &rebased].map(|it| it.aged_ocv_v(&it.grid_position(soc, 20.0), capacity_ah));
            assert!((old - new).abs() < 1e-12, "{capacity_ah} Ah at {soc}: {old} and {new} V");
        }
        assert!(rebased.ocv_v.values.iter().all(|row| row.windows(2).all(|pair| pair[0] < pair[1])));
    }
    assert_eq!(model.rebased(3.0), model);
}
