//! Collects the faults in the files of a configuration, each with file and line.
//!
//! A fault reads `FILE:LINE: KEY = FOUND, must be ALLOWED`. Checking continues after a fault, so all faults are found.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::rc::Rc;

/// All faults of a configuration, one line each: `pack.toml:14: pack.cells = 0, must be 1 to 1024`.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}", .0.join("\n"))]
pub struct ConfigFaults(pub Vec<String>);

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct SourceLine {
    /// File, as the user named it.
    pub file: String,
    /// Line, from 1; 0 = the file as a whole.
    pub line: usize,
}

impl SourceLine {
    /// Describes this line for the text of a fault at the line `other`. The file name is left out if both lines are in
    /// the same file.
    pub(crate) fn beside(&self, other: &Self) -> String {
        if self.file == other.file { format!("line {}", self.line) } else { self.to_string() }
    }
}

impl fmt::Display for SourceLine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.line {
            0 => f.write_str(&self.file),
            line => write!(f, "{}:{line}", self.file),
        }
    }
}

/// The list of faults and warnings in files of any kind. Clones share one list.
#[derive(Debug, Clone, Default)]
pub(crate) struct Faults(Rc<RefCell<Notes>>);

#[derive(Debug, Default)]
struct Notes {
    faults: Vec<(SourceLine, String)>,
    warnings: Vec<(SourceLine, String)>,
    /// All faults and warnings so far, to skip repetitions.
    noted: BTreeSet<(bool, SourceLine, String)>,
}

impl Notes {
    fn note(&mut self, is_fault: bool, at: &SourceLine, text: impl fmt::Display) {
        let (at, text) = (at.clone(), text.to_string());
        if self.noted.insert((is_fault, at.clone(), text.clone())) {
            if is_fault { &mut self.faults } else { &mut self.warnings }.push((at, text));
        }
    }
}

impl Faults {
    /// Adds the fault `text` at line `line` of `file`; line 0 = the file as a whole.
    pub(crate) fn add(&self, file: &str, line: usize, text: impl fmt::Display) {
        self.add_at(&SourceLine { file: file.to_owned(), line }, text);
    }

    pub(crate) fn add_at(&self, at: &SourceLine, text: impl fmt::Display) {
        self.0.borrow_mut().note(true, at, text);
    }

    /// Adds a warning about a value that is allowed but unlikely. The configuration remains valid.
    pub(crate) fn warn(&self, at: &SourceLine, text: impl fmt::Display) {
        self.0.borrow_mut().note(false, at, text);
    }

    pub(crate) fn len(&self) -> usize {
        self.0.borrow().faults.len()
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Whether a fault concerns the file as a whole, so that none of its contents were used.
    pub(crate) fn is_unusable(&self, file: &str) -> bool {
        self.0.borrow().faults.iter().any(|(at, _)| at.file == file && at.line == 0)
    }

    /// The faults, one line each. Files are in the order in which they first failed; faults of a file are sorted by
    /// line.
    pub(crate) fn lines(&self) -> ConfigFaults {
        ConfigFaults(lines(&self.0.borrow().faults))
    }

    /// The warnings, formatted and sorted like the faults.
    pub(crate) fn warning_lines(&self) -> Vec<String> {
        lines(&self.0.borrow().warnings)
    }
}

fn lines(list: &[(SourceLine, String)]) -> Vec<String> {
    let mut sorted: Vec<_> = list.iter().collect();
    let mut firsts = BTreeMap::new();
    for (place, (at, _)) in list.iter().enumerate() {
        firsts.entry(&at.file).or_insert(place);
    }
    sorted.sort_by_key(|(at, _)| (firsts.get(&at.file), at.line));
    // A name in the file may contain a line break, but a fault must stay on one line.
    sorted.iter().map(|(at, text)| format!("{at}: {text}").replace('\n', "\\n")).collect()
}

/// Position of a key and the text of its value.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct KeyPlace {
    pub at: SourceLine,
    pub found: String,
}

/// Position of a table in its file, so that later checks can name file, line, key and found value.
#[derive(Debug, Clone)]
pub(crate) struct TablePlace {
    /// File and line of the table's header.
    pub at: SourceLine,
    /// Path of the table, such as `input.current` or `alarm[2]`; empty for the top of the file.
    pub path: String,
    pub spots: BTreeMap<String, KeyPlace>,
    pub faults: Faults,
}

impl TablePlace {
    pub(crate) fn key(&self, key: &str) -> String {
        if self.path.is_empty() { key.to_owned() } else { format!("{}.{key}", self.path) }
    }

    pub(crate) fn has(&self, key: &str) -> bool {
        self.spots.contains_key(key)
    }

    /// The text of a key's value, shortened to one line.
    pub(crate) fn found(&self, key: &str) -> Option<&str> {
        self.spots.get(key).map(|spot| spot.found.as_str())
    }

    /// File and line of a key, or of its table if the key is not set.
    pub(crate) fn line_of(&self, key: &str) -> &SourceLine {
        self.spots.get(key).map_or(&self.at, |spot| &spot.at)
    }

    /// Adds the fault `KEY = FOUND, WHAT`.
    pub(crate) fn fault(&self, key: &str, what: impl fmt::Display) {
        self.faults.add_at(self.line_of(key), self.sentence(key, what));
    }

    /// Adds the warning `KEY = FOUND, WHAT`.
    pub(crate) fn warn(&self, key: &str, what: impl fmt::Display) {
        self.faults.warn(self.line_of(key), self.sentence(key, what));
    }

    fn sentence(&self, key: &str, what: impl fmt::Display) -> String {
        let name = self.key(key);
        match self.found(key) {
            Some(found) => format!("{name} = {found}, {what}"),
            None => format!("{name} is not set, {what}"),
        }
    }

    /// Adds the fault `KEY: WHAT`, for values that are too long to quote.
    pub(crate) fn note(&self, key: &str, what: impl fmt::Display) {
        self.faults.add_at(self.line_of(key), format!("{}: {what}", self.key(key)));
    }

    /// Adds the fault `TABLE WHAT` about the whole table.
    pub(crate) fn table_fault(&self, what: impl fmt::Display) {
        self.faults.add_at(&self.at, format!("{} {what}", self.path));
    }
}
