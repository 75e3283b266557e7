//! Finds the signals of a DBC that are probably battery signals, and writes them as the `[input]` part of a
//! configuration. Only name, unit and range are considered.
//!
//! Further candidates for each input are written as comments. The owner must confirm the result; `packwatch discover`
//! can check the values in a log. A DBC does not show the sign of the current, so the owner must add the sign to the
//! configuration.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use crate::can::dbc::{Database, Message, Signal};
use crate::can::unit::{Quantity, SignalUnit};
use crate::discover::groups::groups;
use crate::error::LabError;
use crate::fit::quoted;
use crate::wiring::evidence::{PackQuantity, SignalLabel};

#[derive(Debug, Clone)]
struct Candidate {
    points: f64,
    name: String,
    /// Lines that convert the signal's unit, such as `scale = 0.001`; empty = no conversion is needed.
    conversion: Vec<String>,
}

/// Writes the `[input]` part.
///
/// # Errors
/// No signal looks like the current or a voltage of a battery.
pub fn import(database: &Database, file: &str) -> Result<String, LabError> {
    let mut candidates: BTreeMap<PackQuantity, Vec<Candidate>> = BTreeMap::new();
    for message in &database.messages {
        for signal in &message.signals {
            for (kind, points) in judge(message, signal) {
                let name = format!("{}.{}", message.name, signal.name);
                let candidate = Candidate { points, name, conversion: conversion(kind, signal) };
                candidates.entry(kind).or_default().push(candidate);
            }
        }
    }
    let cells = candidates.remove(&PackQuantity::CellVoltage).unwrap_or_default();
    candidates.insert(PackQuantity::CellVoltage, with_patterns(cells));
    for ranked in candidates.values_mut() {
        ranked.sort_by(|a, b| b.points.total_cmp(&a.points).then_with(|| a.name.cmp(&b.name)));
    }
    let is_empty = |kind| candidates.get(&kind).is_none_or(Vec::is_empty);
    if is_empty(PackQuantity::Current) && is_empty(PackQuantity::PackVoltage) && is_empty(PackQuantity::CellVoltage) {
        let what = format!(
            "{file}: no signal of {} messages looks like the current or a voltage of a battery, by name, unit and range; \
             choose the signals yourself and write the tables [input.*]",
            database.messages.len()
        );
        return Err(LabError::Data(what));
    }
    Ok(text(file, &candidates))
}

fn judge(message: &Message, signal: &Signal) -> Vec<(PackQuantity, f64)> {
    let label = SignalLabel::new(&message.name, &signal.name, &signal.unit);
    let largest = largest(signal) * SignalUnit::parse(&signal.unit).map_or(1.0, |unit| unit.factor);
    let points = |quantity| {
        let points = label.score(quantity)?.points;
        let (fits, points) = match quantity {
            // A larger range belongs to the sum of several cells.
            PackQuantity::CellVoltage if label.says_extreme() => (largest <= 10.0, points - 1.0),
            PackQuantity::CellVoltage => (largest <= 10.0, points),
            PackQuantity::PackVoltage => (largest > 60.0 && !label.says_cell(), points),
            PackQuantity::Current | PackQuantity::Temperature | PackQuantity::Soc | PackQuantity::Soh => (true, points),
        };
        // Before deductions, a matching unit and a name that contains the quantity give at least three points.
        (fits && points >= 3.0 && signal.layout.length_bits >= 4).then_some((quantity, points))
    };
    PackQuantity::ALL.into_iter().filter_map(points).collect()
}

/// Returns the keys that convert the unit of the DBC to that of the input. If the converted range is too small for any
/// pack, the unit in the DBC is wrong and no key is returned.
fn conversion(quantity: PackQuantity, signal: &Signal) -> Vec<String> {
    let wanted = match quantity {
        PackQuantity::Current => Quantity::Current,
        PackQuantity::CellVoltage | PackQuantity::PackVoltage => Quantity::Voltage,
        PackQuantity::Temperature => Quantity::Temperature,
        // A maximum above 1.5 means percent. With the unit `%`, no key is needed.
        PackQuantity::Soc | PackQuantity::Soh if signal.unit != "%" && largest(signal) > 1.5 => {
            return vec!["scale = 0.01".to_owned()];
        }
        PackQuantity::Soc | PackQuantity::Soh => return Vec::new(),
    };
    let Some(unit) = SignalUnit::parse(&signal.unit).filter(|unit| unit.quantity == wanted) else { return Vec::new() };
    let is_held = wanted == Quantity::Temperature || largest(signal) * unit.factor >= 1.0;
    let key = |key: &str, value: f64, usual: f64| {
        let rounded = (value * 1e9).round() / 1e9;
        (is_held && value != usual).then(|| format!("{key} = {rounded:?}"))
    };
    key("scale", unit.factor, 1.0).into_iter().chain(key("offset", unit.offset, 0.0)).collect()
}

/// Returns the largest value that the bits can represent, or the maximum in the DBC if it is smaller.
fn largest(signal: &Signal) -> f64 {
    let layout = &signal.layout;
    let top = 2_f64.powi(i32::from(layout.length_bits)) * layout.factor.abs() + layout.offset;
    if layout.has_range() { layout.maximum.min(top) } else { top }
}

/// If the names of at least three signals differ only in a number, joins these signals to one pattern and adds points.
fn with_patterns(cells: Vec<Candidate>) -> Vec<Candidate> {
    let names: Vec<(String, &str)> = cells.iter().map(|cell| (String::new(), cell.name.as_str())).collect();
    let found = groups(&names);
    let mut ranked: Vec<Candidate> = Vec::new();
    let mut grouped = std::collections::BTreeSet::new();
    for group in found.iter().filter(|group| group.members.len() >= 3) {
        let first = group.members[0].1;
        // A group of similar signals probably contains cells.
        let Candidate { points, conversion, .. } = cells[first].clone();
        ranked.push(Candidate { points: points + 4.0, name: group.pattern.clone(), conversion });
        grouped.extend(group.members.iter().map(|member| member.1));
    }
    let alone = cells.into_iter().enumerate().filter(|(index, _)| !grouped.contains(index));
    ranked.extend(alone.map(|(_, ranked)| ranked));
    ranked
}

fn text(file: &str, candidates: &BTreeMap<PackQuantity, Vec<Candidate>>) -> String {
    let name: String = file.chars().filter(|c| !c.is_control()).collect();
    let mut text = format!(
        "# Likely battery signals of {name}, judged only by name, unit and range, written by `packwatch import dbc`.\n\
         # `packwatch discover LOG --dbc FILE` judges them by their values in a log.\n\n\
         [input]\ndbc = [{}]\n",
        quoted(file)
    );
    let has_cells = candidates
        .get(&PackQuantity::CellVoltage)
        .is_some_and(|found| found.iter().any(|found| found.name.contains("{n}")));
    for (kind, ranked) in candidates {
        // Only one of cell voltage and pack voltage may be active.
        let is_active = match kind {
            PackQuantity::CellVoltage => has_cells,
            PackQuantity::PackVoltage => !has_cells,
            _ => true,
        };
        let Some(best) = ranked.first() else { continue };
        let mark = if is_active { "" } else { "# " };
        let _ = write!(text, "\n{mark}{}\n{mark}signal = \"{}\"\n", table(*kind), best.name);
        for key in &best.conversion {
            let _ = writeln!(text, "{mark}{key}");
        }
        if *kind == PackQuantity::Current {
            text.push_str(
                "positive = \"?\"                  # charge or discharge: what does a positive value mean?\n",
            );
        }
        for other in ranked.iter().skip(1).take(4) {
            let keys = other.conversion.iter().map(|key| format!(", {key}"));
            let _ = writeln!(text, "# or: {}{}", other.name, keys.collect::<String>());
        }
    }
    text
}

fn table(quantity: PackQuantity) -> &'static str {
    match quantity {
        PackQuantity::Current => "[input.current]",
        PackQuantity::CellVoltage => "[input.cell_voltage]",
        PackQuantity::PackVoltage => "[input.pack_voltage]",
        PackQuantity::Temperature => "[[input.temperature]]",
        PackQuantity::Soc => "[input.reported_soc]",
        PackQuantity::Soh => "[input.reported_soh]",
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "in a test a panic is the message")]
mod tests {
    use super::*;

    const HEAD: &str = "VERSION \"\"\nNS_ :\nBS_:\nBU_: A\n";

    fn imported(messages: &str) -> Result<String, LabError> {
        import(&Database::parse(&format!("{HEAD}{messages}")).unwrap(), "car.dbc")
    }

    #[test]
    fn best_candidate_is_written_and_others_are_comments() {
        let text = imported(
            "BO_ 1 HV: 8 A\n SG_ BattCurrent : 0|16@1- (0.1,0) [0|0] \"A\" A\n SG_ BattVoltage : 16|16@1+ (0.1,0) [0|0] \"V\" A\n \
             SG_ MotorCurrent : 32|16@1- (0.1,0) [0|0] \"A\" A\n SG_ SOC : 48|8@1+ (0.5,0) [0|100] \"%\" A\n\
             BO_ 2 Cells: 8 A\n SG_ Cell1 : 0|16@1+ (0.001,0) [0|5] \"V\" A\n SG_ Cell2 : 16|16@1+ (0.001,0) [0|5] \"V\" A\n \
             SG_ Cell3 : 32|16@1+ (0.001,0) [0|5] \"V\" A\n SG_ BattTemp : 48|8@1+ (1,-40) [0|0] \"degC\" A\n",
        )
        .unwrap();
        for part in [
            "dbc = [\"car.dbc\"]",
            "[input.current]\nsignal = \"HV.BattCurrent\"\npositive = \"?\"",
            "[input.cell_voltage]\nsignal = \"Cells.Cell{n}\"",
            "# [input.pack_voltage]\n# signal = \"HV.BattVoltage\"",
            "[[input.temperature]]\nsignal = \"Cells.BattTemp\"",
            "[input.reported_soc]\nsignal = \"HV.SOC\"",
        ] {
            assert!(text.contains(part), "{part}\n{text}");
        }
        assert!(!text.contains("MotorCurrent"), "{text}");
        assert!(text.parse::<toml::Table>().is_ok(), "{text}");
    }

    #[test]
    fn unit_of_signal_gives_scale_and_offset() {
        let text = imported(
            "BO_ 1 HV: 8 A\n SG_ BattCurrent : 0|32@1- (1,0) [0|0] \"mA\" A\n SG_ BattSoc : 32|8@1+ (1,0) [0|100] \"\" A\n\
             BO_ 2 Cells: 8 A\n SG_ Cell1 : 0|16@1+ (1,0) [0|5000] \"mV\" A\n SG_ Cell2 : 16|16@1+ (1,0) [0|5000] \"mV\" A\n \
             SG_ Cell3 : 32|16@1+ (1,0) [0|5000] \"mV\" A\n SG_ BattTemp : 48|8@1+ (1,0) [0|0] \"degF\" A\n\
             BO_ 3 Wrong: 8 A\n SG_ BattCurrent2 : 0|16@1- (0.01,0) [0|0] \"mA\" A\n",
        )
        .unwrap();
        for part in [
            "signal = \"HV.BattCurrent\"\nscale = 0.001\npositive",
            "signal = \"Cells.Cell{n}\"\nscale = 0.001\n",
            "signal = \"Cells.BattTemp\"\nscale = 0.555555556\noffset = -17.777777778\n",
            "signal = \"HV.BattSoc\"\nscale = 0.01\n",
            "# or: Wrong.BattCurrent2\n",
        ] {
            assert!(text.contains(part), "{part}\n{text}");
        }
    }

    #[test]
    fn dbc_without_battery_signals_is_rejected() {
        let fault = imported("BO_ 1 Doors: 8 A\n SG_ Open : 0|8@1+ (1,0) [0|0] \"\" A\n").unwrap_err().to_string();
        assert!(fault.contains("car.dbc: no signal of 1 messages"), "{fault}");
    }
}
