//! The names of the vehicle and the pack, from the table `[vehicle]`.

use std::fmt;

use serde::{Deserialize, Serialize};

/// The names that users give the vehicle and the pack. `None` = not given.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct VehicleIdentity {
    /// Name of the vehicle.
    #[serde(default)]
    pub name: Option<String>,
    /// VIN or fleet number.
    #[serde(default)]
    pub id: Option<String>,
    /// Name of the pack in the vehicle.
    #[serde(default)]
    pub pack: Option<String>,
}

impl VehicleIdentity {
    /// Whether at least one name is given.
    pub fn is_stated(&self) -> bool {
        *self != Self::default()
    }

    /// The given fields: `name`, `id`, `pack` and their texts.
    pub fn labels(&self) -> Vec<(&'static str, String)> {
        let all = [("name", &self.name), ("id", &self.id), ("pack", &self.pack)];
        all.into_iter().filter_map(|(key, text)| Some((key, text.clone()?))).collect()
    }
}

/// Shows the names as `Bus 12 (WDB9634031L123456), pack front`; empty if no name is given.
impl fmt::Display for VehicleIdentity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let vehicle = match (&self.name, &self.id) {
            (Some(name), Some(id)) => format!("{name} ({id})"),
            (Some(one), None) | (None, Some(one)) => one.clone(),
            (None, None) => String::new(),
        };
        let pack = self.pack.iter().map(|pack| format!("pack {pack}"));
        let parts: Vec<String> = [vehicle].into_iter().filter(|part| !part.is_empty()).chain(pack).collect();
        f.write_str(&parts.join(", "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn given_fields_are_shown_on_one_line() {
        let text = |text: &str| (!text.is_empty()).then(|| text.to_owned());
        let shown = |name, id, pack| VehicleIdentity { name: text(name), id: text(id), pack: text(pack) }.to_string();
        assert_eq!(shown("Bus 12", "WDB1", "front"), "Bus 12 (WDB1), pack front");
        assert_eq!(shown("", "WDB1", ""), "WDB1");
        assert_eq!(shown("", "", "rear"), "pack rear");
        assert_eq!((shown("", "", ""), VehicleIdentity::default().is_stated()), (String::new(), false));
    }
}
