//! State of the inputs at one time: fresh, silent and lost signals, their latest values and their ranges.

use super::Sampler;
use crate::quantity::{CellIndex, Channel, Timestamp};
use crate::sample::channels::limits;
use crate::sample::signal::Signal;

/// Lowest and highest value of several sensors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorRange {
    pub lowest: f64,
    pub highest: f64,
    /// Whether all sensors have a value.
    pub is_whole: bool,
}

impl SensorRange {
    /// The range of a single sensor.
    pub fn of(value: f64) -> Self {
        Self { lowest: value, highest: value, is_whole: true }
    }

    /// The range of several sensors; `None` = no value is known.
    fn among(values: impl Iterator<Item = Option<f64>>) -> Option<Self> {
        let (mut lowest, mut highest, mut is_whole) = (f64::INFINITY, f64::NEG_INFINITY, true);
        for value in values {
            let Some(value) = value else {
                is_whole = false;
                continue;
            };
            (lowest, highest) = (lowest.min(value), highest.max(value));
        }
        (lowest <= highest).then_some(Self { lowest, highest, is_whole })
    }
}

impl Sampler {
    /// Time since the channel's latest reading, good or bad (s), for the rule `input_missing`.
    pub fn silence_s(&self, channel: Channel, now: Timestamp) -> Option<f64> {
        // Use the later of the two times, because time before the start or before the vehicle last woke does not count.
        let since = self.state.signals[self.slot(channel)?].received.max(self.state.began);
        Some(since.map_or(0.0, |from| now.since(from).max(0.0)))
    }

    /// Share of bad readings, averaged over about [`BAD_SHARE_READINGS`](super::signal::BAD_SHARE_READINGS) readings;
    /// `None` = no reading yet.
    pub fn bad_share(&self, channel: Channel) -> Option<f64> {
        self.slot(channel).and_then(|slot| self.state.signals[slot].bad_share())
    }

    /// The channels in use: current, temperatures, voltages, values reported by the pack, contactors.
    pub fn channels(&self) -> &[Channel] {
        &self.channels
    }

    /// The latest good reading of each channel, at any age: channel, time, value.
    pub fn latest_readings(&self) -> impl Iterator<Item = (Channel, Timestamp, f64)> + '_ {
        let each = self.channels.iter().zip(&self.state.signals);
        each.filter_map(|(&channel, signal)| signal.good.map(|good| (channel, good.time, good.value())))
    }

    /// Time without any reading (s); `None` = at most `quiet_s`, or no reading yet.
    pub fn all_silent_s(&self, now: Timestamp, quiet_s: f64) -> Option<f64> {
        let received = |signal: &Signal| signal.received;
        let is_recent = |at: Timestamp| now.since(at) <= quiet_s;
        // Check the current first, because it arrives most often.
        if received(&self.state.signals[0]).is_some_and(is_recent) {
            return None;
        }
        let latest = self.state.signals.iter().filter_map(received).max()?;
        (!is_recent(latest)).then(|| now.since(latest))
    }

    /// The latest good reading (A), regardless of its age; 0 while the contactors are open.
    pub fn latest_current_a(&self, now: Timestamp) -> Option<f64> {
        if self.state.charge.is_open(now) {
            return Some(0.0);
        }
        self.state.signals[0].good.map(|good| good.value())
    }

    /// Fresh temperatures (degrees C); `None` = no fresh sensor.
    pub fn temperature_range_c(&self, now: Timestamp) -> Option<SensorRange> {
        let sensors = &self.state.signals[1..=self.sensors];
        SensorRange::among(sensors.iter().map(|signal| signal.fresh(now, &self.config.temperature)))
    }

    /// Maximum age of a fresh temperature, voltage and current (s).
    pub fn max_ages_s(&self) -> [f64; 3] {
        let config = &self.config;
        [&config.temperature, &config.voltage, &config.current].map(|limits| limits.max_age_s)
    }

    /// Fresh voltages (V) without the `faulty` cells; `None` = no fresh voltage. If only the total voltage is measured,
    /// this is the mean voltage of the cells.
    pub fn voltage_range_v(&self, now: Timestamp, faulty: &[CellIndex]) -> Option<SensorRange> {
        let first = 1 + self.sensors;
        let is_faulty = |index: usize| faulty.iter().any(|cell| cell.index() == index);
        let signals = self.state.signals[first..first + self.voltages].iter().enumerate();
        SensorRange::among(
            signals.map(|(index, signal)| signal.fresh(now, &self.config.voltage).filter(|_| !is_faulty(index))),
        )
    }

    /// The last good value of a channel, if it is fresh.
    pub fn reported(&self, channel: Channel, now: Timestamp) -> Option<f64> {
        self.slot(channel).and_then(|slot| self.state.signals[slot].fresh(now, limits(&self.config, channel)))
    }

    /// Whether a channel is lost: its latest reading is bad or stale, and its last good reading is stale. A single bad
    /// reading does not lose a channel.
    pub fn is_lost(&self, channel: Channel, now: Timestamp) -> bool {
        let is_bad = self.slot(channel).is_some_and(|slot| self.state.signals[slot].is_bad());
        is_bad && self.reported(channel, now).is_none()
    }

    /// Whether there is a fresh good value, and a reading since the start or the last waking.
    pub fn is_fresh(&self, channel: Channel, now: Timestamp) -> bool {
        self.has_input_since_waking(channel) && self.reported(channel, now).is_some()
    }

    /// Whether the latest reading, good or bad, is older than the maximum age.
    pub fn is_silent(&self, channel: Channel, now: Timestamp) -> bool {
        self.silence_s(channel, now).is_none_or(|silence_s| silence_s > limits(&self.config, channel).max_age_s)
    }

    /// Longest silence (s) and largest share of bad readings; `None` = a channel is silent, or has no reading since the
    /// start or the last waking.
    pub fn worst_input(&self, now: Timestamp) -> Option<(f64, f64)> {
        let began = self.state.began?;
        let (mut longest_s, mut share) = (0.0_f64, 0.0_f64);
        let config = &self.config;
        let voltages = 1 + self.sensors;
        let reported = voltages + self.voltages;
        let parts =
            [(0..1, &config.current), (1..voltages, &config.temperature), (voltages..reported, &config.voltage)];
        for (slots, limits) in parts {
            let mut oldest = now;
            for signal in &self.state.signals[slots] {
                let (received, bad_share) = signal.latest_since(began)?;
                oldest = oldest.min(received);
                share = if bad_share > share { bad_share } else { share };
            }
            let silence_s = now.since(oldest);
            if silence_s > limits.max_age_s {
                return None;
            }
            longest_s = longest_s.max(silence_s);
        }
        for &channel in &self.channels[reported..] {
            let received = self.has_input_since_waking(channel) && !self.is_silent(channel, now);
            longest_s = longest_s.max(self.silence_s(channel, now).filter(|_| received)?);
            share = share.max(self.bad_share(channel).unwrap_or(0.0));
        }
        Some((longest_s, share))
    }

    /// Whether the channel has had a reading, good or bad, since the start or the last waking.
    pub fn has_input_since_waking(&self, channel: Channel) -> bool {
        self.slot(channel).is_some_and(|slot| self.state.signals[slot].received >= self.state.began)
    }

    /// Whether every voltage has a fresh good reading.
    pub fn voltages_fresh(&self, now: Timestamp) -> bool {
        let first = 1 + self.sensors;
        let voltages = &self.state.signals[first..first + self.voltages];
        let oldest = voltages.iter().try_fold(now, |oldest, signal| Some(oldest.min(signal.good?.time)));
        oldest.is_some_and(|oldest| now.since(oldest) <= self.config.voltage.max_age_s)
    }

    /// Whether any signal that the estimates use is bad or stale.
    pub fn any_bad(&self) -> bool {
        self.any_lost() && self.state.signals[..1 + self.sensors + self.voltages].iter().any(Signal::is_bad)
    }

    /// Whether any signal is bad or stale.
    pub fn any_lost(&self) -> bool {
        self.bad_signals > 0
    }
}
