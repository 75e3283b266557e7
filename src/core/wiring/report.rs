//! The report on a wiring: findings with their evidence, reason and the line to change.

use serde::Serialize;

/// Severity of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Estimates will be wrong or missing.
    Error,
    /// Check it.
    Warning,
    /// Worth knowing.
    Note,
}

/// Subject of a finding. The order is that of causes: an earlier one can cause a later one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Topic {
    /// The configuration itself.
    Configuration,
    /// Interface missing, down or silent, or the pack is on another one.
    Interface,
    /// Error frames: bit rate, wiring.
    BitRate,
    /// Classic against FD.
    Fd,
    /// Standard against extended identifiers.
    IdKind,
    /// Another node sends with the daemon's identifiers.
    Conflict,
    /// End-to-end checks fail.
    Protection,
    /// Too many or too few cells.
    CellCount,
    /// Configured, never received.
    Silent,
    /// One signal in another's place.
    Swapped,
    /// Byte order, sign of the number, or position of the bits.
    Layout,
    /// Factor or offset.
    Unit,
    /// Charge and discharge exchanged.
    CurrentSign,
    /// Never moves.
    Frozen,
    /// The cells do not add up to the pack's voltage.
    PackVoltage,
    /// Outside the configured limits.
    Range,
    /// One cell is unlike the others.
    Cell,
    /// Too slow or too uneven.
    Period,
    /// The model is of another cell.
    CellModel,
    /// Not zero at rest.
    CurrentOffset,
    /// Noisier than configured.
    Noise,
    /// Two states of charge on the buses disagree.
    ReportedSoc,
}

/// A line of the configuration to change.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Change {
    /// Table, `input.current`.
    pub table: String,
    /// Key.
    pub key: String,
    /// Value proposed, as TOML.
    pub proposed: String,
    /// File and line; filled in by the caller, which has read the file.
    pub place: Option<String>,
    /// Present value in the file; `None` = not set.
    pub now: Option<String>,
}

/// One finding.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct WiringFinding {
    /// Severity.
    pub severity: Severity,
    /// Subject.
    pub topic: Topic,
    /// One sentence.
    pub title: String,
    /// Evidence: the measured values.
    pub seen: String,
    /// Why the evidence points to this cause.
    pub why: String,
    /// Lines to change.
    pub changes: Vec<Change>,
    /// What to do in addition, or where no line of the configuration helps.
    pub advice: Option<String>,
    /// Titles of findings that are probably its consequences, and are not reported by themselves.
    pub consequences: Vec<String>,
}

/// Result of a diagnosis.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct WiringReport {
    /// Seconds listened; of a record, the time from the first frame to the last without sleep.
    pub seconds: f64,
    /// Frames seen on all interfaces.
    pub frames: u64,
    /// Most severe first, then causes before effects.
    pub findings: Vec<WiringFinding>,
    /// What is in order.
    pub fine: Vec<String>,
    /// What could not be judged, and what to do.
    pub unjudged: Vec<String>,
}

impl WiringFinding {
    /// A finding without lines to change.
    pub fn new(severity: Severity, topic: Topic, title: impl Into<String>) -> Self {
        let (seen, why) = (String::new(), String::new());
        let (changes, consequences) = (Vec::new(), Vec::new());
        Self { severity, topic, title: title.into(), seen, why, changes, advice: None, consequences }
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
        self.changes.push(Change { table, key, proposed: proposed.into(), place: None, now: None });
        self
    }

    pub(super) fn change_cell_model(&mut self) -> &mut Self {
        self.change("pack", "cell_model", "the model of the cell that is in the pack")
    }

    pub(super) fn advice(&mut self, advice: impl Into<String>) -> &mut Self {
        self.advice = Some(advice.into());
        self
    }
}

impl WiringReport {
    /// Adds a finding in the order of `findings`, and returns it there.
    pub fn add(&mut self, finding: WiringFinding) -> &mut WiringFinding {
        let key = |f: &WiringFinding| (f.severity, f.topic);
        let at = self.findings.partition_point(|other| key(other) <= key(&finding));
        self.findings.insert(at, finding);
        &mut self.findings[at]
    }

    /// Moves further findings of a topic, and its consequences, below its first finding, by their titles. What the further
    /// ones advise is added to its advice.
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
    fn consequences_and_further_findings_of_a_cause_are_below_its_first() {
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
