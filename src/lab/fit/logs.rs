//! Fits a cell model to logs of a whole pack: ordinary drives and charges that start at any SOC.
//!
//! Where the logs contain no information, the tables stay as in the configured model.
//!
//! Every log is replayed through the monitor, so limits, decoding and fault handling are the same as in the daemon.
//! Only cells of the configured kind are used. Their mean voltage is fitted like the voltage of a single cell. A
//! stretch is a part of a log without gaps. Its initial SOC is an additional unknown.

use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::cells::{self, CellDistances};
use super::evidence::{self, Capacity};
use super::prepare::CREDIBLE_BEYOND_V;
use super::{
    ELECTRODES_C, FileResidual, FitOutcome, FitProgress, LogsOutcome, MeasuredRange, ageing_electrodes, chemistry,
    judged, verdict,
};
use crate::cell::CellModel;
use crate::error::LabError;
use crate::filter::median;
use crate::ident::fit::{FitSettings, FittedTables};
use crate::ident::grid::{Grid, arrhenius};
use crate::ident::parameters::ParameterTables;
use crate::ident::pass::COLD_POWER;
use crate::ident::prior::PriorDeviations;
use crate::ident::record::{self, Limits, Record};
use crate::ident::unanchored::{self, Known, UnanchoredFit, UnanchoredRecord};
use crate::ident::{MeasuredPart, charge_ah, error_table, thermal};
use crate::io::log::{LogOptions, LogSource};
use crate::monitor::{Estimate, Monitor, MonitorConfig};
use crate::quantity::CellIndex;
use crate::replay::{self, OutputWatch, ReplaySettings, Sinks};

/// A stretch with fewer rows is not used.
const LEAST_ROWS: usize = 20;
/// Standard deviation (SOC) that is added to the uncertainty of a stretch's initial SOC, as a root sum of squares.
const BEGINNING_STD: f64 = 0.02;
/// A stretch starts full if its open-circuit voltage is at least the OCV at this SOC.
const FULL_SOC: f64 = 0.975;
/// Smallest series resistance of a real cell, as a share of the model's resistance. The open-circuit voltage at the
/// start of a stretch is computed with this resistance.
const LEAST_RESISTANCE: f64 = 0.4;
/// Standard deviation of the initial SOC of a stretch that starts full.
const FULL_STD: f64 = 0.01;
/// If the SOC of a cold cell is below this value times (Arrhenius factor - 1), diffusion limits the cell. A circuit
/// model does not describe the voltage in this range, and the voltage error would be mistaken for lost capacity. The
/// value was chosen on Panasonic 18650PF cells.
const KNEE_SOC: f64 = 0.13;
/// Upper limit of [`KNEE_SOC`] times (Arrhenius factor - 1).
const MOST_KNEE_SOC: f64 = 0.35;
/// SOC error of a cold cell divided by (Arrhenius factor - 1). The error arises because the voltage of a cold cell does
/// not settle within a drive. After rests of 20 min at 10 to -20 degrees C, the value is 0.013 to 0.024 for Panasonic
/// 18650PF cells. Rests during drives are shorter, so the error is larger.
const COLD_SOC: f64 = 0.03;
/// Residual (V) above which the logs cannot come from a single kind of cell. In the cold, this limit is multiplied by a
/// power of the Arrhenius factor. Fits of the cells of `tests/label` leave 5 to 20 mV when warm and 27 mV at
/// 0 degrees C.
const UNFIT_V: f64 = 0.04;
/// A charge is complete only if the voltage is within this distance of the maximum voltage (V).
const HELD_V: f64 = 0.012;
/// A charge is complete only if the charge current has fallen below the rated capacity divided by this time (h).
const FADED_H: f64 = 15.0;
/// Smallest assumed error of the configured model's open-circuit curve (V): first the part that varies smoothly over
/// [`CURVE_SOC`], then the independent error of each breakpoint.
const CURVE_V: (f64, f64) = (0.004, 0.002);
/// Correlation length of the smooth part, SOC.
const CURVE_SOC: f64 = 0.1;
const SOC: [f64; 26] = [
    0.0, 0.02, 0.05, 0.075, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85,
    0.9, 0.93, 0.96, 0.98, 0.99, 1.0,
];

/// Logs of a pack, and the settings to read them.
pub struct LogRequest<'a> {
    /// Configuration of the monitor. The fit starts from its cell model.
    pub monitor: &'a MonitorConfig,
    /// Names of the interfaces.
    pub interfaces: Vec<String>,
    /// A gap in a log longer than this (s) means that the recorder was asleep.
    pub sleep_gap_s: f64,
    /// Creates the options for reading one log.
    pub options: &'a (dyn Fn() -> LogOptions + Sync),
    /// Logs; each is replayed separately.
    pub logs: Vec<PathBuf>,
}

#[derive(Debug, Clone, Default)]
struct Stretch {
    log: usize,
    part: MeasuredPart,
    cells: CellDistances,
    /// Initial SOC from the estimator, with its standard deviation.
    beginning: (f64, f64),
}

#[derive(Debug, Default)]
struct MeanCell {
    stretches: Vec<Stretch>,
    /// Latest voltage of each cell; NaN = this cell is not yet part of the sums.
    voltage_v: Vec<f64>,
    count: f64,
    sums: [f64; 6],
    begins: bool,
}

impl MeanCell {
    fn new(cells: usize) -> Self {
        Self { voltage_v: vec![f64::NAN; cells], ..Self::default() }
    }

    fn take(&mut self, estimate: &Estimate) {
        let cell = estimate.cell.index();
        if self.voltage_v.get(cell).is_some_and(|v| v.is_finite()) {
            self.close();
        }
        let measured = &estimate.measured;
        if let Some(voltage_v) = self.voltage_v.get_mut(cell) {
            *voltage_v = measured.voltage_v;
        }
        let values = [
            estimate.time.secs(),
            measured.current_a,
            measured.voltage_v,
            measured.temperature_c,
            estimate.soc,
            estimate.soc_std,
        ];
        self.count += 1.0;
        self.sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
    }

    /// Starts a new stretch at the next reading, because an unknown time has passed.
    fn end_stretch(&mut self) {
        if self.count > 0.0 {
            self.close();
        }
        self.begins = true;
    }

    fn close(&mut self) {
        let [time_s, current_a, voltage_v, temperature_c, soc, soc_std] = self.sums.map(|sum| sum / self.count);
        (self.count, self.sums) = (0.0, [0.0; 6]);
        if !(time_s.is_finite() && current_a.is_finite() && voltage_v.is_finite()) {
            self.voltage_v.fill(f64::NAN);
            return;
        }
        let last_s = self.stretches.last().and_then(|stretch| stretch.part.time_s.last().copied());
        // A gap of more than 120 s begins a new stretch. This is longer than the interval of any logger and shorter
        // than a stop.
        let has_hole = last_s.is_none_or(|last_s| time_s - last_s > 120.0 || time_s < last_s);
        if std::mem::take(&mut self.begins) || has_hole {
            let beginning = (soc, soc_std.hypot(BEGINNING_STD));
            self.stretches.push(Stretch { beginning, ..Stretch::default() });
        }
        if let Some(stretch) = self.stretches.last_mut() {
            stretch.part.push(time_s, current_a, voltage_v, temperature_c, f64::NAN);
            stretch.cells.push(time_s, voltage_v, &self.voltage_v);
        }
        self.voltage_v.fill(f64::NAN);
    }
}

/// Reads the logs and fits the model.
///
/// # Errors
/// The logs cannot be read, or the data do not support a fit. The error has one line per fault.
pub fn run(request: &LogRequest<'_>, mut progress: impl FnMut(FitProgress)) -> Result<FitOutcome, LabError> {
    let numbered: Vec<(usize, &PathBuf)> = request.logs.iter().enumerate().collect();
    let read: Result<Vec<_>, LabError> =
        numbered.par_iter().map(|(log, path)| stretches(request, *log, path)).collect();
    let stretches: Vec<Stretch> = read?.into_iter().flatten().filter(|s| s.part.len() >= LEAST_ROWS).collect();
    progress(FitProgress::Read(request.logs.len(), request.logs.len()));
    if stretches.is_empty() {
        return Err(LabError::Data(format!(
            "no stretch of {LEAST_ROWS} readings with current and voltage in the logs"
        )));
    }
    fit_stretches(request, &stretches, progress)
}

fn fit_stretches(
    request: &LogRequest<'_>,
    stretches: &[Stretch],
    mut progress: impl FnMut(FitProgress),
) -> Result<FitOutcome, LabError> {
    let model = &request.monitor.model;
    let grid = Grid { soc: SOC.to_vec(), temperature_c: temperature_nodes(stretches) };
    let records: Vec<UnanchoredRecord> = stretches.iter().map(|stretch| unanchored(stretch, &grid, model)).collect();
    let settings = FitSettings {
        grid: grid.clone(),
        tau_s: vec![],
        voltage_v: (model.voltage_min_v, model.voltage_max_v),
        ocv: vec![],
        min_slope_v: vec![],
        deviations: PriorDeviations::CHEMISTRY,
    };
    let known = known(model, &grid, request.monitor);
    let fit = unanchored::fit(&settings, &known, &records, |pass, cost| progress(FitProgress::Pass(pass, cost)))
        .map_err(LabError::Data)?;
    // If the residual is large, the logs come from two packs or from cells of an unknown kind. The model from which the
    // fit started is then kept.
    let unfit_v = Some(fit.fitted.total.rmse_v).filter(|rmse_v| *rmse_v > unfit_v(&grid));
    let fit =
        if unfit_v.is_some() { unanchored::prior(&settings, &known, &records).map_err(LabError::Data)? } else { fit };
    let file_of_record: Vec<usize> = stretches.iter().map(|stretch| stretch.log).collect();
    let capacity_ah = fit.capacity_ah;
    let errors_v = error_table::table(&fit.fitted, &judged(&fit.records, &file_of_record), capacity_ah);
    let cold_v = unsettled_v(&fit.fitted);
    let voltage_error_v = (0..errors_v.len()).map(|n| errors_v[n].hypot(fit.ocv_std_v[n]).hypot(cold_v[n])).collect();
    let distances: Vec<&CellDistances> = stretches.iter().map(|stretch| &stretch.cells).collect();
    let cells =
        cells::fit(usize::from(request.monitor.sample.cells), &distances, &fit.records, &fit.fitted.tables, &grid.soc);
    let mut notes = notes(model, stretches, &fit, &known);
    notes.extend(unfit_v.map(|rmse_v| {
        let rmse_mv = 1e3 * rmse_v;
        format!(
            "the voltages do not match any single cell (residual {rmse_mv:.0} mV): the model the fit started from is kept"
        )
    }));
    notes.extend(cells::notes(&cells));
    let electrodes = ageing_electrodes(&fit.fitted, capacity_ah);
    let thermal = thermal::fit(&fit.records, &fit.fitted.tables, capacity_ah * fit.fitted.mean_ocv_v());
    let mut outcome = FitOutcome {
        electrodes,
        capacity_ah,
        voltage_v: settings.voltage_v,
        thermal: thermal.ok(),
        voltage_error_v,
        measured: MeasuredRange::of(&fit.records),
        by_kind: None,
        files: files(request, &fit.records, &file_of_record, &fit.fitted.tables),
        tables: Vec::new(),
        records: fit.records,
        file_of_record,
        notes,
        verdict: vec![],
        logs: Some(LogsOutcome { capacity_std_ah: fit.capacity_std_ah, cells }),
        fit: fit.fitted,
    };
    outcome.verdict = verdict::verdict(&outcome);
    Ok(outcome)
}

fn notes(model: &CellModel, stretches: &[Stretch], fit: &UnanchoredFit, known: &Known) -> Vec<String> {
    let (capacity_ah, std_ah) = (fit.capacity_ah, fit.capacity_std_ah);
    let mut notes = vec![format!(
        "capacity {capacity_ah:.3} +/- {std_ah:.3} Ah per cell, {:+.1} % of the {} Ah of {:?}",
        100.0 * (capacity_ah / model.capacity_ah - 1.0),
        model.capacity_ah,
        model.name
    )];
    let parts: Vec<&MeasuredPart> = stretches.iter().map(|stretch| &stretch.part).collect();
    let before = Capacity { mean_ah: known.capacity_ah, std_ah: known.capacity_std * known.capacity_ah };
    notes.extend(evidence::notes(&parts, &fit.records, before, Capacity { mean_ah: capacity_ah, std_ah }));
    let beginnings = stretches.iter().map(|stretch| (&stretch.part, stretch.beginning.0));
    notes.extend(chemistry::label_of(model).and_then(|label| {
        chemistry::note(&label, (capacity_ah, fit.offset_a), error_ratio(&fit.fitted.grid), beginnings)
    }));
    notes
}

fn unfit_v(grid: &Grid) -> f64 {
    UNFIT_V * error_ratio(grid)
}

fn error_ratio(grid: &Grid) -> f64 {
    let coldest_c = grid.temperature_c.first().copied().unwrap_or(ELECTRODES_C);
    libm::pow(1.0 + colder(coldest_c), COLD_POWER)
}

fn unsettled_v(fitted: &FittedTables) -> Vec<f64> {
    let (soc, columns) = (&fitted.grid.soc, fitted.grid.soc.len());
    let of_node = |node: usize| {
        let (first, s) = (node - node % columns, node % columns);
        let (low, high) = (s.saturating_sub(1), (s + 1).min(columns - 1));
        let ocv_v = &fitted.tables.ocv_v;
        let slope_v = (ocv_v[first + high] - ocv_v[first + low]) / (soc[high] - soc[low]);
        slope_v * COLD_SOC * colder(fitted.grid.temperature_c[node / columns])
    };
    (0..fitted.tables.ocv_v.len()).map(of_node).collect()
}

/// Returns the Arrhenius factor minus 1, but at least 0.
fn colder(temperature_c: f64) -> f64 {
    (arrhenius(temperature_c) - 1.0).max(0.0)
}

fn stretches(request: &LogRequest<'_>, log: usize, path: &Path) -> Result<Vec<Stretch>, LabError> {
    let mean = Rc::new(RefCell::new(MeanCell::new(usize::from(request.monitor.sample.cells))));
    let watched = Rc::clone(&mean);
    // Other kinds of cells have another open-circuit curve.
    let is_own: Vec<bool> =
        (0..request.monitor.sample.cells).map(|cell| request.monitor.is_own(CellIndex(cell))).collect();
    let watch: OutputWatch = Box::new(move |record, out| {
        let mut mean = watched.borrow_mut();
        if record.is_unknown_gap() {
            mean.end_stretch();
        }
        out.estimates.iter().filter(|it| is_own[it.cell.index()]).for_each(|estimate| mean.take(estimate));
    });
    let sinks = Sinks { watch: Some(watch), ..Sinks::default() };
    let mut source = LogSource::new([path.to_owned()], (request.options)());
    let settings = ReplaySettings::plain(request.sleep_gap_s, request.interfaces.clone());
    // The label (chemistry and rated capacity of the cells) is removed from the configuration. Without a label, the
    // monitor does not learn a model, so the initial model stays the same during the replay.
    let monitor = Monitor::new(MonitorConfig { label: None, ..request.monitor.clone() });
    replay::run(&mut source, monitor, sinks, settings, &mut |_| ())
        .map_err(|error| LabError::Data(error.to_string()))?;
    let mut mean = mean.borrow_mut();
    mean.close();
    let stretches = std::mem::take(&mut mean.stretches);
    Ok(stretches.into_iter().map(|stretch| Stretch { log, ..stretch }).collect())
}

/// Converts a stretch to rows of the fit. In these rows, the field `soc` contains minus the charge that was taken out
/// since the first row (Ah).
fn unanchored(stretch: &Stretch, grid: &Grid, model: &CellModel) -> UnanchoredRecord {
    let mut part = stretch.part.clone();
    let first_s = part.time_s[0];
    part.time_s.iter_mut().for_each(|time_s| *time_s -= first_s);
    part.soc = charge_ah(&part.time_s, &part.current_a).iter().map(|ah| -ah).collect();
    let limits = Limits {
        voltage_low_v: model.voltage_min_v - CREDIBLE_BEYOND_V.0,
        voltage_high_v: model.voltage_max_v + CREDIBLE_BEYOND_V.1,
        capacity_ah: 1.0,
    };
    let is_judged = |k: usize| part.voltage_v[k] >= knee_v(model, part.current_a[k], part.temperature_c[k]);
    let judged: Vec<bool> = (0..part.len()).map(is_judged).collect();
    let record = Record::prepare(&part, &judged, grid, &limits);
    let scale = record::share(&record) * record::weight(&record) / model.rated_capacity_ah;
    let full = full(&part, model);
    let beginning = if begins_full(&part, model) { (1.0, FULL_STD) } else { stretch.beginning };
    UnanchoredRecord { record, scale, beginning, full }
}

/// Whether a stretch starts with a full cell: even with the smallest resistance ([`LEAST_RESISTANCE`]), the computed
/// open-circuit voltage reaches the open-circuit voltage of a full cell.
fn begins_full(part: &MeasuredPart, model: &CellModel) -> bool {
    let (voltage_v, current_a, temperature_c) = (part.voltage_v[0], part.current_a[0], part.temperature_c[0]);
    let drop_v = LEAST_RESISTANCE * model.r0_ohm(&model.grid_position(1.0, temperature_c)) * current_a;
    voltage_v + drop_v >= model.ocv_v(&model.grid_position(FULL_SOC, temperature_c))
}

/// Returns the voltage (V) below which diffusion limits a cold cell. Rows with a lower voltage do not count in the fit.
fn knee_v(model: &CellModel, current_a: f64, temperature_c: f64) -> f64 {
    let soc = (KNEE_SOC * colder(temperature_c)).min(MOST_KNEE_SOC);
    if soc <= 0.0 {
        return f64::NEG_INFINITY;
    }
    let position = model.grid_position(soc, temperature_c);
    model.ocv_v(&position) - model.settled_ohm(&position) * current_a.max(0.0)
}

/// Finds the last row at which a charge is complete. Returns the charge taken out before this row (Ah) and the time of
/// the row (h).
fn full(part: &MeasuredPart, model: &CellModel) -> Option<(f64, f64)> {
    let most_a = model.rated_capacity_ah / FADED_H;
    let is_full = |&k: &usize| {
        part.voltage_v[k] >= model.voltage_max_v - HELD_V && (-most_a..-0.01 * most_a).contains(&part.current_a[k])
    };
    (0..part.len()).rev().find(is_full).map(|k| (-part.soc[k], part.time_s[k] / 3600.0))
}

fn temperature_nodes(stretches: &[Stretch]) -> Vec<f64> {
    let of_stretch = |stretch: &Stretch| median(stretch.part.temperature_c.iter().copied());
    let mut medians: Vec<f64> = stretches.iter().filter_map(of_stretch).collect();
    medians.sort_by(f64::total_cmp);
    // Neighbouring temperatures that differ by less than 5 K are combined to one temperature breakpoint.
    let groups = medians.chunk_by(|a, b| b - a < 5.0);
    groups.map(|group| (10.0 * group.iter().sum::<f64>() / group.len() as f64).round() / 10.0).collect()
}

fn known(model: &CellModel, grid: &Grid, monitor: &MonitorConfig) -> Known {
    let per_node = |value: &dyn Fn(f64, f64) -> f64| -> Vec<f64> {
        grid.temperature_c
            .iter()
            .flat_map(|&t| grid.soc.iter().map(move |&soc| (soc, t)))
            .map(|(soc, t)| value(soc, t))
            .collect()
    };
    let at = |soc: f64, t: f64| model.grid_position(soc, t);
    let branches = 0..model.branches.len();
    let tables = ParameterTables {
        ocv_v: per_node(&|soc, t| model.ocv_v(&at(soc, t))),
        r0_ohm: per_node(&|soc, t| model.r0_ohm(&at(soc, t))),
        r_ohm: branches.clone().map(|i| per_node(&|soc, t| model.branch_r_ohm(i, &at(soc, t)))).collect(),
        tau_s: branches.map(|i| per_node(&|soc, t| model.branch_tau_s(i, &at(soc, t)))).collect(),
    };
    let distance = |t: usize| (grid.temperature_c[t] - ELECTRODES_C).abs();
    let curve_row = (0..grid.temperature_c.len()).min_by(|&a, &b| distance(a).total_cmp(&distance(b))).unwrap_or(0);
    let position = |s: usize| at(grid.soc[s], grid.temperature_c[curve_row]);
    let modes_v: Vec<_> = (0..SOC.len()).map(|s| model.aged_ocv_changes_v(&position(s), model.capacity_ah).1).collect();
    let rest_v = |s: usize| model.voltage_error_v(&position(s)).unwrap_or(0.0).hypot(CURVE_V.0);
    let curve_covariance = DMatrix::from_fn(SOC.len(), SOC.len(), |a, b| {
        let modes: f64 = modes_v[a].iter().zip(&modes_v[b]).map(|(a, b)| a * b).sum();
        let apart = (grid.soc[a] - grid.soc[b]) / CURVE_SOC;
        let alone = if a == b { CURVE_V.1 * CURVE_V.1 } else { 0.0 };
        modes + rest_v(a) * rest_v(b) * libm::exp(-0.5 * apart * apart) + alone
    });
    let initial = &monitor.estimator.initial;
    Known {
        tables,
        curve_covariance,
        curve_row,
        capacity_ah: initial.capacity_ah,
        capacity_std: initial.capacity_std_ah / initial.capacity_ah,
        // The standard deviation of the offset is at least C/1000 (a current that takes 1000 h for the rated capacity).
        offset_std_a: monitor.estimator.sensor.current_offset_a.max(model.rated_capacity_ah / 1000.0),
    }
}

fn files(
    request: &LogRequest<'_>,
    records: &[Record],
    file_of_record: &[usize],
    tables: &ParameterTables,
) -> Vec<FileResidual> {
    let of_log = |(log, path): (usize, &PathBuf)| {
        let own: Vec<Record> =
            records.iter().zip(file_of_record).filter(|(_, file)| **file == log).map(|(r, _)| r.clone()).collect();
        FileResidual::of(path, &own, tables)
    };
    request.logs.iter().enumerate().map(of_log).collect()
}
