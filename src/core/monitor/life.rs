//! Remaining useful life: each cell's forecast is fed by its half-cycles, and the pack's is its weakest cell's.
//!
//! What feeds a forecast is what each half-cycle alone says of the capacity, not the learned capacity: learned capacities
//! that follow each other are mostly the same evidence. What all half-cycles have wrong alike (the current sensor's gain)
//! goes in as the shared part of the deviation.

use super::{CellSlot, Event, EventKind, Monitor, MonitorConfig, Outputs};

use crate::alarm::{Observation, Rule};
use crate::health::{
    Axis, CapacityReading, CapacityUpdate, Forecast, HalfCycle, InsufficientData, Remaining, RemainingLife, Usage,
};
use crate::quantity::CellIndex;

/// Deviations of a normal distribution between its median and its 5 % quantile.
const LOW_DEVIATIONS: f64 = 1.645;

/// A cell's forecast and what it said last.
#[derive(Debug, Clone)]
pub(super) struct CellLife {
    pub(super) forecast: Forecast,
    pub(super) remaining: Result<RemainingLife, InsufficientData>,
}

impl CellLife {
    pub(super) fn new(config: &MonitorConfig) -> Self {
        let forecast = Forecast::new(Axis::Cycles, config.model.rated_capacity_ah);
        Self::of(forecast, config)
    }

    /// Of a stored forecast.
    pub(super) fn of(forecast: Forecast, config: &MonitorConfig) -> Self {
        let remaining = forecast.remaining(config.health.end_of_life_ah);
        Self { forecast, remaining }
    }

    /// A half-cycle is over, and so long after the one before (seconds; `None` = not known). `update` is what it taught.
    pub(super) fn learn(
        &mut self,
        config: &MonitorConfig,
        half: &HalfCycle,
        since_before_s: Option<f64>,
        update: Option<&CapacityUpdate>,
    ) {
        let rated_ah = config.model.rated_capacity_ah;
        let passed = Usage::in_half_cycle(half.charge_ah, half.duration_s, since_before_s, rated_ah);
        let reading = update.and_then(|update| {
            let z = update.measurement?;
            let gain_ah = config.health.capacity.current_gain_std * update.capacity.mean;
            Some(CapacityReading {
                capacity_ah: z.value,
                variance_ah2: z.variance,
                shared_variance_ah2: gain_ah * gain_ah,
            })
        });
        self.forecast.update(passed, reading);
        self.restate(config);
    }

    /// The same forecast, of another threshold perhaps.
    pub(super) fn restate(&mut self, config: &MonitorConfig) {
        self.remaining = self.forecast.remaining(config.health.end_of_life_ah);
    }

    /// Equivalent full cycles until the end of life; `None` = not known.
    fn cycles(&self) -> Option<Remaining> {
        self.remaining.ok().and_then(|life| life.cycles)
    }
}

impl Monitor {
    /// Remaining life of a cell until its capacity passes the configured end of life.
    ///
    /// # Errors
    /// While too little is known.
    pub fn remaining_life(&self, cell: CellIndex) -> Result<RemainingLife, InsufficientData> {
        self.cells.get(cell.index()).map_or(Err(InsufficientData::Readings { found: 0 }), |slot| slot.life.remaining)
    }

    /// The forecast of a cell, for pictures; `None` = there is no such cell.
    pub fn forecast(&self, cell: CellIndex) -> Option<&Forecast> {
        Some(&self.cells.get(cell.index())?.life.forecast)
    }

    /// The cell whose life ends first, and when; `None` until every cell's is known.
    pub fn pack_remaining_life(&self) -> Option<(CellIndex, RemainingLife)> {
        let all_known = self.cells.iter().all(|slot| slot.life.cycles().is_some());
        self.shortest_life().filter(|_| all_known)
    }

    /// The same of the cells whose life is known.
    fn shortest_life(&self) -> Option<(CellIndex, RemainingLife)> {
        let median = |slot: &CellSlot| slot.life.cycles().map(|cycles| cycles.median);
        let known = (0..).map(CellIndex).zip(&self.cells).filter_map(|(cell, slot)| Some((median(slot)?, cell)));
        let (_, cell) = known.min_by(|a, b| a.0.total_cmp(&b.0))?;
        Some((cell, self.cells[cell.index()].life.remaining.ok()?))
    }

    /// After a half-cycle: what remains, to the record and to the rule. `is_new`: some cell's capacity was measured.
    pub(super) fn tell_life(&mut self, was_known: bool, is_new: bool, out: &mut Outputs) {
        let found = self.pack_remaining_life();
        if was_known || found.is_some() {
            out.events.push(Event { time: self.now, kind: life_event(found) });
        }
        self.observe_life(is_new, out);
    }

    /// The end of life is another one: what was said of the one before is not known of it, before new thresholds look.
    pub(super) fn restate_lives(&mut self, out: &mut Outputs) {
        let before = self.pack_remaining_life();
        self.cells.iter_mut().for_each(|slot| slot.life.restate(&self.config));
        self.observe_alarm(Rule::RemainingLifeLow, None, Observation::default(), out);
        let found = self.pack_remaining_life();
        if before != found {
            out.events.push(Event { time: self.now, kind: life_event(found) });
        }
    }

    /// For the rule: while some cell's life is not known the pack's may be shorter, never longer.
    pub(super) fn observe_life(&mut self, is_new: bool, out: &mut Outputs) {
        let is_bound = self.pack_remaining_life().is_none();
        let cycles = self.shortest_life().and_then(|(_, life)| life.cycles);
        let seen = cycles.map_or(Observation::default(), |cycles| {
            let std = (cycles.median - cycles.low) / LOW_DEVIATIONS;
            Observation { is_bound, is_new, ..Observation::new(Some(cycles.median)).with_std(std) }
        });
        self.observe_alarm(Rule::RemainingLifeLow, None, seen, out);
    }
}

fn life_event(found: Option<(CellIndex, RemainingLife)>) -> EventKind {
    let cycles = found.and_then(|(_, life)| life.cycles);
    let days = found.and_then(|(_, life)| life.days);
    EventKind::RemainingLife {
        cell: found.map(|(cell, _)| cell),
        cycles: cycles.map(|cycles| cycles.median),
        cycles_low: cycles.map(|cycles| cycles.low),
        cycles_high: cycles.map(|cycles| cycles.high),
        days: days.map(|days| days.median),
        days_low: days.map(|days| days.low),
        days_high: days.map(|days| days.high),
    }
}
