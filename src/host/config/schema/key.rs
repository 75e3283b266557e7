//! Defines the properties of a declared key (meaning, type, range), and reads its value from a table.

use std::fmt;
use std::ops::Range;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::reader::did_you_mean;
use crate::config::document::{Document, TablePlace};
use crate::quantity::bounds::Bounds;

/// The range of a key's value; for a list, the range of each element.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum ValueRange {
    /// Any value of the type. Numbers must be finite.
    Any,
    /// A number between the two bounds, both included.
    Between(f64, f64),
    /// A number above the first bound, up to and including the second.
    Above(f64, f64),
    /// A string or list that is not empty.
    NotEmpty,
}

/// The range of alarm thresholds and of signal factors and offsets. No sensible value is outside this range.
const WIDEST: ValueRange = ValueRange::Between(-1e9, 1e9);

/// The range of a key with physical bounds.
pub(crate) const fn within(bounds: Bounds) -> ValueRange {
    ValueRange::Between(bounds.low, bounds.high)
}

impl ValueRange {
    pub(crate) fn has(&self, number: f64) -> bool {
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

/// Why a value is rejected, with the byte range of the value in the file.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum ValueFault {
    Type(Range<usize>),
    Range(Range<usize>),
}

/// Returns the contents of `found`, or a type fault at the position of `value`.
pub(crate) fn typed<T>(value: &Spanned<DeValue<'_>>, found: Option<T>) -> Result<T, ValueFault> {
    found.ok_or_else(|| ValueFault::Type(value.span()))
}

/// Returns the contents of `found`, or a range fault at the position of `value`.
pub(crate) fn in_range<T>(value: &Spanned<DeValue<'_>>, found: Option<T>) -> Result<T, ValueFault> {
    found.ok_or_else(|| ValueFault::Range(value.span()))
}

pub(crate) trait Setting: Sized {
    /// Description of the type for fault messages, such as "a number".
    const KIND: &'static str;
    /// Description of a list of this type.
    const LIST_KIND: &'static str = "a list";
    const CHOICES: &'static [&'static str] = &[];
    fn read(value: &Spanned<DeValue<'_>>, allowed: &ValueRange) -> Result<Self, ValueFault>;
    /// Reads and checks a value that consists of tables with their own keys. The outer `None` means that this type has
    /// no tables; the inner `None` means that the value is faulty.
    fn read_tables(_: &TableReader<'_>, _: &Key, _: &Spanned<DeValue<'_>>) -> Option<Option<Self>> {
        None
    }
    /// The value for an optional key that the file does not contain; `None` = this type has no such value.
    fn absent() -> Option<Self> {
        None
    }
}

/// What happens if the file does not contain a key.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Presence {
    Required,
    /// The key may be absent. The text describes the default, or the condition that requires the key.
    Optional(&'static str),
    /// If the key is absent, this TOML text is read as its value.
    Default(&'static str),
}

/// A declared key.
#[derive(Debug)]
pub(crate) struct Key {
    pub name: &'static str,
    /// Meaning of the key, as printed in the reference page.
    pub about: &'static str,
    /// Unit of the value; empty if the value has no unit.
    pub unit: &'static str,
    /// Type of the value in words.
    pub kind: &'static str,
    /// Allowed words, if the key is a choice.
    pub choices: &'static [&'static str],
    pub allowed: ValueRange,
    pub presence: Presence,
}

impl Key {
    /// The range in words; empty if every value of the type is allowed.
    pub(crate) fn range(&self) -> String {
        if self.choices.is_empty() { self.allowed.to_string() } else { self.choices.join(" or ") }
    }

    /// The range for a fault message. [`WIDEST`] is left out, because no sensible value exceeds it.
    fn range_in_fault(&self) -> String {
        match self.choices {
            [_, _, _, ..] => format!("one of {}", self.choices.join(", ")),
            _ if self.allowed == WIDEST => String::new(),
            _ => self.range(),
        }
    }

    /// The first sentence of the key's meaning, without its full stop.
    fn meaning(&self) -> &'static str {
        let about = self.about.trim();
        about.split_once(". ").map_or(about, |(first, _)| first).trim_end_matches('.')
    }

    /// The allowed values and their type, for a fault message.
    pub(crate) fn must_be(&self) -> String {
        let range = self.range_in_fault();
        if self.allowed == ValueRange::NotEmpty {
            return format!("must be {} that is not empty", self.kind);
        }
        let unit = if self.unit.is_empty() { String::new() } else { format!(" ({})", self.unit) };
        match (self.choices.is_empty(), range.is_empty()) {
            (false, _) => format!("must be {range}"),
            (true, true) => format!("must be {}{unit}", self.kind),
            (true, false) => format!("must be {}, {range}{unit}", self.kind),
        }
    }

    /// The allowed values without their type, for a fault message about a value that has the right type.
    fn must_be_in_range(&self) -> String {
        match self.range_in_fault() {
            range if range.is_empty() || self.allowed == ValueRange::NotEmpty => self.must_be(),
            range => format!("must be {range}"),
        }
    }
}

/// Reads the keys of one table.
pub(crate) struct TableReader<'a> {
    pub document: &'a Document<'a>,
    /// Whether a part of the table may be unreadable. If so, missing keys are not reported.
    pub broken: bool,
    /// The table; `None` = the file does not contain the table.
    pub table: Option<&'a DeTable<'a>>,
    pub place: TablePlace,
}

impl TableReader<'_> {
    /// Returns the value of `key` or its default. Returns `None` if the value is faulty (reported) or if a required key
    /// is missing (reported unless the table is `broken`).
    pub(crate) fn setting<T: Setting>(&self, key: &Key) -> Option<T> {
        let Some(value) = self.table.and_then(|table| table.get(key.name)) else {
            return self.absent(key);
        };
        if let Some(tables) = T::read_tables(self, key, value) {
            return tables;
        }
        match T::read(value, &key.allowed) {
            Ok(setting) => Some(setting),
            Err(wrong) => {
                let what = match &wrong {
                    ValueFault::Type(_) => key.must_be(),
                    ValueFault::Range(_) => {
                        let found = value.get_ref().as_str().unwrap_or_default();
                        key.must_be_in_range() + &did_you_mean(found, key.choices.iter().copied())
                    }
                };
                let (ValueFault::Type(span) | ValueFault::Range(span)) = wrong;
                let found = self.document.found(value, &span);
                let text = format!("{} = {found}, {what}", self.place.key(key.name));
                self.document.faults.add_at(&self.document.line(&span), text);
                None
            }
        }
    }

    fn absent<T: Setting>(&self, key: &Key) -> Option<T> {
        match key.presence {
            Presence::Optional(_) => T::absent(),
            Presence::Default(text) => {
                let value = DeValue::parse(text).ok()?;
                T::read(&value, &key.allowed).ok()
            }
            Presence::Required if self.broken => None,
            Presence::Required => {
                let text = format!("{} is missing, {}: {}", self.place.key(key.name), key.must_be(), key.meaning());
                self.document.faults.add_at(&self.place.at, text);
                None
            }
        }
    }
}
