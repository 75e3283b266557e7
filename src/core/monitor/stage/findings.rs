//! Findings stage: detects faults of cells and sensors from cell samples.
//!
//! In: the samples of all cells with their estimates. Out: an event for each new finding ([`EventKind::Finding`]).
//! Estimates and capacities do not depend on findings. When a row of the detector (a few minutes of samples) ends, its
//! results go to the alarm rules about single cells. If the rule `thermal_event` is configured, the stage also checks
//! the readings for a thermal event.

use super::estimation::Estimation;
use super::learning::Learning;
use super::sampling::Sampling;
use crate::alarm::Rule;
use crate::cell_faults::fault::OFFSET_PER_H;
use crate::cell_faults::gain::CellAgeing;
use crate::cell_faults::thermal_event::ThermalWatch;
use crate::cell_faults::{BalancingConfig, CellFaultDetector, CellFaultKind, MeanCell};
use crate::filter::{ScalarGaussian, probability_below};
use crate::monitor::config::MonitorConfig;
use crate::monitor::message::{Event, EventKind, Outputs};
use crate::quantity::{CellIndex, Channel, Fault, Reading, Timestamp};
use crate::sample::CellSample;

#[derive(Debug)]
pub(crate) struct Findings {
    pub(crate) diagnosis: CellFaultDetector,
    cells: usize,
    /// Cells that the detector compares with each other: all cells except those in modules of another kind.
    compared: Vec<usize>,
    /// Whether the BMS discharges fuller cells after a charge (passive balancing).
    is_balanced: bool,
    /// Meaning of the balancing bits; `None` without balancing bits.
    balancing: Option<BalancingConfig>,
    /// `None` without the rule `thermal_event`.
    thermal: Option<ThermalWatch>,
}

impl Findings {
    /// `compared`: all cells except those in modules of another kind.
    pub(crate) fn new(config: &MonitorConfig, compared: &[usize]) -> Self {
        let cells = usize::from(config.sample.cells);
        let (is_balanced, balancing) = (config.is_balanced, config.balancing);
        let (compared, diagnosis) = (compared.to_vec(), CellFaultDetector::among(cells, compared));
        let thermal = thermal_watch(config);
        Self { diagnosis, cells, compared, is_balanced, balancing, thermal }
    }

    pub(crate) fn reconfigure(&mut self, config: &MonitorConfig) {
        (self.is_balanced, self.balancing) = (config.is_balanced, config.balancing);
        let new = thermal_watch(config);
        self.thermal = new.map(|new| self.thermal.take().unwrap_or(new));
    }

    pub(crate) fn forget(&mut self) {
        self.diagnosis = CellFaultDetector::among(self.cells, &self.compared);
        self.interrupt_thermal();
    }

    /// Handles a break in the readings. A rise or fall across the break does not count as a thermal event.
    pub(crate) fn interrupt_thermal(&mut self) {
        self.thermal.iter_mut().for_each(ThermalWatch::interrupt);
    }

    pub(crate) fn stored_thermal(&self) -> Option<ThermalWatch> {
        self.thermal.clone()
    }

    /// Restores a stored watch that has been checked. If the configuration has changed, the stored watch is ignored.
    pub(crate) fn restore_thermal(&mut self, stored: Option<ThermalWatch>) {
        if let (Some(thermal), Some(stored)) = (&mut self.thermal, stored)
            && stored.fits(thermal)
        {
            *thermal = stored;
        }
    }

    /// Checks a reading for a thermal event, before its plausibility check. Returns the cell and its evidence if the
    /// evidence is new.
    #[inline]
    pub(crate) fn watch_reading(
        &mut self,
        now: Timestamp,
        reading: &Reading,
        (sampling, estimation): (&Sampling, &Estimation),
    ) -> Option<(CellIndex, f64)> {
        let (thermal, value) = (self.thermal.as_mut()?, reading.value.ok()?);
        let cell = match reading.channel {
            Channel::CellVoltage(cell) => {
                let rate_per_h = || rate_per_h(now, cell.index(), sampling, estimation);
                thermal.handle_voltage(now, cell, value, rate_per_h).then_some(cell)
            }
            Channel::Temperature(sensor) => {
                let sensors = &sampling.sampler.config().sensor_of_cell;
                let measures = |cell: usize| sensors.get(cell) == Some(&Some(sensor));
                let first = (0..sensors.len()).find(|&cell| measures(cell))?;
                let rate_per_h = rate_per_h(now, first, sampling, estimation);
                thermal.handle_temperature(now, sensor, value, rate_per_h, measures)
            }
            _ => None,
        }?;
        Some((cell, thermal.evidence_of(now, cell)))
    }

    /// Updates the evidence for a thermal event. Returns the evidence of each cell, or an empty list if no update is
    /// due.
    pub(crate) fn refresh_thermal(
        &mut self,
        now: Timestamp,
        (sampling, estimation): (&Sampling, &Estimation),
    ) -> Vec<(CellIndex, Option<f64>)> {
        let Some(thermal) = &mut self.thermal else { return Vec::new() };
        let least_soc = |cell: usize| estimation.bank.soc(cell).map(|soc| soc.mean - 2.0 * soc.std());
        let rate_per_h = |cell: usize| rate_per_h(now, cell, sampling, estimation);
        if !thermal.refresh(now, rate_per_h, least_soc) {
            return Vec::new();
        }
        thermal.evidence(now, &sampling.sampler.config().sensor_of_cell).collect()
    }

    /// The state to be stored; `None` if the pack is too small for a comparison.
    pub(crate) fn stored(&self) -> Option<CellFaultDetector> {
        self.diagnosis.is_active().then(|| self.diagnosis.clone())
    }

    /// Restores a checked state. `away`: start and end of the time in which the daemon did not run; `None` if the
    /// daemon ran without a break.
    pub(crate) fn restore(&mut self, stored: Option<CellFaultDetector>, away: Option<(Timestamp, Timestamp)>) {
        let Some(stored) = stored.filter(|_| self.diagnosis.is_active()) else { return };
        self.diagnosis = stored;
        self.diagnosis.compare_only(&self.compared);
        if let Some((from, to)) = away {
            self.diagnosis.interrupt();
            self.diagnosis.note_missed_bits(from, to);
        }
    }

    pub(crate) fn faulty_channels(&self) -> Vec<CellIndex> {
        let is_faulty = |cell: &CellIndex| self.diagnosis.has_channel_fault(*cell) == Some(true);
        (0..).map(CellIndex).take(self.cells).filter(is_faulty).collect()
    }

    pub(crate) fn handle_balancing(&mut self, now: Timestamp, cell: CellIndex, reading: Result<f64, Fault>) {
        if let Some(balancing) = &self.balancing {
            let is_bled = reading.ok().map(|value| value != 0.0);
            self.diagnosis.handle_balancing(cell.index(), now, is_bled, now.plus_secs(balancing.max_age_s));
        }
    }

    /// Adds or withdraws the finding that the reading of the current is frozen. This cannot wait for the end of a row,
    /// because no row ends without readings of the current.
    pub(crate) fn watch_current(&mut self, now: Timestamp, is_frozen: bool, out: &mut Outputs) {
        let is_found = || self.diagnosis.findings().iter().any(|found| found.kind == CellFaultKind::CurrentFrozen);
        if self.diagnosis.is_active() && is_frozen != is_found() {
            let size = ScalarGaussian { mean: 1.0, variance: 0.0 };
            let new =
                self.diagnosis.note_sensor(now, CellFaultKind::CurrentFrozen, f64::from(u8::from(is_frozen)), size);
            out.events.extend(new.map(|finding| Event { time: now, kind: EventKind::Finding(finding) }));
        }
    }

    /// Handles samples that the estimator has already processed. `is_prior`: whether the cell model comes from a label.
    /// Returns whether these samples completed a row of the detector.
    #[inline]
    pub(crate) fn observe(
        &mut self,
        now: Timestamp,
        samples: &[CellSample],
        (estimation, is_prior): (&Estimation, bool),
        learning: &Learning,
        out: &mut Outputs,
    ) -> bool {
        if !self.diagnosis.is_active() {
            return false;
        }
        for sample in samples.iter().filter(|sample| estimation.bank.is_own(sample.cell.index())) {
            let CellSample { cell, time, voltage_v, current_a, temperature_c, .. } = *sample;
            self.diagnosis.add(cell.index(), time, voltage_v, current_a, temperature_c);
        }
        let middle = self.diagnosis.middle();
        let Some(sample) = samples.iter().find(|sample| sample.cell.index() == middle) else { return false };
        let bank = &estimation.bank;
        let (Some(soc), Some(current_a)) = (bank.filtered_soc(middle), sample.current_a) else {
            self.diagnosis.interrupt();
            return false;
        };
        let (model, capacity_ah) = (bank.own_model(), learning.capacity(middle).mean);
        let temperature_c = bank.temperature_c(middle).unwrap_or(estimation.ambient_c());
        let position = model.grid_position(soc.mean.clamp(0.0, 1.0), temperature_c);
        let ohm = model.r0_ohm(&position) * libm::exp(bank.log_resistance(middle).mean);
        let drop_v = current_a * ohm + bank.branch_v(middle)[..model.branches.len()].iter().sum::<f64>();
        let charge_ah = sample.charge_as / 3600.0;
        let mean = MeanCell { soc: soc.mean, current_a, drop_v, temperature_c, charge_ah };
        let is_complete = self.diagnosis.note(sample.time, &mean, capacity_ah);
        if is_complete {
            let socs = |cell: usize| bank.filtered_soc(cell).filter(|_| bank.is_own(cell)).map(|soc| soc.mean);
            let mut reported =
                self.diagnosis.close_row((model, is_prior), capacity_ah, socs, self.is_balanced, self.balancing);
            let (probability, size) = current_offset(learning, model.rated_capacity_ah);
            reported.extend(self.diagnosis.note_sensor(now, CellFaultKind::CurrentOffset, probability, size));
            let cell = |index: usize| CellAgeing {
                capacity_ah: learning.capacity(index),
                log_resistance: bank.log_resistance(index).mean,
            };
            reported.extend(self.diagnosis.note_day(now, temperature_c, self.compared.iter().copied().map(cell)));
            out.events
                .extend(reported.into_iter().map(|finding| Event { time: now, kind: EventKind::Finding(finding) }));
        }
        is_complete
    }
}

/// Current of a cell relative to its rated capacity (1/h); `None` = unknown.
fn rate_per_h(now: Timestamp, cell: usize, sampling: &Sampling, estimation: &Estimation) -> Option<f64> {
    Some(sampling.sampler.cell_current_a(now)? / estimation.bank.model(cell).rated_capacity_ah)
}

fn thermal_watch(config: &MonitorConfig) -> Option<ThermalWatch> {
    let is_wanted = config.rules.iter().any(|rule| rule.rule == Rule::ThermalEvent);
    is_wanted.then(|| ThermalWatch::new(config.sample.cells.into(), config.sample.sensors().into()))
}

/// Probability that the current sensor's offset is larger than [`OFFSET_PER_H`], and the learned offset as a fraction
/// of the rated capacity per hour.
fn current_offset(learning: &Learning, rated_ah: f64) -> (f64, ScalarGaussian) {
    let offset = learning.state.learner.current_offset().learned(learning.config.capacity.current_offset_std_a);
    let offset = offset.unwrap_or(ScalarGaussian { mean: 0.0, variance: 1.0 });
    let size = ScalarGaussian { mean: offset.mean / rated_ah, variance: offset.variance / (rated_ah * rated_ah) };
    (probability_below(size.mean.abs() - OFFSET_PER_H, size.std().max(1e-12)), size)
}
