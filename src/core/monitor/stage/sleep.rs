//! Detects that the vehicle is asleep: no current flows and no input is received on any bus.
//!
//! In: the time, the latest current, and the time of the latest reading of any input. Out: whether the inputs may be
//! judged, and an event at the start and end of a sleep. A single silent input, and silence under load, are faults that
//! other modules handle. While the buses sleep, no input turns bad, inputs and estimates are not compared with the
//! alarm rules, and no estimate is valid.

use crate::monitor::config::MonitorConfig;
use crate::quantity::Timestamp;

/// If no current flows and all inputs have been silent for longer than this time (s), the inputs are not judged,
/// because the buses may be falling asleep. The time is longer than the pauses between frames of an awake bus, and shorter than
/// the age at which a reading is stale.
pub(crate) const QUIET_S: f64 = 0.25;

/// State of the bus sleep.
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
    /// This is not a sleep: each input is judged by its own age.
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

    /// Whether the buses count as asleep.
    pub(crate) fn is_asleep(&self) -> bool {
        self.since.is_some() && self.after_s.is_some()
    }

    /// Applies the time-out of a new configuration; a sleep in progress continues.
    pub(crate) fn reconfigure(&mut self, config: &MonitorConfig) {
        self.after_s = Self::new(config).after_s;
    }
}
