//! `packwatch dbc`: the DBC of the frames as they are configured, for those who receive them.
//!
//! It is the very layout the encoder is made from: identifiers, frame formats, end-to-end protection, cycle times,
//! value tables. A file is written beside its place and renamed when complete. A bad configuration, and one that sends
//! nothing, ends with exit code 78.

use std::io::Write as _;
use std::path::PathBuf;

use super::{EXIT_CONFIG, Failure};
use crate::config;
use crate::io::result_file::ResultFile;

/// Arguments of `dbc`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Configuration file
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// File to write instead of standard output; one that is there is replaced
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
    match written {
        // A reader that has seen enough (`| head`) is no failure.
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(Failure::new(error.to_string())),
        Ok(()) | Err(_) => Ok(()),
    }
}
