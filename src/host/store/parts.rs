//! Splits a JSON document into its numbers and its skeleton, and joins them again.
//!
//! The skeleton is the document with every number replaced by a letter for its kind. From minute to minute the numbers of
//! a state change, its skeleton hardly does.

/// Placeholder of a floating-point number.
pub(super) const FLOAT: u8 = b'.';
/// Placeholder of a whole number that fits an `i64`.
pub(super) const INT: u8 = b'0';
/// Placeholder of a larger whole number.
pub(super) const BIG: u8 = b'9';

/// A document, split.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct JsonParts {
    /// The document without its numbers.
    pub(super) skeleton: Vec<u8>,
    /// The kind of each number: the placeholders in their order.
    pub(super) kinds: Vec<u8>,
    /// The numbers' bits in the same order.
    pub(super) bits: Vec<u64>,
}

impl JsonParts {
    /// Splits a compact JSON document; `None` when a number in it cannot be read.
    pub(super) fn of(json: &[u8]) -> Option<Self> {
        let mut parts = Self { skeleton: Vec::with_capacity(json.len()), ..Self::default() };
        for token in tokens(json) {
            if token[0] == b'-' || token[0].is_ascii_digit() {
                let (kind, bits) = number(token)?;
                parts.skeleton.push(kind);
                parts.kinds.push(kind);
                parts.bits.push(bits);
            } else {
                parts.skeleton.extend_from_slice(token);
            }
        }
        Some(parts)
    }

    /// A skeleton with all numbers 0.
    pub(super) fn of_skeleton(skeleton: Vec<u8>) -> Self {
        let kinds: Vec<u8> = tokens(&skeleton).map(|token| token[0]).filter(|&byte| is_placeholder(byte)).collect();
        Self { skeleton, bits: vec![0; kinds.len()], kinds }
    }

    /// The document.
    pub(super) fn join(&self) -> Vec<u8> {
        let mut json = Vec::with_capacity(self.skeleton.len() + 10 * self.bits.len());
        let mut numbers = self.kinds.iter().zip(&self.bits);
        for token in tokens(&self.skeleton) {
            match if is_placeholder(token[0]) { numbers.next() } else { None } {
                Some((kind, bits)) => write_number(&mut json, *kind, *bits),
                None => json.extend_from_slice(token),
            }
        }
        json
    }

    /// The numbers of `self` at the places of `skeleton`'s numbers; 0 where `self` has none.
    pub(super) fn aligned_to(&self, skeleton: &[u8]) -> Vec<u64> {
        let known: std::collections::HashMap<u64, u64> =
            paths(&self.skeleton).into_iter().zip(self.bits.iter().copied()).collect();
        paths(skeleton).into_iter().map(|path| known.get(&path).copied().unwrap_or(0)).collect()
    }
}

const fn is_placeholder(byte: u8) -> bool {
    matches!(byte, FLOAT | INT | BIG)
}

/// The strings, numbers and other single bytes of a JSON text, in order.
fn tokens(mut text: &[u8]) -> impl Iterator<Item = &[u8]> {
    std::iter::from_fn(move || {
        let (first, rest) = text.split_first()?;
        let length = match first {
            b'"' => string_length(rest),
            b'-' | b'0'..=b'9' => {
                rest.iter().take_while(|b| matches!(b, b'0'..=b'9' | b'.' | b'e' | b'E' | b'+' | b'-')).count()
            }
            _ => 0,
        };
        let (token, after) = text.split_at(1 + length);
        text = after;
        Some(token)
    })
}

/// Bytes up to and including the closing quote.
fn string_length(rest: &[u8]) -> usize {
    let mut at = 0;
    while let Some(&byte) = rest.get(at) {
        match byte {
            b'"' => return at + 1,
            b'\\' => at += 2,
            _ => at += 1,
        }
    }
    rest.len()
}

fn number(token: &[u8]) -> Option<(u8, u64)> {
    let text = std::str::from_utf8(token).ok()?;
    if token.iter().any(|b| matches!(b, b'.' | b'e' | b'E')) {
        return text.parse::<f64>().ok().filter(|value| value.is_finite()).map(|value| (FLOAT, value.to_bits()));
    }
    match text.parse::<i64>() {
        Ok(value) => Some((INT, value.cast_unsigned())),
        Err(_) => text.parse::<u64>().ok().map(|value| (BIG, value)),
    }
}

fn write_number(json: &mut Vec<u8>, kind: u8, bits: u64) {
    let written = match kind {
        FLOAT => serde_json::to_writer(&mut *json, &f64::from_bits(bits)),
        INT => serde_json::to_writer(&mut *json, &bits.cast_signed()),
        _ => serde_json::to_writer(&mut *json, &bits),
    };
    // Writing a number into memory cannot fail.
    debug_assert!(written.is_ok(), "a number was not written");
}

/// The place of each number of a skeleton, as a hash of the keys and indices that lead to it. A collision only costs
/// space: encoder and decoder look up the same number.
fn paths(skeleton: &[u8]) -> Vec<u64> {
    let mut found = Vec::new();
    // Each open object or list: its path, the present key or index, and whether it is an object.
    let mut open: Vec<(u64, u64, bool)> = Vec::new();
    let mut key_next = false;
    for token in tokens(skeleton) {
        let here = open.last().map_or(0, |&(path, step, _)| mix(path, step));
        match token[0] {
            byte @ (b'{' | b'[') => {
                key_next = byte == b'{';
                open.push((here, 0, key_next));
            }
            b'}' | b']' => {
                open.pop();
            }
            b',' => {
                key_next = open.last().is_some_and(|&(_, _, is_object)| is_object);
                if let Some((_, step, false)) = open.last_mut() {
                    *step += 1;
                }
            }
            b'"' if key_next => {
                key_next = false;
                if let Some((_, step, _)) = open.last_mut() {
                    *step = token.iter().fold(0, |hash, &byte| mix(hash, u64::from(byte)));
                }
            }
            byte if is_placeholder(byte) => found.push(here),
            _ => {}
        }
    }
    found
}

/// One step of FNV-1a over whole words, with extra mixing.
const fn mix(hash: u64, word: u64) -> u64 {
    let mixed = (hash ^ word.wrapping_add(0x9E37_79B9_7F4A_7C15)).wrapping_mul(0x0000_0100_0000_01B3);
    mixed ^ (mixed >> 29)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_document_is_joined_as_it_was() {
        let json = br#"{"a":[1,-2,1.5,-0.0,1e-300],"b":{"c\"9.0":null,"d":true,"e":"0.9"},"f":18446744073709551615}"#;
        let parts = JsonParts::of(json).unwrap();
        assert_eq!(parts.kinds, b"00...9");
        assert_eq!(parts.join(), json);
        assert_eq!(JsonParts::of_skeleton(parts.skeleton.clone()).kinds, parts.kinds);
    }

    #[test]
    fn numbers_keep_their_place_when_others_are_added_and_removed() {
        let before = JsonParts::of(br#"{"a":null,"b":[{"x":1,"y":2},{"x":3,"y":4}],"c":5}"#).unwrap();
        let after = JsonParts::of(br#"{"a":{"z":9},"b":[{"x":7,"y":7},{"y":7},{"x":7}],"c":7}"#).unwrap();
        assert_eq!(before.aligned_to(&after.skeleton), [0, 1, 2, 4, 0, 5]);
    }

    #[test]
    fn an_invalid_number_is_rejected() {
        assert_eq!(JsonParts::of(b"[1-2]"), None);
        assert_eq!(JsonParts::of(b"[1e999]"), None);
    }
}
