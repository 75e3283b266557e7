//! Decodes frames with prepared tables: bindings by message and multiplexer page, with shift, factor and limits of each
//! signal.
//!
//! In: frames. Out: readings. For each signal, a range of raw codes with valid values is computed in advance: the good
//! codes. The signal's [`Binding`] decodes all other codes. The binding also decodes signals without good codes:
//! floats, signals of 64 bits or spanning nine bytes, signals whose scale is 0 or not finite, and the direction of the
//! current. A page consists of the signals that are present with one code of the selector. A group consists of
//! consecutive bindings with the same multiplexer conditions. If the selector has too many codes for a table of pages,
//! the first binding of each group decodes the selector.

use std::hint::cold_path;
use std::ops::Range;
use std::sync::Arc;

use super::{Binding, Channel, MuxTest, Reading};
use crate::can::id_table::IdTable;
use crate::can::signal::{ByteOrder, SignalPlan, ValueType, float_of_signed};
use crate::can::{CanId, Frame};
use crate::quantity::{BusIndex, Fault};

/// Maximum number of selector codes with a page of their own: ten bits. Selectors usually have 4 to 8 bits.
const MAX_CODES: u64 = 1024;
/// Maximum number of entries in a page table. Limits the memory if many signals have wide ranges of codes.
const MAX_GROUPS: usize = 1 << 16;

#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct MessageTable {
    indices: IdTable,
    messages: Vec<MessageGroups>,
}

#[derive(Debug, Clone, PartialEq)]
struct MessageGroups {
    bus: BusIndex,
    id: CanId,
    all: Vec<SignalGroup>,
    pages: Option<PageTable>,
}

/// Consecutive bindings with the same multiplexer conditions.
#[derive(Debug, Clone, PartialEq)]
struct SignalGroup {
    /// The prepared bindings. Pages share the list.
    signals: Arc<[LinearSignal]>,
    /// Index among all bindings.
    first: usize,
    /// A payload of at least this length (bytes) carries all signals. [`NEVER`] = the first binding decides whether the
    /// group is present.
    bytes_needed: usize,
}

const NEVER: usize = usize::MAX;

/// The groups that may be present for each code of the selector.
#[derive(Debug, Clone, PartialEq)]
struct PageTable {
    selector: BitPosition,
    /// A payload of at least this length (bytes) carries every selector. For a shorter payload, the first binding of
    /// each group decides whether the group is present.
    bytes_needed: usize,
    /// Range in `groups` for each code. The last entry is for all larger codes.
    codes: Vec<Range<usize>>,
    groups: Vec<SignalGroup>,
}

/// Number of words in [`PayloadWords::words`]. A word index of at least [`FAR`] marks a signal outside these words.
const FAR: u8 = 2;

#[derive(Debug, Clone, Copy, PartialEq)]
struct BitPosition {
    /// Index in [`PayloadWords::words`]. For a signal outside these words: [`FAR`] (little-endian) or `FAR + 1`.
    word: u8,
    /// First byte of the eight-byte window with the signal.
    window: u8,
    up: u8,
    down: u8,
}

impl BitPosition {
    fn new(plan: &SignalPlan) -> Self {
        let order = u8::from(plan.byte_order == ByteOrder::BigEndian);
        let word = if plan.window == 0 { order } else { FAR + order };
        Self { word, window: plan.window, up: plan.up, down: plan.down }
    }
}

/// Converts the good codes of one signal. The struct has 64 bytes, one cache line.
#[derive(Debug, Clone, Copy, PartialEq)]
struct LinearSignal {
    channel: Channel,
    position: BitPosition,
    /// Sign bit; 0 for an unsigned signal. `(code ^ sign) - sign` extends the sign.
    sign: u64,
    /// First good code, with its sign bit flipped. `more_good` is the number of good codes after it.
    first_good: u64,
    more_good: u64,
    factor: f64,
    offset: f64,
    scale: f64,
    shift: f64,
}

struct PayloadWords<'a> {
    frame: &'a Frame,
    /// The first eight bytes, padded with zeros, as a little-endian and a big-endian word.
    words: [u64; FAR as usize],
}

impl<'a> PayloadWords<'a> {
    #[inline(always)]
    fn new(frame: &'a Frame) -> Self {
        let word = frame.padded_data().first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes));
        Self { frame, words: [word, word.swap_bytes()] }
    }

    #[inline(always)]
    fn has(&self, bytes: usize) -> bool {
        self.frame.len() >= bytes
    }

    /// The bits at a position, shifted to bit 0.
    #[inline(always)]
    fn bits(&self, position: &BitPosition) -> u64 {
        let word = match self.words.get(usize::from(position.word)) {
            Some(word) => *word,
            None => {
                cold_path();
                self.far_word(position)
            }
        };
        word << (position.up & 63) >> (position.down & 63)
    }

    #[inline(always)]
    fn far_word(&self, position: &BitPosition) -> u64 {
        let from = usize::from(position.window);
        let bytes = self.frame.padded_data().get(from..).and_then(|rest| rest.first_chunk());
        let word = bytes.map_or(0, |bytes| u64::from_le_bytes(*bytes));
        if position.word == FAR { word } else { word.swap_bytes() }
    }
}

impl MessageTable {
    pub(super) fn new(bindings: &[Binding]) -> Self {
        let mut messages = Vec::new();
        let mut end = 0;
        for message in bindings.chunk_by(|a, b| (a.bus, a.id) == (b.bus, b.id)) {
            let runs = message.chunk_by(|a, b| a.mux == b.mux).map(|run| {
                end += run.len();
                end - run.len()..end
            });
            let runs: Vec<_> = runs.collect();
            messages.push(MessageGroups::new(bindings, &runs));
        }
        Self { indices: IdTable::new(messages.iter().map(|message| (message.bus, message.id))), messages }
    }

    pub(super) fn messages(&self) -> impl Iterator<Item = (BusIndex, CanId, usize)> + '_ {
        self.messages.iter().map(|message| (message.bus, message.id, message.all.len()))
    }

    #[inline]
    pub(super) fn decode(&self, bindings: &[Binding], bus: BusIndex, frame: &Frame, mut each: impl FnMut(Reading)) {
        let Some(message) = self.messages.get(self.indices.number(bus, frame.id())) else { return };
        let words = PayloadWords::new(frame);
        for group in message.groups(&words) {
            if !words.has(group.bytes_needed) {
                cold_path();
                decode_one_by_one(&bindings[group.first..][..group.signals.len()], frame.data(), &mut each);
                continue;
            }
            for (n, plan) in group.signals.iter().enumerate() {
                // Separate calls for good and bad values keep a good value in a register.
                match plan.good(&words) {
                    Some(value) => each(Reading { channel: plan.channel, value: Ok(value) }),
                    None => {
                        cold_path();
                        let value = value_of(&bindings[group.first + n], frame.data());
                        each(Reading { channel: plan.channel, value });
                    }
                }
            }
        }
    }
}

#[cold]
#[inline(never)]
fn value_of(binding: &Binding, payload: &[u8]) -> Result<f64, Fault> {
    binding.value(payload)
}

/// Decodes a group if it is present. If a selector is missing, every binding gives a fault.
fn decode_one_by_one(bindings: &[Binding], payload: &[u8], each: &mut impl FnMut(Reading)) {
    let present = bindings.first().map_or(Ok(false), |first| first.holds(payload));
    if present == Ok(false) {
        return;
    }
    for binding in bindings {
        let value = present.and_then(|_| value_of(binding, payload));
        each(Reading { channel: binding.channel, value });
    }
}

impl SignalGroup {
    /// Creates a group that is always present.
    fn new(bindings: &[Binding], run: &Range<usize>) -> Self {
        let bindings = &bindings[run.clone()];
        let bytes_needed = bindings.iter().map(|binding| binding.plan.bytes_needed()).max().unwrap_or(0);
        Self { signals: bindings.iter().map(LinearSignal::new).collect(), first: run.start, bytes_needed }
    }

    fn with_presence_check(&self) -> Self {
        Self { bytes_needed: NEVER, ..self.clone() }
    }
}

impl MessageGroups {
    fn new(bindings: &[Binding], runs: &[Range<usize>]) -> Self {
        let groups: Vec<_> = runs.iter().map(|run| SignalGroup::new(bindings, run)).collect();
        let pages = PageTable::new(bindings, runs, &groups);
        let tests = |run: &Range<usize>| bindings[run.start].mux.len();
        let all = groups
            .into_iter()
            .zip(runs)
            .map(|(group, run)| if tests(run) > 0 { group.with_presence_check() } else { group });
        let first = &bindings[runs[0].start];
        Self { bus: first.bus, id: first.id, all: all.collect(), pages }
    }

    #[inline]
    fn groups(&self, words: &PayloadWords<'_>) -> &[SignalGroup] {
        match &self.pages {
            Some(pages) if words.has(pages.bytes_needed) => pages.of(words),
            _ => &self.all,
        }
    }
}

impl PageTable {
    /// Creates the table for the selector on which most groups depend. `runs` are the binding ranges of the groups in
    /// `all`. `None` = there is no selector, the selector is not a simple integer, or the table would be too large.
    fn new(bindings: &[Binding], runs: &[Range<usize>], all: &[SignalGroup]) -> Option<Self> {
        let tests = |run: &Range<usize>| bindings[run.start].mux.as_slice();
        let dependents = |plan: SignalPlan| runs.iter().flat_map(tests).filter(|test| test.plan == plan).count();
        let selector = runs.iter().flat_map(tests).map(|test| test.plan).max_by_key(|plan| dependents(*plan))?;
        let highest = runs.iter().flat_map(tests).filter(|test| test.plan == selector).flat_map(|test| &test.ranges);
        let codes = highest.map(|(_, high)| high.saturating_add(1)).max()?;
        if codes > MAX_CODES || !selector.is_simple() {
            return None;
        }
        let mut pages = Self {
            selector: BitPosition::new(&selector),
            bytes_needed: runs.iter().flat_map(tests).map(|test| test.plan.bytes_needed()).max()?,
            codes: Vec::new(),
            groups: Vec::new(),
        };
        // The last entry is for all larger codes, which no range contains.
        for code in 0..=codes {
            let start = pages.groups.len();
            for (run, group) in runs.iter().zip(all) {
                if !may_hold(selector, tests(run), code) {
                    continue;
                }
                let check = tests(run).iter().any(|test| test.plan != selector);
                pages.groups.push(if check { group.with_presence_check() } else { group.clone() });
            }
            pages.codes.push(start..pages.groups.len());
            if pages.groups.len() > MAX_GROUPS {
                return None;
            }
        }
        Some(pages)
    }

    #[inline]
    fn of(&self, words: &PayloadWords<'_>) -> &[SignalGroup] {
        let code = usize::try_from(words.bits(&self.selector)).unwrap_or(usize::MAX);
        // The table has at least the entry for all larger codes.
        let groups = &self.codes[code.min(self.codes.len() - 1)];
        &self.groups[groups.clone()]
    }
}

/// Whether the selector's code allows a group with these conditions.
fn may_hold(selector: SignalPlan, tests: &[MuxTest], code: u64) -> bool {
    tests.iter().filter(|test| test.plan == selector).all(|test| test.allows(code))
}

impl LinearSignal {
    fn new(binding: &Binding) -> Self {
        let Binding { channel, scale, offset: shift, .. } = *binding;
        let never_good = Self {
            channel,
            // Any position works, because no code is good.
            position: BitPosition { word: 0, window: 0, up: 0, down: 63 },
            sign: 0,
            first_good: u64::MAX,
            more_good: 0,
            factor: 0.0,
            offset: 0.0,
            scale,
            shift,
        };
        let is_regular = scale.is_finite() && scale != 0.0 && shift.is_finite();
        let plan = &binding.plan;
        let limits = [plan.low, plan.high, binding.range.0, binding.range.1];
        if !is_regular || !binding.charge.is_empty() || !plan.is_simple() || limits.iter().any(|limit| limit.is_nan()) {
            return never_good;
        }
        let sign = if plan.value_type() == ValueType::Signed { 1 << (63 - plan.down) } else { 0 };
        let good = good_codes(binding).and_then(|good| available_codes(binding, sign, good));
        let Some((first, last)) = good else { return never_good };
        Self {
            position: BitPosition::new(plan),
            sign,
            first_good: first.cast_unsigned().wrapping_add(sign),
            more_good: first.abs_diff(last),
            factor: plan.factor,
            offset: plan.offset,
            ..never_good
        }
    }

    /// The value in the program's unit and sign; `None` = not a good code. The payload must carry the signal.
    #[inline(always)]
    fn good(&self, words: &PayloadWords<'_>) -> Option<f64> {
        let flipped = words.bits(&self.position) ^ self.sign;
        let code = flipped.wrapping_sub(self.sign).cast_signed();
        let is_good = flipped.wrapping_sub(self.first_good) <= self.more_good;
        is_good.then(|| (float_of_signed(code) * self.factor + self.offset) * self.scale + self.shift)
    }
}

/// The longest run of good codes without a "not available" code. Usually this is the whole range, because "not
/// available" codes are mostly at its ends.
fn available_codes(binding: &Binding, sign: u64, (first, last): (i64, i64)) -> Option<(i64, i64)> {
    let possible = binding.not_available.iter().filter(|code| **code <= binding.plan.all_ones());
    let signed = possible.map(|code| (code ^ sign).wrapping_sub(sign).cast_signed());
    let mut missing: Vec<i64> = signed.filter(|code| (first..=last).contains(code)).collect();
    missing.sort_unstable();
    // Codes have at most 63 bits, so code + 1 and code - 1 do not overflow.
    let begins = std::iter::once(first).chain(missing.iter().map(|code| code + 1));
    let ends = missing.iter().map(|code| code - 1).chain([last]);
    begins.zip(ends).filter(|(begin, end)| begin <= end).max_by_key(|(begin, end)| begin.abs_diff(*end))
}

/// The first and the last code with a value in both the DBC's range and the configured range. Bisection finds these
/// codes exactly, because every step from code to value is monotonic, rounding included.
fn good_codes(binding: &Binding) -> Option<(i64, i64)> {
    let plan = &binding.plan;
    let physical = |code: i64| float_of_signed(code) * plan.factor + plan.offset;
    let value = |code: i64| physical(code) * binding.scale + binding.offset;
    let (lowest, highest) = plan.codes();
    let is_rising = |of: &dyn Fn(i64) -> f64| of(lowest) <= of(highest);
    let mut good = (lowest, highest);
    type Map<'a> = &'a dyn Fn(i64) -> f64;
    let both: [(Map<'_>, f64, f64); 2] = [(&physical, plan.low, plan.high), (&value, binding.range.0, binding.range.1)];
    for (of, low, high) in both {
        // For rising values: the first code at or above the lower limit, and the first code above the upper limit.
        let (first, end) = if is_rising(of) {
            (first_where(good, |code| of(code) >= low), first_where(good, |code| of(code) > high))
        } else {
            (first_where(good, |code| of(code) <= high), first_where(good, |code| of(code) < low))
        };
        good = (first?, end.map_or(good.1, |end| end - 1));
        if good.0 > good.1 {
            return None;
        }
    }
    Some(good)
}

/// The first code that satisfies a predicate; all later codes must satisfy it, too.
fn first_where((mut low, mut high): (i64, i64), holds: impl Fn(i64) -> bool) -> Option<i64> {
    if !holds(high) {
        return None;
    }
    while low < high {
        let middle = low + (high - low) / 2;
        if holds(middle) { high = middle } else { low = middle + 1 }
    }
    Some(low)
}
