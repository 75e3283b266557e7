//! Tables of `whatif`: the summary over the logs, and each log.

use std::io::{self, Write};

use serde::Serialize;

use crate::alarm::{Rule, Severity};
use crate::cli::common::output::write_table;
use crate::lab::fleet::judge::Horizon;
use crate::lab::fleet::variants::VariantGrid;
use crate::lab::fleet::whatif::{EndOfLife, LogResult, ThresholdScore, WhatifSettings};

/// Number of columns that follow the alarm column and the columns of the settings.
const OWN_COLUMNS: usize = 9;
const SUMMARY_HEADS: [&str; OWN_COLUMNS] =
    ["threshold", "raised", "lead, days", "lead, cycles", "missed", "false", "open", "false raises", "flickers"];
const LOG_HEADS: [&str; OWN_COLUMNS] =
    ["threshold", "raised", "at day", "cycle", "cell", "value", "lead, days", "lead, cycles", "judged"];

pub(super) struct WhatifReport<'a> {
    pub(super) grid: &'a VariantGrid,
    pub(super) settings: &'a WhatifSettings<'a>,
    pub(super) rated_ah: f64,
    pub(super) rules: &'a [Rule],
    pub(super) logs: &'a [&'a LogResult],
    /// One error message for each log that failed.
    pub(super) failed: Vec<String>,
}

/// Results of one threshold with one setting, over all logs.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Summary {
    setting: usize,
    rule: Rule,
    severity: Severity,
    threshold: f64,
    /// Number of logs in which the alarm was raised.
    raised_logs: usize,
    /// Lead time of the alarm: median, 5 % and 95 % quantiles over the logs (days).
    lead_days: Option<[f64; 3]>,
    lead_cycles: Option<[f64; 3]>,
    missed: Option<usize>,
    false_alarms: Option<usize>,
    open: Option<usize>,
    false_raises: Option<usize>,
    flickers: usize,
}

impl WhatifReport<'_> {
    pub(super) fn table(&self, each: bool) -> io::Result<()> {
        if self.logs.is_empty() {
            return Ok(());
        }
        let mut text = Vec::new();
        self.write_head(&mut text)?;
        if self.logs.len() != 1 {
            self.write_summary(&mut text)?;
        }
        if each || self.logs.len() == 1 {
            self.logs.iter().try_for_each(|log| self.write_log(&mut text, log))?;
        }
        io::stdout().write_all(&text)
    }

    fn write_head(&self, out: &mut impl Write) -> io::Result<()> {
        let (settings, replays) = (self.grid.variants.len(), self.grid.replays);
        let more =
            if settings == 1 { "the configuration without changes".to_owned() } else { format!("{settings} settings") };
        writeln!(out, "{}, {more}, {} per log", numbered(self.logs.len(), "log"), numbered(replays, "replay"))?;
        let (end_ah, part) = (self.settings.end_of_life_ah, 100.0 * self.settings.end_of_life_ah / self.rated_ah);
        let reached = self.logs.iter().filter(|log| log.end_of_life.is_some()).count();
        let mut by: Vec<_> = self.logs.iter().map(|log| log.judged_by).collect();
        by.sort_unstable();
        let by = by.chunk_by(|a, b| a == b).map(|same| format!("{} ({})", same[0].words(), same.len()));
        let by = by.collect::<Vec<_>>().join(", ");
        writeln!(out, "end of life {end_ah:.3} Ah ({part:.0} % of rated), reached in {reached}, judged by {by}")?;
        match self.settings.horizon {
            None => writeln!(out, "a raise is false in a log without end of life")?,
            Some(Horizon::Cycles(n)) => {
                writeln!(out, "a raise is false if the end of life does not follow within {n} cycles")?
            }
            Some(Horizon::Days(n)) => {
                writeln!(out, "a raise is false if the end of life does not follow within {n} days")?
            }
        }
        self.grid.notes.iter().try_for_each(|note| writeln!(out, "note: {note}"))?;
        for log in self.logs {
            log.notes.iter().try_for_each(|note| writeln!(out, "note: {}: {note}", log.log.display()))?;
        }
        Ok(())
    }

    fn write_summary(&self, out: &mut impl Write) -> io::Result<()> {
        let ended = self.logs.iter().filter(|log| log.end_of_life.is_some()).count();
        let row = |summary: &Summary| {
            let own = [
                level(summary.threshold),
                format!("{} of {}", summary.raised_logs, self.logs.len()),
                spread(summary.lead_days),
                spread(summary.lead_cycles),
                summary.missed.map_or_else(dash, |missed| format!("{missed} of {ended}")),
                count(summary.false_alarms),
                count(summary.open),
                count(summary.false_raises),
                summary.flickers.to_string(),
            ];
            self.row((summary.rule, summary.severity), summary.setting, own)
        };
        writeln!(out)?;
        write_table(out, &self.heads(SUMMARY_HEADS), self.summaries().iter().map(row), 2)
    }

    fn write_log(&self, out: &mut impl Write, log: &LogResult) -> io::Result<()> {
        let learned =
            log.learned_ah.map_or_else(|| "nothing learned".to_owned(), |ah| format!("{ah:.3} Ah learned at the end"));
        let end = match &log.end_of_life {
            Some(end) => format!("end of life at day {:.2}, cycle {:.1}, cell {}", end.days, end.cycles, end.cell + 1),
            None => "end of life not reached".to_owned(),
        };
        let (name, by) = (log.log.display(), log.judged_by.words());
        writeln!(out, "\n{name}: {:.2} days, {:.1} cycles, {learned}; {end} ({by})", log.days, log.cycles)?;
        write_table(out, &self.heads(LOG_HEADS), self.rows(log).map(|row| self.log_row(log, row)), 2)
    }

    fn log_row(&self, log: &LogResult, row: &ThresholdScore) -> Vec<String> {
        let judged = &row.judged;
        let first = judged.first.as_ref();
        let number = |value: Option<f64>, digits: usize| value.map_or_else(dash, |value| format!("{value:.digits$}"));
        let place = |cell: Option<u16>| cell.map_or_else(|| "pack".to_owned(), |cell| (cell + 1).to_string());
        let own = [
            level(row.threshold),
            format!("{} times", judged.raises),
            number(first.map(|first| first.days), 2),
            number(first.map(|first| first.cycles), 1),
            first.map_or_else(dash, |first| place(first.cell)),
            number(first.and_then(|first| first.value), 4),
            number(judged.lead_days, 2),
            number(judged.lead_cycles, 1),
            verdict(row, log.end_of_life.as_ref()),
        ];
        self.row((row.rule, row.severity), row.setting, own)
    }

    fn heads(&self, own: [&str; OWN_COLUMNS]) -> Vec<String> {
        std::iter::once("alarm".to_owned())
            .chain(self.grid.keys.iter().cloned())
            .chain(own.map(str::to_owned))
            .collect()
    }

    fn row(&self, (rule, severity): (Rule, Severity), setting: usize, own: [String; OWN_COLUMNS]) -> Vec<String> {
        let alarm = format!("{} {}", rule.name(), severity.name());
        std::iter::once(alarm).chain(self.setting_cells(setting)).chain(own).collect()
    }

    /// Returns the columns of the settings. For the configuration without changes, they contain "unchanged".
    fn setting_cells(&self, setting: usize) -> impl Iterator<Item = String> {
        let values = self.grid.variants.get(setting).map(|variant| variant.values.clone()).unwrap_or_default();
        let plain = values.is_empty();
        (0..self.grid.keys.len()).map(move |key| match values.get(key) {
            Some(value) => value.clone(),
            None if plain => "unchanged".to_owned(),
            None => dash(),
        })
    }

    /// Rows of a log, without the rules that are not shown.
    pub(super) fn rows<'l>(&'l self, log: &'l LogResult) -> impl Iterator<Item = &'l ThresholdScore> {
        log.alarms.iter().filter(|row| self.rules.contains(&row.rule))
    }

    pub(super) fn summaries(&self) -> Vec<Summary> {
        let Some(first) = self.logs.first() else { return Vec::new() };
        // Every log has the same rows in the same order.
        (0..first.alarms.len())
            .filter(|&index| self.rules.contains(&first.alarms[index].rule))
            .map(|index| summary(&self.logs.iter().map(|log| &log.alarms[index]).collect::<Vec<_>>()))
            .collect()
    }
}

fn summary(rows: &[&ThresholdScore]) -> Summary {
    let first = rows[0];
    let sum = |of: fn(&ThresholdScore) -> Option<usize>| {
        rows.iter()
            .map(|row| of(row))
            .fold(None, |so_far: Option<usize>, next| next.map(|next| so_far.unwrap_or(0) + next).or(so_far))
    };
    let leads = |of: fn(&ThresholdScore) -> Option<f64>| quantiles(rows.iter().filter_map(|row| of(row)).collect());
    Summary {
        setting: first.setting,
        rule: first.rule,
        severity: first.severity,
        threshold: first.threshold,
        raised_logs: rows.iter().filter(|row| row.judged.raises > 0).count(),
        lead_days: leads(|row| row.judged.lead_days),
        lead_cycles: leads(|row| row.judged.lead_cycles),
        missed: sum(|row| row.judged.missed.map(usize::from)),
        false_alarms: sum(|row| row.judged.false_alarms),
        open: sum(|row| row.judged.open),
        false_raises: sum(|row| row.judged.false_raises),
        flickers: rows.iter().map(|row| row.judged.flickers).sum(),
    }
}

/// Median, 5 % and 95 % quantiles. Each quantile is the nearest existing value. If the median lies between two values,
/// the lower value is used.
fn quantiles(mut values: Vec<f64>) -> Option<[f64; 3]> {
    values.sort_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    let at = |part: f64| values[((part * values.len() as f64).ceil() as usize).saturating_sub(1).min(last)];
    Some([at(0.5), at(0.05), at(0.95)])
}

fn verdict(row: &ThresholdScore, end: Option<&EndOfLife>) -> String {
    let judged = &row.judged;
    let late_days = judged.first.zip(end).map(|(first, end)| first.days - end.days).filter(|days| *days >= 0.0);
    let missed = || late_days.map_or_else(|| "missed".to_owned(), |days| format!("missed, {days:.2} days late"));
    let words = [
        judged.missed.filter(|missed| *missed).map(|_| missed()),
        judged.false_alarms.filter(|n| *n > 0).map(|n| format!("{n} false")),
        judged.open.filter(|n| *n > 0).map(|n| format!("{n} open")),
        judged.false_raises.filter(|n| *n > 0).map(|n| format!("{n} false raises")),
        Some(judged.flickers).filter(|n| *n > 0).map(|n| format!("{n} flickers")),
        Some(judged.not_kept).filter(|n| *n > 0).map(|n| format!("{n} more not evaluated")),
    ];
    let words: Vec<String> = words.into_iter().flatten().collect();
    match (words.is_empty(), judged.lead_days.is_some()) {
        (false, _) => words.join(", "),
        (true, true) => "good".to_owned(),
        (true, false) => dash(),
    }
}

fn numbered(count: usize, what: &str) -> String {
    if count == 1 { format!("1 {what}") } else { format!("{count} {what}s") }
}

fn level(threshold: f64) -> String {
    let text = format!("{threshold:.4}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

fn spread(values: Option<[f64; 3]>) -> String {
    values.map_or_else(dash, |[median, low, high]| format!("{median:.1} ({low:.1} to {high:.1})"))
}

fn count(value: Option<usize>) -> String {
    value.map_or_else(dash, |value| value.to_string())
}

fn dash() -> String {
    "-".to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_existing_values() {
        assert_eq!(quantiles(Vec::new()), None);
        assert_eq!(quantiles(vec![3.0]), Some([3.0; 3]));
        assert_eq!(quantiles((1..=100).map(f64::from).collect()), Some([50.0, 5.0, 95.0]));
    }
}
