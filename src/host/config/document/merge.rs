//! Parses and merges the TOML texts of a configuration, and keeps the lines of their values.

use std::ops::Range;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::faults::{Faults, KeyPlace, SourceLine, TablePlace};
use super::source::{SourceFile, Sources};

/// Maximum number of characters that a fault quotes: enough to recognise the text, and few enough for one line.
const MAX_QUOTE: usize = 48;
/// Maximum number of syntax faults listed one by one for each file. A file with more faults is probably not TOML.
const MAX_SYNTAX_FAULTS: usize = 10;

/// The tables of a configuration: one file, or a file and its drop-ins merged.
#[derive(Debug)]
pub(crate) struct Document<'t> {
    /// The main file, as the user named it.
    pub file: String,
    /// Whether a file has a syntax fault. If so, a key that was not found may be in the part that could not be parsed.
    pub broken: bool,
    pub faults: Faults,
    sources: &'t Sources,
    root: DeTable<'t>,
}

impl<'t> Document<'t> {
    /// Parses every file of `sources` and merges the files in order. Syntax faults are reported. The parts that can be
    /// parsed are kept, so that later checks find their faults too.
    pub(crate) fn parse(sources: &'t Sources, faults: &Faults) -> Self {
        let (mut root, mut broken) = (DeTable::new(), false);
        for source in sources.files() {
            let (table, errors) = DeTable::parse_recoverable(source.placed_text());
            let table = table.into_inner();
            note_syntax(source, &table, &errors, faults);
            broken |= !errors.is_empty();
            merge(&mut root, table);
        }
        Self { file: sources.main_file().to_owned(), broken, faults: faults.clone(), sources, root }
    }

    pub(crate) fn root(&self) -> &DeTable<'t> {
        &self.root
    }

    pub(crate) fn find(&self, path: &str) -> Option<&Spanned<DeValue<'t>>> {
        let mut parts = path.split('.');
        let mut value = self.root.get(parts.next()?)?;
        for part in parts {
            let DeValue::Table(table) = value.get_ref() else { return None };
            value = table.get(part)?;
        }
        Some(value)
    }

    pub(crate) fn first_line(&self) -> SourceLine {
        SourceLine { file: self.file.clone(), line: 1 }
    }

    /// File and line on which `span` begins.
    pub(crate) fn line(&self, span: &Range<usize>) -> SourceLine {
        self.sources.line(span)
    }

    pub(crate) fn written(&self, span: &Range<usize>) -> &'t str {
        self.sources.written(span)
    }

    /// The source text at `span`, shortened to one line.
    pub(crate) fn quote(&self, span: &Range<usize>) -> String {
        let words: Vec<&str> = self.written(span).split_whitespace().collect();
        shorten(&words.join(" "))
    }

    /// Returns the text that a fault quotes as the value found. `span` is the position of `value`, or of a part of
    /// `value`.
    pub(crate) fn found(&self, value: &Spanned<DeValue<'_>>, span: &Range<usize>) -> String {
        let is_inline = self.written(&value.span()).starts_with('{');
        if value.get_ref().is_table() && !is_inline {
            return "a table".to_owned();
        }
        let quote = self.quote(span);
        if quote.is_empty() { "(no value)".to_owned() } else { quote }
    }

    /// The position of a table: its path as shown to users, its line, and the positions of its keys.
    pub(crate) fn place(&self, path: &str, at: SourceLine, table: &DeTable<'_>) -> TablePlace {
        let spot = |(key, value): (&Spanned<_>, &Spanned<DeValue<'_>>)| {
            let key: &Spanned<std::borrow::Cow<'_, str>> = key;
            (
                key.get_ref().to_string(),
                KeyPlace { at: self.line(&key.span()), found: self.found(value, &value.span()) },
            )
        };
        TablePlace { at, path: path.to_owned(), spots: table.iter().map(spot).collect(), faults: self.faults.clone() }
    }
}

fn note_syntax(source: &SourceFile, table: &DeTable<'_>, errors: &[toml::de::Error], faults: &Faults) {
    let line = |error: &toml::de::Error| error.span().map_or(0, |span| source.line(&span));
    // Sorts the faults by line, because the first fault is often the cause of the others.
    let mut errors: Vec<&toml::de::Error> = errors.iter().collect();
    errors.sort_by_key(|&error| line(error));
    for &error in errors.iter().take(MAX_SYNTAX_FAULTS) {
        let mut what = error.message().trim().replace('\n', ", ");
        if let Some(again) = error.span().filter(|_| what == "duplicate key") {
            what = duplicate(source, table, &again).unwrap_or(what);
        }
        faults.add(source.name(), line(error), format!("invalid TOML: {what}"));
    }
    if let Some(&error) = errors.get(MAX_SYNTAX_FAULTS) {
        let more = errors.len() - MAX_SYNTAX_FAULTS;
        let what = format!("and {more} more syntax faults from here on; is this file really TOML?");
        faults.add(source.name(), line(error), what);
    }
}

/// Describes the key at `again`, which the file sets twice: its name and the line on which it is set first.
fn duplicate(source: &SourceFile, table: &DeTable<'_>, again: &Range<usize>) -> Option<String> {
    let name = source.placed_text().get(again.clone())?.trim_matches(['"', '\'']);
    let first = source.line(&last_use(table, name, again.start)?);
    Some(format!("the key {name} is set twice, first in line {first}"))
}

/// The last position before `end` at which a key `name` is set. For a duplicate key, this is the earlier setting in the
/// same table.
fn last_use(table: &DeTable<'_>, name: &str, end: usize) -> Option<Range<usize>> {
    let below = |value: &Spanned<DeValue<'_>>| match value.get_ref() {
        DeValue::Table(table) => last_use(table, name, end),
        DeValue::Array(items) => {
            let tables = items.iter().filter_map(|item| item.get_ref().as_table());
            tables.filter_map(|table| last_use(table, name, end)).max_by_key(|span| span.start)
        }
        _ => None,
    };
    let own = table.iter().filter(|(key, _)| key.get_ref() == name && key.span().start < end);
    let own = own.map(|(key, _)| key.span());
    own.chain(table.iter().filter_map(|(_, value)| below(value))).max_by_key(|span| span.start)
}

/// Merges the later file `over` into the earlier file `under`. Tables are merged key by key, and lists of tables are
/// appended. Any other value replaces the earlier value. An empty list also replaces the earlier list, so that a
/// drop-in can remove tables.
fn merge<'t>(under: &mut DeTable<'t>, over: DeTable<'t>) {
    for (key, new) in over {
        let Some((old_key, mut old)) = under.remove_entry(&key) else {
            under.insert(key, new);
            continue;
        };
        let is_list = is_list_of_tables(&old) && is_list_of_tables(&new);
        let (span, new) = (new.span(), new.into_inner());
        match (old.get_mut(), new) {
            (DeValue::Table(table), DeValue::Table(more)) => merge(table, more),
            (DeValue::Array(items), DeValue::Array(more)) if is_list => {
                more.into_iter().for_each(|item| items.push(item))
            }
            (_, new) => {
                under.insert(key, Spanned::new(span, new));
                continue;
            }
        }
        under.insert(old_key, old);
    }
}

/// Whether a value is a non-empty list that contains only tables.
pub(crate) fn is_list_of_tables(value: &Spanned<DeValue<'_>>) -> bool {
    let items = value.get_ref().as_array();
    items.is_some_and(|items| !items.is_empty() && items.iter().all(|item| item.get_ref().is_table()))
}

/// Shortens `text` to [`MAX_QUOTE`] characters.
pub(crate) fn shorten(text: &str) -> String {
    match text.char_indices().nth(MAX_QUOTE) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text.to_owned(),
    }
}
