//! A vehicle that sleeps: its buses fall silent as a whole while no current flows.
//!
//! In: the time, and when the latest reading of any input came. Out: whether the inputs may be judged, and two events a
//! sleep. One silent input among others, and silence under load, are faults and not judged here. While the buses sleep
//! nothing is missing: no input turns bad, no alarm is raised, and no estimate is valid.

use super::stages::Stages;
use super::{Event, EventKind, MonitorConfig, Outputs};
use crate::quantity::{Channel, Timestamp};

/// Without a reading of any input for this long its inputs are not judged at rest, s: they may all have fallen asleep. Longer
/// than the pauses between the frames of an awake bus, shorter than the age at which a reading is stale.
const QUIET_S: f64 = 0.25;

/// Whether the buses sleep.
#[derive(Debug)]
pub(super) struct BusSleep {
    /// Silence after which they do, s; `None` = never.
    after_s: Option<f64>,
    /// Since when.
    pub(super) since: Option<Timestamp>,
}

/// What the silence of all inputs means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Silence {
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
    pub(super) fn new(config: &MonitorConfig) -> Self {
        let sample = &config.sample;
        let oldest_s = sample.current.max_age_s.max(sample.voltage.max_age_s);
        Self { after_s: config.asleep_after_s.map(|after_s| after_s.max(oldest_s)), since: None }
    }

    /// Another time-out; a sleep lasts.
    pub(super) fn reconfigure(&mut self, config: &MonitorConfig) {
        self.after_s = Self::new(config).after_s;
    }
}

impl Stages {
    /// Judges the silence of all inputs.
    pub(super) fn silence(&self, now: Timestamp) -> Silence {
        let Some(after_s) = self.sleep.after_s else { return Silence::None };
        if self.sleep.since.is_some() {
            return Silence::Lasts;
        }
        let sampler = &self.sampling.sampler;
        let transition = &self.learning.config.transition;
        let rest_a = transition.dead_band_a + transition.hysteresis_a;
        // Without any reading so far nothing can have fallen asleep: the wiring may be wrong.
        let Some(silent_s) = sampler.all_silent_s(now, QUIET_S) else { return Silence::None };
        if sampler.latest_current_a(now).is_none_or(|current_a| current_a.abs() > rest_a) {
            return Silence::None;
        }
        if silent_s > after_s { Silence::Begins } else { Silence::Quiet }
    }

    /// The buses fall asleep.
    pub(super) fn begin_bus_sleep(&mut self, now: Timestamp, out: &mut Outputs) {
        self.sleep.since = Some(now);
        self.fall_asleep(now, out);
        out.events.push(Event { time: now, kind: EventKind::BusAsleep { asleep: true, seconds: None } });
    }

    /// A reading came: the buses are awake again.
    #[cold]
    pub(super) fn end_bus_sleep(&mut self, now: Timestamp, out: &mut Outputs) {
        let Some(since) = self.sleep.since.take() else { return };
        let seconds = Some(now.since(since));
        out.events.push(Event { time: now, kind: EventKind::BusAsleep { asleep: false, seconds } });
        self.sampling.sampler.wake(now);
    }

    /// Whether a reading is one of an input that wakes the buses: any but the supply voltage, which the computer may
    /// measure itself, and the bits of a BMS that balances while the vehicle is parked.
    pub(super) fn wakes(channel: Channel) -> bool {
        !matches!(channel, Channel::SupplyVoltage | Channel::Balancing(_))
    }
}
