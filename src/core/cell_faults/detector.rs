//! Detects faults of the cells of a pack and of their sensors. The detector adds samples to rows (sums over a few
//! minutes), compares the cells once per row and derives findings from the comparison (`judge`).
//!
//! The assumed errors of a row (the standard deviations in `shared_row`) are rounded values. They are typical of an
//! equivalent-circuit model and of a cell monitor chip, and were checked on simulated packs. Only the slope of the
//! open-circuit curve (`pack_slope`) and the limit of a charge difference were also tuned on measurements of two cars.

mod balancing;
mod judge;
mod jumps;
mod shared_row;

use serde::{Deserialize, Serialize};

use super::bleed_timer::BalancingConfig;
use super::channels::{Channel, compare};
use super::difference::{CONTACT, Difference, LEAK, Observation, RESISTANCE, SOC, STATES};
use super::fault::{CellFault, CellFaultKind};
use super::gain::{CellAgeing, Gain};
use super::pack_slope::{PackSlope, SlopeRow};
use super::row::{CellSums, PackSums};
use super::temperature::WarmingRatio;
use crate::cell::CellModel;
use crate::filter::ScalarGaussian;
use crate::quantity::{CellIndex, DAY_S, InvalidState, Timestamp};
use balancing::Bleed;
use judge::Population;
use shared_row::Row;

/// Length of a row. A row ends when the fraction `ROW_SOC` of the capacity has been charged or discharged, or after
/// `ROW_S` seconds. During a rest, a row may last up to the fraction `REST_PART` of the rest, because more samples
/// add no information. Shorter rows would show a bad contact sooner. However, the detector would then mistake an aged
/// cell for a bad contact, and would miss exchanged channels.
const ROW_SOC: f64 = 0.02;
const ROW_S: f64 = 300.0;
const REST_PART: f64 = 0.5;
/// Minimum number of cells for a comparison.
pub(super) const LEAST_CELLS: usize = 3;
/// Standard deviations of a resistance measurement from current steps: `STEP_PART` is a fraction of the resistance,
/// `STEP_V` applies to the voltage of one step (V).
const STEP_PART: f64 = 0.05;
const STEP_V: f64 = 0.003;
/// Minimum sum of squared current steps for a resistance measurement (squares of the 1 C current).
const LEAST_STEPS: f64 = 0.02;
/// If the estimated change of the mean cell's SOC differs from the counted charge by at least this fraction, the
/// counted charge is used.
const SOC_JUMP: f64 = 0.02;
/// Number of fault kinds up to `HighCharge`. All kinds that apply to single cells are among them.
const CELL_KINDS: usize = CellFaultKind::HighCharge as usize;

/// Estimates of the mean cell (an imaginary cell with the typical values of the pack) at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeanCell {
    /// SOC, fraction.
    pub soc: f64,
    /// Current (A), positive = discharge.
    pub current_a: f64,
    /// Voltage drop of the series resistance and the branches (V).
    pub drop_v: f64,
    /// Temperature (degrees C).
    pub temperature_c: f64,
    /// Charge taken out since any fixed time (Ah). Only differences of this value are used.
    pub charge_ah: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct WatchedCell {
    /// Whether the cell is of the pack's main type. Cells of another type (in a module with its own cell model) are not
    /// compared.
    #[serde(default = "yes", skip_serializing_if = "Clone::clone")]
    is_compared: bool,
    difference: Difference,
    /// Means of the states when a row last agreed with the prediction.
    settled: [f64; STATES],
    /// Means of the states before the last sudden change.
    before_jump: [f64; STATES],
    sums: CellSums,
    channel: Channel,
    #[serde(default, skip_serializing_if = "Bleed::is_unused")]
    bleed: Bleed,
    temperature: WarmingRatio,
    /// For each kind of fault: since when the fault has been more likely than not.
    suspected: [Option<Timestamp>; CELL_KINDS],
    jumped: Option<Timestamp>,
}

fn yes() -> bool {
    true
}

impl WatchedCell {
    fn new(is_compared: bool) -> Self {
        Self {
            is_compared,
            difference: Difference::new(),
            settled: [0.0; STATES],
            before_jump: [0.0; STATES],
            sums: CellSums::default(),
            channel: Channel::default(),
            bleed: Bleed::default(),
            temperature: WarmingRatio::default(),
            suspected: [None; CELL_KINDS],
            jumped: None,
        }
    }

    fn interrupt(&mut self) {
        self.sums.interrupt();
        self.channel.interrupt();
    }
}

/// Detector of cell faults of one pack.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellFaultDetector {
    cells: Vec<WatchedCell>,
    pack: PackSums,
    /// The last row: time of the row's middle, SOC and charge (Ah).
    last_row: Option<(Timestamp, f64, f64)>,
    rest_s: f64,
    /// Series resistance of the mean cell in the present row (ohm).
    ohm: f64,
    /// The middle cell: the cell whose SOC and resistance are closest to the medians.
    middle: usize,
    /// Whether the BMS may bleed (discharge through a resistor) every cell except the lowest.
    is_balanced: bool,
    /// The cell with the lowest charge; `None` if no cell is clearly the lowest.
    lowest: Option<usize>,
    gain: Gain,
    slope: PackSlope,
    /// Slope of the open-circuit curve in the last row (V per unit of SOC).
    slope_v: f64,
    /// Whether the cell model was derived from a label (chemistry and capacity). Its open-circuit curve is then
    /// uncertain.
    is_prior: bool,
    findings: Vec<CellFault>,
}

impl CellFaultDetector {
    /// Creates a detector that compares only the cells `compared`, which are of the same type. The caller must not
    /// [add](Self::add) samples of other cells.
    pub fn among(cells: usize, compared: &[usize]) -> Self {
        let mut diagnosis = Self::new(if compared.len() < LEAST_CELLS { 0 } else { cells });
        diagnosis.compare_only(compared);
        diagnosis
    }

    /// Selects the cells to compare. Resets the state of every cell that is newly compared or no longer compared.
    pub fn compare_only(&mut self, compared: &[usize]) {
        for (index, cell) in self.cells.iter_mut().enumerate() {
            let is_compared = compared.contains(&index);
            if is_compared == cell.is_compared {
                continue;
            }
            *cell = WatchedCell::new(is_compared);
            self.findings.retain(|found| !found.is_of(CellIndex(index as u16)));
        }
        self.lowest = self.lowest.filter(|lowest| compared.contains(lowest));
        if !compared.contains(&self.middle) {
            self.middle = compared.first().copied().unwrap_or_default();
        }
    }

    /// Creates a detector without history. If the pack has fewer than three cells, the detector is inactive.
    pub fn new(cells: usize) -> Self {
        Self {
            cells: vec![WatchedCell::new(true); if cells < LEAST_CELLS { 0 } else { cells }],
            pack: PackSums::default(),
            last_row: None,
            rest_s: 0.0,
            ohm: 0.0,
            middle: 0,
            is_balanced: false,
            lowest: None,
            gain: Gain::default(),
            slope: PackSlope::default(),
            slope_v: 0.0,
            is_prior: false,
            findings: Vec::new(),
        }
    }

    /// Whether the pack has enough cells for a comparison.
    #[inline]
    pub fn is_active(&self) -> bool {
        !self.cells.is_empty()
    }

    /// The findings, ordered by cell.
    pub fn findings(&self) -> &[CellFault] {
        &self.findings
    }

    /// Filter of the difference between a cell and the middle of the pack; `None` if the cell is not compared.
    pub fn difference(&self, cell: CellIndex) -> Option<&Difference> {
        self.cells.get(cell.index()).filter(|cell| cell.is_compared).map(|cell| &cell.difference)
    }

    /// A cell's states minus the median of the pack. `None` if the detector is inactive or the pack has no such cell.
    /// Unknown states are `None`: all states of a cell that is not compared, and the leak of a cell that the BMS may
    /// bleed.
    pub fn relative(&self, cell: CellIndex) -> Option<[Option<ScalarGaussian>; STATES]> {
        let WatchedCell { is_compared, difference, .. } = self.cells.get(cell.index())?;
        Some(std::array::from_fn(|state| {
            let middle = self.population(state).middle;
            let ScalarGaussian { mean, variance } = difference.state(state);
            let is_known = *is_compared && (state != LEAK || !self.may_be_bled(cell.index()));
            is_known.then_some(ScalarGaussian { mean: mean - middle, variance })
        }))
    }

    /// The real cell whose estimates stand for the mean cell.
    #[inline]
    pub fn middle(&self) -> usize {
        self.middle
    }

    pub(super) fn middle_soc(&self) -> Option<(Timestamp, f64)> {
        self.last_row.map(|(time, soc, _)| (time, soc))
    }

    /// Adds a sample of a cell. If `current_a` is `None`, discards the cell's samples in the present row.
    #[inline]
    pub fn add(
        &mut self,
        cell: usize,
        time: Timestamp,
        voltage_v: f64,
        current_a: Option<f64>,
        temperature_c: Option<f64>,
    ) {
        match (self.cells.get_mut(cell), current_a) {
            (Some(cell), Some(current_a)) => cell.sums.add(time, voltage_v, current_a, temperature_c, self.ohm),
            (Some(cell), None) => cell.sums.interrupt(),
            (None, _) => {}
        }
    }

    /// Adds the mean cell's values at `time`. The caller first adds all samples of this time. Returns whether the row
    /// is complete. If so, the caller ends the row with [`Self::close_row`].
    pub fn note(&mut self, time: Timestamp, mean: &MeanCell, capacity_ah: f64) -> bool {
        if ![mean.soc, mean.current_a, mean.drop_v, mean.temperature_c, mean.charge_ah].iter().all(|it| it.is_finite())
        {
            self.interrupt();
            return false;
        }
        let pack = &mut self.pack;
        if pack.last.is_some_and(|last| time.since(last) > 60.0) {
            *pack = PackSums::default();
            self.rest_s = 0.0;
            self.slope.interrupt();
            self.cells.iter_mut().for_each(WatchedCell::interrupt);
        }
        let seconds = pack.last.replace(time).map_or(0.0, |last| time.since(last).max(0.0));
        if pack.begun.is_none() {
            self.cells.iter_mut().for_each(|cell| cell.bleed.timer.begin_row(time));
        }
        let begun = *pack.begun.get_or_insert(time);
        let first_ah = if pack.count == 0 { mean.charge_ah } else { pack.first_ah };
        pack.first_ah = first_ah;
        pack.count += 1;
        pack.current_a += mean.current_a;
        pack.drop_v += mean.drop_v;
        pack.soc += mean.soc;
        pack.temperature_c += mean.temperature_c;
        pack.charge_ah += mean.charge_ah - first_ah;
        self.rest_s = if mean.current_a.abs() < 0.02 * capacity_ah { self.rest_s + seconds } else { 0.0 };
        (mean.charge_ah - first_ah).abs() >= ROW_SOC * capacity_ah
            || time.since(begun) >= ROW_S.max(REST_PART * self.rest_s)
    }

    /// Lists, updates or withdraws the finding for a sensor that all cells share, depending on `probability`. Returns
    /// the finding if it is new.
    pub fn note_sensor(
        &mut self,
        time: Timestamp,
        kind: CellFaultKind,
        probability: f64,
        size: ScalarGaussian,
    ) -> Option<CellFault> {
        let find = |findings: &[CellFault]| findings.iter().copied().find(|found| found.kind == kind);
        let was_known = find(&self.findings).is_some();
        self.put(CellFault { kind, cells: None, since: time, reported: time, probability, size });
        find(&self.findings).filter(|_| !was_known)
    }

    /// Checks once per day whether the learned values of all cells show a rise of the current sensor's gain. Returns
    /// the finding if it is new.
    pub fn note_day(
        &mut self,
        time: Timestamp,
        temperature_c: f64,
        cells: impl Iterator<Item = CellAgeing>,
    ) -> Option<CellFault> {
        if !self.gain.is_due(time) {
            return None;
        }
        let (probability, size) = self.gain.take(time, temperature_c, &cells.collect::<Vec<_>>());
        self.note_sensor(time, CellFaultKind::CurrentGain, probability, size)
    }

    /// Ends a row and returns the new findings.
    ///
    /// * `socs`: estimated SOC of each cell, to choose the middle cell.
    /// * `is_balanced`: whether the BMS may bleed fuller cells after a charge.
    /// * `balancing`: balancing settings, if the BMS sends balancing bits.
    /// * `is_prior`: whether the model was derived from a label, instead of being given or learned.
    pub fn close_row(
        &mut self,
        (model, is_prior): (&CellModel, bool),
        capacity_ah: f64,
        socs: impl Fn(usize) -> Option<f64>,
        is_balanced: bool,
        balancing: Option<BalancingConfig>,
    ) -> Vec<CellFault> {
        self.is_prior = is_prior;
        let pack = std::mem::take(&mut self.pack);
        let (Some(begun), Some(time)) = (pack.begun, pack.last) else { return Vec::new() };
        self.pack.last = pack.last;
        let mean = |sum: f64| sum / f64::from(pack.count.max(1));
        let (soc, charge_ah) = (mean(pack.soc), pack.first_ah + mean(pack.charge_ah));
        let (temperature_c, current_a, drop_v) = (mean(pack.temperature_c), mean(pack.current_a), mean(pack.drop_v));
        let voltages_v: Vec<Option<f64>> = self.cells.iter().map(|cell| cell.sums.mean_v()).collect();
        let middle_v = middle(voltages_v.iter().flatten().copied());
        let mut curve_soc = soc;
        if !is_prior {
            self.slope.forget();
        } else if let Some(middle_v) = middle_v {
            // The middle voltage is already corrected for the drop of the series resistance `ohm`.
            let ocv_v = middle_v + drop_v - self.ohm * current_a;
            curve_soc = PackSlope::position(model, capacity_ah, temperature_c, soc, ocv_v);
            self.slope.add(model, capacity_ah, temperature_c, SlopeRow { charge_ah, soc: curve_soc, ocv_v, drop_v });
        }
        let factor = self.slope.factor(curve_soc);
        let row = Row { model, factor, capacity_ah, soc, curve_soc, temperature_c, current_a, drop_v, charge_ah };
        let middle_time = begun.plus_secs(0.5 * time.since(begun));
        let seconds = self.last_row.map_or(0.0, |(last, ..)| middle_time.since(last));
        self.pass(middle_time, &row);
        self.remove_bled_charge(time, capacity_ah, balancing);
        let before = self.findings.clone();
        if let Some(middle_v) = middle_v {
            self.observe(time, seconds, &row, &voltages_v, middle_v);
            self.slope_v = factor.mean * row.model_slope_v();
            self.observe_temperatures(time, seconds);
            // A BMS bleeds cells near the end of a charge, at about SOC 0.9.
            let slope_v = || model.ocv_slope_v(&model.grid_position(0.9, temperature_c), capacity_ah);
            self.judge(time, is_balanced.then(slope_v));
        }
        self.cells.iter_mut().for_each(|cell| cell.sums.begin());
        self.ohm = model.r0_ohm(&model.grid_position(soc, temperature_c));
        self.choose_middle(socs);
        let is_new = |found: &&CellFault| !before.iter().any(|old| (old.kind, old.cells) == (found.kind, found.cells));
        self.findings.iter().filter(is_new).copied().collect()
    }

    fn pass(&mut self, time: Timestamp, row: &Row<'_>) {
        let Some((last, last_soc, last_ah)) = self.last_row.replace((time, row.soc, row.charge_ah)) else { return };
        let counted = (last_ah - row.charge_ah) / row.capacity_ah;
        let estimated = row.soc - last_soc;
        // If the estimated SOC jumped, the filter corrected its estimate although no charge moved. Use the counted
        // charge instead.
        let change = if (estimated - counted).abs() < SOC_JUMP { estimated } else { counted };
        let days = (time.since(last) / DAY_S).max(0.0);
        self.cells.iter_mut().for_each(|cell| cell.difference.pass(days, change));
    }

    fn observe(&mut self, time: Timestamp, seconds: f64, row: &Row<'_>, voltages_v: &[Option<f64>], middle_v: f64) {
        let to_reference = self.slope.reference_soc() - row.curve_soc;
        let mut charges = Vec::with_capacity(self.cells.len());
        for cell in &mut self.cells {
            cell.channel.end_row(&cell.sums, middle_v);
        }
        let (mut channels, sums): (Vec<Channel>, Vec<CellSums>) =
            self.cells.iter().map(|cell| (cell.channel, cell.sums)).unzip();
        compare(&mut channels, &sums);
        self.cells.iter_mut().zip(channels).for_each(|(cell, channel)| cell.channel = channel);
        let mut jumped: Vec<(usize, Observation)> = Vec::new();
        let may_be_bled: Vec<bool> = (0..self.cells.len()).map(|cell| self.may_be_bled(cell)).collect();
        for (index, voltage_v) in voltages_v.iter().enumerate() {
            let cell = &mut self.cells[index];
            let Some(voltage_v) = voltage_v.filter(|_| !cell.channel.is_frozen) else { continue };
            let observed =
                row.observation(cell.difference.mean(), cell.difference.state(SOC).variance, voltage_v - middle_v);
            let charge = cell.difference.soc_after(to_reference).mean;
            charges.push((charge, (voltage_v - middle_v) / row.curve_v(charge)));
            if may_be_bled[index] {
                cell.difference.open_charge(seconds / DAY_S, &observed);
            }
            if cell.difference.is_settled() {
                cell.settled = *cell.difference.mean();
            }
            if cell.difference.observe(&observed) {
                (cell.jumped, cell.before_jump) = (Some(time), cell.settled);
                jumped.push((index, observed));
            }
        }
        self.handle_jumps(time, row, &jumped, |cell| voltages_v[cell].map(|v| v - middle_v));
        self.observe_steps(row);
        self.slope.learn_from_cells(row.curve_soc, row.model_slope_v(), charges);
    }

    fn observe_steps(&mut self, row: &Row<'_>) {
        let least_a2 = LEAST_STEPS * row.capacity_ah * row.capacity_ah;
        let ohms: Vec<Option<(f64, f64)>> = self.cells.iter().map(|cell| cell.sums.ohm(least_a2)).collect();
        let Some(middle_ohm) = middle(ohms.iter().flatten().map(|(ohm, _)| *ohm)) else { return };
        let (now_ohm, contact_ohm) = (row.ohm(), row.contact_ohm());
        let mut slope = [0.0; STATES];
        (slope[RESISTANCE], slope[CONTACT]) = (now_ohm, contact_ohm);
        let innovation_ohm = |cell: &WatchedCell, ohm: f64| {
            let mean = cell.difference.mean();
            ohm - middle_ohm - slope[RESISTANCE] * mean[RESISTANCE] - slope[CONTACT] * mean[CONTACT]
        };
        // The scatter between the cells includes the noise of the voltage channels, which is high for a coarse
        // resolution.
        let innovations =
            self.cells.iter().zip(&ohms).filter_map(|(cell, ohm)| Some(innovation_ohm(cell, ohm.as_ref()?.0)));
        let scatter_ohm = Population::of(innovations).std;
        for (cell, ohm) in self.cells.iter_mut().zip(ohms) {
            let Some((ohm, steps_a2)) = ohm else { continue };
            let (part, noise) = (STEP_PART * now_ohm, STEP_V / steps_a2.sqrt());
            let variance = (part * part + noise * noise).max(scatter_ohm * scatter_ohm);
            cell.difference.observe_steps(&Observation { innovation: innovation_ohm(cell, ohm), slope, variance });
        }
    }

    fn choose_middle(&mut self, socs: impl Fn(usize) -> Option<f64>) {
        let of_cells: Vec<Option<f64>> = (0..self.cells.len()).map(socs).collect();
        let middle = Population::of(of_cells.iter().flatten().copied()).middle;
        let off = |cell: usize, soc: &Option<f64>| {
            let mean = self.cells[cell].difference.mean();
            soc.map_or(f64::INFINITY, |soc| (soc - middle).abs() + 0.1 * (mean[RESISTANCE].abs() + mean[CONTACT].abs()))
        };
        let nearest = of_cells.iter().enumerate().min_by(|a, b| off(a.0, a.1).total_cmp(&off(b.0, b.1)));
        if let Some((cell, Some(_))) = nearest {
            self.middle = cell;
        }
    }

    fn observe_temperatures(&mut self, time: Timestamp, seconds: f64) {
        let of_cells: Vec<Option<f64>> = self.cells.iter().map(|cell| cell.sums.mean_c()).collect();
        if of_cells.iter().flatten().count() < LEAST_CELLS {
            return;
        }
        let warm = |(cell, here_c): (&mut WatchedCell, Option<f64>)| Some(cell.temperature.warming_k(seconds, here_c?));
        let warmings_k: Vec<Option<f64>> = self.cells.iter_mut().zip(of_cells).map(warm).collect();
        let middle_k = Population::of(warmings_k.iter().flatten().copied()).middle;
        for (cell, here_k) in self.cells.iter_mut().zip(warmings_k) {
            if let Some(here_k) = here_k {
                cell.temperature.compare(seconds, middle_k, here_k);
            }
        }
        let kind = CellFaultKind::TemperatureSensor;
        let reported: Vec<CellFault> = self.findings.iter().filter(|found| found.kind == kind).copied().collect();
        self.findings.retain(|found| found.kind != kind);
        let mut first = 0;
        let mut detached: Vec<(CellIndex, CellIndex)> = Vec::new();
        for of_one in self.cells.chunk_by(|a, b| a.temperature == b.temperature) {
            if of_one[0].temperature.is_detached {
                detached.push((CellIndex(first as u16), CellIndex((first + of_one.len() - 1) as u16)));
            }
            first += of_one.len();
        }
        for cells in detached.into_iter().map(Some) {
            let before = reported.iter().find(|found| found.cells == cells);
            let since = before.map_or(time, |found| found.since);
            let reported = before.map_or(time, |found| found.reported);
            let size = ScalarGaussian { mean: 1.0, variance: 0.0 };
            self.insert(CellFault { kind, cells, since, reported, probability: 1.0, size });
        }
    }

    /// Resets the charge of all cells after a gap of unknown length.
    pub fn forget_charge(&mut self) {
        self.interrupt();
        self.last_row = None;
        for cell in &mut self.cells {
            cell.difference.forget_charge();
            cell.bleed.forget_time();
        }
    }

    /// Discards the samples of the present row, because the next sample follows a gap.
    pub fn interrupt(&mut self) {
        self.pack = PackSums::default();
        self.rest_s = 0.0;
        self.slope.interrupt();
        self.cells.iter_mut().for_each(WatchedCell::interrupt);
    }

    /// Shifts all timestamps by `by_nanos`, to another clock.
    pub fn rebase(&mut self, by_nanos: i64) {
        let moved = |stamp: &mut Timestamp| *stamp = stamp.plus_nanos(by_nanos);
        self.findings.iter_mut().for_each(|found| {
            moved(&mut found.since);
            moved(&mut found.reported);
        });
        self.last_row.iter_mut().for_each(|(time, ..)| moved(time));
        self.gain.rebase(by_nanos);
        for cell in &mut self.cells {
            cell.suspected.iter_mut().flatten().chain(&mut cell.jumped).for_each(moved);
            cell.bleed.timer.rebase(by_nanos);
        }
    }

    /// Checks the numbers of a stored detector for `cells` cells.
    ///
    /// # Errors
    /// The first impossible number.
    pub fn check(&self, cells: usize) -> Result<(), InvalidState> {
        let expected = if cells < LEAST_CELLS { 0 } else { cells };
        let count = self.cells.len();
        InvalidState::unless(count == expected, "the cells of the diagnosis", count as f64, "the cells of the pack")?;
        let middle = self.middle;
        InvalidState::unless(middle <= cells, "the middle cell of the diagnosis", middle as f64, "a cell of the pack")?;
        for cell in &self.cells {
            cell.difference.check()?;
            cell.channel.check(cells)?;
            cell.bleed.check()?;
            let numbers = cell
                .sums
                .numbers()
                .into_iter()
                .chain(cell.temperature.numbers())
                .chain(cell.settled)
                .chain(cell.before_jump);
            InvalidState::unless_numbers("a number of the diagnosis", numbers)?;
        }
        let PackSums { current_a, drop_v, soc, temperature_c, charge_ah, first_ah, .. } = self.pack;
        let last = self.last_row.map_or([0.0; 2], |(_, soc, charge_ah)| [soc, charge_ah]);
        let numbers = [current_a, drop_v, soc, temperature_c, charge_ah, first_ah, self.rest_s, self.ohm, self.slope_v];
        InvalidState::unless_numbers("a number of the diagnosis", numbers.into_iter().chain(last))?;
        self.gain.check()?;
        self.slope.check()?;
        for found in &self.findings {
            let (first, last) = found.cells.unwrap_or((CellIndex(0), CellIndex(0)));
            let is_there = first <= last && last.index() < cells;
            InvalidState::unless(is_there, "the cell of a finding", f64::from(last.0), "a cell of the pack")?;
            InvalidState::unless_numbers("a finding", [found.size.mean, found.size.variance, found.probability])?;
        }
        Ok(())
    }
}

/// Mean of the middle half of the values, which a single outlier hardly changes. `None` for fewer than three values.
fn middle(values: impl Iterator<Item = f64>) -> Option<f64> {
    // Allocates once. Collecting a filtered iterator would start with a small buffer and grow it.
    let mut kept = Vec::with_capacity(values.size_hint().1.unwrap_or_default());
    kept.extend(values);
    if kept.len() < LEAST_CELLS {
        return None;
    }
    let inner = inner_half(&mut kept, |value: &f64| *value);
    Some(inner.iter().sum::<f64>() / inner.len() as f64)
}

/// Sorts the values and returns them without the lowest quarter and the highest quarter.
fn inner_half<T>(values: &mut [T], by: impl Fn(&T) -> f64) -> &[T] {
    values.sort_by(|a, b| by(a).total_cmp(&by(b)));
    let cut = values.len() / 4;
    &values[cut..values.len() - cut]
}

#[cfg(test)]
mod tests;
