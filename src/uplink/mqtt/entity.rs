//! Defines the entities of a pack: key in `info`, name, unit and value. Most entities are rows of the catalogue of
//! quantities.
//!
//! Input: the daemon's status. Output: the values as JSON. If Battery-Emulator publishes the same quantity, the entity
//! has Battery-Emulator's key and name. As in Battery-Emulator, SOC and other fractions are published in percent, and
//! positive current and power mean charging. The daemon's current is therefore negated. Cells count from 1. Unknown
//! values are `null`, never a number.

use std::borrow::Cow;
use std::sync::LazyLock;

use packwatch_host::io::stamp::format_utc;
use packwatch_host::quantity::catalogue::{PackValues, Part, Quantity, Unit};
use packwatch_host::quantity::{CellIndex, Mode, Timestamp};
use packwatch_host::status::document::StatusDocument;
use serde::Serialize;
use serde_json::Value;

/// Kind of value of an entity.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A quantity with its unit and its device class in Home Assistant (empty = none), and its number of decimals.
    Measured {
        /// Unit.
        unit: &'static str,
        /// Device class.
        class: &'static str,
        /// Decimals.
        decimals: i32,
    },
    /// A count or a cell number.
    Number,
    /// A word.
    Word,
    /// A point in time, ISO 8601.
    Time,
}

/// One entity.
pub struct Entity {
    /// Key in `info`, and part of the identifiers in Home Assistant.
    pub key: Cow<'static, str>,
    /// Display name.
    pub name: Cow<'static, str>,
    /// Kind of value.
    pub kind: Kind,
    /// Whether the entity describes the daemon instead of the pack.
    pub is_diagnostic: bool,
    /// Whether Home Assistant shows the entity at once; otherwise the user turns it on.
    pub is_enabled: bool,
    source: Source,
}

enum Source {
    Document(fn(&StatusDocument) -> Value),
    Catalogue(Quantity, Part),
}

impl Entity {
    const fn new(key: &'static str, name: &'static str, kind: Kind, value: fn(&StatusDocument) -> Value) -> Self {
        let source = Source::Document(value);
        Self {
            key: Cow::Borrowed(key),
            name: Cow::Borrowed(name),
            kind,
            is_diagnostic: false,
            is_enabled: true,
            source,
        }
    }

    fn diagnostic(self) -> Self {
        Self { is_diagnostic: true, is_enabled: false, ..self }
    }

    /// The entity's value; `null` if unknown.
    pub fn value(&self, document: &StatusDocument) -> Value {
        match self.source {
            Source::Document(value) => value(document),
            Source::Catalogue(quantity, part) => published(quantity, part, document.pack.values.part(quantity, part)),
        }
    }
}

/// Formats a number of a quantity for publication; `null` if unknown.
pub fn published(quantity: Quantity, part: Part, value: Option<f64>) -> Value {
    let (Measure { decimals, .. }, factor) = measure(quantity.row().unit);
    let factor = if part == Part::Std { factor.abs() } else { factor };
    rounded(value.map(|value| factor * value), decimals)
}

/// A sum of energy that only grows.
const ENERGY: Kind = Kind::Measured { unit: "Wh", class: "energy", decimals: 0 };
/// Device class of a state of charge.
const BATTERY: &str = "battery";

struct Measure {
    unit: &'static str,
    class: &'static str,
    decimals: i32,
}

impl Measure {
    const fn kind(&self) -> Kind {
        let Self { unit, class, decimals } = *self;
        Kind::Measured { unit, class, decimals }
    }
}

/// How numbers with this unit are published, and the factor by which they are multiplied.
const fn measure(unit: Unit) -> (Measure, f64) {
    let (unit, class, decimals, factor) = match unit {
        Unit::Level | Unit::Fraction => ("%", "", 2, 100.0),
        Unit::Ratio => ("", "", 3, 1.0),
        Unit::Volts => ("V", "voltage", 3, 1.0),
        Unit::Amperes => ("A", "current", 3, -1.0),
        Unit::Celsius => ("°C", "temperature", 1, 1.0),
        Unit::AmpereHours => ("Ah", "", 3, 1.0),
        Unit::WattHours => ("Wh", "energy_storage", 0, 1.0),
        Unit::Watts => ("W", "power", 0, 1.0),
        Unit::Seconds => ("s", "duration", 0, 1.0),
        Unit::Days => ("d", "duration", 1, 1.0),
        Unit::Cycles => ("cycles", "", 1, 1.0),
        Unit::Count => ("", "", 0, 1.0),
    };
    (Measure { unit, class, decimals }, factor)
}

/// The entities of the catalogue: the mean of each quantity and, for some quantities, the standard deviation.
fn of_catalogue() -> impl Iterator<Item = Entity> {
    PackValues::rows().filter_map(|(row, it)| Some((row, it.mqtt_key?, it.mqtt_name))).flat_map(|(row, key, name)| {
        row.parts().map(move |(part, _)| {
            let (measure, _) = measure(row.unit);
            let (ending, name, class) = match part {
                // The device class `battery` is for the state of charge; Home Assistant warns if such a value is low.
                Part::Mean if row.quantity == Quantity::Soc => ("", name.into(), BATTERY),
                Part::Mean => ("", name.into(), measure.class),
                Part::Std => ("_std", format!("{name} Standard Deviation").into(), measure.class),
            };
            Entity {
                key: format!("{key}{ending}").into(),
                name,
                kind: Measure { class, ..measure }.kind(),
                is_diagnostic: false,
                is_enabled: part == Part::Mean,
                source: Source::Catalogue(row.quantity, part),
            }
        })
    })
}

/// Every entity of the pack.
pub fn entities() -> &'static [Entity] {
    static ENTITIES: LazyLock<Vec<Entity>> = LazyLock::new(|| derived().into_iter().chain(of_catalogue()).collect());
    &ENTITIES
}

/// Entities outside the catalogue.
fn derived() -> [Entity; 21] {
    let volts = measure(Unit::Volts).0.kind();
    let millivolts = Kind::Measured { unit: "mV", class: "voltage", decimals: 0 };
    let watts = Kind::Measured { unit: "W", class: "power", decimals: 0 };
    [
        Entity::new("time", "Time of the Values", Kind::Time, |d| stamp(d.wall_time).into()).diagnostic(),
        // Battery-Emulator also has a scaled SOC. Here, the scaled and the real SOC are equal.
        Entity::new("SOC_real", "SoC (real)", Measure { class: BATTERY, ..measure(Unit::Level).0 }.kind(), |d| {
            published(Quantity::Soc, Part::Mean, d.pack.values.mean(Quantity::Soc))
        }),
        Entity::new("temperature_min", "Temperature Min", measure(Unit::Celsius).0.kind(), |d| {
            rounded(d.least(Quantity::Temperature).map(|(_, celsius)| celsius), 1)
        }),
        Entity::new("stat_batt_power", "Battery Power", watts, |d| rounded(power_w(&d.pack.values), 0)),
        Entity::new("charged_energy", "Charged Energy", ENERGY, |d| rounded(d.pack.moved.map(|sum| sum.charged_wh), 0)),
        Entity::new("discharged_energy", "Discharged Energy", ENERGY, |d| {
            rounded(d.pack.moved.map(|sum| sum.discharged_wh), 0)
        }),
        Entity::new("cell_max_voltage", "Cell Max Voltage", volts, |d| {
            rounded(d.greatest(Quantity::Voltage).map(|(_, volts)| volts), 3)
        }),
        Entity::new("cell_min_voltage", "Cell Min Voltage", volts, |d| {
            rounded(d.least(Quantity::Voltage).map(|(_, volts)| volts), 3)
        }),
        Entity::new("cell_voltage_delta", "Cell Voltage Delta", millivolts, |d| rounded(spread_mv(d), 0)),
        Entity::new("min_cell_number", "Min Cell Number", Kind::Number, |d| {
            cell_number(d.least(Quantity::Voltage).map(|(cell, _)| cell))
        }),
        Entity::new("max_cell_number", "Max Cell Number", Kind::Number, |d| {
            cell_number(d.greatest(Quantity::Voltage).map(|(cell, _)| cell))
        }),
        Entity::new("charging_state", "Charging State", Kind::Word, |d| charging_state(d.pack.mode)),
        Entity::new("limiting_cell", "Limiting Cell", Kind::Number, |d| cell_number(d.pack.limiting_cell)),
        Entity::new("weakest_cell", "Weakest Cell", Kind::Number, |d| cell_number(d.pack.weakest_cell)),
        Entity::new("shortest_lived_cell", "Shortest-lived Cell", Kind::Number, |d| {
            cell_number(d.pack.shortest_lived_cell)
        }),
        Entity::new("validity", "Validity of the Estimates", Kind::Word, |d| word(&d.state).into()),
        Entity::new("alarms_raised", "Alarms Raised", Kind::Number, |d| d.alarms.raised.into()),
        Entity::new("event_level", "Event Level", Kind::Word, |d| d.alarms.level().into()),
        Entity::new("uptime", "Uptime", measure(Unit::Seconds).0.kind(), |d| rounded(Some(d.uptime_s), 0)).diagnostic(),
        Entity::new("late_ticks", "Late Ticks", Kind::Number, |d| d.counters.service.missed_deadlines.into())
            .diagnostic(),
        Entity::new("software_version", "packwatch Version", Kind::Word, |d| d.program_version.as_str().into())
            .diagnostic(),
    ]
}

/// Rounds to a number of decimals; `null` if unknown.
pub fn rounded(value: Option<f64>, decimals: i32) -> Value {
    let scale = 10_f64.powi(decimals);
    // Adding 0 turns -0 into 0. Non-finite numbers become null.
    value.map_or(Value::Null, |value| Value::from((value * scale).round() / scale + 0.0))
}

fn cell_number(cell: Option<CellIndex>) -> Value {
    cell.map_or(Value::Null, |cell| Value::from(u32::from(cell.0) + 1))
}

/// Power of the pack (W); positive = charging.
fn power_w(pack: &PackValues) -> Option<f64> {
    Some(-pack.mean(Quantity::Current)? * pack.mean(Quantity::Voltage)?)
}

fn spread_mv(document: &StatusDocument) -> Option<f64> {
    let voltage = Quantity::Voltage;
    Some((document.greatest(voltage)?.1 - document.least(voltage)?.1) * 1000.0)
}

/// Charging state in Battery-Emulator's terms.
fn charging_state(mode: Mode) -> Value {
    match mode {
        Mode::Charge => Value::from("Charging"),
        Mode::Discharge => Value::from("Discharging"),
        Mode::Rest => Value::from("Idle"),
        Mode::Unknown => Value::Null,
    }
}

/// Name of an enumeration value in JSON.
pub fn word(value: &impl Serialize) -> String {
    serde_json::to_value(value).ok().and_then(|value| value.as_str().map(str::to_owned)).unwrap_or_default()
}

/// Formats the time as ISO 8601 in UTC with milliseconds.
pub fn stamp(time: Timestamp) -> String {
    let millis = time.nanos().div_euclid(1_000_000).rem_euclid(1000);
    format!("{}.{millis:03}Z", format_utc(time).trim_end_matches('Z'))
}
