//! Detects that the vehicle is asleep: no current and no traffic on any bus.
//!
//! In: the time, and when the latest reading of any input came. Out: whether the inputs may be judged, and two events a
//! sleep. One silent input among others, and silence under load, are faults and not judged here. While the buses sleep
//! nothing is missing: no input turns bad, no alarm is raised, and no estimate is valid.

use crate::monitor::config::MonitorConfig;
use crate::quantity::Timestamp;

/// Without a reading of any input for this long its inputs are not judged at rest, s: they may all have fallen asleep. Longer
/// than the pauses between the frames of an awake bus, shorter than the age at which a reading is stale.
pub(crate) const QUIET_S: f64 = 0.25;

/// Whether the buses sleep.
#[derive(Debug)]
pub(crate) struct BusSleep {
    /// Silence after which they do, s; `None` = never.
    pub(crate) after_s: Option<f64>,
    /// Since when.
    pub(crate) since: Option<Timestamp>,
}

/// What the silence of all inputs means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Silence {
    /// There is none, or current flows: inputs are judged each by its own age.
    None,
    /// The buses may be about to sleep.
    Quiet,
    /// They have just fallen asleep.
    Begins,
    /// They sleep.
    Lasts,
}

impl BusSleep {
    pub(crate) fn new(config: &MonitorConfig) -> Self {
        let sample = &config.sample;
        let oldest_s = sample.current.max_age_s.max(sample.voltage.max_age_s);
        Self { after_s: config.asleep_after_s.map(|after_s| after_s.max(oldest_s)), since: None }
    }

    /// Another time-out; a sleep lasts.
    pub(crate) fn reconfigure(&mut self, config: &MonitorConfig) {
        self.after_s = Self::new(config).after_s;
    }
}
