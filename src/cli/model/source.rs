//! Selects a cell model: from a file, a configuration, a label, or the learned state of a vehicle.

use std::io::Read as _;
use std::path::{Path, PathBuf};

use crate::cell::{Chemistry, Label};
use crate::cli::common::label::LabelArgs;
use crate::cli::common::numbers::above_0;
use crate::config::cell_model::{self, SourcedModel};
use crate::config::{self, Config, of_label, of_view};
use crate::io::snapshot_file;
use crate::monitor::Snapshot;
use crate::store::HistoryReader;
use packwatch_host::bounded_file;
use packwatch_host::failure::Failure;

/// Selects a cell model.
#[derive(Debug, clap::Args)]
pub(super) struct SourceArgs {
    /// Cell model file, configuration file, state file of `packwatch run --snapshot`, state folder of `packwatch run`, or label
    /// as CHEMISTRY:AH, for example nca-graphite:2.9
    #[arg(value_name = "SOURCE", required_unless_present_any = ["config", "chemistry", "state"], conflicts_with_all = ["chemistry", "state"])]
    source: Option<PathBuf>,
    /// Configuration file whose cell model or label to show. If a state is given too, the configuration's cell model is shown
    /// only if the state has no learned model
    #[arg(short, long, value_name = "FILE.toml")]
    config: Option<PathBuf>,
    /// State folder of `packwatch run`; its learned model is shown
    #[arg(long, value_name = "DIR", conflicts_with = "chemistry")]
    state: Option<PathBuf>,
    #[command(flatten)]
    label: LabelArgs,
}

impl SourceArgs {
    /// Returns the model and its display name.
    ///
    /// # Errors
    /// If the source cannot be read, the error lists all faults of the source.
    pub(super) fn load(&self) -> Result<(String, SourcedModel), Failure> {
        let config = self.config.as_deref().map(config::load).transpose()?;
        match (self.state.as_ref().or(self.source.as_ref()), config, self.label.label()) {
            (Some(source), Some(config), _) => load_with(source, Some(config)),
            (Some(source), None, _) => load(source),
            (None, Some(config), _) => Ok((named(&config.path), of_config(config))),
            (None, None, Some(label)) => {
                of_label_named(format!("{}:{}", label.chemistry.name(), label.rated_ah), &label)
            }
            // The command line parser requires at least one of these arguments.
            (None, None, None) => Err(Failure::new("give a cell model: SOURCE, --config, --chemistry or --state")),
        }
    }

    /// Files that are read.
    pub(super) fn files(&self) -> impl Iterator<Item = &PathBuf> {
        self.config.iter().chain(&self.source)
    }
}

/// Returns the model of a SOURCE and its display name.
///
/// # Errors
/// If the source cannot be read, the error lists all faults of the source.
pub(super) fn load(path: &Path) -> Result<(String, SourcedModel), Failure> {
    load_with(path, None)
}

/// Like [`load`]. If the vehicle's state contains no learned model, the model comes from `config`.
fn load_with(path: &Path, config: Option<Config>) -> Result<(String, SourcedModel), Failure> {
    if path.is_dir() {
        let reader = HistoryReader::open(path).map_err(Failure::new)?;
        return of_snapshot(path, &reader.required_snapshot().map_err(Failure::new)?, config);
    }
    if is_snapshot(path) {
        return of_snapshot(path, &snapshot_file::read(path).map_err(Failure::new)?, config);
    }
    if config.is_some() {
        return Err(Failure::new(format!(
            "{}: neither a state folder nor a state file, so -c cannot be given with it",
            path.display()
        )));
    }
    if path.exists() {
        return match is_configuration(path) {
            true => Ok((named(path), of_config(config::load(path)?))),
            false => Ok((named(path), cell_model::load_sourced(path)?)),
        };
    }
    of_label_text(path)
}

/// Returns the model that the vehicle has learned or, if it has learned none, the configured model.
fn of_snapshot(path: &Path, snapshot: &Snapshot, config: Option<Config>) -> Result<(String, SourcedModel), Failure> {
    let label = config.as_ref().and_then(|config| config.monitor.label);
    let view = snapshot.model(label).map_err(|error| Failure::new(format!("{}: {error}", path.display())))?;
    let learned = view.as_ref().and_then(of_view);
    match (learned, config) {
        (Some(learned), _) => Ok((named(path), learned)),
        (None, Some(config)) => Ok((named(&config.path), of_config(config))),
        (None, None) => {
            let what = "no cell model has been learned yet; add -c FILE to see the configured one";
            Err(Failure::new(format!("{}: {what}", path.display())))
        }
    }
}

/// Parses a label as CHEMISTRY:AH.
fn of_label_text(path: &Path) -> Result<(String, SourcedModel), Failure> {
    let source = named(path);
    let Some((chemistry, rated)) = source.split_once(':') else {
        let what = "must be a cell model file, a configuration, a state, or CHEMISTRY:AH such as nca-graphite:2.9";
        return Err(Failure::new(format!("{source}: no such file; {what}")));
    };
    let names: Vec<&str> = Chemistry::ALL.iter().map(|(_, name)| *name).collect();
    let known = Chemistry::ALL.into_iter().find(|(_, name)| *name == chemistry).map(|found| found.0);
    let known = known.ok_or_else(|| {
        Failure::new(format!(
            "{source}: {chemistry:?} is neither a file nor a chemistry; chemistries: {}",
            names.join(", ")
        ))
    })?;
    let rated_ah =
        above_0(rated).map_err(|what| Failure::new(format!("{source}: rated capacity {rated:?}, {what} (Ah)")))?;
    of_label_named(source, &Label::usual(known, rated_ah))
}

/// Whether a file contains a stored state (JSON), judged by its name or its first byte.
fn is_snapshot(path: &Path) -> bool {
    let mut first = [0];
    let read = bounded_file::open(path).and_then(|mut file| file.read_exact(&mut first));
    path.extension().is_some_and(|extension| extension == "json") || (read.is_ok() && first == *b"{")
}

/// Whether a file is a configuration, that is, contains a table `[pack]`. Faults of the file are reported later, when
/// it is read.
fn is_configuration(path: &Path) -> bool {
    let text = bounded_file::read_text(path).unwrap_or_default();
    text.parse::<toml::Table>().is_ok_and(|table| table.contains_key("pack"))
}

fn of_config(config: Config) -> SourcedModel {
    SourcedModel { model: config.monitor.model, source: config.model_source }
}

fn of_label_named(name: String, label: &Label) -> Result<(String, SourcedModel), Failure> {
    let sourced = of_label(label).ok_or_else(|| {
        let Label { chemistry, voltage_min_v, voltage_max_v, .. } = label;
        let (low, high) = chemistry.usual_voltages_v();
        Failure::new(format!(
            "{name}: {voltage_min_v} to {voltage_max_v} V is not a plausible range for {} (typical: {low} to {high} V)",
            chemistry.name()
        ))
    })?;
    Ok((name, sourced))
}

fn named(path: &Path) -> String {
    path.display().to_string()
}
