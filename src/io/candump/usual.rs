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
    /// The interface's name, if it is what [`name_key`] gives for one; anything else may have a line's end in it, and is none.
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
    if !(1..=7).contains(&name.len()) || name.contains(&b' ') || name.contains(&b'\n') {
        return None;
    }
    let mut bytes = [0; 8];
    bytes[..name.len()].copy_from_slice(name);
    bytes[name.len()] = b' ';
    Some(u64::from_le_bytes(bytes))
}

/// Reads usual lines; remembers the second of the last one, since thousands of lines share it.
#[derive(Debug, Clone, Default)]
pub(crate) struct UsualLines {
    /// The first twelve bytes of the last line, up to the decimal point, as two words that overlap.
    head: [u64; 2],
    second_ns: u64,
}

impl UsualLines {
    /// Reads the first line of `text`; `None` where it is none of the usual ones, or too little text is left to tell.
    #[inline(always)]
    pub(crate) fn parse(&mut self, text: &[u8]) -> Option<Usual> {
        let text: &[u8; WINDOW] = text.first_chunk()?;
        let head = [word(text, 0), word(text, 4)];
        if head != self.head {
            self.second_ns = second_ns(text)?;
            self.head = head;
        }
        let (fraction_ns, name_at) = fraction_ns(text)?;
        rest(text, Timestamp::from_nanos((self.second_ns + fraction_ns).cast_signed()), name_at)
    }
}

/// What follows the stamp.
#[inline(always)]
fn rest(text: &[u8; WINDOW], time: Timestamp, name_at: usize) -> Option<Usual> {
    let (name_key, name_len) = name(word(text, name_at))?;
    let (id, at) = identifier(text, name_at + name_len + 1)?;
    if text[at + 16] == b'\n' {
        let payload = hex_sixteen(text.get(at..at + 16)?.first_chunk()?)?;
        return Some(Usual { time, name_key, id, payload, payload_len: 8, line_len: at + 17 });
    }
    let (first, second) = (hex_word(word(text, at)), hex_word(word(text, at + 8)));
    let all = first.value | second.value << 32;
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

/// `(`, ten digits, `.` at the start of the text, in nanoseconds.
fn second_ns(text: &[u8; WINDOW]) -> Option<u64> {
    let hundreds = digits(word(text, 1))?;
    let [tens, ones] = [text[9], text[10]].map(|byte| u64::from(byte.wrapping_sub(b'0')));
    if text[0] != b'(' || text[11] != b'.' || tens > 9 || ones > 9 || hundreds > MAX_HUNDREDS {
        return None;
    }
    // At most 92,233,719.99 x 1e11, below 2^63 by more than a second.
    Some((hundreds * 100 + tens * 10 + ones) * 1_000_000_000)
}

/// Six or nine digits and `) ` from byte 12 on, in nanoseconds; the place after it.
#[inline(always)]
fn fraction_ns(text: &[u8; WINDOW]) -> Option<(u64, usize)> {
    // Two zeros before the six digits make a word of eight.
    let word = (word(text, 11) << 8) & !0xFFFF | (ZEROS & 0xFFFF);
    let nanos = digits(word)? * 1000;
    if text[18] == b')' {
        return (text[19] == b' ').then_some((nanos, 20));
    }
    let [a, b, c] = [text[18], text[19], text[20]].map(|byte| u64::from(byte.wrapping_sub(b'0')));
    let is_good = a <= 9 && b <= 9 && c <= 9 && text[21] == b')' && text[22] == b' ';
    is_good.then_some((nanos + 100 * a + 10 * b + c, 23))
}

/// The number that eight digits make, the first byte the highest.
#[inline(always)]
fn digits(text: u64) -> Option<u64> {
    let digits = text ^ ZEROS;
    if (digits | digits.wrapping_add(0x76 * ONES)) & HIGHS != 0 {
        return None;
    }
    let pairs = (digits.wrapping_mul(10 << 8 | 1) >> 8) & 0x00FF_00FF_00FF_00FF;
    let fours = (pairs.wrapping_mul(100 << 16 | 1) >> 16) & 0x0000_FFFF_0000_FFFF;
    Some(fours.wrapping_mul(10_000 << 32 | 1) >> 32)
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

/// Eight bytes of two hex digits each, the first lowest. Loops over sixteen bytes: the compiler makes one instruction of each.
#[inline(always)]
fn hex_sixteen(text: &[u8; 16]) -> Option<u64> {
    let digits: [u8; 16] = std::array::from_fn(|i| text[i].wrapping_sub(b'0'));
    let letters: [u8; 16] = std::array::from_fn(|i| (text[i] | 0x20).wrapping_sub(b'a'));
    let bad: [u8; 16] = std::array::from_fn(|i| u8::from(digits[i] > 9) & u8::from(letters[i] > 5));
    let values: [u8; 16] = std::array::from_fn(|i| if digits[i] > 9 { letters[i].wrapping_add(10) } else { digits[i] });
    if u128::from_ne_bytes(bad) != 0 {
        return None;
    }
    let (first, second) = values.split_at(8);
    let word = |bytes: &[u8]| bytes.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes));
    Some(packed(word(first)) | packed(word(second)) << 32)
}

/// Eight values below 16, in pairs of which the first is the upper half, as four bytes.
#[inline(always)]
fn packed(nibbles: u64) -> u64 {
    let pairs = (nibbles << 4 | nibbles >> 8) & 0x00FF_00FF_00FF_00FF;
    let fours = (pairs | pairs >> 8) & 0x0000_FFFF_0000_FFFF;
    (fours | fours >> 16) & 0xFFFF_FFFF
}

#[inline(always)]
fn hex_word(word: u64) -> HexWord {
    // Lanes hold at most 0x7F before each addition, so that none carries into the next.
    let low = word & !HIGHS;
    let no_digit = (low ^ ZEROS).wrapping_add(0x76 * ONES);
    let letter = (low | (0x20 * ONES)) ^ (0x60 * ONES);
    let letters = letter.wrapping_add(0x7F * ONES) & !letter.wrapping_add(0x79 * ONES) & HIGHS;
    let bad = ((no_digit & !letters) | word) & HIGHS;
    HexWord { bad, value: packed((word & (0x0F * ONES)) + (letters >> 7) * 9) }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::{Line, parse_line};
    use super::*;

    /// What follows in the log, so that the window is full.
    const MORE: &str = "(1700000000.123456) can0 123#1122334455667788\n(1700000000.123457) can0 123#\n";

    /// The line as the quick way reads it, checked against the full grammar: whatever it says must be the same.
    fn quick(lines: &mut UsualLines, line: &[u8]) -> Option<Usual> {
        let text = [line, b"\n", MORE.as_bytes()].concat();
        let usual = lines.parse(&text)?;
        if usual.name_key.to_le_bytes().contains(&b'\n') {
            return None;
        }
        let first = memchr::memchr(b'\n', &text).expect("there is one");
        assert_eq!(usual.line_len, first + 1, "{:?}", String::from_utf8_lossy(line));
        let Ok(Line::Frame { time, interface, frame, .. }) = parse_line(&text[..first]) else {
            panic!("no frame: {:?}", String::from_utf8_lossy(line));
        };
        assert_eq!((usual.time, Some(usual.name_key), usual.frame()), (time, name_key(interface), frame));
        Some(usual)
    }

    fn digit() -> impl Strategy<Value = u8> {
        prop::sample::select(b"0123456789ABCDEFabcdef".to_vec())
    }

    /// Usual lines; the parts that vary, in all their lengths.
    fn usual_line() -> impl Strategy<Value = Vec<u8>> {
        let stamp = (0..9_223_371_999u64, prop_oneof!["[0-9]{6}", "[0-9]{9}"]);
        let id = prop_oneof!["[0-7][0-9A-Fa-f]{2}", "[01][0-9A-Fa-f]{7}"];
        let payload = (0..=8usize).prop_flat_map(|len| prop::collection::vec(digit(), 2 * len));
        (stamp, "[!-~]{1,7}", id, payload, prop::sample::select(vec!["", "\r"])).prop_map(
            |((s, f), name, id, payload, end)| {
                [format!("({s:010}.{f}) {name} {id}#").as_bytes(), &payload, end.as_bytes()].concat()
            },
        )
    }

    proptest! {
        #[test]
        fn usual_lines_are_read_the_quick_way(lines in prop::collection::vec(usual_line(), 1..5)) {
            let mut reader = UsualLines::default();
            for line in lines {
                prop_assert!(quick(&mut reader, &line).is_some(), "{}", String::from_utf8_lossy(&line));
            }
        }

        #[test]
        fn a_line_with_wrong_bytes_is_read_as_the_full_grammar_reads_it_or_not_at_all(
            line in usual_line(),
            changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4),
            cut in prop::option::of(any::<prop::sample::Index>()),
        ) {
            let mut changed = line.clone();
            for (at, byte) in changes {
                let at = at.index(changed.len());
                changed[at] = byte;
            }
            changed.truncate(cut.map_or(changed.len(), |cut| cut.index(changed.len() + 1)));
            let mut reader = UsualLines::default();
            quick(&mut reader, &changed);
            quick(&mut reader, &line);
            quick(&mut reader, &changed);
        }

        #[test]
        fn any_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = UsualLines::default().parse(&bytes);
        }
    }

    #[test]
    fn every_byte_at_every_place_of_a_line_is_judged_as_the_full_grammar_does() {
        for line in
            [&b"(1700000000.123456) can0 7FF#00112233445566fF"[..], b"(9223371999.999999999) vcan10 1FFFFFFf#aB\r"]
        {
            let mut reader = UsualLines::default();
            assert!(quick(&mut reader, line).is_some());
            for at in 0..line.len() {
                for byte in 0..=u8::MAX {
                    let mut changed = line.to_vec();
                    changed[at] = byte;
                    quick(&mut reader, &changed);
                }
            }
        }
    }

    #[test]
    fn stamps_at_the_end_of_the_range_are_left_to_the_full_grammar() {
        let mut reader = UsualLines::default();
        assert!(quick(&mut reader, b"(9223371999.999999999) can0 123#").is_some());
        for line in
            ["(9223372036.854775807) can0 123#", "(9223372036.854775808) can0 123#", "(9999999999.999999) can0 123#"]
        {
            quick(&mut reader, line.as_bytes());
        }
    }
}
