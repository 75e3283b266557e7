//! Collects the data of a report from the rows of a store or from the events and estimates of a replay.
//!
//! Times are in seconds on the wall clock or, in a replay, on the clock of the log. Cells count from 0.

use std::collections::{BTreeMap, BTreeSet};

use super::trace::Trace;

use crate::cell_faults::CellFaultKind;
use crate::fields::Fields;
use crate::filter::ScalarGaussian;
use crate::monitor::{Estimate, Event, EventKind};
use crate::quantity::CellIndex;
use crate::quantity::catalogue::Quantity;
use crate::store::{HistoryEntry, HistoryQuery, HistoryReader, HistoryTable};

/// Origin of the data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// The history of a store: learned values and alarms, no samples.
    Store,
    /// A replay, which contains all data.
    Replay,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct HalfCycleRecord {
    pub(super) time_s: f64,
    pub(super) cell: usize,
    pub(super) is_charge: bool,
    pub(super) charge_ah: f64,
    pub(super) duration_s: f64,
    pub(super) mean_temperature_c: Option<f64>,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct CapacityRecord {
    pub(super) time_s: f64,
    pub(super) cell: usize,
    /// Capacity from this half-cycle alone (Ah).
    pub(super) measured_ah: Option<f64>,
    pub(super) measured_std_ah: Option<f64>,
    /// Learned capacity (Ah): mean and standard deviation.
    pub(super) capacity_ah: (f64, f64),
    pub(super) usable_ah: Option<(f64, f64)>,
    /// Lost fractions of the lithium, the negative electrode and the positive electrode: mean and standard deviation.
    pub(super) losses: Option<[(f64, f64); 3]>,
    /// Resistance relative to new: mean and standard deviation.
    pub(super) resistance: (f64, f64),
}

/// A charge that covered the recharge window (a configured SOC range) or enough of it. The recharge period is the time
/// for this window.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct RechargeRecord {
    pub(super) time_s: f64,
    pub(super) raw_s: Option<f64>,
    /// Normalised recharge period (s): mean and standard deviation.
    pub(super) normalised_s: Option<(f64, f64)>,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct AlarmRecord {
    pub(super) time_s: f64,
    pub(super) rule: String,
    pub(super) severity: String,
    pub(super) cell: Option<usize>,
    pub(super) change: String,
    pub(super) is_active: bool,
    pub(super) value: Option<f64>,
    pub(super) threshold: Option<f64>,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct ModelRecord {
    pub(super) time_s: f64,
    /// Name of a [`ModelState`](crate::monitor::ModelState).
    pub(super) state: String,
    /// Learned capacity of the mean cell (Ah): mean and standard deviation. `None` = nothing was learned, so the rated
    /// capacity on the cells' label applies.
    pub(super) capacity_ah: Option<(f64, f64)>,
    pub(super) residual_v: Option<f64>,
    /// Chemistry that fits better; empty = the label's chemistry fits.
    pub(super) chemistry: String,
    pub(super) is_taken_back: bool,
}

/// Origin and quality of the data.
#[derive(Debug, Clone)]
pub struct DataSource {
    /// Kind of source.
    pub origin: Origin,
    /// Number of the store's pack, from 1.
    pub pack: Option<i64>,
    /// Reason for doubt about the data, as a sentence without its full stop.
    pub doubt: Option<String>,
}

/// All data of a report.
#[derive(Debug)]
pub struct Data {
    pub(super) source: DataSource,
    pub(super) halves: Vec<HalfCycleRecord>,
    pub(super) learned: Vec<CapacityRecord>,
    pub(super) recharges: Vec<RechargeRecord>,
    pub(super) alarms: Vec<AlarmRecord>,
    pub(super) models: Vec<ModelRecord>,
    /// Time and text of other events: resets, replaced packs, and a clock that was set back.
    pub(super) incidents: Vec<(f64, String)>,
    pub(super) trace: Trace,
    /// Only in a replay: size of each finding (a probable fault) at its first report. Key: kind of the fault and first
    /// affected cell.
    pub(super) first_sizes: BTreeMap<(CellFaultKind, CellIndex), ScalarGaussian>,
    pub(super) untrusted: BTreeSet<usize>,
    /// Offset of the current sensor (A): mean and standard deviation.
    pub(super) current_offset: Option<(f64, f64)>,
    first_s: f64,
    last_s: f64,
}

impl Data {
    /// Creates empty data.
    pub fn new(origin: Origin) -> Self {
        Self {
            source: DataSource { origin, pack: None, doubt: None },
            halves: Vec::new(),
            learned: Vec::new(),
            recharges: Vec::new(),
            alarms: Vec::new(),
            models: Vec::new(),
            incidents: Vec::new(),
            trace: Trace::default(),
            first_sizes: BTreeMap::new(),
            untrusted: BTreeSet::new(),
            current_offset: None,
            first_s: f64::INFINITY,
            last_s: f64::NEG_INFINITY,
        }
    }

    /// Reads the history of the connected pack, which is the latest pack of the store.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn of_store(reader: &HistoryReader) -> Result<Self, String> {
        let mut data = Self::new(Origin::Store);
        let entries = reader.entries(&HistoryQuery::default())?;
        let pack = entries.iter().map(|entry| entry.pack).max();
        data.source.pack = pack;
        entries.iter().filter(|entry| Some(entry.pack) == pack).for_each(|entry| data.take_entry(entry));
        data.source.doubt = reader.damage();
        Ok(data)
    }

    /// Sets the reason for doubt about the data. The text is a sentence without its full stop.
    pub fn doubt(&mut self, why: String) {
        self.source.doubt = Some(why);
    }

    /// Sets the learned offset of the current sensor (A): mean and standard deviation of reading minus true current.
    pub fn set_current_offset(&mut self, offset: Option<(f64, f64)>) {
        self.current_offset = offset;
    }

    fn take_entry(&mut self, entry: &HistoryEntry) {
        let time_s = entry.wall_ns as f64 * 1e-9;
        self.span(time_s);
        let fields = Fields::of_entry(entry);
        match entry.kind {
            HistoryTable::HalfCycle => self.take_half_cycle(time_s, &fields),
            HistoryTable::Capacity => self.take_capacity(time_s, &fields),
            HistoryTable::LossModes => self.take_losses(time_s, &fields),
            HistoryTable::Model => self.take_model(time_s, &fields, fields.flag("taken_back")),
            HistoryTable::Alarm => self.take_alarm(time_s, &fields),
            HistoryTable::Reset => {
                let of = cell_of(&fields).map_or(String::new(), |cell| format!(" (cell {})", cell + 1));
                let (reason, detail) = (fields.text("reason").replace('_', " "), fields.text("detail"));
                let colon = if detail.is_empty() { "" } else { ": " };
                self.incidents.push((time_s, format!("{reason}{of}{colon}{detail}")));
            }
            // The report computes its own forecast, and does not show energy and power.
            HistoryTable::RemainingLife | HistoryTable::Outlook => {}
        }
    }

    /// Adds an event of a replay.
    pub fn take_event(&mut self, event: &Event) {
        let time_s = event.time.secs();
        self.span(time_s);
        match event.kind {
            EventKind::HalfCycle { .. } => self.take_half_cycle(time_s, &Fields::of_event(&event.kind)),
            EventKind::Capacity { .. } => self.take_capacity(time_s, &Fields::of_event(&event.kind)),
            EventKind::LossModes { .. } => self.take_losses(time_s, &Fields::of_event(&event.kind)),
            EventKind::Model { is_taken_back, .. } => {
                self.take_model(time_s, &Fields::of_event(&event.kind), is_taken_back)
            }
            EventKind::Alarm { .. } => self.take_alarm(time_s, &Fields::of_event(&event.kind)),
            EventKind::Finding(found) => {
                found.cells.map(|cells| self.first_sizes.entry((found.kind, cells.0)).or_insert(found.size));
            }
            EventKind::Trust { cell, trusted: true, .. } => {
                self.untrusted.remove(&cell.index());
            }
            EventKind::Trust { cell, .. } => {
                self.untrusted.insert(cell.index());
            }
            EventKind::RechargePeriod { seconds, normalised_s, normalised_std_s } => {
                let normalised_s = normalised_s.zip(normalised_std_s);
                self.recharges.push(RechargeRecord { time_s, raw_s: seconds, normalised_s });
            }
            _ => self.take_incident(time_s, &event.kind),
        }
    }

    fn take_half_cycle(&mut self, time_s: f64, fields: &Fields) {
        // The store only writes rows with a cell number.
        let Some(cell) = cell_of(fields) else { return };
        self.halves.push(HalfCycleRecord {
            time_s,
            cell,
            is_charge: fields.text("mode") == "charge",
            charge_ah: fields.number("charge_ah").unwrap_or(f64::NAN),
            duration_s: fields.number("duration_s").unwrap_or(f64::NAN),
            mean_temperature_c: fields.number("mean_temperature_c"),
        });
    }

    fn take_capacity(&mut self, time_s: f64, fields: &Fields) {
        let unknown = (f64::NAN, f64::NAN);
        let Some(cell) = cell_of(fields) else { return };
        self.learned.push(CapacityRecord {
            time_s,
            cell,
            measured_ah: fields.number("measured_ah"),
            measured_std_ah: fields.number("measured_std_ah"),
            capacity_ah: fields.quantity(Quantity::Capacity).unwrap_or(unknown),
            usable_ah: fields.quantity(Quantity::UsableCapacity),
            losses: None,
            resistance: fields.quantity(Quantity::ResistanceRatio).unwrap_or(unknown),
        });
    }

    /// Adds the losses of a cell to its capacity record of the same time, which arrives before the losses.
    fn take_losses(&mut self, time_s: f64, fields: &Fields) {
        let Some(cell) = cell_of(fields) else { return };
        let [lithium, negative, positive] =
            [Quantity::LithiumLoss, Quantity::NegativeLoss, Quantity::PositiveLoss].map(|loss| fields.quantity(loss));
        let losses =
            lithium.zip(negative).zip(positive).map(|((lithium, negative), positive)| [lithium, negative, positive]);
        let mut of_this_time = self.learned.iter_mut().rev().take_while(|row| row.time_s == time_s);
        if let Some(row) = of_this_time.find(|row| row.cell == cell) {
            row.losses = losses;
        }
    }

    fn take_model(&mut self, time_s: f64, fields: &Fields, is_taken_back: bool) {
        self.models.push(ModelRecord {
            time_s,
            state: fields.text("state").to_owned(),
            capacity_ah: fields.pair("capacity_ah", "capacity_std_ah"),
            residual_v: fields.number("residual_v"),
            chemistry: fields.text("chemistry").to_owned(),
            is_taken_back,
        });
    }

    fn take_alarm(&mut self, time_s: f64, fields: &Fields) {
        self.alarms.push(AlarmRecord {
            time_s,
            rule: fields.text("rule").to_owned(),
            severity: fields.text("severity").to_owned(),
            cell: cell_of(fields),
            change: fields.text("change").to_owned(),
            is_active: fields.flag("active"),
            value: fields.number("value"),
            threshold: fields.number("threshold"),
        });
    }

    fn take_incident(&mut self, time_s: f64, kind: &EventKind) {
        let what = match *kind {
            EventKind::FilterReset { cell } => format!("filter of cell {} restarted", cell.index() + 1),
            EventKind::PackReplaced { .. } => {
                self.forget_pack();
                "another pack was connected: values learned on the previous one are not shown".to_owned()
            }
            EventKind::TimeBackwards { seconds } => format!("the clock was set back by {seconds:.0} s"),
            _ => return,
        };
        self.incidents.push((time_s, what));
    }

    /// Removes the data of the old pack, because a report describes the pack that is connected at the end.
    fn forget_pack(&mut self) {
        self.halves.clear();
        self.learned.clear();
        self.recharges.clear();
        self.models.clear();
        self.first_sizes.clear();
        self.untrusted.clear();
    }

    /// Adds an estimate of a replay.
    pub fn take_estimate(&mut self, estimate: &Estimate) {
        self.span(estimate.time.secs());
        self.trace.take(estimate);
    }

    fn span(&mut self, time_s: f64) {
        self.first_s = self.first_s.min(time_s);
        self.last_s = self.last_s.max(time_s);
    }

    pub(super) fn ends_s(&self) -> Option<(f64, f64)> {
        (self.first_s <= self.last_s).then_some((self.first_s, self.last_s))
    }

    pub(super) fn is_dated(&self) -> bool {
        // Larger times are dates (s since 1970). Smaller times count from the start of a log.
        self.first_s >= 3.0e8
    }

    pub(super) fn cells(&self) -> usize {
        let learned = self.learned.iter().map(|row| row.cell + 1);
        let halves = self.halves.iter().map(|row| row.cell + 1);
        learned.chain(halves).max().unwrap_or(0).max(self.trace.cells.len())
    }
}

fn cell_of(fields: &Fields) -> Option<usize> {
    fields.whole("cell").map(|cell| cell as usize)
}
