//! Combines the models that the vehicles of a fleet have learned into a prior: the model with which the next vehicle
//! starts, if its cells have the same label (chemistry, rated capacity and voltage limits).
//!
//! Input: a folder of merged tables with `models.jsonl`, which has a line per learned model. Output: a [`FleetPrior`].
//! The same models give the same prior.

use std::path::Path;

use super::vehicle::LearnedModel;
use crate::cell::{FleetPrior, Label, OwnModel};
use crate::error::LabError;

/// File with the learned models, in the folder of the merged tables.
pub const MODELS: &str = "models.jsonl";
/// Minimum number of vehicles from which a prior is made. Two vehicles say almost nothing about the spread of all
/// vehicles.
const LEAST_VEHICLES: usize = 3;

pub(super) fn write_models(folder: &Path, models: &[LearnedModel]) -> Result<(), LabError> {
    let mut text = String::new();
    for model in models {
        text += &(serde_json::to_string(model)? + "\n");
    }
    Ok(crate::write_file(&folder.join(MODELS), text.as_bytes())?)
}

/// Combines the learned models in a folder of merged tables, if their label is wanted.
///
/// # Errors
/// The file is missing or damaged, the wanted models have several labels, or fewer than three vehicles have a wanted
/// model. Vehicles that started from a prior do not count.
pub fn combine(folder: &Path, is_wanted: impl Fn(&Label) -> bool) -> Result<FleetPrior, LabError> {
    let path = folder.join(MODELS);
    let fault = |what: &str| LabError::Data(format!("{}: {what}", path.display()));
    let text = std::fs::read_to_string(&path)
        .map_err(|error| LabError::File(format!("{}: {error}; `packwatch fleet merge` writes it", path.display())))?;
    let mut by_label: Vec<(Label, Vec<OwnModel>)> = Vec::new();
    for (number, line) in (1..).zip(text.lines()) {
        let of_line = |error: &dyn std::fmt::Display| fault(&format!("line {number}: {error}"));
        let LearnedModel { label, own, has_prior } = serde_json::from_str(line).map_err(|error| of_line(&error))?;
        own.check().map_err(|error| of_line(&error))?;
        if has_prior {
            // A model that started from a prior repeats the prior, so it would count the same vehicles twice.
            continue;
        }
        match by_label.iter_mut().find(|(known, _)| *known == label) {
            Some((_, models)) => models.push(own),
            None => by_label.push((label, vec![own])),
        }
    }
    let found: Vec<String> = by_label.iter().map(|(label, models)| format!("{label}: {}", models.len())).collect();
    let found = if found.is_empty() { "none".to_owned() } else { found.join("; ") };
    by_label.retain(|(label, _)| is_wanted(label));
    let (label, models) = match by_label.as_slice() {
        [(label, models)] => (label, models),
        [] => return Err(fault(&format!("no vehicle has a suitable model (vehicles with a model: {found})"))),
        _ => return Err(fault(&format!("several labels, choose one by chemistry and rated capacity: {found}"))),
    };
    if models.len() < LEAST_VEHICLES {
        let what = format!("{} vehicles have a model of {label}, must be at least {LEAST_VEHICLES}", models.len());
        return Err(fault(&what));
    }
    FleetPrior::new(label, models).ok_or_else(|| fault(&format!("no cell has the label {label}")))
}
