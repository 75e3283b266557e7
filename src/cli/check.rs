//! `packwatch check`: says whether a configuration is good, and what it means.

use std::path::PathBuf;

use super::Failure;

/// Arguments of `check`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Configuration file
    #[arg(required_unless_present = "reference")]
    file: Option<PathBuf>,
    /// Print the reference of all keys and do nothing else
    #[arg(long, conflicts_with = "file")]
    reference: bool,
}

/// Runs the command.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    if args.reference {
        print!("{}", crate::config::reference());
    }
    if let Some(file) = &args.file {
        let config = crate::config::load(file)?;
        println!("{}: good", config.path.display());
    }
    Ok(())
}
