//! Finds a second sender of an unprotected input message, by the rate of its frames against their cycle time.
//!
//! In: time and identifier of each frame, whether its current contradicts the frames around it, the time alone
//! ([`SecondSenders::poll`]). Out: a [`SenderChange`] when a second sender is found and when it is gone.
//!
//! Per window of [`WINDOW_NS`] the frames are counted. More than [`EXCESS`] times the expected number in [`WINDOWS`] windows in
//! a row is a second sender where there is a second sign of it: each frame of the first one falls between two of the other, so
//! that one interval in each of its periods is much shorter than the mean; or the currents alternate. A sender that becomes
//! faster, as many do when the vehicle wakes, gives neither. Short intervals that a message has anyway, as the pages of a
//! multiplexed one that come in a burst, are learned with its rate and count for nothing. The expected number is the highest
//! steady rate so far, or that of the DBC's cycle time if it is higher; the rate is stored, so that a second sender is found after
//! a restart, too.
//!
//! Limits: a second sender as slow as the first of fewer than [`LEAST_PER_S`] frames a second, one of a message that always comes
//! in bursts or more than twenty times as often, if it carries no current, and one that is there before the rate is known, if its
//! currents do not differ, are not found. A message with end-to-end protection needs none of this: its counters do not fit.

use serde::{Deserialize, Serialize};

use crate::can::CanId;
use crate::can::id_table::IdTable;
use crate::quantity::{BusIndex, Timestamp};

/// Length of a window, ns.
const WINDOW_NS: i64 = 1_000_000_000;
/// Frames beyond this many times the expected number are too many; two senders of one cycle are twice.
const EXCESS: f64 = 1.5;
/// Room for frames that the bus has delayed into the window.
const DELAYED: f64 = 1.5;
/// Windows in a row with too many frames: a burst after a pause of the bus is one.
const WINDOWS: u32 = 3;
/// Windows in a row without, after which the second sender is gone.
const GONE_WINDOWS: u32 = 10;
/// Windows in a row with about as many frames that make a rate steady.
const STEADY_WINDOWS: u32 = 20;
/// Deviation that is about as many, part of the frames, and frames.
const STEADY: (f64, f64) = (0.2, 1.0);
/// Frames a second from which a rate is learned: fewer in a window say little.
const LEAST_PER_S: f64 = 3.0;
/// An interval shorter than this part of the mean is a short one.
const SHORT: f64 = 0.5;
/// Short intervals, or contradictions, per expected frame that are a sign of a second sender.
const SIGNS: f64 = 0.4;
/// Part of the frames that comes after a short interval by chance: other messages delay them.
const CHANCE_SHORT: f64 = 0.02;

/// A second sender was found, or is gone.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SenderChange {
    /// Interface.
    pub bus: BusIndex,
    /// Message.
    pub id: CanId,
    /// Whether it was found.
    pub active: bool,
    /// Frames in the latest second.
    pub frames_per_s: u32,
    /// Expected frames in a second.
    pub expected_per_s: f64,
}

/// What is known of one message; all of it is part of a snapshot.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MessageRate {
    bus: BusIndex,
    id: CanId,
    /// Highest steady rate, 1/s.
    learned_per_s: Option<f64>,
    /// Part of its frames that come after a short interval.
    usual_short: f64,
    /// Rate of the latest windows, and for how many it has been steady.
    candidate: f64,
    steady: u32,
    /// Windows in a row with too many frames, and without.
    excess: u32,
    calm: u32,
    /// Begin of the window; `None` = no frame since listening began.
    window_from: Option<Timestamp>,
    frames: u32,
    short: u32,
    contradictions: u32,
    latest: Timestamp,
    /// The last two currents of the message, A.
    currents_a: [Option<f64>; 2],
    /// Whether a second sender is there.
    is_doubtful: bool,
}

/// All unprotected input messages.
#[derive(Debug, Clone, Default)]
pub struct SecondSenders {
    /// Sorted by interface and identifier.
    rates: Vec<MessageRate>,
    /// Rate by the DBC's cycle time, 1/s.
    configured_per_s: Vec<Option<f64>>,
    numbers: IdTable,
    /// No window ends before this time.
    next_end: Option<Timestamp>,
    /// Changes that wait to be published, in their order.
    pub(crate) changes: Vec<SenderChange>,
}

impl SecondSenders {
    /// For these messages, each with the cycle time (s) of its frames where it is known.
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

    /// Whether a second sender of a message is there.
    pub fn is_doubtful(&self, bus: BusIndex, id: CanId) -> bool {
        self.rates.get(self.numbers.number(bus, id)).is_some_and(|rate| rate.is_doubtful)
    }

    /// Messages with a second sender.
    pub fn doubtful(&self) -> impl Iterator<Item = (BusIndex, CanId)> + '_ {
        self.rates.iter().filter(|rate| rate.is_doubtful).map(|rate| (rate.bus, rate.id))
    }

    /// Counts a frame.
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

    /// Takes the current of a frame that was [counted](Self::handle); `step_a` is the smallest step that is no noise.
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

    /// Ends the windows that are over: a message that no longer comes has no second sender.
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

    /// After time without listening, or a step of the clock: counting begins again. Rates stay, and so does a second sender until
    /// enough windows have come without.
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

    /// What is known of each message.
    pub fn snapshot(&self) -> Vec<MessageRate> {
        self.rates.clone()
    }

    /// Continues stored messages; [`restart`](Self::restart) follows where the program was not running in between.
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
            // The mean of the window before: that of this one is not known yet.
            let interval_ns = now.nanos().saturating_sub(self.latest.nanos()) as f64;
            self.short = self.short.saturating_add(u32::from(interval_ns * self.candidate < SHORT * WINDOW_NS as f64));
        }
        self.frames = self.frames.saturating_add(1);
        self.latest = now;
    }

    /// Ends the window, if it is over.
    #[inline]
    fn end_windows(&mut self, now: Timestamp, configured: Option<f64>, changes: &mut Vec<SenderChange>) {
        let Some(from) = self.window_from else { return };
        let passed_ns = now.nanos().saturating_sub(from.nanos());
        if passed_ns >= WINDOW_NS {
            let rates = configured.into_iter().chain(self.learned_per_s);
            self.end_window(rates.reduce(f64::max), changes);
            let next = from.plus_nanos(WINDOW_NS);
            // A message that has paused begins a new window with its next frame.
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

    /// Signs of a second sender in the window. What intervals are usual has to be known before a short one is a sign.
    fn signs(&self, frames: f64) -> f64 {
        let usual = frames * self.usual_short.max(CHANCE_SHORT);
        let short = self.learned_per_s.map_or(0.0, |_| f64::from(self.short) - usual);
        short.max(f64::from(self.contradictions))
    }

    /// Learns a steady rate; a higher one replaces a lower one where no second sender causes it.
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
