//! Detects a second sender of an unprotected input message by comparing the frame rate with the expected rate.
//!
//! In: time and identifier of each frame, the battery current that the frame reports, and the time between frames
//! ([`SecondSenders::poll`]). Out: a [`SenderChange`] when a second sender is found, and when this sender is gone.
//!
//! Frames are counted in windows of [`WINDOW_NS`]. A window is suspicious if it has more than [`EXCESS`] times the
//! expected number of frames and one of two further signs. The first sign is that many intervals are much shorter than
//! the mean, because each frame of one sender falls between two frames of the other sender. The second sign is that the
//! reported currents alternate. After [`WINDOWS`] consecutive suspicious windows, a second sender is found. A single
//! sender that becomes faster, as many do when the vehicle wakes, shows neither sign. Some messages always have short
//! intervals, for example between the pages of a multiplexed message. These intervals are learned with the rate and do
//! not count.
//!
//! The expected number follows from the highest steady rate so far, or from the DBC's cycle time if the latter gives a
//! higher rate. The learned rate is stored, so that a second sender is also found after a restart.
//!
//! A second sender is not found in these cases:
//! * the message has fewer than [`LEAST_PER_S`] frames a second, and the second sender is as slow as the first;
//! * the message contains no current and always arrives in bursts;
//! * the message contains no current, and the second sender is more than twenty times as fast as the first;
//! * the second sender is present before the rate is known, and its currents do not differ from the first sender's.
//!
//! A message with end-to-end protection does not need this check, because the frame counters of two senders contradict
//! each other.

use serde::{Deserialize, Serialize};

use crate::can::CanId;
use crate::can::id_table::IdTable;
use crate::quantity::{BusIndex, Timestamp};

const WINDOW_NS: i64 = 1_000_000_000;
/// A window may be suspicious above this multiple of the expected number of frames. A second sender with the same cycle
/// time doubles the number.
const EXCESS: f64 = 1.5;
/// Number of additional frames that a normal window may have, because arbitration may delay frames into the window.
const DELAYED: f64 = 1.5;
/// A second sender is found after this number of suspicious windows. A burst after a pause of the bus affects only one
/// window.
const WINDOWS: u32 = 3;
/// After this number of normal windows, the second sender counts as gone.
const GONE_WINDOWS: u32 = 10;
/// A rate is steady after this number of windows with similar numbers of frames.
const STEADY_WINDOWS: u32 = 20;
/// Largest difference between similar numbers of frames: a fraction of the number, plus a number of frames.
const STEADY: (f64, f64) = (0.2, 1.0);
/// Lowest learned rate, frames a second. Fewer frames per window are not significant.
const LEAST_PER_S: f64 = 3.0;
/// An interval shorter than this fraction of the mean is short.
const SHORT: f64 = 0.5;
/// Signs of a second sender are unusual short intervals, or alternating currents. In a suspicious window, the number of
/// signs is at least this multiple of the expected number of frames, and at least 1.
const SIGNS: f64 = 0.4;
/// Fraction of the frames that follow a short interval by chance, because other messages delay them.
const CHANCE_SHORT: f64 = 0.02;

/// Reports that a second sender was found or is gone.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SenderChange {
    pub bus: BusIndex,
    pub id: CanId,
    pub active: bool,
    /// Frames in the latest second.
    pub frames_per_s: u32,
    pub expected_per_s: f64,
}

/// Rate statistics of one message; all fields are part of a snapshot.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MessageRate {
    bus: BusIndex,
    id: CanId,
    /// 1/s.
    learned_per_s: Option<f64>,
    /// Fraction of the frames after a short interval.
    usual_short: f64,
    /// Smoothed rate (1/s). `steady` is the number of consecutive windows with this rate.
    candidate: f64,
    steady: u32,
    /// Number of consecutive suspicious windows. `calm` is the number of consecutive normal windows.
    excess: u32,
    calm: u32,
    /// Start of the window; `None` = no frame since the start of listening or since a pause.
    window_from: Option<Timestamp>,
    frames: u32,
    short: u32,
    contradictions: u32,
    latest: Timestamp,
    /// The previous two currents.
    currents_a: [Option<f64>; 2],
    is_doubtful: bool,
}

/// Detects second senders of all unprotected input messages.
#[derive(Debug, Clone, Default)]
pub struct SecondSenders {
    /// Sorted by interface and identifier.
    rates: Vec<MessageRate>,
    /// From the DBC's cycle time, 1/s.
    configured_per_s: Vec<Option<f64>>,
    numbers: IdTable,
    /// Start of the oldest open window; `None` = no window is open.
    next_end: Option<Timestamp>,
    pub(crate) changes: Vec<SenderChange>,
}

impl SecondSenders {
    /// Creates the detector. Messages are given with their cycle times (s), if known.
    pub fn new(messages: impl IntoIterator<Item = (BusIndex, CanId, Option<f64>)>) -> Self {
        let mut messages: Vec<_> = messages.into_iter().collect();
        messages.sort_by_key(|(bus, id, _)| (*bus, *id));
        messages.dedup_by_key(|(bus, id, _)| (*bus, *id));
        let rate = |cycle_s: f64| Some(1.0 / cycle_s).filter(|rate| rate.is_finite() && *rate > 0.0);
        Self {
            numbers: IdTable::new(messages.iter().map(|(bus, id, _)| (*bus, *id))),
            configured_per_s: messages.iter().map(|(.., cycle_s)| cycle_s.and_then(rate)).collect(),
            rates: messages.iter().map(|(bus, id, _)| MessageRate::new(*bus, *id)).collect(),
            next_end: None,
            changes: Vec::with_capacity(messages.len()),
        }
    }

    /// Whether a message has a second sender.
    pub fn is_doubtful(&self, bus: BusIndex, id: CanId) -> bool {
        self.rates.get(self.numbers.number(bus, id)).is_some_and(|rate| rate.is_doubtful)
    }

    /// Messages with a second sender.
    pub fn doubtful(&self) -> impl Iterator<Item = (BusIndex, CanId)> + '_ {
        self.rates.iter().filter(|rate| rate.is_doubtful).map(|rate| (rate.bus, rate.id))
    }

    /// Counts a received frame.
    #[inline]
    pub fn handle(&mut self, now: Timestamp, bus: BusIndex, id: CanId) {
        let number = self.numbers.number(bus, id);
        let Some(rate) = self.rates.get_mut(number) else { return };
        rate.end_windows(now, self.configured_per_s[number], &mut self.changes);
        rate.count(now);
        if self.next_end.is_none() {
            self.next_end = rate.window_from;
        }
    }

    /// Compares the current in a [counted](Self::handle) frame with the two currents before it. `step_a` is the
    /// smallest step that exceeds noise (A).
    pub fn note_current(&mut self, bus: BusIndex, id: CanId, current_a: f64, step_a: f64) {
        let Some(rate) = self.rates.get_mut(self.numbers.number(bus, id)) else { return };
        let [before, between] = rate.currents_a;
        if let (Some(before), Some(between)) = (before, between) {
            let back_a = (current_a - before).abs();
            let away_a = (between - before).abs().min((between - current_a).abs());
            rate.contradictions += u32::from(away_a > step_a && back_a < 0.25 * away_a);
        }
        rate.currents_a = [between, Some(current_a)];
    }

    /// Ends windows. A window without frames is a normal window.
    pub fn poll(&mut self, now: Timestamp) {
        let is_over = |from: Timestamp| now.nanos().saturating_sub(from.nanos()) >= WINDOW_NS;
        if !self.next_end.is_some_and(is_over) {
            return;
        }
        for (rate, configured) in self.rates.iter_mut().zip(&self.configured_per_s) {
            rate.end_windows(now, *configured, &mut self.changes);
        }
        self.next_end = self.rates.iter().filter_map(|rate| rate.window_from).min();
    }

    /// Restarts counting after a time without listening or a clock step. Keeps the learned rates and the second senders
    /// that were found.
    pub fn restart(&mut self) {
        for rate in &mut self.rates {
            *rate = MessageRate {
                learned_per_s: rate.learned_per_s,
                usual_short: rate.usual_short,
                is_doubtful: rate.is_doubtful,
                ..MessageRate::new(rate.bus, rate.id)
            };
        }
        self.next_end = None;
    }

    /// The statistics to store.
    pub fn snapshot(&self) -> Vec<MessageRate> {
        self.rates.clone()
    }

    /// Restores stored statistics. If the program did not run in between, call [`restart`](Self::restart) afterwards.
    pub fn restore(&mut self, stored: &[MessageRate]) {
        for of in stored.iter().filter(|of| of.is_possible()) {
            if let Some(rate) = self.rates.get_mut(self.numbers.number(of.bus, of.id)) {
                *rate = *of;
            }
        }
        self.next_end = self.rates.iter().filter_map(|rate| rate.window_from).min();
    }
}

impl MessageRate {
    fn new(bus: BusIndex, id: CanId) -> Self {
        Self {
            bus,
            id,
            learned_per_s: None,
            usual_short: 0.0,
            candidate: 0.0,
            steady: 0,
            excess: 0,
            calm: 0,
            window_from: None,
            frames: 0,
            short: 0,
            contradictions: 0,
            latest: Timestamp::ZERO,
            currents_a: [None; 2],
            is_doubtful: false,
        }
    }

    fn is_possible(&self) -> bool {
        let is_rate = |rate: f64| (0.0..=1e9).contains(&rate);
        is_rate(self.candidate) && self.learned_per_s.is_none_or(is_rate) && (0.0..=1.0).contains(&self.usual_short)
    }

    #[inline]
    fn count(&mut self, now: Timestamp) {
        if self.window_from.is_none() {
            self.window_from = Some(now);
        } else if self.candidate > 0.0 {
            // Use the smoothed rate, because the rate of the open window is not known yet.
            let interval_ns = now.nanos().saturating_sub(self.latest.nanos()) as f64;
            self.short = self.short.saturating_add(u32::from(interval_ns * self.candidate < SHORT * WINDOW_NS as f64));
        }
        self.frames = self.frames.saturating_add(1);
        self.latest = now;
    }

    #[inline]
    fn end_windows(&mut self, now: Timestamp, configured: Option<f64>, changes: &mut Vec<SenderChange>) {
        let Some(from) = self.window_from else { return };
        let passed_ns = now.nanos().saturating_sub(from.nanos());
        if passed_ns >= WINDOW_NS {
            let rates = configured.into_iter().chain(self.learned_per_s);
            self.end_window(rates.reduce(f64::max), changes);
            let next = from.plus_nanos(WINDOW_NS);
            // After a pause, the next frame of the message starts a new window.
            self.window_from = (passed_ns < 2 * WINDOW_NS).then_some(next);
        }
    }

    fn end_window(&mut self, expected: Option<f64>, changes: &mut Vec<SenderChange>) {
        let frames = f64::from(self.frames);
        let is_excess = expected.is_some_and(|expected| {
            frames > EXCESS * expected + DELAYED && self.signs(frames) >= (SIGNS * expected).max(1.0)
        });
        (self.excess, self.calm) = match is_excess {
            true => (self.excess.saturating_add(1), 0),
            false => (0, self.calm.saturating_add(1)),
        };
        let is_found = !self.is_doubtful && self.excess >= WINDOWS;
        let is_gone = self.is_doubtful && self.calm >= GONE_WINDOWS;
        if is_found || is_gone {
            self.is_doubtful = is_found;
            let (bus, id, frames_per_s) = (self.bus, self.id, self.frames);
            let expected_per_s = expected.unwrap_or(0.0);
            changes.push(SenderChange { bus, id, active: is_found, frames_per_s, expected_per_s });
        }
        self.learn(frames, is_excess);
        (self.frames, self.short, self.contradictions) = (0, 0, 0);
    }

    /// Number of signs of a second sender: short intervals or alternating currents, whichever are more. Short intervals
    /// count only after the rate is learned, and only above the usual number.
    fn signs(&self, frames: f64) -> f64 {
        let usual = frames * self.usual_short.max(CHANCE_SHORT);
        let short = self.learned_per_s.map_or(0.0, |_| f64::from(self.short) - usual);
        short.max(f64::from(self.contradictions))
    }

    /// Learns a steady rate. A higher rate replaces a lower rate, unless a second sender causes the higher rate.
    fn learn(&mut self, frames: f64, is_excess: bool) {
        let (part, count) = STEADY;
        let is_steady = (frames - self.candidate).abs() <= part * self.candidate + count;
        self.steady = if is_steady && !is_excess && !self.is_doubtful { self.steady.saturating_add(1) } else { 0 };
        if self.steady > 0 && frames > 0.0 {
            let short = f64::from(self.short) / frames;
            self.usual_short += 0.2 * (short - self.usual_short);
        }
        self.candidate = if is_steady { self.candidate + 0.2 * (frames - self.candidate) } else { frames };
        if self.steady >= STEADY_WINDOWS && self.candidate >= LEAST_PER_S {
            self.learned_per_s = Some(self.learned_per_s.map_or(self.candidate, |rate| rate.max(self.candidate)));
        }
    }
}

#[cfg(test)]
mod tests;
