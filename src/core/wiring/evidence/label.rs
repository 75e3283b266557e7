//! Derives evidence about what a signal measures from its name and unit.
//!
//! In: message name, signal name and unit as written in the DBC. Out: points for each quantity of a pack, with their
//! reasons in words, or `None` if the name or the unit excludes the quantity. The points are weights that were chosen
//! on the DBCs of three cars. A matching unit or name adds 1 to 3 points. A word that indicates another device or a
//! limit subtracts 3 points.

use serde::Serialize;

use crate::can::unit::{Quantity, SignalUnit};

/// Quantity that a signal of a pack may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PackQuantity {
    /// Pack current (A).
    Current,
    /// Pack voltage (V).
    PackVoltage,
    /// Voltages of single cells (V).
    CellVoltage,
    /// Temperatures of the pack, degrees Celsius.
    Temperature,
    /// The battery controller's state of charge (%).
    Soc,
    /// The battery controller's state of health (%).
    Soh,
}

/// Points for a quantity, with their reasons.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Score {
    /// Weight of the evidence, without a physical meaning. It ranks signals, and callers compare it with a threshold.
    pub points: f64,
    /// Reasons in plain words.
    pub reasons: Vec<String>,
}

/// Name and unit of a signal.
#[derive(Debug, Clone)]
pub struct SignalLabel {
    /// Words of the signal's name, lower case; split at changes of case, at digits and at punctuation.
    words: Vec<String>,
    name: String,
    unit: LabelUnit,
    is_pack_message: bool,
    is_low_voltage_message: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum LabelUnit {
    Known(Quantity),
    Missing,
    /// A unit is stated but not known.
    Other,
}

// Words in names. A word that starts with `=` must be a whole word of the name; any other word may be a part of the
// name.

/// Words that indicate the traction battery.
const PACK: &str = "batt akku pack bms traction hvb =hv accumulator";
/// Words that indicate other devices or the 12 V battery.
const ELSEWHERE: &str = "12v twelvevolt =lv aux starter dcdc =dc =ac motor inverter invrt phase obc evse ptc heater htr \
    compressor hvac cabin ambient coolant tpms tire =front =rear =link solar pump =fan =oil igbt =fet =pcb =cpu \
    pilot connector =pin =inlet =outlet capacitor charger plug =port climate freezer stator brake trailer \
    screen =bus =line isolation relay =coil contactor";
/// Words that indicate the battery controller's own electronics. They are warmer than the cells and follow the load.
const ELECTRONICS: &str =
    "=mos =tmos mosfet board shunt heatsink heat_sink =afe =ic =mcu chip electronic balanc resist tube";
/// Words that indicate the 12 V battery.
const LOW_VOLTAGE: &str = "12v twelvevolt twelve_volt =lv aux starter";
/// Words that indicate a value that is not measured, such as a limit or request.
const NO_MEASUREMENT: &str = "limit target request =req avail possible set allowed threshold lifetime cumulative rated nominal =id \
    =num count delta =dev deviation fault offset reserve initial =hist history";

impl Score {
    /// If `holds` is true, adds `points`, and adds `reason` unless it is empty.
    pub fn add(&mut self, points: f64, holds: bool, reason: &str) {
        if holds {
            self.points += points;
            if !reason.is_empty() {
                self.reasons.push(reason.to_owned());
            }
        }
    }
}

impl PackQuantity {
    /// Every quantity, in the order of reports.
    pub const ALL: [Self; 6] =
        [Self::Current, Self::PackVoltage, Self::CellVoltage, Self::Temperature, Self::Soc, Self::Soh];

    /// Name in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Current => "pack current",
            Self::PackVoltage => "pack voltage",
            Self::CellVoltage => "cell voltages",
            Self::Temperature => "temperatures",
            Self::Soc => "state of charge",
            Self::Soh => "state of health",
        }
    }

    /// Unit of the quantity's values.
    pub fn unit(self) -> &'static str {
        match self {
            Self::Current => "A",
            Self::PackVoltage | Self::CellVoltage => "V",
            Self::Temperature => "degC",
            Self::Soc | Self::Soh => "%",
        }
    }

    fn measured(self) -> Quantity {
        match self {
            Self::Current => Quantity::Current,
            Self::PackVoltage | Self::CellVoltage => Quantity::Voltage,
            Self::Temperature => Quantity::Temperature,
            Self::Soc | Self::Soh => Quantity::PERCENTAGE,
        }
    }
}

impl SignalLabel {
    /// Splits the names into words and parses the unit.
    pub fn new(message: &str, signal: &str, unit: &str) -> Self {
        let unit = match SignalUnit::parse(unit) {
            Some(unit) => LabelUnit::Known(unit.quantity),
            None if matches!(unit.trim(), "" | "-" | "1") => LabelUnit::Missing,
            None => LabelUnit::Other,
        };
        let label = |name: &str| Self {
            words: words(name),
            name: name.to_lowercase(),
            unit,
            is_pack_message: false,
            is_low_voltage_message: false,
        };
        let (is_pack_message, is_low_voltage_message) = (label(message).has(PACK), label(message).has(LOW_VOLTAGE));
        Self { is_pack_message, is_low_voltage_message, ..label(signal) }
    }

    /// Creates a label for a signal without a name.
    pub fn unnamed(quantity: Quantity) -> Self {
        Self {
            words: Vec::new(),
            name: String::new(),
            unit: LabelUnit::Known(quantity),
            is_pack_message: false,
            is_low_voltage_message: false,
        }
    }

    fn has(&self, any: &str) -> bool {
        any.split(' ').any(|wanted| match wanted.strip_prefix('=') {
            Some(word) => self.words.iter().any(|own| own == word),
            None => self.name.contains(wanted),
        })
    }

    /// Whether a unit is stated and belongs to this quantity.
    pub fn has_unit_of(&self, quantity: Quantity) -> bool {
        self.unit == LabelUnit::Known(quantity)
    }

    /// Whether the unit belongs to this quantity or is not stated.
    pub fn may_measure(&self, quantity: Quantity) -> bool {
        self.has_unit_of(quantity) || self.unit == LabelUnit::Missing
    }

    /// Whether the name of the signal or its message indicates the traction battery.
    pub fn is_of_pack(&self) -> bool {
        self.has(PACK) || self.is_pack_message
    }

    /// Whether the name of the signal or its message indicates the 12 V battery.
    pub fn is_of_low_voltage(&self) -> bool {
        self.has(LOW_VOLTAGE) || self.is_low_voltage_message
    }

    /// Whether the name says that a temperature belongs to another device or to the controller's electronics.
    pub fn is_of_other_part(&self) -> bool {
        !self.says_cell() && (self.has(ELSEWHERE) || self.has(ELECTRONICS))
    }

    /// Whether the name says that the value is a maximum or minimum.
    pub fn says_extreme(&self) -> bool {
        self.has("max min highest lowest")
    }

    /// Whether the name says that the value belongs to a cell.
    pub fn says_cell(&self) -> bool {
        self.has("cell brick cmu zelle =vc")
    }

    /// Whether the name says state of charge.
    pub fn says_soc(&self) -> bool {
        self.has("=soc stateofcharge state_of_charge socave socui socdisp")
            || self.words.iter().any(|word| word.starts_with("soc") && word.len() <= 7)
            || self.name.starts_with("soc")
    }

    /// Whether the name says state of health.
    pub fn says_soh(&self) -> bool {
        self.has("soh stateofhealth state_of_health")
    }

    /// Points for a quantity from name and unit; `None` if the name or the unit excludes the quantity.
    pub fn score(&self, quantity: PackQuantity) -> Option<Score> {
        let mut score = Score::default();
        let has_unit = self.has_unit_of(quantity.measured());
        if !self.may_measure(quantity.measured()) {
            return None;
        }
        let (says, name) = match quantity {
            PackQuantity::Current => (self.has("curr strom amp =i =ibat =ibatt =a"), "its name says current"),
            PackQuantity::PackVoltage => {
                (self.has("volt spannung =v =u vdc =vbat =vbatt =ubatt"), "its name says voltage")
            }
            PackQuantity::CellVoltage => (self.says_cell(), "its name says cell"),
            PackQuantity::Temperature => (self.has("temp =t =tmp"), "its name says temperature"),
            PackQuantity::Soc => (self.says_soc() && !self.says_soh(), "its name says state of charge"),
            PackQuantity::Soh => (self.says_soh(), "its name says state of health"),
        };
        // Points for a matching unit, points for a matching name, and whether the name must match even if a unit is
        // stated.
        let (unit_points, name_points, needs_name) = match quantity {
            PackQuantity::Current | PackQuantity::PackVoltage => (2.0, 2.0, false),
            PackQuantity::CellVoltage => (1.0, 2.0, true),
            PackQuantity::Temperature => (2.0, 1.0, false),
            PackQuantity::Soc | PackQuantity::Soh => (1.0, 3.0, true),
        };
        let needs_unit = quantity == PackQuantity::Temperature || quantity == PackQuantity::Current && !self.has(PACK);
        if !says && (needs_name || !has_unit) || needs_unit && !has_unit {
            return None;
        }
        score.add(unit_points, has_unit, &format!("unit {}", quantity.unit()));
        score.add(name_points, says, name);
        score.add(2.0, self.has(PACK), "its name says battery");
        score.add(1.0, self.is_pack_message && !self.has(PACK), "its message says battery");
        score.add(-3.0, self.has(ELSEWHERE), "its name says another device");
        score.add(-3.0, self.has(NO_MEASUREMENT), "its name says limit, request or count");
        match quantity {
            PackQuantity::Current => score.add(-2.0, self.says_extreme(), "its name says extreme"),
            PackQuantity::PackVoltage => {
                score.add(-3.0, self.says_cell(), "its name says cell");
                score.add(-2.0, self.says_extreme(), "its name says extreme");
            }
            PackQuantity::Temperature => {
                score.add(1.0, self.says_cell(), "its name says cell");
                let is_electronics = self.has(ELECTRONICS) && !self.says_cell() && !self.has(ELSEWHERE);
                score.add(-3.0, is_electronics, "its name says electronics, not cells");
            }
            PackQuantity::Soc => {
                let is_dash = self.has("disp =ui dash socui");
                score.add(-1.0, is_dash, "the dashboard's, not the battery controller's");
                score.add(-1.0, self.says_extreme(), "an extreme of the cells");
            }
            PackQuantity::CellVoltage | PackQuantity::Soh => {}
        }
        Some(score)
    }
}

/// Splits a name at changes of case, at digits and at punctuation.
fn words(name: &str) -> Vec<String> {
    let chars: Vec<char> = name.chars().collect();
    let mut words = vec![String::new()];
    for (index, &c) in chars.iter().enumerate() {
        let previous = index.checked_sub(1).map(|index| chars[index]);
        let next = chars.get(index + 1);
        let is_lower = |c: Option<char>| c.is_some_and(char::is_lowercase);
        let begins = c.is_uppercase() && (is_lower(previous) || is_lower(next.copied()));
        let changes = previous.is_some_and(|previous| previous.is_ascii_digit() != c.is_ascii_digit());
        if begins || changes || !c.is_alphanumeric() {
            words.push(String::new());
        }
        if let Some(word) = words.last_mut().filter(|_| c.is_alphanumeric()) {
            word.extend(c.to_lowercase());
        }
    }
    words.retain(|word| !word.is_empty());
    words
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_split_into_words() {
        for (name, expected) in [
            ("IBatt", &["i", "batt"][..]),
            ("uwe596_6_TAkkuL", &["uwe", "596", "6", "t", "akku", "l"]),
            ("BattVoltage132", &["batt", "voltage", "132"]),
            ("HVBAT_CMU{n}_VOLT", &["hvbat", "cmu", "n", "volt"]),
            ("", &[]),
        ] {
            assert_eq!(words(name), expected, "{name}");
        }
    }

    #[test]
    fn words_of_other_devices_are_recognised() {
        let label = |name: &str| SignalLabel::new("", name, "");
        assert!(label("Voltage_12V").has(ELSEWHERE) && label("RearMotorCurrent126").has(ELSEWHERE));
        for own in ["SmoothBattCurrent132", "VBatt", "BattSpineTemp", "Container_Temp", "BaselineTemp", "Supported"] {
            assert!(!label(own).has(ELSEWHERE), "{own}");
        }
        for cells in ["Busbar temperature of cell 3", "CellTempFront", "RearCell_Temp"] {
            assert!(!label(cells).is_of_other_part(), "{cells}");
        }
        assert!(label("BatteryInletTemp").is_of_other_part() && label("HV_Bus_Temp").is_of_other_part());
        assert!(label("SOCave292").says_soc() && !label("UI_enableVinAssociation").says_soc());
    }

    #[test]
    fn score_requires_matching_unit_or_name() {
        let points = |signal: &str, unit: &str, quantity| {
            SignalLabel::new("Bms", signal, unit).score(quantity).map(|score| score.points)
        };
        assert_eq!(points("PackVoltage", "V", PackQuantity::PackVoltage), Some(6.0));
        assert_eq!(points("PackVoltage", "A", PackQuantity::PackVoltage), None);
        assert_eq!(points("Value", "", PackQuantity::PackVoltage), None);
        assert_eq!(points("PackCurrent", "", PackQuantity::Current), Some(4.0));
        assert_eq!(points("MaxPackCurrent", "A", PackQuantity::Current), Some(4.0));
    }
}
