//! Applies sensor faults to true values before a measurement, and to readings after it.

use super::FaultKind;
use crate::quantity::{Channel, SensorIndex};

#[derive(Debug, Clone, Default)]
pub(crate) struct SensorFaults {
    begun: Vec<FaultKind>,
    /// The frozen channels with their values; `None` = no reading since the start of the fault.
    frozen: Vec<(Channel, Option<f64>)>,
}

impl SensorFaults {
    /// Starts a fault. Faults of cells have no effect here.
    pub(crate) fn begin(&mut self, fault: FaultKind) {
        let frozen = match fault {
            FaultKind::CurrentStuck => Some(Channel::Current),
            FaultKind::VoltageStuck { cell } => Some(Channel::CellVoltage(cell)),
            FaultKind::TemperatureStuck(sensor) => Some(Channel::Temperature(sensor)),
            _ => None,
        };
        self.frozen.extend(frozen.map(|channel| (channel, None)));
        self.begun.push(fault);
    }

    pub(crate) fn current_a(&self, truth_a: f64) -> f64 {
        self.begun.iter().fold(truth_a, |current_a, fault| match fault {
            FaultKind::CurrentOffset(offset_a) => current_a + offset_a,
            FaultKind::CurrentGain(gain) => current_a + truth_a * gain,
            _ => current_a,
        })
    }

    pub(crate) fn temperature_c(&self, sensor: SensorIndex, truth_c: f64, ambient_c: f64) -> f64 {
        if self.begun.contains(&FaultKind::TemperatureOff(sensor)) { ambient_c } else { truth_c }
    }

    /// Converts the voltages at the cells' taps into the voltages at the channels (V): adds offsets and swaps channels.
    pub(crate) fn distort_voltages(&self, voltages_v: &mut [f64]) {
        for fault in &self.begun {
            match *fault {
                FaultKind::VoltageOffset { cell, offset_v } => voltages_v[cell.index()] += offset_v,
                FaultKind::Swap(first, second) => voltages_v.swap(first.index(), second.index()),
                _ => {}
            }
        }
    }

    /// Freezes and duplicates readings. A frozen channel has no dropouts.
    pub(crate) fn distort_readings(&mut self, readings: &mut [(Channel, Option<f64>)]) {
        for (channel, frozen) in &mut self.frozen {
            for (_, value) in readings.iter_mut().filter(|(of, _)| of == channel) {
                *frozen = frozen.or(*value);
                *value = *frozen;
            }
        }
        for fault in &self.begun {
            if let FaultKind::Double { shown, hidden } = *fault {
                let find = |cell| readings.iter().position(|(of, _)| *of == Channel::CellVoltage(cell));
                if let (Some(from), Some(to)) = (find(shown), find(hidden)) {
                    readings[to].1 = readings[from].1;
                }
            }
        }
    }
}
