//! Diagnosis stage: from cell samples to findings about single cells.
//!
//! In: the samples of all cells with their estimates. Out: an event for each finding that is new ([`EventKind::Finding`]).
//! It only watches: no estimate and no capacity depends on it.

use super::estimation::Estimation;
use super::learning::Learning;
use super::{Event, EventKind, MonitorConfig, Outputs};
use crate::filter::ScalarGaussian;
use crate::findings::{Diagnosis, FindingKind, MeanCell};
use crate::quantity::Timestamp;
use crate::sample::CellSample;

/// Offset of the current beyond which its sensor is faulty, part of the rated capacity per hour: SOC runs away by a quarter in a day.
const OFFSET_PER_H: f64 = 0.01;

/// The diagnosis stage.
#[derive(Debug)]
pub(super) struct Diagnosing {
    pub(super) diagnosis: Diagnosis,
    cells: usize,
    /// The BMS lets fuller cells lose charge.
    is_balanced: bool,
}

impl Diagnosing {
    pub(super) fn new(config: &MonitorConfig) -> Self {
        let cells = usize::from(config.sample.cells);
        Self { diagnosis: Diagnosis::new(cells), cells, is_balanced: config.is_balanced }
    }

    /// Other settings for the same cells.
    pub(super) fn reconfigure(&mut self, config: &MonitorConfig) {
        self.is_balanced = config.is_balanced;
    }

    /// Forgets everything: another pack is connected.
    pub(super) fn forget(&mut self) {
        self.diagnosis = Diagnosis::new(self.cells);
    }

    /// The state, to be stored; `None` = the pack is too small for a comparison.
    pub(super) fn stored(&self) -> Option<Diagnosis> {
        self.diagnosis.is_active().then(|| self.diagnosis.clone())
    }

    /// Continues from a checked state. `is_continued`: without a break.
    pub(super) fn restore(&mut self, stored: Option<Diagnosis>, is_continued: bool) {
        let Some(stored) = stored else { return };
        self.diagnosis = stored;
        if !is_continued {
            self.diagnosis.interrupt();
        }
    }

    /// Takes samples that have made their step.
    #[inline]
    pub(super) fn observe(
        &mut self,
        now: Timestamp,
        samples: &[CellSample],
        estimation: &Estimation,
        learning: &Learning,
        is_current_frozen: bool,
        out: &mut Outputs,
    ) {
        if !self.diagnosis.is_active() {
            return;
        }
        for sample in samples {
            let CellSample { cell, time, voltage_v, current_a, temperature_c, .. } = *sample;
            self.diagnosis.add(cell.index(), time, voltage_v, current_a, temperature_c);
        }
        self.observe_mean(now, samples, estimation, learning, is_current_frozen, out);
    }

    fn observe_mean(
        &mut self,
        now: Timestamp,
        samples: &[CellSample],
        estimation: &Estimation,
        learning: &Learning,
        is_current_frozen: bool,
        out: &mut Outputs,
    ) {
        let middle = self.diagnosis.middle();
        let Some(sample) = samples.iter().find(|sample| sample.cell.index() == middle) else { return };
        let bank = &estimation.bank;
        let (Some(soc), Some(current_a)) = (bank.filtered_soc(middle), sample.current_a) else {
            return self.diagnosis.interrupt();
        };
        let (model, capacity_ah) = (bank.model(), learning.capacity(middle).mean);
        let temperature_c = bank.temperature_c(middle).unwrap_or(estimation.ambient_c());
        let position = model.grid_position(soc.mean.clamp(0.0, 1.0), temperature_c);
        let ohm = model.r0_ohm(&position) * libm::exp(bank.log_resistance(middle).mean);
        let drop_v = current_a * ohm + bank.branch_v(middle)[..model.branches.len()].iter().sum::<f64>();
        let charge_ah = sample.charge_as / 3600.0;
        let mean = MeanCell { soc: soc.mean, current_a, drop_v, temperature_c, charge_ah };
        if self.diagnosis.note(sample.time, &mean, capacity_ah) {
            let socs = |cell: usize| bank.filtered_soc(cell).map(|soc| soc.mean);
            let sensors = shared_sensors(is_current_frozen, learning, model.rated_capacity_ah);
            let reported = self.diagnosis.close_row(model, capacity_ah, socs, &sensors, self.is_balanced);
            out.events
                .extend(reported.into_iter().map(|finding| Event { time: now, kind: EventKind::Finding(finding) }));
        }
    }
}

/// How probable a fault is of the sensors that all cells share: what the other stages know of them.
fn shared_sensors(
    is_current_frozen: bool,
    learning: &Learning,
    rated_ah: f64,
) -> [(FindingKind, f64, ScalarGaussian); 2] {
    let frozen = ScalarGaussian { mean: 1.0, variance: 0.0 };
    let offset = learning.state.learner.current_offset().learned(learning.config.capacity.current_offset_std_a);
    let offset = offset.unwrap_or(ScalarGaussian { mean: 0.0, variance: 1.0 });
    let size = ScalarGaussian { mean: offset.mean / rated_ah, variance: offset.variance / (rated_ah * rated_ah) };
    let beyond = (size.mean.abs() - OFFSET_PER_H) / (size.std() * std::f64::consts::SQRT_2).max(1e-12);
    [
        (FindingKind::CurrentFrozen, f64::from(u8::from(is_current_frozen)), frozen),
        (FindingKind::CurrentOffset, 0.5 * libm::erfc(-beyond), size),
    ]
}
