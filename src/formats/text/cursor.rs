//! Parses the parts of a line: words, numbers, identifiers and data bytes.
//!
//! Numbers are converted from their decimal text without floating point, so that equal times are equal in all formats.

use packwatch_core::can::{CanId, Frame, MAX_DATA};

/// Value of each hex digit; 255 for any other character.
static HEX: [u8; 256] = {
    let mut table = [u8::MAX; 256];
    let mut digit = 0;
    while digit < 16 {
        table[b"0123456789ABCDEF"[digit] as usize] = digit as u8;
        table[b"0123456789abcdef"[digit] as usize] = digit as u8;
        digit += 1;
    }
    table
};

/// Length of the payload for each data length code of CAN FD, bytes.
const FD_LENGTHS: [usize; 16] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64];

/// Place in a line, and what the format allows there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Fault {
    /// Offset in the line, bytes.
    at: usize,
    expected: &'static str,
}

impl Fault {
    /// Formats the fault. Quotes the text of the line at the place of the fault.
    pub(super) fn describe(self, line: &[u8]) -> String {
        const SHOWN: usize = 24;
        let rest = line.get(self.at..).unwrap_or_default();
        let found = match rest.len() {
            0 => "the end of the line".to_owned(),
            len => {
                let shown = String::from_utf8_lossy(&rest[..len.min(SHOWN)]);
                format!("{shown:?}{}", if len > SHOWN { "..." } else { "" })
            }
        };
        format!("column {}: found {found}, expected {}", self.at + 1, self.expected)
    }
}

/// Number base of identifiers and data bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Base {
    Hex,
    Dec,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Cursor<'a> {
    pub(super) text: &'a [u8],
    pub(super) at: usize,
    /// Whether the line has a line end. Otherwise, the last word of the line may be incomplete.
    pub(super) is_whole: bool,
}

impl<'a> Cursor<'a> {
    /// A cursor at the start of a whole line.
    pub(super) fn new(text: &'a [u8]) -> Self {
        Self { text, at: 0, is_whole: true }
    }

    /// A fault at the next word.
    pub(super) fn fault(mut self, expected: &'static str) -> Fault {
        self.skip_blanks();
        Fault { at: self.at, expected }
    }

    /// The text from this position, without blanks at its start.
    pub(super) fn rest(mut self) -> &'a [u8] {
        self.skip_blanks();
        &self.text[self.at..]
    }

    fn skip_blanks(&mut self) {
        while matches!(self.text.get(self.at), Some(b' ' | b'\t')) {
            self.at += 1;
        }
    }

    /// Takes the next word: bytes other than spaces and tabs. Empty at the end of the line.
    #[inline]
    pub(super) fn word(&mut self) -> &'a [u8] {
        self.skip_blanks();
        let start = self.at;
        while !matches!(self.text.get(self.at), None | Some(b' ' | b'\t')) {
            self.at += 1;
        }
        &self.text[start..self.at]
    }

    /// The next word, without taking it.
    pub(super) fn peek(mut self) -> &'a [u8] {
        self.word()
    }

    /// Takes the next field of a table: the bytes before the next separator, without blanks and quotation marks around
    /// them. `None` at the end of the line.
    pub(super) fn field(&mut self, separator: u8) -> Option<&'a [u8]> {
        let rest = self.text.get(self.at..)?;
        let len = memchr::memchr(separator, rest).unwrap_or(rest.len());
        self.at += len + 1;
        Some(unquoted(&rest[..len]))
    }

    /// Takes and parses the next word.
    #[inline]
    pub(super) fn parse<T>(
        &mut self,
        expected: &'static str,
        parse: impl FnOnce(&'a [u8]) -> Option<T>,
    ) -> Result<T, Fault> {
        let before = *self;
        parse(self.word()).ok_or_else(|| before.fault(expected))
    }

    /// Takes a time and multiplies it by 10^`shift`.
    #[inline]
    pub(super) fn time(&mut self, shift: i32) -> Result<i64, Fault> {
        self.parse("a time below 9223372036 s", |word| scaled(word, shift))
    }

    /// Takes `len` data bytes, separated by blanks. `len` must be at most 64. The rest of the array is zero.
    #[inline]
    pub(super) fn data(&mut self, len: usize, base: Base) -> Result<[u8; MAX_DATA], Fault> {
        let mut data = [0; MAX_DATA];
        for byte in &mut data[..len] {
            let before = *self;
            *byte = match base {
                Base::Hex => hex_byte(self.word()).ok_or_else(|| before.fault("a data byte of 2 hex digits"))?,
                Base::Dec => {
                    let word = self.word();
                    let is_cut = !self.is_whole && self.at == self.text.len();
                    let value = number(word, Base::Dec).filter(|_| !is_cut);
                    let value = value.and_then(|value| u8::try_from(value).ok());
                    value.ok_or_else(|| before.fault("a data byte of 0 to 255"))?
                }
            };
        }
        Ok(data)
    }
}

/// A field without blanks and quotation marks around it.
fn unquoted(field: &[u8]) -> &[u8] {
    let field = field.trim_ascii();
    field.strip_prefix(b"\"").and_then(|inner| inner.strip_suffix(b"\"")).unwrap_or(field)
}

/// Parses an integer; `None` if it exceeds 32 bits. `0x` before a hexadecimal number is accepted.
#[inline]
pub(super) fn number(text: &[u8], base: Base) -> Option<u32> {
    let (digits, radix) = match (text, base) {
        ([b'0', b'x' | b'X', digits @ ..], _) => (digits, 16),
        (_, Base::Hex) => (text, 16),
        (_, Base::Dec) => (text, 10),
    };
    if digits.is_empty() {
        return None;
    }
    digits.iter().try_fold(0_u32, |value, &byte| {
        let digit = u32::from(HEX[usize::from(byte)]);
        if digit < radix { value.checked_mul(radix)?.checked_add(digit) } else { None }
    })
}

/// Parses a byte of exactly two hex digits.
#[inline]
pub(super) fn hex_byte(text: &[u8]) -> Option<u8> {
    let &[high, low] = text else { return None };
    let [high, low] = [HEX[usize::from(high)], HEX[usize::from(low)]];
    (high < 16 && low < 16).then_some(high << 4 | low)
}

/// Parses data bytes without blanks between them, at most 64. Returns the bytes, followed by zeros, and their number.
pub(super) fn joined_bytes(text: &[u8]) -> Option<([u8; MAX_DATA], usize)> {
    let mut data = [0; MAX_DATA];
    if !text.len().is_multiple_of(2) || text.len() > 2 * MAX_DATA {
        return None;
    }
    for (byte, digits) in data.iter_mut().zip(text.chunks_exact(2)) {
        *byte = hex_byte(digits)?;
    }
    Some((data, text.len() / 2))
}

/// Parses a decimal number and multiplies it by 10^`shift`. Digits below 1 are cut off. Accepts a decimal point or comma,
/// a sign and an exponent. `None` if the result exceeds 64 bits.
#[inline]
pub(super) fn scaled(text: &[u8], shift: i32) -> Option<i64> {
    let (is_negative, digits) = match text {
        [b'-', digits @ ..] => (true, digits),
        [b'+', digits @ ..] => (false, digits),
        digits => (false, digits),
    };
    let (mut value, mut decimals, mut has_digit, mut has_point, mut exponent) = (0_i64, 0, false, false, 0);
    for (index, &byte) in digits.iter().enumerate() {
        match byte {
            b'0'..=b'9' => {
                has_digit = true;
                let longer = value.checked_mul(10).and_then(|value| value.checked_add(i64::from(byte - b'0')));
                if !has_point {
                    value = longer?;
                } else if let Some(longer) = longer.filter(|_| decimals < 18) {
                    (value, decimals) = (longer, decimals + 1);
                }
            }
            b'.' | b',' if !has_point => has_point = true,
            b'e' | b'E' => {
                exponent = std::str::from_utf8(&digits[index + 1..]).ok()?.parse::<i16>().ok()?;
                break;
            }
            _ => return None,
        }
    }
    let shift = shift - decimals + i32::from(exponent);
    let power = 10_i64.checked_pow(shift.unsigned_abs());
    let value = match (value, power) {
        (0, _) => 0,
        (value, Some(power)) if shift >= 0 => value.checked_mul(power)?,
        (value, Some(power)) => value / power,
        (_, None) if shift < 0 => 0,
        (_, None) => return None,
    };
    has_digit.then_some(if is_negative { -value } else { value })
}

/// An identifier; `None` if it is out of range.
#[inline]
pub(super) fn identifier(raw: u32, is_extended: bool) -> Option<CanId> {
    if is_extended { CanId::extended(raw) } else { CanId::standard(raw) }
}

/// Length of the payload for a data length code, bytes; `None` above 15.
pub(super) fn fd_length(code: u32) -> Option<usize> {
    FD_LENGTHS.get(code as usize).copied()
}

/// A data frame without flags: classic up to 8 bytes, FD above. `len` must be at most 64.
pub(super) fn frame(id: CanId, len: usize, data: &[u8; MAX_DATA]) -> Option<Frame> {
    if len <= 8 { Frame::classic(id, &data[..len]) } else { Frame::fd_padded(id, false, false, len, data) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decimal_text_is_scaled_without_rounding_error() {
        let cases: [(&str, i32, Option<i64>); 17] = [
            ("1700000000.123456", 9, Some(1_700_000_000_123_456_000)),
            ("1700000000.1234567891", 9, Some(1_700_000_000_123_456_789)),
            ("1000000000", 9, Some(1_000_000_000_000_000_000)),
            ("0.000001", 9, Some(1_000)),
            ("12,5", 9, Some(12_500_000_000)),
            ("2.3e-05", 9, Some(23_000)),
            ("1e+2", 9, Some(100_000_000_000)),
            ("1e-300", 9, Some(0)),
            ("0e9999", 9, Some(0)),
            ("1059.9", 6, Some(1_059_900_000)),
            ("-0.5", 9, Some(-500_000_000)),
            (".5", 9, Some(500_000_000)),
            ("9223372037", 9, None),
            ("1e300", 9, None),
            ("", 9, None),
            (".", 9, None),
            ("1.2.3", 9, None),
        ];
        for (text, shift, expected) in cases {
            assert_eq!(scaled(text.as_bytes(), shift), expected, "{text}");
        }
    }

    #[test]
    fn numbers_out_of_range_are_refused() {
        assert_eq!(number(b"1FFFFFFF", Base::Hex), Some(0x1FFF_FFFF));
        assert_eq!(number(b"0x10", Base::Dec), Some(16));
        for text in ["", "0x", "100000000", "12G", "-1"] {
            assert_eq!(number(text.as_bytes(), Base::Hex), None, "{text}");
        }
        assert_eq!(number(b"4294967296", Base::Dec), None);
    }

    #[test]
    fn fault_states_column_found_and_expected() {
        let mut line = Cursor::new(b"1.5  zz");
        assert_eq!(line.time(9), Ok(1_500_000_000));
        let fault = line.data(1, Base::Hex).expect_err("not a byte");
        assert_eq!(fault.describe(line.text), "column 6: found \"zz\", expected a data byte of 2 hex digits");
        let cut = Cursor { is_whole: false, ..Cursor::new(b"16") };
        assert!({ cut }.data(1, Base::Dec).is_err(), "162 may have been cut to 16");
    }
}
