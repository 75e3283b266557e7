//! Tests of capacity learning from half-cycles.

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

/// Discharges for an hour at 1 A while the voltage falls from 4.1 V to 3.5 V.
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
            is_voltage_frozen: false,
        };
        estimator.step(&small_model(), &estimator_config(), &step);
    }
}

#[test]
fn mode_begun_in_gap_starts_at_soc_after_gap() {
    let transition = TransitionConfig { dead_band_a: 0.05, hysteresis_a: 0.05, min_duration_s: 0.0, min_swing: 0.02 };
    let mut learner = Learner::new(&config(), vec![ScalarGaussian::from_std(2.0, 0.1)]);
    let at = |soc: f64| (Some(ScalarGaussian::from_std(soc, 0.01)), Some(soc));
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
    assert!((found[0].swing.expect("the SOC of both ends is known").mean - 0.5).abs() < 1e-12, "{found:?}");
}

#[test]
fn half_cycle_without_new_voltages_measures_nothing() {
    let config = config();
    let mut estimator = CellEstimator::new(&estimator_config());
    let mut learner = Learner::new(&config, vec![estimator.capacity()]);
    let at = |soc| CellMark { soc: Some(ScalarGaussian::from_std(soc, 0.01)), ..CellMark::default() };
    let moved = half_cycle(1.0, 3600.0, &at(0.9), &at(0.4));
    discharge(&mut estimator);
    assert!(!learner.has_learned_all());
    let first = learner.learn(&small_model(), &config, 0, &mut estimator, &moved);
    assert!(first.measurement.is_some() && learner.has_learned_all());
    // Without new voltages, the information that has already been used does not count again.
    let second = learner.learn(&small_model(), &config, 0, &mut estimator, &moved);
    assert_eq!(second.measurement, None);
    assert_eq!(moved.swing.map(|swing| swing.mean), Some(0.5));
}

#[test]
fn capacity_of_readopted_label_is_not_learned() {
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
fn half_cycle_with_filter_restart_measures_nothing() {
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
    let text = serde_json::to_string(&learner).expect("writes");
    let mut learner: Learner = serde_json::from_str(&text).expect("reads");
    let in_doubt = learn(&mut learner, &mut estimator);
    assert_eq!((in_doubt.measurement, in_doubt.capacity.mean), (None, sure.mean));
    assert!(learn(&mut learner, &mut estimator).measurement.is_some());
    // The capacity is at least the charge that was moved in one half-cycle.
    learner.doubt(&config, 0, new_variance, &mut estimator);
    let much = HalfCycle { charge_ah: 2.5, ..moved };
    assert_eq!(learner.learn(&small_model(), &config, 0, &mut estimator, &much).capacity.mean, 2.5);
}

/// Error of the learned capacity, in standard deviations, after 1,000 half-cycles between SOC 0.8 and 0.3 at 1 A. The
/// voltage is 5 mV too high at SOC 0.8 and 5 mV too low at SOC 0.3; in between, the error is linear.
fn deviations_after_thousand_half_cycles(config: &CapacityConfig, sensor: SensorErrors) -> f64 {
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
fn lasting_errors_of_equal_half_cycles_stay_in_interval() {
    let config = CapacityConfig { end_error_v: Some(0.005), noise_ah_per_cycle: 0.001, ..config() };
    let sensor = SensorErrors { voltage_offset_v: 0.004, current_gain: 0.005, ..SensorErrors::NONE };
    let deviations = deviations_after_thousand_half_cycles(&config, sensor);
    assert!(deviations.abs() < 1.96, "{deviations}");
    // If the filter treated the voltage's error as new noise in each half-cycle, it would expect the error to average
    // out, and the interval would exclude the true capacity.
    let without =
        deviations_after_thousand_half_cycles(&CapacityConfig { end_error_v: Some(0.0), ..config }, SensorErrors::NONE);
    assert!(without.abs() > 3.0, "{without}");
}

#[test]
fn contradicting_half_cycle_widens_belief_and_changes_no_capacity() {
    let config = config();
    let mut estimator = CellEstimator::new(&estimator_config());
    let mut learner = Learner::new(&config, vec![estimator.capacity()]);
    let belief = ScalarGaussian::from_std(4.0, 0.02);
    (learner.drift[0], learner.capacity[0]) = (DriftFilter::new(&config, belief), belief);
    let at = |soc| CellMark { soc: Some(ScalarGaussian::from_std(soc, 0.01)), ..CellMark::default() };
    let moved = half_cycle(1.0, 3600.0, &at(0.9), &at(0.4));
    discharge(&mut estimator);
    let model = small_model();
    let update = learner.learn(&model, &config, 0, &mut estimator, &moved);
    assert_eq!((update.measurement, learner.has_learned(0)), (None, false));
    assert!((update.capacity.mean - 4.0).abs() < 1e-12, "{update:?}");
    let widest = f64::hypot(0.02, NEW_SPREAD * model.capacity_ah);
    assert!((update.capacity.std() - widest).abs() < 1e-9, "{update:?} {widest}");
}

/// Runs three discharges from SOC 0.9 to 0.3, each followed by a charge, with a cell of 1.6 Ah whose label says 2.0 Ah.
/// The cell model comes from the label, and the voltages show the true SOC. `is_doubtful`: whether the current is
/// doubtful in the first part of each discharge and at the end of each charge.
fn learned_by_label(is_doubtful: bool) -> Learner {
    let transition = TransitionConfig { dead_band_a: 0.05, hysteresis_a: 0.05, min_duration_s: 0.0, min_swing: 0.02 };
    let (model, true_ah) = (small_model(), 1.6);
    let before = ScalarGaussian::from_std(2.0, 0.2);
    let mut learner = Learner::new(&config(), vec![before]);
    let mut estimator = CellEstimator::new(&estimator_config());
    discharge(&mut estimator);
    let (mut time_s, mut soc, mut half_cycles) = (0.0, 0.9, Vec::new());
    let mut pass = |learner: &mut Learner, from: Mode, moved: f64| {
        (time_s, soc) = (time_s + 3600.0, soc - moved);
        let charge_as = (0.9 - soc) * true_ah * 3600.0;
        let at = (Some(ScalarGaussian::from_std(soc, 0.03)), Some(soc));
        learner.mark_candidate(Timestamp::from_secs(time_s), charge_as, |_| at);
        learner.complete(&transition, 2.0, from, &mut half_cycles);
        learner.prepare(|_| Lesson::ByLabel { before: before.variance, soc_error: 0.02 });
        for half_cycle in half_cycles.drain(..) {
            learner.learn(&model, &config(), 0, &mut estimator, &half_cycle);
            learner.finish();
        }
        if is_doubtful && moved.abs() > 0.1 && moved < 0.4 {
            learner.interrupt_span();
        }
    };
    pass(&mut learner, Mode::Unknown, 0.0);
    for _ in 0..3 {
        for (from, moved) in [(Mode::Discharge, 0.2), (Mode::Rest, 0.0), (Mode::Charge, -0.02), (Mode::Discharge, 0.42)]
        {
            pass(&mut learner, from, moved);
        }
        pass(&mut learner, Mode::Unknown, 0.0);
        pass(&mut learner, Mode::Charge, -0.6);
        pass(&mut learner, Mode::Rest, 0.0);
    }
    learner
}

#[test]
fn label_learns_capacity_from_trips_and_charges() {
    let learner = learned_by_label(false);
    let capacity = learner.capacity(0);
    assert!(learner.has_learned(0), "{capacity:?}");
    assert!((capacity.mean - 1.6).abs() < 2.0 * capacity.std(), "{capacity:?}");
    assert!(capacity.mean < 1.8 && capacity.std() < 0.17, "{capacity:?}");
    // The error of the open-circuit curve is the same in every discharge and charge. It does not average out, so the
    // uncertainty stays above 0.
    assert!(capacity.std() > 0.02, "{capacity:?}");
}

#[test]
fn doubtful_charge_ends_span_and_teaches_nothing() {
    let learner = learned_by_label(true);
    // Only the charge of the second part of each discharge is known, from SOC 0.72 to 0.3.
    let capacity = learner.capacity(0);
    assert!((capacity.mean - 1.6).abs() < 2.0 * capacity.std(), "{capacity:?}");
    assert!(capacity.std() > learned_by_label(false).capacity(0).std(), "{capacity:?}");
}
