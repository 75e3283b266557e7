//! `packwatch score`: replays measured files and compares the estimates with the true values.

mod args;
mod bar;

pub(crate) use args::Args;

use super::common::logs::print_tables;
use super::common::output::{failure, print};
use packwatch_host::failure::Failure;

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let run = args.request().prepare(&|| ())?;
    let bar = bar::Bar::new(run.jobs());
    let report = run.run(&|index, part| bar.advance(index, part));
    bar.clear();
    let report = report.map_err(failure)?;
    let mut tables: Vec<_> = report.scores.iter().map(|score| score.reading.clone()).collect();
    tables.dedup();
    print_tables(&tables);
    print(&if args.output.json { report.json().map_err(failure)? } else { report.table() })
}
