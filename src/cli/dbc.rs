//! `packwatch dbc`: writes a DBC that describes the configured output frames, for the ECUs that receive them.
//!
//! The DBC is generated from the layout that the encoder uses, so it matches the sent frames. The output file gets its
//! final name only when it is complete. The exit code is 78 if the configuration is invalid or has no frames to send.

use std::path::PathBuf;

use super::common::output::unless_closed;
use crate::config;
use crate::io::result_file::write_file;
use packwatch_host::failure::{EXIT_CONFIG, Failure};

/// Arguments of `dbc`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Configuration file
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// File to write, replacing an existing one [default: standard output]
    #[arg(short, long, value_name = "FILE", default_value = "-", hide_default_value = true)]
    output: PathBuf,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let config = config::load(&args.config)?;
    let Some(layout) = config.output_layout else {
        let message = format!(
            "{}: nothing is sent, so there is no DBC to write; add a table [output] that is enabled",
            args.config.display()
        );
        return Err(Failure { message, code: EXIT_CONFIG });
    };
    unless_closed(write_file(&args.output, &layout.to_dbc_bytes()))
}
