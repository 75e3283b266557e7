//! Remaining useful life: each half-cycle updates the forecasts of the cells. The remaining life of the pack is the
//! shortest remaining life of its cells.
//!
//! A forecast uses the capacity measured by each single half-cycle, not the learned capacity, because successive
//! learned capacities share most of their evidence. All half-cycles share the error of the current sensor's gain. This
//! error enters the forecast as the shared variance.

use crate::alarm::{Observation, Rule};
use crate::cell::{CellModel, PackBank};
use crate::health::{
    Axis, CapacityReading, CapacityUpdate, Forecast, HalfCycle, HealthConfig, InsufficientData, Remaining,
    RemainingLife, Usage,
};
use crate::monitor::message::EventKind;
use crate::monitor::stage::publisher::Publisher;
use crate::quantity::CellIndex;

/// Number of standard deviations between the median and the 5 % quantile of a normal distribution.
const LOW_DEVIATIONS: f64 = 1.645;

#[derive(Debug, Clone)]
pub(crate) struct CellLife {
    pub(crate) forecast: Forecast,
    pub(crate) remaining: Result<RemainingLife, InsufficientData>,
}

impl CellLife {
    pub(crate) fn new(model: &CellModel, config: &HealthConfig) -> Self {
        Self::restore(Forecast::new(Axis::Cycles, model.rated_capacity_ah), config)
    }

    pub(crate) fn restore(forecast: Forecast, config: &HealthConfig) -> Self {
        let remaining = forecast.remaining(config.end_of_life_ah);
        Self { forecast, remaining }
    }

    /// Updates the forecast with a half-cycle. `since_before_s`: time from the end of the previous half-cycle to the
    /// end of this one; `None` = unknown. `update`: the capacity update of this half-cycle.
    pub(crate) fn learn(
        &mut self,
        model: &CellModel,
        config: &HealthConfig,
        half: &HalfCycle,
        since_before_s: Option<f64>,
        update: Option<&CapacityUpdate>,
    ) {
        let usage = Usage::in_half_cycle(half.charge_ah, half.duration_s, since_before_s, model.rated_capacity_ah);
        let reading = update.and_then(|update| {
            let z = update.measurement?;
            let gain_ah = config.capacity.current_gain_std * update.capacity.mean;
            Some(CapacityReading {
                capacity_ah: z.value,
                variance_ah2: z.variance,
                shared_variance_ah2: gain_ah * gain_ah,
            })
        });
        self.forecast.update(usage, reading);
        if self.forecast.check(Axis::Cycles).is_err() {
            // Impossible use or readings have made the state of the forecast impossible, so the forecast restarts.
            self.forecast = Forecast::new(Axis::Cycles, model.rated_capacity_ah);
        }
        self.restate(config);
    }

    /// Computes the remaining life again, for example after a change of the end-of-life capacity.
    fn restate(&mut self, config: &HealthConfig) {
        self.remaining = self.forecast.remaining(config.end_of_life_ah);
    }

    /// Equivalent full cycles until the end of life; `None` if unknown.
    fn cycles(&self) -> Option<Remaining> {
        self.remaining.ok().and_then(|life| life.cycles)
    }
}

#[derive(Debug)]
pub(crate) struct PackLife {
    pub(crate) cells: Vec<CellLife>,
}

impl PackLife {
    pub(crate) fn new(bank: &PackBank, config: &HealthConfig) -> Self {
        Self { cells: (0..bank.cells()).map(|cell| CellLife::new(bank.model(cell), config)).collect() }
    }

    pub(crate) fn of_cell(&self, cell: CellIndex) -> Result<RemainingLife, InsufficientData> {
        self.cells.get(cell.index()).map_or(Err(InsufficientData::Readings { found: 0 }), |cell| cell.remaining)
    }

    /// The cell with the shortest remaining life, and that life; `None` until every cell's life is known.
    pub(crate) fn of_pack(&self) -> Option<(CellIndex, RemainingLife)> {
        let all_known = self.cells.iter().all(|cell| cell.cycles().is_some());
        self.shortest().filter(|_| all_known)
    }

    /// The cell with the shortest remaining life among the cells whose remaining life is known.
    fn shortest(&self) -> Option<(CellIndex, RemainingLife)> {
        let median = |cell: &CellLife| cell.cycles().map(|cycles| cycles.median);
        let known = (0..).map(CellIndex).zip(&self.cells).filter_map(|(index, cell)| Some((median(cell)?, index)));
        let (_, cell) = known.min_by(|a, b| a.0.total_cmp(&b.0))?;
        Some((cell, self.cells[cell.index()].remaining.ok()?))
    }

    /// Publishes the pack's remaining life after a half-cycle, if this life is known or has just become unknown.
    /// `was_known`: whether this life was known before the half-cycle. `is_new`: whether the half-cycle measured a
    /// cell's capacity.
    pub(crate) fn publish(&self, was_known: bool, is_new: bool, to: &mut Publisher<'_>) {
        let life = self.of_pack();
        if was_known || life.is_some() {
            to.event(life_event(life));
        }
        self.observe(is_new, to);
    }

    /// Computes the remaining lives for another end-of-life capacity. The alarm value is unknown until the caller calls
    /// [`Self::observe`] with the new thresholds.
    pub(crate) fn restate(&mut self, config: &HealthConfig, to: &mut Publisher<'_>) {
        let before = self.of_pack();
        self.cells.iter_mut().for_each(|cell| cell.restate(config));
        to.observe(Rule::RemainingLifeLow, None, Observation::default());
        let life = self.of_pack();
        if before != life {
            to.event(life_event(life));
        }
    }

    /// Passes the shortest known life to the alarm rule. While the life of a cell is unknown, the value is an upper
    /// bound.
    pub(crate) fn observe(&self, is_new: bool, to: &mut Publisher<'_>) {
        let is_bound = self.of_pack().is_none();
        let cycles = self.shortest().and_then(|(_, life)| life.cycles);
        let value = cycles.map_or(Observation::default(), |cycles| {
            let std = (cycles.median - cycles.low) / LOW_DEVIATIONS;
            Observation { is_bound, is_new, ..Observation::new(Some(cycles.median)).with_std(std) }
        });
        to.observe(Rule::RemainingLifeLow, None, value);
    }
}

fn life_event(life: Option<(CellIndex, RemainingLife)>) -> EventKind {
    let cycles = life.and_then(|(_, life)| life.cycles);
    let days = life.and_then(|(_, life)| life.days);
    EventKind::RemainingLife {
        cell: life.map(|(cell, _)| cell),
        cycles: cycles.map(|cycles| cycles.median),
        cycles_low: cycles.map(|cycles| cycles.low),
        cycles_high: cycles.map(|cycles| cycles.high),
        days: days.map(|days| days.median),
        days_low: days.map(|days| days.low),
        days_high: days.map(|days| days.high),
    }
}
