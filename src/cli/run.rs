//! `packwatch run`.

use super::Failure;

/// Arguments of `run`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {}

/// Runs the command.
pub(crate) fn run(_args: &Args) -> Result<(), Failure> {
    Err(Failure::new("run: not built yet"))
}
