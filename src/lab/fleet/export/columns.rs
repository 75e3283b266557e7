//! Defines the columns of the exported tables: name, type, unit, meaning and value.
//!
//! The writers, the schema of the Parquet files and the page `docs/src/reference/export.md` use this definition. An
//! unknown value is null (an empty field in CSV), never NaN. Cells count from 0; a positive current discharges.

use std::borrow::Cow;
use std::fmt::Write as _;
use std::sync::LazyLock;

use super::rows::{AlarmRow, EstimateRow, HalfCycleRow, OutlookRow, UseRow};
use crate::fleet::vehicle::VehicleRecord;

use crate::cell::LossModes;
use crate::fields::Fields;
use crate::health::Remaining;
use crate::quantity::Timestamp;
use crate::quantity::catalogue::{Part, Quantity, RECORDED, RECORDED_OF_PACK, RecordedPackValues};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ColumnType {
    /// A time: microseconds since 1970, UTC. CSV has the form 2008-04-02T13:08:17.921000Z.
    Time,
    /// A number.
    Real,
    /// A whole number, 0 or more.
    Whole,
    /// Yes or no.
    Flag,
    /// A word from a fixed list, or a name.
    Word,
}

impl ColumnType {
    /// Returns the physical and the logical type in a Parquet schema.
    pub(super) const fn parquet(self) -> (&'static str, &'static str) {
        match self {
            Self::Time => ("INT64", " (TIMESTAMP(MICROS,true))"),
            Self::Real => ("DOUBLE", ""),
            Self::Whole => ("INT32", ""),
            Self::Flag => ("BOOLEAN", ""),
            Self::Word => ("BYTE_ARRAY", " (STRING)"),
        }
    }

    const fn name(self) -> &'static str {
        match self {
            Self::Time => "timestamp, UTC",
            Self::Real => "double",
            Self::Whole => "int32",
            Self::Flag => "boolean",
            Self::Word => "string",
        }
    }
}

/// A value of a column; `None` in a variant = unknown.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum FieldValue<'r> {
    Time(Timestamp),
    Real(Option<f64>),
    Whole(Option<u32>),
    Flag(bool),
    Word(Option<Cow<'r, str>>),
}

pub(super) struct Column<R> {
    pub(super) name: &'static str,
    pub(super) unit: &'static str,
    pub(super) kind: ColumnType,
    pub(super) optional: bool,
    pub(super) about: &'static str,
    source: ColumnSource<R>,
}

enum ColumnSource<R> {
    Value(for<'r> fn(&'r R) -> FieldValue<'r>),
    /// A field of the event. The name of the field is the name of the column.
    Field(fn(&R) -> &Fields),
    /// A value of the pack.
    Quantity(Quantity, Part, fn(&R) -> &RecordedPackValues),
}

impl<R> Column<R> {
    pub(super) fn value<'r>(&self, row: &'r R) -> FieldValue<'r> {
        match self.source {
            ColumnSource::Value(value) => value(row),
            ColumnSource::Field(fields) => FieldValue::Real(fields(row).number(self.name)),
            ColumnSource::Quantity(quantity, part, values) => {
                FieldValue::Real(values(row).get(quantity).and_then(|value| value.part(part)))
            }
        }
    }
}

/// Defines columns. Each line states name, kind, unit, `null` if the value is optional, meaning and value.
macro_rules! columns {
    ($row:ty; $( $name:literal $kind:ident $unit:literal $($null:ident)?, $about:literal, $get:expr; )+) => {
        [$( Column::<$row> {
            name: $name,
            unit: $unit,
            kind: ColumnType::$kind,
            optional: columns!(@ $($null)?),
            about: $about,
            source: ColumnSource::Value($get),
        }, )+]
    };
    (@ null) => { true };
    (@) => { false };
}

pub(super) const ESTIMATES: &[Column<EstimateRow>] = &columns! { EstimateRow;
    "log" Word "", "name of the log and of its folder", |row| text(&row.log);
    "time" Time "UTC", "time of the voltage reading", |row| FieldValue::Time(row.estimate.time);
    "since_start_s" Real "s", "time since the log's first result", |row| real(row.since_s);
    "cell" Whole "", "cell, from 0", |row| whole(row.estimate.cell.0);
    "soc" Real "fraction" null, "state of charge", |row| real(row.estimate.soc);
    "soc_std" Real "fraction" null, "its standard deviation", |row| real(row.estimate.soc_std);
    "u1_v" Real "V" null, "voltage of the first RC branch", |row| branch(row, 0);
    "u2_v" Real "V" null, "voltage of the second branch, if the model has one", |row| branch(row, 1);
    "u3_v" Real "V" null, "voltage of the third branch, if the model has one", |row| branch(row, 2);
    "capacity_ah" Real "Ah" null, "learned capacity: charge between the full and the empty open-circuit voltage", |row| real(row.estimate.capacity_ah);
    "capacity_std_ah" Real "Ah" null, "its standard deviation", |row| real(row.estimate.capacity_std_ah);
    "resistance_ratio" Real "" null, "resistance relative to new", |row| real(row.estimate.resistance_ratio);
    "resistance_ratio_std" Real "" null, "its standard deviation", |row| real(row.estimate.resistance_ratio_std);
    "innovation_v" Real "V" null, "measured minus predicted voltage", |row| real(row.estimate.innovation_v);
    "innovation_std_v" Real "V" null, "its predicted standard deviation", |row| real(row.estimate.innovation_std_v);
    "accepted" Flag "", "whether the reading changed the estimate", |row| FieldValue::Flag(row.estimate.accepted);
    "voltage_v" Real "V" null, "voltage used", |row| real(row.estimate.measured.voltage_v);
    "current_a" Real "A" null, "cell current used, positive = discharge", |row| real(row.estimate.measured.current_a);
    "temperature_c" Real "degrees C" null, "temperature used", |row| real(row.estimate.measured.temperature_c);
};

pub(super) static HALF_CYCLES: LazyLock<Vec<Column<HalfCycleRow>>> = LazyLock::new(|| {
    let half_cycle = columns! { HalfCycleRow;
        "log" Word "", "name of the log and of its folder", |row| text(&row.log);
        "time" Time "UTC", "end of the half-cycle", |row| FieldValue::Time(row.time);
        "since_start_s" Real "s", "time since the log's first result", |row| real(row.since_s);
        "cell" Whole "", "cell, from 0", |row| FieldValue::Whole(row.half.whole("cell"));
        "full_cycles" Real "cycles" null, "equivalent full cycles of the connected pack so far: charge moved divided by twice the rated capacity", |row| real(row.full_cycles);
        "mode" Word "", "charge or discharge", |row| text(row.half.text("mode"));
        "charge_ah" Real "Ah", "charge moved", |row| number(&row.half, "charge_ah");
        "swing" Real "fraction" null, "change of the state of charge, from the voltages", |row| number(&row.half, "swing");
        "swing_std" Real "fraction" null, "its standard deviation", |row| number(&row.half, "swing_std");
        "duration_s" Real "s", "duration", |row| number(&row.half, "duration_s");
        "mean_current_a" Real "A", "mean cell current, positive = discharge", |row| number(&row.half, "mean_current_a");
        "mean_temperature_c" Real "degrees C" null, "mean temperature", |row| number(&row.half, "mean_temperature_c");
        "measured_ah" Real "Ah" null, "capacity measured in this half-cycle alone", |row| number(&row.capacity, "measured_ah");
        "measured_std_ah" Real "Ah" null, "its standard deviation", |row| number(&row.capacity, "measured_std_ah");
    };
    let forecast = columns! { HalfCycleRow;
        "lli" Real "fraction" null, "loss of lithium inventory, relative to the model's new cell; null = not learned, or a model without electrodes", |row| loss(row, |it| it.lithium.mean);
        "lli_std" Real "fraction" null, "its standard deviation", |row| loss(row, |it| it.lithium.std());
        "lam_ne" Real "fraction" null, "loss of active material of the negative electrode", |row| loss(row, |it| it.negative.mean);
        "lam_ne_std" Real "fraction" null, "its standard deviation", |row| loss(row, |it| it.negative.std());
        "lam_pe" Real "fraction" null, "loss of active material of the positive electrode", |row| loss(row, |it| it.positive.mean);
        "lam_pe_std" Real "fraction" null, "its standard deviation", |row| loss(row, |it| it.positive.std());
        "remaining_cycles" Real "cycles" null, "equivalent full cycles (as full_cycles) until the cell's end of life, median; null = too little is known", |row| cycles(row, |left| left.median);
        "remaining_cycles_low" Real "cycles" null, "its 5 % quantile", |row| cycles(row, |left| left.low);
        "remaining_cycles_high" Real "cycles" null, "its 95 % quantile", |row| cycles(row, |left| left.high);
        "remaining_days" Real "days" null, "days until the cell's end of life at the recent rate of use: median", |row| days(row, |left| left.median);
        "remaining_days_low" Real "days" null, "its 5 % quantile", |row| days(row, |left| left.low);
        "remaining_days_high" Real "days" null, "its 95 % quantile", |row| days(row, |left| left.high);
    };
    half_cycle.into_iter().chain(RECORDED.into_iter().flat_map(recorded)).chain(forecast).collect()
});

fn recorded(quantity: Quantity) -> impl Iterator<Item = Column<HalfCycleRow>> {
    let about = quantity.row().cell.map_or("", |it| it.about);
    columns_of(quantity, about, |_, _| ColumnSource::Field(|row: &HalfCycleRow| &row.capacity))
}

fn columns_of<R>(
    quantity: Quantity,
    about: &'static str,
    source: impl Fn(Quantity, Part) -> ColumnSource<R>,
) -> impl Iterator<Item = Column<R>> {
    let row = quantity.row();
    row.parts().map(move |(part, name)| Column {
        name,
        unit: row.unit.symbol(),
        kind: ColumnType::Real,
        optional: true,
        about: if part == Part::Std { "its standard deviation" } else { about },
        source: source(quantity, part),
    })
}

pub(super) static OUTLOOK: LazyLock<Vec<Column<OutlookRow>>> = LazyLock::new(|| {
    let moment = columns! { OutlookRow;
        "log" Word "", "name of the log and of its folder", |row| text(&row.log);
        "time" Time "UTC", "end of the half-cycle", |row| FieldValue::Time(row.time);
        "since_start_s" Real "s", "time since the log's first result", |row| real(row.since_s);
    };
    let values = RECORDED_OF_PACK.into_iter().flat_map(|quantity| {
        let about = quantity.row().pack.map_or("", |it| it.about);
        columns_of(quantity, about, |quantity, part| {
            ColumnSource::Quantity(quantity, part, |row: &OutlookRow| &row.values)
        })
    });
    moment.into_iter().chain(values).collect()
});

pub(super) const ALARMS: &[Column<AlarmRow>] = &columns! { AlarmRow;
    "log" Word "", "name of the log and of its folder", |row| text(&row.log);
    "time" Time "UTC", "time of the change", |row| FieldValue::Time(row.time);
    "since_start_s" Real "s", "time since the log's first result", |row| real(row.since_s);
    "cell" Whole "" null, "cell, from 0; null = the pack", |row| FieldValue::Whole(row.alarm.whole("cell"));
    "rule" Word "", "rule of the alarm", |row| text(row.rule.name());
    "severity" Word "", "info, warning or severe", |row| text(row.alarm.text("severity"));
    "change" Word "", "change: raised, cleared, ...", |row| text(row.alarm.text("change"));
    "state" Word "", "state of the alarm after the change", |row| text(row.alarm.text("state"));
    "active" Flag "", "whether the alarm is raised after the change", |row| FieldValue::Flag(row.alarm.flag("active"));
    "value" Real "unit" null, "value that caused the change", |row| FieldValue::Real(row.alarm.number("value"));
    "probability" Real "fraction" null, "probability that the true value is beyond the threshold", |row| FieldValue::Real(row.alarm.number("probability"));
    "threshold" Real "unit", "threshold that the value is compared with", |row| FieldValue::Real(row.alarm.number("threshold"));
    "unit" Word "", "unit of value and threshold; empty for fractions and ratios", |row| text(row.rule.spec().unit.symbol());
    "occurrences" Whole "", "number of times that the alarm was raised", |row| FieldValue::Whole(row.alarm.whole("occurrences"));
    "acknowledged" Flag "", "whether the alarm was acknowledged", |row| FieldValue::Flag(row.alarm.flag("acknowledged"));
};

pub(super) const USE_RECORD: &[Column<UseRow>] = &columns! { UseRow;
    "log" Word "", "name of the log and of its folder", |row| text(&row.log);
    "counter" Word "", "path of the number in the record of use, with its unit", |row| text(&row.counter);
    "value" Real "unit", "number at the end of the log", |row| real(row.value);
};

/// Columns of `vehicles`, which [`merge`](super::merge) writes.
pub(super) const VEHICLES: &[Column<VehicleRecord>] = &columns! { VehicleRecord;
    "log" Word "", "name of the vehicle, as in the other tables", |row| text(&row.line.vehicle);
    "logs" Whole "", "number of its logs", |row| FieldValue::Whole(u32::try_from(row.line.logs.len()).ok());
    "bytes" Real "bytes", "size of its logs", |row| real(row.line.bytes as f64);
    "cells" Whole "", "cells of the pack; 0 = the configuration cannot be read", |row| FieldValue::Whole(Some(row.cells));
    "days" Real "days", "time from the first stamp to the last", |row| real(row.days);
    "half_cycles" Whole "", "rows in half_cycles", |row| rows_in(row, "half_cycles");
    "alarms" Whole "", "rows in alarms", |row| rows_in(row, "alarms");
    "estimates" Whole "", "rows in estimates", |row| rows_in(row, "estimates");
    "rated_ah" Real "Ah" null, "rated capacity of a cell", |row| maybe(row.rated_ah);
    "settings_sha256" Word "" null, "SHA-256 of all settings: configuration, DBC, cell model, options", |row| FieldValue::Word(row.settings_sha256.as_deref().map(Cow::Borrowed));
    "error" Word "" null, "reason why the other tables have no rows of this vehicle; null = the vehicle was replayed", |row| FieldValue::Word(row.error.as_deref().map(Cow::Borrowed));
    "notes" Word "" null, "notes on its logs", |row| FieldValue::Word(Some(row.notes.join("; ").into()).filter(|_| !row.notes.is_empty()));
};

fn rows_in<'r>(row: &VehicleRecord, table: &str) -> FieldValue<'r> {
    let rows = row.rows.get(table).copied().unwrap_or(0);
    FieldValue::Whole(Some(u32::try_from(rows).unwrap_or(u32::MAX)))
}

fn real<'r>(value: f64) -> FieldValue<'r> {
    FieldValue::Real(Some(value).filter(|value| value.is_finite()))
}

fn maybe<'r>(value: Option<f64>) -> FieldValue<'r> {
    FieldValue::Real(value.filter(|value| value.is_finite()))
}

fn number<'r>(fields: &Fields, name: &str) -> FieldValue<'r> {
    FieldValue::Real(fields.number(name))
}

fn whole<'r>(value: u16) -> FieldValue<'r> {
    FieldValue::Whole(Some(value.into()))
}

fn text(value: &str) -> FieldValue<'_> {
    FieldValue::Word(Some(value.into()))
}

fn branch(row: &EstimateRow, index: usize) -> FieldValue<'_> {
    maybe(row.estimate.branch_v.get(index).copied())
}

fn loss(row: &HalfCycleRow, get: fn(&LossModes) -> f64) -> FieldValue<'_> {
    maybe(row.losses.as_ref().map(get))
}

fn cycles(row: &HalfCycleRow, get: fn(Remaining) -> f64) -> FieldValue<'_> {
    maybe(row.remaining.and_then(|life| life.cycles).map(get))
}

fn days(row: &HalfCycleRow, get: fn(Remaining) -> f64) -> FieldValue<'_> {
    maybe(row.remaining.and_then(|life| life.days).map(get))
}

/// Returns the reference page of the columns as Markdown.
pub fn reference() -> String {
    let mut page = String::from(
        "# Exported tables\n\nWritten by `packwatch export --columns-page`; the exported files use the same definition. An unknown value is null \
         (an empty field in CSV). `log` is dictionary-encoded: it takes almost no space and identifies the log in a query over all files.\n",
    );
    page += &section(
        "estimates",
        "An estimate of a cell, at most one per cell and `--period`: the first of each period since the log's start.",
        ESTIMATES,
    );
    page += &section(
        "half_cycles",
        "A charge or discharge of a cell, what was learned from it, and the cell's remaining life after it.",
        &HALF_CYCLES,
    );
    page += &section(
        "outlook",
        "Energy and power of the pack after a charge or discharge, while they are known.",
        &OUTLOOK,
    );
    page += &section("alarms", "A change of an alarm.", ALARMS);
    page += &section(
        "use_record",
        "A known number of the record of use (`use_record` in the status document) of the pack that is connected at the end of the log.",
        USE_RECORD,
    );
    page += &section("vehicles", "A vehicle of a fleet, written by `packwatch fleet merge`.", VEHICLES);
    page
}

fn section<R>(name: &str, about: &str, columns: &[Column<R>]) -> String {
    let mut text = format!(
        "\n## {name}\n\n{about}\n\n| column | type | unit | null | meaning |\n| --- | --- | --- | --- | --- |\n"
    );
    for column in columns {
        let null = if column.optional { "yes" } else { "" };
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "| `{}` | {} | {} | {null} | {} |",
            column.name,
            column.kind.name(),
            column.unit,
            column.about
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names<R>(columns: &[Column<R>]) -> Vec<&'static str> {
        columns.iter().map(|column| column.name).collect()
    }

    #[test]
    fn column_names_are_unique_and_state_the_unit() {
        for names in [names(ESTIMATES), names(&HALF_CYCLES), names(&OUTLOOK), names(ALARMS)] {
            assert!(names.iter().enumerate().all(|(index, name)| !names[..index].contains(name)));
        }
        let units = ESTIMATES.iter().map(|c| (c.name, c.unit)).chain(HALF_CYCLES.iter().map(|c| (c.name, c.unit)));
        for (name, unit) in units {
            for (ending, named) in [("_ah", "Ah"), ("_v", "V"), ("_a", "A"), ("_c", "degrees C"), ("_s", "s")] {
                assert_eq!(name.ends_with(ending), unit == named, "{name}: {unit}");
            }
        }
    }

    #[test]
    fn every_estimated_branch_has_a_column() {
        let branches = names(ESTIMATES).iter().filter(|name| name.starts_with('u') && name.ends_with("_v")).count();
        assert_eq!(branches, crate::cell::MAX_BRANCHES);
    }
}
