//! Computes how a cell type's open-circuit curve changes with lost capacity: voltage offsets over SOC and capacity.
//!
//! In: the electrodes of the new cell, or a shift of the SOC axis, and the SOC breakpoints of the model. Out: offsets,
//! V, to be added to the new cell's open-circuit voltage. Offsets are interpolated linearly over SOC and capacity.
//! Outside the range of capacities in the table, they are constant; below SOC 0 and above SOC 1, they continue
//! linearly.
//!
//! # One curve per capacity
//! The capacity alone does not show how much lithium and how much active material was lost. Assumption: if the cell has
//! lost a fraction x of its capacity, each electrode has lost the fraction [`MATERIAL_SHARE`] times x of its active
//! material. The rest of the lost capacity is explained by lost lithium. The share is uncertain. The uncertainty of one
//! electrode's share is called a mix. [`OffsetLine::mixes_v`] has one entry per mix: the change of the offset if the
//! share of that electrode is higher by [`MATERIAL_SHARE_STD`].

use super::electrodes::{Electrodes, LostMaterial};
use crate::filter::locate;

/// How the curve's change with ageing is computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AgeingLaw {
    /// The change is computed from a shift of the SOC axis; 0 = the curve over SOC does not change.
    Shift(f64),
    /// The change is computed from the electrodes of the new cell.
    Electrodes(Electrodes),
}

impl Default for AgeingLaw {
    fn default() -> Self {
        Self::Shift(0.0)
    }
}

/// Fraction of active material that each electrode loses, divided by the fraction of capacity lost. It is 0 for
/// calendar ageing alone, and 1 if material and capacity shrink equally. Graphite cells with layered oxides lose mostly
/// lithium if they are cycled at moderate temperature (Birkl et al. 2017; Dubarry et al. 2012).
pub const MATERIAL_SHARE: f64 = 0.3;

/// Standard deviation of [`MATERIAL_SHARE`] per electrode.
pub const MATERIAL_SHARE_STD: f64 = 0.3;

/// Standard deviation of a shift.
pub const SHIFT_STD: f64 = 0.3;

/// Capacities of aged cells in the table, relative to the new cell's capacity, rising. The table also has rows for the
/// new cell and, above it, for one larger capacity. Beyond that capacity, the curve stays constant: such a cell is a
/// larger cell, not a newer one.
const LOST_CAPACITIES: [f64; 10] = [0.4, 0.5, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95];

/// The electrodes must give curves down to this fraction of the new cell's capacity, which is a usual end of life.
const LEAST_KNOWN: f64 = 0.7;

/// Offsets of the open-circuit voltage over capacity and SOC; an empty table means no change.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct AgedOcv {
    /// Capacities (Ah), rising.
    capacity_ah: Vec<f64>,
    /// `offset_v[c][s]` (V): row per capacity, column per SOC breakpoint.
    offset_v: Vec<Vec<f64>>,
    /// Change of `offset_v` by one standard deviation of each mix (V); empty = unknown.
    mixes_v: [Vec<Vec<f64>>; MIXES],
    /// Per capacity: lithium lost, as a fraction of the new cell's lithium, and the change of this loss by one standard
    /// deviation of each mix. Empty without electrodes.
    lithium: Vec<Vec<f64>>,
    is_shift: bool,
    law: AgeingLaw,
    /// Modes of the curve's spread between cells, added by [`Self::add_spread`]; empty = no spread.
    spread_v: [Vec<f64>; MIXES],
}

/// Number of mixes: additional material lost from the negative electrode, and from the positive electrode. With a
/// shift, the first mix is the uncertainty of the shift, and the second mix is 0.
pub const MIXES: usize = 2;

/// A quantity over one interval of SOC: its value at SOC 0 and its slope per unit of SOC.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SocLine(pub [f64; 2]);

impl SocLine {
    /// Value at a SOC.
    pub fn at(&self, soc: f64) -> f64 {
        self.0[0] + self.0[1] * soc
    }
}

/// Difference between the curve near one capacity and the new cell's curve, over one interval of SOC.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct OffsetLine {
    /// Offset (V).
    pub offset_v: SocLine,
    /// Change of the offset with the capacity (V per Ah).
    pub per_ah_v: SocLine,
    /// Change of the offset by one standard deviation of each mix (V).
    pub mixes_v: [SocLine; MIXES],
}

/// Lithium lost at one capacity, as a fraction of the new cell's lithium.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LithiumLoss {
    /// Lithium lost.
    pub lost: f64,
    /// Change of the loss with the capacity, per Ah.
    pub per_ah: f64,
    /// Change of the loss by one standard deviation of each mix.
    pub mixes: [f64; MIXES],
    /// Change of `mixes` with the capacity, per Ah.
    pub mixes_per_ah: [f64; MIXES],
}

impl AgedOcv {
    /// Ageing that follows from the electrodes of the new cell. `None` if they give no curve down to [`LEAST_KNOWN`].
    /// `rows` contains the new cell's open-circuit voltages (V), one row per temperature.
    pub fn of_electrodes(
        electrodes: &Electrodes,
        soc: &[f64],
        new_capacity_ah: f64,
        rows: &[Vec<f64>],
    ) -> Option<Self> {
        // A row of offsets, and the lithium lost.
        let curve = |negative: f64, positive: f64, part: f64| {
            let lost = LostMaterial { negative: negative * (1.0 - part), positive: positive * (1.0 - part) };
            let aged = electrodes.aged(lost, part)?;
            let offset_v = soc.iter().map(|&z| aged.voltage_v(z) - electrodes.voltage_v(z));
            Some(offset_v.chain([aged.lithium_lost()]).collect::<Vec<f64>>())
        };
        let (low, high) = (MATERIAL_SHARE - MATERIAL_SHARE_STD, MATERIAL_SHARE + MATERIAL_SHARE_STD);
        let half_width = |a: Vec<f64>, b: Vec<f64>| a.iter().zip(b).map(|(a, b)| 0.5 * (b - a)).collect::<Vec<f64>>();
        let row = |part: f64| {
            let offset_v = curve(MATERIAL_SHARE, MATERIAL_SHARE, part)?;
            let negative = half_width(curve(low, MATERIAL_SHARE, part)?, curve(high, MATERIAL_SHARE, part)?);
            let positive = half_width(curve(MATERIAL_SHARE, low, part)?, curve(MATERIAL_SHARE, high, part)?);
            Some([offset_v, negative, positive])
        };
        // The capacities of the table go from the new cell down to the lowest capacity at which the electrodes still
        // form a cell.
        let aged: Vec<_> = LOST_CAPACITIES.iter().rev().map_while(|&part| Some((part, row(part)?))).collect();
        if aged.last().is_none_or(|(part, _)| *part > LEAST_KNOWN) {
            return None;
        }
        let mut table = Self { law: AgeingLaw::Electrodes(*electrodes), ..Self::default() };
        for (part, mut row) in aged.into_iter().rev() {
            table.lithium.push(row.iter_mut().filter_map(Vec::pop).collect());
            let [offset_v, mixes_v @ ..] = row;
            table.push(part * new_capacity_ah, offset_v, rows);
            table.mixes_v.iter_mut().zip(mixes_v).for_each(|(table, row)| table.push(row));
        }
        let first = table.lithium.last().map(|row| row.iter().map(|lost| -lost).collect());
        table.lithium.extend([Some(vec![0.0; 1 + MIXES]), first].into_iter().flatten());
        table.finish(new_capacity_ah, rows);
        Some(table)
    }

    /// Ageing that follows from a shift: OCV(s + a s (1 - s)) with a = shift (1 - C / C_new). `rows` contains the new
    /// cell's open-circuit voltages (V), one row per temperature. The offsets are computed for the middle row. With
    /// shift 1, each point near the top of the curve keeps its distance from full in Ah. With shift 0, all these
    /// distances shrink in proportion to the capacity.
    pub fn of_shift(shift: f64, soc: &[f64], new_capacity_ah: f64, rows: &[Vec<f64>]) -> Self {
        let mut table = Self { law: AgeingLaw::Shift(shift), ..Self::default() };
        let middle_v = &rows[rows.len() / 2];
        let ocv_v = |at: f64| {
            let (k, _) = locate(soc, at);
            middle_v[k] + (middle_v[k + 1] - middle_v[k]) * (at - soc[k]) / (soc[k + 1] - soc[k])
        };
        for part in LOST_CAPACITIES {
            let shifted = |shift: f64, z: f64| ocv_v(z + shift * (1.0 - part) * z * (1.0 - z));
            let offset_v = soc.iter().map(|&z| shifted(shift, z) - ocv_v(z)).collect();
            let more = |z: f64| 0.5 * (shifted(shift + SHIFT_STD, z) - shifted(shift - SHIFT_STD, z));
            table.push(part * new_capacity_ah, offset_v, rows);
            table.mixes_v[0].push(soc.iter().map(|&z| more(z)).collect());
            table.mixes_v[1].push(vec![0.0; soc.len()]);
        }
        table.is_shift = true;
        table.finish(new_capacity_ah, rows);
        table
    }

    /// Adds two rows: the new cell, and above it the mirror image of the smallest loss. The curve then changes smoothly
    /// around the new cell's capacity.
    fn finish(&mut self, new_capacity_ah: f64, rows: &[Vec<f64>]) {
        let Some((&aged_ah, aged_v)) = self.capacity_ah.last().zip(self.offset_v.last().cloned()) else { return };
        self.mixes_v.iter_mut().for_each(|table| table.extend(vec![vec![0.0; aged_v.len()]; 2]));
        self.push(new_capacity_ah, vec![0.0; aged_v.len()], rows);
        self.push(2.0 * new_capacity_ah - aged_ah, aged_v.iter().map(|offset_v| -offset_v).collect(), rows);
    }

    /// Adds a row of offsets. The new cell's tables can differ from the curve of its electrodes, so the aged curve
    /// might not rise with the SOC at every temperature. In that case, scales the row down.
    fn push(&mut self, capacity_ah: f64, mut offset_v: Vec<f64>, rows: &[Vec<f64>]) {
        let factor = rows.iter().flat_map(|row| row.windows(2).zip(offset_v.windows(2))).fold(
            1.0_f64,
            |factor, (new, offset)| {
                let (rise_v, change_v) = (new[1] - new[0], offset[1] - offset[0]);
                // The slope of an aged curve is at least a tenth of the new curve's slope everywhere.
                if change_v < 0.0 { factor.min(0.9 * rise_v / -change_v) } else { factor }
            },
        );
        offset_v.iter_mut().for_each(|offset_v| *offset_v *= factor);
        self.capacity_ah.push(capacity_ah);
        self.offset_v.push(offset_v);
    }

    /// Sets the standard deviation of the shift, initially [`SHIFT_STD`]. Does nothing if the ageing follows from
    /// electrodes, or after [`Self::add_spread`].
    pub fn set_shift_std(&mut self, std: f64) {
        if self.is_shift {
            self.mixes_v[0].iter_mut().flatten().for_each(|mix_v| *mix_v *= std / SHIFT_STD);
        }
    }

    /// Adds the spread of the curve between cells: adds `modes_v[i]` (V per standard deviation, one value per SOC
    /// breakpoint) to mix i at every capacity. The sign of the mix is chosen so that mix and mode do not cancel.
    pub fn add_spread(&mut self, modes_v: &[Vec<f64>; MIXES]) {
        self.is_shift = false;
        self.spread_v.clone_from(modes_v);
        for (table, mode_v) in self.mixes_v.iter_mut().zip(modes_v) {
            for row in table {
                let product: f64 = row.iter().zip(mode_v).map(|(mix_v, mode_v)| mix_v * mode_v).sum();
                let sign = if product < 0.0 { -1.0 } else { 1.0 };
                row.iter_mut().zip(mode_v).for_each(|(mix_v, mode_v)| *mix_v = sign * *mix_v + mode_v);
            }
        }
    }

    /// The source of the ageing.
    pub fn law(&self) -> AgeingLaw {
        self.law
    }

    /// Modes of the curve's spread between cells (V) per standard deviation at the SOC breakpoints; empty = no spread.
    pub fn spread_v(&self) -> &[Vec<f64>; MIXES] {
        &self.spread_v
    }

    /// Offset at a capacity, over the interval that starts at SOC breakpoint `s`.
    pub fn line(&self, soc: &[f64], s: usize, capacity_ah: f64) -> OffsetLine {
        let line = |rows: &[Vec<f64>], change: bool| {
            let Some(ends) = self.between(rows, [s, s + 1], capacity_ah) else { return SocLine::default() };
            let [low, high] = ends.map(|(value, per_ah)| if change { per_ah } else { value });
            let slope = (high - low) / (soc[s + 1] - soc[s]);
            SocLine([low - slope * soc[s], slope])
        };
        OffsetLine {
            offset_v: line(&self.offset_v, false),
            per_ah_v: line(&self.offset_v, true),
            mixes_v: [0, 1].map(|mix| line(&self.mixes_v[mix], false)),
        }
    }

    /// Lithium lost at a capacity. Above the new cell's capacity, returns the new cell's loss. Returns `None`
    /// without electrodes or below the smallest capacity in the table.
    pub fn lithium_loss(&self, capacity_ah: f64) -> Option<LithiumLoss> {
        let [least_ah, .., new_ah, _] = self.capacity_ah[..] else { return None };
        let found = self.between(&self.lithium, [0, 1, 2], capacity_ah.min(new_ah));
        let [lost, negative, positive] = found.filter(|_| capacity_ah >= least_ah)?;
        Some(LithiumLoss {
            lost: lost.0,
            per_ah: lost.1,
            mixes: [negative.0, positive.0],
            mixes_per_ah: [negative.1, positive.1],
        })
    }

    /// Values of `rows` (one row per capacity) at the SOC breakpoints `at`, and their change per Ah. The values are
    /// linear between the capacities and constant outside.
    fn between<const K: usize>(&self, rows: &[Vec<f64>], at: [usize; K], capacity_ah: f64) -> Option<[(f64, f64); K]> {
        let last = rows.len().checked_sub(1)?;
        let above = self.capacity_ah.iter().take_while(|&&border| capacity_ah >= border).count();
        if above == 0 || above > last {
            return Some(at.map(|s| (rows[above.min(last)][s], 0.0)));
        }
        let (low_ah, high_ah) = (self.capacity_ah[above - 1], self.capacity_ah[above]);
        Some(at.map(|s| {
            let per_ah = (rows[above][s] - rows[above - 1][s]) / (high_ah - low_ah);
            (rows[above - 1][s] + (capacity_ah - low_ah) * per_ah, per_ah)
        }))
    }
}

#[cfg(test)]
mod tests;
