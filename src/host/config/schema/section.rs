//! Macros that declare the tables and keys of a file.
//!
//! [`section!`] declares a table, with one line for each key. The line determines the key's type, how it is read, its
//! fault messages, and its text in the reference page. [`tables!`] lists the tables of a file. [`SchemaReader`] reads
//! these tables from a document.

use toml::Spanned;
use toml::de::DeValue;

use super::key::{Key, Setting, TableReader, ValueFault, ValueRange};

/// A declared table of a file.
pub(crate) trait Section: Sized {
    /// Dotted path; empty for the top of the file.
    const PATH: &'static str;
    const ABOUT: &'static str;
    const KEYS: &'static [Key];
    /// Reads the table. If a key is bad, reports a fault and returns `None`.
    fn read(table: &TableReader<'_>) -> Option<Self>;
}

/// A declared table, for the check of unknown keys and for the reference page.
#[derive(Debug)]
pub(crate) struct SectionInfo {
    pub path: &'static str,
    /// Whether the table is written `[[path]]` and may be repeated.
    pub many: bool,
    pub about: &'static str,
    /// The keys of the table; `None` = any key is allowed, because the program ignores the table.
    pub keys: Option<&'static [Key]>,
}

impl SectionInfo {
    pub(crate) const fn one<S: Section>() -> Self {
        Self { path: S::PATH, many: false, about: S::ABOUT, keys: Some(S::KEYS) }
    }

    pub(crate) const fn optional<S: Section>() -> Self {
        Self::one::<S>()
    }

    pub(crate) const fn many<S: Section>() -> Self {
        Self { path: S::PATH, many: true, about: S::ABOUT, keys: Some(S::KEYS) }
    }

    /// A table of notes for people who read the file.
    pub(crate) const fn notes(path: &'static str, about: &'static str) -> Self {
        Self { path, many: false, about, keys: None }
    }
}

/// Declares a table of a file. The macro generates the table's struct and the function that reads the table. If the
/// table has a `gives` clause, the macro also generates a function that builds the named parameter struct.
///
/// ```text
/// section! {
///     /// What the table is for.
///     Transition at "transition" gives TransitionConfig, |keys, pack_ah: f64| {
///         /// A key that sets the field of the same name.
///         min_duration_s: f64, "s", Between(0.0, 1e6), Default("10.0");
///         /// A key from which a field is computed. If nothing follows `=>`, the key sets no field.
///         dead_band_a: Option<f64>, "A", Between(0.0, 1e6), Optional("C/50") => dead_band_a: keys.dead_band_a.unwrap_or(pack_ah / 50.0);
///     } and {
///         a_field_without_a_key: 1.0,
///     }
/// }
/// ```
///
/// This example generates `config(&self, pack_ah: f64) -> TransitionConfig`.
macro_rules! section {
    // Collects the fields of the parameter struct, one key at a time.
    (@fields $target:ident $keys:ident [$($done:tt)*]) => { $target { $($done)* } };
    (@fields $target:ident $keys:ident [$($done:tt)*] $key:ident; $($rest:tt)*) => {
        $crate::config::schema::section!(@fields $target $keys [$($done)* $key: $keys.$key,] $($rest)*)
    };
    (@fields $target:ident $keys:ident [$($done:tt)*] $key:ident []; $($rest:tt)*) => {
        $crate::config::schema::section!(@fields $target $keys [$($done)*] $($rest)*)
    };
    (@fields $target:ident $keys:ident [$($done:tt)*] $key:ident [$field:ident: $value:expr]; $($rest:tt)*) => {
        $crate::config::schema::section!(@fields $target $keys [$($done)* $field: $value,] $($rest)*)
    };
    (
        $(#[doc = $about:literal])+
        $name:ident at $path:literal gives $target:ident $(<$borrow:lifetime>)?, |$keys:ident $(, $argument:ident: $argument_type:ty)*| {
            $(
                $(#[doc = $doc:literal])+
                $key:ident : $type:ty, $unit:literal, $allowed:expr, $presence:expr
                $(=> $($field:ident: $value:expr)?)?;
            )*
        } $(and { $($more:ident: $more_value:expr),* $(,)? })?
    ) => {
        $crate::config::schema::section! {
            $(#[doc = $about])+
            $name at $path {
                $( $(#[doc = $doc])+ $key: $type, $unit, $allowed, $presence; )*
            }
        }

        impl $name {
            pub(crate) fn config(&self $(, $argument: $argument_type)*) -> $target $(<$borrow>)? {
                let $keys = self;
                $crate::config::schema::section!(
                    @fields $target $keys [] $( $key $([ $($field: $value)? ])?; )* $($( $more [$more: $more_value]; )*)?
                )
            }
        }
    };
    ($(#[doc = $about:literal])+ $name:ident at $path:literal {
        $( $(#[doc = $doc:literal])+ $key:ident : $type:ty, $unit:literal, $allowed:expr, $presence:expr; )*
    }) => {
        $(#[doc = $about])+
        #[derive(Debug, Clone)]
        #[allow(dead_code, reason = "some keys are only for people, and the places of some tables are not used by later checks")]
        pub(crate) struct $name {
            pub place: $crate::config::document::TablePlace,
            $( $(#[doc = $doc])+ pub $key: $type, )*
        }

        impl $crate::config::schema::Section for $name {
            const PATH: &'static str = $path;
            const ABOUT: &'static str = concat!($($about),+);
            const KEYS: &'static [$crate::config::schema::Key] = &[$(
                $crate::config::schema::Key {
                    name: stringify!($key),
                    about: concat!($($doc),+),
                    unit: $unit,
                    kind: <$type as $crate::config::schema::Setting>::KIND,
                    choices: <$type as $crate::config::schema::Setting>::CHOICES,
                    allowed: $allowed,
                    presence: $presence,
                },
            )*];

            fn read(table: &$crate::config::schema::TableReader<'_>) -> Option<Self> {
                let mut keys = Self::KEYS.iter();
                $( let $key: Option<$type> = keys.next().and_then(|key| table.setting(key)); )*
                Some(Self { place: table.place.clone(), $( $key: $key?, )* })
            }
        }
    };
}
pub(crate) use section;

/// The type of a table's field in the struct of [`tables!`]: a list for a repeatable table, else an `Option`.
macro_rules! table_field {
    (many $section:ty) => { Vec<$section> };
    ($kind:ident $section:ty) => { Option<$section> };
}
pub(crate) use table_field;

/// Lists the tables of a file in the order of the reference page. The macro generates a struct of these tables and the
/// function that reads it.
///
/// Each table is `one`, `optional` or `many`. A table marked `one` is always read: if the file does not contain it, its
/// keys have their defaults, and missing required keys are reported. A table marked `optional` is read only if the file
/// contains it. A table marked `many` is repeatable (`[[path]]`). If the value of a key is itself a list of tables,
/// `with` names the type of these inner tables.
macro_rules! tables {
    ($(#[$about:meta])* $name:ident, $sections:ident { $($field:ident: $kind:ident $section:ident $(with $below:ident)?),+ $(,)? }) => {
        $(#[$about])*
        #[derive(Debug)]
        pub(crate) struct $name {
            /// The file, as the user named it.
            pub file: String,
            pub faults: $crate::config::document::Faults,
            /// Whether the file's syntax or a table is broken. If so, a table that was not found may still exist.
            pub broken: bool,
            /// How often the file contains each table, including faulty tables.
            written: std::collections::BTreeMap<&'static str, usize>,
            $( pub $field: $crate::config::schema::table_field!($kind $section), )+
        }

        impl $name {
            /// Reads every table, and reports faulty and unknown keys.
            pub(crate) fn read(document: &$crate::config::document::Document<'_>) -> Self {
                use $crate::config::schema::Section as _;
                let reader = $crate::config::schema::SchemaReader::new(document, $sections);
                Self {
                    file: document.file.clone(),
                    faults: document.faults.clone(),
                    broken: reader.broken,
                    written: [$( ($section::PATH, reader.count($section::PATH)) ),+].into_iter().collect(),
                    $( $field: reader.$kind(), )+
                }
            }

            /// Whether a table is present, even if faulty.
            pub(crate) fn is_written<S: $crate::config::schema::Section>(&self) -> bool {
                self.count::<S>() > 0
            }

            pub(crate) fn count<S: $crate::config::schema::Section>(&self) -> usize {
                self.written.get(S::PATH).copied().unwrap_or_default()
            }

            /// Place of each table that was read without a fault.
            pub(crate) fn places(&self) -> impl Iterator<Item = &$crate::config::document::TablePlace> {
                std::iter::empty() $( .chain(self.$field.iter().map(|keys| &keys.place)) )+
            }
        }

        pub(crate) const $sections: &[$crate::config::schema::SectionInfo] =
            &[$( $crate::config::schema::SectionInfo::$kind::<$section>(), $( $crate::config::schema::SectionInfo::many::<$below>(), )? )+];
    };
}
pub(crate) use tables;

/// A key whose value is a list of declared tables, `[{ ... }, ...]` or `[[...]]`.
#[derive(Debug, Clone)]
pub(crate) struct SubTables<S>(pub Vec<S>);

impl<S: Section> Setting for SubTables<S> {
    const KIND: &'static str = "a list of tables";

    fn read(value: &Spanned<DeValue<'_>>, _: &ValueRange) -> Result<Self, ValueFault> {
        Err(ValueFault::Type(value.span()))
    }

    fn read_tables(reader: &TableReader<'_>, key: &Key, value: &Spanned<DeValue<'_>>) -> Option<Option<Self>> {
        let DeValue::Array(items) = value.get_ref() else { return Some(None) }; // the unknown-key check reports this
        if items.is_empty() {
            reader.place.fault(key.name, key.must_be());
            return Some(None);
        }
        let read = |(item, number): (&Spanned<DeValue<'_>>, usize)| {
            let DeValue::Table(table) = item.get_ref() else { return None };
            let path = format!("{}[{number}]", reader.place.key(key.name));
            let place = reader.document.place(&path, reader.document.line(&item.span()), table);
            S::read(&TableReader { table: Some(table), place, ..*reader })
        };
        // Reads every table before returning, so that each fault is reported.
        let tables: Vec<Option<S>> = items.iter().zip(1..).map(read).collect();
        Some(tables.into_iter().collect::<Option<Vec<S>>>().map(Self))
    }
}
