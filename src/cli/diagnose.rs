//! `packwatch diagnose`: finds failing cells. Reports findings with advice, and each cell's difference from the median
//! of the pack.
//!
//! Input: logs, which are replayed, or the stored state of a vehicle. Every "±" is one standard deviation.

mod pack;

use std::path::PathBuf;

use serde::Serialize;

use super::common::cell_model::cell_model;
use super::common::logs::InputArgs;
use super::common::output::{self, create_folder, failure, print_json, table};
use super::common::replaying;
use crate::cell_faults::difference::{CAPACITY, CHANNEL, CONTACT, LEAK, RESISTANCE, SOC};
use crate::cell_faults::{CellFault, CellFaultDetector, CellFaultKind, UnknownImbalance};
use crate::config::{self, Config};
use crate::filter::ScalarGaussian;
use crate::io::stamp::format_utc;
use crate::lab::{self, chart, pack_view};
use crate::monitor::Snapshot;
use crate::quantity::CellIndex;
use crate::replay::Sinks;
use crate::store::HistoryReader;
use pack::PackPage;
use packwatch_host::failure::Failure;

/// Arguments of `diagnose`.
#[derive(Debug, clap::Args)]
#[command(override_usage = "packwatch diagnose [OPTIONS] --config <FILE> <LOG>...\n       \
    packwatch diagnose [OPTIONS] --state <DIR>")]
pub(crate) struct Args {
    /// Journals, candump logs or CSV files of one pack, also .gz or .zst; read in this order as one record
    #[arg(required_unless_present = "state", value_name = "LOG")]
    logs: Vec<PathBuf>,
    /// Configuration file; required with logs
    #[arg(short, long, value_name = "FILE", required_unless_present = "state")]
    config: Option<PathBuf>,
    /// State folder of a vehicle, or a copy of it, to diagnose instead of logs
    #[arg(long, value_name = "DIR", conflicts_with_all = ["logs", "config"])]
    state: Option<PathBuf>,
    #[command(flatten)]
    input: InputArgs,
    /// Write SVG plots into this folder, one per quantity (SOC, capacity, resistance, leak, ...); each shows how far each
    /// cell is from the middle of the pack
    #[arg(long, value_name = "DIR")]
    plots: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Page {
    version: u32,
    findings: Vec<FindingRow>,
    pack: PackPage,
    cells: Vec<CellRow>,
}

/// A finding; cells count from 1.
#[derive(Debug, Serialize)]
struct FindingRow {
    kind: CellFaultKind,
    first_cell: Option<u16>,
    last_cell: Option<u16>,
    what: &'static str,
    size: f64,
    size_std: f64,
    since: String,
    reported: String,
    probability: f64,
    advice: &'static str,
}

/// Differences of a cell from the median of the pack. Unknown values are `null`.
#[derive(Debug, Serialize)]
struct CellRow {
    cell: u16,
    soc: Option<Value>,
    capacity: Option<Value>,
    resistance: Option<Value>,
    contact: Option<Value>,
    channel_v: Option<Value>,
    leak_per_day: Option<Value>,
}

#[derive(Debug, Clone, Copy, Serialize)]
struct Value {
    mean: f64,
    std: f64,
}

impl From<ScalarGaussian> for Value {
    fn from(value: ScalarGaussian) -> Self {
        Self { mean: value.mean, std: value.std() }
    }
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let config = args.config.as_deref().map(config::load).transpose()?;
    let snapshot = match (&args.state, &config) {
        (Some(folder), _) => stored(folder)?,
        (None, Some(config)) => replayed(args, config)?,
        (None, None) => return Err(Failure::new("give --state DIR, or --config FILE and logs")),
    };
    let Some(diagnosis) = snapshot.diagnosis() else {
        return Err(Failure::new(match (&args.config, &config) {
            (Some(file), Some(config)) => format!(
                "no cell can be compared: {} gives the voltages of {} cells, must be at least 3",
                file.display(),
                config.monitor.sample.cells
            ),
            _ => "no cell can be compared: the pack has fewer than 3 cells with their own voltage, or an older version of \
                packwatch wrote the state"
                .to_owned(),
        }));
    };
    if let Some(folder) = &args.plots {
        create_folder(folder)?;
        chart::write_each(folder, &lab::cell_fault_pictures::all(diagnosis)).map_err(failure)?;
    }
    let imbalance = snapshot.imbalance().unwrap_or(Err(UnknownImbalance::NotCompared));
    let model = cell_model(Some(&snapshot), config.as_ref())?.map(|sourced| sourced.model);
    let page = page(diagnosis, PackPage::new(&imbalance, model.as_ref()));
    if args.json {
        return output::unless_closed(print_json(&page));
    }
    output::print(&text(diagnosis, pack_view::lines(&imbalance, model.as_ref()), &page))
}

fn stored(folder: &std::path::Path) -> Result<Snapshot, Failure> {
    HistoryReader::open(folder).and_then(|reader| reader.required_snapshot()).map_err(Failure::new)
}

fn replayed(args: &Args, config: &Config) -> Result<Snapshot, Failure> {
    let replayed = replaying::replay(&args.logs, &args.input, config, Sinks::default())?;
    replayed
        .snapshot
        .ok_or_else(|| Failure::new("the logs have no readings; check the configuration with `packwatch doctor`"))
}

fn page(diagnosis: &CellFaultDetector, pack: PackPage) -> Page {
    let number = |cell: CellIndex| cell.0 + 1;
    let row = |found: &CellFault| FindingRow {
        kind: found.kind,
        first_cell: found.cells.map(|(first, _)| number(first)),
        last_cell: found.cells.map(|(_, last)| number(last)),
        what: found.kind.words(),
        size: found.size.mean,
        size_std: found.size.std(),
        since: format_utc(found.since),
        reported: format_utc(found.reported),
        probability: found.probability,
        advice: found.kind.advice(),
    };
    let cells = (0..).map(CellIndex).map_while(|cell| {
        let states = diagnosis.relative(cell)?;
        let value = |state: usize| states[state].map(Value::from);
        Some(CellRow {
            cell: number(cell),
            soc: value(SOC),
            capacity: value(CAPACITY),
            resistance: value(RESISTANCE),
            contact: value(CONTACT),
            channel_v: value(CHANNEL),
            leak_per_day: value(LEAK),
        })
    });
    Page { version: 1, findings: diagnosis.findings().iter().map(row).collect(), pack, cells: cells.collect() }
}

fn text(diagnosis: &CellFaultDetector, pack: Vec<(String, String)>, page: &Page) -> String {
    let mut text = String::new();
    if diagnosis.findings().is_empty() {
        text += "nothing found\n";
    }
    for found in diagnosis.findings() {
        text += &format!("{found}, since {}\n    {}\n", format_utc(found.since), found.kind.advice());
    }
    text += "\npack\n";
    text += &table::<&str>(&[], pack.into_iter().map(|(name, value)| vec![name, value]), 2);
    text += "\ndifference from the middle of the pack\n";
    let shown = |value: Option<Value>, scale: f64, digits: usize| {
        value.map_or_else(|| "-".to_owned(), |it| with_deviation(scale * it.mean, scale * it.std, digits))
    };
    let rows = page.cells.iter().map(|cell| {
        vec![
            cell.cell.to_string(),
            shown(cell.soc, 100.0, 1),
            shown(cell.capacity, 100.0, 1),
            shown(cell.resistance, 100.0, 1),
            shown(cell.contact, 100.0, 1),
            shown(cell.channel_v, 1e3, 1),
            shown(cell.leak_per_day, 100.0, 2),
        ]
    });
    let heads = ["cell", "SOC, points", "capacity, %", "resistance, %", "contact, %", "channel, mV", "leak, %/day"];
    text + &table(&heads, rows, 0)
}

/// Formats a value with its sign and its standard deviation. Zero gets a plus sign.
fn with_deviation(mean: f64, std: f64, digits: usize) -> String {
    let scale = 10f64.powi(i32::try_from(digits).unwrap_or(0));
    format!("{:+.digits$} ± {std:.digits$}", (mean * scale).round() / scale + 0.0)
}
