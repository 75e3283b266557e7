//! The TOML configuration: as written, then checked; every fault at once, with file, line, key, found and allowed.
//!
//! In: the configuration file, its drop-ins and the files they name (DBC files, cell model). Out: [`Config`], the settings of the other
//! modules, which cannot be wrong; or [`ConfigFaults`], a line per fault.
//!
//! | file | content |
//! | --- | --- |
//! | `source` | the file and its drop-ins, their texts |
//! | `document` | the texts parsed and merged, places of keys, list of faults |
//! | `merged` | the merged tables as one TOML text |
//! | `setting`, `threshold` | types a key may have |
//! | `schema` | the mechanism: what a declared key gives |
//! | `keys` | every key, declared once |
//! | `tables` | every table of the file |
//! | `resolve`, `pattern` | signals looked up in the DBC files |
//! | `cross`, `alarm`, `output`, `commands`, `j1939`, `protect` | what concerns several keys |
//! | `input_tables`, `plausible` | faulty tables checked as far as they go; what cannot be meant |
//! | `convert` | the settings of the core |
//! | `cell_model` | cell model files, by the same mechanism |
//! | `modules` | modules of other cells |
//! | `vehicle` | which vehicle and pack |
//! | `describe`, `reference`, `manual` | the configuration in words |
//! | `partial` | as much of a faulty configuration as can be read |
//!
//! # How a key is added
//! 1. In `keys`, a line in the table's `section!`: doc comment, name, type, unit, range, presence. In a table that `gives`
//!    the parameters of an algorithm it fills the field of the same name; another field, or one that needs other values,
//!    stands behind `=>` on the same line.
//! 2. In the algorithm, that field.
//! 3. `packwatch check --reference > config/REFERENCE.md`; a test compares the two.
//!
//! Reading, default, range check, fault texts, reference and manual page follow from the line. A check that concerns
//! several keys goes into `cross`. A new table needs a line in `tables` too.

use std::path::{Path, PathBuf};

use crate::can::CanId;
use crate::can::dbc::Database;
use crate::monitor::MonitorConfig;
use crate::quantity::BusIndex;

mod alarm;
pub mod cell_model;
mod commands;
mod convert;
mod cross;
mod describe;
mod document;
mod input_tables;
mod j1939;
mod keys;
mod label;
mod manual;
mod merged;
mod modules;
mod output;
mod partial;
mod pattern;
mod plausible;
mod protect;
mod reference;
mod resolve;
mod schema;
mod setting;
mod source;
mod tables;
mod threshold;
mod uds;
mod vehicle;

use cell_model::{ModelSource, SourcedModel};
pub use describe::{Description, InterfaceUse, OutputUse, SignalUse};
pub(crate) use document::TablePlace;
use document::{Document, Faults};
pub(crate) use keys::SignalSource;
pub use label::{of_label, of_view};
pub use manual::manual;
pub(crate) use partial::PartialConfig;
pub(crate) use pattern::Pattern;
pub use reference::reference;
use resolve::Checks;
pub(crate) use resolve::{Databases, NamedSignal, ResolvedSignal, channel_words, input_map};
pub use source::ConfigFiles;
use source::Sources;
pub(crate) use tables::RawTables;
pub(crate) use uds::answers;
pub use vehicle::VehicleIdentity;

/// A configuration that cannot be wrong.
#[derive(Debug, Clone)]
pub struct Config {
    /// The configuration file.
    pub path: PathBuf,
    /// CAN interfaces; a `BusIndex` counts in this order.
    pub interfaces: Vec<InterfaceConfig>,
    /// Settings of the core.
    pub monitor: MonitorConfig,
    /// Where the cell model in them comes from.
    pub model_source: ModelSource,
    /// Layout of the sent frames, for receivers; `None` = nothing is sent.
    pub output_layout: Option<Database>,
    /// How state and history are kept.
    pub store: StoreConfig,
    /// What is allowed and unlikely, one line each, in the form of the faults.
    pub warnings: Vec<String>,
    /// Which vehicle and pack this is.
    pub vehicle: VehicleIdentity,
    /// Where the key of authenticated frames is; `None` = no frame is authenticated.
    pub key: Option<KeySource>,
}

/// Where the key of authenticated frames is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum KeySource {
    /// The credential of this name that the service manager passes.
    Credential(String),
    /// A file.
    File(PathBuf),
}

impl std::fmt::Display for KeySource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Credential(name) => write!(f, "credential {name}"),
            Self::File(path) => write!(f, "file {}", path.display()),
        }
    }
}

impl Config {
    /// Names of the interfaces, in the order in which they are numbered.
    pub fn interface_names(&self) -> Vec<String> {
        self.interfaces.iter().map(|interface| interface.name.clone()).collect()
    }

    /// How commands from the bus are checked, in a sentence.
    pub fn command_words(&self) -> String {
        protect::command_words(self)
    }
}

/// How state and history are kept.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StoreConfig {
    /// Period of the state's checkpoints, s.
    pub checkpoint_s: f64,
    /// Half-cycles kept, one row per cell each; beyond, the oldest are thinned.
    pub max_half_cycles: u32,
    /// Capacities, loss modes, remaining lives, cell models, alarms and resets kept; beyond, the oldest are thinned.
    pub max_chained_rows: u32,
    /// Half-cycles older than this are deleted, years; `None` = whatever their age, they are kept.
    pub keep_years: Option<f64>,
}

/// One CAN interface.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InterfaceConfig {
    /// Kernel name, `can0`.
    pub name: String,
    /// Whether FD frames are accepted and may be sent.
    pub fd: bool,
}

/// All faults of a configuration, one line each: `pack.toml:14: pack.cells = 0, must be 1 to 1024`.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}", .0.join("\n"))]
pub struct ConfigFaults(pub Vec<String>);

/// Reads the bytes of a file: from the disk, or (demo, tests) from memory.
pub type ReadFile<'a> = &'a dyn Fn(&Path) -> std::io::Result<Vec<u8>>;

/// Reads and checks a configuration, its drop-ins and everything they name (DBC files, cell model; paths are relative to
/// the configuration file).
///
/// # Errors
/// Every fault found, not only the first.
pub fn load(path: &Path) -> Result<Config, ConfigFaults> {
    load_with(&ConfigFiles::find(path)?, &read_file)
}

/// As [`load`], with files read by `read`.
///
/// # Errors
/// Every fault found, not only the first.
pub fn load_with(files: &ConfigFiles, read: ReadFile<'_>) -> Result<Config, ConfigFaults> {
    read_all(files, read).map(|(config, _)| config)
}

/// Reads and checks a configuration and describes it.
///
/// # Errors
/// Every fault found, not only the first.
pub fn describe(path: &Path) -> Result<Description, ConfigFaults> {
    read_all(&ConfigFiles::find(path)?, &read_file).map(|(_, description)| description)
}

/// The configuration file and its drop-ins as one TOML text, each part with the file and line it comes from. Keys and
/// values are not checked.
///
/// # Errors
/// When a file cannot be read or is no TOML: every such fault.
pub fn merged(path: &Path) -> Result<String, ConfigFaults> {
    merged_with(&ConfigFiles::find(path)?, &read_file)
}

/// As [`merged`], with files read by `read`.
///
/// # Errors
/// When a file cannot be read or is no TOML: every such fault.
pub fn merged_with(files: &ConfigFiles, read: ReadFile<'_>) -> Result<String, ConfigFaults> {
    let mut faults = Faults::default();
    let sources = Sources::read(files, read, &mut faults);
    let text = sources.as_ref().map(|sources| merged::text(&Document::parse(sources, &mut faults)));
    text.filter(|_| faults.is_empty()).ok_or_else(|| ConfigFaults(faults.into_lines()))
}

fn read_all(files: &ConfigFiles, read: ReadFile<'_>) -> Result<(Config, Description), ConfigFaults> {
    let mut faults = Faults::default();
    match read_config(files, read, &mut faults) {
        Some(good) if faults.is_empty() => Ok(good),
        // A part that cannot be made and has no fault is an error of this program, which is reported too.
        None if faults.is_empty() => Err(ConfigFaults(vec![format!("{}: not usable", files.main.display())])),
        _ => Err(ConfigFaults(faults.into_lines())),
    }
}

/// Cycle times that the DBC files give the input messages, s.
fn cycle_times_s(found: &[resolve::ResolvedSignal<'_>]) -> Vec<(BusIndex, CanId, f64)> {
    let in_frames = found.iter().filter(|resolved| resolved.answer.is_none());
    let times = in_frames.filter_map(|resolved| {
        let cycle_ms = resolved.message.cycle_time_ms.filter(|cycle_ms| *cycle_ms > 0)?;
        Some((resolved.bus, resolved.message.id, f64::from(cycle_ms) / 1000.0))
    });
    let mut times: Vec<_> = times.collect();
    times.dedup_by_key(|(bus, id, _)| (*bus, *id));
    times
}

fn read_config(files: &ConfigFiles, read: ReadFile<'_>, faults: &mut Faults) -> Option<(Config, Description)> {
    let path = files.main.as_path();
    let sources = Sources::read(files, read, faults)?;
    let document = Document::parse(&sources, faults);
    let raw = RawTables::read(&document, faults);
    let sourced = read_model(path, &document, &raw, read, faults);
    let (model, model_source) = sourced.map(|SourcedModel { model, source }| (model, source)).unzip();
    let modules = modules::read(path, &raw, read, faults);
    let ranged = model.as_ref().map(|model| modules::with_voltages_of(model, &modules));
    cross::check(&raw, model.as_ref(), faults);
    input_tables::interfaces(&document, &raw, faults);
    plausible::rated_capacity(&raw, model.as_ref(), faults);
    plausible::initial_capacity(&raw, model.as_ref(), faults);
    let own_ah =
        raw.pack.as_ref().and_then(|pack| pack.rated_capacity_ah).or(model.as_ref().map(|m| m.rated_capacity_ah));
    modules.iter().for_each(|module| plausible::module(module, own_ah, faults));
    let databases = Databases::load(path, &raw, read, faults);
    let before = faults.len();
    let found = databases.as_ref().map(|databases| resolve::resolve(&raw, databases, faults)).unwrap_or_default();
    let inputs_whole = databases.is_some() && faults.len() == before && !raw.broken;
    if let Some(databases) = &databases {
        input_tables::signals(&document, &raw, databases, faults);
    }
    plausible::signals(&raw, &found, ranged.as_ref(), faults);
    plausible::ranges(&raw, &found, ranged.as_ref(), faults);
    let checks = &mut Checks { raw: &raw, found: &found, faults };
    let mut guards = protect::guards(checks, inputs_whole);
    let laid_out = output::output(checks, path, model.as_ref(), read);
    let (commands, guard) = commands::commands(checks, laid_out.as_ref()).unzip();
    guards.extend(guard.flatten());
    let poll = uds::poll(&raw, &found, checks.faults);
    let j1939 = j1939::node(checks, laid_out.as_ref().map(|(output, _)| output));
    let (output, output_layout) = laid_out.unzip();
    let outputs = output::uses(&raw, output.as_ref());
    let ranges = resolve::ranges(&found, raw.pack.as_ref()?.cells);
    let interfaces = raw.interfaces.iter().map(|i| InterfaceConfig { name: i.name.clone(), fd: i.fd }).collect();
    let traffic = convert::Traffic {
        input: input_map(&found)?,
        answers: answers(&found).ok()?,
        poll,
        guards,
        cycle_times_s: cycle_times_s(&found),
        output,
        commands,
        j1939,
    };
    let monitor = convert::monitor(&raw, model?, modules, &ranges, traffic)?;
    let store = raw.store.as_ref()?.config();
    let warnings = faults.warning_lines();
    let vehicle = raw.vehicle.as_ref()?.config();
    let key = commands::key_source(&raw, path, !monitor.authentications().is_empty(), faults);
    let config = Config {
        path: path.to_owned(),
        interfaces,
        monitor,
        model_source: model_source?,
        output_layout,
        store,
        warnings,
        vehicle,
        key,
    };
    let description = describe::describe(files, &raw, &config, &found, outputs);
    Some((config, description))
}

/// The cell model that `pack.cell_model` names, also where another key of `[pack]` is faulty; without it, that of the label.
fn read_model(
    path: &Path,
    document: &Document<'_>,
    raw: &RawTables,
    read: ReadFile<'_>,
    faults: &mut Faults,
) -> Option<SourcedModel> {
    match document.text("pack.cell_model") {
        Some(named) => cell_model::load_with(&beside(path, named), read, faults),
        None => label::model(raw, faults),
    }
}

/// `named`, relative to the folder of `path`.
fn beside(path: &Path, named: &str) -> PathBuf {
    path.parent().unwrap_or(Path::new("")).join(named)
}

fn read_file(path: &Path) -> std::io::Result<Vec<u8>> {
    std::fs::read(path)
}

/// The file as UTF-8 text, or `None` with a fault noted.
fn read_text(path: &Path, read: ReadFile<'_>, faults: &mut Faults) -> Option<String> {
    let file = path.display().to_string();
    let bytes = read(path).map_err(|error| faults.add(&file, 0, format!("cannot be read: {error}"))).ok()?;
    match String::from_utf8(bytes) {
        Ok(text) => Some(text),
        Err(error) => {
            let good = error.utf8_error().valid_up_to();
            let line = 1 + error.as_bytes()[..good].iter().filter(|&&b| b == b'\n').count();
            faults.add(&file, line, "is not UTF-8 text");
            None
        }
    }
}

#[cfg(test)]
mod tests;
