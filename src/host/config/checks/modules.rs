//! Modules of other cells than the pack's own: `[[pack.module]]`.
//!
//! In: the tables and the cell model files they name. Out: the cells of each module with their model; faults where cells are not
//! there, in two modules, or of no known kind.

use std::path::Path;

use crate::cell::{CellModel, Label};
use crate::config::cell_model;
use crate::config::document::{Faults, ReadFile, beside};
use crate::config::schema::RawTables;
use crate::config::schema::keys::PackModule;
use crate::quantity::CellIndex;

/// A module's cells and what they are.
#[derive(Debug)]
pub(crate) struct Module<'a> {
    pub keys: &'a PackModule,
    pub cells: Vec<CellIndex>,
    pub model: CellModel,
}

/// Reads all modules; those with a fault are left out.
pub(crate) fn read<'a>(path: &Path, raw: &'a RawTables, file: ReadFile<'_>, faults: &mut Faults) -> Vec<Module<'a>> {
    let Some(pack) = &raw.pack else { return Vec::new() };
    if raw.is_pack_total() {
        for keys in &raw.modules {
            keys.place.fault(
                faults,
                "cells",
                "must be without [input.pack_voltage]: the pack is estimated as one cell",
            );
        }
        return Vec::new();
    }
    for (index, keys) in raw.modules.iter().enumerate() {
        if numbers(keys).any(|cell| cell > pack.cells) {
            keys.place.fault(faults, "cells", &format!("must be within 1 to {} (pack.cells)", pack.cells));
        }
        let is_shared = |other: &&PackModule| numbers(keys).any(|cell| numbers(other).any(|it| it == cell));
        if let Some(other) = raw.modules[..index].iter().find(is_shared) {
            let line = other.place.at.beside(keys.place.line_of("cells"));
            keys.place.fault(faults, "cells", &format!("must not name cells of {} ({line})", other.place.path));
        }
    }
    let is_elsewhere = |cell: u16| raw.modules.iter().any(|keys| numbers(keys).any(|it| it == cell));
    if let Some(last) = raw.modules.last().filter(|_| (1..=pack.cells).all(is_elsewhere)) {
        last.place.fault(faults, "cells", "must leave cells that are of [pack]'s own kind");
    }
    let of_keys = |keys: &'a PackModule| {
        let mut cells: Vec<u16> = numbers(keys).filter(|cell| (1..=pack.cells).contains(cell)).collect();
        cells.sort_unstable();
        cells.dedup();
        let model = model(path, keys, file, faults)?;
        Some(Module { keys, cells: cells.into_iter().map(|number| CellIndex(number - 1)).collect(), model })
    };
    raw.modules.iter().filter_map(of_keys).collect()
}

/// Cell numbers, from 1.
fn numbers(keys: &PackModule) -> impl Iterator<Item = u16> {
    keys.cells.0.iter().cloned().flatten()
}

fn model(path: &Path, keys: &PackModule, file: ReadFile<'_>, faults: &mut Faults) -> Option<CellModel> {
    let rated_ah = keys.rated_capacity_ah;
    let model = match (&keys.cell_model, keys.chemistry, rated_ah) {
        (Some(_), Some(_), _) => {
            keys.place.fault(faults, "chemistry", "must not be given together with cell_model, which states it");
            return None;
        }
        (Some(named), None, _) => cell_model::load_with(&beside(path, named), file, faults)?.model,
        (None, Some(chemistry), Some(rated_ah)) => cell_model::of_label(&Label::usual(chemistry, rated_ah))?.model,
        (None, Some(_), None) => {
            keys.place.fault(faults, "chemistry", "needs rated_capacity_ah, the capacity on the label of one cell");
            return None;
        }
        (None, None, _) => {
            let what = "must be a cell model file; or chemistry and rated_capacity_ah must be given";
            keys.place.fault(faults, "cell_model", what);
            return None;
        }
    };
    Some(CellModel { rated_capacity_ah: rated_ah.unwrap_or(model.rated_capacity_ah), ..model })
}

/// The pack's own model with the voltages of all its cells, for limits that hold for every cell.
pub(crate) fn with_voltages_of(model: &CellModel, modules: &[Module<'_>]) -> CellModel {
    let lowest = modules.iter().map(|module| module.model.voltage_min_v).fold(model.voltage_min_v, f64::min);
    let highest = modules.iter().map(|module| module.model.voltage_max_v).fold(model.voltage_max_v, f64::max);
    CellModel { voltage_min_v: lowest, voltage_max_v: highest, ..model.clone() }
}
