//! Foreign descriptions of a car's signals or of a cell, converted to parts of a packwatch configuration.
//!
//! In: the text of a file. Out: TOML a person can read and edit, and a list of everything that was left out, with place and
//! reason. Pure: nothing is read or written here.

pub mod bpx;
pub mod dbc;
mod diagnostic;
pub mod obdb;
pub(crate) mod series;

use std::collections::BTreeMap;
use std::fmt;

pub(crate) use diagnostic::{DiagnosticSignal, DiagnosticTable, NumberRange};

/// A converted file.
#[derive(Debug, Clone, PartialEq)]
pub struct ImportResult {
    /// The part of a configuration, TOML; the list of exclusions stands at its end as comments.
    pub text: String,
    /// What was left out, in the order of the file.
    pub exclusions: Vec<Exclusion>,
    /// Fields that are not known and were ignored: place and name.
    pub warnings: Vec<String>,
    /// Signals converted; a numbered series counts as many.
    pub signals: usize,
}

/// One thing that was left out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exclusion {
    /// Class, for counts.
    pub reason: ExclusionReason,
    /// Where it is in the file.
    pub place: String,
    /// Found and allowed.
    pub detail: String,
}

/// Why something was left out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ExclusionReason {
    /// The command is of other model years.
    OtherYear,
    /// The command's service is not 0x01, 0x21 or 0x22.
    OtherService,
    /// The addresses of the command are of no supported form.
    Address,
    /// The values are names, no numbers.
    Enumeration,
    /// The value is a text.
    Text,
    /// Computed from other signals.
    Synthetic,
    /// A field is missing or has an invalid value.
    InvalidField,
    /// Its bits belong to another signal already.
    Overlap,
    /// Another command or signal of this name, or with this request, came before.
    Duplicate,
}

impl fmt::Display for ExclusionReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::OtherYear => "command of other model years",
            Self::OtherService => "command of a service that is not supported",
            Self::Address => "command with addresses that are not supported",
            Self::Enumeration => "enumeration: names, no numbers",
            Self::Text => "text, no number",
            Self::Synthetic => "computed from other signals",
            Self::InvalidField => "missing or invalid field",
            Self::Overlap => "bits of another signal",
            Self::Duplicate => "defined twice",
        })
    }
}

impl fmt::Display for Exclusion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}: {}", self.place, self.reason, self.detail)
    }
}

impl ImportResult {
    /// How many were left out, by reason.
    pub fn counts(&self) -> BTreeMap<ExclusionReason, usize> {
        let mut counts = BTreeMap::new();
        for exclusion in &self.exclusions {
            *counts.entry(exclusion.reason).or_default() += 1;
        }
        counts
    }
}
