//! `packwatch look`: from logs to a verdict in one command.
//!
//! The command finds the battery's signals in the logs, writes the configuration that follows, checks the wiring, and
//! replays the logs into a report. If the logs and the label leave a question open, the command asks it and says which
//! option answers it. The exit code is 0 if a report was written, and 1 otherwise.

use std::path::{Path, PathBuf};

use packwatch_host::failure::Failure;

use super::common::logs::{CsvSign, InputArgs, channel};
use super::common::numbers::integer;
use super::common::output::{failure, print};
use super::discover::{self, Positive};
use super::{doctor, report};
use crate::io::result_file::check_place;
use crate::lab::discover::{Candidate, Discovery};
use crate::lab::report::Verdict;
use crate::replay::SLEEP_GAP_S;
use crate::wiring::Severity;
use crate::wiring::evidence::PackQuantity;

/// Maximum number of lines about one subject. The report and the other commands have all of them.
const MAX_SHOWN: usize = 8;
/// Column where the text of a line begins.
const INDENT: usize = 14;

/// Arguments of `look`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Finds the battery's signals (as `discover` does), writes the configuration that follows, checks the wiring (as `doctor` does) and writes a \
report (as `report` does). If something is not known, the command asks for it.")]
pub(crate) struct Args {
    /// Logs of one battery in any known format, read in this order
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// DBC file that describes the frames; repeat for several
    #[arg(long = "dbc", value_name = "FILE.dbc")]
    dbc: Vec<PathBuf>,
    /// OBDb signal set of the car model, which describes its diagnostic answers
    #[arg(long, value_name = "FILE.json")]
    obdb: Option<PathBuf>,
    /// Model year, selects commands of the OBDb signal set
    #[arg(long, value_name = "YEAR", requires = "obdb", value_parser = integer::<i64>(1980, 2100))]
    year: Option<i64>,
    /// What the label states: chemistry, rated capacity and cells in series, for example nmc:64Ah:98s. Each part may be left out
    #[arg(long, value_name = "LABEL")]
    label: Option<PackLabel>,
    /// Cell model instead of the label's chemistry and capacity
    #[arg(long, value_name = "CELL.toml")]
    model: Option<PathBuf>,
    /// Meaning of a positive current; needed if the logs do not show it
    #[arg(long, value_enum)]
    positive: Option<Positive>,
    /// Read a channel or interface of a log as this interface, as for `replay`
    #[arg(long = "channel", value_name = "CHANNEL=INTERFACE", value_parser = channel)]
    channels: Vec<(String, String)>,
    /// Keep the configuration in this file. If the file exists and was edited, it is used and not changed
    #[arg(long, value_name = "PACK.toml")]
    write: Option<PathBuf>,
    /// Report to write
    #[arg(short, long, value_name = "FILE.html", default_value = "report.html")]
    out: PathBuf,
}

/// Runs the command.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let inputs = args.files.iter().chain(&args.dbc).chain(&args.obdb).chain(&args.model);
    check_place(&args.out, inputs.clone().chain(&args.write)).map_err(Failure::new)?;
    let folder = tempfile::tempdir().map_err(failure)?;
    let config = args.write.clone().unwrap_or_else(|| folder.path().join("pack.toml"));
    let found = discover::search(&args.search())?;
    print(&lines("log", found.inputs()))?;
    print(&lines("signals", signals(&found.discovery)))?;
    let written = discover::configure(&found, &args.settings(), &config)?;
    print(&lines("configuration", written.lines()))?;
    print(&lines("wiring", wiring(args, &config)?))?;
    let verdict = report::write(&args.report(config))?;
    print(&battery(&verdict))?;
    print(&lines("report", vec![args.out.display().to_string()]))
}
