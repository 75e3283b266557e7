//! Decodes and encodes signals: numbers at a position of a payload.
//!
//! In: a layout from a DBC, and payload bytes. Out: raw codes (`u64`, the signal's bits, not sign-extended) and
//! physical values (code x factor + offset, in the DBC's unit). A [`SignalPlan`] is a layout that was prepared once.
//! Decoding then needs one load, two shifts and one multiply-add. Signals have 1 to 64 bits at any position of a
//! payload of up to 64 bytes.
//!
//! Bad input gives a fault instead of a value: [`Fault::ShortFrame`] for a payload that is too short,
//! [`Fault::NotFinite`] for NaN or infinity, [`Fault::OutOfRange`] for a value outside the DBC's range. Encoding rounds
//! to the nearest code and saturates.

use crate::can::MAX_DATA;
use crate::quantity::Fault;

const MAX_BITS: u16 = 512;
const _: () = assert!(MAX_DATA * 8 == MAX_BITS as usize);

/// Order of a signal's bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ByteOrder {
    /// `@1` in a DBC. The start bit is the least significant bit.
    LittleEndian,
    /// `@0` in a DBC. The start bit is the most significant bit.
    BigEndian,
}

/// Number format of a signal's bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ValueType {
    Unsigned,
    /// Two's complement.
    Signed,
    /// `SIG_VALTYPE_ 1`.
    Float32,
    /// `SIG_VALTYPE_ 2`.
    Float64,
}

/// Position and conversion of a signal, as in a DBC.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SignalLayout {
    /// In DBC numbering: bits 0 to 7 are byte 0, from the least to the most significant bit.
    pub start_bit: u16,
    /// 1 to 64.
    pub length_bits: u16,
    pub byte_order: ByteOrder,
    pub value_type: ValueType,
    /// Physical units per code; not 0.
    pub factor: f64,
    /// Physical value of code 0.
    pub offset: f64,
    /// If `minimum` and `maximum` are both 0, the DBC states no range.
    pub minimum: f64,
    pub maximum: f64,
}

/// Reason why a layout is invalid.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct LayoutFault(String);

/// A layout prepared for decoding and encoding.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SignalPlan {
    /// First byte of the eight-byte window that is loaded.
    pub(crate) window: u8,
    bytes_needed: u8,
    /// Whether the signal spans nine bytes.
    wide: bool,
    pub(crate) byte_order: ByteOrder,
    value_type: ValueType,
    /// Left shift that moves the signal's highest bit to the top of the word.
    pub(crate) up: u8,
    /// Right shift that then moves the signal's lowest bit to the bottom of the word: 64 - length.
    pub(crate) down: u8,
    pub(crate) factor: f64,
    pub(crate) offset: f64,
    /// Physical limits, widened by half a code so that rounding never rejects a code on the limit.
    pub(crate) low: f64,
    pub(crate) high: f64,
    /// Smallest and largest code in the DBC's range and in the signal's bits, sign-extended.
    low_code: i128,
    high_code: i128,
}

/// `code` as a float: exact up to 2^53, otherwise rounded.
pub(crate) fn float_of(code: u64) -> f64 {
    code as f64
}

/// `code` as a float: exact within +-2^53, otherwise rounded.
pub(crate) fn float_of_signed(code: i64) -> f64 {
    code as f64
}

/// Converts a float without fraction. Saturates; NaN gives 0.
fn integer_of(whole: f64) -> i128 {
    whole as i128
}

/// Rounds like `number.round()`, but without a function call. Saturates; NaN gives 0.
fn nearest(number: f64) -> i64 {
    let towards_zero = number as i64;
    // The difference is exact, because numbers above 2^52 have no fraction.
    let rest = number - float_of_signed(towards_zero);
    towards_zero.saturating_add(i64::from(rest >= 0.5) - i64::from(rest <= -0.5))
}

/// The code nearest to a number, for codes that do not fit `i64`.
#[cold]
fn wide_code(number: f64, low: i128, high: i128) -> u64 {
    low_64(integer_of(number.round()).clamp(low, high))
}

/// The lowest 64 bits of a two's complement number.
fn low_64(code: i128) -> u64 {
    let bytes = code.to_le_bytes();
    u64::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3], bytes[4], bytes[5], bytes[6], bytes[7]])
}

impl SignalLayout {
    /// First and last bit in wire order. Within a byte, little-endian signals count from bit 0 up, and big-endian
    /// signals from bit 7 down.
    pub(crate) fn span(&self) -> (u32, u32) {
        let start = u32::from(self.start_bit);
        let first = match self.byte_order {
            ByteOrder::LittleEndian => start,
            ByteOrder::BigEndian => start - start % 8 + (7 - start % 8),
        };
        (first, first + u32::from(self.length_bits.max(1)) - 1)
    }

    /// Number of payload bytes up to the signal's end.
    pub fn end_byte(&self) -> u32 {
        self.span().1 / 8 + 1
    }

    /// Physical range of the signal's bits; infinite for floats.
    pub fn extent(&self) -> (f64, f64) {
        if matches!(self.value_type, ValueType::Float32 | ValueType::Float64) || !(1..=64).contains(&self.length_bits) {
            return (f64::NEG_INFINITY, f64::INFINITY);
        }
        let (lowest, highest) = self.representable();
        let [a, b] = [lowest, highest].map(|code| code as f64 * self.factor + self.offset);
        (a.min(b), a.max(b))
    }

    /// Whether the two signals share a bit of the payload.
    pub fn overlaps(&self, other: &Self) -> bool {
        let theirs: Vec<u32> = other.bits().collect();
        self.bits().any(|bit| theirs.contains(&bit))
    }

    fn bits(&self) -> impl Iterator<Item = u32> + use<> {
        let (first, last) = self.span();
        let is_little = self.byte_order == ByteOrder::LittleEndian;
        (first..=last).map(move |bit| if is_little { bit } else { bit - bit % 8 + (7 - bit % 8) })
    }

    /// Whether the range is stated; `[0|0]` means that it is not.
    pub fn has_range(&self) -> bool {
        self.minimum != 0.0 || self.maximum != 0.0
    }

    /// Whether one of the signal's bits is set in `mask`, which covers the first bytes of the payload.
    pub fn touches(&self, mask: [u8; 3]) -> bool {
        let mut payload = [0; MAX_DATA];
        payload[..mask.len()].copy_from_slice(&mask);
        self.plan().is_ok_and(|plan| plan.raw(&payload).is_ok_and(|code| code != 0))
    }

    fn check(&self) -> Result<(), LayoutFault> {
        let Self { length_bits, value_type, factor, offset, minimum, maximum, .. } = *self;
        let allowed = match value_type {
            ValueType::Unsigned | ValueType::Signed => length_bits,
            ValueType::Float32 => 32,
            ValueType::Float64 => 64,
        };
        Err(LayoutFault(if !(1..=64).contains(&length_bits) {
            format!("length is {length_bits} bits, must be 1 to 64")
        } else if self.span().1 >= u32::from(MAX_BITS) {
            format!("reaches to bit {} of the payload, must end within 512 bits (64 bytes)", self.span().1)
        } else if length_bits != allowed {
            format!("IEEE float of {length_bits} bits, must be {allowed}")
        } else if !factor.is_finite() || factor == 0.0 {
            format!("factor is {factor}, must be finite and not 0")
        } else if !offset.is_finite() {
            format!("offset is {offset}, must be finite")
        } else if minimum.is_nan() || maximum.is_nan() || minimum > maximum {
            format!("range is [{minimum}|{maximum}], the first must not be above the second")
        } else {
            return Ok(());
        }))
    }

    /// Smallest and largest code in the signal's bits.
    fn representable(&self) -> (i128, i128) {
        match self.value_type {
            ValueType::Signed => (-(1_i128 << (self.length_bits - 1)), (1_i128 << (self.length_bits - 1)) - 1),
            ValueType::Unsigned | ValueType::Float32 | ValueType::Float64 => (0, (1_i128 << self.length_bits) - 1),
        }
    }

    /// Smallest and largest code in the stated range and in the signal's bits. If no code lies in the range, the range
    /// is ignored.
    fn code_limits(&self) -> (i128, i128) {
        /// Tolerance for the decimal numbers of the DBC, in codes.
        const ROUNDING: f64 = 1e-6;
        let (lowest, highest) = self.representable();
        if !self.has_range() {
            return (lowest, highest);
        }
        let a = (self.minimum - self.offset) / self.factor;
        let b = (self.maximum - self.offset) / self.factor;
        let low = integer_of((a.min(b) - ROUNDING).ceil()).max(lowest);
        let high = integer_of((a.max(b) + ROUNDING).floor()).min(highest);
        if low <= high { (low, high) } else { (lowest, highest) }
    }

    /// Physical limits, widened by half a code (for floats, by 1e-6 of the larger limit).
    fn physical_limits(&self) -> (f64, f64) {
        if !self.has_range() {
            // Reject only values that factor and offset make infinite.
            return (f64::MIN, f64::MAX);
        }
        let room = match self.value_type {
            ValueType::Unsigned | ValueType::Signed => self.factor.abs() / 2.0,
            ValueType::Float32 | ValueType::Float64 => 1e-6 * self.minimum.abs().max(self.maximum.abs()),
        };
        (self.minimum - room, self.maximum + room)
    }

    /// Prepares the layout for decoding and encoding, or says why it is invalid.
    pub fn plan(&self) -> Result<SignalPlan, LayoutFault> {
        self.check()?;
        let (first, last) = self.span();
        let (first_byte, last_byte) = (first / 8, last / 8);
        let wide = last_byte - first_byte == 8;
        let window = if wide { first_byte } else { last_byte.saturating_sub(7) };
        let in_window = first - 8 * window;
        let length = u32::from(self.length_bits);
        let word = if wide { 128 } else { 64 };
        let up = match self.byte_order {
            ByteOrder::LittleEndian => word - (in_window + length),
            ByteOrder::BigEndian => in_window,
        };
        let (low, high) = self.physical_limits();
        let (low_code, high_code) = self.code_limits();
        // Each number is below 128.
        let small = |n: u32| u8::try_from(n).unwrap_or(u8::MAX);
        Ok(SignalPlan {
            window: small(window),
            bytes_needed: small(last_byte + 1),
            wide,
            byte_order: self.byte_order,
            value_type: self.value_type,
            up: small(up),
            down: small(64 - length),
            factor: self.factor,
            offset: self.offset,
            low,
            high,
            low_code,
            high_code,
        })
    }
}

impl SignalPlan {
    /// Bytes that a payload must have to carry the signal.
    pub fn bytes_needed(&self) -> usize {
        usize::from(self.bytes_needed)
    }

    /// Whether the signal is an integer of at most 63 bits within eight bytes.
    pub(crate) fn is_simple(&self) -> bool {
        let is_integer = matches!(self.value_type, ValueType::Unsigned | ValueType::Signed);
        is_integer && !self.wide && self.down > 0
    }

    /// Smallest and largest code of a simple signal.
    pub(crate) fn codes(&self) -> (i64, i64) {
        let highest = (u64::MAX >> self.down).cast_signed();
        if self.value_type == ValueType::Signed { (-(highest >> 1) - 1, highest >> 1) } else { (0, highest) }
    }

    /// Length, 1 to 64 bits.
    pub fn length_bits(&self) -> u32 {
        64 - u32::from(self.down)
    }

    /// Number format.
    pub fn value_type(&self) -> ValueType {
        self.value_type
    }

    /// The code with all bits set: the usual "not available" code of an unsigned signal.
    pub fn all_ones(&self) -> u64 {
        u64::MAX >> self.down
    }

    /// The signal's bits, without sign extension. Fails with [`Fault::ShortFrame`].
    #[inline]
    pub fn raw(&self, payload: &[u8]) -> Result<u64, Fault> {
        Ok(self.lifted(payload)? >> self.down)
    }

    /// The signal's bits at the top of a word. The bits below may be other payload bits.
    #[inline]
    fn lifted(&self, payload: &[u8]) -> Result<u64, Fault> {
        if payload.len() < self.bytes_needed() {
            return Err(Fault::ShortFrame);
        }
        if self.wide {
            return Ok(self.lifted_wide(payload));
        }
        let from = usize::from(self.window);
        let bytes = match payload.get(from..from + 8) {
            Some(bytes) => <[u8; 8]>::try_from(bytes).unwrap_or_default(),
            None => padded(payload, from),
        };
        let word = match self.byte_order {
            ByteOrder::LittleEndian => u64::from_le_bytes(bytes),
            ByteOrder::BigEndian => u64::from_be_bytes(bytes),
        };
        Ok(word << self.up)
    }

    /// Like `lifted`, for a signal of 58 to 64 bits that spans nine bytes.
    #[cold]
    fn lifted_wide(&self, payload: &[u8]) -> u64 {
        let bytes: [u8; 16] = padded(payload, usize::from(self.window));
        let word = match self.byte_order {
            ByteOrder::LittleEndian => u128::from_le_bytes(bytes),
            ByteOrder::BigEndian => u128::from_be_bytes(bytes),
        };
        let top = (word << self.up) >> 64;
        // Lossless, because 64 bits remain after the shift.
        u64::try_from(top).unwrap_or(u64::MAX)
    }

    /// The physical value, not checked against the DBC's range. Fails with [`Fault::ShortFrame`] or
    /// [`Fault::NotFinite`].
    #[inline]
    pub fn physical(&self, payload: &[u8]) -> Result<f64, Fault> {
        let lifted = self.lifted(payload)?;
        let number = match self.value_type {
            ValueType::Unsigned => float_of(lifted >> self.down),
            ValueType::Signed => float_of_signed(lifted.cast_signed() >> self.down),
            ValueType::Float32 | ValueType::Float64 => self.ieee(lifted >> self.down)?,
        };
        Ok(number * self.factor + self.offset)
    }

    fn ieee(&self, code: u64) -> Result<f64, Fault> {
        let number = match u32::try_from(code) {
            Ok(code) if self.value_type == ValueType::Float32 => f64::from(f32::from_bits(code)),
            _ => f64::from_bits(code),
        };
        if number.is_finite() { Ok(number) } else { Err(Fault::NotFinite) }
    }

    /// The physical value. Fails with [`Fault::ShortFrame`], [`Fault::NotFinite`] or, outside the DBC's range,
    /// [`Fault::OutOfRange`]. A code on the limit is in the range, regardless of rounding.
    #[inline]
    pub fn decode(&self, payload: &[u8]) -> Result<f64, Fault> {
        let value = self.physical(payload)?;
        if value >= self.low && value <= self.high { Ok(value) } else { Err(Fault::OutOfRange) }
    }

    /// The code nearest to a physical value. Saturates at the limits of the bits and of the DBC's range; `None` for
    /// NaN.
    pub fn code(&self, value: f64) -> Option<u64> {
        match self.value_type {
            ValueType::Unsigned | ValueType::Signed => self.integer_code(value, self.low_code, self.high_code),
            ValueType::Float32 | ValueType::Float64 => self.ieee_code(value.clamp(self.low, self.high)),
        }
    }

    /// Like [`Self::code`], but saturates only at the limits of the bits, so that the receiver detects values outside
    /// the DBC's range.
    pub fn code_beyond_range(&self, value: f64) -> Option<u64> {
        let bits = self.length_bits();
        match self.value_type {
            ValueType::Unsigned => self.integer_code(value, 0, (1_i128 << bits) - 1),
            ValueType::Signed => self.integer_code(value, -(1_i128 << (bits - 1)), (1_i128 << (bits - 1)) - 1),
            ValueType::Float32 | ValueType::Float64 => self.ieee_code(value),
        }
    }

    fn integer_code(&self, value: f64, low: i128, high: i128) -> Option<u64> {
        if value.is_nan() {
            return None;
        }
        let code = (value - self.offset) / self.factor;
        let bits = match (i64::try_from(low), i64::try_from(high)) {
            (Ok(low), Ok(high)) => nearest(code).clamp(low, high).cast_unsigned(),
            _ => wide_code(code, low, high),
        };
        Some(bits & self.all_ones())
    }

    fn ieee_code(&self, value: f64) -> Option<u64> {
        if value.is_nan() {
            return None;
        }
        let number = ((value - self.offset) / self.factor).clamp(f64::MIN, f64::MAX);
        match self.value_type {
            ValueType::Float32 => {
                let number = number.clamp(f64::from(f32::MIN), f64::from(f32::MAX));
                // The clamp keeps the number finite.
                Some(u64::from((number as f32).to_bits()))
            }
            ValueType::Float64 | ValueType::Unsigned | ValueType::Signed => Some(number.to_bits()),
        }
    }

    /// Writes the nearest code. Saturates, also for infinities. Fails with [`Fault::ShortFrame`], or for NaN with
    /// [`Fault::NotFinite`], and then leaves the payload unchanged.
    pub fn encode(&self, payload: &mut [u8], value: f64) -> Result<(), Fault> {
        let code = self.code(value).ok_or(Fault::NotFinite)?;
        self.encode_raw(payload, code)
    }

    /// Writes the signal's bits. Fails with [`Fault::ShortFrame`], or with [`Fault::OutOfRange`] if `code` has more
    /// bits than the signal, and then leaves the payload unchanged.
    pub fn encode_raw(&self, payload: &mut [u8], code: u64) -> Result<(), Fault> {
        if payload.len() < self.bytes_needed() {
            return Err(Fault::ShortFrame);
        }
        if code > self.all_ones() {
            return Err(Fault::OutOfRange);
        }
        if self.wide {
            self.place_wide(payload, code);
            return Ok(());
        }
        let up = self.down - self.up;
        let (keep, put) = (!(self.all_ones() << up), code << up);
        let from = usize::from(self.window);
        let changed = |bytes: [u8; 8]| match self.byte_order {
            ByteOrder::LittleEndian => (u64::from_le_bytes(bytes) & keep | put).to_le_bytes(),
            ByteOrder::BigEndian => (u64::from_be_bytes(bytes) & keep | put).to_be_bytes(),
        };
        match payload.get_mut(from..).and_then(|rest| rest.first_chunk_mut()) {
            Some(bytes) => *bytes = changed(*bytes),
            None => {
                let bytes = changed(padded(payload, from));
                payload.iter_mut().skip(from).zip(bytes).for_each(|(to, byte)| *to = byte);
            }
        }
        Ok(())
    }

    /// Like `encode_raw`, for a signal of 58 to 64 bits that spans nine bytes. The payload must be long enough.
    #[cold]
    fn place_wide(&self, payload: &mut [u8], code: u64) {
        let from = usize::from(self.window);
        let place = |bits: u64| u128::from(bits) << (128 - self.length_bits() - u32::from(self.up));
        let changed = |bytes: [u8; 16]| match self.byte_order {
            ByteOrder::LittleEndian => {
                (u128::from_le_bytes(bytes) & !place(self.all_ones()) | place(code)).to_le_bytes()
            }
            ByteOrder::BigEndian => (u128::from_be_bytes(bytes) & !place(self.all_ones()) | place(code)).to_be_bytes(),
        };
        let bytes = changed(padded(payload, from));
        payload.iter_mut().skip(from).zip(bytes).for_each(|(to, byte)| *to = byte);
    }
}

/// `N` bytes from `from` on, padded with zeros.
fn padded<const N: usize>(payload: &[u8], from: usize) -> [u8; N] {
    let mut bytes = [0; N];
    for (to, byte) in bytes.iter_mut().zip(payload.iter().skip(from)) {
        *to = *byte;
    }
    bytes
}

#[cfg(test)]
mod tests;
