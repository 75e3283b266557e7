//! Scores the life of a cell: the usable capacity after each discharge is compared with the published capacity.

use serde::Serialize;

use super::ScoreSettings;
use super::cycles::CycleTable;
use super::soc::{largest, mean};
use crate::OF_95;
use crate::monitor::{Event, EventKind};
use crate::quantity::Mode;
use crate::quantity::catalogue::Quantity;

/// Estimates after one discharge.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DischargeScore {
    /// Number of the discharge, from 1.
    pub number: usize,
    /// Published capacity down to the load's cut-off voltage (Ah); `None` = not stated.
    pub truth_ah: Option<f64>,
    /// Usable capacity at the configured load (Ah).
    pub usable_ah: f64,
    /// Standard deviation of the usable capacity (Ah).
    pub usable_std_ah: f64,
    /// Capacity between the full and the empty open-circuit voltage (Ah).
    pub capacity_ah: f64,
    /// Standard deviation of the capacity (Ah).
    pub capacity_std_ah: f64,
    /// Resistance relative to new.
    pub resistance_ratio: f64,
    /// Standard deviation of `resistance_ratio`.
    pub resistance_ratio_std: f64,
}

/// Errors of the usable capacities over a life, without the skipped discharges.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LifeScore {
    /// Number of discharges in the table.
    pub discharges: usize,
    /// Number of discharges in the statistics.
    pub scored: usize,
    /// Number of discharges that were not skipped but have no estimate or no published capacity.
    pub left_out: usize,
    /// Mean |estimate - published| (Ah).
    pub mean_abs_error_ah: f64,
    /// Mean (estimate - published) (Ah).
    pub mean_error_ah: f64,
    /// Largest |estimate - published| (Ah).
    pub max_abs_error_ah: f64,
    /// Share of discharges whose 95 % interval contains the published value, fraction.
    pub coverage: f64,
    /// Mean half-width of the interval (Ah).
    pub mean_half_width_ah: f64,
    /// Threshold for `first_below_estimate` and `first_below_truth` (Ah).
    pub threshold_ah: f64,
    /// First unskipped discharge whose estimate is below the threshold.
    pub first_below_estimate: Option<usize>,
    /// First unskipped discharge whose published capacity is below the threshold.
    pub first_below_truth: Option<usize>,
    /// Every discharge with an estimate.
    pub each: Vec<DischargeScore>,
}

/// Collects the estimates after each discharge from the monitor's events.
#[derive(Debug, Default)]
pub(super) struct LifeRecorder {
    /// Mode of the latest half-cycle. The capacity event of this half-cycle follows.
    mode: Option<Mode>,
    each: Vec<DischargeScore>,
}

impl LifeRecorder {
    pub(super) fn observe(&mut self, event: &Event, table: &CycleTable) {
        match event.kind {
            EventKind::HalfCycle { mode, .. } => self.mode = Some(mode),
            EventKind::Capacity { values, .. } if self.mode == Some(Mode::Discharge) => {
                let [Some((capacity_ah, capacity_std_ah)), Some((usable_ah, usable_std_ah)), Some(resistance)] =
                    [Quantity::Capacity, Quantity::UsableCapacity, Quantity::ResistanceRatio]
                        .map(|quantity| values.pair(quantity))
                else {
                    return;
                };
                let number = table.number_at(event.time);
                let Some(discharge) = number.checked_sub(1).and_then(|index| table.discharges.get(index)) else {
                    return;
                };
                // If a discharge was split, the last estimate counts.
                self.each.pop_if(|before| before.number == number);
                self.each.push(DischargeScore {
                    number,
                    truth_ah: discharge.capacity_ah,
                    usable_ah,
                    usable_std_ah,
                    capacity_ah,
                    capacity_std_ah,
                    resistance_ratio: resistance.0,
                    resistance_ratio_std: resistance.1,
                });
            }
            _ => {}
        }
    }

    pub(super) fn score(self, table: &CycleTable, settings: &ScoreSettings) -> LifeScore {
        score(self.each, table, settings.threshold_ah, settings.skip_cycles)
    }
}

fn score(each: Vec<DischargeScore>, table: &CycleTable, threshold_ah: f64, skip: usize) -> LifeScore {
    let counted = each.iter().filter(|d| d.number > skip);
    let pairs: Vec<(f64, f64)> =
        counted.clone().filter_map(|d| Some((d.usable_ah - d.truth_ah?, OF_95 * d.usable_std_ah))).collect();
    let mut truths = (1..).zip(&table.discharges).skip(skip);
    LifeScore {
        discharges: table.discharges.len(),
        scored: pairs.len(),
        left_out: table.discharges.len().saturating_sub(skip + pairs.len()),
        mean_abs_error_ah: mean(pairs.iter().map(|(error, _)| error.abs())),
        mean_error_ah: mean(pairs.iter().map(|(error, _)| *error)),
        max_abs_error_ah: largest(pairs.iter().map(|(error, _)| error.abs())),
        coverage: mean(pairs.iter().map(|(error, width)| f64::from(error.abs() <= *width))),
        mean_half_width_ah: mean(pairs.iter().map(|(_, width)| *width)),
        threshold_ah,
        first_below_estimate: counted.clone().find(|d| d.usable_ah < threshold_ah).map(|d| d.number),
        first_below_truth: truths.find(|(_, d)| d.capacity_ah.is_some_and(|ah| ah < threshold_ah)).map(|(n, _)| n),
        each,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quantity::catalogue::RecordedValues;
    use crate::quantity::{CellIndex, Timestamp};
    use crate::score::cycles::CycleTable;

    fn table() -> CycleTable {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cycles.csv");
        let rows =
            "1,discharge,100,1.5\n2,discharge,200,1.45\n3,discharge,300,1.41\n4,discharge,400,1.39\n5,discharge,500,\n";
        std::fs::write(&path, format!("cycle,type,start,capacity_ah_source\n{rows}")).expect("written");
        CycleTable::read(&path).expect("reads")
    }

    fn capacity_event(time_s: f64, usable_ah: f64) -> Event {
        let kind = EventKind::Capacity {
            cell: CellIndex(0),
            measured_ah: None,
            measured_std_ah: None,
            values: RecordedValues::default()
                .with(Quantity::Capacity, Some((2.0, 0.1)))
                .with(Quantity::UsableCapacity, Some((usable_ah, 0.01)))
                .with(Quantity::ResistanceRatio, Some((1.0, 0.1))),
        };
        Event { time: Timestamp::from_secs(time_s), kind }
    }

    fn half_cycle(time_s: f64, mode: Mode) -> Event {
        let kind = EventKind::HalfCycle {
            cell: CellIndex(0),
            mode,
            charge_ah: 1.0,
            swing: None,
            swing_std: None,
            duration_s: 1.0,
            mean_current_a: 1.0,
            mean_temperature_c: None,
        };
        Event { time: Timestamp::from_secs(time_s), kind }
    }

    #[test]
    fn estimates_are_compared_with_their_own_discharge() {
        let table = table();
        let mut life = LifeRecorder::default();
        let discharges = [(150.0, 1.3), (250.0, 9.0), (260.0, 1.46), (350.0, 1.39), (450.0, 1.36), (550.0, 1.3)];
        for (time_s, usable_ah) in discharges {
            life.observe(&half_cycle(time_s, Mode::Discharge), &table);
            life.observe(&capacity_event(time_s, usable_ah), &table);
            life.observe(&half_cycle(time_s + 1.0, Mode::Charge), &table);
            life.observe(&capacity_event(time_s + 1.0, 7.0), &table); // ignored: follows a charge
        }
        let score = score(life.each, &table, 1.4, 1);
        assert_eq!((score.discharges, score.scored, score.left_out, score.each.len()), (5, 3, 1, 5));
        // Errors of discharges 2, 3 and 4: +0.01, -0.02, -0.03; half-width 0.0196.
        assert!((score.mean_abs_error_ah - 0.02).abs() < 1e-12 && (score.mean_error_ah + 0.04 / 3.0).abs() < 1e-12);
        assert!((score.max_abs_error_ah - 0.03).abs() < 1e-12 && (score.coverage - 1.0 / 3.0).abs() < 1e-12);
        assert!((score.mean_half_width_ah - 0.0196).abs() < 1e-12);
        // Discharge 1 is skipped, although its estimate is below the threshold.
        assert_eq!((score.first_below_estimate, score.first_below_truth), (Some(3), Some(4)));
    }
}
