//! Defines the signals outside the catalogue of quantities. These signals are derived from several values, from the
//! alarms, or from the state of the daemon.
//!
//! VSS signals have the names, datatypes and units of releases 3 to 6. These VSS signals are omitted, because the
//! status document has no value for them:
//!
//! * `NetCapacity` and `GrossCapacity`: whole kWh, but the daemon learns Ah.
//! * `StateOfCharge.Displayed`: the value that the vehicle shows to the customer.
//! * `Charging.IsCharging`: true only with a charger, but the daemon's mode `charge` includes braking.
//!
//! The throughputs "over lifetime of the battery" are provided only if `kuksa.recorded_from_new` states that the daemon
//! has run since the battery was new, because the daemon counts only while it runs.
//!
//! Overlay booleans begin with `Is`, as VSS recommends. No overlay signal has a temperature unit, because the unit's
//! name changed between VSS 5 and VSS 6. No overlay signal has a list of allowed values: the databroker (0.7) checks
//! even "no value" against such a list. It would reject "no value" and keep the last value.

use packwatch_host::quantity::catalogue::Quantity;
use packwatch_host::quantity::{CellIndex, Mode};
use packwatch_host::status::document::StatusDocument;
use serde::Serialize;

use super::super::value::{DataType, Value, single};
use super::{Origin, Signal, Source, of_cells};

/// A signal: path, datatype, unit, status fields, value, description.
type Row =
    (&'static str, DataType, Option<&'static str>, &'static str, fn(&StatusDocument) -> Option<Value>, &'static str);

/// Returns the signals; the VSS signals come first.
pub(super) fn signals() -> Vec<Signal> {
    let signal = |origin| {
        move |(name, data_type, unit, fields, value, description): Row| Signal {
            name: name.into(),
            origin,
            data_type,
            unit,
            description: description.into(),
            fields: fields.into(),
            source: Source::Document(value),
        }
    };
    let standard = STANDARD.into_iter().map(signal(Origin::Standard));
    standard.chain(OVERLAY.into_iter().map(signal(Origin::Overlay))).collect()
}

const STANDARD: [Row; 15] = [
    (
        "CurrentPower",
        DataType::Float,
        Some("W"),
        "pack.voltage_v, pack.current_a",
        |status| {
            let values = &status.pack.values;
            float(Some(0.0 - values.mean(Quantity::Current)? * values.mean(Quantity::Voltage)?))
        },
        "Positive = into the battery",
    ),
    (
        "Temperature.Average",
        DataType::Float,
        Some("Celsius"),
        "cells.temperature_c",
        |status| float(average(status, Quantity::Temperature)),
        "Of all cells",
    ),
    (
        "Temperature.Min",
        DataType::Float,
        Some("Celsius"),
        "cells.temperature_c",
        |status| float(status.least(Quantity::Temperature).map(|(_, celsius)| celsius)),
        "Of all cells",
    ),
    (
        "CellVoltage.Min",
        DataType::Float,
        Some("V"),
        "cells.voltage_v",
        |status| float(status.least(Quantity::Voltage).map(|(_, volts)| volts)),
        "Of all cells",
    ),
    (
        "CellVoltage.IdMin",
        DataType::Uint16,
        None,
        "cells.voltage_v",
        |status| cell(status.least(Quantity::Voltage).map(|(cell, _)| cell)),
        "First cell with that voltage, from 0",
    ),
    (
        "CellVoltage.Max",
        DataType::Float,
        Some("V"),
        "cells.voltage_v",
        |status| float(status.greatest(Quantity::Voltage).map(|(_, volts)| volts)),
        "Of all cells",
    ),
    (
        "CellVoltage.IdMax",
        DataType::Uint16,
        None,
        "cells.voltage_v",
        |status| cell(status.greatest(Quantity::Voltage).map(|(cell, _)| cell)),
        "First cell with that voltage, from 0",
    ),
    (
        "StateOfHealth",
        DataType::Float,
        Some("percent"),
        "pack.soh",
        |status| float(status.pack.values.mean(Quantity::Soh).map(|soh| 100.0 * soh)),
        "Learned capacity over rated capacity. VSS allows 0 to 100, so this signal has no value while the capacity is above the rated capacity",
    ),
    (
        "ErrorCodes",
        DataType::Texts,
        None,
        "alarms",
        alarm_codes,
        "Raised alarms, `RULE:SEVERITY` or `RULE:SEVERITY:cell3`. Empty only if every threshold was evaluated",
    ),
    (
        "TimeRemaining",
        DataType::Uint32,
        Some("s"),
        "pack.time_to_empty_s",
        |status| whole(status.pack.values.mean(Quantity::TimeToEmpty)?)?.try_into().ok().map(Value::Uint32),
        "At the recent load",
    ),
    (
        "AccumulatedChargedThroughput",
        DataType::Float,
        Some("Ah"),
        "pack.moved.charged_ah",
        |status| float(status.pack.moved.map(|moved| moved.charged_ah)),
        "Needs `kuksa.recorded_from_new`. Contains regenerative braking",
    ),
    (
        "AccumulatedConsumedThroughput",
        DataType::Float,
        Some("Ah"),
        "pack.moved.discharged_ah",
        |status| float(status.pack.moved.map(|moved| moved.discharged_ah)),
        "Needs `kuksa.recorded_from_new`",
    ),
    (
        "AccumulatedChargedEnergy",
        DataType::Float,
        Some("kWh"),
        "pack.moved.charged_wh",
        |status| float(status.pack.moved.map(|moved| moved.charged_wh / 1e3)),
        "Needs `kuksa.recorded_from_new`. Contains regenerative braking",
    ),
    (
        "AccumulatedConsumedEnergy",
        DataType::Float,
        Some("kWh"),
        "pack.moved.discharged_wh",
        |status| float(status.pack.moved.map(|moved| moved.discharged_wh / 1e3)),
        "Needs `kuksa.recorded_from_new`",
    ),
    (
        "TotalEnergyThroughput",
        DataType::Uint64,
        Some("Wh"),
        "pack.moved.charged_wh, pack.moved.discharged_wh",
        |status| whole(status.pack.moved.map(|moved| moved.charged_wh + moved.discharged_wh)?).map(Value::Uint64),
        "Needs `kuksa.recorded_from_new`",
    ),
];

const OVERLAY: [Row; 15] = [
    (
        "Validity",
        DataType::Text,
        None,
        "state",
        |status| word(Some(status.state)),
        "Whether the estimates can be used: unavailable, valid, degraded (coasting on stale inputs) or untrusted (the readings contradict the model).",
    ),
    (
        "Mode",
        DataType::Text,
        None,
        "pack.mode",
        |status| word(Some(status.pack.mode).filter(|mode| *mode != Mode::Unknown)),
        "Charge, rest or discharge, by the direction of the current. Regenerative braking counts as charge.",
    ),
    (
        "LimitingCell",
        DataType::Uint16,
        None,
        "pack.limiting_cell",
        |status| cell(status.pack.limiting_cell),
        "Cell that limits a discharge, counted from 0.",
    ),
    (
        "WeakestCell",
        DataType::Uint16,
        None,
        "pack.weakest_cell",
        |status| cell(status.pack.weakest_cell),
        "Cell with the least capacity, counted from 0.",
    ),
    (
        "IsAsleep",
        DataType::Flag,
        None,
        "asleep_since",
        |status| Some(Value::Flag(status.asleep_since.is_some())),
        "True while the buses sleep.",
    ),
    (
        "RemainingLife.Cell",
        DataType::Uint16,
        None,
        "pack.shortest_lived_cell",
        |status| cell(status.pack.shortest_lived_cell),
        "Cell whose life ends first, counted from 0.",
    ),
    (
        "CurrentSensor.IsFrozen",
        DataType::Flag,
        None,
        "current_frozen",
        |status| status.pack.values.get(Quantity::Current).map(|_| Value::Flag(status.current_frozen)),
        "True if the reading does not change although the voltages show a changing load.",
    ),
    (
        "Model.State",
        DataType::Text,
        None,
        "pack.model_state",
        |status| word(status.pack.model_state),
        "State of the cell model: prior, learning, learned, unfit (another chemistry explains the voltages better) or given (configured).",
    ),
    (
        "Model.BetterChemistry",
        DataType::Text,
        None,
        "pack.model_fits_better",
        |status| word(status.pack.model_fits_better),
        "Chemistry that explains the voltages better than the configured one; no value if there is none.",
    ),
    (
        "Alarms.Thresholds",
        DataType::Uint16,
        None,
        "alarms.thresholds",
        |status| count(status.alarms.thresholds),
        "Number of configured thresholds.",
    ),
    (
        "Alarms.Raised",
        DataType::Uint16,
        None,
        "alarms.raised",
        |status| count(status.alarms.raised),
        "Number of raised alarms.",
    ),
    (
        "Alarms.Unknown",
        DataType::Uint16,
        None,
        "alarms.unknown",
        |status| count(status.alarms.unknown.len()),
        "Number of thresholds that cannot be evaluated, because their value is unknown.",
    ),
    (
        "Alarms.HighestSeverity",
        DataType::Text,
        None,
        "alarms.highest_severity",
        |status| status.alarms.level().map(|word| Value::Text(word.to_owned())),
        "Highest severity of the raised alarms: info, warning or severe; none only if every threshold was evaluated.",
    ),
    (
        "Findings",
        DataType::Texts,
        None,
        "findings",
        findings,
        "Faults found in single cells and sensors: KIND, KIND:cell3 or KIND:cell3:cell7 (first and last cell, or the cells of a pair). Empty if nothing is reported.",
    ),
    (
        "Cells.IsTrusted",
        DataType::Flags,
        None,
        "cells.trusted",
        |status| of_cells(status, |cell| cell.trusted).map(Value::Flags),
        "Whether the filter of each cell is consistent.",
    ),
];

fn float(number: Option<f64>) -> Option<Value> {
    single(number).map(Value::Float)
}

fn cell(cell: Option<CellIndex>) -> Option<Value> {
    cell.map(|cell| Value::Uint16(cell.0))
}

fn count(count: usize) -> Option<Value> {
    count.try_into().ok().map(Value::Uint16)
}

/// Rounds to a whole number; `None` if the number is negative or above 1e15.
fn whole(number: f64) -> Option<u64> {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "the range is checked")]
    (0.0..=1e15).contains(&number).then(|| number.round() as u64)
}

/// Returns a word of the status document, spelled as in its JSON.
fn word(value: Option<impl Serialize>) -> Option<Value> {
    match serde_json::to_value(value?) {
        Ok(serde_json::Value::String(word)) => Some(Value::Text(word)),
        _ => None,
    }
}

fn average(status: &StatusDocument, quantity: Quantity) -> Option<f64> {
    let numbers = of_cells(status, |cell| cell.values.mean(quantity))?;
    Some(numbers.iter().sum::<f64>() / numbers.len() as f64)
}

/// Codes of the raised alarms: `RULE:SEVERITY`, for a cell `RULE:SEVERITY:cell3`. An empty list means that every
/// threshold was evaluated and no alarm is raised. If some threshold was not evaluated and no raised alarm is known,
/// returns `None`.
fn alarm_codes(document: &StatusDocument) -> Option<Value> {
    let alarms = &document.alarms;
    let raised = alarms.list.iter().filter(|alarm| alarm.state.is_raised());
    let codes: Vec<String> = raised
        .map(|alarm| {
            let cell = alarm.cell.map_or_else(String::new, |cell| format!(":cell{}", cell.0));
            format!("{}:{}{cell}", alarm.rule.name(), alarm.severity.name())
        })
        .collect();
    // An empty list means "no error", so it is sent only if every threshold was evaluated.
    let is_known = !codes.is_empty() || (alarms.raised == 0 && alarms.are_judged());
    is_known.then_some(Value::Texts(codes))
}

/// Codes of the findings. If the daemon has neither findings nor estimates, returns `None`, because an empty list would
/// look healthy.
fn findings(status: &StatusDocument) -> Option<Value> {
    let codes: Vec<String> = status
        .findings
        .iter()
        .map(|finding| match finding.cells {
            None => finding.kind.name().to_owned(),
            Some((first, last)) if first == last => format!("{}:cell{}", finding.kind.name(), first.0),
            Some((first, last)) => format!("{}:cell{}:cell{}", finding.kind.name(), first.0, last.0),
        })
        .collect();
    (!codes.is_empty() || status.pack.values.get(Quantity::Soc).is_some()).then_some(Value::Texts(codes))
}
