//! `packwatch fit`: measured data to a cell model.

use super::Failure;

#[derive(Debug, clap::Args)]
pub(crate) struct Args {}

/// Runs the command.
pub(crate) fn run(_: &Args) -> Result<(), Failure> {
    Err(Failure::new("not built yet"))
}
