//! The TOML texts of a configuration merged, with the lines their values stand on, and the list of everything found wrong.
//!
//! A fault reads `FILE:LINE: KEY = FOUND, must be ALLOWED`; nothing here stops at the first one.

use std::collections::BTreeMap;
use std::ops::Range;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::source::{SourceFile, SourceLine, Sources};

/// Longest piece of the file quoted in a fault, characters: enough to recognise it, short enough for one line.
const MAX_QUOTE: usize = 48;
/// Faults of syntax listed one by one; a file with more is of another kind.
const MAX_SYNTAX_FAULTS: usize = 10;

/// Faults and warnings found so far, in files of any kind.
#[derive(Debug, Default)]
pub(crate) struct Faults {
    list: Vec<(String, usize, String)>,
    warnings: Vec<(String, usize, String)>,
}

impl Faults {
    /// Notes `text` about line `line` of `file`; line 0 = the file as a whole.
    pub(crate) fn add(&mut self, file: &str, line: usize, text: impl Into<String>) {
        let fault = (file.to_owned(), line, text.into());
        if !self.list.contains(&fault) {
            self.list.push(fault);
        }
    }

    /// Notes what is unlikely and may be meant; it does not make the configuration bad.
    fn warn(&mut self, at: &SourceLine, text: String) {
        let warning = (at.file.clone(), at.line, text);
        if !self.warnings.contains(&warning) {
            self.warnings.push(warning);
        }
    }

    /// Notes `text` about a line.
    pub(crate) fn add_at(&mut self, at: &SourceLine, text: impl Into<String>) {
        self.add(&at.file, at.line, text);
    }

    /// Number of faults.
    pub(crate) fn len(&self) -> usize {
        self.list.len()
    }

    /// Whether nothing was found.
    pub(crate) fn is_empty(&self) -> bool {
        self.list.is_empty()
    }

    /// The faults, one line each: the files in the order in which they first failed, each by line.
    pub(crate) fn into_lines(self) -> Vec<String> {
        Self::lines(&self.list)
    }

    /// The warnings, in the same form.
    pub(crate) fn warning_lines(&self) -> Vec<String> {
        Self::lines(&self.warnings)
    }

    fn lines(list: &[(String, usize, String)]) -> Vec<String> {
        let mut files: Vec<&str> = Vec::new();
        for (file, _, _) in list {
            if !files.contains(&file.as_str()) {
                files.push(file);
            }
        }
        let mut sorted: Vec<_> = list.iter().collect();
        sorted.sort_by_key(|(file, line, _)| (files.iter().position(|f| f == file), *line));
        let show = |(file, line, text): &&(String, usize, String)| match line {
            0 => format!("{file}: {text}"),
            _ => format!("{file}:{line}: {text}"),
        };
        // A name in the file may hold a line break; a fault is one line all the same.
        sorted.iter().map(|fault| show(fault).replace('\n', "\\n")).collect()
    }
}

/// The tables of a configuration: of one file, or of a file and its drop-ins merged.
#[derive(Debug)]
pub(super) struct Document<'t> {
    /// The file, as people named it; of several the one that the drop-ins belong to.
    pub file: String,
    /// Whether the syntax is broken somewhere: a missing key may then stand in the broken part.
    pub broken: bool,
    sources: &'t Sources,
    root: DeTable<'t>,
}

impl<'t> Document<'t> {
    /// Parses every file of `sources` and merges them in order. Syntax faults go to `faults`; the readable rest is kept
    /// and checked.
    pub(super) fn parse(sources: &'t Sources, faults: &mut Faults) -> Self {
        let (mut root, mut broken) = (DeTable::new(), false);
        for source in sources.files() {
            let (table, errors) = DeTable::parse_recoverable(source.placed_text());
            note_syntax(source, &errors, faults);
            broken |= !errors.is_empty();
            merge(&mut root, table.into_inner());
        }
        Self { file: sources.main_file().to_owned(), broken, sources, root }
    }

    /// The whole as a table.
    pub(super) fn root(&self) -> &DeTable<'t> {
        &self.root
    }

    /// The value at a dotted path.
    pub(super) fn find(&self, path: &str) -> Option<&Spanned<DeValue<'t>>> {
        let mut parts = path.split('.');
        let mut value = self.root.get(parts.next()?)?;
        for part in parts {
            let DeValue::Table(table) = value.get_ref() else { return None };
            value = table.get(part)?;
        }
        Some(value)
    }

    /// The text at a dotted path, also where another key of its table is faulty.
    pub(super) fn text(&self, path: &str) -> Option<&str> {
        self.find(path)?.get_ref().as_str()
    }

    /// The first line of the file.
    pub(super) fn first_line(&self) -> SourceLine {
        SourceLine { file: self.file.clone(), line: 1 }
    }

    /// File and line on which `span` begins.
    pub(super) fn line(&self, span: &Range<usize>) -> SourceLine {
        self.sources.line(span)
    }

    /// The text at `span`, as it is written.
    pub(super) fn written(&self, span: &Range<usize>) -> &'t str {
        self.sources.written(span)
    }

    /// The text at `span`, cut to one short line.
    pub(super) fn quote(&self, span: &Range<usize>) -> String {
        let words: Vec<&str> = self.written(span).split_whitespace().collect();
        shorten(&words.join(" "))
    }

    /// The found text of a fault at `span`, which is within `value`.
    pub(super) fn found(&self, value: &Spanned<DeValue<'_>>, span: &Range<usize>) -> String {
        let is_inline = self.written(&value.span()).starts_with('{');
        if value.get_ref().is_table() && !is_inline { "a table".to_owned() } else { self.quote(span) }
    }

    /// The place of a table: its path for people, its line, and where its keys stand.
    pub(super) fn place(&self, path: &str, at: SourceLine, table: &DeTable<'_>) -> TablePlace {
        let spot = |(key, value): (&Spanned<_>, &Spanned<DeValue<'_>>)| {
            let key: &Spanned<std::borrow::Cow<'_, str>> = key;
            (
                key.get_ref().to_string(),
                KeyPlace { at: self.line(&key.span()), found: self.found(value, &value.span()) },
            )
        };
        TablePlace { at, path: path.to_owned(), spots: table.iter().map(spot).collect() }
    }
}

fn note_syntax(source: &SourceFile, errors: &[toml::de::Error], faults: &mut Faults) {
    let line = |error: &toml::de::Error| error.span().map_or(0, |span| source.line(&span));
    for error in errors.iter().take(MAX_SYNTAX_FAULTS) {
        faults.add(source.name(), line(error), error.message().trim().replace('\n', ", "));
    }
    if let Some(error) = errors.get(MAX_SYNTAX_FAULTS) {
        let more = errors.len() - MAX_SYNTAX_FAULTS;
        faults.add(source.name(), line(error), format!("and {more} more faults of syntax from here"));
    }
}

/// Merges `over` into `under`: tables by key, lists of tables one after the other; anything else replaces. An empty list
/// replaces too, so that a drop-in can remove the tables before it.
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

/// Whether a value is a list of at least one table, and of nothing else.
pub(super) fn is_list_of_tables(value: &Spanned<DeValue<'_>>) -> bool {
    let items = value.get_ref().as_array();
    items.is_some_and(|items| !items.is_empty() && items.iter().all(|item| item.get_ref().is_table()))
}

/// `text` cut to the length of a quotation.
pub(super) fn shorten(text: &str) -> String {
    match text.char_indices().nth(MAX_QUOTE) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text.to_owned(),
    }
}

/// Place of a key and the text of its value.
#[derive(Debug, Clone, PartialEq)]
struct KeyPlace {
    at: SourceLine,
    found: String,
}

/// Place of a table in its file, with which a later check can name file, line, key and found.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TablePlace {
    /// File and line of the table's header.
    pub at: SourceLine,
    /// `input.current`, `alarm[2]`; empty for the top of the file.
    pub path: String,
    spots: BTreeMap<String, KeyPlace>,
}

impl TablePlace {
    /// Full name of a key of this table.
    pub(crate) fn key(&self, key: &str) -> String {
        if self.path.is_empty() { key.to_owned() } else { format!("{}.{key}", self.path) }
    }

    /// Whether the key is written in the file.
    pub(crate) fn has(&self, key: &str) -> bool {
        self.spots.contains_key(key)
    }

    /// The text of a key's value, cut to one short line.
    pub(crate) fn found(&self, key: &str) -> Option<&str> {
        self.spots.get(key).map(|spot| spot.found.as_str())
    }

    /// File and line of a key; of the table when the key is not written.
    pub(crate) fn line_of(&self, key: &str) -> &SourceLine {
        self.spots.get(key).map_or(&self.at, |spot| &spot.at)
    }

    /// Notes `KEY = FOUND, WHAT`.
    pub(crate) fn fault(&self, faults: &mut Faults, key: &str, what: &str) {
        faults.add_at(self.line_of(key), self.sentence(key, what));
    }

    /// Notes `KEY = FOUND, WHAT` as a warning.
    pub(crate) fn warn(&self, faults: &mut Faults, key: &str, what: &str) {
        faults.warn(self.line_of(key), self.sentence(key, what));
    }

    fn sentence(&self, key: &str, what: &str) -> String {
        let name = self.key(key);
        match self.spots.get(key) {
            Some(spot) => format!("{name} = {}, {what}", spot.found),
            None => format!("{name} is not set, {what}"),
        }
    }

    /// Notes `KEY: WHAT`, where the value as a whole is too long to quote.
    pub(crate) fn note(&self, faults: &mut Faults, key: &str, what: &str) {
        faults.add_at(self.line_of(key), format!("{}: {what}", self.key(key)));
    }
}
