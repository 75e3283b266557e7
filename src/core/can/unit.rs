//! Parses units as written in a DBC.
//!
//! In: the text between the quotation marks. Out: the quantity and the conversion to the program's unit (A, V, degrees
//! C). A DBC may contain any text as a unit, so an unknown unit is not an error.

/// Quantity of a unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quantity {
    /// In A.
    Current,
    /// In V.
    Voltage,
    /// In degrees C.
    Temperature,
    /// A quantity that packwatch does not read. The text is its name with an article, such as `an angle`.
    Other(&'static str),
}

impl Quantity {
    /// A percentage, with the unit `%`.
    pub const PERCENTAGE: Self = Self::Other("a percentage");
}

/// A known unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SignalUnit {
    pub quantity: Quantity,
    /// Value in the program's unit = value x factor + offset. The factor is 1 for quantities that packwatch does not
    /// read.
    pub factor: f64,
    pub offset: f64,
}

impl SignalUnit {
    /// Parses a unit, ignoring case. Returns `None` for an empty or unknown unit.
    pub fn parse(text: &str) -> Option<Self> {
        let plain: String = text.chars().filter(|c| c.is_ascii_alphanumeric() || "%/".contains(*c)).collect();
        let is_degree_sign = plain.is_empty() && text.contains('\u{b0}');
        let plain = if is_degree_sign { "deg".to_owned() } else { plain.to_ascii_lowercase() };
        let (quantity, factor, offset) = match plain.as_str() {
            "a" | "amp" | "amps" | "ampere" | "amperes" => (Quantity::Current, 1.0, 0.0),
            "ma" => (Quantity::Current, 1e-3, 0.0),
            "ka" => (Quantity::Current, 1e3, 0.0),
            "v" | "volt" | "volts" | "vdc" => (Quantity::Voltage, 1.0, 0.0),
            "mv" => (Quantity::Voltage, 1e-3, 0.0),
            "uv" => (Quantity::Voltage, 1e-6, 0.0),
            "kv" => (Quantity::Voltage, 1e3, 0.0),
            "c" | "degc" | "celsius" | "degcelsius" | "degreec" | "degreesc" => (Quantity::Temperature, 1.0, 0.0),
            // 0 K is -273.15 degrees C.
            "k" | "kelvin" | "degk" => (Quantity::Temperature, 1.0, -273.15),
            "f" | "degf" | "fahrenheit" => (Quantity::Temperature, 5.0 / 9.0, -160.0 / 9.0),
            other => (Quantity::Other(other_quantity(other)?), 1.0, 0.0),
        };
        Some(Self { quantity, factor, offset })
    }
}

fn other_quantity(plain: &str) -> Option<&'static str> {
    Some(match plain {
        "deg" | "degree" | "degrees" | "rad" => "an angle",
        // Some files append a remark, such as "%+1".
        _ if plain.starts_with('%') || matches!(plain, "percent" | "pct") => "a percentage",
        "ah" | "mah" => "a charge",
        "w" | "kw" => "a power",
        "wh" | "kwh" => "an energy",
        "ohm" | "mohm" | "kohm" => "a resistance",
        "rpm" | "1/min" | "rad/s" => "a speed of rotation",
        "km/h" | "kmh" | "kph" | "mph" | "m/s" => "a speed",
        "nm" => "a torque",
        "bar" | "mbar" | "pa" | "kpa" | "psi" => "a pressure",
        "hz" | "khz" => "a frequency",
        "ms" | "us" | "s" | "sec" | "min" => "a time",
        "m" | "cm" | "mm" | "km" => "a length",
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn known(text: &str) -> Option<(Quantity, f64, f64)> {
        SignalUnit::parse(text).map(|unit| (unit.quantity, unit.factor, unit.offset))
    }

    #[test]
    fn common_unit_spellings_are_recognised() {
        for celsius in ["C", "degC", "deg C", "\u{b0}C", "Celsius"] {
            assert_eq!(known(celsius), Some((Quantity::Temperature, 1.0, 0.0)), "{celsius}");
        }
        assert_eq!(known("%+1"), Some((Quantity::PERCENTAGE, 1.0, 0.0)));
        assert_eq!(known("mV"), Some((Quantity::Voltage, 1e-3, 0.0)));
        assert_eq!(known("K"), Some((Quantity::Temperature, 1.0, -273.15)));
        for angle in ["Deg", "\u{b0}", "rad"] {
            assert_eq!(known(angle), Some((Quantity::Other("an angle"), 1.0, 0.0)), "{angle}");
        }
        assert_eq!(
            (known("m/s"), known("ms")),
            (Some((Quantity::Other("a speed"), 1.0, 0.0)), Some((Quantity::Other("a time"), 1.0, 0.0)))
        );
        for unknown in ["", "-", "kA2s", "Steps", "1"] {
            assert_eq!(known(unknown), None, "{unknown}");
        }
    }
}
