//! Determines which ranges of SOC and temperature the data cover.
//!
//! In: SOC (fraction) and temperature (degrees C) of readings, or of the averaged readings in a notebook
//! ([`super::notebook`]). NaN and infinities are ignored. Out: the covered share of the SOC range, and the covered
//! ranges of SOC and temperature.

use std::collections::BTreeMap;

use super::notebook::Row;

const PARTS: usize = 10;
const CLASS_K: f64 = 10.0;

/// Number of readings per part of the SOC range and per temperature class.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Coverage {
    soc: [u64; PARTS],
    /// Key: lower end of the class divided by [`CLASS_K`].
    temperature: BTreeMap<i32, u64>,
}

impl Coverage {
    /// Counts the rows of a notebook.
    pub fn of_rows(rows: &[Row]) -> Self {
        let mut coverage = Self::default();
        rows.iter().for_each(|row| coverage.note(row.soc(), f64::from(row.temperature_c)));
        coverage
    }

    /// Counts one reading.
    pub fn note(&mut self, soc: f64, temperature_c: f64) {
        if soc.is_finite() {
            // The cast saturates.
            let part = (soc * PARTS as f64).max(0.0) as usize;
            self.soc[part.min(PARTS - 1)] += 1;
        }
        if temperature_c.is_finite() {
            *self.temperature.entry((temperature_c / CLASS_K).floor() as i32).or_default() += 1;
        }
    }

    /// Whether no SOC was counted.
    pub fn is_empty(&self) -> bool {
        self.soc.iter().all(|count| *count == 0)
    }

    /// Covered fraction of the SOC range, in steps of one tenth.
    pub fn soc_share(&self) -> f64 {
        self.soc.iter().filter(|count| **count > 0).count() as f64 / PARTS as f64
    }

    /// Covered ranges of the SOC (fractions).
    pub fn soc_ranges(&self) -> Vec<[f64; 2]> {
        let parts = (0..PARTS).filter(|part| self.soc[*part] > 0);
        let whole = |value: usize| i32::try_from(value).unwrap_or(i32::MAX);
        ranges(parts.map(whole)).into_iter().map(|range| range.map(|end| f64::from(end) / PARTS as f64)).collect()
    }

    /// Covered ranges of temperature (degrees C).
    pub fn temperature_ranges_c(&self) -> Vec<[f64; 2]> {
        let classes = self.temperature.iter().filter(|(_, count)| **count > 0).map(|(class, _)| *class);
        ranges(classes).into_iter().map(|range| range.map(|end| CLASS_K * f64::from(end))).collect()
    }
}

/// Joins neighbouring classes into ranges [first class, last class + 1].
fn ranges(classes: impl Iterator<Item = i32>) -> Vec<[i32; 2]> {
    let mut ranges: Vec<[i32; 2]> = Vec::new();
    for class in classes {
        match ranges.last_mut() {
            Some(last) if last[1] == class => last[1] = class.saturating_add(1),
            _ => ranges.push([class, class.saturating_add(1)]),
        }
    }
    ranges
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbouring_classes_join_into_one_range() {
        let mut coverage = Coverage::default();
        assert!(coverage.is_empty() && coverage.soc_share() == 0.0);
        for (soc, t) in [(-0.02, -3.0), (0.31, 4.0), (0.49, 12.0), (1.0, 41.0), (f64::NAN, f64::INFINITY)] {
            coverage.note(soc, t);
        }
        assert_eq!(coverage.soc_ranges(), [[0.0, 0.1], [0.3, 0.5], [0.9, 1.0]]);
        assert_eq!(coverage.temperature_ranges_c(), [[-10.0, 20.0], [40.0, 50.0]]);
        assert_eq!(coverage.soc_share(), 0.4);
    }
}
