//! The types a key may have: how each is read from TOML and what range it may be given.

use std::fmt;
use std::ops::{Range, RangeInclusive};

use toml::Spanned;
use toml::de::{DeInteger, DeValue};

use super::schema::{Key, TableReader};
use crate::quantity::bounds::Bounds;

/// Most numbers in a row: more than any pack has cells.
const MAX_ROW: usize = 2048;

/// The range of a key's value; of each element when the value is a list.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum ValueRange {
    /// Anything of the type (numbers must still be finite).
    Any,
    /// A number from the first to the second, both included.
    Between(f64, f64),
    /// A number above the first, up to and including the second.
    Above(f64, f64),
    /// A text or list that is not empty.
    NotEmpty,
}

/// The range of a key with physical bounds.
pub(crate) const fn within(bounds: Bounds) -> ValueRange {
    ValueRange::Between(bounds.low, bounds.high)
}

impl ValueRange {
    fn has(&self, number: f64) -> bool {
        number.is_finite()
            && match *self {
                Self::Any | Self::NotEmpty => true,
                Self::Between(low, high) => low <= number && number <= high,
                Self::Above(low, high) => low < number && number <= high,
            }
    }
}

impl fmt::Display for ValueRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Any => Ok(()),
            Self::Between(low, high) if low == high => write!(f, "{low}"),
            Self::Between(low, f64::INFINITY) => write!(f, "{low} or more"),
            Self::Between(low, high) => write!(f, "{low} to {high}"),
            Self::Above(low, f64::INFINITY) => write!(f, "above {low}"),
            Self::Above(low, high) => write!(f, "above {low} and at most {high}"),
            Self::NotEmpty => write!(f, "not empty"),
        }
    }
}

/// Why a value is refused, and where exactly.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum ValueFault {
    /// Not the key's type.
    Type(Range<usize>),
    /// The type, but not in the range.
    Range(Range<usize>),
}

/// `found`, or a fault that the value has another type.
pub(crate) fn typed<T>(value: &Spanned<DeValue<'_>>, found: Option<T>) -> Result<T, ValueFault> {
    found.ok_or_else(|| ValueFault::Type(value.span()))
}

/// `found`, or a fault that the value is out of range.
pub(crate) fn in_range<T>(value: &Spanned<DeValue<'_>>, found: Option<T>) -> Result<T, ValueFault> {
    found.ok_or_else(|| ValueFault::Range(value.span()))
}

/// A type a key may have.
pub(crate) trait Setting: Sized {
    /// The type in words.
    const KIND: &'static str;
    /// A list of the type in words.
    const LIST_KIND: &'static str = "a list";
    /// The words it may be, when it is a choice.
    const CHOICES: &'static [&'static str] = &[];
    /// Reads and checks a value.
    fn read(value: &Spanned<DeValue<'_>>, allowed: &ValueRange) -> Result<Self, ValueFault>;
    /// Reads and checks a value that is tables with keys of their own; `None` = the type is no such value.
    fn read_tables(_: &mut TableReader<'_>, _: &Key, _: &Spanned<DeValue<'_>>) -> Option<Option<Self>> {
        None
    }
    /// Value of a key that is not written and has no default.
    fn absent() -> Option<Self> {
        None
    }
}

impl<T: Setting> Setting for Option<T> {
    const KIND: &'static str = T::KIND;
    const CHOICES: &'static [&'static str] = T::CHOICES;

    fn read(value: &Spanned<DeValue<'_>>, allowed: &ValueRange) -> Result<Self, ValueFault> {
        T::read(value, allowed).map(Some)
    }

    fn absent() -> Option<Self> {
        Some(None)
    }
}

impl Setting for bool {
    const KIND: &'static str = "true or false";

    fn read(value: &Spanned<DeValue<'_>>, _: &ValueRange) -> Result<Self, ValueFault> {
        typed(value, value.get_ref().as_bool())
    }
}

impl Setting for f64 {
    const KIND: &'static str = "a number";
    const LIST_KIND: &'static str = "a list of numbers";

    fn read(value: &Spanned<DeValue<'_>>, allowed: &ValueRange) -> Result<Self, ValueFault> {
        let number = match value.get_ref().as_integer() {
            Some(integer) => in_range(value, whole(integer))? as f64,
            None => typed(value, value.get_ref().as_float().and_then(|float| float.as_str().parse().ok()))?,
        };
        in_range(value, Some(number).filter(|&number| allowed.has(number)))
    }
}

/// The number an integer in any of TOML's bases stands for; `None` when it does not fit.
fn whole(integer: &DeInteger<'_>) -> Option<i128> {
    i128::from_str_radix(integer.as_str(), integer.radix()).ok()
}

macro_rules! whole_numbers {
    ($($type:ty),+) => {$(
        impl Setting for $type {
            const KIND: &'static str = "a whole number";
            const LIST_KIND: &'static str = "a list of whole numbers";

            fn read(value: &Spanned<DeValue<'_>>, allowed: &ValueRange) -> Result<Self, ValueFault> {
                let number = whole(typed(value, value.get_ref().as_integer())?);
                let number = number.filter(|&number| allowed.has(number as f64));
                in_range(value, number.and_then(|number| Self::try_from(number).ok()))
            }
        }
    )+};
}
whole_numbers!(u8, u16, u32, u64);

impl Setting for String {
    const KIND: &'static str = "a text";
    const LIST_KIND: &'static str = "a list of texts";

    fn read(value: &Spanned<DeValue<'_>>, allowed: &ValueRange) -> Result<Self, ValueFault> {
        let text = typed(value, value.get_ref().as_str())?;
        let is_good = *allowed != ValueRange::NotEmpty || !text.trim().is_empty();
        in_range(value, is_good.then(|| text.to_owned()))
    }
}

impl<T: Setting> Setting for Vec<T> {
    const KIND: &'static str = T::LIST_KIND;
    const LIST_KIND: &'static str = "a list of lists of numbers";

    fn read(value: &Spanned<DeValue<'_>>, allowed: &ValueRange) -> Result<Self, ValueFault> {
        let items = typed(value, value.get_ref().as_array())?;
        let is_good = *allowed != ValueRange::NotEmpty || !items.is_empty();
        in_range(value, is_good.then_some(()))?;
        items.iter().map(|item| T::read(item, allowed)).collect()
    }
}

/// Cell numbers as people write them: `"1-12, 15"`, counted from 1.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct CellRanges(pub Vec<RangeInclusive<u16>>);

impl CellRanges {
    fn parse(text: &str) -> Option<Self> {
        let range = |part: &str| {
            let (first, last) = part.split_once('-').unwrap_or((part, part));
            let (first, last) = (first.trim().parse::<u16>().ok()?, last.trim().parse::<u16>().ok()?);
            (1 <= first && first <= last).then_some(first..=last)
        };
        text.split(',').map(range).collect::<Option<Vec<_>>>().map(Self)
    }
}

impl Setting for CellRanges {
    const KIND: &'static str = "cell numbers from 1, like \"1-12, 15\"";

    fn read(value: &Spanned<DeValue<'_>>, _: &ValueRange) -> Result<Self, ValueFault> {
        typed(value, value.get_ref().as_str().and_then(Self::parse))
    }
}

/// Numbers in a row: `"1-32"`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct NumberRange(pub RangeInclusive<u16>);

impl Setting for NumberRange {
    const KIND: &'static str = "numbers in a row, like \"1-32\"";

    fn read(value: &Spanned<DeValue<'_>>, _: &ValueRange) -> Result<Self, ValueFault> {
        let parse = |text: &str| {
            let (first, last) = text.split_once('-')?;
            let (first, last) = (first.trim().parse::<u16>().ok()?, last.trim().parse::<u16>().ok()?);
            (first <= last && usize::from(last - first) < MAX_ROW).then_some(Self(first..=last))
        };
        typed(value, value.get_ref().as_str().and_then(parse))
    }
}

/// Makes an enum a choice between words.
macro_rules! choice {
    ($type:ty { $($word:literal => $value:expr),+ $(,)? }) => {
        impl $crate::config::setting::Setting for $type {
            const KIND: &'static str = "one of";
            const CHOICES: &'static [&'static str] = &[$($word),+];

            fn read(
                value: &toml::Spanned<toml::de::DeValue<'_>>,
                _: &$crate::config::setting::ValueRange,
            ) -> Result<Self, $crate::config::setting::ValueFault> {
                let choice = match $crate::config::setting::typed(value, value.get_ref().as_str())? {
                    $($word => Some($value),)+
                    _ => None,
                };
                $crate::config::setting::in_range(value, choice)
            }
        }
    };
}
pub(crate) use choice;
