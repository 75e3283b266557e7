//! The columns of the exported tables: name, type, unit, meaning and value, once.
//!
//! The writers, the schema of the Parquet files and the page `config/EXPORT.md` all come from these lines. A value that is
//! not known is null (an empty field in CSV), never NaN. Cells count from 0, current is positive for discharge.

use std::borrow::Cow;
use std::fmt::Write as _;
use std::sync::Arc;

use serde::Serialize;

use crate::alarm::{Change, Rule, Severity, State};
use crate::monitor::{Estimate, Event, EventKind};
use crate::quantity::{CellIndex, Mode, Timestamp};

/// Type of a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// A moment: microseconds since 1970, UTC; in CSV like 2008-04-02T13:08:17.921000Z.
    Time,
    /// A number.
    Real,
    /// A whole number, 0 or more.
    Whole,
    /// Yes or no.
    Flag,
    /// One of a few words, or a name.
    Word,
}

impl Kind {
    /// In a Parquet schema.
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

/// A value; `None` inside = not known.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Field<'r> {
    Time(Timestamp),
    Real(Option<f64>),
    Whole(Option<u32>),
    Flag(bool),
    Word(Option<Cow<'r, str>>),
}

/// A column of a table with rows `R`.
pub(super) struct Column<R> {
    pub(super) name: &'static str,
    pub(super) unit: &'static str,
    pub(super) kind: Kind,
    /// Whether it may be null.
    pub(super) optional: bool,
    pub(super) about: &'static str,
    pub(super) get: for<'r> fn(&'r R) -> Field<'r>,
}

/// An estimate of a cell.
pub(super) struct EstimateRow {
    pub(super) log: Arc<str>,
    pub(super) since_s: f64,
    pub(super) estimate: Estimate,
}

/// A half-cycle of a cell, and what was learned from it.
pub(super) struct HalfCycleRow {
    pub(super) log: Arc<str>,
    pub(super) since_s: f64,
    pub(super) cell: CellIndex,
    pub(super) cycles: f64,
    pub(super) half_cycle: Event,
    pub(super) capacity: Event,
}

/// Something that became of an alarm.
pub(super) struct AlarmRow {
    pub(super) log: Arc<str>,
    pub(super) since_s: f64,
    pub(super) event: Event,
}

/// Columns: name, kind, unit, `null` where it may be, meaning, value.
macro_rules! columns {
    ($row:ty; $( $name:literal $kind:ident $unit:literal $($null:ident)?, $about:literal, $get:expr; )+) => {
        &[$( Column::<$row> {
            name: $name,
            unit: $unit,
            kind: Kind::$kind,
            optional: columns!(@ $($null)?),
            about: $about,
            get: $get,
        }, )+]
    };
    (@ null) => { true };
    (@) => { false };
}

/// Of `estimates`.
pub(super) const ESTIMATES: &[Column<EstimateRow>] = columns! { EstimateRow;
    "log" Word "", "name of the log, that of its folder", |row| text(&row.log);
    "time" Time "UTC", "when the voltage was read", |row| Field::Time(row.estimate.time);
    "since_start_s" Real "s", "the same since the log's first result", |row| real(row.since_s);
    "cell" Whole "", "cell, from 0", |row| whole(row.estimate.cell.0);
    "soc" Real "fraction" null, "state of charge", |row| real(row.estimate.soc);
    "soc_std" Real "fraction" null, "its standard deviation", |row| real(row.estimate.soc_std);
    "u1_v" Real "V" null, "voltage of the first RC branch", |row| branch(row, 0);
    "u2_v" Real "V" null, "of the second, where the model has one", |row| branch(row, 1);
    "u3_v" Real "V" null, "of the third, where the model has one", |row| branch(row, 2);
    "capacity_ah" Real "Ah" null, "learned capacity between the open-circuit voltages", |row| real(row.estimate.capacity_ah);
    "capacity_std_ah" Real "Ah" null, "its standard deviation", |row| real(row.estimate.capacity_std_ah);
    "resistance_ratio" Real "" null, "resistance relative to new", |row| real(row.estimate.resistance_ratio);
    "resistance_ratio_std" Real "" null, "its standard deviation", |row| real(row.estimate.resistance_ratio_std);
    "innovation_v" Real "V" null, "measured minus predicted voltage", |row| real(row.estimate.innovation_v);
    "innovation_std_v" Real "V" null, "its predicted standard deviation", |row| real(row.estimate.innovation_std_v);
    "accepted" Flag "", "whether the reading moved the estimate", |row| Field::Flag(row.estimate.accepted);
    "voltage_v" Real "V" null, "voltage used", |row| real(row.estimate.voltage_v);
    "current_a" Real "A" null, "cell current used, positive = discharge", |row| real(row.estimate.current_a);
    "temperature_c" Real "degrees C" null, "temperature used", |row| real(row.estimate.temperature_c);
};

/// Of `half_cycles`.
pub(super) const HALF_CYCLES: &[Column<HalfCycleRow>] = columns! { HalfCycleRow;
    "log" Word "", "name of the log, that of its folder", |row| text(&row.log);
    "time" Time "UTC", "when it was over", |row| Field::Time(row.half_cycle.time);
    "since_start_s" Real "s", "the same since the log's first result", |row| real(row.since_s);
    "cell" Whole "", "cell, from 0", |row| whole(row.cell.0);
    "full_cycles" Real "" null, "equivalent full cycles so far: charge moved over twice the rated capacity", |row| real(row.cycles);
    "mode" Word "", "charge or discharge", |row| half_cycle(row, |half| word(&half.mode));
    "charge_ah" Real "Ah", "charge moved", |row| half_cycle(row, |half| real(half.charge_ah));
    "swing" Real "fraction" null, "swing of the state of charge that the voltages tell", |row| half_cycle(row, |half| maybe(half.swing));
    "swing_std" Real "fraction" null, "its standard deviation", |row| half_cycle(row, |half| maybe(half.swing_std));
    "duration_s" Real "s", "duration", |row| half_cycle(row, |half| real(half.duration_s));
    "mean_current_a" Real "A", "mean cell current, positive = discharge", |row| half_cycle(row, |half| real(half.mean_current_a));
    "mean_temperature_c" Real "degrees C" null, "mean temperature", |row| half_cycle(row, |half| maybe(half.mean_temperature_c));
    "measured_ah" Real "Ah" null, "capacity by this half-cycle alone", |row| capacity(row, |told| told.0[0]);
    "measured_std_ah" Real "Ah" null, "its standard deviation", |row| capacity(row, |told| told.0[1]);
    "capacity_ah" Real "Ah", "learned capacity after it", |row| capacity(row, |told| told.0[2]);
    "capacity_std_ah" Real "Ah", "its standard deviation", |row| capacity(row, |told| told.0[3]);
    "usable_capacity_ah" Real "Ah" null, "usable capacity at the load of [usable]", |row| capacity(row, |told| told.0[4]);
    "usable_capacity_std_ah" Real "Ah" null, "its standard deviation", |row| capacity(row, |told| told.0[5]);
    "resistance_ratio" Real "", "resistance relative to new", |row| capacity(row, |told| told.0[6]);
    "resistance_ratio_std" Real "", "its standard deviation", |row| capacity(row, |told| told.0[7]);
};

/// Of `alarms`.
pub(super) const ALARMS: &[Column<AlarmRow>] = columns! { AlarmRow;
    "log" Word "", "name of the log, that of its folder", |row| text(&row.log);
    "time" Time "UTC", "when", |row| Field::Time(row.event.time);
    "since_start_s" Real "s", "the same since the log's first result", |row| real(row.since_s);
    "cell" Whole "" null, "cell, from 0; null = the pack", |row| alarm(row, |told| Field::Whole(told.cell.map(|cell| cell.0.into())));
    "rule" Word "", "what it is about", |row| alarm(row, |told| Field::Word(Some(told.rule.name().into())));
    "severity" Word "", "info, warning or severe", |row| alarm(row, |told| Field::Word(Some(told.severity.name().into())));
    "change" Word "", "what became of it: raised, cleared, ...", |row| alarm(row, |told| word(&told.change));
    "state" Word "", "where it is in its life now", |row| alarm(row, |told| word(&told.state));
    "active" Flag "", "whether it is raised now", |row| alarm(row, |told| Field::Flag(told.active));
    "value" Real "unit" null, "the value that decided", |row| alarm(row, |told| maybe(told.value));
    "probability" Real "fraction" null, "that the truth is beyond the threshold", |row| alarm(row, |told| maybe(told.probability));
    "threshold" Real "unit", "what it is compared with", |row| alarm(row, |told| real(told.threshold));
    "unit" Word "", "unit of value and threshold; empty for fractions and ratios", |row| alarm(row, |told| Field::Word(Some(told.rule.row().unit.symbol().into())));
    "occurrences" Whole "", "times it was raised", |row| alarm(row, |told| Field::Whole(Some(told.occurrences)));
    "acknowledged" Flag "", "whether somebody has seen it since", |row| alarm(row, |told| Field::Flag(told.acknowledged));
};

fn real<'r>(value: f64) -> Field<'r> {
    Field::Real(Some(value).filter(|value| value.is_finite()))
}

fn maybe<'r>(value: Option<f64>) -> Field<'r> {
    Field::Real(value.filter(|value| value.is_finite()))
}

fn whole<'r>(value: u16) -> Field<'r> {
    Field::Whole(Some(value.into()))
}

fn text(value: &str) -> Field<'_> {
    Field::Word(Some(value.into()))
}

/// A choice as events and configurations write it.
fn word<'r>(value: &impl Serialize) -> Field<'r> {
    let word = serde_json::to_value(value).ok();
    Field::Word(word.and_then(|word| word.as_str().map(|word| word.to_owned().into())))
}

fn branch(row: &EstimateRow, index: usize) -> Field<'_> {
    maybe(row.estimate.branch_v.get(index).copied())
}

/// What a half-cycle told, under names of its own.
struct Half {
    mode: Mode,
    charge_ah: f64,
    swing: Option<f64>,
    swing_std: Option<f64>,
    duration_s: f64,
    mean_current_a: f64,
    mean_temperature_c: Option<f64>,
}

fn half_cycle(row: &HalfCycleRow, get: fn(Half) -> Field<'static>) -> Field<'_> {
    match row.half_cycle.kind {
        EventKind::HalfCycle {
            mode,
            charge_ah,
            swing,
            swing_std,
            duration_s,
            mean_current_a,
            mean_temperature_c,
            ..
        } => get(Half { mode, charge_ah, swing, swing_std, duration_s, mean_current_a, mean_temperature_c }),
        _ => Field::Real(None),
    }
}

/// Measured, learned, usable, resistance, each with its standard deviation.
struct Told([Option<f64>; 8]);

fn capacity(row: &HalfCycleRow, get: fn(Told) -> Option<f64>) -> Field<'_> {
    let EventKind::Capacity {
        measured_ah,
        measured_std_ah,
        capacity_ah,
        capacity_std_ah,
        usable_capacity_ah,
        usable_capacity_std_ah,
        resistance_ratio,
        resistance_ratio_std,
        ..
    } = row.capacity.kind
    else {
        return Field::Real(None);
    };
    maybe(get(Told([
        measured_ah,
        measured_std_ah,
        Some(capacity_ah),
        Some(capacity_std_ah),
        usable_capacity_ah,
        usable_capacity_std_ah,
        Some(resistance_ratio),
        Some(resistance_ratio_std),
    ])))
}

/// What became of an alarm.
struct AlarmTold {
    rule: Rule,
    cell: Option<CellIndex>,
    change: Change,
    state: State,
    active: bool,
    severity: Severity,
    value: Option<f64>,
    probability: Option<f64>,
    threshold: f64,
    occurrences: u32,
    acknowledged: bool,
}

fn alarm(row: &AlarmRow, get: fn(AlarmTold) -> Field<'static>) -> Field<'_> {
    match row.event.kind {
        EventKind::Alarm {
            rule,
            cell,
            change,
            state,
            active,
            severity,
            value,
            probability,
            threshold,
            occurrences,
            acknowledged,
        } => get(AlarmTold {
            rule,
            cell,
            change,
            state,
            active,
            severity,
            value,
            probability,
            threshold,
            occurrences,
            acknowledged,
        }),
        _ => Field::Real(None),
    }
}

/// The page about the columns, as Markdown.
pub(crate) fn reference() -> String {
    let mut page = String::from(
        "# Exported tables\n\nWritten by `packwatch export --columns-page`; the files are written from the same definition. A value that is not known is null \
         (an empty field in CSV). `log` is dictionary-encoded: it costs next to nothing, and tells logs apart in a query over all files.\n",
    );
    page += &section(
        "estimates",
        "An estimate of a cell, at most one per cell and `--period`: the first of each period since the log's start.",
        ESTIMATES,
    );
    page += &section("half_cycles", "A charge or discharge of a cell, and what was learned from it.", HALF_CYCLES);
    page += &section("alarms", "Something that became of an alarm.", ALARMS);
    page
}

fn section<R>(name: &str, about: &str, columns: &[Column<R>]) -> String {
    let mut text = format!(
        "\n## {name}\n\n{about}\n\n| column | type | unit | null | meaning |\n| --- | --- | --- | --- | --- |\n"
    );
    for column in columns {
        let null = if column.optional { "yes" } else { "" };
        // Writing to a text cannot fail.
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
    fn every_column_has_a_name_of_its_own_and_the_unit_its_name_says() {
        for names in [names(ESTIMATES), names(HALF_CYCLES), names(ALARMS)] {
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
