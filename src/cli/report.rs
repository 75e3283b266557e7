//! `packwatch report`: writes an HTML page on the condition and history of a battery, from a store or a replay.

use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use super::common::cell_model::cell_model;
use super::common::logs::InputArgs;
use super::common::output::{create_folder, failure, unless_closed};
use super::common::replaying::{self, Replayed};
use packwatch_host::failure::Failure;

use crate::config::{self, Config, ConfigFiles, VehicleIdentity};
use crate::io::result_file::check_place;
use crate::lab;
use crate::lab::report::{self, Data, Origin, PageContext, Verdict};
use crate::monitor::Snapshot;
use crate::replay::{OutputWatch, ReplaySummary, Sinks};
use crate::store::HistoryReader;
use packwatch_host::bounded_file;

/// Arguments of `report`.
#[derive(Debug, clap::Args)]
#[command(override_usage = "packwatch report [OPTIONS] --config <FILE> <LOG>...\n       \
    packwatch report [OPTIONS] --state <DIR> [--config <FILE>]")]
pub(crate) struct Args {
    /// Configuration file. Optional with --state; then it adds limits and the rated capacity
    #[arg(short, long, value_name = "FILE", required_unless_present = "state")]
    pub(crate) config: Option<PathBuf>,
    /// Journals, candump logs or CSV files to replay, also .gz or .zst, read in this order as one record; - reads standard input
    #[arg(value_name = "LOG", required_unless_present = "state", conflicts_with = "state")]
    pub(crate) logs: Vec<PathBuf>,
    /// Folder of state and history to report on instead of logs; a running daemon may use it
    #[arg(long, value_name = "DIR")]
    pub(crate) state: Option<PathBuf>,
    /// HTML file to write; - writes standard output
    #[arg(short, long, value_name = "FILE.html", default_value = "report.html")]
    pub(crate) out: PathBuf,
    /// Also write every plot as SVG into this folder
    #[arg(long, value_name = "DIR")]
    pub(crate) plots: Option<PathBuf>,
    /// True values to show next to the estimates: CSV (.gz, .zst) with capacity_ah or capacity_ah_source (Ah), soc
    /// (fraction), or both, and the time in the clock of the data: time_s (s), or start or date (such as
    /// 2008-04-02T13:08:17, UTC). If the file has a column cell (such as the truth of `simulate`), its capacities are
    /// charges from full to empty; otherwise they were measured under load
    #[arg(long, value_name = "TABLE.csv")]
    pub(crate) reference: Option<PathBuf>,
    /// Title of the page [default: vehicle, else name of the log or folder]
    #[arg(long)]
    pub(crate) title: Option<String>,
    #[command(flatten)]
    pub(crate) input: InputArgs,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    write(args).map(drop)
}

/// Writes the page, and the plots if they are wanted. Returns the verdict at the top of the page.
pub(crate) fn write(args: &Args) -> Result<Verdict, Failure> {
    args.check()?;
    let config = args.config.as_deref().map(config::load).transpose()?;
    let config_text = args.config.as_deref().map(config_text).transpose();
    let reference = args.reference.as_deref().map(report::read_reference).transpose();
    let reference = reference.map_err(failure)?;
    let (data, provenance, vehicle, snapshot) = match (&args.state, &config) {
        (Some(folder), _) => load_store(folder)?,
        (None, Some(config)) => replay_logs(args, config)?,
        (None, None) => return Err(Failure::new("give --state DIR, or --config FILE and logs")),
    };
    let mut provenance = provenance;
    provenance.extend(vehicle.is_stated().then(|| ("Vehicle".to_owned(), vehicle.to_string())));
    provenance.extend(args.config.iter().map(|path| ("Configuration".to_owned(), path.display().to_string())));
    provenance.extend(args.reference.iter().map(|path| ("Reference".to_owned(), path.display().to_string())));
    let context = PageContext {
        title: args.title(&vehicle),
        config: config.as_ref(),
        model: cell_model(snapshot.as_ref(), config.as_ref())?,
        config_text: config_text?,
        diagnosis: snapshot.as_ref().and_then(Snapshot::diagnosis),
        imbalance: snapshot.as_ref().and_then(Snapshot::imbalance),
        use_record: snapshot.as_ref().map(|snapshot| *snapshot.use_record()),
        reference: reference.unwrap_or_default(),
        provenance,
    };
    unless_closed(lab::write_file(&args.out, report::page(&data, &context).as_bytes()))?;
    if let Some(folder) = &args.plots {
        create_folder(folder)?;
        report::write_plots(folder, &data, &context).map_err(failure)?;
    }
    Ok(Verdict::of(&data, &context))
}

/// The page of the store in `folder`.
pub(crate) fn page_of_store(folder: &Path) -> Result<String, String> {
    let text = |failure: Failure| failure.message;
    let (data, provenance, vehicle, snapshot) = load_store(folder).map_err(text)?;
    let title = if vehicle.is_stated() { vehicle.to_string() } else { "Battery".to_owned() };
    let model = cell_model(snapshot.as_ref(), None).map_err(text)?;
    let diagnosis = snapshot.as_ref().and_then(Snapshot::diagnosis);
    let imbalance = snapshot.as_ref().and_then(Snapshot::imbalance);
    let use_record = snapshot.as_ref().map(|snapshot| *snapshot.use_record());
    let context = PageContext { title, model, diagnosis, imbalance, use_record, provenance, ..PageContext::default() };
    Ok(report::page(&data, &context))
}

/// Text of the configuration, merged with its drop-ins.
fn config_text(path: &Path) -> Result<String, Failure> {
    match ConfigFiles::find(path)?.drop_ins.is_empty() {
        true => bounded_file::read_text(path).map_err(failure),
        false => Ok(config::merged(path)?),
    }
}

impl Args {
    fn check(&self) -> Result<(), Failure> {
        let inputs = self.logs.iter().chain(&self.config).chain(&self.reference);
        check_place(&self.out, inputs).map_err(Failure::new)
    }

    fn title(&self, vehicle: &VehicleIdentity) -> String {
        if let (None, true) = (&self.title, vehicle.is_stated()) {
            return vehicle.to_string();
        }
        let of = self.state.as_ref().or(self.logs.first());
        let name = of.and_then(|path| path.file_name()).map(|name| name.to_string_lossy().into_owned());
        let more = if self.logs.len() > 1 { format!(" and {} more", self.logs.len() - 1) } else { String::new() };
        self.title.clone().unwrap_or_else(|| name.unwrap_or_else(|| "Battery".to_owned()) + &more)
    }
}

/// What a report is made from: data, provenance, vehicle and last state.
type ReportInput = (Data, Provenance, VehicleIdentity, Option<Snapshot>);

type Provenance = Vec<(String, String)>;

fn load_store(folder: &Path) -> Result<ReportInput, Failure> {
    let reader = HistoryReader::open(folder).map_err(Failure::new)?;
    let vehicle = reader.vehicle().map_err(Failure::new)?;
    let mut data = Data::of_store(&reader).map_err(Failure::new)?;
    let verdict = reader.verify().map_err(Failure::new)?;
    if let Some(broken) = &verdict.broken {
        data.doubt(format!("the history was changed: {broken}"));
    }
    let chain = match &verdict.broken {
        None => format!("{} rows, all as they were written; the last has the hash {}", verdict.rows, verdict.head),
        Some(broken) => format!(
            "{broken}: expected hash {}, found {}; the {} rows before them are intact",
            broken.expected, broken.found, verdict.good_rows
        ),
    };
    let provenance = vec![("History".to_owned(), folder.display().to_string()), ("Hash chain".to_owned(), chain)];
    Ok((data, provenance, vehicle, reader.snapshot()))
}

fn replay_logs(args: &Args, config: &Config) -> Result<ReportInput, Failure> {
    let data = Rc::new(RefCell::new(Data::new(Origin::Replay)));
    let watched = Rc::clone(&data);
    let watch: OutputWatch = Box::new(move |_, out| {
        let mut data = watched.borrow_mut();
        out.estimates.iter().for_each(|estimate| data.take_estimate(estimate));
        out.events.iter().for_each(|event| data.take_event(event));
    });
    let sinks = Sinks { watch: Some(watch), ..Sinks::default() };
    let Replayed { summary, snapshot, .. } = replaying::replay(&args.logs, &args.input, config, sinks)?;
    // The closure that shared the data was dropped with the replay.
    let mut data = Rc::try_unwrap(data).map_err(|_| Failure::new("the replay still holds its data"))?.into_inner();
    data.set_current_offset(summary.current_offset_a.zip(summary.current_offset_std_a));
    Ok((data, provenance(args, &summary), config.vehicle.clone(), snapshot))
}

fn provenance(args: &Args, summary: &ReplaySummary) -> Provenance {
    let mut lines: Provenance =
        args.logs.iter().map(|log| ("Replayed log".to_owned(), log.display().to_string())).collect();
    lines.push(("Frames used".to_owned(), summary.log.frames.to_string()));
    lines.push(("Bad readings of signals that later recovered".to_owned(), summary.bad_readings.to_string()));
    lines.extend(summary.notes.iter().map(|note| ("Note".to_owned(), note.clone())));
    lines
}
