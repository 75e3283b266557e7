//! Report on the wiring: findings with evidence, reason and the line to change.

use serde::Serialize;

/// Severity of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Estimates will be wrong or missing.
    Error,
    /// The user should check the subject of the finding.
    Warning,
    /// Useful information.
    Note,
}

/// Subject of a finding. The variants are ordered from causes to effects: a fault of an earlier variant can cause a
/// fault of a later variant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Topic {
    /// The configuration itself.
    Configuration,
    /// The interface is missing, down or silent, or the pack is on another interface.
    Interface,
    /// Error frames: bit rate or wiring.
    BitRate,
    /// Classic and FD frames are confused.
    Fd,
    /// Standard and extended identifiers are confused.
    IdKind,
    /// Another node sends with the daemon's identifiers.
    Conflict,
    /// The end-to-end checks fail.
    Protection,
    /// Too many or too few cells.
    CellCount,
    /// A configured signal was never received.
    Silent,
    /// A signal is configured as the wrong quantity.
    Swapped,
    /// Byte order, sign or position of the bits is wrong.
    Layout,
    /// Factor or offset is wrong.
    Unit,
    /// Charge and discharge are exchanged.
    CurrentSign,
    /// A value never changes.
    Frozen,
    /// The cells do not add up to the pack's voltage.
    PackVoltage,
    /// Readings are outside the configured limits.
    Range,
    /// One cell or sensor differs from the other cells or sensors.
    Cell,
    /// Readings arrive too slowly or too unevenly.
    Period,
    /// Stretches of the log or of one input are missing.
    Missing,
    /// The cell model belongs to another type of cell.
    CellModel,
    /// The current is not zero at rest.
    CurrentOffset,
    /// Voltages are noisier than configured.
    Noise,
    /// Two signals on the buses report different states of charge.
    ReportedSoc,
}

/// A line of the configuration to change.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct Change {
    /// Name of the table, for example `input.current`.
    pub table: String,
    /// Name of the key.
    pub key: String,
    /// Proposed value as TOML, or a description of the value.
    pub proposed: String,
    /// File and line. The caller sets it, because only the caller has read the file.
    pub place: Option<String>,
    /// Present value in the file; `None` if the key is not set.
    pub now: Option<String>,
    /// Whether this change is an alternative to the changes before it in the list. Only one of the alternatives is
    /// right.
    pub is_alternative: bool,
}

/// One finding.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct WiringFinding {
    /// Severity.
    pub severity: Severity,
    /// Subject.
    pub topic: Topic,
    /// The finding in one sentence.
    pub title: String,
    /// Evidence: the measured values.
    pub seen: String,
    /// Why the evidence points to this cause.
    pub why: String,
    /// Lines to change.
    pub changes: Vec<Change>,
    /// Further advice, or the only advice if no change of the configuration helps.
    pub advice: Option<String>,
    /// Whether the finding disappears if the same input is judged again with the changes; `None` = not tried.
    pub is_solved: Option<bool>,
    /// Titles of findings that are probably consequences of this finding and are not listed separately.
    pub consequences: Vec<String>,
}

/// Result of the commissioning check.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct WiringReport {
    /// Time listened (s). For a recording: from the first frame to the last, without sleep.
    pub seconds: f64,
    /// Frames seen on all interfaces.
    pub frames: u64,
    /// Findings, most severe first. Among equally severe findings, causes come before effects.
    pub findings: Vec<WiringFinding>,
    /// Checks that passed.
    pub fine: Vec<String>,
    /// Checks that were not possible, and what to do.
    pub unjudged: Vec<String>,
}

impl WiringFinding {
    /// Creates a finding without lines to change.
    pub fn new(severity: Severity, topic: Topic, title: impl Into<String>) -> Self {
        let (seen, why) = (String::new(), String::new());
        let (changes, consequences) = (Vec::new(), Vec::new());
        Self { severity, topic, title: title.into(), seen, why, changes, advice: None, is_solved: None, consequences }
    }

    pub(super) fn seen(&mut self, seen: impl Into<String>) -> &mut Self {
        self.seen = seen.into();
        self
    }

    pub(super) fn why(&mut self, why: impl Into<String>) -> &mut Self {
        self.why = why.into();
        self
    }

    pub(super) fn change(&mut self, table: &str, key: &str, proposed: impl Into<String>) -> &mut Self {
        let (table, key) = (table.to_owned(), key.to_owned());
        self.changes.push(Change { table, key, proposed: proposed.into(), ..Change::default() });
        self
    }

    /// Adds a change that is an alternative to the changes before it.
    pub(super) fn alternative(&mut self, table: &str, key: &str, proposed: impl Into<String>) -> &mut Self {
        let is_alternative = !self.changes.is_empty();
        let (table, key) = (table.to_owned(), key.to_owned());
        self.changes.push(Change { table, key, proposed: proposed.into(), is_alternative, ..Change::default() });
        self
    }

    pub(super) fn advice(&mut self, advice: impl Into<String>) -> &mut Self {
        self.advice = Some(advice.into());
        self
    }
}

impl WiringReport {
    /// Inserts a finding into `findings`, keeps the list in order, and returns the inserted finding.
    pub fn add(&mut self, finding: WiringFinding) -> &mut WiringFinding {
        let key = |f: &WiringFinding| (f.severity, f.topic);
        let at = self.findings.partition_point(|other| key(other) <= key(&finding));
        self.findings.insert(at, finding);
        &mut self.findings[at]
    }

    /// Merges findings into the first finding on `cause`: all later findings on `cause`, and all findings that fulfil
    /// `is_consequence`. Keeps the title of every merged finding. Keeps the advice only of merged findings on `cause`.
    pub(super) fn fold(&mut self, cause: Topic, is_consequence: impl Fn(&WiringFinding) -> bool) {
        let Some(first) = self.findings.iter().position(|finding| finding.topic == cause) else { return };
        let is_moved = |finding: &mut WiringFinding| finding.topic == cause || is_consequence(finding);
        let moved: Vec<WiringFinding> = self.findings.extract_if(first + 1.., is_moved).collect();
        let before: Vec<WiringFinding> = self.findings.extract_if(..first, |finding| is_consequence(finding)).collect();
        let Some(finding) = self.findings.iter_mut().find(|finding| finding.topic == cause) else { return };
        for other in before.into_iter().chain(moved) {
            let advice = other.advice.filter(|_| other.topic == cause);
            finding.advice =
                finding.advice.take().into_iter().chain(advice).reduce(|all, more| format!("{all}; {more}"));
            finding.consequences.push(other.title);
        }
    }

    /// Whether there is an error or a warning.
    pub fn has_findings(&self) -> bool {
        self.findings.iter().any(|finding| finding.severity != Severity::Note)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fold_moves_consequences_below_first_finding() {
        let mut report = WiringReport::default();
        let mut add = |topic, title: &str, advice: &str| {
            report.add(WiringFinding::new(Severity::Error, topic, title)).advice(advice);
        };
        add(Topic::Interface, "other", "");
        add(Topic::CellCount, "count", "not this");
        add(Topic::Layout, "cells", "a");
        add(Topic::Layout, "current", "b");
        add(Topic::Cell, "cell 4", "nor this");
        report.fold(Topic::Layout, |finding| [Topic::CellCount, Topic::Cell].contains(&finding.topic));
        let titles: Vec<&str> = report.findings.iter().map(|finding| finding.title.as_str()).collect();
        assert_eq!(titles, ["other", "cells"]);
        assert_eq!(report.findings[1].consequences, ["count", "current", "cell 4"]);
        assert_eq!(report.findings[1].advice.as_deref(), Some("a; b"));
    }

    #[test]
    fn findings_are_sorted_by_severity_then_cause_before_effect() {
        let mut report = WiringReport::default();
        report.add(WiringFinding::new(Severity::Note, Topic::Interface, "n"));
        assert!(!report.has_findings());
        report.add(WiringFinding::new(Severity::Warning, Topic::Silent, "w"));
        report.add(WiringFinding::new(Severity::Error, Topic::CellModel, "late"));
        report.add(WiringFinding::new(Severity::Error, Topic::Unit, "early"));
        report.add(WiringFinding::new(Severity::Error, Topic::Unit, "early, second"));
        let titles: Vec<&str> = report.findings.iter().map(|finding| finding.title.as_str()).collect();
        assert_eq!(titles, ["early", "early, second", "late", "w", "n"]);
        assert!(report.has_findings());
    }
}
