//! Names and units of signals as evidence.

/// What a unit measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Dimension {
    /// V; mV have a factor of 0.001.
    Voltage,
    /// A.
    Current,
    /// Degrees Celsius.
    Temperature,
    /// Per cent.
    Percent,
    /// No unit is stated.
    None,
    /// Any other.
    Other,
}

/// Dimension of a unit, and the factor to V, A, degrees Celsius or per cent.
pub(crate) fn dimension(unit: &str) -> (Dimension, f64) {
    match unit.trim() {
        "V" | "v" | "Volt" | "Volts" | "volt" | "volts" => (Dimension::Voltage, 1.0),
        "mV" | "mv" => (Dimension::Voltage, 1e-3),
        "A" | "Amp" | "Amps" | "amps" => (Dimension::Current, 1.0),
        "mA" => (Dimension::Current, 1e-3),
        "C" | "°C" | "degC" | "DegC" | "deg C" | "degrees C" | "Celsius" | "celsius" => (Dimension::Temperature, 1.0),
        "%" | "percent" | "Percent" | "pct" => (Dimension::Percent, 1.0),
        "" | "-" | "1" => (Dimension::None, 1.0),
        _ => (Dimension::Other, 1.0),
    }
}

/// Words of a name, lower case: split at every change of case, at digits and at anything else.
#[derive(Debug)]
pub(crate) struct Words {
    words: Vec<String>,
    whole: String,
}

/// Words that place a signal at the traction battery.
const PACK: &[&str] = &["batt", "akku", "pack", "bms", "traction", "hvb", "=hv", "accumulator"];
/// Words of other devices and of the 12 V battery.
const ELSEWHERE: &[&str] = &[
    "12v",
    "twelvevolt",
    "=lv",
    "aux",
    "starter",
    "dcdc",
    "=dc",
    "=ac",
    "motor",
    "inverter",
    "invrt",
    "phase",
    "obc",
    "evse",
    "ptc",
    "heater",
    "htr",
    "compressor",
    "hvac",
    "cabin",
    "ambient",
    "coolant",
    "tpms",
    "tire",
    "front",
    "rear",
    "link",
    "solar",
    "pump",
    "fan",
    "oil",
    "igbt",
    "fet",
    "pcb",
    "cpu",
    "pilot",
    "connector",
    "pin",
    "inlet",
    "outlet",
    "capacitor",
    "charger",
    "plug",
    "port",
    "climate",
    "freezer",
    "stator",
    "brake",
    "trailer",
    "screen",
    "bus",
    "line",
    "isolation",
    "relay",
    "coil",
    "contactor",
    "cont",
];
/// Words of limits and requests: no measured value.
const NO_MEASUREMENT: &[&str] = &[
    "limit",
    "target",
    "request",
    "=req",
    "avail",
    "possible",
    "set",
    "allowed",
    "threshold",
    "lifetime",
    "cumulative",
    "rated",
    "nominal",
    "=id",
    "=num",
    "count",
    "delta",
    "=dev",
    "deviation",
    "fault",
    "=tot",
    "total",
    "offset",
    "reserve",
    "initial",
];
/// Words of the extremes of a group.
const EXTREME: &[&str] = &["max", "min", "highest", "lowest"];

impl Words {
    /// Splits a name.
    pub(crate) fn new(name: &str) -> Self {
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
        Self { words, whole: name.to_lowercase() }
    }

    /// Whether one of the words is there: anywhere in the name, with `=` as a word of its own.
    fn has(&self, any: &[&str]) -> bool {
        any.iter().any(|wanted| match wanted.strip_prefix('=') {
            Some(word) => self.words.iter().any(|own| own == word),
            None => self.whole.contains(wanted),
        })
    }

    pub(crate) fn says_pack(&self) -> bool {
        self.has(PACK)
    }

    pub(crate) fn says_elsewhere(&self) -> bool {
        self.has(ELSEWHERE)
    }

    pub(crate) fn says_no_measurement(&self) -> bool {
        self.has(NO_MEASUREMENT)
    }

    pub(crate) fn says_extreme(&self) -> bool {
        self.has(EXTREME)
    }

    pub(crate) fn says_voltage(&self) -> bool {
        self.has(&["volt", "spannung", "=v", "=u", "vdc", "=vbat", "=vbatt", "=ubatt"])
    }

    pub(crate) fn says_current(&self) -> bool {
        self.has(&["curr", "strom", "amp", "=i", "=ibat", "=ibatt", "=a"])
    }

    pub(crate) fn says_cell(&self) -> bool {
        self.has(&["cell", "brick", "cmu", "zelle", "=vc"])
    }

    pub(crate) fn says_temperature(&self) -> bool {
        self.has(&["temp", "=t", "=tmp"])
    }

    pub(crate) fn says_soc(&self) -> bool {
        self.has(&["=soc", "stateofcharge", "state_of_charge", "socave", "socui", "socdisp"])
            || self.words.iter().any(|word| word.starts_with("soc") && word.len() <= 7)
            || self.whole.starts_with("soc")
    }

    pub(crate) fn says_dash(&self) -> bool {
        self.has(&["disp", "=ui", "dash", "socui"])
    }

    pub(crate) fn says_soh(&self) -> bool {
        self.has(&["soh", "stateofhealth", "state_of_health"])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_split_where_a_reader_splits_them() {
        for (name, words) in [
            ("IBatt", &["i", "batt"][..]),
            ("uwe596_6_TAkkuL", &["uwe", "596", "6", "t", "akku", "l"]),
            ("BattVoltage132", &["batt", "voltage", "132"]),
            ("HVBAT_CMU{n}_VOLT", &["hvbat", "cmu", "n", "volt"]),
            ("", &[]),
        ] {
            assert_eq!(Words::new(name).words, words, "{name}");
        }
    }

    #[test]
    fn words_of_other_devices_are_seen() {
        assert!(Words::new("Voltage_12V").says_elsewhere() && Words::new("RearMotorCurrent126").says_elsewhere());
        assert!(!Words::new("SmoothBattCurrent132").says_elsewhere() && !Words::new("VBatt").says_elsewhere());
        assert!(Words::new("SOCave292").says_soc() && !Words::new("UI_enableVinAssociation").says_soc());
    }
}
