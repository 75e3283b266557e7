//! The simulation's loop: steps the true state, the course of the current and the sensors, and returns readings.
//!
//! At each moment, the current until the next moment is already known, so the voltages include the drop that this
//! current causes. Cells are stepped once per cell sampling period with the mean current of the period. This keeps the
//! charge exact. The relative error of a branch voltage is less than `period / (2 tau)`, where `tau` is the branch's
//! time constant.

use super::balancing::{Balancer, Balancing};
use super::course::{Course, Demand};
use super::fault::Fault;
use super::fault::sensed::SensorFaults;
use super::noise::Stream;
use super::scenario::Settings;
use super::sensor::{Sensor, SensorError};
use super::truth::Pack;
use crate::cell::CellModel;
use crate::quantity::{CellIndex, Channel, SensorIndex, Timestamp};

/// Strings and temperature sensors of the pack.
#[derive(Debug, Clone, PartialEq)]
pub struct Wiring {
    /// Number of parallel strings. The pack current is the cell current times this number.
    pub strings: u16,
    /// The cell of each temperature sensor; `None` = the sensor measures the ambient temperature.
    pub temperature_at: Vec<Option<CellIndex>>,
}

impl Wiring {
    /// One string, with one temperature sensor on the first cell.
    pub fn single() -> Self {
        Self { strings: 1, temperature_at: vec![Some(CellIndex(0))] }
    }
}

/// One sampling moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    /// Time since the start.
    pub time: Timestamp,
    /// True cell current from this moment on (A); positive = discharge.
    pub current_a: f64,
    /// Whether the cells were also sampled at this moment.
    pub cells_sampled: bool,
}

#[derive(Debug, Clone)]
struct PackSensors {
    current: Sensor,
    pack_voltage: Sensor,
    temperatures: Vec<Sensor>,
    voltages: Vec<Sensor>,
}

impl PackSensors {
    fn new(settings: &Settings, temperatures: usize) -> Self {
        let (seed, errors, cells) = (settings.seed, settings.sensors, settings.pack.cells);
        let noise_std = errors.voltage.noise_std * f64::from(cells).sqrt();
        let pack_voltage = SensorError { noise_std, offset: 0.0, offset_std: 0.0, ..errors.voltage };
        let temperature = |i| Sensor::new(errors.temperature, seed, Stream::Temperature(i));
        let voltage = |i| Sensor::new(errors.voltage, seed, Stream::CellVoltage(i));
        Self {
            current: Sensor::new(errors.current, seed, Stream::Current),
            pack_voltage: Sensor::new(pack_voltage, seed, Stream::PackVoltage),
            temperatures: (0..u16::try_from(temperatures).unwrap_or(u16::MAX)).map(temperature).collect(),
            voltages: (0..cells).map(voltage).collect(),
        }
    }
}

#[derive(Debug, Clone, Copy)]
struct Asleep {
    from: Timestamp,
    duration_s: f64,
    step: u32,
    steps: u32,
}

impl Asleep {
    fn time(&self) -> Timestamp {
        self.from.plus_secs(f64::from(self.step) * self.duration_s / f64::from(self.steps))
    }
}

/// A running simulation.
#[derive(Debug, Clone)]
pub struct Simulation {
    settings: Settings,
    wiring: Wiring,
    pack: Pack,
    course: Course,
    sensors: PackSensors,
    readings: Vec<(Channel, Option<f64>)>,
    time: Timestamp,
    current_a: f64,
    /// Charge (A s) and time (ns) since the cells were last stepped.
    pending: (f64, i64),
    cells_due: bool,
    started: bool,
    /// Faults that have not started, in reverse order of their start.
    coming: Vec<Fault>,
    sensor_faults: SensorFaults,
    balancer: Option<Balancer>,
    has_bits: bool,
    asleep: Option<Asleep>,
    /// Voltages of the cells (V): first at the taps, then with sensor faults.
    sensed_v: Vec<f64>,
}

impl Simulation {
    /// Creates a simulation at its start. The mean capacity of the cells is `settings.pack.capacity_ah`; all other
    /// properties follow `model`.
    pub fn new(model: CellModel, settings: Settings, wiring: Wiring) -> Self {
        Self {
            pack: Pack::new(model, settings.pack, settings.seed),
            course: Course::new(&settings),
            sensors: PackSensors::new(&settings, wiring.temperature_at.len()),
            readings: Vec::new(),
            time: Timestamp::ZERO,
            current_a: 0.0,
            pending: (0.0, 0),
            cells_due: true,
            started: false,
            coming: Vec::new(),
            sensor_faults: SensorFaults::default(),
            balancer: None,
            has_bits: false,
            asleep: None,
            sensed_v: Vec::new(),
            settings,
            wiring,
        }
    }

    /// Injects faults. The pack must have the cells and sensors that the faults name
    /// ([`FaultKind::check`](super::FaultKind::check)).
    #[must_use]
    pub fn with_faults(mut self, faults: &[Fault]) -> Self {
        self.coming.extend(faults.iter().rev());
        self.coming.sort_by(|a, b| b.from_s.total_cmp(&a.from_s));
        self
    }

    /// Enables balancing by the BMS.
    #[must_use]
    pub fn with_balancing(mut self, balancing: Balancing) -> Self {
        self.balancer = Some(Balancer::new(balancing));
        self
    }

    /// Makes the BMS send a balancing bit for each cell together with the voltages (1 = the cell is bled). During
    /// sleep, the BMS sends the bits every minute while it bleeds a cell, and once more when it has stopped.
    #[must_use]
    pub fn with_balancing_bits(mut self) -> Self {
        self.has_bits = true;
        self
    }

    /// Advances to the next sampling moment; `None` = the scenario has ended.
    pub fn advance(&mut self) -> Option<Moment> {
        if self.started && self.asleep.is_none() {
            self.pass_period();
        }
        self.started = true;
        let dt_s = self.settings.current_period_ns as f64 * 1e-9;
        self.begin_faults(self.time);
        loop {
            if self.sleep() {
                return Some(Moment { time: self.time, current_a: 0.0, cells_sampled: false });
            }
            if self.settings.duration_s.is_some_and(|end_s| self.time.secs() + 0.5 * dt_s >= end_s) {
                return None;
            }
            match self.course.next(&mut self.pack, dt_s) {
                Demand::Finished => return None,
                Demand::Asleep { duration_s } => self.fall_asleep(duration_s),
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

    /// Readings of the latest moment. A value of `None` means that the sample is missing.
    pub fn readings(&self) -> &[(Channel, Option<f64>)] {
        &self.readings
    }

    /// Constant errors of the current sensor (A) and of each cell's voltage sensor (V), without injected faults.
    pub fn sensor_offsets(&self) -> (f64, Vec<f64>) {
        (self.sensors.current.offset(), self.sensors.voltages.iter().map(Sensor::offset).collect())
    }

    /// The true pack.
    pub fn pack(&self) -> &Pack {
        &self.pack
    }

    /// True terminal voltages at the latest moment (V).
    pub fn voltages_v(&self) -> impl Iterator<Item = f64> + '_ {
        self.pack.voltages_v(self.current_a)
    }

    fn pass_period(&mut self) {
        let dt_ns = self.settings.current_period_ns;
        self.time = self.time.plus_nanos(dt_ns);
        self.pending.0 += self.current_a * dt_ns as f64 * 1e-9;
        self.pending.1 += dt_ns;
        if self.pending.1 >= self.settings.cell_period_ns {
            self.step_pending();
        }
    }

    fn step_pending(&mut self) {
        let (charge_as, ns) = std::mem::take(&mut self.pending);
        let dt_s = ns as f64 * 1e-9;
        if dt_s > 0.0 {
            self.step_cells(charge_as / dt_s, dt_s);
        }
        self.cells_due = true;
    }

    fn fall_asleep(&mut self, duration_s: f64) {
        self.step_pending();
        self.current_a = 0.0;
        // The steps take at most 60 s, because resistances and temperatures change during sleep.
        let steps = (duration_s / 60.0).ceil().max(1.0) as u32;
        self.asleep = Some(Asleep { from: self.time, duration_s, step: 0, steps });
    }

    /// Continues a sleep. Returns whether balancing bits were reported before the end of the sleep.
    fn sleep(&mut self) -> bool {
        while let Some(asleep) = &mut self.asleep {
            let (now, step_s) = (asleep.time(), asleep.duration_s / f64::from(asleep.steps));
            asleep.step += 1;
            let (end, is_over) = (asleep.time(), asleep.step == asleep.steps);
            let was_bleeding = self.is_bleeding();
            self.begin_faults(now);
            self.step_cells(0.0, step_s);
            self.time = end;
            if is_over {
                self.asleep = None;
                self.begin_faults(end);
            } else if self.has_bits && (was_bleeding || self.is_bleeding()) {
                self.readings.clear();
                self.report_bits();
                return true;
            }
        }
        false
    }

    fn is_bleeding(&self) -> bool {
        self.pack.cells().iter().any(|cell| cell.bleed_a > 0.0)
    }

    fn report_bits(&mut self) {
        let bits = (0..).map(CellIndex).zip(self.pack.cells());
        let bits = bits.map(|(cell, truth)| (cell, if truth.bleed_a > 0.0 { 1.0 } else { 0.0 }));
        self.readings.extend(bits.map(|(cell, bit)| (Channel::Balancing(cell), Some(bit))));
    }

    fn step_cells(&mut self, current_a: f64, dt_s: f64) {
        self.pack.step(current_a, dt_s);
        if let Some(balancer) = &mut self.balancer {
            let voltages = &self.sensors.voltages;
            balancer.update(&mut self.pack, current_a, dt_s, |i| voltages[i].offset());
        }
    }

    fn begin_faults(&mut self, now: Timestamp) {
        while let Some(fault) = self.coming.pop_if(|fault| Timestamp::from_secs(fault.from_s) <= now) {
            self.pack.begin_fault(fault.kind);
            self.sensor_faults.begin(fault.kind);
        }
    }

    fn measure(&mut self, cells: bool) {
        self.readings.clear();
        let pack_current_a = self.sensor_faults.current_a(self.current_a * f64::from(self.wiring.strings));
        self.readings.push((Channel::Current, self.sensors.current.read(pack_current_a)));
        if cells {
            self.measure_temperatures();
            self.measure_voltages();
            if self.has_bits {
                self.report_bits();
            }
        }
        self.sensor_faults.distort_readings(&mut self.readings);
    }

    fn measure_temperatures(&mut self) {
        let ambient_c = self.settings.pack.ambient_c;
        for (i, sensor) in (0..).zip(&mut self.sensors.temperatures) {
            let cell = self.wiring.temperature_at[usize::from(i)].and_then(|c| self.pack.cells().get(c.index()));
            let truth = cell.map_or(ambient_c, |cell| cell.temperature_c);
            let truth = self.sensor_faults.temperature_c(SensorIndex(i), truth, ambient_c);
            self.readings.push((Channel::Temperature(SensorIndex(i)), sensor.read(truth)));
        }
    }

    /// Measures the cell voltages and the pack voltage. Both include the voltage drop of a contact resistance, which is
    /// between the taps.
    fn measure_voltages(&mut self) {
        self.sensed_v.clear();
        let taps = self.pack.voltages_v(self.current_a).zip(self.pack.cells());
        self.sensed_v.extend(taps.map(|(voltage_v, cell)| voltage_v - self.current_a * cell.contact_ohm));
        let total_v = self.sensed_v.iter().fold(0.0, |total_v, voltage_v| total_v + voltage_v);
        self.sensor_faults.distort_voltages(&mut self.sensed_v);
        for (i, (sensor, voltage_v)) in (0..).zip(self.sensors.voltages.iter_mut().zip(&self.sensed_v)) {
            self.readings.push((Channel::CellVoltage(CellIndex(i)), sensor.read(*voltage_v)));
        }
        self.readings.push((Channel::PackVoltage, self.sensors.pack_voltage.read(total_v)));
    }
}

#[cfg(test)]
mod tests;
