//! Reports in one line how a table was read.

use serde::Serialize;

use super::judge::Judgement;
use super::layout::{Column, Layout};
use super::state::SignSource;
use super::time_text::TimeForm;
use super::{Channel, CsvOptions};
use crate::io::table::Header;

/// How a table was read.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct TableReading {
    /// Name of the file.
    pub file: String,
    /// The columns with their units, and the sign of the current.
    pub columns: String,
    /// Number of rows read so far.
    pub rows: u64,
    /// Number of rows without a bad field.
    pub read: u64,
    /// Number of currents that were rejected because they are impossible.
    pub refused_currents: u64,
    /// Whether a column of temperatures is read.
    #[serde(skip)]
    pub has_temperature: bool,
    /// The largest possible current (A), for the message.
    #[serde(skip)]
    largest_current: String,
}

impl TableReading {
    pub(super) fn new(header: &Header, layout: &Layout, judgement: &Judgement, options: &CsvOptions) -> Self {
        let mut parts: Vec<String> = layout.format.name().map(str::to_owned).into_iter().collect();
        parts.push(time(header, layout, judgement));
        for (name, is_wanted) in KINDS {
            let columns = layout.channels.iter().filter(|(channel, _)| is_wanted(channel)).map(|of| of.1);
            parts.extend(group(name, header, &columns.collect::<Vec<_>>()));
            if name == "current" {
                let sign = sign(judgement);
                let state = layout.state.filter(|_| judgement.sign.is_by_state);
                let state = state.map_or_else(String::new, |column| format!(" {}", quoted(header, column)));
                if let Some(part) = parts.last_mut() {
                    *part += &format!(", {sign}{state}");
                }
            }
        }
        parts.extend(layout.section.map(|column| format!("sections: {}", quoted(header, column))));
        parts.extend(judgement.notes.iter().cloned());
        Self {
            file: header.file().to_owned(),
            columns: parts.join("; "),
            rows: 0,
            read: 0,
            refused_currents: 0,
            has_temperature: layout.channels.iter().any(|(channel, _)| matches!(channel, Channel::Temperature(_))),
            largest_current: super::PackSize { capacity_ah: options.capacity_ah }.max_current_a().to_string(),
        }
    }

    pub(super) fn check(&mut self, current_a: Option<f64>, max_current_a: f64) -> Option<f64> {
        let possible = current_a.filter(|current_a| current_a.abs() <= max_current_a);
        self.refused_currents += u64::from(possible.is_none());
        possible
    }

    /// Number of rows without a bad field whose current was not rejected.
    pub fn accepted(&self) -> u64 {
        self.read.saturating_sub(self.refused_currents)
    }
}

impl std::fmt::Display for TableReading {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if self.rows == 0 {
            return write!(f, "{}: {}", self.file, self.columns);
        }
        // Round down, so that a share below 100 % is not shown as 100 %.
        let share = (1000.0 * self.accepted() as f64 / self.rows as f64).floor() / 10.0;
        write!(f, "{}: {}; {share} % of {} rows accepted", self.file, self.columns, grouped(self.rows))?;
        if self.refused_currents > 0 {
            let (count, limit) = (grouped(self.refused_currents), &self.largest_current);
            write!(f, ", {count} currents refused (beyond {limit} A, or of the wrong sign)")?;
        }
        Ok(())
    }
}

type Wanted = fn(&Channel) -> bool;

const KINDS: [(&str, Wanted); 4] = [
    ("current", |channel| *channel == Channel::Current),
    ("voltage", |channel| matches!(channel, Channel::PackVoltage | Channel::CellVoltage(_))),
    ("temperature", |channel| matches!(channel, Channel::Temperature(_))),
    ("reported SOC", |channel| *channel == Channel::ReportedSoc),
];

fn quoted(header: &Header, column: usize) -> String {
    format!("{:?}", header.names().get(column).map_or("", String::as_str))
}

fn time(header: &Header, layout: &Layout, judgement: &Judgement) -> String {
    let form = match judgement.time_form {
        TimeForm::Number => judgement.time.unit.symbol,
        TimeForm::Clock => "h:m:s",
        TimeForm::Date => "dates",
    };
    let step = if layout.is_step_time { " of the step" } else { "" };
    let (number, name) = (layout.time.index + 1, quoted(header, layout.time.index));
    let assumed = match judgement.is_time_assumed {
        true => {
            format!(" (assumed, --column time='{}[UNIT]' changes it)", header.names()[layout.time.index])
        }
        false => String::new(),
    };
    format!("time{step}: column {number} {name} in {form}{assumed}")
}

fn group(name: &str, header: &Header, columns: &[Column]) -> Option<String> {
    let (first, last) = (columns.first()?, columns.last()?);
    let assumed = if first.is_stated || first.unit.symbol.is_empty() { "" } else { " (assumed)" };
    let unit = if first.unit.symbol.is_empty() { "a fraction" } else { first.unit.symbol };
    let (number, first_name) = (first.index + 1, quoted(header, first.index));
    Some(match columns.len() {
        1 => format!("{name}: column {number} {first_name} in {unit}{assumed}"),
        count => {
            let last_name = quoted(header, last.index);
            format!("{name}: {count} columns {first_name} to {last_name} in {unit}{assumed}")
        }
    })
}

fn sign(judgement: &Judgement) -> String {
    let sign = &judgement.sign;
    if sign.is_by_state {
        return "a magnitude with its sign from".to_owned();
    }
    let positive = if sign.is_charge_positive { "charge positive" } else { "discharge positive" };
    let source = match sign.source {
        SignSource::User => " (--csv-sign)",
        SignSource::Format => "",
        SignSource::State => " (state column)",
        SignSource::Voltage => " (the voltage shows it)",
        SignSource::Nothing => " (assumed)",
    };
    format!("{positive}{source}")
}

/// A count with commas between thousands.
fn grouped(count: u64) -> String {
    let digits = count.to_string();
    let mut text = String::new();
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}
