//! Converts the digits of a candump line several bytes at a time. Some functions treat a `u64` as eight lanes of one
//! byte each, with the first byte of the text in the lowest lane. Others use loops that compile to vector instructions.

/// `ONES` is a word with the value 1 in every byte. `HIGHS` is a word in which only the highest bit of every byte is
/// set.
const ONES: u64 = 0x0101_0101_0101_0101;
const HIGHS: u64 = 0x80 * ONES;

/// Value of each hex digit. For any other character, the value is so large that an identifier computed from it is out
/// of range.
pub(super) static HEX: [u32; 256] = {
    let mut table = [u16::MAX as u32; 256];
    let mut digit = 0;
    while digit < 16 {
        table[b"0123456789ABCDEF"[digit] as usize] = digit as u32;
        table[b"0123456789abcdef"[digit] as usize] = digit as u32;
        digit += 1;
    }
    table
};

/// Returns eight bytes of the text from `at` as a word; 0 if the text ends earlier.
#[inline(always)]
pub(super) fn word(text: &[u8], at: usize) -> u64 {
    text.get(at..).and_then(|rest| rest.first_chunk()).map_or(0, |bytes| u64::from_le_bytes(*bytes))
}

/// Parses six digits followed by `) `; the result is in nanoseconds.
#[inline(always)]
pub(super) fn six_decimals(text: u64) -> Option<i64> {
    // The shift removes the `) ` and puts two zeros before the six digits, so there are eight digits.
    lanes(text ^ u64::from_le_bytes(*b"000000) "), 0x7F7F_7676_7676_7676).map(|digits| number::<1000>(digits << 16))
}

/// Converts eight decimal digits, most significant first, to a number.
#[inline(always)]
pub(super) fn eight_digits(text: u64) -> Option<i64> {
    lanes(text ^ (u64::from(b'0') * ONES), 0x76 * ONES).map(number::<1>)
}

/// Returns `lanes` if all lanes are valid, otherwise `None`. A lane is valid if it is below 0x80, both before and after
/// `wrong` is added. The caller chooses `wrong` so that the addition moves every value above the largest valid one to
/// 0x80 or more.
#[inline(always)]
fn lanes(lanes: u64, wrong: u64) -> Option<u64> {
    ((lanes | lanes.wrapping_add(wrong)) & HIGHS == 0).then_some(lanes)
}

/// Converts eight lanes of 0 to 9, most significant first, to a number and multiplies it by `UNIT`. The result must be
/// below 2^32.
#[inline(always)]
fn number<const UNIT: u64>(digits: u64) -> i64 {
    let pairs = (digits.wrapping_mul(10 << 8 | 1) >> 8) & 0x00FF_00FF_00FF_00FF;
    let fours = (pairs.wrapping_mul(100 << 16 | 1) >> 16) & 0x0000_FFFF_0000_FFFF;
    (fours.wrapping_mul((10_000 * UNIT) << 32 | UNIT) >> 32).cast_signed()
}

/// Converts sixteen hex digits to eight bytes, first byte lowest; `None` = a character is not a hex digit. Each
/// operation in the loop over the sixteen bytes compiles to one vector instruction.
#[inline(always)]
pub(super) fn eight_hex_bytes(text: [u8; 16]) -> Option<u64> {
    let (mut values, mut wrong) = ([0; 16], [0; 16]);
    for ((&byte, value), wrong) in text.iter().zip(&mut values).zip(&mut wrong) {
        // The value is 0 to 9 for a digit and at least 16 for any other character.
        let digit = byte.wrapping_add(0xFF - b'9').saturating_sub(6).wrapping_sub(0xF0);
        // The value is 10 to 15 for the letters A to F in either case, and at least 16 for any other character.
        let letter = (byte & 0xDF).wrapping_sub(b'A').saturating_add(10);
        *value = digit.min(letter);
        *wrong = *value & 0xF0;
    }
    if u128::from_ne_bytes(wrong) != 0 {
        return None;
    }
    let mut words = [word(&values, 0), word(&values, 8)];
    // Each step handles both words. A shift by twelve bits moves the upper digit of a byte above the lower one.
    for word in &mut words {
        *word = (word.wrapping_mul(0x1001) >> 8) & 0x00FF_00FF_00FF_00FF;
    }
    for word in &mut words {
        *word = (*word | *word >> 8) & 0x0000_FFFF_0000_FFFF;
    }
    for word in &mut words {
        *word |= *word >> 16;
    }
    let [first, second] = words;
    Some(first & 0xFFFF_FFFF | second << 32)
}
