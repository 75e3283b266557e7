//! The steps from the files of a configuration to the checked [`Config`].

use std::path::Path;

use super::config::{Config, InterfaceConfig, StoreConfig};
use super::key_source::key_source;
use super::vehicle::VehicleIdentity;
use crate::can::CanId;
use crate::config::cell_model::{self, SourcedModel};
use crate::config::checks::{
    Checks, Databases, ResolvedSignal, answers, commands, cross, input_map, input_tables, j1939, label, modules,
    monitor, output, plausible, polling, protect, signals,
};
use crate::config::document::{ConfigFaults, ConfigFiles, Document, Faults, ReadFile, Sources, beside, read_file};
use crate::config::schema::RawTables;
use crate::quantity::BusIndex;

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
    read_and(files, read, |_, _, _| ()).map(|(config, ())| config)
}

/// As [`load_with`], with what `then` makes of the tables, the configuration and the signals found for it.
///
/// # Errors
/// Every fault found, not only the first.
pub(crate) fn read_and<T>(
    files: &ConfigFiles,
    read: ReadFile<'_>,
    then: impl FnOnce(&RawTables, &Config, &[ResolvedSignal<'_>]) -> T,
) -> Result<(Config, T), ConfigFaults> {
    let mut faults = Faults::default();
    match read_config(files, read, &mut faults, then) {
        Some(good) if faults.is_empty() => Ok(good),
        // A part that cannot be made and has no fault is an error of this program, which is reported too.
        None if faults.is_empty() => Err(ConfigFaults(vec![format!("{}: not usable", files.main.display())])),
        _ => Err(ConfigFaults(faults.into_lines())),
    }
}

/// Cycle times that the DBC files give the input messages, s.
fn cycle_times_s(found: &[ResolvedSignal<'_>]) -> Vec<(BusIndex, CanId, f64)> {
    let in_frames = found.iter().filter(|resolved| resolved.answer.is_none());
    let times = in_frames.filter_map(|resolved| {
        let cycle_ms = resolved.message.cycle_time_ms.filter(|cycle_ms| *cycle_ms > 0)?;
        Some((resolved.bus, resolved.message.id, f64::from(cycle_ms) / 1000.0))
    });
    let mut times: Vec<_> = times.collect();
    times.dedup_by_key(|(bus, id, _)| (*bus, *id));
    times
}

fn read_config<T>(
    files: &ConfigFiles,
    read: ReadFile<'_>,
    faults: &mut Faults,
    then: impl FnOnce(&RawTables, &Config, &[ResolvedSignal<'_>]) -> T,
) -> Option<(Config, T)> {
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
    let found = databases.as_ref().map(|databases| signals::resolve(&raw, databases, faults)).unwrap_or_default();
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
    let poll = polling::poll(&raw, &found, checks.faults);
    let j1939 = j1939::node(checks, laid_out.as_ref().map(|(output, _)| output));
    let (output, output_layout) = laid_out.unzip();
    let ranges = signals::ranges(&found, raw.pack.as_ref()?.cells);
    let interfaces = raw.interfaces.iter().map(|i| InterfaceConfig { name: i.name.clone(), fd: i.fd }).collect();
    let traffic = monitor::Traffic {
        input: input_map(&found)?,
        answers: answers(&found).ok()?,
        poll,
        guards,
        cycle_times_s: cycle_times_s(&found),
        output,
        commands,
        j1939,
    };
    let monitor = monitor::monitor(&raw, model?, modules, &ranges, traffic)?;
    let store = raw.store.as_ref()?;
    let store =
        StoreConfig { checkpoint_s: store.checkpoint_s, max_rows: store.max_rows, keep_years: store.keep_years };
    let warnings = faults.warning_lines();
    let vehicle = raw.vehicle.as_ref()?;
    let vehicle = VehicleIdentity { name: vehicle.name.clone(), id: vehicle.id.clone(), pack: vehicle.pack.clone() };
    let key = key_source(&raw, path, !monitor.authentications().is_empty(), faults);
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
    let then = then(&raw, &config, &found);
    Some((config, then))
}

/// The cell model that `pack.cell_model` names, also where another key of `[pack]` is faulty; without it, that of the label.
pub(crate) fn read_model(
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
