//! Splits the name of a column into words, unit and number.
//!
//! In: a name such as `Current(mA)`, `Test Time / s`, `<I>/mA`, `Aux_Temperature(C)_1`, `voltage12_v` or `Cell 3 [mV]`.
//! Out: the words in lower case without unit and number, the unit, and the number.

use crate::io::units::{Unit, is_clock};

#[derive(Debug, Clone, PartialEq)]
pub(super) struct ColumnName {
    /// Words in lower case, separated by blanks, without unit and number.
    pub(super) words: String,
    /// The unit, if the name states one that is known.
    pub(super) unit: Option<&'static Unit>,
    /// Whether the name states that the column holds times with colons.
    pub(super) is_clock: bool,
    /// The number, if the name contains exactly one.
    pub(super) number: Option<u16>,
}

impl ColumnName {
    /// Splits a name. `unit` is the text of the column in a line of units; empty = no such line.
    pub(super) fn parse(name: &str, unit: &str) -> Self {
        let name = name.trim().trim_start_matches(['#', '~', ' ']);
        let (rest, stated) = split_unit(name);
        let in_row = unit.trim().trim_matches(['[', ']', '(', ')', ' ']);
        let stated = stated.or(Some(in_row).filter(|text| !text.is_empty()));
        let (words, number) = words_and_number(rest.as_str());
        Self { words, unit: stated.and_then(Unit::find), is_clock: stated.is_some_and(is_clock), number }
    }

    /// The same name with its last word as unit: `time s`, `current ampere`. `None` if the last word is not a unit.
    pub(super) fn with_last_word_as_unit(&self) -> Option<Self> {
        let (words, last) = self.words.rsplit_once(' ').filter(|_| self.unit.is_none() && !self.is_clock)?;
        let unit = Unit::find(last)?;
        let words = words.strip_suffix(" deg").unwrap_or(words).to_owned();
        Some(Self { words, unit: Some(unit), ..self.clone() })
    }
}

/// Splits the unit off: in brackets, or after a slash, a hash or a comma.
fn split_unit(name: &str) -> (String, Option<&str>) {
    for (open, close) in [('[', ']'), ('(', ')'), ('{', '}')] {
        let Some(start) = name.rfind(open) else { continue };
        let Some(len) = name[start..].find(close) else { continue };
        let inner = &name[start + open.len_utf8()..start + len];
        if Unit::find(inner).is_some() || is_clock(inner) {
            return (format!("{} {}", &name[..start], &name[start + len + close.len_utf8()..]), Some(inner));
        }
    }
    for separator in ['/', '#', ','] {
        if let Some((rest, unit)) = name.rsplit_once(separator)
            && !rest.trim().is_empty()
            && (Unit::find(unit).is_some() || is_clock(unit))
        {
            return (rest.to_owned(), Some(unit));
        }
    }
    (name.to_owned(), None)
}

/// The words in lower case, and the number if there is exactly one.
fn words_and_number(text: &str) -> (String, Option<u16>) {
    let mut parts: Vec<String> = Vec::new();
    let mut numbers: Vec<u16> = Vec::new();
    let mut last = ' ';
    for c in text.chars().flat_map(char::to_lowercase) {
        let is_new = !last.is_alphanumeric() || last.is_ascii_digit() != c.is_ascii_digit();
        if c.is_alphanumeric() {
            if is_new {
                parts.push(String::new());
            }
            if let Some(part) = parts.last_mut() {
                part.push(c);
            }
        }
        last = c;
    }
    parts.retain(|part| match part.parse() {
        Ok(number) => {
            numbers.push(number);
            false
        }
        Err(_) => true,
    });
    let number = if let [number] = numbers[..] { Some(number) } else { None };
    // A name with several numbers does not belong to one cell. Its numbers stay part of the name.
    if numbers.len() > 1 {
        parts.extend(numbers.iter().map(u16::to_string));
    }
    (parts.join(" "), number)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_exports_split_into_parts() {
        for (name, words, unit, number) in [
            ("time_s", "time s", None, None),
            ("Current(mA)", "current", Some("mA"), None),
            ("Test Time / s", "test time", Some("s"), None),
            ("<I>/mA", "i", Some("mA"), None),
            ("~Time[h]", "time", Some("h"), None),
            ("Aux_Temperature(C)_1", "aux temperature", Some("degC"), Some(1)),
            ("Voltage#V", "voltage", Some("V"), None),
            ("Cell 03 [mV]", "cell", Some("mV"), Some(3)),
            ("CP96", "cp", None, Some(96)),
            ("# Time [s]", "time", Some("s"), None),
            ("Date/Time", "date time", None, None),
            ("Module 2 Cell 3", "module cell 2 3", None, None),
            ("Current (charge +)", "current charge", None, None),
        ] {
            let found = ColumnName::parse(name, "");
            let parts = (found.words.as_str(), found.unit.map(|unit| unit.symbol), found.number);
            assert_eq!(parts, (words, unit, number), "{name}");
        }
        assert!(ColumnName::parse("Time(h:min:s.ms)", "").is_clock);
        assert_eq!(ColumnName::parse("Current", "[mA]").unit.map(|unit| unit.symbol), Some("mA"));
        let last = ColumnName::parse("surface_temperature_t1_celsius", "").with_last_word_as_unit();
        assert_eq!(last.map(|name| name.words).as_deref(), Some("surface temperature t"));
    }
}
