//! The mechanism behind every declared key: a line of [`section!`] gives its type, reading, faults and reference text.
//!
//! [`section!`] declares a table of a file and, where the table `gives` a parameter struct, makes that struct of the keys.
//! [`tables!`] lists the tables of a file. [`SchemaReader`] reads declared tables from a document and notes every fault:
//! missing, unknown, of the wrong type, out of range.

use std::collections::BTreeSet;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::document::{Document, Faults, TablePlace};
use super::setting::{Setting, ValueFault, ValueRange};
use super::source::SourceLine;

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

/// A declared table of a file.
pub(crate) trait Section: Sized {
    /// Dotted path; empty for the top of the file.
    const PATH: &'static str;
    /// Purpose of the table.
    const ABOUT: &'static str;
    /// Its keys.
    const KEYS: &'static [Key];
    /// Reads it; `None` when a key is bad (noted in the faults).
    fn read(table: &mut TableReader<'_>) -> Option<Self>;
}

/// A declared table, for the check of unknown keys and for the reference page.
#[derive(Debug)]
pub(crate) struct SectionInfo {
    /// Dotted path.
    pub path: &'static str,
    /// Whether it is written `[[path]]`, any number of times.
    pub many: bool,
    /// Purpose of the table.
    pub about: &'static str,
    /// Its keys; `None` = any key (notes for people).
    pub keys: Option<&'static [Key]>,
}

impl SectionInfo {
    /// A table written once.
    pub(crate) const fn one<S: Section>() -> Self {
        Self { path: S::PATH, many: false, about: S::ABOUT, keys: Some(S::KEYS) }
    }

    /// A table written once or not at all.
    pub(crate) const fn optional<S: Section>() -> Self {
        Self::one::<S>()
    }

    /// A table written any number of times.
    pub(crate) const fn many<S: Section>() -> Self {
        Self { path: S::PATH, many: true, about: S::ABOUT, keys: Some(S::KEYS) }
    }

    /// A table for people, never read.
    pub(crate) const fn notes(path: &'static str, about: &'static str) -> Self {
        Self { path, many: false, about, keys: None }
    }
}

/// Declares a table of a file: the struct, its keys, how it is read and, after `gives`, the parameters it stands for.
///
/// ```text
/// section! {
///     /// What the table is for.
///     Transition at "transition" gives TransitionConfig, |keys, pack_ah: f64| {
///         /// A key that is the field of the same name.
///         min_duration_s: f64, "s", Between(0.0, 1e6), Default("10.0");
///         /// A key from which a field is computed; behind an arrow alone, no field is.
///         dead_band_a: Option<f64>, "A", Between(0.0, 1e6), Optional => dead_band_a: keys.dead_band_a.unwrap_or(pack_ah / 50.0);
///     } and {
///         a_field_without_a_key: 1.0,
///     }
/// }
/// ```
///
/// The parameters are then those of `config(&self, pack_ah: f64) -> TransitionConfig`.
macro_rules! section {
    // Collects the fields of the parameters, one key at a time.
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
            /// The parameters these keys stand for.
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
        #[allow(dead_code, reason = "some keys are for people only, and not every table is checked again at its place")]
        pub(crate) struct $name {
            /// Place in the file.
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
                    kind: <$type as $crate::config::setting::Setting>::KIND,
                    choices: <$type as $crate::config::setting::Setting>::CHOICES,
                    allowed: $allowed,
                    presence: $presence,
                },
            )*];

            fn read(table: &mut $crate::config::schema::TableReader<'_>) -> Option<Self> {
                let mut keys = Self::KEYS.iter();
                $( let $key: Option<$type> = keys.next().and_then(|key| table.setting(key)); )*
                Some(Self { place: table.place.clone(), $( $key: $key?, )* })
            }
        }
    };
}
pub(crate) use section;

/// The field of [`tables!`] for a table: a list where it may be written many times.
macro_rules! table_field {
    (many $section:ty) => { Vec<$section> };
    ($kind:ident $section:ty) => { Option<$section> };
}
pub(crate) use table_field;

/// Lists the tables of a file, in the order of the reference page: the struct of all of them and how it is read.
///
/// Each is `one` (always read: without it in the file its defaults hold, and its required keys are missing), `optional`
/// (read where it is written) or `many` (`[[path]]`, any number of times); `with` names the tables that one of its keys holds.
macro_rules! tables {
    ($(#[$about:meta])* $name:ident, $sections:ident { $($field:ident: $kind:ident $section:ident $(with $below:ident)?),+ $(,)? }) => {
        $(#[$about])*
        #[derive(Debug)]
        pub(crate) struct $name {
            /// The file, as people named it.
            pub file: String,
            /// Whether the file's syntax or a table is broken, so that a table not found may still be there.
            pub broken: bool,
            /// How often each table is written, faulty or not.
            written: std::collections::BTreeMap<&'static str, usize>,
            $( pub $field: $crate::config::schema::table_field!($kind $section), )+
        }

        impl $name {
            /// Reads every table; faults of single keys and unknown keys are noted.
            pub(super) fn read(
                document: &$crate::config::document::Document<'_>,
                faults: &mut $crate::config::document::Faults,
            ) -> Self {
                use $crate::config::schema::Section as _;
                let mut reader = $crate::config::schema::SchemaReader::new(document, $sections, faults);
                Self {
                    file: document.file.clone(),
                    broken: reader.broken,
                    written: [$( ($section::PATH, reader.count($section::PATH)) ),+].into_iter().collect(),
                    $( $field: reader.$kind(), )+
                }
            }

            /// Whether a table is written, faulty or not.
            pub(crate) fn is_written<S: $crate::config::schema::Section>(&self) -> bool {
                self.count::<S>() > 0
            }

            /// How often a table is written, faulty or not.
            pub(crate) fn count<S: $crate::config::schema::Section>(&self) -> usize {
                self.written.get(S::PATH).copied().unwrap_or_default()
            }

            /// Place of each table.
            pub(crate) fn places(&self) -> impl Iterator<Item = &$crate::config::document::TablePlace> {
                std::iter::empty() $( .chain(self.$field.iter().map(|keys| &keys.place)) )+
            }
        }

        /// Every table, in the order of the reference page.
        pub(crate) const $sections: &[$crate::config::schema::SectionInfo] =
            &[$( $crate::config::schema::SectionInfo::$kind::<$section>(), $( $crate::config::schema::SectionInfo::many::<$below>(), )? )+];
    };
}
pub(crate) use tables;

/// Reads the keys of one table.
pub(crate) struct TableReader<'a> {
    document: &'a Document<'a>,
    broken: bool,
    table: Option<&'a DeTable<'a>>,
    /// Place in the file.
    pub place: TablePlace,
    faults: &'a mut Faults,
}

impl TableReader<'_> {
    /// The value of `key`, its default, or `None` with a fault noted.
    pub(crate) fn setting<T: Setting>(&mut self, key: &Key) -> Option<T> {
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
                self.faults.add_at(&self.document.line(&span), text);
                None
            }
        }
    }

    /// The tables below a key; `None` when one of them is faulty (noted).
    fn sub_tables<S: Section>(&mut self, key: &Key, value: &Spanned<DeValue<'_>>) -> Option<Vec<S>> {
        let DeValue::Array(items) = value.get_ref() else { return None }; // noted by the check for unknown keys
        if items.is_empty() {
            self.place.fault(self.faults, key.name, &key.must_be());
            return None;
        }
        let read = |(item, number): (&Spanned<DeValue<'_>>, usize)| {
            let DeValue::Table(table) = item.get_ref() else { return None };
            let path = format!("{}[{number}]", self.place.key(key.name));
            let place = self.document.place(&path, self.document.line(&item.span()), table);
            let Self { document, broken, ref mut faults, .. } = *self;
            S::read(&mut TableReader { document, broken, table: Some(table), place, faults })
        };
        // Every one is read, so that each fault is noted.
        let tables: Vec<Option<S>> = items.iter().zip(1..).map(read).collect();
        tables.into_iter().collect()
    }

    fn absent<T: Setting>(&mut self, key: &Key) -> Option<T> {
        match key.presence {
            Presence::Optional => T::absent(),
            Presence::Default(text) => {
                let value = DeValue::parse(text).ok()?;
                T::read(&value, &key.allowed).ok()
            }
            Presence::Required if self.broken => None,
            Presence::Required => {
                let text = format!("{} is missing, {}", self.place.key(key.name), key.must_be());
                self.faults.add_at(&self.place.at, text);
                None
            }
        }
    }
}

/// A key whose value is a list of declared tables, `[{ ... }, ...]` or `[[...]]`.
#[derive(Debug, Clone)]
pub(crate) struct SubTables<S>(pub Vec<S>);

impl<S: Section> Setting for SubTables<S> {
    const KIND: &'static str = "a list of tables";

    fn read(value: &Spanned<DeValue<'_>>, _: &ValueRange) -> Result<Self, ValueFault> {
        Err(ValueFault::Type(value.span()))
    }

    fn read_tables(reader: &mut TableReader<'_>, key: &Key, value: &Spanned<DeValue<'_>>) -> Option<Option<Self>> {
        Some(reader.sub_tables(key, value).map(Self))
    }
}

/// Reads the declared tables of one document.
pub(crate) struct SchemaReader<'a> {
    document: &'a Document<'a>,
    /// Whether syntax or tables are broken somewhere, so that a missing key may still be there: then none is reported as
    /// missing.
    pub broken: bool,
    faults: &'a mut Faults,
}

impl<'a> SchemaReader<'a> {
    /// A walk that has checked the document for unknown keys.
    pub(super) fn new(document: &'a Document<'a>, known: &[SectionInfo], faults: &'a mut Faults) -> Self {
        let mut walk = Self { document, broken: document.broken, faults };
        walk.refuse_unknown("", "", document.root(), known);
        walk
    }

    /// A table that is always read: without it in the file its required keys are missing.
    pub(super) fn one<S: Section>(&mut self) -> Option<S> {
        if S::PATH.is_empty() {
            let root = self.document.root();
            return self.read(S::PATH, self.document.first_line(), Some(root));
        }
        match self.document.find(S::PATH) {
            None => self.read(S::PATH, self.line_above(S::PATH), None),
            Some(value) => match value.get_ref() {
                DeValue::Table(table) => self.read(S::PATH, self.document.line(&value.span()), Some(table)),
                _ => None, // noted by the check for unknown keys
            },
        }
    }

    /// A table that may be left out.
    pub(super) fn optional<S: Section>(&mut self) -> Option<S> {
        self.document.find(S::PATH).and_then(|_| self.one())
    }

    /// A table that may be written any number of times; faulty ones are left out (and noted).
    pub(super) fn many<S: Section>(&mut self) -> Vec<S> {
        let Some(DeValue::Array(items)) = self.document.find(S::PATH).map(Spanned::get_ref) else {
            return Vec::new();
        };
        let mut sections = Vec::new();
        for (index, item) in items.iter().enumerate() {
            if let DeValue::Table(table) = item.get_ref() {
                let path = format!("{}[{}]", S::PATH, index + 1);
                sections.extend(self.read(&path, self.document.line(&item.span()), Some(table)));
            }
        }
        sections
    }

    /// How often the table at `path` is written; what is no list of tables counts once.
    pub(super) fn count(&self, path: &str) -> usize {
        match self.document.find(path).map(Spanned::get_ref) {
            None => 0,
            Some(DeValue::Array(items)) => items.len(),
            Some(_) => 1,
        }
    }

    /// Line of the table that the table at `path`, which is not written, would be in.
    fn line_above(&self, path: &str) -> SourceLine {
        let above = path.rsplit_once('.').and_then(|(above, _)| self.document.find(above));
        above.map_or_else(|| self.document.first_line(), |value| self.document.line(&value.span()))
    }

    fn read<S: Section>(&mut self, path: &str, at: SourceLine, table: Option<&'a DeTable<'a>>) -> Option<S> {
        let nothing = DeTable::new();
        let place = self.document.place(path, at, table.unwrap_or(&nothing));
        S::read(&mut TableReader { document: self.document, broken: self.broken, table, place, faults: self.faults })
    }

    /// Notes every key of `table` that `known` does not have. `schema` is the table's path in the schema,
    /// `shown` the one for people (with the number of a repeated table).
    fn refuse_unknown(&mut self, schema: &str, shown: &str, table: &'a DeTable<'a>, known: &[SectionInfo]) {
        let here = known.iter().find(|info| info.path == schema);
        if here.is_some_and(|info| info.keys.is_none()) {
            return;
        }
        let keys = here.and_then(|info| info.keys).unwrap_or(&[]);
        let tables = tables_below(schema, known);
        for (name, value) in table.iter() {
            let (key, line) = (name.get_ref().as_ref(), self.document.line(&name.span()));
            let shown_key = join(shown, key);
            if tables.contains(key) {
                self.table_below(&join(schema, key), &shown_key, value, known);
            } else if !keys.iter().any(|k| k.name == key) {
                let hint = did_you_mean(key, keys.iter().map(|k| k.name).chain(tables.iter().copied()));
                self.faults.add_at(&line, format!("{shown_key} is not a known key{hint}"));
            }
        }
    }

    /// The value where the schema has a table.
    fn table_below(&mut self, schema: &str, shown: &str, value: &'a Spanned<DeValue<'a>>, known: &[SectionInfo]) {
        let line = self.document.line(&value.span());
        let many = known.iter().any(|info| info.path == schema && info.many);
        match value.get_ref() {
            DeValue::Table(table) if !many => self.refuse_unknown(schema, shown, table, known),
            DeValue::Array(items) if many && items.iter().all(|item| item.get_ref().is_table()) => {
                for (index, item) in items.iter().enumerate() {
                    if let DeValue::Table(table) = item.get_ref() {
                        self.refuse_unknown(schema, &format!("{shown}[{}]", index + 1), table, known);
                    }
                }
            }
            other => {
                self.broken = true;
                let found = match other {
                    DeValue::Table(_) => format!("[{schema}]"),
                    DeValue::Array(items) if items.iter().any(|item| item.get_ref().is_table()) => {
                        format!("[[{schema}]]")
                    }
                    _ => self.document.quote(&value.span()),
                };
                let must_be = if many { format!("tables [[{schema}]]") } else { format!("one table [{schema}]") };
                self.faults.add_at(&line, format!("{shown} = {found}, must be {must_be}"));
            }
        }
    }
}

/// The names that continue `path` towards a known table.
fn tables_below<'k>(path: &str, known: &'k [SectionInfo]) -> BTreeSet<&'k str> {
    let below = |info: &'k SectionInfo| match path {
        "" => Some(info.path),
        _ => info.path.strip_prefix(path)?.strip_prefix('.'),
    };
    let first = |rest: &'k str| rest.split('.').next().filter(|name| !name.is_empty());
    known.iter().filter_map(below).filter_map(first).collect()
}

fn join(path: &str, key: &str) -> String {
    if path.is_empty() { key.to_owned() } else { format!("{path}.{key}") }
}

/// `, did you mean X` for the nearest of `names`, or nothing when none is near.
pub(super) fn did_you_mean<'n>(found: &str, names: impl Iterator<Item = &'n str>) -> String {
    /// Jaro-Winkler similarity below which a hint confuses more than it helps.
    const NEAR: f64 = 0.8;
    let near = |name: &'n str| (strsim::jaro_winkler(&found.to_lowercase(), &name.to_lowercase()), name);
    let best = names.map(near).max_by(|a, b| a.0.total_cmp(&b.0));
    match best {
        Some((similarity, name)) if similarity >= NEAR => format!(", did you mean {name}"),
        _ => String::new(),
    }
}
