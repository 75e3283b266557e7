//! Reads the declared tables of a document. An unknown key is a fault. The fault message suggests the most similar
//! known key, or lists all known keys if no name is similar.

use std::collections::BTreeSet;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::key::TableReader;
use super::section::{Section, SectionInfo};
use crate::config::document::{Document, SourceLine};

pub(crate) struct SchemaReader<'a> {
    document: &'a Document<'a>,
    /// Whether a part of the document is unreadable. If so, a key that was not found may still exist, so no key is
    /// reported as missing.
    pub broken: bool,
}

impl<'a> SchemaReader<'a> {
    /// Creates a reader. Reports the unknown keys of the document, and values that should be tables.
    pub(crate) fn new(document: &'a Document<'a>, known: &[SectionInfo]) -> Self {
        let mut walk = Self { document, broken: document.broken };
        walk.refuse_unknown("", "", document.root(), known);
        walk
    }

    /// Reads a table that occurs once. If the file does not contain the table, its keys have their defaults, and
    /// missing required keys are reported.
    pub(crate) fn one<S: Section>(&self) -> Option<S> {
        if S::PATH.is_empty() {
            let root = self.document.root();
            return self.read(S::PATH, self.document.first_line(), Some(root));
        }
        match self.document.find(S::PATH) {
            None => self.read(S::PATH, self.line_above(S::PATH), None),
            Some(value) => match value.get_ref() {
                DeValue::Table(table) => self.read(S::PATH, self.document.line(&value.span()), Some(table)),
                _ => None, // reported by the check for unknown keys
            },
        }
    }

    pub(crate) fn optional<S: Section>(&self) -> Option<S> {
        self.document.find(S::PATH).and_then(|_| self.one())
    }

    /// Reads every table of a repeatable section. Faulty tables are reported and left out.
    pub(crate) fn many<S: Section>(&self) -> Vec<S> {
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

    /// How often the file contains the table at `path`. A value that is not a list counts as one table.
    pub(crate) fn count(&self, path: &str) -> usize {
        match self.document.find(path).map(Spanned::get_ref) {
            None => 0,
            Some(DeValue::Array(items)) => items.len(),
            Some(_) => 1,
        }
    }

    /// Line of the parent table of `path`, for faults about an absent table.
    fn line_above(&self, path: &str) -> SourceLine {
        let above = path.rsplit_once('.').and_then(|(above, _)| self.document.find(above));
        above.map_or_else(|| self.document.first_line(), |value| self.document.line(&value.span()))
    }

    fn read<S: Section>(&self, path: &str, at: SourceLine, table: Option<&'a DeTable<'a>>) -> Option<S> {
        let nothing = DeTable::new();
        let place = self.document.place(path, at, table.unwrap_or(&nothing));
        S::read(&TableReader { document: self.document, broken: self.broken, table, place })
    }

    /// Reports every key of `table` that `known` does not contain. `schema` is the table's path in the schema. `shown`
    /// is its path in fault messages, which includes the number of a repeated table.
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
                let names: Vec<&str> = keys.iter().map(|k| k.name).chain(tables.iter().copied()).collect();
                let hint = match did_you_mean(key, names.iter().copied()) {
                    nothing if nothing.is_empty() => format!(", must be one of {}", names.join(", ")),
                    meant => meant,
                };
                self.document.faults.add_at(&line, format!("{shown_key} is not a known key{hint}"));
            }
        }
    }

    /// Checks a value that must be a table according to the schema.
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
                self.document.faults.add_at(&line, format!("{shown} = {found}, must be {must_be}"));
            }
        }
    }
}

/// Returns the names of the tables directly below `path` that are known tables or contain known tables.
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

/// Returns `, did you mean X` for the most similar of `names`, or an empty text if no name is similar enough.
pub(crate) fn did_you_mean<'n>(found: &str, names: impl Iterator<Item = &'n str>) -> String {
    nearest(found, names).map_or_else(String::new, |name| format!(", did you mean {name}"))
}

/// Returns the most similar of `names`; `None` if no name is similar enough.
pub(crate) fn nearest<'n>(found: &str, names: impl Iterator<Item = &'n str>) -> Option<&'n str> {
    /// Smallest Jaro-Winkler similarity of a suggested name. A less similar name would confuse the user.
    const NEAR: f64 = 0.8;
    let near = |name: &'n str| (strsim::jaro_winkler(&found.to_lowercase(), &name.to_lowercase()), name);
    let best = names.map(near).max_by(|a, b| a.0.total_cmp(&b.0));
    best.filter(|(similarity, _)| *similarity >= NEAR).map(|(_, name)| name)
}
