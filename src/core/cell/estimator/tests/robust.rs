//! Tests the estimator with wrong initial values, with an offset of the current sensor, and during rests in which the
//! cell's voltage still relaxes. The simulated cell has a slow RC branch that the estimator's model does not have. The
//! simulated readings have no noise.

use super::*;

/// Time constant of the slow branch (s).
const SLOW_TAU_S: f64 = 1500.0;

/// Resistance of the slow branch (ohm): a fifth of the model's resistance. With 15 mohm or more, the intervals would be
/// too narrow: the estimator assumes a model error of 0.15 V over one second by default, and this does not cover an
/// error that lasts for 1500 s.
const SLOW_OHM: f64 = 0.01;

/// Half of the width of a 95 % interval in standard deviations.
const STD_OF_95: f64 = 1.96;

/// An estimator, a cell with the slow branch, and a current sensor with an offset.
struct Bench {
    estimator: CellEstimator,
    config: EstimatorConfig,
    model: CellModel,
    truth: Truth,
    slow_ohm: f64,
    slow_v: f64,
    offset_a: f64,
}

/// Errors during a part of the test, in percentage points of SOC.
#[derive(Debug, Clone, Copy, Default)]
struct StretchErrors {
    largest_error: f64,
    /// Maximum of |error| divided by half of the width of the 95 % interval.
    largest_ratio: f64,
}

impl Bench {
    fn new(soc: f64, initial: Option<(f64, f64)>, slow_ohm: f64, offset_a: f64) -> Self {
        let mut config = config();
        if let Some((soc, std)) = initial {
            (config.initial.soc, config.initial.soc_std) = (Some(soc), std);
        }
        let truth = Truth { soc, branch_v: 0.0, capacity_ah: 2.0, ratio: 1.1 };
        let estimator = CellEstimator::new(&config);
        Self { estimator, config, model: small_model(), truth, slow_ohm, slow_v: 0.0, offset_a }
    }

    fn run(&mut self, current_a: f64, seconds: f64) -> StretchErrors {
        const DT_S: f64 = 5.0;
        let steps = (seconds / DT_S) as u32;
        let mut errors = StretchErrors::default();
        for _ in 0..steps {
            let mut step = self.truth.step(&self.model, current_a, DT_S);
            self.slow_v += (self.slow_ohm * current_a - self.slow_v) * -libm::expm1(-DT_S / SLOW_TAU_S);
            step.voltage_v -= self.slow_v;
            step.charge_as += self.offset_a * DT_S;
            step.current_a = Some(current_a + self.offset_a);
            assert!(!self.estimator.step(&self.model, &self.config, &step).reset, "the filter restarted");
            let (error, half_width) = (self.error_points().abs(), self.half_width_points());
            errors.largest_error = errors.largest_error.max(error);
            errors.largest_ratio = errors.largest_ratio.max(error / half_width);
        }
        errors
    }

    fn error_points(&self) -> f64 {
        100.0 * (soc(&self.estimator).mean - self.truth.soc)
    }

    fn half_width_points(&self) -> f64 {
        100.0 * STD_OF_95 * soc(&self.estimator).std()
    }
}

/// Maximum errors over three days of partial cycles with rests between them.
fn three_days(slow_ohm: f64, offset_a: f64) -> StretchErrors {
    let mut bench = Bench::new(0.8, None, slow_ohm, offset_a);
    bench.run(1.0, 1800.0);
    let mut worst = StretchErrors::default();
    for _ in 0..36 {
        for (current_a, seconds) in [(1.0, 1800.0), (0.0, 1800.0), (-1.0, 1800.0), (0.0, 1800.0)] {
            let seen = bench.run(current_a, seconds);
            worst.largest_error = worst.largest_error.max(seen.largest_error);
            worst.largest_ratio = worst.largest_ratio.max(seen.largest_ratio);
        }
    }
    worst
}

#[test]
fn current_offset_does_not_drift_soc() {
    // The offset is 0.5 % of 1 C (2 Ah), which is 10 mA. In 72 h, it adds 0.72 Ah or 36 percentage points.
    for offset_a in [-0.01, 0.01] {
        let worst = three_days(0.0, offset_a);
        assert!(worst.largest_error < 0.75, "{offset_a} A: {worst:?}");
        // The 95 % interval is calculated without the offset. With a permanent offset, it is up to a quarter too
        // narrow.
        assert!(worst.largest_ratio < 1.25, "{offset_a} A: {worst:?}");
        let worst = three_days(SLOW_OHM, offset_a);
        assert!(worst.largest_error < 1.25, "with a slow branch, {offset_a} A: {worst:?}");
    }
    let worst = three_days(0.0, 0.0);
    assert!(worst.largest_error < 0.4 && worst.largest_ratio < 1.0, "without an offset: {worst:?}");
}

#[test]
fn thirty_point_error_recovers_within_minutes() {
    for current_a in [1.0, -1.0, 0.0] {
        for wrong in [-0.3, 0.3] {
            let mut bench = Bench::new(0.5, Some((0.5 + wrong, 0.3)), SLOW_OHM, 0.0);
            bench.run(current_a, 300.0);
            assert!(bench.error_points().abs() < 2.0, "{current_a} A, {wrong}: {}", bench.error_points());
            assert!(bench.run(current_a, 600.0).largest_error < 3.0, "{current_a} A, {wrong}");
        }
    }
}

#[test]
fn interval_covers_error_while_cell_relaxes() {
    for current_a in [1.0, -1.0] {
        // The filter starts when the load starts, so it has never used a voltage at rest.
        let mut bench = Bench::new(0.5 + 0.3 * current_a, None, SLOW_OHM, 0.0);
        bench.run(current_a, 3600.0);
        let mut rested_s = 0.0;
        for until_s in [300.0, 1800.0, 36_000.0] {
            let seen = bench.run(0.0, until_s - rested_s);
            rested_s = until_s;
            assert!(seen.largest_ratio < 1.0, "{current_a} A, {until_s} s: {seen:?}");
        }
        // The slow branch has relaxed, so the voltage is the open-circuit voltage.
        assert!(bench.error_points().abs() < 0.5, "{current_a} A: {}", bench.error_points());
        // Ten hours of rest give as much information as 1000 s x ln 37 (about an hour) under load.
        let least = 100.0 * STD_OF_95 * bench.config.voltage.model_error_v_sqrt_s / 1.2 / libm::sqrt(3600.0);
        assert!(bench.half_width_points() > least, "{current_a} A: {} {least}", bench.half_width_points());
    }
}
