//! Finds voltage channels that do not show the voltage of their own cell, because they are frozen at one value or show
//! another cell. The middle voltage of the pack is the mean of the middle half of the cell voltages.

use serde::{Deserialize, Serialize};

use super::row::CellSums;
use crate::quantity::InvalidState;

/// If the middle voltage of the pack changes by more than this while a channel's value stays the same, the channel is
/// frozen (V).
const FROZEN_V: f64 = 0.03;
/// Minimum number of voltage changes within a row (a few minutes of samples) for a comparison of channels.
/// [`Channel::doubled`] also requires that the channels agree in ten consecutive rows. Fewer rows are not enough: at a
/// resolution of 2.5 mV, two of 96 healthy cells agreed in three rows.
const LEAST_CHANGES: u32 = 10;

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct Channel {
    /// Middle voltage of the pack (V) in the row in which the channel's value last changed. Before the first change:
    /// in the first row after the start or after a gap.
    middle_v: Option<f64>,
    pub(super) is_frozen: bool,
    /// The channel that shows the same values, and the number of consecutive rows in which the two channels agreed.
    same_as: Option<(u16, u8)>,
}

impl Channel {
    pub(super) fn end_row(&mut self, sums: &CellSums, middle_v: f64) {
        if sums.changes > 0 {
            (self.middle_v, self.is_frozen) = (Some(middle_v), false);
        } else if sums.count > 1 {
            let was_v = *self.middle_v.get_or_insert(middle_v);
            self.is_frozen |= (middle_v - was_v).abs() > FROZEN_V;
        }
    }

    /// Handles a gap in the samples: all voltages may have changed during the gap.
    pub(super) fn interrupt(&mut self) {
        self.middle_v = None;
    }

    /// The other channel that shows the same values; `None` if the two channels have agreed in too few rows.
    pub(super) fn doubled(&self) -> Option<u16> {
        self.same_as.filter(|(_, rows)| *rows >= 10).map(|(other, _)| other)
    }

    pub(super) fn check(&self, cells: usize) -> Result<(), InvalidState> {
        InvalidState::unless_numbers("the voltage of a frozen channel's pack", self.middle_v)?;
        let (other, _) = self.same_as.unwrap_or_default();
        InvalidState::unless(
            usize::from(other) < cells,
            "the channel with the values of another channel",
            f64::from(other),
            "a cell of the pack",
        )
    }
}

/// Compares the channels of a row. Two channels form a pair if they show the same sequence of values and no third
/// channel shows it. If the number of different sequences is at most half of the number of cells, there are no pairs.
pub(super) fn compare(channels: &mut [Channel], sums: &[CellSums]) {
    let compared = |cell: &usize| sums[*cell].changes >= LEAST_CHANGES;
    let mut order: Vec<usize> = (0..sums.len()).filter(compared).collect();
    if order.len() < sums.len() / 2 + 1 {
        return;
    }
    order.sort_by_key(|&cell| (sums[cell].digest, cell));
    let alike: Vec<&[usize]> = order.chunk_by(|&a, &b| sums[a].digest == sums[b].digest).collect();
    let are_cells_distinct = 2 * alike.len() > sums.len();
    for group in alike {
        for &cell in group {
            let other = (are_cells_distinct && group.len() == 2).then(|| group[usize::from(group[0] == cell)] as u16);
            let channel = &mut channels[cell];
            channel.same_as = match (other, channel.same_as) {
                (None, _) => None,
                (Some(other), Some((before, rows))) if before == other => Some((other, rows.saturating_add(1))),
                (Some(other), _) => Some((other, 1)),
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quantity::Timestamp;

    fn doubled(channels: &[Channel]) -> Vec<Option<u16>> {
        channels.iter().map(Channel::doubled).collect()
    }

    fn row(voltages_v: &[f64]) -> CellSums {
        let mut sums = CellSums::default();
        voltages_v.iter().enumerate().for_each(|(i, v)| sums.add(Timestamp::from_secs(i as f64), *v, 0.0, None, 0.0));
        sums
    }

    #[test]
    fn channel_is_frozen_after_others_have_moved() {
        let mut channel = Channel::default();
        channel.end_row(&row(&[3.7, 3.71]), 3.70);
        for middle_v in [3.69, 3.68, 3.675] {
            channel.end_row(&row(&[3.71, 3.71]), middle_v);
            assert!(!channel.is_frozen, "the others have moved by less than the limit");
        }
        channel.end_row(&row(&[3.71, 3.71]), 3.66);
        assert!(channel.is_frozen);
        channel.end_row(&row(&[3.71, 3.70]), 3.66);
        assert!(!channel.is_frozen, "the channel changes again");
        channel.interrupt();
        channel.end_row(&row(&[3.71, 3.71]), 3.60);
        channel.end_row(&row(&[3.71, 3.71]), 3.61);
        assert!(!channel.is_frozen, "the others have moved during a gap in the record");
    }

    #[test]
    fn equal_channels_are_doubled_unless_all_channels_agree() {
        let shown = |offset: f64| -> Vec<f64> { (0..30).map(|i| 3.7 + offset + f64::from(i % 7) * 0.001).collect() };
        let mut channels = vec![Channel::default(); 4];
        let one_doubled = [shown(0.0), shown(0.002), shown(0.0), shown(0.005)].map(|v| row(&v));
        (0..9).for_each(|_| compare(&mut channels, &one_doubled));
        assert_eq!(doubled(&channels), [None; 4], "too few rows");
        compare(&mut channels, &one_doubled);
        assert_eq!(doubled(&channels), [Some(2), None, Some(0), None]);
        let alike = [shown(0.0), shown(0.0), shown(0.0), shown(0.0)].map(|v| row(&v));
        compare(&mut channels, &alike);
        assert_eq!(doubled(&channels), [None; 4]);
    }
}
