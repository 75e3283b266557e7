//! Noise and memory against their closed forms.

use super::super::tests::config;
use super::*;
use crate::cell::Table;
use crate::cell::model::tests::small_model;

fn step(current_a: f64, measured_s: f64, unmeasured_s: f64) -> CellStep {
    CellStep {
        measured_s,
        charge_as: current_a * measured_s,
        unmeasured_s,
        current_a: Some(current_a),
        temperature_c: Some(25.0),
        ambient_c: 25.0,
        voltage_v: 3.6,
    }
}

fn near(a: f64, b: f64) -> bool {
    (a - b).abs() < 1e-9 * b.abs().max(1.0)
}

#[test]
fn a_rest_counts_the_logarithm_of_its_length_at_any_sample_rate() {
    let config = config();
    for dt_s in [1.0, 60.0, 3600.0] {
        let mut estimator = CellEstimator::new(&config);
        let steps = (36_000.0 / dt_s) as u32;
        let information_s: f64 = (0..steps).map(|_| estimator.new_information_s(&config, &step(0.0, dt_s, 0.0))).sum();
        // 10 h are worth 3.6 times 1000 s.
        assert!(near(information_s, REST_REPEATS_S * libm::log(1.0 + 36.0)), "{dt_s}: {information_s}");
    }
}

#[test]
fn under_load_and_after_a_gap_all_time_counts_and_the_rest_starts_again() {
    let config = config();
    let mut estimator = CellEstimator::new(&config);
    let fresh_s = estimator.new_information_s(&config, &step(0.0, 10.0, 0.0));
    estimator.new_information_s(&config, &step(0.0, 7200.0, 0.0));
    let late_s = estimator.new_information_s(&config, &step(config.rest_current_a, 10.0, 0.0));
    assert!(late_s < 0.15 * fresh_s, "{late_s} {fresh_s}");
    for interruption in [step(1.0, 10.0, 0.0), step(-1.0, 10.0, 0.0), step(0.0, 0.0, 10.0)] {
        assert_eq!(estimator.new_information_s(&config, &interruption), 10.0);
        assert_eq!(estimator.new_information_s(&config, &step(0.0, 10.0, 0.0)), fresh_s);
    }
}

#[test]
fn the_load_decays_exponentially_in_both_directions() {
    let (config, model) = (config(), small_model());
    let mut estimator = CellEstimator::new(&config);
    for current_a in [2.0, -2.0] {
        estimator.memory.load_a = 0.5;
        for _ in 0..60 {
            estimator.update_load_memory(&model, &config, &step(current_a, 10.0, 0.0));
        }
        let keep = libm::exp(-600.0 / config.load_memory_s);
        assert!(near(estimator.memory.load_a, 2.0 + (0.5 - 2.0) * keep), "{}", estimator.memory.load_a);
    }
}

#[test]
fn a_gap_next_to_a_load_counts_as_the_heaviest_usual_load_and_a_gap_at_rest_as_rest() {
    let (config, model) = (config(), small_model());
    let mut estimator = CellEstimator::new(&config);
    estimator.memory.load_a = 0.5;
    estimator.update_load_memory(&model, &config, &step(0.0, 0.0, config.load_memory_s));
    assert!(near(estimator.memory.load_a, 0.5 * libm::exp(-1.0)), "{}", estimator.memory.load_a);
    estimator.update_load_memory(&model, &config, &step(1.0, 0.0, 60.0));
    assert_eq!(estimator.memory.load_a, model.rated_capacity_ah * GAP_LOAD_PER_H);
    estimator.update_load_memory(&model, &config, &step(5.0, 0.0, 60.0));
    assert_eq!(estimator.memory.load_a, 5.0);
}

#[test]
fn the_resistance_does_not_walk_through_a_long_step_and_branches_settle() {
    let (config, model) = (config(), small_model());
    let position = model.grid_position(0.5, 25.0);
    let q = process::<4>(&model, &config, &position, 1e6);
    assert!(near(q[(1, 1)], square(config.log_resistance_noise_per_sqrt_s) * MAX_WALK_S));
    assert!(near(q[(3, 3)], square(config.branch_noise_v_per_sqrt_s) * 0.5 * model.branch_tau_s(0, &position)));
    assert_eq!((q[(0, 0)], q[(2, 2)]), (0.0, 0.0));
}

#[test]
fn the_variance_of_a_reading_sums_sensor_model_drop_and_load() {
    let (mut config, mut model) = (config(), small_model());
    config.voltage_noise_v = 0.0;
    let mut x = Gaussian::<4> { mean: nalgebra::SVector::zeros(), covariance: SMatrix::identity() };
    (x.mean[0], x.mean[3], x.mean[2]) = (0.5, 0.05, 2.0);
    let of = |model: &CellModel, load_a: f64, current_a: f64, information_s: f64| {
        VoltageReading {
            voltage_v: 3.6,
            current_a,
            load_a,
            temperature: model.temperature_position(0.0),
            information_s,
        }
        .noise(&x, model, &config)
    };
    let at = |load_a: f64, current_a: f64, information_s: f64| of(&model, load_a, current_a, information_s);
    // At 0 C and a SOC of 0.5: 60 + 20 mohm.
    let (base, drop, load) = (0.15 * 0.15, square(0.3 * (0.06 * 2.0 + 0.05)), square(0.5 * 0.08 * 5.0));
    assert!(near(at(5.0, 2.0, 10.0).variance, (base + drop + load) / 10.0));
    assert!(near(at(0.0, 2.0, 1.0).variance, base + drop));
    assert_eq!(at(5.0, 2.0, 10.0).gate_variance, at(0.0, 0.0, 1.0).gate_variance);
    // The model's own error is an average over 100 s: 20 mV there are 0.2 V over one second.
    model.voltage_error_v = Some(Table { values: vec![vec![0.01, 0.02, 0.03]; 2] });
    let variance = of(&model, 0.0, 2.0, 1.0).variance;
    assert!(near(variance, 0.2 * 0.2 + drop), "{variance} {}", 0.2 * 0.2 + drop);
}
