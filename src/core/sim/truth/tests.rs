//! Compares the true state with closed-form solutions.

use super::*;
use crate::cell::{Branch, Table, Thermal};

pub(crate) fn plain_model(capacity_ah: f64) -> CellModel {
    let k = capacity_ah / 2.6;
    let flat = |value: f64| Table { values: vec![vec![value; 5]] };
    CellModel {
        name: "plain".into(),
        rated_capacity_ah: capacity_ah,
        capacity_ah,
        voltage_min_v: 2.5,
        voltage_max_v: 4.2,
        soc: vec![0.0, 0.1, 0.5, 0.9, 1.0],
        temperature_c: vec![25.0],
        aged_ocv: crate::cell::AgedOcv::default(),
        ocv_v: Table { values: vec![vec![3.0, 3.45, 3.7, 4.08, 4.19]] },
        r0_ohm: flat(0.03 / k),
        branches: vec![Branch { r_ohm: flat(0.02 / k), c_farad: flat(2000.0 * k) }],
        voltage_error_v: None,
        thermal: Some(Thermal { heat_capacity_j_per_k: 45.0 * k, resistance_k_per_w: 8.0 / k }),
        spread: None,
    }
}

pub(crate) fn plain_settings() -> PackSettings {
    PackSettings {
        cells: 1,
        capacity_ah: 2.6,
        initial_soc: 0.9,
        spread: Spread::default(),
        ageing: Ageing::default(),
        hysteresis: Hysteresis::default(),
        leakage_a: 0.0,
        ambient_c: 25.0,
    }
}

fn plain_pack() -> Pack {
    Pack::new(plain_model(2.6), plain_settings(), 1)
}

#[test]
fn constant_current_matches_closed_form_for_any_step() {
    for dt in [0.1, 1.0, 10.0] {
        let mut pack = plain_pack();
        for _ in 0..(600.0 / dt) as u32 {
            pack.step(1.3, dt);
        }
        let cell = pack.cells()[0];
        assert!((cell.soc - (0.9 - 1.3 * 600.0 / (3600.0 * 2.6))).abs() < 1e-12, "dt {dt}");
        let u1 = 1.3 * 0.02 * (1.0 - libm::exp(-600.0 / 40.0));
        assert!((cell.branch_v[0] - u1).abs() < 1e-12, "dt {dt}");
    }
}

#[test]
fn temperature_settles_where_losses_equal_cooling() {
    let mut pack = plain_pack();
    for i in 0..20_000 {
        pack.step(if i % 2 == 0 { 3.0 } else { -3.0 }, 1.0);
    }
    let losses_w = 9.0 * 0.03; // the alternating current keeps the branch voltage near 0
    assert!((pack.cells()[0].temperature_c - (25.0 + 8.0 * losses_w)).abs() < 0.01);
}

#[test]
fn cut_off_current_reaches_requested_voltage() {
    let mut pack = plain_pack();
    pack.step(-2.0, 300.0);
    let current = pack.current_at_highest_a(4.2);
    assert!((pack.highest_v(current) - 4.2).abs() < 1e-12);
}

#[test]
fn hysteresis_separates_curves_by_its_magnitude() {
    let mut settings = plain_settings();
    settings.hysteresis = Hysteresis { magnitude_v: 0.02, rate: 50.0 };
    let mut pack = Pack::new(plain_model(2.6), settings, 1);
    let mut without = plain_pack();
    for (current, shift) in [(1.3, -0.02), (-1.3, 0.02)] {
        for _ in 0..1800 {
            pack.step(current, 1.0);
            without.step(current, 1.0);
        }
        assert!((pack.lowest_v(0.0) - without.lowest_v(0.0) - shift).abs() < 1e-5);
    }
    assert_eq!(without.cells()[0].hysteresis, 0.0);
}

#[test]
fn cycle_and_charge_ageing_add_and_keep_soc() {
    let mut settings = plain_settings();
    settings.ageing = Ageing {
        capacity_loss_ah_per_cycle: 0.05,
        capacity_loss_ah_per_ah: 0.01,
        resistance_growth_per_cycle: 0.1,
        resistance_growth_per_ah: 0.02,
    };
    let mut pack = Pack::new(plain_model(2.6), settings, 1);
    pack.step(1.0, 3600.0);
    let soc = pack.cells()[0].soc;
    pack.complete_cycle();
    let cell = pack.cells()[0];
    assert!((cell.capacity_ah - 2.54).abs() < 1e-12);
    assert!((cell.resistance_ratio - 1.12).abs() < 1e-12);
    assert_eq!((cell.soc, pack.cycles()), (soc, 1));
    for _ in 0..100 {
        pack.complete_cycle();
    }
    assert!(pack.lowest_capacity_ah() > 0.0);
}

#[test]
fn leakage_discharges_a_resting_cell() {
    let mut settings = plain_settings();
    settings.leakage_a = 0.001;
    let mut pack = Pack::new(plain_model(2.6), settings, 1);
    pack.step(0.0, 3600.0 * 100.0);
    assert!((pack.cells()[0].soc - (0.9 - 0.1 / 2.6)).abs() < 1e-12);
}

#[test]
fn spread_matches_setting_and_depends_on_seed() {
    let mut settings = plain_settings();
    settings.cells = 1000;
    settings.spread = Spread { capacity: 0.02, resistance: 0.1, soc: 0.01 };
    let pack = |seed| Pack::new(plain_model(2.6), settings, seed);
    assert_eq!(pack(5).cells(), pack(5).cells());
    assert_ne!(pack(5).cells(), pack(6).cells());
    let std = |value: fn(&TruthCell) -> f64| {
        let values: Vec<f64> = pack(5).cells().iter().map(value).collect();
        let mean = values.iter().sum::<f64>() / 1000.0;
        (values.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / 1000.0).sqrt()
    };
    assert!((std(|c| c.capacity_ah / 2.6) / 0.02 - 1.0).abs() < 0.1);
    assert!((std(|c| c.resistance_ratio) / 0.1 - 1.0).abs() < 0.1);
    assert!((std(|c| c.soc) / 0.01 - 1.0).abs() < 0.1);
}
