//! `packwatch passport`: writes a battery passport as JSON. The passport merges values that packwatch measured (from a
//! store or a replay) with values that the manufacturer states in a file.

use std::cell::RefCell;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use serde::Serialize as _;
use serde_json::{Map, Value};

use super::common::cell_model::cell_model;
use super::common::logs::InputArgs;
use super::common::numbers::{NamedValue, above_0, one_of, within};
use super::common::output::{failure, named, unless_closed};
use super::common::replaying::{self, Replayed};
use crate::config::{self, Config, VehicleIdentity};
use crate::io::json::json_fault;
use crate::io::result_file::check_place;
use crate::lab;
use crate::lab::passport::{self, Condition, ReadingLimits, Record, Standard, Terms};
use crate::replay::{OutputSink, Sinks};
use crate::store::HistoryReader;
use packwatch_host::failure::Failure;

/// Maximum size of the file with the manufacturer's part, bytes. A passport has about 10 kB.
const MAX_STATIC_BYTES: u64 = 16 << 20;

const STANDARDS: [NamedValue<Standard>; 2] = [
    (
        "product-condition",
        Standard::ProductCondition,
        "IDTA 02035-5, Digital Battery Passport, Part 5: Product Condition 1.0.1",
    ),
    ("battery-pass", Standard::BatteryPass, "Catena-X io.catenax.battery.battery_pass 6.0.0"),
];

/// Arguments of `passport`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Unknown values are left out. If the standard requires an unknown value, nothing is written; the error lists \
    each missing value with the reason and a remedy. The static part may state everything that packwatch does not \
    measure; a value that both parts have is an error.",
    override_usage = "packwatch passport [OPTIONS] --config <FILE> <LOG>...\n       \
    packwatch passport [OPTIONS] --config <FILE> --state <DIR>\n       \
    packwatch passport [--form <STANDARD>] --static-template"
)]
pub(crate) struct Args {
    /// Configuration file of the pack
    #[arg(short, long, value_name = "FILE", required_unless_present = "static_template")]
    config: Option<PathBuf>,
    /// Journals, candump logs or CSV files of the battery's whole life, also .gz or .zst; read in this order as one
    /// record
    #[arg(value_name = "LOG", required_unless_present_any = ["state", "static_template"], conflicts_with = "state")]
    logs: Vec<PathBuf>,
    /// Folder of state and history to use instead of logs; a running daemon may use it
    #[arg(long, value_name = "DIR")]
    state: Option<PathBuf>,
    /// Standard of the passport
    #[arg(long, value_name = "STANDARD", value_parser = one_of(&STANDARDS), default_value = "product-condition")]
    form: Standard,
    /// Manufacturer's part in the form of the standard: what cannot be measured, such as manufacturer, materials,
    /// accidents
    #[arg(long = "static", value_name = "FILE.json")]
    manufacturer: Option<PathBuf>,
    /// Write an empty manufacturer's part: fill in the known values, leave the others null, and pass the file with
    /// --static
    #[arg(long, conflicts_with_all = ["config", "logs", "state", "manufacturer", "details"])]
    static_template: bool,
    /// Usable energy of the pack at certification (kWh); needed for the state of certified energy (SOCE)
    #[arg(long, value_name = "KWH", value_parser = above_0)]
    certified_energy_kwh: Option<f64>,
    /// Charge throughput (charge plus discharge) before the record began (Ah); 0 if the battery was recorded from new
    #[arg(long, value_name = "AH", value_parser = at_least_0)]
    throughput_before_ah: Option<f64>,
    /// Total charge throughput (charge plus discharge) from the pack's own counter (Ah); replaces the sum of the record
    #[arg(long, value_name = "AH", value_parser = at_least_0, conflicts_with = "throughput_before_ah")]
    throughput_ah: Option<f64>,
    /// Passport file to write; - writes standard output
    #[arg(short, long, value_name = "FILE.json", default_value = "-")]
    out: PathBuf,
    /// Write standard deviation, unit and definition of each value, and the reasons for missing values, to this file
    #[arg(long, value_name = "FILE.json")]
    details: Option<PathBuf>,
    #[command(flatten)]
    input: InputArgs,
}

fn at_least_0(text: &str) -> Result<f64, String> {
    within(text, |value| value >= 0.0, "a finite number, 0 or more")
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    args.check()?;
    let Some(config) = &args.config else { return write(&args.out, &passport::template(args.form)) };
    let config = config::load(config)?;
    let manufacturer = args.manufacturer.as_deref().map(read_static).transpose()?;
    let manufacturer = manufacturer.and_then(passport::without_nulls);
    let manufacturer = manufacturer.unwrap_or_else(|| Value::Object(Map::new()));
    let (record, vehicle) = match &args.state {
        Some(folder) => load_store(folder, &config)?,
        None => (replay_logs(args, &config)?, config.vehicle.clone()),
    };
    let model =
        cell_model(record.snapshot(), Some(&config))?.map_or_else(|| config.monitor.model.clone(), |it| it.model);
    let condition = Condition::new(&record, &config, &model, &args.terms());
    let condition = condition.map_err(|error| match &args.state {
        Some(folder) => named(folder, error),
        None => Failure::new(error),
    })?;
    let document = passport::passport(args.form, &condition, manufacturer);
    let document = document.map_err(|faults| Failure::new(faults.join("\n")))?;
    if let Some(path) = &args.details {
        write(path, &passport::details(args.form, &condition, &vehicle))?;
    }
    write(&args.out, &document)
}

impl Args {
    fn check(&self) -> Result<(), Failure> {
        let inputs = || self.logs.iter().chain(&self.manufacturer).chain(&self.config);
        for out in self.details.iter().chain([&self.out]) {
            check_place(out, inputs()).map_err(Failure::new)?;
        }
        if self.details.as_ref() == Some(&self.out) {
            return Err(named(&self.out, "given for two results; each needs its own file"));
        }
        Ok(())
    }

    fn terms(&self) -> Terms {
        Terms {
            moved_before_ah: self.throughput_before_ah,
            moved_ah: self.throughput_ah,
            certified_kwh: self.certified_energy_kwh,
        }
    }
}

fn read_static(path: &Path) -> Result<Value, Failure> {
    let mut bytes = Vec::new();
    let unread = |error: std::io::Error| named(path, format!("cannot be read: {error}"));
    let file = File::open(path).map_err(unread)?;
    file.take(MAX_STATIC_BYTES + 1).read_to_end(&mut bytes).map_err(unread)?;
    if u64::try_from(bytes.len()).is_ok_and(|length| length > MAX_STATIC_BYTES) {
        return Err(named(path, format!("larger than {MAX_STATIC_BYTES} bytes")));
    }
    serde_json::from_slice(&bytes).map_err(|error| named(path, format!("not valid JSON: {}", json_fault(&error))))
}

fn load_store(folder: &Path, config: &Config) -> Result<(Record, VehicleIdentity), Failure> {
    let reader = HistoryReader::open(folder).map_err(Failure::new)?;
    let vehicle = reader.vehicle().map_err(Failure::new)?;
    if vehicle.is_stated() && config.vehicle.is_stated() && vehicle != config.vehicle {
        return Err(named(folder, format!("belongs to {vehicle}, but the configuration to {}", config.vehicle)));
    }
    let record = Record::of_store(&reader).map_err(|error| named(folder, error))?;
    Ok((record, vehicle))
}

fn replay_logs(args: &Args, config: &Config) -> Result<Record, Failure> {
    let record = Rc::new(RefCell::new(Record::of_replay(reading_limits(config))));
    let shared = Rc::clone(&record);
    let take: OutputSink = Box::new(move |out| shared.borrow_mut().take(out));
    let sinks = Sinks { outputs: Some(take), ..Sinks::default() };
    let Replayed { source, summary, snapshot } = replaying::replay(&args.logs, &args.input, config, sinks)?;
    if source.has_moved_stamps() {
        return Err(Failure::new(
            "a log begins before the end of the previous log, so its times are unknown; give the logs in their order, and only logs \
            that use the same clock",
        ));
    }
    let mut record = record.take();
    let deleted = summary.log.deleted_segments;
    if deleted > 0 {
        record.note_gap(format!("the first {deleted} segments of the journal are missing"));
    }
    if let Some(snapshot) = snapshot {
        record.finish(snapshot);
    }
    Ok(record)
}

fn reading_limits(config: &Config) -> ReadingLimits {
    let (sample, transition) = (&config.monitor.sample, &config.monitor.health.transition);
    ReadingLimits {
        current_age_s: sample.current.max_age_s,
        voltage_age_s: sample.voltage.max_age_s,
        rest_a: (transition.dead_band_a + transition.hysteresis_a) / f64::from(sample.strings),
    }
}

fn write(path: &Path, document: &Value) -> Result<(), Failure> {
    let mut bytes = Vec::new();
    document.serialize(&mut serde_json::Serializer::pretty(&mut bytes)).map_err(failure)?;
    bytes.push(b'\n');
    unless_closed(lab::write_file(path, &bytes))
}
