//! What half-cycles teach, and what they do not.

use super::*;
use crate::cell::estimator::tests::{config as estimator_config, truth};
use crate::cell::model::tests::small_model;
use crate::cell::{CellStep, SensorErrors};

fn config() -> CapacityConfig {
    CapacityConfig {
        method: CapacityMethod::Swing,
        noise_ah_per_cycle: 0.01,
        noise_ah_per_rest_day: 0.0,
        end_error_v: Some(0.0),
        current_gain_std: 0.0,
        current_offset_std_a: 0.0,
        fade_std_ah_per_cycle: 0.0,
        fade_noise_ah_per_cycle: 0.0,
    }
}

/// An hour's discharge at 1 A whose voltages fall from 4.1 V to 3.5 V.
fn discharge(estimator: &mut CellEstimator) {
    for k in 0..360 {
        let step = CellStep {
            measured_s: 10.0,
            charge_as: 10.0,
            offset_s: 10.0,
            unmeasured_s: 0.0,
            current_a: Some(1.0),
            temperature_c: Some(20.0),
            ambient_c: 20.0,
            voltage_v: 4.1 - 0.6 * f64::from(k) / 360.0,
        };
        estimator.step(&small_model(), &estimator_config(), &step);
    }
}

#[test]
fn a_mode_that_begins_in_a_gap_begins_at_the_soc_after_it() {
    let transition = TransitionConfig { dead_band_a: 0.05, hysteresis_a: 0.05, min_duration_s: 0.0, min_swing: 0.02 };
    let mut learner = Learner::new(&config(), vec![ScalarGaussian::from_std(2.0, 0.1)]);
    let at = |soc: f64| Some(ScalarGaussian::from_std(soc, 0.01));
    let (start, end) = (Timestamp::from_secs(5000.0), Timestamp::from_secs(8600.0));
    assert!(!learner.observe(0, Timestamp::from_secs(1000.0), None, 10.0, 0.0));
    learner.mark_candidate(start, 0.0, |_| at(0.1));
    assert!(learner.observe(0, Timestamp::from_secs(5000.1), None, 10.0, 4000.0));
    learner.move_mark(0, at(0.9));
    let mut found = Vec::new();
    learner.complete(&transition, 2.0, Mode::Unknown, &mut found);
    assert!(!learner.observe(0, end, None, 10.0, 0.0));
    learner.mark_candidate(end, 3600.0, |_| at(0.4));
    learner.complete(&transition, 2.0, Mode::Discharge, &mut found);
    assert!((found[0].swing.expect("both ends seen").mean - 0.5).abs() < 1e-12, "{found:?}");
}

#[test]
fn a_half_cycle_is_measured_by_its_own_information() {
    let config = config();
    let mut estimator = CellEstimator::new(&estimator_config());
    let mut learner = Learner::new(&config, vec![estimator.capacity()]);
    let at = |soc| CellMark { soc: Some(ScalarGaussian::from_std(soc, 0.01)), ..CellMark::default() };
    let moved = half_cycle(1.0, 3600.0, &at(0.9), &at(0.4));
    discharge(&mut estimator);
    assert!(!learner.has_learned_all());
    let first = learner.learn(&small_model(), &config, 0, &mut estimator, &moved);
    assert!(first.measurement.is_some() && learner.has_learned_all());
    // No new measurement: the same voltages must not count a second time.
    let second = learner.learn(&small_model(), &config, 0, &mut estimator, &moved);
    assert_eq!(second.measurement, None);
    assert_eq!(moved.swing.map(|swing| swing.mean), Some(0.5));
}

#[test]
fn the_capacity_of_a_label_that_is_returned_to_is_not_learned() {
    let (config, estimator) = (config(), CellEstimator::new(&estimator_config()));
    let mut learner = Learner::new(&config, vec![estimator.capacity()]);
    let [fitted, label] = [1.8, 2.0].map(|ah| ScalarGaussian::from_std(ah, 0.1));
    learner.adopt(&config, 0, Some((fitted, true)), None, &estimator);
    assert_eq!((learner.capacity(0), learner.has_learned(0)), (fitted, true));
    learner.adopt(&config, 0, None, None, &estimator);
    assert_eq!((learner.capacity(0), learner.has_learned(0)), (fitted, true));
    learner.adopt(&config, 0, Some((label, false)), None, &estimator);
    assert_eq!((learner.capacity(0), learner.has_learned(0)), (label, false));
}

#[test]
fn after_a_restart_of_its_filter_a_capacity_is_in_doubt_and_the_half_cycle_teaches_nothing() {
    let config = config();
    let mut estimator = CellEstimator::new(&estimator_config());
    let mut learner = Learner::new(&config, vec![estimator.capacity()]);
    let at = |soc| CellMark { soc: Some(ScalarGaussian::from_std(soc, 0.01)), ..CellMark::default() };
    let moved = half_cycle(1.0, 3600.0, &at(0.9), &at(0.4));
    let learn = |learner: &mut Learner, estimator: &mut CellEstimator| {
        discharge(estimator);
        learner.learn(&small_model(), &config, 0, estimator, &moved)
    };
    let sure = learn(&mut learner, &mut estimator).capacity;
    let new_variance = 0.2 * 0.2;
    assert!(sure.variance < 0.5 * new_variance, "{sure:?}");
    learner.doubt(&config, 0, new_variance, &mut estimator);
    assert_eq!(learner.capacity(0).mean, sure.mean);
    assert!((learner.capacity(0).variance / new_variance - 1.0).abs() < 1e-9, "{:?}", learner.capacity(0));
    assert!(estimator.capacity().variance >= new_variance * (1.0 - 1e-9), "{:?}", estimator.capacity());
    // As stored and restored between the restart and the half-cycle's end.
    let text = serde_json::to_string(&learner).expect("writes");
    let mut learner: Learner = serde_json::from_str(&text).expect("reads");
    let in_doubt = learn(&mut learner, &mut estimator);
    assert_eq!((in_doubt.measurement, in_doubt.capacity.mean), (None, sure.mean));
    assert!(learn(&mut learner, &mut estimator).measurement.is_some());
    // A cell holds at least what was moved at a time.
    learner.doubt(&config, 0, new_variance, &mut estimator);
    let much = HalfCycle { charge_ah: 2.5, ..moved };
    assert_eq!(learner.learn(&small_model(), &config, 0, &mut estimator, &much).capacity.mean, 2.5);
}

/// The capacity after 1,000 half-cycles between 0.8 and 0.3 at 1 A, with 5 mV too much at the upper end of the curve and too
/// little at the lower one, less the true one, in standard deviations.
fn after_a_thousand(config: &CapacityConfig, sensor: SensorErrors) -> f64 {
    let model = small_model();
    let mut estimator_config = estimator_config();
    estimator_config.sensor = sensor;
    let mut estimator = CellEstimator::new(&estimator_config);
    let mut learner = Learner::new(config, vec![estimator.capacity()]);
    let mut truth = truth();
    truth.soc = 0.8;
    for k in 0..1000 {
        let current_a = if k % 2 == 0 { 1.0 } else { -1.0 };
        let mark = |estimator: &CellEstimator| CellMark { soc: estimator.soc(), ..CellMark::default() };
        let (start, mut moved_ah) = (mark(&estimator), 0.0);
        while if current_a > 0.0 { truth.soc > 0.3 } else { truth.soc < 0.8 } {
            let mut step = truth.step(&model, current_a, 30.0);
            step.voltage_v += 0.005 * (4.0 * (truth.soc - 0.55)).clamp(-1.0, 1.0);
            estimator.step(&model, &estimator_config, &step);
            moved_ah += current_a * 30.0 / 3600.0;
        }
        let half_cycle = half_cycle(moved_ah, 3600.0 * moved_ah.abs(), &start, &mark(&estimator));
        learner.learn(&model, config, 0, &mut estimator, &half_cycle);
    }
    let capacity = learner.capacity(0);
    (capacity.mean - truth.capacity_ah) / capacity.std()
}

#[test]
fn a_thousand_equal_half_cycles_with_the_same_errors_are_one_witness() {
    let config = CapacityConfig { end_error_v: Some(0.005), noise_ah_per_cycle: 0.001, ..config() };
    let sensor = SensorErrors { voltage_offset_v: 0.004, current_gain: 0.005, ..SensorErrors::NONE };
    let deviations = after_a_thousand(&config, sensor);
    assert!(deviations.abs() < 1.96, "{deviations}");
    // Errors that are taken for noise average out, and the interval is left without the truth.
    let without = after_a_thousand(&CapacityConfig { end_error_v: Some(0.0), ..config }, SensorErrors::NONE);
    assert!(without.abs() > 3.0, "{without}");
}
