//! Units as other programs write them into the headers of tables: `mA`, `[V]`, `degC`, `h:min:s.ms`.
//!
//! In: the text of a unit. Out: a [`Unit`] that converts values to seconds, amperes, volts, degrees Celsius or
//! ampere-hours. Upper and lower case count as equal.

/// What a unit measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quantity {
    /// Time, in seconds.
    Time,
    /// Current, in amperes.
    Current,
    /// Voltage, in volts.
    Voltage,
    /// Temperature, in degrees Celsius.
    Temperature,
    /// Charge, in ampere-hours.
    Charge,
    /// Share of a whole, as a fraction.
    Share,
}

impl Quantity {
    /// The role of a column with this quantity.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Time => "time",
            Self::Current => "current",
            Self::Voltage => "voltage",
            Self::Temperature => "temperature",
            Self::Charge => "charge",
            Self::Share => "share",
        }
    }
}

/// A unit of a quantity.
#[derive(Debug, PartialEq)]
pub struct Unit {
    /// What the unit measures.
    pub quantity: Quantity,
    /// Symbol for messages.
    pub symbol: &'static str,
    /// Value in this unit that equals 0 in the base unit.
    zero: f64,
    multiply: f64,
    divide: f64,
    /// Accepted spellings without blanks and points, in lower case.
    spellings: &'static [&'static str],
}

const fn unit(
    quantity: Quantity,
    symbol: &'static str,
    multiply: f64,
    divide: f64,
    spellings: &'static [&'static str],
) -> Unit {
    Unit { quantity, symbol, zero: 0.0, multiply, divide, spellings }
}

/// All units. The first unit of each quantity is its base unit.
const UNITS: [Unit; 22] = [
    unit(Quantity::Time, "s", 1.0, 1.0, &["s", "sec", "secs", "second", "seconds"]),
    unit(Quantity::Time, "ms", 1.0, 1e3, &["ms", "msec", "millisecond", "milliseconds"]),
    unit(Quantity::Time, "us", 1.0, 1e6, &["us", "usec", "microsecond", "microseconds"]),
    unit(Quantity::Time, "ns", 1.0, 1e9, &["ns", "nsec", "nanosecond", "nanoseconds"]),
    unit(Quantity::Time, "min", 60.0, 1.0, &["min", "mins", "minute", "minutes"]),
    unit(Quantity::Time, "h", 3600.0, 1.0, &["h", "hr", "hrs", "hour", "hours"]),
    unit(Quantity::Time, "d", 86_400.0, 1.0, &["d", "day", "days"]),
    Unit {
        quantity: Quantity::Time,
        symbol: "Excel days",
        zero: 25_569.0,
        multiply: 86_400.0,
        divide: 1.0,
        spellings: &["exceldays"],
    },
    unit(Quantity::Current, "A", 1.0, 1.0, &["a", "amp", "amps", "ampere", "amperes"]),
    unit(Quantity::Current, "mA", 1.0, 1e3, &["ma", "mamp", "mamps", "milliamp", "milliamps", "milliampere"]),
    unit(Quantity::Current, "uA", 1.0, 1e6, &["ua", "microamp", "microampere"]),
    unit(Quantity::Voltage, "V", 1.0, 1.0, &["v", "volt", "volts"]),
    unit(Quantity::Voltage, "mV", 1.0, 1e3, &["mv", "millivolt", "millivolts"]),
    unit(Quantity::Voltage, "uV", 1.0, 1e6, &["uv", "microvolt"]),
    unit(Quantity::Temperature, "degC", 1.0, 1.0, &["c", "oc", "degc", "celsius", "deg_c", "degreec", "degreesc"]),
    Unit {
        quantity: Quantity::Temperature,
        symbol: "K",
        zero: 273.15,
        multiply: 1.0,
        divide: 1.0,
        spellings: &["k", "kelvin", "degk"],
    },
    Unit {
        quantity: Quantity::Temperature,
        symbol: "degF",
        zero: 32.0,
        multiply: 1.0,
        divide: 1.8,
        spellings: &["f", "degf", "fahrenheit", "deg_f", "degreef", "degreesf"],
    },
    unit(Quantity::Charge, "Ah", 1.0, 1.0, &["ah", "amp-hr", "amphr", "ahr", "ampere_hour", "amperehour"]),
    unit(Quantity::Charge, "mAh", 1.0, 1e3, &["mah", "mamp-hr", "mahr", "milliamphour"]),
    unit(Quantity::Share, "", 1.0, 1.0, &["1"]),
    unit(Quantity::Share, "%", 1.0, 1e2, &["%", "pct", "percent"]),
    unit(Quantity::Share, "ppm", 1.0, 1e6, &["ppm"]),
];

impl Unit {
    /// Finds the unit that `text` names.
    pub fn find(text: &str) -> Option<&'static Self> {
        let mut plain: String = text.trim().to_lowercase().replace(['\u{b5}', '\u{3bc}'], "u");
        plain = plain.replace('\u{2103}', "c").replace('\u{2109}', "f");
        plain.retain(|c| !matches!(c, ' ' | '.' | '\u{b7}' | '*' | '^'));
        // The degree sign, the similar ordinal indicator, and two characters that appear if the encoding is wrong.
        for (sign, ends) in [('\u{b0}', ""), ('\u{ba}', ""), ('\u{f8}', ""), ('\u{fffd}', "cfk")] {
            if let Some(rest) = plain.strip_prefix(sign).or_else(|| plain.strip_prefix(&format!("\u{c2}{sign}")))
                && (ends.is_empty() || (rest.len() == 1 && ends.contains(rest)))
            {
                plain = rest.to_owned();
                break;
            }
        }
        UNITS.iter().find(|unit| unit.spellings.contains(&plain.as_str()))
    }

    /// The base unit of a quantity.
    pub fn base(quantity: Quantity) -> &'static Self {
        // Every quantity has a unit, so the fallback is never used.
        UNITS.iter().find(|unit| unit.quantity == quantity).unwrap_or(&UNITS[0])
    }

    /// Converts a value to the base unit.
    pub fn convert(&self, value: f64) -> f64 {
        (value - self.zero) * self.multiply / self.divide
    }

    /// How many of this unit make one base unit, for messages about a wrong factor.
    pub(super) fn per_base(&self) -> f64 {
        self.divide / self.multiply
    }

    /// Length of this unit of time (ns). `None` for other quantities, and for Excel's days, which do not begin in
    /// 1970.
    pub(super) fn nanos(&self) -> Option<i64> {
        (self.quantity == Quantity::Time && self.zero == 0.0).then_some((1e9 * self.multiply / self.divide) as i64)
    }
}

/// Whether `text` names a time of day or a duration with colons, such as `h:min:s.ms`.
pub(super) fn is_clock(text: &str) -> bool {
    let text = text.trim().to_lowercase();
    text.contains(':') && text.chars().all(|c| matches!(c, 'd' | 'h' | 'm' | 'i' | 'n' | 's' | ':' | '.' | ' ' | '-'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spellings_of_units_convert_to_base_unit() {
        for (text, value, expected) in [
            ("mA", 2500.0, 2.5),
            (" Amps", 2.5, 2.5),
            ("mV", 3700.0, 3.7),
            ("min", 2.0, 120.0),
            ("\u{b0}F", 77.0, 25.0),
            ("K", 298.15, 25.0),
            ("\u{2103}", 25.0, 25.0),
            ("\u{2109}", 77.0, 25.0),
            ("Excel days", 45_244.0, 1_700_000_000.0 - 80_000.0),
            ("\u{fffd}C", 25.0, 25.0),
            ("\u{b5}s", 5e6, 5.0),
            ("mA.h", 500.0, 0.5),
        ] {
            let found = Unit::find(text).unwrap_or_else(|| panic!("{text} is known")).convert(value);
            assert!((found - expected).abs() < 1e-9, "{text}: {found}");
        }
        // A lost character in front of an s may be a micro sign, so the unit is unknown.
        assert!(Unit::find("\u{fffd}s").is_none() && Unit::find("W").is_none() && Unit::find("").is_none());
        assert!(is_clock("h:min:s.ms") && !is_clock("s"));
    }
}
