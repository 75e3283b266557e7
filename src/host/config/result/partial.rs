//! Reads as much of a faulty configuration as possible, and all faults, for `packwatch doctor`.

use std::path::Path;

use super::config::Config;
use super::read::load_with;
use crate::can::guard::GuardConfig;
use crate::cell::CellModel;
use crate::config::checks::{Databases, ResolvedSignal, cells, protect, signals};
use crate::config::document::{ConfigFaults, ConfigFiles, Document, Faults, ReadFile, Sources};
use crate::config::schema::RawTables;

/// The readable part of a configuration.
#[derive(Debug)]
pub(crate) struct PartialConfig {
    /// The whole configuration, if it has no faults.
    pub config: Option<Config>,
    /// Every fault; empty if there are none.
    pub faults: Vec<String>,
    /// The tables of the file and its drop-ins.
    pub raw: RawTables,
    /// The DBC files and diagnostic answers.
    pub databases: Databases,
    pub model: Option<CellModel>,
}

impl PartialConfig {
    /// Reads the parts that can be read. `read_file` reads the files.
    ///
    /// # Errors
    /// Fails if the configuration file, a drop-in or a DBC file cannot be read, if a table `[[input.diagnostic]]` is
    /// faulty, or if there is neither a DBC file nor such a table. The error lists every fault found.
    pub(crate) fn read(path: &Path, read_file: ReadFile<'_>) -> Result<Self, ConfigFaults> {
        let (config, faults) = match ConfigFiles::find(path).and_then(|files| load_with(&files, read_file)) {
            Ok(config) => (Some(config), Vec::new()),
            Err(faults) => (None, faults.0),
        };
        // Reading the tables a second time finds the same faults again, so this list of faults is ignored.
        let again = Faults::default();
        let read = || {
            let sources = Sources::read(&ConfigFiles::find(path).ok()?, read_file, &again)?;
            let document = Document::parse(&sources, &again);
            let raw = RawTables::read(&document);
            let databases = Databases::load(path, &raw, read_file)?;
            let model = cells::own_model(path, &document, &raw, read_file);
            Some((raw, databases, model.map(|sourced| sourced.model)))
        };
        match read() {
            Some((raw, databases, model)) => Ok(Self { config, faults, raw, databases, model }),
            None => Err(ConfigFaults(faults)),
        }
    }

    pub(crate) fn signals(&self) -> Vec<ResolvedSignal<'_>> {
        signals::resolve(&self.raw, &self.databases)
    }

    /// End-to-end protection of the inputs, as far as it can be read.
    pub(crate) fn guards(&self, signals: &[ResolvedSignal<'_>]) -> Vec<GuardConfig> {
        match &self.config {
            Some(config) => config.monitor.guards.clone(),
            None => protect::guards(&self.raw, signals, false),
        }
    }
}
