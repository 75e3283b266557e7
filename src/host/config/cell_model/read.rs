//! Reads a cell model file into a checked [`CellModel`] and reports every fault at once.

use std::path::Path;

use super::keys::{BranchTables, ElectrodesKeys, Head, Measured, SECTIONS, SpreadKeys, Tables, ThermalKeys, ends};
use super::source::{MeasuredRange, ModelSource, SourcedModel};
use crate::cell::{AgedOcv, CellModel, MAX_BRANCHES, Table};
use crate::config::document::{ConfigFaults, ConfigFiles, Document, Faults, ReadFile, Sources, TablePlace, read_file};
use crate::config::schema::{SchemaReader, Section as _};
use crate::monitor::ModelState;

/// Reads and checks a cell model file.
///
/// # Errors
/// Returns every fault found, one line each.
pub fn load(path: &Path) -> Result<CellModel, ConfigFaults> {
    load_sourced(path).map(|sourced| sourced.model)
}

/// Like [`load`], and also returns the origin of the model.
///
/// # Errors
/// Returns every fault found, one line each.
pub fn load_sourced(path: &Path) -> Result<SourcedModel, ConfigFaults> {
    let faults = Faults::default();
    let model = load_with(path, &read_file, &faults);
    model.filter(|_| faults.is_empty()).ok_or_else(|| faults.lines())
}

/// Like [`load_sourced`], but reads files with `read` and adds faults to the list `faults`.
pub(crate) fn load_with(path: &Path, read: ReadFile<'_>, faults: &Faults) -> Option<SourcedModel> {
    let sources = Sources::read(&ConfigFiles::alone(path), read, faults)?;
    let document = Document::parse(&sources, faults);
    let is_configuration = document.find("pack").is_some();
    if document.find("tables").is_none() && (is_configuration || document.broken) {
        let found = if is_configuration { "is a configuration" } else { "has no [tables]" };
        faults.add(&document.file, 0, format!("{found}, must be a cell model file (format, name, [tables], ...)"));
        return None;
    }
    let reader = SchemaReader::new(&document, SECTIONS);
    let head = reader.one::<Head>();
    let measured = reader.optional::<Measured>();
    let tables = reader.one::<Tables>();
    let branches = reader.many::<BranchTables>();
    let electrodes = reader.optional::<ElectrodesKeys>();
    let spread = reader.optional::<SpreadKeys>();
    let thermal = reader.optional::<ThermalKeys>();
    head.iter().for_each(check_head);
    measured.iter().for_each(check_measured);
    let tables = tables?;
    check_tables(&tables);
    let written = reader.count(BranchTables::PATH);
    if written == 0 || written > MAX_BRANCHES {
        let what = format!("{written} tables [[tables.branches]], must be 1 to {MAX_BRANCHES}");
        tables.place.note("branches", what);
    }
    for branch in &branches {
        check_shape(&branch.place, "r_ohm", &branch.r_ohm, &tables);
        check_shape(&branch.place, "c_farad", &branch.c_farad, &tables);
    }
    spread.iter().for_each(|spread| check_spread(spread, &tables));
    let head = head?;
    let mut aged_ocv = ageing(&head, &tables, electrodes.as_ref(), faults);
    if let Some([a, b]) = spread.as_ref().map(|keys| keys.curve_modes_v.as_slice())
        && faults.is_empty()
    {
        aged_ocv.add_spread(&[a.clone(), b.clone()]);
    }
    let source = ModelSource {
        state: ModelState::Given,
        chemistry: head.chemistry,
        measured: measured.map_or_else(MeasuredRange::default, |keys| keys.range()),
        provenance: provenance(path, read),
        learned: None,
        fleet: None,
    };
    let model = CellModel {
        name: head.name,
        rated_capacity_ah: head.rated_capacity_ah,
        capacity_ah: head.capacity_ah,
        voltage_min_v: head.voltage_min_v,
        voltage_max_v: head.voltage_max_v,
        soc: tables.soc,
        temperature_c: tables.temperature_c,
        aged_ocv,
        ocv_v: Table { values: tables.ocv_v },
        r0_ohm: Table { values: tables.r0_ohm },
        branches: branches.iter().map(BranchTables::config).collect(),
        voltage_error_v: tables.voltage_error_v.map(|values| Table { values }),
        thermal: thermal.map(|keys| keys.config()),
        spread: spread.map(|keys| keys.config()),
    };
    Some(SourcedModel { model, source })
}

/// The table `[provenance]`; empty if the file has none. Syntax faults were reported when the file was parsed.
fn provenance(path: &Path, read: ReadFile<'_>) -> toml::Table {
    let text = read(path).ok().and_then(|bytes| String::from_utf8(bytes).ok()).unwrap_or_default();
    let notes = text.parse::<toml::Table>().ok().and_then(|mut table| table.remove("provenance"));
    notes.and_then(|notes| notes.try_into().ok()).unwrap_or_default()
}

impl Measured {
    fn range(&self) -> MeasuredRange {
        let range = |values: &Option<Vec<f64>>| values.as_ref().map(|values| ends(values));
        MeasuredRange {
            temperature_c: range(&self.temperature_c),
            current_a: range(&self.current_a),
            soc: range(&self.soc),
        }
    }
}

/// Returns how the open-circuit curve ages, and reports impossible values. Returns the default if any fault was already
/// reported.
fn ageing(head: &Head, tables: &Tables, electrodes: Option<&ElectrodesKeys>, faults: &Faults) -> AgedOcv {
    if !faults.is_empty() {
        return AgedOcv::default();
    }
    let (soc, rows) = (&tables.soc, &tables.ocv_v);
    let Some(keys) = electrodes else {
        return AgedOcv::of_shift(head.ocv_ageing_shift.unwrap_or(0.0), soc, head.capacity_ah, rows);
    };
    if head.ocv_ageing_shift.is_some() {
        head.place.fault("ocv_ageing_shift", "must not be given together with [electrodes]");
    }
    let (positive, negative) = (&keys.positive_content, &keys.negative_content);
    for (key, contents, rises) in [("positive_content", positive, false), ("negative_content", negative, true)] {
        let [empty, full] = ends(contents);
        if contents.len() != 2 || empty == full || (full > empty) != rises {
            let first = if rises { "lower" } else { "higher" };
            keys.place.fault(key, format!("must be two numbers, the {first} first: for the empty, then the full cell"));
        }
    }
    if !faults.is_empty() {
        return AgedOcv::default();
    }
    AgedOcv::of_electrodes(&keys.config(), soc, head.capacity_ah, rows).unwrap_or_else(|| {
        keys.place
            .note("positive_content", "the ageing of the open-circuit curve cannot be computed from these contents");
        AgedOcv::default()
    })
}

fn check_head(head: &Head) {
    if head.voltage_max_v <= head.voltage_min_v {
        head.place.fault("voltage_max_v", format!("must be above voltage_min_v = {}", head.voltage_min_v));
    }
}

fn check_measured(measured: &Measured) {
    let Measured { temperature_c, current_a, soc, place, .. } = measured;
    for (key, range) in [("temperature_c", temperature_c), ("current_a", current_a), ("soc", soc)] {
        if range.as_ref().is_some_and(|range| range.len() != 2 || range[0] > range[1]) {
            place.fault(key, "must be two numbers, the lower first");
        }
    }
}

fn check_tables(tables: &Tables) {
    let place = &tables.place;
    if tables.soc.len() < 2 || tables.soc.first() != Some(&0.0) || tables.soc.last() != Some(&1.0) {
        place.fault("soc", "must begin with 0 and end with 1");
    }
    if tables.temperature_c.is_empty() {
        place.fault("temperature_c", "must have at least one temperature");
    }
    for (key, values) in [("soc", &tables.soc), ("temperature_c", &tables.temperature_c)] {
        if let Some((a, b)) = first_not_rising(values) {
            place.note(key, format!("{b} follows {a}, must rise strictly"));
        }
    }
    check_shape(place, "ocv_v", &tables.ocv_v, tables);
    check_shape(place, "r0_ohm", &tables.r0_ohm, tables);
    if let Some(voltage_error_v) = &tables.voltage_error_v {
        check_shape(place, "voltage_error_v", voltage_error_v, tables);
    }
    for (row, t) in tables.ocv_v.iter().zip(&tables.temperature_c) {
        if let Some((a, b)) = first_not_rising(row) {
            place.note("ocv_v", format!("{b} follows {a} at {t} degrees C, must rise strictly with soc"));
        }
    }
}

fn check_spread(spread: &SpreadKeys, tables: &Tables) {
    let (modes, socs) = (&spread.curve_modes_v, tables.soc.len());
    if modes.len() != 2 || modes.iter().any(|mode_v| mode_v.len() != socs) {
        let counts: Vec<String> = modes.iter().map(|mode_v| mode_v.len().to_string()).collect();
        let what = format!("rows of {} values, must be two rows of {socs}, one value per soc", counts.join(" and "));
        spread.place.note("curve_modes_v", &what);
    }
}

fn check_shape(place: &TablePlace, key: &str, rows: &[Vec<f64>], tables: &Tables) {
    let (temperatures, socs) = (tables.temperature_c.len(), tables.soc.len());
    if rows.len() != temperatures {
        place.note(key, format!("{} rows, must be {temperatures}, one per temperature_c", rows.len()));
    }
    for (number, row) in (1..).zip(rows) {
        if row.len() != socs {
            place.note(key, format!("row {number} has {} values, must be {socs}, one per soc", row.len()));
        }
    }
}

/// Returns the first pair of adjacent values whose second value is not larger than the first.
fn first_not_rising(values: &[f64]) -> Option<(f64, f64)> {
    values.windows(2).find(|pair| pair[1] <= pair[0]).map(|pair| (pair[0], pair[1]))
}
