//! Checks the cells of the pack: the pack's own cells, described by a model file or a label (chemistry and rated
//! capacity), and modules with other cells (`[[pack.module]]`).
//!
//! In: the tables and the cell model files they name. Out: the models. Reports missing keys and keys that contradict
//! each other. Reports cells of a module that do not exist, belong to two modules, or have no known type.

use std::path::Path;

use crate::cell::{CellModel, Chemistry, FleetPrior, Label};
use crate::config::cell_model::{self, SourcedModel};
use crate::config::document::{Document, Faults, ReadFile, TablePlace, beside, meant_file};
use crate::config::schema::RawTables;
use crate::config::schema::keys::{Pack, PackModule};
use crate::quantity::CellIndex;

/// A module: its cells and their model.
#[derive(Debug)]
pub(crate) struct Module<'a> {
    pub keys: &'a PackModule,
    pub cells: Vec<CellIndex>,
    pub model: CellModel,
}

/// The label of the pack's own cells; `None` if a model file is named or a key is missing.
pub(crate) fn label(pack: &Pack) -> Option<Label> {
    let (chemistry, rated_ah) = (pack.chemistry.filter(|_| pack.cell_model.is_none())?, pack.rated_capacity_ah?);
    let usual = Label::usual(chemistry, rated_ah);
    Some(Label {
        voltage_min_v: pack.voltage_min_v.unwrap_or(usual.voltage_min_v),
        voltage_max_v: pack.voltage_max_v.unwrap_or(usual.voltage_max_v),
        ..usual
    })
}

/// The model of the pack's own cells: from the file `pack.cell_model`, else from `chemistry`.
pub(crate) fn own_model(
    path: &Path,
    document: &Document<'_>,
    raw: &RawTables,
    read: ReadFile<'_>,
) -> Option<SourcedModel> {
    // The key is read from the document: if another key of the table `pack` is faulty, `raw` does not contain this
    // table.
    let key = document.find("pack.cell_model");
    if let Some((key, named)) = key.and_then(|key| Some((key.span(), key.get_ref().as_str()?))) {
        return file_model(path, named, read, &raw.faults, |what| {
            let text = format!("pack.cell_model = {}, {what}", document.quote(&key));
            raw.faults.add_at(&document.line(&key), text);
        });
    }
    let pack = raw.pack.as_ref()?;
    check_label(&pack.place, pack.chemistry, pack.rated_capacity_ah)?;
    let label = label(pack)?;
    if pack.prior.is_some() {
        return cell_model::of_fleet(fleet_prior(path, pack, read)?);
    }
    let model = cell_model::of_label(&label);
    if model.is_none() {
        let Label { chemistry, voltage_min_v, voltage_max_v, rated_ah, .. } = label;
        let usual = Label::usual(chemistry, rated_ah);
        let what = format!(
            "{voltage_min_v} to {voltage_max_v} V is not a plausible range for {} (typical: {} to {} V)",
            chemistry.name(),
            usual.voltage_min_v,
            usual.voltage_max_v
        );
        pack.place.fault("chemistry", what);
    }
    model
}

/// What other vehicles have learned about the pack's own cells, from the file `pack.prior`.
fn fleet_prior(path: &Path, pack: &Pack, read: ReadFile<'_>) -> Option<FleetPrior> {
    let (named, label) = (pack.prior.as_ref()?, label(pack)?);
    let file = beside(path, named);
    let parsed = read(&file).map_err(|error| error.to_string()).and_then(|bytes| {
        let text = String::from_utf8(bytes).map_err(|error| error.to_string())?;
        let table: toml::Table = text.parse().map_err(|error: toml::de::Error| error.message().to_owned())?;
        // Deserialises through JSON, as for stored models. A second deserialiser of these types would enlarge the
        // program.
        let json = serde_json::to_vec(&table).map_err(|error| error.to_string())?;
        let prior: FleetPrior = serde_json::from_slice(&json).map_err(|error| error.to_string())?;
        prior.check().map_err(|error| error.to_string())?;
        Ok(prior)
    });
    match parsed {
        Ok(prior) if prior.label == label => return Some(prior),
        Ok(prior) => pack.place.fault("prior", format!("was made for {}, but [pack] describes {label}", prior.label)),
        Err(error) => {
            let what = format!("must be a file of `packwatch fleet prior`: {}: {error}", file.display());
            pack.place.fault("prior", what);
        }
    }
    None
}

/// The model in the file `named`. If the file cannot be used at all, `fault` reports this at the key that names the
/// file.
fn file_model(
    path: &Path,
    named: &str,
    read: ReadFile<'_>,
    faults: &Faults,
    fault: impl FnOnce(&str),
) -> Option<SourcedModel> {
    let file = beside(path, named);
    let model = cell_model::load_with(&file, read, faults);
    if faults.is_unusable(&file.display().to_string()) {
        let meant = meant_file(path, named);
        fault(&format!("must be a cell model file, relative to the folder of the configuration{meant}"));
    }
    model
}

/// Chemistry and rated capacity of a cell without a model file; missing keys are reported.
fn check_label(place: &TablePlace, chemistry: Option<Chemistry>, rated_ah: Option<f64>) -> Option<(Chemistry, f64)> {
    match (chemistry, rated_ah) {
        (Some(chemistry), Some(rated_ah)) => return Some((chemistry, rated_ah)),
        (Some(_), None) => {
            place.fault("chemistry", "requires rated_capacity_ah, the capacity on the label of one cell");
        }
        (None, _) => {
            place.fault(
                "cell_model",
                "must be a cell model file, unless chemistry and rated_capacity_ah describe the cell",
            );
        }
    }
    None
}

/// Reports label keys that are given together with a model file, because the file states the same values. Returns
/// whether any such key is given.
fn check_file(place: &TablePlace, cell_model: Option<&String>) -> bool {
    let of_label = ["chemistry", "prior", "voltage_min_v", "voltage_max_v"].into_iter();
    let given: Vec<&str> = of_label.filter(|key| cell_model.is_some() && place.has(key)).collect();
    for key in &given {
        place.fault(key, "must not be given together with cell_model, which states it");
    }
    !given.is_empty()
}

pub(crate) fn check(pack: &Pack) {
    check_file(&pack.place, pack.cell_model.as_ref());
}

/// Reads all modules and leaves out modules without a valid model.
pub(crate) fn modules<'a>(path: &Path, raw: &'a RawTables, file: ReadFile<'_>) -> Vec<Module<'a>> {
    let Some(pack) = &raw.pack else { return Vec::new() };
    if raw.is_pack_total() {
        for keys in &raw.modules {
            keys.place.fault(
                "cells",
                "must not be given together with [input.pack_voltage]: the pack is then estimated as one cell",
            );
        }
        return Vec::new();
    }
    for (index, keys) in raw.modules.iter().enumerate() {
        let earlier = raw.modules[..index].iter().map(|other| (&other.place, numbers(other).collect()));
        check_cells(&keys.place, &numbers(keys).collect::<Vec<_>>(), earlier, pack.cells);
    }
    let is_elsewhere = |cell: u16| raw.modules.iter().any(|keys| numbers(keys).any(|it| it == cell));
    if let Some(last) = raw.modules.last().filter(|_| (1..=pack.cells).all(is_elsewhere)) {
        last.place.fault("cells", "must leave at least one cell of the pack's own type");
    }
    let of_keys = |keys: &'a PackModule| {
        let mut cells: Vec<u16> = numbers(keys).filter(|cell| (1..=pack.cells).contains(cell)).collect();
        cells.sort_unstable();
        cells.dedup();
        let model = model(path, keys, file)?;
        Some(Module { keys, cells: cells.into_iter().map(|number| CellIndex(number - 1)).collect(), model })
    };
    raw.modules.iter().filter_map(of_keys).collect()
}

/// Reports a fault at the key `cells` for cells that do not exist or that an earlier table lists.
pub(crate) fn check_cells<'a>(
    place: &TablePlace,
    cells: &[u16],
    mut earlier: impl Iterator<Item = (&'a TablePlace, Vec<u16>)>,
    count: u16,
) {
    if cells.iter().any(|&cell| cell > count) {
        place.fault("cells", format!("must be within 1 to {count} (pack.cells)"));
    }
    if let Some((other, _)) = earlier.find(|(_, others)| cells.iter().any(|cell| others.contains(cell))) {
        let line = other.at.beside(place.line_of("cells"));
        place.fault("cells", format!("must not name cells of {} ({line})", other.path));
    }
}

/// Cell numbers, from 1.
fn numbers(keys: &PackModule) -> impl Iterator<Item = u16> {
    keys.cells.0.iter().cloned().flatten()
}

fn model(path: &Path, keys: &PackModule, file: ReadFile<'_>) -> Option<CellModel> {
    let model = match &keys.cell_model {
        Some(_) if check_file(&keys.place, keys.cell_model.as_ref()) => return None,
        Some(named) => {
            file_model(path, named, file, &keys.place.faults, |what| keys.place.fault("cell_model", what))?.model
        }
        None => {
            let (chemistry, rated_ah) = check_label(&keys.place, keys.chemistry, keys.rated_capacity_ah)?;
            cell_model::of_label(&Label::usual(chemistry, rated_ah))?.model
        }
    };
    Some(CellModel { rated_capacity_ah: keys.rated_capacity_ah.unwrap_or(model.rated_capacity_ah), ..model })
}

/// Returns the pack's own model with the lowest and highest voltage of all cells' models, for limits that apply to
/// every cell.
pub(crate) fn with_voltages_of(model: &CellModel, modules: &[Module<'_>]) -> CellModel {
    let lowest = modules.iter().map(|module| module.model.voltage_min_v).fold(model.voltage_min_v, f64::min);
    let highest = modules.iter().map(|module| module.model.voltage_max_v).fold(model.voltage_max_v, f64::max);
    CellModel { voltage_min_v: lowest, voltage_max_v: highest, ..model.clone() }
}
