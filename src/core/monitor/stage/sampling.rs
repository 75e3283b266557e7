//! Sampling stage: turns readings into cell samples, and detects which pack is connected.
//!
//! In: decoded readings, each a value or a fault. Out: a [`CellSample`] for each good voltage, an event for each signal
//! that turns bad or good, and the pack's identity. A new identity counts after a configured number of consecutive
//! equal readings; bad readings are ignored. The identity is stored, so that an exchange of the pack during a downtime
//! is detected.

use serde::{Deserialize, Serialize};

use crate::monitor::config::MonitorConfig;
use crate::monitor::message::{Event, EventKind, Outputs};
use crate::quantity::{CellIndex, Channel, Fault, Reading, Timestamp};
use crate::sample::{CellSample, Sampler, SamplerState, SignalChange, VoltageSource};

#[derive(Debug)]
pub(crate) struct Sampling {
    pub(crate) sampler: Sampler,
    pub(crate) identity: Identity,
    identity_readings: u32,
    /// Whether a usable reading has arrived since the first input.
    pub(crate) has_usable_reading: bool,
    /// Whether an input message has a second sender.
    pub(crate) has_second_sender: bool,
    /// Buffer for the signal changes of the input that is being handled; reused to avoid allocations.
    changes: Vec<SignalChange>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SamplingState {
    pub(crate) sampler: SamplerState,
    identity: Identity,
    has_usable_reading: bool,
    has_second_sender: bool,
}

impl SamplingState {
    /// Forgets the values that are valid only in the present run: the candidate for the pack's identity, and whether a
    /// usable reading or a second sender was seen. Keeps the state of the signals and the pack's identity.
    pub(crate) fn restart(&mut self) {
        self.identity.candidate = None;
        (self.has_usable_reading, self.has_second_sender) = (false, false);
    }
}

/// Identity of the pack according to its signal.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(crate) struct Identity {
    pub(crate) known: Option<f64>,
    /// An identity other than the known identity, and the number of consecutive readings that have shown it.
    candidate: Option<(f64, u32)>,
}

impl Identity {
    /// Handles a good reading. If the last `readings` readings agree on a new identity, returns the identity and
    /// whether it replaces a known identity.
    fn observe(&mut self, value: f64, readings: u32) -> Option<(f64, bool)> {
        if self.known == Some(value) {
            self.candidate = None;
            return None;
        }
        let count = self.candidate.filter(|(number, _)| *number == value).map_or(0, |(_, count)| count) + 1;
        self.candidate = Some((value, count));
        if count < readings {
            return None;
        }
        let is_replacement = self.known.is_some();
        *self = Self { known: Some(value), candidate: None };
        Some((value, is_replacement))
    }
}

impl Identity {
    /// Whether a reading shows an identity other than the connected pack's; `None` if either identity is unknown.
    pub(crate) fn is_other(&self, reading: Result<f64, Fault>) -> Option<bool> {
        let value = reading.ok().filter(|value| value.is_finite())?;
        Some(self.known? != value)
    }
}

impl Sampling {
    pub(crate) fn new(config: &MonitorConfig) -> Self {
        Self {
            sampler: Sampler::new(config.sample.clone()),
            identity: Identity::default(),
            identity_readings: config.identity_readings,
            has_usable_reading: false,
            has_second_sender: false,
            changes: Vec::new(),
        }
    }

    pub(crate) fn snapshot(&self) -> SamplingState {
        SamplingState {
            sampler: self.sampler.snapshot(),
            identity: self.identity,
            has_usable_reading: self.has_usable_reading,
            has_second_sender: self.has_second_sender,
        }
    }

    pub(crate) fn restore(&mut self, state: SamplingState) {
        self.sampler.restore(state.sampler);
        self.identity = state.identity;
        (self.has_usable_reading, self.has_second_sender) = (state.has_usable_reading, state.has_second_sender);
    }

    /// Applies the limits of a new configuration that has the same signals.
    pub(crate) fn reconfigure(&mut self, config: &MonitorConfig) {
        self.sampler.reconfigure(&config.sample);
        self.identity_readings = config.identity_readings;
    }

    /// Handles a reading of a signal. If the reading is a good voltage, returns the resulting sample.
    pub(crate) fn handle_reading(&mut self, now: Timestamp, reading: Reading, out: &mut Outputs) -> Option<CellSample> {
        let sample = self.sampler.handle_reading(now, reading, &mut self.changes);
        self.has_usable_reading =
            self.has_usable_reading || (reading.value.is_ok() && self.sampler.is_fresh(reading.channel, now));
        self.report(now, out);
        sample
    }

    /// Handles a reading of the identity signal. If the identity is new, returns the identity and whether it replaces a
    /// known identity.
    pub(crate) fn handle_identity(&mut self, reading: Result<f64, Fault>) -> Option<(f64, bool)> {
        let value = reading.ok().filter(|value| value.is_finite())?;
        self.identity.observe(value, self.identity_readings)
    }

    pub(crate) fn poll(&mut self, now: Timestamp, out: &mut Outputs) {
        self.sampler.poll(now, &mut self.changes);
        self.report(now, out);
    }

    /// Sum of the cells' voltages (V); `None` unless all cell voltages are fresh.
    pub(crate) fn pack_voltage_v(&self, mut cells: impl Iterator<Item = CellIndex>, now: Timestamp) -> Option<f64> {
        let sum_v = cells.try_fold(0.0, |sum_v, cell| {
            let channel = self.voltage_channel(cell);
            let voltage_v = self.sampler.reported(channel, now).filter(|_| self.sampler.is_fresh(channel, now))?;
            Some(sum_v + voltage_v)
        })?;
        Some(match self.sampler.config().voltage_source {
            VoltageSource::Cells => sum_v,
            VoltageSource::PackTotal { series } => sum_v * f64::from(series),
        })
    }

    pub(crate) fn voltage_channel(&self, cell: CellIndex) -> Channel {
        match self.sampler.config().voltage_source {
            VoltageSource::Cells => Channel::CellVoltage(cell),
            VoltageSource::PackTotal { .. } => Channel::PackVoltage,
        }
    }

    /// Whether both inputs of a cell's estimate, the current and the cell's voltage, are available.
    pub(crate) fn inputs_valid(&self, cell: CellIndex, now: Timestamp) -> bool {
        let is_lost = |channel| self.sampler.is_lost(channel, now);
        !is_lost(Channel::Current) && !is_lost(self.voltage_channel(cell))
    }

    fn report(&mut self, time: Timestamp, out: &mut Outputs) {
        if self.changes.is_empty() {
            return;
        }
        for SignalChange { channel, state } in self.changes.drain(..) {
            let kind = match state {
                Err(fault) => EventKind::SignalBad { channel, fault },
                Ok(bad_readings) => EventKind::SignalGood { channel, bad_readings },
            };
            out.events.push(Event { time, kind });
        }
    }
}
