//! Fast parser of the line that nearly every log consists of, `(1700000000.123456) can0 123#1122334455667788`, read eight bytes at a time.
//!
//! In: text that begins with a line. Out: the result of the full grammar for that line, or `None`, which means "use the full
//! grammar". Known are only: a stamp of ten digits with six or nine decimals, one space, a name of 1 to 7 bytes, one space, a
//! standard or extended identifier, and up to eight bytes of payload. Numbers are
//! converted several bytes at a time (as lanes of a `u64`, the first byte lowest, or by loops that become vectors).

use crate::can::{CanId, Frame};
use crate::quantity::{BusIndex, Timestamp};

/// Every byte of a word 1, and its highest bit.
const ONES: u64 = 0x0101_0101_0101_0101;
const HIGHS: u64 = 0x8080_8080_8080_8080;
/// The digit 0 in every byte.
const ZEROS: u64 = b'0' as u64 * ONES;
/// Bytes that are looked at: the longest usual line has 58. Where less text is left, the full grammar reads it.
const WINDOW: usize = 64;
/// Bytes that are looked at from the identifier on: at most 23 of stamp and 8 of name come before.
const BODY: usize = 32;
/// Bytes that are looked at from the payload on: sixteen digits, carriage return, line feed.
const PAYLOAD: usize = 18;
/// Seconds are eight digits and two: up to this many hundreds no nanosecond count overflows.
const MAX_HUNDREDS: u64 = 92_233_719;

/// A usual line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct FastLine {
    /// Its stamp.
    pub time: Timestamp,
    /// Its interface.
    pub bus: BusIndex,
    /// Identifier.
    pub id: CanId,
    /// Payload bytes, the first lowest, zeros above.
    pub payload: u64,
    /// Number of payload bytes, 0 to 8.
    pub payload_len: u8,
    /// Length of the line with its line feed.
    pub line_len: usize,
}

impl FastLine {
    /// The frame.
    #[inline(always)]
    pub(crate) fn frame(&self) -> Frame {
        Frame::of_word(self.id, self.payload, self.payload_len)
    }
}

/// An interface with a name of up to seven bytes, ready to be found.
#[derive(Debug, Clone, Copy)]
struct Interface {
    /// The name and the space that ends it; two names have the same word only if they are the same.
    name: u64,
    /// The bytes of a word that these are.
    mask: u64,
    /// Number of these bytes.
    len: u8,
    bus: BusIndex,
}

impl Interface {
    /// `None` for names that no usual line has.
    fn new(name: &[u8], bus: BusIndex) -> Option<Self> {
        if !(1..=7).contains(&name.len()) || name.contains(&b' ') || name.contains(&b'\n') {
            return None;
        }
        let mut bytes = [0; 8];
        bytes[..name.len()].copy_from_slice(name);
        bytes[name.len()] = b' ';
        let mask = u64::MAX >> (56 - 8 * name.len());
        Some(Self { name: u64::from_le_bytes(bytes), mask, len: name.len() as u8 + 1, bus })
    }
}

/// Two words that no line begins with: where they overlap, they differ.
const NO_HEAD: [u64; 2] = [0, u64::MAX];

/// Reads usual lines of known interfaces; remembers the second of the last one, since thousands of lines share it.
#[derive(Debug, Clone)]
pub(crate) struct FastLineParser {
    interfaces: Vec<Interface>,
    shift_ns: i64,
    /// The first twelve bytes of the last line, up to the decimal point, as two words that overlap.
    head: [u64; 2],
    /// That second, shifted, ns.
    second_ns: i64,
}

impl FastLineParser {
    /// A parser for interfaces of these names, in the order of their numbers.
    pub(crate) fn new(interfaces: &[String]) -> Self {
        let mut lines = Self { interfaces: Vec::new(), shift_ns: 0, head: NO_HEAD, second_ns: 0 };
        lines.know(interfaces);
        lines
    }

    /// Replaces the interfaces.
    pub(crate) fn know(&mut self, interfaces: &[String]) {
        let numbered = (0..u8::MAX).map(BusIndex).zip(interfaces);
        self.interfaces = numbered.filter_map(|(bus, name)| Interface::new(name.as_bytes(), bus)).collect();
    }

    /// Moves all further stamps by `shift_ns`.
    pub(crate) fn shift(&mut self, shift_ns: i64) {
        (self.shift_ns, self.head) = (shift_ns, NO_HEAD);
    }

    /// Reads the first line of `text`; `None` where it has another form, or too little text is left.
    #[inline(always)]
    pub(crate) fn parse(&mut self, text: &[u8]) -> Option<FastLine> {
        let text: &[u8; WINDOW] = text.first_chunk()?;
        let head = [word(text, 0), word(text, 4)];
        if head != self.head {
            self.begin_second(text, head)?;
        }
        let (fraction_ns, name_at) = match micros_ns(word(text, 12)) {
            Some(nanos) => (nanos, 20),
            None => (nine_digits(text)?, 23),
        };
        let time = Timestamp::from_nanos(self.second_ns + fraction_ns.cast_signed());
        // The position after the name depends on its length. Comparing known names lets the processor predict it; counting would
        // make it wait.
        let name = word(text, name_at);
        let is_known = |known: &&Interface| name & known.mask == known.name;
        // Most logs are of one interface: no loop for the first.
        let interface =
            self.interfaces.first().filter(is_known).or_else(|| self.interfaces.iter().skip(1).find(is_known))?;
        let body_at = name_at + usize::from(interface.len);
        let body: &[u8; BODY] = text.get(body_at..body_at + BODY)?.first_chunk()?;
        if body[3] != b'#' {
            return extended(body, time, interface.bus, body_at);
        }
        let [high, middle, low] = [0, 1, 2].map(|place: usize| u32::from(ID_DIGITS[place][usize::from(body[place])]));
        payload::<4>(body, CanId::standard(high | middle | low)?, time, interface.bus, body_at)
    }

    /// A line with another second than the last one.
    #[inline(never)]
    fn begin_second(&mut self, text: &[u8; WINDOW], head: [u64; 2]) -> Option<()> {
        let second_ns = second_ns(text)?.cast_signed().checked_add(self.shift_ns)?;
        // Any fraction of it fits as well.
        second_ns.checked_add(1_000_000_000)?;
        (self.second_ns, self.head) = (second_ns, head);
        Some(())
    }
}

/// An identifier of eight digits and what follows it.
#[inline(never)]
fn extended(body: &[u8; BODY], time: Timestamp, bus: BusIndex, body_at: usize) -> Option<FastLine> {
    let digits = hex_word(word(body, 0));
    if digits.bad != 0 || body[8] != b'#' {
        return None;
    }
    let id = CanId::extended(u32::try_from(digits.value).ok()?.swap_bytes())?;
    payload::<9>(body, id, time, bus, body_at)
}

/// The payload, which begins `AT` bytes after where the identifier begins, and the line's end.
#[inline(always)]
fn payload<const AT: usize>(
    body: &[u8; BODY],
    id: CanId,
    time: Timestamp,
    bus: BusIndex,
    body_at: usize,
) -> Option<FastLine> {
    let text: &[u8; PAYLOAD] = body[AT..].first_chunk()?;
    let (payload, payload_len, len) =
        if text[16] == b'\n' { (hex_sixteen(text.first_chunk()?)?, 8, 17) } else { short_payload(text)? };
    Some(FastLine { time, bus, id, payload, payload_len, line_len: body_at + AT + len })
}

/// Eight bytes of the text; zeros beyond its end, which no caller reaches.
#[inline(always)]
fn word(text: &[u8], at: usize) -> u64 {
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

/// Six digits and `) `, in nanoseconds.
#[inline(always)]
fn micros_ns(text: u64) -> Option<u64> {
    const ZERO: u64 = u64::from_le_bytes(*b"000000) ");
    // Bytes that are right become 0 to 9, and 0 where there is no choice. Added to these, no wrong one stays below 0x80.
    const WRONG: u64 = 0x7F7F_7676_7676_7676;
    let digits = text ^ ZERO;
    if (digits | digits.wrapping_add(WRONG)) & HIGHS != 0 {
        return None;
    }
    // Two zeros before the six digits make eight.
    Some(number::<1000>(digits << 16))
}

/// Nine digits and `) ` from byte 12 on, in nanoseconds.
fn nine_digits(text: &[u8; WINDOW]) -> Option<u64> {
    let nanos = digits(word(text, 12))? * 10;
    let last = u64::from(text[20].wrapping_sub(b'0'));
    (last <= 9 && text[21] == b')' && text[22] == b' ').then_some(nanos + last)
}

/// The number that eight digits make, the first byte the highest.
#[inline(always)]
fn digits(text: u64) -> Option<u64> {
    let digits = text ^ ZEROS;
    if (digits | digits.wrapping_add(0x76 * ONES)) & HIGHS != 0 {
        return None;
    }
    Some(number::<1>(digits))
}

/// The number that eight bytes of 0 to 9 make, the first the highest, times `UNIT`; below 2^32 with it.
#[inline(always)]
fn number<const UNIT: u64>(digits: u64) -> u64 {
    let pairs = (digits.wrapping_mul(10 << 8 | 1) >> 8) & 0x00FF_00FF_00FF_00FF;
    let fours = (pairs.wrapping_mul(100 << 16 | 1) >> 16) & 0x0000_FFFF_0000_FFFF;
    fours.wrapping_mul((10_000 * UNIT) << 32 | UNIT) >> 32
}

/// Value of a hex digit in the first, second and third place of a standard identifier; above all identifiers for other bytes.
static ID_DIGITS: [[u16; 256]; 3] = {
    let mut table = [[u16::MAX; 256]; 3];
    let mut byte = 0;
    while byte < 256 {
        let digit = super::HEX[byte] as u16;
        if digit < 16 {
            table[0][byte] = digit << 8;
            table[1][byte] = digit << 4;
            table[2][byte] = digit;
        }
        byte += 1;
    }
    table
};

/// Up to eight bytes of payload and the line's end; how many bytes, and the length of all that. (Eight come here before a
/// carriage return.)
#[inline(never)]
fn short_payload(text: &[u8; PAYLOAD]) -> Option<(u64, u8, usize)> {
    let (first, second) = (hex_word(word(text, 0)), hex_word(word(text, 8)));
    let all = first.value | second.value << 32;
    let digits = if first.bad != 0 { first.good() } else { 8 + second.good() };
    let line_feed = digits + usize::from(text[digits] == b'\r');
    if text[line_feed] != b'\n' || digits % 2 != 0 {
        return None;
    }
    let payload_len = digits / 2;
    // Bytes beyond the payload are what bytes that are no digits happened to give.
    let payload = if payload_len == 8 { all } else { all & !(u64::MAX << (8 * payload_len)) };
    Some((payload, payload_len as u8, line_feed + 1))
}

/// Eight bytes of two hex digits each, the first lowest. Loops over sixteen bytes: the compiler makes one instruction of each
/// step.
#[inline(always)]
fn hex_sixteen(text: &[u8; 16]) -> Option<u64> {
    let (mut values, mut wrong) = ([0; 16], [0; 16]);
    for ((&byte, value), wrong) in text.iter().zip(&mut values).zip(&mut wrong) {
        // 0 to 9 for a digit, at least 16 for anything else.
        let digit = byte.wrapping_add(0xFF - b'9').saturating_sub(6).wrapping_sub(0xF0);
        // 10 to 15 for a letter, at least 16 for anything else.
        let letter = (byte & 0xDF).wrapping_sub(b'A').saturating_add(10);
        *value = digit.min(letter);
        *wrong = *value & 0xF0;
    }
    if u128::from_ne_bytes(wrong) != 0 {
        return None;
    }
    let (first, second) = values.split_at(8);
    let [first, second] = packed([word(first, 0), word(second, 0)]);
    Some(first & 0xFFFF_FFFF | second << 32)
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
    let letter = (low | (0x20 * ONES)) ^ (0x60 * ONES);
    let letters = letter.wrapping_add(0x7F * ONES) & !letter.wrapping_add(0x79 * ONES) & HIGHS;
    let bad = ((no_digit & !letters) | word) & HIGHS;
    let [value] = packed([(word & (0x0F * ONES)) + (letters >> 7) * 9]);
    HexWord { bad, value: value & 0xFFFF_FFFF }
}

/// Of each word eight values below 16, in pairs of which the first is the upper half, as four bytes; what is above them means
/// nothing. Step by step over all words, for the compiler's sake as in [`hex_sixteen`].
#[inline(always)]
fn packed<const N: usize>(mut words: [u64; N]) -> [u64; N] {
    for word in &mut words {
        // Twelve bits up, the upper half comes to stand above the lower one.
        *word = (word.wrapping_mul(0x1001) >> 8) & 0x00FF_00FF_00FF_00FF;
    }
    for word in &mut words {
        *word = (*word | *word >> 8) & 0x0000_FFFF_0000_FFFF;
    }
    for word in &mut words {
        *word |= *word >> 16;
    }
    words
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::{Line, parse_line};
    use super::*;

    /// What follows in the log, so that the window is full.
    const MORE: &str = "(1700000000.123456) can0 123#1122334455667788\n(1700000000.123457) can0 123#\n";

    /// The line as the quick way reads it, checked against the full grammar: whatever it says must be the same. The line's
    /// interface is made known, with the number 1, if it can be.
    fn quick(lines: &mut FastLineParser, line: &[u8]) -> Option<FastLine> {
        let text = [line, b"\n", MORE.as_bytes()].concat();
        let first = memchr::memchr(b'\n', &text).expect("there is one");
        let plain = parse_line(&text[..first]);
        let name = match plain {
            Ok(Line::Frame { interface, .. }) => String::from_utf8_lossy(interface).into_owned(),
            _ => "can0".to_owned(),
        };
        lines.know(&["none".to_owned(), name.clone()]);
        let usual = lines.parse(&text)?;
        let Ok(Line::Frame { time, interface, frame, .. }) = plain else {
            panic!("no frame: {:?}", String::from_utf8_lossy(line));
        };
        let found = (usual.line_len, usual.time, usual.bus, usual.frame());
        let bus = BusIndex(u8::from(interface != b"none"));
        assert_eq!(found, (first + 1, time, bus, frame), "{:?}", String::from_utf8_lossy(line));
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
            let mut reader = FastLineParser::new(&[]);
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
            let mut reader = FastLineParser::new(&[]);
            quick(&mut reader, &changed);
            quick(&mut reader, &line);
            quick(&mut reader, &changed);
        }

        #[test]
        fn any_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = FastLineParser::new(&[]).parse(&bytes);
        }
    }

    #[test]
    fn every_byte_at_every_place_of_a_line_is_judged_as_the_full_grammar_does() {
        for line in
            [&b"(1700000000.123456) can0 7FF#00112233445566fF"[..], b"(9223371999.999999999) vcan10 1FFFFFFf#aB\r"]
        {
            let mut reader = FastLineParser::new(&[]);
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
    fn unknown_interfaces_are_left_to_the_full_grammar() {
        let line = |name: &str| format!("(1700000000.123456) {name} 123#11\n{MORE}");
        let mut reader =
            FastLineParser::new(&["can1".to_owned(), "a name".to_owned(), "vcan10".to_owned(), String::new()]);
        let mut bus = |name: &str| reader.parse(line(name).as_bytes()).map(|usual| usual.bus);
        assert_eq!((bus("can1"), bus("vcan10")), (Some(BusIndex(0)), Some(BusIndex(2))));
        for name in ["can0", "can", "can10", "vcan1", "vcan100", "a name", "a", "", "can1\n"] {
            assert_eq!(bus(name), None, "{name:?}");
        }
    }

    #[test]
    fn a_first_line_without_a_stamp_is_left_to_the_full_grammar() {
        for byte in 0..=u8::MAX {
            let mut reader = FastLineParser::new(&["can0".to_owned()]);
            let line = [&[byte; 12][..], b"123456) can0 123#1122\n", MORE.as_bytes()].concat();
            assert_eq!(reader.parse(&line), None, "{byte:#x}");
        }
    }

    #[test]
    fn stamps_are_moved_from_the_next_line_on_or_left_to_the_full_grammar() {
        let line = format!("(9223371999.999999) can0 123#11\n{MORE}");
        let mut reader = FastLineParser::new(&["can0".to_owned()]);
        let mut time = |shift_ns| {
            reader.shift(shift_ns);
            reader.parse(line.as_bytes()).map(|usual| usual.time.nanos())
        };
        let raw = 9_223_371_999_999_999_000;
        assert_eq!((time(0), time(-5), time(5)), (Some(raw), Some(raw - 5), Some(raw + 5)));
        assert_eq!((time(i64::MAX), time(0)), (None, Some(raw)), "beyond the range of stamps");
    }

    #[test]
    fn stamps_at_the_end_of_the_range_are_left_to_the_full_grammar() {
        let mut reader = FastLineParser::new(&[]);
        assert!(quick(&mut reader, b"(9223371999.999999999) can0 123#").is_some());
        for line in
            ["(9223372036.854775807) can0 123#", "(9223372036.854775808) can0 123#", "(9999999999.999999) can0 123#"]
        {
            quick(&mut reader, line.as_bytes());
        }
    }
}
