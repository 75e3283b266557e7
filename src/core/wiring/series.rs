//! Statistics of one signal: counts, periods, extent and roughness of its values, and of its bits with another layout.
//!
//! In: payloads with their time. Values are in the program's unit after the configured scale and offset; no limit is
//! applied. Memory is bounded: gaps and values are kept as a thinned sample.

use super::loss::LossCounter;
use crate::can::decode::Binding;
use crate::can::signal::{ByteOrder, SignalLayout, SignalPlan, ValueType};
use crate::quantity::{Fault, Timestamp};

/// Values kept per sample: quartiles of some hundred are good to a few per cent.
const MAX_VALUES: usize = 512;

/// No temperature changes by more than this within [`JUMP_S`], K.
const JUMP: f64 = 2.0;
const JUMP_S: f64 = 2.0;

/// A sample of a stream: every value at first, then every second, every fourth, ...
#[derive(Debug, Clone)]
pub(crate) struct ThinnedSample {
    values: Vec<f64>,
    stride: u64,
    seen: u64,
}

impl Default for ThinnedSample {
    fn default() -> Self {
        Self { values: Vec::new(), stride: 1, seen: 0 }
    }
}

impl ThinnedSample {
    pub(crate) fn push(&mut self, value: f64) {
        if self.seen.is_multiple_of(self.stride) {
            if self.values.len() == MAX_VALUES {
                let mut keep = false;
                self.values.retain(|_| {
                    keep = !keep;
                    keep
                });
                self.stride *= 2;
            }
            if self.seen.is_multiple_of(self.stride) {
                self.values.push(value);
            }
        }
        self.seen += 1;
    }

    /// The value below which the share `q` of the values lies; `None` = no value.
    pub(crate) fn quantile(&self, q: f64) -> Option<f64> {
        let mut sorted = self.values.clone();
        sorted.sort_by(f64::total_cmp);
        let at = (q * (sorted.len().max(1) - 1) as f64).round() as usize;
        sorted.get(at).copied()
    }

    pub(crate) fn median(&self) -> Option<f64> {
        self.quantile(0.5)
    }

    /// Share of the values with a property, 0 without a value.
    pub(crate) fn share(&self, has: impl Fn(f64) -> bool) -> f64 {
        self.values.iter().filter(|value| has(**value)).count() as f64 / self.values.len().max(1) as f64
    }

    /// The 2 % and 98 % quantiles.
    pub(crate) fn bulk(&self) -> Option<(f64, f64)> {
        Some((self.quantile(0.02)?, self.quantile(0.98)?))
    }
}

/// Extent and roughness of a stream.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Extent {
    pub(crate) count: u64,
    pub(crate) min: f64,
    pub(crate) max: f64,
    pub(crate) last: f64,
    pub(crate) changes: u64,
    sum: f64,
    travel: f64,
}

impl Default for Extent {
    fn default() -> Self {
        let (min, max) = (f64::INFINITY, f64::NEG_INFINITY);
        Self { count: 0, min, max, last: f64::NAN, changes: 0, sum: 0.0, travel: 0.0 }
    }
}

impl Extent {
    pub(crate) fn push(&mut self, value: f64) {
        if self.count > 0 && value != self.last {
            self.changes += 1;
            self.travel += (value - self.last).abs();
        }
        self.count += 1;
        self.sum += value;
        self.last = value;
        self.min = self.min.min(value);
        self.max = self.max.max(value);
    }

    pub(crate) fn mean(&self) -> f64 {
        self.sum / self.count as f64
    }

    pub(crate) fn range(&self) -> f64 {
        (self.max - self.min).max(0.0)
    }

    /// Mean change from one value to the next.
    pub(crate) fn step(&self) -> f64 {
        self.travel / (self.count.max(2) - 1) as f64
    }
}

/// Faults of a layout that are looked for, in the order of the alternatives.
pub(crate) const LAYOUT_FAULTS: [&str; 5] = [
    "wrong byte order",
    "signed and unsigned exchanged",
    "wrong byte order and sign of the number",
    "wrong byte order (the start bit is right)",
    "wrong byte order and sign of the number (the start bit is right)",
];

/// The same bits read with another layout.
#[derive(Debug, Clone)]
pub(crate) struct AlternativeReading {
    /// One of [`LAYOUT_FAULTS`].
    pub(crate) fault: &'static str,
    pub(crate) layout: SignalLayout,
    plan: SignalPlan,
    pub(crate) extent: Extent,
}

/// Frames without a value, by reason.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct UnusableCounts {
    pub(crate) short: u64,
    pub(crate) not_available: u64,
    pub(crate) not_finite: u64,
}

/// Statistics of one signal.
#[derive(Debug, Clone, Default)]
pub(crate) struct Series {
    /// Frames with the signal's identifier.
    pub(crate) frames: u64,
    pub(crate) unusable: UnusableCounts,
    /// Values outside `plausible`.
    pub(crate) implausible: u64,
    plausible: Option<(f64, f64)>,
    pub(crate) extent: Extent,
    pub(crate) values: ThinnedSample,
    /// Time between two readings, s.
    pub(crate) gaps: ThinnedSample,
    pub(crate) loss: LossCounter,
    pub(crate) longest_gap_s: f64,
    /// Gaps above the age from which a reading is stale.
    pub(crate) stale_gaps: u64,
    /// Absolute changes from one value to the next.
    pub(crate) changes: ThinnedSample,
    /// Changes no temperature can make.
    pub(crate) jumps: u64,
    pub(crate) alternatives: Vec<AlternativeReading>,
    last_time: Option<Timestamp>,
}

impl Series {
    /// `plausible`: smallest and largest plausible value; `None` = any.
    pub(crate) fn new(layout: &SignalLayout, plausible: Option<(f64, f64)>) -> Self {
        Self { alternatives: alternatives(layout), plausible, ..Self::default() }
    }

    /// Takes a frame that may carry the signal. Returns its value.
    pub(crate) fn handle(&mut self, time: Timestamp, payload: &[u8], binding: &Binding, max_age_s: f64) -> Option<f64> {
        self.frames += 1;
        let value = match self.value(payload, binding) {
            Ok(value) => value?,
            Err(fault) => {
                self.note_unusable(fault, payload, binding);
                return None;
            }
        };
        let gap_s = self.note_gap(time, max_age_s);
        if self.extent.count > 0 {
            let change = (value - self.extent.last).abs();
            self.changes.push(change);
            self.jumps += u64::from(change > JUMP && gap_s.is_some_and(|gap_s| gap_s <= JUMP_S));
        }
        self.implausible += u64::from(self.plausible.is_some_and(|(low, high)| !(low..=high).contains(&value)));
        self.extent.push(value);
        self.values.push(value);
        self.read_otherwise(payload, binding);
        Some(value)
    }

    fn note_unusable(&mut self, fault: Fault, payload: &[u8], binding: &Binding) {
        let count = match fault {
            Fault::NotAvailable => &mut self.unusable.not_available,
            Fault::NotFinite => &mut self.unusable.not_finite,
            _ => &mut self.unusable.short,
        };
        *count += 1;
        // With another layout the payload may be long enough.
        if fault == Fault::ShortFrame && binding.holds(payload) == Ok(true) {
            self.read_otherwise(payload, binding);
        }
    }

    /// Reads the bits with the other layouts.
    fn read_otherwise(&mut self, payload: &[u8], binding: &Binding) {
        for other in &mut self.alternatives {
            if let Ok(physical) = other.plan.physical(payload) {
                other.extent.push(physical * binding.scale + binding.offset);
            }
        }
    }

    /// The value without the DBC's range; `Ok(None)` = the payload does not carry the signal.
    fn value(&self, payload: &[u8], binding: &Binding) -> Result<Option<f64>, Fault> {
        if !binding.holds(payload)? {
            return Ok(None);
        }
        let raw = binding.plan.raw(payload)?;
        // All ones outside the range customarily mean "not available", even without an entry in the value table.
        let is_customary = raw == binding.plan.all_ones() && binding.plan.decode(payload) == Err(Fault::OutOfRange);
        if binding.not_available.contains(&raw) || is_customary {
            return Err(Fault::NotAvailable);
        }
        Ok(Some(binding.plan.physical(payload)? * binding.scale + binding.offset))
    }

    fn note_gap(&mut self, time: Timestamp, max_age_s: f64) -> Option<f64> {
        let gap_s = self.last_time.map(|last| time.since(last).max(0.0));
        if let Some(gap_s) = gap_s {
            self.gaps.push(gap_s);
            self.loss.push(gap_s);
            self.longest_gap_s = self.longest_gap_s.max(gap_s);
            self.stale_gaps += u64::from(gap_s > max_age_s);
        }
        self.last_time = Some(time);
        gap_s
    }

    /// Not listening: the next gap says nothing.
    pub(crate) fn pause(&mut self) {
        self.last_time = None;
    }

    /// Readings with a value.
    pub(crate) fn count(&self) -> u64 {
        self.extent.count
    }

    pub(crate) fn period_s(&self) -> Option<f64> {
        self.gaps.median()
    }

    /// White part of the noise, from one reading to the next; robust where fewer than half of the readings step.
    pub(crate) fn noise(&self) -> Option<f64> {
        /// Median of |difference of two normal variables| over their standard deviation.
        const MEDIAN_OF_DIFFERENCE: f64 = 0.6745 * std::f64::consts::SQRT_2;
        Some(self.changes.median()? / MEDIAN_OF_DIFFERENCE)
    }
}

/// Median of the finite values.
pub(crate) fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut sorted: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    let middle = sorted.len() / 2;
    if sorted.is_empty() {
        return None;
    }
    let (_, found, _) = sorted.select_nth_unstable_by(middle, f64::total_cmp);
    Some(*found)
}

fn alternatives(layout: &SignalLayout) -> Vec<AlternativeReading> {
    let other_sign = |layout: SignalLayout| match layout.value_type {
        ValueType::Unsigned => Some(SignalLayout { value_type: ValueType::Signed, ..layout }),
        ValueType::Signed => Some(SignalLayout { value_type: ValueType::Unsigned, ..layout }),
        ValueType::Float32 | ValueType::Float64 => None,
    };
    let swapped = byte_swapped(layout);
    let flipped = order_flipped(layout);
    let others = [swapped, other_sign(*layout), swapped.and_then(other_sign), flipped, flipped.and_then(other_sign)];
    let reading = |(fault, layout): (&'static str, Option<SignalLayout>)| {
        // The stated range belongs to the stated layout.
        let plan = SignalLayout { minimum: 0.0, maximum: 0.0, ..layout? }.plan().ok()?;
        Some(AlternativeReading { fault, layout: layout?, plan, extent: Extent::default() })
    };
    LAYOUT_FAULTS.into_iter().zip(others).filter_map(reading).collect()
}

/// The same start bit with the other byte order: `@0` for `@1` in the DBC; `None` = the signal is within a byte.
fn order_flipped(layout: &SignalLayout) -> Option<SignalLayout> {
    let byte_order = match layout.byte_order {
        ByteOrder::LittleEndian => ByteOrder::BigEndian,
        ByteOrder::BigEndian => ByteOrder::LittleEndian,
    };
    (layout.length_bits > 8).then_some(SignalLayout { byte_order, ..*layout })
}

/// The same whole bytes in the other order; `None` = the signal does not fill whole bytes, or only one.
fn byte_swapped(layout: &SignalLayout) -> Option<SignalLayout> {
    let whole = layout.length_bits.is_multiple_of(8) && layout.length_bits > 8;
    let (byte, bit) = (layout.start_bit / 8, layout.start_bit % 8);
    match layout.byte_order {
        ByteOrder::LittleEndian if whole && bit == 0 => {
            Some(SignalLayout { byte_order: ByteOrder::BigEndian, start_bit: 8 * byte + 7, ..*layout })
        }
        ByteOrder::BigEndian if whole && bit == 7 => {
            Some(SignalLayout { byte_order: ByteOrder::LittleEndian, start_bit: 8 * byte, ..*layout })
        }
        _ => None,
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "in a test a panic is the message")]
mod tests {
    use super::*;

    #[test]
    fn a_thinned_sample_keeps_its_quartiles_and_its_size() {
        let mut sample = ThinnedSample::default();
        (0..100_000).for_each(|n| sample.push(f64::from(n)));
        assert!(sample.values.len() <= MAX_VALUES);
        for q in [0.1, 0.5, 0.9] {
            let found = sample.quantile(q).unwrap();
            assert!((found - q * 1e5).abs() < 1000.0, "{q}: {found}");
        }
        assert_eq!(ThinnedSample::default().median(), None);
    }

    #[test]
    fn whole_bytes_can_be_read_in_the_other_order() {
        let layout = SignalLayout {
            start_bit: 16,
            length_bits: 16,
            byte_order: ByteOrder::LittleEndian,
            value_type: ValueType::Unsigned,
            factor: 1.0,
            offset: 0.0,
            minimum: 0.0,
            maximum: 0.0,
        };
        let payload = [0, 0, 0x12, 0x34, 0, 0, 0, 0];
        let swapped = byte_swapped(&layout).unwrap();
        assert_eq!(layout.plan().unwrap().raw(&payload), Ok(0x3412));
        assert_eq!(swapped.plan().unwrap().raw(&payload), Ok(0x1234));
        assert_eq!(byte_swapped(&swapped), Some(layout));
        assert_eq!(byte_swapped(&SignalLayout { length_bits: 12, ..layout }), None);
        assert_eq!(byte_swapped(&SignalLayout { length_bits: 8, ..layout }), None);
    }
}
