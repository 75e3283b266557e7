//! Signals of VSS itself, with its names, datatypes and units (releases 3 to 6).
//!
//! Left out, because the status document cannot say it: `NetCapacity` and `GrossCapacity` (whole kWh; the daemon learns Ah),
//! `StateOfCharge.CurrentEnergy` and the energies (no energy is estimated), the throughputs "over lifetime of the battery" (the daemon
//! knows its own time only), `StateOfCharge.Displayed` (what the customer sees), `Charging.IsCharging` (true only with a charger; a
//! drive brakes into the battery too).

use packwatch_host::status::document::{CellStatus, StatusDocument};

use super::super::value::{DataType, Value};
use super::{Origin, Signal, alarm_codes, cell_numbers, cells, float, negated, percent};

const fn signal(
    name: &'static str,
    data_type: DataType,
    unit: Option<&'static str>,
    fields: &'static str,
    value: fn(&StatusDocument) -> Option<Value>,
    description: &'static str,
) -> Signal {
    Signal { name, origin: Origin::Standard, data_type, unit, description, fields, value }
}

pub(super) static SIGNALS: &[Signal] = &[
    signal(
        "CurrentVoltage",
        DataType::Float,
        Some("V"),
        "pack.voltage_v",
        |status| float(status.pack.voltage_v),
        "Sum of the cells",
    ),
    signal(
        "CurrentCurrent",
        DataType::Float,
        Some("A"),
        "pack.current_a",
        |status| float(negated(status.pack.current_a)),
        "Positive = into the battery",
    ),
    signal(
        "CurrentPower",
        DataType::Float,
        Some("W"),
        "pack.voltage_v, pack.current_a",
        |status| {
            float(
                negated(status.pack.current_a)
                    .zip(status.pack.voltage_v)
                    .map(|(current_a, voltage_v)| current_a * voltage_v),
            )
        },
        "Positive = into the battery",
    ),
    signal(
        "Temperature.Average",
        DataType::Float,
        Some("Celsius"),
        "cells.temperature_c",
        |status| float(mean(status, |cell| cell.temperature_c)),
        "Of all cells",
    ),
    signal(
        "Temperature.Min",
        DataType::Float,
        Some("Celsius"),
        "cells.temperature_c",
        |status| lowest(status, |cell| cell.temperature_c).map(|(_, value)| Value::Float(value)),
        "Of all cells",
    ),
    signal(
        "Temperature.Max",
        DataType::Float,
        Some("Celsius"),
        "pack.temperature_max_c",
        |status| float(status.pack.temperature_max_c),
        "Of all cells",
    ),
    signal(
        "Temperature.CellTemperature",
        DataType::Floats,
        None,
        "cells.temperature_c",
        |status| cells(status, |cell| cell.temperature_c),
        "°C, each cell's sensor",
    ),
    signal(
        "CellVoltage.Min",
        DataType::Float,
        Some("V"),
        "cells.voltage_v",
        |status| lowest(status, |cell| cell.voltage_v).map(|(_, value)| Value::Float(value)),
        "Of all cells",
    ),
    signal(
        "CellVoltage.IdMin",
        DataType::Uint16,
        None,
        "cells.voltage_v",
        |status| lowest(status, |cell| cell.voltage_v).map(|(cell, _)| Value::Uint16(cell)),
        "First cell with that voltage, from 0",
    ),
    signal(
        "CellVoltage.Max",
        DataType::Float,
        Some("V"),
        "cells.voltage_v",
        |status| highest(status, |cell| cell.voltage_v).map(|(_, value)| Value::Float(value)),
        "Of all cells",
    ),
    signal(
        "CellVoltage.IdMax",
        DataType::Uint16,
        None,
        "cells.voltage_v",
        |status| highest(status, |cell| cell.voltage_v).map(|(cell, _)| Value::Uint16(cell)),
        "First cell with that voltage, from 0",
    ),
    signal(
        "CellVoltage.CellVoltages",
        DataType::Floats,
        None,
        "cells.voltage_v",
        |status| cells(status, |cell| cell.voltage_v),
        "V, each cell",
    ),
    signal(
        "StateOfCharge.Current",
        DataType::Float,
        Some("percent"),
        "pack.soc",
        |status| percent(status.pack.soc),
        "Of the limiting cell",
    ),
    signal(
        "StateOfHealth",
        DataType::Float,
        Some("percent"),
        "pack.soh",
        |status| percent(status.pack.soh),
        "Learned capacity over rated capacity. VSS allows 0 to 100: a cell with more than its rated capacity gives no value here",
    ),
    signal(
        "ErrorCodes",
        DataType::Texts,
        None,
        "alarms",
        alarm_codes,
        "Raised alarms, `RULE:SEVERITY` or `RULE:SEVERITY:cell3`. Empty only when every threshold was judged",
    ),
];

fn lowest(status: &StatusDocument, value: fn(&CellStatus) -> Option<f64>) -> Option<(u16, f32)> {
    extreme(status, value, |candidate, best| candidate < best)
}

fn highest(status: &StatusDocument, value: fn(&CellStatus) -> Option<f64>) -> Option<(u16, f32)> {
    extreme(status, value, |candidate, best| candidate > best)
}

/// The first cell whose value no other one beats, and that value; `None` while the value of a cell is unknown.
fn extreme(
    status: &StatusDocument,
    value: fn(&CellStatus) -> Option<f64>,
    beats: fn(f32, f32) -> bool,
) -> Option<(u16, f32)> {
    let numbers = cell_numbers(status, value)?;
    (0..).zip(numbers).reduce(|best, candidate| if beats(candidate.1, best.1) { candidate } else { best })
}

fn mean(status: &StatusDocument, value: fn(&CellStatus) -> Option<f64>) -> Option<f64> {
    let numbers: Vec<f64> = status.cells.iter().map(value).collect::<Option<_>>()?;
    let count = u32::try_from(numbers.len()).ok().filter(|count| *count > 0)?;
    Some(numbers.iter().sum::<f64>() / f64::from(count))
}
