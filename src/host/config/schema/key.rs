//! What every declared key has: its meaning, type and range, and how its value is read from a table.

use std::fmt;
use std::ops::Range;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::config::document::{Document, TablePlace};
use crate::quantity::bounds::Bounds;

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
    fn read_tables(_: &TableReader<'_>, _: &Key, _: &Spanned<DeValue<'_>>) -> Option<Option<Self>> {
        None
    }
    /// Value of a key that is not written and has no default.
    fn absent() -> Option<Self> {
        None
    }
}

/// Effect of a key that is not written.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Presence {
    /// It is a fault.
    Required,
    /// None is needed; the key's text says what holds without it.
    Optional,
    /// This TOML text is read instead.
    Default(&'static str),
}

/// One key.
#[derive(Debug)]
pub(crate) struct Key {
    /// Name in the file.
    pub name: &'static str,
    /// Meaning.
    pub about: &'static str,
    /// Unit, or empty.
    pub unit: &'static str,
    /// Its type in words.
    pub kind: &'static str,
    /// Words it may be, when it is a choice.
    pub choices: &'static [&'static str],
    /// Its range.
    pub allowed: ValueRange,
    /// Effect of leaving it out.
    pub presence: Presence,
}

impl Key {
    /// The range for people; empty when anything of the type goes.
    pub(crate) fn range(&self) -> String {
        if self.choices.is_empty() { self.allowed.to_string() } else { self.choices.join(" or ") }
    }

    /// The allowed values with their type, as a fault says it.
    pub(crate) fn must_be(&self) -> String {
        let range = self.range();
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

    /// The allowed values, for a value of the right type.
    fn must_be_in_range(&self) -> String {
        match self.range() {
            range if range.is_empty() || self.allowed == ValueRange::NotEmpty => self.must_be(),
            range => format!("must be {range}"),
        }
    }
}

/// Reads the keys of one table.
pub(crate) struct TableReader<'a> {
    pub document: &'a Document<'a>,
    /// Whether the table may be incomplete, so that a missing key is not reported.
    pub broken: bool,
    /// `None` = not written.
    pub table: Option<&'a DeTable<'a>>,
    /// Place in the file.
    pub place: TablePlace,
}

impl TableReader<'_> {
    /// The value of `key`, its default, or `None` with a fault noted.
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
                    ValueFault::Range(_) => key.must_be_in_range(),
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
            Presence::Optional => T::absent(),
            Presence::Default(text) => {
                let value = DeValue::parse(text).ok()?;
                T::read(&value, &key.allowed).ok()
            }
            Presence::Required if self.broken => None,
            Presence::Required => {
                let text = format!("{} is missing, {}", self.place.key(key.name), key.must_be());
                self.document.faults.add_at(&self.place.at, text);
                None
            }
        }
    }
}
