//! What a report is about, gathered from a store's rows or from a replay's events and estimates.
//!
//! Times are seconds on the wall clock (a replay: on the log's clock). Cells count from 0.

use super::trace::Trace;
use crate::monitor::{Estimate, Event, EventKind};
use crate::quantity::{CellIndex, Mode};
use crate::store::{Entry, Filter, Kind, Reader};

/// Stamps from here on are dates, s since 1970; a log that begins earlier counts from its own start.
const FIRST_DATE_S: f64 = 3.0e8;

/// Where data come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// A store's history: what was learned and alarms, no samples.
    Store,
    /// A replay: everything.
    Replay,
}

/// A charge or discharge of a cell.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Half {
    pub(super) time_s: f64,
    pub(super) cell: usize,
    pub(super) is_charge: bool,
    pub(super) charge_ah: f64,
    pub(super) duration_s: f64,
    pub(super) mean_temperature_c: Option<f64>,
}

/// What was learned at a transition.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Learned {
    pub(super) time_s: f64,
    pub(super) cell: usize,
    /// What this half-cycle alone said, Ah.
    pub(super) measured_ah: Option<f64>,
    /// Its standard deviation, Ah.
    pub(super) measured_std_ah: Option<f64>,
    /// Mean and standard deviation, Ah.
    pub(super) capacity_ah: (f64, f64),
    pub(super) usable_ah: Option<(f64, f64)>,
    /// Times new.
    pub(super) resistance: (f64, f64),
}

/// A charge that covered the window.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Recharge {
    pub(super) time_s: f64,
    pub(super) raw_s: Option<f64>,
    /// Mean and standard deviation.
    pub(super) normalised_s: Option<(f64, f64)>,
}

/// Something that became of an alarm.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct AlarmRow {
    pub(super) time_s: f64,
    pub(super) rule: String,
    pub(super) severity: String,
    pub(super) cell: Option<usize>,
    pub(super) change: String,
    pub(super) is_active: bool,
    pub(super) value: Option<f64>,
    pub(super) threshold: Option<f64>,
}

/// Where the data come from and how they are.
#[derive(Debug, Clone)]
pub struct Source {
    /// Which kind.
    pub origin: Origin,
    /// Pack of the store, from 1, and packs before it.
    pub pack: Option<i64>,
    /// Why it may not be believed: a sentence without its full stop.
    pub doubt: Option<String>,
}

/// Everything a report shows.
#[derive(Debug)]
pub struct Data {
    pub(super) source: Source,
    pub(super) halves: Vec<Half>,
    pub(super) learned: Vec<Learned>,
    pub(super) recharges: Vec<Recharge>,
    pub(super) alarms: Vec<AlarmRow>,
    /// Resets, damages, lost trust: when and what.
    pub(super) incidents: Vec<(f64, String)>,
    pub(super) trace: Trace,
    first_s: f64,
    last_s: f64,
}

impl Data {
    /// Nothing yet.
    pub fn new(origin: Origin) -> Self {
        Self {
            source: Source { origin, pack: None, doubt: None },
            halves: Vec::new(),
            learned: Vec::new(),
            recharges: Vec::new(),
            alarms: Vec::new(),
            incidents: Vec::new(),
            trace: Trace::default(),
            first_s: f64::INFINITY,
            last_s: f64::NEG_INFINITY,
        }
    }

    /// The history of the pack that is connected, the latest of a store.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn of_store(reader: &Reader) -> Result<Self, String> {
        let mut data = Self::new(Origin::Store);
        let entries = reader.entries(&Filter::default())?;
        let pack = entries.iter().map(|entry| entry.pack).max();
        data.source.pack = pack;
        entries.iter().filter(|entry| Some(entry.pack) == pack).for_each(|entry| data.take_entry(entry));
        Ok(data)
    }

    /// The record may not be believed: a sentence without its full stop.
    pub fn doubt(&mut self, why: String) {
        self.source.doubt = Some(why);
    }

    /// Takes a row of a store.
    fn take_entry(&mut self, entry: &Entry) {
        let time_s = entry.wall_ns as f64 * 1e-9;
        self.span(time_s);
        let row = Values(entry);
        let cell = row.number("cell").map(|cell| cell as usize);
        match (entry.kind, cell) {
            (Kind::HalfCycle, Some(cell)) => self.halves.push(Half {
                time_s,
                cell,
                is_charge: row.text("mode") == "charge",
                charge_ah: row.number("charge_ah").unwrap_or(f64::NAN),
                duration_s: row.number("duration_s").unwrap_or(f64::NAN),
                mean_temperature_c: row.number("mean_temperature_c"),
            }),
            (Kind::Capacity, Some(cell)) => self.learned.push(Learned {
                time_s,
                cell,
                measured_ah: row.number("measured_ah"),
                measured_std_ah: row.number("measured_std_ah"),
                capacity_ah: row.pair("capacity_ah", "capacity_std_ah").unwrap_or((f64::NAN, f64::NAN)),
                usable_ah: row.pair("usable_capacity_ah", "usable_capacity_std_ah"),
                resistance: row.pair("resistance_ratio", "resistance_ratio_std").unwrap_or((f64::NAN, f64::NAN)),
            }),
            (Kind::Alarm, cell) => self.alarms.push(AlarmRow {
                time_s,
                rule: row.text("rule"),
                severity: row.text("severity"),
                cell,
                change: row.text("change"),
                is_active: row.number("active").is_some_and(|active| active != 0.0),
                value: row.number("value"),
                threshold: row.number("threshold"),
            }),
            (Kind::Reset, cell) => {
                let of = cell.map_or(String::new(), |cell| format!(" (cell {})", cell + 1));
                let detail = row.text("detail");
                let colon = if detail.is_empty() { "" } else { ": " };
                self.incidents.push((time_s, format!("{}{of}{colon}{detail}", row.text("reason").replace('_', " "))));
            }
            // A row of a cell without its number: the store writes none. And the forecast is made anew here.
            (Kind::HalfCycle | Kind::Capacity, None) | (Kind::RemainingLife, _) => {}
        }
    }

    /// Takes an event of a replay.
    pub fn take_event(&mut self, event: &Event) {
        let time_s = event.time.secs();
        self.span(time_s);
        match event.kind {
            EventKind::HalfCycle { cell, mode, charge_ah, duration_s, mean_temperature_c, .. } => {
                let (cell, is_charge) = (cell.index(), mode == Mode::Charge);
                self.halves.push(Half { time_s, cell, is_charge, charge_ah, duration_s, mean_temperature_c });
            }
            EventKind::RechargePeriod { seconds, normalised_s, normalised_std_s } => {
                let normalised_s = normalised_s.zip(normalised_std_s);
                self.recharges.push(Recharge { time_s, raw_s: seconds, normalised_s });
            }
            EventKind::Mode { to: Mode::Charge | Mode::Discharge, .. } => self.trace.turn(time_s),
            EventKind::Capacity { .. } | EventKind::Alarm { .. } => self.take_learned(time_s, &event.kind),
            _ => self.take_incident(time_s, &event.kind),
        }
    }

    fn take_learned(&mut self, time_s: f64, kind: &EventKind) {
        match *kind {
            EventKind::Capacity {
                cell,
                measured_ah,
                measured_std_ah,
                capacity_ah,
                capacity_std_ah,
                usable_capacity_ah,
                usable_capacity_std_ah,
                resistance_ratio,
                resistance_ratio_std,
                ..
            } => self.learned.push(Learned {
                time_s,
                cell: cell.index(),
                measured_ah,
                measured_std_ah,
                capacity_ah: (capacity_ah, capacity_std_ah),
                usable_ah: usable_capacity_ah.zip(usable_capacity_std_ah),
                resistance: (resistance_ratio, resistance_ratio_std),
            }),
            EventKind::Alarm { rule, cell, change, active, severity, value, threshold, .. } => {
                self.alarms.push(AlarmRow {
                    time_s,
                    rule: rule.name().to_owned(),
                    severity: severity.name().to_owned(),
                    cell: cell.map(CellIndex::index),
                    change: word(&change),
                    is_active: active,
                    value,
                    threshold: Some(threshold),
                });
            }
            _ => {}
        }
    }

    fn take_incident(&mut self, time_s: f64, kind: &EventKind) {
        let number = |cell: CellIndex| cell.index() + 1;
        let what = match *kind {
            EventKind::FilterReset { cell } => format!("filter of cell {} started again", number(cell)),
            EventKind::Trust { cell, trusted: false, mean_nis } => {
                format!(
                    "estimate of cell {} not to be trusted (innovations {mean_nis:.1} times as expected)",
                    number(cell)
                )
            }
            EventKind::Trust { cell, trusted: true, .. } => format!("estimate of cell {} trusted again", number(cell)),
            EventKind::PackReplaced { .. } => {
                self.forget_pack();
                "another pack was connected: what was learned of the one before is not shown".to_owned()
            }
            EventKind::TimeBackwards { seconds } => format!("the clock was set back by {seconds:.0} s"),
            _ => return,
        };
        self.incidents.push((time_s, what));
    }

    /// Like a store's report, a replay's is about the pack that is connected at its end.
    fn forget_pack(&mut self) {
        self.halves.clear();
        self.learned.clear();
        self.recharges.clear();
    }

    /// Takes an estimate of a replay.
    pub fn take_estimate(&mut self, estimate: &Estimate) {
        self.span(estimate.time.secs());
        self.trace.take(estimate);
    }

    fn span(&mut self, time_s: f64) {
        self.first_s = self.first_s.min(time_s);
        self.last_s = self.last_s.max(time_s);
    }

    /// First and last moment; `None` = there is nothing.
    pub(super) fn ends_s(&self) -> Option<(f64, f64)> {
        (self.first_s <= self.last_s).then_some((self.first_s, self.last_s))
    }

    /// Whether moments are dates.
    pub(super) fn is_dated(&self) -> bool {
        self.first_s >= FIRST_DATE_S
    }

    /// Cells that anything is known of.
    pub(super) fn cells(&self) -> usize {
        let learned = self.learned.iter().map(|row| row.cell + 1);
        let halves = self.halves.iter().map(|row| row.cell + 1);
        learned.chain(halves).max().unwrap_or(0).max(self.trace.cells.len())
    }
}

/// A word of the core as it is written everywhere.
fn word(value: &impl serde::Serialize) -> String {
    serde_json::to_value(value).ok().and_then(|value| value.as_str().map(str::to_owned)).unwrap_or_default()
}

/// The values of a row by name.
struct Values<'a>(&'a Entry);

impl Values<'_> {
    fn value(&self, name: &str) -> Option<&serde_json::Value> {
        let column = self.0.kind.columns().iter().position(|column| *column == name)?;
        self.0.values.get(column)
    }

    fn number(&self, name: &str) -> Option<f64> {
        self.value(name)?.as_f64()
    }

    fn pair(&self, mean: &str, std: &str) -> Option<(f64, f64)> {
        self.number(mean).zip(self.number(std))
    }

    fn text(&self, name: &str) -> String {
        self.value(name).and_then(|value| value.as_str()).unwrap_or_default().to_owned()
    }
}
