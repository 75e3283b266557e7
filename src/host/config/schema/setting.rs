//! Defines the types that a key may have, and reads each type from TOML.

use std::ops::RangeInclusive;

use toml::Spanned;
use toml::de::{DeInteger, DeValue};

use super::key::{Setting, ValueFault, ValueRange, in_range, typed};

/// Maximum length of a [`NumberRange`]. No pack has more cells.
const MAX_ROW: usize = 2048;

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

/// Parses a TOML integer of any base. Returns `None` if the value does not fit into an `i128`.
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
    const KIND: &'static str = "a string";
    const LIST_KIND: &'static str = "a list of strings";

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

/// Cell numbers in text form, `"1-12, 15"`, counted from 1.
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
    const KIND: &'static str = "cell numbers from 1, ranges ascending, like \"1-12, 15\"";

    fn read(value: &Spanned<DeValue<'_>>, _: &ValueRange) -> Result<Self, ValueFault> {
        typed(value, value.get_ref().as_str().and_then(Self::parse))
    }
}

/// A range of numbers: `"1-32"`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct NumberRange(pub RangeInclusive<u16>);

impl Setting for NumberRange {
    const KIND: &'static str = "an ascending range of numbers, like \"1-32\"";

    fn read(value: &Spanned<DeValue<'_>>, _: &ValueRange) -> Result<Self, ValueFault> {
        let parse = |text: &str| {
            let (first, last) = text.split_once('-')?;
            let (first, last) = (first.trim().parse::<u16>().ok()?, last.trim().parse::<u16>().ok()?);
            (first <= last && usize::from(last - first) < MAX_ROW).then_some(Self(first..=last))
        };
        typed(value, value.get_ref().as_str().and_then(parse))
    }
}

/// Implements `Setting` for an enum. Each line maps an allowed word to a value. A second word is a short form of the
/// first.
macro_rules! choice {
    ($type:ty { $($word:literal $(| $short:literal)? => $value:expr),+ $(,)? }) => {
        impl $crate::config::schema::Setting for $type {
            const KIND: &'static str = "one of";
            const CHOICES: &'static [&'static str] = &[$($word),+];

            fn read(
                value: &toml::Spanned<toml::de::DeValue<'_>>,
                _: &$crate::config::schema::ValueRange,
            ) -> Result<Self, $crate::config::schema::ValueFault> {
                let choice = match $crate::config::schema::typed(value, value.get_ref().as_str())? {
                    $($word $(| $short)? => Some($value),)+
                    _ => None,
                };
                $crate::config::schema::in_range(value, choice)
            }
        }
    };
}
pub(crate) use choice;
