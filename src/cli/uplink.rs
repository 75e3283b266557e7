//! `packwatch mqtt`, `kuksa`, `sovd` and `vss`. These commands replace this process by the program `packwatch-uplink`,
//! which is in a separate package.
//!
//! `packwatch-uplink` is searched for first in the folder of this program, then in `PATH`.

use std::ffi::OsString;
use std::io;
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::Command;

use packwatch_host::failure::Failure;

const PROGRAM: &str = "packwatch-uplink";

/// Arguments of these commands; `packwatch-uplink` parses them and prints the help.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Arguments of the command; --help lists them
    #[arg(value_name = "ARG", trailing_var_arg = true, allow_hyphen_values = true)]
    arguments: Vec<OsString>,
}

/// Replaces this process by `packwatch-uplink`. Returns only if this fails.
pub(crate) fn run(command: &str, args: &Args) -> Result<(), Failure> {
    let error = Command::new(program()).arg(command).args(&args.arguments).exec();
    Err(Failure::new(match error.kind() {
        io::ErrorKind::NotFound => format!(
            "packwatch {command}: {PROGRAM} is not installed; install the package {PROGRAM}, or run \"cargo install --path src/uplink\""
        ),
        _ => format!("packwatch {command}: {PROGRAM}: {error}"),
    }))
}

/// Path of `packwatch-uplink` in the folder of this program. If that file does not exist, returns only the name, which
/// is then searched for in `PATH`.
fn program() -> PathBuf {
    let beside = std::env::current_exe().ok().map(|own| own.with_file_name(PROGRAM));
    beside.filter(|path| path.is_file()).unwrap_or_else(|| PROGRAM.into())
}
