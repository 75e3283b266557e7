//! One TOML text with the lines its values stand on, and the list of everything found wrong.
//!
//! A fault reads `FILE:LINE: KEY = FOUND, must be ALLOWED`; nothing here stops at the first one.

use std::collections::BTreeMap;
use std::ops::Range;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

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
    fn warn(&mut self, file: &str, line: usize, text: String) {
        let warning = (file.to_owned(), line, text);
        if !self.warnings.contains(&warning) {
            self.warnings.push(warning);
        }
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

/// A TOML text and its name.
#[derive(Debug)]
pub(super) struct Document<'t> {
    /// As people named it.
    pub file: String,
    /// Whether the syntax is broken somewhere: a missing key may then stand in the broken part.
    pub broken: bool,
    source: &'t str,
    root: DeTable<'t>,
}

impl<'t> Document<'t> {
    /// Parses `text`. Syntax faults go to `faults`; the readable rest is kept and checked.
    pub(super) fn parse(file: &str, text: &'t str, faults: &mut Faults) -> Self {
        let (root, errors) = DeTable::parse_recoverable(text);
        let document =
            Self { file: file.to_owned(), broken: !errors.is_empty(), source: text, root: root.into_inner() };
        for error in errors.iter().take(MAX_SYNTAX_FAULTS) {
            let line = error.span().map_or(0, |span| document.line(&span));
            faults.add(file, line, error.message().trim().replace('\n', ", "));
        }
        if let Some(error) = errors.get(MAX_SYNTAX_FAULTS) {
            let line = error.span().map_or(0, |span| document.line(&span));
            faults.add(file, line, format!("and {} more faults of syntax from here", errors.len() - MAX_SYNTAX_FAULTS));
        }
        document
    }

    /// The whole file as a table.
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

    /// Line, from 1, on which `span` begins.
    pub(super) fn line(&self, span: &Range<usize>) -> usize {
        let before = self.source.as_bytes().get(..span.start).unwrap_or(self.source.as_bytes());
        1 + before.iter().filter(|&&b| b == b'\n').count()
    }

    /// The text at `span`, cut to one short line.
    pub(super) fn quote(&self, span: &Range<usize>) -> String {
        let words: Vec<&str> = self.source.get(span.clone()).unwrap_or("").split_whitespace().collect();
        shorten(&words.join(" "))
    }

    /// The found text of a fault at `span`, which is within `value`.
    pub(super) fn found(&self, value: &Spanned<DeValue<'_>>, span: &Range<usize>) -> String {
        let is_inline = self.source.get(value.span()).is_some_and(|text| text.starts_with('{'));
        if value.get_ref().is_table() && !is_inline { "a table".to_owned() } else { self.quote(span) }
    }

    /// The place of a table: its path for people, its line, and where its keys stand.
    pub(super) fn place(&self, path: &str, line: usize, table: &DeTable<'_>) -> TablePlace {
        let spot = |(key, value): (&Spanned<_>, &Spanned<DeValue<'_>>)| {
            let key: &Spanned<std::borrow::Cow<'_, str>> = key;
            (
                key.get_ref().to_string(),
                KeyPlace { line: self.line(&key.span()), found: self.found(value, &value.span()) },
            )
        };
        TablePlace { file: self.file.clone(), path: path.to_owned(), line, spots: table.iter().map(spot).collect() }
    }
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
    line: usize,
    found: String,
}

/// Place of a table in its file, with which a later check can name file, line, key and found.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TablePlace {
    /// File as people named it.
    pub file: String,
    /// `input.current`, `alarm[2]`; empty for the top of the file.
    pub path: String,
    /// Line of the table's header.
    pub line: usize,
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

    /// Line of a key; of the table when the key is not written.
    pub(crate) fn line_of(&self, key: &str) -> usize {
        self.spots.get(key).map_or(self.line, |spot| spot.line)
    }

    /// Notes `KEY = FOUND, WHAT`.
    pub(crate) fn fault(&self, faults: &mut Faults, key: &str, what: &str) {
        faults.add(&self.file, self.line_of(key), self.sentence(key, what));
    }

    /// Notes `KEY = FOUND, WHAT` as a warning.
    pub(crate) fn warn(&self, faults: &mut Faults, key: &str, what: &str) {
        faults.warn(&self.file, self.line_of(key), self.sentence(key, what));
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
        faults.add(&self.file, self.line_of(key), format!("{}: {what}", self.key(key)));
    }
}
