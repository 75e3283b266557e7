//! Which cell model: a file, a configuration, or a label.

use std::path::{Path, PathBuf};

use crate::cell::{Chemistry, Label};
use crate::cli::Failure;
use crate::cli::label::LabelArgs;
use crate::cli::numbers::above_0;
use crate::config::cell_model::{self, SourcedModel};
use crate::config::{self, of_label};

/// Names a cell model.
#[derive(Debug, clap::Args)]
pub(super) struct SourceArgs {
    /// Cell model file, configuration, or a label as CHEMISTRY:AH, such as nca-graphite:2.9
    #[arg(value_name = "SOURCE", required_unless_present_any = ["config", "chemistry"], conflicts_with_all = ["config", "chemistry"])]
    source: Option<PathBuf>,
    /// Configuration: the cell model that it names, or its label
    #[arg(short, long, value_name = "FILE.toml")]
    config: Option<PathBuf>,
    #[command(flatten)]
    label: LabelArgs,
}

impl SourceArgs {
    /// The model, with its name for people.
    ///
    /// # Errors
    /// When it cannot be read: every fault.
    pub(super) fn load(&self) -> Result<(String, SourcedModel), Failure> {
        if let Some(path) = &self.config {
            return of_config(path);
        }
        match (&self.source, self.label.label()) {
            (Some(source), _) => load(source),
            (None, Some(label)) => of_label_named(format!("{}:{}", label.chemistry.name(), label.rated_ah), &label),
            // The command line is refused before.
            (None, None) => Err(Failure::new("no cell model is named")),
        }
    }

    /// Files that are read.
    pub(super) fn files(&self) -> impl Iterator<Item = &PathBuf> {
        self.config.iter().chain(&self.source)
    }
}

/// The model of a SOURCE, with its name for people.
///
/// # Errors
/// When it cannot be read: every fault.
pub(super) fn load(path: &Path) -> Result<(String, SourcedModel), Failure> {
    if path.exists() {
        return if is_configuration(path) {
            of_config(path)
        } else {
            Ok((named(path), cell_model::load_sourced(path)?))
        };
    }
    let source = named(path);
    let Some((chemistry, rated)) = source.split_once(':') else {
        let what = "must be a cell model file, a configuration, or CHEMISTRY:AH such as nca-graphite:2.9";
        return Err(Failure::new(format!("{source}: there is no such file; {what}")));
    };
    let names: Vec<&str> = Chemistry::ALL.iter().map(|(_, name)| *name).collect();
    let known = Chemistry::ALL.into_iter().find(|(_, name)| *name == chemistry).map(|found| found.0);
    let known = known.ok_or_else(|| {
        Failure::new(format!("{source}: {chemistry:?} is no file and no chemistry, must be {}", names.join(" or ")))
    })?;
    let rated_ah =
        above_0(rated).map_err(|what| Failure::new(format!("{source}: rated capacity {rated:?}, {what} (Ah)")))?;
    of_label_named(source, &Label::usual(known, rated_ah))
}

/// Whether a file is a configuration: it has a table [pack]. Faults are named when it is read.
fn is_configuration(path: &Path) -> bool {
    let text = std::fs::read_to_string(path).unwrap_or_default();
    text.parse::<toml::Table>().is_ok_and(|table| table.contains_key("pack"))
}

fn of_config(path: &Path) -> Result<(String, SourcedModel), Failure> {
    let config = config::load(path)?;
    Ok((named(path), SourcedModel { model: config.monitor.model, source: config.model_source }))
}

fn of_label_named(name: String, label: &Label) -> Result<(String, SourcedModel), Failure> {
    let sourced = of_label(label).ok_or_else(|| {
        let Label { chemistry, voltage_min_v, voltage_max_v, .. } = label;
        let (low, high) = chemistry.usual_voltages_v();
        Failure::new(format!(
            "{name}: no cell of {} is empty at {voltage_min_v} V and full at {voltage_max_v} V; usual are {low} and {high} V",
            chemistry.name()
        ))
    })?;
    Ok((name, sourced))
}

fn named(path: &Path) -> String {
    path.display().to_string()
}
