//! Creates data for the tests of the report: a recording of estimates, and a worn pack that gives every card of the
//! report a value.
//!
//! Times are in s; cells count from 0. Standard deviations differ between quantities and between neighbouring cells, so
//! that a test detects a swapped standard deviation.

use std::path::Path;

use super::data::{Data, Origin};
use crate::config::{self, Config};
use crate::monitor::{Estimate, Event, EventKind, MeasuredValues};
use crate::quantity::catalogue::{Quantity, RecordedValues};
use crate::quantity::{CellIndex, Mode, Timestamp};

/// Number of half-cycles of the worn pack. It is large enough to forecast the remaining life of every cell.
pub(super) const HALVES: u16 = 60;
/// End of the first half-cycle (2023-11-14), s since 1970.
const FIRST_END_S: f64 = 1.7e9;
const HALF_CYCLE_S: f64 = 21_600.0;
/// Number of estimates of a recording, not counting the first.
const STEPS: u16 = 60;

/// Loads the demo's configuration: cells with a rated capacity of 2.6 Ah, and the end of life at 2.08 Ah.
pub(super) fn config() -> Config {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/demo.toml");
    config::load(&path).expect("shipped")
}

pub(super) fn recording(first_s: f64, length_s: f64) -> Data {
    let mut data = Data::new(Origin::Replay);
    for step in 0..=STEPS {
        let part = f64::from(step) / f64::from(STEPS);
        data.take_estimate(&Estimate {
            time: Timestamp::from_secs(first_s + part * length_s),
            cell: CellIndex(0),
            soc: 0.9 - 0.5 * part,
            soc_std: 0.01,
            branch_v: [0.0; crate::cell::MAX_BRANCHES],
            capacity_ah: 2.5,
            capacity_std_ah: 0.02,
            resistance_ratio: 1.0,
            resistance_ratio_std: 0.1,
            innovation_v: 0.002,
            innovation_std_v: 0.006,
            accepted: true,
            measured: MeasuredValues { voltage_v: 3.7, current_a: 1.0, temperature_c: 25.0 },
        });
    }
    data
}

#[derive(Debug, Clone, Copy)]
pub(super) struct CellStds {
    pub(super) capacity_ah: f64,
    pub(super) usable_ah: f64,
    pub(super) resistance: f64,
    /// Losses of lithium and of the electrodes (negative, positive), fractions.
    pub(super) losses: [f64; 3],
}

/// Returns the standard deviations of a cell. They are the same in every half-cycle.
pub(super) fn stds(cell: u16) -> CellStds {
    let own = f64::from(cell % 4);
    let [capacity_ah, usable_ah, resistance] = [0.031, 0.052, 0.073].map(|std| std + 0.001 * own);
    CellStds { capacity_ah, usable_ah, resistance, losses: [0.02, 0.07, 0.12].map(|std| std + 0.01 * own) }
}

/// Creates a pack at the end of [`HALVES`] half-cycles. The last cell has the smallest capacity. The first cell has the
/// smallest usable capacity, the largest resistance and the largest loss of the positive electrode. The second cell has
/// the largest loss of lithium. The third cell has the largest loss of the negative electrode.
pub(super) fn worn(cells: u16) -> Data {
    let mut data = Data::new(Origin::Replay);
    for half in 0..HALVES {
        let at = |kind| Event { time: Timestamp::from_secs(end_s(half)), kind };
        for cell in 0..cells {
            [half_cycle(half, cell), capacity(half, cell), losses(cell)]
                .into_iter()
                .for_each(|kind| data.take_event(&at(kind)));
        }
        if half % 2 == 1 {
            let seconds = Some(6000.0 - 10.0 * f64::from(half));
            let kind = EventKind::RechargePeriod { seconds, normalised_s: seconds, normalised_std_s: Some(60.0) };
            data.take_event(&at(kind));
        }
    }
    data
}

pub(super) fn end_s(half: u16) -> f64 {
    FIRST_END_S + HALF_CYCLE_S * f64::from(half)
}

fn capacity_ah(half: u16, cell: u16) -> f64 {
    2.6 * (1.0 - (0.002 + 0.000_01 * f64::from(cell)) * f64::from(half))
}

fn half_cycle(half: u16, cell: u16) -> EventKind {
    EventKind::HalfCycle {
        cell: CellIndex(cell),
        mode: if half % 2 == 1 { Mode::Charge } else { Mode::Discharge },
        charge_ah: capacity_ah(half, cell),
        swing: Some(1.0),
        swing_std: Some(0.01),
        duration_s: HALF_CYCLE_S / 2.0,
        mean_current_a: 0.8,
        mean_temperature_c: Some(25.0),
    }
}

fn capacity(half: u16, cell: u16) -> EventKind {
    let stds = stds(cell);
    EventKind::Capacity {
        cell: CellIndex(cell),
        measured_ah: Some(capacity_ah(half, cell)),
        measured_std_ah: Some(0.01),
        values: RecordedValues::default()
            .with(Quantity::Capacity, Some((capacity_ah(half, cell), stds.capacity_ah)))
            .with(
                Quantity::UsableCapacity,
                Some((2.4 - 0.005 * f64::from(half) + 0.001 * f64::from(cell), stds.usable_ah)),
            )
            .with(
                Quantity::ResistanceRatio,
                Some((1.0 + 0.01 * f64::from(half) - 0.001 * f64::from(cell), stds.resistance)),
            ),
    }
}

fn losses(cell: u16) -> EventKind {
    let [lli_std, lam_ne_std, lam_pe_std] = stds(cell).losses;
    let lost = |most: f64, of: u16| most - 0.001 * f64::from(cell.abs_diff(of));
    EventKind::LossModes {
        cell: CellIndex(cell),
        lli: lost(0.2, 1),
        lli_std,
        lam_ne: lost(0.3, 2),
        lam_ne_std,
        lam_pe: lost(0.4, 0),
        lam_pe_std,
    }
}
