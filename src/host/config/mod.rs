//! The TOML configuration: as written, then checked; every fault at once, with file, line, key, found and allowed.
//!
//! `keys` says what each key is, `schema` and `setting` read them, `cross` checks what concerns several keys,
//! `convert` makes the settings the other modules take, `cell_model` does the same for cell files.

use std::path::{Path, PathBuf};

use crate::can::dbc::Database;
use crate::monitor::MonitorConfig;

mod alarm;
pub mod cell_model;
mod commands;
mod convert;
mod cross;
mod describe;
mod document;
mod j1939;
mod keys;
mod manual;
mod output;
mod pattern;
mod protect;
mod reference;
mod resolve;
mod schema;
mod setting;
mod survey;

pub use describe::{Description, InterfaceUse, OutputUse, SignalUse};
use document::{Document, Faults};
pub use manual::manual;
pub use reference::reference;
use resolve::Databases;
pub use survey::{Survey, survey};

/// A configuration that cannot be wrong.
#[derive(Debug, Clone)]
pub struct Config {
    /// Where it was read from.
    pub path: PathBuf,
    /// CAN interfaces; a `BusIndex` counts in this order.
    pub interfaces: Vec<InterfaceConfig>,
    /// What the core needs.
    pub monitor: MonitorConfig,
    /// Layout of what is sent, for consumers; `None` = nothing is sent.
    pub output_layout: Option<Database>,
    /// How state and history are kept.
    pub store: StoreConfig,
}

impl Config {
    /// Names of the interfaces, in the order in which they are numbered.
    pub fn interface_names(&self) -> Vec<String> {
        self.interfaces.iter().map(|interface| interface.name.clone()).collect()
    }
}

/// Half-cycles kept where nobody says otherwise.
pub const DEFAULT_MAX_HALF_CYCLES: u32 = 200_000;

/// How state and history are kept.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StoreConfig {
    /// Period of the state's checkpoints, s.
    pub checkpoint_s: f64,
    /// Half-cycles kept, one row per cell each; beyond, the oldest are thinned.
    pub max_half_cycles: u32,
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
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConfigFaults(pub Vec<String>);

/// How a file's bytes are had: from the disk, or (demo, tests) from memory.
pub type ReadFile<'a> = &'a dyn Fn(&Path) -> std::io::Result<Vec<u8>>;

/// Reads and checks a configuration with everything it names (DBC files, cell model; paths are relative to it).
///
/// # Errors
/// Every fault found, not only the first.
pub fn load(path: &Path) -> Result<Config, ConfigFaults> {
    load_with(path, &read_file)
}

/// As [`load`], with the files had through `read`.
///
/// # Errors
/// Every fault found, not only the first.
pub fn load_with(path: &Path, read: ReadFile<'_>) -> Result<Config, ConfigFaults> {
    read_all(path, read).map(|(config, _)| config)
}

/// Reads and checks a configuration, and says what it means.
///
/// # Errors
/// Every fault found, not only the first.
pub fn describe(path: &Path) -> Result<Description, ConfigFaults> {
    read_all(path, &read_file).map(|(_, description)| description)
}

fn read_all(path: &Path, read: ReadFile<'_>) -> Result<(Config, Description), ConfigFaults> {
    let mut faults = Faults::default();
    match read_config(path, read, &mut faults) {
        Some(good) if faults.is_empty() => Ok(good),
        // A part that could not be made without anything said would be a fault of this program: never silent.
        None if faults.is_empty() => Err(ConfigFaults(vec![format!("{}: not usable", path.display())])),
        _ => Err(ConfigFaults(faults.into_lines())),
    }
}

fn read_config(path: &Path, read: ReadFile<'_>, faults: &mut Faults) -> Option<(Config, Description)> {
    let text = read_text(path, read, faults)?;
    let document = Document::parse(&path.display().to_string(), &text, faults);
    let raw = convert::Raw::read(&document, faults);
    let model = raw.cell_model.as_ref().and_then(|named| cell_model::load_with(&beside(path, named), read, faults));
    cross::check(&raw, model.as_ref(), faults);
    let names = raw.input.as_ref().map_or(&[][..], |input| &input.dbc);
    let databases = Databases::load(path, names, read, faults);
    let before = faults.len();
    let found = databases.as_ref().map(|databases| resolve::resolve(&raw, databases, faults)).unwrap_or_default();
    let inputs_whole = databases.is_some() && faults.len() == before && !raw.broken;
    let mut guards = protect::guards(&raw, &found, inputs_whole, faults);
    let laid_out = output::output(&raw, path, model.as_ref(), &found, read, faults);
    let (commands, guard) = commands::commands(&raw, laid_out.as_ref(), &found, faults).unzip();
    guards.extend(guard);
    let j1939 = j1939::node(&raw, &found, laid_out.as_ref().map(|(output, _)| output), faults);
    let (output, output_layout) = laid_out.unzip();
    let outputs = output::uses(&raw, output.as_ref());
    let ranges = resolve::ranges(&found, raw.pack.as_ref()?.cells);
    let interfaces = raw.interfaces.iter().map(|i| InterfaceConfig { name: i.name.clone(), fd: i.fd }).collect();
    let traffic = convert::Traffic { input: resolve::input_map(&found)?, guards, output, commands, j1939 };
    let monitor = convert::monitor(&raw, model?, &ranges, traffic)?;
    let store = convert::store(raw.store.as_ref()?);
    let config = Config { path: path.to_owned(), interfaces, monitor, output_layout, store };
    let description = describe::describe(&raw, &config, &found, outputs);
    Some((config, description))
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
