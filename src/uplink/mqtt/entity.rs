//! The entities of a pack: key in `info`, name, unit and value of each, in one table.
//!
//! In: the daemon's status. Out: the values as JSON. Keys and names are Battery-Emulator's where it has the quantity. Outside,
//! SOC and the like are percent and current and power are positive into the pack (charging), as Battery-Emulator has them: the
//! daemon's current is negated. Cells count from 1. What is not known is `null`, never a number.

use packwatch_host::quantity::Mode;
use packwatch_host::status::document::{CellStatus, PackStatus, StatusDocument};
use serde_json::Value;

/// What kind of value an entity has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A quantity with unit, device class and state class of Home Assistant; empty = none.
    Measured {
        /// Unit.
        unit: &'static str,
        /// Device class.
        class: &'static str,
        /// Decimals.
        decimals: i32,
    },
    /// A count or a cell's number.
    Number,
    /// A word.
    Word,
    /// A point in time, ISO 8601.
    Time,
}

/// One entity.
pub struct Entity {
    /// Key in `info`, and part of the identifiers in Home Assistant.
    pub key: &'static str,
    /// Name shown.
    pub name: &'static str,
    /// What kind of value it is.
    pub kind: Kind,
    /// Whether it describes the daemon rather than the pack.
    pub is_diagnostic: bool,
    value: fn(&StatusDocument) -> Value,
}

impl Entity {
    /// Its value; `null` = not known.
    pub fn value(&self, document: &StatusDocument) -> Value {
        (self.value)(document)
    }
}

const fn measured(
    key: &'static str,
    name: &'static str,
    (unit, class, decimals): (&'static str, &'static str, i32),
    value: fn(&StatusDocument) -> Value,
) -> Entity {
    Entity { key, name, kind: Kind::Measured { unit, class, decimals }, is_diagnostic: false, value }
}

const fn number(key: &'static str, name: &'static str, value: fn(&StatusDocument) -> Value) -> Entity {
    Entity { key, name, kind: Kind::Number, is_diagnostic: false, value }
}

const fn word(key: &'static str, name: &'static str, value: fn(&StatusDocument) -> Value) -> Entity {
    Entity { key, name, kind: Kind::Word, is_diagnostic: false, value }
}

const fn diagnostic(entity: Entity) -> Entity {
    Entity { is_diagnostic: true, ..entity }
}

const SOC: (&str, &str, i32) = ("%", "battery", 2);
const PERCENT: (&str, &str, i32) = ("%", "", 2);
const CELSIUS: (&str, &str, i32) = ("°C", "temperature", 1);
const VOLTS: (&str, &str, i32) = ("V", "voltage", 3);
const AMPERES: (&str, &str, i32) = ("A", "current", 2);
const AMPERE_HOURS: (&str, &str, i32) = ("Ah", "", 3);
const SECONDS: (&str, &str, i32) = ("s", "duration", 0);
const CYCLES: (&str, &str, i32) = ("cycles", "", 1);

/// Every entity of the pack, in the order of `info`.
pub const ENTITIES: &[Entity] = &[
    diagnostic(Entity {
        key: "time",
        name: "Time of the Values",
        kind: Kind::Time,
        is_diagnostic: true,
        value: |d| Value::from(super::payload::stamp(d.wall_time)),
    }),
    // Battery-Emulator scales the first of the two; without scaling, as here, they are equal.
    measured("SOC", "SoC", SOC, |d| percent(d.pack.soc)),
    measured("SOC_real", "SoC (real)", SOC, |d| percent(d.pack.soc)),
    measured("SOC_std", "SoC Standard Deviation", PERCENT, |d| percent(d.pack.soc_std)),
    measured("SOC_low", "SoC 95 % Low", PERCENT, |d| percent(d.pack.soc_low)),
    measured("SOC_high", "SoC 95 % High", PERCENT, |d| percent(d.pack.soc_high)),
    measured("SOC_reported", "SoC (reported by the pack)", SOC, |d| percent(d.pack.reported_soc)),
    measured("state_of_health", "State of Health", SOC, |d| percent(d.pack.soh)),
    measured("state_of_health_std", "State of Health Standard Deviation", PERCENT, |d| percent(soh_std(&d.pack))),
    measured("state_of_health_reported", "State of Health (reported by the pack)", SOC, |d| {
        percent(d.pack.reported_soh)
    }),
    measured("temperature_min", "Temperature Min", CELSIUS, |d| rounded(least(d, |cell| cell.temperature_c), 1)),
    measured("temperature_max", "Temperature Max", CELSIUS, |d| rounded(d.pack.temperature_max_c, 1)),
    measured("stat_batt_power", "Battery Power", ("W", "power", 0), |d| rounded(power_w(&d.pack), 0)),
    measured("battery_current", "Battery Current", AMPERES, |d| rounded(d.pack.current_a.map(|a| -a), 2)),
    measured("battery_current_offset", "Battery Current Sensor Offset", ("A", "current", 3), |d| {
        rounded(d.pack.current_offset_a.map(|a| -a), 3)
    }),
    measured(
        "battery_current_offset_std",
        "Battery Current Sensor Offset Standard Deviation",
        ("A", "current", 3),
        |d| rounded(d.pack.current_offset_std_a, 3),
    ),
    measured("cell_max_voltage", "Cell Max Voltage", VOLTS, |d| rounded(greatest(d, |cell| cell.voltage_v), 3)),
    measured("cell_min_voltage", "Cell Min Voltage", VOLTS, |d| rounded(least(d, |cell| cell.voltage_v), 3)),
    measured("cell_voltage_delta", "Cell Voltage Delta", ("mV", "voltage", 0), |d| rounded(spread_mv(d), 0)),
    measured("battery_voltage", "Battery Voltage", VOLTS, |d| rounded(d.pack.voltage_v, 3)),
    number("min_cell_number", "Min Cell Number", |d| extreme_cell(d, |voltage, best| voltage < best)),
    number("max_cell_number", "Max Cell Number", |d| extreme_cell(d, |voltage, best| voltage > best)),
    word("charging_state", "Charging State", |d| charging_state(d.pack.mode)),
    measured("capacity", "Capacity", AMPERE_HOURS, |d| rounded(d.pack.capacity_ah, 3)),
    measured("capacity_std", "Capacity Standard Deviation", AMPERE_HOURS, |d| rounded(d.pack.capacity_std_ah, 3)),
    measured("usable_capacity", "Usable Capacity", AMPERE_HOURS, |d| rounded(d.pack.usable_capacity_ah, 3)),
    measured("usable_capacity_std", "Usable Capacity Standard Deviation", AMPERE_HOURS, |d| {
        rounded(d.pack.usable_capacity_std_ah, 3)
    }),
    measured("recharge_period", "Recharge Period", SECONDS, |d| rounded(d.pack.recharge_period_s, 0)),
    measured("normalised_recharge_period", "Normalised Recharge Period", SECONDS, |d| {
        rounded(d.pack.normalised_recharge_period_s, 0)
    }),
    measured("normalised_recharge_period_std", "Normalised Recharge Period Standard Deviation", SECONDS, |d| {
        rounded(d.pack.normalised_recharge_period_std_s, 0)
    }),
    measured("remaining_cycles", "Remaining Cycles", CYCLES, |d| rounded(d.pack.remaining.remaining_cycles, 1)),
    measured("remaining_cycles_low", "Remaining Cycles 5 %", CYCLES, |d| {
        rounded(d.pack.remaining.remaining_cycles_low, 1)
    }),
    measured("remaining_cycles_high", "Remaining Cycles 95 %", CYCLES, |d| {
        rounded(d.pack.remaining.remaining_cycles_high, 1)
    }),
    measured("remaining_days", "Remaining Days", ("d", "duration", 1), |d| rounded(d.pack.remaining.remaining_days, 1)),
    measured("lithium_loss", "Loss of Lithium Inventory", PERCENT, |d| percent(d.pack.losses.lli)),
    measured("lithium_loss_std", "Loss of Lithium Inventory Standard Deviation", PERCENT, |d| {
        percent(d.pack.losses.lli_std)
    }),
    measured("negative_loss", "Loss of Negative Electrode", PERCENT, |d| percent(d.pack.losses.lam_ne)),
    measured("negative_loss_std", "Loss of Negative Electrode Standard Deviation", PERCENT, |d| {
        percent(d.pack.losses.lam_ne_std)
    }),
    measured("positive_loss", "Loss of Positive Electrode", PERCENT, |d| percent(d.pack.losses.lam_pe)),
    measured("positive_loss_std", "Loss of Positive Electrode Standard Deviation", PERCENT, |d| {
        percent(d.pack.losses.lam_pe_std)
    }),
    number("limiting_cell", "Limiting Cell", |d| cell_number(d.pack.limiting_cell)),
    number("weakest_cell", "Weakest Cell", |d| cell_number(d.pack.weakest_cell)),
    number("shortest_lived_cell", "Shortest-lived Cell", |d| cell_number(d.pack.shortest_lived_cell)),
    word("validity", "Validity of the Estimates", |d| Value::from(super::payload::word(&d.state))),
    number("alarms_raised", "Alarms Raised", |d| Value::from(d.alarms.raised)),
    word("event_level", "Event Level", |d| Value::from(d.alarms.level())),
    diagnostic(measured("uptime", "Uptime", SECONDS, |d| rounded(Some(d.uptime_s), 0))),
    diagnostic(number("late_ticks", "Late Ticks", |d| Value::from(d.counters.service.missed_deadlines))),
    diagnostic(word("software_version", "packwatch Version", |d| Value::from(d.program_version.as_str()))),
];

/// A number with so many decimals; `null` = not known.
pub fn rounded(value: Option<f64>, decimals: i32) -> Value {
    let scale = 10_f64.powi(decimals);
    // Adding 0 makes -0 a 0. What is not finite becomes null.
    value.map_or(Value::Null, |value| Value::from((value * scale).round() / scale + 0.0))
}

/// A fraction as percent with two decimals.
pub fn percent(value: Option<f64>) -> Value {
    rounded(value.map(|value| value * 100.0), 2)
}

fn cell_number(cell: Option<u16>) -> Value {
    cell.map_or(Value::Null, |cell| Value::from(u32::from(cell) + 1))
}

/// Positive while charging.
fn power_w(pack: &PackStatus) -> Option<f64> {
    Some(-pack.current_a? * pack.voltage_v?)
}

fn soh_std(pack: &PackStatus) -> Option<f64> {
    let (soh, capacity, std) = (pack.soh?, pack.capacity_ah?, pack.capacity_std_ah?);
    (capacity > 0.0).then(|| soh * std / capacity)
}

/// Battery-Emulator's words.
fn charging_state(mode: Mode) -> Value {
    match mode {
        Mode::Charge => Value::from("Charging"),
        Mode::Discharge => Value::from("Discharging"),
        Mode::Rest => Value::from("Idle"),
        Mode::Unknown => Value::Null,
    }
}

/// The least value of all cells; `None` while that of one of them is not known.
fn least(document: &StatusDocument, of: fn(&CellStatus) -> Option<f64>) -> Option<f64> {
    document.cells.iter().map(of).reduce(|a, b| Some(a?.min(b?))).flatten()
}

/// The greatest, as [`least`].
fn greatest(document: &StatusDocument, of: fn(&CellStatus) -> Option<f64>) -> Option<f64> {
    document.cells.iter().map(of).reduce(|a, b| Some(a?.max(b?))).flatten()
}

fn spread_mv(document: &StatusDocument) -> Option<f64> {
    let voltage = |cell: &CellStatus| cell.voltage_v;
    Some((greatest(document, voltage)? - least(document, voltage)?) * 1000.0)
}

/// Number of the first cell that no other is better than; `null` while one voltage is not known.
fn extreme_cell(document: &StatusDocument, is_better: fn(f64, f64) -> bool) -> Value {
    let voltages: Option<Vec<f64>> = document.cells.iter().map(|cell| cell.voltage_v).collect();
    let Some(voltages) = voltages else { return Value::Null };
    let mut best: Option<(usize, f64)> = None;
    for (cell, &voltage) in voltages.iter().enumerate() {
        if best.is_none_or(|(_, best)| is_better(voltage, best)) {
            best = Some((cell, voltage));
        }
    }
    best.map_or(Value::Null, |(cell, _)| Value::from(cell + 1))
}
