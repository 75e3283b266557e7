//! The simulation's loop: truth, course and sensors stepped together, readings out.
//!
//! At each moment the current that will flow until the next moment is known; the readings and the truth of that moment
//! belong together (the voltage has that current's drop in it). Cells are stepped at their own sampling period with
//! the mean current over it: charge is exact, and a branch voltage differs from stepping at every current sample by
//! less than half a period over its time constant, relative.

use super::course::{Course, Demand};
use super::noise::Stream;
use super::scenario::Settings;
use super::sensor::{Sensor, SensorError};
use super::truth::Pack;
use crate::cell::CellModel;
use crate::quantity::{CellIndex, Channel, SensorIndex, Timestamp};

/// Longest step of the truth while nobody measures, s: the tables and the temperature are followed this finely.
const ASLEEP_STEP_S: f64 = 60.0;

/// How the pack is wired and which sensors it has.
#[derive(Debug, Clone, PartialEq)]
pub struct Wiring {
    /// Parallel strings: the pack current is this times the cell current.
    pub strings: u16,
    /// For each temperature sensor, the cell it sits on; `None` = the surroundings.
    pub temperature_at: Vec<Option<CellIndex>>,
}

impl Wiring {
    /// One string, one temperature sensor on the first cell.
    pub fn single() -> Self {
        Self { strings: 1, temperature_at: vec![Some(CellIndex(0))] }
    }
}

/// One sampling moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    /// When, from the start.
    pub time: Timestamp,
    /// True cell current from now on, A, positive = discharge.
    pub current_a: f64,
    /// Whether the cells were sampled too.
    pub cells_sampled: bool,
}

/// A running simulation.
#[derive(Debug, Clone)]
pub struct Simulation {
    settings: Settings,
    wiring: Wiring,
    pack: Pack,
    course: Course,
    current_sensor: Sensor,
    pack_voltage_sensor: Sensor,
    temperature_sensors: Vec<Sensor>,
    voltage_sensors: Vec<Sensor>,
    readings: Vec<(Channel, Option<f64>)>,
    time: Timestamp,
    current_a: f64,
    pending_charge_as: f64,
    pending_ns: i64,
    cells_due: bool,
    started: bool,
}

impl Simulation {
    /// A simulation at its start. The pack's cells have `settings.pack.capacity_ah`; all else follows `model`.
    pub fn new(model: CellModel, settings: Settings, wiring: Wiring) -> Self {
        let (seed, errors) = (settings.seed, settings.sensors);
        let pack_noise = errors.voltage.noise_std * f64::from(settings.pack.cells).sqrt();
        let pack_voltage = SensorError { noise_std: pack_noise, offset: 0.0, ..errors.voltage };
        let sensor_count = u16::try_from(wiring.temperature_at.len()).unwrap_or(u16::MAX);
        Self {
            pack: Pack::new(model, settings.pack, seed),
            course: Course::new(&settings),
            current_sensor: Sensor::new(errors.current, seed, Stream::Current),
            pack_voltage_sensor: Sensor::new(pack_voltage, seed, Stream::PackVoltage),
            temperature_sensors: (0..sensor_count)
                .map(|i| Sensor::new(errors.temperature, seed, Stream::Temperature(i)))
                .collect(),
            voltage_sensors: (0..settings.pack.cells)
                .map(|i| Sensor::new(errors.voltage, seed, Stream::CellVoltage(i)))
                .collect(),
            readings: Vec::new(),
            time: Timestamp::ZERO,
            current_a: 0.0,
            pending_charge_as: 0.0,
            pending_ns: 0,
            cells_due: true,
            started: false,
            settings,
            wiring,
        }
    }

    /// Goes on to the next sampling moment; `None` = the scenario is over.
    pub fn advance(&mut self) -> Option<Moment> {
        if self.started {
            self.pass_period();
        }
        self.started = true;
        let dt_s = self.settings.current_period_ns as f64 * 1e-9;
        loop {
            if self.settings.duration_s.is_some_and(|end_s| self.time.secs() + 0.5 * dt_s >= end_s) {
                return None;
            }
            match self.course.next(&mut self.pack, dt_s) {
                Demand::Finished => return None,
                Demand::Asleep { duration_s } => self.sleep(duration_s),
                Demand::Current(current_a) => {
                    self.current_a = current_a;
                    break;
                }
            }
        }
        let cells_sampled = std::mem::take(&mut self.cells_due);
        self.measure(cells_sampled);
        Some(Moment { time: self.time, current_a: self.current_a, cells_sampled })
    }

    /// What the sensors said at the latest moment; `None` = dropped out.
    pub fn readings(&self) -> &[(Channel, Option<f64>)] {
        &self.readings
    }

    /// The pack as it really is.
    pub fn pack(&self) -> &Pack {
        &self.pack
    }

    /// True terminal voltages at the latest moment, V.
    pub fn voltages_v(&self) -> impl Iterator<Item = f64> + '_ {
        self.pack.voltages_v(self.current_a)
    }

    fn pass_period(&mut self) {
        let dt_ns = self.settings.current_period_ns;
        self.time = self.time.plus_nanos(dt_ns);
        self.pending_charge_as += self.current_a * dt_ns as f64 * 1e-9;
        self.pending_ns += dt_ns;
        if self.pending_ns >= self.settings.cell_period_ns {
            self.step_pending();
        }
    }

    fn step_pending(&mut self) {
        let dt_s = self.pending_ns as f64 * 1e-9;
        if dt_s > 0.0 {
            self.pack.step(self.pending_charge_as / dt_s, dt_s);
        }
        (self.pending_charge_as, self.pending_ns, self.cells_due) = (0.0, 0, true);
    }

    fn sleep(&mut self, duration_s: f64) {
        self.step_pending();
        let steps = (duration_s / ASLEEP_STEP_S).ceil().max(1.0);
        for _ in 0..steps as u32 {
            self.pack.step(0.0, duration_s / steps);
        }
        self.time = self.time.plus_secs(duration_s);
    }

    fn measure(&mut self, cells: bool) {
        self.readings.clear();
        let pack_current_a = self.current_a * f64::from(self.wiring.strings);
        self.readings.push((Channel::Current, self.current_sensor.read(pack_current_a)));
        if !cells {
            return;
        }
        for (i, sensor) in (0..).zip(&mut self.temperature_sensors) {
            let cell = self.wiring.temperature_at[usize::from(i)].and_then(|c| self.pack.cells().get(c.index()));
            let truth = cell.map_or(self.settings.pack.ambient_c, |cell| cell.temperature_c);
            self.readings.push((Channel::Temperature(SensorIndex(i)), sensor.read(truth)));
        }
        let mut total_v = 0.0;
        let voltages = self.pack.voltages_v(self.current_a);
        for (i, (sensor, voltage_v)) in (0..).zip(self.voltage_sensors.iter_mut().zip(voltages)) {
            total_v += voltage_v;
            self.readings.push((Channel::CellVoltage(CellIndex(i)), sensor.read(voltage_v)));
        }
        self.readings.push((Channel::PackVoltage, self.pack_voltage_sensor.read(total_v)));
    }
}

#[cfg(test)]
mod tests;
