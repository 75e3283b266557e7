//! Encodes a state in few bytes: a checkpoint writes it to flash every minute, for years.
//!
//! A *full* record is the whole state, exact. A *delta* record is the difference to a full record: numbers to six digits
//! (finer where they are large, see [`rounded`]), each as the difference to the number at its place, with the lowest bytes
//! of all numbers together, then the next bytes, and so on, compressed. A number that occurs a second time (a covariance
//! has two equal halves) is a reference to the first. The skeleton (the document without its numbers) is written when it
//! differs, compressed against that of the full record.
//!
//! | form of the state of 96 cells | bytes | written a day at one checkpoint a minute |
//! | --- | --- | --- |
//! | JSON | 250 kB | |
//! | JSON, zstd level 3 (level 19) | 50 kB (37 kB) | 80 MB (60 MB) |
//! | full record | 35 kB | |
//! | delta record | 5 to 8 kB | 11 MB |
//!
//! The bar is 20 MB a day, so the state is not stored as one compressed document. The codec does not depend on the
//! contents of a state. A hash finds damaged bytes, which are an error; no input panics.

use std::collections::HashMap;

use sha2::{Digest, Sha256};

use super::parts::{FLOAT, JsonParts};

/// First byte of a full record.
const FULL: u8 = b'F';
/// First byte of a delta record.
const DELTA: u8 = b'D';
/// Bytes of the hash at the end: damage is missed once in 2^64.
const HASH_BYTES: usize = 8;
/// Longest list within a record, bytes: fifty times the state of the largest pack.
const MAX_SECTION_BYTES: usize = 128 << 20;
/// Compression level: the highest before the time doubles.
const LEVEL: i32 = 3;
/// Bits of a mantissa in a delta: 5e-7 of the value, a thousandth of the uncertainty of any of the numbers.
const KEPT_BITS: i32 = 20;
/// Bits after the point in a delta: more bits than above where those would be coarser than 2^-15 (counted charge, seconds).
const KEPT_FRACTION_BITS: i32 = 14;
/// Bits of a mantissa.
const MANTISSA_BITS: i32 = 52;

/// Why a record cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("stored state is damaged: {0}")]
pub(super) struct DamagedRecord(&'static str);

/// Encodes the whole state as the record of number `number`.
pub(super) fn full(parts: &JsonParts, number: i64) -> Vec<u8> {
    let mut record = vec![FULL];
    push_section(&mut record, &parts.skeleton, &[]);
    push_numbers(&mut record, parts, &vec![0; parts.bits.len()], |bits| bits);
    sealed(record, &[number])
}

/// Encodes the difference to `base`, the full record of number `serial`, as the record of number `number`.
pub(super) fn delta(parts: &JsonParts, base: &JsonParts, serial: i64, number: i64) -> Vec<u8> {
    let mut record = vec![DELTA];
    if parts.skeleton == base.skeleton {
        push_section(&mut record, &[], &[]);
        push_numbers(&mut record, parts, &base.bits, rounded);
    } else {
        push_section(&mut record, &parts.skeleton, &base.skeleton);
        push_numbers(&mut record, parts, &base.aligned_to(&parts.skeleton), rounded);
    }
    sealed(record, &[serial, number])
}

/// Reads the full record of number `number`. Records of layouts before 5 are sealed without it.
pub(super) fn read_full(record: &[u8], number: i64) -> Result<JsonParts, DamagedRecord> {
    let mut reader = RecordReader::open(record, FULL, &[number]).or_else(|_| RecordReader::open(record, FULL, &[0]))?;
    let mut parts = JsonParts::of_skeleton(reader.section(&[])?);
    let zeros = vec![0; parts.bits.len()];
    reader.numbers(&mut parts, &zeros, |bits| bits)?;
    Ok(parts)
}

/// Reads the delta record of number `number` to `base`, the full record of number `serial`. Layouts before 5 gave both the
/// same number.
pub(super) fn read_delta(
    record: &[u8],
    base: &JsonParts,
    serial: i64,
    number: i64,
) -> Result<JsonParts, DamagedRecord> {
    let numbers = [serial, number];
    let mut reader = RecordReader::open(record, DELTA, if serial == number { &numbers[..1] } else { &numbers })?;
    let skeleton = reader.section(&base.skeleton)?;
    if skeleton.is_empty() {
        let mut parts = JsonParts { bits: vec![0; base.bits.len()], ..base.clone() };
        reader.numbers(&mut parts, &base.bits, rounded)?;
        return Ok(parts);
    }
    let aligned = base.aligned_to(&skeleton);
    let mut parts = JsonParts::of_skeleton(skeleton);
    reader.numbers(&mut parts, &aligned, rounded)?;
    Ok(parts)
}

/// The bits of a double with its mantissa rounded as in a delta.
fn rounded(bits: u64) -> u64 {
    let exponent = i32::try_from((bits >> MANTISSA_BITS) & 0x7FF).unwrap_or(0) - 1023;
    let dropped = MANTISSA_BITS - KEPT_BITS.max(exponent + KEPT_FRACTION_BITS);
    if dropped <= 0 {
        return bits;
    }
    let half = 1_u64 << (dropped - 1);
    let near = bits.wrapping_add(half) & !((half << 1) - 1);
    // The largest double must not become infinite.
    if f64::from_bits(near).is_finite() { near } else { bits }
}

/// Marks of the numbers in a record: as in the base, as an earlier number, or new.
const SAME: u8 = 0;
const REFERENCE: u8 = 1;
const NEW: u8 = 2;

fn push_numbers(record: &mut Vec<u8>, parts: &JsonParts, base: &[u64], round: fn(u64) -> u64) {
    let (mut marks, mut references) = (Vec::with_capacity(parts.bits.len()), Vec::new());
    let (mut floats, mut whole) = (Vec::new(), Vec::new());
    let mut seen: HashMap<u64, usize> = HashMap::new();
    let mut last_distance = 0_i64;
    for (index, ((&kind, &bits), &base)) in parts.kinds.iter().zip(&parts.bits).zip(base).enumerate() {
        if kind != FLOAT {
            marks.push(if bits == base { SAME } else { NEW });
            if bits != base {
                whole.push(zigzag(bits.wrapping_sub(base).cast_signed()));
            }
            continue;
        }
        let (bits, base) = (round(bits), round(base));
        if bits == base {
            marks.push(SAME);
        } else if let Some(earlier) = seen.get(&bits) {
            marks.push(REFERENCE);
            let distance = i64::try_from(index - earlier).unwrap_or(i64::MAX);
            push_varint(&mut references, zigzag(distance - last_distance));
            last_distance = distance;
        } else {
            marks.push(NEW);
            floats.push(bits ^ base);
        }
        seen.insert(bits, index);
    }
    push_section(record, &marks, &[]);
    push_section(record, &references, &[]);
    for numbers in [&floats, &whole] {
        for byte in 0..8 {
            let lane: Vec<u8> = numbers.iter().map(|number| number.to_le_bytes()[byte]).collect();
            push_section(record, &lane, &[]);
        }
    }
}

const fn zigzag(value: i64) -> u64 {
    ((value << 1) ^ (value >> 63)).cast_unsigned()
}

const fn unzigzag(value: u64) -> i64 {
    (value >> 1).cast_signed() ^ -(value & 1).cast_signed()
}

fn push_varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

/// Appends a list, compressed with a dictionary (empty = none) where that is shorter.
fn push_section(record: &mut Vec<u8>, bytes: &[u8], dictionary: &[u8]) {
    let packed = zstd::bulk::Compressor::with_dictionary(LEVEL, dictionary).and_then(|mut c| c.compress(bytes)).ok();
    let packed = packed.filter(|packed| packed.len() < bytes.len());
    let stored = packed.as_deref().unwrap_or(bytes);
    push_varint(record, bytes.len() as u64);
    push_varint(record, stored.len() as u64);
    record.extend_from_slice(stored);
}

/// Appends the hash of the record, of the number of its base and of its own number.
fn sealed(mut record: Vec<u8>, numbers: &[i64]) -> Vec<u8> {
    let seal = seal(&record, numbers);
    record.extend_from_slice(&seal);
    record
}

fn seal(body: &[u8], numbers: &[i64]) -> [u8; HASH_BYTES] {
    let hasher = numbers.iter().fold(Sha256::new(), |hasher, number| hasher.chain_update(number.to_le_bytes()));
    let hash = hasher.chain_update(body).finalize();
    std::array::from_fn(|index| hash[index])
}

/// The unread rest of a record.
struct RecordReader<'a> {
    rest: &'a [u8],
}

impl<'a> RecordReader<'a> {
    fn open(record: &'a [u8], kind: u8, numbers: &[i64]) -> Result<Self, DamagedRecord> {
        let (body, hash) =
            record.len().checked_sub(HASH_BYTES).map(|at| record.split_at(at)).ok_or(DamagedRecord("too short"))?;
        if seal(body, numbers) != *hash {
            return Err(DamagedRecord("its hash differs"));
        }
        match body.split_first() {
            Some((&found, rest)) if found == kind => Ok(Self { rest }),
            _ => Err(DamagedRecord("it is of another kind")),
        }
    }

    fn varint(&mut self) -> Result<u64, DamagedRecord> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let (&byte, rest) = self.rest.split_first().ok_or(DamagedRecord("it ends early"))?;
            self.rest = rest;
            value |= u64::from(byte & 0x7F) << shift;
            if byte < 0x80 {
                return Ok(value);
            }
        }
        Err(DamagedRecord("a number in it does not end"))
    }

    /// The next list, which was compressed with a dictionary (empty = none).
    fn section(&mut self, dictionary: &[u8]) -> Result<Vec<u8>, DamagedRecord> {
        let length = usize::try_from(self.varint()?).unwrap_or(usize::MAX);
        let stored = usize::try_from(self.varint()?).unwrap_or(usize::MAX);
        if stored > self.rest.len() || length > MAX_SECTION_BYTES {
            return Err(DamagedRecord("a list in it is too long"));
        }
        let (stored, rest) = self.rest.split_at(stored);
        self.rest = rest;
        if stored.len() == length {
            return Ok(stored.to_vec());
        }
        let unpacked =
            zstd::bulk::Decompressor::with_dictionary(dictionary).and_then(|mut d| d.decompress(stored, length));
        unpacked.map_err(|_| DamagedRecord("a list in it does not unpack"))
    }

    /// The numbers of `parts`, whose kinds are known.
    fn numbers(&mut self, parts: &mut JsonParts, base: &[u64], round: fn(u64) -> u64) -> Result<(), DamagedRecord> {
        const MISSING: DamagedRecord = DamagedRecord("a number in it is missing");
        let marks = self.section(&[])?;
        let references = self.section(&[])?;
        let mut references = RecordReader { rest: &references };
        let mut floats = self.lanes()?.into_iter();
        let mut whole = self.lanes()?.into_iter();
        if marks.len() != parts.kinds.len() || base.len() != parts.kinds.len() {
            return Err(MISSING);
        }
        let mut distance = 0_i64;
        for index in 0..marks.len() {
            let is_float = parts.kinds[index] == FLOAT;
            parts.bits[index] = match (marks[index], is_float) {
                (SAME, true) => round(base[index]),
                (SAME, false) => base[index],
                (NEW, true) => round(base[index]) ^ floats.next().ok_or(MISSING)?,
                (NEW, false) => base[index].wrapping_add(unzigzag(whole.next().ok_or(MISSING)?).cast_unsigned()),
                (REFERENCE, true) => {
                    distance = distance.wrapping_add(unzigzag(references.varint()?));
                    let back = usize::try_from(distance).ok().and_then(|back| index.checked_sub(back));
                    *back.and_then(|earlier| parts.bits.get(earlier)).ok_or(MISSING)?
                }
                _ => return Err(DamagedRecord("a mark in it has no meaning")),
            };
        }
        Ok(())
    }

    /// Numbers from their eight lanes of bytes.
    fn lanes(&mut self) -> Result<Vec<u64>, DamagedRecord> {
        let mut numbers = Vec::new();
        for byte in 0..8 {
            let lane = self.section(&[])?;
            if byte == 0 {
                numbers = vec![0_u64; lane.len()];
            }
            if lane.len() != numbers.len() {
                return Err(DamagedRecord("lists in it differ in length"));
            }
            numbers.iter_mut().zip(lane).for_each(|(number, part)| *number |= u64::from(part) << (8 * byte));
        }
        Ok(numbers)
    }
}

/// A delta as layouts before 5 wrote it.
#[cfg(test)]
pub(super) fn old_delta(parts: &JsonParts, base: &JsonParts, serial: i64) -> Vec<u8> {
    let mut record = delta(parts, base, serial, serial);
    record.truncate(record.len() - HASH_BYTES);
    sealed(record, &[serial])
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::{Value, json};

    use super::*;

    fn parts(value: &Value) -> JsonParts {
        JsonParts::of(&serde_json::to_vec(value).unwrap()).unwrap()
    }

    /// Documents of a few levels with every kind of value.
    fn document() -> impl Strategy<Value = Value> {
        let float = prop_oneof![Just(0.0), -1e6..1e6, any::<f64>().prop_filter("finite", |value| value.is_finite()),];
        let leaf = prop_oneof![
            Just(Value::Null),
            any::<bool>().prop_map(Value::from),
            any::<i64>().prop_map(Value::from),
            any::<u64>().prop_map(Value::from),
            float.prop_map(Value::from),
            "[a-c\\\\\"0-9.{\\[,:]{0,4}".prop_map(Value::from),
        ];
        leaf.prop_recursive(4, 60, 6, |inner| {
            prop_oneof![
                prop::collection::vec(inner.clone(), 0..6).prop_map(Value::from),
                prop::collection::btree_map("[a-e\"\\\\]{1,2}", inner, 0..6)
                    .prop_map(|map| Value::Object(map.into_iter().collect())),
            ]
        })
    }

    /// As a delta leaves it.
    fn near(mut parts: JsonParts) -> JsonParts {
        for (kind, bits) in parts.kinds.iter().zip(&mut parts.bits) {
            *bits = if *kind == FLOAT { rounded(*bits) } else { *bits };
        }
        parts
    }

    proptest! {
        #[test]
        fn a_full_record_gives_the_state_exactly(value in document()) {
            let parts = parts(&value);
            let read = read_full(&full(&parts, 5), 5).unwrap();
            prop_assert_eq!(&read, &parts);
            prop_assert_eq!(serde_json::from_slice::<Value>(&read.join()).unwrap(), value);
        }

        #[test]
        fn a_delta_record_gives_the_state_rounded_whatever_its_base(value in document(), base in document()) {
            let (parts, base) = (parts(&value), parts(&base));
            prop_assert_eq!(read_delta(&delta(&parts, &base, 3, 4), &base, 3, 4).unwrap(), near(parts));
        }

        #[test]
        fn any_bytes_are_an_error_or_a_state(bytes in prop::collection::vec(any::<u8>(), 0..300), seal in any::<bool>()) {
            let bytes = if seal { sealed(bytes, &[0]) } else { bytes };
            let _ = read_full(&bytes, 1);
            let _ = read_delta(&bytes, &parts(&json!({"a": [1.5, 2]})), 0, 0);
        }

        #[test]
        fn a_rounded_number_is_near(value in any::<f64>().prop_filter("finite", |value| value.is_finite())) {
            let near = f64::from_bits(rounded(value.to_bits()));
            prop_assert!(near.is_finite());
            prop_assert!((near - value).abs() <= (value.abs() * 5e-7).max(f64::MIN_POSITIVE), "{value} became {near}");
            prop_assert!((near - value).abs() <= 3.1e-5 || value.abs() > 1e9 || value.abs() < 1e3, "{value} became {near}");
        }
    }

    #[test]
    fn a_flipped_bit_is_found() {
        let good = full(&parts(&json!({"cells": [1.5, 2.5, {"x": 3}]})), 7);
        for bit in 0..8 * good.len() {
            let mut bad = good.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            assert!(read_full(&bad, 7).is_err(), "bit {bit}");
        }
        assert!(read_full(&good, 6).is_err(), "of another number");
    }

    #[test]
    fn equal_numbers_and_unchanged_ones_cost_next_to_nothing() {
        let numbers: Vec<f64> = (1..1000).map(|n| 1.0 / f64::from(n)).collect();
        let base = parts(&json!({ "a": numbers, "b": vec![0.5; 999] }));
        let same = parts(&json!({ "a": numbers, "b": numbers }));
        let delta = delta(&same, &base, 1, 2);
        assert!(delta.len() < 150, "{}", delta.len());
        assert!(read_delta(&delta, &base, 1, 2).is_ok());
        assert!(read_delta(&delta, &base, 2, 3).is_err(), "to another base");
        assert!(read_delta(&delta, &base, 1, 3).is_err(), "of another number");
    }
}
