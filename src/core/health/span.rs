//! Finds the largest changes of the charge, across several half-cycles.
//!
//! In: marks. A mark is a copy of all totals, made when a mode (charge, discharge, rest or unknown) ends. Out: pairs of
//! marks between which a large charge has moved in one direction.
//!
//! A single half-cycle is often too small to measure the capacity. For example, a car discharges in several trips, and
//! clouds interrupt the solar charging of a boat. A *span* lasts from one turning point of the counted charge to the
//! next. A small change in the other direction does not end a span.
//!
//! While no current was measured, the cells may have been charged or used. If the SOC computed from the voltages (SOC
//! by voltage) has changed by more than [`JUMP`] in such a time, the span starts again. Otherwise, the charge that may
//! have flowed is part of the span's error.

use serde::{Deserialize, Serialize};

use super::CapacityConfig;
use super::half_cycle::HalfCycle;
use super::learner::{Mark, half_cycle};
use crate::cell::model_bands::CURVE_C;
use crate::cell::{CellModel, reach_of_error};
use crate::filter::{Measurement, square};
use crate::quantity::{InvalidState, Mode};

/// Smallest span, as a part of the rated capacity. If the open-circuit curve is derived from a label, its error
/// dominates in smaller spans.
const LEAST: f64 = 0.25;

/// Smallest charge in the other direction that ends a span, as a part of the rated capacity.
const TURN: f64 = 0.05;

/// Change of the SOC by voltage (fraction) that shows a charge or a discharge while no current was measured. If a cell
/// only relaxes after a load, its SOC by voltage changes less.
const JUMP: f64 = 0.08;

/// Standard deviation of the charge that may have flowed unnoticed while no current was measured, as a part of the
/// capacity.
const UNNOTICED: f64 = 0.03;

/// The present span, and the last complete one.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Span {
    start: Option<Mark>,
    /// The mark with the largest change of the charge since the start.
    turn: Option<Mark>,
    last: Option<Mark>,
    /// Numbers of periods without a measured current: from the start until now, and from the start to the turn.
    gaps: [u32; 2],
    /// Start and end of the last complete span that no cell has learned from yet, and the number of its gaps.
    pub(super) closed: Option<(Mark, Mark, u32)>,
}

impl Span {
    /// Handles the end of the mode `from`, at the mark `now`.
    pub(super) fn note(&mut self, now: &Mark, from: Mode, rated_capacity_ah: f64) {
        if now.cells.iter().all(|cell| cell.by_voltage.is_none()) {
            return *self = Self { closed: self.closed.take(), ..Self::default() };
        }
        let (Some(start), Some(turn), Some(last)) = (&self.start, &self.turn, self.last.replace(now.clone())) else {
            (self.start, self.turn, self.last) = (Some(now.clone()), Some(now.clone()), Some(now.clone()));
            return;
        };
        let part = |a: &Mark, b: &Mark| (b.charge_as - a.charge_as) / (3600.0 * rated_capacity_ah);
        if from == Mode::Unknown {
            if jump(&last, now, part(&last, now)).is_none_or(|jump| jump > JUMP) {
                *self = Self { closed: self.closed.take(), ..Self::default() };
                return self.note(now, from, rated_capacity_ah);
            }
            self.gaps[0] = self.gaps[0].saturating_add(1);
        }
        let (moved, most) = (part(start, now), part(start, turn));
        let is_still_last = turn.time == last.time && matches!(from, Mode::Rest | Mode::Unknown);
        if is_still_last || moved * most >= most * most {
            // The turn moves to this mark, because the charge has moved further or the cell has rested at the turn.
            // After a rest, the voltage shows the SOC better than before.
            (self.turn, self.gaps[1]) = (Some(now.clone()), self.gaps[0]);
        } else if part(turn, now).abs() >= TURN {
            let end = turn.clone();
            if most.abs() >= LEAST {
                self.closed = Some((start.clone(), end.clone(), self.gaps[1]));
            }
            self.gaps = [self.gaps[0].saturating_sub(self.gaps[1]); 2];
            (self.start, self.turn) = (Some(end), Some(now.clone()));
        }
    }

    /// The last complete span of a cell, if no cell has learned from it yet. `None` if the SOC at an end is unknown.
    pub(super) fn closed(&self, cell: usize) -> Option<CellSpan> {
        let (start, end, gaps) = self.closed.as_ref()?;
        let (a, b) = (start.cells.get(cell)?, end.cells.get(cell)?);
        let ends = [a.by_voltage?, b.by_voltage?];
        let moved_ah = (end.charge_as - start.charge_as) / 3600.0;
        let half_cycle = half_cycle(moved_ah, end.time.since(start.time), a, b);
        let uncounted = f64::from(*gaps) * square(UNNOTICED);
        Some(CellSpan { half_cycle: HalfCycle { ends: Some(ends), ..half_cycle }, ends, uncounted })
    }

    /// Checks the numbers of a stored span, except those of its marks.
    pub(super) fn check(&self) -> Result<(), InvalidState> {
        let [all, to_turn] = self.gaps.map(f64::from);
        InvalidState::unless(to_turn <= all, "the gaps of a span", to_turn, "at most those up to now")
    }

    /// Forgets a cell's SOC, because the cell or its model has changed.
    pub(super) fn forget(&mut self, cell: usize) {
        self.marks_mut().filter_map(|mark| mark.cells.get_mut(cell)).for_each(|cell| cell.by_voltage = None);
    }

    /// The marks at the start, the turn and the end.
    pub(super) fn marks_mut(&mut self) -> impl Iterator<Item = &mut Mark> {
        let marks = [&mut self.start, &mut self.turn, &mut self.last].into_iter().flatten();
        marks.chain(self.closed.iter_mut().flat_map(|(start, end, _)| [start, end]))
    }

    pub(super) fn marks(&self) -> impl Iterator<Item = &Mark> + Clone {
        let marks = [&self.start, &self.turn, &self.last].into_iter().flatten();
        marks.chain(self.closed.iter().flat_map(|(start, end, _)| [start, end]))
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct CellSpan {
    /// The span as one half-cycle; its ends are SOCs by voltage.
    pub(super) half_cycle: HalfCycle,
    ends: [f64; 2],
    /// Variance of the charge that may have flowed while no current was measured (square of a fraction of the
    /// capacity).
    uncounted: f64,
}

impl CellSpan {
    /// The capacity (Ah): counted charge divided by the change of the SOC that the voltages show. `None` if the SOC has
    /// not changed in the direction of the charge. `soc_error`: error of the SOC by voltage that the preceding loads
    /// cause (fraction).
    pub(super) fn capacity(&self, model: &CellModel, config: &CapacityConfig, soc_error: f64) -> Option<Measurement> {
        let Self { half_cycle, ends: [start, end], uncounted } = *self;
        let swing = if half_cycle.mode == Mode::Charge { end - start } else { start - end };
        if swing <= 0.0 {
            return None;
        }
        let value = half_cycle.charge_ah / swing;
        let offset_ah = config.current_offset_std_a * half_cycle.duration_s / 3600.0;
        let temperature = model.temperature_position(half_cycle.mean_temperature_c.unwrap_or(CURVE_C));
        let soc_variance = |soc: f64| {
            // The model of a label always states its error.
            let error_v = model.voltage_error_v(&model.grid_position_at(&temperature, soc)).unwrap_or(0.0);
            square(reach_of_error(model, &temperature, model.capacity_ah, (soc, error_v))) + square(soc_error)
        };
        let of_swing = (soc_variance(start) + soc_variance(end) + uncounted) / square(swing);
        let of_charge = square(offset_ah / half_cycle.charge_ah);
        Some(Measurement { value, variance: value * value * (of_charge + of_swing) })
    }
}

/// Change of the SOC by voltage that the counted charge `moved` (fraction, positive = discharge) does not explain, as
/// the median over the cells. `None` if no cell has both SOC values.
fn jump(before: &Mark, after: &Mark, moved: f64) -> Option<f64> {
    let cells = before.cells.iter().zip(&after.cells);
    let changes = cells.filter_map(|(a, b)| Some((b.by_voltage? - a.by_voltage? + moved).abs()));
    let mut changes: Vec<f64> = changes.collect();
    changes.sort_unstable_by(f64::total_cmp);
    changes.get(changes.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::health::learner::CellMark;
    use crate::quantity::Timestamp;

    /// Notes a mark of a cell of 100 Ah. `taken`: charge taken out (fraction of the rated capacity). `by_voltage`: SOC
    /// by voltage.
    fn note(span: &mut Span, from: Mode, [taken, by_voltage]: [f64; 2]) {
        let time_s = 600.0 + span.last.as_ref().map_or(0.0, |last| last.time.since(Timestamp::from_secs(0.0)));
        let mut cell = CellMark::default();
        cell.move_to(None, Some(by_voltage));
        let charge_as = taken * 360_000.0;
        span.note(&Mark { time: Timestamp::from_secs(time_s), charge_as, cells: vec![cell] }, from, 100.0);
    }

    #[test]
    fn trips_with_small_returns_are_one_span() {
        let mut span = Span::default();
        let trips = [
            (Mode::Unknown, [0.0, 0.9]),
            (Mode::Discharge, [0.2, 0.65]),
            (Mode::Unknown, [0.2, 0.7]),
            (Mode::Charge, [0.17, 0.73]),
            (Mode::Discharge, [0.5, 0.36]),
            (Mode::Rest, [0.5, 0.4]),
            (Mode::Charge, [0.46, 0.44]),
        ];
        for (from, at) in trips {
            note(&mut span, from, at);
            assert_eq!(span.closed(0), None);
        }
        note(&mut span, Mode::Charge, [0.3, 0.6]);
        let closed = span.closed(0).expect("a span");
        assert!((closed.half_cycle.charge_ah - 50.0).abs() < 1e-9, "{closed:?}");
        assert_eq!(closed.ends, [0.9, 0.4]);
        assert!((closed.uncounted - UNNOTICED * UNNOTICED).abs() < 1e-12, "{closed:?}");
        span.forget(0);
        assert_eq!(span.closed(0), None);
    }

    #[test]
    fn unseen_use_restarts_span() {
        let mut span = Span::default();
        // Before the third mark, the SOC by voltage falls by 0.3 while no current is measured.
        let trips = [
            (Mode::Unknown, [0.0, 0.9]),
            (Mode::Discharge, [0.2, 0.7]),
            (Mode::Unknown, [0.2, 0.4]),
            (Mode::Discharge, [0.3, 0.3]),
            (Mode::Charge, [0.1, 0.5]),
        ];
        for (from, at) in trips {
            note(&mut span, from, at);
        }
        assert_eq!(span.closed(0), None);
        note(&mut span, Mode::Charge, [0.0, 0.6]);
        note(&mut span, Mode::Discharge, [0.1, 0.5]);
        let closed = span.closed(0).expect("the charge");
        assert_eq!(closed.ends, [0.3, 0.6]);
    }
}
