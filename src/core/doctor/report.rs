//! What the doctor says.

use serde::Serialize;

/// How bad.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Estimates will be wrong or missing.
    Error,
    /// Look at it.
    Warning,
    /// Worth knowing.
    Note,
}

/// What a finding is about. The order is that of causes: an earlier one can bring about a later one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Topic {
    /// The configuration itself.
    Configuration,
    /// Interface missing, down, silent, or another one.
    Interface,
    /// Error frames: bit rate, wiring.
    BitRate,
    /// Classic against FD.
    Fd,
    /// Standard against extended identifiers.
    IdKind,
    /// Somebody else sends under our identifiers.
    Conflict,
    /// End-to-end checks fail.
    Protection,
    /// Too many or too few cells.
    CellCount,
    /// Configured, never seen.
    Silent,
    /// One signal in another's place.
    Swapped,
    /// Byte order, sign of the number, or place of the bits.
    Layout,
    /// Factor or offset.
    Unit,
    /// Charge and discharge exchanged.
    CurrentSign,
    /// Never moves.
    Frozen,
    /// Outside the configured limits.
    Range,
    /// One cell unlike the others.
    Cell,
    /// Comes too seldom or too unevenly.
    Period,
    /// Model of another cell.
    CellModel,
    /// Not zero at rest.
    CurrentOffset,
    /// Rougher than the estimator is told.
    Noise,
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
    /// File and line, and what stands there now: filled in by who has read the file.
    pub place: Option<String>,
    /// See `place`; `None` = not written.
    pub now: Option<String>,
}

/// One thing found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// How bad.
    pub severity: Severity,
    /// About what.
    pub topic: Topic,
    /// In a sentence.
    pub title: String,
    /// The figures.
    pub seen: String,
    /// Why they point there.
    pub why: String,
    /// Lines to change.
    pub changes: Vec<Change>,
    /// What to do where no line of the configuration helps, or besides.
    pub advice: Option<String>,
}

/// Everything.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Report {
    /// Seconds listened; of a record, those from the first frame to the last without sleep.
    pub seconds: f64,
    /// Frames seen on all interfaces.
    pub frames: u64,
    /// Worst first, then cause before effect.
    pub findings: Vec<Finding>,
    /// What was in order.
    pub fine: Vec<String>,
    /// What could not be judged, and what to do for it.
    pub unjudged: Vec<String>,
}

impl Change {
    pub(super) fn new(table: &str, key: &str, proposed: impl Into<String>) -> Self {
        Self { table: table.to_owned(), key: key.to_owned(), proposed: proposed.into(), place: None, now: None }
    }
}

impl Finding {
    /// A finding without lines to change.
    pub fn new(severity: Severity, topic: Topic, title: impl Into<String>) -> Self {
        let (seen, why) = (String::new(), String::new());
        Self { severity, topic, title: title.into(), seen, why, changes: Vec::new(), advice: None }
    }

    pub(super) fn error(topic: Topic, title: impl Into<String>) -> Self {
        Self::new(Severity::Error, topic, title)
    }

    pub(super) fn warning(topic: Topic, title: impl Into<String>) -> Self {
        Self::new(Severity::Warning, topic, title)
    }

    pub(super) fn note(topic: Topic, title: impl Into<String>) -> Self {
        Self::new(Severity::Note, topic, title)
    }

    pub(super) fn seen(mut self, seen: impl Into<String>) -> Self {
        self.seen = seen.into();
        self
    }

    pub(super) fn why(mut self, why: impl Into<String>) -> Self {
        self.why = why.into();
        self
    }

    pub(super) fn change(mut self, table: &str, key: &str, proposed: impl Into<String>) -> Self {
        self.changes.push(Change::new(table, key, proposed));
        self
    }

    pub(super) fn advice(mut self, advice: impl Into<String>) -> Self {
        self.advice = Some(advice.into());
        self
    }
}

impl Report {
    /// Adds a finding where it belongs.
    pub fn add(&mut self, finding: Finding) {
        let key = |f: &Finding| (f.severity, f.topic);
        let at = self.findings.partition_point(|other| key(other) <= key(&finding));
        self.findings.insert(at, finding);
    }

    /// Whether something must be looked at: a finding that is more than a note.
    pub fn has_findings(&self) -> bool {
        self.findings.iter().any(|finding| finding.severity != Severity::Note)
    }

    pub(super) fn has(&self, topics: &[Topic]) -> bool {
        self.findings.iter().any(|f| f.severity != Severity::Note && topics.contains(&f.topic))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn findings_stand_worst_first_and_causes_before_effects() {
        let mut report = Report::default();
        report.add(Finding::note(Topic::Interface, "n"));
        assert!(!report.has_findings());
        report.add(Finding::warning(Topic::Silent, "w"));
        report.add(Finding::error(Topic::CellModel, "late"));
        report.add(Finding::error(Topic::Unit, "early"));
        report.add(Finding::error(Topic::Unit, "early, second"));
        let titles: Vec<&str> = report.findings.iter().map(|finding| finding.title.as_str()).collect();
        assert_eq!(titles, ["early", "early, second", "late", "w", "n"]);
        assert!(report.has_findings());
    }
}
