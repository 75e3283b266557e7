//! `packwatch look`: from logs to a verdict in one command.
//!
//! Finds the battery's signals in the logs, makes a configuration from them, checks the wiring, and replays the logs
//! into a report. For a table of samples, no signals are searched: the label describes the battery. If the logs and the
//! label leave a question open, the command prints the question and the option that answers it. The exit code is 0 if a
//! report was written, and 1 otherwise.

mod table;

use std::path::{Path, PathBuf};

use packwatch_host::failure::Failure;

use super::common::logs::{CsvSign, InputArgs, channel, charge_positive, column};
use super::common::output::{failure, named, print, word};
use super::discover::{self, Known, Positive, Search};
use super::{doctor, report};
use crate::io::log::LogCounts;
use crate::io::result_file::check_place;
use crate::lab::discover::PackConfiguration;
use crate::lab::report::Verdict;
use crate::replay::LogReading;
use crate::wiring::evidence::PackQuantity;
use crate::wiring::{Severity, WiringReport};
use table::PackTable;

/// Maximum number of lines about one subject. The report and the other commands have all of them.
const MAX_SHOWN: usize = 8;
/// Column where the text of a line begins.
const INDENT: usize = 15;

/// Arguments of `look`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Finds the battery's signals like `discover`, makes the configuration that follows, checks the wiring like `doctor` and writes a report \
like `report`. If something is not known, the command asks for it and writes no report.")]
pub(crate) struct Args {
    /// CAN logs or tables of one battery in any known format, also .gz or .zst, read in this order
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    #[command(flatten)]
    known: Known,
    /// Read a channel or interface of a log as this interface, as for `replay`
    #[arg(long = "channel", value_name = "CHANNEL=INTERFACE", value_parser = channel)]
    channels: Vec<(String, String)>,
    /// Name a column of a table, as for `replay`
    #[arg(long = "column", value_name = "ROLE=NAME", value_parser = column)]
    columns: Vec<(String, String)>,
    /// Keep the configuration in this file, and the fields that no DBC describes in PACK.dbc. If the file exists, it is used
    /// and not changed
    #[arg(long, value_name = "PACK.toml")]
    write: Option<PathBuf>,
    /// HTML report to write
    #[arg(short, long, value_name = "FILE.html", default_value = "report.html")]
    out: PathBuf,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let inputs = || discover::inputs(&args.files, &args.known);
    args.write.iter().try_for_each(|write| check_place(write, inputs())).map_err(Failure::new)?;
    check_place(&args.out, inputs().chain(&args.write)).map_err(Failure::new)?;
    if let Some(file) = args.files.iter().find(|file| *file == Path::new("-") || file.exists() && !file.is_file()) {
        return Err(named(file, "must be a file, because `look` reads its logs several times"));
    }
    let folder = tempfile::tempdir().map_err(failure)?;
    let config = args.write.clone().unwrap_or_else(|| folder.path().join("pack.toml"));
    let lines = if let Some(table) = PackTable::read(args)? {
        print(&section("table", table.reading.to_string().split("; ").map(str::to_owned).collect()))?;
        configure(args, &config, || table.configuration(args, &config))?
    } else {
        let search = discover::search(&args.files, &args.known, args.channels.clone())?;
        print(&section("log", logs(args, &search)))?;
        print(&section("signals", signals(&search)))?;
        configure(args, &config, || {
            let open =
                |questions| Failure::new(format!("please answer, so that the battery can be judged:\n{questions}"));
            search.configuration(&args.files[0], &args.known, &config)?.map_err(open)
        })?
    };
    print(&section("configuration", lines))?;
    let (survey, counts) = doctor::judge(&config, &args.files, &args.reading())?;
    if !counts.tables.is_empty() {
        print(&section("rows", damage(&counts)))?;
    }
    print(&section("wiring", wiring(&survey)))?;
    let page = report::Args {
        config: Some(config),
        logs: args.files.clone(),
        out: args.out.clone(),
        input: InputArgs {
            channels: args.channels.clone(),
            columns: args.columns.clone(),
            csv_sign: args.csv_sign(),
            ..InputArgs::default()
        },
        state: None,
        plots: None,
        reference: None,
        title: None,
    };
    print(&battery(&report::write(&page)?))?;
    print(&section("report", vec![args.out.display().to_string()]))
}

impl Args {
    fn reading(&self) -> LogReading {
        LogReading {
            channels: self.channels.clone(),
            columns: self.columns.clone(),
            charge_positive: charge_positive(self.csv_sign()),
            ..LogReading::default()
        }
    }

    fn csv_sign(&self) -> Option<CsvSign> {
        self.known.positive.map(|positive| match positive {
            Positive::Charge => CsvSign::Charge,
            Positive::Discharge => CsvSign::Discharge,
        })
    }
}

/// Formats lines under a heading in the first column.
fn section(heading: &str, lines: Vec<String>) -> String {
    let mut text = String::new();
    for (n, line) in lines.iter().enumerate() {
        text += &format!("{:INDENT$}{line}\n", if n == 0 { heading } else { "" });
    }
    text
}

fn logs(args: &Args, search: &Search) -> Vec<String> {
    let (counts, discovery) = (&search.counts, &search.discovery);
    let mut lines = counts.inputs.clone();
    if lines.is_empty() {
        lines = args.files.iter().map(|file| format!("{}: candump log or journal", file.display())).collect();
    }
    let interfaces = search.interfaces().join(", ");
    lines.push(format!("{} frames in {:.0} s on {interfaces}", discovery.frames, discovery.seconds));
    lines.extend(damage(counts));
    lines
}

/// Describes faults in the lines of the logs.
fn damage(counts: &LogCounts) -> Vec<String> {
    let bad = counts.first_bad_line.iter().map(|first| format!("{} bad lines, first {first}", counts.bad_lines));
    let back = counts.first_time_backwards.iter();
    bad.chain(back.map(|first| format!("{} stamps backwards, first {first}", counts.time_backwards))).collect()
}

fn signals(search: &Search) -> Vec<String> {
    let best = |quantity: PackQuantity| {
        let found = search.discovery.candidates.iter().find(|candidate| candidate.quantity == quantity);
        let found = found.map_or_else(
            || "not found".to_owned(),
            |found| format!("{} on {}: {}", found.signal, found.interface, discover::values(found)),
        );
        format!("{:17}{found}", quantity.name())
    };
    PackQuantity::ALL.into_iter().map(best).chain(search.discovery.remarks.iter().cloned()).collect()
}

/// Writes the configuration unless the file exists. Returns lines about its contents, or the open questions.
fn configure(
    args: &Args,
    file: &Path,
    make: impl FnOnce() -> Result<PackConfiguration, Failure>,
) -> Result<Vec<String>, Failure> {
    let name = file.display();
    if args.write.is_some() && file.exists() {
        let ignored = if args.known.has_answers() { "; --label, --model and --positive are not used" } else { "" };
        return Ok(vec![format!("{name} exists, so it is used as it is{ignored}")]);
    }
    let pack = make()?;
    let own = file.with_extension("dbc");
    if pack.database.is_some() && own.exists() {
        let advice = "exists and would be replaced; give it with --dbc, or give --write another name";
        return Err(named(&own, advice));
    }
    let own = discover::save(&pack, file, discover::inputs(&args.files, &args.known))?;
    let mut lines = match &args.write {
        Some(_) => own.iter().chain([&file.to_owned()]).map(|file| format!("{} written", file.display())).collect(),
        None => vec!["made for this run; --write PACK.toml keeps it".to_owned()],
    };
    lines.extend(pack.open.iter().map(|question| format!("please check: {question}")));
    Ok(lines)
}

/// Errors and warnings about the wiring, with the advice.
fn wiring(report: &WiringReport) -> Vec<String> {
    let findings = report.findings.iter().filter(|finding| finding.severity != Severity::Note);
    let mut lines: Vec<String> = findings
        .map(|finding| {
            let advice = finding.advice.as_ref().map_or_else(String::new, |advice| format!("; {advice}"));
            format!("{}: {}: {}{advice}", word(finding.severity), finding.title, finding.seen)
        })
        .collect();
    if lines.is_empty() {
        lines.push("no faults found in what could be judged".to_owned());
        lines.extend(report.unjudged.iter().take(MAX_SHOWN).map(|what| format!("not judged: {what}")));
    }
    shortened(lines)
}

fn battery(verdict: &Verdict) -> String {
    let pairs = |pairs: &[(&str, String)]| pairs.iter().map(|(name, value)| format!("{name}: {value}")).collect();
    section("battery", shortened(verdict.problems.clone()))
        + &section("known", pairs(&verdict.known))
        + &section("not known", pairs(&verdict.unknown))
}

fn shortened(mut lines: Vec<String>) -> Vec<String> {
    let more = lines.len().saturating_sub(MAX_SHOWN);
    if more > 0 {
        lines.truncate(MAX_SHOWN);
        lines.push(format!("... and {more} more"));
    }
    lines
}
