//! Statistics of one signal: counts, periods, and the range and the changes of its values. The range is also kept for
//! alternative layouts of the signal (byte order, start bit, sign).
//!
//! In: payloads or values with their time. Values are in the program's unit, after the configured scale and offset,
//! without range limits. Memory is bounded, because gaps and values are kept as thinned samples.

use std::collections::{BTreeMap, BTreeSet};

use super::layout::AlternativeReading;
use super::loss::LossCounter;
use super::sample::{Extent, ThinnedSample};
use crate::can::decode::Binding;
use crate::can::signal::SignalLayout;
use crate::quantity::{Fault, Timestamp};

/// Number of frames without a value, by reason.
#[derive(Debug, Clone, Copy, Default)]
pub struct UnusableCounts {
    pub(crate) short: u64,
    pub(crate) not_available: u64,
    pub(crate) not_finite: u64,
}

/// A gap is a missing stretch if it is longer than `MISSING_S` seconds and longer than `MISSING_PERIODS` periods of
/// the signal.
const MISSING_S: f64 = 60.0;
const MISSING_PERIODS: f64 = 20.0;

/// Statistics of one signal.
#[derive(Debug, Clone, Default)]
pub struct Series {
    pub(crate) frames: u64,
    pub(crate) unusable: UnusableCounts,
    /// Number of values outside `plausible`.
    pub(crate) implausible: u64,
    plausible: Option<(f64, f64)>,
    /// Smallest, largest and latest value, and the number of values.
    pub extent: Extent,
    /// A sample of the values.
    pub values: ThinnedSample,
    pub(super) times_s: ThinnedSample,
    pub(crate) gaps: ThinnedSample,
    pub(crate) loss: LossCounter,
    /// Longest gap, without missing stretches (s).
    pub(crate) longest_gap_s: f64,
    /// Longest missing stretch: begin and length (s).
    pub(crate) longest_missing: Option<(Timestamp, f64)>,
    pub(crate) missing_s: f64,
    /// Number of gaps longer than `max_age_s`, without missing stretches. In each of them, a reading became stale.
    pub(crate) stale_gaps: u64,
    pub(crate) changes: ThinnedSample,
    /// Number of changes that are too fast for a temperature.
    pub(crate) jumps: u64,
    pub(crate) alternatives: Vec<AlternativeReading>,
    last_time: Option<Timestamp>,
}

impl Series {
    /// Creates empty statistics. `plausible`: smallest and largest plausible value; `None` = unlimited.
    pub(crate) fn new(layout: &SignalLayout, plausible: Option<(f64, f64)>) -> Self {
        Self { alternatives: AlternativeReading::all(layout), plausible, ..Self::default() }
    }

    /// Handles a frame that may carry the signal. Returns the signal's value; `None` if the frame has no value.
    pub(crate) fn handle(&mut self, time: Timestamp, payload: &[u8], binding: &Binding, max_age_s: f64) -> Option<f64> {
        self.frames += 1;
        let value = match self.value(payload, binding) {
            Ok(value) => value?,
            Err(fault) => {
                self.note_unusable(fault, payload, binding);
                return None;
            }
        };
        self.push(time, value, max_age_s);
        self.read_otherwise(payload, binding);
        Some(value)
    }

    /// Creates the statistics of a recorded signal from its values and their times (s).
    pub fn of(readings: impl Iterator<Item = (f64, Result<f64, Fault>)>) -> Self {
        // 4096 values suffice for a correlation. Samples of this size fit into memory for thousands of signals.
        const MOST: usize = 4096;
        // One reading per 0.5 s is enough to show load changes, which take some tenths of a second.
        const FINE_S: f64 = 0.5;
        let mut series = Self::default();
        let mut all = Vec::new();
        for (time_s, value) in readings {
            match value {
                Ok(value) if value.is_finite() => {
                    series.push(Timestamp::from_secs(time_s), value, f64::INFINITY);
                    all.push((time_s, value));
                }
                Err(Fault::NotAvailable) => series.unusable.not_available += 1,
                Ok(_) | Err(_) => series.unusable.short += 1,
            }
        }
        let (times_s, values) = windows(all, MOST, FINE_S).into_iter().unzip();
        (series.times_s, series.values) = (ThinnedSample::of(times_s), ThinnedSample::of(values));
        series
    }

    fn push(&mut self, time: Timestamp, value: f64, max_age_s: f64) {
        let gap_s = self.note_gap(time, max_age_s);
        if self.extent.count > 0 {
            let change = (value - self.extent.last).abs();
            self.changes.push(change);
            self.jumps += u64::from(change > 2.0 && gap_s.is_some_and(|gap_s| gap_s <= 2.0));
        }
        self.implausible += u64::from(self.plausible.is_some_and(|(low, high)| !(low..=high).contains(&value)));
        self.extent.push(value);
        self.values.push(value);
        self.times_s.push(time.secs());
    }

    fn note_unusable(&mut self, fault: Fault, payload: &[u8], binding: &Binding) {
        let count = match fault {
            Fault::NotAvailable => &mut self.unusable.not_available,
            Fault::NotFinite => &mut self.unusable.not_finite,
            _ => &mut self.unusable.short,
        };
        *count += 1;
        // With another layout, the payload may be long enough.
        if fault == Fault::ShortFrame && binding.holds(payload) == Ok(true) {
            self.read_otherwise(payload, binding);
        }
    }

    fn read_otherwise(&mut self, payload: &[u8], binding: &Binding) {
        self.alternatives.iter_mut().for_each(|other| other.handle(payload, binding.scale, binding.offset));
    }

    /// The value without the DBC's range check; `Ok(None)` if the payload does not carry the signal.
    fn value(&self, payload: &[u8], binding: &Binding) -> Result<Option<f64>, Fault> {
        if !binding.holds(payload)? {
            return Ok(None);
        }
        let raw = binding.plan.raw(payload)?;
        if binding.not_available.contains(&raw) || is_customary(payload, binding) {
            return Err(Fault::NotAvailable);
        }
        Ok(Some(binding.plan.physical(payload)? * binding.scale + binding.offset))
    }

    fn note_gap(&mut self, time: Timestamp, max_age_s: f64) -> Option<f64> {
        let gap_s = self.last_time.map(|last| time.since(last).max(0.0));
        if let Some(gap_s) = gap_s {
            // In a missing stretch, the sender slept or left the signal out.
            let is_missing = gap_s > MISSING_S && gap_s > MISSING_PERIODS * self.period_s().unwrap_or(f64::INFINITY);
            self.gaps.push(gap_s);
            self.loss.push(gap_s);
            if is_missing {
                self.missing_s += gap_s;
                let is_longest = self.longest_missing.is_none_or(|(_, longest_s)| gap_s > longest_s);
                self.longest_missing =
                    self.last_time.filter(|_| is_longest).map(|from| (from, gap_s)).or(self.longest_missing);
            } else {
                self.longest_gap_s = self.longest_gap_s.max(gap_s);
                self.stale_gaps += u64::from(gap_s > max_age_s);
            }
        }
        self.last_time = Some(time);
        gap_s
    }

    /// Ignores the next gap, because the observer does not listen during this gap.
    pub(crate) fn pause(&mut self) {
        self.last_time = None;
    }

    /// Number of readings with a value.
    pub fn count(&self) -> u64 {
        self.extent.count
    }

    /// Median time between two readings (s).
    pub fn period_s(&self) -> Option<f64> {
        self.gaps.median()
    }

    /// Standard deviation of the white noise, computed from the median change between readings. A few real steps of
    /// the value hardly change the median.
    pub(crate) fn noise(&self) -> Option<f64> {
        // The absolute difference of two normal variables with standard deviation s has the median 0.6745 sqrt(2) s.
        Some(self.changes.median()? / (0.6745 * std::f64::consts::SQRT_2))
    }

    /// Number of readings without a value: outside the range, not finite, too short, or "not available".
    pub fn bad(&self) -> u64 {
        self.invalid() + self.unusable.not_available
    }

    /// Number of readings without a value, except "not available".
    pub fn invalid(&self) -> u64 {
        self.unusable.short + self.unusable.not_finite
    }

    /// Whether all values are equal.
    pub fn is_constant(&self) -> bool {
        self.extent.range() == 0.0
    }

    /// Number of different values among about a hundred evenly spread kept values.
    pub fn distinct(&self) -> usize {
        let stride = (self.values.kept().len() / 100).max(1);
        self.values
            .kept()
            .iter()
            .step_by(stride)
            .take(100)
            .map(|value| value.to_bits())
            .collect::<BTreeSet<u64>>()
            .len()
    }

    /// Whether the signal is a counter: most of its steps have the same non-zero size.
    pub fn is_counter(&self) -> bool {
        let values = self.values.kept();
        let mut steps: BTreeMap<u64, usize> = BTreeMap::new();
        for pair in values.windows(2).take(200).filter(|pair| pair[0] != pair[1]) {
            *steps.entry((pair[1] - pair[0]).abs().to_bits()).or_default() += 1;
        }
        let most = steps.values().max().copied().unwrap_or(0);
        5 * most > 3 * values.len().saturating_sub(1).min(200)
    }

    /// Returns the raw code that means zero. If the received codes come near 0, this is 0. Otherwise, it is a usual
    /// offset in or near the range of the received codes; `None` if there is no such offset. `factor`: value per code.
    pub fn zero_code(&self, factor: f64) -> Option<f64> {
        let (low, high) = (self.extent.min / factor, self.extent.max / factor);
        if low - 3.0 * (high - low) <= 0.0 {
            return Some(0.0);
        }
        // First the middle of a 16-bit or 12-bit field, then round numbers, the roundest first.
        let powers = [32_768.0, 32_767.0, 2048.0, 32_000.0].into_iter();
        let round =
            [10_000.0, 5000.0, 1000.0, 500.0, 100.0].into_iter().map(|step| (0.5 * (low + high) / step).round() * step);
        // If the pack was only discharged, the code for zero lies outside the received range. Therefore widen the
        // range.
        let (low, high) = (2.0 * low - high, 2.0 * high - low);
        powers.chain(round).find(|zero| *zero > 0.0 && (low..=high).contains(zero))
    }

    /// Largest step between consecutive kept values.
    pub fn largest_step(&self) -> f64 {
        self.values.kept().windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max)
    }
}

/// Thins readings to at most `most`. First, fast readings are thinned to one per `fine_s` (s). If that is not enough,
/// whole windows of time are kept and the readings between them are dropped. Even for a long log, the sample therefore
/// contains steps between consecutive readings. The windows depend only on the time, so all signals keep the same
/// times.
pub fn windows<T>(mut readings: Vec<(f64, T)>, most: usize, fine_s: f64) -> Vec<(f64, T)> {
    // This is longer than the period of most signals, and short enough that fast signals keep many windows.
    let window_s = 16.0 * fine_s;
    let span_s = readings.first().zip(readings.last()).map_or(0.0, |((first_s, _), (last_s, _))| last_s - first_s);
    let period_s = span_s / readings.len().max(1) as f64;
    let finest = if period_s > 0.0 { (fine_s / period_s) as usize } else { 1 };
    let stride = readings.len().div_ceil(most).min(finest).max(1);
    readings = readings.into_iter().step_by(stride).collect();
    let mut mask = 0_u64;
    while readings.len() > most && mask < u64::MAX >> 1 {
        mask = mask << 1 | 1;
        readings.retain(|(time_s, _)| (time_s / window_s) as u64 & mask == 0);
    }
    let stride = readings.len().div_ceil(most).max(1);
    readings.into_iter().step_by(stride).collect()
}

/// The value of a recorded payload, within the DBC's range.
pub fn recorded_value(payload: &[u8], binding: &Binding) -> Result<f64, Fault> {
    if is_customary(payload, binding) { Err(Fault::NotAvailable) } else { binding.value(payload) }
}

/// Whether all bits are 1 and the value is outside the DBC's range. By convention, this means "not available", even
/// without an entry in the value table.
fn is_customary(payload: &[u8], binding: &Binding) -> bool {
    binding.plan.raw(payload) == Ok(binding.plan.all_ones()) && binding.plan.decode(payload) == Err(Fault::OutOfRange)
}
