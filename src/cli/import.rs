//! `packwatch import`: converts signal lists of a car, or a BPX cell, to configuration files.
//!
//! If signals or commands of an OBDb signal set are left out, standard error shows how many for each reason, and the
//! written file lists them with their positions. The exit code is 1 if the file cannot be read, has another format, or
//! contains nothing that can be converted.

use std::path::{Path, PathBuf};

use super::common::files::{database, named_from, read};
use super::common::numbers::integer;
use super::common::output::{failure, note, unless_closed};
use crate::io::result_file::{check_place, write_file};
use crate::lab::import::ImportResult;
use crate::lab::import::bpx::{self, BpxSettings};
use crate::lab::import::dbc;
use crate::lab::import::obdb::{self, ObdbSettings};
use packwatch_host::failure::Failure;

/// Arguments of `import`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(subcommand)]
    what: ImportCommand,
}

#[derive(Debug, clap::Subcommand)]
enum ImportCommand {
    /// Convert an OBDb signal set (JSON) to [[input.diagnostic]] tables
    Obdb(ObdbArgs),
    /// Write the [input] tables for the likely battery signals of a DBC, chosen by name, unit and range
    Dbc(DbcArgs),
    /// Derive a cell model from the physical parameters of a BPX file (JSON)
    Bpx(BpxArgs),
}

/// Arguments of `import bpx`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
The open-circuit voltage follows from the two electrode potentials, the resistances from the parameters at small currents. Nothing is \
fitted; [provenance] states how each value was derived. SOC is 1 at the upper voltage cut-off and 0 at the lower. A fit to measured data is better.")]
struct BpxArgs {
    /// BPX file of version 0.x or 1.x; model SPM, SPMe or DFN
    #[arg(value_name = "FILE.json")]
    file: PathBuf,
    /// Name of the cell [default: title of the file]
    #[arg(long)]
    name: Option<String>,
    /// File to write, replacing an existing one [default: standard output]
    #[arg(
        short,
        long,
        visible_alias = "output",
        value_name = "MODEL.toml",
        default_value = "-",
        hide_default_value = true
    )]
    write: PathBuf,
}

/// Arguments of `import dbc`.
#[derive(Debug, clap::Args)]
struct DbcArgs {
    /// DBC file
    #[arg(value_name = "FILE.dbc")]
    file: PathBuf,
    #[command(flatten)]
    output: OutputArgs,
}

/// Arguments of `import obdb`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
The written tables carry the source's licence, CC BY-SA 4.0. Signals are named NAME.SIGNAL in [input.*]. NAME is --name or the common \
prefix of all ids in the file. Numbered signals of one answer become one line, with the letter n in braces for the number. Signals are \
left out, and listed at the end of the file, if their values are names or texts, a field is invalid, or their bits belong to another \
signal. Commands are left out if they belong to other model years, or their service is not 0x01, 0x21 or 0x22.")]
struct ObdbArgs {
    /// signalset.json of a car model
    #[arg(value_name = "FILE.json")]
    file: PathBuf,
    /// Convert only commands of this model year [default: all years]
    #[arg(long, value_name = "YEAR", value_parser = integer::<i64>(1980, 2100))]
    year: Option<i64>,
    /// Name before the dot of every signal [default: common prefix of all ids]
    #[arg(long)]
    name: Option<String>,
    #[command(flatten)]
    output: OutputArgs,
}

/// Where the result is written.
#[derive(Debug, clap::Args)]
struct OutputArgs {
    /// File to write, replacing an existing one [default: standard output]
    #[arg(short, long, value_name = "FILE", default_value = "-", hide_default_value = true)]
    output: PathBuf,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match &args.what {
        ImportCommand::Obdb(args) => import_obdb(args),
        ImportCommand::Dbc(args) => import_dbc(args),
        ImportCommand::Bpx(args) => import_bpx(args),
    }
}

fn import_dbc(args: &DbcArgs) -> Result<(), Failure> {
    check_place(&args.output.output, std::iter::once(&args.file)).map_err(Failure::new)?;
    let output = &args.output.output;
    let name = match output == Path::new("-") {
        true => args.file.display().to_string(),
        false => named_from(output, &args.file)?,
    };
    let text = dbc::import(&database(&args.file)?, &name).map_err(failure)?;
    unless_closed(write_file(output, text.as_bytes()))
}

fn import_obdb(args: &ObdbArgs) -> Result<(), Failure> {
    check_place(&args.output.output, std::iter::once(&args.file)).map_err(Failure::new)?;
    let text = read(&args.file)?;
    let source = args.file.display().to_string();
    let settings = ObdbSettings { source: source.clone(), year: args.year, name: args.name.clone() };
    let result = obdb::import(&text, &settings).map_err(failure)?;
    report(&source, &result);
    unless_closed(write_file(&args.output.output, result.text.as_bytes()))
}

fn import_bpx(args: &BpxArgs) -> Result<(), Failure> {
    check_place(&args.write, std::iter::once(&args.file)).map_err(Failure::new)?;
    let text = read(&args.file)?;
    let source = args.file.display().to_string();
    let settings = BpxSettings { source: source.clone(), name: args.name.clone() };
    let result = bpx::import(&text, &settings).map_err(failure)?;
    for found in &result.notes {
        note(format_args!("{source}: note: {found}"));
    }
    note(format_args!("{source}: {:.3} Ah between the cut-offs, {} Ah nominal", result.capacity_ah, result.nominal_ah));
    unless_closed(write_file(&args.write, result.text.as_bytes()))
}

fn report(source: &str, result: &ImportResult) {
    for warning in &result.warnings {
        note(format_args!("{source}: {warning}"));
    }
    note(format_args!("{source}: {} signals converted, {} left out", result.signals, result.exclusions.len()));
    for (reason, count) in result.counts() {
        note(format_args!("  {count} {reason}"));
    }
}
