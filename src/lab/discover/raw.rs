//! Searches diagnostic answers for cell voltages, pack voltage, current and temperatures, in the bytes that no
//! definition describes.
//!
//! A row of cell voltages is a run of at least [`MIN_CELLS`] neighbouring values of 8 or 16 bits. If they are read with
//! the same byte order and scale, all of them are plausible and similar voltages. Other fields are tried at every byte
//! with usual scales; [`judge`](super::judge) decides which quantity they carry.

use std::collections::BTreeMap;

use super::capture::{AnswerKey, Answers};
use super::label::PackLabel;
use super::log_signal::{LogSignal, SignalOrigin, longest_run};
use crate::can::CanId;
use crate::can::unit::Quantity;
use crate::import::{DiagnosticSignal, NumberRange};
use crate::quantity::{BusIndex, Fault};
use crate::wiring::evidence::Series;

pub(super) const CELL: &str = "Cell";
const MIN_CELLS: usize = 8;
/// Plausible voltages of a cell in use (V), if the label does not state the chemistry.
const CELL_V: (f64, f64) = (2.0, 4.5);
/// Lengths of a cell voltage in bits, each with the scales to try (V per code).
const CELL_SCALES: [(u32, &[f64]); 2] = [(16, &[0.001, 0.0001, 0.002, 0.005, 0.01]), (8, &[0.02, 0.01, 0.05])];
/// Plausible voltages of a pack (V), if the label does not state the number of cells.
const PACK_V: (f64, f64) = (100.0, 950.0);
/// Scales of a 16-bit pack voltage (V per code).
const PACK_SCALES: [f64; 5] = [0.1, 0.01, 0.5, 0.25, 1.0];
/// Lengths of a current in bits, each with the scales to try (A per code).
const CURRENT_FORMS: [(u32, &[f64]); 3] =
    [(16, &[0.1, 0.01, 0.05, 0.5, 0.025]), (24, &[0.001, 0.01]), (32, &[1.0 / 1024.0, 0.001])];
/// Smallest number of answers in which a field is searched.
const MIN_ANSWERS: usize = 3;

/// Number of cells found so far for each form of a row. A row of the same form in the next answer continues the
/// numbering of the cells.
#[derive(Debug, Default)]
pub(super) struct CellRows(BTreeMap<RowForm, u32>);

/// Form of a row: bus, CAN identifier and address byte of the controller, first bit, length, byte order, scale (bits of
/// an `f64`).
type RowForm = (BusIndex, CanId, Option<u8>, u32, u32, bool, u64);

/// Returns the possible signals in these answers. Skips the bits that a definition already describes: `described` lists
/// their ranges (first bit, last bit).
pub(super) fn signals(
    key: &AnswerKey,
    answers: &Answers,
    described: &[(u32, u32)],
    rows: &mut CellRows,
    label: &PackLabel,
) -> Vec<LogSignal> {
    let bytes = answers.payloads.iter().map(|(_, data)| data.len()).min().unwrap_or(0);
    if answers.payloads.len() < MIN_ANSWERS {
        return Vec::new();
    }
    let is_free_of = |taken: &[(u32, u32)], bit: u32, length: u32| {
        taken.iter().all(|(low, high)| bit > *high || bit + length <= *low)
    };
    let mut found = cells(key, answers, bytes, rows, label);
    found.extend(temperatures(key, answers, bytes));
    found.retain(|signal| signal.span().is_some_and(|(low, high)| is_free_of(described, low, high + 1 - low)));
    let mut taken: Vec<(u32, u32)> = found.iter().filter_map(LogSignal::span).collect();
    taken.extend(described);
    let is_free = |bit: u32, length: u32| is_free_of(&taken, bit, length);
    for byte in 0..u32::try_from(bytes).unwrap_or(0) {
        let bit = 8 * byte;
        let rest = 8 * (u32::try_from(bytes).unwrap_or(0) - byte);
        let mut forms = vec![field("Temperature", bit, 8, true, 1.0), field("Temperature", bit, 8, false, 1.0)];
        forms[1].offset = -40.0;
        forms.extend(PACK_SCALES.iter().map(|scale| field("Voltage", bit, 16, false, *scale)));
        let currents =
            CURRENT_FORMS.iter().flat_map(|(length, scales)| scales.iter().map(move |scale| (*length, *scale)));
        forms.extend(currents.map(|(length, scale)| field("Current", bit, length, true, scale)));
        let fitting = forms.into_iter().filter(|form| form.length <= rest && is_free(bit, form.length));
        found
            .extend(fitting.filter_map(|form| signal(key, answers, form)).filter(|signal| is_plausible(signal, label)));
    }
    found
}

impl LogSignal {
    pub(super) fn span(&self) -> Option<(u32, u32)> {
        let SignalOrigin::Raw(_, field) = &self.origin else { return None };
        Some((field.bit, field.bit + field.length - 1))
    }
}

fn field(what: &str, bit: u32, length: u32, signed: bool, factor: f64) -> DiagnosticSignal {
    let unit = match what {
        "Temperature" | "Sensor" => "degC",
        "Current" => "A",
        _ => "V",
    };
    DiagnosticSignal {
        name: format!("{what}_{}", bit / 8),
        bit,
        length,
        signed,
        little_endian: false,
        factor,
        offset: 0.0,
        unit: unit.to_owned(),
        range: None,
        not_available: Vec::new(),
        numbers: None,
    }
}

fn signal(key: &AnswerKey, answers: &Answers, form: DiagnosticSignal) -> Option<LogSignal> {
    let readings = answers.payloads.iter().map(|(time_s, data)| (time_s, form.value(data).ok_or(Fault::OutOfRange)));
    let series = Series::of(readings);
    let quantity = match form.unit.as_str() {
        "degC" => Quantity::Temperature,
        "A" => Quantity::Current,
        _ => Quantity::Voltage,
    };
    // Cells are numbered across all answers, so their names are unique. The other names need the service and identifier
    // of their answer.
    let mut form = form;
    if !form.name.starts_with(CELL) {
        form.name = format!("D{:02X}{:02X}_{}", key.service, key.identifier, form.name);
    }
    let name = format!("{}.{}", table_name(key), form.name);
    let is_known = series.count() >= MIN_ANSWERS as u64;
    is_known.then(|| LogSignal::unnamed(name, key.bus, SignalOrigin::Raw(*key, Box::new(form)), quantity, series))
}

pub(super) fn table_name(key: &AnswerKey) -> String {
    let extension = key.extension.map(|byte| format!("_{byte:02X}")).unwrap_or_default();
    format!("Answer{}{extension}", key.response)
}

fn is_plausible(signal: &LogSignal, pack: &PackLabel) -> bool {
    let (SignalOrigin::Raw(_, field), LogSignal { label, series, .. }) = (&signal.origin, signal) else { return false };
    let within = |low: f64, high: f64| series.extent.min >= low && series.extent.max <= high;
    if label.has_unit_of(Quantity::Voltage) {
        // Codes from 0xFF00 on mean "no value" or are the sign bytes of a longer number.
        let (low_v, high_v) = pack.pack_v().unwrap_or(PACK_V);
        within(low_v, high_v) && series.extent.max < 65_280.0 * field.factor
    } else if label.has_unit_of(Quantity::Current) {
        within(-1500.0, 1500.0) && !series.is_constant()
    } else {
        // A constant 0 or 0xFF, with or without the offset of -40, means "no value".
        let is_absent = series.values.kept().iter().all(|value| [-1.0, 0.0, 215.0, -40.0].contains(value));
        within(-35.0, 75.0) && series.largest_step() <= 2.0 && !is_absent
    }
}

/// Finds the best row of temperatures: bytes at a constant distance with similar, slowly changing values. The bytes of
/// missing sensors (0xFF) are skipped.
fn temperatures(key: &AnswerKey, answers: &Answers, bytes: usize) -> Vec<LogSignal> {
    let mut best: Vec<LogSignal> = Vec::new();
    let mut best_weight = 0;
    for (distance, offset) in (1..=4).flat_map(|distance| [(distance, 0.0), (distance, -40.0)]) {
        for first in 0..bytes {
            let row = temperature_row(key, answers, (first, bytes), distance, offset);
            let values: std::collections::BTreeSet<u64> =
                row.iter().flat_map(|signal| signal.series.values.kept()).map(|value| value.to_bits()).collect();
            // Bytes with the same constant value are probably parts of other numbers.
            let weight = if values.len() > 1 { 2 * row.len() + usize::from(distance > 1) } else { 0 };
            if row.len() >= 3 && weight > best_weight {
                (best, best_weight) = (row, weight);
            }
        }
    }
    best
}

fn temperature_row(
    key: &AnswerKey,
    answers: &Answers,
    (first, end): (usize, usize),
    distance: usize,
    offset: f64,
) -> Vec<LogSignal> {
    let is_absent = |byte: usize| answers.payloads.iter().all(|(_, data)| data.get(byte) == Some(&0xFF));
    let mut row: Vec<LogSignal> = Vec::new();
    for byte in (first..end).step_by(distance) {
        if is_absent(byte) && !row.is_empty() {
            continue;
        }
        // At a distance above 1, the bytes between two sensors are skipped. If one of them belongs to a missing sensor,
        // the row ends.
        if !row.is_empty() && (byte + 1 - distance..byte).any(is_absent) {
            break;
        }
        let mut form = field("Sensor", u32::try_from(8 * byte).unwrap_or(u32::MAX), 8, offset == 0.0, 1.0);
        (form.name, form.offset) = (format!("Row{first}Sensor{}", row.len() + 1), offset);
        let next = signal(key, answers, form).filter(|signal| is_plausible(signal, &PackLabel::default()));
        let is_near = |signal: &LogSignal| {
            row.first()
                // Temperature sensors of a pack differ by at most 12 K.
                .is_none_or(|first| (signal.series.extent.mean() - first.series.extent.mean()).abs() <= 12.0)
        };
        match next.filter(is_near) {
            Some(signal) => row.push(signal),
            None => break,
        }
    }
    row
}

fn cells(key: &AnswerKey, answers: &Answers, bytes: usize, rows: &mut CellRows, label: &PackLabel) -> Vec<LogSignal> {
    let mut best: Option<(usize, DiagnosticSignal)> = None;
    let cell_v = label.chemistry.map_or(CELL_V, |_| label.cell_v());
    let orders = [(16, false), (16, true), (8, false)];
    let forms = orders.into_iter().flat_map(|(length, little_endian)| {
        let scales = CELL_SCALES.iter().filter(move |(bits, _)| *bits == length).flat_map(|(_, scales)| *scales);
        scales.map(move |scale| (length, little_endian, *scale))
    });
    for (length, little_endian, scale) in forms {
        let width = length as usize / 8;
        for first in 0..width {
            let longest = best.as_ref().map_or(MIN_CELLS - 1, |best| best.0 * best.1.length as usize / 8);
            let mut form = field("Cell", 0, length, false, scale);
            form.little_endian = little_endian;
            if let Some((count, start)) = row(answers, bytes, first, &form, cell_v)
                && count >= MIN_CELLS
                && count * width > longest
            {
                form.bit = u32::try_from(8 * start).unwrap_or(u32::MAX);
                best = Some((count, form));
            }
        }
    }
    let Some((count, mut form)) = best else { return Vec::new() };
    let count = u32::try_from(count).unwrap_or(1);
    let form_key =
        (key.bus, key.response, key.extension, form.bit, form.length, form.little_endian, form.factor.to_bits());
    let before = rows.0.entry(form_key).or_default();
    form.name = format!("{CELL}{{n}}");
    form.numbers = Some(NumberRange { first: *before + 1, last: *before + count, step: form.length });
    *before += count;
    (0..count).filter_map(|n| signal(key, answers, form.of_series(n))).collect()
}

/// Returns length and first byte of the longest run of plausible cell voltages. Voltages are read from `first` on, at
/// multiples of the field width.
fn row(
    answers: &Answers,
    bytes: usize,
    first: usize,
    form: &DiagnosticSignal,
    (low_v, high_v): (f64, f64),
) -> Option<(usize, usize)> {
    let width = form.length as usize / 8;
    let code = |data: &[u8], start: usize| {
        let add = |code: u32, byte: &u8| code << 8 | u32::from(*byte);
        let field = &data[start..start + width];
        if form.little_endian { field.iter().rev().fold(0, add) } else { field.iter().fold(0, add) }
    };
    let cell = |start: usize| {
        let mut codes = answers.payloads.iter().map(|(_, data)| code(data, start));
        let value = f64::from(codes.next()?) * form.factor;
        let is_cell = answers.payloads.iter().map(|(_, data)| code(data, start)).all(|code| {
            (low_v..=high_v).contains(&(f64::from(code) * form.factor)) && code != u32::MAX >> (32 - 8 * width)
        });
        is_cell.then_some((start, value))
    };
    let starts = (first..bytes).step_by(width).filter(|start| start + width <= bytes);
    // Cells of a pack differ by at most 0.35 V.
    let run = longest_run(starts.map(cell), |(_, first_v), (_, next_v)| (next_v - first_v).abs() <= 0.35);
    Some((run.len(), run.first()?.0))
}
