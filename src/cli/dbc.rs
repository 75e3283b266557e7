//! `packwatch dbc`: writes the DBC of the configured frames for their receivers.
//!
//! The DBC is the layout from which the encoder is made: identifiers, frame formats, end-to-end protection, cycle times,
//! value tables. An output file appears under its name only when it is complete. Exit code 78: the configuration is
//! invalid, or it has no frames to send.

use std::io::Write as _;
use std::path::PathBuf;

use super::output::unless_closed;
use super::{EXIT_CONFIG, Failure};
use crate::config;
use crate::io::result_file::ResultFile;

/// Arguments of `dbc`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Configuration file
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// File to write instead of standard output; an existing file is replaced
    #[arg(short, long, value_name = "FILE", default_value = "-", hide_default_value = true)]
    output: PathBuf,
}

/// Runs the command.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let config = config::load(&args.config)?;
    let Some(layout) = config.output_layout else {
        let message = format!("{}: nothing is sent, must have a table [output] that is enabled", args.config.display());
        return Err(Failure { message, code: EXIT_CONFIG });
    };
    let written = ResultFile::create(&args.output).and_then(|mut file| {
        file.write_all(&layout.to_dbc_bytes())?;
        file.finish()
    });
    unless_closed(written)
}
