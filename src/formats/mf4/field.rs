//! Decodes the numbers in a record.

use std::io;

use super::blocks::{Block, MdfFile};
use crate::byte_stream::{damaged, u16_at, u32_at, u64_at};

/// Data types of a channel block.
const UNSIGNED: u8 = 0;
const SIGNED: u8 = 2;
const FLOAT: u8 = 4;
const FIRST_OTHER: u8 = 6;
/// Conversion of a channel.
const IDENTITY: u8 = 0;
const LINEAR: u8 = 1;
/// Types of channels that have no bytes in the record.
const VIRTUAL_MASTER: u8 = 3;
const VIRTUAL: u8 = 6;

/// Meaning of the bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum NumberType {
    Unsigned,
    Signed,
    Float,
}

/// A number in a record, or a constant.
#[derive(Debug, Clone, Copy)]
pub(super) struct Field {
    byte: usize,
    /// Number of bytes that contain the bits; 0 = the value is constant.
    bytes: usize,
    shift: u32,
    bits: u32,
    big_endian: bool,
    number: NumberType,
    constant: u64,
    /// Linear conversion: value = offset + factor * number.
    offset: f64,
    factor: f64,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct ChannelBlock {
    pub(super) kind: u8,
    pub(super) data_type: u8,
    pub(super) bit: u8,
    pub(super) byte: u32,
    pub(super) bits: u32,
    pub(super) conversion: u64,
}

impl ChannelBlock {
    pub(super) fn read(file: &MdfFile, block: &Block) -> io::Result<Self> {
        let data = file.description(block, 24)?;
        let [byte, bits] = [4, 8].map(|at| u32_at(&data, at, false));
        let conversion = file.link(block, 4)?;
        Ok(Self { kind: data[0], data_type: data[2], bit: data[3], byte, bits, conversion })
    }
}

impl Field {
    /// Creates a field from a channel block. `Ok(None)` = the channel has a conversion that is not linear, or it is a
    /// virtual channel whose value is not constant.
    ///
    /// # Errors
    /// Fails if the block is damaged, or if the field is longer than the record.
    pub(super) fn read(file: &MdfFile, channel: &ChannelBlock, record_len: usize) -> io::Result<Option<Self>> {
        let Some((offset, factor)) = conversion(file, channel.conversion)? else { return Ok(None) };
        let number = match channel.data_type & !1 {
            UNSIGNED => NumberType::Unsigned,
            SIGNED => NumberType::Signed,
            FLOAT => NumberType::Float,
            _ => return Err(damaged(format!("channel of data type {}, must be a number", channel.data_type))),
        };
        let big_endian = channel.data_type < FIRST_OTHER && channel.data_type & 1 != 0;
        let (byte, shift, bits) = (channel.byte as usize, u32::from(channel.bit), channel.bits);
        // A virtual channel has the record's index as its number. If its factor is 0, as usual for the fields of a bus,
        // its value is constant. Some converters store the index in the record but keep the factor 0, so any channel
        // with this factor counts as constant.
        if factor == 0.0 || matches!(channel.kind, VIRTUAL_MASTER | VIRTUAL) {
            let constant = offset.clamp(0.0, f64::from(u32::MAX)) as u64;
            let number = NumberType::Unsigned;
            let field = Self { byte, bytes: 0, shift: 0, bits: 0, big_endian, number, constant, offset, factor };
            return Ok((factor == 0.0).then_some(field));
        }
        let bytes = shift.saturating_add(bits).div_ceil(8) as usize;
        let is_number = shift < 8 && (1..=64).contains(&bits) && bytes <= 8;
        let is_float = number != NumberType::Float || matches!((shift, bits), (0, 32 | 64));
        if !is_number || !is_float {
            return Err(damaged(format!(
                "channel of {bits} bits from bit {shift}, must be a number of at most 8 bytes"
            )));
        }
        if byte + bytes > record_len {
            let end = byte + bytes;
            return Err(damaged(format!("channel that ends at byte {end} of a record of {record_len} bytes")));
        }
        Ok(Some(Self { byte, bytes, shift, bits, big_endian, number, constant: 0, offset, factor }))
    }

    /// The unsigned number in a record, without conversion. The record has the length that `read` checked.
    #[inline]
    pub(super) fn number(&self, record: &[u8]) -> u64 {
        if self.bytes == 0 {
            return self.constant;
        }
        let mut word = [0; 8];
        let part = &record[self.byte..self.byte + self.bytes];
        let value = if self.big_endian {
            word[8 - self.bytes..].copy_from_slice(part);
            u64::from_be_bytes(word)
        } else if let Some(long) = record.get(self.byte..self.byte + 8) {
            word.copy_from_slice(long);
            u64::from_le_bytes(word)
        } else {
            for (to, from) in word.iter_mut().zip(part) {
                *to = *from;
            }
            u64::from_le_bytes(word)
        };
        value >> self.shift & u64::MAX >> (64 - self.bits)
    }

    /// Whether the number is used without a conversion.
    pub(super) fn is_plain(&self) -> bool {
        self.bytes == 0 || (self.offset == 0.0 && self.factor == 1.0)
    }

    /// Interprets the value as seconds. Returns rounded nanoseconds.
    #[inline]
    pub(super) fn nanos(&self, record: &[u8]) -> i64 {
        let bits = self.number(record);
        let number = match (self.number, self.bits) {
            (NumberType::Unsigned, _) => bits as f64,
            (NumberType::Signed, bits_used) => {
                let unused = 64 - bits_used;
                ((bits << unused).cast_signed() >> unused) as f64
            }
            (NumberType::Float, 32) => f64::from(f32::from_bits(bits as u32)),
            (NumberType::Float, _) => f64::from_bits(bits),
        };
        if self.factor == 1e-9 && self.offset == 0.0 {
            return number.round() as i64;
        }
        ((self.offset + self.factor * number) * 1e9).round() as i64
    }

    /// Whether the value is stored as seconds in floating point, so that digits below a microsecond are noise.
    pub(super) fn is_float_seconds(&self) -> bool {
        self.number == NumberType::Float && self.factor == 1.0
    }
}

/// Offset and factor of a conversion. `None` = the conversion is not linear.
fn conversion(file: &MdfFile, address: u64) -> io::Result<Option<(f64, f64)>> {
    if address == 0 {
        return Ok(Some((0.0, 1.0)));
    }
    let block = file.block(address, &[b"##CC"])?;
    let data = file.description(&block, 24)?;
    let values = u16_at(&data, 6, false);
    match data[0] {
        IDENTITY => Ok(Some((0.0, 1.0))),
        LINEAR if values >= 2 && data.len() >= 40 => {
            let [offset, factor] = [24, 32].map(|at| f64::from_bits(u64_at(&data, at)));
            Ok(Some((offset, factor)))
        }
        LINEAR => Err(damaged(format!("linear conversion at byte {address} with {values} values, must have 2"))),
        _ => Ok(None),
    }
}
