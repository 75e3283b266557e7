//! Tracks use and wear during a log: charge moved, and the learned capacity of the weakest cell.
//!
//! Use is counted in equivalent full cycles (charge moved divided by twice the rated capacity). Cycles and capacities
//! are known at the end of each half-cycle (a charge or a discharge). Between these times, the cycles are interpolated,
//! and the capacities keep their last value.

use std::collections::BTreeMap;

use super::truth::EndOfLifeSource;
use crate::monitor::{Event, EventKind};
use crate::quantity::catalogue::Quantity;
use crate::quantity::{CellIndex, Timestamp};

/// Charge moved and capacities learned so far.
#[derive(Debug, Clone)]
pub struct Track {
    rated_ah: f64,
    learned: EndOfLifeSource,
    moved_ah: BTreeMap<CellIndex, f64>,
    capacity_ah: BTreeMap<CellIndex, f64>,
    /// Time of each end of a half-cycle, and the equivalent full cycles up to this time.
    cycles: Vec<(Timestamp, f64)>,
    /// Time of each end of a half-cycle, the weakest learned capacity (Ah) and its cell.
    weakest: Vec<(Timestamp, f64, CellIndex)>,
}

impl Track {
    pub fn new(rated_ah: f64, learned: EndOfLifeSource) -> Self {
        let none = BTreeMap::new();
        Self { rated_ah, learned, moved_ah: none.clone(), capacity_ah: none, cycles: Vec::new(), weakest: Vec::new() }
    }

    /// Adds the events of one input.
    pub fn observe(&mut self, events: &[Event]) {
        for event in events {
            match event.kind {
                EventKind::HalfCycle { cell, charge_ah, .. } => self.move_charge(event.time, cell, charge_ah),
                EventKind::Capacity { cell, values, .. } => {
                    let is_usable = self.learned == EndOfLifeSource::LearnedUsable;
                    let quantity = if is_usable { Quantity::UsableCapacity } else { Quantity::Capacity };
                    self.learn(event.time, cell, values.mean(quantity));
                }
                EventKind::PackReplaced { .. } => self.capacity_ah.clear(),
                _ => {}
            }
        }
    }

    fn move_charge(&mut self, time: Timestamp, cell: CellIndex, charge_ah: f64) {
        let moved_ah = self.moved_ah.entry(cell).or_default();
        *moved_ah += charge_ah;
        let cycles = *moved_ah / (2.0 * self.rated_ah);
        let most = self.cycles.last().map_or(0.0, |last| last.1);
        // The same charge flows through all cells of a string. The count of a cell without estimates is too small, so
        // the largest count applies.
        if cycles > most {
            self.cycles.pop_if(|last| last.0 == time);
            self.cycles.push((time, cycles));
        }
    }

    fn learn(&mut self, time: Timestamp, cell: CellIndex, learned_ah: Option<f64>) {
        let Some(learned_ah) = learned_ah else { return };
        self.capacity_ah.insert(cell, learned_ah);
        let least = self.capacity_ah.iter().min_by(|a, b| a.1.total_cmp(b.1));
        let Some((&cell, &ah)) = least else { return };
        self.weakest.pop_if(|last| last.0 == time);
        self.weakest.push((time, ah, cell));
    }

    /// Returns the equivalent full cycles up to `time`.
    pub fn cycles_at(&self, time: Timestamp) -> f64 {
        let after = self.cycles.partition_point(|(at, _)| *at <= time);
        let before = after.checked_sub(1).and_then(|index| self.cycles.get(index));
        match (before, self.cycles.get(after)) {
            (Some(&(from, low)), Some(&(to, high))) => low + (high - low) * time.since(from) / to.since(from),
            (Some(&(_, cycles)), None) => cycles,
            (None, _) => 0.0,
        }
    }

    /// Returns the equivalent full cycles of the whole log.
    pub fn cycles(&self) -> f64 {
        self.cycles.last().map_or(0.0, |last| last.1)
    }

    /// Returns which learned capacity is tracked.
    pub fn learned(&self) -> EndOfLifeSource {
        self.learned
    }

    /// Returns the time from which the weakest learned capacity stays below `end_ah`, and the weakest cell at this
    /// time. `None` = the capacity at the end is not below `end_ah`, or nothing was learned.
    pub fn stays_below(&self, end_ah: f64) -> Option<(Timestamp, CellIndex)> {
        let below = self.weakest.iter().rev().take_while(|(_, ah, _)| *ah < end_ah).last();
        below.map(|&(time, _, cell)| (time, cell))
    }

    /// Returns the weakest learned capacity at the end of the log (Ah).
    pub fn last_ah(&self) -> Option<f64> {
        self.weakest.last().map(|last| last.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quantity::Mode;
    use crate::quantity::catalogue::RecordedValues;

    fn half_cycle(time_s: f64, cell: u16, charge_ah: f64) -> Event {
        let kind = EventKind::HalfCycle {
            cell: CellIndex(cell),
            mode: Mode::Charge,
            charge_ah,
            swing: None,
            swing_std: None,
            duration_s: 1.0,
            mean_current_a: 1.0,
            mean_temperature_c: None,
        };
        Event { time: Timestamp::from_secs(time_s), kind }
    }

    fn learned(time_s: f64, cell: u16, capacity_ah: f64) -> Event {
        let kind = EventKind::Capacity {
            cell: CellIndex(cell),
            measured_ah: None,
            measured_std_ah: None,
            values: RecordedValues::default()
                .with(Quantity::Capacity, Some((capacity_ah, 0.1)))
                .with(Quantity::UsableCapacity, Some((capacity_ah - 0.1, 0.1)))
                .with(Quantity::ResistanceRatio, Some((1.0, 0.1))),
        };
        Event { time: Timestamp::from_secs(time_s), kind }
    }

    #[test]
    fn cycles_are_interpolated_between_half_cycles() {
        let mut track = Track::new(2.0, EndOfLifeSource::Learned);
        track.observe(&[half_cycle(100.0, 0, 2.0), half_cycle(100.0, 1, 1.0), half_cycle(200.0, 0, 1.0)]);
        let at = |time_s| track.cycles_at(Timestamp::from_secs(time_s));
        assert_eq!((at(99.0), at(100.0), at(150.0), at(300.0)), (0.0, 0.5, 0.625, 0.75));
        assert_eq!(track.cycles(), 0.75);
    }

    #[test]
    fn end_is_when_weakest_cell_stays_below() {
        let mut track = Track::new(2.0, EndOfLifeSource::LearnedUsable);
        let lives = [(1.0, 0, 1.4), (1.0, 1, 1.6), (2.0, 0, 1.6), (3.0, 1, 1.45), (4.0, 0, 1.55), (5.0, 1, 1.4)];
        track.observe(&lives.map(|(time_s, cell, ah)| learned(time_s, cell, ah)));
        assert_eq!(track.stays_below(1.4), Some((Timestamp::from_secs(3.0), CellIndex(1))));
        assert_eq!(track.stays_below(1.25), None);
        assert!((track.last_ah().expect("learned") - 1.3).abs() < 1e-12);
    }
}
