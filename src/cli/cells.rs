//! `packwatch cells`: lists the installed cell models, and the chemistries for use without a model.
//!
//! A file that is not a cell model is reported on standard error, after the list. The exit code is then 1.

use std::path::PathBuf;

use serde_json::{Value, json};

use super::common::output::{self, print, print_json, unless_closed};
use crate::cell::{Chemistry, Label, ModelBands, advise};
use crate::config::cell_model::SourcedModel;
use crate::config::cell_model::library::{self, LibraryEntry};
use packwatch_host::failure::Failure;

/// Arguments of `cells`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folders to list [default: config/cells and cells in the current folder, /etc/packwatch/cells, and share/packwatch/cells
    /// of the installation]
    #[arg(value_name = "DIR")]
    folders: Vec<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let folders = match args.folders.is_empty() {
        true => library::usual_folders(std::env::current_exe().ok().as_deref()),
        false => args.folders.clone(),
    };
    let lists = folders.iter().map(|folder| library::list(folder)).collect::<Result<Vec<_>, _>>();
    let entries: Vec<LibraryEntry> = lists.map_err(Failure::new)?.into_iter().flatten().collect();
    let mut faults = Vec::new();
    let mut models = Vec::new();
    for LibraryEntry { path, model } in entries {
        match model {
            Ok(model) => models.push((path, model)),
            Err(found) => faults.extend(found.0),
        }
    }
    match args.json {
        true => unless_closed(print_json(&document(&models, &folders)))?,
        false => print(&page(&models, &folders))?,
    }
    if faults.is_empty() { Ok(()) } else { Err(Failure::new(faults.join("\n"))) }
}

fn page(models: &[(PathBuf, SourcedModel)], folders: &[PathBuf]) -> String {
    let names: Vec<String> = folders.iter().map(|folder| folder.display().to_string()).collect();
    let mut page = match (names.is_empty(), models.is_empty()) {
        (true, _) => "no cell model folder found; name one: packwatch cells DIR\n".to_owned(),
        (false, true) => format!("no cell models in {}\n", names.join(", ")),
        (false, false) => listed(models),
    };
    page.push_str("\nWithout a model file, set pack.chemistry (below) and pack.rated_capacity_ah:\n");
    let heads = ["chemistry", "typical voltages, V", "initial SOC error, points"];
    page.push_str(&output::table(&heads, Chemistry::ALL.into_iter().map(|(chemistry, _)| label_row(chemistry)), 1));
    page
}

fn listed(models: &[(PathBuf, SourcedModel)]) -> String {
    let heads = ["cell", "chemistry", "rated Ah", "voltages, V", "measured, \u{b0}C", "error, mV", "file"];
    let row = |(path, sourced): &(PathBuf, SourcedModel)| {
        let SourcedModel { model, source } = sourced;
        let range = |[low, high]: [f64; 2]| format!("{low:.0} to {high:.0}");
        vec![
            model.name.clone(),
            source.chemistry.clone().unwrap_or_else(|| "not stated".to_owned()),
            model.rated_capacity_ah.to_string(),
            format!("{} to {}", model.voltage_min_v, model.voltage_max_v),
            source.measured.temperature_c.map_or("not stated".to_owned(), range),
            error(sourced),
            path.display().to_string(),
        ]
    };
    let mut page = output::table(&heads, models.iter().map(row), 2);
    page.push_str("\nData sources and licences\n");
    for (_, SourcedModel { model, source }) in models {
        let (data, licence) = (source.citation().unwrap_or("not stated"), source.licence().unwrap_or("not stated"));
        page.push_str(&format!("  {}\n    data: {data}\n    licence: {licence}\n", model.name));
    }
    page
}

/// Returns the voltage error (mV) that the model states or, if the model states none, the residuals of its fit (mV).
fn error(sourced: &SourcedModel) -> String {
    match (sourced.error_v(), sourced.source.residual_v()) {
        (Some(error_v), _) => format!("{:.0}", 1e3 * error_v),
        (None, Some(residual_v)) => format!("{:.0} (residuals)", 1e3 * residual_v),
        (None, None) => "not stated".to_owned(),
    }
}

fn label_row(chemistry: Chemistry) -> Vec<String> {
    let (low, high) = chemistry.usual_voltages_v();
    let points = first_points(chemistry).map_or("unknown".to_owned(), |points| format!("{points:.0}"));
    vec![chemistry.name().to_owned(), format!("{low} to {high}"), points]
}

/// Returns the expected error of the first SOC estimate, in percentage points, if only the label of a cell is known.
fn first_points(chemistry: Chemistry) -> Option<f64> {
    // The error does not depend on the capacity, so any capacity can be used.
    let model = Label::usual(chemistry, 1.0).model()?;
    advise(&ModelBands::new(&model)).map(|(points, _)| points)
}

fn document(models: &[(PathBuf, SourcedModel)], folders: &[PathBuf]) -> Value {
    let of_model = |(path, sourced): &(PathBuf, SourcedModel)| {
        let SourcedModel { model, source } = sourced;
        json!({
            "file": path, "name": model.name, "chemistry": source.chemistry,
            "rated_capacity_ah": model.rated_capacity_ah, "capacity_ah": model.capacity_ah,
            "voltage_min_v": model.voltage_min_v, "voltage_max_v": model.voltage_max_v,
            "measured": source.measured, "voltage_error_v": sourced.error_v(), "residual_v": source.residual_v(),
            "data": source.citation(), "licence": source.licence(),
        })
    };
    let of_chemistry = |(chemistry, name): (Chemistry, &str)| {
        let (low, high) = chemistry.usual_voltages_v();
        json!({"name": name, "voltage_min_v": low, "voltage_max_v": high, "soc_error_points": first_points(chemistry)})
    };
    json!({
        "version": 1, "folders": folders,
        "models": models.iter().map(of_model).collect::<Vec<_>>(),
        "chemistries": Chemistry::ALL.into_iter().map(of_chemistry).collect::<Vec<_>>(),
    })
}
