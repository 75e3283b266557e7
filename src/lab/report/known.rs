//! Lists the known values of the battery. For an unknown value, it lists the reason and the measurement that would
//! determine this value.

use std::collections::{BTreeMap, BTreeSet};

use super::context::PageContext;
use super::data::{Data, Origin};
use super::forecast::Outlook;
use super::format::capitalised;
use super::model;
use super::raised::{doubt, raised};
use super::series::{self, CellStep};
use crate::cell::{ModelBands, advise};
use crate::monitor::ModelState;

/// Measurement that determines the capacity if the cell model was measured.
const TEACHES_CAPACITY: &str =
    "A charge from below 20 % to full after an hour of rest, or a discharge over the same range.";
/// If fewer than this share of the innovations are within their 95 % interval, the estimator's intervals are too
/// narrow.
const LEAST_COVERAGE: f64 = 0.8;

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Tile {
    pub(super) name: &'static str,
    pub(super) value: String,
    pub(super) note: String,
    /// Untrusted cells on which the value depends; `None` = all cells are trusted, or the value is not an estimate.
    pub(super) doubt: Option<String>,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Gap {
    pub(super) name: &'static str,
    pub(super) why: String,
    pub(super) teaches: String,
}

#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Knowledge {
    pub(super) tiles: Vec<Tile>,
    pub(super) gaps: Vec<Gap>,
    pub(super) measured_cells: usize,
}

impl Knowledge {
    pub(super) fn of(data: &Data, context: &PageContext<'_>, outlook: &Result<Outlook, String>) -> Self {
        let measured: BTreeSet<usize> =
            data.learned.iter().filter(|row| row.measured_ah.is_some()).map(|row| row.cell).collect();
        let mut known = Self { measured_cells: measured.len(), ..Self::default() };
        known.capacity(data, context, &measured);
        known.usable(data, context);
        known.losses(data);
        known.resistance(data, context);
        known.recharge(data, context);
        match outlook {
            Ok(outlook) => known.tile("Remaining life", outlook.value(), outlook.note(data.cells())),
            Err(why) => known.gap("Remaining life", capitalised(why) + ".", "Measured capacities over months of use."),
        }
        // Each value is that of the worst cell, which may be untrusted.
        let raised = raised(data);
        let doubt = doubt(data, &raised);
        known.tiles.iter_mut().for_each(|tile| tile.doubt.clone_from(&doubt));
        known.imbalance(context);
        let rated_ah = context.config.map(|it| it.monitor.model.rated_capacity_ah);
        if let Some(cycles) = series::full_cycles(data, rated_ah) {
            known.tile("Use so far", format!("{cycles:.0} cycles"), "equivalent full cycles in this record");
        }
        known.tile("Alarms raised now", raised.len().to_string(), raised_before(data));
        known.model(data, context);
        known
    }

    fn tile(&mut self, name: &'static str, value: String, note: impl Into<String>) {
        self.tiles.push(Tile { name, value, note: note.into(), doubt: None });
    }

    fn gap(&mut self, name: &'static str, why: impl Into<String>, teaches: impl Into<String>) {
        self.gaps.push(Gap { name, why: why.into(), teaches: teaches.into() });
    }

    fn capacity(&mut self, data: &Data, context: &PageContext<'_>, measured: &BTreeSet<usize>) {
        let last = last(data, series::capacity, false);
        let Some(step) = last.filter(|_| !measured.is_empty()) else {
            let used = last.map_or_else(String::new, |step| {
                format!(" Until then {:.3} \u{b1} {:.3} Ah is assumed.", step.worst.0, step.worst.1)
            });
            let why = if is_prior(context) {
                "No charge of more than a quarter of the capacity has measured it yet."
            } else {
                "No charge or discharge has measured it yet."
            };
            return self.gap("Capacity, state of health", format!("{why}{used}"), teaches_capacity(context));
        };
        match context.rated_ah(step.cell) {
            Some(rated) => self.tile(
                "State of health",
                format!("{:.1} \u{b1} {:.1} %", 100.0 * step.worst.0 / rated, 100.0 * step.worst.1 / rated),
                format!("of {rated} Ah rated{}{}", of_cell(data, &step), assumed(measured, &step)),
            ),
            None => self.gap(
                "State of health",
                "The rated capacity is unknown without -c.",
                "Create the report with the configuration (-c).",
            ),
        }
        self.tile("Capacity", format!("{:.3} Ah", step.worst.0), deviation(data, &step) + assumed(measured, &step));
        if measured.len() < data.cells() {
            let why = format!("Not measured yet in {} of {} cells.", data.cells() - measured.len(), data.cells());
            self.gap("Capacity of the other cells", why, teaches_capacity(context));
        }
    }

    fn usable(&mut self, data: &Data, context: &PageContext<'_>) {
        match last(data, series::usable, false) {
            Some(step) => self.tile("Usable capacity", format!("{:.3} Ah", step.worst.0), deviation(data, &step)),
            None if context.config.is_some_and(|config| config.monitor.health.usable.is_none()) => self.gap(
                "Usable capacity",
                "The configuration states no load.",
                "State the load in [usable] of the configuration.",
            ),
            None => self.gap(
                "Usable capacity",
                "It is learned together with the capacity.",
                "The same as for the capacity.",
            ),
        }
    }

    fn losses(&mut self, data: &Data) {
        let figure = |step: CellStep| format!("{:.0} \u{b1} {:.0} %", step.worst.0, step.worst.1);
        let [lithium, negative, positive] = [series::lithium_lost, series::negative_lost, series::positive_lost]
            .map(|pick| last(data, pick, true).map(figure));
        if let (Some(lithium), Some(negative), Some(positive)) = (lithium, negative, positive) {
            self.tile("Lithium lost", lithium, format!("negative electrode {negative}, positive {positive}"));
        }
    }

    fn resistance(&mut self, data: &Data, context: &PageContext<'_>) {
        let is_prior = is_prior(context);
        match last(data, series::resistance, true) {
            Some(step) if !is_prior => {
                self.tile("Resistance", format!("{:.2} \u{d7} new", step.worst.0), deviation(data, &step));
            }
            Some(_) => self.gap(
                "Resistance compared with a new cell",
                "A label does not state the resistance of a new cell.",
                teaches_model(context),
            ),
            None => {
                self.gap("Resistance", "No half-cycle has ended yet.", "A charge or discharge with a changing current.")
            }
        }
    }

    /// Adds the latest recharge period, normalised if known, with the first recharge period for comparison.
    fn recharge(&mut self, data: &Data, context: &PageContext<'_>) {
        let normalised = || data.recharges.iter().filter_map(|row| row.normalised_s.map(|(mean, _)| mean));
        let raw = || data.recharges.iter().filter_map(|row| row.raw_s);
        let minutes = |seconds: f64| format!("{:.1} min", seconds / 60.0);
        let (first, last, how) = match normalised().next_back() {
            Some(last) => (normalised().next(), Some(last), "normalised"),
            None => (raw().next(), raw().next_back(), "as measured"),
        };
        if let Some((first, last)) = first.zip(last) {
            return self.tile("Recharge period", minutes(last), format!("{how}; {} at first", minutes(first)));
        }
        if data.source.origin == Origin::Store {
            return self.gap("Recharge period", "The history does not contain it.", "A report of a replay.");
        }
        let window = context.config.map(|config| &config.monitor.health.recharge);
        let window = window.map_or_else(
            || "of the window".to_owned(),
            |it| format!("from {:.0} to {:.0} %", 100.0 * it.from_soc, 100.0 * it.to_soc),
        );
        self.gap(
            "Recharge period",
            format!("No charge {window} was long enough."),
            format!("A charge {window} without a break."),
        );
    }

    fn imbalance(&mut self, context: &PageContext<'_>) {
        match &context.imbalance {
            Some(Ok(pack)) => self.tile(
                "Lost by imbalance",
                format!("{:.1} %", 100.0 * pack.lost_by_imbalance.mean),
                format!(
                    "\u{b1} {:.1} of the charge; cell {} is empty first, cell {} is full first",
                    100.0 * pack.lost_by_imbalance.std(),
                    pack.discharge_limit.cell.index() + 1,
                    pack.charge_limit.cell.index() + 1
                ),
            ),
            Some(Err(why)) => self.gap(
                "Differences between the cells",
                format!("Unknown: {why}."),
                "An hour of driving or charging, with the voltages of all cells.",
            ),
            None => {}
        }
    }

    /// Adds the kinds of cell faults that cannot be found with this cell model, and the measurement that would reduce
    /// the model's SOC error most.
    fn model(&mut self, data: &Data, context: &PageContext<'_>) {
        let sourced = context.model.as_ref();
        if context.diagnosis.is_some() && is_prior(context) {
            self.gap(
                "Weak cells, aged cells, wrong voltage channels",
                "The voltage curve is typical of the chemistry on the label. It is too uncertain to tell these faults from a \
                 difference in charge.",
                teaches_model(context),
            );
        }
        if let Some((points, advice)) = sourced.and_then(|it| advise(&ModelBands::new(&it.model)))
            && let Some(first) = advice.first()
        {
            let why = format!("The cell model makes its error about {points:.1} points.");
            self.gap("State of charge, more exactly", why, capitalised(&model::sentence(first)) + ".");
        }
        if data.trace.health().coverage().is_some_and(|share| share < LEAST_COVERAGE) {
            self.gap(
                "How far the figures can be trusted",
                "The estimator's intervals are too narrow: see its health below.",
                "A cell model that fits this battery.",
            );
        }
    }
}

fn is_prior(context: &PageContext<'_>) -> bool {
    let state = context.model.as_ref().map(|sourced| sourced.source.state);
    matches!(state, Some(ModelState::Prior | ModelState::Unfit))
}

/// States how the cell model can be measured or learned. The model of LFP cells cannot be learned in use.
fn teaches_model(context: &PageContext<'_>) -> String {
    let in_use = " With a reading per second and rests of some minutes, packwatch may also learn it in use.";
    format!("A measured cell model (packwatch fit).{}", if is_learnable(context) { in_use } else { "" })
}

fn is_learnable(context: &PageContext<'_>) -> bool {
    let chemistry = context.model.as_ref().and_then(|sourced| sourced.source.chemistry.as_deref());
    !chemistry.is_some_and(|name| name.starts_with("lfp"))
}

fn teaches_capacity(context: &PageContext<'_>) -> String {
    if is_prior(context) { teaches_by_label(context) } else { TEACHES_CAPACITY.to_owned() }
}

fn teaches_by_label(context: &PageContext<'_>) -> String {
    let lfp = " An LFP cell must be nearly empty at one end and nearly full at the other.";
    let is_flat = !is_learnable(context);
    format!("A discharge and a charge of more than a quarter of the capacity.{}", if is_flat { lfp } else { "" })
}

/// States which alarms were raised in the record, and how often. Alarms of several cells in the same minute count once.
fn raised_before(data: &Data) -> String {
    let mut times: BTreeMap<&str, BTreeSet<i64>> = BTreeMap::new();
    for row in data.alarms.iter().filter(|row| row.change == "raised") {
        times.entry(&row.rule).or_default().insert((row.time_s / 60.0) as i64);
    }
    let plural = |count: usize| if count == 1 { "" } else { "s" };
    let often = times.iter().map(|(rule, times)| format!("{rule} at {} time{}", times.len(), plural(times.len())));
    let often: Vec<String> = often.collect();
    if often.is_empty() { "none in this record".to_owned() } else { format!("in this record: {}", often.join(", ")) }
}

fn last(data: &Data, pick: series::ValueSelector, high_is_bad: bool) -> Option<CellStep> {
    series::steps(data, pick, high_is_bad).last().copied()
}

fn of_cell(data: &Data, step: &CellStep) -> String {
    if data.cells() > 1 { format!(", cell {}", step.cell + 1) } else { String::new() }
}

fn deviation(data: &Data, step: &CellStep) -> String {
    format!("\u{b1} {:.3}{}", step.worst.1, of_cell(data, step))
}

fn assumed(measured: &BTreeSet<usize>, step: &CellStep) -> &'static str {
    if measured.contains(&step.cell) { "" } else { "; assumed, not measured yet" }
}
