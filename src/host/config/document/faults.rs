//! Everything found wrong in the files of a configuration, with file and line.
//!
//! A fault reads `FILE:LINE: KEY = FOUND, must be ALLOWED`; nothing here stops at the first one.

use std::collections::BTreeMap;
use std::fmt;

/// All faults of a configuration, one line each: `pack.toml:14: pack.cells = 0, must be 1 to 1024`.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}", .0.join("\n"))]
pub struct ConfigFaults(pub Vec<String>);

/// A line of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct SourceLine {
    /// File as people named it.
    pub file: String,
    /// Line, from 1.
    pub line: usize,
}

impl SourceLine {
    /// The line for a text about `other`: without the file where it is the same.
    pub(crate) fn beside(&self, other: &Self) -> String {
        if self.file == other.file { format!("line {}", self.line) } else { self.to_string() }
    }
}

impl fmt::Display for SourceLine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.file, self.line)
    }
}

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

/// Place of a key and the text of its value.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct KeyPlace {
    pub at: SourceLine,
    pub found: String,
}

/// Place of a table in its file, with which a later check can name file, line, key and found.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TablePlace {
    /// File and line of the table's header.
    pub at: SourceLine,
    /// `input.current`, `alarm[2]`; empty for the top of the file.
    pub path: String,
    pub spots: BTreeMap<String, KeyPlace>,
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
