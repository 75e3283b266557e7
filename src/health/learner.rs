//! What each completed half-cycle teaches about each cell: charge moved, SOC swing, capacity.
//!
//! A half-cycle runs from where charge or discharge began to where it ended (both dated by the transition
//! detector). The capacity filter (paper, section 3.3.4: random walk, A = C = 1, one step per half-cycle) gets
//! its measurement by one of two rules:
//! * `Swing`: the information which the voltages since the last half-cycle have given about the capacity. The
//!   sample-by-sample filter carries the capacity with its correlation to the SOC; the measurement is what leads
//!   from its belief then to its belief now, `Belief::information_until`. Charge / swing with the SOC of that same
//!   filter would return the capacity it assumed; this does not.
//! * `Nominal`: the paper's, charge / nominal swing with a fixed variance.

use serde::{Deserialize, Serialize};

use super::{CapacityConfig, CapacityMethod, TransitionConfig};
use crate::cell::CellEstimator;
use crate::filter::{Belief, Measurement};
use crate::quantity::{Mode, Timestamp};

/// One completed half-cycle of one cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HalfCycle {
    /// Charge or discharge.
    pub mode: Mode,
    /// Charge moved, Ah, positive.
    pub charge_ah: f64,
    /// SOC swing, fraction, positive when it goes with the charge.
    pub swing: f64,
    /// Its standard deviation; the errors of both ends taken as independent.
    pub swing_std: f64,
    /// SOC at its end, fraction.
    pub end_soc: f64,
    /// Duration, s.
    pub duration_s: f64,
    /// Mean current, A, positive = discharge.
    pub mean_current_a: f64,
    /// Mean temperature, degrees C; `None` when there was none.
    pub mean_temperature_c: Option<f64>,
}

/// What the capacity filter made of a half-cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CapacityUpdate {
    /// What the half-cycle alone says; `None` = nothing.
    pub measurement: Option<Measurement>,
    /// The published capacity, gain error of the current sensor included.
    pub capacity: Belief,
}

/// The state of one cell's totals at a moment.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct CellMark {
    soc: f64,
    soc_variance: f64,
    temperature_integral: f64,
    temperature_s: f64,
}

/// The state of all totals at a moment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Mark {
    time: Timestamp,
    /// Cumulative charge per cell, A s, positive = discharge.
    charge_as: f64,
    cells: Vec<CellMark>,
}

/// Totals, marks and capacity filters of all cells.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Learner {
    totals: Vec<CellMark>,
    /// Where the present mode began.
    start: Option<Mark>,
    /// Where the mode that may follow began.
    candidate: Option<Mark>,
    /// Capacity belief of each sample filter right after the last half-cycle's step.
    prior: Vec<Belief>,
    /// Event filter's belief.
    capacity: Vec<Belief>,
    /// Time without current since the last half-cycle, s.
    rest_s: f64,
}

impl Learner {
    /// For cells that start from these beliefs.
    pub fn new(cells: usize, initial_capacity: Belief) -> Self {
        Self {
            totals: vec![CellMark::default(); cells],
            start: None,
            candidate: None,
            prior: vec![initial_capacity; cells],
            capacity: vec![initial_capacity; cells],
            rest_s: 0.0,
        }
    }

    /// Takes a cell's new estimate into its totals.
    pub fn observe(&mut self, cell: usize, soc: Belief, temperature_c: Option<f64>, elapsed_s: f64) {
        let totals = &mut self.totals[cell];
        (totals.soc, totals.soc_variance) = (soc.mean, soc.variance);
        if let Some(temperature_c) = temperature_c {
            totals.temperature_integral += temperature_c * elapsed_s;
            totals.temperature_s += elapsed_s;
        }
    }

    /// All cells have learned from the half-cycle at hand.
    pub fn finish(&mut self) {
        self.rest_s = 0.0;
    }

    /// A mode that may follow the present one begins here.
    pub fn mark_candidate(&mut self, time: Timestamp, charge_as: f64) {
        let mut cells = self.candidate.take().map(|mark| mark.cells).unwrap_or_default();
        cells.clone_from(&self.totals);
        self.candidate = Some(Mark { time, charge_as, cells });
    }

    /// The mode that began at the candidate mark is confirmed: the marks of the mode that ended, or `None`
    /// when there are not two yet.
    fn close(&mut self) -> Option<(Mark, Mark)> {
        let end = self.candidate.take()?;
        let start = self.start.replace(end.clone())?;
        Some((start, end))
    }

    /// Completes the mode `from`. Appends each cell's half-cycle to `half_cycles` in cell order when it was a
    /// charge or a discharge of at least the configured swing.
    pub fn complete(
        &mut self,
        config: &TransitionConfig,
        rated_capacity_ah: f64,
        from: Mode,
        half_cycles: &mut Vec<HalfCycle>,
    ) {
        let Some((start, end)) = self.close() else { return };
        let sign = match from {
            Mode::Discharge => 1.0,
            Mode::Charge => -1.0,
            Mode::Rest | Mode::Unknown => {
                self.rest_s += end.time.since(start.time);
                return;
            }
        };
        let charge_ah = sign * (end.charge_as - start.charge_as) / 3600.0;
        if charge_ah <= 0.0 || charge_ah < config.min_swing * rated_capacity_ah {
            return;
        }
        let duration_s = end.time.since(start.time);
        half_cycles.extend(start.cells.iter().zip(&end.cells).map(|(a, b)| {
            let temperature_s = b.temperature_s - a.temperature_s;
            HalfCycle {
                mode: from,
                charge_ah,
                swing: sign * (a.soc - b.soc),
                swing_std: (a.soc_variance + b.soc_variance).sqrt(),
                end_soc: b.soc,
                duration_s,
                mean_current_a: sign * charge_ah * 3600.0 / duration_s,
                mean_temperature_c: (temperature_s > 0.0)
                    .then(|| (b.temperature_integral - a.temperature_integral) / temperature_s),
            }
        }));
    }

    /// Runs the capacity filter of one cell over its completed half-cycle.
    pub fn learn(
        &mut self,
        config: &CapacityConfig,
        cell: usize,
        estimator: &mut CellEstimator,
        half_cycle: &HalfCycle,
    ) -> CapacityUpdate {
        let measurement = match config.method {
            CapacityMethod::Swing => self.learn_swing(config, cell, estimator, half_cycle),
            CapacityMethod::Nominal { swing, variance_ah2 } => {
                let measurement = Measurement { value: half_cycle.charge_ah / swing, variance: variance_ah2 };
                let belief = &mut self.capacity[cell];
                belief.predict(config.noise_ah_per_cycle * config.noise_ah_per_cycle);
                belief.update(measurement);
                estimator.hold_capacity(belief.mean);
                Some(measurement)
            }
        };
        CapacityUpdate { measurement, capacity: self.capacity(config, cell) }
    }

    fn learn_swing(
        &mut self,
        config: &CapacityConfig,
        cell: usize,
        estimator: &mut CellEstimator,
        half_cycle: &HalfCycle,
    ) -> Option<Measurement> {
        let after = estimator.capacity();
        let measurement = self.prior[cell].information_until(&after);
        let mut belief = self.prior[cell];
        match measurement {
            Some(z) => belief.update(z),
            None => belief = after,
        }
        self.capacity[cell] = belief;
        let cycles = half_cycle.charge_ah / (2.0 * after.mean);
        let rest_days = (self.rest_s / 86_400.0).min(1.0);
        estimator.widen_capacity(
            config.noise_ah_per_cycle * config.noise_ah_per_cycle * cycles
                + config.noise_ah_per_rest_day * config.noise_ah_per_rest_day * rest_days,
        );
        self.prior[cell] = estimator.capacity();
        measurement
    }

    /// The published capacity of a cell: the filter's, its variance widened by the gain error of the current
    /// sensor, which no number of half-cycles averages out.
    pub fn capacity(&self, config: &CapacityConfig, cell: usize) -> Belief {
        let belief = self.capacity[cell];
        let gain_ah = config.current_gain_std * belief.mean;
        Belief { mean: belief.mean, variance: belief.variance + gain_ah * gain_ah }
    }

    /// Whether the totals are for this many cells.
    pub fn fits(&self, cells: usize) -> bool {
        [self.totals.len(), self.prior.len(), self.capacity.len()] == [cells; 3]
            && [&self.start, &self.candidate].into_iter().flatten().all(|mark| mark.cells.len() == cells)
    }

    /// Moves stored stamps onto another clock.
    pub fn rebase(&mut self, by_nanos: i64) {
        for mark in [&mut self.start, &mut self.candidate].into_iter().flatten() {
            mark.time = mark.time.plus_nanos(by_nanos);
        }
    }
}
