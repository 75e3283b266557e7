//! Compares the process and measurement noise with closed formulas.

use super::*;
use crate::cell::Table;
use crate::cell::estimator::tests::config;
use crate::cell::model::tests::small_model;

fn near(a: f64, b: f64) -> bool {
    (a - b).abs() < 1e-9 * b.abs().max(1.0)
}

#[test]
fn process_noise_is_bounded_in_long_steps() {
    let (config, model) = (config(), small_model());
    let position = model.grid_position(0.5, 25.0);
    let q = process::<4>(&model, &config, &position, 1e6);
    assert!(near(q[(1, 1)], square(config.process.log_resistance_per_sqrt_s) * MAX_WALK_S));
    assert!(near(q[(3, 3)], square(config.process.branch_v_per_sqrt_s) * 0.5 * model.branch_tau_s(0, &position)));
    assert_eq!((q[(0, 0)], q[(2, 2)]), (0.0, 0.0));
}

#[test]
fn reading_variance_sums_its_parts() {
    let (mut config, mut model) = (config(), small_model());
    config.voltage.noise_v = 0.0;
    let mut x =
        Gaussian::<4> { mean: SVector::zeros(), covariance: SMatrix::identity(), by_constant: SMatrix::zeros() };
    (x.mean[0], x.mean[3], x.mean[2]) = (0.5, 0.05, 2.0);
    let of = |model: &CellModel, load_a: f64, current_a: f64, information_s: f64| {
        VoltageReading {
            voltage_v: 3.6,
            current_a,
            load_a,
            temperature: model.temperature_position(0.0),
            information_s,
            curve: ScalarGaussian::from_std(2.0, 0.1),
            slow_ratio: 1.0,
            slow_std: 0.0,
        }
        .noise(&x, model, &config)
    };
    let at = |load_a: f64, current_a: f64, information_s: f64| of(&model, load_a, current_a, information_s);
    // At 0 degrees C and SOC 0.5, the series resistance is 60 mohm, and the branch has 20 mohm.
    let (base, drop, load) = (0.15 * 0.15, square(0.3 * (0.06 * 2.0 + 0.05)), square(0.5 * 0.08 * 5.0));
    assert!(near(at(5.0, 2.0, 10.0).variance, (base + drop + load) / 10.0));
    assert!(near(at(0.0, 2.0, 1.0).variance, base + drop));
    assert_eq!(at(5.0, 2.0, 10.0).gate_variance, at(0.0, 0.0, 1.0).gate_variance);
    // The model states its error as an average over 100 s. Noise averages out with the square root of the time, so 20
    // mV over 100 s correspond to 0.2 V over one second.
    model.voltage_error_v = Some(Table { values: vec![vec![0.01, 0.02, 0.03]; 2] });
    let variance = of(&model, 0.0, 2.0, 1.0).variance;
    assert!(near(variance, 0.2 * 0.2 + drop), "{variance} {}", 0.2 * 0.2 + drop);
}
