//! What a store or a replay says of the connected pack: half-cycles added up, the latest learned values, energy, the last state.
//!
//! Times are nanoseconds since 1970: the wall clock of a store, the log's clock of a replay. Rows of a store and events of a replay have
//! the same names for the same values, so both give the same sums. Energy needs every voltage: a store has none.

use crate::fields::Fields;
use crate::monitor::{Estimate, Event, EventKind, Snapshot};
use crate::quantity::Timestamp;
use crate::store::{HistoryEntry, HistoryQuery, HistoryReader, HistoryTable};

/// Charge that a cell has moved.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Moved {
    /// Both directions, Ah.
    pub(super) charge_ah: f64,
    /// Duration of the charges, s.
    pub(super) charging_s: f64,
    /// Duration of the discharges, s.
    pub(super) discharging_s: f64,
}

/// Latest values learned of a cell, with standard deviations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Learned {
    pub(super) at_ns: i64,
    /// Ah.
    pub(super) capacity: (f64, f64),
    /// Ah, with its own time: of the latest half-cycle that gave one; `None` = no load is configured.
    pub(super) usable: Option<(i64, (f64, f64))>,
    /// Over new.
    pub(super) resistance: (f64, f64),
}

/// A cell's part of a record.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct CellRecord {
    pub(super) moved: Moved,
    pub(super) learned: Option<Learned>,
    /// Of a replay: last power, W, and its time.
    power: Option<(Timestamp, f64)>,
}

/// Everything that a passport is made from, besides the configuration.
#[derive(Debug, Default)]
pub struct Record {
    pub(super) cells: Vec<CellRecord>,
    /// End of the latest half-cycle.
    pub(super) moved_until_ns: Option<i64>,
    /// Why half-cycles are missing.
    pub(super) gap: Option<String>,
    /// Energy moved by all cells of one string, Wh, and the time of the last part; `None` = not known: a store.
    pub(super) energy: Option<(f64, Option<i64>)>,
    /// Longest time between two voltages that counts for the energy, s.
    longest_step_s: f64,
    /// The last state and its time, which its own clock calls `snapshot.time`.
    pub(super) state: Option<(i64, Box<Snapshot>)>,
}

impl Record {
    /// A replay's record, without any event yet; voltages further apart than this, s, give no energy.
    pub fn of_replay(longest_step_s: f64) -> Self {
        Self { energy: Some((0.0, None)), longest_step_s, ..Self::default() }
    }

    /// The connected pack's record in a store.
    ///
    /// # Errors
    /// When the file cannot be read, or its chained rows were changed.
    pub fn of_store(reader: &HistoryReader) -> Result<Self, String> {
        if let Some(broken) = reader.verify()?.broken {
            return Err(format!(
                "the history was changed: row {} is not as it was written, no passport is made of it",
                broken.row
            ));
        }
        let extent = reader.extent()?;
        let mut record =
            Self { state: reader.dated_snapshot().map(|(at, state)| (at, Box::new(state))), ..Self::default() };
        if extent.deleted_half_cycles > 0 {
            record.gap = Some(format!(
                "{} half-cycles were deleted from the store (store.max_half_cycles, store.keep_years)",
                extent.deleted_half_cycles
            ));
        }
        for kind in [HistoryTable::HalfCycle, HistoryTable::Capacity, HistoryTable::Reset] {
            reader.for_each(kind, &HistoryQuery::default(), &mut |entry| {
                if entry.pack == extent.pack {
                    record.take_entry(&entry);
                }
            })?;
        }
        Ok(record)
    }

    fn take_entry(&mut self, entry: &HistoryEntry) {
        let fields = Fields::of_entry(entry);
        match entry.kind {
            HistoryTable::HalfCycle => self.take_half_cycle(entry.wall_ns, &fields),
            HistoryTable::Capacity => self.take_capacity(entry.wall_ns, &fields),
            HistoryTable::Reset if matches!(fields.text("reason"), "damaged" | "rows_lost") => {
                self.gap.get_or_insert_with(|| "the store was damaged, or had no room: rows may be missing".to_owned());
            }
            _ => {}
        }
    }

    /// Takes an event of a replay.
    pub fn take_event(&mut self, event: &Event) {
        let at_ns = event.time.nanos();
        match event.kind {
            EventKind::HalfCycle { .. } => self.take_half_cycle(at_ns, &Fields::of_event(&event.kind)),
            EventKind::Capacity { .. } => self.take_capacity(at_ns, &Fields::of_event(&event.kind)),
            EventKind::PackReplaced { .. } => *self = Self::of_replay(self.longest_step_s),
            _ => {}
        }
    }

    /// Takes an estimate of a replay: the energy since the cell's one before.
    pub fn take_estimate(&mut self, estimate: &Estimate) {
        let longest_s = self.longest_step_s;
        let power_w = (estimate.measured.voltage_v * estimate.measured.current_a).abs();
        let power = power_w.is_finite().then_some((estimate.time, power_w));
        let before = std::mem::replace(&mut self.cell(estimate.cell.index()).power, power);
        let (Some((from, from_w)), Some((to, to_w)), Some((energy_wh, until))) = (before, power, &mut self.energy)
        else {
            return;
        };
        let step_s = to.since(from);
        if (0.0..=longest_s).contains(&step_s) {
            *energy_wh += 0.5 * (from_w + to_w) * step_s / 3600.0;
            *until = Some(to.nanos());
        }
    }

    /// Takes the state at the end of a replay.
    pub fn finish(&mut self, state: Snapshot) {
        self.state = Some((state.time.nanos(), Box::new(state)));
    }

    /// The last state.
    pub fn snapshot(&self) -> Option<&Snapshot> {
        self.state.as_ref().map(|(_, state)| &**state)
    }

    fn cell(&mut self, index: usize) -> &mut CellRecord {
        if self.cells.len() <= index {
            self.cells.resize(index + 1, CellRecord::default());
        }
        &mut self.cells[index]
    }

    fn take_half_cycle(&mut self, at_ns: i64, fields: &Fields) {
        let (Some(cell), Some(charge_ah)) = (fields.whole("cell"), fields.number("charge_ah")) else { return };
        let duration_s = fields.number("duration_s").unwrap_or(0.0);
        let moved = &mut self.cell(cell as usize).moved;
        moved.charge_ah += charge_ah.max(0.0);
        match fields.text("mode") {
            "charge" => moved.charging_s += duration_s,
            _ => moved.discharging_s += duration_s,
        }
        self.moved_until_ns = self.moved_until_ns.max(Some(at_ns));
    }

    fn take_capacity(&mut self, at_ns: i64, fields: &Fields) {
        let capacity = fields.pair("capacity_ah", "capacity_std_ah");
        let resistance = fields.pair("resistance_ratio", "resistance_ratio_std");
        let (Some(cell), Some(capacity), Some(resistance)) = (fields.whole("cell"), capacity, resistance) else {
            return;
        };
        let usable = fields.pair("usable_capacity_ah", "usable_capacity_std_ah").map(|value| (at_ns, value));
        let cell = self.cell(cell as usize);
        let usable = usable.or(cell.learned.and_then(|learned| learned.usable));
        cell.learned = Some(Learned { at_ns, capacity, usable, resistance });
    }

    /// Charge that the pack of so many strings has moved: that of the cell with most, which no missing row lowers. Ah, and the
    /// difference of the durations of discharge and charge, h.
    pub(super) fn moved(&self, strings: f64) -> (f64, f64) {
        let most = self.cells.iter().map(|cell| cell.moved).max_by(|a, b| a.charge_ah.total_cmp(&b.charge_ah));
        let most = most.unwrap_or_default();
        (strings * most.charge_ah, (most.discharging_s - most.charging_s).abs() / 3600.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monitor::MeasuredValues;
    use crate::quantity::{CellIndex, Mode};

    fn half_cycle(time_s: f64, cell: u16, mode: Mode, charge_ah: f64) -> Event {
        let kind = EventKind::HalfCycle {
            cell: CellIndex(cell),
            mode,
            charge_ah,
            swing: None,
            swing_std: None,
            duration_s: 1800.0,
            mean_current_a: 1.0,
            mean_temperature_c: None,
        };
        Event { time: Timestamp::from_secs(time_s), kind }
    }

    fn estimate(time_s: f64, voltage_v: f64, current_a: f64) -> Estimate {
        Estimate {
            time: Timestamp::from_secs(time_s),
            cell: CellIndex(0),
            soc: 0.5,
            soc_std: 0.01,
            branch_v: [f64::NAN; crate::cell::MAX_BRANCHES],
            capacity_ah: 2.0,
            capacity_std_ah: 0.1,
            resistance_ratio: 1.0,
            resistance_ratio_std: 0.1,
            innovation_v: 0.0,
            innovation_std_v: 0.01,
            accepted: true,
            measured: MeasuredValues { voltage_v, current_a, temperature_c: f64::NAN },
        }
    }

    #[test]
    fn half_cycles_of_both_directions_add_up_and_the_fullest_record_counts() {
        let mut record = Record::of_replay(60.0);
        for event in [
            half_cycle(10.0, 0, Mode::Charge, 1.0),
            half_cycle(20.0, 0, Mode::Discharge, 0.5),
            half_cycle(10.0, 1, Mode::Charge, 1.0),
        ] {
            record.take_event(&event);
        }
        assert_eq!(record.moved(3.0), (4.5, 0.0));
        assert_eq!(record.moved_until_ns, Some(20_000_000_000));
        let replaced = EventKind::PackReplaced { capacity_ah: None, capacity_std_ah: None };
        record.take_event(&Event { time: Timestamp::from_secs(30.0), kind: replaced });
        assert_eq!((record.moved(1.0), record.moved_until_ns), ((0.0, 0.0), None), "another pack begins at nothing");
    }

    #[test]
    fn energy_counts_both_directions_and_no_gap() {
        let mut record = Record::of_replay(60.0);
        // 7.2 W for 50 s, and the same in the other direction; two minutes of nothing between them; a voltage without a current.
        for (time_s, current_a) in
            [(0.0, 2.0), (50.0, 2.0), (180.0, -2.0), (230.0, -2.0), (250.0, f64::NAN), (260.0, 2.0)]
        {
            record.take_estimate(&estimate(time_s, 3.6, current_a));
        }
        let (energy_wh, until) = record.energy.unwrap();
        assert!((energy_wh - 2.0 * 7.2 * 50.0 / 3600.0).abs() < 1e-12, "{energy_wh}");
        assert_eq!(until, Some(230_000_000_000));
    }
}
