//! `packwatch demo`.

use super::Failure;

/// Arguments of `demo`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {}

/// Runs the command.
pub(crate) fn run(_args: &Args) -> Result<(), Failure> {
    Err(Failure::new("demo: not built yet"))
}
