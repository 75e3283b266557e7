//! `packwatch check`.

use super::Failure;

/// Arguments of `check`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {}

/// Runs the command.
pub(crate) fn run(_args: &Args) -> Result<(), Failure> {
    Err(Failure::new("check: not built yet"))
}
