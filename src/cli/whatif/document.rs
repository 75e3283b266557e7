//! Output of `whatif` for programs: one JSON document, or CSV.

use std::io::{self, Write};
use std::path::Path;

use serde_json::json;

use super::report::WhatifReport;
use crate::io::result_file::ResultFile;
use crate::io::stamp;
use crate::lab::fleet::judge::Horizon;
use crate::lab::fleet::variants::Variant;
use crate::lab::fleet::whatif::{ThresholdScore, LogResult};
use crate::quantity::Timestamp;

/// Version of the JSON document.
const VERSION: u32 = 1;
/// Columns of the CSV in addition to the values set.
const HEADS: [&str; 23] = [
    "log",
    "judged_by",
    "days",
    "cycles",
    "end_of_life_day",
    "end_of_life_cycle",
    "setting",
    "rule",
    "severity",
    "threshold",
    "raises",
    "raised_utc",
    "raised_day",
    "raised_cycle",
    "cell",
    "value",
    "lead_days",
    "lead_cycles",
    "missed",
    "false_alarms",
    "open",
    "false_raises",
    "flickers",
];

impl WhatifReport<'_> {
    /// Prints one JSON document.
    pub(super) fn json(&self) -> io::Result<()> {
        let horizon = match self.settings.horizon {
            None => json!(null),
            Some(Horizon::Cycles(cycles)) => json!({ "cycles": cycles }),
            Some(Horizon::Days(days)) => json!({ "days": days }),
        };
        let setting = |variant: &Variant| {
            let set = self.grid.keys.iter().cloned().zip(variant.values.iter().map(|value| json!(value)));
            json!({ "set": serde_json::Map::from_iter(set), "replay": variant.replay })
        };
        let logs: Vec<_> = self
            .logs
            .iter()
            .map(|log| {
                let alarms = self.rows(log).cloned().collect();
                LogResult { alarms, ..(*log).clone() }
            })
            .collect();
        let document = json!({
            "version": VERSION,
            "end_of_life_ah": self.settings.end_of_life_ah,
            "rated_capacity_ah": self.rated_ah,
            "horizon": horizon,
            "replays_per_log": self.grid.replays,
            "settings": self.grid.variants.iter().map(setting).collect::<Vec<_>>(),
            "summary": self.summaries(),
            "logs": logs,
            "failed": self.failed,
            "notes": self.grid.notes,
        });
        let mut out = io::stdout().lock();
        serde_json::to_writer_pretty(&mut out, &document)?;
        writeln!(out)
    }

    /// Writes a row per log, setting and alarm.
    pub(super) fn csv(&self, path: &Path) -> io::Result<()> {
        let mut out = csv::Writer::from_writer(ResultFile::create(path)?);
        out.write_record(HEADS.into_iter().chain(self.grid.keys.iter().map(String::as_str)))?;
        for log in self.logs {
            for row in self.rows(log) {
                let values =
                    self.grid.variants.get(row.setting).map(|variant| variant.values.as_slice()).unwrap_or_default();
                let set = (0..self.grid.keys.len()).map(|key| values.get(key).cloned().unwrap_or_default());
                out.write_record(csv_row(log, row).into_iter().chain(set))?;
            }
        }
        out.into_inner().map_err(|error| io::Error::other(error.to_string()))?.finish()
    }
}

fn csv_row(log: &LogResult, row: &ThresholdScore) -> [String; HEADS.len()] {
    fn text(value: Option<impl ToString>) -> String {
        value.map(|value| value.to_string()).unwrap_or_default()
    }
    let (judged, first, end) = (&row.judged, row.judged.first.as_ref(), log.end_of_life.as_ref());
    [
        log.log.display().to_string(),
        log.judged_by.words().to_owned(),
        log.days.to_string(),
        log.cycles.to_string(),
        text(end.map(|end| end.days)),
        text(end.map(|end| end.cycles)),
        row.setting.to_string(),
        row.rule.name().to_owned(),
        row.severity.name().to_owned(),
        row.threshold.to_string(),
        judged.raises.to_string(),
        text(first.map(|first| stamp::format_utc(Timestamp::from_secs(first.time_s)))),
        text(first.map(|first| first.days)),
        text(first.map(|first| first.cycles)),
        text(first.and_then(|first| first.cell)),
        text(first.and_then(|first| first.value)),
        text(judged.lead_days),
        text(judged.lead_cycles),
        text(judged.missed),
        text(judged.false_alarms),
        text(judged.open),
        text(judged.false_raises),
        judged.flickers.to_string(),
    ]
}
