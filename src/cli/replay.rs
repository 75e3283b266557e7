//! `packwatch replay`.

use super::Failure;

/// Arguments of `replay`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {}

/// Runs the command.
pub(crate) fn run(_args: &Args) -> Result<(), Failure> {
    Err(Failure::new("replay: not built yet"))
}
