//! Computes how a cell type's open-circuit curve changes when a cell loses capacity.
//!
//! In: the SOC breakpoints of the model, and either the electrodes of the new cell or a shift of the SOC axis. Out: a
//! table of offsets (V) over capacity and SOC, which are added to the new cell's open-circuit voltage. Offsets are
//! interpolated linearly. For a capacity outside the table, the offset of the nearest capacity applies. For a SOC
//! outside the table, the offsets are extrapolated linearly.
//!
//! If a cell has lost a fraction x of its capacity, this module assumes that each electrode has lost the fraction
//! [`MATERIAL_SHARE`] times x of its active material. Lost lithium explains the rest of the lost capacity. The material
//! share is uncertain. For each electrode, the table therefore contains a "mix": the change of the offset if the
//! material share of this electrode is higher by one standard deviation ([`MATERIAL_SHARE_STD`]).

use super::electrodes::{Electrodes, LostMaterial};
use crate::filter::locate;

/// How an aged curve is computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AgeingLaw {
    /// From a shift of the SOC axis ([`AgedOcv::of_shift`]). With shift 0, the curve over SOC does not change.
    Shift(f64),
    /// From the electrodes of the new cell.
    Electrodes(Electrodes),
}

impl Default for AgeingLaw {
    fn default() -> Self {
        Self::Shift(0.0)
    }
}

/// Lost fraction of an electrode's active material, divided by the lost fraction of the capacity. It is 0 for calendar
/// ageing alone. Graphite cells with layered oxides that are cycled at moderate temperature lose mostly lithium (Birkl
/// et al. 2017; Dubarry et al. 2012).
pub const MATERIAL_SHARE: f64 = 0.3;

/// Standard deviation of [`MATERIAL_SHARE`] per electrode.
pub const MATERIAL_SHARE_STD: f64 = 0.3;

/// Standard deviation of a shift.
pub const SHIFT_STD: f64 = 0.3;

/// Capacities of the aged cells in the table, relative to the new cell's capacity.
const LOST_CAPACITIES: [f64; 10] = [0.4, 0.5, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95];

/// The electrodes must give curves down to this fraction of the new cell's capacity (a usual end of life).
const LEAST_KNOWN: f64 = 0.7;

/// Offsets of the open-circuit voltage over capacity and SOC; an empty table means no change.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct AgedOcv {
    capacity_ah: Vec<f64>,
    /// One row per capacity, one column per SOC breakpoint (V).
    offset_v: Vec<Vec<f64>>,
    /// The two mixes (V), each with the shape of `offset_v`; empty = unknown.
    mixes_v: [Vec<Vec<f64>>; MIXES],
    /// One row per capacity: the lost lithium as a fraction of the new cell's lithium, then the change of this fraction
    /// by each mix.
    lithium: Vec<Vec<f64>>,
    is_shift: bool,
    law: AgeingLaw,
    /// Typical shapes of the voltage difference between cells (V), set by [`Self::add_spread`].
    spread_v: [Vec<f64>; MIXES],
}

/// Number of mixes: one for the negative electrode, one for the positive electrode. If the curve comes from a shift,
/// the first mix is the uncertainty of the shift, and the second mix is 0.
pub const MIXES: usize = 2;

/// A straight line over SOC: its value at SOC 0 and its slope per unit of SOC.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SocLine(pub [f64; 2]);

impl SocLine {
    /// Value at a SOC.
    pub fn at(&self, soc: f64) -> f64 {
        self.0[0] + self.0[1] * soc
    }
}

/// Difference between an aged curve and the new cell's curve, over one interval of SOC.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct OffsetLine {
    /// Offset (V).
    pub offset_v: SocLine,
    /// Change of the offset with the capacity (V per Ah).
    pub per_ah_v: SocLine,
    /// Change of the offset by each mix (V).
    pub mixes_v: [SocLine; MIXES],
}

/// Lithium lost at one capacity, as a fraction of the new cell's lithium.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LithiumLoss {
    /// Lithium lost.
    pub lost: f64,
    /// Change of the loss with the capacity, per Ah.
    pub per_ah: f64,
    /// Change of the loss by each mix.
    pub mixes: [f64; MIXES],
    /// Change of `mixes` with the capacity, per Ah.
    pub mixes_per_ah: [f64; MIXES],
}

impl AgedOcv {
    /// Computes the table from the electrodes of the new cell. Returns `None` if the electrodes give no curve down to
    /// [`LEAST_KNOWN`]. `rows` contains the new cell's open-circuit voltages (V), one row per temperature.
    pub fn of_electrodes(
        electrodes: &Electrodes,
        soc: &[f64],
        new_capacity_ah: f64,
        rows: &[Vec<f64>],
    ) -> Option<Self> {
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

    /// Computes the table from a shift. The aged curve is OCV(s + a s (1 - s)) with a = shift (1 - C / C_new). `rows`
    /// contains the new cell's open-circuit voltages (V), one row per temperature; the middle row is used. With shift
    /// 1, a voltage near the top of the curve stays the same number of Ah away from full when the cell ages. With shift
    /// 0, this number of Ah shrinks with the capacity.
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

    /// Adds a row for the new cell and a row for a larger cell. The larger cell gets the offsets of the cell with the
    /// smallest loss, with the opposite sign. The curve then changes smoothly around the new cell's capacity.
    fn finish(&mut self, new_capacity_ah: f64, rows: &[Vec<f64>]) {
        let Some((&aged_ah, aged_v)) = self.capacity_ah.last().zip(self.offset_v.last().cloned()) else { return };
        self.mixes_v.iter_mut().for_each(|table| table.extend(vec![vec![0.0; aged_v.len()]; 2]));
        self.push(new_capacity_ah, vec![0.0; aged_v.len()], rows);
        self.push(2.0 * new_capacity_ah - aged_ah, aged_v.iter().map(|offset_v| -offset_v).collect(), rows);
    }

    /// Adds a row of offsets. If the aged curve would fall with rising SOC at some temperature, scales the row down. A
    /// curve can fall if the new cell's tables differ from the curve of its electrodes.
    fn push(&mut self, capacity_ah: f64, mut offset_v: Vec<f64>, rows: &[Vec<f64>]) {
        let factor = rows.iter().flat_map(|row| row.windows(2).zip(offset_v.windows(2))).fold(
            1.0_f64,
            |factor, (new, offset)| {
                let (rise_v, change_v) = (new[1] - new[0], offset[1] - offset[0]);
                // The slope of the aged curve must be at least a tenth of the new curve's slope.
                if change_v < 0.0 { factor.min(0.9 * rise_v / -change_v) } else { factor }
            },
        );
        offset_v.iter_mut().for_each(|offset_v| *offset_v *= factor);
        self.capacity_ah.push(capacity_ah);
        self.offset_v.push(offset_v);
    }

    /// Sets the standard deviation of the shift, initially [`SHIFT_STD`]. Does nothing if the curve comes from
    /// electrodes, or after [`Self::add_spread`].
    pub fn set_shift_std(&mut self, std: f64) {
        if self.is_shift {
            self.mixes_v[0].iter_mut().flatten().for_each(|mix_v| *mix_v *= std / SHIFT_STD);
        }
    }

    /// Adds the differences between cells of the same type. A mode is a typical shape of these differences, with one
    /// value per SOC breakpoint (V per standard deviation). `modes_v[i]` is added to mix i at every capacity. If mix
    /// and mode have opposite signs, they would cancel, so the mix is negated first.
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

    /// How the aged curve is computed.
    pub fn law(&self) -> AgeingLaw {
        self.law
    }

    /// The modes that [`Self::add_spread`] added (V per standard deviation, one value per SOC breakpoint); empty
    /// without such modes.
    pub fn spread_v(&self) -> &[Vec<f64>; MIXES] {
        &self.spread_v
    }

    /// Offset at a capacity (Ah), over the interval that starts at SOC breakpoint `s`.
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

    /// Lithium lost at a capacity (Ah). Above the new cell's capacity, returns the new cell's loss. Returns `None`
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

    /// Values of `rows` at the SOC breakpoints `at`, and their change per Ah. Each row belongs to one capacity.
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
