//! Output of `whatif` as JSON or CSV.

use std::io;
use std::path::Path;

use serde_json::json;

use super::report::WhatifReport;
use crate::cli::common::output::print_json;
use crate::io::result_file::ResultFile;
use crate::io::stamp;
use crate::lab::fleet::variants::Variant;
use crate::lab::fleet::whatif::{LogResult, ThresholdScore};
use crate::quantity::Timestamp;

const VERSION: u32 = 1;
/// A column of the CSV: name and value.
type Column = (&'static str, fn(&LogResult, &ThresholdScore) -> String);

/// Fixed columns of the CSV. One column per varied setting follows them.
#[rustfmt::skip]
const COLUMNS: [Column; 23] = [
    ("log", |log, _| log.log.display().to_string()),
    ("judged_by", |log, _| log.judged_by.words().to_owned()),
    ("days", |log, _| log.days.to_string()),
    ("cycles", |log, _| log.cycles.to_string()),
    ("end_of_life_day", |log, _| text(log.end_of_life.map(|end| end.days))),
    ("end_of_life_cycle", |log, _| text(log.end_of_life.map(|end| end.cycles))),
    ("setting", |_, row| row.setting.to_string()),
    ("rule", |_, row| row.rule.name().to_owned()),
    ("severity", |_, row| row.severity.name().to_owned()),
    ("threshold", |_, row| row.threshold.to_string()),
    ("raises", |_, row| row.judged.raises.to_string()),
    ("raised_utc", |_, row| text(row.judged.first.map(|first| stamp::format_utc(Timestamp::from_secs(first.time_s))))),
    ("raised_day", |_, row| text(row.judged.first.map(|first| first.days))),
    ("raised_cycle", |_, row| text(row.judged.first.map(|first| first.cycles))),
    ("cell", |_, row| text(row.judged.first.and_then(|first| first.cell))),
    ("value", |_, row| text(row.judged.first.and_then(|first| first.value))),
    ("lead_days", |_, row| text(row.judged.lead_days)),
    ("lead_cycles", |_, row| text(row.judged.lead_cycles)),
    ("missed", |_, row| text(row.judged.missed)),
    ("false_alarms", |_, row| text(row.judged.false_alarms)),
    ("open", |_, row| text(row.judged.open)),
    ("false_raises", |_, row| text(row.judged.false_raises)),
    ("flickers", |_, row| row.judged.flickers.to_string()),
];

fn text(value: Option<impl ToString>) -> String {
    value.map(|value| value.to_string()).unwrap_or_default()
}

impl WhatifReport<'_> {
    pub(super) fn json(&self) -> io::Result<()> {
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
        print_json(&json!({
            "version": VERSION,
            "end_of_life_ah": self.settings.end_of_life_ah,
            "rated_capacity_ah": self.rated_ah,
            "horizon": self.settings.horizon,
            "replays_per_log": self.grid.replays,
            "settings": self.grid.variants.iter().map(setting).collect::<Vec<_>>(),
            "summary": self.summaries(),
            "logs": logs,
            "failed": self.failed,
            "notes": self.grid.notes,
        }))
    }

    pub(super) fn csv(&self, path: &Path) -> io::Result<()> {
        let mut out = csv::Writer::from_writer(ResultFile::create(path)?);
        let keys = self.grid.keys.iter().map(String::as_str);
        out.write_record(COLUMNS.iter().map(|(name, _)| *name).chain(keys))?;
        for log in self.logs {
            for row in self.rows(log) {
                let values =
                    self.grid.variants.get(row.setting).map(|variant| variant.values.as_slice()).unwrap_or_default();
                let set = (0..self.grid.keys.len()).map(|key| values.get(key).cloned().unwrap_or_default());
                out.write_record(COLUMNS.iter().map(|(_, value)| value(log, row)).chain(set))?;
            }
        }
        out.into_inner().map_err(|error| io::Error::other(error.to_string()))?.finish()
    }
}
