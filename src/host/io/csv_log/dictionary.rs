//! The names of columns in the exports of cyclers, applications and battery management systems.
//!
//! In: the names of a header. Out: the [`Role`] of each known column, and the [`Format`], that is, the program that
//! writes such a header. Source: the column names in public projects that read these exports.

use super::column_name::ColumnName;
use crate::io::units::{Quantity, Unit};

/// Columns of the Battery Data Format: packwatch's name, the format's label, and the format's machine-readable name.
pub const BDF_COLUMNS: [(&str, &str, &str); 6] = [
    ("time_s", "Test Time / s", "test_time_second"),
    ("current_a", "Current / A", "current_ampere"),
    ("voltage_v", "Voltage / V", "voltage_volt"),
    ("temperature_c", "Surface Temperature T1 / degC", "temperature_t1_celsius"),
    ("temperature_c", "Ambient Temperature / degC", "ambient_temperature_celsius"),
    // The sign of this column is opposite to packwatch's, like the sign of the current.
    ("discharged_ah", "Net Capacity / Ah", "net_capacity_ah"),
];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Role {
    /// Time since the beginning of the file, or since 1970.
    Time,
    /// Time since the beginning of the step.
    StepTime,
    /// Date and time of day.
    Date,
    Current,
    /// Voltage of the cell or of the pack.
    Voltage,
    /// Voltage of the cell whose number the name contains.
    CellVoltage,
    Temperature,
    Step,
    /// Whether the row belongs to a charge or a discharge, in words.
    State,
    /// Charge taken out since the beginning of the file. In the Battery Data Format, the column has the opposite sign.
    Discharged,
    NetCharged,
    Soc,
}

/// Names of each role, divided by bars. If a role has several lines, the earlier line is preferred: a name of a later
/// line is used only if the file has no column with a name of an earlier line.
const NAMES: [(Role, &str); 19] = [
    (Role::Time, "test time|total time|testtime|totaltime|prog time|program time|program duration|test"),
    (
        Role::Time,
        "time|elapsed time|elapsed|run time|runtime|rel time|t|time since start|seconds|minutes|hours|millis|\
         milliseconds|test duration|ms today|zeit|gesamtzeit|programmdauer",
    ),
    (Role::Time, "epoch time|epoch|unix time|unixtime|unix timestamp|unix|timestamp|time stamp|ts"),
    (
        Role::Date,
        "date time|datetime|date|absolute time|dpt time|dpt|system time|utc time|local time|date time iso|\
         realtime|device time|gps time|date and time|recorded at|zeitstempel|\
         \u{7edd}\u{5bf9}\u{65f6}\u{95f4}|gmtime",
    ),
    (Role::StepTime, "relative time|step time|steptime|t step|step duration|state time"),
    (
        Role::Current,
        "current|amps|amp|amperes|i|cur|pack current|battery current|batt current|bat current|pack amps|\
         cell current|current measured|measured current|load current|mamps|hv battery current|bms current|\
         bms battery current|current in|strom|\u{7535}\u{6d41}|battery amps|battery|batt|bat|pack",
    ),
    (
        Role::Voltage,
        "voltage|volts|volt|u|v|ecell|cell voltage|voltage measured|measured voltage|potential|\
         terminal voltage|vol|spannung|\u{7535}\u{538b}",
    ),
    (
        Role::Voltage,
        "pack voltage|pack volts|battery voltage|batt voltage|bat voltage|total voltage|hv battery voltage|\
         bms voltage|bms battery voltage|input voltage|pack inst voltage|battery volts|ewe|\
         battery terminal voltage|battery|batt|bat|pack",
    ),
    (
        Role::CellVoltage,
        "v|u|cell|cell voltage|voltage|voltage cell|cell v|v cell|u cell|cell u|cp|cellvoltage|cell volt|\
         cell volts|cellv|vcell|ucell|volt|volts|c|cell pair",
    ),
    (
        Role::Temperature,
        "temperature|temp|cell temperature|cell temp|surface temperature|surface temperature t|surface temp|\
         temperature t|temperature cell|temp cell|t cell|aux temperature|evtemp|ev temp|logtemp|\
         x averaged cell temperature|volume averaged cell temperature|temperature measured|cell t|\
         cell temp mid|temperatur|\u{6e29}\u{5ea6}",
    ),
    (
        Role::Temperature,
        "battery temperature|battery temp|batt temp|bat temp|hv battery temperature|hv battery temp|\
         bms battery temperature|pack temperature|pack temp|pack t|module temperature|module temp|t|\
         temp sensor|temperature sensor|ntc",
    ),
    (Role::Temperature, "ambient temperature|ambient temp|tenv|environment temperature|chamber temperature"),
    (Role::Step, "step|step index|stepindex|step id|step number|ns|line|steps"),
    (
        Role::State,
        "state|status|step type|steptype|step name|md|mode|charge state|charging state|charge status|command|\
         work mode|direction|charging|charging status|charge discharge|battery status|battery state|\
         bms state|zustand|\u{5de5}\u{6b65}\u{7c7b}\u{578b}",
    ),
    (Role::Discharged, "discharged"),
    (Role::NetCharged, "net capacity|ahbal"),
    (Role::Soc, "soc|state of charge"),
    // Chinese names of Neware and Landt.
    (Role::Time, "\u{603b}\u{65f6}\u{95f4}|\u{6d4b}\u{8bd5}\u{65f6}\u{95f4}"),
    (Role::StepTime, "\u{65f6}\u{95f4}"),
];

const BATTERY: [&str; 4] = ["battery", "batt", "bat", "pack"];

/// Names that contain their unit as a word.
const UNITS_AS_NAMES: [(&str, &str); 12] = [
    ("ms today", "ms"),
    ("seconds", "s"),
    ("minutes", "min"),
    ("hours", "h"),
    ("millis", "ms"),
    ("milliseconds", "ms"),
    ("amps", "A"),
    ("amp", "A"),
    ("amperes", "A"),
    ("volts", "V"),
    ("volt", "V"),
    ("mamps", "mA"),
];

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Known {
    pub(super) role: Role,
    /// Preference among columns of the same role; 0 is best.
    pub(super) rank: usize,
    /// The unit, if the header states it.
    pub(super) unit: Option<&'static Unit>,
    pub(super) number: Option<u16>,
}

impl Role {
    /// The quantity of the role's values; `None` = text or a number without unit.
    pub(super) fn quantity(self) -> Option<Quantity> {
        Some(match self {
            Self::Time | Self::StepTime | Self::Date => Quantity::Time,
            Self::Current => Quantity::Current,
            Self::Voltage | Self::CellVoltage => Quantity::Voltage,
            Self::Temperature => Quantity::Temperature,
            Self::Discharged | Self::NetCharged => Quantity::Charge,
            Self::Soc => Quantity::Share,
            Self::Step | Self::State => return None,
        })
    }
}

pub(super) fn known(name: &str, unit: &str) -> Vec<Known> {
    if !unit.is_empty() && unknown_unit(name, unit).is_some() {
        return Vec::new();
    }
    let name = ColumnName::parse(name, unit);
    let found = lookup(&name);
    if !found.is_empty() {
        return found;
    }
    name.with_last_word_as_unit().map_or_else(Vec::new, |name| lookup(&name))
}

/// The role of a column and the text of its unit, if packwatch does not know this unit. The unit is in the line of
/// units, in brackets or after a slash.
pub(super) fn unknown_unit(name: &str, unit: &str) -> Option<(Role, String)> {
    let trimmed = |text: &str| text.trim_matches(['(', '[', '{', ')', ']', '}', ' ']).to_owned();
    let (words, text) = if trimmed(unit).is_empty() { name.rsplit_once(['(', '[', '{', '/'])? } else { (name, unit) };
    let text = trimmed(text);
    let role = lookup(&ColumnName::parse(words, "")).first()?.role;
    let is_unknown = !text.is_empty() && text.chars().all(char::is_alphabetic) && Unit::find(&text).is_none();
    (is_unknown && role != Role::Date && role.quantity().is_some()).then_some((role, text))
}

fn lookup(name: &ColumnName) -> Vec<Known> {
    let as_word = || {
        UNITS_AS_NAMES
            .iter()
            .find(|(word, _)| name.words == *word || name.words.rsplit(' ').next() == Some(*word))
            .and_then(|of| Unit::find(of.1))
    };
    let unit = name.unit.or_else(as_word);
    let fits = |role: Role| {
        let quantity_fits = match (role.quantity(), unit) {
            (_, None) => true,
            (Some(quantity), Some(unit)) => quantity == unit.quantity,
            (None, Some(_)) => false,
        };
        let number_fits = match role {
            Role::CellVoltage => name.number.is_some(),
            // Only the unit shows whether a current or a voltage is meant.
            Role::Current | Role::Voltage if BATTERY.contains(&name.words.as_str()) => {
                name.number.is_none() && unit.is_some()
            }
            Role::Time if name.words == "test" => unit.is_some() || name.is_clock,
            Role::Temperature => true,
            _ => name.number.is_none(),
        };
        quantity_fits && number_fits && (!name.is_clock || role.quantity() == Some(Quantity::Time))
    };
    let named = NAMES
        .iter()
        .enumerate()
        .filter(|(_, (role, names))| names.split('|').any(|of| of == name.words) && fits(*role));
    named.map(|(rank, &(role, _))| Known { role, rank, unit, number: name.number }).collect()
}

/// Rates the fields of a line that may be a header. Returns the number of known columns if a time and a current or
/// voltage are among them, else 0.
pub(super) fn score(fields: &[String]) -> usize {
    let roles: Vec<Role> =
        fields.iter().flat_map(|field| known(field, "").into_iter().map(|of| of.role).take(1)).collect();
    let has = |wanted: &[Role]| roles.iter().any(|role| wanted.contains(role));
    let is_header =
        has(&[Role::Time, Role::StepTime, Role::Date]) && has(&[Role::Current, Role::Voltage, Role::CellVoltage]);
    if is_header { roles.len() } else { 0 }
}

/// The program that writes such a header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Format {
    Packwatch,
    Bdf,
    Arbin,
    Neware,
    Maccor,
    BioLogic,
    Digatron,
    Basytec,
    PyBamm,
    Cellpy,
    LeafSpy,
    Unknown,
}

impl Format {
    pub(super) fn of(names: &[String]) -> Self {
        let lower: Vec<String> = names.iter().map(|name| name.trim().to_lowercase()).collect();
        let has = |wanted: &str| lower.iter().any(|name| name == wanted);
        let begins = |start: &str| lower.iter().any(|name| name.starts_with(start));
        let words: Vec<String> = names.iter().map(|name| ColumnName::parse(name, "").words).collect();
        let word = |wanted: &str| words.iter().any(|name| name == wanted);
        if has("time_s") && (begins("current_") || has("voltage_v")) {
            Self::Packwatch
        } else if begins("test time / ")
            || begins("test_time_second")
            || begins("test_time_milli")
            || begins("unix time / ")
        {
            Self::Bdf
        } else if word("ecell") || word("ewe") || begins("ox/red") {
            Self::BioLogic
        } else if word("cp") && word("pack amps") {
            Self::LeafSpy
        } else if begins("~time") || (word("u") && word("i") && word("command")) {
            Self::Basytec
        } else if word("prog time") || word("program duration") || word("ahaccu") {
            Self::Digatron
        } else if (word("step type") && !word("potential"))
            || word("record number")
            || (word("total time") && word("record"))
        {
            Self::Neware
        } else if word("rec") || word("cyc") || word("dpt time") {
            Self::Maccor
        } else if has("test_time") && has("data_point") && has("cycle_index") {
            Self::Cellpy
        } else if word("data point") && (word("test time") || word("step index"))
            || (has("test_time") && has("step_index"))
            || (word("test time") && word("cycle index") && word("step index"))
        {
            Self::Arbin
        } else if has("time [s]")
            && (lower.iter().any(|name| name.contains("[a.h]")) || begins("terminal voltage") || begins("x-averaged"))
        {
            Self::PyBamm
        } else {
            Self::Unknown
        }
    }

    pub(super) const fn name(self) -> Option<&'static str> {
        Some(match self {
            Self::Packwatch | Self::Unknown => return None,
            Self::Bdf => "Battery Data Format",
            Self::Arbin => "Arbin",
            Self::Neware => "Neware",
            Self::Maccor => "Maccor",
            Self::BioLogic => "BioLogic",
            Self::Digatron => "Digatron",
            Self::Basytec => "Basytec",
            Self::PyBamm => "PyBaMM",
            Self::Cellpy => "cellpy",
            Self::LeafSpy => "LeafSpy",
        })
    }

    /// Whether a positive current is a charge in this format; `None` = the format does not decide.
    pub(super) const fn charge_positive(self) -> Option<bool> {
        match self {
            Self::Packwatch | Self::PyBamm => Some(false),
            // The Battery Data Format does not state the sign. However, its net capacity is charged minus discharged
            // capacity, and cyclers count a charging current as positive.
            Self::Bdf | Self::Arbin | Self::Neware | Self::BioLogic | Self::Digatron | Self::Basytec | Self::Cellpy => {
                Some(true)
            }
            Self::Maccor | Self::LeafSpy | Self::Unknown => None,
        }
    }

    /// Unit of the cell voltages if the header does not state it.
    pub(super) fn cell_voltage_unit(self) -> Option<&'static Unit> {
        (self == Self::LeafSpy).then(|| Unit::find("mV")).flatten()
    }
}
