//! `packwatch model`: shows, plots and writes a cell model, and compares two cell models.

mod compare;
mod page;
mod source;

use std::io::Write as _;
use std::path::PathBuf;

use super::common::output::{print, print_json, unless_closed};
use crate::cell::ModelComparison;
use crate::config::cell_model;
use crate::io::result_file::{ResultFile, check_place};
#[cfg(feature = "lab")]
use crate::lab::{self, chart};
use packwatch_host::failure::Failure;
use page::ModelPage;
use source::SourceArgs;

/// Arguments of `model`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(subcommand)]
    what: ModelCommand,
}

#[derive(Debug, clap::Subcommand)]
enum ModelCommand {
    /// Show curve, resistances and capacity with their standard deviations, and the most useful next measurement
    Show(ShowArgs),
    /// Plot curve, slope and resistances with their uncertainty bands
    #[cfg(feature = "lab")]
    Plot(PlotArgs),
    /// Write a cell model file, for `pack.cell_model` and `score --cell`
    Export(ExportArgs),
    /// Compare two cell models: curve, resistances, and the effect on the SOC
    Compare(CompareArgs),
}

#[derive(Debug, clap::Args)]
struct ShowArgs {
    /// Print JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    source: SourceArgs,
}

#[cfg(feature = "lab")]
#[derive(Debug, clap::Args)]
struct PlotArgs {
    /// SVG file to write; the name must end in .svg
    #[arg(short, long, value_name = "FILE.svg")]
    out: PathBuf,
    #[command(flatten)]
    source: SourceArgs,
}

#[derive(Debug, clap::Args)]
struct ExportArgs {
    /// Cell model file to write; - writes standard output
    #[arg(short, long, value_name = "FILE.toml", default_value = "-")]
    out: PathBuf,
    #[command(flatten)]
    source: SourceArgs,
}

#[derive(Debug, clap::Args)]
struct CompareArgs {
    /// First model; accepts the same as SOURCE of `model show`
    #[arg(value_name = "A")]
    first: PathBuf,
    /// The second model
    #[arg(value_name = "B")]
    second: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match &args.what {
        ModelCommand::Show(args) => show(args),
        #[cfg(feature = "lab")]
        ModelCommand::Plot(args) => plot(args),
        ModelCommand::Export(args) => export(args),
        ModelCommand::Compare(args) => compare(args),
    }
}

fn show(args: &ShowArgs) -> Result<(), Failure> {
    let (name, sourced) = args.source.load()?;
    let page = ModelPage::new(name, &sourced);
    if args.json { unless_closed(print_json(&page)) } else { print(&page.text()) }
}

#[cfg(feature = "lab")]
fn plot(args: &PlotArgs) -> Result<(), Failure> {
    let (_, sourced) = args.source.load()?;
    check_place(&args.out, args.source.files()).map_err(Failure::new)?;
    if args.out.extension().is_none_or(|extension| extension != "svg") {
        return Err(Failure::new(format!("{}: must end in .svg", args.out.display())));
    }
    let pictures: Vec<_> = lab::model_pictures::all(&sourced).into_iter().map(|(_, picture)| picture).collect();
    chart::write_stack(&args.out, &pictures).map_err(super::common::output::failure)
}

fn export(args: &ExportArgs) -> Result<(), Failure> {
    let (name, sourced) = args.source.load()?;
    check_place(&args.out, args.source.files()).map_err(Failure::new)?;
    let head = format!("Written by `packwatch model export` from {name}.").replace(['\n', '\r'], " ");
    let text = cell_model::text(&sourced, &head);
    unless_closed(ResultFile::create(&args.out).and_then(|mut file| {
        file.write_all(text.as_bytes())?;
        file.finish()
    }))
}

fn compare(args: &CompareArgs) -> Result<(), Failure> {
    let [(first_name, first), (second_name, second)] = [source::load(&args.first)?, source::load(&args.second)?];
    let comparison = ModelComparison::new(&first.model, &second.model);
    let named = [(first_name.as_str(), &first), (second_name.as_str(), &second)];
    match args.json {
        true => unless_closed(print_json(&compare::document(&comparison, named))),
        false => print(&compare::page(&comparison, named)),
    }
}
