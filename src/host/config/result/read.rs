//! The steps that turn the files of a configuration into the checked [`Config`].

use std::path::Path;

use super::config::{Config, InterfaceConfig, StoreConfig};
use super::key_source::key_source;
use super::vehicle::VehicleIdentity;
use crate::config::cell_model::SourcedModel;
use crate::config::checks::{Databases, ResolvedSignal, cells, cross, input_tables, monitor, plausible, signals};
use crate::config::document::{ConfigFaults, ConfigFiles, Document, Faults, ReadFile, Sources, read_file};
use crate::config::schema::RawTables;

/// Reads and checks a configuration, its drop-ins and the files they name (DBC files, cell models; paths are relative
/// to the configuration file).
///
/// # Errors
/// Returns every fault found, not only the first.
pub fn load(path: &Path) -> Result<Config, ConfigFaults> {
    load_with(&ConfigFiles::find(path)?, &read_file)
}

/// Like [`load`], but reads files with `read`.
///
/// # Errors
/// Returns every fault found, not only the first.
pub fn load_with(files: &ConfigFiles, read: ReadFile<'_>) -> Result<Config, ConfigFaults> {
    read_and(files, read, |_, _, _| ()).map(|(config, ())| config)
}

/// Like [`load_with`], but also calls `then` with the tables, the configuration and the signals found, and returns the
/// result of `then`.
///
/// # Errors
/// Returns every fault found, not only the first.
pub(crate) fn read_and<T>(
    files: &ConfigFiles,
    read: ReadFile<'_>,
    then: impl FnOnce(&RawTables, &Config, &[ResolvedSignal<'_>]) -> T,
) -> Result<(Config, T), ConfigFaults> {
    let faults = Faults::default();
    match read_config(files, read, &faults, then) {
        Some(good) if faults.is_empty() => Ok(good),
        // If a part is missing although no fault was reported, packwatch itself has a bug. This bug is reported instead
        // of hidden.
        None if faults.is_empty() => Err(ConfigFaults(vec![format!(
            "{}: cannot be used, but no fault was found: this is a bug in packwatch",
            files.main.display()
        )])),
        _ => Err(faults.lines()),
    }
}

fn read_config<T>(
    files: &ConfigFiles,
    read: ReadFile<'_>,
    faults: &Faults,
    then: impl FnOnce(&RawTables, &Config, &[ResolvedSignal<'_>]) -> T,
) -> Option<(Config, T)> {
    let path = files.main.as_path();
    let sources = Sources::read(files, read, faults)?;
    let document = Document::parse(&sources, faults);
    let raw = RawTables::read(&document);
    let sourced = cells::own_model(path, &document, &raw, read);
    let (model, model_source) = sourced.map(|SourcedModel { model, source }| (model, source)).unzip();
    let modules = cells::modules(path, &raw, read);
    let ranged = model.as_ref().map(|model| cells::with_voltages_of(model, &modules));
    cross::check(&raw, model.as_ref());
    input_tables::interfaces(&document, &raw);
    plausible::rated_capacity(&raw, model.as_ref());
    plausible::initial_capacity(&raw, model.as_ref());
    let own_ah = raw.rated_ah(model.as_ref());
    modules.iter().for_each(|module| plausible::module(module, own_ah));
    let databases = Databases::load(path, &raw, read);
    let before = faults.len();
    let found = databases.as_ref().map(|databases| signals::resolve(&raw, databases)).unwrap_or_default();
    let inputs_whole = databases.is_some() && faults.len() == before && !raw.broken;
    if let Some(databases) = &databases {
        input_tables::signals(&document, &raw, databases);
    }
    plausible::signals(&raw, &found, ranged.as_ref());
    plausible::ranges(&raw, &found, ranged.as_ref());
    let monitor = monitor::monitor(&raw, &found, inputs_whole, model, modules, path, read);
    let interfaces = raw.interfaces.iter().map(|i| InterfaceConfig { name: i.name.clone(), fd: i.fd }).collect();
    let (mut monitor, output_layout) = monitor?;
    let fleet = model_source.as_ref().and_then(|source| source.fleet.as_deref());
    monitor.fleet = monitor.label.and(fleet.cloned());
    let store = raw.store.as_ref()?;
    let store =
        StoreConfig { checkpoint_s: store.checkpoint_s, max_rows: store.max_rows, keep_years: store.keep_years };
    let warnings = faults.warning_lines();
    let vehicle = raw.vehicle.as_ref()?;
    let vehicle = VehicleIdentity { name: vehicle.name.clone(), id: vehicle.id.clone(), pack: vehicle.pack.clone() };
    let key = key_source(&raw, path, !monitor.authentications().is_empty());
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
    let more = then(&raw, &config, &found);
    Some((config, more))
}
