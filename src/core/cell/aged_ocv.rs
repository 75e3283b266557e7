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

/// Capacities of aged cells in the table, parts of the new cell's, rising. Further above the new one's capacity a cell is
/// a larger one, whose curve no longer changes.
const LOST_CAPACITIES: [f64; 10] = [0.4, 0.5, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95];

/// Capacity down to which the electrodes must say how the cell ages, part of the new cell's: a usual end of life.
const LEAST_KNOWN: f64 = 0.7;

/// Least slope that an aged curve keeps anywhere, part of the new curve's.
const LEAST_RISE: f64 = 0.1;

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
    /// By the electrodes of the new cell; `None` when they do not say how it ages down to [`LEAST_KNOWN`]. `rows` are the new
    /// cell's open-circuit voltages, V, by temperature.
    pub fn of_electrodes(
        electrodes: &Electrodes,
        soc: &[f64],
        new_capacity_ah: f64,
        rows: &[Vec<f64>],
    ) -> Option<Self> {
        let curve = |negative: f64, positive: f64, part: f64| {
            let lost = LostMaterial { negative: negative * (1.0 - part), positive: positive * (1.0 - part) };
            let aged = electrodes.aged(lost, part)?;
            Some(soc.iter().map(|&z| aged.voltage_v(z) - electrodes.voltage_v(z)).collect::<Vec<f64>>())
        };
        let (low, high) = (MATERIAL_SHARE - MATERIAL_SHARE_STD, MATERIAL_SHARE + MATERIAL_SHARE_STD);
        let half_width = |a: Vec<f64>, b: Vec<f64>| a.iter().zip(b).map(|(a, b)| 0.5 * (b - a)).collect::<Vec<f64>>();
        let row = |part: f64| {
            let offset_v = curve(MATERIAL_SHARE, MATERIAL_SHARE, part)?;
            let negative = half_width(curve(low, MATERIAL_SHARE, part)?, curve(high, MATERIAL_SHARE, part)?);
            let positive = half_width(curve(MATERIAL_SHARE, low, part)?, curve(MATERIAL_SHARE, high, part)?);
            let error_v = negative.iter().zip(positive).map(|(a, b)| libm::hypot(*a, b));
            Some((offset_v, error_v.collect::<Vec<f64>>()))
        };
        // From the new cell down, as far as there are such cells.
        let aged: Vec<_> = LOST_CAPACITIES.iter().rev().map_while(|&part| Some((part, row(part)?))).collect();
        if aged.last().is_none_or(|(part, _)| *part > LEAST_KNOWN) {
            return None;
        }
        let mut table = Self::default();
        for (part, (offset_v, error_v)) in aged.into_iter().rev() {
            table.push(part * new_capacity_ah, offset_v, rows);
            table.error_v.push(error_v);
        }
        table.error_v.extend([vec![0.0; soc.len()], vec![0.0; soc.len()]]);
        table.finish(new_capacity_ah, rows);
        Some(table)
    }

    /// By a shift: OCV(s + a s (1 - s)) with a = shift (1 - C / C_new) and the middle one of the new cell's `rows`, V, by
    /// temperature. 1 = the top keeps its ampere-hours, 0 = the curve shrinks evenly.
    pub fn of_shift(shift: f64, soc: &[f64], new_capacity_ah: f64, rows: &[Vec<f64>]) -> Self {
        let mut table = Self::default();
        if shift == 0.0 {
            return table;
        }
        let ocv_v = |at: f64| interpolate(soc, &rows[rows.len() / 2], at);
        for part in LOST_CAPACITIES {
            let lost = shift * (1.0 - part);
            let offset_v = soc.iter().map(|&z| ocv_v(z + lost * z * (1.0 - z)) - ocv_v(z)).collect();
            table.push(part * new_capacity_ah, offset_v, rows);
        }
        table.finish(new_capacity_ah, rows);
        table
    }

    /// Adds the new cell, and a little above it the opposite of the first loss: round the capacity at which cells start the
    /// curve changes smoothly.
    fn finish(&mut self, new_capacity_ah: f64, rows: &[Vec<f64>]) {
        let Some((&aged_ah, aged_v)) = self.capacity_ah.last().zip(self.offset_v.last().cloned()) else { return };
        self.push(new_capacity_ah, vec![0.0; aged_v.len()], rows);
        self.push(2.0 * new_capacity_ah - aged_ah, aged_v.iter().map(|offset_v| -offset_v).collect(), rows);
    }

    /// Adds a row of offsets, made smaller where the aged curve would not rise with the SOC at every temperature: the tables
    /// of the new cell differ from its electrodes' curve.
    fn push(&mut self, capacity_ah: f64, mut offset_v: Vec<f64>, rows: &[Vec<f64>]) {
        let factor = rows.iter().flat_map(|row| row.windows(2).zip(offset_v.windows(2))).fold(
            1.0_f64,
            |factor, (new, offset)| {
                let (rise_v, change_v) = (new[1] - new[0], offset[1] - offset[0]);
                if change_v < 0.0 { factor.min((1.0 - LEAST_RISE) * rise_v / -change_v) } else { factor }
            },
        );
        offset_v.iter_mut().for_each(|offset_v| *offset_v *= factor);
        self.capacity_ah.push(capacity_ah);
        self.offset_v.push(offset_v);
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

/// Linear between the points, which rise in `x`; the outer lines continue.
fn interpolate(x: &[f64], y: &[f64], at: f64) -> f64 {
    let k = x[1..x.len() - 1].iter().take_while(|&&border| at >= border).count();
    y[k] + (y[k + 1] - y[k]) * (at - x[k]) / (x[k + 1] - x[k])
}

#[cfg(test)]
mod tests;
