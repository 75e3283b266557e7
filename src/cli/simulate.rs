//! `packwatch simulate`.

use super::Failure;

/// Arguments of `simulate`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {}

/// Runs the command.
pub(crate) fn run(_args: &Args) -> Result<(), Failure> {
    Err(Failure::new("simulate: not built yet"))
}
