//! Defines values and their VSS datatypes.
//!
//! Input: numbers of the status document, and the limits of the broker. Output: values of the protocol. A number
//! outside the range of its datatype or outside the broker's limits becomes unknown; it is never clamped.

use super::messages::{Flags, Floats, Texts, TypedValue};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum DataType {
    Text,
    Flag,
    Uint16,
    Uint32,
    Uint64,
    Float,
    Texts,
    Flags,
    Floats,
}

impl DataType {
    /// Name in VSS.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Text => "string",
            Self::Flag => "boolean",
            Self::Uint16 => "uint16",
            Self::Uint32 => "uint32",
            Self::Uint64 => "uint64",
            Self::Float => "float",
            Self::Texts => "string[]",
            Self::Flags => "boolean[]",
            Self::Floats => "float[]",
        }
    }

    pub(crate) const fn code(self) -> i32 {
        match self {
            Self::Text => 1,
            Self::Flag => 2,
            Self::Uint16 => 8,
            Self::Uint32 => 9,
            Self::Uint64 => 10,
            Self::Float => 11,
            Self::Texts => 20,
            Self::Flags => 21,
            Self::Floats => 30,
        }
    }
}

/// Name of the datatype with this number, including datatypes that this program does not use.
pub(crate) fn type_name(code: i32) -> String {
    const SINGLE: [&str; 13] = [
        "string",
        "boolean",
        "int8",
        "int16",
        "int32",
        "int64",
        "uint8",
        "uint16",
        "uint32",
        "uint64",
        "float",
        "double",
        "timestamp",
    ];
    let name = |code: i32| usize::try_from(code - 1).ok().and_then(|index| SINGLE.get(index));
    match (name(code), name(code - 19)) {
        (Some(single), _) => (*single).to_owned(),
        (None, Some(item)) => format!("{item}[]"),
        (None, None) => format!("datatype {code}"),
    }
}

/// A value of one of the datatypes.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Value {
    Text(String),
    Flag(bool),
    Uint16(u16),
    Uint32(u32),
    Uint64(u64),
    Float(f32),
    Texts(Vec<String>),
    Flags(Vec<bool>),
    Floats(Vec<f32>),
}

impl Value {
    pub(crate) const fn data_type(&self) -> DataType {
        match self {
            Self::Text(_) => DataType::Text,
            Self::Flag(_) => DataType::Flag,
            Self::Uint16(_) => DataType::Uint16,
            Self::Uint32(_) => DataType::Uint32,
            Self::Uint64(_) => DataType::Uint64,
            Self::Float(_) => DataType::Float,
            Self::Texts(_) => DataType::Texts,
            Self::Flags(_) => DataType::Flags,
            Self::Floats(_) => DataType::Floats,
        }
    }

    /// Whether all numbers of this value are within the limits.
    pub(crate) fn is_within(&self, limits: Limits) -> bool {
        match self {
            Self::Uint16(number) => limits.contain(f64::from(*number)),
            Self::Uint32(number) => limits.contain(f64::from(*number)),
            #[expect(clippy::cast_precision_loss, reason = "compared with limits that are not that exact")]
            Self::Uint64(number) => limits.contain(*number as f64),
            Self::Float(number) => limits.contain(f64::from(*number)),
            Self::Floats(numbers) => numbers.iter().all(|number| limits.contain(f64::from(*number))),
            Self::Text(_) | Self::Flag(_) | Self::Texts(_) | Self::Flags(_) => true,
        }
    }

    /// Converts to the protocol's type, which has no 16-bit integers.
    pub(crate) fn into_message(self) -> TypedValue {
        match self {
            Self::Text(text) => TypedValue::Text(text),
            Self::Flag(flag) => TypedValue::Flag(flag),
            Self::Uint16(number) => TypedValue::Uint32(number.into()),
            Self::Uint32(number) => TypedValue::Uint32(number),
            Self::Uint64(number) => TypedValue::Uint64(number),
            Self::Float(number) => TypedValue::Float(number),
            Self::Texts(values) => TypedValue::Texts(Texts { values }),
            Self::Flags(values) => TypedValue::Flags(Flags { values }),
            Self::Floats(values) => TypedValue::Floats(Floats { values }),
        }
    }
}

/// Converts to a VSS `float`; `None` = unknown, not finite, or out of range.
pub(crate) fn single(number: Option<f64>) -> Option<f32> {
    #[expect(
        clippy::cast_possible_truncation,
        reason = "rounds; a number out of range becomes infinite, which is rejected below"
    )]
    number.map(|number| number as f32).filter(|number| number.is_finite())
}

/// The broker's limits of a signal, both inclusive; `None` = no limit.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Limits {
    pub(crate) min: Option<f64>,
    pub(crate) max: Option<f64>,
}

impl Limits {
    fn contain(self, number: f64) -> bool {
        self.min.is_none_or(|min| number >= min) && self.max.is_none_or(|max| number <= max)
    }
}

/// Reads a limit as a number; `None` = no limit.
pub(crate) fn limit(value: Option<&super::messages::Value>) -> Option<f64> {
    match value?.typed.as_ref()? {
        TypedValue::Int32(number) => Some(f64::from(*number)),
        TypedValue::Uint32(number) => Some(f64::from(*number)),
        TypedValue::Float(number) => Some(f64::from(*number)),
        TypedValue::Double(number) => Some(*number),
        #[expect(clippy::cast_precision_loss, reason = "limits are not that exact")]
        TypedValue::Uint64(number) => Some(*number as f64),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn number_beyond_float_range_is_unknown() {
        assert_eq!(single(Some(1.5)), Some(1.5));
        for number in [None, Some(f64::NAN), Some(f64::INFINITY), Some(1e39)] {
            assert_eq!(single(number), None, "{number:?}");
        }
    }

    #[test]
    fn limits_apply_to_every_array_element() {
        let limits = Limits { min: Some(0.0), max: Some(100.0) };
        assert!(Value::Float(100.0).is_within(limits) && Value::Float(0.0).is_within(limits));
        assert!(!Value::Float(100.1).is_within(limits) && !Value::Uint16(101).is_within(limits));
        assert!(!Value::Floats(vec![1.0, -0.1]).is_within(limits));
        assert!(Value::Floats(vec![1.0, -0.1]).is_within(Limits::default()));
    }

    #[test]
    fn datatype_numbers_map_to_names() {
        for data_type in [
            DataType::Text,
            DataType::Flag,
            DataType::Uint16,
            DataType::Uint32,
            DataType::Uint64,
            DataType::Float,
            DataType::Texts,
            DataType::Flags,
            DataType::Floats,
        ] {
            assert_eq!(type_name(data_type.code()), data_type.name());
        }
        assert_eq!((type_name(12).as_str(), type_name(32).as_str()), ("double", "timestamp[]"));
        assert_eq!((type_name(0).as_str(), type_name(15).as_str()), ("datatype 0", "datatype 15"));
    }
}
