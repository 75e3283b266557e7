//! `packwatch score`: measured files against truth.

use super::Failure;

#[derive(Debug, clap::Args)]
pub(crate) struct Args {}

/// Runs the command.
pub(crate) fn run(_: &Args) -> Result<(), Failure> {
    Err(Failure::new("not built yet"))
}
