//! Learns from every completed half-cycle of every cell: charge moved, SOC swing and capacity.
//!
//! In: times and temperatures of samples, SOC of the cells at the start and end of half-cycles, charge (A s). Out:
//! half-cycles and capacity updates (Ah). While a cell's SOC is not estimated, the caller does not call
//! [`Learner::learn`] for this cell.
//!
//! A half-cycle lasts from the beginning of a charge or discharge to its end, as found by the transition detector. A
//! *mark* is a copy of all totals at such a time.
//!
//! Two filters estimate the capacity of a cell. The *sample filter* ([`CellEstimator`]) takes a step at every sample.
//! The *event filter* takes one step per half-cycle and holds the published capacity. It is the random walk in section
//! 3.3.4 of the paper that packwatch follows. The measurement of the event filter is computed by one of two methods:
//! * `Swing`: the information about the capacity in all voltages since the last half-cycle. It is computed from the
//!   sample filter's previous and present estimates of the capacity (`ScalarGaussian::information_until`). The charge
//!   is not divided by the swing of the sample filter's SOC, because this SOC already depends on the assumed capacity.
//!   With this method, the event filter also estimates the fade ([`super::drift`]).
//! * `Nominal`: as in the paper, charge divided by a nominal swing, with a fixed variance.

use serde::{Deserialize, Serialize};

use super::drift::DriftFilter;
use super::end_errors::effects_ah;
use super::half_cycle::HalfCycle;
use super::offset::CurrentOffset;
use super::span::Span;
use super::{CapacityConfig, CapacityMethod, TransitionConfig};
use crate::cell::{CellEstimator, CellModel};
use crate::filter::{Measurement, ScalarGaussian};
use crate::quantity::bounds;
use crate::quantity::{InvalidState, Mode, Timestamp};

/// If a measured capacity and the expected capacity differ by more than this many standard deviations of their
/// difference, one of them is wrong.
const CONTRADICTION: f64 = 4.0;

/// With the model of a label, a capacity counts as learned if its variance is below this part of the initial variance.
const KNOWN_PART: f64 = 0.9;

/// Standard deviation of the capacity of cells of one type, fraction. A smaller difference is never a contradiction.
const NEW_SPREAD: f64 = 0.1;

/// Result of the event filter's step for one half-cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CapacityUpdate {
    /// Measurement from this half-cycle alone; `None` if the half-cycle contains no information about the capacity.
    pub measurement: Option<Measurement>,
    /// The published capacity. With `Swing`, its variance includes the gain error of the current sensor.
    pub capacity: ScalarGaussian,
}

/// SOC of one cell at one time, and totals of this cell since the learner was created.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct CellMark {
    soc: Option<ScalarGaussian>,
    /// SOC according to the voltage alone; `None` if it is unknown or not needed.
    #[serde(default)]
    pub(super) by_voltage: Option<f64>,
    temperature_integral: f64,
    temperature_s: f64,
}

impl CellMark {
    pub(super) fn move_to(&mut self, soc: Option<ScalarGaussian>, by_voltage: Option<f64>) {
        self.soc = Self::storable(soc);
        self.by_voltage = by_voltage;
    }

    /// Returns the SOC, or `None` if its numbers cannot be stored (for example, a variance that came from a damaged
    /// stored state).
    fn storable(soc: Option<ScalarGaussian>) -> Option<ScalarGaussian> {
        soc.filter(|soc| bounds::STORED_SOC.has(soc.mean) && (0.0..=bounds::NUMBER.high).contains(&soc.variance))
    }

    fn check(&self) -> Result<(), InvalidState> {
        InvalidState::unless_number("a temperature at a half-cycle's end", self.temperature_integral)?;
        bounds::TIME_S.check("the time with a temperature", self.temperature_s)?;
        bounds::STORED_SOC.check_all("the SOC by voltage at a half-cycle's end", self.by_voltage)?;
        let Some(soc) = self.soc else { return Ok(()) };
        bounds::STORED_SOC.check("the SOC at a half-cycle's end", soc.mean)?;
        InvalidState::unless_natural("the variance of the SOC at a half-cycle's end", soc.variance)
    }
}

/// A mark: totals of all cells at one time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Mark {
    pub(super) time: Timestamp,
    /// Cumulative charge (A) s per cell, positive = discharge.
    pub(super) charge_as: f64,
    pub(super) cells: Vec<CellMark>,
}

/// Totals, marks and capacity filters of all cells.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Learner {
    totals: Vec<CellMark>,
    /// Mark at the start of the present half-cycle.
    start: Option<Mark>,
    /// Mark at the start of the candidate, a mode that the transition detector has not confirmed yet.
    candidate: Option<Mark>,
    /// Per cell: capacity in the sample filter after the event filter's last step.
    prior: Vec<ScalarGaussian>,
    /// Per cell: capacity in the event filter.
    capacity: Vec<ScalarGaussian>,
    /// Time without charge or discharge since the last half-cycle (s).
    rest_s: f64,
    mode_since: Option<Timestamp>,
    /// Whether the charge moved since `start` was too small for a half-cycle when the last charge or discharge ended.
    /// If so, `start` stays, and the next charge or discharge extends this half-cycle.
    joining: bool,
    learned: Vec<bool>,
    /// Per cell: filter of capacity and fade (`Swing`).
    drift: Vec<DriftFilter>,
    /// Cells whose sample filter was restarted in the present half-cycle.
    in_doubt: Vec<usize>,
    offset: CurrentOffset,
    /// Largest change of the charge, across several half-cycles.
    #[serde(default)]
    span: Span,
    /// Per cell: how the next half-cycle is used ([`Self::prepare`]).
    #[serde(skip)]
    lessons: Vec<Lesson>,
}

/// How a half-cycle is used for a cell's capacity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Lesson {
    /// Not at all, because its readings are doubtful.
    Nothing,
    /// With a cell model of a label. Only a large [`Span`] is used. The capacity counts as learned when its variance is
    /// clearly smaller than `before`, the variance before anything was measured (Ah^2). `soc_error`: error of a SOC by
    /// voltage that the preceding loads cause (fraction).
    ByLabel { before: f64, soc_error: f64 },
    /// With a cell model that was fitted to cells of this type.
    ByModel,
}

impl Lesson {
    fn soc_error(self) -> Option<f64> {
        if let Self::ByLabel { soc_error, .. } = self { Some(soc_error) } else { None }
    }
}

impl Learner {
    /// Creates a learner; `initial` has the initial capacity of each cell (Ah).
    pub fn new(config: &CapacityConfig, initial: Vec<ScalarGaussian>) -> Self {
        let cells = initial.len();
        Self {
            totals: vec![CellMark::default(); cells],
            learned: vec![false; cells],
            drift: initial.iter().map(|&capacity| DriftFilter::new(config, capacity)).collect(),
            prior: initial.clone(),
            capacity: initial,
            ..Self::default()
        }
    }

    /// Sets a cell's capacity to `capacity`, which was learned in an earlier run. The caller must already have set this
    /// capacity in the sample filter.
    pub fn relearn(
        &mut self,
        config: &CapacityConfig,
        cell: usize,
        capacity: ScalarGaussian,
        estimator: &CellEstimator,
    ) {
        self.drift[cell] = DriftFilter::new(config, capacity);
        self.capacity[cell] = capacity;
        self.prior[cell] = estimator.capacity();
        self.learned[cell] = true;
    }

    /// Restarts the learning for a replaced cell with `capacity`, because the learned values belong to the previous
    /// cell.
    pub fn begin(&mut self, config: &CapacityConfig, cell: usize, capacity: ScalarGaussian) {
        self.drift[cell] = DriftFilter::new(config, capacity);
        (self.prior[cell], self.capacity[cell], self.learned[cell]) = (capacity, capacity, false);
        self.in_doubt.retain(|&other| other != cell);
        for mark in [&mut self.start, &mut self.candidate].into_iter().flatten() {
            (mark.cells[cell].soc, mark.cells[cell].by_voltage) = (None, None);
        }
        self.span.forget(cell);
    }

    /// A copy with the learned values only, without the present half-cycle.
    pub fn learned_only(&self) -> Self {
        Self {
            totals: vec![CellMark::default(); self.totals.len()],
            prior: self.prior.clone(),
            capacity: self.capacity.clone(),
            learned: self.learned.clone(),
            drift: self.drift.clone(),
            offset: self.offset,
            ..Self::default()
        }
    }

    /// Adds a sample of `cell` to the totals of this cell.
    ///
    /// `measured_s` and `gap_s` are the times since the previous sample with and without a measured current (s). The
    /// gap is infinite before the first sample and after a gap of unknown length. Returns whether the candidate (an
    /// unconfirmed mode) began within that gap. If so, the caller sets the SOC at the candidate's mark to the SOC after
    /// the gap ([`Self::move_mark`]).
    #[inline]
    pub fn observe(
        &mut self,
        cell: usize,
        time: Timestamp,
        temperature_c: Option<f64>,
        measured_s: f64,
        gap_s: f64,
    ) -> bool {
        if let Some(temperature_c) = temperature_c {
            let totals = &mut self.totals[cell];
            totals.temperature_integral += temperature_c * measured_s;
            totals.temperature_s += measured_s;
        }
        gap_s > 0.0 && self.candidate.as_ref().is_some_and(|mark| time.since(mark.time) < gap_s)
    }

    /// Sets the SOC at the candidate's mark to the cell's present SOC, in the filter and by voltage.
    pub fn move_mark(&mut self, cell: usize, (soc, by_voltage): (Option<ScalarGaussian>, Option<f64>)) {
        if let Some(mark) = &mut self.candidate {
            mark.cells[cell].move_to(soc, by_voltage);
        }
    }

    /// Resets the time at rest after all cells have learned from a half-cycle.
    pub fn finish(&mut self) {
        self.rest_s = 0.0;
        self.span.closed = None;
    }

    /// Marks the start of the candidate, an unconfirmed mode. `soc` returns the SOC of each cell, in the filter and by
    /// voltage.
    pub fn mark_candidate(
        &mut self,
        time: Timestamp,
        charge_as: f64,
        soc: impl Fn(usize) -> (Option<ScalarGaussian>, Option<f64>),
    ) {
        let mut cells = self.candidate.take().map(|mark| mark.cells).unwrap_or_default();
        cells.clone_from(&self.totals);
        for (cell, mark) in cells.iter_mut().enumerate() {
            let (soc, by_voltage) = soc(cell);
            mark.move_to(soc, by_voltage);
        }
        self.candidate = Some(Mark { time, charge_as, cells });
    }

    /// Ends the mode `from` after the detector has confirmed the candidate.
    ///
    /// If `from` is a charge or discharge, and the charge moved since the last half-cycle reaches the configured swing,
    /// appends one half-cycle per cell to `half_cycles`, in cell order. A charge or discharge that moved less is merged
    /// with the next half-cycle.
    pub fn complete(
        &mut self,
        config: &TransitionConfig,
        rated_capacity_ah: f64,
        from: Mode,
        half_cycles: &mut Vec<HalfCycle>,
    ) {
        let Some(end) = self.candidate.take() else { return };
        let since = self.mode_since.replace(end.time);
        self.span.note(&end, from, rated_capacity_ah);
        let Some(start) = &self.start else {
            self.start = Some(end);
            return;
        };
        if matches!(from, Mode::Rest | Mode::Unknown) {
            self.rest_s += since.map_or(0.0, |since| end.time.since(since).max(0.0));
            if !self.joining {
                self.start = Some(end);
            }
            return;
        }
        let moved_ah = (end.charge_as - start.charge_as) / 3600.0;
        self.joining = moved_ah == 0.0 || moved_ah.abs() < config.min_swing * rated_capacity_ah;
        if !self.joining {
            half_cycles.extend(
                start.cells.iter().zip(&end.cells).map(|(a, b)| half_cycle(moved_ah, end.time.since(start.time), a, b)),
            );
            self.start = Some(end);
        }
    }

    /// Sets how the next half-cycle is used for each cell. Has no effect with `Nominal`.
    pub fn prepare(&mut self, lesson: impl Fn(usize) -> Lesson) {
        self.lessons = (0..self.capacity.len()).map(lesson).collect();
    }

    /// Restarts the span, because the current was doubtful and the counted charge may be wrong.
    pub fn interrupt_span(&mut self) {
        self.span = Span::default();
    }

    fn lesson(&self, cell: usize) -> Lesson {
        self.lessons.get(cell).copied().unwrap_or(Lesson::ByModel)
    }

    /// Steps the event filter of one cell after its half-cycle is complete.
    pub fn learn(
        &mut self,
        model: &CellModel,
        config: &CapacityConfig,
        cell: usize,
        estimator: &mut CellEstimator,
        half_cycle: &HalfCycle,
    ) -> CapacityUpdate {
        let measurement = match config.method {
            CapacityMethod::Swing => self.learn_swing(model, config, cell, estimator, half_cycle),
            CapacityMethod::Nominal { swing, variance_ah2 } => {
                let measurement = Measurement { value: half_cycle.charge_ah / swing, variance: variance_ah2 };
                let capacity = &mut self.capacity[cell];
                let before = *capacity;
                capacity.predict(config.noise_ah_per_cycle * config.noise_ah_per_cycle);
                capacity.update(measurement);
                if !bounds::TRUSTED_CAPACITY.has(capacity.mean / model.capacity_ah) {
                    *capacity = before;
                    return CapacityUpdate { measurement: None, capacity: before };
                }
                estimator.hold_capacity(capacity.mean);
                Some(measurement)
            }
        };
        let is_known = match self.lesson(cell) {
            Lesson::ByLabel { before, .. } if config.method == CapacityMethod::Swing => {
                self.capacity[cell].variance < KNOWN_PART * before
            }
            _ => true,
        };
        self.learned[cell] |= measurement.is_some() && is_known;
        // While the capacity is still mostly assumed, the measurement is not reported.
        let measurement = measurement.filter(|_| self.learned[cell]);
        CapacityUpdate { measurement, capacity: self.capacity(cell) }
    }

    /// Handles a restart of a cell's sample filter, which happens if the voltages contradict the learned values. Raises
    /// the variance of the capacity to at least `new_variance_ah2`, the variance for a new cell. From the present
    /// half-cycle, only a lower bound is then learned: the capacity is at least the charge moved. Has no effect with
    /// `Nominal`.
    pub fn doubt(
        &mut self,
        config: &CapacityConfig,
        cell: usize,
        new_variance_ah2: f64,
        estimator: &mut CellEstimator,
    ) {
        if config.method != CapacityMethod::Swing {
            return;
        }
        if !self.in_doubt.contains(&cell) {
            self.in_doubt.push(cell);
        }
        self.span.forget(cell);
        let drift = &mut self.drift[cell];
        drift.doubt(new_variance_ah2);
        self.capacity[cell] = drift.capacity();
        estimator.restate_capacity(self.capacity[cell]);
        self.prior[cell] = estimator.capacity();
    }

    /// Handles a new cell model that the estimator has adopted. The present half-cycle restarts at `soc`. If `capacity`
    /// is given, it replaces the capacity (Ah) and the flag that says whether the capacity has been learned.
    pub fn adopt(
        &mut self,
        config: &CapacityConfig,
        cell: usize,
        capacity: Option<(ScalarGaussian, bool)>,
        soc: Option<ScalarGaussian>,
        estimator: &CellEstimator,
    ) {
        if let Some((capacity, is_learned)) = capacity {
            self.drift[cell] = DriftFilter::new(config, capacity);
            (self.capacity[cell], self.learned[cell]) = (capacity, is_learned);
        }
        self.prior[cell] = estimator.capacity();
        self.in_doubt.retain(|&other| other != cell);
        self.span.forget(cell);
        // The SOC at the start of a merged half-cycle was estimated with the old model, so it becomes unknown.
        let soc = CellMark::storable(soc);
        let at_start = soc.filter(|_| !self.joining);
        for (mark, soc) in [(&mut self.start, at_start), (&mut self.candidate, soc)] {
            mark.iter_mut().for_each(|mark| mark.cells[cell].move_to(soc, None));
        }
    }

    /// Whether a cell's capacity has been measured since it started with the configured capacity.
    pub fn has_learned(&self, cell: usize) -> bool {
        self.learned.get(cell).copied().unwrap_or(false)
    }

    /// Whether the capacity of every cell has been measured since it started with the configured capacity.
    pub fn has_learned_all(&self) -> bool {
        self.learned.iter().all(|&learned| learned)
    }

    fn learn_swing(
        &mut self,
        model: &CellModel,
        config: &CapacityConfig,
        cell: usize,
        estimator: &mut CellEstimator,
        half_cycle: &HalfCycle,
    ) -> Option<Measurement> {
        let after = estimator.capacity();
        let is_in_doubt = self.in_doubt.contains(&cell);
        self.in_doubt.retain(|&other| other != cell);
        let lesson = self.lesson(cell);
        let soc_error = lesson.soc_error();
        let is_by_label = soc_error.is_some();
        let is_held = lesson == Lesson::Nothing;
        let is_open = !is_in_doubt && !is_held;
        let evidence = self.prior[cell].information_until(&after).filter(|_| is_open && !is_by_label);
        let span = if is_open && is_by_label { self.span.closed(cell) } else { None };
        let by_label = span.zip(soc_error).and_then(|(span, error)| span.capacity(model, config, error));
        let learned_from = span.as_ref().map_or(half_cycle, |span| &span.half_cycle);
        let measurement = evidence.map(|z| {
            // The open-circuit curve assumes a capacity C_curve, which influences the measurement z:
            // z = C + s (C_curve - C). Solve for C.
            let weight = 1.0 - after.variance / self.prior[cell].variance;
            // Limits s, the influence of the curve's capacity.
            let by_curve = (estimator.capacity_by_curve() / weight).clamp(-0.8, 0.8);
            let (own, curve_ah) = (1.0 - by_curve, estimator.curve().mean);
            Measurement { value: curve_ah + (z.value - curve_ah) / own, variance: z.variance / (own * own) }
        });
        let measurement = measurement.or(by_label);
        let drift = &mut self.drift[cell];
        let before = *drift;
        let expected = drift.capacity();
        let is_contradiction = |z: &Measurement| {
            let difference = z.value - expected.mean;
            // A cell that has rested may gain a few percent of capacity.
            difference.abs() > NEW_SPREAD * model.capacity_ah
                && difference * difference > CONTRADICTION * CONTRADICTION * (z.variance + expected.variance)
        };
        if let Some(z) = measurement.filter(is_contradiction) {
            // The measured or the expected capacity is wrong, and further half-cycles decide. Each contradiction adds
            // at most the variance of new cells, so that one outlier does not make the capacity unknown.
            let difference = z.value - expected.mean;
            let doubt = difference * difference / (CONTRADICTION * CONTRADICTION);
            let spread_ah = NEW_SPREAD * model.capacity_ah;
            drift.doubt(doubt.min(expected.variance + spread_ah * spread_ah));
        } else if let Some(z) = measurement {
            drift.update(z, &effects_ah(model, config, learned_from, after.mean, is_by_label));
        } else if is_in_doubt && !is_held {
            drift.at_least(half_cycle.charge_ah);
        }
        // Discards a measurement that makes the capacity impossible for this cell.
        let is_possible = drift.is_possible(model.capacity_ah);
        if !is_possible {
            *drift = before;
        }
        let measurement = measurement.filter(|z| is_possible && !is_contradiction(z));
        self.capacity[cell] = drift.capacity();
        let cycles = half_cycle.charge_ah / (2.0 * after.mean);
        let rest_days = (self.rest_s / 86_400.0).min(1.0);
        let walk = config.noise_ah_per_cycle * config.noise_ah_per_cycle * cycles
            + config.noise_ah_per_rest_day * config.noise_ah_per_rest_day * rest_days;
        let charged = if half_cycle.mode == Mode::Charge { 2.0 * cycles } else { 0.0 };
        let learned = *drift;
        drift.predict(config, cycles, charged, walk);
        if !drift.is_possible(model.capacity_ah) {
            *drift = learned;
        }
        // The sample filter continues with the event filter's capacity.
        estimator.restate_capacity(drift.capacity());
        self.prior[cell] = estimator.capacity();
        measurement
    }

    /// The published capacity of a cell.
    pub fn capacity(&self, cell: usize) -> ScalarGaussian {
        self.capacity[cell]
    }

    /// Learned offset of the current per cell (A): measured minus true.
    #[inline]
    pub fn current_offset(&self) -> &CurrentOffset {
        &self.offset
    }

    /// Mutable access to the learned offset of the current.
    pub fn current_offset_mut(&mut self) -> &mut CurrentOffset {
        &mut self.offset
    }

    /// Whether a stored learner has entries for `cells` cells in all its lists.
    pub fn fits(&self, cells: usize) -> bool {
        [self.totals.len(), self.prior.len(), self.capacity.len(), self.learned.len(), self.drift.len()] == [cells; 5]
            && self.all_marks().all(|mark| mark.cells.len() == cells)
    }

    fn all_marks(&self) -> impl Iterator<Item = &Mark> + Clone {
        [&self.start, &self.candidate].into_iter().flatten().chain(self.span.marks())
    }

    /// Checks the numbers of a stored state.
    ///
    /// # Errors
    /// The first impossible number.
    pub fn check(&self) -> Result<(), InvalidState> {
        for capacity in self.prior.iter().chain(&self.capacity) {
            InvalidState::unless_capacity("a learned capacity", capacity.mean)?;
            InvalidState::unless_positive("the variance of a learned capacity", capacity.variance)?;
        }
        self.drift.iter().try_for_each(DriftFilter::check)?;
        self.offset.check()?;
        bounds::TIME_S.check("the time at rest", self.rest_s)?;
        self.span.check()?;
        let marks = self.all_marks();
        let charges_as = marks.clone().map(|mark| mark.charge_as);
        bounds::CHARGE_AS.check_all("the charge at a half-cycle's end", charges_as)?;
        marks.flat_map(|mark| &mark.cells).chain(&self.totals).try_for_each(CellMark::check)
    }

    /// Time and charge (A s per cell) at each stored mark.
    pub fn marks(&self) -> impl Iterator<Item = (Timestamp, f64)> + '_ {
        self.all_marks().map(|mark| (mark.time, mark.charge_as))
    }

    /// Shifts all timestamps by `by_nanos`, to another clock.
    pub fn rebase(&mut self, by_nanos: i64) {
        let marks = [&mut self.start, &mut self.candidate].into_iter().flatten();
        marks.chain(self.span.marks_mut()).for_each(|mark| mark.time = mark.time.plus_nanos(by_nanos));
        self.mode_since = self.mode_since.map(|since| since.plus_nanos(by_nanos));
    }
}

/// One cell's half-cycle between the marks `a` and `b`. `moved_ah` is positive for a discharge.
pub(super) fn half_cycle(moved_ah: f64, duration_s: f64, a: &CellMark, b: &CellMark) -> HalfCycle {
    let (mode, sign) = if moved_ah > 0.0 { (Mode::Discharge, 1.0) } else { (Mode::Charge, -1.0) };
    let temperature_s = b.temperature_s - a.temperature_s;
    HalfCycle {
        mode,
        charge_ah: moved_ah.abs(),
        swing: a
            .soc
            .zip(b.soc)
            .map(|(a, b)| ScalarGaussian { mean: sign * (a.mean - b.mean), variance: a.variance + b.variance }),
        end_soc: b.soc.map(|soc| soc.mean),
        // If the SOC at the start is unknown, use the SOC at the end.
        ends: b.soc.map(|end| [a.soc.unwrap_or(end).mean, end.mean]),
        duration_s,
        mean_current_a: moved_ah * 3600.0 / duration_s,
        mean_temperature_c: (temperature_s > 0.0)
            .then(|| (b.temperature_integral - a.temperature_integral) / temperature_s),
    }
}

#[cfg(test)]
mod tests;
