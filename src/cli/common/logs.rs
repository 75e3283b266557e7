//! Arguments shared by the commands that read logs.

use std::path::PathBuf;

use super::numbers::positive;
use super::output::note;
use crate::config::Config;
#[cfg(feature = "lab")]
use crate::io::csv_log::CsvOptions;
use crate::io::csv_log::TableReading;
use crate::io::log::LogOptions;
use crate::monitor::MonitorConfig;
use crate::replay::{self, LogReading};

/// Direction of positive current in a CSV.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum CsvSign {
    /// Positive is discharge
    Discharge,
    /// Positive is charge
    Charge,
}

/// Options for reading logs.
#[derive(Debug, Default, clap::Args)]
pub(crate) struct InputArgs {
    /// Stop with an error at the first line that cannot be read
    #[arg(long)]
    pub(crate) strict: bool,
    /// Count a gap longer than this as sleep of the recorder: during the gap, nothing is computed and no frame is made
    /// [default: the largest max_age_s of current and voltages, at least 30]
    #[arg(long, value_name = "SECONDS", value_parser = positive)]
    pub(crate) sleep_gap: Option<f64>,
    /// Read a channel or interface of a log as this interface, for example 2=can0. CHANNEL is written as in the log. By
    /// default, numbered channels are the configured interfaces in their order
    #[arg(long = "channel", value_name = "CHANNEL=INTERFACE", value_parser = channel)]
    pub(crate) channels: Vec<(String, String)>,
    /// Name a CSV column, for example current=Current(A). ROLE is time, current, voltage, temperature, state or section. If
    /// the header has no unit or a wrong one, write the unit after the name: 'current=I[mA]'. If
    /// each cell or sensor has its own column (U1, U2, ..., counted from 1), one --column names them all: in NAME, replace
    /// the number by the letter n in braces; append the same letter in braces to ROLE. An empty NAME means that the
    /// column does not exist
    #[arg(long = "column", value_name = "ROLE=NAME", value_parser = column)]
    pub(crate) columns: Vec<(String, String)>,
    /// Direction of positive current in a CSV [default: derived from the state column, the file format or the voltage]
    #[arg(long, value_enum)]
    pub(crate) csv_sign: Option<CsvSign>,
    /// CSV table that gives the start time of each section of a CSV log. The table has two columns: the log's section
    /// column, for example `cycle`, and `start`
    #[arg(long, value_name = "TABLE.csv")]
    pub(crate) start_times: Option<PathBuf>,
}

impl InputArgs {
    /// Gap that counts as sleep of the recorder (s).
    pub(crate) fn sleep_gap_s(&self, config: &MonitorConfig) -> f64 {
        self.sleep_gap.unwrap_or_else(|| replay::sleep_gap_s(config))
    }
}

/// Returns the options for reading logs with a configuration.
pub(crate) fn log_options(args: &InputArgs, config: &Config) -> LogOptions {
    let reading = LogReading {
        strict: args.strict,
        channels: args.channels.clone(),
        columns: args.columns.clone(),
        charge_positive: charge_positive(args.csv_sign),
        start_times: args.start_times.clone(),
    };
    reading.options(config)
}

pub(crate) fn channel(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((channel, interface)) if !channel.is_empty() && !interface.is_empty() => {
            Ok((channel.to_owned(), interface.to_owned()))
        }
        _ => Err("must be CHANNEL=INTERFACE, for example 2=can0".to_owned()),
    }
}

/// Whether a positive current is a charge; `None` = the file decides.
pub(crate) fn charge_positive(sign: Option<CsvSign>) -> Option<bool> {
    sign.map(|sign| sign == CsvSign::Charge)
}

/// Columns and sign of the measured files of one cell.
#[cfg(feature = "lab")]
pub(crate) fn table_options(args: &InputArgs) -> CsvOptions {
    let charge_positive = charge_positive(args.csv_sign);
    CsvOptions { columns: args.columns.clone(), charge_positive, ..CsvOptions::default() }
}

/// Prints what was read of each table, one line per table.
pub(crate) fn print_tables(tables: &[TableReading]) {
    tables.iter().for_each(note);
}

pub(crate) fn column(text: &str) -> Result<(String, String), String> {
    const ROLES: [&str; 8] =
        ["time", "current", "voltage", "voltage{n}", "temperature", "temperature{n}", "state", "section"];
    let (role, name) = text.split_once('=').ok_or("must be ROLE=NAME, for example current=Current(A)")?;
    if !ROLES.contains(&role) {
        return Err(format!("unknown role {role:?}, must be one of {}", ROLES.join(", ")));
    }
    if role.ends_with("{n}") != name.contains("{n}") {
        return Err("{n} must be in both ROLE and NAME, or in neither".to_owned());
    }
    Ok((role.to_owned(), name.to_owned()))
}
