//! Units as a DBC writes them.

use crate::doctor::plan::Kind;

/// Kind of quantity, factor and offset to the program's unit; `None` for any other unit.
pub(super) fn unit_of(text: &str) -> Option<(Kind, f64, f64)> {
    let plain: String = text.chars().filter(char::is_ascii_alphanumeric).collect();
    Some(match plain.to_ascii_lowercase().as_str() {
        "a" | "amp" | "amps" | "ampere" => (Kind::Current, 1.0, 0.0),
        "ma" => (Kind::Current, 1e-3, 0.0),
        "v" | "volt" | "volts" => (Kind::Voltage, 1.0, 0.0),
        "mv" => (Kind::Voltage, 1e-3, 0.0),
        "uv" => (Kind::Voltage, 1e-6, 0.0),
        "c" | "degc" | "celsius" | "degcelsius" => (Kind::Temperature, 1.0, 0.0),
        "k" | "kelvin" | "degk" => (Kind::Temperature, 1.0, -273.15),
        "f" | "degf" | "fahrenheit" => (Kind::Temperature, 5.0 / 9.0, -160.0 / 9.0),
        _ => return None,
    })
}
