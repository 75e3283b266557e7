//! Estimates the open-circuit voltage of the median cell during use, by correcting the voltage for the current.
//!
//! The correction uses the measured resistance if the current steps show it, otherwise the resistance of the cell
//! model. Each estimate has a slack (its largest error). The slack covers half of the correction, the spread of the
//! curves of one chemistry, and hysteresis.

use super::context::{EXPLAINED, Judge};
use crate::wiring::evidence::usage::MAX_REPORTED;

/// Slack of a voltage without current (V). The curves of cells with the same label (chemistry and capacity) differ by
/// up to 30 mV. The hysteresis of iron phosphate is 10 mV.
const SLACK_V: f64 = 0.04;

#[derive(Debug, Clone, Copy)]
pub(super) struct OcvEstimate {
    pub(super) voltage_v: f64,
    /// Largest error of the estimate (V).
    pub(super) slack_v: f64,
    /// Current (A), positive = discharge.
    pub(super) current_a: f64,
    pub(super) reported: [f64; MAX_REPORTED],
    pub(super) stretch: u32,
}

/// Estimates for all moments; empty without a cell model.
pub(super) fn estimates(judge: &Judge<'_>) -> Vec<OcvEstimate> {
    let Some(model) = &judge.plan.pack.model else { return Vec::new() };
    let strings = f64::from(judge.plan.pack.strings.max(1));
    let (fast_ohm, _) = judge.model_ohm(model, 1.0);
    let settled_ohm = judge.settled_ohm(model).max(fast_ohm);
    let measured = judge.observed.slope().filter(|slope| slope.certainty() >= 1.0 && slope.r2 >= EXPLAINED);
    let measured = measured.map(|slope| slope.ohm.abs() * judge.voltage_factor / judge.current_factor * strings);
    let ratio = measured.map_or(1.0, |ohm| ohm / fast_ohm);
    let (fast_ohm, slow_ohm) = (ratio * fast_ohm / strings, ratio * (settled_ohm - fast_ohm) / strings);
    let estimate = |moment: &crate::wiring::evidence::usage::Moment| {
        let (now_a, slow_a) = (moment.current_a * judge.current_factor, moment.slow_a * judge.current_factor);
        OcvEstimate {
            voltage_v: moment.voltage_v * judge.voltage_factor + fast_ohm * now_a + slow_ohm * slow_a,
            slack_v: SLACK_V + 0.5 * (fast_ohm * now_a.abs() + slow_ohm * slow_a.abs()),
            current_a: now_a,
            reported: moment.reported,
            stretch: moment.stretch,
        }
    };
    judge.observed.usage.moments().iter().map(estimate).collect()
}

/// Whether the voltages show that the state of charge rises (with `is_rise`) or falls (without `is_rise`), by more than
/// the errors of the estimates can explain. If a current always has the same sign although the state of charge has
/// risen and fallen, its sign is missing.
pub(super) fn moves_against(judge: &Judge<'_>, is_rise: bool) -> bool {
    const LEAST: f64 = 0.05;
    let Some(model) = &judge.plan.pack.model else { return false };
    let temperature_c = judge.temperature_c();
    let soc = |voltage_v: f64| model.soc_of_ocv(voltage_v, temperature_c).clamp(0.0, 1.0);
    let estimates = estimates(judge);
    let mut moved = 0;
    for stretch in estimates.chunk_by(|a, b| a.stretch == b.stretch) {
        // Lowest upper bound of the state of charge so far. To find a fall, the signs are inverted.
        let mut bound: Option<f64> = None;
        for estimate in stretch {
            let (low, high) = (soc(estimate.voltage_v - estimate.slack_v), soc(estimate.voltage_v + estimate.slack_v));
            let (near, far) = if is_rise { (low, high) } else { (-high, -low) };
            let lowest = bound.map_or(far, |bound| bound.min(far));
            moved += usize::from(near - lowest > LEAST);
            bound = Some(lowest);
        }
    }
    moved >= 5 && 20 * moved >= estimates.len()
}
