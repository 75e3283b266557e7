//! Converts descriptions of a car's signals or of a cell from other formats to parts of a packwatch configuration.
//!
//! Parts of the file that cannot be converted are listed with their path in the file and the reason.

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
    /// The part of a configuration as TOML. Comments at its end list the exclusions.
    pub text: String,
    /// Parts that were left out, in the order of the file.
    pub exclusions: Vec<Exclusion>,
    /// Unknown fields that were ignored, each with its path and name.
    pub warnings: Vec<String>,
    /// Number of converted signals, counting each signal of a numbered series.
    pub signals: usize,
}

/// A part of the file that was left out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exclusion {
    /// Kind of reason, used to count the exclusions.
    pub reason: ExclusionReason,
    /// Path of the part in the file.
    pub place: String,
    /// What was found and what is allowed.
    pub detail: String,
}

/// Reason why a part of the file was left out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ExclusionReason {
    /// The command exists only in other model years.
    OtherYear,
    /// The command's service is not 0x01, 0x21 or 0x22.
    OtherService,
    /// The command's addresses are not supported.
    Address,
    /// The values are names, not numbers.
    Enumeration,
    /// The value is a text.
    Text,
    /// The value is computed from other signals.
    Synthetic,
    /// A field is missing or has an invalid value.
    InvalidField,
    /// Another signal already uses the bits.
    Overlap,
    /// An earlier command or signal has the same name, or the same request.
    Duplicate,
}

impl fmt::Display for ExclusionReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::OtherYear => "command of other model years",
            Self::OtherService => "command of a service that is not supported",
            Self::Address => "command with addresses that are not supported",
            Self::Enumeration => "enumeration: names, not numbers",
            Self::Text => "text, not a number",
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
    /// Counts the exclusions by reason.
    pub fn counts(&self) -> BTreeMap<ExclusionReason, usize> {
        let mut counts = BTreeMap::new();
        for exclusion in &self.exclusions {
            *counts.entry(exclusion.reason).or_default() += 1;
        }
        counts
    }
}
