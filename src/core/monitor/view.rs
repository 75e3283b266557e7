//! The core as it stands, for those who only look: what is known now, and `None` for what is not (any more).

use super::{Monitor, Statistics, Validity};
use crate::filter::ScalarGaussian;
use crate::health::{InsufficientData, RemainingLife};
use crate::quantity::{CellIndex, Channel, Mode, Timestamp};
use crate::sample::{ReadingCounts, VoltageSource};

/// One cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellView {
    /// Which.
    pub cell: CellIndex,
    /// Voltage, V, while its last good reading is fresh.
    pub voltage_v: Option<f64>,
    /// Current, A, positive = discharge, while fresh.
    pub current_a: Option<f64>,
    /// Temperature of its sensor, degrees C, while fresh.
    pub temperature_c: Option<f64>,
    /// State of charge, fraction, while its voltage is fresh.
    pub soc: Option<ScalarGaussian>,
    /// Capacity, Ah, once a half-cycle taught something about it.
    pub capacity: Option<ScalarGaussian>,
    /// Usable capacity, Ah, likewise.
    pub usable_capacity: Option<ScalarGaussian>,
    /// Resistance relative to new, while its voltage is fresh.
    pub resistance_ratio: Option<ScalarGaussian>,
    /// What remains until the end of life, or why that is not known.
    pub remaining_life: Result<RemainingLife, InsufficientData>,
    /// Whether its innovations agree with their covariance; `None` while there is no SOC.
    pub trusted: Option<bool>,
}

/// The pack.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PackView {
    /// Validity of the estimates.
    pub validity: Validity,
    /// Charge, rest or discharge.
    pub mode: Mode,
    /// State of charge, fraction.
    pub soc: Option<ScalarGaussian>,
    /// The cell that ends a discharge.
    pub limiting_cell: Option<CellIndex>,
    /// Sum of the cells' voltages, V, while all are fresh.
    pub voltage_v: Option<f64>,
    /// Current, A, positive = discharge.
    pub current_a: Option<f64>,
    /// Highest temperature, degrees C, while all sensors are fresh.
    pub temperature_max_c: Option<f64>,
    /// The cell with the least capacity, and that, Ah, once every cell was learned.
    pub weakest: Option<(CellIndex, ScalarGaussian)>,
    /// Least usable capacity, Ah, likewise.
    pub usable_capacity: Option<ScalarGaussian>,
    /// Capacity relative to rated, likewise.
    pub soh: Option<f64>,
    /// The cell whose life ends first, and when, once every cell's is known.
    pub remaining_life: Option<(CellIndex, RemainingLife)>,
    /// Last recorded recharge period, s.
    pub recharge_period_s: Option<f64>,
    /// What the reference charger would need, s.
    pub normalised_recharge_period: Option<ScalarGaussian>,
    /// SOC as the pack itself reports it, fraction.
    pub reported_soc: Option<f64>,
    /// SOH as the pack itself reports it, fraction.
    pub reported_soh: Option<f64>,
}

impl Monitor {
    /// Time of the latest input.
    pub fn now(&self) -> Timestamp {
        self.now
    }

    /// Counts since the first start.
    pub fn statistics(&self) -> &Statistics {
        &self.statistics
    }

    /// Readings by what became of them.
    pub fn reading_counts(&self) -> ReadingCounts {
        self.sampler.reading_counts()
    }

    /// Every cell as it stands.
    pub fn cell_views(&self) -> impl ExactSizeIterator<Item = CellView> + '_ {
        (0..self.config.sample.cells).map(CellIndex).map(|cell| self.cell_view(cell))
    }

    fn cell_view(&self, cell: CellIndex) -> CellView {
        let slot = &self.cells[cell.index()];
        let channel = self.voltage_channel(cell);
        let is_fresh = self.sampler.is_fresh(channel, self.now);
        let soc = self.estimators.soc(cell.index()).filter(|_| is_fresh);
        CellView {
            cell,
            voltage_v: self.sampler.reported(channel, self.now).filter(|_| is_fresh),
            current_a: self.sampler.cell_current_a(self.now),
            temperature_c: self.sampler.temperature_c(cell, self.now),
            soc,
            capacity: self.learner.has_learned(cell.index()).then(|| self.capacity(cell)),
            usable_capacity: slot.usable.filter(|_| self.learner.has_learned(cell.index())),
            resistance_ratio: soc.map(|_| self.resistance(cell.index())),
            remaining_life: self.remaining_life(cell),
            trusted: soc.map(|_| slot.trusted),
        }
    }

    /// Sum of the cells' voltages, while all are fresh.
    fn pack_voltage_v(&self) -> Option<f64> {
        let sum_v: Option<f64> = self.cell_views().map(|view| view.voltage_v).sum();
        match self.config.sample.voltage_source {
            VoltageSource::Cells => sum_v,
            VoltageSource::PackTotal { series } => sum_v.map(|cell_v| cell_v * f64::from(series)),
        }
    }

    /// The pack as it stands.
    pub fn pack_view(&self) -> PackView {
        let pack = self.pack.as_ref();
        let health = self.health_fields();
        let capacities = self.cell_views().filter_map(|view| view.capacity.map(|capacity| (view.cell, capacity)));
        let weakest = capacities.min_by(|a, b| a.1.mean.total_cmp(&b.1.mean));
        PackView {
            validity: self.validity(),
            mode: self.detector.mode(),
            soc: pack.map(|pack| ScalarGaussian::from_std(pack.soc, pack.soc_std)),
            limiting_cell: pack.map(|pack| pack.limiting_cell),
            voltage_v: self.pack_voltage_v(),
            current_a: self.sampler.pack_current_a(self.now),
            temperature_max_c: self
                .sampler
                .hottest_c(self.now)
                .and_then(|(hottest_c, is_whole)| is_whole.then_some(hottest_c)),
            weakest: weakest.filter(|_| self.learner.has_learned_all()),
            usable_capacity: health
                .usable_capacity_ah
                .zip(health.usable_capacity_std_ah)
                .map(|(mean, std)| ScalarGaussian::from_std(mean, std)),
            soh: health.soh,
            remaining_life: self.pack_remaining_life(),
            recharge_period_s: self.recharge_period_s,
            normalised_recharge_period: self.normalised_recharge,
            reported_soc: self.sampler.reported(Channel::ReportedSoc, self.now),
            reported_soh: self.sampler.reported(Channel::ReportedSoh, self.now),
        }
    }
}
