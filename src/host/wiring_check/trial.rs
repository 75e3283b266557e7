//! Tries the changes that a report proposes: applies them to the text of the configuration in memory and judges the same
//! input again.
//!
//! In: the report and a function that judges the input with another configuration. Out: each finding states whether its
//! change removes it. A change that does not help is removed from the report, so that nobody follows it. Nothing is
//! written.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::Survey;
use super::survey::survey_with;
use crate::wiring::{Change, Severity, WiringReport};

/// Maximum number of findings whose changes are tried, because every trial reads the logs again.
const MAX_TRIALS: usize = 4;

/// Tries the changes of the first findings. `judge` judges the input with another configuration; `None` = it cannot be
/// judged again.
pub fn try_changes(
    config: &Path,
    report: &mut WiringReport,
    judge: &mut dyn FnMut(&mut Survey) -> Option<WiringReport>,
) {
    let errors = errors(report);
    let faults = super::survey(config).map_or(0, |survey| survey.faults.len());
    let is_tried = |index: &usize| {
        let finding = &report.findings[*index];
        finding.severity != Severity::Note && !finding.changes.is_empty() && finding.changes.iter().all(is_exact)
    };
    let tried: Vec<usize> = (0..report.findings.len()).filter(is_tried).take(MAX_TRIALS).collect();
    for index in tried {
        let finding = &report.findings[index];
        let Some(mut survey) = changed(config, &finding.changes) else { continue };
        let Some(other) = judge(&mut survey) else { continue };
        let remains =
            other.findings.iter().any(|other| other.title == finding.title && other.severity == finding.severity);
        let is_worse = self::errors(&other) > errors || survey.faults.len() > faults;
        let finding = &mut report.findings[index];
        finding.is_solved = Some(!remains && !is_worse);
        if remains || is_worse {
            let lines: Vec<String> = finding.changes.drain(..).map(|c| format!("{} = {}", c.key, c.proposed)).collect();
            let text = format!("{} was tried and does not help", lines.join(", "));
            let advice = finding.advice.take().into_iter().chain([text]);
            finding.advice = Some(advice.collect::<Vec<_>>().join("; "));
        }
    }
}

fn errors(report: &WiringReport) -> usize {
    report.findings.iter().filter(|finding| finding.severity == Severity::Error).count()
}

/// Whether the change states a value, and not only a description.
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
    // From the last line to the first, so that inserted lines do not move the lines of other changes.
    placed.sort_by_key(|(_, line, _)| std::cmp::Reverse(*line));
    for (file, line, change) in placed {
        if !texts.contains_key(&file) {
            let text = std::fs::read_to_string(&file).ok()?;
            texts.insert(file.clone(), text.lines().map(str::to_owned).collect());
        }
        apply(texts.get_mut(&file)?, line, change)?;
    }
    let read = |path: &Path| match texts.get(path) {
        Some(lines) => Ok((lines.join("\n") + "\n").into_bytes()),
        None => std::fs::read(path),
    };
    survey_with(config, &read).ok()
}

/// Replaces the line of the key, or inserts a line below the header of the table. `None` if the line has another form.
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
        Change { table, key, proposed: "98".to_owned(), place: None, now: now.map(str::to_owned) }
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
