//! One signal as it comes: how often, how far apart, from where to where, how roughly; and its bits read otherwise.
//!
//! In: payloads with their time. Values are in the program's unit after the configured scale and offset, and not held
//! to any limit. Memory is bounded: of gaps and values a thinned sample is kept.

use crate::can::decode::Binding;
use crate::can::signal::{ByteOrder, SignalLayout, SignalPlan as Plan, ValueType};
use crate::quantity::{Fault, Timestamp};

/// Values kept of each sample: quartiles of some hundred are good to a few per cent.
const KEPT: usize = 512;

/// A change by more than this within [`JUMP_S`] is none of a temperature, K.
const JUMP: f64 = 2.0;
const JUMP_S: f64 = 2.0;

/// A sample of a stream: every value at first, then every second, every fourth, ...
#[derive(Debug, Clone)]
pub(crate) struct Thinned {
    kept: Vec<f64>,
    stride: u64,
    seen: u64,
}

impl Default for Thinned {
    fn default() -> Self {
        Self { kept: Vec::new(), stride: 1, seen: 0 }
    }
}

impl Thinned {
    pub(crate) fn push(&mut self, value: f64) {
        if self.seen.is_multiple_of(self.stride) {
            if self.kept.len() == KEPT {
                let mut keep = false;
                self.kept.retain(|_| {
                    keep = !keep;
                    keep
                });
                self.stride *= 2;
            }
            if self.seen.is_multiple_of(self.stride) {
                self.kept.push(value);
            }
        }
        self.seen += 1;
    }

    /// The value below which the share `q` of them lies; `None` = there are none.
    pub(crate) fn quantile(&self, q: f64) -> Option<f64> {
        let mut sorted = self.kept.clone();
        sorted.sort_by(f64::total_cmp);
        let at = (q * (sorted.len().max(1) - 1) as f64).round() as usize;
        sorted.get(at).copied()
    }

    pub(crate) fn median(&self) -> Option<f64> {
        self.quantile(0.5)
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

/// How else the bits could be meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum LayoutVariant {
    /// The other byte order, the same bytes.
    ByteOrder,
    /// Signed for unsigned, or the other way.
    Sign,
    /// Both.
    Both,
}

/// The same bits read in another way.
#[derive(Debug, Clone)]
pub(crate) struct Alternative {
    pub(crate) how: LayoutVariant,
    pub(crate) layout: SignalLayout,
    plan: Plan,
    pub(crate) extent: Extent,
}

/// Everything about one signal.
#[derive(Debug, Clone, Default)]
pub(crate) struct Series {
    /// Frames that should carry it by their identifier.
    pub(crate) frames: u64,
    pub(crate) short: u64,
    pub(crate) not_available: u64,
    pub(crate) not_finite: u64,
    /// Values that the DBC's own range refuses.
    pub(crate) out_of_range: u64,
    /// Values outside the plausible ones.
    pub(crate) implausible: u64,
    band: (f64, f64),
    pub(crate) extent: Extent,
    pub(crate) values: Thinned,
    /// Time between two readings, s.
    pub(crate) gaps: Thinned,
    pub(crate) longest_gap_s: f64,
    /// Gaps above the age from which a reading is stale.
    pub(crate) stale_gaps: u64,
    /// Absolute changes from one value to the next.
    pub(crate) changes: Thinned,
    /// Changes no temperature can make.
    pub(crate) jumps: u64,
    pub(crate) alternatives: Vec<Alternative>,
    last_time: Option<Timestamp>,
}

impl Series {
    /// `band`: what is plausible, both ends 0 = anything.
    pub(crate) fn new(layout: &SignalLayout, band: (f64, f64)) -> Self {
        Self { alternatives: alternatives(layout), band, ..Self::default() }
    }

    /// Takes a frame that may carry the signal; the value when it does.
    pub(crate) fn handle(&mut self, time: Timestamp, payload: &[u8], binding: &Binding, max_age_s: f64) -> Option<f64> {
        self.frames += 1;
        match binding.holds(payload) {
            Ok(true) => {}
            Ok(false) => return None,
            Err(_) => {
                self.short += 1;
                return None;
            }
        }
        let value = self.value(payload, binding)?;
        let gap_s = self.note_gap(time, max_age_s);
        if self.extent.count > 0 {
            let change = (value - self.extent.last).abs();
            self.changes.push(change);
            self.jumps += u64::from(change > JUMP && gap_s.is_some_and(|gap_s| gap_s <= JUMP_S));
        }
        let is_open = self.band == (0.0, 0.0);
        self.implausible += u64::from(!is_open && !(self.band.0..=self.band.1).contains(&value));
        self.extent.push(value);
        self.values.push(value);
        for other in &mut self.alternatives {
            if let Ok(physical) = other.plan.physical(payload) {
                other.extent.push(physical * binding.scale + binding.offset);
            }
        }
        Some(value)
    }

    fn value(&mut self, payload: &[u8], binding: &Binding) -> Option<f64> {
        let raw = binding.plan.raw(payload);
        if raw.is_ok_and(|raw| binding.not_available.contains(&raw)) {
            self.not_available += 1;
            return None;
        }
        match binding.plan.physical(payload) {
            Ok(physical) => {
                let is_refused = binding.plan.decode(payload).is_err();
                self.out_of_range += u64::from(is_refused);
                // The customary "nothing to say", though no value table says so.
                if is_refused && raw.is_ok_and(|raw| raw == binding.plan.all_ones()) {
                    self.not_available += 1;
                    return None;
                }
                Some(physical * binding.scale + binding.offset)
            }
            Err(Fault::NotFinite) => {
                self.not_finite += 1;
                None
            }
            Err(_) => {
                self.short += 1;
                None
            }
        }
    }

    fn note_gap(&mut self, time: Timestamp, max_age_s: f64) -> Option<f64> {
        let gap_s = self.last_time.map(|last| time.since(last).max(0.0));
        if let Some(gap_s) = gap_s {
            self.gaps.push(gap_s);
            self.longest_gap_s = self.longest_gap_s.max(gap_s);
            self.stale_gaps += u64::from(gap_s > max_age_s);
        }
        self.last_time = Some(time);
        gap_s
    }

    /// Nobody listened: the next gap says nothing.
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

    /// White part of the noise, from one reading to the next: robust against steps of less than half of them.
    pub(crate) fn noise(&self) -> Option<f64> {
        /// Median of |difference of two normal variables| over their standard deviation.
        const MEDIAN_OF_DIFFERENCE: f64 = 0.6745 * std::f64::consts::SQRT_2;
        Some(self.changes.median()? / MEDIAN_OF_DIFFERENCE)
    }
}

fn alternatives(layout: &SignalLayout) -> Vec<Alternative> {
    let mut ways = Vec::new();
    let mut add = |how, layout: SignalLayout| {
        // The range written belongs to the layout written.
        let open = SignalLayout { minimum: 0.0, maximum: 0.0, ..layout };
        if let Ok(plan) = open.plan() {
            ways.push(Alternative { how, layout, plan, extent: Extent::default() });
        }
    };
    let other_order = byte_swapped(layout);
    if let Some(swapped) = other_order {
        add(LayoutVariant::ByteOrder, swapped);
    }
    let other_sign = match layout.value_type {
        ValueType::Unsigned => Some(ValueType::Signed),
        ValueType::Signed => Some(ValueType::Unsigned),
        ValueType::Float32 | ValueType::Float64 => None,
    };
    if let Some(value_type) = other_sign {
        add(LayoutVariant::Sign, SignalLayout { value_type, ..*layout });
        if let Some(swapped) = other_order {
            add(LayoutVariant::Both, SignalLayout { value_type, ..swapped });
        }
    }
    ways
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
        let mut sample = Thinned::default();
        (0..100_000).for_each(|n| sample.push(f64::from(n)));
        assert!(sample.kept.len() <= KEPT);
        for q in [0.1, 0.5, 0.9] {
            let found = sample.quantile(q).unwrap();
            assert!((found - q * 1e5).abs() < 1000.0, "{q}: {found}");
        }
        assert_eq!(Thinned::default().median(), None);
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
