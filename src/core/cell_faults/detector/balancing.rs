//! Corrects the differences between the cells for balancing, if the BMS sends bits that show which cells it bleeds.
//! To bleed a cell is to discharge it through a balancing resistor.

use serde::{Deserialize, Serialize};

use super::{CellFaultDetector, inner_half};
use crate::cell_faults::bleed_timer::{BalancingConfig, BleedTime, BleedTimer};
use crate::quantity::{InvalidState, Timestamp};

/// Relative standard deviation of the bled charge that is computed from the bits. The balancing resistors of one BMS
/// are equal, but the bleed current depends on the cell voltage.
const BLEED_PART: f64 = 0.2;
/// Maximum SOC that bleeding can take from a cell relative to the other cells. A BMS bleeds a cell only down to the
/// level of the lowest cell.
const MOST_BESIDE: f64 = 0.1;

/// Sum of errors that keep their sign while their cause lasts. Such errors are added linearly, not as squares.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CorrelatedError {
    sum: f64,
}

impl CorrelatedError {
    /// Adds the error of one row. Returns the increase of the squared sum. A row with the error 0 resets the sum.
    fn add(&mut self, part: f64) -> f64 {
        let before = std::mem::take(&mut self.sum);
        let part = part.clamp(-MOST_BESIDE, MOST_BESIDE);
        let sum = before + part;
        if part != 0.0 {
            self.sum = sum.clamp(-MOST_BESIDE, MOST_BESIDE);
        }
        (sum * sum - before * before).max(0.0)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Bleed {
    pub(super) timer: BleedTimer,
    /// SOC bled from this cell minus the mean SOC bled from the middle cells (the middle half by voltage). Summed
    /// over all rows since this difference was last 0.
    bled: CorrelatedError,
    /// Maximum SOC that the cell may have lost while it was unknown whether the cell was bled.
    unseen: CorrelatedError,
}

impl Bleed {
    /// Whether no bit has been received yet.
    pub(super) fn is_unused(&self) -> bool {
        *self == Self::default()
    }

    pub(super) fn forget_time(&mut self) {
        self.timer.forget_time();
        *self = Self { timer: self.timer, ..Self::default() };
    }

    pub(super) fn check(&self) -> Result<(), InvalidState> {
        self.timer.check()?;
        InvalidState::unless_natural("the charge bled from a cell", self.bled.sum.abs())?;
        InvalidState::unless_natural("the charge bled from a cell in unknown state", self.unseen.sum)
    }
}

impl CellFaultDetector {
    /// Handles a balancing bit of a cell. The bit is valid until `holds_until` or until the next bit. `is_bled` is
    /// `None` if the bit cannot be read.
    pub fn handle_balancing(&mut self, cell: usize, time: Timestamp, is_bled: Option<bool>, holds_until: Timestamp) {
        let Some(watched) = self.cells.get(cell) else { return };
        // From the first bit on, any loss that the bits do not explain is a leak.
        let begins = is_bled.is_some() && !watched.bleed.timer.has_bits && self.may_be_bled(cell);
        let watched = &mut self.cells[cell];
        watched.bleed.timer.take(time, is_bled, holds_until);
        if begins {
            watched.difference.watch_leak();
        }
    }

    /// Handles a period in which the daemon did not run, so it received no bits.
    pub fn note_missed_bits(&mut self, from: Timestamp, to: Timestamp) {
        self.cells.iter_mut().for_each(|cell| cell.bleed.timer.note_missed_bits(from, to));
    }

    /// Subtracts from each cell the charge that the BMS has bled from it since the last row, relative to the middle
    /// cells. If `balancing` is `None`, discards everything learned from balancing bits.
    pub(super) fn remove_bled_charge(&mut self, time: Timestamp, capacity_ah: f64, balancing: Option<BalancingConfig>) {
        let Some(balancing) = balancing else {
            return self.cells.iter_mut().for_each(|cell| cell.bleed = Bleed::default());
        };
        let times: Vec<BleedTime> = self.cells.iter_mut().map(|cell| cell.bleed.timer.end_row(time)).collect();
        let middle_s = self.bled_in_middle_s(&times);
        let soc_per_s = balancing.bleed_a / (3600.0 * capacity_ah);
        for (index, (cell, time)) in self.cells.iter_mut().zip(&times).enumerate() {
            let has_bits = cell.bleed.timer.has_bits;
            let soc = if has_bits { soc_per_s * (time.bled_s - middle_s) } else { 0.0 };
            let silent_s = if balancing.is_only_while_sent { 0.0 } else { time.silent_s };
            // A BMS never bleeds the lowest cell. If a cell has no bits, it may have been bled for as long as the
            // middle cells.
            let unseen_s = match has_bits {
                _ if self.lowest == Some(index) => 0.0,
                true => time.unknown_s + silent_s,
                false => middle_s,
            };
            let variance = BLEED_PART * BLEED_PART * cell.bleed.bled.add(soc)
                // 1/3 is the mean square of a value that is uniformly distributed between -1 and 1.
                + (1.0 / 3.0) * cell.bleed.unseen.add(soc_per_s * unseen_s);
            cell.difference.remove_charge(soc, variance);
        }
    }

    fn bled_in_middle_s(&self, times: &[BleedTime]) -> f64 {
        let known = self.cells.iter().zip(times).filter(|(cell, _)| cell.bleed.timer.has_bits);
        let mut by_voltage: Vec<(f64, f64)> =
            known.filter_map(|(cell, time)| Some((cell.sums.mean_v()?, time.bled_s))).collect();
        let inner = inner_half(&mut by_voltage, |(voltage_v, _)| *voltage_v);
        inner.iter().map(|(_, bled_s)| bled_s).sum::<f64>() / inner.len().max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell_faults::difference::SOC;

    const BALANCING: BalancingConfig = BalancingConfig { bleed_a: 0.06, max_age_s: 10.0, is_only_while_sent: true };
    const HOUR: f64 = 3600.0;

    fn at(seconds: f64) -> Timestamp {
        Timestamp::from_secs(seconds)
    }

    /// Three cells of 60 Ah. At time 0, a bit with the value 0 was received for each cell.
    fn diagnosis() -> CellFaultDetector {
        let mut diagnosis = CellFaultDetector::new(3);
        (0..3).for_each(|cell| diagnosis.handle_balancing(cell, at(0.0), Some(false), at(10.0)));
        diagnosis
    }

    /// Ends a row at `end_s`. Returns the standard deviation that this adds to the SOC of cell 0, because the cell may
    /// have been bled.
    fn lost_std(diagnosis: &mut CellFaultDetector, end_s: f64, balancing: BalancingConfig) -> f64 {
        let variance = |diagnosis: &CellFaultDetector| diagnosis.cells[0].difference.state(SOC).variance;
        let before = variance(diagnosis);
        diagnosis.cells.iter_mut().for_each(|cell| cell.bleed.timer.begin_row(at(end_s)));
        diagnosis.remove_bled_charge(at(end_s), 60.0, Some(balancing));
        (variance(diagnosis) - before).sqrt()
    }

    #[test]
    fn time_without_bits_is_unknown_unless_configured_otherwise() {
        // Standard deviation of the SOC that a 60 Ah cell loses in 8 h at 0.06 A, for a uniform distribution.
        let unknown = 0.008 / 3.0_f64.sqrt();
        let silent = BalancingConfig { is_only_while_sent: false, ..BALANCING };
        let near = |a: f64, b: f64| (a - b).abs() < 0.01 * unknown;
        assert!(near(lost_std(&mut diagnosis(), 8.0 * HOUR, BALANCING), 0.0));
        assert!(near(lost_std(&mut diagnosis(), 8.0 * HOUR, silent), unknown));
        let mut stopped = diagnosis();
        stopped.note_missed_bits(at(10.0), at(8.0 * HOUR));
        assert!(near(lost_std(&mut stopped, 8.0 * HOUR, BALANCING), unknown));
    }

    #[test]
    fn bled_charge_is_removed_with_its_deviation() {
        let mut bled = diagnosis();
        bled.handle_balancing(0, at(10.0), Some(true), at(10.0 + 10.0 * HOUR));
        let std = lost_std(&mut bled, 10.0 + 10.0 * HOUR, BALANCING);
        let soc = bled.cells[0].difference.state(SOC).mean;
        assert!((soc + 0.01).abs() < 1e-9 && (std - 0.2 * 0.01).abs() < 1e-9, "{soc} {std}");
        assert_eq!(bled.cells[1].difference.state(SOC).mean, 0.0);
    }

    #[test]
    fn unseen_loss_is_bounded_over_a_year() {
        let mut year = diagnosis();
        let silent = BalancingConfig { is_only_while_sent: false, ..BALANCING };
        let std = lost_std(&mut year, 8760.0 * HOUR, silent);
        assert!((std - MOST_BESIDE / 3.0_f64.sqrt()).abs() < 1e-6, "{std}");
        // Each further hour may take another thousandth of the capacity, always with the same sign.
        let mut last = std;
        for row in 1..100 {
            last = lost_std(&mut year, (8760.0 + f64::from(row)) * HOUR, silent);
        }
        let hour = (MOST_BESIDE + 0.001).powi(2) - MOST_BESIDE.powi(2);
        assert!((last * last - hour / 3.0).abs() < 1e-9, "one row adds only its own loss: {std}, then {last}");
        assert!(year.check(3).is_ok());
    }

    #[test]
    fn lasting_errors_add_up_until_reset() {
        let mut lasting = CorrelatedError::default();
        let added = [0.01, 0.01, -0.01, 0.0, 0.02].map(|part| lasting.add(part));
        assert!(added.iter().zip([1.0, 3.0, 0.0, 0.0, 4.0]).all(|(a, b)| (a - 1e-4 * b).abs() < 1e-12), "{added:?}");
        for _ in 0..1000 {
            lasting.add(0.02);
        }
        assert_eq!(lasting.sum, MOST_BESIDE);
    }
}
