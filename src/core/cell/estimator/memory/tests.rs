//! Compares the estimator's memory of recent rest, load and gaps with closed formulas.

use super::super::tests::config;
use super::*;
use crate::cell::CellEstimator;
use crate::cell::model::tests::small_model;

fn step(current_a: f64, measured_s: f64, unmeasured_s: f64) -> CellStep {
    CellStep {
        measured_s,
        charge_as: current_a * measured_s,
        offset_s: measured_s,
        unmeasured_s,
        current_a: Some(current_a),
        temperature_c: Some(25.0),
        ambient_c: 25.0,
        voltage_v: 3.6,
        is_voltage_frozen: false,
    }
}

fn near(a: f64, b: f64) -> bool {
    (a - b).abs() < 1e-9 * b.abs().max(1.0)
}

/// Computes a step whose current is unknown, so that its voltage is not used. Returns how much time of the step counts
/// as new information (s).
fn new_information_s(estimator: &mut CellEstimator, step: CellStep) -> f64 {
    let before_s = estimator.memory.information_s;
    estimator.step(&small_model(), &config(), &CellStep { current_a: None, ..step });
    estimator.memory.information_s - before_s
}

fn started() -> CellEstimator {
    let mut estimator = CellEstimator::new(&config());
    estimator.step(&small_model(), &config(), &step(1.0, 1.0, 0.0));
    estimator
}

#[test]
fn rest_counts_logarithm_of_its_length() {
    for dt_s in [1.0, 60.0, 3600.0] {
        let mut estimator = started();
        let steps = (36_000.0 / dt_s) as u32;
        let information_s: f64 = (0..steps).map(|_| new_information_s(&mut estimator, step(0.0, dt_s, 0.0))).sum();
        // Ten hours of rest are 36 times 1000 s. They count as 1000 s times ln(1 + 36), which is 3.6 times 1000 s.
        assert!(near(information_s, 1000.0 * libm::log(1.0 + 36.0)), "{dt_s}: {information_s}");
    }
}

#[test]
fn load_and_gap_end_the_rest() {
    let (mut estimator, rest_a) = (started(), config().gap.rest_current_a);
    let fresh_s = new_information_s(&mut estimator, step(0.0, 10.0, 0.0));
    new_information_s(&mut estimator, step(0.0, 7200.0, 0.0));
    let late_s = new_information_s(&mut estimator, step(rest_a, 10.0, 0.0));
    assert!(late_s < 0.15 * fresh_s, "{late_s} {fresh_s}");
    for interruption in [step(1.0, 10.0, 0.0), step(-1.0, 10.0, 0.0), step(0.0, 0.0, 10.0), step(0.0, 4.0, 6.0)] {
        assert!(near(new_information_s(&mut estimator, interruption), 10.0));
        assert!(near(new_information_s(&mut estimator, step(0.0, 10.0, 0.0)), fresh_s));
    }
}

#[test]
fn load_decays_exponentially() {
    let mut estimator = started();
    for current_a in [2.0, -2.0] {
        estimator.memory.load_a = 0.5;
        for _ in 0..60 {
            new_information_s(&mut estimator, step(current_a, 10.0, 0.0));
        }
        let keep = libm::exp(-600.0 / config().voltage.load_memory_s);
        assert!(near(estimator.memory.load_a, 2.0 + (0.5 - 2.0) * keep), "{}", estimator.memory.load_a);
    }
}

#[test]
fn gap_after_load_counts_as_heavy_load() {
    let (config, model) = (config(), small_model());
    let mut memory = Memory::new(&config);
    memory.load_a = 0.5;
    memory.pass_gap(&model, &config, &step(0.0, 0.0, config.voltage.load_memory_s));
    assert!(near(memory.load_a, 0.5 * libm::exp(-1.0)), "{}", memory.load_a);
    memory.pass_gap(&model, &config, &step(1.0, 0.0, 60.0));
    assert_eq!(memory.load_a, model.rated_capacity_ah * GAP_LOAD_PER_H);
    memory.pass_gap(&model, &config, &step(5.0, 0.0, 60.0));
    assert_eq!(memory.load_a, 5.0);
}

#[test]
fn possible_use_depends_on_load_and_gap_length() {
    let mut config = config();
    config.gap.away_use_per_s = 0.5 / 3600.0;
    let after = |config: &EstimatorConfig, current_a: f64, gap_s: f64| {
        let mut memory = Memory::new(config);
        let std = memory.note_gap(config, &step(current_a, 0.0, gap_s), 2.0);
        (std, memory.downtime_std, memory.used_prior)
    };
    // A load of 4 A (2 C, for 2 Ah) flows before the gap. If it continued for 900 s, it took out half of the capacity.
    // That is more than a charger with C/2 supplies in this time.
    let (std, downtime_std, used) = after(&config, 4.0, 900.0);
    assert!(
        std == 0.0 && near(downtime_std, 0.5 / 3.0_f64.sqrt()) && near(used, LOADED_PRIOR),
        "{downtime_std} {used}"
    );
    // The cell rests before the gap, but a charger may have been connected during the gap. The probability of this is 0
    // for a gap below an hour, then grows, and is highest from half a day on.
    let (_, downtime_std, used) = after(&config, 0.0, 4320.0);
    assert!(near(downtime_std, 0.6 / 3.0_f64.sqrt()) && near(used, 0.1 * CHARGER_PRIOR), "{downtime_std} {used}");
    assert!([43_200.0, 604_800.0].iter().all(|&gap_s| near(after(&config, 0.0, gap_s).2, CHARGER_PRIOR)));
    assert_eq!(after(&config, 0.0, 3599.0), (0.0, 0.0, 0.0));
    assert!(near(after(&config, 1.0, 1.0).0, 0.5 / 3600.0 / 3.0_f64.sqrt()));
    assert_eq!((after(&config, 1.0, 1.0).1, after(&config, 0.0, 1.0)), (0.0, (0.0, 0.0, 0.0)));
    config.gap.silence_is_rest = true;
    assert_eq!(after(&config, 4.0, 900.0), (0.0, 0.0, 0.0));
}

#[test]
fn noted_downtime_counts_once() {
    let mut config = config();
    config.gap.away_use_per_s = 0.5 / 3600.0;
    let noted = || {
        let mut memory = Memory::new(&config);
        memory.note_downtime(0.5 * 60.0 / 3600.0, USED_PRIOR);
        memory.noted_s = 60.0;
        memory
    };
    let mut at_rest = noted();
    at_rest.note_gap(&config, &step(0.0, 0.0, 60.0), 2.0);
    assert_eq!(at_rest, Memory { noted_s: 0.0, ..noted() });
    // The load of 3 C after the gap may also have flowed during the gap, which would move 0.05 of SOC.
    let mut loaded = noted();
    loaded.note_gap(&config, &step(6.0, 0.0, 60.0), 2.0);
    assert!(near(loaded.downtime_std, 0.05 / 3.0_f64.sqrt()), "{loaded:?}");
    assert!(near(loaded.used_prior, USED_PRIOR), "{loaded:?}");
    let mut used = noted();
    used.end_downtime();
    assert_eq!((used.noted_s, used.downtime_std, used.used_prior), (0.0, 0.0, 0.0));
}
