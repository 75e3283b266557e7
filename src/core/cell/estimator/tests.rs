//! Tests the estimator on a simulated cell that follows the estimator's own model without noise.

mod robust;
pub(super) mod textbook;

use super::state_vector::UNKNOWN_SOC_VARIANCE;
use super::{CellEstimator, CellStep, EstimatorBank, StepResult};
use crate::cell::circuit::{self, BranchAt};
use crate::cell::model::tests::small_model;
use crate::cell::{
    CapacityState, CellModel, ConsistencySettings, Discretisation, EstimatorConfig, GapSettings, GateSettings,
    InitialState, ProcessNoise, SensorErrors, SigmaPointSettings, VoltageError,
};
use crate::filter::ScalarGaussian;

pub(crate) fn config() -> EstimatorConfig {
    EstimatorConfig {
        points: SigmaPointSettings { alpha: 1.0, beta: 2.0, kappa: 0.0 },
        discretisation: Discretisation::Exact,
        capacity_state: CapacityState::Joint,
        initial: InitialState {
            soc: None,
            soc_std: 0.3,
            branch_std_v: 0.05,
            capacity_ah: 2.0,
            capacity_std_ah: 0.2,
            curve: ScalarGaussian::from_std(2.0, 0.06),
            log_resistance_std: 0.2,
        },
        process: ProcessNoise {
            soc_per_sqrt_s: 3e-5,
            charge_per_sqrt_soc: 3e-3,
            branch_v_per_sqrt_s: 1e-3,
            log_resistance_per_sqrt_s: 3e-4,
        },
        gap: GapSettings {
            noise_per_sqrt_s: 1.5e-5,
            self_discharge_per_s: 1e-8,
            away_use_per_s: 0.0,
            rest_current_a: 0.04,
            silence_is_rest: false,
        },
        voltage: VoltageError {
            noise_v: 0.005,
            model_error_v_sqrt_s: 0.15,
            drop_error_sqrt_s: 0.3,
            load_error_sqrt_s: 0.5,
            load_memory_s: 1200.0,
            max_information_s: 100.0,
        },
        sensor: SensorErrors::NONE,
        gate: GateSettings { sigma: 5.0, model_error_v: 0.06, soc_error: 0.02, lost_after_s: 30.0 },
        consistency: ConsistencySettings { window_s: 600.0, limit: 4.0 },
    }
}

impl CellEstimator {
    pub(crate) fn step(&mut self, model: &CellModel, config: &EstimatorConfig, step: &CellStep) -> StepResult {
        let mut bank = EstimatorBank::new(model, config, 1);
        bank.put(0, self);
        bank.add(0, step);
        bank.step();
        *self = bank.cell(0);
        *bank.result(0)
    }
}

/// The simulated cell. `ratio` is its resistance relative to the model.
pub(crate) struct Truth {
    pub(crate) soc: f64,
    branch_v: f64,
    pub(crate) capacity_ah: f64,
    ratio: f64,
}

impl Truth {
    pub(crate) fn step(&mut self, model: &CellModel, current_a: f64, dt_s: f64) -> CellStep {
        let position = model.grid_position(self.soc, 25.0);
        let branch = BranchAt::new(model, 0, &position, self.ratio);
        self.branch_v = branch.voltage_after(Discretisation::Exact, self.branch_v, current_a, dt_s);
        self.soc = circuit::soc_after(self.soc, current_a * dt_s, self.capacity_ah);
        let state = (self.soc, self.ratio, self.capacity_ah);
        let temperature = model.temperature_position(25.0);
        CellStep {
            measured_s: dt_s,
            charge_as: current_a * dt_s,
            offset_s: dt_s,
            unmeasured_s: 0.0,
            current_a: Some(current_a),
            temperature_c: Some(25.0),
            ambient_c: 25.0,
            voltage_v: circuit::aged_terminal_v(model, state, &temperature, self.branch_v, current_a),
            is_voltage_frozen: false,
        }
    }
}

/// Discharges and charges the cell between SOC 0.9 and 0.1 for `hours`, in steps of `dt_s`.
fn cycle(estimator: &mut CellEstimator, config: &EstimatorConfig, truth: &mut Truth, dt_s: f64, hours: f64) {
    let model = small_model();
    let mut current_a = 1.0;
    for _ in 0..(hours * 3600.0 / dt_s) as u32 {
        if truth.soc < 0.1 {
            current_a = -1.0;
        } else if truth.soc > 0.9 {
            current_a = 1.0;
        }
        let step = truth.step(&model, current_a, dt_s);
        assert!(!estimator.step(&model, config, &step).reset);
    }
}

pub(crate) fn truth() -> Truth {
    Truth { soc: 0.9, branch_v: 0.0, capacity_ah: 1.7, ratio: 1.3 }
}

fn soc(estimator: &CellEstimator) -> ScalarGaussian {
    estimator.soc().expect("started")
}

#[test]
fn wrong_capacity_and_resistance_converge() {
    let (config, mut truth) = (config(), truth());
    let mut estimator = CellEstimator::new(&config);
    cycle(&mut estimator, &config, &mut truth, 1.0, 12.0);
    let (capacity, log_r) = (estimator.capacity(), estimator.log_resistance());
    assert!((capacity.mean - 1.7).abs() < 2.0 * capacity.std(), "{capacity:?}");
    assert!(capacity.std() < 0.05, "{capacity:?}");
    assert!((log_r.mean - libm::log(1.3)).abs() < 2.0 * log_r.std() + 0.02, "{log_r:?}");
    assert!((soc(&estimator).mean - truth.soc).abs() < 0.01);
}

#[test]
fn result_is_independent_of_sample_rate() {
    let config = config();
    let run = |dt_s| {
        let (mut estimator, mut truth) = (CellEstimator::new(&config), truth());
        cycle(&mut estimator, &config, &mut truth, dt_s, 6.0);
        (estimator.capacity(), soc(&estimator))
    };
    let (slow, fast) = (run(2.0), run(0.2));
    assert!((slow.0.mean - fast.0.mean).abs() < 0.1 * slow.0.std(), "{slow:?} {fast:?}");
    assert!((slow.0.std() / fast.0.std() - 1.0).abs() < 0.05, "{slow:?} {fast:?}");
    assert!((slow.1.std() / fast.1.std() - 1.0).abs() < 0.05, "{slow:?} {fast:?}");
}

#[test]
fn wrong_initial_soc_recovers() {
    let mut config = config();
    config.initial.soc = Some(0.6);
    let (mut estimator, mut truth) = (CellEstimator::new(&config), truth());
    cycle(&mut estimator, &config, &mut truth, 1.0, 0.5);
    assert!((soc(&estimator).mean - truth.soc).abs() < 0.02, "{:?} {}", soc(&estimator), truth.soc);
}

#[test]
fn rejected_glitch_still_counts_its_charge() {
    let (config, mut truth, model) = (config(), truth(), small_model());
    let mut estimator = CellEstimator::new(&config);
    cycle(&mut estimator, &config, &mut truth, 1.0, 1.0);
    let before = soc(&estimator).mean;
    let mut step = truth.step(&model, 1.0, 1.0);
    step.voltage_v += 1.0;
    let result = estimator.step(&model, &config, &step);
    assert!(result.update.is_some_and(|update| !update.accepted) && !result.reset);
    let moved = before - soc(&estimator).mean;
    assert!((moved - 1.0 / (3600.0 * estimator.capacity().mean)).abs() < 1e-6, "{moved}");
}

#[test]
fn lost_filter_restarts_and_keeps_capacity() {
    let (config, mut truth, model) = (config(), truth(), small_model());
    let mut estimator = CellEstimator::new(&config);
    cycle(&mut estimator, &config, &mut truth, 1.0, 6.0);
    let capacity = estimator.capacity();
    truth.soc = if truth.soc > 0.5 { 0.05 } else { 0.95 }; // charge moved without a measurement
    let resets = (0..120).filter(|_| {
        let step = truth.step(&model, 0.0, 1.0);
        estimator.step(&model, &config, &step).reset
    });
    assert_eq!(resets.count(), 1);
    assert!((soc(&estimator).mean - truth.soc).abs() < 0.05);
    assert!((estimator.capacity().mean - capacity.mean).abs() < 3.0 * capacity.std());
}

#[test]
fn unmeasured_load_widens_soc_unless_voltage_known() {
    let (config, mut truth, model) = (config(), truth(), small_model());
    let mut estimator = CellEstimator::new(&config);
    cycle(&mut estimator, &config, &mut truth, 1.0, 1.0);
    let before = soc(&estimator);
    let rest = (0..1800).map(|_| truth.step(&model, 1.0, 1.0)).last().expect("steps");
    let lost = CellStep { unmeasured_s: 1800.0, current_a: None, is_voltage_frozen: true, ..rest };
    let result = estimator.step(&model, &config, &lost);
    assert_eq!(result.update, None);
    // In half an hour, 1 A takes 0.5 Ah out of 1.7 Ah, which is 0.29 of SOC.
    let without = soc(&estimator);
    assert!(without.std() > before.std() + 0.1, "{without:?}");
    // The voltage error includes the drop of an unknown current of up to 1 C in either direction.
    let open = CellStep { unmeasured_s: 1.0, is_voltage_frozen: false, ..lost };
    (0..1000).for_each(|_| _ = estimator.step(&model, &config, &open));
    let with = soc(&estimator);
    let position = model.grid_position(truth.soc, 25.0);
    let drop = 1.8 * truth.ratio * model.settled_ohm(&position) / 3.0_f64.sqrt() / model.ocv_slope_v(&position, 1.8);
    assert!((with.mean - truth.soc).abs() < 2.0 * with.std(), "{with:?} {}", truth.soc);
    assert!(with.std() < without.std() && with.std() > 0.7 * drop, "{with:?} {without:?} {drop}");
}

#[test]
fn voltage_finds_soc_while_current_lost() {
    let (config, mut truth, model) = (config(), truth(), small_model());
    let mut estimator = CellEstimator::new(&config);
    cycle(&mut estimator, &config, &mut truth, 1.0, 1.0);
    // A discharge with 1 A for 40 min, in which no current is measured.
    let (start, before) = (truth.soc, soc(&estimator));
    for _ in 0..2400 {
        let moved = truth.step(&model, 1.0, 1.0);
        let lost =
            CellStep { measured_s: 0.0, charge_as: 0.0, offset_s: 0.0, unmeasured_s: 1.0, current_a: None, ..moved };
        estimator.step(&model, &config, &lost);
        assert!(soc(&estimator).std() >= before.std(), "{before:?} {:?}", soc(&estimator));
    }
    let found = soc(&estimator);
    assert!(start - truth.soc > 0.3, "{start} {}", truth.soc);
    assert!((found.mean - truth.soc).abs() < 2.0 * found.std(), "{found:?} {}", truth.soc);
    assert!(found.std() < 0.12, "{found:?}");
}

#[test]
fn lost_current_widens_soc_linearly() {
    let (config, mut truth, model) = (config(), truth(), small_model());
    let mut estimator = CellEstimator::new(&config);
    cycle(&mut estimator, &config, &mut truth, 1.0, 1.0);
    let (before, capacity_ah) = (soc(&estimator), estimator.capacity().mean);
    for _ in 0..120 {
        let lost = CellStep {
            measured_s: 0.0,
            charge_as: 0.0,
            offset_s: 0.0,
            unmeasured_s: 10.0,
            current_a: None,
            is_voltage_frozen: true,
            ..truth.step(&model, 1.0, 1.0)
        };
        estimator.step(&model, &config, &lost);
    }
    // The unmeasured current is assumed to be constant. Each current between 0 and the last known load is equally
    // likely.
    let load_std = 1200.0 / (3600.0 * capacity_ah) / 3.0_f64.sqrt();
    let added = (soc(&estimator).variance - before.variance).sqrt();
    assert!((added / load_std - 1.0).abs() < 0.05, "{added} {load_std}");
}

#[test]
fn slowest_branch_ratio_is_learned() {
    let mut model = small_model();
    let mut slow = model.branches[0].clone();
    slow.r_ohm.values.iter_mut().flatten().for_each(|r_ohm| *r_ohm *= 5.0);
    slow.c_farad.values.iter_mut().flatten().for_each(|c_farad| *c_farad *= 2.0);
    model.branches.push(slow);
    let soc_error_points = |config: &EstimatorConfig| {
        let mut estimator = CellEstimator::new(config);
        let (mut truth, mut slow_v, mut worst) = (truth(), 0.0, 0.0_f64);
        for half_cycle in 0..20 {
            let current_a = if half_cycle % 2 == 0 { 1.0 } else { -1.0 };
            for k in 0..240 {
                let current_a = if k < 80 { 0.0 } else { current_a };
                let mut step = truth.step(&model, current_a, 15.0);
                // The slow branch of the simulated cell has half of the model's resistance.
                let position = model.grid_position(truth.soc, 25.0);
                let branch = BranchAt::new(&model, 1, &position, 0.5 * truth.ratio);
                slow_v = branch.voltage_after(Discretisation::Exact, slow_v, current_a, 15.0);
                step.voltage_v -= slow_v;
                estimator.step(&model, config, &step);
            }
            estimator.learn_slow_branch(config);
            if half_cycle >= 16 {
                worst = worst.max(100.0 * (soc(&estimator).mean - truth.soc).abs());
            }
        }
        (estimator.slow_ratio(config), worst)
    };
    let mut config = config();
    let (_, unlearned) = soc_error_points(&config);
    config.sensor.slow_branch = 0.3;
    let (ratio, learned) = soc_error_points(&config);
    assert!((ratio.mean - 0.5).abs() < 1.96 * ratio.std(), "{ratio:?}");
    assert!(learned < 0.5 * unlearned, "{learned} {unlearned} points");
}

#[test]
fn unknown_soc_variance_is_limited() {
    let (config, mut truth, model) = (config(), truth(), small_model());
    let mut estimator = CellEstimator::new(&config);
    cycle(&mut estimator, &config, &mut truth, 1.0, 0.1);
    for _ in 0..50 {
        let step = CellStep { unmeasured_s: 1e6, current_a: None, ..truth.step(&model, 1.0, 1.0) };
        estimator.step(&model, &config, &step);
    }
    assert!(soc(&estimator).variance < 0.1);
    estimator.handle_unknown_gap();
    assert!((soc(&estimator).variance - UNKNOWN_SOC_VARIANCE).abs() < 0.02);
}

#[test]
fn unseen_charge_moves_soc_not_capacity() {
    let (mut config, model) = (config(), small_model());
    config.gap.away_use_per_s = 0.5 / 3600.0;
    // Only the discharges are measured, not the charges between them. Before and after each gap, a load of C/20 flows.
    let mut truth = Truth { soc: 0.8, branch_v: 0.0, capacity_ah: 2.0, ratio: 1.0 };
    let mut estimator = CellEstimator::new(&config);
    for _ in 0..40 {
        for _ in 0..720 {
            estimator.step(&model, &config, &truth.step(&model, 1.0, 1.0));
        }
        estimator.step(&model, &config, &truth.step(&model, 0.1, 1.0));
        (truth.soc, truth.branch_v) = (0.8, 0.0);
        let step = CellStep { unmeasured_s: 43_200.0, ..truth.step(&model, 0.1, 1.0) };
        assert!(!estimator.step(&model, &config, &step).reset);
        let soc = soc(&estimator);
        assert!((soc.mean - truth.soc).abs() < 0.03 && (soc.mean - truth.soc).abs() < 1.96 * soc.std(), "{soc:?}");
    }
    let capacity = estimator.capacity();
    assert!((capacity.mean - 2.0).abs() < 0.05, "{capacity:?}");
}

#[test]
fn silent_gap_is_rest_if_configured() {
    let after = |silence_is_rest: bool, unmeasured_s: f64| {
        let (mut config, mut truth, model) = (config(), truth(), small_model());
        config.gap.silence_is_rest = silence_is_rest;
        let mut estimator = CellEstimator::new(&config);
        cycle(&mut estimator, &config, &mut truth, 1.0, 0.1);
        // The voltage arrives without a current, so the filter does not use it.
        let step = CellStep { unmeasured_s, current_a: None, ..truth.step(&model, 1.0, 1.0) };
        estimator.step(&model, &config, &step);
        soc(&estimator).std()
    };
    assert!(after(false, 600.0) > 2.0 * after(true, 600.0), "{} {}", after(false, 600.0), after(true, 600.0));
    assert_eq!(after(false, 4.0), after(true, 4.0), "the voltage came meanwhile: only the current is missing");
}

#[test]
fn thermal_model_replaces_missing_sensor() {
    let (config, mut truth, model) = (config(), truth(), small_model());
    let mut estimator = CellEstimator::new(&config);
    estimator.step(&model, &config, &truth.step(&model, 2.0, 1.0));
    for _ in 0..600 {
        let step = CellStep { temperature_c: None, ..truth.step(&model, 2.0, 1.0) };
        estimator.step(&model, &config, &step);
    }
    let warmed_c = estimator.memory.temperature_c.expect("known") - 25.0;
    assert!((0.2..5.0).contains(&warmed_c), "{warmed_c}");
}

#[test]
fn restored_estimator_continues_with_equal_bits() {
    let (config, mut truth, model) = (config(), truth(), small_model());
    let mut estimator = CellEstimator::new(&config);
    cycle(&mut estimator, &config, &mut truth, 1.0, 0.3);
    let mut restored = CellEstimator::restore(&estimator.snapshot(), 1).expect("fits");
    for _ in 0..100 {
        let step = truth.step(&model, 1.0, 1.0);
        assert_eq!(estimator.step(&model, &config, &step), restored.step(&model, &config, &step));
    }
    assert_eq!(estimator.snapshot(), restored.snapshot());
    assert!(CellEstimator::restore(&estimator.snapshot(), 2).is_none());
}

#[test]
fn held_capacity_is_the_papers_filter() {
    let config = EstimatorConfig { capacity_state: CapacityState::Held, ..config() };
    let (mut estimator, mut truth) = (CellEstimator::new(&config), truth());
    cycle(&mut estimator, &config, &mut truth, 1.0, 2.0);
    assert!((estimator.capacity().mean - 2.0).abs() < 1e-6);
    estimator.hold_capacity(1.9);
    assert_eq!(estimator.capacity().mean, 1.9);
}

#[test]
fn two_and_three_branches_estimate_the_soc() {
    for branches in [2, 3] {
        let mut model = small_model();
        for _ in 1..branches {
            model.branches.push(model.branches[0].clone());
        }
        let config = config();
        let mut estimator = CellEstimator::new(&config);
        let mut truth = truth();
        for _ in 0..600 {
            let mut step = truth.step(&model, 1.0, 1.0);
            step.voltage_v -= truth.branch_v * f64::from(branches - 1); // the cell's branches are equal, too
            estimator.step(&model, &config, &step);
        }
        assert!((soc(&estimator).mean - truth.soc).abs() < 0.02, "{branches} branches");
        assert_eq!(estimator.branch_v().iter().filter(|v| v.is_finite()).count(), branches as usize);
    }
}

#[test]
fn restated_capacity_never_lowers_the_variance() {
    let (config, mut truth) = (config(), truth());
    let mut estimator = CellEstimator::new(&config);
    estimator.restate_capacity(ScalarGaussian::from_std(1.9, 0.1));
    assert_eq!(estimator.capacity(), ScalarGaussian::from_std(1.9, 0.1)); // before the first voltage
    cycle(&mut estimator, &config, &mut truth, 1.0, 2.0);
    let before = estimator.capacity();
    estimator.restate_capacity(ScalarGaussian { mean: 1.5, variance: 0.1 * before.variance });
    assert_eq!(estimator.capacity(), ScalarGaussian { mean: 1.5, variance: before.variance });
    estimator.restate_capacity(ScalarGaussian { mean: 1.6, variance: 9.0 * before.variance });
    assert_eq!(estimator.capacity(), ScalarGaussian { mean: 1.6, variance: 9.0 * before.variance });
}

#[test]
fn aged_cell_starts_on_aged_curve() {
    let mut model = small_model();
    model.aged_ocv = crate::cell::AgedOcv::of_shift(0.8, &model.soc, model.capacity_ah, &model.ocv_v.values);
    let mut config = config();
    config.initial.capacity_ah = 1.5;
    config.initial.curve = ScalarGaussian::from_std(1.5, 0.0);
    // The initial SOC is so certain that the first voltage does not change it.
    config.initial.soc_std = 1e-3;
    let mut truth = Truth { soc: 0.4, branch_v: 0.0, capacity_ah: 1.5, ratio: 1.0 };
    let mut estimator = CellEstimator::new(&config);
    let step = truth.step(&model, 0.0, 1.0);
    estimator.step(&model, &config, &step);
    let soc = estimator.soc().expect("started").mean;
    assert!((soc - 0.4).abs() < 0.005, "{soc}");
}
