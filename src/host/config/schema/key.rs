//! Defines the properties of a declared key (meaning, type, range), and reads the value of a key from a table.

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

/// The range of alarm thresholds and of the factors and offsets of signals. No sensible value is outside this range.
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

/// Why and where a value is rejected.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum ValueFault {
    /// The value has the wrong type.
    Type(Range<usize>),
    /// The value has the right type but is out of range.
    Range(Range<usize>),
}

/// Returns the contents of `found`. If `found` is `None`, returns a type fault at the position of `value`.
pub(crate) fn typed<T>(value: &Spanned<DeValue<'_>>, found: Option<T>) -> Result<T, ValueFault> {
    found.ok_or_else(|| ValueFault::Type(value.span()))
}

/// Returns the contents of `found`. If `found` is `None`, returns a range fault at the position of `value`.
pub(crate) fn in_range<T>(value: &Spanned<DeValue<'_>>, found: Option<T>) -> Result<T, ValueFault> {
    found.ok_or_else(|| ValueFault::Range(value.span()))
}

/// A type that a key may have.
pub(crate) trait Setting: Sized {
    /// Description of the type for fault messages, such as "a number".
    const KIND: &'static str;
    /// Description of a list of this type.
    const LIST_KIND: &'static str = "a list";
    /// The allowed words, if the type is a choice.
    const CHOICES: &'static [&'static str] = &[];
    /// Reads and checks a value.
    fn read(value: &Spanned<DeValue<'_>>, allowed: &ValueRange) -> Result<Self, ValueFault>;
    /// Reads and checks a value that consists of tables with their own keys; `None` for all other types.
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
    /// The absence is a fault.
    Required,
    /// The absence is allowed. The text describes the default, or the condition that requires the key.
    Optional(&'static str),
    /// If the key is absent, this TOML text is read as its value.
    Default(&'static str),
}

/// One key.
#[derive(Debug)]
pub(crate) struct Key {
    /// Name of the key in the file.
    pub name: &'static str,
    /// Meaning of the key, as printed in the reference page.
    pub about: &'static str,
    /// Unit of the value; empty if the value has no unit.
    pub unit: &'static str,
    /// Type of the value in words.
    pub kind: &'static str,
    /// Allowed words, if the key is a choice.
    pub choices: &'static [&'static str],
    /// Allowed range of the value.
    pub allowed: ValueRange,
    /// What happens if the key is absent.
    pub presence: Presence,
}

impl Key {
    /// The range in words; empty if every value of the type is allowed.
    pub(crate) fn range(&self) -> String {
        if self.choices.is_empty() { self.allowed.to_string() } else { self.choices.join(" or ") }
    }

    /// The range as it appears in a fault. Bounds so wide that no sensible value exceeds them are left out.
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

    /// The allowed values with their type, as they appear in a fault.
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

    /// The allowed values, without the type, for a fault of a value that has the right type.
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
    /// Place of the table in the file.
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
