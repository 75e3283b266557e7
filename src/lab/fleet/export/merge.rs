//! Merges the tables of vehicles from several runs into one Parquet file per table. Vehicles are sorted by name, and
//! each has its own row groups.
//!
//! Input: folders written by [`run`](crate::fleet::vehicles::run). Output: `vehicles.parquet` with a row for each
//! vehicle, including failed vehicles; the tables `half_cycles`, `outlook`, `alarms`, `use_record` and, if exported,
//! `estimates`; and `models.jsonl` with the learned models. The bytes depend neither on the machine that replayed a
//! vehicle nor on the order of the replays.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::TableFormat;
use super::columns::{ALARMS, ESTIMATES, HALF_CYCLES, OUTLOOK, USE_RECORD, VEHICLES};
use super::table::{TableFile, concatenate};
use crate::error::{LabError, create_folder};
use crate::fleet::prior::write_models;
use crate::fleet::vehicle::{RECORD, Vehicle, VehicleRecord};

/// Summary of a merge.
#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Serialize)]
pub struct MergeSummary {
    /// Number of vehicles, including failed vehicles.
    pub vehicles: usize,
    /// Name of each vehicle without tables, with the reason.
    pub failed: BTreeMap<String, String>,
    /// Number of rows of each table.
    pub rows: BTreeMap<String, u64>,
}

struct VehicleFolder {
    folder: PathBuf,
    record: VehicleRecord,
}

/// Merges the vehicles in `folders` into `out`. `wanted` lists the expected vehicles; any other vehicle is an error.
///
/// # Errors
/// A vehicle is missing, unexpected or incomplete, or is found twice with different contents. Vehicles were replayed by
/// different versions or with different periods of estimates. A table cannot be read or written.
pub fn merge(folders: &[PathBuf], wanted: Option<&[Vehicle]>, out: &Path) -> Result<MergeSummary, LabError> {
    let vehicles = read_all(folders)?;
    check(&vehicles, wanted)?;
    create_folder(out)?;
    let mut summary = MergeSummary { vehicles: vehicles.len(), ..MergeSummary::default() };
    let metadata = [("packwatch.version", env!("CARGO_PKG_VERSION").to_owned())];
    for table in ["half_cycles", "outlook", "alarms", "use_record", "estimates"] {
        let has_table = |vehicle: &&VehicleFolder| vehicle.record.rows.contains_key(table);
        let parts: Vec<PathBuf> =
            vehicles.values().filter(has_table).map(|found| found.folder.join(format!("{table}.parquet"))).collect();
        let path = out.join(format!("{table}.parquet"));
        let is_wanted = table != "estimates" || vehicles.values().any(|found| found.record.period_s.is_some());
        if is_wanted {
            let rows = match table {
                "half_cycles" => concatenate(&path, &parts, &HALF_CYCLES, &metadata)?,
                "outlook" => concatenate(&path, &parts, &OUTLOOK, &metadata)?,
                "alarms" => concatenate(&path, &parts, ALARMS, &metadata)?,
                "use_record" => concatenate(&path, &parts, USE_RECORD, &metadata)?,
                _ => concatenate(&path, &parts, ESTIMATES, &metadata)?,
            };
            summary.rows.insert(table.to_owned(), rows);
        }
    }
    let mut table = TableFile::create(&out.join("vehicles.parquet"), TableFormat::Parquet, VEHICLES)?;
    let mut models = Vec::new();
    for (name, VehicleFolder { record, .. }) in vehicles {
        table.push(&record)?;
        models.extend(record.model);
        summary.failed.extend(record.error.map(|error| (name, error)));
    }
    summary.rows.insert("vehicles".to_owned(), table.finish(&metadata)?);
    write_models(out, &models)?;
    Ok(summary)
}

fn read_all(folders: &[PathBuf]) -> Result<BTreeMap<String, VehicleFolder>, LabError> {
    let mut vehicles: BTreeMap<String, VehicleFolder> = BTreeMap::new();
    for folder in folders {
        let failed = |error: std::io::Error| LabError::File(format!("{}: cannot be read: {error}", folder.display()));
        for entry in std::fs::read_dir(folder).map_err(failed)? {
            let folder = entry.map_err(failed)?.path();
            if !folder.is_dir() {
                continue;
            }
            let Some(record) = VehicleRecord::read(&folder) else {
                let why = "incomplete, or written by another version: run it again, or remove the folder";
                return Err(LabError::Data(format!("{}: {why}", folder.display())));
            };
            let name = record.line.vehicle.clone();
            let Some(other) = vehicles.get(&name) else {
                vehicles.insert(name, VehicleFolder { folder, record });
                continue;
            };
            if other.record != record {
                let (one, two) = (other.folder.display(), folder.display());
                return Err(LabError::Data(format!("vehicle {name}: {one} and {two} differ")));
            }
        }
    }
    if vehicles.is_empty() {
        let folders: Vec<String> = folders.iter().map(|folder| folder.display().to_string()).collect();
        return Err(LabError::Data(format!(
            "{}: no vehicle; `packwatch fleet run` writes {RECORD} for each vehicle",
            folders.join(", ")
        )));
    }
    Ok(vehicles)
}

fn check(vehicles: &BTreeMap<String, VehicleFolder>, wanted: Option<&[Vehicle]>) -> Result<(), LabError> {
    let mut made = vehicles.values().map(|found| (&found.record, (&found.record.packwatch, found.record.period_s)));
    let first = made.next();
    if let Some((other, (version, period_s))) = made.find(|(_, by)| first.is_some_and(|(_, first)| first != *by)) {
        let name = &other.line.vehicle;
        let period =
            period_s.map_or_else(|| "no estimates".to_owned(), |period_s| format!("an estimate each {period_s} s"));
        return Err(LabError::Data(format!(
            "vehicle {name} was replayed by packwatch {version} with {period}, unlike others: run it again"
        )));
    }
    let Some(wanted) = wanted else { return Ok(()) };
    let missing = wanted
        .iter()
        .filter(|vehicle| vehicles.get(&vehicle.vehicle).is_none_or(|found| found.record.line != **vehicle));
    let missing: Vec<&str> = missing.map(|vehicle| vehicle.vehicle.as_str()).collect();
    if !missing.is_empty() {
        return Err(LabError::Data(format!(
            "{} of {} vehicles have not been replayed: {}",
            missing.len(),
            wanted.len(),
            first_names(&missing)
        )));
    }
    let named: BTreeSet<&str> = wanted.iter().map(|vehicle| vehicle.vehicle.as_str()).collect();
    let others: Vec<&str> = vehicles.keys().map(String::as_str).filter(|name| !named.contains(name)).collect();
    if !others.is_empty() {
        return Err(LabError::Data(format!(
            "{} vehicles are not in the manifest: {}",
            others.len(),
            first_names(&others)
        )));
    }
    Ok(())
}

fn first_names(names: &[&str]) -> String {
    let shown: usize = 8;
    let more = if names.len() > shown { ", ..." } else { "" };
    names[..names.len().min(shown)].join(", ") + more
}
