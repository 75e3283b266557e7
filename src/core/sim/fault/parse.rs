//! Parses the text form of a fault: `KIND:...@WHEN`.
//!
//! WHEN is `day3` or `3d` (three days after the start), `12h` or `900s`. Without `@WHEN`, the fault starts at the start
//! of the simulation.

use std::str::FromStr;

use super::{ContactResistance, Fault, FaultError, FaultKind, Leak};
use crate::quantity::{CellIndex, MAX_CELLS, SensorIndex};

/// The text forms of all kinds, for errors and help.
const KINDS: &str = "leak:CELL:20mA, leak:CELL:1kohm, contact:CELL:0.4mohm, contact:CELL:+20%, weak:CELL:-10%, \
     resistance:CELL:+20%, module:FIRST-LAST:+15%, current-offset:50mA, current-gain:+1%, current-stuck, \
     voltage-offset:CELL:10mV, voltage-stuck:CELL, swap:CELL:CELL, double:CELL:CELL, temperature-stuck:SENSOR or \
     temperature-off:SENSOR, each optionally followed by @WHEN";

/// Latest start (s): ten years.
const LATEST_S: f64 = 10.0 * 365.0 * 86_400.0;

type Unit = (&'static str, f64);
const AMPERE: &[Unit] = &[("mA", 1e-3), ("A", 1.0)];
const VOLT: &[Unit] = &[("mV", 1e-3), ("V", 1.0)];
const OHM: &[Unit] = &[("mohm", 1e-3), ("kohm", 1e3), ("ohm", 1.0)];
const PERCENT: &[Unit] = &[("%", 0.01)];

impl FromStr for Fault {
    type Err = FaultError;

    fn from_str(text: &str) -> Result<Self, FaultError> {
        let (kind, from_s) = match text.split_once('@') {
            Some((kind, when)) => (kind, parse_when(when)?),
            None => (text, 0.0),
        };
        Ok(Self { kind: parse_kind(kind)?, from_s })
    }
}

fn parse_kind(text: &str) -> Result<FaultKind, FaultError> {
    let parts: Vec<&str> = text.split(':').collect();
    Ok(match parts[..] {
        ["leak", c, size] => FaultKind::Leak { cell: cell(c)?, leak: leak(size)? },
        ["contact", c, size] => FaultKind::Contact { cell: cell(c)?, resistance: contact(size)? },
        ["weak", c, size] => FaultKind::Weak { cell: cell(c)?, change: change("change of capacity", size)? },
        ["resistance", c, size] => {
            FaultKind::Resistance { cell: cell(c)?, change: change("change of resistance", size)? }
        }
        ["module", cells, size] => module(cells, change("change of capacity", size)?)?,
        ["current-offset", size] => FaultKind::CurrentOffset(quantity("current offset", size, AMPERE, 1000.0)?),
        ["current-gain", size] => FaultKind::CurrentGain(change("current gain", size)?),
        ["current-stuck"] => FaultKind::CurrentStuck,
        ["voltage-offset", c, size] => {
            FaultKind::VoltageOffset { cell: cell(c)?, offset_v: quantity("voltage offset", size, VOLT, 5.0)? }
        }
        ["voltage-stuck", c] => FaultKind::VoltageStuck { cell: cell(c)? },
        ["swap", a, b] => {
            let (a, b) = two_cells(a, b)?;
            FaultKind::Swap(a, b)
        }
        ["double", a, b] => {
            let (shown, hidden) = two_cells(a, b)?;
            FaultKind::Double { shown, hidden }
        }
        ["temperature-stuck", sensor] => {
            FaultKind::TemperatureStuck(SensorIndex(number("temperature sensor", sensor)?))
        }
        ["temperature-off", sensor] => FaultKind::TemperatureOff(SensorIndex(number("temperature sensor", sensor)?)),
        _ => return Err(FaultError::new("fault", text, KINDS)),
    })
}

/// Parses a number that counts from 1 into an index that counts from 0.
fn number(what: &'static str, text: &str) -> Result<u16, FaultError> {
    let number = text.parse::<u16>().ok().filter(|n| (1..=MAX_CELLS).contains(&usize::from(*n)));
    number.map(|n| n - 1).ok_or_else(|| FaultError::new(what, text, format!("a number from 1 to {MAX_CELLS}")))
}

fn cell(text: &str) -> Result<CellIndex, FaultError> {
    number("cell", text).map(CellIndex)
}

fn two_cells(first: &str, second: &str) -> Result<(CellIndex, CellIndex), FaultError> {
    let (first_cell, second_cell) = (cell(first)?, cell(second)?);
    if first_cell == second_cell {
        return Err(FaultError::new("second cell", second, "different from the first cell"));
    }
    Ok((first_cell, second_cell))
}

fn module(cells: &str, change: f64) -> Result<FaultKind, FaultError> {
    let Some((first, last)) = cells.split_once('-') else {
        return Err(FaultError::new("cells of the module", cells, "FIRST-LAST, such as 13-24"));
    };
    let (first, last) = (cell(first)?, cell(last)?);
    if last < first {
        return Err(FaultError::new("cells of the module", cells, "FIRST-LAST, with FIRST not above LAST"));
    }
    Ok(FaultKind::Module { first, last, change })
}

fn leak(text: &str) -> Result<Leak, FaultError> {
    const ALLOWED: &str =
        "a current above 0 to 100 A, such as 20mA, or a resistance from 0.01 ohm to 1000 kohm, such as 1kohm";
    let current_a = measured(text, AMPERE).filter(|a| *a > 0.0 && *a <= 100.0).map(Leak::Current);
    let resistance = || measured(text, OHM).filter(|ohm| (0.01..=1e6).contains(ohm)).map(Leak::Resistance);
    current_a.or_else(resistance).ok_or_else(|| FaultError::new("leak", text, ALLOWED))
}

fn contact(text: &str) -> Result<ContactResistance, FaultError> {
    const ALLOWED: &str = "a resistance above 0 to 1 ohm, such as 0.4mohm, or a share of the cell's own, such as +20%";
    let ohm = measured(text, OHM).filter(|ohm| *ohm > 0.0 && *ohm <= 1.0).map(ContactResistance::Ohm);
    let share = || measured(text, PERCENT).filter(|x| *x > 0.0 && *x <= 10.0).map(ContactResistance::OfCell);
    ohm.or_else(share).ok_or_else(|| FaultError::new("contact resistance", text, ALLOWED))
}

/// Parses a relative change from -90 to +900 %.
fn change(what: &'static str, text: &str) -> Result<f64, FaultError> {
    let found = measured(text, PERCENT).filter(|x| (-0.9..=9.0).contains(x) && *x != 0.0);
    found.ok_or_else(|| FaultError::new(what, text, "-90% to +900% and not 0, such as -10%"))
}

fn quantity(what: &'static str, text: &str, units: &[Unit], limit: f64) -> Result<f64, FaultError> {
    measured(text, units).filter(|x| x.abs() <= limit && *x != 0.0).ok_or_else(|| {
        let (small, large) = (units[0].0, units[1].0);
        FaultError::new(what, text, format!("a number in {small} or {large}, not 0, at most {limit} {large}"))
    })
}

/// Parses a finite number followed by one of `units`. Returns it in the base unit.
fn measured(text: &str, units: &[Unit]) -> Option<f64> {
    let (number, factor) = units.iter().find_map(|(unit, factor)| Some((text.strip_suffix(unit)?, factor)))?;
    let number = number.parse::<f64>().ok().filter(|x| x.is_finite())?;
    Some(number * factor)
}

fn parse_when(text: &str) -> Result<f64, FaultError> {
    const UNITS: &[Unit] = &[("d", 86_400.0), ("h", 3600.0), ("s", 1.0)];
    let days = text.strip_prefix("day").map(|days| days.parse::<f64>().ok().map(|days| days * 86_400.0));
    let from_s = days.unwrap_or_else(|| measured(text, UNITS)).filter(|s| (0.0..=LATEST_S).contains(s));
    from_s.ok_or_else(|| FaultError::new("start of the fault", text, "day3, 3d, 12h or 900s, at most 10 years"))
}
