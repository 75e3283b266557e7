//! Fields of diagnostic answers that no definition describes: which bytes behave like cell voltages, pack voltage, current or
//! temperatures.
//!
//! A row of cell voltages is a run of at least [`MIN_CELLS`] neighbours of 8 or 16 bits that, at one of the customary scales,
//! are all plausible voltages close to one another. Other fields are tried at every byte with customary scales; which of
//! them is what is judged from their values, as for named signals.

use super::capture::{AnswerKey, Answers};
use super::series::Series;
use super::signals::{LogSignal, SignalOrigin};
use super::words::{Dimension, Words};
use crate::import::{DiagnosticSignal, NumberRange};

/// Fewest neighbours of a row of cells.
const MIN_CELLS: usize = 8;
/// Plausible voltages of a cell in use, V.
const CELL_V: (f64, f64) = (2.0, 4.5);
/// Cells of one pack are at most so far apart, V.
const MAX_SPREAD_V: f64 = 0.35;
/// V per code, 16 bits and 8 bits.
const CELL_SCALES: [(u32, &[f64]); 2] = [(16, &[0.001, 0.0001, 0.002, 0.005, 0.01]), (8, &[0.02, 0.01, 0.05])];
/// Plausible voltages of a pack, V.
const PACK_V: (f64, f64) = (100.0, 950.0);
/// V per code of a pack voltage of 16 bits.
const PACK_SCALES: [f64; 5] = [0.1, 0.01, 0.5, 0.25, 1.0];
/// Bits and A per code of a current.
const CURRENT_FORMS: [(u32, &[f64]); 3] =
    [(16, &[0.1, 0.01, 0.05, 0.5, 0.025]), (24, &[0.001, 0.01]), (32, &[1.0 / 1024.0, 0.001])];
/// Largest plausible current, A.
const MAX_CURRENT_A: f64 = 1500.0;
/// Codes of no value.
const ABSENT_8: u64 = 0xFF;
/// Answers to judge a field by.
const MIN_ANSWERS: usize = 3;

/// Signals that may be in these answers.
pub(super) fn signals(key: &AnswerKey, answers: &Answers) -> Vec<LogSignal> {
    let bytes = answers.payloads.iter().map(|(_, data)| data.len()).min().unwrap_or(0);
    if answers.payloads.len() < MIN_ANSWERS {
        return Vec::new();
    }
    let cells = cells(key, answers, bytes);
    let taken: Vec<(u32, u32)> = cells.iter().filter_map(|signal| signal.span()).collect();
    let is_free = |bit: u32, length: u32| taken.iter().all(|(low, high)| bit > *high || bit + length <= *low);
    let mut found = cells;
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
        found.extend(fitting.filter_map(|form| signal(key, answers, form)).filter(is_plausible));
    }
    found
}

impl LogSignal {
    /// First and last bit of a field.
    fn span(&self) -> Option<(u32, u32)> {
        let SignalOrigin::Raw(_, field) = &self.origin else { return None };
        Some((field.bit, field.bit + field.length - 1))
    }
}

/// A field with a name that says where it is.
fn field(what: &str, bit: u32, length: u32, signed: bool, factor: f64) -> DiagnosticSignal {
    let unit = match what {
        "Temperature" => "degC",
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
    let readings = answers.payloads.iter().map(|(time_s, data)| (time_s, form.value(data)));
    let series = Series::collect(readings, answers.payloads.len());
    let dimension = match form.unit.as_str() {
        "degC" => Dimension::Temperature,
        "A" => Dimension::Current,
        _ => Dimension::Voltage,
    };
    (series.values.len() >= MIN_ANSWERS).then(|| LogSignal {
        name: format!("{}.{}", table_name(key), form.name),
        bus: key.bus,
        // Places say nothing about a meaning.
        words: Words::new(""),
        is_pack_message: false,
        origin: SignalOrigin::Raw(*key, Box::new(form)),
        dimension,
        series,
        scale: 1.0,
    })
}

/// Name of the table of an answer: `Answer7BB_2102`.
pub(super) fn table_name(key: &AnswerKey) -> String {
    let extension = key.extension.map(|byte| format!("_{byte:02X}")).unwrap_or_default();
    let digits = if key.service == 0x22 { 4 } else { 2 };
    format!("Answer{}{extension}_{:02X}{:0digits$X}", key.response, key.service, key.identifier)
}

fn is_plausible(signal: &LogSignal) -> bool {
    let Series { values, .. } = &signal.series;
    let within = |low: f64, high: f64| values.iter().all(|value| (low..=high).contains(value));
    match signal.dimension {
        Dimension::Voltage => within(PACK_V.0, PACK_V.1),
        Dimension::Current => within(-MAX_CURRENT_A, MAX_CURRENT_A) && !signal.series.is_constant(),
        Dimension::Temperature => {
            let is_absent =
                values.iter().all(|value| *value == ABSENT_8 as f64 - 40.0 || *value == -1.0 || *value == 0.0);
            within(-35.0, 75.0) && signal.series.largest_step() <= 2.0 && !is_absent
        }
        Dimension::Percent | Dimension::None | Dimension::Other => false,
    }
}

/// The longest row of cell voltages, each cell a signal.
fn cells(key: &AnswerKey, answers: &Answers, bytes: usize) -> Vec<LogSignal> {
    let mut best: Option<(usize, DiagnosticSignal)> = None;
    for (length, scales) in CELL_SCALES {
        let width = length as usize / 8;
        for scale in scales {
            for first in 0..width {
                let longest = best.as_ref().map_or(MIN_CELLS - 1, |best| best.0 * best.1.length as usize / 8);
                if let Some((count, start)) = row(answers, bytes, first, width, *scale)
                    && count >= MIN_CELLS
                    && count * width > longest
                {
                    let bit = u32::try_from(8 * start).unwrap_or(u32::MAX);
                    best = Some((count, field("Cell", bit, length, false, *scale)));
                }
            }
        }
    }
    let Some((count, mut form)) = best else { return Vec::new() };
    let last = u32::try_from(count).unwrap_or(1);
    form.name = "Cell{n}".to_owned();
    form.numbers = Some(NumberRange { first: 1, last, step: form.length });
    (0..last).filter_map(|n| signal(key, answers, form.of_series(n))).collect()
}

/// Length and first byte of the longest run of plausible neighbours that begin at `first`, `first + width`, ...
fn row(answers: &Answers, bytes: usize, first: usize, width: usize, scale: f64) -> Option<(usize, usize)> {
    let is_cell = |start: usize| {
        answers.payloads.iter().all(|(_, data)| {
            let code = data[start..start + width].iter().fold(0_u32, |code, byte| code << 8 | u32::from(*byte));
            (CELL_V.0..=CELL_V.1).contains(&(f64::from(code) * scale))
        })
    };
    let value = |start: usize| {
        let data = answers.payloads.iter().next().map_or(&[][..], |(_, data)| data);
        scale * f64::from(data[start..start + width].iter().fold(0_u32, |code, byte| code << 8 | u32::from(*byte)))
    };
    let (mut best, mut run): (Option<(usize, usize)>, Option<(usize, usize)>) = (None, None);
    for start in (first..bytes).step_by(width).filter(|start| start + width <= bytes) {
        run = match run {
            _ if !is_cell(start) => None,
            Some((count, begin)) if (value(start) - value(begin)).abs() <= MAX_SPREAD_V => Some((count + 1, begin)),
            _ => Some((1, start)),
        };
        best = best.max(run);
    }
    best
}
