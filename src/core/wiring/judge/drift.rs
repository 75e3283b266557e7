//! Compares the voltage drift during steady current with the drift that the cell model expects.

use super::context::Judge;
use crate::cell::CellModel;
use crate::wiring::evidence::response::SteadyRun;

/// A drift counts only if it is at least this many standard deviations from zero.
const SURE: f64 = 6.0;

/// Voltage drift over all steady runs (periods of steady current) together, as the voltage of one cell.
#[derive(Debug, Clone, Copy)]
pub(super) struct Drift {
    pub(super) seconds: f64,
    /// Sum of the absolute drifts that the model expects (V).
    pub(super) expected_v: f64,
    /// Absolute value of the mean measured drift of a run, weighted by the expected drift (V). If the current seems to
    /// be inverted, the report shows this value.
    pub(super) against_v: f64,
    /// Ratio of measured to expected drift, weighted by the expected drift.
    pub(super) ratio: f64,
    pub(super) sigma: f64,
}

impl Drift {
    /// Drift over the steady runs that were found with short averaging blocks. `None` without a cell model, or if the
    /// model expects no drift in any run.
    pub(super) fn of(judge: &Judge<'_>) -> Option<Self> {
        let model = judge.plan.pack.model.as_ref()?;
        let (mut xx, mut xy, mut variance, mut seconds, mut expected_v) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for run in &judge.observed.fast_response().runs {
            let expected = expected_drift_v(judge, model, run);
            let (measured, std) = (run.drift_v * judge.voltage_factor, run.drift_std_v * judge.voltage_factor);
            xx += expected * expected;
            xy += expected * measured;
            variance += (expected * std.max(2e-4)).powi(2);
            seconds += run.seconds;
            expected_v += expected.abs();
        }
        (xx > 0.0).then(|| Self {
            seconds,
            expected_v,
            against_v: (-xy / expected_v.max(1e-9)).abs(),
            ratio: xy / xx,
            sigma: xy.abs() / variance.sqrt(),
        })
    }

    pub(super) fn is_opposite(&self) -> bool {
        (-6.0..-0.25).contains(&self.ratio) && self.sigma >= SURE && self.expected_v >= 0.004
    }

    pub(super) fn is_along(&self) -> bool {
        self.ratio > 0.1 && self.sigma >= SURE
    }
}

fn expected_drift_v(judge: &Judge<'_>, model: &CellModel, run: &SteadyRun) -> f64 {
    let temperature_c = judge.temperature_c();
    let cell_a = run.current_a * judge.current_factor / f64::from(judge.plan.pack.strings.max(1));
    let settled = judge.settled_ohm(model);
    let soc = model.soc_of_ocv(run.voltage_v * judge.voltage_factor + cell_a * settled, temperature_c).clamp(0.0, 1.0);
    let moved = -cell_a * run.seconds / 3600.0 / judge.plan.pack.capacity_ah;
    let end = model.grid_position((soc + moved).clamp(0.0, 1.0), temperature_c);
    model.ocv_v(&end) - model.ocv_v(&model.grid_position(soc, temperature_c))
}
