//! The bindings compiled for reading: which message, which page of it, and per signal shifts, factors and limits.
//!
//! Everything here only finds sooner, and computes with fewer branches, what [`Binding`] says; results are the same bit
//! for bit. What is rare (floats, signals of 64 bits or over nine bytes, a scale that is 0 or not finite, codes beyond one for
//! "not available" amid the good ones, a selector with too many codes for a table) goes the binding's own way.

use std::hint::cold_path;
use std::ops::Range;
use std::sync::Arc;

use super::{Binding, Channel, MuxTest, Reading};
use crate::can::Frame;
use crate::can::id_table::IdTable;
use crate::can::signal::{Shifts, SignalPlan, float_of_signed};
use crate::quantity::{BusIndex, Fault};

/// Codes a selector may have to be looked up in a table: ten bits. Selectors have 4 to 8.
const MAX_CODES: u64 = 1024;
/// Entries of all tables of one message, so that wide ranges on many signals take no memory to speak of.
const MAX_VISITS: usize = 1 << 16;

/// All messages, ready to be read.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Plans {
    numbers: IdTable,
    messages: Vec<MessagePlan>,
}

/// One message.
#[derive(Debug, Clone, PartialEq)]
struct MessagePlan {
    /// Every group of signals, in order.
    all: Vec<Visit>,
    pages: Option<Pages>,
}

/// Neighbours among the bindings that are there or not there together.
#[derive(Debug, Clone, PartialEq)]
struct Visit {
    /// Those bindings, compiled; one list however many pages have it.
    plans: Arc<[Plan]>,
    /// The first of them among all bindings.
    first: usize,
    /// Payloads of this length carry them all; [`NEVER`] where it is still to be found out whether they are there.
    bytes_needed: usize,
}

/// More than any payload has.
const NEVER: usize = usize::MAX;

/// What a selector's codes bring.
#[derive(Debug, Clone, PartialEq)]
struct Pages {
    selector: Place,
    /// A payload of this length carries every selector of the message; of shorter ones, each signal is judged for itself.
    bytes_needed: usize,
    /// Per code, and last for every code above: where its visits are.
    codes: Vec<Range<usize>>,
    visits: Vec<Visit>,
}

/// How many [`Wire::words`] there are.
const FAR: u8 = 2;

/// Where the bits of a number are.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Place {
    /// Which of [`Wire::words`]; for a signal that is in none of them, [`FAR`] more.
    word: u8,
    /// Eight bytes of the payload from here on hold the signal.
    window: u8,
    up: u8,
    down: u8,
}

impl Place {
    fn new(shifts: &Shifts) -> Self {
        let order = u8::from(shifts.is_big_endian);
        let word = if shifts.window == 0 { order } else { FAR + order };
        Self { word, window: shifts.window, up: shifts.up, down: shifts.down }
    }
}

/// One signal: what a good code becomes. Whatever is not certainly good is left to the binding. 64 bytes, the least that is
/// loaded at once.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Plan {
    channel: Channel,
    place: Place,
    /// The highest bit of a signed signal, 0 for an unsigned one: flipped and subtracted it extends the sign.
    sign: u64,
    /// Good codes, those within the DBC's and the configured range: the first, its sign flipped, and how many follow it.
    first_good: u64,
    more_good: u64,
    factor: f64,
    offset: f64,
    scale: f64,
    shift: f64,
}

/// A payload as signals are taken from it.
struct Wire<'a> {
    frame: &'a Frame,
    /// The first eight bytes, zeros where the payload ends: the first byte lowest, and highest.
    words: [u64; FAR as usize],
}

impl<'a> Wire<'a> {
    /// Of a frame with a payload.
    #[inline(always)]
    fn new(frame: &'a Frame) -> Self {
        let word = frame.padded_data().first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes));
        Self { frame, words: [word, word.swap_bytes()] }
    }

    #[inline(always)]
    fn has(&self, bytes: usize) -> bool {
        self.frame.len() >= bytes
    }

    /// The bits at a place, the lowest at the bottom.
    #[inline(always)]
    fn bits(&self, place: &Place) -> u64 {
        let word = match self.words.get(usize::from(place.word)) {
            Some(word) => *word,
            None => {
                cold_path();
                self.far_word(place)
            }
        };
        word << (place.up & 63) >> (place.down & 63)
    }

    /// A word that does not begin with the payload.
    #[inline(always)]
    fn far_word(&self, place: &Place) -> u64 {
        let from = usize::from(place.window);
        // The window of a signal lies within the longest payload.
        let bytes = self.frame.padded_data().get(from..).and_then(|rest| rest.first_chunk());
        let word = bytes.map_or(0, |bytes| u64::from_le_bytes(*bytes));
        if place.word == FAR { word } else { word.swap_bytes() }
    }
}

impl Plans {
    /// Bindings sorted by message and channel, and their runs.
    pub(super) fn new(bindings: &[Binding], runs: &[Range<usize>]) -> Self {
        let message = |run: &Range<usize>| (bindings[run.start].bus, bindings[run.start].id);
        let messages: Vec<_> = runs.chunk_by(|a, b| message(a) == message(b)).collect();
        Self {
            numbers: IdTable::new(messages.iter().map(|runs| message(&runs[0]))),
            messages: messages.iter().map(|runs| MessagePlan::new(bindings, runs)).collect(),
        }
    }

    /// See [`super::InputMap::decode`].
    #[inline]
    pub(super) fn decode(&self, bindings: &[Binding], bus: BusIndex, frame: &Frame, mut each: impl FnMut(Reading)) {
        let Some(message) = self.messages.get(self.numbers.number(bus, frame.id())) else { return };
        let wire = Wire::new(frame);
        for visit in message.visits(&wire) {
            if !wire.has(visit.bytes_needed) {
                cold_path();
                decode_plainly(&bindings[visit.first..][..visit.plans.len()], frame.data(), &mut each);
                continue;
            }
            for (n, plan) in visit.plans.iter().enumerate() {
                // Two places rather than one value made of both: the good one then stays in a register.
                match plan.good(&wire) {
                    Some(value) => each(Reading { channel: plan.channel, value: Ok(value) }),
                    None => {
                        cold_path();
                        let value = plain_value(&bindings[visit.first + n], frame.data());
                        each(Reading { channel: plan.channel, value });
                    }
                }
            }
        }
    }
}

/// Whether the payload carries bindings that are there or not there together.
#[cold]
#[inline(never)]
fn present(bindings: &[Binding], payload: &[u8]) -> Result<bool, Fault> {
    bindings.first().map_or(Ok(false), |first| first.holds(payload))
}

/// What a binding that is there says, in full.
#[cold]
#[inline(never)]
fn plain_value(binding: &Binding, payload: &[u8]) -> Result<f64, Fault> {
    binding.value(payload)
}

/// Bindings that are there or not there together, as they say.
#[inline(always)]
pub(super) fn decode_plainly(bindings: &[Binding], payload: &[u8], each: &mut impl FnMut(Reading)) {
    let present = present(bindings, payload);
    if present == Ok(false) {
        return;
    }
    for binding in bindings {
        let value = present.and_then(|_| plain_value(binding, payload));
        each(Reading { channel: binding.channel, value });
    }
}

impl Visit {
    /// Of neighbours that are certainly there.
    fn new(bindings: &[Binding], run: &Range<usize>) -> Self {
        let bindings = &bindings[run.clone()];
        let bytes_needed = bindings.iter().map(|binding| binding.plan.bytes_needed()).max().unwrap_or(0);
        Self { plans: bindings.iter().map(Plan::new).collect(), first: run.start, bytes_needed }
    }

    /// Of the same, of which it is still to be found out.
    fn to_be_checked(&self) -> Self {
        Self { bytes_needed: NEVER, ..self.clone() }
    }
}

impl MessagePlan {
    fn new(bindings: &[Binding], runs: &[Range<usize>]) -> Self {
        let visits: Vec<_> = runs.iter().map(|run| Visit::new(bindings, run)).collect();
        let pages = Pages::new(bindings, runs, &visits);
        let tests = |run: &Range<usize>| bindings[run.start].mux.len();
        let all =
            visits.into_iter().zip(runs).map(|(visit, run)| if tests(run) > 0 { visit.to_be_checked() } else { visit });
        Self { all: all.collect(), pages }
    }

    #[inline]
    fn visits(&self, wire: &Wire<'_>) -> &[Visit] {
        match &self.pages {
            Some(pages) if wire.has(pages.bytes_needed) => pages.of(wire),
            _ => &self.all,
        }
    }
}

impl Pages {
    /// By the selector most runs depend on; `None` without one, or when a table would be too large.
    fn new(bindings: &[Binding], runs: &[Range<usize>], all: &[Visit]) -> Option<Self> {
        let tests = |run: &Range<usize>| bindings[run.start].mux.as_slice();
        let dependents = |plan: SignalPlan| runs.iter().flat_map(tests).filter(|test| test.plan == plan).count();
        let selector = runs.iter().flat_map(tests).map(|test| test.plan).max_by_key(|plan| dependents(*plan))?;
        let highest = runs.iter().flat_map(tests).filter(|test| test.plan == selector).flat_map(|test| &test.ranges);
        let codes = highest.map(|(_, high)| high.saturating_add(1)).max()?;
        if codes > MAX_CODES {
            return None;
        }
        let mut pages = Self {
            selector: Place::new(&selector.shifts()?),
            bytes_needed: runs.iter().flat_map(tests).map(|test| test.plan.bytes_needed()).max()?,
            codes: Vec::new(),
            visits: Vec::new(),
        };
        // The last code stands for every one above: no range reaches it.
        for code in 0..=codes {
            let start = pages.visits.len();
            for (run, visit) in runs.iter().zip(all) {
                if !may_hold(selector, tests(run), code) {
                    continue;
                }
                let check = tests(run).iter().any(|test| test.plan != selector);
                pages.visits.push(if check { visit.to_be_checked() } else { visit.clone() });
            }
            pages.codes.push(start..pages.visits.len());
            if pages.visits.len() > MAX_VISITS {
                return None;
            }
        }
        Some(pages)
    }

    #[inline]
    fn of(&self, wire: &Wire<'_>) -> &[Visit] {
        let code = usize::try_from(wire.bits(&self.selector)).unwrap_or(usize::MAX);
        // There is one code at least: the one that stands for every one above.
        let visits = &self.codes[code.min(self.codes.len() - 1)];
        &self.visits[visits.clone()]
    }
}

/// Whether the selector's code leaves room for the run to be there.
fn may_hold(selector: SignalPlan, tests: &[MuxTest], code: u64) -> bool {
    tests.iter().filter(|test| test.plan == selector).all(|test| test.allows(code))
}

impl Plan {
    fn new(binding: &Binding) -> Self {
        let Binding { channel, scale, offset: shift, .. } = *binding;
        let nothing = Self {
            channel,
            // One bit, and no code is good.
            place: Place { word: 0, window: 0, up: 0, down: 63 },
            sign: 0,
            first_good: u64::MAX,
            more_good: 0,
            factor: 0.0,
            offset: 0.0,
            scale,
            shift,
        };
        let is_usual = scale.is_finite() && scale != 0.0 && shift.is_finite();
        let Some(shifts) = binding.plan.shifts().filter(|_| is_usual) else { return nothing };
        let limits = [shifts.low, shifts.high, binding.range.0, binding.range.1];
        if limits.iter().any(|limit| limit.is_nan()) {
            return nothing;
        }
        let sign = if shifts.is_signed { 1 << (63 - shifts.down) } else { 0 };
        let good = good_codes(binding, &shifts).and_then(|good| available_codes(binding, sign, good));
        let Some((first, last)) = good else { return nothing };
        Self {
            place: Place::new(&shifts),
            sign,
            first_good: first.cast_unsigned().wrapping_add(sign),
            more_good: first.abs_diff(last),
            factor: shifts.factor,
            offset: shifts.offset,
            ..nothing
        }
    }

    /// The value in the program's unit and sign, if it is good; the payload carries the signal.
    #[inline(always)]
    fn good(&self, wire: &Wire<'_>) -> Option<f64> {
        let flipped = wire.bits(&self.place) ^ self.sign;
        let code = flipped.wrapping_sub(self.sign).cast_signed();
        let is_good = flipped.wrapping_sub(self.first_good) <= self.more_good;
        is_good.then(|| (float_of_signed(code) * self.factor + self.offset) * self.scale + self.shift)
    }
}

/// Of the good codes the longest run without one that means "not available": those are at the ends almost always, and what
/// lies beyond one in the midst goes the binding's own way.
fn available_codes(binding: &Binding, sign: u64, (first, last): (i64, i64)) -> Option<(i64, i64)> {
    let possible = binding.not_available.iter().filter(|code| **code <= binding.plan.all_ones());
    let signed = possible.map(|code| (code ^ sign).wrapping_sub(sign).cast_signed());
    let mut missing: Vec<i64> = signed.filter(|code| (first..=last).contains(code)).collect();
    missing.sort_unstable();
    // At most 63 bits: there is a number before the first and after the last.
    let begins = std::iter::once(first).chain(missing.iter().map(|code| code + 1));
    let ends = missing.iter().map(|code| code - 1).chain([last]);
    begins.zip(ends).filter(|(begin, end)| begin <= end).max_by_key(|(begin, end)| begin.abs_diff(*end))
}

/// The first and the last code whose value is within both ranges. Every step from the code to the value keeps the order
/// (or turns it round), rounding included, so that the good codes are neighbours and halving finds their ends exactly.
fn good_codes(binding: &Binding, shifts: &Shifts) -> Option<(i64, i64)> {
    let physical = |code: i64| float_of_signed(code) * shifts.factor + shifts.offset;
    let value = |code: i64| physical(code) * binding.scale + binding.offset;
    let (lowest, highest) = shifts.codes();
    let is_rising = |of: &dyn Fn(i64) -> f64| of(lowest) <= of(highest);
    let mut good = (lowest, highest);
    type Map<'a> = &'a dyn Fn(i64) -> f64;
    let both: [(Map<'_>, f64, f64); 2] =
        [(&physical, shifts.low, shifts.high), (&value, binding.range.0, binding.range.1)];
    for (of, low, high) in both {
        // Along rising values: not below the lower limit any more, and above the upper one.
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

/// The first of neighbouring codes for which something holds that holds for all after it.
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
