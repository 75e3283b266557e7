//! Remaining energy, time to empty or full, and available power of the pack. These values are computed on demand from
//! the states of the monitor's stages (sampling, estimation, learning).

use super::{EventKind, Stages};
use crate::cell::{ModelBands, arrhenius};
use crate::filter::{ScalarGaussian, square};
use crate::health::outlook::{CellNow, Outlook, Structure, energy_health, of_pack};
use crate::quantity::CellIndex;
use crate::quantity::catalogue::{PackValues, Quantity, RecordedPackValues};
use crate::sample::VoltageSource;

impl Stages {
    /// Energy, time and power of the pack; `None` unless the state of every cell is known.
    fn outlook(&self) -> Option<Outlook> {
        let Self { sampling, estimation, learning, .. } = self;
        let pack = learning.state.pack.as_ref()?;
        let cells: Vec<_> = (0..estimation.cells()).map(|index| self.cell_state(index)).collect::<Option<_>>()?;
        let (config, sampler) = (&learning.config.outlook, &sampling.sampler);
        let series_per_state = match sampler.config().voltage_source {
            VoltageSource::Cells => 1.0,
            VoltageSource::PackTotal { series } => f64::from(series),
        };
        let (soc, capacity_ah) = (pack.soc, pack.capacity_ah);
        let structure = Structure { series_per_state, strings: sampler.strings(), soc, capacity_ah };
        of_pack(config, (&learning.state.load, learning.mode()), &cells, &structure)
    }

    /// Sets the values of energy, time and power. Returns the cell that limits the discharge and the cell that limits
    /// the charge.
    pub(crate) fn set_outlook(&self, values: &mut PackValues) -> Option<[CellIndex; 2]> {
        let outlook = self.outlook();
        use Quantity as Q;
        let mut set = |quantity, value: Option<ScalarGaussian>| values.set(quantity, value);
        set(Q::RemainingEnergy, outlook.map(|it| it.remaining_wh));
        set(Q::EnergyToFull, outlook.map(|it| it.to_full_wh));
        set(Q::TimeToEmpty, outlook.and_then(|it| it.to_empty_s));
        set(Q::TimeToFull, outlook.and_then(|it| it.to_full_s));
        set(Q::TimeToTarget, outlook.and_then(|it| it.to_target_s));
        let powers = [
            [Q::DischargePower2s, Q::DischargePower10s, Q::DischargePower30s],
            [Q::ChargePower2s, Q::ChargePower10s, Q::ChargePower30s],
        ];
        for (k, [discharge, charge]) in (0..3).map(|k| (k, powers.map(|times| times[k]))) {
            set(discharge, outlook.map(|it| it.discharge_w[k]));
            set(charge, outlook.map(|it| it.charge_w[k]));
        }
        outlook.map(|it| it.limiting_cells)
    }

    /// The event with the pack's energy and power; `None` while they are unknown.
    pub(super) fn recorded_outlook(&self) -> Option<EventKind> {
        let mut values = PackValues::default();
        self.set_outlook(&mut values)?;
        values.set(Quantity::EnergySoh, self.energy_soh());
        Some(EventKind::Outlook { values: RecordedPackValues::of(&values) })
    }

    /// Energy-based state of health of the cell with the lowest capacity; `None` until every capacity has been learned.
    pub(crate) fn energy_soh(&self) -> Option<ScalarGaussian> {
        let (index, _) = self.learning.weakest()?;
        Some(energy_health(&self.learning.config.outlook, &self.cell_state(index)?))
    }

    /// State of a cell, from which its energy and power are computed. `None` before the cell's first estimate, or
    /// without a temperature.
    pub(crate) fn cell_state(&self, index: usize) -> Option<CellNow<'_>> {
        let bank = &self.estimation.bank;
        let (soc, temperature_c, estimator) = (bank.soc(index)?, bank.temperature_c(index)?, bank.cell(index));
        // The filter learns one resistance ratio for all SOC values and temperatures. `local` is the remaining error of
        // the model at this SOC and temperature.
        let local = ModelBands::new(bank.model(index)).resistance(soc.mean, temperature_c).local;
        let of_cell = estimator.log_resistance();
        // Outside its temperature table, the model uses the resistance at the nearest tabulated temperature. `outside`
        // is the resulting error according to the Arrhenius law.
        let temperatures_c = &bank.model(index).temperature_c;
        let nearest_c = temperature_c.max(temperatures_c[0]).min(temperatures_c[temperatures_c.len() - 1]);
        let outside = libm::log(arrhenius(temperature_c) / arrhenius(nearest_c));
        Some(CellNow {
            model: bank.model(index),
            soc,
            capacity: self.learning.capacity(index),
            resistance_ratio: libm::exp(of_cell.mean),
            log_resistance_std: (of_cell.variance + square(local) + square(outside)).sqrt(),
            slow_ratio: estimator.slow_ratio(bank.config(index)).mean,
            branch_v: estimator.branch_v(),
            temperature: bank.model(index).temperature_position(temperature_c),
        })
    }
}
