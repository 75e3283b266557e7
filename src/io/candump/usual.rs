//! The line that nearly every log consists of, `(1700000000.123456) can0 123#1122334455667788`, read eight bytes at a time.
//!
//! In: text that begins with a line. Out: what the full grammar gives for that line, or `None`, which says nothing but "use
//! the full grammar": a stamp of ten digits with six or nine decimals, one space, a name of 1 to 7 bytes, one space, a
//! standard or extended identifier, and up to eight bytes of payload are all that is known here. The numbers are
//! converted a word at a time (bytes of a `u64` as lanes), with the first byte of the text lowest.

use crate::can::{CanId, Frame};
use crate::quantity::Timestamp;

/// Every byte of a word 1, and its highest bit.
const ONES: u64 = 0x0101_0101_0101_0101;
const HIGHS: u64 = 0x8080_8080_8080_8080;
/// The digit 0 in every byte.
const ZEROS: u64 = b'0' as u64 * ONES;
/// Bytes that are looked at: the longest usual line has 60. Where less text is left, the full grammar reads it.
const WINDOW: usize = 64;
/// Seconds are eight digits and two: up to this many hundreds no nanosecond count overflows.
const MAX_HUNDREDS: u64 = 92_233_719;

/// A usual line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Usual {
    /// Its stamp.
    pub(crate) time: Timestamp,
    /// The interface's name, see [`name_key`].
    pub(crate) name_key: u64,
    /// Identifier.
    pub(crate) id: CanId,
    /// Payload bytes, the first lowest, zeros above.
    pub(crate) payload: u64,
    /// How many, 0 to 8.
    pub(crate) payload_len: u8,
    /// Length of the line with its line feed.
    pub(crate) line_len: usize,
}

impl Usual {
    /// The frame.
    #[inline]
    pub(crate) fn frame(&self) -> Frame {
        Frame::of_word(self.id, self.payload, self.payload_len)
    }
}

/// A name of up to seven bytes and the space that ends it as one word; two names have the same key only if they are the
/// same. `None` for names that no usual line has.
pub(crate) fn name_key(name: &[u8]) -> Option<u64> {
    if !(1..=7).contains(&name.len()) || name.contains(&b' ') {
        return None;
    }
    let mut bytes = [0; 8];
    bytes[..name.len()].copy_from_slice(name);
    bytes[name.len()] = b' ';
    Some(u64::from_le_bytes(bytes))
}

/// Reads the first line of `text`; `None` where it is none of the usual ones, or too little text is left to tell.
#[inline]
pub(crate) fn parse(text: &[u8]) -> Option<Usual> {
    let text: &[u8; WINDOW] = text.first_chunk()?;
    let (time, name_at) = stamp(text)?;
    let (name_key, name_len) = name(word(text, name_at))?;
    let (id, at) = identifier(text, name_at + name_len + 1)?;
    let (first, second) = (hex_word(word(text, at)), hex_word(word(text, at + 8)));
    let all = first.value | second.value << 32;
    if first.bad | second.bad == 0 && text[at + 16] == b'\n' {
        return Some(Usual { time, name_key, id, payload: all, payload_len: 8, line_len: at + 17 });
    }
    let digits = if first.bad != 0 { first.good() } else { 8 + second.good() };
    let line_feed = at + digits + usize::from(text[at + digits] == b'\r');
    if text[line_feed] != b'\n' || digits % 2 != 0 {
        return None;
    }
    let payload_len = digits / 2;
    // Bytes beyond the payload are what bytes that are no digits happened to give.
    let payload = if payload_len == 8 { all } else { all & !(u64::MAX << (8 * payload_len)) };
    Some(Usual { time, name_key, id, payload, payload_len: payload_len as u8, line_len: line_feed + 1 })
}

/// Eight bytes of the text; zeros beyond its end, which no caller reaches.
#[inline(always)]
fn word(text: &[u8; WINDOW], at: usize) -> u64 {
    text.get(at..).and_then(|rest| rest.first_chunk()).map_or(0, |bytes| u64::from_le_bytes(*bytes))
}

/// `(`, ten digits, `.`, six or nine digits, `) ` at the start of the text: the time and the place after it.
#[inline(always)]
fn stamp(text: &[u8; WINDOW]) -> Option<(Timestamp, usize)> {
    let (hundreds, tens, fraction) = (word(text, 1), u16::from_le_bytes([text[9], text[10]]), word(text, 11));
    // The last two digits of the seconds and the six of the fraction make one word of eight digits.
    let rest = ((fraction << 8) & !0xFFFF) | u64::from(tens);
    let (hundreds, rest) = (hundreds ^ ZEROS, rest ^ ZEROS);
    let bad = (hundreds | hundreds.wrapping_add(0x76 * ONES) | rest | rest.wrapping_add(0x76 * ONES)) & HIGHS;
    if text[0] != b'(' || text[11] != b'.' || bad != 0 {
        return None;
    }
    let hundreds = decimal(hundreds);
    if hundreds > MAX_HUNDREDS {
        return None;
    }
    // At most 92,233,719 x 1e8 + 1e8 microseconds: 9.2e15, and a thousand times that is below 2^63.
    let nanos = (hundreds * 100_000_000 + decimal(rest)) * 1000;
    let (nanos, at) = if text[18] == b')' {
        (nanos, 19)
    } else {
        let [a, b, c] = [text[18], text[19], text[20]].map(|byte| u64::from(byte.wrapping_sub(b'0')));
        if a > 9 || b > 9 || c > 9 || text[21] != b')' {
            return None;
        }
        (nanos + 100 * a + 10 * b + c, 22)
    };
    (text[at] == b' ').then_some((Timestamp::from_nanos(nanos.cast_signed()), at + 1))
}

/// The number that eight digits (0 to 9, the first byte the highest) make.
#[inline(always)]
fn decimal(digits: u64) -> u64 {
    let pairs = (digits.wrapping_mul(10 << 8 | 1) >> 8) & 0x00FF_00FF_00FF_00FF;
    let fours = (pairs.wrapping_mul(100 << 16 | 1) >> 16) & 0x0000_FFFF_0000_FFFF;
    fours.wrapping_mul(10_000 << 32 | 1) >> 32
}

/// Key and length of the name that a word begins with.
#[inline(always)]
fn name(word: u64) -> Option<(u64, usize)> {
    let differs = word ^ (u64::from(b' ') * ONES);
    // The lowest flag is exact; those above it may be wrong.
    let spaces = differs.wrapping_sub(ONES) & !differs & HIGHS;
    let len = spaces.trailing_zeros() as usize / 8;
    if !(1..=7).contains(&len) {
        return None;
    }
    Some((word & (u64::MAX >> (56 - 8 * len)), len))
}

/// An identifier of three or eight digits and the `#` after it; the place after that.
#[inline(always)]
fn identifier(text: &[u8; WINDOW], at: usize) -> Option<(CanId, usize)> {
    if text[at + 3] == b'#' {
        let [a, b, c] = [text[at], text[at + 1], text[at + 2]].map(|byte| u32::from(super::HEX[usize::from(byte)]));
        if (a | b | c) > 15 {
            return None;
        }
        return Some((CanId::standard(a << 8 | b << 4 | c)?, at + 4));
    }
    let digits = hex_word(word(text, at));
    if digits.bad != 0 || text[at + 8] != b'#' {
        return None;
    }
    Some((CanId::extended(u32::try_from(digits.value).ok()?.swap_bytes())?, at + 9))
}

/// Eight bytes read as hex digits.
struct HexWord {
    /// The highest bit of every byte that is no digit.
    bad: u64,
    /// Four bytes, the first lowest; those of bytes that are no digits mean nothing. Below 2^32.
    value: u64,
}

impl HexWord {
    /// Digits before the first byte that is none.
    #[inline(always)]
    fn good(&self) -> usize {
        self.bad.trailing_zeros() as usize / 8
    }
}

#[inline(always)]
fn hex_word(word: u64) -> HexWord {
    // Lanes hold at most 0x7F before each addition, so that none carries into the next.
    let low = word & !HIGHS;
    let no_digit = (low ^ ZEROS).wrapping_add(0x76 * ONES);
    let letter = (low | 0x20 * ONES) ^ (0x60 * ONES);
    let letters = letter.wrapping_add(0x7F * ONES) & !letter.wrapping_add(0x79 * ONES) & HIGHS;
    let bad = ((no_digit & !letters) | word) & HIGHS;
    let nibbles = (word & (0x0F * ONES)) + (letters >> 7) * 9;
    let pairs = (nibbles << 4 | nibbles >> 8) & 0x00FF_00FF_00FF_00FF;
    let fours = (pairs | pairs >> 8) & 0x0000_FFFF_0000_FFFF;
    HexWord { bad, value: (fours | fours >> 16) & 0xFFFF_FFFF }
}
