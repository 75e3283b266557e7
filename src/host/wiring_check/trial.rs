//! Tries the changes that a report proposes: applies them to the text of the configuration in memory and judges the
//! same input again. No file is written.
//!
//! In: the report and a function that judges the input with another configuration. Out: each finding states whether its
//! change alone removes the finding without causing another error or warning. Alternatives are tried one by one. A
//! change that does not help is removed from the report, so that the reader does not apply it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::Survey;
use super::survey::survey_with;
use crate::bounded_file;
use crate::wiring::{Change, Severity, Topic, WiringFinding, WiringReport};

/// Maximum number of trials. It is small, because every trial reads the logs again.
const MAX_TRIALS: usize = 4;

/// Tries the changes of the first findings. `judge` judges the input with another configuration. It returns `None` if
/// the input cannot be judged again.
pub fn try_changes(
    config: &Path,
    report: &mut WiringReport,
    judge: &mut dyn FnMut(&mut Survey) -> Option<WiringReport>,
) {
    let faults = super::survey(config).map_or(0, |survey| survey.faults.len());
    let before = counts(report);
    let mut left = MAX_TRIALS;
    for finding in report.findings.iter_mut().filter(|finding| finding.severity != Severity::Note) {
        let own = subject(finding);
        let mut is_solved = Some(true).filter(|_| !finding.changes.is_empty());
        for group in std::mem::take(&mut finding.changes).chunk_by(|_, next| !next.is_alternative) {
            let is_exact = left > 0 && group.iter().all(is_exact);
            let outcome = match if is_exact { changed(config, group) } else { None } {
                Some(survey) if survey.faults.len() > faults => Outcome::Useless,
                // With an invalid configuration, some checks do not run, so the outcome would be unknown.
                Some(mut survey) if survey.faults.is_empty() => {
                    left -= 1;
                    judge(&mut survey).map_or(Outcome::Untried, |other| Outcome::of(&before, &own, &other))
                }
                _ => Outcome::Untried,
            };
            is_solved = match outcome {
                Outcome::Untried => None,
                Outcome::Exchanged(_) => is_solved.and(Some(false)),
                Outcome::Solved | Outcome::Useless => is_solved,
            };
            keep(finding, group, outcome);
        }
        finding.is_solved = is_solved.map(|is_solved| is_solved && !finding.changes.is_empty());
    }
}

enum Outcome {
    Untried,
    /// The finding disappears, and no other finding appears.
    Solved,
    /// The finding disappears, but another finding with this title appears.
    Exchanged(String),
    Useless,
}

impl Outcome {
    fn of(before: &BTreeMap<Subject, usize>, own: &Subject, other: &WiringReport) -> Self {
        let after = counts(other);
        let count = |counts: &BTreeMap<Subject, usize>, subject: &Subject| counts.get(subject).copied().unwrap_or(0);
        let is_new = |finding: &&WiringFinding| {
            let subject = subject(finding);
            finding.severity != Severity::Note && count(&after, &subject) > count(before, &subject)
        };
        if count(&after, own) >= count(before, own) {
            Self::Useless
        } else {
            other.findings.iter().find(is_new).map_or(Self::Solved, |new| Self::Exchanged(new.title.clone()))
        }
    }
}

/// Puts tried changes back into a finding, or states why they do not help.
fn keep(finding: &mut WiringFinding, changes: &[Change], outcome: Outcome) {
    let lines = changes.iter().map(|c| format!("{} = {}", c.key, c.proposed)).collect::<Vec<_>>().join(", ");
    let text = match &outcome {
        Outcome::Untried | Outcome::Solved => None,
        Outcome::Exchanged(title) => Some(format!("{lines} was tried; then another finding appears: {title}")),
        Outcome::Useless => Some(format!("{lines} was tried and does not help")),
    };
    finding.advice = finding.advice.take().into_iter().chain(text).reduce(|all, more| format!("{all}; {more}"));
    if !matches!(outcome, Outcome::Useless) {
        let is_first = finding.changes.is_empty();
        finding.changes.extend_from_slice(changes);
        if is_first {
            // An alternative follows another proposal. This change is now the first, so it is not an alternative.
            finding.changes[0].is_alternative = false;
        }
    }
}

/// What a finding is about: its topic and the table of its first change.
type Subject = (Topic, String);

fn subject(finding: &WiringFinding) -> Subject {
    (finding.topic, finding.changes.first().map_or_else(String::new, |change| change.table.clone()))
}

/// Number of errors and warnings about each subject.
fn counts(report: &WiringReport) -> BTreeMap<Subject, usize> {
    let mut counts = BTreeMap::new();
    for finding in report.findings.iter().filter(|finding| finding.severity != Severity::Note) {
        *counts.entry(subject(finding)).or_default() += 1;
    }
    counts
}

/// Whether the change states a value instead of only a description.
fn is_exact(change: &Change) -> bool {
    change.place.is_some() && toml::from_str::<toml::Table>(&format!("{} = {}", change.key, change.proposed)).is_ok()
}

/// The configuration with the changes; `None` if a change cannot be applied to the text.
fn changed(config: &Path, changes: &[Change]) -> Option<Survey> {
    let mut texts: BTreeMap<PathBuf, Vec<String>> = BTreeMap::new();
    let mut placed: Vec<(PathBuf, usize, &Change)> = Vec::new();
    for change in changes {
        let (file, line) = change.place.as_ref()?.rsplit_once(':')?;
        placed.push((PathBuf::from(file), line.parse().ok()?, change));
    }
    // Changes are applied from the last line to the first, so that inserted lines do not move other lines to change.
    placed.sort_by_key(|(_, line, _)| std::cmp::Reverse(*line));
    for (file, line, change) in placed {
        if !texts.contains_key(&file) {
            let text = bounded_file::read_text(&file).ok()?;
            texts.insert(file.clone(), text.lines().map(str::to_owned).collect());
        }
        apply(texts.get_mut(&file)?, line, change)?;
    }
    let read = |path: &Path| match texts.get(path) {
        Some(lines) => Ok((lines.join("\n") + "\n").into_bytes()),
        None => bounded_file::read(path),
    };
    survey_with(config, &read).ok()
}

/// Replaces the line of the key, or inserts a line below the header of the table. Returns `None` if the line has
/// another form.
fn apply(lines: &mut Vec<String>, line: usize, change: &Change) -> Option<()> {
    let text = lines.get(line.checked_sub(1)?)?;
    let new = format!("{} = {}", change.key, change.proposed);
    match &change.now {
        Some(_) => {
            let value = text.trim_start().strip_prefix(change.key.as_str())?.trim_start().strip_prefix('=')?;
            toml::from_str::<toml::Table>(&format!("key = {value}")).ok()?;
            lines[line - 1] = new;
        }
        None => {
            text.trim_start().strip_prefix('[')?;
            lines.insert(line, new);
        }
    }
    Some(())
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests may panic")]
mod tests {
    use super::*;

    fn change(now: Option<&str>) -> Change {
        let (table, key) = ("pack".to_owned(), "cells".to_owned());
        Change { table, key, proposed: "98".to_owned(), now: now.map(str::to_owned), ..Change::default() }
    }

    fn report(titles: &[(Severity, Topic, &str)]) -> WiringReport {
        let mut report = WiringReport::default();
        for (severity, topic, title) in titles {
            report.add(WiringFinding::new(*severity, *topic, *title));
        }
        report
    }

    #[test]
    fn proposal_is_solved_only_without_other_finding() {
        let sign = (Severity::Error, Topic::CurrentSign, "5 sigma");
        let unit = (Severity::Warning, Topic::Unit, "off");
        let outcome = |after: &[(Severity, Topic, &str)]| {
            Outcome::of(&counts(&report(&[sign])), &(Topic::CurrentSign, String::new()), &report(after))
        };
        assert!(matches!(outcome(&[]), Outcome::Solved));
        assert!(matches!(outcome(&[(Severity::Note, Topic::Noise, "noisy")]), Outcome::Solved));
        assert!(matches!(outcome(&[unit]), Outcome::Exchanged(title) if title == "off"));
        assert!(matches!(outcome(&[(Severity::Warning, Topic::CurrentSign, "4 sigma")]), Outcome::Useless));
    }

    #[test]
    fn change_replaces_or_inserts_one_line() {
        let mut lines = vec!["[pack]".to_owned(), "  cells = 90 # counted".to_owned()];
        apply(&mut lines, 2, &change(Some("90"))).unwrap();
        assert_eq!(lines, ["[pack]", "cells = 98"]);
        apply(&mut lines, 1, &change(None)).unwrap();
        assert_eq!(lines, ["[pack]", "cells = 98", "cells = 98"]);
        assert!(apply(&mut vec!["pack = { cells = 3 }".to_owned()], 1, &change(Some("3"))).is_none());
    }
}
