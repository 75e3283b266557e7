//! Replays the vehicles of a fleet, in one or several parts.
//!
//! | function | input | output |
//! | --- | --- | --- |
//! | [`plan`] | logs, and folders that each contain the logs of one vehicle | the vehicles, sorted by name |
//! | [`Shard::choose`] | all vehicles | the vehicles of one part; parts have similar sizes, the same on every machine |
//! | [`run`] | vehicles | a folder for each vehicle with `vehicle.json` and the tables of [`export`](super::export) |
//!
//! `vehicle.json` is written last. If it has the same manifest line, settings and program and contains no error, the
//! vehicle is complete and is not replayed again. If a vehicle fails, its `vehicle.json` contains the reason, and the
//! other vehicles continue. A vehicle's folder is locked during its replay. A second process waits for the lock and
//! then finds the vehicle complete.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use sha2::{Digest, Sha256};

use super::export::{self, ExportSettings};
use super::vehicle::{RECORD, VERSION, Vehicle, VehicleRecord};
use crate::config::Config;
use crate::error::LabError;
use crate::io::json::json_fault;

const LOCK: &str = ".lock";
const MAX_SHARDS: usize = 100_000;

/// Lists the vehicles in `paths`, sorted by name. Each log and each folder with logs is a vehicle. The logs of a folder
/// are read in the order of their names. Paths become absolute, because the vehicles may be replayed from other
/// folders.
///
/// # Errors
/// A path cannot be read, or a folder contains no log.
pub fn plan(paths: &[PathBuf]) -> Result<Vec<Vehicle>, LabError> {
    let names = export::names(paths);
    let vehicle = |(path, vehicle): (&PathBuf, String)| {
        let path = &std::path::absolute(path).map_err(|error| named(path, &error))?;
        let logs = if path.is_dir() { logs_in(path)? } else { vec![path.clone()] };
        let size = |log: &PathBuf| {
            let meta = std::fs::metadata(log)
                .map_err(|error| LabError::File(format!("{}: cannot be read: {error}", log.display())))?;
            Ok::<u64, LabError>(meta.len())
        };
        let bytes = logs.iter().map(size).sum::<Result<u64, LabError>>()?;
        Ok(Vehicle { vehicle, bytes, logs, config: None })
    };
    let mut vehicles = paths.iter().zip(names).map(vehicle).collect::<Result<Vec<_>, LabError>>()?;
    vehicles.sort_by(|a, b| a.vehicle.cmp(&b.vehicle));
    Ok(vehicles)
}

fn logs_in(folder: &Path) -> Result<Vec<PathBuf>, LabError> {
    let failed = |error: std::io::Error| LabError::File(format!("{}: cannot be read: {error}", folder.display()));
    let mut logs = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        if path.is_file() && path.file_name().is_some_and(is_log) {
            logs.push(path);
        }
    }
    logs.sort();
    if logs.is_empty() {
        return Err(LabError::Data(format!(
            "{}: contains no log, must have .log, .journal or .csv files",
            folder.display()
        )));
    }
    Ok(logs)
}

/// Whether a file name belongs to a log, compressed or not. Truth tables and cycle tables are not logs.
fn is_log(name: &OsStr) -> bool {
    let name = name.to_string_lossy();
    let name = crate::without_compression(&name);
    let is_table = name.ends_with(".truth.csv") || name.ends_with("_cycles.csv");
    !name.starts_with('.') && !is_table && [".log", ".journal", ".csv"].iter().any(|ending| name.ends_with(ending))
}

/// Writes the manifest (the list of vehicles): one JSON document per line.
///
/// # Errors
/// A path is not valid UTF-8.
pub fn manifest(vehicles: &[Vehicle]) -> Result<String, LabError> {
    let line = |vehicle: &Vehicle| match serde_json::to_string(vehicle) {
        Ok(line) => Ok(line + "\n"),
        Err(error) => Err(LabError::Data(format!("vehicle {}: {error}", vehicle.vehicle))),
    };
    vehicles.iter().map(line).collect()
}

/// Reads a manifest.
///
/// # Errors
/// The file cannot be read or contains no vehicle, a line is not a vehicle, or two lines have the same vehicle name.
/// The error names the faulty line.
pub fn read_manifest(path: &Path) -> Result<Vec<Vehicle>, LabError> {
    let shown = path.display();
    let text = std::fs::read_to_string(path)
        .map_err(|error| LabError::of_io(format!("{shown}: cannot be read: {error}"), &error))?;
    let mut lines = BTreeMap::new();
    let mut vehicles = Vec::new();
    for (number, line) in (1..).zip(text.lines()).filter(|(_, line)| !line.trim().is_empty()) {
        let vehicle: Vehicle = serde_json::from_str(line).map_err(|error| {
            let fault = json_fault(&error);
            LabError::Data(format!(
                "{shown}:{number}: not a vehicle of a manifest (see `packwatch fleet plan`): {fault}"
            ))
        })?;
        let Vehicle { vehicle: name, logs, .. } = &vehicle;
        if name.is_empty() || export::clean(name) != *name {
            let allowed = "must be letters, digits, '.', '_' and '-', not '.' first";
            return Err(LabError::Data(format!("{shown}:{number}: vehicle name \"{name}\", {allowed}")));
        }
        if logs.is_empty() {
            return Err(LabError::Data(format!("{shown}:{number}: vehicle {name} has no logs")));
        }
        if let Some(first) = lines.insert(name.clone(), number) {
            return Err(LabError::Data(format!("{shown}:{number}: vehicle {name} is already in line {first}")));
        }
        vehicles.push(vehicle);
    }
    if vehicles.is_empty() {
        return Err(LabError::Data(format!("{shown}: contains no vehicle; `packwatch fleet plan` writes a manifest")));
    }
    Ok(vehicles)
}

/// One of several parts of a fleet, written as `I/N`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    /// Number of the part, from 1.
    pub number: usize,
    /// Number of parts.
    pub of: usize,
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers = text.split_once('/').and_then(|(number, of)| Some((number.parse().ok()?, of.parse().ok()?)));
        match numbers {
            Some((number, of)) if (1..=of).contains(&number) && of <= MAX_SHARDS => Ok(Self { number, of }),
            _ => Err(format!("must be I/N, I from 1 to N, N at most {MAX_SHARDS}")),
        }
    }
}

impl Shard {
    /// Returns the vehicles of this part. In the order of falling size, each vehicle goes to the part with the fewest
    /// bytes so far.
    pub fn choose<'v>(&self, vehicles: &'v [Vehicle]) -> Vec<&'v Vehicle> {
        let mut largest: Vec<&Vehicle> = vehicles.iter().collect();
        largest.sort_by(|a, b| b.bytes.cmp(&a.bytes).then_with(|| a.vehicle.cmp(&b.vehicle)));
        let mut sizes = vec![0_u64; self.of];
        largest.retain(|vehicle| {
            let smallest = (0..self.of).min_by_key(|part| sizes[*part]).unwrap_or(0);
            // An empty log takes some time too.
            sizes[smallest] = sizes[smallest].saturating_add(vehicle.bytes.max(1));
            smallest + 1 == self.number
        });
        largest
    }
}

/// Result of a vehicle's replay.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// The vehicle was replayed in this run.
    Replayed(VehicleRecord),
    /// The vehicle was completed in an earlier run.
    Complete(VehicleRecord),
    /// The vehicle failed. The record contains the reason and lists no tables.
    Failed(VehicleRecord),
}

/// Replays the vehicles. Returns the outcomes in the same order. `config_of` reads the configuration of a vehicle.
/// `report` receives the number of bytes read since its last call. For a complete vehicle, it receives the size of the
/// logs.
///
/// # Errors
/// No threads can be started, or a record cannot be written.
pub fn run(
    vehicles: &[&Vehicle],
    config_of: &(dyn Fn(&Vehicle) -> Result<Config, LabError> + Sync),
    settings: &ExportSettings<'_>,
    report: &(dyn Fn(u64) + Sync),
) -> Result<Vec<Outcome>, LabError> {
    let outcomes =
        super::in_parallel(vehicles, settings.jobs, |_, vehicle| replay(vehicle, config_of, settings, report))?;
    outcomes.into_iter().collect()
}

fn replay(
    vehicle: &Vehicle,
    config_of: &(dyn Fn(&Vehicle) -> Result<Config, LabError> + Sync),
    settings: &ExportSettings<'_>,
    report: &dyn Fn(u64),
) -> Result<Outcome, LabError> {
    let folder = settings.out.join(&vehicle.vehicle);
    let config = config_of(vehicle);
    let mut record = VehicleRecord {
        version: VERSION,
        packwatch: env!("CARGO_PKG_VERSION").to_owned(),
        line: vehicle.clone(),
        settings_sha256: config
            .as_ref()
            .ok()
            .map(|config| sha256(&format!("{:?} {}", config.monitor, settings.reading))),
        period_s: settings.period_s,
        error: None,
        rows: BTreeMap::new(),
        cells: config.as_ref().map_or(0, |config| config.monitor.sample.cells.into()),
        rated_ah: config.as_ref().ok().map(|config| config.monitor.model.rated_capacity_ah),
        days: 0.0,
        notes: Vec::new(),
        model: None,
    };
    std::fs::create_dir_all(&folder).map_err(|error| named(&folder, &error))?;
    let lock = std::fs::File::create(folder.join(LOCK)).and_then(|file| file.lock().map(|()| file));
    let _lock = lock.map_err(|error| named(&folder.join(LOCK), &error))?;
    let earlier =
        VehicleRecord::read(&folder).filter(|earlier| earlier.has_inputs_of(&record) && earlier.error.is_none());
    if let Some(earlier) = earlier {
        report(vehicle.bytes);
        return Ok(Outcome::Complete(earlier));
    }
    // Without these files, the folder counts as incomplete.
    for file in [RECORD, export::ABOUT] {
        match std::fs::remove_file(folder.join(file)) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(named(&folder, &error)),
            _ => {}
        }
    }
    // A bug that one vehicle triggers must not stop the other vehicles.
    let replayed = catch_unwind(AssertUnwindSafe(|| {
        let config = config?;
        export::export(&config, &vehicle.logs, &vehicle.vehicle, settings, report)
    }));
    match replayed.unwrap_or_else(|_| {
        Err(LabError::Data(
            "packwatch has a bug that this vehicle triggers: see the message on standard error".to_owned(),
        ))
    }) {
        Ok(exported) => {
            record.rows = exported.rows.iter().map(|(table, rows)| ((*table).to_owned(), *rows)).collect();
            (record.days, record.notes, record.model) = (exported.days, exported.notes, exported.model);
            write(&folder, &record)?;
            Ok(Outcome::Replayed(record))
        }
        Err(error) => {
            record.error = Some(error.to_string());
            write(&folder, &record)?;
            Ok(Outcome::Failed(record))
        }
    }
}

fn sha256(text: &str) -> String {
    Sha256::digest(text.as_bytes()).iter().map(|byte| format!("{byte:02x}")).collect()
}

fn write(folder: &Path, record: &VehicleRecord) -> Result<(), LabError> {
    Ok(crate::write_file(&folder.join(RECORD), &serde_json::to_vec_pretty(record)?)?)
}

fn named(folder: &Path, error: &std::io::Error) -> LabError {
    LabError::of_io(format!("{}: {error}", folder.display()), error)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn vehicle(name: &str, bytes: u64) -> Vehicle {
        Vehicle { vehicle: name.to_owned(), bytes, logs: vec![PathBuf::from(format!("{name}.log"))], config: None }
    }

    #[test]
    fn parts_are_disjoint_and_of_similar_size() {
        let vehicles: Vec<Vehicle> =
            (0..100).map(|n| vehicle(&format!("car{n:02}"), 1000 + 37 * (n * n % 101))).collect();
        for of in [1, 2, 3, 7, 100, 130] {
            let parts: Vec<Vec<&Vehicle>> = (1..=of).map(|number| Shard { number, of }.choose(&vehicles)).collect();
            let mut names: Vec<&str> = parts.iter().flatten().map(|vehicle| vehicle.vehicle.as_str()).collect();
            names.sort_unstable();
            assert_eq!(names, vehicles.iter().map(|vehicle| vehicle.vehicle.as_str()).collect::<Vec<_>>(), "{of}");
            let sizes: Vec<u64> = parts.iter().map(|part| part.iter().map(|vehicle| vehicle.bytes).sum()).collect();
            let (least, most) = (sizes.iter().min().unwrap(), sizes.iter().max().unwrap());
            assert!(most - least <= 4700, "no more than the largest vehicle: {sizes:?}");
        }
        // The order of the vehicles in the manifest has no effect.
        let reversed: Vec<Vehicle> = vehicles.iter().rev().cloned().collect();
        assert_eq!(Shard { number: 2, of: 3 }.choose(&vehicles), Shard { number: 2, of: 3 }.choose(&reversed));
    }

    #[test]
    fn shard_number_must_be_within_its_range() {
        assert_eq!("2/4".parse(), Ok(Shard { number: 2, of: 4 }));
        for text in ["0/4", "5/4", "1", "1/0", "a/b", "1/4/2", "-1/4", "1/9999999999999", ""] {
            assert!(text.parse::<Shard>().is_err(), "{text}");
        }
    }

    #[test]
    fn manifest_reads_back_and_faults_name_the_line() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("fleet.jsonl");
        let vehicles = vec![vehicle("a", 1), Vehicle { config: Some("b.toml".into()), ..vehicle("b", 2) }];
        std::fs::write(&path, manifest(&vehicles).unwrap()).unwrap();
        assert_eq!(read_manifest(&path), Ok(vehicles));
        let line = |name: &str| manifest(&[vehicle(name, 1)]).unwrap();
        for (text, fault) in [
            (line("a") + "\n" + &line("a"), ":3: vehicle a is already in line 1"),
            (line("a/../b"), ":1: vehicle name \"a/../b\", must be letters"),
            (line(".."), ":1: vehicle name \"..\", must be letters"),
            (line("a").replace("\"a.log\"", ""), ":1: vehicle a has no logs"),
            (
                line("a").replace("bytes", "size"),
                ":1: not a vehicle of a manifest (see `packwatch fleet plan`): unknown field `size`",
            ),
            (String::new(), ": contains no vehicle"),
        ] {
            std::fs::write(&path, &text).unwrap();
            let error = read_manifest(&path).unwrap_err().to_string();
            assert!(error.contains(fault), "{fault}\n{error}");
        }
    }

    #[test]
    fn folder_becomes_one_vehicle_with_all_its_logs() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("car 1");
        std::fs::create_dir(&folder).unwrap();
        for name in ["b.log.gz", "a.log", "a.truth.csv", "x_cycles.csv", "notes.txt", ".c.log"] {
            std::fs::write(folder.join(name), "12345").unwrap();
        }
        let vehicles = plan(std::slice::from_ref(&folder)).unwrap();
        let logs = vec![folder.join("a.log"), folder.join("b.log.gz")];
        assert_eq!(vehicles, [Vehicle { vehicle: "car_1".to_owned(), bytes: 10, logs, config: None }]);
        let empty = place.path().join("empty");
        std::fs::create_dir(&empty).unwrap();
        assert!(plan(&[empty]).unwrap_err().to_string().contains("contains no log"));
        assert!(plan(&["missing.log".into()]).unwrap_err().to_string().contains("missing.log: "));
    }
}
