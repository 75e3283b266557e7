//! Defines the JSON of an OBDb signal set (github.com/OBDb/.schemas, `signals.json`): the fields that the conversion
//! uses, and known fields that it ignores. Each command and each signal is read separately, so that a faulty entry does
//! not hide other entries.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::Value;

#[derive(Debug, Deserialize)]
pub(super) struct SignalSetDocument {
    pub(super) commands: Vec<Value>,
    #[serde(default)]
    pub(super) synthetics: Vec<Value>,
    #[serde(rename = "diagnosticLevel")]
    pub(super) diagnostic_level: Option<String>,
    #[serde(flatten)]
    pub(super) rest: BTreeMap<String, Value>,
}

#[derive(Debug, Deserialize)]
pub(super) struct CommandDocument {
    #[serde(flatten)]
    pub(super) address: AddressDocument,
    pub(super) cmd: BTreeMap<String, String>,
    pub(super) freq: Option<f64>,
    /// Diagnostic session that the controller must be in.
    pub(super) din: Option<String>,
    pub(super) filter: Option<YearFilter>,
    pub(super) signals: Vec<Value>,
    #[serde(flatten)]
    pub(super) rest: BTreeMap<String, Value>,
}

/// Addresses as hexadecimal texts.
#[derive(Debug, Default, Deserialize)]
pub(super) struct AddressDocument {
    /// 3 digits: 11-bit identifier. 4 digits: middle of a 29-bit identifier.
    pub(super) hdr: String,
    pub(super) rax: Option<String>,
    /// Extended address: first data byte of requests.
    pub(super) eax: Option<String>,
    /// First byte of a 29-bit identifier.
    pub(super) pri: Option<String>,
    pub(super) tst: Option<String>,
    pub(super) proto: Option<String>,
}

/// Model years of a command: a range, or a list of single years. If `from` is after `to`, the years between them are
/// excluded.
#[derive(Debug, Deserialize)]
pub(super) struct YearFilter {
    from: Option<i64>,
    to: Option<i64>,
    #[serde(default)]
    years: Vec<i64>,
}

#[derive(Debug, Deserialize)]
pub(super) struct SignalDocument {
    pub(super) id: String,
    pub(super) fmt: FormatDocument,
    #[serde(flatten)]
    pub(super) rest: BTreeMap<String, Value>,
}

/// Position and scaling: value = code * mul / div + add.
#[derive(Debug, Deserialize)]
pub(super) struct FormatDocument {
    #[serde(default)]
    pub(super) bix: i64,
    pub(super) len: i64,
    #[serde(default)]
    pub(super) blsb: bool,
    #[serde(default)]
    pub(super) sign: bool,
    #[serde(default)]
    pub(super) min: f64,
    pub(super) max: Option<f64>,
    #[serde(default)]
    pub(super) add: f64,
    #[serde(default = "one")]
    pub(super) mul: f64,
    #[serde(default = "one")]
    pub(super) div: f64,
    pub(super) unit: Option<String>,
    /// Values up to this limit mean "not available".
    pub(super) nullmin: Option<f64>,
    /// Values from this limit on mean "not available".
    pub(super) nullmax: Option<f64>,
    pub(super) map: Option<Value>,
    #[serde(flatten)]
    pub(super) rest: BTreeMap<String, Value>,
}

fn one() -> f64 {
    1.0
}

impl YearFilter {
    pub(super) fn contains(&self, year: i64) -> bool {
        let in_range = match (self.from, self.to) {
            (Some(from), Some(to)) if from <= to => (from..=to).contains(&year),
            (Some(from), Some(to)) => year >= from || year <= to,
            (Some(from), None) => year >= from,
            (None, Some(to)) => year <= to,
            (None, None) => false,
        };
        in_range || self.years.contains(&year)
    }
}

impl std::fmt::Display for YearFilter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut parts = Vec::new();
        match (self.from, self.to) {
            (Some(from), Some(to)) if from <= to => parts.push(format!("{from} to {to}")),
            (from, to) => {
                parts.extend(to.map(|to| format!("up to {to}")));
                parts.extend(from.map(|from| format!("{from} and later")));
            }
        }
        parts.extend(self.years.iter().map(i64::to_string));
        f.write_str(&parts.join(", "))
    }
}

impl SignalSetDocument {
    pub(super) fn unknown(&self) -> Vec<&str> {
        unknown(&self.rest, &["$schema", "signalGroups"])
    }
}

impl CommandDocument {
    pub(super) fn unknown(&self) -> Vec<&str> {
        unknown(&self.rest, &["tmo", "fcm1", "dbg", "dbgfilter", "dout"])
    }
}

impl SignalDocument {
    pub(super) fn unknown(&self) -> Vec<&str> {
        let mut fields = unknown(&self.rest, &["name", "path", "description", "hidden", "suggestedMetric"]);
        fields.extend(unknown(&self.fmt.rest, &["omin", "omax", "oval"]));
        fields
    }
}

fn unknown<'a>(rest: &'a BTreeMap<String, Value>, known: &[&str]) -> Vec<&'a str> {
    rest.keys().map(String::as_str).filter(|field| !known.contains(field)).collect()
}
