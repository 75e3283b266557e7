//! Parses the label of a pack: chemistry, capacity and number of cells. Every part is optional.
//!
//! Input: a text such as `nmc:64Ah:98s`. Output: the parts, and the voltages and resistances that follow from them.
//! These voltages and resistances decide the scale of a field that no file describes.

use std::str::FromStr;

use crate::cell::{Chemistry, Label};

/// Resistance of a usual cell times its capacity (ohm Ah): the immediate part and the 10 s part of the chemistry model.
const OHM_AH: f64 = 0.1;
/// Voltage range of lithium cells of any chemistry (V).
const ANY_CELL_V: (f64, f64) = (2.5, 4.4);

/// Parts of a pack's label.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PackLabel {
    /// Chemistry of the cells.
    pub chemistry: Option<Chemistry>,
    /// Rated capacity of the pack (Ah).
    pub capacity_ah: Option<f64>,
    /// Number of cells in series.
    pub cells: Option<u16>,
}

impl PackLabel {
    /// Returns the label of a cell; `None` if the chemistry or the capacity is missing.
    pub fn cell(&self) -> Option<Label> {
        Some(Label::usual(self.chemistry?, self.capacity_ah?))
    }

    pub(super) fn cell_v(&self) -> (f64, f64) {
        self.chemistry.map_or(ANY_CELL_V, |chemistry| {
            let (low, high) = chemistry.usual_voltages_v();
            (low.min(2.5), high + 0.1)
        })
    }

    pub(super) fn pack_v(&self) -> Option<(f64, f64)> {
        let (cells, (low, high)) = (f64::from(self.cells?), self.cell_v());
        Some((cells * low, cells * high))
    }

    /// Returns the usual resistance of a pack divided by its voltage (1/A). Without a capacity, the value of a car's
    /// pack is used.
    pub(super) fn ohm_per_v(&self) -> f64 {
        self.capacity_ah.map_or(2.5e-4, |capacity_ah| OHM_AH / capacity_ah / 3.6)
    }
}

impl FromStr for PackLabel {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let mut label = Self::default();
        for part in text.split([':', ',']).map(str::trim).filter(|part| !part.is_empty()) {
            label.add(part)?;
        }
        Ok(label)
    }
}

impl PackLabel {
    fn add(&mut self, part: &str) -> Result<(), String> {
        let lower = part.to_lowercase();
        let number = |text: &str| text.trim().parse::<f64>().ok().filter(|number| number.is_finite() && *number > 0.0);
        let is_new = if let Some(ah) = lower.strip_suffix("ah").and_then(number) {
            self.capacity_ah.replace(ah).is_none()
        } else if let Some(cells) = lower.strip_suffix('s').and_then(|text| text.parse::<u16>().ok()) {
            if !(1..=1024).contains(&cells) {
                return Err(format!("{part}: must be 1s to 1024s cells in series"));
            }
            self.cells.replace(cells).is_none()
        } else if let Some(chemistry) = chemistry(&lower) {
            self.chemistry.replace(chemistry).is_none()
        } else {
            let names = Chemistry::ALL.map(|(_, name)| name.trim_end_matches("-graphite")).join(", ");
            return Err(format!(
                "{part:?}: must be a chemistry ({names}), a capacity such as 64Ah, or cells such as 98s"
            ));
        };
        if is_new { Ok(()) } else { Err(format!("{part}: this part of the label is given twice")) }
    }
}

/// Returns the chemistry with this name. The suffix `-graphite` is optional.
fn chemistry(name: &str) -> Option<Chemistry> {
    let is_named = |(_, full): &(Chemistry, &str)| *full == name || full.strip_suffix("-graphite") == Some(name);
    Chemistry::ALL.into_iter().find(is_named).map(|(chemistry, _)| chemistry)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "in a test a panic is the message")]
mod tests {
    use super::*;

    #[test]
    fn every_part_of_a_label_is_optional() {
        let label: PackLabel = "nmc:64Ah:98s".parse().unwrap();
        assert_eq!(
            label,
            PackLabel { chemistry: Some(Chemistry::NmcGraphite), capacity_ah: Some(64.0), cells: Some(98) }
        );
        assert_eq!("16s, lfp-graphite".parse::<PackLabel>().unwrap().pack_v().map(|v| v.1.round()), Some(60.0));
        assert_eq!("".parse(), Ok(PackLabel::default()));
        for (text, part) in
            [("pb", "lfp"), ("0s", "1s to 1024s"), ("1025s", "1s to 1024s"), ("-3Ah", "64Ah"), ("1s:2s", "twice")]
        {
            let error = text.parse::<PackLabel>().unwrap_err();
            assert!(error.contains(part), "{text}: {error}");
        }
    }
}
