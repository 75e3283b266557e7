//! Fits a cell model to measured files: `packwatch fit` without its terminal output.
//!
//! Input: measured CSV files ([`super::measured`]), slow tests (discharges so slow that they show the open-circuit
//! voltage), and the data of the cell from the command line. One error lists all files whose SOC cannot be determined,
//! with the reasons.

mod cells;
mod chemistry;
mod document;
mod evidence;
mod limits;
pub mod logs;
mod nodes;
mod picture;
mod prepare;
mod range;
mod request;
mod toml;
mod verdict;

use std::path::{Path, PathBuf};

use rayon::prelude::*;

pub use cells::CellDeviation;
pub use document::document;
pub use picture::write as write_plot;
pub use range::MeasuredRange;
pub use request::{FitRequest, MAX_SOC_NODES};
pub use toml::text;
pub(crate) use toml::{list as toml_list, quoted, table as toml_table};

use super::measured::MeasuredFile;
use crate::cell::{AgedOcv, Thermal};
use crate::error::LabError;
use crate::filter::ends;
use crate::ident::electrodes::{self, FittedElectrodes};
use crate::ident::error_table::WeightedRecord;
use crate::ident::fit::{FitSettings, FittedTables, Residual};
use crate::ident::grid::Grid;
use crate::ident::parameters::ParameterTables;
use crate::ident::prior::PriorDeviations;
use crate::ident::record::{self, Record};
use crate::ident::{ageing, error_table, fit, thermal};
use crate::io::csv_log::{CsvOptions, TableReading};

/// Smallest share of the SOC range that the data must cover.
const MIN_SOC_RANGE: f64 = 0.5;
/// Default SOC breakpoints, closer together where the open-circuit voltage (OCV) bends.
const SOC_NODES: [f64; 24] = [
    0.0, 0.025, 0.05, 0.075, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85,
    0.9, 0.95, 0.975, 1.0,
];
/// SOC breakpoints if slow tests give the shape of the OCV. [`nodes`] adds more where the OCV bends.
const SLOW_TEST_SOC_NODES: [f64; 15] = [0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0];
/// SOC breakpoints for the full discharges of an ageing cell, which have a sharp knee.
const AGEING_SOC_NODES: [f64; 25] = [
    0.0, 0.03, 0.045, 0.06, 0.075, 0.09, 0.105, 0.12, 0.14, 0.17, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 0.8, 0.85,
    0.9, 0.93, 0.96, 0.98, 1.0,
];
/// Width of the SOC interval above the cut-off. Its slope continues the curve of an ageing cell below the cut-off.
const LOW_END_SOC: f64 = 0.03;
/// Initial time constants (s) for models with 1, 2 and 3 branches.
const TAU_S: [&[f64]; 3] = [&[60.0], &[10.0, 150.0], &[5.0, 50.0, 500.0]];

/// Temperature at which the electrodes are identified, degrees Celsius.
const ELECTRODES_C: f64 = 25.0;

/// Default shift of the open-circuit curve of an ageing cell (see `AgedOcv::of_shift`). With 0, the curve shrinks
/// evenly; 1 is a pure loss of lithium. The value is a prior, because no fit of a new cell determines it. It was chosen
/// on the measured lives of two cells.
pub const AGEING_SHIFT: f64 = 0.5;

/// Progress of the fit, for a progress bar.
#[derive(Debug, Clone, Copy)]
pub enum FitProgress {
    /// Number of files read so far, and number of all files.
    Read(usize, usize),
    /// Number of the pass, and the cost after it.
    Pass(usize, f64),
}

/// Residuals of one file.
#[derive(Debug, Clone)]
pub struct FileResidual {
    /// Path as given.
    pub path: PathBuf,
    /// Number of raw rows.
    pub rows: usize,
    /// Seconds of data.
    pub seconds: f64,
    /// Number of rows left out because their voltage is not plausible for this cell.
    pub outliers: usize,
    /// Residual of the model.
    pub residual: Residual,
}

impl FileResidual {
    fn of(path: &Path, records: &[Record], tables: &ParameterTables) -> Self {
        Self {
            path: path.to_owned(),
            rows: records.iter().map(|record| record.raw_rows).sum(),
            seconds: records.iter().map(Record::seconds).sum(),
            outliers: records.iter().map(|record| record.outliers).sum(),
            residual: fit::judge(records, tables),
        }
    }
}

/// A fitted model with its provenance and quality.
#[derive(Debug, Clone)]
pub struct FitOutcome {
    /// Tables, and the residual over all records.
    pub fit: FittedTables,
    /// Capacity (Ah).
    pub capacity_ah: f64,
    /// Lowest and highest voltage (V).
    pub voltage_v: (f64, f64),
    /// Electrodes that explain the open-circuit curve. `None` = no known electrodes explain the curve, the request
    /// gives a shift of the curve, or measured files were fitted without a slow test.
    pub electrodes: Option<FittedElectrodes>,
    /// Thermal parameters; `None` = the data do not determine them.
    pub thermal: Option<Thermal>,
    /// Voltage error of the model at each node (V): standard deviation of the 100 s averages.
    pub voltage_error_v: Vec<f64>,
    /// Ranges in which the cell was measured.
    pub measured: MeasuredRange,
    /// Residuals of the discharges and of the charges of an ageing cell; `None` = the cell is not ageing.
    pub by_kind: Option<(Residual, Residual)>,
    /// Residuals of each file; slow tests come last.
    pub files: Vec<FileResidual>,
    /// Interpretation of each file's columns.
    pub tables: Vec<TableReading>,
    /// The fitted records in the order of the files, for plots.
    pub records: Vec<Record>,
    /// For each record, the index of its file in `files`.
    pub file_of_record: Vec<usize>,
    /// Additional results of a fit to logs; `None` = measured files were fitted.
    pub logs: Option<LogsOutcome>,
    /// Notes and warnings to print.
    pub notes: Vec<String>,
    /// Sentences on the accuracy of the model, to print at the end.
    pub verdict: Vec<String>,
}

/// Additional results of a fit to logs of a whole pack.
#[derive(Debug, Clone)]
pub struct LogsOutcome {
    /// Standard deviation of the capacity (Ah).
    pub capacity_std_ah: f64,
    /// Deviation of every cell from the mean cell; empty if the pack has too few cells.
    pub cells: Vec<CellDeviation>,
}

/// Reads and prepares the files, and fits the model.
///
/// # Errors
/// [`FitRequest::check`] rejects the request, files cannot be read or used, or the data do not support a fit. The error
/// has one line per fault.
pub fn run(request: &FitRequest, mut progress: impl FnMut(FitProgress)) -> Result<FitOutcome, LabError> {
    request.check()?;
    let (files, slow) = read_all(request, &mut progress)?;
    let prepared = prepare::prepare(request, &files, &slow)?;
    let settings = settings(request, &prepared);
    let (records, scale) = prepared.records(&settings.grid);
    check_range(&records)?;
    let fitted = fit::fit(&settings, &records, &scale, |pass, cost| progress(FitProgress::Pass(pass, cost)));
    let mut fitted = fitted?;
    if request.first_cycles.is_some() && request.soc.is_none() {
        continue_low_end(&mut fitted);
    }
    let energy_wh = prepared.capacity_ah * fitted.mean_ocv_v();
    let thermal = thermal::fit(&records, &fitted.tables, energy_wh);
    let file_of_record: Vec<usize> = prepared.sources.iter().map(|source| source.file).collect();
    let voltage_error_v = error_table::table(&fitted, &judged(&records, &file_of_record), prepared.capacity_ah);
    let by_kind = request.first_cycles.map(|_| prepared.by_kind(&records, &fitted));
    let all: Vec<&MeasuredFile> = files.iter().chain(&slow).collect();
    let tables = all.iter().map(|file| file.reading.clone()).collect();
    let files = by_file(&all, &prepared, &records, &fitted);
    // Without slow tests, the curve comes from discharges under load and is too coarse to identify electrodes.
    let has_curve = !prepared.ocv.is_empty() && request.ageing_shift.is_none();
    let electrodes = if has_curve { ageing_electrodes(&fitted, prepared.capacity_ah) } else { None };
    let mut outcome = FitOutcome {
        electrodes,
        capacity_ah: prepared.capacity_ah,
        voltage_v: prepared.voltage_v,
        thermal: thermal.clone().ok(),
        voltage_error_v,
        measured: MeasuredRange::of(&records),
        by_kind,
        files,
        tables,
        records,
        file_of_record,
        logs: None,
        notes: prepared.notes,
        verdict: vec![],
        fit: fitted,
    };
    outcome.notes.extend(thermal.err());
    add_notes(request, &mut outcome);
    outcome.verdict = verdict::verdict(&outcome);
    Ok(outcome)
}

/// Returns the electrodes of the fitted curve, if they determine how the curve ages.
fn ageing_electrodes(fitted: &FittedTables, capacity_ah: f64) -> Option<FittedElectrodes> {
    let soc = &fitted.grid.soc;
    let rows: Vec<Vec<f64>> = fitted.tables.ocv_v.chunks(soc.len()).map(<[f64]>::to_vec).collect();
    electrodes::identify(|soc| fitted.ocv_v(soc, ELECTRODES_C))
        .filter(|found| AgedOcv::of_electrodes(&found.electrodes, soc, capacity_ah, &rows).is_some())
}

/// Extends the open-circuit curve of an ageing cell below the cut-off, where data are missing. The extension is a
/// straight line with the slope of the lowest [`LOW_END_SOC`] above the cut-off. Without it, the last rows under load
/// would make the curve too steep. The estimator's innovation gates would then reject the voltages of an aged cell's
/// first rest.
fn continue_low_end(fitted: &mut FittedTables) {
    let soc = &fitted.grid.soc;
    let cut_off = soc.partition_point(|&node| node < ageing::SOC_LEFT);
    let above = soc.partition_point(|&node| node < ageing::SOC_LEFT + LOW_END_SOC);
    for row in fitted.tables.ocv_v.chunks_mut(soc.len()) {
        let slope_v = (row[above] - row[cut_off]) / (soc[above] - soc[cut_off]);
        for s in 0..cut_off {
            row[s] = row[cut_off] - slope_v * (soc[cut_off] - soc[s]);
        }
    }
}

fn judged<'a>(records: &'a [Record], file_of_record: &[usize]) -> Vec<WeightedRecord<'a>> {
    let each = records.iter().zip(file_of_record);
    each.map(|(record, &file)| WeightedRecord { record, file, share: record::share(record) }).collect()
}

fn read_all(
    request: &FitRequest,
    progress: &mut impl FnMut(FitProgress),
) -> Result<(Vec<MeasuredFile>, Vec<MeasuredFile>), LabError> {
    let table = CsvOptions { capacity_ah: request.capacity_ah.or(request.rated_ah), ..request.table.clone() };
    let paths: Vec<&PathBuf> = request.files.iter().chain(&request.ocv).collect();
    let workers = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let mut read = Vec::with_capacity(paths.len());
    for some in paths.chunks(workers) {
        let files: Result<Vec<_>, _> = some.par_iter().map(|path| MeasuredFile::read(path, &table)).collect();
        read.extend(files?);
        progress(FitProgress::Read(read.len(), paths.len()));
    }
    let slow = read.split_off(request.files.len());
    Ok((read, slow))
}

fn settings(request: &FitRequest, prepared: &prepare::FitInputs) -> FitSettings {
    let ageing = request.first_cycles.is_some();
    let branches = request.branches.unwrap_or(if ageing { 1 } else { 2 });
    let tau_s = request.tau_s.clone().unwrap_or_else(|| TAU_S[branches - 1].to_vec());
    let temperature_c = request.temperature_c.clone().unwrap_or_else(|| prepared.temperature_nodes());
    let (default_soc, deviations) = match (ageing, prepared.ocv.first()) {
        (true, _) => (AGEING_SOC_NODES.to_vec(), PriorDeviations::AGEING),
        (false, Some(_)) => (nodes::by_curvature(&SLOW_TEST_SOC_NODES, &prepared.ocv), PriorDeviations::SLOW_TEST),
        (false, None) => (SOC_NODES.to_vec(), PriorDeviations::FREE_OCV),
    };
    FitSettings {
        grid: Grid { soc: request.soc.clone().unwrap_or(default_soc), temperature_c },
        tau_s,
        voltage_v: prepared.voltage_v,
        ocv: prepared.ocv.clone(),
        // Without a minimum slope, a voltage relaxation that is slower than the model's RC branch would bend the top of
        // an ageing cell's OCV down.
        min_slope_v: if ageing { [(0.0, 0.2), (0.9, 1.0)].to_vec() } else { vec![] },
        deviations,
    }
}

fn check_range(records: &[Record]) -> Result<(), LabError> {
    let judged = records.iter().flat_map(|record| &record.rows).filter(|row| row.weight_s > 0.0);
    let (low, high) = ends(judged.map(|row| row.soc));
    if high - low >= MIN_SOC_RANGE {
        return Ok(());
    }
    let found = if high > low { format!("SOC {:.2} to {:.2}", low, high) } else { "no usable row".to_owned() };
    Err(LabError::Data(format!("the data cover {found}, at least {MIN_SOC_RANGE:.1} of the range is needed")))
}

fn by_file(
    files: &[&MeasuredFile],
    prepared: &prepare::FitInputs,
    records: &[Record],
    fitted: &FittedTables,
) -> Vec<FileResidual> {
    let of_file = |(number, file): (usize, &&MeasuredFile)| {
        let own = || prepared.sources.iter().enumerate().filter(move |(_, source)| source.file == number);
        let only: Vec<Record> = own().map(|(i, _)| records[i].clone()).collect();
        FileResidual::of(&file.path, &only, &fitted.tables)
    };
    files.iter().enumerate().map(of_file).collect()
}

fn add_notes(request: &FitRequest, outcome: &mut FitOutcome) {
    if let Some(found) = &outcome.electrodes {
        let (positive, negative) = found.electrodes.names();
        outcome.notes.push(format!("electrodes {positive} and {negative}, within {:.1} mV", 1e3 * found.residual_v));
    } else if !request.ocv.is_empty() && request.ageing_shift.is_none() {
        let most_mv = 1e3 * electrodes::MAX_RESIDUAL_V;
        let what = format!("no known electrodes within {most_mv} mV of the slow test's curve: its ageing is unknown");
        outcome.notes.push(what);
    }
    let outliers: usize = outcome.files.iter().map(|file| file.outliers).sum();
    if outliers > 0 {
        outcome.notes.push(format!("{outliers} rows left out: this cell cannot have their voltage"));
    }
    if !outcome.fit.converged {
        outcome.notes.push(format!("not converged after {} passes", outcome.fit.passes));
    }
    let weak = outcome.fit.unsupported();
    for &t in &outcome.fit.grid.temperature_c {
        let soc: Vec<String> = weak.iter().filter(|node| node.0 == t).map(|node| format!("{}", node.1)).collect();
        if !soc.is_empty() {
            let what =
                format!("no data near {t} degrees C at soc {}: these nodes follow their neighbours", soc.join(", "));
            outcome.notes.push(what);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curve_keeps_its_slope_below_the_cut_off() {
        let ocv_v = AGEING_SOC_NODES.map(|soc| if soc < 0.045 { 2.0 + soc } else { 3.0 + 10.0 * soc }).to_vec();
        let tables = ParameterTables { ocv_v, r0_ohm: vec![], r_ohm: vec![], tau_s: vec![] };
        let grid = Grid { soc: AGEING_SOC_NODES.to_vec(), temperature_c: vec![25.0] };
        let (total, visits_s) = (Residual::default(), vec![]);
        let mut fitted = FittedTables { grid, tables, total, visits_s, passes: 1, converged: true };
        continue_low_end(&mut fitted);
        for (soc, found) in AGEING_SOC_NODES.iter().zip(&fitted.tables.ocv_v) {
            assert!((found - (3.0 + 10.0 * soc)).abs() < 1e-9, "{soc}: {found}");
        }
    }
}
