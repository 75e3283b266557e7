//! Balancing taken out of the differences between the cells, where bits show which cells are bled.

use serde::{Deserialize, Serialize};

use super::{CellFaultDetector, inner_half};
use crate::cell_faults::bleed_timer::{BalancingConfig, BleedTime, BleedTimer};
use crate::quantity::{InvalidState, Timestamp};

/// Deviation of what the bits say was bled, part of it: the resistors of one BMS are alike, their current follows the voltage.
const BLEED_PART: f64 = 0.2;
/// Most that a cell loses beside the others before it is like them, SOC: a BMS bleeds it down to the lowest.
const MOST_BESIDE: f64 = 0.1;

/// Errors that lie to one side for as long as something lasts: their sum, not their squares, grows.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Lasting {
    sum: f64,
}

impl Lasting {
    /// What one more row adds to the square of the sum. The sum is bounded, and with it what a row can add; a row in which nothing
    /// was lost ends it.
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

/// What is bled of one cell.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Bleed {
    pub(super) timer: BleedTimer,
    /// Beside the middle cells, SOC, while it is bled or they are.
    bled: Lasting,
    /// At most, SOC, while it is not known.
    unseen: Lasting,
}

impl Bleed {
    /// Whether no bit has come so far.
    pub(super) fn is_unused(&self) -> bool {
        *self == Self::default()
    }

    /// The time so far does not count.
    pub(super) fn forget_time(&mut self) {
        self.timer.forget_time();
        *self = Self { timer: self.timer, ..Self::default() };
    }

    /// Checks the numbers of a stored state.
    pub(super) fn check(&self) -> Result<(), InvalidState> {
        self.timer.check()?;
        InvalidState::unless_natural("charge bled of a cell", self.bled.sum.abs())?;
        InvalidState::unless_natural("charge bled unseen of a cell", self.unseen.sum)
    }
}

impl CellFaultDetector {
    /// Takes a bit of the BMS, which holds until `holds_until` or the next one: whether it bleeds a cell; `None` = it cannot be read.
    pub fn handle_balancing(&mut self, cell: usize, time: Timestamp, is_bled: Option<bool>, holds_until: Timestamp) {
        let Some(watched) = self.cells.get(cell) else { return };
        // What a cell loses beside what the bits show is a leak.
        let begins = is_bled.is_some() && !watched.bleed.timer.has_bits && self.may_be_bled(cell);
        let watched = &mut self.cells[cell];
        watched.bleed.timer.take(time, is_bled, holds_until);
        if begins {
            watched.difference.watch_leak();
        }
    }

    /// Takes that no bit was received from a time to another, because the daemon did not run.
    pub fn note_unheard(&mut self, from: Timestamp, to: Timestamp) {
        self.cells.iter_mut().for_each(|cell| cell.bleed.timer.note_unheard(from, to));
    }

    /// Removes the charge that was bled since the last row from each cell's difference, less that of the middle cells. `balancing`:
    /// `None` forgets all bits.
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
            // As without bits: the lowest cell is never bled, and of a cell without bits what the others lost may be its own too.
            let unseen_s = match has_bits {
                _ if self.lowest == Some(index) => 0.0,
                true => time.unknown_s + silent_s,
                false => middle_s,
            };
            let variance = BLEED_PART * BLEED_PART * cell.bleed.bled.add(soc)
                // Mean square of a part that is uniform between -1 and 1.
                + (1.0 / 3.0) * cell.bleed.unseen.add(soc_per_s * unseen_s);
            cell.difference.remove_charge(soc, variance);
        }
    }

    /// For how long the cells whose voltages are in the middle half were bled, mean, s.
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

    /// Three cells of 60 Ah with a bit of 0 at the beginning.
    fn diagnosis() -> CellFaultDetector {
        let mut diagnosis = CellFaultDetector::new(3);
        (0..3).for_each(|cell| diagnosis.handle_balancing(cell, at(0.0), Some(false), at(10.0)));
        diagnosis
    }

    /// Deviation that a cell's SOC has got by what may have been bled.
    fn lost_std(diagnosis: &mut CellFaultDetector, end_s: f64, balancing: BalancingConfig) -> f64 {
        let variance = |diagnosis: &CellFaultDetector| diagnosis.cells[0].difference.state(SOC).variance;
        let before = variance(diagnosis);
        diagnosis.cells.iter_mut().for_each(|cell| cell.bleed.timer.begin_row(at(end_s)));
        diagnosis.remove_bled_charge(at(end_s), 60.0, Some(balancing));
        (variance(diagnosis) - before).sqrt()
    }

    #[test]
    fn a_time_without_bits_is_unknown_unless_the_bms_bleeds_only_while_it_sends_and_the_daemon_ran() {
        // A thousandth of the capacity an hour.
        let unknown = 0.008 / 3.0_f64.sqrt();
        let silent = BalancingConfig { is_only_while_sent: false, ..BALANCING };
        let near = |a: f64, b: f64| (a - b).abs() < 0.01 * unknown;
        assert!(near(lost_std(&mut diagnosis(), 8.0 * HOUR, BALANCING), 0.0));
        assert!(near(lost_std(&mut diagnosis(), 8.0 * HOUR, silent), unknown));
        let mut stopped = diagnosis();
        stopped.note_unheard(at(10.0), at(8.0 * HOUR));
        assert!(near(lost_std(&mut stopped, 8.0 * HOUR, BALANCING), unknown));
    }

    #[test]
    fn what_was_bled_is_taken_out_and_known_within_a_fifth() {
        let mut bled = diagnosis();
        bled.handle_balancing(0, at(10.0), Some(true), at(10.0 + 10.0 * HOUR));
        let std = lost_std(&mut bled, 10.0 + 10.0 * HOUR, BALANCING);
        let soc = bled.cells[0].difference.state(SOC).mean;
        assert!((soc + 0.01).abs() < 1e-9 && (std - 0.2 * 0.01).abs() < 1e-9, "{soc} {std}");
        assert_eq!(bled.cells[1].difference.state(SOC).mean, 0.0);
    }

    #[test]
    fn a_year_unseen_counts_as_the_most_a_cell_loses_and_each_further_hour_as_little() {
        let mut year = diagnosis();
        let silent = BalancingConfig { is_only_while_sent: false, ..BALANCING };
        let std = lost_std(&mut year, 8760.0 * HOUR, silent);
        assert!((std - MOST_BESIDE / 3.0_f64.sqrt()).abs() < 1e-6, "{std}");
        // A thousandth of the capacity each, to the same side as before.
        let mut last = std;
        for row in 1..100 {
            last = lost_std(&mut year, (8760.0 + f64::from(row)) * HOUR, silent);
        }
        let hour = (MOST_BESIDE + 0.001).powi(2) - MOST_BESIDE.powi(2);
        assert!((last * last - hour / 3.0).abs() < 1e-9, "a row, not all of them: {std}, then {last}");
        assert!(year.check(3).is_ok());
    }

    #[test]
    fn errors_to_one_side_add_up_until_nothing_is_added() {
        let mut lasting = Lasting::default();
        let added = [0.01, 0.01, -0.01, 0.0, 0.02].map(|part| lasting.add(part));
        assert!(added.iter().zip([1.0, 3.0, 0.0, 0.0, 4.0]).all(|(a, b)| (a - 1e-4 * b).abs() < 1e-12), "{added:?}");
        for _ in 0..1000 {
            lasting.add(0.02);
        }
        assert_eq!(lasting.sum, MOST_BESIDE);
    }
}
