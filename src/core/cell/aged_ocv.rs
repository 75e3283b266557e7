//! How a cell type's open-circuit curve changes as capacity is lost: offsets of the voltage over SOC and capacity.
//!
//! In: the electrodes of the new cell, or a shift, and the SOC breakpoints of the model. Out: V to be added to the new
//! cell's open-circuit voltage. Between SOC breakpoints and between capacities the offsets are linear; beyond the outer
//! capacities they are constant, beyond SOC 0 and 1 they continue.
//!
//! # One curve per capacity
//! Which losses have taken a capacity is not measured. Assumed: per part of capacity lost, each electrode has lost
//! [`MATERIAL_SHARE`] of its active material and the rest is lithium. [`AgedOcv::error_v`] is what another mix within
//! [`MATERIAL_SHARE_STD`] would change.

use super::electrodes::{Electrodes, LostMaterial};

/// Active material lost of either electrode per part of capacity lost. Between no loss of material (a calendar life) and
/// loss in proportion; graphite cells with layered oxides that cycle at moderate temperature lose mostly lithium
/// (Birkl et al. 2017; Dubarry et al. 2012).
pub const MATERIAL_SHARE: f64 = 0.3;

/// Standard deviation of [`MATERIAL_SHARE`], of each electrode.
pub const MATERIAL_SHARE_STD: f64 = 0.3;

/// Capacities of the table, parts of the new cell's, rising.
const CAPACITIES: [f64; 13] = [0.4, 0.5, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.1];

/// Largest shift: the curve would fold at 1.
const MAX_SHIFT: f64 = 0.9;

/// Offsets of the open-circuit voltage over capacity and SOC; without capacities it never changes.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct AgedOcv {
    /// Capacities, Ah, rising.
    capacity_ah: Vec<f64>,
    /// `offset_v[c][s]`, V: row per capacity, column per SOC breakpoint.
    offset_v: Vec<Vec<f64>>,
    /// Standard deviation of the offsets, V, likewise; empty = unknown.
    error_v: Vec<Vec<f64>>,
}

/// Offset between two capacities over one interval of SOC: a0 + a1 soc + C (b0 + b1 soc), V.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct OffsetLine {
    /// [a0, a1].
    pub fixed: [f64; 2],
    /// [b0, b1], per Ah.
    pub per_ah: [f64; 2],
}

impl OffsetLine {
    /// Offset, V.
    pub fn at(&self, soc: f64, capacity_ah: f64) -> f64 {
        self.fixed[0] + self.fixed[1] * soc + capacity_ah * (self.per_ah[0] + self.per_ah[1] * soc)
    }

    /// Slope over SOC, V per unit of SOC.
    pub fn slope_v(&self, capacity_ah: f64) -> f64 {
        self.fixed[1] + capacity_ah * self.per_ah[1]
    }
}

impl AgedOcv {
    /// By the electrodes of the new cell; `None` when they allow no aged cell.
    pub fn of_electrodes(electrodes: &Electrodes, soc: &[f64], new_capacity_ah: f64) -> Option<Self> {
        let curve = |share: LostMaterial, part: f64| {
            let lost = |share: f64| share * (1.0 - part);
            let lost = LostMaterial { negative: lost(share.negative), positive: lost(share.positive) };
            let aged = electrodes.aged(lost, part)?;
            Some(soc.iter().map(|&z| aged.voltage_v(z) - electrodes.voltage_v(z)).collect::<Vec<f64>>())
        };
        let mean = LostMaterial { negative: MATERIAL_SHARE, positive: MATERIAL_SHARE };
        let (low, high) = (MATERIAL_SHARE - MATERIAL_SHARE_STD, MATERIAL_SHARE + MATERIAL_SHARE_STD);
        let mut table = Self::default();
        for part in CAPACITIES {
            // A cell above the new one's capacity is a larger cell, with the new one's curve.
            let part_or_new = part.min(1.0);
            let Some(offset_v) = curve(mean, part_or_new) else { continue };
            let spread = |share: fn(f64) -> LostMaterial| {
                let (low, high) = (curve(share(low), part_or_new), curve(share(high), part_or_new));
                low.zip(high).map(|(low, high)| low.iter().zip(high).map(|(a, b)| 0.5 * (b - a)).collect::<Vec<f64>>())
            };
            let negative = spread(|negative| LostMaterial { negative, positive: MATERIAL_SHARE });
            let positive = spread(|positive| LostMaterial { negative: MATERIAL_SHARE, positive });
            let Some((negative, positive)) = negative.zip(positive) else { continue };
            table.capacity_ah.push(part * new_capacity_ah);
            table.offset_v.push(offset_v);
            table.error_v.push(negative.iter().zip(positive).map(|(a, b)| libm::hypot(*a, b)).collect());
        }
        (table.capacity_ah.len() > CAPACITIES.len() / 2).then_some(table)
    }

    /// By a shift: OCV(s + a s (1 - s)) with a = shift (1 - C / C_new) and the new cell's curve `ocv_v`. 1 = the top keeps its
    /// ampere-hours, 0 = the curve shrinks evenly.
    pub fn of_shift(shift: f64, soc: &[f64], new_capacity_ah: f64, ocv_v: impl Fn(f64) -> f64) -> Self {
        let mut table = Self::default();
        for part in CAPACITIES.into_iter().filter(|_| shift != 0.0) {
            let lost = (shift * (1.0 - part)).clamp(-MAX_SHIFT, MAX_SHIFT);
            let row = soc.iter().map(|&z| ocv_v(z + lost * z * (1.0 - z)) - ocv_v(z));
            table.capacity_ah.push(part * new_capacity_ah);
            table.offset_v.push(row.collect());
        }
        table
    }

    /// Borders between the segments of capacity, Ah, rising: one segment more than borders.
    pub fn borders_ah(&self) -> &[f64] {
        &self.capacity_ah
    }

    /// Segment of a capacity: how many borders are at or below it.
    pub fn segment(&self, capacity_ah: f64) -> usize {
        self.capacity_ah.iter().take_while(|&&border| capacity_ah >= border).count()
    }

    /// Offset in a segment of capacity over the interval from SOC breakpoint `s`.
    pub fn line(&self, soc: &[f64], segment: usize, s: usize) -> OffsetLine {
        if self.capacity_ah.is_empty() {
            return OffsetLine::default();
        }
        let line = |value: &dyn Fn(usize) -> f64| {
            let slope = (value(s + 1) - value(s)) / (soc[s + 1] - soc[s]);
            [value(s) - slope * soc[s], slope]
        };
        let last = self.capacity_ah.len();
        if segment == 0 || segment == last {
            return OffsetLine { fixed: line(&|s| self.offset_v[segment.min(last - 1)][s]), per_ah: [0.0; 2] };
        }
        let (low_ah, high_ah) = (self.capacity_ah[segment - 1], self.capacity_ah[segment]);
        let (low, high) = (&self.offset_v[segment - 1], &self.offset_v[segment]);
        let per_ah = |s: usize| (high[s] - low[s]) / (high_ah - low_ah);
        OffsetLine { fixed: line(&|s| low[s] - low_ah * per_ah(s)), per_ah: line(&per_ah) }
    }

    /// Standard deviation of the offset at a SOC breakpoint for a capacity, V; `None` = unknown.
    pub fn error_v(&self, s: usize, capacity_ah: f64) -> Option<f64> {
        let last = self.error_v.len().checked_sub(1)?;
        let segment = self.segment(capacity_ah);
        if segment == 0 || segment > last {
            return Some(self.error_v[segment.min(last)][s]);
        }
        let (low_ah, high_ah) = (self.capacity_ah[segment - 1], self.capacity_ah[segment]);
        let along = (capacity_ah - low_ah) / (high_ah - low_ah);
        Some(self.error_v[segment - 1][s] * (1.0 - along) + self.error_v[segment][s] * along)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::electrodes::tests::M50;

    const SOC: [f64; 6] = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0];

    fn offset_v(table: &AgedOcv, s: usize, capacity_ah: f64) -> f64 {
        table.line(&SOC, table.segment(capacity_ah), s).at(SOC[s], capacity_ah)
    }

    #[test]
    fn nothing_changes_without_capacities_and_for_a_new_cell() {
        let none = AgedOcv::default();
        assert_eq!((none.line(&SOC, 0, 2), none.error_v(2, 1.0)), (OffsetLine::default(), None));
        assert_eq!(AgedOcv::of_shift(0.0, &SOC, 2.0, |z| z), none);
        let table = AgedOcv::of_electrodes(&M50, &SOC, 5.0).expect("a table");
        for (s, capacity_ah) in [(0, 4.0), (1, 5.0), (4, 5.2), (5 - 1, 9.0)] {
            assert!(offset_v(&table, s, capacity_ah).abs() < 1e-6, "{s} {capacity_ah}");
        }
    }

    #[test]
    fn offsets_are_the_aged_curve_less_the_new_one_and_continuous_over_capacity() {
        let table = AgedOcv::of_electrodes(&M50, &SOC, 5.0).expect("a table");
        let lost = LostMaterial { negative: 0.3 * 0.2, positive: 0.3 * 0.2 };
        let aged = M50.aged(lost, 0.8).expect("a cell");
        for (s, z) in SOC.into_iter().enumerate().take(5) {
            let expected_v = aged.voltage_v(z) - M50.voltage_v(z);
            assert!((offset_v(&table, s, 4.0) - expected_v).abs() < 1e-9, "{z}");
            for border in table.borders_ah() {
                let (below, above) = (offset_v(&table, s, border - 1e-9), offset_v(&table, s, border + 1e-9));
                assert!((below - above).abs() < 1e-6, "{z} {border}");
            }
            let (least, edge) = (offset_v(&table, s, 0.5), offset_v(&table, s, 2.0));
            assert!((least - edge).abs() < 1e-9, "constant below the lowest capacity: {least} {edge}");
        }
        let error_v = |capacity_ah| table.error_v(2, capacity_ah).expect("known");
        assert!(error_v(4.0) > 0.002 && error_v(5.0) < 1e-6, "{}", error_v(4.0));
    }

    #[test]
    fn a_shift_moves_the_inside_of_the_curve_only() {
        let table = AgedOcv::of_shift(0.8, &SOC, 2.0, |z| 3.0 + z);
        // A quarter lost: a = 0.8 x 0.25 = 0.2.
        assert!((offset_v(&table, 2, 1.5) - 0.2 * 0.4 * 0.6).abs() < 1e-12);
        assert_eq!(offset_v(&table, 0, 1.5), 0.0);
        assert!(table.line(&SOC, table.segment(1.5), 4).at(1.0, 1.5).abs() < 1e-12);
    }
}
