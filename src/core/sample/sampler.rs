//! Combines the signals of all channels in use and the charge counter into samples.
//!
//! In: readings with their time (V, A, degrees C). Out: a [`CellSample`] per good voltage. A sample contains the
//! current and temperature that are fresh at the time of the voltage, and the charge and unmeasured time up to this
//! time.
//!
//! The signals are an array of structs, because a reading touches all fields of one signal. Once the buffers are
//! filled, handling a reading allocates nothing.

mod inputs;

use serde::{Deserialize, Serialize};

use super::cell_sample::{CellSample, Moment};
use super::channels::{channels, limits, should_move_s};
use super::charge::{ChargeCounter, ChargeTotals};
use super::config::{SampleConfig, VoltageSource};
use super::counts::ReadingCounts;
use super::frozen::{self, FrozenCheck};
use super::signal::Signal;
pub use inputs::SensorRange;

use crate::quantity::{CellIndex, Channel, Fault, InvalidState, Reading, SensorIndex, Timestamp};

/// Smallest current that counts as flowing, as a fraction of the largest plausible current. It is larger than a
/// sensor's noise and offset. It is smaller than any load under which a voltage or temperature must change.
pub const FLOW_SHARE: f64 = 0.01;

/// Reports that a signal turned bad (with the fault) or good again (with the number of preceding bad readings).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SignalChange {
    pub channel: Channel,
    pub state: Result<u64, Fault>,
}

/// State of a [`Sampler`] for storing.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SamplerState {
    signals: Vec<Signal>,
    charge: ChargeCounter,
    began: Option<Timestamp>,
    latest: Timestamp,
    unused_readings: u64,
    counts: ReadingCounts,
    frozen: FrozenCheck,
    strings: u16,
    series: u16,
}

impl SamplerState {
    /// Checks a stored state and returns the first impossible number.
    pub fn check(&self) -> Result<(), InvalidState> {
        self.charge.check()?;
        self.frozen.check()?;
        self.signals.iter().try_for_each(Signal::check)
    }

    /// Number of parallel strings and of cells in series.
    pub fn wiring(&self) -> (u16, u16) {
        (self.strings, self.series)
    }

    /// Pack charge up to `time` (As). Holds the latest current reading for at most `max_age_s`.
    pub fn charge_as(&self, time: Timestamp, max_age_s: f64) -> f64 {
        self.charge.totals_at(time, max_age_s).charge_as
    }

    /// Shifts every time stamp by `by_nanos` to another clock.
    pub fn rebase(&mut self, by_nanos: i64) {
        self.signals.iter_mut().for_each(|signal| signal.rebase(by_nanos));
        self.charge.rebase(by_nanos);
        self.frozen.rebase(by_nanos);
        self.began = self.began.map(|stamp| stamp.plus_nanos(by_nanos));
        self.latest = self.latest.plus_nanos(by_nanos);
    }
}

/// Checks readings and combines them into samples.
#[derive(Debug, Clone)]
pub struct Sampler {
    config: SampleConfig,
    /// In the order of the signals: current, temperatures, voltages, values reported by the pack, contactors.
    channels: Vec<Channel>,
    sensors: usize,
    voltages: usize,
    flow_a: f64,
    /// Voltage step that is larger than the noise (V).
    step_v: f64,
    state: SamplerState,
    /// Earliest time at which a signal becomes stale; `None` = not computed.
    next_stale: Option<Timestamp>,
    bad_signals: usize,
    shared: SharedInputs,
}

/// Inputs shared by readings with the same time stamp. A new current or contactor reading invalidates all fields; a new
/// temperature invalidates only `sensor`.
#[derive(Debug, Clone, Copy, Default)]
struct SharedInputs {
    /// Whether the other fields are valid.
    is_known: bool,
    time: Timestamp,
    totals: ChargeTotals,
    cell_current_a: Option<f64>,
    cell_charge_as: f64,
    /// The latest sensor and its value, because neighbouring cells often share a sensor.
    sensor: Option<(SensorIndex, Option<f64>)>,
}

impl Sampler {
    /// Creates a sampler without readings.
    pub fn new(config: SampleConfig) -> Self {
        let sensors = usize::from(config.sensors());
        let voltages = match config.voltage_source {
            VoltageSource::Cells => usize::from(config.cells),
            VoltageSource::PackTotal { .. } => 1,
        };
        let channels = channels(&config, sensors);
        let state = SamplerState { signals: vec![Signal::default(); channels.len()], ..SamplerState::default() };
        let flow_a = FLOW_SHARE * config.current.min.abs().max(config.current.max.abs());
        Self {
            step_v: frozen::step_v(config.voltage_noise_v),
            config,
            channels,
            sensors,
            voltages,
            flow_a,
            state,
            next_stale: None,
            bad_signals: 0,
            shared: SharedInputs::default(),
        }
    }

    pub fn config(&self) -> &SampleConfig {
        &self.config
    }

    /// Replaces the limits and keeps the state of the signals. Panics if the configuration has other signals.
    pub fn reconfigure(&mut self, config: &SampleConfig) {
        let state = std::mem::replace(self, Self::new(config.clone())).state;
        self.restore(state);
    }

    /// Handles a reading. Returns a sample for a good voltage. Appends a change of the signal to `changes`.
    pub fn handle_reading(
        &mut self,
        time: Timestamp,
        reading: Reading,
        changes: &mut Vec<SignalChange>,
    ) -> Option<CellSample> {
        let time = self.advance(time);
        let channel = reading.channel;
        let Some(slot) = self.slot(channel) else {
            self.state.unused_readings = self.state.unused_readings.saturating_add(1);
            return None;
        };
        self.refresh_shared_inputs(time);
        let limits = limits(&self.config, channel);
        let mut value = reading.value.map(|value| value / self.divisor(channel));
        if channel == Channel::Current && self.config.direction.is_some() {
            value = value.and_then(|magnitude_a| Ok(magnitude_a * self.direction(time)?));
        }
        if let (Channel::Current, Ok(current_a)) = (channel, value)
            && self.state.frozen.handle_current(time, current_a)
        {
            value = Err(Fault::Stuck);
        }
        let judged = self.state.signals[slot].handle(time, value, limits, should_move_s(channel, &self.shared.totals));
        self.state.counts.note(judged.value.err());
        let counts = &mut self.state.counts;
        counts.levels_believed = counts.levels_believed.saturating_add(u64::from(judged.is_new_level));
        if let Some(state) = judged.change {
            changes.push(SignalChange { channel, state });
            // Changes alternate between good and bad, so the count never falls below 0.
            self.bad_signals = if state.is_err() { self.bad_signals + 1 } else { self.bad_signals - 1 };
            self.next_stale = None;
        }
        let value = judged.value.ok()?;
        match channel {
            Channel::Current => {
                let max_age_s = self.config.current.max_age_s;
                let value = if self.state.charge.is_open(time) { 0.0 } else { value };
                self.state.charge.handle_current(time, value, max_age_s, self.flow_a);
                self.shared.is_known = false;
                None
            }
            Channel::Contactor => {
                self.handle_contactor(time, value);
                None
            }
            Channel::Temperature(_) => {
                self.shared.sensor = None;
                None
            }
            Channel::CurrentDirection
            | Channel::ReportedSoc
            | Channel::ReportedSoh
            | Channel::SupplyVoltage
            | Channel::Balancing(_)
            | Channel::PackIdentity => None,
            Channel::PackVoltage => {
                self.state.frozen.handle_voltage(time, 0, value, self.step_v);
                Some(self.sample(CellIndex(0), value))
            }
            Channel::CellVoltage(cell) => {
                self.state.frozen.handle_voltage(time, cell.index(), value, self.step_v);
                Some(self.sample(cell, value))
            }
        }
    }

    /// Whether the current reading is frozen while the voltages show a changing load.
    pub fn is_current_frozen(&self) -> bool {
        self.state.frozen.is_frozen()
    }

    /// Smallest change of the pack current that is larger than the sensor's noise (A).
    pub fn flow_a(&self) -> f64 {
        self.flow_a
    }

    /// Direction of the current: 1 = discharge, -1 = charge. Fails if the latest reading is bad or too old.
    fn direction(&self, time: Timestamp) -> Result<f64, Fault> {
        let limits = limits(&self.config, Channel::CurrentDirection);
        let signal = self.slot(Channel::CurrentDirection).map(|slot| &self.state.signals[slot]);
        signal
            .filter(|signal| !signal.is_bad())
            .and_then(|signal| signal.fresh(time, limits))
            .ok_or(Fault::NotAvailable)
    }

    /// Handles the state of the contactors. While they are open, no current flows, regardless of the sensor.
    fn handle_contactor(&mut self, time: Timestamp, value: f64) {
        let Some(contactor) = &self.config.contactor else { return };
        let max_age_s = self.config.current.max_age_s;
        if contactor.open.contains(&value) {
            let until = time.plus_secs(contactor.limits.max_age_s);
            self.state.charge.open(time, until, max_age_s);
        } else {
            let measured_a = self.state.signals[0].fresh(time, &self.config.current);
            self.state.charge.close(time, measured_a, max_age_s);
        }
        self.shared.is_known = false;
    }

    /// Checks ages at `now`. Appends signals that have become stale to `changes`.
    pub fn poll(&mut self, now: Timestamp, changes: &mut Vec<SignalChange>) {
        let now = self.advance(now);
        if self.next_stale.is_some_and(|next| now <= next) {
            return;
        }
        let began = self.state.began.unwrap_or(now);
        let mut next = Timestamp::from_nanos(i64::MAX);
        for (signal, &channel) in self.state.signals.iter_mut().zip(&self.channels) {
            if signal.is_bad() {
                continue;
            }
            let stale_from = signal.stale_from(began, limits(&self.config, channel));
            if now <= stale_from {
                next = next.min(stale_from);
                continue;
            }
            self.state.counts.note(Some(Fault::Stale));
            self.bad_signals += 1;
            changes.push(SignalChange { channel, state: Err(signal.turn_stale()) });
        }
        self.next_stale = Some(next);
    }

    /// Handles a gap of unknown length. Afterwards, no value is fresh, and ages start at `time`. No charge is counted
    /// for the gap.
    pub fn handle_gap(&mut self, time: Timestamp) {
        self.state.charge.handle_gap(self.state.latest, time, self.config.current.max_age_s);
        self.state.signals.iter_mut().for_each(Signal::handle_gap);
        self.state.frozen.restart();
        self.state.began = Some(time);
        self.state.latest = time;
        (self.next_stale, self.shared.is_known) = (None, false);
    }

    /// Handles the end of a sleep. Values keep their age, so values from before the sleep are not used as fresh. But a
    /// signal is reported as silent or stale only if it sends no new value for its maximum age after `time`.
    pub fn wake(&mut self, time: Timestamp) {
        self.state.began = Some(time);
        self.next_stale = None;
    }

    /// Pack current (A) if its last good reading is fresh; 0 while the contactors are open.
    #[inline]
    pub fn pack_current_a(&self, now: Timestamp) -> Option<f64> {
        if self.state.charge.is_open(now) {
            return Some(0.0);
        }
        self.state.signals[0].fresh(now, &self.config.current)
    }

    /// Pack current divided by the number of strings (A).
    pub fn cell_current_a(&self, now: Timestamp) -> Option<f64> {
        self.pack_current_a(now).map(|current| current / self.strings())
    }

    /// Charge (As, per cell) and unmeasured time (s) up to `now`, as in [`CellSample`].
    pub fn counted(&self, now: Timestamp) -> (f64, f64) {
        let totals = self.state.charge.totals_at(now, self.config.current.max_age_s);
        (totals.charge_as / self.strings(), totals.unmeasured_s)
    }

    /// Temperature of a cell (degrees C) if its sensor's last good reading is fresh.
    pub fn temperature_c(&self, cell: CellIndex, now: Timestamp) -> Option<f64> {
        self.sensor_c(self.sensor_of(cell)?, now)
    }

    /// Whether a stored state has this sampler's signals. Only the contactor signal may be missing.
    pub fn fits(&self, state: &SamplerState) -> bool {
        let (own, stored) = (self.state.signals.len(), state.signals.len());
        stored == own || (self.config.contactor.is_some() && stored + 1 == own)
    }

    /// Readings by outcome.
    pub fn reading_counts(&self) -> ReadingCounts {
        ReadingCounts { unused: self.state.unused_readings, ..self.state.counts }
    }

    /// The state to store.
    pub fn snapshot(&self) -> SamplerState {
        let (strings, series) = (self.config.strings, self.config.series());
        SamplerState { strings, series, ..self.state.clone() }
    }

    /// Restores a stored state that [`fits`](Self::fits) and whose times were rebased. The downtime counts as
    /// unmeasured.
    pub fn restore(&mut self, state: SamplerState) {
        assert!(self.fits(&state), "the stored state must have the same signals");
        let signals = self.state.signals.len();
        self.state = state;
        self.state.signals.resize_with(signals, Signal::default);
        if self.config.contactor.is_none() {
            self.state.charge.forget_contactors();
        }
        self.bad_signals = self.state.signals.iter().filter(|signal| signal.is_bad()).count();
        (self.next_stale, self.shared.is_known) = (None, false);
    }

    /// Returns the current and the counters at `now`, for voltages that were measured at `now` but arrive later.
    pub fn moment(&mut self, now: Timestamp) -> Moment {
        let time = self.advance(now);
        self.refresh_shared_inputs(time);
        let SharedInputs { totals, cell_current_a: current_a, cell_charge_as: charge_as, .. } = self.shared;
        Moment { time, current_a, charge_as, offset_s: totals.offset_s, unmeasured_s: totals.unmeasured_s }
    }

    #[inline]
    fn refresh_shared_inputs(&mut self, time: Timestamp) {
        if self.shared.is_known && self.shared.time == time {
            return;
        }
        let totals = self.state.charge.totals_at(time, self.config.current.max_age_s);
        let cell_charge_as = totals.charge_as / self.strings();
        let cell_current_a = self.cell_current_a(time);
        self.shared = SharedInputs { is_known: true, time, totals, cell_current_a, cell_charge_as, sensor: None };
    }

    /// The sample of a good voltage at the latest time.
    #[inline]
    fn sample(&mut self, cell: CellIndex, voltage_v: f64) -> CellSample {
        let time = self.shared.time;
        let temperature_c = self.sensor_of(cell).and_then(|sensor| match self.shared.sensor {
            Some((cached, value)) if cached == sensor => value,
            _ => {
                let value = self.sensor_c(sensor, time);
                self.shared.sensor = Some((sensor, value));
                value
            }
        });
        CellSample {
            time,
            cell,
            voltage_v,
            current_a: self.shared.cell_current_a,
            charge_as: self.shared.cell_charge_as,
            offset_s: self.shared.totals.offset_s,
            unmeasured_s: self.shared.totals.unmeasured_s,
            temperature_c,
        }
    }

    fn sensor_of(&self, cell: CellIndex) -> Option<SensorIndex> {
        *self.config.sensor_of_cell.get(cell.index())?
    }

    fn sensor_c(&self, sensor: SensorIndex, now: Timestamp) -> Option<f64> {
        self.state.signals[1 + sensor.index()].fresh(now, &self.config.temperature)
    }

    /// Advances the clock and returns the latest time so far, because time stamps may go back.
    #[inline]
    fn advance(&mut self, time: Timestamp) -> Timestamp {
        if self.state.began.is_none() {
            self.state.began = Some(time);
            self.state.latest = time;
            self.state.charge.begin(time);
        }
        self.state.latest = self.state.latest.max(time);
        self.state.latest
    }

    /// Number of parallel strings.
    pub fn strings(&self) -> f64 {
        f64::from(self.config.strings.max(1))
    }

    /// Divisor for a reading. Only a total voltage is divided, by the number of cells in series.
    #[inline]
    fn divisor(&self, channel: Channel) -> f64 {
        match self.config.voltage_source {
            VoltageSource::PackTotal { series } if channel == Channel::PackVoltage => f64::from(series.max(1)),
            VoltageSource::PackTotal { .. } | VoltageSource::Cells => 1.0,
        }
    }

    #[inline]
    fn slot(&self, channel: Channel) -> Option<usize> {
        let voltage = 1 + self.sensors;
        match (channel, self.config.voltage_source) {
            (Channel::Current, _) => Some(0),
            (Channel::Temperature(sensor), _) => (sensor.index() < self.sensors).then(|| 1 + sensor.index()),
            (Channel::PackVoltage, VoltageSource::PackTotal { .. }) => Some(voltage),
            (Channel::CellVoltage(cell), VoltageSource::Cells) => {
                (cell.0 < self.config.cells).then(|| voltage + cell.index())
            }
            (Channel::PackVoltage, VoltageSource::Cells)
            | (Channel::CellVoltage(_), VoltageSource::PackTotal { .. })
            // The monitor itself uses these channels. They do not become part of a sample.
            | (Channel::SupplyVoltage | Channel::Balancing(_) | Channel::PackIdentity, _) => None,
            (Channel::ReportedSoc | Channel::ReportedSoh | Channel::CurrentDirection | Channel::Contactor, _) => {
                let first = voltage + self.voltages;
                let found = self.channels[first..].iter().position(|reported| *reported == channel)?;
                Some(first + found)
            }
        }
    }
}

#[cfg(test)]
mod tests;
