//! Collects the record of the connected pack from a store or a replay: sums of half-cycles, energy, latest learned
//! values, last state.
//!
//! Times are nanoseconds since 1970, on the wall clock of a store or on the log's clock of a replay. A store's rows and
//! a replay's events use the same field names, so both give the same sums. Only a replay gives the energy, because a
//! store does not contain every voltage. If a part of a sum is missing, [`Record::gap`] states the reason.

use super::losses::{Losses, ReadingLimits, is_too_much};
use crate::fields::Fields;
use crate::monitor::{Estimate, Event, EventKind, Outputs, Snapshot, Throughput};
use crate::quantity::catalogue::Quantity;
use crate::quantity::{Mode, Timestamp};
use crate::store::{HistoryEntry, HistoryExtent, HistoryQuery, HistoryReader, HistoryTable};

/// Latest learned values of a cell, with standard deviations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Learned {
    pub(super) at_ns: i64,
    pub(super) capacity: (f64, f64),
    /// Usable capacity (Ah) with the time of the latest half-cycle that gave it; `None` = no load is configured.
    pub(super) usable: Option<(i64, (f64, f64))>,
    /// Resistance relative to a new cell.
    pub(super) resistance: (f64, f64),
}

#[derive(Debug, Clone, Copy, Default)]
pub(super) struct CellRecord {
    pub(super) moved: Throughput,
    half_cycles: u64,
    pub(super) learned: Option<Learned>,
    /// In a replay: power at the last reading of voltage and current.
    power: Option<Power>,
}

#[derive(Debug, Clone, Copy)]
struct Power {
    time: Timestamp,
    power_w: f64,
    is_rest: bool,
}

/// Energy of a replay: the power of all cells of one string, integrated over time.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Energy {
    /// Energy of charges plus discharges (Wh).
    pub(super) energy_wh: f64,
    pub(super) until: Option<Timestamp>,
    /// Integrated time, summed over all cells (s).
    counted_s: f64,
    /// Time in use without a voltage, summed over all cells (s).
    lost_s: f64,
}

impl Energy {
    /// Returns the reason why the energy is unknown; `None` = it is known.
    pub(super) fn gap(&self) -> Option<&'static str> {
        is_too_much(self.lost_s, self.counted_s).then_some("voltages are missing from the record while current flowed")
    }
}

/// Recorded data for a passport.
#[derive(Debug, Default)]
pub struct Record {
    pub(super) cells: Vec<CellRecord>,
    /// End of the half-cycle that was recorded last. If the clock was set back, an earlier half-cycle can have a later
    /// end.
    pub(super) moved_until_ns: Option<i64>,
    /// Reason why charge is missing from the half-cycles; `None` = no charge is missing.
    pub(super) gap: Option<String>,
    /// Energy of charges and discharges; `None` = unknown, because the record comes from a store.
    pub(super) energy: Option<Energy>,
    limits: ReadingLimits,
    losses: Losses,
    pub(super) state: Option<(i64, Box<Snapshot>)>,
}

impl Record {
    /// Creates an empty record of a replay.
    pub fn of_replay(limits: ReadingLimits) -> Self {
        Self { energy: Some(Energy::default()), limits, losses: Losses::new(limits), ..Self::default() }
    }

    /// Reads the record of the connected pack from a store.
    ///
    /// # Errors
    /// The file cannot be read, or rows of its hash chain were changed.
    pub fn of_store(reader: &HistoryReader) -> Result<Self, String> {
        if let Some(broken) = reader.verify()?.broken {
            return Err(format!("the history was changed: {broken}; packwatch does not write a passport from it"));
        }
        // Read the state first, because a daemon may add rows while they are read.
        let state = reader.dated_snapshot().map(|(at, state)| (at, Box::new(state)));
        let extent = reader.extent()?;
        let mut record = Self { state, ..Self::default() };
        for kind in [HistoryTable::HalfCycle, HistoryTable::Capacity, HistoryTable::Reset] {
            reader.for_each(kind, &HistoryQuery::default(), &mut |entry| {
                if entry.pack == extent.pack {
                    record.take_entry(&entry);
                }
            })?;
        }
        record.note_missing_rows(&extent);
        Ok(record)
    }

    /// Compares the half-cycles in a store with the number counted when they were written. If the store has deleted
    /// rows but the state counts all half-cycles, the sums of the state replace the rows.
    fn note_missing_rows(&mut self, extent: &HistoryExtent) {
        let HistoryExtent { half_cycles, deleted_half_cycles: deleted, written_half_cycles, .. } = *extent;
        let counted = self.snapshot().map_or(0, Snapshot::half_cycles);
        let counted = i64::try_from(counted).unwrap_or(i64::MAX);
        let missing = counted.max(written_half_cycles).saturating_sub(half_cycles.saturating_add(deleted));
        if missing > 0 {
            self.note_gap(format!(
                "{missing} half-cycles are missing from the store, which did not delete them itself"
            ));
        }
        if deleted == 0 {
            return;
        }
        let is_whole = counted >= half_cycles.saturating_add(deleted);
        match self.snapshot().map(Snapshot::throughputs).filter(|_| is_whole) {
            Some(sums) => sums.into_iter().enumerate().for_each(|(index, sum)| self.cell(index).moved = sum),
            None => self.note_gap(format!(
                "{deleted} half-cycles were deleted from the store (store.max_rows, store.keep_years)"
            )),
        }
    }

    /// Records why charge is missing. Only the first reason is kept.
    pub fn note_gap(&mut self, reason: String) {
        self.gap.get_or_insert(reason);
    }

    fn take_entry(&mut self, entry: &HistoryEntry) {
        let fields = Fields::of_entry(entry);
        match entry.kind {
            HistoryTable::HalfCycle => self.take_half_cycle(entry.wall_ns, &fields),
            HistoryTable::Capacity => self.take_capacity(entry.wall_ns, &fields),
            HistoryTable::Reset if matches!(fields.text("reason"), "damaged" | "rows_lost") => {
                self.gap.get_or_insert_with(|| "the store was damaged or full: rows may be missing".to_owned());
            }
            _ => {}
        }
    }

    /// Receives the outputs of a replay, in order.
    pub fn take(&mut self, out: &Outputs) {
        // An event may be a gap. Estimates with an earlier time belong before the event, and estimates with the same
        // time belong after the event.
        let mut estimates = out.estimates.iter().peekable();
        for event in &out.events {
            while let Some(estimate) = estimates.next_if(|estimate| estimate.time < event.time) {
                self.take_estimate(estimate);
            }
            self.take_event(event);
        }
        estimates.for_each(|estimate| self.take_estimate(estimate));
    }

    fn take_event(&mut self, event: &Event) {
        let at_ns = event.time.nanos();
        self.losses.take_event(event);
        match event.kind {
            EventKind::HalfCycle { .. } => self.take_half_cycle(at_ns, &Fields::of_event(&event.kind)),
            EventKind::Capacity { .. } => self.take_capacity(at_ns, &Fields::of_event(&event.kind)),
            EventKind::PackReplaced { .. } => {
                self.losses.restart(event.time);
                *self = Self { losses: std::mem::take(&mut self.losses), ..Self::of_replay(self.limits) };
            }
            EventKind::PackReturned { .. } => {
                self.note_gap("the pack was connected before, and its earlier charge is not included".to_owned());
            }
            _ => {}
        }
    }

    fn take_estimate(&mut self, estimate: &Estimate) {
        self.losses.take_estimate(estimate);
        let longest_s = self.limits.voltage_age_s;
        let measured = &estimate.measured;
        let power_w = (measured.voltage_v * measured.current_a).abs();
        let is_rest = self.losses.is_rest(measured.current_a);
        let power = power_w.is_finite().then_some(Power { time: estimate.time, power_w, is_rest });
        let before = std::mem::replace(&mut self.cell(estimate.cell.index()).power, power);
        let (Some(from), Some(to), Some(energy)) = (before, power, &mut self.energy) else { return };
        let step_s = to.time.since(from.time);
        if (0.0..=longest_s).contains(&step_s) {
            energy.energy_wh += 0.5 * (from.power_w + to.power_w) * step_s / 3600.0;
            energy.counted_s += step_s;
            energy.until = Some(to.time);
        } else if !(from.is_rest && to.is_rest || self.losses.has_paused_since(from.time)) {
            energy.lost_s += step_s.abs();
        }
    }

    /// Receives the state at the end of a replay.
    pub fn finish(&mut self, state: Snapshot) {
        let Throughput { charging_s, discharging_s, .. } = self.fullest();
        if let Some(reason) = self.losses.finish(state.time, charging_s + discharging_s) {
            self.note_gap(reason);
        }
        self.state = Some((state.time.nanos(), Box::new(state)));
    }

    /// Returns the last state.
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
        let mode = if fields.text("mode") == "charge" { Mode::Charge } else { Mode::Discharge };
        let cell = self.cell(cell as usize);
        cell.moved.add(mode, charge_ah, duration_s);
        cell.half_cycles += 1;
        self.moved_until_ns = Some(at_ns);
    }

    fn take_capacity(&mut self, at_ns: i64, fields: &Fields) {
        let capacity = fields.quantity(Quantity::Capacity);
        let resistance = fields.quantity(Quantity::ResistanceRatio);
        let (Some(cell), Some(capacity), Some(resistance)) = (fields.whole("cell"), capacity, resistance) else {
            return;
        };
        let usable = fields.quantity(Quantity::UsableCapacity).map(|value| (at_ns, value));
        let cell = self.cell(cell as usize);
        let usable = usable.or(cell.learned.and_then(|learned| learned.usable));
        cell.learned = Some(Learned { at_ns, capacity, usable, resistance });
    }

    /// Returns the charge moved by a pack with this number of strings (Ah), and the difference between the durations of
    /// discharges and charges (h). Both come from the cell that moved the largest charge, so that a missing row of
    /// another cell does not reduce them.
    pub(super) fn moved(&self, strings: f64) -> (f64, f64) {
        let most = self.fullest();
        (strings * most.charge_ah, (most.discharging_s - most.charging_s).abs() / 3600.0)
    }

    pub(super) fn half_cycles(&self) -> u64 {
        self.cells.iter().map(|cell| cell.half_cycles).max().unwrap_or(0)
    }

    fn fullest(&self) -> Throughput {
        let sums = self.cells.iter().map(|cell| cell.moved);
        sums.max_by(|a, b| a.charge_ah.total_cmp(&b.charge_ah)).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monitor::MeasuredValues;
    use crate::quantity::{CellIndex, Mode};

    const LIMITS: ReadingLimits = ReadingLimits { current_age_s: 60.0, voltage_age_s: 60.0, rest_a: 0.1 };

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
    fn half_cycles_add_up_and_fullest_cell_counts() {
        let mut record = Record::of_replay(LIMITS);
        for event in [
            half_cycle(10.0, 0, Mode::Charge, 1.0),
            half_cycle(10.0, 1, Mode::Charge, 1.0),
            half_cycle(20.0, 0, Mode::Discharge, 0.5),
        ] {
            record.take_event(&event);
        }
        assert_eq!(record.moved(3.0), (4.5, 0.0));
        assert_eq!(record.moved_until_ns, Some(20_000_000_000));
        let replaced = EventKind::PackReplaced { capacity_ah: None, capacity_std_ah: None };
        record.take_event(&Event { time: Timestamp::from_secs(30.0), kind: replaced });
        assert_eq!((record.moved(1.0), record.moved_until_ns), ((0.0, 0.0), None), "another pack starts at 0");
    }

    #[test]
    fn energy_counts_both_directions_but_no_gaps() {
        let mut record = Record::of_replay(LIMITS);
        // The record has 7.2 W for 50 s in each direction, two minutes without data in between, and at the end a
        // voltage without a current.
        for (time_s, current_a) in
            [(0.0, 2.0), (50.0, 2.0), (180.0, -2.0), (230.0, -2.0), (250.0, f64::NAN), (260.0, 2.0)]
        {
            record.take_estimate(&estimate(time_s, 3.6, current_a));
        }
        let energy = record.energy.unwrap();
        assert!((energy.energy_wh - 2.0 * 7.2 * 50.0 / 3600.0).abs() < 1e-12, "{energy:?}");
        assert_eq!(energy.until, Some(Timestamp::from_secs(230.0)));
        assert!(energy.gap().is_some(), "two minutes under load");
    }

    #[test]
    fn late_voltage_at_rest_keeps_the_energy_known() {
        let mut record = Record::of_replay(LIMITS);
        for (time_s, current_a) in [(0.0, 2.0), (50.0, 0.0), (5000.0, 0.0), (5050.0, 2.0)] {
            record.take_estimate(&estimate(time_s, 3.6, current_a));
        }
        assert_eq!(record.energy.unwrap().gap(), None);
    }

    #[test]
    fn current_before_a_gap_decides() {
        let gap = Event { time: Timestamp::from_secs(5000.0), kind: EventKind::Gap { seconds: Some(4000.0) } };
        for (before_a, after_a, is_known) in [(0.0, 2.0, true), (2.0, 0.0, false)] {
            let mut record = Record::of_replay(LIMITS);
            record.take(&Outputs { estimates: vec![estimate(900.0, 3.6, before_a)], ..Outputs::default() });
            let estimates = vec![estimate(5000.0, 3.6, after_a)];
            record.take(&Outputs { estimates, events: vec![gap], ..Outputs::default() });
            assert_eq!(record.losses.finish(gap.time, 3600.0).is_none(), is_known, "{before_a} A before");
        }
    }

    #[test]
    fn rows_missing_from_the_store_are_detected() {
        let gap = |half_cycles, deleted_half_cycles, written_half_cycles| {
            let mut record = Record::default();
            let extent = HistoryExtent { pack: 1, half_cycles, deleted_half_cycles, written_half_cycles };
            record.note_missing_rows(&extent);
            record.gap.unwrap_or_default()
        };
        assert_eq!(gap(10, 0, 10), "");
        assert!(gap(7, 0, 10).contains("3 half-cycles are missing"));
        assert!(gap(7, 3, 10).contains("3 half-cycles were deleted"));
    }
}
