//! The doctor's report as text: findings (most severe first), what is in order, and what could not be checked.

use std::io::IsTerminal as _;
use std::path::Path;

use crate::cli::common::output::{self, printable};
use crate::wiring::{Change, Severity, WiringFinding, WiringReport};
use packwatch_host::failure::Failure;

/// Column where the text of a finding begins.
const INDENT: usize = 10;

#[derive(Debug, Clone, Copy)]
struct Paint(bool);

impl Paint {
    fn with(self, code: &str, text: &str) -> String {
        // A name from a file may contain control characters.
        let text = printable(text);
        if self.0 { format!("\u{1b}[{code}m{text}\u{1b}[0m") } else { text }
    }

    fn bold(self, text: &str) -> String {
        self.with("1", text)
    }

    fn dim(self, text: &str) -> String {
        self.with("2", text)
    }
}

pub(super) fn print(report: &WiringReport, config: &Path, source: &str) -> Result<(), Failure> {
    let is_terminal = std::io::stdout().is_terminal();
    let paint = Paint(is_terminal && std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty()));
    let width =
        if is_terminal { ratatui::crossterm::terminal::size().map_or(100, |(w, _)| usize::from(w)) } else { 100 };
    output::print_painted(&render(report, config, source, width.clamp(50, 120), paint))
}

fn render(report: &WiringReport, config: &Path, source: &str, width: usize, paint: Paint) -> String {
    let (config, seconds, frames) = (config.display(), report.seconds, report.frames);
    let mut page = printable(&format!("{source} with {config}: {seconds:.0} s, {frames} frames\n\n"));
    page.push_str(&format!("{}\n", paint.bold(&summary(report))));
    for finding in &report.findings {
        page.push('\n');
        show(finding, width, paint, &mut page);
    }
    list("fine", &report.fine, width, paint, &mut page);
    list("not judged", &report.unjudged, width, paint, &mut page);
    page
}

/// The proposed configuration line. If only a person can know the value, the key with a description of the value.
fn proposal(change: &Change) -> String {
    let line = format!("{} = {}", change.key, change.proposed);
    if toml::from_str::<toml::Table>(&line).is_ok() {
        format!("+ {line}")
    } else {
        format!("+ {} = ... ({})", change.key, change.proposed)
    }
}

fn summary(report: &WiringReport) -> String {
    let count = |severity| report.findings.iter().filter(|finding| finding.severity == severity).count();
    let many = |n: usize, one: &str| if n == 1 { format!("1 {one}") } else { format!("{n} {one}s") };
    const CONSEQUENCES: &str = "Start with the first; it may cause the others.";
    match (count(Severity::Error), count(Severity::Warning)) {
        (0, 0) if report.frames == 0 => "No frames were received.".to_owned(),
        (0, 0) => "No faults found in what could be judged.".to_owned(),
        (errors, 0) => format!("{}. {CONSEQUENCES}", many(errors, "error")),
        (0, warnings) => format!("{}.", many(warnings, "warning")),
        (errors, warnings) => {
            format!("{} and {}. {CONSEQUENCES}", many(errors, "error"), many(warnings, "warning"))
        }
    }
}

fn show(finding: &WiringFinding, width: usize, paint: Paint, page: &mut String) {
    let (label, colour) = match finding.severity {
        Severity::Error => ("ERROR", "1;31"),
        Severity::Warning => ("WARNING", "1;33"),
        Severity::Note => ("note", "1;36"),
    };
    let title = wrapped(&finding.title, width, INDENT);
    page.push_str(&format!("{}{}\n", paint.with(colour, &format!("{label:INDENT$}")), paint.bold(&title)));
    for (label, text) in
        [("seen", Some(&finding.seen)), ("because", Some(&finding.why)), ("do", finding.advice.as_ref())]
    {
        if let Some(text) = text.filter(|text| !text.is_empty()) {
            page.push_str(&format!("{}{}\n", paint.dim(&format!("  {label:8}")), wrapped(text, width, INDENT)));
        }
    }
    changes(&finding.changes, paint, page);
    if finding.is_solved == Some(true) {
        page.push_str(&format!("{}with this change, the finding disappears\n", paint.dim(&format!("  {:8}", "tried"))));
    }
    consequences(&finding.consequences, width, paint, page);
}

fn consequences(titles: &[String], width: usize, paint: Paint, page: &mut String) {
    const SHOWN: usize = 4;
    let shown = titles.iter().take(SHOWN).map(String::as_str).collect::<Vec<_>>().join("; ");
    let text = match titles.len() {
        0 => return,
        n if n > SHOWN => format!("{shown}; and {} more", n - SHOWN),
        _ => shown,
    };
    page.push_str(&format!("{}{}\n", paint.dim(&format!("  {:8}", "below")), wrapped(&text, width, INDENT)));
}

fn changes(changes: &[Change], paint: Paint, page: &mut String) {
    const SHOWN: usize = 4;
    for change in changes.iter().take(SHOWN) {
        let place = change.place.as_deref().unwrap_or("");
        let now = match &change.now {
            Some(now) => format!("{} = {now}", change.key),
            None => format!("{} is not set", change.key),
        };
        let label = if change.is_alternative { "or" } else { "change" };
        page.push_str(&format!(
            "{}{}  [{}]\n",
            paint.dim(&format!("  {label:8}")),
            printable(place),
            printable(&change.table)
        ));
        page.push_str(&format!("{:INDENT$}{}\n", "", paint.with("31", &format!("- {now}"))));
        page.push_str(&format!("{:INDENT$}{}\n", "", paint.with("32", &proposal(change))));
    }
    if changes.len() > SHOWN {
        page.push_str(&format!("{:INDENT$}and {} similar lines\n", "", changes.len() - SHOWN));
    }
}

fn list(heading: &str, lines: &[String], width: usize, paint: Paint, page: &mut String) {
    if lines.is_empty() {
        return;
    }
    page.push_str(&format!("\n{}\n", paint.bold(heading)));
    for line in lines {
        page.push_str(&format!("  {}\n", wrapped(line, width, 2)));
    }
}

/// Wraps text to at most `width`; indents all lines but the first.
fn wrapped(text: &str, width: usize, indent: usize) -> String {
    let mut lines: Vec<String> = vec![String::new()];
    for word in printable(text).split_whitespace() {
        let line = lines.last_mut().map_or(0, |line| line.chars().count());
        if line > 0 && indent + line + 1 + word.chars().count() > width {
            lines.push(word.to_owned());
        } else if let Some(last) = lines.last_mut() {
            if line > 0 {
                last.push(' ');
            }
            last.push_str(word);
        }
    }
    lines.join(&format!("\n{:indent$}", ""))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests may panic")]
mod tests {
    use super::*;
    use crate::wiring::Topic;

    fn change(proposed: &str) -> Change {
        let (table, key) = ("pack".to_owned(), "cells".to_owned());
        Change { table, key, proposed: proposed.to_owned(), place: Some("pack.toml:7".to_owned()), ..Change::default() }
    }

    #[test]
    fn proposal_without_single_value_is_description() {
        assert_eq!(proposal(&change("90")), "+ cells = 90");
        assert_eq!(proposal(&change("85 to 131")), "+ cells = ... (85 to 131)");
    }

    #[test]
    fn wrapped_text_is_indented_and_complete() {
        let text = "one two three four five";
        let lines = wrapped(text, 14, 4);
        assert!(lines.lines().all(|line| line.chars().count() <= 14), "{lines}");
        assert_eq!(lines.split_whitespace().collect::<Vec<_>>().join(" "), text);
        assert_eq!(wrapped("unbreakablyLong", 5, 2), "unbreakablyLong");
    }

    #[test]
    fn long_list_of_consequences_is_cut_and_counted() {
        let mut report = WiringReport::default();
        let mut finding = WiringFinding::new(Severity::Error, Topic::Layout, "off");
        finding.consequences = (1..=30).map(|n| format!("cell {n} is odd")).collect();
        report.add(finding);
        let page = render(&report, Path::new("pack.toml"), "can0", 80, Paint(false));
        let words = page.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(words.contains("below cell 1 is odd; cell 2") && words.contains("odd; and 26 more"), "{page}");
    }

    #[test]
    fn long_list_of_changes_is_cut_and_counted() {
        let mut report = WiringReport::default();
        let mut finding = WiringFinding::new(Severity::Error, Topic::Unit, "off");
        finding.changes = vec![change("1"); 12];
        report.add(finding);
        let page = render(&report, Path::new("pack.toml"), "can0", 80, Paint(false));
        assert_eq!(page.matches("pack.toml:7").count(), 4);
        assert!(page.contains("and 8 similar lines") && page.contains("1 error."), "{page}");
    }
}
