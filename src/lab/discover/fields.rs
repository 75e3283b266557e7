//! Finds bit fields that behave like pack voltage, current or cell voltages. Used if no DBC is given.
//!
//! * Voltage: fields of 16 bits at every byte and of 12 bits at every half byte, in both byte orders, with common
//!   scales. The value is plausible for a pack, varies by at most 35 % and takes at least five different codes.
//! * Current: the same positions, but signed. The changes of the field correlate with the changes of a voltage, because
//!   the pack has a resistance. The scale is a guess. Each common scale gives a resistance of the pack; the scale is
//!   chosen whose resistance is closest to the typical resistance of a pack with this label (chemistry, capacity,
//!   number of cells).
//! * Cells: neighbouring fields of 8, 12 or 16 bits with similar values.
//!
//! Temperatures and SOC are not searched for, because they show no characteristic behaviour within minutes.

use std::collections::BTreeSet;

use super::capture::{Capture, MessageKey, Payloads};
use super::label::PackLabel;
use super::log_signal::{LogSignal, MessageField, SignalOrigin, longest_run};
use crate::can::CanId;
use crate::can::dbc::{Database, FrameFormat, Message, MuxCondition, Signal};
use crate::can::signal::{ByteOrder, SignalLayout, ValueType};
use crate::can::unit::Quantity;
use crate::wiring::evidence::{Series, Slope, windows};

/// Maximum number of payloads that are evaluated per message, or per page of a multiplexed message.
const MAX_PAYLOADS: usize = 1500;
const PACK_V: (f64, f64) = (100.0, 950.0);
/// Scales of a pack voltage (V per code).
const PACK_SCALES: [f64; 5] = [0.1, 0.01, 0.05, 0.25, 0.5];
/// Largest deviation of the pack's voltage from the sum of its cells, as a fraction.
const SUM_TOLERANCE: f64 = 0.02;
/// Scales of a current (A per code).
const CURRENT_SCALES: [f64; 7] = [0.1, 0.01, 0.05, 0.025, 0.25, 0.5, 1.0];
/// Fewest cells, if the label does not state their number.
const MIN_CELLS: usize = 8;
/// Largest difference between cells of a pack (V).
const MAX_SPREAD_V: f64 = 0.25;
/// Lengths of a cell voltage in bits, each with the scales to try (V per code).
const CELL_FORMS: [(u16, &[f64]); 3] = [(16, &[0.001, 0.0001, 0.002, 0.0005]), (12, &[0.001, 0.002]), (8, &[0.02])];

/// Returns the name of a message that no DBC describes. The identifier is decimal, so that the name contains only one
/// number.
pub(super) fn message_name(id: CanId) -> String {
    format!("Message{}", id.raw())
}

pub(super) fn signals(capture: &Capture, label: &PackLabel) -> Vec<LogSignal> {
    let diagnostic: BTreeSet<CanId> = capture
        .answers
        .iter()
        .flat_map(|(key, answers)| [Some(key.response), answers.request.map(|request| request.0)])
        .flatten()
        .collect();
    let usual = capture.messages.iter();
    let usual = usual.filter(|(key, payloads)| payloads.len() >= 20 && !diagnostic.contains(&key.1));
    let messages = usual.map(|(key, payloads)| Samples::new(*key, payloads)).filter(|samples| samples.bytes >= 2);
    let messages: Vec<Samples<'_>> = messages.collect();
    let mut found = cells(&messages, label);
    let sum_v: f64 = found.iter().map(|cell| cell.series.extent.mean()).sum();
    let of_cells: BTreeSet<MessageKey> = found.iter().filter_map(LogSignal::message).collect();
    let others = messages.iter().filter(|samples| !of_cells.contains(&samples.key));
    let mut voltages: Vec<LogSignal> = others.flat_map(|samples| voltages_of(samples, label, sum_v)).collect();
    voltages.sort_by(|a, b| swing(&a.series).total_cmp(&swing(&b.series)).then_with(|| a.name.cmp(&b.name)));
    let is_sum = |voltage: &LogSignal| (voltage.series.extent.mean() / sum_v - 1.0).abs() <= SUM_TOLERANCE;
    if voltages.iter().any(is_sum) {
        voltages.retain(is_sum);
    }
    voltages.truncate(16);
    let compared: Vec<&LogSignal> = voltages.iter().chain(found.first()).collect();
    let others = messages.iter().filter(|samples| !of_cells.contains(&samples.key));
    let currents = currents(others, &compared, label);
    found.extend(currents);
    found.extend(voltages);
    found
}

struct Samples<'a> {
    key: MessageKey,
    /// Length of the shortest payload, at most 8 bytes.
    bytes: usize,
    /// Values of the first byte if it numbers pages; otherwise a single `None`.
    pages: Vec<Option<u8>>,
    payloads: Vec<(f64, &'a [u8])>,
}

impl<'a> Samples<'a> {
    fn new(key: MessageKey, payloads: &'a Payloads) -> Self {
        let bytes = payloads.iter().map(|(_, data)| data.len()).min().unwrap_or(0).min(8);
        let pages = pages(payloads);
        let payloads = if pages.len() > 1 {
            // The first payloads are taken, because taking every n-th payload might drop whole pages.
            payloads.iter().take(MAX_PAYLOADS * pages.len()).collect()
        } else {
            // Short runs of successive payloads are taken. Over longer times, not only the current but also the
            // changing SOC would change the voltage.
            windows(payloads.iter().collect(), MAX_PAYLOADS, 8.0)
        };
        Self { key, bytes, pages, payloads }
    }

    fn values(&self, layout: &SignalLayout, page: Option<u8>) -> Series {
        let Ok(plan) = layout.plan() else { return Series::default() };
        let of_page = self.payloads.iter().filter(|(_, data)| page.is_none() || data.first().copied() == page);
        Series::of(of_page.map(|(time_s, data)| (*time_s, plan.decode(data))))
    }
}

fn swing(series: &Series) -> f64 {
    series.extent.range() / series.extent.max
}

/// Returns the layouts of 16 bits at every byte and of 12 bits at every half byte, in both byte orders.
fn layouts(bytes: usize, signed: bool) -> Vec<SignalLayout> {
    let last = u16::try_from(8 * bytes).unwrap_or(0);
    let mut found = Vec::new();
    for (bits, step) in [(16, 8), (12, 4)] {
        for first in (0..last).step_by(step) {
            let value_type = if signed { ValueType::Signed } else { ValueType::Unsigned };
            if first + bits <= last {
                found.push(layout(first, bits, ByteOrder::LittleEndian, value_type, 1.0));
                found.push(layout(first, bits, ByteOrder::BigEndian, value_type, 1.0));
            }
        }
    }
    found
}

/// Returns the layout of a field whose first bit is `first`. Bytes are counted as transmitted. Bits in a byte are
/// counted from the lowest bit (little-endian) or from the highest bit (big-endian).
fn layout(first: u16, bits: u16, byte_order: ByteOrder, value_type: ValueType, factor: f64) -> SignalLayout {
    let start_bit = match byte_order {
        ByteOrder::LittleEndian => first,
        ByteOrder::BigEndian => first - first % 8 + (7 - first % 8),
    };
    SignalLayout {
        start_bit,
        length_bits: bits,
        byte_order,
        value_type,
        factor,
        offset: 0.0,
        minimum: 0.0,
        maximum: 0.0,
    }
}

fn signal(
    key: MessageKey,
    page: Option<u8>,
    name: String,
    quantity: Quantity,
    layout: SignalLayout,
    series: Series,
) -> LogSignal {
    let full_name = format!("{}.{name}", message_name(key.1));
    let signal = Signal {
        name,
        layout,
        unit: if quantity == Quantity::Current { "A" } else { "V" }.to_owned(),
        receivers: Vec::new(),
        conditions: Vec::new(),
        is_multiplexor: false,
        values: Vec::new(),
        comment: None,
    };
    let origin = SignalOrigin::Field(Box::new(MessageField { id: key.1, page, signal }));
    LogSignal::unnamed(full_name, key.0, origin, quantity, series)
}

fn place(layout: &SignalLayout) -> String {
    let order = if layout.byte_order == ByteOrder::LittleEndian { "little" } else { "big" };
    format!("{}bits_at_{}_{order}", layout.length_bits, layout.start_bit)
}

/// Finds the fields that may be the pack's voltage. `sum_v` is the sum of the found cell voltages (V); 0 = no cells.
fn voltages_of(samples: &Samples<'_>, label: &PackLabel, sum_v: f64) -> Vec<LogSignal> {
    let mut found = Vec::new();
    let (low_v, high_v) = label.pack_v().unwrap_or(PACK_V);
    for layout in layouts(samples.bytes, false) {
        let codes = samples.values(&layout, None);
        // The voltage of a pack varies by at most 35 % of its maximum within a log.
        let is_alive = codes.bad() == 0 && codes.distinct() >= 5 && swing(&codes) <= 0.35;
        if !is_alive || codes.is_counter() {
            continue;
        }
        for factor in PACK_SCALES {
            let is_within = codes.extent.min * factor >= low_v && codes.extent.max * factor <= high_v;
            if is_within || (codes.extent.mean() * factor / sum_v - 1.0).abs() <= SUM_TOLERANCE {
                let layout = SignalLayout { factor, ..layout };
                let series = samples.values(&layout, None);
                found.push(signal(
                    samples.key,
                    None,
                    format!("Voltage_{}", place(&layout)),
                    Quantity::Voltage,
                    layout,
                    series,
                ));
            }
        }
    }
    found
}

/// Finds the fields whose changes correlate best with the changes of a pack voltage or cell voltage.
fn currents<'a>(
    messages: impl Iterator<Item = &'a Samples<'a>>,
    voltages: &[&LogSignal],
    label: &PackLabel,
) -> Vec<LogSignal> {
    let mut found: Vec<(f64, LogSignal)> = Vec::new();
    for samples in messages {
        let all = layouts(samples.bytes, true).into_iter().chain(layouts(samples.bytes, false));
        let read = all.map(|layout| (layout, samples.values(&layout, None)));
        let read: Vec<_> = read.filter(|(_, codes)| !codes.is_constant() && !codes.is_counter()).collect();
        // Exclude fields that repeat a voltage, such as the lowest and the highest cell voltage.
        let repeats = |codes: &Series| voltages.iter().any(|voltage| is_reading_of(codes, &voltage.series));
        let taken: Vec<SignalLayout> =
            read.iter().filter(|(_, codes)| repeats(codes)).map(|(layout, _)| *layout).collect();
        for (layout, codes) in read {
            // If the highest bit is never set, the unsigned field equals the signed field.
            let is_same =
                layout.value_type == ValueType::Unsigned && codes.extent.max < f64::from(layout.length_bits - 1).exp2();
            if is_same || taken.iter().any(|taken| taken.overlaps(&layout)) {
                continue;
            }
            let Some(zero) = codes.zero_code(1.0) else { continue };
            let others = voltages.iter().filter(|voltage| !shares_bits(voltage, samples.key.1, &layout));
            let related = others
                .filter_map(|voltage| Some((Slope::between(&voltage.series, &codes)?, voltage.series.extent.mean())));
            let best = related
                // The limits are high, because thousands of fields are compared.
                .filter(|(slope, _)| slope.correlation().abs() >= 0.6 && slope.strength() >= 7.0)
                .max_by(|a, b| a.0.correlation().abs().total_cmp(&b.0.correlation().abs()));
            let Some((slope, mean_v)) = best else { continue };
            let distance = |factor: &f64| {
                let unusual = (slope.ohm.abs() / factor / mean_v / label.ohm_per_v()).ln().abs();
                // The first scale is preferred because it is the most common.
                if *factor == CURRENT_SCALES[0] { unusual - 0.25 } else { unusual }
            };
            let factor = CURRENT_SCALES.iter().copied().min_by(|a, b| distance(a).total_cmp(&distance(b)));
            let factor = factor.unwrap_or(1.0);
            let layout = SignalLayout { factor, offset: -zero * factor, ..layout };
            let series = samples.values(&layout, None);
            let name = format!("Current_{}", place(&layout));
            found.push((slope.correlation().abs(), signal(samples.key, None, name, Quantity::Current, layout, series)));
        }
    }
    found.sort_by(|a, b| b.0.total_cmp(&a.0).then_with(|| a.1.name.cmp(&b.1.name)));
    found.into_iter().take(12).map(|(_, signal)| signal).collect()
}

/// Whether the codes repeat the voltage: the values are equal at a common scale and change in proportion. A current
/// with an offset may have equal values, but its changes do not match.
fn is_reading_of(codes: &Series, voltage: &Series) -> bool {
    let scale = voltage.extent.mean() / codes.extent.mean();
    let common = PACK_SCALES.iter().chain(CELL_FORMS[0].1).any(|common| (scale / common - 1.0).abs() < 0.05);
    // `Slope` counts a resistance as positive, so the slope is negative if codes and voltage rise together.
    let slope = Slope::between(voltage, codes).filter(|slope| slope.correlation() >= 0.5);
    common && slope.is_some_and(|slope| (0.5..2.0).contains(&(-slope.ohm / scale)))
}

/// Whether a field overlaps a layout in the message `id`. The interface is not compared, because gateways repeat
/// messages on other interfaces.
fn shares_bits(field: &LogSignal, id: CanId, layout: &SignalLayout) -> bool {
    matches!(&field.origin, SignalOrigin::Field(own) if own.id == id && own.signal.layout.overlaps(layout))
}

impl LogSignal {
    fn message(&self) -> Option<MessageKey> {
        match &self.origin {
            SignalOrigin::Field(field) => Some((self.bus, field.id)),
            SignalOrigin::Dbc(_) | SignalOrigin::Defined(_) | SignalOrigin::Raw(..) => None,
        }
    }
}

/// Finds rows of neighbouring cells in messages and pages. All rows have the same field length, scale and byte order,
/// and their cells are numbered consecutively.
fn cells(messages: &[Samples<'_>], label: &PackLabel) -> Vec<LogSignal> {
    let mut best: Vec<LogSignal> = Vec::new();
    let wanted = label.cells.map(usize::from);
    let least = wanted.unwrap_or(MIN_CELLS).clamp(3, MIN_CELLS);
    // A row with the label's number of cells is preferred to a longer row.
    let weight = |found: &Vec<LogSignal>| (Some(found.len()) == wanted, found.len());
    for (bits, scales) in CELL_FORMS {
        for factor in scales {
            for byte_order in [ByteOrder::LittleEndian, ByteOrder::BigEndian] {
                let found = cells_of_form(messages, label.cell_v(), bits, *factor, byte_order);
                if found.len() >= least && weight(&found) > weight(&best) {
                    best = found;
                }
            }
        }
    }
    best
}

fn cells_of_form(
    messages: &[Samples<'_>],
    cell_v: (f64, f64),
    bits: u16,
    factor: f64,
    byte_order: ByteOrder,
) -> Vec<LogSignal> {
    let mut found: Vec<LogSignal> = Vec::new();
    for samples in messages {
        let end = u16::try_from(8 * samples.bytes).unwrap_or(0);
        for page in &samples.pages {
            // Skip the page byte and, in some rows, a byte of flags after it.
            let first = if page.is_some() { 8 } else { 0 };
            let starts = (first..first + 16).step_by(if bits == 12 { 4 } else { 8 });
            let rows = starts.map(|start| {
                let places = (start..end).step_by(usize::from(bits)).filter(|place| place + bits <= end);
                let layouts = places.map(|place| layout(place, bits, byte_order, ValueType::Unsigned, factor));
                row(samples, *page, cell_v, layouts)
            });
            let longest = rows.rev().max_by_key(Vec::len).filter(|row| row.len() >= 3);
            let Some(row) = longest.filter(|row| continues(&found, samples.key, row)) else { continue };
            for (layout, series) in row {
                let name = format!("Cell{}", found.len() + 1);
                found.push(signal(samples.key, *page, name, Quantity::Voltage, layout, series));
            }
        }
    }
    found
}

fn continues(cells: &[LogSignal], key: MessageKey, row: &[(SignalLayout, Series)]) -> bool {
    cells.first().is_none_or(|first| {
        first.bus == key.0 && (first.series.extent.mean() - row[0].1.extent.mean()).abs() <= MAX_SPREAD_V
    })
}

/// Returns the values of the first byte if they number pages: 2 to 64 consecutive numbers that repeat. Otherwise,
/// returns a single `None`.
fn pages(payloads: &Payloads) -> Vec<Option<u8>> {
    let values: BTreeSet<u8> = payloads.iter().filter_map(|(_, data)| data.first().copied()).collect();
    let span = values.first().zip(values.last()).map_or(0, |(first, last)| usize::from(last - first) + 1);
    let is_counter = (2..=64).contains(&values.len()) && span == values.len() && payloads.len() >= 3 * span;
    // A page number changes from payload to payload. The high byte of a big-endian voltage seldom changes.
    let firsts: Vec<Option<&u8>> = payloads.iter().map(|(_, data)| data.first()).collect();
    let changes = firsts.windows(2).filter(|pair| pair[0] != pair[1]).count();
    let is_cycling = 2 * changes >= payloads.len();
    if is_counter && is_cycling { values.into_iter().map(Some).collect() } else { vec![None] }
}

/// Returns the longest run of plausible neighbouring fields with similar values.
fn row(
    samples: &Samples<'_>,
    page: Option<u8>,
    (low_v, high_v): (f64, f64),
    layouts: impl Iterator<Item = SignalLayout>,
) -> Vec<(SignalLayout, Series)> {
    let neighbours = layouts.map(|layout| {
        let series = samples.values(&layout, page);
        let is_cell = series.extent.min >= low_v && series.extent.max <= high_v && series.bad() == 0;
        is_cell.then_some((layout, series))
    });
    let row = longest_run(neighbours, |(_, first), (_, next)| {
        (next.extent.mean() - first.extent.mean()).abs() <= MAX_SPREAD_V
    });
    // Bytes that never change are probably text or constants.
    let is_alive = row.iter().any(|(_, series)| !series.is_constant());
    if is_alive { row } else { Vec::new() }
}

/// Creates a DBC of these fields. Pages become values of a multiplexor.
pub(super) fn database(fields: &[&MessageField]) -> Database {
    let mut messages: Vec<Message> = Vec::new();
    for field in fields {
        let place = messages.iter().position(|message| message.id == field.id);
        let place = place.unwrap_or_else(|| {
            messages.push(empty_message(field));
            messages.len() - 1
        });
        let mut signal = field.signal.clone();
        let condition = |page: u8| MuxCondition { selector: 0, ranges: vec![(page.into(), page.into())] };
        signal.conditions = field.page.map(condition).into_iter().collect();
        messages[place].signals.push(signal);
    }
    let comment = "Found by packwatch discover from values alone: positions and scales are guesses".to_owned();
    Database { comment: Some(comment), messages, ..Database::default() }
}

fn empty_message(field: &MessageField) -> Message {
    let layout = layout(0, 8, ByteOrder::LittleEndian, ValueType::Unsigned, 1.0);
    let page =
        Signal { name: "Page".to_owned(), layout, unit: String::new(), is_multiplexor: true, ..field.signal.clone() };
    Message {
        id: field.id,
        name: message_name(field.id),
        len_bytes: 8,
        sender: None,
        format: FrameFormat::Classic,
        is_j1939: false,
        e2e: None,
        secoc: None,
        signals: field.page.map(|_| page).into_iter().collect(),
        cycle_time_ms: None,
        repetition: Default::default(),
        comment: None,
    }
}
