//! Writes `[[input.diagnostic]]` tables as TOML: one answer with its signals, one signal per line.
//!
//! Numbers are written with the fewest digits that read back as the same number. Values have the unit of their signal.

use std::fmt;

use crate::can::CanId;

/// One `[[input.diagnostic]]`: a request, and the signals in its answer.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct DiagnosticTable {
    /// Part of the signals' names before the dot. Several tables may share it.
    pub(crate) name: String,
    pub(crate) request: CanId,
    pub(crate) response: CanId,
    /// First data byte of requests and of answers; `None` = addressing is not extended.
    pub(crate) extension: Option<(u8, u8)>,
    /// Service: 0x01, 0x21 or 0x22.
    pub(crate) service: u8,
    /// Identifier of the values: 2 bytes for service 0x22, otherwise 1 byte.
    pub(crate) identifier: u16,
    /// Comment lines inside the table, without `#`.
    pub(crate) remarks: Vec<String>,
    /// Signals in the order of their bits.
    pub(crate) signals: Vec<DiagnosticSignal>,
}

/// A signal, or a numbered series of signals with equal properties.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct DiagnosticSignal {
    /// Name, with `{n}` if `numbers` is given.
    pub(crate) name: String,
    /// First bit, counted from the most significant bit after the echoed service and identifier.
    pub(crate) bit: u32,
    /// Number of bits, 1 to 64.
    pub(crate) length: u32,
    pub(crate) signed: bool,
    pub(crate) little_endian: bool,
    /// Change of the value per code.
    pub(crate) factor: f64,
    /// Value of code 0.
    pub(crate) offset: f64,
    pub(crate) unit: String,
    pub(crate) range: Option<(f64, f64)>,
    /// Codes that mean "not available".
    pub(crate) not_available: Vec<u64>,
    /// Numbers in the names of a series; `None` = a single signal.
    pub(crate) numbers: Option<NumberRange>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct NumberRange {
    pub(crate) first: u32,
    pub(crate) last: u32,
    /// Number of bits from the start of one signal to the start of the next.
    pub(crate) step: u32,
}

impl DiagnosticTable {
    pub(crate) fn signal_count(&self) -> usize {
        self.signals.iter().map(|signal| signal.count() as usize).sum()
    }
}

impl DiagnosticSignal {
    /// Returns the number of signals of the series; 1 = a single signal.
    pub(crate) fn count(&self) -> u32 {
        self.numbers.map_or(1, |numbers| numbers.last - numbers.first + 1)
    }

    pub(crate) fn spans(&self) -> impl Iterator<Item = (u32, u32)> {
        let step = self.numbers.map_or(0, |numbers| numbers.step);
        (0..self.count()).map(move |n| (self.bit + n * step, self.bit + n * step + self.length - 1))
    }

    /// Returns one signal of the series; `index` counts from 0.
    pub(crate) fn of_series(&self, index: u32) -> Self {
        let Some(NumberRange { first, step, .. }) = self.numbers else { return self.clone() };
        let name = self.name.replace("{n}", &(first + index).to_string());
        Self { name, bit: self.bit + index * step, numbers: None, ..self.clone() }
    }

    /// Returns the same bits read in two's complement, without a range.
    pub(crate) fn as_signed(&self) -> Self {
        Self { signed: true, range: None, ..self.clone() }
    }

    /// Returns the value in the data after the echoed service and identifier. `None` = the data are too short, or the
    /// value is not available or out of range.
    pub(crate) fn value(&self, data: &[u8]) -> Option<f64> {
        let (first, last) = (self.bit / 8, (self.bit + self.length - 1) / 8);
        let bytes = data.get(usize::try_from(first).ok()?..=usize::try_from(last).ok()?)?;
        let join = |word: u128, byte: &u8| word << 8 | u128::from(*byte);
        let word = if self.little_endian { bytes.iter().rev().fold(0, join) } else { bytes.iter().fold(0, join) };
        let below = 8 * (last + 1) - (self.bit + self.length);
        let code = u64::try_from((word >> below) & (u128::MAX >> (128 - self.length))).ok()?;
        let unused = 64 - self.length;
        let number = if self.signed { ((code << unused).cast_signed() >> unused) as f64 } else { code as f64 };
        let value = number * self.factor + self.offset;
        // The tolerance is half a code, because the limits are rounded decimals.
        let room = self.factor.abs() / 2.0;
        let is_inside = self.range.is_none_or(|(low, high)| value >= low - room && value <= high + room);
        (is_inside && !self.not_available.contains(&code)).then_some(value)
    }

    pub(crate) fn codes(&self) -> (f64, f64) {
        let top = 2_f64.powi(i32::try_from(self.length).unwrap_or(64));
        if self.signed { (-top / 2.0, top / 2.0 - 1.0) } else { (0.0, top - 1.0) }
    }

    pub(crate) fn representable(&self) -> (f64, f64) {
        let (low, high) = self.codes();
        let (a, b) = (low * self.factor + self.offset, high * self.factor + self.offset);
        (a.min(b), a.max(b))
    }
}

impl fmt::Display for DiagnosticTable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "[[input.diagnostic]]\nname = \"{}\"", self.name)?;
        writeln!(f, "request = 0x{:X}\nresponse = 0x{:X}", self.request.raw(), self.response.raw())?;
        if let Some((request, response)) = self.extension {
            writeln!(f, "request_extension = 0x{request:02X}\nresponse_extension = 0x{response:02X}")?;
        }
        let digits = if self.service == 0x22 { 4 } else { 2 };
        writeln!(f, "service = 0x{:02X}\nidentifier = 0x{:0digits$X}", self.service, self.identifier)?;
        self.remarks.iter().try_for_each(|remark| writeln!(f, "# {remark}"))?;
        writeln!(f, "signals = [")?;
        self.signals.iter().try_for_each(|signal| writeln!(f, "  {signal},"))?;
        writeln!(f, "]")
    }
}

impl fmt::Display for DiagnosticSignal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{{ name = \"{}\"", self.name)?;
        if let Some(NumberRange { first, last, step }) = self.numbers {
            write!(f, ", numbers = \"{first}-{last}\", step = {step}")?;
        }
        write!(f, ", bit = {}, length = {}", self.bit, self.length)?;
        if self.signed {
            write!(f, ", signed = true")?;
        }
        if self.little_endian {
            write!(f, ", byte_order = \"little\"")?;
        }
        if self.factor != 1.0 {
            write!(f, ", factor = {}", self.factor)?;
        }
        if self.offset != 0.0 {
            write!(f, ", offset = {}", self.offset)?;
        }
        if !self.unit.is_empty() {
            write!(f, ", unit = \"{}\"", self.unit)?;
        }
        if let Some((minimum, maximum)) = self.range {
            write!(f, ", minimum = {minimum}, maximum = {maximum}")?;
        }
        if !self.not_available.is_empty() {
            write!(f, ", not_available = {:?}", self.not_available)?;
        }
        write!(f, " }}")
    }
}
