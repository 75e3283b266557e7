//! Detects that the vehicle is asleep: no current flows and no input is received on any bus.
//!
//! In: the time, the latest current, and the time of the latest reading of any input. Out: whether the inputs may be
//! judged, and an event at the start and end of a sleep. If only some inputs are silent, or if current flows, the
//! silence is a fault, which other modules handle. While the buses sleep, inputs do not turn bad, no estimate is valid,
//! and the alarm rules do not judge inputs and estimates.

use crate::monitor::config::MonitorConfig;
use crate::quantity::Timestamp;

/// If no current flows and all inputs have been silent for longer than this time (s), the buses may be falling asleep,
/// so the inputs are not judged. The time is longer than the pauses between frames on an awake bus. It is shorter than
/// the age at which a reading is stale.
pub(crate) const QUIET_S: f64 = 0.25;

#[derive(Debug)]
pub(crate) struct BusSleep {
    /// If all inputs are silent for longer than this time (s), the buses count as asleep; `None` = never.
    pub(crate) after_s: Option<f64>,
    /// Start of the present sleep.
    pub(crate) since: Option<Timestamp>,
}

/// Meaning of the silence of all inputs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Silence {
    /// Not a sleep. Each input is judged by its own age.
    None,
    /// The buses may be falling asleep.
    Quiet,
    /// The buses have just fallen asleep.
    Begins,
    /// The buses are asleep.
    Lasts,
}

impl BusSleep {
    pub(crate) fn new(config: &MonitorConfig) -> Self {
        let sample = &config.sample;
        let oldest_s = sample.current.max_age_s.max(sample.voltage.max_age_s);
        Self { after_s: config.asleep_after_s.map(|after_s| after_s.max(oldest_s)), since: None }
    }

    pub(crate) fn is_asleep(&self) -> bool {
        self.since.is_some() && self.after_s.is_some()
    }

    /// Applies the time-out of a new configuration; a sleep in progress continues.
    pub(crate) fn reconfigure(&mut self, config: &MonitorConfig) {
        self.after_s = Self::new(config).after_s;
    }
}
